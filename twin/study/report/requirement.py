"""Requirements on responses: the share of runs that meet them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scenes.study import ThresholdSpec
from twin.study.report.statistics import Description, describe, share_interval
from twin.study.report.study_runs import Response, StudyRuns


@dataclass(frozen=True)
class Requirement:
    """What became of a requirement.

    Attributes:
        name: of the requirement; empty for all of them together.
        text: in words.
        met: runs that meet it.
        count: runs that have a number.
        interval: of the share, in a drawn design; None in a grid.
        judged: statistics of what is judged: the response, or its size; None for all together.
        unit: of it.
    """

    name: str
    text: str
    met: int
    count: int
    interval: tuple[float, float] | None
    judged: Description | None
    unit: str

    @property
    def share(self) -> float | None:
        """Share of the runs with a number; None without any."""
        return self.met / self.count if self.count else None


def is_met(spec: ThresholdSpec, values: np.ndarray) -> np.ndarray:
    """(n,) whether each value meets the requirement; NaN does not."""
    judged = np.abs(values) if spec.magnitude else values
    good = np.isfinite(judged)
    if spec.at_most is not None:
        good &= judged <= spec.at_most
    if spec.at_least is not None:
        good &= judged >= spec.at_least
    return np.asarray(good)


def requirements(runs: StudyRuns) -> tuple[Requirement, ...]:
    """All requirements of a study, then, of several, all together."""
    out = []
    everything = np.ones(runs.count, bool)
    judged = np.ones(runs.count, bool)
    for name, spec in runs.study.report.thresholds.items():
        response = runs.find(spec.response)
        assert isinstance(response, Response)
        good = is_met(spec, response.values)
        everything &= good
        judged &= response.good
        values = np.abs(response.values) if spec.magnitude else response.values
        out.append(_counted(runs, name, _text(spec), good, response.good, describe(values, runs.drawn), response.unit))
    if len(out) > 1:
        out.append(_counted(runs, "", "all of them", everything, judged, None, ""))
    return tuple(out)


def _counted(
    runs: StudyRuns, name: str, text: str, good: np.ndarray, known: np.ndarray, judged: Description | None, unit: str
) -> Requirement:
    met, count = int(np.sum(good & known)), int(np.sum(known))
    interval = share_interval(met, count) if runs.drawn and count else None
    return Requirement(name, text, met, count, interval, judged, unit)


def _text(spec: ThresholdSpec) -> str:
    what = f"|{spec.response}|" if spec.magnitude else spec.response
    low = f"{spec.at_least:g} ≤ " if spec.at_least is not None else ""
    high = f" ≤ {spec.at_most:g}" if spec.at_most is not None else ""
    return f"{low}{what}{high}"
