"""Simulated lives of an instrument whose light is read every few days, by plain sums: nothing of a filter is used here.

The scale is the published one of Chandra's aspect camera (the model of the aimpoint's drift, `AcaDriftModel` of the
package chandra_aca): 2.15 and 1.00 arcsec per degree Fahrenheit of the camera, a trend of 1.11 and 0.16 arcsec a year,
steps of 0.7 to 12.5 arcsec, and 0.9 and 1.3 arcsec of scatter in the two axes. Added are what such a model leaves out:
the structure follows the temperature with a lag, a part of each step goes back slowly, the structure settles slowly
after each safe mode, and readings are missing, some alone, some for weeks.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

DAY, YEAR = 86_400.0, 365.25 * 86_400.0
DAYS = 365.25
"""Of a year."""
STEP = 0.125
"""Days between two points of the temperature."""
APART = 60.0
"""Days between two jumps, at least, and from the start to the first; half of it from the last to the end. The published
ones are 164 days apart and more."""
NEAR = 10.0
"""Days before and after a jump in which its surroundings are looked at."""
AROUND = 12
"""Times at which the state is asked for around each jump."""
ANYWHERE = 20
"""Times a year at which it is asked for besides."""


@dataclass(frozen=True)
class Law:
    """Of the life.

    Attributes:
        coefficient: arcsec per degree Fahrenheit in each axis.
        season: amplitude of the year in the temperature, degrees Fahrenheit.
        wander, wander_days: standard deviation and correlation time of what else the temperature does.
        lag_days: the structure follows the temperature with this time constant.
        trend: standard deviation of the trend in each axis, arcsec a year.
        jumps: a year.
        smallest, largest: of the jumps, arcsec; the logarithm of a size is uniform, and so is the direction.
        recovers: the largest share of a jump that goes back; recovery_days: shortest and longest time constant.
        settles: standard deviation of what a safe mode brings in each axis, arcsec; settling_days: shortest and longest
            time constant.
        scatter: of a reading in each axis, arcsec.
        every_days: a reading is planned.
        missing: share of readings that are missing alone.
        safe_modes: a year, each of 10 to 25 days without a reading.
    """

    coefficient: tuple[float, float] = (2.1467, 1.004)
    season: float = 3.0
    wander: float = 1.0
    wander_days: float = 30.0
    lag_days: float = 1.0
    trend: tuple[float, float] = (1.108, 0.159)
    jumps: float = 0.9
    smallest: float = 0.7
    largest: float = 12.5
    recovers: float = 0.1
    recovery_days: tuple[float, float] = (20.0, 60.0)
    settles: float = 0.8
    settling_days: tuple[float, float] = (10.0, 40.0)
    scatter: tuple[float, float] = (0.9, 1.3)
    every_days: float = 5.0
    missing: float = 0.08
    safe_modes: float = 0.5


@dataclass(frozen=True, eq=False)
class Mission:
    """A life of two axes.

    Attributes:
        times: (n,) of the readings, seconds; readings: (n, 2) arcsec; warmth: (n,) the sensor then, degrees Fahrenheit.
        wanted: (m,) times, seconds; truth: (m, 2) without scatter, arcsec; wanted_warmth: (m,) the sensor then.
        moments: (J,) of the jumps, seconds, in order; sizes: (J, 2) arcsec at once; remaining: (J,) the share that
            does not go back.
        safe_modes: (s, 2) first and last moment, seconds.
    """

    times: np.ndarray
    readings: np.ndarray
    warmth: np.ndarray
    wanted: np.ndarray
    truth: np.ndarray
    wanted_warmth: np.ndarray
    moments: np.ndarray
    sizes: np.ndarray
    remaining: np.ndarray
    safe_modes: np.ndarray


def moments_of(rng: np.random.Generator, count: int, length: float) -> np.ndarray:
    """(count,) days, in order: uniform among all that keep their distance.

    Args:
        rng: of the chance.
        count: number of jumps.
        length: of the mission, days.
    """
    free = length - 1.5 * APART - APART * max(count - 1, 0)
    if free < 0.0:
        raise ValueError(f"missions: {count} jumps do not fit into {length:g} days")
    return np.asarray(APART + np.sort(rng.uniform(0.0, free, count)) + APART * np.arange(count))


def temperatures(rng: np.random.Generator, law: Law, length: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Days, the sensor's temperature and the one that the structure has, degrees Fahrenheit.

    Args:
        rng: of the chance.
        law: of the life.
        length: of the mission, days.
    """
    start = -200.0  # what it was before the mission is forgotten by its start
    days = np.arange(start, length + 2.0 * STEP, STEP)
    kept = math.exp(-STEP / law.wander_days)
    noise = law.wander * math.sqrt(1.0 - kept**2) * rng.standard_normal(len(days))
    sensor = lfilter([1.0], [1.0, -kept], noise) + law.season * np.cos(2.0 * math.pi * (days / DAYS - rng.random()))
    slow = math.exp(-STEP / law.lag_days)
    return days, sensor, lfilter([1.0 - slow], [1.0, -slow], sensor)


def mission(rng: np.random.Generator, years: float, law: Law = Law(), jumps: int | None = None) -> Mission:
    """One life.

    Args:
        rng: of all that chance decides.
        years: it lasts.
        law: of the life.
        jumps: number of them; None for that of the law.
    """
    length = DAYS * years
    planned = np.arange(0.0, length, law.every_days)
    days = planned + rng.uniform(0.0, 0.5, len(planned))
    keep = rng.random(len(days)) >= law.missing
    starts = np.sort(rng.uniform(APART, length - APART, rng.poisson(law.safe_modes * years)))
    ends = starts + rng.uniform(10.0, 25.0, len(starts))
    for start, end in zip(starts, ends, strict=True):
        keep &= (days < start) | (days > end)
    days = days[keep]

    count = round(law.jumps * years) if jumps is None else jumps
    moments = moments_of(rng, count, length)
    amount = np.exp(rng.uniform(math.log(law.smallest), math.log(law.largest), count))
    angle = rng.uniform(0.0, 2.0 * math.pi, count)
    sizes = amount[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    share = rng.uniform(0.0, law.recovers, count)
    recovery = rng.uniform(*law.recovery_days, count)
    settled = law.settles * rng.standard_normal((len(starts), 2))
    settling = rng.uniform(*law.settling_days, len(starts))
    trend = np.array(law.trend) * rng.standard_normal(2)

    around = (moments[:, None] + rng.uniform(-NEAR, NEAR, (count, AROUND))).ravel()
    wanted = np.sort(np.concatenate([rng.uniform(days[0], days[-1], round(ANYWHERE * years)), around]))
    grid, sensor, structure = temperatures(rng, law, length)

    def state(at: np.ndarray) -> np.ndarray:
        out = np.interp(at, grid, structure)[:, None] * np.array(law.coefficient) + (at / DAYS)[:, None] * trend
        for moment, size, part, slow in zip(moments, sizes, share, recovery, strict=True):
            since = at - moment
            left = 1.0 - part + part * np.exp(-np.maximum(since, 0.0) / slow)
            out += np.where(since >= 0.0, left, 0.0)[:, None] * size
        for start, size, slow in zip(starts, settled, settling, strict=True):
            out -= np.expm1(-np.maximum(at - start, 0.0) / slow)[:, None] * size
        return out

    readings = state(days) + np.array(law.scatter) * rng.standard_normal((len(days), 2))
    return Mission(
        times=days * DAY,
        readings=readings,
        warmth=np.interp(days, grid, sensor),
        wanted=wanted * DAY,
        truth=state(wanted),
        wanted_warmth=np.interp(wanted, grid, sensor),
        moments=moments * DAY,
        sizes=sizes,
        remaining=1.0 - share,
        safe_modes=np.stack([starts, ends], axis=1) * DAY,
    )
