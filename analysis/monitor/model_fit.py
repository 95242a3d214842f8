"""Estimator `model`: weighted least squares on all spot coordinates with the Jacobian of the traced instrument.

The instrument is linear over the small motions of a monitor: spot shifts s = A m (px) and changes of the camera's
parameters p = B m, with the amounts m of P motions. `gain` maps s to the Gauss-Markov estimate of m and on to p. It can
separate only the family of motions that it assumes; `observability` reports quantitatively how it misreads all others.

Order of spot coordinates: row and column of one spot after the other, [left row, left column, right row, right column]
of a plain pair, px, after - before. Order of parameters: d_alpha, d_beta, d_gamma (rad), d_f (m).

**Unobservable modes.** Motions of the prior that move no spot cannot be estimated from the spots, however long they are
measured. Spots see A x, quantities are B x. Of motions with one law in time and covariance C, the part that moves no
spot has the covariance

    C - C A' (A C A')^+ A C,

and its effect on the quantities is unobservable. Motions of different laws may be separated by their behaviour in time;
with each law's share of the spots known separately, the sum over laws of the rest is a lower bound of the error
covariance of every estimate from the spots, at every time (`error_floor`). An eigenvector of this floor is a mode of
quantities, and the most likely motions that cause it are a combination that leaves the spots unchanged.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from analysis import statistics
from analysis.arrays import ARCSEC, UM_PER_M, Array, MeasurementError, UndeterminedError, shows
from analysis.monitor.disturbances import Disturbances

_SHOWN = (
    ("d_alpha", 1 / ARCSEC, '"'),
    ("d_beta", 1 / ARCSEC, '"'),
    ("d_gamma", 1 / ARCSEC, '"'),
    ("d_f", UM_PER_M, " um"),
)
# Least ratio of singular values of a spot Jacobian with its columns scaled to length one.
_RANK_TOLERANCE = 1e-8
# Shift of any spot, px per unit of motion, below which a motion is called invisible; monitors resolve some 1e-3 px.
_INVISIBLE_PX = 1e-5
# Statements omit components that are smaller than this fraction of the largest component beside them ...
_NEGLIGIBLE = 1e-5
# ... and those below this, arcsec or um per unit of motion: the rounding of Jacobians by differences.
_ROUNDING = 1e-6


class RankError(MeasurementError, ValueError):
    """Error raised when the spots cannot separate the motions.

    Dimensions: K combinations, P motions that are fitted.

    Attributes
    ----------
    null_vectors : (K, P) ndarray
        Combinations of motions that move no spot.
    """

    def __init__(self, message: str, null_vectors: Array) -> None:
        super().__init__(message)
        self.null_vectors = null_vectors


def gain(
    covariance: ArrayLike,
    spot_jacobian: ArrayLike,
    parameter_jacobian: ArrayLike,
    motion_names: Sequence[str] | None = None,
) -> Array:
    """Return the weighted least-squares matrix from spot shifts to camera parameters, (..., 4, D) rad and m per px.

    Dimensions: D spot coordinates (row and column of every spot).

    Parameters
    ----------
    covariance : (..., D, D) array_like
        Covariance of the shifts, px^2, positive definite, or all zero (no noise: equal weights).
    spot_jacobian : (D, P) array_like
        Shifts in px per unit of motion.
    parameter_jacobian : (4, P) array_like
        Parameters in rad and m per unit of motion; P from 1 to D.
    motion_names : sequence of str or None
        Names of the P motions, for messages.

    Raises
    ------
    RankError
        The spots cannot separate the motions; the message names the combination that moves no spot.
    ValueError
        Shapes or values are invalid.
    """
    spread = np.asarray(covariance, dtype=np.float64)
    spots, parameters = _jacobians(spot_jacobian, parameter_jacobian)
    if spread.shape[-2:] != (len(spots), len(spots)) or not np.all(np.isfinite(spread)):
        raise ValueError(
            f"model fit: covariance must be (..., {len(spots)}, {len(spots)}) and finite, found {spread.shape}"
        )
    _check_rank(spots, motion_names)
    noiseless = not np.any(spread)
    try:
        # whitening: solve(L, x) has unit covariance
        root = np.linalg.cholesky(np.eye(len(spots)) if noiseless else spread)
    except np.linalg.LinAlgError as error:
        raise UndeterminedError("model fit: covariance of the shifts is not positive definite") from error
    return np.asarray(parameters @ statistics.gain(spots, root, _RANK_TOLERANCE * 1e-3))


@dataclass(frozen=True, eq=False)
class MotionReport:
    """Response of the spots and of the `model` estimator to one unit of one motion.

    Dimensions: D spot coordinates (row and column of every spot), F motions that the model fits.

    Attributes
    ----------
    name : str
        Name of the motion.
    signature_px : (D,) ndarray
        Spot shifts due to one unit of the motion (its signature), px.
    explained : float
        Fraction, 0 to 1, of the square of the signature, weighted by the noise, that the fitted motions can reproduce.
    imitation : (F,) ndarray
        Amounts of the fitted motions, in their units, that the fit gives for this motion.
    reported, true : (4,) ndarray
        Parameters that the model reports, and the true change; rad and m.
    nearest, cosine : str or None, float
        Other fitted motion with the most similar signature, and the cosine of the angle between both signatures.
    """

    name: str
    signature_px: Array
    explained: float
    imitation: Array
    reported: Array
    true: Array
    nearest: str | None
    cosine: float


@dataclass(frozen=True, eq=False)
class ObservabilityReport:
    """Response of the spots to M motions, and separability of these motions.

    Attributes
    ----------
    rank : int
        Rank of the matrix of the spot shifts due to one unit of each motion, weighted by the noise.
    family : tuple of str
        Names of the P motions that the model fits.
    motions : tuple of MotionReport
        Report on each motion.
    sentences : tuple of str
        Sentences that name the motions that cannot be separated.
    """

    rank: int
    family: tuple[str, ...]
    motions: tuple[MotionReport, ...]
    sentences: tuple[str, ...]


def observability(
    motion_names: Sequence[str],
    spot_jacobian: ArrayLike,
    parameter_jacobian: ArrayLike,
    scales: ArrayLike,
    covariance: ArrayLike,
    family: Sequence[int],
) -> ObservabilityReport:
    """Report which motions the spots can separate.

    Dimensions: D spot coordinates (row and column of every spot).

    Parameters
    ----------
    motion_names : sequence of str
        Names of the M motions.
    spot_jacobian : (D, M) array_like
        Shifts in px per SI unit of motion.
    parameter_jacobian : (4, M) array_like
        Parameters in rad and m per SI unit of motion.
    scales : (M,) array_like
        Size of one unit of each motion in SI (1e-6 for one micrometre).
    covariance : (D, D) array_like
        Covariance of the shifts, px^2, positive definite.
    family : sequence of int
        Indices of the motions that the model fits.

    Raises
    ------
    RankError
        The spots cannot separate the motions that the model fits.
    """
    spots, parameters = _jacobians(spot_jacobian, parameter_jacobian, limited=False)
    names, size = tuple(motion_names), np.asarray(scales, dtype=np.float64)
    count = spots.shape[1]
    chosen = [int(k) for k in family]
    if len(names) != count or size.shape != (count,) or not np.all(size > 0):
        raise ValueError(f"observability: {count} motions need {count} names and positive scales")
    if not 1 <= len(set(chosen)) == len(chosen) <= len(spots) or not all(0 <= k < count for k in chosen):
        allowed = f"1 to {len(spots)} different indices below {count}"
        raise ValueError(f"observability: family must be {allowed}, found {chosen}")
    try:
        root = np.linalg.cholesky(np.asarray(covariance, dtype=np.float64))
    except np.linalg.LinAlgError as error:
        raise UndeterminedError("observability: covariance of the shifts is not positive definite") from error
    spots, parameters = spots * size, parameters * size
    family_names = [names[k] for k in chosen]
    _check_rank(spots[:, chosen], family_names)
    white = np.linalg.solve(root, spots)
    members = white[:, chosen]
    length = np.linalg.norm(white, axis=0)
    inverse = statistics.gain(members)
    reports = []
    for k, name in enumerate(names):
        visible = float(np.max(np.abs(spots[:, k]))) > _INVISIBLE_PX
        imitation = inverse @ white[:, k]
        left = np.linalg.norm(white[:, k] - members @ imitation) / length[k] if visible else 0.0
        others = [j for j in chosen if j != k]
        cosines = [float(white[:, k] @ white[:, j] / (length[k] * length[j])) if visible else 0.0 for j in others]
        best = int(np.argmax(np.abs(cosines))) if cosines else -1
        reports.append(
            MotionReport(
                name=name,
                signature_px=spots[:, k],
                explained=float(1 - left**2) if visible else 0.0,
                imitation=imitation,
                reported=parameters[:, chosen] @ imitation,
                true=parameters[:, k],
                nearest=names[others[best]] if visible and best >= 0 else None,
                cosine=cosines[best] if best >= 0 else 0.0,
            )
        )
    values = np.linalg.svd(white, compute_uv=False)
    rank = int(np.sum(values > _RANK_TOLERANCE * values[0]))
    return ObservabilityReport(
        rank=rank,
        family=tuple(family_names),
        motions=tuple(reports),
        sentences=tuple(_sentences(reports, family_names, rank, len(spots))),
    )


def _sentences(reports: list[MotionReport], family: list[str], rank: int, coordinates: int) -> list[str]:
    """Return sentences on what the spots can separate: all fitted motions together, then each misreported motion."""
    seen = "Four" if coordinates == 4 else str(coordinates)
    lines = [
        f"{seen} spot coordinates observe {rank} independent combination{'s' if rank != 1 else ''} of {len(reports)} "
        f"motions; the model fits {len(family)}: {', '.join(family)}."
    ]
    largest_shift = {report.name: float(np.max(np.abs(report.signature_px))) for report in reports}
    for report in reports:
        name = report.name
        if name in family:
            if abs(report.cosine) > 0.99 and report.nearest is not None:
                lines.append(f"{name}: looks almost like {report.nearest} (cosine {report.cosine:+.6f}).")
            continue
        if largest_shift[name] <= _INVISIBLE_PX:
            true = _show(report.true)
            what = f"is invisible; its true change is {true}" if true else "changes no parameter"
            lines.append(f"{name}: moves no spot and {what}.")
            continue
        text = f"is explained to {100 * report.explained:.3g}% by the family and leaves a residual"
        if report.explained > 1 - 1e-6:
            text = "is not separable from the family"
        amounts = [(float(a), other) for a, other in zip(report.imitation, family, strict=True)]
        least = _NEGLIGIBLE * largest_shift[name]
        shown = [(a, other) for a, other in amounts if abs(a) * largest_shift[other] > least]
        mix = _sum(sorted(shown, key=lambda item: -abs(item[0]) * largest_shift[item[1]])) or "nothing"
        smallest = _NEGLIGIBLE * float(np.max(np.abs(np.concatenate([_table(report.reported), _table(report.true)]))))
        lines.append(
            f"{name}: {text}; one unit moves a spot by {largest_shift[name]:.3g} px and reads as {mix}: the model gives"
            f" {_show(report.reported, smallest) or 'no change'}; the true change is "
            f"{_show(report.true, smallest) or 'none'}."
        )
    return lines


def _sum(terms: Sequence[tuple[float, str]]) -> str:
    """Return a linear combination as text, such as ``-0.755 x one + 0.535 x other``."""
    text = ""
    for amount, name in terms:
        sign = (" - " if amount < 0 else " + ") if text else ("-" if amount < 0 else "")
        text += f"{sign}{abs(amount):.3g} x {name}"
    return text


def _table(values: Array) -> Array:
    """Return four parameters in rad and m, (4,), converted to the units in which they are shown (arcsec, um)."""
    return values * np.array([factor for _, factor, _ in _SHOWN])


def _show(values: Array, smallest: float = 0.0) -> str:
    """Return as text those of four parameters that exceed ``smallest`` (arcsec, um) and rounding, empty if none."""
    return ", ".join(
        f"{name} {value:+.3g}{unit}"
        for value, (name, _, unit) in zip(_table(values), _SHOWN, strict=True)
        if abs(value) > max(smallest, _ROUNDING)
    )


def _check_rank(spots: Array, names: Sequence[str] | None) -> None:
    """Raise RankError if the columns of the spot Jacobian are dependent, with the null vectors."""
    labels = list(names) if names is not None else [f"motion {k}" for k in range(spots.shape[1])]
    null, text = statistics.null_combinations(spots, labels, _RANK_TOLERANCE, 1e-12)
    if len(null):
        raise RankError(
            f"model fit: the spots cannot separate the motions; this combination moves no spot: {text}", null
        )


def _jacobians(spots: ArrayLike, parameters: ArrayLike, limited: bool = True) -> tuple[Array, Array]:
    first, second = np.asarray(spots, dtype=np.float64), np.asarray(parameters, dtype=np.float64)
    shapes = first.ndim == 2 and second.shape == (4, first.shape[1]) and first.shape[0] > 0
    if not shapes or first.shape[0] % 2 or first.shape[1] < 1:
        raise ValueError(
            f"model fit: the Jacobians must be (2 n, P) and (4, P), found {first.shape} and {second.shape}"
        )
    if limited and first.shape[1] > first.shape[0]:
        text = f"{first.shape[0]} spot coordinates cannot fix {first.shape[1]} motions; choose at most {first.shape[0]}"
        raise ValueError(f"model fit: {text}")
    if not (np.all(np.isfinite(first)) and np.all(np.isfinite(second))):
        raise ValueError("model fit: Jacobians must be finite")
    return first, second


_NOTHING = 1e-12
"""Eigenvalue of the spots' covariance due to one law's motions, relative to the largest, that is only rounding."""


@shows("sigma", "bodies")
@dataclass(frozen=True, eq=False)
class UnobservableMode:
    """Motions that change quantities (camera parameters or combinations of them) but move no spot.

    Dimensions: Q quantities, M motions.

    Attributes
    ----------
    quantities : (Q,) ndarray
        Effect of one standard deviation of the mode, in the quantities' units.
    sigma : float
        Root of the sum of the squares of `quantities`, each divided by the scale given to `unobservable_modes`.
    motions : (M,) ndarray
        Most likely motions that cause it, in prior standard deviations.
    bodies : mapping of str to float
        Share of each body in the mode's variance, the largest first; negative where motions are correlated.
    spots : float
        Largest spot shift due to the motions, px; only rounding makes it differ from 0.
    """

    quantities: Array
    sigma: float
    motions: Array
    bodies: Mapping[str, float]
    spots: float


def _unobservable(disturbances: Disturbances) -> Array:
    """Return the covariance of the motions that remains if the spot shifts due to each time law were known, (M, M).

    Dimensions: M motions.
    """
    out = np.zeros_like(disturbances.correlation)
    for law in dict.fromkeys(disturbances.laws):
        indices = np.flatnonzero([other == law for other in disturbances.laws])
        block = np.ix_(indices, indices)
        prior, spots = disturbances.correlation[block], disturbances.spots[:, indices]
        scale = np.abs(spots).max(axis=1)
        seen = spots[scale > 0.0] / scale[scale > 0.0, None]
        across = prior @ seen.T
        inverse = np.linalg.pinv(seen @ across, rcond=_NOTHING, hermitian=True) if len(seen) else np.zeros((0, 0))
        out[block] = prior - across @ inverse @ across.T
    return out


def error_floor(disturbances: Disturbances, rows: Array) -> Array:
    """Return the lower bound of the error covariance of quantities for every estimate from the spots, (Q, Q).

    Dimensions: Q quantities, P parameters.

    Parameters
    ----------
    disturbances : Disturbances
        Prior of the disturbances (motions of bodies), with their effects on spots and parameters.
    rows : (Q, P) ndarray
        Coefficients of the quantities on the parameters.
    """
    effect = rows @ disturbances.parameters
    return np.asarray(effect @ _unobservable(disturbances) @ effect.T)


_LEAST_MODE = 1e-3
"""Ratio of a mode's sigma to that of the first mode below which the mode is not reported."""


def unobservable_modes(disturbances: Disturbances, rows: Array, scale: Array) -> tuple[UnobservableMode, ...]:
    """Return the changes of quantities that no measurement of the spots reveals, the largest first.

    Dimensions: Q quantities, P parameters.

    Parameters
    ----------
    disturbances : Disturbances
        Prior of the disturbances (motions of bodies), with their effects on spots and parameters.
    rows : (Q, P) ndarray
        Coefficients of the quantities on the parameters.
    scale : (Q,) ndarray
        Scale of each quantity, in which they are compared.
    """
    effect = rows @ disturbances.parameters
    unobservable = _unobservable(disturbances)
    values, vectors = np.linalg.eigh((effect / scale[:, None]) @ unobservable @ (effect / scale[:, None]).T)
    out = []
    for k in np.argsort(-values):
        sigma = float(np.sqrt(max(values[k], 0.0)))
        if sigma <= _LEAST_MODE * np.sqrt(max(values.max(), 0.0)):
            break
        row = vectors[:, k] / scale @ effect
        motions = unobservable @ row / sigma
        shares = row * motions / sigma
        bodies = {
            body: float(shares[[other == body for other in disturbances.bodies]].sum())
            for body in dict.fromkeys(disturbances.bodies)
        }
        # the sign of an eigenvector is arbitrary: its largest quantity is made positive
        doing = effect @ motions
        sign = float(np.sign(doing[np.argmax(np.abs(doing / scale))]))
        largest = float(np.abs(disturbances.spots @ motions).max(initial=0.0))
        ordered = dict(sorted(bodies.items(), key=lambda item: -item[1]))
        out.append(UnobservableMode(sign * doing, sigma, sign * motions, ordered, largest))
    return tuple(out)
