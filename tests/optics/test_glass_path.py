"""Light through glass bodies against closed forms: plates, prisms, total reflection, growth and change of index."""

import numpy as np
import pytest

from optics.geometry.pose import Pose, about_axis
from optics.geometry.surface import plane
from optics.geometry.tree import Body, Motion, RigidTree
from optics.raytrace.assembly import Assembly, Element, Interaction
from optics.raytrace.element_numbers import Medium, media_along
from tests.optics.bench import run

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
        (Motion(stretch=1e-3), (N - 1.0) * thick * 1e-3),
        (Motion(scale=1e-3), (N - 1.0) * thick * 1e-3),
        (Motion(stretch=1e-3, index=-1e-3), (N - 1.0) * thick * 1e-3 - 1e-3 * thick * 1.001),
        (Motion(index=1e-3, index_gradient=(0.0, 0.0, 2e-3)), 1e-3 * thick + 1e-3 * thick**2),
    ):
        assert run(backend, plate, start, along, {"glass": motion})[2][0] - nominal == pytest.approx(change, abs=1e-15)
    placed = plate.place([{"glass": Motion(stretch=0.5)}, {"glass": Motion(scale=0.5)}])
    back = placed.index["glass/back"]
    assert placed.translation[:, back, 2] == pytest.approx(1.5 * thick)
    assert placed.scale[:, back] == pytest.approx([1.0, 1.5])
    assert placed.scale[:, placed.index["glass"]] == pytest.approx([1.5, 1.5])


def test_what_an_assembly_refuses() -> None:
    face, tree = Element("face", "glass", plane(), REFRACT, solid="glass"), RigidTree((Body("glass"),))
    for arguments, words in (
        (({"face": face}, {}), "'glass', which has no refractive index"),
        (({}, {}, {"prism": 1.5}), "unknown body 'prism'"),
        (({"other": face}, {}, {"glass": 1.5}), "'face' is filed under 'other'"),
        (({"e": Element("e", "nowhere", plane(), PASS)}, {}), "stands on unknown body 'nowhere'"),
        (({}, {"all": ("e",)}), "names unknown element 'e'"),
    ):
        with pytest.raises(ValueError, match=words):
            Assembly(tree, *arguments)
    with pytest.raises(ValueError, match="no gradients of refractive indices by itself"):
        Assembly(tree, {}, {}, {"glass": 1.5}).standing({"glass": Motion(index_gradient=(1e-6, 0.0, 0.0))})
