"""Statistics against the number of runs."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from twin.report.svg import BLUE, SKY
from twin.study.report.analysis import StudyAnalysis
from twin.study.report.panels import finish, panels
from twin.study.report.study_runs import Response, typeset

_TITLES = {"mean": "mean", "sigma": "standard deviation", "p95": "95% quantile", "p99.7": "99.7% quantile"}


def convergence_figure(found: StudyAnalysis, response: Response) -> Figure:
    """Mean, sigma and the upper quantiles of the first n runs, each with its interval."""
    courses = found.courses[response.name]
    figure, grid = panels(len(courses), len(courses), 2.8)
    for axes, course in zip(grid, courses, strict=True):
        both = np.isfinite(course.low) & np.isfinite(course.high)
        axes.fill_between(course.counts, course.low, course.high, where=both, color=SKY, alpha=0.4, lw=0)
        axes.plot(course.counts, course.values, color=BLUE, lw=1.3)
        axes.set_xscale("log")
        axes.set(title=f"{_TITLES[course.name]} of {response.name}", xlabel="runs")
        if not both.any():
            axes.text(0.03, 0.04, f"no upper limit below {course.needed} runs", transform=axes.transAxes, fontsize=7.5)
        finish(axes, None, 5)
    grid[0].set_ylabel(typeset(response.unit) or response.name)
    return figure
