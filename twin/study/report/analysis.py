"""Everything that the report says of a study, as numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from scenes.study import StudySpec
from twin.study.report.convergence import Course, courses
from twin.study.report.linear_model import LinearModel, MainEffect, linear_model, main_effects
from twin.study.report.pareto import ParetoFront, pareto_front
from twin.study.report.requirement import Requirement, requirements
from twin.study.report.sensitivity_indices import Indices, Untold, sensitivity_indices
from twin.study.report.statistics import CONFIDENCE, Description, Estimate, describe
from twin.study.report.study_runs import Factor, StudyRuns


@dataclass(frozen=True, eq=False)
class StudyAnalysis:
    """What was found; mappings go by the name of the response.

    Attributes:
        runs: the study's.
        descriptions: statistics of responses and of stated sigmas.
        linear: None where no model can be fitted.
        effects: main effects of a grid; empty in drawn designs.
        indices: empty when the study does not ask for them.
        courses: how the statistics settle; empty for grids.
        requirements: in the study's order, then all together.
        fronts: of the pairs that the study asks for and that are numbers.
        not_numbers: pairs that are not.
    """

    runs: StudyRuns
    descriptions: Mapping[str, Description]
    linear: Mapping[str, LinearModel | None]
    effects: Mapping[str, tuple[MainEffect, ...]]
    indices: Mapping[str, Indices | Untold]
    courses: Mapping[str, tuple[Course, ...]]
    requirements: tuple[Requirement, ...]
    fronts: tuple[ParetoFront, ...]
    not_numbers: tuple[str, ...]

    @classmethod
    def of(cls, runs: StudyRuns) -> StudyAnalysis:
        """Analyse all runs."""
        everything = runs.everything
        indexed = everything if runs.study.report.sobol else ()
        fronts, wrong = [], []
        for spec in runs.study.report.pareto:
            x, y = runs.find(spec.x), runs.find(spec.y)
            if any(isinstance(thing, Factor) and not thing.numeric for thing in (x, y)):
                wrong.append(f"{spec.x} and {spec.y}")
            else:
                # a run without a response is no compromise
                fronts.append(pareto_front(spec, x.values, y.values))
        return cls(
            runs=runs,
            descriptions={r.name: describe(r.values, runs.drawn) for r in everything},
            linear={r.name: linear_model(runs.factors, r) for r in everything},
            effects={r.name: () if runs.drawn else main_effects(runs.factors, r) for r in everything},
            indices={r.name: sensitivity_indices(runs, r) for r in indexed},
            courses={r.name: courses(r.known) if runs.drawn and not r.constant else () for r in runs.responses},
            requirements=requirements(runs),
            fronts=tuple(fronts),
            not_numbers=tuple(wrong),
        )

    def influence(self, response: str) -> dict[str, float]:
        """Factor -> how much of the response's variance it moves, the largest first; for orders and choices only.

        The total index where there is one, otherwise the squared standardised coefficient or the share of the main
        effect.
        """
        found = self.indices.get(response)
        out = {factor.name: 0.0 for factor in self.runs.factors}
        std = self.descriptions[response].std
        if isinstance(found, Indices):
            out.update({name: index.total.value for index in found.axes for name in index.factors})
        elif self.effects[response] and std is not None and std.value > 0.0:
            out.update({effect.factor: float(np.var(effect.means)) / std.value**2 for effect in self.effects[response]})
        else:
            model = self.linear[response]
            for effect in model.effects if model is not None else ():
                # a swing over 90% of a text's values is some 3 sigma
                size = effect.coefficient.value if effect.coefficient is not None else _swing_in_sigmas(effect, std)
                out[effect.factor] = size**2
        return dict(sorted(out.items(), key=lambda item: -item[1]))


def _swing_in_sigmas(effect: Any, std: Estimate | None) -> float:
    return float(effect.swing.value) / (2.0 * std.value) if std is not None and std.value > 0.0 else 0.0


def summary(dataset: xr.Dataset, study: StudySpec) -> dict[str, Any]:
    """What the report says of a study, as plain data for JSON; intervals are those of 95%."""
    return plain_data(StudyAnalysis.of(StudyRuns.of(dataset, study)))


def plain_data(found: StudyAnalysis) -> dict[str, Any]:
    """An analysis as plain data; null where the runs cannot tell a number."""
    runs = found.runs
    return {
        "name": runs.study.name,
        "design": runs.kind,
        "runs": runs.count,
        "failed": int(runs.failed.sum()),
        "confidence": CONFIDENCE,
        "responses": {
            r.name: {
                "unit": r.unit,
                **({"sigma_of": r.of} if r.of else {}),
                **_description(found.descriptions[r.name]),
                "linear_model": _linear(found.linear[r.name]),
                "main_effects": [
                    {"factor": e.factor, "levels": e.levels.tolist(), "means": e.means.tolist(), "swing": e.swing}
                    for e in found.effects[r.name]
                ],
                **({"sobol": _indices(found.indices[r.name])} if r.name in found.indices else {}),
                "convergence": {c.name: _course(c) for c in found.courses.get(r.name, ())},
            }
            for r in runs.everything
        },
        "requirements": [
            {
                "name": r.name or "all",
                "text": r.text,
                "met": r.met,
                "runs_with_a_number": r.count,
                "share": r.share,
                "interval": list(r.interval) if r.interval is not None else None,
            }
            for r in found.requirements
        ],
        "pareto": [
            {
                "x": f.spec.x,
                "y": f.spec.y,
                "best_x": f.spec.best_x,
                "best_y": f.spec.best_y,
                "runs": f.runs.tolist(),
                "knee_run": None if f.knee is None else int(f.runs[f.knee]),
            }
            for f in found.fronts
        ],
    }


def _number(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else float(value)


def _estimate(value: Estimate | None) -> dict[str, Any] | None:
    if value is None:
        return None
    return {"value": _number(value.value), "interval": [_number(end) for end in value.interval]}


def _description(d: Description) -> dict[str, Any]:
    return {
        "count": d.count,
        **{name: _estimate(getattr(d, name)) for name in ("mean", "std", "median", "p95", "p997")},
        "min": d.low,
        "max": d.high,
        "skewness": d.normality.skewness if d.normality else None,
        "excess_kurtosis": d.normality.kurtosis if d.normality else None,
        "normality_p": d.normality.p if d.normality else None,
        "p0135": d.tails[0] if d.tails else None,
        "p99865": d.tails[1] if d.tails else None,
    }


def _linear(model: LinearModel | None) -> dict[str, Any] | None:
    if model is None:
        return None
    return {
        "r2": model.r2,
        "adjusted_r2": model.adjusted,
        "effects": {
            e.factor: {
                "swing": _estimate(e.swing),
                "standardised_coefficient": _estimate(e.coefficient),
                "rank_correlation": _estimate(e.rank),
            }
            for e in model.effects
        },
        "not_separable": list(model.cannot),
    }


def _indices(found: Indices | Untold) -> dict[str, Any]:
    if isinstance(found, Untold):
        return {"method": None, "reason": found.reason}
    return {
        "method": found.method,
        "degree": found.degree,
        "terms": found.terms,
        "held_out_r2": found.held_out,
        "unexplained_share": found.rest,
        "noise_share": found.noise,
        "factors": {
            index.name: {
                "first": _estimate(index.first),
                "total": _estimate(index.total),
                "first_rbd_fast": index.check,
            }
            for index in found.axes
        },
    }


def _course(course: Course) -> dict[str, Any]:
    return {
        "relative_half_width": course.relative,
        "enough_runs": course.enough,
        "runs_needed": course.needed,
    }
