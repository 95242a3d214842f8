"""Which combinations of calibration unknowns the points leave open, by name, and the gauge that closes them.

Unknowns are counted in sigmas of their start values: what a launch may change, or `WORST` metres of image motion
(`scale`; of a principal distance at the ends of the line, where it moves the image most). The normal matrix N carries
the a-priori sigmas of the measurements; in these units the eigenvectors of N are combinations that are uncorrelated,
each known to 1 / sqrt(eigenvalue). A combination is open when that is above 1: the data say less of it than the start
values do. The space of open combinations depends on neither units nor order nor on which combinations of the unknowns
are chosen as unknowns, and all that is square to it is known better than at the start. Misfit does not open anything:
estimated variance factors do not count here. Start values with sigmas then are observations of the open combinations,
and of nothing else; what the points tell is left to the points.

The strength of a combination compares the reduced system with the lengths its columns had before the ground points were
eliminated: at a strength s it is known 1/s times less well than its unknowns alone. What is solved for with a strength
below `WEAK` is reported. What opens in a three-line camera:

- x of all lines against pitch: exact for lines square to the track, whatever the terrain.
- Orbit offsets against bias and interior: broken by relief and by the curvature of the Earth, a thousandth.
- Roll against y of all lines, yaw against y of the outer ones: broken by the turn of the outer lines about their line
  of sight, so weak or correlated, not open.
- Drift of the cameras in each field, unless a monitor tells it: d_alpha, d_beta and d_f of one line in all fields
  against its x, y and f; d_alpha, d_beta and d_gamma of all lines in one field against the bias of that field.
- A drift of the bias during the fields against x and y of the outer lines, which see a field earlier and later: weak,
  for within a line a field of 50 km passes in 7 s.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, eigh, qr

from analysis.arrays import Array
from analysis.orbit.calibration_parameters import CalibrationError, index
from analysis.orbit.three_line_model import BIAS, DRIFT
from analysis.units import ARCSEC

# Image motion: 15 px of 6.5 um, 32 arcsec, 75 m on the ground, as without any calibration (paper 003: 100 m class). A
# camera that is mounted askew by one arc minute lets the pitch be seen, but to 400 px with sixty points of 0.3 px.
WORST = 1e-4
# Of the noise of a single image point: a combination that may move the image by so much without the points' noticing is
# none of theirs, whatever start values say of it. Six points over the width of a field leave 500 times or less.
LOST = 3e3
WEAK = 3e-2
_CLOSED = 10.0
_SHOWN = 1e-2
_ANGLES = (*BIAS, *DRIFT[:3], "rate")


@dataclass(frozen=True, eq=False)
class Combination:
    """A change of unknowns that (nearly) moves no image point.

    Attributes:
        names, change: the unknowns that take part and their changes, metres and radians, for a largest image motion of
            any single one of 1 mm.
        strength: how much less well it is known than its unknowns alone would be.
        sigma: what one sigma of the data allows it, metres of image motion of the unknown that moves the image most.
    """

    names: tuple[str, ...]
    change: Array
    strength: float
    sigma: float

    def __str__(self) -> str:
        parts = [shown(n, c) for n, c in zip(self.names, self.change, strict=True)]
        return f"{', '.join(parts)} (strength {self.strength:.1e}, sigma {self.sigma * 1e3:.2g} mm)"


@dataclass(frozen=True)
class Gauge:
    """Rule that closes open combinations.

    Attributes:
        held: unknowns that keep their start values, for example ("nadir x",).
        start: sigmas of the start values, which observe open combinations and nothing else: by name, metres or radians,
            or one for all, metres of image motion. None: nothing closes what the points leave open.
    """

    held: tuple[str, ...] = ()
    start: Mapping[str, float] | float | None = None

    def __str__(self) -> str:
        held = f"held at the start values: {', '.join(self.held)}" if self.held else ""
        sure = "to what is stated of them"
        if isinstance(self.start, float):
            sure = f"to {self.start:g} m of image motion"
        start = "" if self.start is None else f"open combinations keep their start values, {sure}"
        return "; ".join(t for t in (held, start) if t) or "none"

    def sigmas(self, names: Sequence[str], scale: Array) -> tuple[Array, NDArray[np.bool_]]:
        """(P,) sigmas of the start values, SI, `WORST` of image motion where none is stated; (P,) whether it is.

        Raises CalibrationError for one that is not positive.
        """
        if self.start is None:
            return WORST * scale, np.zeros(len(names), bool)
        if isinstance(self.start, Mapping):
            given = np.array([self.start.get(n, np.nan) for n in names])
        else:
            given = self.start * scale
        stated = ~np.isnan(given)
        if not np.all(np.isfinite(given[stated]) & (given[stated] > 0)):
            raise CalibrationError(f"calibration: sigmas of start values must be positive, found {self.start}")
        return np.where(stated, given, WORST * scale), stated


class RankError(CalibrationError):
    """The points leave combinations of unknowns open and no gauge closes them.

    open: the combinations. They are also in the message, by name.
    """

    def __init__(self, message: str, open_combinations: Sequence[Combination]) -> None:
        super().__init__(message)
        self.open = tuple(open_combinations)


@dataclass(frozen=True, eq=False)
class Freedom:
    """What a gauge lets an adjustment solve for.

    Attributes:
        kept: (R,) unknowns that are solved for.
        rows: (k, P) what the start values observe: rows @ (unknowns - start) is zero to a standard deviation of 1.
        opened: the open combinations before the gauge.
    """

    kept: NDArray[np.intp]
    rows: Array
    opened: tuple[Combination, ...]


def null_vectors(reduced: Array, sigma: Array) -> Array:
    """(P, k) orthonormal basis of what is open, in units of `sigma`.

    Args:
        reduced: (P, P) normal matrix, of the a-priori sigmas.
        sigma: (P,) of the start values.
    """
    values, vectors = eigh(sigma[:, None] * reduced * sigma)
    # an eigenvalue below the rounding of the largest one is no information
    rounding = len(values) * np.finfo(np.float64).eps * max(float(values[-1]), 0.0)
    return np.asarray(vectors[:, values < max(1.0, rounding)])


def weak_vectors(reduced: Array, length: Array, scale: Array, basis: Array) -> Array:
    """(P, k) combinations within `basis` whose strength is below `WEAK`, in units of `scale`.

    Args:
        reduced: normal matrix without the ground points, (P, P).
        length: (P,) of the columns of the normal matrix before the ground points were eliminated.
        scale: a-priori sigmas of the unknowns, (P,), SI.
        basis: of what may be solved for, (P, r), in units of `scale`.
    """
    unit = scale * np.where(length > 0, length, 1.0)
    squares = basis.T @ (unit[:, None] ** 2 * basis)
    values, vectors = eigh(basis.T @ (scale[:, None] * reduced * scale) @ basis, squares)
    return np.asarray(basis @ vectors[:, values < WEAK**2])


def combinations(
    names: Sequence[str], scale: Array, vectors: Array, reduced: Array, length: Array
) -> tuple[Combination, ...]:
    """The space of vectors (P, k), in units of `scale`, by name: what takes part with a hundredth of the largest motion
    or more. Each combination has an unknown that is in no other one.

    Args:
        names: of the P unknowns.
        scale: their units, (P,), SI.
        vectors: (P, k), in units of `scale`.
        reduced: normal matrix without the ground points, (P, P).
        length: of the columns before the ground points were eliminated, (P,).
    """
    found = []
    for vector in echelon(vectors).T:
        change = scale * vector / np.abs(vector).max()
        form = float(np.sqrt(max(float(change @ reduced @ change), 0.0)))
        taking = np.flatnonzero(np.abs(vector) >= _SHOWN * np.abs(vector).max())
        found.append(
            Combination(
                tuple(names[i] for i in taking.tolist()),
                1e-3 * change[taking],
                form / max(float(np.linalg.norm(change * length)), 1e-300),
                1.0 / max(form, 1e-300),
            )
        )
    return tuple(found)


def free_basis(
    reduced: Array,
    length: Array,
    scale: Array,
    names: Sequence[str],
    gauge: Gauge | None,
    ray: float = np.inf,
    told: Mapping[str, float] | None = None,
) -> Freedom:
    """What may be solved for. `reduced` (P, P) is of the a-priori sigmas.

    Args:
        reduced: normal matrix without the ground points, (P, P), of the a-priori sigmas.
        length: of the columns before they were eliminated, (P,).
        scale: units of the unknowns, (P,), SI.
        names: of the P unknowns.
        gauge: what closes open combinations, None for nothing.
        ray: standard deviation of a single image point, metres, for `LOST`.
        told: unknowns without a stated start value that have priors of their own, with the sigmas of these.

    Raises:
        RankError: open combinations that the gauge does not close, or that may move the image by `LOST` times the noise
            of a single image point; points that tell nothing at all.
        CalibrationError: a held unknown that does not exist, a start value whose sigma is not positive.
    """
    gauge = gauge or Gauge()
    sigma, stated = gauge.sigmas(names, scale)
    if np.any(stated):
        # counted so that their own priors in `reduced` close them
        own_prior = np.array([_CLOSED * (told or {}).get(n, np.nan) for n in names])
        sigma = np.where(stated | np.isnan(own_prior), sigma, own_prior)
    opened = combinations(names, scale, _in_scale(null_vectors(reduced, sigma), sigma, scale), reduced, length)
    kept = np.setdiff1d(np.arange(len(names)), [index(names, n) for n in gauge.held])
    within, own = reduced[np.ix_(kept, kept)], sigma[kept]
    inside = null_vectors(within, own)
    # a row says nothing of unknowns whose start values nobody knows
    rows = np.where(stated[kept], inside.T / own, 0.0)
    # what start values close has an eigenvalue of 1 or more then
    checks = [(within + rows.T @ rows, np.where(stated[kept], np.sqrt(2.0), 1.0) * own)]
    if np.any(stated) and np.isfinite(ray):
        checks.append((within, LOST * ray * scale[kept]))
    for matrix, units in checks:
        vectors = null_vectors(matrix, units)
        if vectors.shape[1]:
            if matrix is within:
                vectors, units = inside, own  # all that is open, of which some is lost
            shown = _in_scale(vectors, units, scale[kept])
            found = combinations([names[i] for i in kept.tolist()], scale[kept], shown, within, length[kept])
            text = "; ".join(str(c) for c in found)
            raise RankError(
                f"calibration: the points cannot tell: {text}. Gauge: {gauge}. Hold or weight some of these", found
            )
    if inside.shape[1] == len(kept):
        raise RankError("calibration: the points determine none of the unknowns", opened)
    padded = np.zeros((len(rows), len(names)))
    padded[:, kept] = rows
    return Freedom(kept, padded, opened)


def _in_scale(vectors: Array, sigma: Array, scale: Array) -> Array:
    """(P, k) combinations in units of `sigma` (P,) as vectors in units of `scale` (P,)."""
    return np.asarray(vectors * (sigma / scale)[:, None])


def solved(normal: Array, right: Array) -> Array:
    """Solution of a positive definite system, its unknowns brought to one size first."""
    size = 1.0 / np.sqrt(np.diag(normal))
    factor = cho_factor(size[:, None] * normal * size)
    wide = right.reshape(len(size), -1)
    return np.asarray(size[:, None] * cho_solve(factor, size[:, None] * wide)).reshape(right.shape)


def echelon(vectors: Array) -> Array:
    """(P, k) of the same space as independent vectors (P, k), each with an unknown of its own and a largest entry of 1.

    The own unknowns are those that have most part in the space, which does not depend on the vectors that span it.
    """
    if not vectors.shape[1]:
        return vectors
    basis = np.linalg.qr(vectors)[0]
    own = qr(basis.T, mode="r", pivoting=True)[1][: basis.shape[1]]
    found = np.linalg.solve(basis[own].T, basis.T).T
    largest = np.abs(found).argmax(axis=0)
    return np.asarray(found / found[largest, np.arange(found.shape[1])])


def shown(name: str, change: float) -> str:
    """A change of an unknown, metres or radians, in words."""
    if "offset" in name or "height" in name:
        return f"{name} {change:+.4g} m"
    if name.split()[-1] in _ANGLES:
        per = "/s" if name.endswith("rate") else ""
        return f"{name} {change / ARCSEC:+.4g} arcsec{per}"
    return f"{name} {change * 1e3:+.4g} mm"
