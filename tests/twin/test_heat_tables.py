"""Bodies that tables of temperatures warm, in spots, in a course, and in a job with its files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from optics.geometry.tree import Motion
from optics.thermal.heat import Temperature
from scenes.models.nodal_bodies import Coverage, HeatedBody, HeatedFace
from scenes.specs.instrument import MaterialsSpec
from scenes.specs.job import JobSpec
from scenes.specs.resolved import resolve, resolve_job
from scenes.yaml.errors import InputError
from tests.scenes.test_temperature_tables import lattice, quadratic, write
from tests.twin.test_deformation import STUDY
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.time_series import series_states
from twin.monitor.truth import trace_truth
from twin.study.runs.render_base import JobMaker
from twin.study.runs.setup import resolve_study

M1 = "base/forward/M1"


@pytest.fixture(scope="module")
def silica(backend) -> MonitorExperiment:
    """The pair with everything of fused silica."""
    given = resolve_job(JobSpec(instrument="gf7_pair"))
    names = dict.fromkeys(MaterialsSpec.model_fields, "fused silica")
    spec = given.instrument.model_copy(update={"materials": MaterialsSpec(**names)})
    return MonitorExperiment(given.model_copy(update={"instrument": spec}), backend)


def job(folder: Path, text: str) -> JobSpec:
    (folder / "job.yaml").write_text(text)
    return resolve(folder / "job.yaml").job


def test_what_a_table_of_temperatures_does_not_tell_is_said() -> None:
    """Each sentence beyond its limit, and none below all limits."""
    face = HeatedFace(Motion(figure={5: 1e-8}), 0.9e-9, 0.9e-9)
    good = HeatedBody(100, 0.05, Temperature(1.0), (0.01, 0.02), 0.9e-3, Coverage(0.9e-3, 0.01), {"f": face}, 0.9e-9)
    assert good.warnings("b") == ()
    for changed, words in (
        ({"coverage": Coverage(0.02, 0.013)}, "b: 2 % of its volume lie outside of the table's nodes, up to 13 mm"),
        ({"between": 4e-3}, "b: the table is coarser than its field: nodes left out are foretold to 0.004 K rms only"),
        ({"faces": {"f": replace(face, unmeshed=2e-9)}}, "f: finite elements here follow the table to 2 nm rms only"),
        ({"faces": {"f": replace(face, lost=4e-9)}}, "f: 4 nm rms of its change by the table are finer than Z"),
        (
            {"index_path": 3e-9},
            "b: the index of glass follows the linear part of the table; the rest is worth",
        ),
    ):
        (text,) = replace(good, **changed).warnings("b")
        assert text.startswith(words)


@pytest.mark.second
def test_one_material_evenly_heated_keeps_its_angles(silica, tmp_path) -> None:
    """Told as nodes of the base, from which all bodies inherit."""
    points = np.random.default_rng(2).uniform(-1.0, 1.0, (40, 3))
    write(tmp_path / "even.csv", points, np.full(40, 298.15), "T [K]")
    state = silica.state(job(tmp_path, "instrument: gf7_pair\nperturb:\n  base: {temperature: even.csv}\n"))
    assert state[M1].stretch == pytest.approx(5.0 * 0.52e-6, rel=1e-9)
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
        silica.motions(job(tmp_path, text % keys))[M1]
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
    read = job(tmp_path, text)
    first, second = series_states(silica, read)
    field = silica.heated(read)[M1].linear
    assert first[M1].stretch == pytest.approx(0.52e-6 * silica.fields(read, 0)[M1].at(_mount(silica)), rel=1e-12)
    assert silica.fields(read, 0)[M1].change == pytest.approx(field.change, rel=1e-12)
    assert second[M1].stretch - first[M1].stretch == pytest.approx(0.52e-6, rel=1e-9)


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
