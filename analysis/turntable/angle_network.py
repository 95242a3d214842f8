"""Back-propagation network of paper 004 (Li et al. 2020, section 3.3) as a fit with one hidden layer of tanh.

One angle goes in, one value comes out.

It is trained on standardised points with weight decay, several times from random starts, and averaged. It has more
weights than there are points; the decay makes the solution unique and leaves some 25 effective parameters. A
training that does not converge is excluded and counted.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

from analysis.arrays import Array, MeasurementError

Curve = Callable[[Array], Array]

NEURONS, RESTARTS = 20, 4
DECAY, GAIN = 1e-2, 5.0
"""Weight decay of the network, and standard deviation to which its input angles are scaled.

The scale makes the network's initial curves steep enough for an error with many turns. Both were chosen on simulated
turntables, seeds 0 to 3 of a model like that of scenes/lab/turntable.yaml.
"""
FLATTEST = 0.1
"""Smallest curvature of the network's loss, in units of the decay, that its linearisation uses. Between 0.1 and 1 the
propagated sigma changes by 6 % and agrees with the scatter of networks trained on fresh noise.
"""
MOST_ITERATIONS, TOLERANCE = 8000, 1e-4


class NotConvergedError(MeasurementError, RuntimeError):
    """Error raised if no training of the network converged."""


def network(x: Array, y: Array, s: Array, seed: int) -> tuple[dict[str, float], Curve, Curve]:
    """Train the network on N points that the caller has validated.

    Parameters
    ----------
    x : (N,) ndarray
        Angles, in radians.
    y : (N,) ndarray
        Values.
    s : (N,) ndarray
        Standard deviations of the values.
    seed : int
        Seed of the random starts.

    Returns
    -------
    tuple of (dict of str to float, callable, callable)
        Settings of the training; function from M angles to values of the curve, (M,); function from M angles to the
        derivatives of the curve with respect to the N training values, (M, N).

    Raises
    ------
    NotConvergedError
        No training converged.
    """
    # imported here because the import takes a second and only this fit needs it
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.neural_network import MLPRegressor

    neurons = min(NEURONS, (len(x) - 1) // 2)
    middle, scale = float(np.mean(x)), GAIN / float(np.std(x))
    mean, scale_of_values = float(np.mean(y)), float(np.std(y)) or 1.0
    weight = s**-2 / np.mean(s**-2)
    nets: list[Any] = []
    for state in np.random.SeedSequence(seed).generate_state(RESTARTS):
        net = MLPRegressor(
            hidden_layer_sizes=(neurons,),
            activation="tanh",
            solver="lbfgs",
            alpha=DECAY,
            tol=TOLERANCE,
            max_iter=MOST_ITERATIONS,
            max_fun=2 * MOST_ITERATIONS,
            random_state=int(state),
        )
        with warnings.catch_warnings():
            # a training that does not converge is excluded, and counted in the settings
            warnings.simplefilter("error", ConvergenceWarning)
            try:
                nets.append(net.fit(scale * (x[:, None] - middle), (y - mean) / scale_of_values, sample_weight=weight))
            except ConvergenceWarning:
                continue
    if not nets:
        raise NotConvergedError(
            f"network: none of {RESTARTS} trainings converged in {MOST_ITERATIONS} iterations; check the "
            "values for gross errors, or choose another fit"
        )

    def curve(a: Array) -> Array:
        """Return the mean of the trained networks' predictions at given angles."""
        return mean + scale_of_values * np.mean([net.predict(scale * (a[:, None] - middle)) for net in nets], axis=0)

    solves = [response(net, scale * (x - middle), (y - mean) / scale_of_values, weight) for net in nets]

    def derivative(a: Array) -> Array:
        """Return the derivatives of the predictions at angles with respect to the training values."""
        at = scale * (a - middle)
        return np.asarray(np.mean([gradient(net, at) @ solve for net, solve in zip(nets, solves, strict=True)], axis=0))

    return {"hidden": neurons, "trainings": RESTARTS, "converged": len(nets)}, curve, derivative


def gradient(net: Any, x: Array) -> Array:
    """Return the derivatives of the network's output at M inputs with respect to its weights, (M, 3 H + 1).

    The output is c + v . tanh(w x + b), and the weights are in the order w, b, v (H each), c.

    Parameters
    ----------
    net : MLPRegressor
        Network of scikit-learn with one hidden layer of H; only `coefs_` and `intercepts_` are used.
    x : (M,) ndarray
        Standardised angles.
    """
    w, b, v = net.coefs_[0][0], net.intercepts_[0], net.coefs_[1][:, 0]
    t = np.tanh(np.outer(x, w) + b)
    slope = v * (1.0 - t**2)
    return np.concatenate([slope * x[:, None], slope, t, np.ones((len(x), 1))], axis=-1)


def response(net: Any, x: Array, y: Array, weight: Array) -> Array:
    """Return the derivatives of the 3 H + 1 trained weights with respect to the N training values.

    They follow from the implicit function theorem at the minimum of 1/2 sum weight (net - y)^2 + DECAY/2 (|w|^2 +
    |v|^2).

    Parameters
    ----------
    net : MLPRegressor
        Trained network, as for `gradient`.
    x : (N,) ndarray
        Inputs of the network.
    y : (N,) ndarray
        Training values.
    weight : (N,) ndarray
        Weights of the values.
    """
    w, b, v, c = net.coefs_[0][0], net.intercepts_[0], net.coefs_[1][:, 0], net.intercepts_[1][0]
    n = len(w)
    t = np.tanh(np.outer(x, w) + b)
    slopes = 1.0 - t**2
    jacobian = gradient(net, x)
    residual = weight * (c + t @ v - y)
    hessian = jacobian.T @ (weight[:, None] * jacobian)
    # contribution of the residuals: second derivatives of the output, nonzero within one hidden unit only
    by_input, by_bias = residual @ (slopes * x[:, None]), residual @ slopes
    second = -2.0 * v * t * slopes
    i = np.arange(n)
    for row, column, term in (
        (0, 0, residual @ (second * x[:, None] ** 2)),
        (0, n, residual @ (second * x[:, None])),
        (n, n, residual @ second),
        (0, 2 * n, by_input),
        (n, 2 * n, by_bias),
    ):
        hessian[row + i, column + i] += term
        if row != column:
            hessian[column + i, row + i] += term
    hessian[i, i] += DECAY
    hessian[2 * n + i, 2 * n + i] += DECAY
    # Trainings stop slightly before the minimum, where flat directions may have negative curvature; a lower bound
    # relative to the decay keeps the response from becoming arbitrarily large.
    level, direction = np.linalg.eigh(hessian)
    return (direction / np.maximum(level, FLATTEST * DECAY)) @ (direction.T @ (jacobian.T * weight))
