"""The back-propagation network of paper 004 (section 3.3) as a fit of a curve: one angle in, one hidden layer of tanh,
one value out; trained on standardised points with weight decay, several times from random starts, and averaged.

It has more weights than there are points. The decay makes the solution definite and leaves some 25 effective
parameters. A training that does not converge is left out and counted.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

from analysis.arrays import Array, MeasurementError

Curve = Callable[[Array], Array]

HIDDEN, RESTARTS = 20, 4
DECAY, GAIN = 1e-2, 5.0
"""Weight decay, and the standard deviation to which angles are scaled: steep enough starts for a curve with many turns.
Chosen on simulated turntables, seeds 0 to 3 of a model like that of scenes/lab/turntable.yaml.
"""
FLATTEST = 0.1
"""Least curvature of the network's loss, in units of the decay, that its linearisation believes. Between 0.1 and 1 the
propagated sigma changes by 6% and agrees with the scatter of networks trained on fresh noise.
"""
MOST_ITERATIONS, TOLERANCE = 8000, 1e-4


class NotConvergedError(MeasurementError, RuntimeError):
    """No training of the network came to a minimum."""


def network(x: Array, y: Array, s: Array, seed: int) -> tuple[dict[str, float], Curve, Curve]:
    """Train; points (N,) each, checked by the caller.

    Parameters
    ----------
    x : Array
        angles.
    y : Array
        values.
    s : Array
        Their standard deviations.
    seed : int
        Of the random starts.

    Returns
    -------
    tuple[dict[str, float], Curve, Curve]
        Settings, curve (M,) -> (M,), and its derivative with respect to the values, (M,) -> (M, N).

    Raises
    ------
    NotConvergedError
        No training came to a minimum.
    """
    # a second for the import, and only this fit needs it
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.neural_network import MLPRegressor

    hidden = min(HIDDEN, (len(x) - 1) // 2)
    middle, scale = float(np.mean(x)), GAIN / float(np.std(x))
    mean, spread = float(np.mean(y)), float(np.std(y)) or 1.0
    weight = s**-2 / np.mean(s**-2)
    nets: list[Any] = []
    for state in np.random.SeedSequence(seed).generate_state(RESTARTS):
        net = MLPRegressor(
            hidden_layer_sizes=(hidden,),
            activation="tanh",
            solver="lbfgs",
            alpha=DECAY,
            tol=TOLERANCE,
            max_iter=MOST_ITERATIONS,
            max_fun=2 * MOST_ITERATIONS,
            random_state=int(state),
        )
        with warnings.catch_warnings():
            # a training that stops early is left out, and counted in the settings
            warnings.simplefilter("error", ConvergenceWarning)
            try:
                nets.append(net.fit(scale * (x[:, None] - middle), (y - mean) / spread, sample_weight=weight))
            except ConvergenceWarning:
                continue
    if not nets:
        raise NotConvergedError(
            f"network: none of {RESTARTS} trainings came to a minimum in {MOST_ITERATIONS} iterations; check the "
            "values for gross errors, or take another fit"
        )

    def curve(a: Array) -> Array:
        return mean + spread * np.mean([net.predict(scale * (a[:, None] - middle)) for net in nets], axis=0)

    solves = [response(net, scale * (x - middle), (y - mean) / spread, weight) for net in nets]

    def derivative(a: Array) -> Array:
        at = scale * (a - middle)
        return np.asarray(np.mean([gradient(net, at) @ solve for net, solve in zip(nets, solves, strict=True)], axis=0))

    return {"hidden": hidden, "trainings": RESTARTS, "converged": len(nets)}, curve, derivative


def gradient(net: Any, x: Array) -> Array:
    """Derivative (M, 3 H + 1) of the output c + v . tanh(w x + b), at standardised angles, by (w, b, v, c).

    net: scikit-learn's, with one hidden layer of H; only `coefs_` and `intercepts_` are used.
    """
    w, b, v = net.coefs_[0][0], net.intercepts_[0], net.coefs_[1][:, 0]
    t = np.tanh(np.outer(x, w) + b)
    slope = v * (1.0 - t**2)
    return np.concatenate([slope * x[:, None], slope, t, np.ones((len(x), 1))], axis=-1)


def response(net: Any, x: Array, y: Array, weight: Array) -> Array:
    """Derivative (3 H + 1, N) of the trained weights with respect to the values, by the implicit function theorem at
    the minimum of 1/2 sum weight (net - y)^2 + DECAY/2 (|w|^2 + |v|^2).

    Parameters
    ----------
    net : Any
        Trained, as for `gradient`.
    x : Array
        Inputs of the net, (N,).
    y : Array
        Values that it was trained with, (N,).
    weight : Array
        Of the values, (N,).
    """
    w, b, v, c = net.coefs_[0][0], net.intercepts_[0], net.coefs_[1][:, 0], net.intercepts_[1][0]
    n = len(w)
    t = np.tanh(np.outer(x, w) + b)
    bend = 1.0 - t**2
    jacobian = gradient(net, x)
    residual = weight * (c + t @ v - y)
    hessian = jacobian.T @ (weight[:, None] * jacobian)
    # what the residuals add: second derivatives of the output, within one hidden unit only
    once, twice = residual @ (bend * x[:, None]), residual @ bend
    curved = -2.0 * v * t * bend
    i = np.arange(n)
    for row, column, term in (
        (0, 0, residual @ (curved * x[:, None] ** 2)),
        (0, n, residual @ (curved * x[:, None])),
        (n, n, residual @ curved),
        (0, 2 * n, once),
        (n, 2 * n, twice),
    ):
        hessian[row + i, column + i] += term
        if row != column:
            hessian[column + i, row + i] += term
    hessian[i, i] += DECAY
    hessian[2 * n + i, 2 * n + i] += DECAY
    # Trainings stop a little short of the minimum, where flat directions may still curve the wrong way; none can be
    # flatter than a part of the decay, or the response would be too large by any amount.
    level, direction = np.linalg.eigh(hessian)
    return (direction / np.maximum(level, FLATTEST * DECAY)) @ (direction.T @ (jacobian.T * weight))
