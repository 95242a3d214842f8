"""Readings that are not linear are worked out anew, and nothing else is touched: on a made-up monitor of four motions
with four spot coordinates, whose spots and parameters bend.
"""

from dataclasses import replace

import numpy as np
import pytest

from analysis.monitor.recovery import LinearReading, MotionModel, Retraced, read_again

RNG = np.random.default_rng(4)
A = RNG.standard_normal((4, 4)) + 3.0 * np.eye(4)
B = RNG.standard_normal((4, 4))
BEND, TURN = 0.02 * RNG.standard_normal((4, 4, 4)), 0.02 * RNG.standard_normal((4, 4, 4))
NOISE = 1e-6 * np.eye(4)[None]
ROWS = np.eye(4)


def spots(x):
    return x @ A.T + np.einsum("dpq,sp,sq->sd", BEND, x, x)


def parameters(x):
    return x @ B.T + np.einsum("dpq,sp,sq->sd", TURN, x, x)


def model(trace=lambda x: Retraced(spots(x), parameters(x))):
    inverse = np.linalg.inv(A)
    return MotionModel(
        A,
        B,
        lambda noise: np.broadcast_to(inverse, (len(noise), 4, 4)),
        states=lambda rows: rows,
        trace=lambda states: trace(np.array(states)),
    )


def linear_reading(shift, how):
    linear = shift @ np.linalg.inv(A).T @ B.T
    gain = B @ np.linalg.inv(A)
    return LinearReading(linear, np.broadcast_to(gain @ NOISE[0] @ gain.T, (len(shift), 4, 4)), how)


def read(x, how=None):
    """Linear readings of a true state's exact spots, and those that are worked out anew."""
    shift = spots(x)
    linear = linear_reading(shift, model() if how is None else how)
    again = read_again({"own": linear}, shift, np.broadcast_to(NOISE, (len(x), 4, 4)), ROWS)
    return linear.values, *again["own"]


def test_large_motions_are_read_as_they_are() -> None:
    """The linear reading is off by tens of sigmas; Gauss and Newton's steps end within a hundredth of one."""
    x = 0.5 * np.sign(np.random.default_rng(2).standard_normal((5, 4)))
    linear, found, told = read(x)
    sigma = np.sqrt(np.diagonal(B @ np.linalg.inv(A) @ NOISE[0] @ np.linalg.inv(A).T @ B.T))
    assert np.all(np.max(np.abs(linear - parameters(x)) / sigma, axis=1) > 10.0)
    assert np.max(np.abs(found - parameters(x)) / sigma) < 0.02
    assert told.beyond.all()
    assert told.valid.all()
    # what is said to be off is, to first order
    assert told.off == pytest.approx(np.abs(linear - parameters(x)) / sigma, rel=0.5, abs=5.0)
    worst, size = told.worst(2)
    assert size == np.max(told.off[2])
    assert worst == int(np.argmax(told.off[2]))


def test_states_without_light_and_steps_without_end_do_not_hold() -> None:
    x = np.stack([0.5 * np.ones(4), 1e-3 * np.ones(4)])

    def dark(states):
        lost = np.any(np.abs(states) > 0.1, axis=1)[:, None]
        return Retraced(np.where(lost, np.nan, spots(states)), np.where(lost, np.nan, parameters(states)))

    linear, found, told = read(x, model(dark))
    assert np.array_equal(linear, found)
    assert told.valid.tolist() == [False, True]
    assert told.worst(0)[1] == np.inf

    def wild(states):
        return Retraced(-2.0 * spots(states), parameters(states))

    _, _, told = read(x[:1], model(wild))
    assert told.beyond.all()
    assert not told.valid.any()


def test_estimators_that_trace_alike_are_traced_together_and_keep_their_own() -> None:
    asked = []

    def counted(states):
        asked.append(len(states))
        return Retraced(spots(states), parameters(states))

    x = np.stack([1e-3 * np.ones(4), 0.5 * np.ones(4), 0.4 * np.ones(4)])
    shift, noise, one = spots(x), np.broadcast_to(NOISE, (3, 4, 4)), model(counted)
    models = {"near": replace(one, near_px=0.1), "all": one, "none": replace(one, near_px=99.0), "other": model()}
    together = read_again({name: linear_reading(shift, how) for name, how in models.items()}, shift, noise, ROWS)
    assert asked[0] == 2 + 3
    for name, how in models.items():
        alone = read_again({name: linear_reading(shift, how)}, shift, noise, ROWS)[name]
        np.testing.assert_array_equal(together[name][0], alone[0])
        np.testing.assert_array_equal(together[name][1].off, alone[1].off)
        assert together[name][1].rests.tolist() == alone[1].rests.tolist()
    assert not together["none"][1].beyond.any()
