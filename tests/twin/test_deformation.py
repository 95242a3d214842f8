"""Mirrors that tables of displaced nodes deform: in the trace, in spots, in a job and its files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from optics.geometry.pose import rotation_matrix
from optics.geometry.surface import GridFigure
from optics.geometry.tree import Motion, compose
from optics.raytrace.system import assemble
from optics.raytrace.trace import make_rays, trace
from optics.thermal.nodal_deformation import nodal_deformation
from scenes.specs.resolved import resolve
from scenes.yaml.errors import InputError
from tests.twin.path_bench import scene_beam
from twin.main_job.job_tables import deformation_warnings
from twin.study.runs.render_base import JobMaker
from twin.study.runs.setup import resolve_study

M1, M2 = "base/forward/M1", "base/forward/M2"


def rippled(instrument, body: str, amplitude: float = 2e-8) -> GridFigure:
    element = instrument.assembly.elements[body.removeprefix("base/")]
    x0, x1, y0, y1 = element.aperture.bounds
    x, y = np.meshgrid(np.linspace(x0 - 0.02, x1 + 0.02, 60), np.linspace(y0 - 0.02, y1 + 0.02, 50))
    return GridFigure(amplitude * np.cos(40.0 * x) * np.cos(30.0 * y), (x0 - 0.02, x1 + 0.02, y0 - 0.02, y1 + 0.02))


# --- in the trace -----------------------------------------------------------------------------------------------------


def test_states_with_and_without_a_grid_in_one_batch(backend, gf7_pair) -> None:
    """Every system of a batch reads its own table: the same as each state by itself."""
    first, second = rippled(gf7_pair, M1), rippled(gf7_pair, M1, 5e-8)
    backward = Motion(grid=rippled(gf7_pair, "base/backward/M1", 3e-8))
    turned = {M2: Motion((1e-6, 0.0, 0.0))}
    states = [{}, {M1: Motion(grid=first)}, {M1: Motion(grid=second), "base/backward/M1": backward}, turned]
    names = ["forward/imaging", "backward/imaging"]
    middle, heading, across = scene_beam(gf7_pair, backend, 0.0, 0.0)
    position = middle + np.random.default_rng(2).uniform(-0.2, 0.2, (300, 2)) @ across
    rays = (position, np.broadcast_to(heading, position.shape))
    together = trace(backend, assemble(gf7_pair.assembly, ["forward/imaging"], states), make_rays(backend, *rays))
    path = together.numpy()[2]
    for k, state in enumerate(states):
        alone = trace(backend, assemble(gf7_pair.assembly, ["forward/imaging"], [state]), make_rays(backend, *rays))
        # 4 m of path; a state without grids takes the closed form alone and Newton's method in the batch
        np.testing.assert_allclose(path[k], alone.numpy()[2][0], rtol=0, atol=1e-14)
    assert np.max(np.abs(path[1] - path[0])) > 2e-8
    assert np.max(np.abs(path[2] - path[1])) > 2e-8
    both = assemble(gf7_pair.assembly, names, states)
    table = both.grids[0]
    assert table is not None
    # one table for each grid and one for none, however many systems read it
    assert table.size == 3 * 64 * 54 + 64
    np.testing.assert_array_equal(both.values[0].surface.grid.columns, [4, 60, 60, 4, 4, 4, 60, 4])
    assert both.take(np.array([6])).values[0].surface.grid.first == both.values[0].surface.grid.first[6]


def test_grids_add_up_or_are_refused(gf7_pair) -> None:
    grid = rippled(gf7_pair, M1)
    bodies = {body.path: body for body in gf7_pair.assembly.tree.bodies}
    twice = compose({M1: Motion(grid=grid)}, {M1: Motion(shift=(0.0, 0.0, 1e-6), grid=grid)}, bodies)
    np.testing.assert_array_equal(twice[M1].grid.values, 2.0 * grid.values)
    assert compose({M1: Motion(grid=grid)}, {M1: Motion()}, bodies)[M1].grid is grid
    other = GridFigure(np.zeros((5, 5)), grid.bounds)
    with pytest.raises(ValueError, match="different samples"):
        compose({M1: Motion(grid=grid)}, {M1: Motion(grid=other)}, bodies)


# --- in spots ---------------------------------------------------------------------------------------------------------


def centres(experiment, states) -> np.ndarray:
    """Energy centroids of the expected images, (S, C, 2), pixels."""
    photons = experiment.path.expected_photons(states, single=False)
    rows, columns = (np.arange(count) for count in photons.shape[2:])
    out = [np.einsum("scij,i->sc", photons, rows), np.einsum("scij,j->sc", photons, columns)]
    return np.stack(out, axis=-1) / np.sum(photons, axis=(2, 3))[..., None]


def test_a_rigid_table_is_the_rigid_motion(experiment, gf7_pair) -> None:
    element = gf7_pair.assembly.elements["forward/M1"]
    x0, x1, y0, y1 = element.aperture.bounds
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(x0, x1, 20), np.linspace(y0, y1, 20)))
    points = np.stack([x, y, element.surface.sag(x, y)], axis=-1)
    turn, shift = np.array([2e-6, -1e-6, 3e-6]), np.array([1e-6, 2e-6, -3e-6])
    motion = Motion(tuple(turn), tuple(shift))
    moves = points @ rotation_matrix(turn).T + shift - points
    face = nodal_deformation(points, moves, element.surface, element.aperture)
    one, two = centres(experiment("gf7_pair"), [{M1: motion}, {M1: face.motion()}])
    np.testing.assert_allclose(one, two, rtol=0, atol=1e-7)  # a turn of 1e-12 rad is worth 1e-6 px


def test_a_face_of_glass(experiment) -> None:
    """A table of a prism's mirror face, of defocus alone, does what that Zernike term does."""
    bench, body = experiment("gf7_pair"), "base/forward/monitor/left/prism_180/mirror"
    element = next(e for e in bench.instrument.assembly.elements.values() if e.body == body)
    disk = element.figure_disk
    x0, x1, y0, y1 = element.aperture.bounds
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(x0, x1, 24), np.linspace(y0, y1, 20)))
    square = ((x - disk.centre[0]) ** 2 + (y - disk.centre[1]) ** 2) / disk.radius**2
    moves = np.stack([0.0 * x, 0.0 * x, 5e-8 * np.sqrt(3.0) * (2.0 * square - 1.0)], axis=-1)
    face = nodal_deformation(np.stack([x, y, 0.0 * x], axis=-1), moves, element.surface, element.aperture)
    images = bench.path.expected_photons([{}, {body: Motion(figure={4: 5e-8})}, {body: face.motion()}], single=False)
    nominal, by_term, by_table = images[:, 0]
    peak = np.max(nominal)
    assert np.max(np.abs(by_term - nominal)) > 1e-4 * peak
    # the nodes' own piston is a rigid motion, which moves the aperture by picometres
    np.testing.assert_allclose(by_table, by_term, rtol=0, atol=1e-7 * peak)


# --- in a job ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def job(gf7_pair, tmp_path_factory) -> Path:
    """A job with a table beside it."""
    folder = tmp_path_factory.mktemp("deformed")
    element = gf7_pair.assembly.elements["forward/M1"]
    x0, x1, y0, y1 = element.aperture.bounds
    along, across = np.linspace(x0 - 0.01, x1 + 0.01, 30), np.linspace(y0 - 0.01, y1 + 0.01, 24)
    x, y = (a.ravel() for a in np.meshgrid(along, across))
    points = np.stack([x, y, element.surface.sag(x, y)], axis=-1)
    moves = np.cross([2e-6, -3e-6, 1e-6], points) + np.array([1e-6, -2e-6, 3e-6])
    moves[:, 2] += 2e-8 * np.sin(9.0 * x) * np.cos(7.0 * y)
    heads = "x [mm],y [mm],z [mm],dx [um],dy [um],dz [um]"
    rows = [",".join(repr(float(v)) for v in (*(1e3 * p), *(1e6 * u))) for p, u in zip(points, moves, strict=True)]
    (folder / "m1.csv").write_text("\n".join([heads, *rows]))
    text = f"instrument: gf7_pair\nperturb:\n  {M1}: {{deformation: m1.csv, shift: [0 um, 0 um, 1 um]}}\n"
    (folder / "job.yaml").write_text(text + "render: {frames: 2}\n")
    return folder / "job.yaml"


def test_other_motions_come_on_top(experiment, job) -> None:
    read = resolve(job).job
    state = experiment("gf7_pair").state(read)
    face = experiment("gf7_pair").deformed(read)[M1]
    assert state[M1].grid is face.grid
    np.testing.assert_allclose(state[M1].shift, np.array(face.shift) + np.array([0.0, 0.0, 1e-6]), rtol=0, atol=1e-11)
    assert state[M1].rotate == pytest.approx([2e-6, -3e-6, 1e-6], abs=1e-8)
    assert experiment("gf7_pair").deformed(read)[M1] is face  # worked out once


def test_warnings_name_the_body_and_what_is_wrong_with_its_mesh(gf7_pair) -> None:
    element = gf7_pair.assembly.elements["forward/M1"]
    x0, x1, y0, y1 = element.aperture.bounds
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(x0, x1, 40), np.linspace(y0, y1, 30)))
    points = np.stack([x, y, element.surface.sag(x, y)], axis=-1)
    rough = np.random.default_rng(1).normal(0.0, 5e-9, len(x))
    smooth, noisy = (
        nodal_deformation(points, np.stack([0.0 * x, 0.0 * x, u], axis=-1), element.surface, element.aperture)
        for u in (5e-9 * np.sin(8.0 * x), rough)
    )
    assert deformation_warnings({M1: smooth}) == ()
    (finer,) = deformation_warnings({M1: replace(smooth, lost=np.full_like(smooth.lost, 5e-9))})
    assert finer.startswith(f"{M1}: 5 nm rms of the surface's change are finer than its grid and not carried")
    (mesh,) = deformation_warnings({M1: smooth, M2: noisy})
    assert mesh.startswith(f"{M2}: the mesh prints through")
    plane, _ = deformation_warnings({M1: smooth, M2: noisy}, [M1])
    assert plane.startswith(f"{M1}: stray light takes faces of glass as planes")


STUDY = """name: deformed
base: {{command: render, file: {file}}}
design: {{kind: monte_carlo, runs: 4, seed: 1}}
responses: {{angle: {{key: [truth, cameras, forward, d_f_um]}}}}
factors:
  factor: {{key: [job, perturb, base/forward/M1, {key}], range: [{low}, {high}]}}
"""


def test_a_study_does_not_vary_a_table_and_keeps_that_of_its_base(job, tmp_path) -> None:
    study = tmp_path / "study.yaml"
    study.write_text(STUDY.format(file=job, key="deformation, terms", low=10, high=20))
    with pytest.raises(InputError, match="a study does not vary it"):
        resolve_study(study)
    study.write_text(STUDY.format(file=job, key="shift, 2", low="0 um", high="2 um"))
    maker = JobMaker(resolve_study(study).tree)
    key = ("job", "perturb", M1, "shift", 2)
    changed = maker.job(((key, "1.5 um"),)).job.perturb[M1]
    assert changed.shift == (0.0, 0.0, 1.5e-6)
    assert changed.deformation == resolve(job).job.perturb[M1].deformation
