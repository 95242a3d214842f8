"""Functions of a factor that are orthonormal under the distribution it was drawn from."""

from __future__ import annotations

import math

import numpy as np
from scipy.special import roots_legendre

from twin.study.report.study_runs import Factor

MOST_LEVELS = 20
"""Texts with more values are not taken apart."""


class NoBasis(Exception):
    """A factor for which no functions can be made; the text says why."""


def axis_functions(axis: tuple[Factor, ...], good: np.ndarray, degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Functions 1, 2, ... of the factors of an axis at the runs: values (n, m) and degrees (m,).

    Each has mean 0 and mean square 1 under the axis' distribution, and the mean product of two is 0: of a uniform
    factor Legendre's polynomials, of a normal one Hermite's, of others, lists and texts those that Gram and Schmidt's
    method makes on the distribution itself. All functions of a text have degree 1.

    Args:
        axis: factors that vary together.
        good: (runs,) which runs are used.
        degree: the highest.

    Raises:
        NoBasis: the axis has too many different texts.
    """
    if len(axis) == 1 and axis[0].numeric:
        return _of_number(axis[0], axis[0].values[good], degree)
    rows = np.stack([np.unique(factor.values, return_inverse=True)[1] for factor in axis], axis=1)
    levels, inverse, counts = np.unique(rows, axis=0, return_inverse=True, return_counts=True)
    if all(factor.numeric for factor in axis):
        # a table of numbers: all its rows are equally likely, also those that no run took
        table = np.stack([np.array(factor.spec.numbers().values, np.float64) for factor in axis], axis=1)
        return _of_table(table, np.stack([factor.values[good] for factor in axis], axis=1), degree)
    if len(levels) > MOST_LEVELS:
        raise NoBasis(f"{axis[0].name} has {len(levels)} different values")
    weights = _text_weights(axis, levels, counts)
    # switches of all levels but the first, made orthonormal
    functions = _orthonormal(np.concatenate([np.ones((len(levels), 1)), np.eye(len(levels))[:, 1:]], axis=1), weights)
    return functions[inverse.ravel()[good], 1:], np.ones(functions.shape[1] - 1, int)


def _text_weights(axis: tuple[Factor, ...], levels: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Probability of every level: of a list by how often it holds it, of a table's rows as they were drawn."""
    if len(axis) == 1:
        listed = [_text(value) for value in axis[0].spec.scalars()]
        names = [str(value) for value in np.unique(axis[0].values)[levels[:, 0]]]
        found = np.array([listed.count(name) for name in names], np.float64)
        if np.all(found > 0):
            return np.asarray(found / found.sum())
    return np.asarray(counts / counts.sum())


def _text(value: object) -> str:
    return ("yes" if value else "no") if isinstance(value, bool) else str(value)


def _of_number(factor: Factor, values: np.ndarray, degree: int) -> tuple[np.ndarray, np.ndarray]:
    numbers: tuple[float, ...] = factor.spec.numbers().values
    kind = factor.spec.kind
    orders = np.arange(1, degree + 1)
    if kind in ("range", "uniform"):
        x = (2.0 * values - numbers[0] - numbers[1]) / (numbers[1] - numbers[0])
        vander = np.polynomial.legendre.legvander(x, degree)[:, 1:]
        return vander * np.sqrt(2.0 * orders + 1.0), orders
    if kind == "normal":
        x = (values - numbers[0]) / numbers[1]
        scale = np.array([1.0 / math.sqrt(math.factorial(k)) for k in orders])
        return np.polynomial.hermite_e.hermevander(x, degree)[:, 1:] * scale, orders
    if kind == "truncated":
        mean, sigma, low, high = numbers
        low, high = max(low, mean - 10.0 * sigma), min(high, mean + 10.0 * sigma)
        nodes, weights = roots_legendre(200)
        places = 0.5 * (low + high) + 0.5 * (high - low) * nodes
        z = (places - mean) / sigma
        weights = weights * np.exp(-0.5 * (z**2 - np.min(z**2)))
        return _by_recurrence(places, weights / weights.sum(), values, degree)
    listed = np.array(numbers, np.float64)
    return _by_recurrence(listed, np.full(len(listed), 1.0 / len(listed)), values, degree)


def _by_recurrence(
    places: np.ndarray, weights: np.ndarray, values: np.ndarray, degree: int
) -> tuple[np.ndarray, np.ndarray]:
    """Orthonormal polynomials of a discrete measure at ``values``, by Stieltjes' recurrence."""
    middle, reach = 0.5 * (places.max() + places.min()), 0.5 * np.ptp(places)
    if reach == 0.0:
        return np.empty((len(values), 0)), np.empty(0, int)
    nodes, x = (places - middle) / reach, (values - middle) / reach
    most = min(degree, len(np.unique(nodes)) - 1)
    before, now = np.zeros(len(nodes)), np.ones(len(nodes))
    before_x, now_x = np.zeros(len(x)), np.ones(len(x))
    beta = 0.0
    out = []
    for _ in range(most):
        alpha = np.sum(weights * nodes * now**2)
        following = (nodes - alpha) * now - beta * before
        following_x = (x - alpha) * now_x - beta * before_x
        beta = math.sqrt(np.sum(weights * following**2))
        before, before_x = now, now_x
        now, now_x = following / beta, following_x / beta
        out.append(now_x)
    return np.stack(out, axis=1), np.arange(1, most + 1)


def _of_table(table: np.ndarray, values: np.ndarray, degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Polynomials of several columns that belong together, orthonormal over the rows of the table."""
    middle, reach = table.mean(axis=0), np.maximum(np.ptp(table, axis=0), np.finfo(float).tiny)
    nodes, x = (table - middle) / reach, (values - middle) / reach
    powers = [p for p in np.ndindex(*[degree + 1] * table.shape[1]) if 0 < sum(p) <= degree]
    powers.sort(key=sum)
    kept, degrees = [np.ones(len(nodes))], [0]
    kept_x = [np.ones(len(x))]
    for power in powers:
        if len(kept) >= min(len(np.unique(nodes, axis=0)), 40):
            break
        f, f_x = np.prod(nodes**power, axis=1), np.prod(x**power, axis=1)
        size = math.sqrt(np.mean(f**2))
        for _ in range(2):  # twice is enough for orthogonality to rounding
            for g, g_x in zip(kept, kept_x, strict=True):
                part = np.mean(f * g)
                f, f_x = f - part * g, f_x - part * g_x
        norm = math.sqrt(np.mean(f**2))
        if norm > 1e-8 * size:
            kept.append(f / norm)
            kept_x.append(f_x / norm)
            degrees.append(sum(power))
    return np.stack(kept_x, axis=1)[:, 1:], np.array(degrees[1:], int)


def _orthonormal(columns: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Columns made orthonormal under the weights, the first one 1."""
    root = np.sqrt(weights)[:, None]
    q, r = np.linalg.qr(columns * root)
    return np.asarray(q * np.sign(np.diag(r)) / root)
