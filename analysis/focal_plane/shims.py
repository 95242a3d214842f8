"""Shims under a focal-plane assembly: from a wanted rigid motion to the thickness at each mounting hole (paper 004,
section 2).

The assembly stands on pads at its mounting holes. The pads' normal n points from the camera's structure into the
assembly, so a thicker shim moves the assembly along +n. Of a rigid motion the shims make what they can: the lift along
n and the tilts about axes in the mounting surface. The turn about n and the slide in the surface are set by hand,
within the clearance of the screws in their holes.

In an off-axis camera n is inclined against the focal plane's normal Z' by an angle i, and the two parts mix. Take the
inclination about X', n = (0, sin i, cos i), and a wanted tilt w about Y'. It needs a turn of w sin i about n. If that
is left out, the shims alone give a tilt of w cos^2 i, and the line loses its level by -w sin i cos i; shims that force
the whole tilt without a turn (another w / cos^2 i) would lose w tan i. A tilt about the axis of the inclination itself
does not mix. All this comes out of `ShimPlan.shims_only`.

Frame O'-X'Y'Z' of the assembly, metres and radians; see analysis.focal_plane.plane_fit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from analysis.arrays import Array
from analysis.focal_plane.plane_fit import RigidMotion
from analysis.measurement_error import MeasurementError

# Holes carry a tilt when the smaller spread of their places is at least this part of the larger: 0.3 mm in 0.3 m.
_LEAST_SPREAD = 1e-3


class ShimError(MeasurementError, ValueError):
    """The motion cannot be made with this mount and these shims.

    holes: indices of the holes at fault, empty when it is the mount as a whole. The message counts them from 1.
    slides: by how much these holes would slide, metres; empty when that is not what is wrong.
    """

    def __init__(self, message: str, holes: tuple[int, ...] = (), slides: tuple[float, ...] = ()) -> None:
        super().__init__(message)
        self.holes = holes
        self.slides = slides


@dataclass(frozen=True, eq=False)
class Mount:
    """Where and how the assembly is screwed down.

    holes: (H, 3) centres of the pads in O'-X'Y'Z', metres. normal: (3,) unit vector from the structure into the
    assembly. clearance: how far a hole may slide against its screw, radius, metres. step: the workshop grinds shims to
    multiples of this, metres.
    """

    holes: Array
    normal: Array
    clearance: float
    step: float

    @classmethod
    def of(cls, holes: ArrayLike, normal: ArrayLike, clearance: float, step: float) -> Mount:
        """The mount, checked; the normal of any length.

        Raises ShimError when the holes cannot carry a tilt; ValueError for bad input.

        Args:
            holes: centres of the pads in O'-X'Y'Z', (H, 3), metres.
            normal: from the structure into the assembly, (3,), of any length.
            clearance: how far a hole may slide against its screw, radius, metres.
            step: the workshop grinds shims to multiples of this, metres.
        """
        place, up = np.asarray(holes, np.float64), np.asarray(normal, np.float64)
        if place.ndim != 2 or place.shape[1] != 3 or up.shape != (3,):
            raise ValueError(f"mount: holes must be (H, 3) and normal (3,), found {place.shape} and {up.shape}")
        length = float(np.linalg.norm(up))
        if not (np.all(np.isfinite(place)) and np.isfinite(length) and length > 0):
            raise ValueError("mount: holes must be finite and the normal a finite vector other than zero")
        if not (0 <= clearance < np.inf and 0 < step < np.inf):
            raise ValueError(f"mount: clearance {clearance} must not be negative and step {step} must be positive")
        if len(place) < 3:
            raise ShimError(f"mount: {len(place)} holes cannot hold a plane; at least three are needed")
        up = up / length
        arm = place - place.mean(axis=0)
        spread = np.linalg.svd(arm - np.outer(arm @ up, up), compute_uv=False)
        if spread[1] <= _LEAST_SPREAD * spread[0] or spread[0] == 0:
            raise ShimError(
                "mount: the holes lie on one line (seen along the normal), so shims cannot tilt the assembly about it;"
                " add a hole off that line"
            )
        return cls(place, up, float(clearance), float(step))


@dataclass(frozen=True, eq=False)
class ShimPlan:
    """What to grind, what to set by hand, and what comes of it.

    mount, wanted: as given.
    change: (H,) exact change of thickness at each hole, metres; + is thicker.
    change_covariance: (H, H), from the covariance of the wanted motion; without the rounding.
    rounded_change: (H,) what is ground. thickness: (H,) the new shims, multiples of the step.
    slide: (H, 3) displacement of each hole in the mounting surface that is set by hand.
    turn: rotation about the normal that is set by hand, right-handed; the twist of the wanted rotation.
    achieved: the motion with the rounded shims and turn and slide as wanted. With more than three holes, the plane that
        fits the pads best.
    shims_only: the motion when turn and slide are *not* made and the holes' centre only moves along the normal.
    """

    mount: Mount
    wanted: RigidMotion
    change: Array
    change_covariance: Array
    rounded_change: Array
    thickness: Array
    slide: Array
    turn: float
    achieved: RigidMotion
    shims_only: RigidMotion

    @property
    def change_sigma(self) -> Array:
        """(H,) sigma of the exact changes, metres."""
        return np.sqrt(np.diag(self.change_covariance))

    @property
    def level_coupling(self) -> float:
        """By how much the line would be off its wanted level without turn and slide, radians about +Z'."""
        return self.shims_only.line_turn - self.wanted.line_turn

    def focus_error(self, place: ArrayLike) -> Array:
        """Defocus that rounding leaves at places (..., 2) of the focal plane, metres: focus minus CCD along +Z'."""
        spots = np.asarray(place, np.float64)
        point = np.concatenate([spots, np.zeros((*spots.shape[:-1], 1))], axis=-1)
        return np.asarray((self.wanted.moved(point) - self.achieved.moved(point))[..., 2])


def shim_plan(correction: RigidMotion, mount: Mount, present: ArrayLike) -> ShimPlan:
    """Shims for a rigid motion of the assembly about O'.

    A hole that moves by d needs n . d more shim; what is left of d lies in the mounting surface.

    Args:
        correction: for example FocalPlaneFit.correction().
        mount: where the shims are.
        present: (H,) or a number, thickness of the shims now, metres.

    Raises:
        ShimError: a hole would slide beyond its clearance, or a shim would be thinner than nothing.
        ValueError: a thickness that is not finite.
    """
    up, holes = mount.normal, mount.holes
    move = correction.displacement(holes)
    change = move @ up
    slide = move - np.outer(change, up)
    _check_clearance(slide, mount.clearance)
    now = np.asarray(np.broadcast_to(np.asarray(present, np.float64), change.shape))
    if not np.all(np.isfinite(now)):
        raise ValueError("shims: the present thicknesses must be finite")
    thickness = np.round((now + change) / mount.step) * mount.step
    _check_thickness(thickness, now, mount.step)
    rounded = thickness - now
    # change = (r x n) . rotation + n . shift to first order
    slope = np.concatenate([np.cross(holes, up), np.broadcast_to(up, holes.shape)], axis=1)
    # Twist of the rotation about n (swing-twist decomposition of its quaternion).
    quaternion = Rotation.from_rotvec(correction.rotation).as_quat()
    turn = 2 * float(np.arctan2(quaternion[:3] @ up, quaternion[3]))
    achieved = _seated(correction, mount, rounded)
    centre = holes.mean(axis=0)
    untwisted = Rotation.from_rotvec(correction.rotation) * Rotation.from_rotvec(-turn * up)
    lifted = centre + up * float(np.mean(change))
    start = RigidMotion.of(untwisted.as_rotvec(), lifted - untwisted.apply(centre))
    return ShimPlan(
        mount=mount,
        wanted=correction,
        change=change,
        change_covariance=slope @ correction.covariance @ slope.T,
        rounded_change=rounded,
        thickness=thickness,
        slide=slide,
        turn=turn,
        achieved=achieved,
        shims_only=_seated(start, mount, change),
    )


def _seated(motion: RigidMotion, mount: Mount, change: Array) -> RigidMotion:
    """The motion after the assembly has settled on shims changed by (H,): the nearest one whose holes rise by `change`
    in least squares.

    It settles by tilts about axes in the mounting surface through the holes' centre and a lift along the normal, so
    turn and slide stay what they were.
    """
    up = mount.normal
    first = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    first = first / np.linalg.norm(first)
    second = np.cross(up, first)
    rotation, shift = Rotation.from_rotvec(motion.rotation), motion.shift
    # The first step is right to a few 1e-6 of itself, the others to rounding.
    for _ in range(3):
        place = rotation.apply(mount.holes) + shift
        misfit = change - (place - mount.holes) @ up
        centre = place.mean(axis=0)
        arm = place - centre
        # a tilt by (a, b) about (first, second) lifts a hole by a (second . arm) - b (first . arm)
        design = np.stack([arm @ second, -(arm @ first), np.ones(len(arm))], axis=1)
        step = np.linalg.lstsq(design, misfit, rcond=None)[0]
        tilt = Rotation.from_rotvec(step[0] * first + step[1] * second)
        rotation, shift = tilt * rotation, tilt.apply(shift - centre) + centre + step[2] * up
    return RigidMotion.of(rotation.as_rotvec(), shift)


def _check_clearance(slide: Array, clearance: float) -> None:
    """ShimError naming the holes that would slide beyond the clearance, and by how much."""
    size = np.linalg.norm(slide, axis=1)
    over = np.flatnonzero(size > clearance)
    if not over.size:
        return
    text = ", ".join(f"hole {h + 1} by {1e3 * size[h]:.4g} mm" for h in over)
    raise ShimError(
        f"shims: the motion slides {text}; the screws allow {1e3 * clearance:.4g} mm, which is"
        f" {1e3 * (size.max() - clearance):.4g} mm too little; widen the holes by as much",
        tuple(int(h) for h in over),
        tuple(float(size[h]) for h in over),
    )


def _check_thickness(thickness: Array, now: Array, step: float) -> None:
    """ShimError naming the holes whose shims would be thinner than nothing, and what to start from."""
    thin = np.flatnonzero(thickness < -1e-9 * step)
    if not thin.size:
        return
    text = ", ".join(f"hole {h + 1} would get {1e3 * thickness[h]:.4g} mm" for h in thin)
    short = step * float(np.ceil(np.max(-thickness) / step - 1e-9))
    raise ShimError(
        f"shims: {text}; move the seat back and start from shims that are"
        f" {1e3 * short:.4g} mm thicker at all holes, {1e3 * (float(now.max()) + short):.4g} mm at the thickest",
        tuple(int(h) for h in thin),
    )
