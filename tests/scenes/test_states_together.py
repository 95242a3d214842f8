"""States of heat and stated motions that are worked out together are those that are worked out one by one."""

from __future__ import annotations

import numpy as np
import pytest

from optics.geometry.tree import Motion, State, compose, each_composed
from optics.thermal.heat import Temperature, Temperatures
from scenes.models.disturbances import HEAT, UNITS, Component, stated_motions, states_of
from scenes.models.instrument_builder import build_instrument
from scenes.models.thermal_model import ThermalModel
from scenes.specs.instrument import InstrumentSpec
from scenes.specs.job import JobSpec
from scenes.specs.resolved import resolve_job
from tests.scenes.lens.colour_cameras import colour_camera
from tests.scenes.test_lens_heat import LIKE_ALUMINIUM
from tests.tiers import quick

ROUNDING = 1e-13
"""Of a motion's parts that are sums of products of some ten numbers."""
NUMBERS = ("scale", "stretch", "index", "radius", "conic", "abbe")


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
    return stated_motions(resolved, built), ThermalModel(built)


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
    assert all(m.figure == dict.fromkeys(m.figure, 0.0) and m.stretch == m.index == 0.0 for m in together[0].values())
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
    found = each_composed(several, bodies)
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
