"""Rays in a graded index: against closed forms, quadrature and an ordinary differential equation's solver."""

import drjit as dr
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from optics.geometry.pose import Pose, rotation_matrix
from optics.geometry.surface import Surface, plane
from optics.geometry.tree import Body, Motion, RigidTree
from optics.raytrace.assembly import Assembly, Element, Interaction
from optics.raytrace.system import assemble
from optics.raytrace.trace import GradedRay, make_rays, trace

N0 = 1.5
START, HEADING = np.array([0.03, -0.02, 0.01]), np.array([0.2, -0.1, 1.0]) / np.sqrt(1.05)
GRADIENTS = [(0.02, 0.0, 0.0), (0.0, 0.0, -0.03), (0.01, -0.02, 0.015), (1e-5, 2e-5, -1e-5), (0.0, 0.0, 0.0)]


def ray(backend, gradient, start=START, heading=HEADING) -> GradedRay:
    def vector(v):
        return backend.Vector3(*(backend.Float([float(c)]) for c in v))

    return GradedRay.start(vector(start), vector(heading), backend.Float([N0]), tuple(map(backend.Float, gradient)))


def numbers(value) -> np.ndarray:
    return value.numpy().reshape(-1) if dr.size_v(value) == 3 else float(value.numpy()[0])


def solved(gradient, tau: float, start=START, heading=HEADING) -> np.ndarray:
    """Position, slope and optical path at tau from r'' = n g, L' = n^2, (7,)."""
    g = np.array(gradient)

    def equation(_, y):
        n = N0 + g @ y[:3]
        return np.concatenate([y[3:6], n * g, [n * n]])

    first = np.concatenate([start, (N0 + g @ start) * heading, [0.0]])
    return solve_ivp(equation, (0.0, tau), first, method="DOP853", rtol=3e-14, atol=1e-16).y[:, -1]


@pytest.mark.parametrize("gradient", GRADIENTS)
def test_against_the_ray_equation(backend, gradient) -> None:
    """The solver's steps are good to some 1e-14; the series' own error is below 1e-15 at these gradients."""
    tau = 0.4 / N0
    curve, want = ray(backend, gradient), solved(gradient, tau)
    assert np.abs(numbers(curve.position(tau)) - want[:3]).max() < 1e-12
    assert np.abs(numbers(curve.slope(tau)) - want[3:6]).max() < 1e-12
    assert np.abs(numbers(curve.direction(tau)) - want[3:6] / np.linalg.norm(want[3:6])).max() < 1e-12
    assert abs(numbers(curve.optical_path(tau)) - want[6]) < 1e-12


def slab(length: float, index: float = N0, tilt: float = 0.0) -> Assembly:
    """A plate along z, its entry in the plane z = 0, with a screen 0.1 m behind."""
    tree = RigidTree(
        (
            Body("glass", Pose(rotation_matrix(np.array([tilt, 0.0, 0.0])))),
            Body("glass/entry", Pose(np.diag([1.0, -1.0, -1.0]))),
            Body("glass/exit", Pose(np.eye(3), np.array([0.0, 0.0, length]))),
            Body("screen", Pose(np.eye(3), np.array([0.0, 0.0, length + 0.1]))),
        )
    )
    elements = [
        Element("entry", "glass/entry", plane(), Interaction.REFRACT, solid="glass"),
        Element("exit", "glass/exit", plane(), Interaction.REFRACT, solid="glass"),
        Element("screen", "screen", plane(), Interaction.PASS),
    ]
    return Assembly(tree, {e.name: e for e in elements}, {"all": ("entry", "exit", "screen")}, {"glass": index})


def through(backend, assembly, state, position=(0.0, 0.0, -0.1), direction=(0.0, 0.0, 1.0), keep=()):
    systems = assemble(assembly, ["all"], [state])
    traced = trace(backend, systems, make_rays(backend, np.array(position), np.array(direction)), keep, world=True)
    position, direction, path, valid = (a[0, 0] for a in traced.numpy(traced.world))
    assert valid
    return position, direction, path, traced


@pytest.mark.parametrize("g", [1e-5, 1e-3, 0.05])
def test_gradient_across_the_path(backend, g) -> None:
    """Light that enters square to the gradient leaves with sin = n0 sinh(g L / n0): g L for a weak one."""
    length = 0.8
    state = {"glass": Motion(index_gradient=(g, 0.0, 0.0))}
    _, direction, path, traced = through(backend, slab(length), state, keep=(1,))
    assert direction[0] == pytest.approx(N0 * np.sinh(g * length / N0), abs=1e-15, rel=1e-13)
    assert direction[0] == pytest.approx(g * length, rel=(g * length / N0) ** 2 / 6.0 * 1.1 + 1e-11)
    inside = direction[0] / np.hypot(N0, direction[0])  # tan = slope across over slope along, the latter stays n0
    assert inside == pytest.approx(g * length / N0, rel=(g * length / N0) ** 2 + 1e-11)
    assert traced.hit(1)[0, 0, 0] == pytest.approx(
        2.0 * N0 / g * np.sinh(0.5 * g * length / N0) ** 2, abs=1e-15, rel=1e-13
    )
    mean = 0.5 * N0**2 * (length / N0 + np.sinh(2.0 * g * length / N0) / (2.0 * g))
    assert path == pytest.approx(0.1 + mean + 0.1 / np.sqrt(1.0 - direction[0] ** 2), rel=1e-12)


def test_the_gradient_turns_with_the_glass(backend) -> None:
    """Along the glass's own z, seen from a tilted plate: the same as a gradient given in the world's axes."""
    tilt, g = 0.3, 0.02
    state = {"glass": Motion(index_gradient=(0.0, 0.0, g))}
    *_, traced = through(backend, slab(0.8, tilt=tilt), state, keep=(0, 1))
    own = rotation_matrix(np.array([tilt, 0.0, 0.0]))
    into = own.T @ np.array([0.0, 0.0, 1.0])
    heading = np.array([0.0, into[1] / N0, np.sqrt(1.0 - (into[1] / N0) ** 2)])
    first = traced.hit(0)[0, 0] * [1.0, -1.0, -1.0]

    def equation(_, y):
        n = N0 + g * y[2]
        return np.concatenate([y[3:], [0.0, 0.0, n * g]])

    def far_side(_, y):
        return y[2] - 0.8

    far_side.terminal = True
    start = np.concatenate([first, N0 * heading])
    found = solve_ivp(equation, (0.0, 5.0), start, "DOP853", events=far_side, rtol=3e-14, atol=1e-15)
    assert traced.hit(1)[0, 0, :2] == pytest.approx(found.y_events[0][0][:2], abs=1e-12)


def test_forward_derivative_through_graded_glass(backend) -> None:
    """By the plate's tilt, exact, against differences of fourth order (step 1e-4: rounding decides)."""
    assembly = slab(0.8)
    bent = assembly.with_element(Element("exit", "glass/exit", Surface(0.4, -0.5), Interaction.REFRACT, solid="glass"))
    for optics in (assembly, bent):
        state = {"glass": Motion(index_gradient=(0.02, -0.03, 0.05))}

        def spot(tilt: float, optics=optics) -> np.ndarray:
            moved = {"glass": Motion(rotate=(tilt, 0.0, 0.0), index_gradient=(0.02, -0.03, 0.05))}
            position, direction, path, _ = through(backend, optics, moved, (0.03, 0.02, -0.1))
            return np.array([*position[:2], *direction, path])

        systems = assemble(optics, ["all"], [state], step=[("glass", "rotate", 0)])
        traced = trace(
            backend,
            systems.upload(backend),
            make_rays(backend, np.array([0.03, 0.02, -0.1]), np.array([0.0, 0.0, 1.0])),
            world=True,
            evaluate=False,
        )
        rays = traced.world
        outputs = [rays.position.x, rays.position.y, *rays.direction, rays.path]
        dr.forward_to(*outputs)
        got = np.array([dr.grad(value).numpy()[0] for value in outputs])
        step = 1e-4
        want = (8.0 * (spot(step) - spot(-step)) - (spot(2 * step) - spot(-2 * step))) / (12.0 * step)
        assert np.abs(got - want).max() < 1e-10
        assert np.abs(got).max() > 0.1
