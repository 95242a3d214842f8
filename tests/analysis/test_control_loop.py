"""Loops of integrators with a delay: limits, margins and limit cycles against recursions that are gone through here."""

import math

import numpy as np
import pytest

from analysis.monitor.control_loop import common_margin, limit_cycle, margins, spectral_radius

DELAYS = (0, 1, 2, 3, 7)


def simulated_residual(gain: float, delay: int, course: np.ndarray) -> np.ndarray:
    """What is left of a course when images are taken, reading by reading: a recursion that shares nothing with the
    module.
    """
    commands, left = [], []
    for value in course:
        seen = value + (commands[-1 - delay] if len(commands) > delay else 0.0)
        commands.append((commands[-1] if commands else 0.0) - gain * seen)
        left.append(value + (commands[-1 - delay] if len(commands) > delay else 0.0))
    return np.array(left)


def open_loop(gain: float, delay: int, frequency: float) -> complex:
    """Transfer function of an integrator with a delay, at a frequency in cycles per reading."""
    late = np.exp(-2j * np.pi * frequency)
    return gain * late ** (delay + 1) / (1.0 - late)


@pytest.mark.parametrize("delay", DELAYS)
def test_just_below_the_limit_errors_decay_and_just_above_they_grow(delay: int) -> None:
    limit, step = margins(0.1, delay).limit, np.ones(20_000)
    # 1 % off the limit errors change by e in some hundred readings, twenty thousand are enough for any delay here
    below, above = (np.abs(simulated_residual(factor * limit, delay, step)) for factor in (0.99, 1.01))
    assert below[-100:].max() < 1e-6
    assert above[-100:].max() > 1e6
    assert margins(0.99 * limit, delay).stable
    assert not margins(1.01 * limit, delay).stable


@pytest.mark.parametrize(("gain", "delay"), [(0.5, 0), (0.8, 1), (0.3, 2)])
def test_margins_are_those_of_the_open_loop(gain: float, delay: int) -> None:
    found = margins(gain, delay)
    at = open_loop(gain, delay, found.crossover)
    assert abs(at) == pytest.approx(1.0, rel=1e-12)
    assert 180.0 + math.degrees(np.angle(at)) == pytest.approx(found.phase_deg, abs=1e-9)
    # at the gain margin the curve goes through -1
    frequency = 0.5 / (2 * delay + 1)
    assert open_loop(gain * found.gain, delay, frequency) == pytest.approx(-1.0, abs=1e-12)


def test_loops_that_work_on_each_other() -> None:
    # two that do to each other what they do to themselves are one loop of the sum of their gains
    both = np.ones((2, 2))
    assert common_margin(both, [0.3, 0.2], [1, 1], [4, 4]) == pytest.approx(margins(0.5, 1).gain, rel=1e-9)
    # those that do nothing to each other are as stable as the worse
    assert common_margin(np.eye(2), [0.3, 0.2], [0, 3]) == pytest.approx(margins(0.2, 3).gain, rel=1e-9)
    assert spectral_radius(both, [0.0, 0.5], [9, 1]) == spectral_radius([[1.0]], [0.5], [1])
    assert common_margin(both, [0.0, 0.0], [0, 0]) == math.inf
    # two mechanisms on two quantities to which they do the same cannot correct both: they drift off
    assert common_margin(both, [0.3, 0.2], [1, 1]) == 0.0
    # order does not matter
    coupling = np.array([[1.0, 0.3], [-0.2, 1.0]])
    there = common_margin(coupling, [0.5, 0.7], [0, 2])
    assert common_margin(coupling[::-1, ::-1], [0.7, 0.5], [2, 0]) == pytest.approx(there, rel=1e-9)


def worst_cycle(gain: float, delay: int, band: float) -> tuple[int, float]:
    """Steps and what is left, by going through many places between two steps one by one."""
    steps, worst = 0, 0.0
    for place in np.linspace(0.003, 0.997, 60):
        commands, at = [], []
        for _ in range(700):
            stands = round(commands[-1 - delay]) if len(commands) > delay else 0
            left = place + stands
            commands.append((commands[-1] if commands else 0.0) - gain * left * (abs(left) > band))
            at.append(round(commands[-1 - delay]) if len(commands) > delay else 0)
        seen = at[400:]
        steps, worst = max(steps, max(seen) - min(seen)), max(worst, *(abs(place + p) for p in seen))
    return steps, worst


@pytest.mark.parametrize(
    ("gain", "delay", "band"), [(0.5, 0, 0.0), (0.8, 0, 0.0), (0.5, 1, 0.0), (0.8, 0, 0.6), (0.3, 2, 0.0)]
)
def test_the_limit_cycle(gain: float, delay: int, band: float) -> None:
    found = limit_cycle(gain, delay, band)
    steps, left = worst_cycle(gain, delay, band)
    assert found.steps == steps
    # the two look at other places between the steps, 1/41 of a step apart
    assert found.left == pytest.approx(left, abs=0.05)
