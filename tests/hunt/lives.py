"""Lives of a followed instrument with bad readings, jumps, and laws that are stated too small: whether a value that is
wrong by more than 5 sigma is said to be doubtful.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from analysis.chi_square import limit_of
from analysis.monitor.disturbances import Disturbances
from analysis.monitor.series_filter import SeriesFilter
from tests.analysis.followed_series import of_shifts
from tests.analysis.test_bad_readings import COUNT, DAYS, NOISE, drawn, toy
from tests.hunt.hunt import FAR, RIGHT, WARNED, WRONG_READING, Outcome
from twin.operate.estimate.following import MOST_BAD, widening

REGIMES = ("bad readings", "bad readings and jumps", "drift 3 times", "drift 10 times", "white 3 times")


def lives(first: int, cases: int) -> Iterator[Outcome]:
    """Yield the outcomes of so many lives, one regime after the other."""
    stated = toy(True)
    how = SeriesFilter(stated, life_s=10.0 * DAYS)
    for case in range(first, first + cases):
        regime = REGIMES[case % len(REGIMES)]
        yield _judged(how, _true(stated, regime), case, regime)


def _true(stated: Disturbances, regime: str) -> Disturbances:
    """Return what really moves: motions of one law by the factor of the regime."""
    name, _, times = regime.partition(" ")
    if name not in ("drift", "white"):
        return stated
    own = [law.white if name == "white" else law.drift_s is not None for law in stated.laws]
    return stated.scaled(np.where(own, float(times.split()[0]), 1.0))


def _judged(how: SeriesFilter, true: Disturbances, case: int, regime: str) -> Outcome:
    life = drawn(true, case, case % 6 if "bad" in regime else 0, 1 + case % 2 if "jumps" in regime else 0)
    belief, squares, told, worst = how.start(0.0), [], 0, (0.0, "")
    jumps, bad = 0, 0
    for k, reading in enumerate(of_shifts(life.times, life.shifts, NOISE**2 * np.eye(COUNT))):
        belief, found = how.update(belief, reading)
        jumps += found.jump is not None
        bad += (found.bad is not None) - (found.earlier is not None)
        explained = found.bad is not None or found.jump is not None
        squares.append((0.0, 0.0) if explained else (found.chi_square, float(COUNT)))
        mean, covariance = how.parameters(how.blended(belief), reading.time)
        wide = float(widening(np.array(squares), [k + 1], False, [(0, np.array(squares[:10]))])[0])
        off = np.abs(mean - life.truth[k]) / np.sqrt(np.diag(covariance)) / wide
        # an error that is within what is stated of the reading can be told by nobody
        said = wide > 1.0 or belief.aside is not None or jumps > 2 or bad > MOST_BAD
        hidden = k in life.bad and found.chi_square < float(limit_of(1e-3, COUNT))
        early = k < 10 and true is not how.stated  # before ten readings a law cannot be told to be too small
        if off.max() > FAR and not early:
            told += said or hidden
            if not (said or hidden) and off.max() > worst[0]:
                worst = (float(off.max()), f"reading {k}, {off.max():.3g} sigma, bad {life.bad}, jumps {life.jumps}")
    text = f"{regime}: {worst[1]}"
    return Outcome(f"life {case}", WRONG_READING if worst[1] else WARNED if told else RIGHT, text)
