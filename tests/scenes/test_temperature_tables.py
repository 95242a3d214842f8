"""Tables and meshes of temperatures: what is linear goes the old way, the rest bends mirrors; what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from optics.thermal.nodal_deformation import nodal_deformation
from scenes.models.instrument_builder import build_instrument
from scenes.models.job_state import job_state
from scenes.models.nodal_bodies import FINE_CELLS, HeatedBody, heated_bodies
from scenes.models.thermal_model import ThermalModel
from scenes.specs.instrument import MaterialsSpec
from scenes.specs.job import JobSpec
from scenes.specs.load import load_camera, load_instrument, load_job
from scenes.yaml.errors import InputError
from tests.tiers import quick

M1 = "base/forward/M1"
PRISM = "base/forward/monitor/left/prism_180"
JOB = "instrument: gf7_pair\nperturb:\n  {body}: {{temperature: {heat}}}\n"
SLOPE = np.array([0.25, -0.5, 0.75])


@pytest.fixture(scope="module")
def silica(backend) -> ThermalModel:
    """Everything of fused silica."""
    names = dict.fromkeys(MaterialsSpec.model_fields, "fused silica")
    spec = load_instrument("gf7_pair").model_copy(update={"materials": MaterialsSpec(**names)})
    return ThermalModel(build_instrument(spec, {"gf7": load_camera("gf7")}, backend))


def lattice(model: ThermalModel, path: str, counts: tuple[int, int, int] = (17, 15, 5)) -> np.ndarray:
    """Nodes in a box about a body, (N, 3), metres."""
    held = model.elastic(path)
    points = model.extent(path) if held is None else held[0].nodes
    low, high = points.min(axis=0) - 1e-3, points.max(axis=0) + 1e-3
    sides = (np.linspace(a, b, n) for a, b, n in zip(low, high, counts, strict=True))
    return np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 3)


def write(place: Path, points: np.ndarray, values: np.ndarray, head: str = "dT [K]", unit: str = "mm") -> Path:
    factor = {"m": 1.0, "mm": 1e3}[unit]
    rows = [",".join(map(repr, (*map(float, factor * p), float(t)))) for p, t in zip(points, values, strict=True)]
    place.write_text("\n".join([f"x [{unit}],y [{unit}],z [{unit}],{head}", *rows]) + "\n")
    return place


def job(folder: Path, body: str, heat: str) -> JobSpec:
    (folder / "job.yaml").write_text(JOB.format(body=body, heat=heat))
    return load_job(folder / "job.yaml")


def warmed(model: ThermalModel, folder: Path, body: str, points: np.ndarray, values: np.ndarray) -> HeatedBody:
    place = write(folder / "heat.csv", points, values)
    return heated_bodies(job(folder, body, place.name), model)[body]


# --- what is linear ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("body", quick(1, ["base/forward", M1, PRISM, "base/central_prism"]))
def test_a_linear_table_is_the_linear_temperature(silica, tmp_path, body) -> None:
    points = lattice(silica, body)
    if body in ("base/forward", "base/central_prism"):
        points = np.random.default_rng(1).uniform(-0.5, 0.5, (60, 3))
    place = write(tmp_path / "heat.csv", points, 0.7 + points @ SLOPE)
    by_table = job_state(job(tmp_path, body, place.name), silica)
    number = "{change: 0.7 K, gradient: [0.25 K/m, -0.5 K/m, 0.75 K/m]}"
    by_number = job_state(job(tmp_path, body, number), silica)
    assert by_table.keys() == by_number.keys()
    for path, motion in by_number.items():
        # numbers of 17 digits, least squares of some 1e4 places: 1e-13 of 1 K and 1e-5 m
        for name in ("rotate", "shift", "index_gradient"):
            np.testing.assert_allclose(getattr(by_table[path], name), getattr(motion, name), rtol=1e-9, atol=1e-17)
        assert by_table[path].stretch == pytest.approx(motion.stretch, rel=1e-9)
        assert by_table[path].index == pytest.approx(motion.index, rel=1e-9, abs=1e-18)
        assert {j: by_table[path].figure.get(j, 0.0) for j in motion.figure} == pytest.approx(
            dict(motion.figure), rel=1e-9, abs=1e-17
        )


def test_numbers_beside_a_table_are_added(silica, tmp_path) -> None:
    points = lattice(silica, M1, (7, 7, 3))
    write(tmp_path / "heat.csv", points, 0.5 + points @ SLOPE)
    both = job(tmp_path, M1, "{table: heat.csv, change: 0.2 K, gradient: [1 K/m, 0 K/m, 0 K/m]}")
    number = "{change: 0.7 K, gradient: [1.25 K/m, -0.5 K/m, 0.75 K/m]}"
    state, expected = job_state(both, silica), job_state(job(tmp_path, M1, number), silica)
    assert state[M1].stretch == pytest.approx(expected[M1].stretch, rel=1e-9)
    np.testing.assert_allclose(state[M1].rotate, expected[M1].rotate, rtol=1e-9)


# --- what is not linear -----------------------------------------------------------------------------------------------


def quadratic(points: np.ndarray) -> np.ndarray:
    x, y, z = points.T
    return 4.0 * x**2 - 2.0 * x * y + 1.0 * y * z + 30.0 * z**2


@pytest.mark.second
def test_a_quadratic_field_is_the_thermo_elastic_solution(silica, tmp_path) -> None:
    """Solved directly on the same elements; a table of 12 mm lies h^2/8 of the curvature below the field."""
    elastic, support = silica.elastic(M1, cells=FINE_CELLS)
    ((aperture, _),) = silica.faces_of(M1).values()
    surface = silica.surface(M1)
    points = lattice(silica, M1, (21, 19, 9))
    body = warmed(silica, tmp_path, M1, points, quadratic(points))

    def rest(p: np.ndarray) -> np.ndarray:
        return quadratic(p) - body.linear.change - p @ np.array(body.linear.gradient)

    (moved,) = elastic.solve_many([rest], support)
    face = np.abs(moved.nodes[:, 2] - surface.sag(*moved.nodes[:, :2].T)) < 1e-9
    exact = nodal_deformation(moved.nodes[face], moved.values[face], surface, aperture).figure
    size = np.sqrt(sum(a * a for j, a in exact.items() if j > 3))
    error = [a - body.faces[M1].motion.figure[j] for j, a in exact.items() if j > 3]
    assert size > 1e-8
    assert np.sqrt(np.sum(np.square(error))) < 0.05 * size
    assert body.coverage.outside == 0.0
    assert body.warnings(M1) == ()


def test_zerodur_does_not_bend(gf7_pair, tmp_path) -> None:
    model = ThermalModel(gf7_pair)
    if model.materials[M1].expansion != 0.0:
        pytest.skip("its mirrors expand")
    points = lattice(model, M1)
    body = warmed(model, tmp_path, M1, points, quadratic(points))
    assert body.faces == {}


@pytest.mark.second
def test_a_quadratic_field_in_glass(silica, tmp_path) -> None:
    """A weak one bends its faces and tells what its index leaves; a strong one is refused, with the linear field."""
    points = lattice(silica, PRISM)
    middle, size = points.mean(axis=0), np.ptp(points, axis=0)
    shape = np.sum(((points - middle) / size) ** 2, axis=1)
    body = warmed(silica, tmp_path, PRISM, points, 5e-4 * shape)
    assert set(body.faces) == set(silica.faces_of(PRISM))
    assert max(abs(a) for face in body.faces.values() for a in face.motion.figure.values()) > 1e-13
    assert 0.0 < body.index_path < 6.5e-9
    assert [text for text in body.warnings(PRISM) if "index of glass follows the linear part" in text]
    linear = warmed(silica, tmp_path, PRISM, points, 0.1 + points @ SLOPE)
    assert linear.warnings(PRISM) == ()
    with pytest.raises(InputError, match="rays through its glass") as caught:
        warmed(silica, tmp_path, PRISM, points, 2.0 + 2.0 * shape)
    assert "temperature: {change: " in str(caught.value)
    assert caught.value.issues[0].line == 3


# --- what is wrong ----------------------------------------------------------------------------------------------------


def test_bodies_without_finite_elements_follow_linear_fields_only(silica, tmp_path) -> None:
    points = np.random.default_rng(1).uniform(-0.5, 0.5, (80, 3))
    for body in ("base", "base/forward", "base/forward/focal_plane"):
        assert warmed(silica, tmp_path, body, points, 1.0 + points @ SLOPE).faces == {}
        with pytest.raises(InputError, match="has no shape here") as caught:
            warmed(silica, tmp_path, body, points, quadratic(points))
        assert "the nearest linear field" in str(caught.value)


@pytest.mark.second
def test_warnings_of_coverage_and_of_coarse_tables(silica, tmp_path) -> None:
    points = lattice(silica, M1, (9, 9, 4))
    half = points[points[:, 0] < np.quantile(points[:, 0], 0.8)]
    texts = warmed(silica, tmp_path, M1, half, quadratic(half)).warnings(M1)
    assert "lie outside of the table's nodes" in texts[0]
    rough = np.random.default_rng(5).normal(0.0, 0.1, len(points))
    texts = warmed(silica, tmp_path, M1, points, rough).warnings(M1)
    assert "coarser than its field" in texts[0]


def test_tables_of_another_body_frame_or_unit_are_refused(silica, tmp_path) -> None:
    points = lattice(silica, M1)
    for wrong in (points + np.array([0.0, 0.0, 3.0]), 1e-3 * points):
        with pytest.raises(InputError, match="lie outside of the nodes"):
            warmed(silica, tmp_path, M1, wrong, quadratic(points))
    flat = np.unique(np.where([True, True, False], points, 0.1), axis=0)
    with pytest.raises(InputError, match="in a plane"):
        warmed(silica, tmp_path, M1, flat, quadratic(flat))
    with pytest.raises(InputError, match="no such node"):
        heated_bodies(job(tmp_path, M1, "{table: heat.csv, frame: base/forwrd}"), silica)
    with pytest.raises(InputError, match="at -6"):
        warmed(silica, tmp_path, M1, points, np.full(len(points), -300.0))
