"""Contents of uncertainty.json: which numbers of the analysis are written, and under which keys."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import Any

import numpy as np

from analysis.monitor import limits
from analysis.monitor.limits import Elasticity
from twin.framework.record import Quantity, Record
from twin.uncertainty.coverage import FALSE, Coverage, UncertaintyRun
from twin.uncertainty.monitor_limits import BEST, LINES, MonitorLimits, Remedy

SEEN = 8
"""Largest number of motions that the file lists for the combination of motions that the spots observe least."""


@dataclass(frozen=True, eq=False)
class _Limited:
    """Standard deviation of one quantity and its causes, before or after the measurement, for the JSON file."""

    limits: MonitorLimits
    q: int
    estimator: str = ""

    @property
    def lines(self) -> list[tuple[str, float]]:
        return self.limits.lines(self.estimator, self.q)

    @property
    def sigma(self) -> float:
        split = self.limits.splits[self.estimator or BEST]
        return float((split.sigma if self.estimator else split.sigma_before)[self.q])

    @property
    def noise(self) -> float:
        return float(self.limits.splits[self.estimator].noise[self.q]) / self.sigma**2 if self.estimator else 0.0

    @property
    def after(self) -> dict[str, _Limited]:
        return {name: _Limited(self.limits, self.q, name) for name in self.limits.splits}

    @property
    def sigma_if_known(self) -> dict[str, float]:
        return {name: float(self.limits.sigma_if_known[name][self.q]) for name, _ in self.after[BEST].lines[:LINES]}

    @property
    def motions(self) -> list[tuple[str, float, str]]:
        """Label, amount and unit of the motions in the least observable combination."""
        amounts, disturbances = self.limits.least_observable[self.q].amounts, self.limits.disturbances
        order = np.argsort(-np.abs(amounts), kind="stable")[:SEEN]
        return [
            (disturbances.labels[k], float(amounts[k] * disturbances.sigmas[k]), disturbances.units[k]) for k in order
        ]

    def half_width(self, level: int) -> float:
        return float(self.limits.heavy_tail.half_widths[level, self.q])

    @property
    def followed(self) -> list[tuple[Elasticity, int]]:
        """Numbers of the prior on which the quantity's sigma depends most, each with the index of the quantity."""
        largest = sorted(self.limits.elasticities, key=lambda elasticity: -float(elasticity.elasticity[self.q]))[:LINES]
        return [(elasticity, self.q) for elasticity in largest]


SHARE: Record[tuple[str, float]] = Record(
    "Share of a motion in a variance; shares of correlated motions may be negative.",
    Quantity("motion", itemgetter(0), "label of the motion"),
    Quantity("share", itemgetter(1), "its share of the variance"),
)
_SPLIT: Record[_Limited] = Record(
    "Contributions of motions to a variance.",
    Quantity("sigma", lambda s: s.sigma, "standard deviation, whose square is divided"),
    Quantity("lines", lambda s: s.lines[:LINES], "motions with the largest shares, largest first", record=SHARE),
    Quantity("rest", lambda s: float(sum(share for _, share in s.lines[LINES:])), "share of all other motions"),
    Quantity("noise", lambda s: s.noise, "share of the image noise"),
)
_AMOUNT: Record[tuple[str, float, str]] = Record(
    "A motion in a combination of motions.",
    Quantity("motion", itemgetter(0), "label of the motion"),
    Quantity("amount", itemgetter(1), "its amount in the combination"),
    Quantity("unit", itemgetter(2), "unit of the amount"),
)
_LEAST_OBSERVABLE: Record[_Limited] = Record(
    "Least observable motions that change a quantity.",
    Quantity("change", lambda r: r.limits.least_observable[r.q].change, "change of the quantity by all of them"),
    Quantity("motions", lambda r: r.motions, "the largest of them", record=_AMOUNT),
    Quantity("spots_px", lambda r: r.limits.least_observable[r.q].spots, "spot shifts that they cause"),
    Quantity(
        "spots_noise_px", lambda r: r.limits.least_observable[r.q].noise, "noise standard deviation of the shifts"
    ),
)
_ELASTICITY: Record[tuple[Elasticity, int]] = Record(
    "Sensitivity of the posterior's standard deviation to a number of the prior.",
    Quantity("number", lambda e: e[0].number, "name of the number"),
    Quantity("value", lambda e: e[0].size, "its value in the prior"),
    Quantity("unit", lambda e: e[0].unit, "unit of the number"),
    Quantity("bodies", lambda e: len(e[0].bodies), "number of bodies that it applies to"),
    Quantity("elasticity", lambda e: float(e[0].elasticity[e[1]]), "relative change per relative change"),
    Quantity(
        "doubled",
        lambda e: float(e[0].doubled[e[1]]),
        "standard deviation if the number is twice as large, and the prior is unchanged",
    ),
    Quantity(
        "doubled_in_prior",
        lambda e: float(e[0].doubled_in_prior[e[1]]),
        "standard deviation if the number is twice as large, also in the prior",
    ),
)
_HEAVY_TAIL: Record[_Limited] = Record(
    "Errors of the posterior if each number of the prior is the scale of Student's t distribution.",
    Quantity("degrees", lambda r: r.limits.heavy_tail.degrees, "degrees of freedom of that distribution"),
    Quantity("rms", lambda r: float(r.limits.heavy_tail.rms[r.q]), "root mean square of the error"),
    Quantity("half_width_68", lambda r: r.half_width(0), "half-width of the interval with 68.3 % of the errors"),
    Quantity("half_width_95", lambda r: r.half_width(1), "half-width of the interval with 95.4 % of the errors"),
    Quantity("half_width_997", lambda r: r.half_width(2), "half-width of the interval with 99.7 % of the errors"),
    Quantity(
        "beyond_3_sigma",
        lambda r: float(r.limits.heavy_tail.beyond[r.q]),
        "probability of an error beyond 3 sigma; 0.0027 for a normal error",
    ),
)
_LIMITED: Record[_Limited] = Record(
    "Limits of one quantity, in the unit at the end of its key.",
    Quantity("before", lambda r: r, "variance before the measurement", record=_SPLIT),
    Quantity("after", lambda r: r.after, "variance that each estimator leaves", record=_SPLIT),
    Quantity("sigma_if_known", lambda r: r.sigma_if_known, "remaining standard deviation if that motion is known"),
    Quantity("least_observable", lambda r: r, "least observable motions", record=_LEAST_OBSERVABLE),
    Quantity(
        "from_statement",
        lambda r: float(r.limits.from_prior[r.q]),
        "share of the posterior's variance that remains without image noise",
    ),
    Quantity(
        "elasticities", lambda r: r.followed, "numbers of the prior with the largest elasticities", record=_ELASTICITY
    ),
    Quantity("student_t", lambda r: r, "errors under a prior with heavy tails", record=_HEAVY_TAIL),
)
_REMEDY: Record[tuple[Remedy, Sequence[limits.Quantity]]] = Record(
    "A further measurement.",
    Quantity("what", lambda e: e[0].what, "description of the measurement"),
    Quantity("left", lambda e: _by_quantity(e[1], e[0].sigma), "remaining standard deviation of each quantity"),
)
LIMITS: Record[MonitorLimits] = Record(
    "uncertainty.json",
    Quantity("name", lambda r: r.instrument, "the instrument"),
    Quantity("disturbances", lambda r: r.disturbances.name, "name of the prior on disturbances"),
    Quantity("frames", lambda r: r.frames, "frames of each state"),
    Quantity("outside", lambda r: r.outside, "probability that a spot leaves its CCD"),
    Quantity(
        "quantities",
        lambda r: _by_quantity(r.quantities, [_Limited(r, q) for q in range(len(r.quantities))]),
        "what limits each quantity",
        record=_LIMITED,
    ),
    Quantity(
        "remedies",
        lambda r: {remedy.name: (remedy, r.quantities) for remedy in r.remedies},
        "further measurements",
        record=_REMEDY,
    ),
)


@dataclass(frozen=True, eq=False)
class _Counted:
    """Errors and interval coverage of one quantity by one estimator in the random states, for the JSON file."""

    coverage: Coverage
    q: int
    estimator: str

    def covered(self, level: int) -> float:
        return float(self.coverage.covered(self.estimator, level)[self.q]) / self.coverage.measured

    def limits(self, level: int) -> np.ndarray:
        return self.coverage.limits(self.estimator, level)[:, self.q] / self.coverage.measured

    def expected(self, level: int) -> float:
        return float(self.coverage.expected[self.estimator][level][self.q])


COUNT: Record[_Counted] = Record(
    "Errors of one quantity by one estimator in random states.",
    Quantity("rms", lambda c: float(c.coverage.rms(c.estimator)[c.q]), "root mean square of the errors"),
    Quantity(
        "rms_over_sigma",
        lambda c: float(c.coverage.ratio(c.estimator)[c.q]),
        "root mean square of the errors over their sigmas",
    ),
    Quantity("covered_68", lambda c: c.covered(0), "share of the 68 % intervals that contain the truth"),
    Quantity("covered_95", lambda c: c.covered(1), "share of the 95 % intervals that contain the truth"),
    Quantity("expected_68", lambda c: c.expected(0), "expected share of the 68 % intervals that contain the truth"),
    Quantity("expected_95", lambda c: c.expected(1), "expected share of the 95 % intervals that contain the truth"),
    Quantity("limits_68", lambda c: c.limits(0), "limits of covered_68 if every sigma is right"),
    Quantity("limits_95", lambda c: c.limits(1), "limits of covered_95 if every sigma is right"),
)
_OUTLIER: Record[tuple[str, str, str, float, int]] = Record(
    "A count outside its limits.",
    Quantity("estimator", itemgetter(0), "estimator of the quantity"),
    Quantity("group", itemgetter(1), "group of the quantity"),
    Quantity("key", itemgetter(2), "key of the quantity"),
    Quantity("level", itemgetter(3), "confidence level of the intervals"),
    Quantity("covered", itemgetter(4), "number of intervals that contain the truth"),
)
STATES: Record[Coverage] = Record(
    "Coverage in random states.",
    Quantity("drawn", lambda r: r.drawn, "number of states drawn"),
    Quantity("measured", lambda r: r.measured, "number of states whose spots stay on their CCDs"),
    Quantity("false_alarm", lambda r: FALSE, "probability that any count is outside its limits by chance"),
    Quantity(
        "estimators",
        lambda r: {
            name: _by_quantity(r.quantities, [_Counted(r, q, name) for q in range(len(r.quantities))])
            for name in r.errors
        },
        "errors of each quantity by each estimator",
        record=COUNT,
    ),
    Quantity("outliers", lambda r: r.outliers, "counts outside their limits", record=_OUTLIER),
    Quantity("chi_square_mean", lambda r: float(np.mean(r.chi_square)), "mean chi-square of the shifts"),
    Quantity("alarms", lambda r: r.alarms, "number of states whose chi-square exceeds its limit"),
    Quantity("alarms_limit", lambda r: r.alarm_limit, "largest number of alarms by chance"),
    Quantity("doubted", lambda r: r.doubted, "number of states in which the measurement contradicts sigma"),
    Quantity("sigma_agrees", lambda r: r.sigma_agrees, "no count outside its limits, no state doubted"),
)


def _by_quantity(
    quantities: Sequence[limits.Quantity], values: Sequence[Any] | np.ndarray
) -> dict[str, dict[str, Any]]:
    """Return values by quantity, as nested mappings from group and key to value.

    Parameters
    ----------
    quantities : Sequence[limits.Quantity]
        The Q quantities.
    values : sequence
        The Q values.
    """
    out: dict[str, dict[str, Any]] = {}
    for quantity, value in zip(quantities, values, strict=True):
        out.setdefault(quantity.group, {})[quantity.key] = value
    return out


def uncertainty_numbers(run: UncertaintyRun) -> dict[str, Any]:
    """Return the contents of uncertainty.json: the limits as in the main job, and ``states`` with the random states.

    Parameters
    ----------
    run : UncertaintyRun
        Run of the command.
    """
    out = LIMITS(run.limits)
    if run.coverage is not None:
        out["states"] = {"seed": run.seed, **STATES(run.coverage)}
    return out
