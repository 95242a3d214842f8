"""Which combinations of calibration unknowns the points leave open, by name, and the gauge that closes them.

Columns of the reduced system are brought to unit length (as they were before the ground points were eliminated). A
singular value s, the strength, then says that the combination is known 1/s times less well than its unknowns alone. A
combination is open when its strength is below `OPEN`, or when its sigma is above `WORST`, more than a calibration
starts with. Below `WEAK` it is reported. What opens in a three-line camera:

- x of all lines against pitch: exact for lines square to the track, whatever the terrain.
- Orbit offsets against bias and interior: broken by relief and by the curvature of the Earth, a thousandth.
- Roll against y of all lines, yaw against y of the outer ones: broken by the turn of the outer lines about their line
  of sight, so weak or correlated, not open.
- Drift of the cameras in each field, unless a monitor tells it: d_alpha, d_beta and d_f of one line in all fields
  against its x, y and f; d_alpha, d_beta and d_gamma of all lines in one field against the bias of that field.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from analysis.orbit.calibration_parameters import CalibrationError, index
from analysis.orbit.three_line_model import BIAS, DRIFT

__all__ = [
    "OPEN",
    "WEAK",
    "WORST",
    "Combination",
    "Gauge",
    "RankError",
    "combinations",
    "free_basis",
    "null_vectors",
    "solved",
]

Array = NDArray[np.float64]
# A camera that is mounted askew by one arc minute lets the pitch be seen at s = 1e-5. That is no knowledge: sixty
# points of 0.3 px know a principal point to 0.04 px, at s = 1e-4 the combination is known to 400 px.
OPEN = 1e-4
WEAK = 3e-2
# Image motion: 15 px of 6.5 um, 32 arcsec, 75 m on the ground, as without any calibration (paper 003: 100 m class).
WORST = 1e-4
_SHOWN = 1e-2
_ANGLES = (*BIAS, *DRIFT[:3])


@dataclass(frozen=True, eq=False)
class Combination:
    """A change of unknowns that (nearly) moves no image point.

    Attributes:
        names, change: the unknowns that take part and their changes, metres and radians, for a largest image motion of
            any single one of 1 mm.
        strength: singular value s of the unit-column system.
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
        minimum_norm: take the smallest total change from the start values, in metres of image motion.
    """

    held: tuple[str, ...] = ()
    minimum_norm: bool = False

    def __str__(self) -> str:
        held = f"held at the start values: {', '.join(self.held)}" if self.held else ""
        norm = "smallest change from the start values, in metres of image motion" if self.minimum_norm else ""
        return "; ".join(t for t in (held, norm) if t) or "none"


class RankError(CalibrationError):
    """The points leave combinations of unknowns open and no gauge closes them.

    open: the combinations. They are also in the message, by name.
    """

    def __init__(self, message: str, open_combinations: Sequence[Combination]) -> None:
        super().__init__(message)
        self.open = tuple(open_combinations)


def null_vectors(reduced: Array, length: Array, scale: Array, *, weak: bool = False) -> Array:
    """Open combinations, or those that are weak without being open.

    Args:
        reduced: (P, P) normal matrix.
        length: (P,) of its columns before the ground points were eliminated.
        scale: (P,) change of each unknown that moves the image by one metre.
        weak: the weak ones instead.

    Returns:
        (P, k) in units of `scale`, in reduced echelon form, so that each names few unknowns; largest entries 1.
    """
    unit = np.where(length > 0, length, 1.0)
    values, vectors = np.linalg.eigh(reduced / unit[:, None] / unit)
    strength = np.sqrt(np.maximum(values, 0.0))
    image = vectors / (unit * scale)[:, None]
    # sigma of a combination with unit coefficients: the image motion that one sigma of the data allows
    sigma = np.abs(image).max(axis=0) / np.maximum(strength, 1e-300)
    is_open = (strength < OPEN) | (sigma > WORST)
    chosen = image[:, (~is_open & (strength < WEAK)) if weak else is_open]
    return _echelon(chosen.T).T if chosen.shape[1] else np.empty((len(unit), 0))


def combinations(
    names: Sequence[str], scale: Array, vectors: Array, reduced: Array, length: Array
) -> tuple[Combination, ...]:
    """Vectors (P, k) in units of `scale` by name: what takes part with a hundredth of the largest motion or more."""
    found = []
    for vector in vectors.T:
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


def free_basis(
    reduced: Array, length: Array, scale: Array, names: Sequence[str], gauge: Gauge | None
) -> tuple[Array, tuple[Combination, ...]]:
    """Directions that may be solved for, (P, R) in units of `scale`, and the open combinations before the gauge.

    Raises:
        RankError: open combinations that the gauge does not close.
        CalibrationError: a held unknown that does not exist.
    """
    opened = combinations(names, scale, null_vectors(reduced, length, scale), reduced, length)
    gauge = gauge or Gauge()
    kept = np.setdiff1d(np.arange(len(names)), [index(names, n) for n in gauge.held]).tolist()
    basis = np.eye(len(names))[:, kept]
    within = reduced[np.ix_(kept, kept)]
    inside = null_vectors(within, length[kept], scale[kept])
    if not inside.shape[1]:
        return basis, opened
    if not gauge.minimum_norm:
        still = combinations([names[i] for i in kept], scale[kept], inside, within, length[kept])
        text = "; ".join(str(c) for c in still)
        raise RankError(
            f"calibration: the points cannot tell: {text}. Gauge: {gauge}. Hold or weight some of these", still
        )
    full = np.linalg.qr(inside, mode="complete")[0]
    return basis @ full[:, inside.shape[1] :], opened


def solved(normal: Array, right: Array) -> Array:
    """Solution of a positive definite system, its unknowns brought to one size first."""
    size = 1.0 / np.sqrt(np.diag(normal))
    factor = cho_factor(size[:, None] * normal * size)
    wide = right.reshape(len(size), -1)
    return np.asarray(size[:, None] * cho_solve(factor, size[:, None] * wide)).reshape(right.shape)


def _echelon(rows: Array) -> Array:
    """Reduced row echelon form (k, P) with full pivoting, each row scaled to a largest entry of one."""
    rows = rows.copy()
    for k in range(len(rows)):
        i, j = divmod(int(np.argmax(np.abs(rows[k:]))), rows.shape[1])
        rows[[k, k + i]] = rows[[k + i, k]]
        rows[k] /= rows[k, j]
        others = np.arange(len(rows)) != k
        rows[others] -= rows[others, j, None] * rows[k]
    return rows / np.abs(rows).max(axis=1, keepdims=True)


def _shown(name: str, change: float) -> str:
    if "offset" in name:
        return f"{name} {change:+.4g} m"
    if name.split()[-1] in _ANGLES:
        return f"{name} {np.degrees(change) * 3600:+.4g} arcsec"
    return f"{name} {change * 1e3:+.4g} mm"
