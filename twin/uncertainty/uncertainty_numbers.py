"""Numbers of what limits the readings, as uncertainty.json has them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from analysis.monitor.limits import Quantity
from twin.run.plain_data import plain_data
from twin.uncertainty.coverage import FALSE, LEVELS, Coverage
from twin.uncertainty.monitor_limits import BEST, LINES, MonitorLimits
from twin.uncertainty.uncertainty_run import UncertaintyRun

ByQuantity = Mapping[str, Mapping[str, Any]]
SEEN = 8
"""Motions that are named of a combination."""


@dataclass(frozen=True)
class ShareNumbers:
    """A motion's share of a variance."""

    motion: str
    share: float


@dataclass(frozen=True)
class AmountNumbers:
    """A motion's part of a combination, in its unit."""

    motion: str
    amount: float
    unit: str


@dataclass(frozen=True)
class SplitNumbers:
    """A variance by motions, the largest first; ``rest`` of all that are not named, ``noise`` of the images.

    All are shares of ``sigma``'s square; those of motions that go together may be negative.
    """

    sigma: float
    lines: tuple[ShareNumbers, ...]
    rest: float
    noise: float

    @classmethod
    def of(cls, limits: MonitorLimits, estimator: str, q: int) -> SplitNumbers:
        """Of one quantity; no estimator: before the measurement."""
        lines = limits.lines(estimator, q)
        split = limits.splits[estimator or BEST]
        sigma = float((split.sigma if estimator else split.sigma_before)[q])
        noise = float(split.noise[q]) / sigma**2 if estimator else 0.0
        first = tuple(ShareNumbers(*line) for line in lines[:LINES])
        return cls(sigma, first, float(sum(share for _, share in lines[LINES:])), noise)


@dataclass(frozen=True)
class SeenNumbers:
    """Motions that change a quantity by ``change`` and hide from the spots: how far these move, and their noise."""

    change: float
    motions: tuple[AmountNumbers, ...]
    spots_px: np.ndarray
    spots_noise_px: np.ndarray

    @classmethod
    def of(cls, limits: MonitorLimits, q: int) -> SeenNumbers:
        """Of one quantity."""
        seen, stated = limits.least_seen[q], limits.stated
        order = np.argsort(-np.abs(seen.amounts), kind="stable")[:SEEN]
        motions = tuple(
            AmountNumbers(stated.labels[k], float(seen.amounts[k] * stated.sigmas[k]), stated.units[k]) for k in order
        )
        return cls(seen.change, motions, seen.spots, seen.noise)


@dataclass(frozen=True)
class ElasticityNumbers:
    """How sigma of the posterior follows a stated number of some bodies: relative change per relative change, and sigma
    if the number is twice as large, unknown to the estimator (``doubled``) and stated so (``doubled_stated``).
    """

    number: str
    stated: float
    unit: str
    bodies: int
    elasticity: float
    doubled: float
    doubled_stated: float


@dataclass(frozen=True)
class HeavyTailNumbers:
    """What the posterior leaves if each stated number is the scale of Student's distribution: rms of the error, half
    widths that hold 68.3, 95.4 and 99.7 % of the errors, and the chance of one beyond 3 sigma (0.0027 if normal).
    """

    degrees: float
    rms: float
    held_68: float
    held_95: float
    held_997: float
    beyond_3_sigma: float


@dataclass(frozen=True)
class QuantityNumbers:
    """What limits one quantity, in the unit that its key ends in; ``known``: what is left if that motion is known;
    ``from_statement``: share of the posterior's variance that no spot constrains.
    """

    before: SplitNumbers
    after: Mapping[str, SplitNumbers]
    known: Mapping[str, float]
    least_seen: SeenNumbers
    from_statement: float
    elasticities: tuple[ElasticityNumbers, ...]
    student_t: HeavyTailNumbers

    @classmethod
    def of(cls, limits: MonitorLimits, q: int) -> QuantityNumbers:
        """Of one quantity."""
        after = {name: SplitNumbers.of(limits, name, q) for name in limits.splits}
        known = {line.motion: float(limits.known[line.motion][q]) for line in after[BEST].lines}
        seen, share, tail = SeenNumbers.of(limits, q), float(limits.from_statement[q]), limits.heavy_tail
        one, two, three = (float(width) for width in tail.held[:, q])
        heavy = HeavyTailNumbers(tail.degrees, float(tail.rms[q]), one, two, three, float(tail.beyond[q]))
        return cls(SplitNumbers.of(limits, "", q), after, known, seen, share, _followed(limits, q), heavy)


def _followed(limits: MonitorLimits, q: int) -> tuple[ElasticityNumbers, ...]:
    """The stated numbers that make most of a quantity's variance."""
    found = sorted(limits.elasticities, key=lambda one: -float(one.elasticity[q]))[:LINES]
    return tuple(
        ElasticityNumbers(
            one.number,
            one.size,
            one.unit,
            len(one.bodies),
            float(one.elasticity[q]),
            float(one.doubled[q]),
            float(one.told[q]),
        )
        for one in found
    )


@dataclass(frozen=True)
class RemedyNumbers:
    """What a further measurement would leave of every quantity."""

    what: str
    left: ByQuantity


@dataclass(frozen=True)
class LimitsNumbers:
    """uncertainty.json. ``outside``: chance that a spot leaves its CCD."""

    name: str
    disturbances: str
    frames: int
    outside: float
    quantities: ByQuantity
    remedies: Mapping[str, RemedyNumbers]

    @classmethod
    def of(cls, limits: MonitorLimits) -> LimitsNumbers:
        """Of an instrument."""
        found = [QuantityNumbers.of(limits, q) for q in range(len(limits.quantities))]
        remedies = {r.name: RemedyNumbers(r.what, by_quantity(limits.quantities, r.sigma)) for r in limits.remedies}
        return cls(
            name=limits.instrument,
            disturbances=limits.stated.name,
            frames=limits.frames,
            outside=limits.outside,
            quantities=by_quantity(limits.quantities, found),
            remedies=remedies,
        )


@dataclass(frozen=True)
class CountNumbers:
    """Of one quantity by one estimator: rms of the errors, of errors over sigma; share of intervals of 68 and 95 % that
    hold the truth, the share that is expected, and the limits of it.
    """

    rms: float
    rms_over_sigma: float
    held_68: float
    held_95: float
    expected_68: float
    expected_95: float
    limits_68: tuple[float, float]
    limits_95: tuple[float, float]


@dataclass(frozen=True)
class StatesNumbers:
    """Random states. ``false_alarm``: of the limits of all coverages together; ``outliers``: what is beyond them."""

    drawn: int
    measured: int
    false_alarm: float
    estimators: Mapping[str, ByQuantity]
    outliers: tuple[Mapping[str, Any], ...]
    chi_square_mean: float
    alarms: int
    alarms_limit: int
    doubted: int

    @classmethod
    def of(cls, coverage: Coverage) -> StatesNumbers:
        """Of a run."""
        n = coverage.measured
        estimators = {}
        for name in coverage.errors:
            levels = range(len(LEVELS))
            parts = (
                coverage.rms(name).tolist(),
                coverage.ratio(name).tolist(),
                *((coverage.held(name, k) / n).tolist() for k in levels),
                *(coverage.expected[name][k].tolist() for k in levels),
                *((coverage.limits(name, k).T / n).tolist() for k in levels),
            )
            counts = [CountNumbers(*row) for row in zip(*parts, strict=True)]
            estimators[name] = by_quantity(coverage.quantities, counts)
        keys = ("estimator", "group", "key", "level", "held")
        return cls(
            drawn=coverage.drawn,
            measured=n,
            false_alarm=FALSE,
            estimators=estimators,
            outliers=tuple(dict(zip(keys, row, strict=True)) for row in coverage.outliers),
            chi_square_mean=float(np.mean(coverage.chi_square)),
            alarms=coverage.alarms,
            alarms_limit=coverage.alarm_limit,
            doubted=coverage.doubted,
        )


def by_quantity(quantities: Sequence[Quantity], values: Sequence[Any] | np.ndarray) -> dict[str, dict[str, Any]]:
    """Group -> key -> value.

    Args:
        quantities: Q of them.
        values: Q of them.
    """
    out: dict[str, dict[str, Any]] = {}
    for quantity, value in zip(quantities, values, strict=True):
        out.setdefault(quantity.group, {})[quantity.key] = value
    return out


def limits_numbers(limits: MonitorLimits) -> dict[str, Any]:
    """What limits an instrument, as plain data."""
    out: dict[str, Any] = plain_data(LimitsNumbers.of(limits))
    return out


def uncertainty_numbers(run: UncertaintyRun) -> dict[str, Any]:
    """uncertainty.json of the command: the same, and under ``states`` what random states gave."""
    out = limits_numbers(run.limits)
    out["warnings"] = list(run.warnings)
    if run.coverage is not None:
        out["states"] = {"seed": run.seed, **plain_data(StatesNumbers.of(run.coverage))}
    return out
