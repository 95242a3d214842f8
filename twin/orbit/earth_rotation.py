"""The Earth's rotation over a span of time: from the celestial frame (GCRS) to the terrestrial one (ITRS).

IAU 2006/2000A precession and nutation, Earth rotation angle and polar motion (IERS Conventions 2010, chapter 5, based
on the celestial intermediate origin), computed by the library ERFA. The celestial pole moves so smoothly that its
coordinates are computed at nodes an hour apart and interpolated by cubic splines; the fastest terms have periods of 5
days and some 1e-8 rad, and the error stays below 1e-15 rad. The angle of rotation is linear in time and is not
interpolated.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import erfa
import numpy as np
from scipy.interpolate import CubicSpline

DAY = 86400.0
"""Seconds."""
RATE = 2.0 * np.pi * 1.00273781191135448 / DAY
"""The Earth's rate of rotation, rad/s (IERS Conventions 2010, eq. 5.15)."""

_TT_FROM_TAI = 32.184
_NODE_STEP = 3600.0
_NODES_AROUND = 3
_DIFFERENCE_STEP = 600.0


@contextmanager
def _years_without_announced_leap_seconds() -> Iterator[None]:
    # ERFA calls a year dubious for which leap seconds have not been announced yet; it then takes none, and so do we.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", erfa.ErfaWarning)
        yield


def tai_of(epoch: str) -> tuple[float, float]:
    """TAI of an instant given in UTC, as a Julian date in two parts, days.

    Args:
        epoch: ISO 8601 text with its zone, "2011-03-05T03:05:00Z".

    Raises:
        ValueError: not such a text, or without its zone.
    """
    time = datetime.fromisoformat(epoch)
    if time.tzinfo is None:
        raise ValueError(f"{epoch!r} does not say its zone; UTC ends in Z")
    time = time.astimezone(UTC)
    second = time.second + 1e-6 * time.microsecond
    with _years_without_announced_leap_seconds():
        utc = erfa.dtf2d("UTC", time.year, time.month, time.day, time.hour, time.minute, second)
        one, two = erfa.utctai(*utc)
    return float(one), float(two)


def ut1_of(epoch: str, dut1: float) -> tuple[float, float]:
    """UT1 of an instant given in UTC, as a Julian date in two parts, days.

    Args:
        epoch: as for `tai_of`.
        dut1: UT1 - UTC, seconds.
    """
    with _years_without_announced_leap_seconds():
        one, two = erfa.utcut1(*erfa.taiutc(*tai_of(epoch)), dut1)
    return float(one), float(two)


@dataclass(frozen=True, eq=False)
class EarthRotation:
    """Rotation GCRS -> ITRS around an epoch; made by `rotation_over`. Seconds are SI seconds of atomic time.

    Attributes:
        pole: spline of the celestial pole's X and Y and of the locator s, radians, over seconds.
        angle: Earth rotation angle at the epoch, radians.
        polar: polar motion, TIRS -> ITRS, shape (3, 3).
    """

    pole: Any
    angle: float
    polar: np.ndarray

    def celestial(self, seconds: Any) -> np.ndarray:
        """Rotation GCRS -> CIRS, the frame of the celestial pole and origin of that moment; (...) -> (..., 3, 3)."""
        x, y, s = np.moveaxis(self.pole(np.asarray(seconds, dtype=np.float64)), -1, 0)
        return np.asarray(erfa.c2ixys(x, y, s))

    def matrix(self, seconds: Any) -> np.ndarray:
        """Rotation GCRS -> ITRS: x_itrs = matrix @ x_gcrs; (...) -> (..., 3, 3)."""
        t = np.asarray(seconds, dtype=np.float64)
        return np.asarray(erfa.c2tcio(self.celestial(t), self.angle + RATE * t, self.polar))

    def rate(self, seconds: Any) -> np.ndarray:
        """Angular velocity of the ITRS against the GCRS in axes of the ITRS, rad/s; (...) -> (..., 3).

        The pole's own motion (some 1e-11 rad/s) is part of it, so that velocities are the exact derivatives of
        positions.
        """
        t = np.asarray(seconds, dtype=np.float64)
        after, before = (self.celestial(t + step) for step in (_DIFFERENCE_STEP, -_DIFFERENCE_STEP))
        # C' C^T = -[q x] with q the angular velocity of the CIRS in its own axes
        turn = (after - before) @ np.swapaxes(self.celestial(t), -1, -2) / (2.0 * _DIFFERENCE_STEP)
        q = 0.5 * np.stack(
            [turn[..., 1, 2] - turn[..., 2, 1], turn[..., 2, 0] - turn[..., 0, 2], turn[..., 0, 1] - turn[..., 1, 0]],
            axis=-1,
        )
        angle = self.angle + RATE * t
        c, s = np.cos(angle), np.sin(angle)
        tirs = np.stack([c * q[..., 0] + s * q[..., 1], c * q[..., 1] - s * q[..., 0], q[..., 2] + RATE], axis=-1)
        return tirs @ self.polar.T


def rotation_over(
    epoch: str, first: float, last: float, dut1: float = 0.0, polar_motion: tuple[float, float] = (0.0, 0.0)
) -> EarthRotation:
    """The Earth's rotation from `first` to `last`, seconds from the epoch.

    Args:
        epoch: UTC, ISO 8601 text.
        first: begin of the span, seconds; nodes stand some hours beyond it on either side.
        last: its end, seconds.
        dut1: UT1 - UTC at the epoch, seconds. UT1 runs on evenly from there, also over a leap second.
        polar_motion: x and y of the pole, radians (x toward Greenwich, y toward 90 degrees west).
    """
    one, two = tai_of(epoch)
    two += _TT_FROM_TAI / DAY
    around = np.ceil(0.5 * (last - first) / _NODE_STEP) + _NODES_AROUND
    node = 0.5 * (first + last) + _NODE_STEP * np.arange(-around, around + 1.0)
    pole = np.stack(erfa.xys06a(one, two + node / DAY), axis=-1)
    polar = np.asarray(erfa.pom00(*polar_motion, erfa.sp00(one, two)))
    polar.setflags(write=False)
    return EarthRotation(CubicSpline(node, pole), float(erfa.era00(*ut1_of(epoch, dut1))), polar)
