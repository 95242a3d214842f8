"""Bodies that stand in each other, prisms in the way of light, and beams that miss a prism: found, and told."""

import re
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull, Delaunay

from optics.geometry.pose import rotation_matrix
from scenes.models import instrument_builder, obstruction
from scenes.models.instrument_model import MisplacedError
from scenes.models.obstruction import (
    LEAST_GAP,
    RAYS,
    check_clearance,
    check_solids,
    convex_bodies,
    find_obstructions,
    find_overlaps,
    remedy,
    separation,
)
from scenes.specs.load import INSTRUMENTS, LIBRARY, load_cameras, load_instrument
from scenes.yaml.errors import InputError
from tests.tiers import quick
from tests.twin.commands import replaced

PAIR = (LIBRARY / INSTRUMENTS / "gf7_pair.yaml").read_text("utf-8")
PAIR = re.sub(r", tilt: \[[^]]*\]", "", PAIR)  # prisms square to the beam, for round numbers
PAIR = re.sub(r" +#.*", "", PAIR)


def cube(size: float = 1.0) -> np.ndarray:
    return 0.5 * size * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)


def test_separation_of_cubes() -> None:
    """Corner to corner, overlapping, concentric, nearly touching, in any attitude; Qhull merges faces within 1e-14."""
    turn = rotation_matrix(np.array([0.3, -1.2, 0.7]))
    near = ((0.75, 0.1, 0.2), -0.25), ((0.0, 0.0, 0.0), -1.0), ((1.0 + 1e-5, 0, 0), 1e-5)
    for move, want in (((2.0, 3.0, 1.5), np.sqrt(1 + 4 + 0.25)), *near):
        for one, other in ((cube(), cube() + move), (cube() + move, cube())):
            assert separation(one @ turn.T, other @ turn.T) == pytest.approx(want, abs=1e-12), move


def test_separations_are_those_of_trimesh() -> None:
    """Of boxes of all shapes, flat ones among them: the nearest point of the hull of all differences."""
    rng = np.random.default_rng(11)
    apart = 0
    for _ in range(60):
        first, second = (
            cube() @ np.diag(10.0 ** rng.uniform(-3.0, 0.0, 3)) @ rotation_matrix(rng.standard_normal(3)).T
            for _ in range(2)
        )
        second = second + 1.5 * rng.standard_normal(3)
        between = (second[:, None] - first).reshape(-1, 3)
        triangles = between[ConvexHull(between).simplices]
        nearest = trimesh.triangles.closest_point(triangles, np.zeros((len(triangles), 3)))
        found = separation(first, second)
        if found > 0.0:
            apart += 1
            assert found == pytest.approx(np.min(np.linalg.norm(nearest, axis=-1)), abs=1e-12)
    assert apart > 30


def test_separation_of_crossed_edges() -> None:
    """Two bars across each other, nearest at edges whose cross product is no face's normal: SAT over faces alone says
    too little.
    """
    bar = cube() * [4.0, 1.0, 1.0]
    first = bar @ rotation_matrix(np.array([np.pi / 4.0, 0.0, 0.0])).T
    second = bar @ rotation_matrix(np.array([np.pi / 4.0, 0.0, 0.0])).T @ rotation_matrix([0.0, 0.0, np.pi / 2.0]).T
    for gap in (0.3, -0.2):
        assert separation(first, second + np.array([0.0, 0.0, np.sqrt(2.0) + gap])) == pytest.approx(gap, abs=1e-12)


@pytest.mark.second
@pytest.mark.parametrize("name", ["gf7_pair", "monitor_pair"])
def test_reference_instruments_have_room(name, instrument) -> None:
    model = instrument(name)
    assert find_overlaps(model) == ()
    check_clearance(model)
    bodies = convex_bodies(model)
    assert len(bodies) == len(model.solids) + 2 * 4
    for solid in model.solids:  # the hull has the body's own middle
        middle = bodies[solid.path].mean(axis=0)
        assert np.linalg.norm(middle - model.assembly.nominal_pose(solid.path).translation) < 1.5


def test_beams_wider_than_the_optics_can_lead_are_refused(instrument, backend, monkeypatch) -> None:
    pair = instrument("gf7_pair")
    obstruction.check_beams(pair, backend)
    monkeypatch.setattr(obstruction, "_WHOLE", 1e3 * obstruction._WHOLE)
    with pytest.raises(MisplacedError, match="light of the monitor does not reach its return faces") as caught:
        obstruction.check_beams(pair, backend)
    assert caught.value.key == ("monitor",)


def test_a_body_that_is_open_is_refused(instrument) -> None:
    pair = instrument("gf7_pair")
    check_solids(pair.assembly, pair.solids)
    prism = next(solid for solid in pair.solids if solid.path == "base/forward/monitor/left/prism_180")
    with pytest.raises(MisplacedError, match="do not enclose a body; it is open") as caught:
        check_solids(pair.assembly, [replace(prism, faces=prism.faces[:3])])
    assert (caught.value.key, caught.value.channel) == (("monitor", "prism_180"), ("forward", "left"))


@pytest.fixture
def bare(backend, monkeypatch, tmp_path):
    """Function: changes of gf7_pair -> instrument, without the checks that would refuse it."""
    monkeypatch.setattr(instrument_builder, "check_clearance", lambda instrument: None)
    monkeypatch.setattr(instrument_builder, "check_beams", lambda instrument, backend: None)

    def built(*changes: tuple[str, str]):
        (tmp_path / "own.yaml").write_text(replaced(PAIR, *changes), "utf-8")
        spec = load_instrument(tmp_path / "own.yaml")
        return instrument_builder.build_instrument(spec, load_cameras(spec), backend)

    return built


POSITION = "position: [0.15 m, 0 m, 0.5 m]"
OVERLAPS = {
    "central": (POSITION, "position: [-0.5 m, 0 m, -0.1 m]", 1, (6, "central_prism.position")),
    "rhomboid": ("distance: 0.5 m", "distance: 30 mm", 4, (13, "monitor.prism_0.distance")),
    "field": ("field: 1.22 deg", "field: 0.3 deg", 2, (12, "monitor.prism_180.distance")),
    "camera": ("[-1.4 m, 0 m, 0 m]", "[1.4 m, 0.6 m, 0 m]", None, (5, "cameras.backward.position")),
}
"""Change of the pair, number of overlaps, line and key of one."""
MOVE = re.compile(r"move it by ([+-])([xyz]) ([0-9.e+]+) mm of the base")


@pytest.mark.second
@pytest.mark.parametrize("name", OVERLAPS)
def test_bodies_in_each_other(name, bare) -> None:
    """A message names both bodies and how deep they reach into each other, and says how far and along which axis the
    body that its key moves goes; moved so, it is free.
    """
    old, new, count, place = OVERLAPS[name]
    model = bare((old, new))
    found, bodies = find_overlaps(model), convex_bodies(model)
    assert count in (None, len(found))
    assert [o.depth for o in found] == sorted((o.depth for o in found), reverse=True)
    with pytest.raises(InputError) as caught:
        check_clearance(model)
    assert place in {(i.line, ".".join(map(str, i.key))) for i in caught.value.issues}
    for overlap, issue in zip(found, caught.value.issues, strict=True):
        for said in (overlap.first, overlap.second, f"{1e3 * overlap.depth:.3g} mm"):
            assert said in issue.problem
        assert issue.file.endswith("own.yaml")
        told = MOVE.search(issue.allowed)
        assert told is not None, issue.allowed
        way = float(f"{told[1]}{told[3]}e-3") * np.eye(3)["xyz".index(told[2])]
        # the issue's body is the one whose key is told
        other, moved = overlap.first, overlap.second
        if remedy(model, moved)[0] != issue.key:
            other, moved = moved, other
        assert separation(bodies[moved] + way, bodies[other]) >= LEAST_GAP * (1.0 - 1e-6)
        # 2 % less and they still touch: it is no further than it has to be
        assert separation(bodies[moved] + 0.98 * way, bodies[other]) < LEAST_GAP


@pytest.mark.second
def test_a_gap_below_the_least(bare) -> None:
    """10 um between rhomboid and facet are too little, 100 um are enough."""
    touching = bare(("distance: 0.5 m", "distance: 33.01 mm"))
    found = find_overlaps(touching)
    assert len(found) == 4
    assert all(-LEAST_GAP < o.depth <= 0.0 for o in found)
    with pytest.raises(InputError, match=r"is only .* um from base/central_prism"):
        check_clearance(touching)
    check_clearance(bare(("distance: 0.5 m", "distance: 33.1 mm")))


@pytest.mark.second
@pytest.mark.parametrize("name", quick(1, ["gf7_pair", "monitor_pair"]))
def test_only_its_own_prisms_stand_before_a_camera(name, instrument, backend) -> None:
    """Each 180-deg prism takes some 5 % of its camera's pupil, of which its channel uses the part that the return face
    leaves; no prism stands in a monitor beam that is not its own.
    """
    model = instrument(name)
    found = find_obstructions(model, backend)
    assert {(o.beam, o.body) for o in found} == {
        (f"{c.camera}/imaging", c.prism_body("prism_180")) for c in model.channels
    }
    for one in found:
        camera = model.cameras[one.beam.partition("/")[0]]
        clear = model.spec.monitor.prism_180.width**2 / camera.spec.entrance_pupil**2
        assert one.used == pytest.approx(clear, abs=3.0 / RAYS)  # rays are spread evenly: a few at the edge
        assert 0.03 < one.share < 0.07
        assert one.used < one.share


def test_segments_through_a_body() -> None:
    """Against 4000 points along each of 300 random segments, as in a body seen from its corners."""
    rng = np.random.default_rng(5)
    corners = rng.normal(size=(12, 3))
    planes = ConvexHull(corners).equations
    segments = rng.normal(scale=2.0, size=(300, 1, 2, 3))
    s = np.linspace(0.0, 1.0, 4000)[:, None]
    points = segments[:, 0, :1] * (1.0 - s) + segments[:, 0, 1:] * s
    inside = Delaunay(corners).find_simplex(points) >= 0
    taken = obstruction.blocked_rays(segments, planes)
    seen = inside.any(axis=1)
    assert np.all(taken[seen])
    assert np.sum(taken & ~seen) <= 1  # one that the points step over
    assert 30 < seen.sum() < 270
    # two segments are taken when one of them is; a body that is only touched takes nothing
    both = np.stack([segments[:, 0], np.full((300, 2, 3), 9.0)], axis=1)
    assert np.array_equal(obstruction.blocked_rays(both, planes), taken)
    cube_planes = ConvexHull(cube()).equations
    along = np.array([[[[-2.0, 0.0, 0.5], [2.0, 0.0, 0.5]]], [[[-2.0, 0.0, 0.0], [-0.5, 0.0, 0.0]]]])
    assert not obstruction.blocked_rays(along, cube_planes).any()
    assert obstruction.blocked_rays(along - [0.0, 0.0, 1e-5], cube_planes).tolist() == [True, False]


def test_prisms_in_the_way(bare, backend) -> None:
    """The central prism before the forward camera, and rhomboids that stand in their own beam to the 180-deg prism."""
    model = bare((POSITION, "position: [1.7 m, 0 m, 0.4 m]"))
    found = {(o.beam, o.body): o for o in find_obstructions(model, backend)}
    block = found["forward/imaging", "base/central_prism"]
    assert block.used == 0.0
    # 240 mm x 200 mm of block seen at 26 degrees, in a pupil 0.6 m wide, before M1 or behind it
    pupil = 0.25 * np.pi * model.cameras["forward"].spec.entrance_pupil ** 2
    face = 0.24 * 0.2 * np.cos(model.spec.cameras["forward"].look)
    assert 0.7 * face / pupil < block.share < 2.5 * face / pupil
    assert found["forward/left", "base/forward/monitor/left/prism_0"].share > 0.1
    assert ("backward/imaging", "base/central_prism") not in found
