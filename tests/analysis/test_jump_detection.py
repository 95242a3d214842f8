"""Jumps in a series, against a generator of its own: readings as the aspect camera of Chandra has of its lights
(temperature times a coefficient, a trend, jumps, slow recoveries, scatter, missing days), of which the filter knows the
laws in time and no more; and missions in which nothing jumps, for the chance of a false alarm.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.stats import binom, chi2

from analysis.monitor import series_smoother
from analysis.monitor.disturbances import Disturbances, TimeLaw
from analysis.monitor.jump_detection import Jump, candidates
from analysis.monitor.series_smoother import smooth

DAY, YEAR = 86_400.0, 365.25 * 86_400.0
SCATTER = np.array([0.9, 1.3])
"""Arcsec, of a reading in each axis."""


@dataclass(frozen=True, eq=False)
class Mission:
    """A life of two axes.

    Attributes:
        times: (n,) of the readings, seconds; readings: (n, 2) arcsec.
        wanted: (m,) times, seconds; truth: (m, 2) without scatter, arcsec.
        moments: of the jumps, seconds, in order; sizes: (J, 2) arcsec.
    """

    times: np.ndarray
    readings: np.ndarray
    wanted: np.ndarray
    truth: np.ndarray
    moments: np.ndarray
    sizes: np.ndarray


def mission(rng: np.random.Generator, years: float, jumps: int, every_days: float = 7.0) -> Mission:
    """Plain sums; nothing of the filter's laws is used.

    Args:
        rng: of all that chance decides.
        years: it lasts.
        jumps: number of them, of 0.7 to 12.5 arcsec, in any direction.
        every_days: a reading is planned.
    """
    days = np.arange(0.0, 365.25 * years, every_days) + rng.uniform(0.0, 0.5, math.ceil(365.25 * years / every_days))
    keep = rng.random(len(days)) > 0.08
    for start in rng.uniform(0.0, days[-1], max(1, round(years / 2.0))):
        keep &= (days < start) | (days > start + rng.uniform(10.0, 25.0))  # safe modes
    days = days[keep]
    slots = (np.arange(jumps) + rng.uniform(0.2, 0.8, jumps)) / max(jumps, 1)
    moments = 365.25 * years * (0.03 + 0.94 * slots)
    amount = np.exp(rng.uniform(math.log(0.7), math.log(12.5), jumps))
    angle = rng.uniform(0.0, 2.0 * math.pi, jumps)
    sizes = amount[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    wanted = np.sort(
        np.concatenate([np.linspace(days[0], days[-1], 150), *(moments + d for d in (-3.0, -1.0, 1.0, 3.0))])
    )

    at = np.sort(np.concatenate([days, wanted]))
    walk = np.zeros(len(at))  # a temperature that wanders, and the seasons
    for k in range(1, len(at)):
        kept = math.exp(-(at[k] - at[k - 1]) / 50.0)
        walk[k] = kept * walk[k - 1] + math.sqrt(1.0 - kept**2) * rng.standard_normal()
    warm = walk + 1.5 * np.cos(2.0 * math.pi * (at / 365.25 - rng.random()))
    state = warm[:, None] * np.array([0.5, -0.6])
    state += (at / 365.25)[:, None] * rng.normal(0.0, 0.5, 2)
    for moment, size in zip(moments, sizes, strict=True):
        since = np.maximum(at - moment, 0.0)
        state += np.where(at >= moment, 0.9 + 0.1 * np.exp(-since / 40.0), 0.0)[:, None] * size  # a tenth recovers
    shown = state[np.searchsorted(at, days)]
    readings = shown + SCATTER * rng.standard_normal(shown.shape)
    return Mission(days * DAY, readings, wanted * DAY, state[np.searchsorted(at, wanted)], moments * DAY, sizes)


LAWS = {
    "wandering": (TimeLaw(drift_s=50.0 * DAY), (0.7, 0.8)),
    "seasons": (TimeLaw(period_s=YEAR), (1.0, 1.0)),
    "trend": (TimeLaw(trend_s=YEAR), (0.5, 0.5)),
    "mounting": (TimeLaw(), (5.0, 5.0)),
    "jumps": (TimeLaw(jump=True, every_s=400.0 * DAY), (4.0, 4.0)),
}
"""Cause -> its law and its standard deviation in each axis, arcsec."""


def chandra(false_alarm: float = 0.01, without: tuple[str, ...] = ()) -> Disturbances:
    """What the filter is told; a pixel is an arcsec, and the parameters are the two axes."""
    laws = {name: one for name, one in LAWS.items() if name not in without}
    names = tuple(f"{'fid' if name == 'jumps' else name} shift {axis}" for name in laws for axis in "yz")
    sigma = np.array([size for _, sizes in laws.values() for size in sizes])
    see = np.tile(np.eye(2), len(laws)) * sigma
    return Disturbances(
        "chandra",
        names,
        tuple(name.split()[0] for name in names),
        names,
        sigma,
        ("arcsec",) * len(names),
        see,
        see.copy(),
        np.eye(len(names)),
        tuple(law for law, _ in laws.values() for _ in "yz"),
        false_alarm,
    )


class Scatter:
    """Noise of each reading alone."""

    def __init__(self, sigma: np.ndarray = SCATTER) -> None:
        self.sigma = sigma

    def covariance(self, images: np.ndarray) -> np.ndarray:
        return np.diag(np.tile(self.sigma**2, len(images)))


@dataclass
class Score:
    """Of some missions: jumps above 4 sigma, those of them found within two readings and with their size, jumps found
    where none was; how often the truth is inside one and two sigma near jumps and away from them.
    """

    large: int = 0
    found: int = 0
    sized: int = 0
    false: int = 0
    near: tuple[int, int, int] = (0, 0, 0)
    away: tuple[int, int, int] = (0, 0, 0)

    def add(self, one: Mission, jumps: tuple[Jump, ...], values: np.ndarray, total: np.ndarray) -> None:
        times = one.times
        last = np.searchsorted(times, one.moments)  # the first reading after each
        reach = [(times[max(k - 3, 0)], times[min(k + 2, len(times) - 1)]) for k in last]
        for (early, late), size in zip(reach, one.sizes, strict=True):
            own = [j for j in jumps if early <= j.after and j.until <= late]
            if np.linalg.norm(size / SCATTER) <= 4.0:
                continue
            self.large += 1
            self.found += bool(own)
            got, sigma = np.zeros(2), np.zeros(2)
            for j in own:
                for label, z, s in zip(j.labels, j.sizes, j.sigmas, strict=True):
                    got["yz".index(label[-1])] += z
                    sigma["yz".index(label[-1])] = math.hypot(sigma["yz".index(label[-1])], s)
            seen = sigma > 0.0
            self.sized += bool(own) and bool(np.all(np.abs(got - size)[seen] < 3.0 * sigma[seen]))
        for j in jumps:  # false where none came when the filter says, nor within two readings of it
            stated = np.any((one.moments >= j.chances[0][0]) & (one.moments <= j.chances[-1][0]))
            self.false += not stated and not any(e <= j.after and j.until <= u for e, u in reach)
        ratio = np.abs(values - one.truth) / np.sqrt(np.diagonal(total, 0, 1, 2))
        apart = np.abs(one.wanted[:, None] - one.moments)
        close = np.min(apart, axis=1) < 10.0 * DAY if len(one.moments) else np.zeros(len(one.wanted), bool)
        for name, which in (("near", close), ("away", ~close)):
            part = ratio[which]
            new = (part.size, int((part < 1.0).sum()), int((part < 2.0).sum()))
            setattr(self, name, tuple(a + b for a, b in zip(getattr(self, name), new, strict=True)))


def live(rng: np.random.Generator, missions: int, years: float, jumps: int, false_alarm: float = 0.01) -> Score:
    """Score of some missions."""
    score, told = Score(), chandra(false_alarm)
    for _ in range(missions):
        one = mission(rng, years, jumps)
        found = smooth(told, one.times, one.readings, Scatter(), one.wanted)
        assert found.jumps is not None
        late = found.smoothed
        score.add(one, found.jumps, late.values[:, :2], late.total[:, :2, :2])
    return score
