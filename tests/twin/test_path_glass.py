"""The path tracer in glass, against closed forms and the sequential trace.

Statistical tests use fixed seeds; a deviation of Z_LIMIT standard errors has a false-alarm rate of 1e-4.
"""

from __future__ import annotations

import numpy as np
import pytest

from optics.geometry.aperture import Circle, Rectangle
from optics.geometry.pose import Pose, rotation_matrix
from optics.geometry.solid import Coating, Face, Solid
from optics.geometry.surface import plane
from optics.geometry.tree import Body, RigidTree
from optics.materials.scatter import ABSORBER, BARE, Finish, reflectance
from optics.raytrace.assembly import Assembly, Element, Interaction
from scenes.models.scenery import Finishes, Scenery, solid_surfaces
from tests.optics.bench import unit
from tests.twin.path_bench import facing, frame, glass_scene, screen, slab
from twin.path_tracing.families import Event, decode
from twin.path_tracing.path_result import Family, PathResult
from twin.path_tracing.source import DiskSource, RaySource
from twin.path_tracing.tracer import PathTracer, Sampling

Z_LIMIT = 3.89
INDEX = 1.5
THICKNESS = 0.02
PATHS = 200_000
FLOOR = Sampling(floor=0.3, steps=32)


def way(*names: str) -> str:
    return " ".join(f"glass/{n}" for n in names)


def find(result: PathResult, detector: str, text: str) -> Family:
    return next(f for f in result.families if f.detector == detector and f.text == text)


@pytest.mark.second
@pytest.mark.parametrize("angle", [0.0, 0.3, 0.9])
@pytest.mark.parametrize("coated", [BARE, Finish(reflectance=0.02, transmission=0.97)], ids=["bare", "coated"])
def test_ghosts_of_a_plane_parallel_plate(backend, angle: float, coated: Finish) -> None:
    direction = unit(np.sin(angle), 0.0, np.cos(angle))
    source = DiskSource.along(-0.2 * direction / direction[2], direction, 1e-3)
    result = PathTracer(backend, glass_scene(slab(0.3, THICKNESS), INDEX, coated), sampling=FLOOR).run(source, PATHS, 3)
    if coated.bare:
        r = float(reflectance(np.cos(angle), 1.0, INDEX))
        t = 1.0 - r
    else:
        r, t = coated.reflectance, coated.transmission
    shift = 2.0 * THICKNESS * np.tan(np.arcsin(np.sin(angle) / INDEX))
    bounce = ("exit", "entry")
    expected = [("front", way("entry"), r, 0.0)]
    for k in range(3):
        expected.append(("behind", way("entry>", *bounce * k, "exit>"), t * t * r ** (2 * k), k * shift))
        expected.append(
            ("front", way("entry>", *bounce * k, "exit", "entry>"), t * t * r ** (2 * k + 1), (k + 1) * shift)
        )
    start = {name: find(result, name, text) for name, text, _, _ in expected[:2]}
    for detector, text, energy, aside in expected:
        family = find(result, detector, text)
        assert family.count > 30, text
        assert abs(family.energy - energy) < Z_LIMIT * family.error + 1e-15, (text, family.energy, energy)
        assert family.error < 0.2 * energy
        # the screen's x runs along -x behind the plate
        moved = (family.centroid[0] - start[detector].centroid[0]) * (-1.0 if detector == "behind" else 1.0)
        assert abs(moved - aside) < 2.0 * Z_LIMIT * 0.5e-3 / np.sqrt(family.count)
        assert family.kind == "ghost"
    series = r + t * t * r / (1.0 - r * r), t * t / (1.0 - r * r)
    for detector, total in zip(("front", "behind"), series, strict=True):
        found = sum(f.energy for f in result.families if f.detector == detector)
        error = np.sqrt(sum(f.error**2 for f in result.families if f.detector == detector))
        assert abs(found - total) < Z_LIMIT * error


def near_edges(rng: np.random.Generator, half: float, n: int) -> RaySource:
    """Rays from all around to points within some nanometres of a cube's edges."""
    corner = np.sign(rng.uniform(-1, 1, (n, 3))) * half
    along = rng.integers(0, 3, n)
    target = corner.copy()
    target[np.arange(n), along] = rng.uniform(-half, half, n)
    target += rng.normal(0.0, 1.0, (n, 3)) * 10.0 ** rng.uniform(-12, -5, (n, 1))
    direction = rng.normal(size=(n, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return RaySource.even(target - 0.3 * direction, direction)


@pytest.mark.second
def test_no_light_leaks_through_edges(backend) -> None:
    """Paths aimed at the edges of a bare cube enter and leave it only by refraction at its faces."""
    half = 0.02
    faces = [Face(f"f{k}", "glass", Coating.TOTAL, cube_face(k, half)) for k in range(6)]
    scenery = glass_scene(Solid("glass", "N-BK7", tuple(faces)), INDEX, turn=(0.3, 0.5, 0.7), far=3.0)
    turn = rotation_matrix(np.array([0.3, 0.5, 0.7]))
    rays = near_edges(np.random.default_rng(8), half, 100_000)
    source = RaySource.even(rays.position @ turn.T, rays.direction @ turn.T)
    tracer = PathTracer(backend, scenery, sampling=Sampling(steps=64))
    result = tracer.run(source, seed=2)
    assert abs(result.balance.error) < 1e-12
    assert not result.balance.absorbed
    assert result.balance.under_way < 1e-3  # trapped by total reflection; a cube holds some of it for ever
    entered = 0
    for codes in tracer.events(source, np.arange(20_000), 100_000, 2):
        inside = False
        for number in codes:
            part, event, _ = decode(number)
            on_glass = scenery.parts[part].startswith("glass/")
            assert on_glass or not inside
            if event is Event.TRANSMIT:
                inside = not inside
                entered += inside
        assert not inside or len(codes) > 30
    assert entered > 5000


def cube_face(k: int, half: float) -> Pose:
    normal = np.zeros(3)
    normal[k // 2] = 1.0 if k % 2 else -1.0
    return frame(tuple(normal), tuple(half * normal))


def test_what_the_step_limit_cuts_off_is_under_way(backend) -> None:
    source = DiskSource.along(np.array([0.0, 0.0, -0.2]), unit(0.3, 0.0, 1.0), 1e-3)
    for steps, expected in ((1, 1.0), (32, 0.0)):
        tracer = PathTracer(backend, glass_scene(slab(0.3, THICKNESS), INDEX), sampling=Sampling(steps=steps))
        balance = tracer.run(source, 1000).balance
        assert balance.under_way == pytest.approx(expected, abs=1e-12)
        assert abs(balance.error) < 1e-12


def test_more_detections_than_expected_are_all_kept(backend) -> None:
    """The room for records grows: a launch that overflows it is done again."""
    surface, grid = screen("behind", facing(0.5), 1.0)
    tracer = PathTracer(backend, Scenery((surface,), (grid,)))
    source = DiskSource.along(np.zeros(3), np.array([0.0, 0.0, 1.0]), 1e-3)
    result = tracer.run(source, 70_000, chunk=60_000)
    (family,) = result.families
    assert family.count == 70_000
    assert family.energy == pytest.approx(1.0, rel=1e-12)
    assert result.detections.path.size == 0
    kept = tracer.run(source, 70_000, chunk=60_000, keep=True).detections
    np.testing.assert_array_equal(kept.path, np.arange(70_000))


def test_too_many_and_turned_apertures_of_a_face_are_refused() -> None:
    """A face carries two clear apertures at most, and none that is turned against it unless it is round."""
    entry = frame((0, 0, -1), (0, 0, 0))
    turned = Pose(entry.rotation @ rotation_matrix(np.array([0.0, 0.0, 0.3])), entry.translation)
    for pose, apertures, words in (
        (entry, [Circle(0.01), Circle(0.02), Circle(0.03)], "face 'entry' has 3 clear apertures; at most two"),
        (turned, [Rectangle(0.01, 0.02)], "its clear aperture is turned against the face 'entry'"),
    ):
        common = ("glass/e", plane(), Interaction.REFRACT)
        made = [Element(f"e{k}", *common, one, solid="glass") for k, one in enumerate(apertures)]
        tree = RigidTree((Body("glass"), Body("glass/e", pose)))
        assembly = Assembly(tree, {one.name: one for one in made}, {}, {"glass": INDEX})
        with pytest.raises(ValueError, match=words):
            solid_surfaces(slab(0.3, THICKNESS), assembly, assembly.place(), {}, Finishes(ground=ABSORBER))
