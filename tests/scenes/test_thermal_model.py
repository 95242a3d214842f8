"""Tables and meshes of temperatures and of displaced nodes: what is linear goes the old way, the rest bends mirrors.

Heat in the whole instrument: who inherits which temperature, what expands about what, what glass does to a beam.
"""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import meshlane
import numpy as np
import pytest

from optics.geometry.pose import rotation_matrix
from optics.geometry.tree import Motion
from optics.materials.glass import GLASSES, glass
from optics.materials.material import MATERIALS, material
from optics.raytrace.system import assemble
from optics.raytrace.trace import make_rays, trace
from optics.thermal.heat import Temperature, carried_motion
from optics.thermal.nodal_deformation import nodal_deformation
from optics.thermal.thermo_elastic import free_linear_field
from scenes.models.instrument_builder import build_instrument
from scenes.models.instrument_model import Instrument
from scenes.models.job_state import FINE_CELLS, HeatedBody, deformed_face, heated_bodies, job_state
from scenes.models.thermal_model import TemperatureError, ThermalModel
from scenes.specs.instrument import MaterialsSpec
from scenes.specs.job import JobSpec, checked_nodes
from scenes.specs.job_tables import DeformationSpec
from scenes.specs.load import load_camera, load_instrument, load_job
from scenes.specs.resolved import resolve, resolve_job
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
        assert by_table[path].expansion == pytest.approx(motion.expansion, rel=1e-9)
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
    assert state[M1].expansion == pytest.approx(expected[M1].expansion, rel=1e-9)
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
    assert [text for text in body.warnings(PRISM) if "index of its glass follows the linear part" in text]
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
        with pytest.raises(InputError, match="has no finite elements") as caught:
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
    assert "too coarse for its field" in texts[0]


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
    x, y = one.points[one.weight > 0.0].T
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
    with pytest.raises(InputError, match="lie on the clear aperture"):
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
    with pytest.raises(InputError, match="does not contain its unit"):
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
    with pytest.raises(InputError, match="meshlane does not finish reading this mesh"):
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
    with pytest.raises(InputError, match="checksum differs"):
        resolve(config)


# --- thermal model ----------------------------------------------------------------------------------------------------

SILICA = material("fused silica")
WAVELENGTH = 650e-9
PRISMS = {"forward": PRISM, "backward": "base/backward/monitor/left/prism_180"}


@pytest.fixture(scope="module")
def model(gf7_pair) -> ThermalModel:
    return ThermalModel(gf7_pair)


def variant(backend, **changes) -> Instrument:
    """The pair gf7 with other materials or prisms."""
    spec = load_instrument("gf7_pair").model_copy(update=changes)
    return build_instrument(spec, {"gf7": load_camera("gf7")}, backend)


@pytest.fixture(scope="module")
def one_material(backend) -> ThermalModel:
    """Everything of fused silica."""
    names = dict.fromkeys(MaterialsSpec.model_fields, SILICA.name)
    return ThermalModel(variant(backend, materials=MaterialsSpec(**names)))


# --- who has which temperature ----------------------------------------------------------------------------------------


def test_temperature_is_inherited_until_a_body_has_its_own(model) -> None:
    field = Temperature(2.0, (0.3, -0.5, 0.7))
    own = Temperature(-1.0, (0.0, 0.1, 0.0))
    fields = model.fields({"base/forward": field, "base/forward/monitor/left": own})
    assert fields["base/forward"] is field
    assert fields["base/forward/monitor/left"] is own
    assert fields["base/forward/M1"].change != 2.0
    assert not any(path.startswith(("base/backward", "base/central")) or path == "base" for path in fields)
    # what inherits sees the same field at the same place, in its own axes
    placed = model.instrument.assembly.place()
    for path, inherited in fields.items():
        carrier, source = ("base/forward/monitor/left", own) if "monitor/left" in path else ("base/forward", field)
        for point in ((0.0, 0.0, 0.0), (0.3, -0.2, 0.9)):
            there = placed.pose(carrier).inverse().apply(placed.pose(path).apply(np.array(point)))
            assert inherited.at(np.array(point)) == pytest.approx(source.at(there), abs=1e-13)


# --- expansion --------------------------------------------------------------------------------------------------------


@pytest.mark.second
def test_a_structure_carries_its_children_and_a_mirror_grows_about_its_centre(backend) -> None:
    """Camera of aluminium, mirrors of N-BK7: the mirror's centre rides on the camera, its vertex follows from that."""
    heat = ThermalModel(variant(backend, materials=MaterialsSpec(camera="aluminium", mirror="N-BK7")))
    change, camera, mirror = 3.0, material("aluminium").expansion, material("N-BK7").expansion
    placed = heat.instrument.assembly.place([{}, heat.state({"base/forward": Temperature(change)})])
    root = placed.pose("base/forward")
    for name in ("M1", "M2", "M3"):
        body = heat.instrument.assembly.tree[f"base/forward/{name}"]
        centre = np.array(body.pivots["centre"])
        held = root.apply((1.0 + camera * change) * body.pose.apply(centre))
        now = placed.pose(body.path, 1)
        grown = 1.0 + mirror * change
        assert placed.scale[1, placed.index[body.path]] == pytest.approx(grown, abs=1e-15)
        np.testing.assert_allclose(now.apply(grown * centre), held, atol=2e-15)
        np.testing.assert_allclose(now.translation, held - now.rotation @ (grown * centre), atol=2e-15)
    np.testing.assert_array_equal(placed.rotation[0], placed.rotation[1])


@pytest.mark.second
def test_nested_structures_move_as_one_free_body(backend) -> None:
    """Base, camera, focal plane, boards: of one material, they follow the exact field of a single free body."""
    field = Temperature(1.5, (3.0, -2.0, 5.0))
    names = dict.fromkeys(MaterialsSpec.model_fields, SILICA.name) | {"mirror": "Zerodur"}
    instrument = variant(backend, materials=MaterialsSpec(**names))
    heat = ThermalModel(instrument)
    # the prisms' own bending is not looked at here, and takes seconds
    cold = {solid.path: Temperature() for solid in instrument.solids}
    placed = instrument.assembly.place([{}, heat.state({"base": field} | cold)])
    free = free_linear_field(SILICA.expansion, field.change, field.gradient)
    optics = {s.path for s in instrument.solids} | {f"base/{c}/M{k}" for c in instrument.cameras for k in (1, 2, 3)}
    checked = 0
    for path, i in placed.index.items():
        if any(path == o or path.startswith(f"{o}/") for o in optics):
            continue
        before, after = placed.pose(path), placed.pose(path, 1)
        np.testing.assert_allclose(after.translation - before.translation, free(before.translation[None])[0], atol=1e-9)
        turn, _ = carried_motion(SILICA.expansion, np.array(field.gradient), before.translation)
        np.testing.assert_allclose(after.rotation, rotation_matrix(turn) @ before.rotation, atol=1e-9)
        assert placed.scale[1, i] - 1.0 == pytest.approx(SILICA.expansion * field.at(before.translation), rel=1e-4)
        checked += 1
    assert checked == 1 + 2 * 12


# --- prisms -----------------------------------------------------------------------------------------------------------


def through(instrument: Instrument, camera: str, states, backend, offset=(0.0, 0.0)):
    """A ray along z of the 180-deg prism's frame, from its window back to it: directions (S, 3) in the prism's frame,
    optical paths (S,), and the nominal places (5, 3) on the faces that it meets.
    """
    prism = PRISMS[camera]
    names = [n for n in instrument.assembly.sequences[f"{camera}/left/outgoing"] if "/prism_180/" in n]
    frame = instrument.assembly.nominal_pose(prism)
    entry = instrument.assembly.nominal_pose(instrument.assembly.elements[names[0]].body).translation
    start, along = entry + frame.rotation[:, :2] @ np.array(offset), frame.rotation[:, 2]
    every = range(len(names))
    systems = assemble(instrument.assembly, [names], states)
    traced = trace(backend, systems, make_rays(backend, start, along), keep=every, world=True)
    _, direction, path, valid = traced.numpy(traced.world)
    assert valid.all()
    places = []
    for k, name in enumerate(names):
        body = instrument.assembly.nominal_pose(instrument.assembly.elements[name].body)
        places.append(frame.inverse().apply(body.apply(traced.hit(k)[0, 0])))
    return direction[:, 0] @ frame.rotation, path[:, 0], np.array(places)


def only_glass(state, prism: str):
    """The change of index alone, without any deformation."""
    motion = state[prism]
    return {prism: Motion(index=motion.index, index_gradient=motion.index_gradient)}


def bulk_turn(instrument: Instrument, camera: str, places: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """Change of the direction behind the prism, (3,), by a gradient ``slope`` of its index.

    n d changes by the integral of the gradient along each leg, and is mirrored at all faces that come after it.
    """
    frame = instrument.assembly.nominal_pose(PRISMS[camera])
    total = np.zeros(3)
    for k in range(4):
        total = total + np.linalg.norm(places[k + 1] - places[k]) * slope
        if k < 3:
            name = ("mirror", "roof_a", "roof_b")[k]
            normal = frame.rotation.T @ instrument.assembly.nominal_pose(f"{PRISMS[camera]}/{name}").rotation[:, 2]
            total = total - 2.0 * (total @ normal) * normal
    return np.array([total[0], total[1], 0.0])


def test_a_uniform_change_of_a_perfect_prism_lengthens_the_path_and_turns_nothing(model, gf7_pair, backend) -> None:
    change = 5.0
    state = model.state({PRISM: Temperature(change)})
    step = glass(SILICA.name).vacuum_index(WAVELENGTH, 293.15 + change) - glass(SILICA.name).vacuum_index(WAVELENGTH)
    direction, path, _ = through(gf7_pair, "forward", [{}, only_glass(state, PRISM), state], backend)
    np.testing.assert_allclose(direction, np.broadcast_to([0.0, 0.0, -1.0], (3, 3)), atol=1e-14)
    length = gf7_pair.glass_path["forward/left"]["prism_180"]
    index = glass(SILICA.name).vacuum_index(WAVELENGTH)
    assert path[0] == pytest.approx(index * length, rel=1e-13)
    assert path[1] - path[0] == pytest.approx(step * length, rel=1e-9)
    # the prism itself grows as well, about a centre on neither face: the start's distance to the window comes in
    grown = SILICA.expansion * change
    window = grown * gf7_pair.assembly.tree[PRISM].pivots["centre"][2]
    assert path[2] - path[0] == pytest.approx(step * length + index * grown * length - window, rel=1e-4)


@pytest.mark.parametrize("reference", [293.15, 253.15])
def test_the_index_is_that_at_the_temperature_of_the_glass(gf7_pair, reference: float) -> None:
    """dn/dT itself changes by 2.5e-3 per kelvin: 60 K below 20 C it is 0.84 of what it is there, at 40 K, 0.89."""
    heat = ThermalModel(replace(gf7_pair, spec=gf7_pair.spec.model_copy(update={"temperature": reference})))
    heat.materials = dict.fromkeys(heat.materials, material("Zerodur"))  # nothing expands: no finite elements
    index, gradient, step = glass(SILICA.name).vacuum_index, np.array([0.2, -0.1, 0.3]), 0.01
    for change in (-60.0, 0.0, 45.0):
        motion = heat.state({PRISM: Temperature(change, tuple(gradient))})[PRISM]
        here = reference + change
        assert motion.index == pytest.approx(index(WAVELENGTH, here) - index(WAVELENGTH, reference), abs=1e-15)
        slope = (index(WAVELENGTH, here + step) - index(WAVELENGTH, here - step)) / (2.0 * step)
        assert motion.index_gradient == pytest.approx(slope * gradient, rel=1e-7)
        if abs(here - 293.15) > 30.0:
            at_20 = glass(SILICA.name).dn_dt(WAVELENGTH)
            assert abs(slope / at_20 - 1.0) > 0.05  # so far apart that the one cannot pass for the other


@pytest.mark.second
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_glass_and_deformation_together(model, gf7_pair, backend, axis: int) -> None:
    """Exact geometry of a free prism with a linear temperature.

    Its strain is a T in all directions, so lengths grow by 1 + a T and no angle changes: in the material's own
    coordinates light sees the undeformed prism with index n (1 + a T), whose gradient is dn/dT g + n a g. Entry and
    exit are turned by w = a g x q; a retroreflector's output turns by (w_entry - w_exit) x d, whatever holds it.
    """
    gradient = np.eye(3)[axis] * 0.05
    index, slope = glass(SILICA.name).vacuum_index(WAVELENGTH), glass(SILICA.name).dn_dt(WAVELENGTH)
    a = SILICA.expansion
    for camera, prism in PRISMS.items():
        state = model.state({prism: Temperature(0.0, tuple(gradient))})
        direction, _, places = through(gf7_pair, camera, [{}, state], backend)
        ends = np.cross(a * np.cross(gradient, places[0] - places[4]), [0.0, 0.0, 1.0])
        expected = bulk_turn(gf7_pair, camera, places, (slope + index * a) * gradient) + ends
        scale = slope * 0.05 * gf7_pair.glass_path[f"{camera}/left"]["prism_180"]
        np.testing.assert_allclose((direction[1] - direction[0])[:2], expected[:2], atol=1e-4 * scale)


# --- together with motions --------------------------------------------------------------------------------------------


def test_motions_act_on_top_of_heat_exactly(model, gf7_pair) -> None:
    motions = {
        "base/forward": Motion(rotate=(2e-3, -1e-3, 3e-3), shift=(1e-4, 2e-4, -3e-4), scale=5e-4),
        "base/forward/M2": Motion(
            rotate=(-4e-3, 1e-3, 2e-3), shift=(3e-4, 0.0, -1e-4), pivot="centre", figure={5: 1e-8}
        ),
        "base/backward/focal_plane": Motion(rotate=(1e-3, 2e-3, -1e-3), pivot="rear_node"),
    }
    heat = {"base": Temperature(20.0), "base/backward/focal_plane": Temperature(10.0, (1.0, -2.0, 3.0))}
    warm, both = model.state(heat), model.state(heat, motions)
    placed = gf7_pair.assembly.place([warm, both])
    for path, motion in motions.items():
        body = gf7_pair.assembly.tree[path]
        turn, pivot = rotation_matrix(np.array(motion.rotate)), np.array(body.pivots[motion.pivot])
        offset = pivot + np.array(motion.shift) - (1.0 + motion.scale) * turn @ pivot
        own = {**warm, path: both[path]}  # its ancestors moved as by heat alone
        alone = gf7_pair.assembly.place([warm, own])
        i = alone.index[path]
        scale = alone.scale[0, i]
        np.testing.assert_allclose(alone.rotation[1, i], alone.rotation[0, i] @ turn, atol=1e-15)
        expected = alone.translation[0, i] + scale * alone.rotation[0, i] @ offset
        np.testing.assert_allclose(alone.translation[1, i], expected, atol=3e-15)
        assert alone.scale[1, i] == pytest.approx(scale * (1.0 + motion.scale), rel=1e-15)
    assert both["base/forward/M2"].figure == {5: 1e-8}  # Zerodur does not bend
    untouched = placed.index["base/backward/M1"]
    np.testing.assert_array_equal(placed.translation[0, untouched], placed.translation[1, untouched])


# --- what cannot be ---------------------------------------------------------------------------------------------------


def test_absolute_zero_is_looked_for_in_the_far_corners(model) -> None:
    model.check({PRISM: Temperature(-119.0)})
    with pytest.raises(TemperatureError, match=f"{PRISM} would be at -6.85 K") as caught:
        model.check({PRISM: Temperature(-300.0)})
    assert caught.value.origin == PRISM
    # the middle of the prism stays warm, its far end does not
    steep = Temperature(-200.0, (200.0, 0.0, 0.0))
    assert steep.at(np.array([0.4, 0.0, 0.0])) > -293.15
    with pytest.raises(TemperatureError, match="absolute zero") as caught:
        model.check({PRISM: steep})
    assert caught.value.origin == PRISM
    # nor is it where fused silica is known
    with pytest.raises(TemperatureError, match="fused silica is not known"):
        model.check({PRISM: Temperature(-100.0, (100.0, 0.0, 0.0))})


def test_an_inherited_temperature_is_blamed_on_its_origin(model) -> None:
    with pytest.raises(TemperatureError, match="base/forward") as caught:
        model.check({"base/forward": Temperature(-200.0, (0.0, 0.0, -100.0))})
    assert caught.value.origin == "base/forward"


def test_a_glass_without_known_dn_dt_cannot_be_warmed(backend) -> None:
    spec = load_instrument("gf7_pair")
    prism = spec.monitor.prism_0.model_copy(update={"material": "Zerodur"})
    heat = ThermalModel(variant(backend, monitor=spec.monitor.model_copy(update={"prism_0": prism})))
    heat.check({"base/forward/monitor/left/prism_180": Temperature(1.0)})
    for field in (Temperature(1.0), Temperature(0.0, (0.1, 0.0, 0.0))):
        with pytest.raises(TemperatureError, match="prism_0: Zerodur: no constants") as caught:
            heat.check({"base/forward": field})
        assert caught.value.origin == "base/forward"
    # what is not warmed needs no dn/dT
    heat.check({"base/backward/M1": Temperature(1.0)})


# --- in a job's file --------------------------------------------------------------------------------------------------

HEAD = "instrument: gf7_pair\nperturb:\n"


def written(folder: Path, text: str) -> Path:
    path = folder / "job.yaml"
    path.write_text(text, "utf-8")
    return path


@pytest.mark.second
@pytest.mark.parametrize("own", ["0 K", "{change: 0 K}", "{gradient: [0 K/m, 0 K/m, 0 K/m]}"])
def test_no_change_is_a_temperature_of_its_own(own: str, one_material, tmp_path) -> None:
    """A mirror that its warmed camera carries stays as large as it was, and only its mount is carried along."""
    nodes = "  base/forward: {temperature: 2 K}\n  base/forward/M1: "
    held = checked_nodes(
        load_job(written(tmp_path, HEAD + nodes + f"{{temperature: {own}}}\n")), one_material.instrument.nodes
    )
    fields = held.fields()
    assert one_material.fields(fields)["base/forward/M1"] == Temperature()
    state = one_material.state(fields)
    assert state["base/forward"].expansion != 0.0
    assert "base/forward/M1" not in state or state["base/forward/M1"].expansion == 0.0
    # it is what a change that is nearly none comes to, and not what a body comes to of which nothing is said
    barely = one_material.state({**fields, "base/forward/M1": Temperature(1e-9)})
    silent = one_material.state(load_job(written(tmp_path, HEAD + nodes + "{shift: [0 um, 0 um, 0 um]}\n")).fields())
    sizes = [
        one_material.instrument.assembly.tree.place([s]).size("base/forward/M1")[0] for s in (state, barely, silent)
    ]
    assert sizes[0] == pytest.approx(sizes[1], abs=1e-14)
    assert abs(sizes[0] - sizes[2]) > 1e-8
    # a run's config.yaml says so as well
    resolved = resolve_job(held)
    (tmp_path / "config.yaml").write_text(resolved.to_yaml(), "utf-8")
    assert resolve(tmp_path / "config.yaml").job.fields() == fields


def test_a_figure_belongs_to_the_footprint_that_the_beam_meets(gf7_pair) -> None:
    allowing = {path for path, info in gf7_pair.nodes.items() if "figure" in info.allows}
    assert {f"{PRISM}/window/entry", f"{PRISM}/window/exit", f"{PRISM}/mirror", "base/forward/M1"} <= allowing
    assert not any("temperature" in gf7_pair.nodes[f"{PRISM}/{face}"].allows for face in ("mirror", "window/entry"))
    assert f"{PRISM}/window" not in allowing  # two footprints far apart: nothing stands on the window as a whole


def test_every_material_is_known_about_room_temperature_and_nowhere_near_zero() -> None:
    for stuff in MATERIALS.values():
        assert stuff.known.contains(278.15, 308.15)
        assert not stuff.known.contains(100.0, 293.15)
        assert not stuff.known.contains(293.15, 500.0)
        assert stuff.known.source
    for kind in GLASSES.values():
        assert kind.thermal is None or kind.thermal.known.contains(173.15, 413.15)
    with pytest.raises(ValueError, match=r"N-BK7: its index is known from 173\.15 K to 413\.15 K \(-100 to 140 degC\)"):
        GLASSES["N-BK7"].index(650e-9, 150.0)
