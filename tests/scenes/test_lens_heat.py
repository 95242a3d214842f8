"""Heat in cameras with lenses: one material keeps its angles, a singlet refocuses as first order says, what is not
known is refused.

States of heat and stated motions that are worked out together are those that are worked out one by one.
"""

from __future__ import annotations

import numpy as np
import pytest

from optics.geometry.tree import Motion, State, compose, compose_each
from optics.materials.glass import glass
from optics.thermal.heat import Temperature, Temperatures
from scenes.models.disturbances import HEAT, UNITS, Component, disturbance_prior, states_of
from scenes.models.instrument_builder import build_instrument
from scenes.models.instrument_model import Instrument
from scenes.models.thermal_model import TemperatureError, ThermalModel
from scenes.specs.camera import CameraSpec
from scenes.specs.instrument import InstrumentSpec, MaterialsSpec
from scenes.specs.job import JobSpec, checked_nodes
from scenes.specs.resolved import resolve_job
from scenes.yaml.errors import InputError
from scenes.yaml.spec import validate
from scenes.yaml.yaml_file import YamlFile
from tests.scenes.lens.colour_cameras import ACHROMAT, F2, colour_camera
from tests.tiers import quick
from twin.monitor.image_quality import image_quality
from twin.monitor.truth import trace_truth

STILL = "thermal: [0, 0, 0, 0, 0, 0.2]"
LIKE_ALUMINIUM = ACHROMAT.replace(
    "glass: N-BK7", f"glass: {{name: N-BK7, expansion: 23.6 ppm/K, {STILL}}}"
).replace(F2, F2.replace("{name: F2", f"{{name: F2, expansion: 23.6 ppm/K, {STILL}"))  # fmt: skip
WARM = 10.0


def instrument(camera: CameraSpec, material: str, backend) -> Instrument:
    """The camera by itself, all of one material but its lenses."""
    materials = MaterialsSpec(**dict.fromkeys(MaterialsSpec.model_fields, material))
    spec = InstrumentSpec.of_camera(camera.name, camera.name).model_copy(update={"materials": materials})
    return build_instrument(spec, {camera.name: camera}, backend)


def warmed(built: Instrument, temperatures: dict[str, Temperature]) -> State:
    heat = ThermalModel(built)
    heat.check(temperatures)
    return heat.state(temperatures)


# --- one material ---------------------------------------------------------------------------------------------------


@pytest.mark.second
def test_one_material_keeps_its_angles_and_grows(backend) -> None:
    """Lenses and mount of one expansion, without dn/dT: every length grows by 1 + alpha dT, the wavefront error too."""
    built = instrument(colour_camera("achromat", mirrors=LIKE_ALUMINIUM), "aluminium", backend)
    state = warmed(built, {"base": Temperature(WARM)})
    np.testing.assert_allclose(trace_truth(built, backend, [state]).vector("achromat"), 0.0, atol=1e-15)
    found = image_quality(built, backend, [{}, state]).cameras["achromat"]
    grown = 1.0 + 23.6e-6 * WARM
    # but for the radius of the sphere of reference, which stays that of the nominal pupil: 3e-7, of a growth of 2.4e-4
    np.testing.assert_allclose(found.wfe[1], grown * found.wfe[0], rtol=1e-6)
    np.testing.assert_allclose(found.defocus[1], grown * found.defocus[0], rtol=1e-6)
    placed = built.assembly.tree.place([state])
    assert placed.size("base/achromat/L3")[0] == pytest.approx(grown, rel=1e-15)


def test_one_material_bends_as_one_piece(backend) -> None:
    """A gradient across bends mount and lenses by one formula; image and wavefront turn with them."""
    built = instrument(colour_camera("achromat", mirrors=LIKE_ALUMINIUM), "aluminium", backend)
    state = warmed(built, {"base": Temperature(0.0, (2.0, 0.0, 0.0))})
    # where the middles of its lenses go, and how they turn: u = a ((g.q) q - q^2 g / 2), a g x q
    heat = ThermalModel(built)
    for lens in heat.lenses.values():
        q, g = built.assembly.place().pose("base/achromat").apply(lens.mount), np.array([2.0, 0.0, 0.0])
        move = 23.6e-6 * ((g @ q) * q - 0.5 * (q @ q) * g)
        placed = built.assembly.place([state])
        here = np.mean([placed.pose(face).translation for face in lens.faces], axis=0)
        there = np.mean([built.assembly.place().pose(face).translation for face in lens.faces], axis=0)
        np.testing.assert_allclose(here - there, move, atol=2e-9)
    found = image_quality(built, backend, [{}, state]).cameras["achromat"]
    np.testing.assert_allclose(found.wfe[1], found.wfe[0], rtol=1e-4)


# --- a singlet by hand ------------------------------------------------------------------------------------------------

RADIUS, THICKNESS, CTE = 0.6, 0.02, 7.1e-6
"""Of an equiconvex singlet of N-BK7, metres, and its expansion by Schott's data sheet, 1/K."""


def index_change(change: float) -> float:
    """Of N-BK7 at the d line from 20 C, by the constants of Schott's data sheet."""
    n, w2 = glass("N-BK7").index(587.5618e-9), 0.5875618**2
    slope = 1.86e-6 * change + 1.31e-8 * change**2 - 1.37e-11 * change**3
    return (n * n - 1.0) / (2.0 * n) * (slope + (4.34e-7 * change + 6.27e-10 * change**2) / (w2 - 0.17**2))


def singlet_numbers(change: float) -> tuple[float, float]:
    """Focal length, and the place of the focus from the lens's middle, metres, at so many kelvin above 20 C."""
    grown, n = 1.0 + CTE * change, glass("N-BK7").index(587.5618e-9) + index_change(change)
    radius, thick = RADIUS * grown, THICKNESS * grown
    power = (n - 1.0) * (2.0 / radius - (n - 1.0) * thick / (n * radius**2))
    back = (1.0 - (n - 1.0) * thick / (n * radius)) / power
    return 1.0 / power, 0.5 * thick + back


@pytest.fixture(scope="module")
def singlet(backend) -> Instrument:
    focal, focus = singlet_numbers(0.0)
    mirrors = (
        f"L1: {{z: {-0.5 * THICKNESS} m, radius: {RADIUS} m, light: refracts, glass: N-BK7}}, "
        f"L2: {{z: {0.5 * THICKNESS} m, radius: {-RADIUS} m, light: refracts, index: 1}}"
    )
    shape = {"focal": f"{focal} m", "pupil": "8 mm", "field": "0.1 deg", "mirrors": mirrors, "image": f"{focus} m"}
    return instrument(colour_camera("achromat", **shape), "Zerodur", backend)


@pytest.mark.second
def test_a_singlet_refocuses_as_first_order_says(singlet, backend) -> None:
    """Held by what does not expand: radii, thickness and index change where its light comes together."""
    for change in (WARM, -15.0):
        state = warmed(singlet, {"base": Temperature(change)})
        found = image_quality(singlet, backend, [{}, state], (0.0,)).cameras["achromat"]
        moved = float(found.defocus[1, 0] - found.defocus[0, 0])
        expected = singlet_numbers(change)[1] - singlet_numbers(0.0)[1]
        # the beam is F/72, where the best focus differs from the first order's by 1e-5 of it
        assert moved == pytest.approx(expected, rel=1e-3)
        # as the opto-thermal coefficient of a thin lens has it, but for its thickness over its radius, 3 %
        focal, thin = singlet_numbers(0.0)[0], CTE - index_change(1.0) / (glass("N-BK7").index(587.5618e-9) - 1.0)
        assert singlet_numbers(change)[0] / focal - 1.0 == pytest.approx(thin * change, rel=0.05)


def test_the_parts_of_a_singlets_heat_are_where_they_belong(singlet) -> None:
    state = warmed(singlet, {"base/achromat/L1": Temperature(WARM)})
    first, second = state["base/achromat/L1"], state["base/achromat/L2"]
    assert first.expansion == pytest.approx(CTE * WARM, rel=1e-12)
    assert second.expansion == first.expansion
    assert first.index == pytest.approx(index_change(WARM), rel=1e-9)
    assert second.index == 0.0  # the lens is called by its first face
    placed = singlet.assembly.tree.place([{}, state])
    apart = (
        placed.translation[:, placed.index["base/achromat/L2"]]
        - placed.translation[:, placed.index["base/achromat/L1"]]
    )
    lengths = np.linalg.norm(apart, axis=-1)
    assert lengths[1] - lengths[0] == pytest.approx(CTE * WARM * THICKNESS, rel=1e-6)


def test_a_gradient_across_a_lens_is_a_prism(singlet, backend) -> None:
    """Glass of thickness t turns light by t dn/dT g, and by (n - 1) alpha t g, the wedge that it grows into."""
    across = (0.0, 20.0, 0.0)
    state = warmed(singlet, {"base/achromat/L1": Temperature(0.0, across)})
    turned = trace_truth(singlet, backend, [state]).vector("achromat")[0]
    assert np.argmax(np.abs(turned[:2])) == 0
    wedge = (glass("N-BK7").index(587.5618e-9) - 1.0) * CTE + index_change(0.01) / 0.01
    # a thin prism: the thickness is 3 % of the focal length
    assert abs(turned[0]) == pytest.approx(THICKNESS * wedge * 20.0, rel=0.03)


# --- what is not known ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changed", "node", "said"),
    [
        ({}, "base", "L3: the thermal expansion of F2 is unknown.*`expansion: 8.2 ppm/K`"),
        (
            {"mirrors": ACHROMAT.replace("{name: F2", "{name: F2, expansion: 8.2 ppm/K")},
            "L3",
            "dn/dT of F2.*`thermal: ",
        ),
        (
            {"mirrors": ACHROMAT.replace("glass: N-BK7", "glass: Zerodur"), "focal": "1.05 m"},
            "L1",
            "dn/dT of Zerodur.*`thermal: ",
        ),
        ({"mirrors": LIKE_ALUMINIUM}, "L2", "a face of the lens base/achromat/L1"),
    ],
)
def test_what_nothing_says_is_refused(changed: dict, node: str, said: str, backend) -> None:
    built = instrument(colour_camera("achromat", **changed), "aluminium", backend)
    data = {"instrument": "ritchey_chretien", "perturb": {node: {"temperature": "1 K"}}}
    with pytest.raises(InputError, match=f"does not allow temperature: .*{said}"):
        checked_nodes(validate(JobSpec, YamlFile("", data, {})), built.nodes)
    if node in ("L1", "L3"):
        with pytest.raises(TemperatureError, match=said.partition(".*")[0]) as caught:
            ThermalModel(built).check({f"base/achromat/{node}": Temperature(1.0)})
        assert caught.value.origin == f"base/achromat/{node}"
        ThermalModel(built).check({f"base/achromat/{node}": Temperature()})


def test_a_lens_beyond_what_is_known_is_refused(singlet) -> None:
    heat = ThermalModel(singlet)
    with pytest.raises(TemperatureError, match=r"L1 would be at 373\.15 K") as caught:
        heat.check({"base/achromat": Temperature(80.0)})
    assert caught.value.origin == "base/achromat"


# --- states together --------------------------------------------------------------------------------------------------

ROUNDING = 1e-13
"""Of a motion's parts that are sums of products of some ten numbers."""
NUMBERS = ("scale", "expansion", "index", "radius", "conic", "abbe")


def agree(one: State, other: State) -> None:
    """The same motions of the same bodies, to rounding."""
    assert one.keys() == other.keys()
    for path, motion in one.items():
        same = other[path]
        assert motion.pivot == same.pivot
        assert motion.figure.keys() == same.figure.keys()
        for name in (*NUMBERS, "rotate", "shift", "index_gradient"):
            np.testing.assert_allclose(
                getattr(motion, name), getattr(same, name), rtol=ROUNDING, atol=1e-24, err_msg=f"{path} {name}"
            )
        np.testing.assert_allclose(list(motion.figure.values()), list(same.figure.values()), rtol=ROUNDING)


@pytest.fixture(scope="module", params=quick(1, ["launch", "orbit"]))
def stated(request, backend):
    resolved = resolve_job(JobSpec(instrument="gf7_pair", disturbances=request.param))
    built = build_instrument(resolved.instrument, resolved.cameras, backend)
    return disturbance_prior(resolved, built), ThermalModel(built)


@pytest.mark.second
def test_stated_states(stated) -> None:
    """Among them one at rest, one without heat, one without gradients and one in which a single body is warmer."""
    motions, heat = stated
    amounts = motions.draw(np.random.default_rng(4), 6)
    kind = np.array([c.kind for c in motions.components])
    amounts[0] = 0.0
    amounts[1, np.isin(kind, ("temperature", "gradient"))] = 0.0
    amounts[2, kind == "gradient"] = 0.0
    amounts[3, np.flatnonzero(kind == "temperature")[1:]] = 0.0
    extra = {"base/forward": Motion(rotate=(1e-6, 0.0, 0.0)), "base": Motion(shift=(0.0, 1e-6, 0.0))}
    together = states_of(amounts, motions.components, heat, extra)
    for row, state in zip(amounts, together, strict=True):
        agree(state, states_of(row[None], motions.components, heat, extra)[0])
    # a state at rest but for what is on top of it
    agree({path: m for path, m in together[0].items() if any(m.rotate) or any(m.shift)}, extra)
    assert all(m.figure == dict.fromkeys(m.figure, 0.0) and m.expansion == m.index == 0.0 for m in together[0].values())
    # and they differ
    assert together[4] != together[5]


def test_no_state(stated) -> None:
    motions, heat = stated
    assert states_of(np.empty((0, len(motions.components))), motions.components, heat) == []


@pytest.mark.second
def test_lenses(backend) -> None:
    """Carried by what bends in a gradient, and warmed themselves."""
    camera = colour_camera("achromat", mirrors=LIKE_ALUMINIUM.replace("thermal: [0, 0,", "thermal: [2e-6, 1e-8,"))
    built = build_instrument(InstrumentSpec.of_camera(camera.name, camera.name), {camera.name: camera}, backend)
    heat, rng = ThermalModel(built), np.random.default_rng(5)
    lens = next(iter(heat.lenses))
    numbers = rng.normal(0.0, 0.5, (3, 4, 4)).tolist()
    given = {
        path: [Temperature(), *(Temperature(t, (gx, gy, gz)) for t, gx, gy, gz in own)]
        for path, own in zip(("base", "base/achromat", lens), numbers, strict=True)
    }
    given["base"][2] = Temperature(0.25)
    together = heat.states({path: Temperatures.of(own) for path, own in given.items()}, [{}] * 5)
    for k, state in enumerate(together):
        agree(state, heat.state({path: own[k] for path, own in given.items()}))
    assert not together[0]
    assert all(any(state[lens].index_gradient) for state in together[1:])


def test_sequences_are_composed_each_by_itself(stated) -> None:
    """Of unequal lengths, and none."""
    _, heat = stated
    bodies = {body.path: body for body in heat.instrument.assembly.tree.bodies}
    turn, move = Motion(rotate=(1e-3, 0.0, 2e-3), pivot="origin"), Motion(shift=(1e-3, 0.0, 0.0), scale=1e-4)
    several = [[], [{"base": turn}], [{"base": turn}, {"base": move}, {"base": turn}], [{"base": move}, {}]]
    found = compose_each(several, bodies)
    assert found[:2] == [{}, {"base": turn}]
    agree(found[2], compose(compose({"base": turn}, {"base": move}, bodies), {"base": turn}, bodies))
    assert found[3] == {"base": move}


def test_every_kind_of_component_is_moved_by_its_amount(stated) -> None:
    _, heat = stated
    body = "base/forward/M2"
    axes = {"rotate": range(3), "shift": range(3), "index_gradient": range(3), "figure": (5, 8)}
    places = [(kind, axis) for kind in UNITS if kind not in (*HEAT, "abbe") for axis in axes.get(kind, (0,))]
    components = [Component("own", body, kind, axis, "centre", 1.0) for kind, axis in places]
    amounts = 1e-6 * np.arange(1.0, 2 * len(places) + 1).reshape(2, -1)
    for row, state in zip(amounts.tolist(), states_of(amounts, components, heat), strict=True):
        own = dict(zip(places, row, strict=True))
        vectors = {kind: tuple(own[kind, a] for a in range(3)) for kind in ("rotate", "shift", "index_gradient")}
        numbers = {kind: own[kind, 0] for kind in ("scale", "index", "radius", "conic")}
        assert state == {
            body: Motion(pivot="centre", figure={a: own["figure", a] for a in (5, 8)}, **vectors, **numbers)
        }
