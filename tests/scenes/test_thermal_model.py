"""Heat in the whole instrument: who inherits which temperature, what expands about what, what glass does to a beam."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from optics.geometry.pose import rotation_matrix
from optics.geometry.tree import Motion
from optics.materials.glass import GLASSES, glass
from optics.materials.material import MATERIALS, material
from optics.raytrace.system import assemble
from optics.raytrace.trace import make_rays, trace
from optics.thermal.heat import Temperature, carried_motion
from optics.thermal.thermo_elastic import free_linear_field
from scenes.models.instrument_builder import build_instrument
from scenes.models.instrument_model import Instrument
from scenes.models.thermal_model import TemperatureError, ThermalModel
from scenes.specs.instrument import MaterialsSpec
from scenes.specs.job import checked_nodes
from scenes.specs.load import load_camera, load_instrument, load_job
from scenes.specs.resolved import resolve, resolve_job

SILICA = material("fused silica")
WAVELENGTH = 650e-9
PRISM = "base/forward/monitor/left/prism_180"
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
    assert state["base/forward"].stretch != 0.0
    assert "base/forward/M1" not in state or state["base/forward/M1"].stretch == 0.0
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
        assert stuff.known.holds(278.15, 308.15)
        assert not stuff.known.holds(100.0, 293.15)
        assert not stuff.known.holds(293.15, 500.0)
        assert stuff.known.source
    for kind in GLASSES.values():
        assert kind.thermal is None or kind.thermal.known.holds(173.15, 413.15)
    with pytest.raises(ValueError, match=r"N-BK7: its index is known from 173\.15 K to 413\.15 K \(-100 to 140 degC\)"):
        GLASSES["N-BK7"].index(650e-9, 150.0)
