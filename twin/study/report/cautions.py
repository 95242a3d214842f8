"""What the reader of a study's report must know before using its numbers."""

from __future__ import annotations

from collections import Counter

from twin.study.report.analysis import StudyAnalysis
from twin.study.report.convergence import GOALS, Course
from twin.study.report.sensitivity_indices import HARMONICS, RESAMPLES, Indices, Untold
from twin.study.report.statistics import LEAST
from twin.study.report.wording import listed, percent, plural

MANY_FAILED = 0.05
BAD_MODEL = 0.8
DESIGNS = {
    "grid": "complete grid",
    "latin_hypercube": "Latin hypercube",
    "sobol": "scrambled Sobol sequence",
    "monte_carlo": "Monte Carlo",
}


def warnings(found: StudyAnalysis) -> list[str]:
    """Shown in front of everything else."""
    runs = found.runs
    failed = int(runs.failed.sum())
    out = []
    if failed:
        common = [f"{text} ({plural(n, 'run')})" for text, n in Counter(t for t in runs.messages if t).most_common(3)]
        why = f" Most often: {'; '.join(common)}." if common else ""
        out.append(f"{failed} of {plural(runs.count, 'run')} failed and are in no statistic.{why}")
        if failed > MANY_FAILED * runs.count and failed < runs.count:
            out.append(
                "So many failed that the others no longer follow the design; statistics are those of what can be done."
            )
    for r in runs.responses:
        missing = int((~r.good & ~runs.failed).sum())
        if missing:
            out.append(f"{r.name} has no finite number in {plural(missing, 'run')} that did not fail.")
    if runs.drawn and failed < runs.count < LEAST:
        out.append(
            f"{plural(runs.count, 'run')} are few: distributions, upper quantiles and sensitivity indices cannot be "
            f"told from fewer than {LEAST}, and intervals are wide."
        )
    return out


def indices_texts(found: StudyAnalysis) -> list[str]:
    """How the indices were found, and how good that is."""
    if found.runs.drawn:
        out = [
            f"From the given runs ({DESIGNS[found.runs.kind]}; not a design made for the indices): polynomial "
            f"chaos, whose squared coefficients are the parts of the variance; intervals from {RESAMPLES} resamples by "
            f"the wild bootstrap. RBD-FAST with {HARMONICS} harmonics beside it."
        ]
    else:
        out = [
            "The grid is complete, so that its variance is taken apart exactly, all combinations being equally likely. "
            "Noise that differs from run to run counts as an interaction of all factors and raises every total index."
        ]
    for name, part in found.indices.items():
        if isinstance(part, Untold):
            out.append(f"{name}: {part.reason}.")
        elif part.method == "chaos":
            out.append(_model_text(name, part))
        elif part.noise is not None and part.noise > 0.01:
            out.append(f"{name}: the runs' own sigmas state {percent(min(part.noise, 1.0))} of the variance as noise.")
    return out


def _model_text(name: str, part: Indices) -> str:
    assert part.held_out is not None
    text = (
        f"{name}: degree {part.degree}, {plural(part.terms, 'term')}, R² of held-out runs {part.held_out:.4f}, "
        f"{percent(part.rest)} of the variance not explained"
    ).replace("-", "\N{MINUS SIGN}" if part.held_out < 0 else "-")
    if part.noise is not None:
        text += f" (noise by the runs' own sigmas: {percent(min(part.noise, 1.0))})"
    explained = part.rest - (part.noise or 0.0) < 0.05
    if part.held_out < BAD_MODEL and not explained:
        text += "; so poor a model tells orders of importance at best"
    return f"{text}."


def convergence_texts(found: StudyAnalysis, names: list[str]) -> list[str]:
    """Whether there are enough runs."""
    goals = (
        f"A statistic counts as known when half its 95% interval is below {GOALS['mean']:g}σ (mean, standard "
        f"deviation) or {GOALS['p95']:g}σ (quantiles)."
    )
    out = [goals]
    if found.runs.kind == "latin_hypercube" or found.runs.kind == "sobol":
        out.append(
            "The intervals are those of independent runs; this design is spread more evenly, and knows the mean better."
        )
    for name in names:
        courses = found.courses[name]
        good = [c.name for c in courses if c.enough]
        bad = [f"{c.name}{_needed(c)}" for c in courses if not c.enough]
        n = int(courses[0].counts[-1])
        if not bad:
            out.append(f"{name}: {n} runs are enough for {listed(good)}.")
        else:
            enough = f"enough for {listed(good)}, " if good else ""
            out.append(f"{name}: {n} runs are {enough}too few for {listed(bad)}.")
    return out


def _needed(course: Course) -> str:
    if course.needed is None:
        return ""
    how = "about" if course.relative is not None else "at least"
    return f" ({how} {_round_up(course.needed)} runs)"


def _round_up(count: int) -> int:
    """Two digits."""
    step = 10 ** max(len(str(count)) - 2, 0)
    return -(-count // step) * step
