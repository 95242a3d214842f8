"""Signed angles along the track, and lines that are bent, against the synthetic pass of test_planes."""

from dataclasses import replace

import numpy as np
import pytest

from analysis.orbit.planes import (
    AngleError,
    Station,
    Strip,
    along_track_angle,
    along_track_angles,
    angles_between,
    fit_plane,
    line_frame,
)
from tests.analysis.refusals import refuses
from tests.analysis.test_planes import ARCSEC, DEG, LINES, SCENE, descending_pass, noisy

PAIR, BOTH = ((0, 1),), ("forward", "nadir")


def frames(scene, names, noise=1.5, sigma_station=0.5, bend=0.0):
    station = Station.of(scene.station, sigma_station)
    strips = {name: Strip.of(scene.points[name], noise) for name in names}
    return [line_frame(fit_plane(station, strips[k]), scene.tangents[k], bend) for k in names]


@pytest.mark.parametrize(
    "pair", [("forward", "nadir"), ("nadir", "backward"), ("backward", "forward"), ("nadir", "forward")]
)
def test_signs(pair):
    """Positive where the first looks ahead; rounding of the points."""
    found = along_track_angles(frames(SCENE, pair), PAIR)
    assert found.values[0] == pytest.approx(LINES[pair[0]] - LINES[pair[1]], abs=1e-7 * ARCSEC)
    forward = SCENE.body[:, 0]
    assert all(frame.forward @ forward > 0.9 for frame in frames(SCENE, pair))


def test_only_the_part_along_the_track_counts():
    """A line turned by 2 arcmin about its look that begins 100 arcsec beside the other, 30 arcsec ahead: its dihedral
    angle is sqrt(30^2 + 120^2), its look angle sqrt(30^2 + 100^2), its angle along the track 30 but for 1e-7 of it
    times the offset."""
    looks = {"forward": 30 * ARCSEC, "nadir": 0.0}
    scene = descending_pass(looks=looks, twist=120 * ARCSEC, offset=100 * ARCSEC)
    pair = frames(scene, ("forward", "nadir"))
    assert along_track_angles(pair, PAIR).values[0] == pytest.approx(30 * ARCSEC, abs=0.05 * ARCSEC)
    dihedral = angles_between([frame.plane for frame in pair], PAIR).values[0]
    assert dihedral == pytest.approx(np.hypot(30, 120) * ARCSEC, abs=0.1 * ARCSEC)


@pytest.mark.second
@pytest.mark.parametrize("ahead", [0.0, 25 * DEG], ids=["parallel", "far apart"])
def test_covariance_is_propagated(ahead):
    """Every coordinate of station and points moved and all fitted anew. The signed angle of parallel planes is not
    folded; that of the planes alone is."""
    scene = descending_pass(looks={"forward": ahead, "nadir": 0.0}, n=6)

    def angle(station=0.0, name="nadir", points=0.0):
        moved = {**scene.points, name: scene.points[name] + points}
        return along_track_angles(frames(replace(scene, station=scene.station + station, points=moved), BOTH), PAIR)

    steps = [0.5 * (angle(d).values[0] - angle(-d).values[0]) for d in 0.5 * np.eye(3)]
    for name in BOTH:
        for k in np.ndindex(6, 3):
            d = np.zeros((6, 3))
            d[k] = 1.5
            steps.append(0.5 * (angle(0.0, name, d).values[0] - angle(0.0, name, -d).values[0]))
    assert angle().sigma[0] == pytest.approx(np.linalg.norm(steps), rel=1e-3)
    planes = [frame.plane for frame in frames(noisy(scene, np.random.default_rng(7), 1.5, 0.5), BOTH)]
    assert bool(angles_between(planes, PAIR).folded[0]) == (ahead == 0.0)


def bent(scene, size, name="forward"):
    """The scene with a line whose ends look `size` radians ahead of its plane, quadratic from the centre."""
    arm = scene.points[name] - scene.station
    w = np.arctan(scene.tangents[name])
    forward = SCENE.body @ [np.cos(LINES[name]), 0.0, -np.sin(LINES[name])]
    push = (w / np.abs(w).max()) ** 2 * size * np.linalg.norm(arm, axis=1)
    points = {**scene.points, name: scene.points[name] + push[:, None] * forward}
    return type(scene)(scene.station, scene.body, points, scene.tangents, scene.up)


def test_a_bend_is_taken_out_where_the_points_show_it():
    """5 mas at the ends, points good to 1 mm: the prior of 10 mas leaves the bend free, and the centre is found; a
    rigid line is off by its mean, a third of the bend or so. With points of 1.5 m the prior holds the line straight."""
    scene = bent(SCENE, 0.005 * ARCSEC)
    rigid, free = (frames(scene, ("forward", "nadir"), 1e-3, 0.0, bend) for bend in (0.0, 0.01 * ARCSEC))
    off = [along_track_angles(pair, PAIR).values[0] - LINES["forward"] for pair in (rigid, free)]
    assert off[0] > 0.001 * ARCSEC
    assert abs(off[1]) < 1e-5 * ARCSEC
    stiff, held = (along_track_angles(frames(scene, ("forward", "nadir"), bend=b), PAIR) for b in (0.0, 0.01 * ARCSEC))
    assert held.values == pytest.approx(stiff.values, abs=1e-4 * ARCSEC)
    assert stiff.sigma < held.sigma < 1.01 * stiff.sigma


def test_a_free_bend_costs_what_it_should():
    """Without a prior the centre of a parabola over evenly spread points has 9/4 of the variance of their mean."""
    (straight,), (free,) = (frames(SCENE, ("nadir",), 1.5, 0.0, bend) for bend in (0.0, 1.0))
    assert straight.variance == 0.0
    arm = np.linalg.norm(SCENE.points["nadir"] - SCENE.station, axis=1).mean()
    mean = (1.5 / arm) ** 2 / 20
    assert free.variance == pytest.approx(1.25 * mean, rel=0.3)  # 20 places drawn at random


def test_angles_add_up_with_their_covariance():
    """From forward to nadir and on to backward it is as far as from forward to backward, errors and all: sides that
    differ by the Earth's turn, 4 deg, tilt the axes by less than a per cent. Backwards it is as far."""
    three = frames(SCENE, ("forward", "nadir", "backward"))
    found = along_track_angles(three, ((0, 1), (1, 2), (0, 2), (1, 0)))
    assert found.values[:2].sum() == pytest.approx(found.values[2], rel=1e-3)
    c = found.covariance / ARCSEC**2
    assert c[:2, :2].sum() == pytest.approx(c[2, 2], rel=0.02)
    assert c[:2, 2].sum() == pytest.approx(c[2, 2], rel=0.02)
    assert [c[3, 3], -c[0, 3]] == pytest.approx([c[0, 0], c[0, 0]], rel=1e-9)
    # turns about the line's direction are what planes that far apart turn by, too
    planes = angles_between([frame.plane for frame in three], ((0, 1), (1, 2)))
    assert planes.covariance / ARCSEC**2 == pytest.approx(c[:2, :2], rel=0.02)


def test_lines_seen_from_two_stations():
    """Their common error would be taken for one of the first station."""
    forward = frames(SCENE, ("forward",))
    for other in (frames(SCENE, ("nadir",), sigma_station=0.6), frames(descending_pass(height=501e3), ("nadir",))):
        refuses(AngleError, "one and the same station", along_track_angles, [*forward, *other], PAIR)


def test_lines_counted_from_opposite_ends():
    forward, nadir = frames(SCENE, ("forward", "nadir"))
    with pytest.raises(AngleError, match="opposite directions"):
        along_track_angle(forward.central, forward.side, nadir.central, -nadir.side)
