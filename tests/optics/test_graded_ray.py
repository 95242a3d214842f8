"""Rays in a graded index: against closed forms, quadrature and an ordinary differential equation's solver.

Light through glass bodies against closed forms: plates, prisms, total reflection, growth and change of index.
"""

import drjit as dr
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from optics.geometry.pose import Pose, about_axis, rotation_matrix
from optics.geometry.surface import Surface, plane
from optics.geometry.tree import Body, Motion, RigidTree
from optics.raytrace.assembly import Assembly, Element, Interaction
from optics.raytrace.element_numbers import Medium, media_along
from optics.raytrace.system import assemble
from optics.raytrace.trace import GradedRay, make_rays, trace
from tests.optics.bench import run

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


# --- glass path -------------------------------------------------------------------------------------------------------

N = 1.52
REFRACT, TOTAL, PASS, REFLECT = Interaction.REFRACT, Interaction.TOTAL, Interaction.PASS, Interaction.REFLECT


def glass(*faces: tuple[str, Pose, Interaction], screen: Pose | None = None, index: float = N) -> Assembly:
    """A body with faces on bodies of their own, and a screen in the world; outward normals along +z."""
    bodies = [Body("glass"), *(Body(f"glass/{name}", pose) for name, pose, _ in faces)]
    elements = [Element(name, f"glass/{name}", plane(), what, solid="glass") for name, _, what in faces]
    if screen is not None:
        bodies.append(Body("screen", screen))
        elements.append(Element("screen", "screen", plane(), PASS))
    names = tuple(e.name for e in elements)
    return Assembly(RigidTree(tuple(bodies)), {e.name: e for e in elements}, {"all": names}, {"glass": index})


def at(z: float, angle: float = 0.0) -> Pose:
    """A face whose outward normal is turned from +z about y."""
    return Pose(about_axis(1, angle), np.array([0.0, 0.0, z]))


def slanted(angles) -> np.ndarray:
    """Directions in the x-z plane at these angles to +z."""
    angles = np.asarray(angles)
    return np.stack([np.sin(angles), 0.0 * angles, np.cos(angles)], axis=-1)


def test_plate() -> None:
    """Media of the plate's sequence, there and back."""
    plate = glass(("front", at(0.0, np.pi), REFRACT), ("back", at(0.05), REFRACT), screen=at(0.2))
    inside = Medium("glass")
    assert media_along(plate.sequence("all")) == [Medium(), inside, Medium(), Medium()]
    assert media_along([plate.elements[name] for name in ("back", "front")]) == [Medium(), inside, Medium()]
    mirror = Element("mirror", "glass/back", plane(), REFLECT, solid="glass")
    front = plate.elements["front"]
    assert media_along([front, mirror, front]) == [Medium(), inside, inside, Medium()]


def test_critical_angle(backend) -> None:
    """Total reflection inside a right-angled prism begins where n sin = 1; the same ray refracts just before."""
    critical = np.arcsin(1.0 / N)
    # the slanted face's normal is at 45 degrees; inside, the ray meets it at 45 degrees less its own angle
    inside = np.pi / 4.0 - critical + np.array([-0.3, -1e-9, 1e-9, 0.1])
    into = slanted(np.arcsin(N * np.sin(inside)))
    beyond = np.array([True, True, False, False])
    start = np.zeros(into.shape) - 0.01 * into
    faces = ("in", at(0.0, np.pi), REFRACT)
    reflected = run(backend, glass(faces, ("slanted", at(0.05, np.pi / 4.0), TOTAL)), start, into)
    assert np.array_equal(reflected[3], beyond)
    # reflected by a plane at 45 degrees: x and z change places with the opposite sign
    want = -slanted(inside)[:, ::-1]
    assert np.abs(reflected[1] - want).max() < 1e-15
    refracted = run(backend, glass(faces, ("slanted", at(0.05, np.pi / 4.0), REFRACT)), start, into)
    assert np.array_equal(refracted[3], ~beyond)


def test_no_total_reflection_from_outside(backend) -> None:
    outside = glass(("slanted", at(0.05, np.pi - 1.5), TOTAL))
    assert not run(backend, outside, np.zeros((1, 3)), slanted([0.0]))[3].any()


def test_index_and_growth_change_the_path(backend) -> None:
    """dn t, and n t times the growth; a stretch moves the far face but does not enlarge it, as a scale does."""
    thick = 0.05
    plate = glass(("front", at(0.0, np.pi), REFRACT), ("back", at(thick), REFRACT), screen=at(0.2))
    start, along = np.zeros((1, 3)), slanted([0.0])
    nominal = run(backend, plate, start, along)[2][0]
    assert nominal == pytest.approx(0.15 + N * thick, rel=1e-15)
    for motion, change in (
        (Motion(index=1e-3), 1e-3 * thick),
        (Motion(expansion=1e-3), (N - 1.0) * thick * 1e-3),
        (Motion(scale=1e-3), (N - 1.0) * thick * 1e-3),
        (Motion(expansion=1e-3, index=-1e-3), (N - 1.0) * thick * 1e-3 - 1e-3 * thick * 1.001),
        (Motion(index=1e-3, index_gradient=(0.0, 0.0, 2e-3)), 1e-3 * thick + 1e-3 * thick**2),
    ):
        assert run(backend, plate, start, along, {"glass": motion})[2][0] - nominal == pytest.approx(change, abs=1e-15)
    placed = plate.place([{"glass": Motion(expansion=0.5)}, {"glass": Motion(scale=0.5)}])
    back = placed.index["glass/back"]
    assert placed.translation[:, back, 2] == pytest.approx(1.5 * thick)
    assert placed.scale[:, back] == pytest.approx([1.0, 1.5])
    assert placed.scale[:, placed.index["glass"]] == pytest.approx([1.5, 1.5])


def test_what_an_assembly_refuses() -> None:
    face, tree = Element("face", "glass", plane(), REFRACT, solid="glass"), RigidTree((Body("glass"),))
    for arguments, words in (
        (({"face": face}, {}), "'glass', which has no refractive index"),
        (({}, {}, {"prism": 1.5}), "unknown body 'prism'"),
        (({"other": face}, {}, {"glass": 1.5}), "'face' has the key 'other'"),
        (({"e": Element("e", "nowhere", plane(), PASS)}, {}), "is on unknown body 'nowhere'"),
        (({}, {"all": ("e",)}), "names unknown element 'e'"),
    ):
        with pytest.raises(ValueError, match=words):
            Assembly(tree, *arguments)
    with pytest.raises(ValueError, match="cannot have a gradient of the refractive index"):
        Assembly(tree, {}, {}, {"glass": 1.5}).with_nominal({"glass": Motion(index_gradient=(1e-6, 0.0, 0.0))})
