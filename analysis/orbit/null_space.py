"""Which combinations of calibration unknowns the points leave open, by name, and the gauge that closes them.

Unknowns are counted in metres of image motion (`scale`), so that a combination of any of them has one natural size.
The normal matrix N carries the a-priori sigmas of the measurements; in these units the eigenvectors of N are
combinations that are uncorrelated, each known to 1 / sqrt(eigenvalue) metres. A combination is open when that sigma is
above `WORST`, more than a calibration starts with: the data say less of it than the start values do. The space of open
combinations depends on neither units nor order nor on which combinations of the unknowns are chosen as unknowns, and
all that is square to it is known to `WORST` or better. Misfit does not open anything: estimated variance factors do not
count here.

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

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, eigh, qr

from analysis.orbit.calibration_parameters import CalibrationError, index
from analysis.orbit.three_line_model import BIAS, DRIFT
from analysis.units import ARCSEC

__all__ = [
    "WEAK",
    "WORST",
    "Combination",
    "Freedom",
    "Gauge",
    "RankError",
    "combinations",
    "free_basis",
    "null_vectors",
    "solved",
    "weak_vectors",
]

Array = NDArray[np.float64]
# Image motion: 15 px of 6.5 um, 32 arcsec, 75 m on the ground, as without any calibration (paper 003: 100 m class). A
# camera that is mounted askew by one arc minute lets the pitch be seen, but to 400 px with sixty points of 0.3 px.
WORST = 1e-4
WEAK = 3e-2
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
        parts = [_shown(n, c) for n, c in zip(self.names, self.change, strict=True)]
        return f"{', '.join(parts)} (strength {self.strength:.1e}, sigma {self.sigma * 1e3:.2g} mm)"


@dataclass(frozen=True)
class Gauge:
    """How open combinations are closed.

    Attributes:
        held: unknowns that keep their start values, for example ("nadir x",).
        minimum_norm: open combinations, and nothing else, keep their start values.
        start: sigma of the start values along those, metres of image motion.
    """

    held: tuple[str, ...] = ()
    minimum_norm: bool = False
    start: float = WORST

    def __str__(self) -> str:
        held = f"held at the start values: {', '.join(self.held)}" if self.held else ""
        norm = f"open combinations keep their start values, to {self.start:g} m of image motion"
        norm = norm if self.minimum_norm else ""
        return "; ".join(t for t in (held, norm) if t) or "none"


class RankError(CalibrationError):
    """The points leave combinations of unknowns open and no gauge closes them.

    open: the combinations. They are also in the message, by name.
    """

    def __init__(self, message: str, open_combinations: Sequence[Combination]) -> None:
        super().__init__(message)
        self.open = tuple(open_combinations)


@dataclass(frozen=True, eq=False)
class Freedom:
    """What a gauge lets an adjustment solve for, in metres of image motion (units of `scale`).

    Attributes:
        basis: (P, R) orthonormal, what may be solved for.
        closed: (P, k) orthonormal, open combinations that keep their start values.
        opened: the open combinations before the gauge.
    """

    basis: Array
    closed: Array
    opened: tuple[Combination, ...]


def null_vectors(reduced: Array, scale: Array) -> Array:
    """(P, k) orthonormal basis of what is open, in units of `scale`.

    Args:
        reduced: (P, P) normal matrix, of the a-priori sigmas.
        scale: (P,) change of each unknown that moves the image by one metre.
    """
    values, vectors = eigh(scale[:, None] * reduced * scale)
    # an eigenvalue below the rounding of the largest one is no information
    rounding = len(values) * np.finfo(np.float64).eps * max(float(values[-1]), 0.0)
    return np.asarray(vectors[:, values < max(WORST**-2, rounding)])


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
    for vector in _echelon(vectors).T:
        change = scale * vector / np.abs(vector).max()
        form = float(np.sqrt(max(float(change @ reduced @ change), 0.0)))
        taking = np.flatnonzero(np.abs(vector) >= _SHOWN * np.abs(vector).max())
        found.append(
            Combination(
                tuple(names[i] for i in taking.tolist()),
                1e-3 * change[taking],
                form / float(np.linalg.norm(change * length)),
                1.0 / max(form, 1e-300),
            )
        )
    return tuple(found)


def free_basis(reduced: Array, length: Array, scale: Array, names: Sequence[str], gauge: Gauge | None) -> Freedom:
    """What may be solved for. `reduced` (P, P) is of the a-priori sigmas.

    Args:
        reduced: normal matrix without the ground points, (P, P), of the a-priori sigmas.
        length: of the columns before they were eliminated, (P,).
        scale: units of the unknowns, (P,), SI.
        names: of the P unknowns.
        gauge: what closes open combinations, None for nothing.

    Raises:
        RankError: open combinations that the gauge does not close.
        CalibrationError: a held unknown that does not exist, a gauge whose start sigma is not positive.
    """
    gauge = gauge or Gauge()
    if not (np.isfinite(gauge.start) and gauge.start > 0):
        raise CalibrationError(f"calibration: sigma of the gauge's start values must be positive, found {gauge.start}")
    opened = combinations(names, scale, null_vectors(reduced, scale), reduced, length)
    kept = np.setdiff1d(np.arange(len(names)), [index(names, n) for n in gauge.held]).tolist()
    basis = np.eye(len(names))[:, kept]
    within = reduced[np.ix_(kept, kept)]
    inside = null_vectors(within, scale[kept])
    if inside.shape[1] and not gauge.minimum_norm:
        still = combinations([names[i] for i in kept], scale[kept], inside, within, length[kept])
        text = "; ".join(str(c) for c in still)
        raise RankError(
            f"calibration: the points cannot tell: {text}. Gauge: {gauge}. Hold or weight some of these", still
        )
    if inside.shape[1] == len(kept):
        raise RankError("calibration: the points determine none of the unknowns", opened)
    full = np.linalg.qr(inside, mode="complete")[0]
    return Freedom(basis @ full[:, inside.shape[1] :], basis @ inside, opened)


def solved(normal: Array, right: Array) -> Array:
    """Solution of a positive definite system, its unknowns brought to one size first."""
    size = 1.0 / np.sqrt(np.diag(normal))
    factor = cho_factor(size[:, None] * normal * size)
    wide = right.reshape(len(size), -1)
    return np.asarray(size[:, None] * cho_solve(factor, size[:, None] * wide)).reshape(right.shape)


def _echelon(vectors: Array) -> Array:
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


def _shown(name: str, change: float) -> str:
    if "offset" in name:
        return f"{name} {change:+.4g} m"
    if name.split()[-1] in _ANGLES:
        per = "/s" if name.endswith("rate") else ""
        return f"{name} {change / ARCSEC:+.4g} arcsec{per}"
    return f"{name} {change * 1e3:+.4g} mm"
