"""Shims as a rigid motion: pads moved by hand and a rigid body fitted to them (Kabsch), plane geometry of three pads,
statistics of rounding, and the coupling of focus and line level through an inclined mounting surface.
"""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from analysis.focal_plane import plane_fit
from analysis.focal_plane.plane_fit import LineLevel, Mount, RigidMotion, ShimError, fit_focal_plane
from tests.analysis.refusals import refuses
from tests.analysis.test_planes import rotation

ARCMIN, DEG = np.pi / 10800, np.pi / 180
UM, MM = 1e-6, 1e-3
STEP = 10 * UM


def inclined(angle, azimuth=0.0):
    """Frame (3, 3) of a mounting surface as columns; its normal, the third, leans by angle from Z'.

    azimuth 0 turns it about X', 90 deg about Y'.
    """
    return rotation([0, 0, azimuth]) @ rotation([-angle, 0, 0]) @ rotation([0, 0, -azimuth])


def make_mount(angle=0.0, azimuth=0.0, count=4, step=STEP, clearance=2 * MM, behind=-30 * MM):
    """Holes round the line CCD, 30 mm behind the focal plane at its middle."""
    around = 2 * np.pi * (np.arange(count) + 0.5) / count
    flat = np.column_stack([60 * MM * np.cos(around), 150 * MM * np.sin(around), np.zeros(count)])
    frame = inclined(angle, azimuth)
    return Mount.of(flat @ frame.T + [0, 0, behind], frame[:, 2], clearance, step)


def shim_plan(wanted, mount, present=10 * MM):
    """Shims for a motion; where nothing else is said, on thick ones of whole steps."""
    return plane_fit.shim_plan(wanted, mount, present)


def rounding(plan):
    """What rounding leaves: rotation vector, achieved after wanted, and how far O' stands along +Z' of its place."""
    turn = Rotation.from_matrix(plan.achieved.matrix @ plan.wanted.matrix.T).as_rotvec()
    return np.array([*turn, plan.achieved.shift[2] - plan.wanted.shift[2]])


def kabsch(before, after):
    """Rotation matrix and shift of the rigid body that best takes points (N, 3) to others."""
    mean = before.mean(axis=0), after.mean(axis=0)
    u, _, vt = np.linalg.svd((before - mean[0]).T @ (after - mean[1]))
    turn = (vt.T * [1, 1, np.sign(np.linalg.det(vt.T @ u.T))]) @ u.T
    return turn, mean[1] - turn @ mean[0]


def random_correction(rng, tilt=5 * ARCMIN, piston=0.3 * MM):
    return RigidMotion.of(rng.uniform(-1, 1, 3) * tilt, [0, 0, rng.uniform(-1, 1) * piston])


@pytest.mark.second
@pytest.mark.parametrize(("angle", "azimuth", "count"), [(0, 0, 3), (20 * DEG, 0, 4), (6 * DEG, 90 * DEG, 6)])
def test_exact_shims_reproduce_the_wanted_motion(angle, azimuth, count):
    """Unrounded: pads thickened along n and slid in the surface carry a rigid body by just the wanted motion."""
    rng = np.random.default_rng(1)
    mount = make_mount(angle, azimuth, count)
    for _ in range(10):
        wanted = random_correction(rng)
        plan = shim_plan(wanted, mount)
        assert np.abs(plan.slide @ mount.normal).max() < 1e-17  # the slide lies in the surface
        turn, shift = kabsch(mount.holes, mount.holes + np.outer(plan.change, mount.normal) + plan.slide)
        assert turn == pytest.approx(rotation(wanted.rotation), abs=1e-13)
        assert shift == pytest.approx(wanted.shift, abs=1e-14)
        # a workshop without a step: the achieved motion, found by settling on the pads, is the wanted one
        fine = shim_plan(wanted, Mount(mount.holes, mount.normal, mount.clearance, 1e-15))
        assert fine.achieved.rotation == pytest.approx(wanted.rotation, abs=1e-13)
        assert fine.achieved.shift == pytest.approx(wanted.shift, abs=1e-14)


@pytest.mark.parametrize("angle", [6 * DEG, 20 * DEG])
def test_coupling_of_focus_and_line_level(angle):
    """A tilt of 5' about Y' on a surface inclined about X': without the turn by hand the line is off by -5' sin cos.

    Derived here in the mount's own axes: the shims make the two components of the rotation vector in the surface; the
    third is dropped. Second order: 5'^2 = 0.007'.
    """
    tilt = 5 * ARCMIN
    frame = inclined(angle)
    plan = shim_plan(RigidMotion.of([0, tilt, 0], [0, 0, 0]), make_mount(angle))
    in_mount = frame.T @ [0, tilt, 0]
    kept = frame @ (in_mount * [1, 1, 0])
    assert plan.rotation == pytest.approx(in_mount[2], abs=1e-9)
    assert abs(plan.rotation) == pytest.approx(tilt * np.sin(angle), abs=1e-9)
    assert plan.level_coupling == pytest.approx(kept[2], abs=0.01 * ARCMIN)
    assert plan.level_coupling == pytest.approx(-tilt * np.sin(angle) * np.cos(angle), abs=0.01 * ARCMIN)
    # and of the tilt itself only cos^2 comes about
    assert plan.shims_only.rotation[1] == pytest.approx(tilt * np.cos(angle) ** 2, abs=0.01 * ARCMIN)
    if angle == 20 * DEG:
        assert plan.level_coupling / ARCMIN == pytest.approx(-1.607, abs=0.011)  # 5 x 0.34202 x 0.93969
    # the holes' centre only moves along the normal
    centre = plan.mount.holes.mean(axis=0)
    drift = plan.shims_only.displacement(centre)
    assert np.linalg.norm(drift - plan.mount.normal * (drift @ plan.mount.normal)) < 1e-9


def test_three_pads_are_met_exactly_after_rounding():
    rng = np.random.default_rng(7)
    mount = make_mount(20 * DEG, 30 * DEG, 3)
    for _ in range(10):
        plan = shim_plan(random_correction(rng), mount)
        rise = plan.achieved.displacement(mount.holes) @ mount.normal
        assert rise == pytest.approx(plan.rounded_change, abs=1e-15)
        assert plan.rounded_change / STEP == pytest.approx(np.round(plan.rounded_change / STEP), abs=1e-9)
        # rounding tilts, it does not turn: no rotation about the normal is added
        assert abs(rounding(plan)[:3] @ mount.normal) < 1e-6 * ARCMIN


def test_covariance_of_the_thickness():
    """Propagated by differences from the fitted plane and the level of the line."""
    place = np.array([(x, y) for x in (-10 * MM, 0, 10 * MM) for y in np.linspace(-115, 115, 5) * MM])
    mount, theodolite = make_mount(20 * DEG, count=3), 5 * UM * np.sqrt(2) / 0.23
    sigma = np.linspace(3, 8, 15) * UM

    def plan(extra=0.0, level=0.0):
        fit = fit_focal_plane(place, 0.1 * MM + place @ [1e-3, -5e-4] + extra, sigma)
        return shim_plan(fit.correction(LineLevel(level, theodolite)), mount)

    steps = [0.5 * (plan(d).change - plan(-d).change) for d in np.diag(sigma)]
    steps.append(0.5 * (plan(level=theodolite).change - plan(level=-theodolite).change))
    expected = np.array(steps).T @ np.array(steps)
    # first order: slopes of 1e-3 times a few
    assert plan().change_covariance == pytest.approx(expected, rel=6e-3)
    assert plan().change_sigma == pytest.approx(np.sqrt(np.diag(expected)), rel=3e-3)


def test_present_shims():
    """The new thickness is on the workshop's grid even where the present one is not."""
    mount = make_mount(count=4)
    now = np.array([2.003, 1.998, 2.011, 2.0]) * MM
    plan = shim_plan(RigidMotion.of([1 * ARCMIN, 0, 0], [0, 0, -0.1 * MM]), mount, now)
    assert plan.thickness / STEP == pytest.approx(np.round(plan.thickness / STEP), abs=1e-9)
    assert plan.rounded_change == pytest.approx(plan.thickness - now, abs=1e-18)
    assert np.abs(plan.thickness - now - plan.change).max() <= 0.5 * STEP * (1 + 1e-9)


def test_errors_say_what_to_change():
    mount = make_mount(count=4, clearance=0.05 * MM)
    with pytest.raises(ShimError, match=r"hole 1 by 0\.\d+ mm.*allow 0\.05 mm.*mm too little") as caught:
        shim_plan(RigidMotion.of([0, 0, 5 * ARCMIN], [0, 0, 0]), mount)
    assert caught.value.holes == (0, 1, 2, 3)
    with pytest.raises(ShimError, match=r"hole 3 would get -0\.1 mm; .* 0\.1 mm thicker.* 1\.1 mm at") as caught:
        shim_plan(
            RigidMotion.of([5 * ARCMIN, 0, 0], [0, 0, 0]), make_mount(count=4), [0.5 * MM, 0.5 * MM, 0.05 * MM, MM]
        )
    assert caught.value.holes == (2,)
    # what it asks for does
    now = np.array([0.6, 0.6, 0.15, 1.1]) * MM
    plan = shim_plan(RigidMotion.of([5 * ARCMIN, 0, 0], [0, 0, 0]), make_mount(count=4), now)
    assert plan.thickness.min() == pytest.approx(0, abs=1e-9)
    holes = make_mount().holes
    refuses(ShimError, "2 holes do not fix a plane", Mount.of, holes[:2], [0, 0, 1], MM, STEP)
    refuses(ShimError, "on one line", Mount.of, np.outer(np.arange(4), [0.01, 0.1, 0]), [0, 0, 1], MM, STEP)
    with pytest.raises(ShimError, match="seen along the normal"):
        Mount.of([[0, 0, 0], [0, 0.1, 0], [0, 0.05, 0.05]], [0, 0, 1], MM, STEP)
    for change, message in (
        ({"normal": [0, 0, 0]}, "other than zero"),
        ({"step": 0}, "step"),
        ({"clearance": -1}, "clearance"),
        ({"holes": np.zeros((4, 2))}, r"\(H, 3\)"),
    ):
        with pytest.raises(ValueError, match=message):
            Mount.of(**({"holes": holes, "normal": [0, 0, 1], "clearance": MM, "step": STEP} | change))
    refuses(ValueError, "present thicknesses", shim_plan, RigidMotion.of([0, 0, 0], [0, 0, 0]), make_mount(), np.nan)
    refuses(ValueError, "finite", RigidMotion.of, [0, 0, np.nan], [0, 0, 0])
    refuses(ValueError, r"must be \(3,\)", RigidMotion.of, [0, 0], [0, 0, 0])
