"""Mirrors that tables of displaced nodes deform: in the trace, in spots, in a job and its files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from optics.geometry.surface import GridFigure
from optics.geometry.tree import Motion, compose
from optics.thermal.heat import Temperature
from optics.thermal.nodal_deformation import Coverage, nodal_deformation
from scenes.models.job_state import HeatedBody, HeatedFace
from scenes.specs.instrument import MaterialsSpec
from scenes.specs.job import JobSpec
from scenes.specs.resolved import resolve, resolve_job
from scenes.yaml.errors import InputError
from tests.scenes.test_thermal_model import lattice, quadratic, write
from twin.main_job.render_files import deformation_warnings
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.time_series import series_states
from twin.monitor.truth import trace_truth
from twin.study.runs.render_base import JobMaker
from twin.study.runs.setup import resolve_study

M1, M2 = "base/forward/M1", "base/forward/M2"


def rippled(instrument, body: str, amplitude: float = 2e-8) -> GridFigure:
    element = instrument.assembly.elements[body.removeprefix("base/")]
    x0, x1, y0, y1 = element.aperture.bounds
    x, y = np.meshgrid(np.linspace(x0 - 0.02, x1 + 0.02, 60), np.linspace(y0 - 0.02, y1 + 0.02, 50))
    return GridFigure(amplitude * np.cos(40.0 * x) * np.cos(30.0 * y), (x0 - 0.02, x1 + 0.02, y0 - 0.02, y1 + 0.02))


# --- in the trace -----------------------------------------------------------------------------------------------------


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
    assert finer.startswith(f"{M1}: 5 nm rms of the surface's change are finer than its grid and are not modelled")
    (mesh,) = deformation_warnings({M1: smooth, M2: noisy})
    assert mesh.startswith(f"{M2}: the mesh is too coarse for the residual")
    plane, _ = deformation_warnings({M1: smooth, M2: noisy}, [M1])
    assert plane.startswith(f"{M1}: stray light treats faces of glass as planes")


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


@pytest.fixture(scope="module")
def silica(backend) -> MonitorExperiment:
    """The pair with everything of fused silica."""
    given = resolve_job(JobSpec(instrument="gf7_pair"))
    names = dict.fromkeys(MaterialsSpec.model_fields, "fused silica")
    spec = given.instrument.model_copy(update={"materials": MaterialsSpec(**names)})
    return MonitorExperiment(given.model_copy(update={"instrument": spec}), backend)


def job_of(folder: Path, text: str) -> JobSpec:
    (folder / "job.yaml").write_text(text)
    return resolve(folder / "job.yaml").job


def test_what_a_table_of_temperatures_does_not_tell_is_said() -> None:
    """Each sentence beyond its limit, and none below all limits."""
    face = HeatedFace(Motion(figure={5: 1e-8}), 0.9e-9, 0.9e-9)
    good = HeatedBody(100, 0.05, Temperature(1.0), (0.01, 0.02), 0.9e-3, Coverage(0.9e-3, 0.01), {"f": face}, 0.9e-9)
    assert good.warnings("b") == ()
    for changed, words in (
        ({"coverage": Coverage(0.02, 0.013)}, "b: 2 % of its volume lie outside of the table's nodes, up to 13 mm"),
        (
            {"between": 4e-3},
            "b: the table is too coarse for its field: the leave-one-out error at its nodes is 0.004 K rms",
        ),
        ({"faces": {"f": replace(face, mesh_error=2e-9)}}, "f: the finite elements follow the table to 2 nm rms only"),
        ({"faces": {"f": replace(face, lost=4e-9)}}, "f: 4 nm rms of its change by the table are beyond Z"),
        (
            {"index_path": 3e-9},
            "b: the index of its glass follows the linear part of the table only; the residual causes",
        ),
    ):
        (text,) = replace(good, **changed).warnings("b")
        assert text.startswith(words)


@pytest.mark.second
def test_one_material_evenly_heated_keeps_its_angles(silica, tmp_path) -> None:
    """Told as nodes of the base, from which all bodies inherit."""
    points = np.random.default_rng(2).uniform(-1.0, 1.0, (40, 3))
    write(tmp_path / "even.csv", points, np.full(40, 298.15), "T [K]")
    state = silica.state(job_of(tmp_path, "instrument: gf7_pair\nperturb:\n  base: {temperature: even.csv}\n"))
    assert state[M1].expansion == pytest.approx(5.0 * 0.52e-6, rel=1e-9)
    truth = trace_truth(silica.instrument, silica.backend, [{}, state])
    for name in silica.instrument.cameras:
        change = truth.cameras[name]
        # a copy of other size: rays turn by rounding of some metres over some metres
        for angle in (change.d_alpha, change.d_beta, change.d_gamma):
            assert np.max(np.abs(angle)) < 1e-13
        assert np.max(np.abs(change.d_f)) < 1e-11


@pytest.mark.second
def test_a_table_of_displaced_nodes_of_the_same_mirror_is_added(silica, tmp_path) -> None:
    points = lattice(silica.thermal, M1, (9, 8, 4))
    write(tmp_path / "heat.csv", points, quadratic(points))
    element = silica.instrument.assembly.elements["forward/M1"]
    x0, x1, y0, y1 = element.aperture.bounds
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(x0, x1, 24), np.linspace(y0, y1, 20)))
    bump = 2e-8 * np.sin(30.0 * x) * np.cos(25.0 * y)
    rows = np.stack([1e3 * x, 1e3 * y, 1e3 * element.surface.sag(x, y), 0.0 * x, 0.0 * x, 1e9 * bump], axis=-1)
    heads = "x [mm],y [mm],z [mm],dx [nm],dy [nm],dz [nm]"
    (tmp_path / "nodes.csv").write_text("\n".join([heads, *(",".join(map(repr, r)) for r in rows.tolist())]))
    text = "instrument: gf7_pair\nperturb:\n  base/forward/M1: {%s}\n"
    both, heat, bent = (
        silica.motions(job_of(tmp_path, text % keys))[M1]
        for keys in ("deformation: nodes.csv, temperature: heat.csv", "temperature: heat.csv", "deformation: nodes.csv")
    )
    for j in both.figure:
        assert both.figure[j] == pytest.approx(heat.figure[j] + bent.figure[j], abs=1e-14)
    u, v = np.random.default_rng(1).uniform(-0.05, 0.05, (2, 50)) + np.array([[0.5 * (x0 + x1)], [0.5 * (y0 + y1)]])
    sag = heat.grid.sag(u, v) + bent.grid.sag(u, v)
    # the grid of the heat is put on the samples of the other
    np.testing.assert_allclose(both.grid.sag(u, v), sag, rtol=0, atol=0.02 * np.max(np.abs(heat.grid.values)))


@pytest.mark.second
def test_in_a_course_the_table_stays_and_the_course_is_added(silica, tmp_path) -> None:
    points = lattice(silica.thermal, M1, (7, 7, 3))
    write(tmp_path / "heat.csv", points, 0.5 + points @ np.array([0.2, 0.0, 0.1]))
    text = f"""instrument: gf7_pair
perturb:
  {M1}: {{temperature: heat.csv}}
course:
  times: [0 min, 10 min]
  temperature: {{{M1}: {{change: [0 K, 1 K]}}}}
"""
    read = job_of(tmp_path, text)
    first, second = series_states(silica, read)
    field = silica.heated(read)[M1].linear
    assert first[M1].expansion == pytest.approx(0.52e-6 * silica.fields(read, 0)[M1].at(_mount(silica)), rel=1e-12)
    assert silica.fields(read, 0)[M1].change == pytest.approx(field.change, rel=1e-12)
    assert second[M1].expansion - first[M1].expansion == pytest.approx(0.52e-6, rel=1e-9)


def _mount(experiment: MonitorExperiment) -> np.ndarray:
    return np.array({b.path: b for b in experiment.instrument.assembly.tree.bodies}[M1].pivots["centre"])


def test_a_study_keeps_the_table_and_varies_what_is_added(silica, tmp_path) -> None:
    write(tmp_path / "heat.csv", *(lambda p: (p, quadratic(p)))(lattice(silica.thermal, M1, (7, 7, 3))))
    (tmp_path / "job.yaml").write_text(f"instrument: gf7_pair\nperturb:\n  {M1}: {{temperature: heat.csv}}\n")
    study = tmp_path / "study.yaml"
    for key, problem in (("temperature, table", "does not vary it"), ("temperature, unit", "does not vary it")):
        study.write_text(STUDY.format(file=tmp_path / "job.yaml", key=key, low=1, high=2))
        with pytest.raises(InputError, match=problem):
            resolve_study(study)
    study.write_text(STUDY.format(file=tmp_path / "job.yaml", key="temperature, change", low="0 K", high="2 K"))
    maker = JobMaker(resolve_study(study).tree)
    changed = maker.job(((("job", "perturb", M1, "temperature", "change"), "1.5 K"),)).job.perturb[M1].temperature
    assert changed.change == 1.5
    assert changed.table == str(tmp_path / "heat.csv")
