"""The edge of an exit pupil, and the region where the pupil overlaps a shifted copy of itself.

Points of the normalised pupil plane are complex numbers p = x + iy. The edge is the image of the stop's rim under a
smooth map; normalised so that its first harmonic is the unit circle it is

    B(a) = exp(ia) + sum_n c_n exp(ina),    a = angle on the stop's rim.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optics.numerics.invariants import UnphysicalError

WORST_BEND = 0.3
"""Largest sum of n^2 |c_n|: up to there the edge is convex and the iterations for its chords converge."""

_ITERATIONS = 60
_CLOSE = 1e-13
"""Length of a chord, of 2: a thousand roundings."""


@dataclass(frozen=True, eq=False)
class PupilEdge:
    """Smooth convex edge that is nearly the unit circle; or S such edges, one for each of S shifts.

    Attributes:
        harmonics: c_-H .. c_H, complex, (2H + 1,) or (2H + 1, S), with c_1 = 1 and c_0 = c_-1 = 0.

    Raises:
        ValueError: the edge is too far from the unit circle.
    """

    harmonics: np.ndarray

    def __post_init__(self) -> None:
        last = len(self.harmonics) // 2
        bend = float(np.max(np.arange(-last, last + 1) ** 2 @ np.abs(self.harmonics)) - 1.0)
        if bend > WORST_BEND:
            raise UnphysicalError(
                f"the pupil's edge is too far from an ellipse: sum n^2 |c_n| = {bend:.2g} > {WORST_BEND}"
            )

    def boundary(self, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Edge points B and dB/da at angles a of the stop's rim, complex, of the angles' shape; of S edges (S, ...)."""
        last = len(self.harmonics) // 2
        turn = np.exp(1j * angle)
        own = self.harmonics
        if own.ndim > 1:
            own = own.reshape(*own.shape, *(1,) * (turn.ndim - 1))
        point, slope, power = own[last] + 0.0 * turn, 0.0 * turn, turn
        for n in range(1, last + 1):
            plus, minus = own[last + n] * power, own[last - n] * np.conj(power)
            point += plus + minus
            slope += 1j * n * (plus - minus)
            power = power * turn
        return point, slope

    def reach(self, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Longest chord along directions (radians, normalised coordinates), and its half angle (see ``_chord``).

        A shift by a longer way leaves no overlap of the pupil with itself: this is the cut-off.
        """
        half = np.full(np.shape(direction), 0.5 * np.pi)
        mean = np.asarray(direction) + 0.5 * np.pi
        back = np.exp(-1j * np.asarray(direction))
        for _ in range(_ITERATIONS):
            mean, _ = self._chord(direction, mean, half)
            right, left = (self.boundary(mean + side * half)[1] * back for side in (-1.0, 1.0))
            # d(length)/d(offset) of the chord; Newton's step with the circle's second derivative
            step = -0.5 * (right.real / right.imag - left.real / left.imag)
            half = half + step
            if np.all(np.abs(step) < 1e-9):  # the length is at its maximum: its own error is the square
                break
        return self._chord(direction, mean, half)[1], half

    def _chord(self, direction: np.ndarray, mean: np.ndarray, half: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Chord along ``direction`` between the edge's angles mean - half and mean + half.

        B(m - d) - B(m + d) = 2 sin d exp(i direction) H, H = -i exp(-i direction) sum c_n exp(inm) sin(nd) / sin d. A
        given d in [0, pi] (from the tangent chord on one side to that on the other) has one m with real H; it is well
        conditioned also where the chord shrinks to a point.

        Args:
            direction: (S,).
            mean: start, (S,).
            half: (S,).

        Returns:
            Mean angle and length, negative for negative ``half``, (S,) each.
        """
        last = len(self.harmonics) // 2
        factor = -1j * np.exp(-1j * np.asarray(direction))
        cos = np.cos(half)
        for _ in range(_ITERATIONS):
            turn = np.exp(1j * mean)
            value, slope = np.zeros_like(turn), np.zeros_like(turn)
            power, ratio, before = turn, np.ones_like(cos), np.zeros_like(cos)
            for n in range(1, last + 1):
                plus, minus = self.harmonics[last + n] * power, self.harmonics[last - n] * np.conj(power)
                value += ratio * (plus - minus)
                slope += (1j * n) * ratio * (plus + minus)
                power = power * turn
                ratio, before = 2.0 * cos * ratio - before, ratio  # sin(nd)/sin d: Chebyshev's second kind
            value, slope = factor * value, factor * slope
            step = value.imag / slope.imag
            mean = mean - step
            if np.all(np.abs(step) < 1e-7):  # Newton: the next error is its square
                break
        return mean, 2.0 * np.sin(half) * (value.real - step * slope.real)

    def corners(self, shift: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Where the edges of two copies of the pupil, shifted by s, cross.

        Args:
            shift: normalised shifts s, complex, (S,).

        Returns:
            Angles a (2, S) and b (2, S) with B(a) - B(b) = s at both crossings, and whether there is an overlap, (S,).
        """
        direction, size = np.angle(shift), np.abs(shift)
        longest, middle = self.reach(direction)
        inside = size < longest
        want = np.arccos(np.minimum(size / longest, 1.0))
        out = []
        for sign in (-1.0, 1.0):
            way, mean = want.copy(), direction + 0.5 * np.pi
            for _ in range(_ITERATIONS):
                half = middle + sign * way
                mean, length = self._chord(direction, mean, half)
                if np.all((np.abs(length - size) < _CLOSE) | ~inside):
                    break
                way = way + want - np.arccos(np.clip(length / longest, -1.0, 1.0))
            out.append((mean - half, mean + half))
        return np.stack([a for a, _ in out]), np.stack([b for _, b in out]), inside

    def overlap(
        self,
        shift: np.ndarray,
        right: np.ndarray,
        left: np.ndarray,
        across: tuple[np.ndarray, np.ndarray],
        along: tuple[np.ndarray, np.ndarray],
    ) -> tuple[np.ndarray, np.ndarray]:
        """Quadrature over the overlap of the pupil shifted by -s/2 and by +s/2.

        The region lies between two arcs of the edge that meet in the corners. Straight lines between points of equal
        parameter t on the arcs sweep it smoothly, so that Gauss' rules in t and along the lines converge exponentially.

        Args:
            shift: (S,) normalised.
            right: angles a of ``corners``, (2, S).
            left: angles b, (2, S).
            across: points and weights in t over [-1, 1], (I,) each.
            along: likewise on the lines, (J,) each.

        Returns:
            Points c, complex, (S, I * J), such that c - s/2 and c + s/2 are in the pupil, and area weights in p.
        """
        t = across[0]
        arcs = []
        for ends, side in ((right, -0.5), (left, 0.5)):
            speed = 0.5 * (ends[1] - ends[0])
            point, slope = self.boundary(0.5 * (ends[0] + ends[1])[:, None] + speed[:, None] * t)
            arcs.append((point + side * shift[:, None], slope * speed[:, None]))
        (a, da), (b, db) = arcs
        share = 0.5 * (1.0 + along[0])
        span = (a - b)[..., None]
        points = b[..., None] + span * share
        speed = db[..., None] + (da - db)[..., None] * share
        area = 0.5 * np.abs(speed.real * span.imag - speed.imag * span.real)
        weight = area * (across[1][:, None] * along[1])
        return points.reshape(len(shift), -1), weight.reshape(len(shift), -1)
