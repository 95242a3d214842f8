"""Tables and meshes of temperatures and of displaced nodes: what is linear goes the old way, the rest bends mirrors."""

from __future__ import annotations

import time
from pathlib import Path

import meshlane
import numpy as np
import pytest

from optics.thermal.nodal_deformation import nodal_deformation
from scenes.models.instrument_builder import build_instrument
from scenes.models.job_state import FINE_CELLS, HeatedBody, deformed_face, heated_bodies, job_state
from scenes.models.thermal_model import ThermalModel
from scenes.specs.instrument import MaterialsSpec
from scenes.specs.job import JobSpec
from scenes.specs.job_tables import DeformationSpec
from scenes.specs.load import load_camera, load_instrument, load_job
from scenes.specs.resolved import resolve
from scenes.yaml import node_table
from scenes.yaml.errors import InputError
from scenes.yaml.node_table import read_nodes
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


@pytest.mark.parametrize("body", quick(1, [M1, "base/forward", PRISM, "base/central_prism"]))
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


@pytest.mark.second
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
    sides = support.points - np.roll(support.points, 1, axis=0)
    np.testing.assert_allclose(np.linalg.norm(sides, axis=1), np.linalg.norm(sides[0]), rtol=1e-12)
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


@pytest.mark.second
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
        low, high = 1e3 * wrong.min(axis=0), 1e3 * wrong.max(axis=0)
        ends = ", ".join(f"{a:.4g} .. {b:.4g}" for a, b in zip(low, high, strict=True))
        with pytest.raises(InputError, match=f"lie outside of the nodes, whose x, y, z are {ends} mm"):
            warmed(silica, tmp_path, M1, wrong, quadratic(points))
    flat = np.unique(np.where([True, True, False], points, 0.1), axis=0)
    with pytest.raises(InputError, match="in a plane"):
        warmed(silica, tmp_path, M1, flat, quadratic(flat))
    with pytest.raises(InputError, match="no such node"):
        heated_bodies(job(tmp_path, M1, "{table: heat.csv, frame: base/forwrd}"), silica)
    with pytest.raises(InputError, match="at -6"):
        warmed(silica, tmp_path, M1, points, np.full(len(points), -300.0))


BODY = "base/forward/M1"
DEFORMED = "instrument: gf7_pair\nperturb:\n  base/forward/M1: {deformation: %s}\n"
HEADS = ("x", "y", "z", "dx", "dy", "dz")
TURN, SHIFT = np.array([2e-6, -3e-6, 1e-6]), np.array([1e-6, -2e-6, 3e-6])


@pytest.fixture(scope="module")
def nodes(gf7_pair) -> np.ndarray:
    """Nodes of M1 and their displacements, (N, 6), metres."""
    element = gf7_pair.assembly.elements["forward/M1"]
    x0, x1, y0, y1 = element.aperture.bounds
    x, y = (
        a.ravel() for a in np.meshgrid(np.linspace(x0 - 0.01, x1 + 0.01, 24), np.linspace(y0 - 0.01, y1 + 0.01, 20))
    )
    points = np.stack([x, y, element.surface.sag(x, y)], axis=-1)
    bump = 2e-8 * np.sin(9.0 * x) * np.cos(7.0 * y)
    moves = np.cross(TURN, points) + SHIFT + np.stack([0 * x, 0 * x, bump], axis=-1)
    return np.hstack([points, moves])


def table(
    place: Path, nodes: np.ndarray, units: tuple[str, str] = ("mm", "um"), order: tuple[int, ...] = tuple(range(6))
) -> Path:
    """A CSV file with these units of places and displacements, columns in an order."""
    per = {"m": 1.0, "mm": 1e3, "um": 1e6, "nm": 1e9}
    factors = np.array([per[units[0]]] * 3 + [per[units[1]]] * 3)
    heads = [f"{HEADS[k]} [{units[k // 3]}]" for k in order]
    rows = [",".join(repr(float(v)) for v in row[list(order)]) for row in nodes * factors]
    place.write_text("\n".join([",".join(heads), *rows]) + "\n")
    return place


def deformed(folder: Path, deformation: str) -> Path:
    place = folder / "deformed.yaml"
    place.write_text(DEFORMED % deformation)
    return place


def spec(path: Path, **more) -> DeformationSpec:
    return DeformationSpec(table=str(path), **more)


def test_units_and_order_of_rows_and_columns_do_not_matter(tmp_path, nodes, gf7_pair) -> None:
    a = table(tmp_path / "a.csv", nodes)
    shuffled = np.random.default_rng(1).permutation(nodes)
    b = table(tmp_path / "b.csv", shuffled, ("m", "nm"), (5, 1, 3, 0, 2, 4))
    one, two = (deformed_face(gf7_pair, load_job(deformed(tmp_path, p.name)), BODY, spec(p)) for p in (a, b))
    # rounding of 1 um in 1 nm: 1e-16 of the coordinates, some times over in sums of 500 nodes
    np.testing.assert_allclose(one.rotate, two.rotate, rtol=0, atol=1e-14)
    np.testing.assert_allclose(one.shift, two.shift, rtol=0, atol=1e-14)
    assert one.rms(one.change) == pytest.approx(two.rms(two.change), abs=1e-14)
    assert one.grid is not None
    assert two.grid is not None
    x, y = one.places[one.weight > 0.0].T
    np.testing.assert_allclose(one.grid.sag(x, y), two.grid.sag(x, y), rtol=0, atol=1e-13)
    assert np.max(np.abs(one.grid.sag(x, y))) > 1e-11


def test_nodes_in_another_frame(tmp_path, nodes, gf7_pair) -> None:
    placed = gf7_pair.assembly.place()
    pose = placed.pose("base").inverse() @ placed.pose(BODY)
    elsewhere = np.hstack([pose.apply(nodes[:, :3]), nodes[:, 3:] @ pose.rotation.T])
    own, base = (table(tmp_path / f"{k}.csv", n) for k, n in enumerate((nodes, elsewhere)))
    read = load_job(deformed(tmp_path, own.name))
    one, two = (
        deformed_face(gf7_pair, read, BODY, spec(own)),
        deformed_face(gf7_pair, read, BODY, spec(base, frame="base")),
    )
    np.testing.assert_allclose(one.rotate, two.rotate, rtol=0, atol=1e-13)
    np.testing.assert_allclose(one.shift, two.shift, rtol=0, atol=1e-13)
    with pytest.raises(InputError, match="stand on the clear aperture"):
        deformed_face(gf7_pair, read, BODY, spec(base))
    with pytest.raises(InputError, match="no such node"):
        deformed_face(gf7_pair, read, BODY, spec(base, frame="base/forwrd"))


@pytest.mark.parametrize("ending", ["vtu", "vtk", "msh", "med"])
def test_a_mesh_says_what_a_table_says(tmp_path, nodes, gf7_pair, ending: str) -> None:
    place = tmp_path / f"m1.{ending}"
    cells = [("triangle", np.array([[0, 1, 24], [1, 25, 24]]))]
    mesh = meshlane.Mesh(1e3 * nodes[:, :3], cells, point_data={"U": 1e3 * nodes[:, 3:]})
    mesh.write(place, **({"file_format": "gmsh"} if ending == "msh" else {}))
    read = read_nodes(place, unit="mm")
    np.testing.assert_allclose(read.points, nodes[:, :3], rtol=1e-15)
    np.testing.assert_allclose(read.moves, nodes[:, 3:], rtol=1e-15)
    with pytest.raises(InputError, match="does not say its unit"):
        load_job(deformed(tmp_path, place.name))
    with pytest.raises(InputError, match="no such vectors"):
        read_nodes(place, unit="mm", field="displacement")
    place.unlink()  # after the job was read
    with pytest.raises(InputError, match="no such file"):
        read_nodes(place, unit="mm")


def test_a_mesh_whose_reader_does_not_end_is_refused(tmp_path, monkeypatch) -> None:
    (tmp_path / "m1.vtu").touch()
    monkeypatch.setattr(node_table, "LONGEST_READING", 0.01)
    monkeypatch.setattr(meshlane, "read", lambda *_, **__: time.sleep(0.5))
    with pytest.raises(InputError, match="meshlane does not come to an end with this mesh"):
        read_nodes(tmp_path / "m1.vtu", unit="mm")


@pytest.mark.second
def test_the_job_knows_the_table_that_it_was_read_with(tmp_path, nodes) -> None:
    place = table(tmp_path / "m1.csv", nodes)
    resolved = resolve(deformed(tmp_path, place.name))
    given = resolved.job.perturb[BODY].deformation
    assert given is not None
    assert given.table == str(place)
    assert resolved.job.perturb[BODY].uses() == ("deformation",)
    config = tmp_path / "config.yaml"
    config.write_text(resolved.to_yaml())
    assert resolve(config) == resolved
    place.write_text(place.read_text().replace("e-", "e-0", 1) + "# changed\n")
    with pytest.raises(InputError, match="checksum is another"):
        resolve(config)
