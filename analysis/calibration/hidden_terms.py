"""What the residuals of an adjustment say of terms that the model leaves out.

A term g that moves the misclosures by G g and is not solved for leaves the estimates wrong by C N_xg g, with C their
covariance and N the normal matrix with g among the unknowns. What the residuals say of it is the gradient s at g = 0,
of covariance S = N_gg - N_gx C N_xg: the estimate is -S^-1 s, and s' S^-1 s is chi-square where there is no such term
and the sigmas are right (Lagrange multiplier test; Rao, Proc. Camb. Phil. Soc. 44 (1948) 50). S is the exact
covariance, so the test holds for six points as for six hundred.

Terms here: rates of the attitude during each field; slow courses along each line, cosines of the exposure time over the
time of the line, in x and in y, by which residuals of neighbouring exposures are alike; steps within a line.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from analysis.arrays import Array
from analysis.calibration.normal_equations import Equations
from analysis.orbit.calibration_parameters import CalibrationField
from analysis.orbit.three_line_model import Partials, Rays

FALSE_ALARM = 5e-5
"""False-alarm rate of each of the two tests of a run, rates and courses, over all fields together: 1e-4 a run."""
_WAVES = 4
_POINTS_PER_WAVE = 4
_RANK = 1e-9
"""Smallest eigenvalue of S that counts, relative to the largest. No residual shows a term that the unknowns imitate."""


@dataclass(frozen=True, eq=False)
class Rates:
    """A drift of the attitude during each field, radians per second about the body's axes, zero at its mean time.

    middles: field -> mean time of its rays, seconds; fields without times are left out.
    """

    middles: Mapping[str, float]

    @classmethod
    def of(cls, fields: Sequence[CalibrationField]) -> Rates:
        """Rates of all fields whose rays have times."""
        times = {f.name: [r.time for r in f.rays.values() if r.time is not None and r.point.size] for f in fields}
        return cls({name: float(np.mean(np.concatenate(rows))) for name, rows in times.items() if rows})

    @property
    def size(self) -> int:
        """Number of terms."""
        return 3 * len(self.middles)

    def columns(self, field: CalibrationField, line: str, rays: Rays, by: Partials) -> Array:
        """(n, 2, size) derivatives of the misclosures.

        Args:
            field: the pass.
            line: of the camera.
            rays: n image points of it.
            by: derivatives of their misclosures.
        """
        found = np.zeros((len(rays.point), 2, self.size))
        if rays.time is not None and field.name in self.middles:
            first = 3 * list(self.middles).index(field.name)
            since = (rays.time - self.middles[field.name])[:, None, None]
            found[:, :, first : first + 3] = by.attitude * since
        return found


@dataclass(frozen=True, eq=False)
class Courses:
    """Slow courses of x and y along the time of each line of each field, metres in the image: cosines of up to four
    half periods, the constant apart.

    waves: (field, line) -> (begin, duration, number of the first term, how many of each of x and y).
    """

    waves: Mapping[tuple[str, str], tuple[float, float, int, int]]

    @classmethod
    def of(cls, fields: Sequence[CalibrationField]) -> Courses:
        """Courses of all lines with times and enough points."""
        found: dict[tuple[str, str], tuple[float, float, int, int]] = {}
        first = 0
        for one in fields:
            for line, rays in one.rays.items():
                if rays.time is None or not rays.point.size or not np.ptp(rays.time):
                    continue
                count = min(_WAVES, len(rays.point) // _POINTS_PER_WAVE)
                if count:
                    found[one.name, line] = (float(rays.time.min()), float(np.ptp(rays.time)), first, count)
                    first += 2 * count
        return cls(found)

    @property
    def size(self) -> int:
        """Number of terms."""
        return sum(2 * count for *_, count in self.waves.values())

    def columns(self, field: CalibrationField, line: str, rays: Rays, by: Partials) -> Array:
        """(n, 2, size) derivatives of the misclosures.

        Args:
            field: the pass.
            line: of the camera.
            rays: n image points of it.
            by: derivatives of their misclosures.
        """
        found = np.zeros((len(rays.point), 2, self.size))
        if (field.name, line) in self.waves and rays.time is not None:
            begin, span, first, count = self.waves[field.name, line]
            wave = np.cos(np.pi * np.arange(1, count + 1) * (rays.time[:, None] - begin) / span)
            found[:, 0, first : first + count] = wave
            found[:, 1, first + count : first + 2 * count] = wave
        return found


@dataclass(frozen=True, eq=False)
class Steps:
    """A step of x and of y within a line, metres: all image points beyond a place of the line are displaced.

    places: (line, y of the place in metres).
    """

    places: tuple[tuple[str, float], ...]

    @property
    def size(self) -> int:
        """Number of terms."""
        return 2 * len(self.places)

    def columns(self, field: CalibrationField, line: str, rays: Rays, by: Partials) -> Array:
        """(n, 2, size) derivatives of the misclosures: an image point displaced by 1 m has one that is 1 m larger.

        Args:
            field: the pass.
            line: of the camera.
            rays: n image points of it.
            by: derivatives of their misclosures.
        """
        found = np.zeros((len(rays.point), 2, self.size))
        for k, (name, place) in enumerate(self.places):
            if name == line:
                beyond = rays.image[:, 1] > place
                found[beyond, 0, 2 * k] = found[beyond, 1, 2 * k + 1] = -1.0
        return found


HiddenTerms = Rates | Courses | Steps


@dataclass(frozen=True, eq=False)
class Unseen:
    """What the residuals say of terms that are left out.

    Attributes:
        terms: which, G of them.
        score: (G,) gradient. cofactor: (G, G) its covariance, S.
        moved: (P, G) by how much the estimates are wrong for a term of one unit.
    """

    terms: HiddenTerms
    score: Array
    cofactor: Array
    moved: Array

    @classmethod
    def of(cls, terms: HiddenTerms, wide: Equations, covariance: Array) -> Unseen:
        """Read equations that contain the terms, at a solution.

        Args:
            terms: G of them.
            wide: equations of P unknowns and the G terms, which are zero.
            covariance: of the P unknowns, (P, P), SI.
        """
        count = len(covariance)
        moved = covariance @ wide.reduced[:count, count:]
        cofactor = wide.reduced[count:, count:] - wide.reduced[count:, :count] @ moved
        return cls(terms, wide.right[count:], 0.5 * (cofactor + cofactor.T), moved)

    @property
    def estimate(self) -> Array:
        """(G,) all terms together; a term that nothing tells is zero."""
        return np.asarray(-self._inverse @ self.score)

    @property
    def sigma(self) -> Array:
        """(G,) of `estimate`; infinite where nothing tells a term."""
        spread = np.diag(self._inverse)
        return np.sqrt(np.where(np.diag(self.cofactor) > _RANK * self._largest, spread, np.inf))

    @property
    def sigma_alone(self) -> Array:
        """(G,) of each term where there is no other."""
        own = np.diag(self.cofactor)
        seen = own > _RANK * self._largest
        return np.asarray(np.where(seen, 1.0 / np.sqrt(np.where(seen, own, 1.0)), np.inf))

    @property
    def degrees_of_freedom(self) -> int:
        """Number of combinations of the terms that the residuals can show."""
        return int(np.linalg.matrix_rank(self._unit, tol=1e-6, hermitian=True)) if len(self.score) else 0

    @property
    def chi_square(self) -> float:
        """Chi-square of all terms together."""
        return float(self.score @ self._inverse @ self.score) if len(self.score) else 0.0

    @property
    def p_value(self) -> float:
        """Chance of such a chi-square where none of these terms is there; 1 where residuals show none."""
        return float(chi2.sf(self.chi_square, self.degrees_of_freedom)) if self.degrees_of_freedom else 1.0

    @property
    def _largest(self) -> float:
        return float(np.diag(self.cofactor).max(initial=0.0))

    @property
    def _size(self) -> Array:
        return np.asarray(np.sqrt(np.maximum(np.diag(self.cofactor), 1e-300)))

    @property
    def _unit(self) -> Array:
        return np.asarray(self.cofactor / self._size / self._size[:, None])

    @property
    def _inverse(self) -> Array:
        inner = np.linalg.pinv(self._unit, rcond=1e-6, hermitian=True)
        return np.asarray(inner / self._size / self._size[:, None])
