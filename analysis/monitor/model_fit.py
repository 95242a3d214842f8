"""Estimator `model`: weighted least squares on all spot coordinates with the Jacobian of the traced instrument.

The instrument is linear over the small motions that a monitor sees: spot shifts s = A m (px) and changes of the
camera's parameters p = B m, for P motions m. `gain` maps s to the Gauss-Markov estimate of m and on to p. It can tell
apart only the family of motions that it assumes; `observability` says, with numbers, what happens to all others.

Order of spot coordinates: row and column of one spot after the other, [left row, left column, right row, right column]
of a plain pair, px, after - before. Order of parameters:
d_alpha, d_beta, d_gamma (rad), d_f (m).

What of the stated motions no spot shows, whatever reads the spots and however long.

Spots see A x, quantities are B x. Of motions with one law in time, covariance C, the part that moves no spot has the
covariance

    C - C A' (A C A')^+ A C,

and what it does to the quantities is known by nobody who has the spots alone. Motions of different laws may be told
apart by how they go on in time; with each law's share of the spots known apart, the sum over laws of what is left is
the floor that every estimate from the spots has, of every time (`floor`). An eigenvector of the floor is a mode of
quantities, and the likeliest motions that make it are a combination that leaves the spots where they are.
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
# Below this shift of any spot, px per unit of motion, a motion is called invisible; monitors resolve some 1e-3 px.
_INVISIBLE_PX = 1e-5
# Statements leave out what is smaller than this part of the largest component beside it ...
_NEGLIGIBLE = 1e-5
# ... and what is below this, arcsec or um per unit of motion: the rounding of Jacobians taken by differences.
_ROUNDING = 1e-6


class RankError(MeasurementError, ValueError):
    """The spots cannot separate the motions.

    `null_vectors` (K, P): combinations of motions that move no spot.
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
    """Parameters per pixel of shift, (..., 4, D).

    Raises RankError naming the combination of motions that no spot sees; ValueError for bad input.

    Parameters
    ----------
    covariance : ArrayLike
        (..., D, D) px^2, positive definite, or all zero (no noise: equal weights).
    spot_jacobian : ArrayLike
        (D, P) px per unit of motion.
    parameter_jacobian : ArrayLike
        (4, P), rad and m per unit of motion. P from 1 to D.
    motion_names : Sequence[str] | None
        Of the P motions, for messages.
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
    """What the spots and the model make of one unit (scale) of one motion.

    name: of the motion. signature_px: (D,) spot shifts.
    explained: fraction [0, 1] of the signature, weighted by its noise, that the family's motions can imitate.
    imitation: (F,) the amounts of the family's motions (in their units) that the fit puts in its place.
    reported, true: (4,) parameters that the model reports, and the true change; rad and m.
    nearest, cosine: the single family motion (other than itself) with the most similar signature, and their cosine.
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
    """Response of the spots to M motions, and which of the motions are separable.

    Attributes
    ----------
    rank : int
        Of the noise-weighted, unit-scaled signatures of all motions.
    family : tuple[str, ...]
        Names of the P motions that the model fits.
    motions : tuple[MotionReport, ...]
        a report on each.
    statements : tuple[str, ...]
        Plain English that names what cannot be separated.
    """

    rank: int
    family: tuple[str, ...]
    motions: tuple[MotionReport, ...]
    statements: tuple[str, ...]


def observability(
    motion_names: Sequence[str],
    spot_jacobian: ArrayLike,
    parameter_jacobian: ArrayLike,
    scales: ArrayLike,
    covariance: ArrayLike,
    family: Sequence[int],
) -> ObservabilityReport:
    """Which motions are separable.

    Raises RankError if the family itself is degenerate.

    Parameters
    ----------
    motion_names : Sequence[str]
        M names.
    spot_jacobian : ArrayLike
        (D, M), px per SI unit of motion.
    parameter_jacobian : ArrayLike
        (4, M), rad and m per SI unit of motion.
    scales : ArrayLike
        (M,) size of one unit of each motion in SI (1e-6 for one micrometre).
    covariance : ArrayLike
        (D, D) px^2 of the shifts, positive definite.
    family : Sequence[int]
        Indices of the motions that the model fits.
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
    own = [names[k] for k in chosen]
    _check_rank(spots[:, chosen], own)
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
        family=tuple(own),
        motions=tuple(reports),
        statements=tuple(_statements(reports, own, rank, len(spots))),
    )


def _statements(reports: list[MotionReport], family: list[str], rank: int, coordinates: int) -> list[str]:
    """Sentences on the family as a whole, then on each motion that is not reported as what it is."""
    seen = "Four" if coordinates == 4 else str(coordinates)
    lines = [
        f"{seen} spot coordinates see {rank} independent combination{'s' if rank != 1 else ''} of {len(reports)} "
        f"motions; the model fits {len(family)}: {', '.join(family)}."
    ]
    reach = {report.name: float(np.max(np.abs(report.signature_px))) for report in reports}
    for report in reports:
        name = report.name
        if name in family:
            if abs(report.cosine) > 0.99 and report.nearest is not None:
                lines.append(f"{name}: looks almost like {report.nearest} (cosine {report.cosine:+.6f}).")
            continue
        if reach[name] <= _INVISIBLE_PX:
            true = _show(report.true)
            lines.append(
                f"{name}: moves no spot and is invisible; its true change is {true}."
                if true
                else f"{name}: moves no spot and changes no parameter."
            )
            continue
        if report.explained > 1 - 1e-6:
            text = "is not separable from the family"
        else:
            text = f"is {100 * report.explained:.3g}% like the family and leaves a residual"
        amounts = [(float(a), other) for a, other in zip(report.imitation, family, strict=True)]
        shown = [(a, other) for a, other in amounts if abs(a) * reach[other] > _NEGLIGIBLE * reach[name]]
        mix = _sum(sorted(shown, key=lambda item: -abs(item[0]) * reach[item[1]])) or "nothing"
        floor = _NEGLIGIBLE * float(np.max(np.abs(np.concatenate([_table(report.reported), _table(report.true)]))))
        lines.append(
            f"{name}: {text}; one unit moves a spot by {reach[name]:.3g} px and reads as {mix}: the model gives"
            f" {_show(report.reported, floor) or 'no change'}; the true change is "
            f"{_show(report.true, floor) or 'none'}."
        )
    return lines


def _sum(terms: Sequence[tuple[float, str]]) -> str:
    """A sum such as ``-0.755 x one + 0.535 x other``."""
    text = ""
    for amount, name in terms:
        sign = (" - " if amount < 0 else " + ") if text else ("-" if amount < 0 else "")
        text += f"{sign}{abs(amount):.3g} x {name}"
    return text


def _table(values: Array) -> Array:
    """(4,) rad and m in the units of ``_SHOWN``."""
    return values * np.array([factor for _, factor, _ in _SHOWN])


def _show(values: Array, floor: float = 0.0) -> str:
    """The components above ``floor`` (arcsec, um) and above rounding, empty when there is none."""
    return ", ".join(
        f"{name} {value:+.3g}{unit}"
        for value, (name, _, unit) in zip(_table(values), _SHOWN, strict=True)
        if abs(value) > max(floor, _ROUNDING)
    )


def _check_rank(spots: Array, names: Sequence[str] | None) -> None:
    """RankError when the columns of (4, P) are dependent, naming the null vectors in units of the motions."""
    count = spots.shape[1]
    length = np.linalg.norm(spots, axis=0)
    scaled = spots / np.where(length > 0, length, 1.0)
    _, values, vt = np.linalg.svd(scaled, full_matrices=True)
    values = np.pad(values, (0, count - values.size))
    null = vt[values <= _RANK_TOLERANCE * max(values[0], 1e-300)]
    if not null.size:
        return
    labels = list(names) if names is not None else [f"motion {k}" for k in range(count)]
    vectors = null / np.where(length > 0, length, 1.0)
    vectors /= np.abs(vectors).max(axis=1, keepdims=True)
    shown = "; ".join(
        " ".join(f"{v:+.6g} x {label}" for v, label in zip(vector, labels, strict=True) if abs(v) > 1e-12)
        for vector in vectors
    )
    raise RankError(
        f"model fit: the spots cannot separate the motions; this combination moves no spot: {shown}", vectors
    )


def _jacobians(spots: ArrayLike, parameters: ArrayLike, limited: bool = True) -> tuple[Array, Array]:
    one, two = np.asarray(spots, dtype=np.float64), np.asarray(parameters, dtype=np.float64)
    shapes = one.ndim == 2 and two.shape == (4, one.shape[1]) and one.shape[0] > 0
    if not shapes or one.shape[0] % 2 or one.shape[1] < 1:
        raise ValueError(f"model fit: the Jacobians must be (2 n, P) and (4, P), found {one.shape} and {two.shape}")
    if limited and one.shape[1] > one.shape[0]:
        text = f"{one.shape[0]} spot coordinates cannot fix {one.shape[1]} motions; choose at most {one.shape[0]}"
        raise ValueError(f"model fit: {text}")
    if not (np.all(np.isfinite(one)) and np.all(np.isfinite(two))):
        raise ValueError("model fit: Jacobians must be finite")
    return one, two


_NOTHING = 1e-12
"""Of the largest eigenvalue of what a law's motions do to the spots, below which there is rounding alone."""


@shows("sigma", "bodies")
@dataclass(frozen=True, eq=False)
class UnseenMode:
    """Motions that move quantities and no spot.

    Attributes
    ----------
    quantities : Array
        (Q,) what one standard deviation of the mode does, in their units.
    sigma : float
        Root of the sum of its squares over the quantities' scales.
    motions : Array
        (M,) of that standard deviation, in stated standard deviations: the likeliest that make it.
    bodies : Mapping[str, float]
        Body -> share of the mode's variance, the largest first; negative where motions go together.
    spots : float
        Largest of what the motions do to a spot, px: rounding.
    """

    quantities: Array
    sigma: float
    motions: Array
    bodies: Mapping[str, float]
    spots: float


def _hidden(stated: Disturbances) -> Array:
    """(M, M) covariance of the motions that is left where each law's share of the spots is known."""
    out = np.zeros_like(stated.correlation)
    for law in dict.fromkeys(stated.laws):
        own = np.flatnonzero([one == law for one in stated.laws])
        here = np.ix_(own, own)
        prior, spots = stated.correlation[here], stated.spots[:, own]
        scale = np.abs(spots).max(axis=1)
        seen = spots[scale > 0.0] / scale[scale > 0.0, None]
        across = prior @ seen.T
        inverse = np.linalg.pinv(seen @ across, rcond=_NOTHING, hermitian=True) if len(seen) else np.zeros((0, 0))
        out[here] = prior - across @ inverse @ across.T
    return out


def floor(stated: Disturbances, rows: Array) -> Array:
    """(Q, Q) covariance of quantities that no estimate from the spots can have less of.

    Parameters
    ----------
    stated : Disturbances
        What moves.
    rows : Array
        (Q, P) of the quantities on the parameters.
    """
    effect = rows @ stated.parameters
    return np.asarray(effect @ _hidden(stated) @ effect.T)


_LEAST_MODE = 1e-3
"""Share of the first mode's sigma below which a mode is left out."""


def unseen_modes(stated: Disturbances, rows: Array, scale: Array) -> tuple[UnseenMode, ...]:
    """Modes of the floor, the largest first.

    Parameters
    ----------
    stated : Disturbances
        What moves.
    rows : Array
        (Q, P) of the quantities on the parameters.
    scale : Array
        (Q,) of each quantity what counts as much as one of another.
    """
    effect = rows @ stated.parameters
    hidden = _hidden(stated)
    values, vectors = np.linalg.eigh((effect / scale[:, None]) @ hidden @ (effect / scale[:, None]).T)
    out = []
    for k in np.argsort(-values):
        sigma = float(np.sqrt(max(values[k], 0.0)))
        if sigma <= _LEAST_MODE * np.sqrt(max(values.max(), 0.0)):
            break
        row = vectors[:, k] / scale @ effect
        motions = hidden @ row / sigma
        shares = row * motions / sigma
        bodies = {
            body: float(shares[[one == body for one in stated.bodies]].sum()) for body in dict.fromkeys(stated.bodies)
        }
        # an eigenvector has no sign of its own: its largest quantity counts positive
        doing = effect @ motions
        sign = float(np.sign(doing[np.argmax(np.abs(doing / scale))]))
        largest = float(np.abs(stated.spots @ motions).max(initial=0.0))
        ordered = dict(sorted(bodies.items(), key=lambda item: -item[1]))
        out.append(UnseenMode(sign * doing, sigma, sign * motions, ordered, largest))
    return tuple(out)
