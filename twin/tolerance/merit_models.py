"""Second-order models of merits, sensitivities, and inverse limits (tolerance sizes for a specified loss).

Where a camera is at its optimum the first derivative of a merit with respect to a motion vanishes, and the second
derivative determines the loss. So the models describe smooth parts of the merits (such as the MTF at one field) to the
second order, and every sensitivity and every inverse limit is traced exactly.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from scenes.specs.tolerance import OF_MONITOR
from twin.camera.varied_beams import AT_ONCE
from twin.framework.procedure import Advance, silent
from twin.tolerance.tolerance_bench import AdjustedCameras, ToleranceBench

MOST_PAIRED = 600
"""Largest number of varied parameters for which the second-order model has mixed derivatives.

With more parameters the mixed derivatives would not fit in memory.
"""
FARTHEST = 10.0
"""Largest ratio of a tolerance to its limit at which it is traced; its inverse is the smallest."""
_MOST_ITERATIONS = 40
"""Largest number of iterations in the search for the inverse limit of a tolerance."""
_GRID = 241
"""Number of ratios of a tolerance to its limit, in geometric steps, at which the model's loss is evaluated."""
_CLOSE = 1e-4
"""Relative accuracy of the loss of a merit at a computed inverse limit."""
_AT_ONCE = 8_000_000
"""Largest number of array elements that a matrix product holds in memory at a time."""
_MOST_DRAWS, _MOST_WORK = 50_000, 1_500_000_000
"""Largest number of draws of the model for shares of variance, and of products of two numbers that they cost.

With 50 000 draws the standard error of a share is about 0.3 %.
"""
_MOST_VALUES, _FEWEST = 25_000_000, 500
"""Largest number of array elements of a scaled model in memory, and smallest number of draws that it uses."""


@dataclass(frozen=True, eq=False)
class MeritModel:
    """Second-order model of the parts of the merits: parts = nominal + slope x + x curvature x / 2.

    x are the varied parameters in units of their sizes (the limit of a tolerance, the standard deviation of a figure
    term); the compensators are adjusted ideally for each x.

    Array dimensions: P parts of the merits (smooth quantities, such as the MTF at one field), K varied parameters.

    Attributes
    ----------
    nominal : (P,) ndarray
        Parts of the nominal camera, adjusted.
    slope : (P, K) ndarray
        First derivatives of the parts with respect to x.
    curvature : (P, K, K) ndarray
        Second derivatives of the parts with respect to x, symmetric.
    paired : bool
        True if the curvature has mixed terms of two parameters.
    """

    nominal: np.ndarray
    slope: np.ndarray
    curvature: np.ndarray
    paired: bool = True

    def linear(self, x: np.ndarray) -> np.ndarray:
        """Return the parts of the merits (S, P) to the first order, at parameters x (S, K) in units of their sizes.

        Array dimensions: S cameras, P parts of the merits (smooth quantities, such as the MTF at one field), K varied
        parameters.
        """
        return np.asarray(self.nominal + x @ self.slope.T)

    def quadratic(self, x: np.ndarray) -> np.ndarray:
        """Return the parts of the merits (S, P) to the second order, at parameters x (S, K) in units of their sizes.

        Array dimensions: S cameras, P parts of the merits (smooth quantities, such as the MTF at one field), K varied
        parameters.
        """
        step = max(1, _AT_ONCE // max(1, self.curvature.shape[0] * x.shape[1]))
        parts = [
            self.linear(block) + 0.5 * self._second_order(block)
            for block in (x[s : s + step] for s in range(0, len(x), step))
        ]
        return np.concatenate(parts)

    def without(self, x: np.ndarray, entries: Sequence[Sequence[int]]) -> np.ndarray:
        """Return the parts of the merits to the second order with the parameters of one tolerance at zero, (E, S, P).

        Parameters
        ----------
        x : (S, K) ndarray
            K random parameters of S cameras in units of their sizes.
        entries : sequence of sequence of int
            Indices of the parameters of each of E tolerances.
        """
        pulled = (x @ self.curvature).transpose(1, 0, 2) + self.slope
        whole = self.quadratic(x)
        out = []
        for indices in map(list, entries):
            alone, twice = x[:, indices], self.curvature[:, indices][:, :, indices]
            mixed = np.einsum("sk,spk->sp", alone, pulled[:, :, indices])
            out.append(whole - mixed + 0.5 * np.einsum("sk,pkl,sl->sp", alone, twice, alone, optimize=True))
        return np.stack(out)

    def _second_order(self, x: np.ndarray) -> np.ndarray:
        return np.asarray(np.sum((x @ self.curvature).transpose(1, 0, 2) * x[:, None], axis=-1))


@dataclass(frozen=True, eq=False)
class VarianceShares:
    """Fraction of each merit's variance that vanishes without a tolerance, by random draws of the second-order model.

    Array dimensions: E tolerances, M merits.

    Attributes
    ----------
    values : (E, M) ndarray
        The fractions.
    errors : (E, M) ndarray
        Their standard errors.
    """

    values: np.ndarray
    errors: np.ndarray

    @classmethod
    def of(cls, bench: ToleranceBench, model: MeritModel, x: np.ndarray) -> VarianceShares:
        """Evaluate the model at random parameters x (N, K), in units of their sizes, without one tolerance at a time.

        The same draws are used with and without the tolerance, and the errors follow from the scatter over the draws.
        """
        entries = list(bench.entries.values())
        step = max(1, _AT_ONCE // (model.curvature.shape[0] * x.shape[1]))
        blocks = [x[start : start + step] for start in range(0, len(x), step)]
        full = bench.values(model.quadratic(x))
        without = np.concatenate(
            [np.stack([bench.values(parts) for parts in model.without(block, entries)]) for block in blocks], axis=1
        )
        squares, left = (full - full.mean(axis=0)) ** 2, (without - without.mean(axis=1, keepdims=True)) ** 2
        variance = squares.mean(axis=0)
        size = np.where(variance > 0.0, variance, 1.0)
        values = np.where(variance > 0.0, 1.0 - left.mean(axis=1) / size, 0.0)
        errors = np.std(left - (1.0 - values[:, None]) * squares, axis=1) / size / np.sqrt(len(x))
        return cls(np.maximum(values, 0.0), errors)


def model_draws(bench: ToleranceBench, model: MeritModel) -> int:
    """Return the number of random draws of the second-order model from which the shares of variance follow."""
    parts, count = model.slope.shape
    affordable = _MOST_VALUES // max(len(bench.entries) * len(bench.merits), count)
    return int(np.clip(_MOST_WORK // (parts * count**2), _FEWEST, min(_MOST_DRAWS, affordable)))


@dataclass(frozen=True, eq=False)
class ScaledModel:
    """Second-order model of the merits of S fixed random cameras, as a function of a scale factor of each tolerance.

    Array dimensions: P parts of the merits (smooth quantities, such as the MTF at one field), S cameras, E tolerances.

    Attributes
    ----------
    nominal : (P,) ndarray
        Parts of the nominal camera.
    first : (S, P, E) ndarray
        First-order contribution of each tolerance.
    second : (S, P, E, E) ndarray
        Second-order contribution of each pair of tolerances, symmetric, with the factor 1/2.
    """

    nominal: np.ndarray
    first: np.ndarray
    second: np.ndarray

    @classmethod
    def of(cls, model: MeritModel, x: np.ndarray, entries: Sequence[Sequence[int]]) -> ScaledModel:
        """Evaluate the contributions of each tolerance in a model at the random parameters of S cameras.

        Parameters
        ----------
        model : MeritModel
            Model in the varied parameters.
        x : (S, K) ndarray
            K random parameters of each camera in units of their sizes; only as many cameras are used as fit in memory.
        entries : sequence of sequence of int
            Indices of the parameters of each of E tolerances.
        """
        count, parts = len(entries), len(model.nominal)
        draws = x[: max(_FEWEST, _MOST_VALUES // (parts * count**2))]
        first = np.stack([draws[:, indices] @ model.slope[:, indices].T for indices in map(list, entries)], axis=-1)
        second = np.zeros((len(draws), parts, count, count))
        for e, indices in enumerate(map(list, entries)):
            pulled = np.einsum("sk,pkl->spl", draws[:, indices], model.curvature[:, indices], optimize=True)
            for f, other in enumerate(map(list, entries[: e + 1])):
                pair = 0.5 * np.einsum("spl,sl->sp", pulled[:, :, other], draws[:, other])
                second[:, :, e, f] = second[:, :, f, e] = pair
        return cls(model.nominal, first, second)

    def parts(self, scales: np.ndarray) -> np.ndarray:
        """Return the parts of the merits (S, P) with each tolerance multiplied by its entry of ``scales`` (E,).

        Array dimensions: S cameras, P parts of the merits (smooth quantities, such as the MTF at one field), E
        tolerances.
        """
        return np.asarray(self.nominal + (self.first + self.second @ scales) @ scales)

    def slope(self, scales: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Return the derivatives of the parts of the merits with respect to the logarithms of the scales, (W, P, E).

        ``rows`` selects W cameras; P parts of the merits (smooth quantities, such as the MTF at one field), E
        tolerances.
        """
        return np.asarray((self.first[rows] + 2.0 * (self.second[rows] @ scales)) * scales)


@dataclass(frozen=True, eq=False)
class Sensitivities:
    """Merits and compensator moves with each tolerance alone at its limits.

    Array dimensions: M merits, E tolerances, C compensators.

    Attributes
    ----------
    nominal : (M,) ndarray
        Merits of the nominal camera, adjusted, SI units.
    values : (E, 2, M) ndarray
        Merits with each tolerance at its lower and upper limit, SI units; for a figure error the average over its
        random Zernike terms.
    moves : (E, 2, C) ndarray
        Compensator moves with each tolerance at these limits, SI units; NaN for a figure error.
    problems : tuple of str
        Reason why no light reaches the image with a tolerance at its limits, (E,); empty where it does.
    model : MeritModel
        Second-order model of the merits in all varied parameters together.
    """

    nominal: np.ndarray
    values: np.ndarray
    moves: np.ndarray
    problems: tuple[str, ...]
    model: MeritModel


def sensitivities(bench: ToleranceBench, advance: Advance = silent) -> Sensitivities:
    """Trace every varied parameter at plus and minus its size and derive the second-order model of the merits.

    The size is the limit of a tolerance, or the standard deviation of a figure term. Mixed second derivatives follow
    from the first derivatives of the wavefronts.
    """
    count = len(bench.numbers)
    x = np.concatenate([np.zeros((1, count)), np.eye(count), -np.eye(count)])
    done = []
    for start in range(0, len(x), AT_ONCE):
        advance("sensitivities", start, len(x))
        done.append(bench.adjust_cameras(x[start : start + AT_ONCE] * bench.sizes, paths=True))
    advance("sensitivities", len(x), len(x))
    tried = AdjustedCameras.joined(done)
    nominal, plus, minus = tried.parts[0], tried.parts[1 : 1 + count], tried.parts[1 + count :]
    paired = count <= MOST_PAIRED
    curvature = np.zeros((bench.parts, count, count))
    if paired and tried.paths is not None:
        curvature = bench.pair_curvature(0.5 * (tried.paths[1 : 1 + count] - tried.paths[1 + count :]))
    k = np.arange(count)
    curvature[:, k, k] = (plus + minus - 2.0 * nominal).T
    model = MeritModel(nominal, np.nan_to_num(0.5 * (plus - minus).T), np.nan_to_num(curvature), paired)
    values = np.empty((len(bench.entries), 2, len(bench.merits)))
    moves = np.full((len(bench.entries), 2, len(bench.ranges)), np.nan)
    problems = []
    for e, indices in enumerate(bench.entries.values()):
        rows = np.array(indices)
        if len(rows) == 1:
            ends = np.array([1 + count + rows[0], 1 + rows[0]])
            values[e], moves[e] = bench.values(tried.parts[ends]), tried.moves[ends]
        else:
            values[e] = bench.values(_figure_error_parts(bench, model, rows, np.ones(1))[0])
        reasons = [tried.problems[r] for r in (*(1 + rows), *(1 + count + rows))]
        problems.append(next((text for text in reasons if text), ""))
    return Sensitivities(bench.values(nominal), values, moves, tuple(problems), model)


def _figure_error_parts(bench: ToleranceBench, model: MeritModel, rows: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Return the parts of the merits that represent a figure error at L fractions of its limit, (L, P).

    Parts that depend quadratically on the wavefront get their mean over the random Zernike terms, the others their rms.
    P counts the parts (smooth quantities, such as the MTF at one field).

    Parameters
    ----------
    bench : ToleranceBench
        Camera of the budget.
    model : MeritModel
        Second-order model of the merits.
    rows : ndarray
        Indices of the figure error's Zernike terms among the varied parameters.
    share : (L,) ndarray
        Fractions of the limit.
    """
    mean = 0.5 * np.outer(share**2, model.curvature[:, rows, rows].sum(axis=1))
    rms = np.outer(share, np.sqrt(np.sum(model.slope[:, rows] ** 2, axis=1)))
    bends = np.zeros(bench.parts, dtype=bool)
    for merit in bench.merits:
        bends[merit.parts] = merit.spec.kind in ("wavefront", "mtf", *OF_MONITOR)
    return np.asarray(model.nominal + np.where(bends, mean, rms))


@dataclass(frozen=True, eq=False)
class InverseLimits:
    """Inverse limits: size at which each tolerance alone causes each merit's allowed loss.

    Sizes are relative to the tolerance's limit.

    Array dimensions: M merits, E tolerances.

    Attributes
    ----------
    losses : (M,) ndarray
        Allowed loss of each merit, SI units.
    shares : (E, M) ndarray
        Ratios to the limits; infinite where the loss is not reached at ``FARTHEST`` times the limit, NaN where no loss
        is defined.
    """

    losses: np.ndarray
    shares: np.ndarray


def default_losses(bench: ToleranceBench, nominal: np.ndarray) -> np.ndarray:
    """Return the loss by which one tolerance may degrade each of M merits, SI units, (M,).

    The loss is the one specified in the file, or else the margin between the nominal camera and the requirement divided
    by the square root of the number of tolerances; NaN where there is no margin.
    """
    share = 1.0 / np.sqrt(len(bench.entries))
    out = []
    for merit, value in zip(bench.merits, nominal, strict=True):
        margin = float(merit.worse(np.array(merit.spec.requirement), value))
        specified = merit.spec.loss_si
        out.append(specified if specified is not None else margin * share if margin > 0.0 else np.nan)
    return np.array(out)


def inverse_limits(bench: ToleranceBench, sensitivity: Sensitivities, advance: Advance = silent) -> InverseLimits:
    """Find the size of each tolerance that alone causes each merit's allowed loss, by exact traces of both signs.

    For figure errors the second-order model is used instead of traces.
    """
    losses = default_losses(bench, sensitivity.nominal)
    entries = list(bench.entries.values())
    guess = np.array(
        [[_model_ratio(bench, sensitivity, indices, m, losses) for m in range(len(losses))] for indices in entries]
    )
    undetermined = [
        (e, m) for e, indices in enumerate(entries) for m in range(len(losses)) if len(indices) == 1 and losses[m] > 0.0
    ]
    shares = guess.copy()
    if undetermined:
        pairs = np.array(undetermined)

        def excess(rows: np.ndarray, level: np.ndarray) -> np.ndarray:
            """Return the logarithm of the larger loss of both signs over the allowed one, at ratios exp(level)."""
            indices, m = np.array([entries[e][0] for e in pairs[rows, 0]]), pairs[rows, 1]
            x = np.zeros((2, len(rows), len(bench.numbers)))
            x[0, np.arange(len(rows)), indices], x[1, np.arange(len(rows)), indices] = np.exp(level), -np.exp(level)
            values = bench.values(bench.adjust_cameras(x.reshape(-1, x.shape[-1]) * bench.sizes).parts).reshape(
                2, len(rows), -1
            )
            worst = np.max([_loss(bench, sensitivity, values[:, k, j], j) for k, j in enumerate(m)], axis=1)
            return np.asarray(np.log(np.maximum(worst / losses[m], 1e-12)))

        start = np.log(np.clip(guess[pairs[:, 0], pairs[:, 1]], FARTHEST**-2, FARTHEST))
        shares[pairs[:, 0], pairs[:, 1]] = np.exp(_roots(excess, start, advance))
    return InverseLimits(losses, shares)


def _loss(bench: ToleranceBench, sensitivity: Sensitivities, values: np.ndarray, m: int) -> np.ndarray:
    """Return by how much values of merit number ``m`` are worse than the nominal camera's, SI units.

    The loss is infinite where the light is lost.
    """
    loss = bench.merits[m].worse(values, sensitivity.nominal[m])
    return np.asarray(np.where(np.isnan(loss), np.inf, loss))


def _model_ratio(
    bench: ToleranceBench, sensitivity: Sensitivities, indices: Sequence[int], m: int, losses: np.ndarray
) -> float:
    """Return the ratio to its limit at which a tolerance causes a merit's loss in the model, at most ``FARTHEST``.

    The result is infinite if the loss is not reached.
    """
    if not losses[m] > 0.0:
        return np.nan
    share = np.geomspace(FARTHEST**-2, FARTHEST, _GRID)
    model, rows = sensitivity.model, np.array(indices)
    if len(rows) > 1:
        parts = [_figure_error_parts(bench, model, rows, share)]
    else:
        bent = model.nominal + 0.5 * np.outer(share**2, model.curvature[:, rows[0], rows[0]])
        parts = [bent + np.outer(sign * share, model.slope[:, rows[0]]) for sign in (1.0, -1.0)]
    loss = np.max([_loss(bench, sensitivity, bench.merits[m].values(part), m) for part in parts], axis=0)
    beyond = np.flatnonzero(loss >= losses[m])
    return float(share[beyond[0]]) if beyond.size else np.inf


def _roots(excess: Callable[[np.ndarray, np.ndarray], np.ndarray], start: np.ndarray, advance: Advance) -> np.ndarray:
    """Find the zeros of R increasing functions from individual starting levels; infinite beyond ``FARTHEST``.

    Steps grow threefold until two levels bracket the zero; then the method of false position (Illinois variant)
    converges.

    Parameters
    ----------
    excess : callable
        Takes indices of the functions and one level (logarithm of a ratio to a limit) for each; returns their values.
    start : (R,) ndarray
        Starting levels.
    advance : Advance
        Callback that reports progress.
    """
    count = len(start)
    low, high = np.full(count, -np.inf), np.full(count, np.inf)
    below, above = np.full(count, np.nan), np.full(count, np.nan)
    side, step, out = np.zeros(count), np.full(count, 0.05), np.full(count, np.nan)
    level = start.copy()
    top, bottom = np.log(FARTHEST), -2.0 * np.log(FARTHEST)
    for _ in range(_MOST_ITERATIONS):
        advance("limits for a loss", count - int(np.isnan(out).sum()), count)
        rows = np.flatnonzero(np.isnan(out))
        if not rows.size:
            break
        values = np.clip(excess(rows, level[rows]), -60.0, 60.0)
        for r, value in zip(rows, values, strict=True):
            under = value < 0.0
            if abs(value) < _CLOSE:
                out[r] = level[r]
            elif under and level[r] >= top:
                out[r] = np.inf
            elif not under and level[r] <= bottom:
                out[r] = bottom
            elif under:
                above[r] *= 0.5 if side[r] < 0.0 else 1.0
                low[r], below[r], side[r] = level[r], value, -1.0
            else:
                below[r] *= 0.5 if side[r] > 0.0 else 1.0
                high[r], above[r], side[r] = level[r], value, 1.0
            if np.isfinite(low[r]) and np.isfinite(high[r]):
                level[r] = low[r] - below[r] * (high[r] - low[r]) / (above[r] - below[r])
                if high[r] - low[r] < _CLOSE:
                    out[r] = level[r]
            else:
                level[r] = min(top, low[r] + step[r]) if under else max(bottom, high[r] - step[r])
                step[r] *= 3.0
    advance("limits for a loss", count, count)
    return np.where(np.isnan(out), level, out)
