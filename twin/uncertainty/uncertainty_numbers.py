"""Records of the contents of uncertainty.json."""

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
"""Number of motions that are listed for a combination."""


@dataclass(frozen=True, eq=False)
class _Limited:
    """Limits of one quantity before the measurement, or after it by an estimator."""

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
    def known(self) -> dict[str, float]:
        return {name: float(self.limits.known[name][self.q]) for name, _ in self.after[BEST].lines[:LINES]}

    @property
    def motions(self) -> list[tuple[str, float, str]]:
        """Label, amount and unit of the motions in the least observable combination."""
        amounts, stated = self.limits.least_seen[self.q].amounts, self.limits.stated
        order = np.argsort(-np.abs(amounts), kind="stable")[:SEEN]
        return [(stated.labels[k], float(amounts[k] * stated.sigmas[k]), stated.units[k]) for k in order]

    def held(self, level: int) -> float:
        return float(self.limits.heavy_tail.held[level, self.q])

    @property
    def followed(self) -> list[tuple[Elasticity, int]]:
        """Numbers of the prior with the largest elasticities, each with the quantity's index."""
        found = sorted(self.limits.elasticities, key=lambda one: -float(one.elasticity[self.q]))[:LINES]
        return [(one, self.q) for one in found]


SHARE: Record[tuple[str, float]] = Record(
    "Share of a motion in a variance; the shares of motions that go together may be negative.",
    Quantity("motion", itemgetter(0), "label of the motion"),
    Quantity("share", itemgetter(1), "its share of the variance"),
)
_SPLIT: Record[_Limited] = Record(
    "A variance by motions.",
    Quantity("sigma", lambda one: one.sigma, "standard deviation, whose square is shared out"),
    Quantity("lines", lambda one: one.lines[:LINES], "motions with the largest shares, largest first", record=SHARE),
    Quantity("rest", lambda one: float(sum(share for _, share in one.lines[LINES:])), "share of all other motions"),
    Quantity("noise", lambda one: one.noise, "share of the noise of the images"),
)
_AMOUNT: Record[tuple[str, float, str]] = Record(
    "A motion in a combination of motions.",
    Quantity("motion", itemgetter(0), "label of the motion"),
    Quantity("amount", itemgetter(1), "its amount in the combination"),
    Quantity("unit", itemgetter(2), "unit of the amount"),
)
_SEEN_LEAST: Record[_Limited] = Record(
    "Motions that change a quantity and that the spots see least.",
    Quantity("change", lambda one: one.limits.least_seen[one.q].change, "change of the quantity by all of them"),
    Quantity("motions", lambda one: one.motions, "the largest of them", record=_AMOUNT),
    Quantity("spots_px", lambda one: one.limits.least_seen[one.q].spots, "how far they move the spots"),
    Quantity("spots_noise_px", lambda one: one.limits.least_seen[one.q].noise, "standard deviation of their noise"),
)
_ELASTICITY: Record[tuple[Elasticity, int]] = Record(
    "How the posterior's standard deviation follows a stated number.",
    Quantity("number", lambda one: one[0].number, "name of the stated number"),
    Quantity("stated", lambda one: one[0].size, "the number as it is stated"),
    Quantity("unit", lambda one: one[0].unit, "unit of the number"),
    Quantity("bodies", lambda one: len(one[0].bodies), "how many bodies it is stated for"),
    Quantity("elasticity", lambda one: float(one[0].elasticity[one[1]]), "relative change per relative change"),
    Quantity(
        "doubled",
        lambda one: float(one[0].doubled[one[1]]),
        "standard deviation if the number is twice as large, unknown to the estimator",
    ),
    Quantity(
        "doubled_stated",
        lambda one: float(one[0].told[one[1]]),
        "standard deviation if the number is twice as large and stated so",
    ),
)
_HEAVY_TAIL: Record[_Limited] = Record(
    "Errors of the posterior if each stated number is the scale of Student's distribution.",
    Quantity("degrees", lambda one: one.limits.heavy_tail.degrees, "degrees of freedom of that distribution"),
    Quantity("rms", lambda one: float(one.limits.heavy_tail.rms[one.q]), "root mean square of the error"),
    Quantity("held_68", lambda one: one.held(0), "half width of the interval that holds 68.3 % of the errors"),
    Quantity("held_95", lambda one: one.held(1), "half width of the interval that holds 95.4 % of the errors"),
    Quantity("held_997", lambda one: one.held(2), "half width of the interval that holds 99.7 % of the errors"),
    Quantity(
        "beyond_3_sigma",
        lambda one: float(one.limits.heavy_tail.beyond[one.q]),
        "chance of an error beyond 3 sigma; 0.0027 of a normal error",
    ),
)
_LIMITED: Record[_Limited] = Record(
    "What limits one quantity, in the unit that its key ends in.",
    Quantity("before", lambda one: one, "variance before the measurement", record=_SPLIT),
    Quantity("after", lambda one: one.after, "variance that each estimator leaves", record=_SPLIT),
    Quantity("known", lambda one: one.known, "standard deviation that is left if that motion is known"),
    Quantity("least_seen", lambda one: one, "motions that hide from the spots", record=_SEEN_LEAST),
    Quantity(
        "from_statement",
        lambda one: float(one.limits.from_statement[one.q]),
        "share of the posterior's variance that no spot constrains",
    ),
    Quantity("elasticities", lambda one: one.followed, "stated numbers that make most of it", record=_ELASTICITY),
    Quantity("student_t", lambda one: one, "what a statement with heavy tails leaves", record=_HEAVY_TAIL),
)
_REMEDY: Record[tuple[Remedy, Sequence[limits.Quantity]]] = Record(
    "A further measurement.",
    Quantity("what", lambda one: one[0].what, "the measurement in words"),
    Quantity("left", lambda one: _by_quantity(one[1], one[0].sigma), "standard deviation that it leaves of a quantity"),
)
LIMITS: Record[MonitorLimits] = Record(
    "uncertainty.json",
    Quantity("name", lambda found: found.instrument, "the instrument"),
    Quantity("disturbances", lambda found: found.stated.name, "what is stated to move"),
    Quantity("frames", lambda found: found.frames, "frames of each state"),
    Quantity("outside", lambda found: found.outside, "chance that a spot leaves its CCD"),
    Quantity(
        "quantities",
        lambda found: _by_quantity(found.quantities, [_Limited(found, q) for q in range(len(found.quantities))]),
        "what limits each quantity",
        record=_LIMITED,
    ),
    Quantity(
        "remedies",
        lambda found: {one.name: (one, found.quantities) for one in found.remedies},
        "what further measurements would leave",
        record=_REMEDY,
    ),
)


@dataclass(frozen=True, eq=False)
class _Counted:
    """Errors of one quantity by one estimator in random states."""

    coverage: Coverage
    q: int
    estimator: str

    def held(self, level: int) -> float:
        return float(self.coverage.held(self.estimator, level)[self.q]) / self.coverage.measured

    def limits(self, level: int) -> np.ndarray:
        return self.coverage.limits(self.estimator, level)[:, self.q] / self.coverage.measured

    def expected(self, level: int) -> float:
        return float(self.coverage.expected[self.estimator][level][self.q])


COUNT: Record[_Counted] = Record(
    "Errors of one quantity by one estimator in random states.",
    Quantity("rms", lambda one: float(one.coverage.rms(one.estimator)[one.q]), "root mean square of the errors"),
    Quantity(
        "rms_over_sigma",
        lambda one: float(one.coverage.ratio(one.estimator)[one.q]),
        "root mean square of the errors over their sigmas",
    ),
    Quantity("held_68", lambda one: one.held(0), "share of the intervals of 68 % that hold the truth"),
    Quantity("held_95", lambda one: one.held(1), "share of the intervals of 95 % that hold the truth"),
    Quantity("expected_68", lambda one: one.expected(0), "share of the intervals of 68 % that should hold the truth"),
    Quantity("expected_95", lambda one: one.expected(1), "share of the intervals of 95 % that should hold the truth"),
    Quantity("limits_68", lambda one: one.limits(0), "limits of held_68 if every sigma is right"),
    Quantity("limits_95", lambda one: one.limits(1), "limits of held_95 if every sigma is right"),
)
_OUTLIER: Record[tuple[str, str, str, float, int]] = Record(
    "A count that is beyond its limits.",
    Quantity("estimator", itemgetter(0), "who reads the quantity"),
    Quantity("group", itemgetter(1), "group of the quantity"),
    Quantity("key", itemgetter(2), "key of the quantity"),
    Quantity("level", itemgetter(3), "share of the truths that the intervals should hold"),
    Quantity("held", itemgetter(4), "how many intervals hold the truth"),
)
STATES: Record[Coverage] = Record(
    "What random states gave.",
    Quantity("drawn", lambda found: found.drawn, "states that were drawn"),
    Quantity("measured", lambda found: found.measured, "states whose spots stay on their CCDs"),
    Quantity("false_alarm", lambda found: FALSE, "chance that any count falls out of its limits"),
    Quantity(
        "estimators",
        lambda found: {
            name: _by_quantity(found.quantities, [_Counted(found, q, name) for q in range(len(found.quantities))])
            for name in found.errors
        },
        "errors of each quantity by each estimator",
        record=COUNT,
    ),
    Quantity("outliers", lambda found: found.outliers, "counts that are beyond their limits", record=_OUTLIER),
    Quantity("chi_square_mean", lambda found: float(np.mean(found.chi_square)), "mean chi-square of the shifts"),
    Quantity("alarms", lambda found: found.alarms, "states whose chi-square is beyond its limit"),
    Quantity("alarms_limit", lambda found: found.alarm_limit, "largest number of alarms by chance"),
    Quantity("doubted", lambda found: found.doubted, "states for which sigma does not hold by what is measured"),
    Quantity("sigma_holds", lambda found: found.sigma_holds, "no count beyond its limits, no state doubted"),
)


def _by_quantity(
    quantities: Sequence[limits.Quantity], values: Sequence[Any] | np.ndarray
) -> dict[str, dict[str, Any]]:
    """Return values by quantity, as group -> key -> value.

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
    """Return the contents of uncertainty.json: those of the main job, and ``states`` with the random states.

    Parameters
    ----------
    run : UncertaintyRun
        Run of the command.
    """
    out = LIMITS(run.limits)
    if run.coverage is not None:
        out["states"] = {"seed": run.seed, **STATES(run.coverage)}
    return out
