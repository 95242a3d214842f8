"""Derivatives by Dr.Jit's AD through the gf7 camera: against central differences, and reverse against forward mode."""

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest

from optics.geometry.tree import Motion, State
from optics.numerics.number_tree import leaves
from optics.raytrace.assembly import Assembly
from optics.raytrace.system import SystemBatch, assemble
from optics.raytrace.trace import Traced, jvp, make_rays, trace, vjp
from scenes.models.camera_model import IMAGE, collimated, field_direction

MOTIONS = [
    (body, kind, axis)
    for body in ("M1", "M2", "M3", IMAGE)
    for kind, axes in (("rotate", 3), ("shift", 3), ("scale", 1))
    for axis in range(axes)
]
STEP = {"rotate": 1e-5, "shift": 1e-5, "scale": 1e-5}
BASE: State = {
    "M2": Motion(rotate=(1e-4, -5e-5, 2e-4), shift=(5e-5, -2e-5, 3e-5)),
    "M3": Motion(shift=(1e-5, 2e-5, 0.0)),
}


@pytest.fixture(scope="module")
def bare(gf7) -> Assembly:
    return gf7.bare_assembly(apertures=False)


@pytest.fixture(scope="module")
def rays(backend, gf7, bare):
    """Nine rays of an off-axis field: positions (9, 3) and the direction."""
    direction = field_direction(gf7.spec, np.radians(0.7), np.radians(-0.1))
    radius = gf7.apertures["M2"].radius
    grid = 0.65 * radius * np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1]), axis=-1).reshape(-1, 2)
    return collimated(backend, assemble(bare, [gf7.mirrors[:2]]), direction[None], grid)[0], direction


def columns(traced: Traced) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    position, direction, path, valid = traced.numpy()
    assert valid.all()
    return position, direction, path


def gradients(backend, systems: SystemBatch, rays) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    out = trace(backend, systems, make_rays(backend, *rays), evaluate=False).local
    dr.forward_to(out.position, out.direction, out.path, flags=dr.ADFlag.ClearEdges)

    def rows(vector) -> np.ndarray:
        return np.stack([c.numpy() for c in dr.grad(vector)], axis=-1).reshape(systems.count, -1, 3)

    return rows(out.position), rows(out.direction), dr.grad(out.path).numpy().reshape(systems.count, -1)


def moved(body: str, kind: str, axis: int, h: float) -> State:
    start = BASE.get(body, Motion())
    if kind == "scale":
        return {**BASE, body: replace(start, scale=start.scale + h)}
    vector = list(getattr(start, kind))
    vector[axis] += h
    return {**BASE, body: replace(start, **{kind: tuple(vector)})}


def test_forward_mode_for_every_motion(backend, bare, rays) -> None:
    systems = assemble(bare, ["imaging"], [BASE] * len(MOTIONS), MOTIONS)
    forward = gradients(backend, systems, rays)
    states = [moved(*m, h * STEP[m[1]]) for m in MOTIONS for h in (1, -1)]
    values = columns(trace(backend, assemble(bare, ["imaging"], states), make_rays(backend, *rays)))
    width = 2.0 * np.array([STEP[kind] for _, kind, _ in MOTIONS])
    for exact, value in zip(forward, values, strict=True):
        pairs = value.reshape(len(MOTIONS), 2, *value.shape[1:])
        difference = (pairs[:, 0] - pairs[:, 1]) / width.reshape(-1, *[1] * (value.ndim - 1))
        # derivatives are 5 to 20 m/rad and 1 m/m; truncation h^2 f''' and rounding 1e-15 / h are below 1e-8
        np.testing.assert_allclose(exact, difference, rtol=1e-7, atol=1e-8)
    moves = np.max(np.abs(forward[0]), axis=(1, 2)) > 0.0
    assert [m for m, moved in zip(MOTIONS, moves, strict=True) if not moved] == [(IMAGE, "scale", 0)]  # a plane


STEPS = [("M1", "rotate", 0), ("M2", "shift", 2), ("M3", "figure", 7), ("M3", "scale", 0), ("image", "rotate", 1)]
CURVATURE = ("surface", "curvature")
FIGURE = {"M3": Motion(figure={7: 1e-7})}


@pytest.fixture(scope="module")
def launch(gf7, backend) -> tuple[np.ndarray, np.ndarray]:
    """Rays of as many fields as there are steps: (B, N, 3) twice."""
    bare = gf7.bare_assembly(apertures=False)
    directions = np.array([field_direction(gf7.spec, 0.004 * k, 0.001 * k) for k in range(len(STEPS))])
    nodes = 0.8 * gf7.apertures["M2"].radius * np.random.default_rng(1).uniform(-0.7, 0.7, (40, 2))
    place = collimated(backend, assemble(bare, [gf7.mirrors[:2]]), directions, nodes)
    return place, np.broadcast_to(directions[:, None], place.shape)


def test_reverse_mode_is_the_transpose_of_forward_mode(gf7, backend, launch) -> None:
    """Each system has a motion, launch points and directions of its own; so nothing may leak between systems."""
    bare = gf7.bare_assembly()
    systems = assemble(bare, ["imaging"], [FIGURE] * len(STEPS), STEPS)
    place, heading = launch
    rng = np.random.default_rng(2)
    position_step, direction_step, weight = rng.normal(size=(3, *place.shape))
    pushed = jvp(backend, systems, place, heading, position_step, direction_step)
    steps = [leaves(tangents) for tangents in systems.tangents]
    names = [tuple(path for path, step in own.items() if np.any(step)) for own in steps]
    assert [len(own) > 0 for own in names] == [True] * 4
    pulled = vjp(backend, systems, place, heading, weight, names)

    forward = np.sum(weight * pushed.position, axis=(1, 2))
    reverse = np.sum(pulled.position * position_step + pulled.direction * direction_step, axis=(1, 2))
    for own, slopes, tangents in zip(names, pulled.values, steps, strict=True):
        assert set(slopes) == set(own)
        reverse = reverse + sum(slopes[name] * tangents[name] for name in own)
    # both sums have a few hundred terms of up to 10, rounded to 1e-16
    np.testing.assert_allclose(reverse, forward, rtol=1e-12, atol=1e-11)
    assert np.all(np.abs(forward) > 0.1)


def test_only_what_is_asked_for(gf7, backend, launch) -> None:
    systems = assemble(gf7.bare_assembly(), ["imaging"], [{}] * len(STEPS))
    nothing = vjp(backend, systems, *launch, np.array([1.0, 0.0, 0.0]), [()] * 4)
    assert nothing.values == ({}, {}, {}, {})
    curvature = vjp(backend, systems, *launch, np.array([1.0, 0.0, 0.0]), [(CURVATURE,), (), (), ()])
    assert set(curvature.values[0]) == {CURVATURE}
    assert curvature.values[0][CURVATURE].shape == (len(STEPS),)
    np.testing.assert_allclose(curvature.position, nothing.position, rtol=1e-12)
