"""Verdict and warnings of a study, and the formatting of its numbers."""

from collections import Counter

from scenes.specs.study import GRID, SAMPLERS
from twin.framework.artefact import decimals_for, fixed, significant
from twin.framework.report import answer
from twin.study.report import study_statistics
from twin.study.report.sensitivity_indices import MANY_FAILED, RESAMPLES, Indices, NoIndices
from twin.study.report.study_analysis import Requirement, StudyAnalysis

BAD_MODEL = 0.8
"""Cross-validated R² below which the report calls the polynomial chaos model of a response poor."""


def design_title(kind: str) -> str:
    """Return the name of a kind of design as the report writes it."""
    return "complete grid" if kind == GRID else SAMPLERS[kind].title


def warnings(analysis: StudyAnalysis) -> list[str]:
    """Return the warnings, which precede everything else in the report."""
    runs = analysis.runs
    failed = int(runs.failed.sum())
    out = []
    if failed:
        common = [f"{text} ({plural(n, 'run')})" for text, n in Counter(t for t in runs.messages if t).most_common(3)]
        why = f" Most often: {'; '.join(common)}." if common else ""
        out.append(f"{failed} of {plural(runs.count, 'run')} failed and are excluded from all statistics.{why}")
        if failed > MANY_FAILED * runs.count and failed < runs.count:
            out.append(
                "So many runs failed that the others no longer represent the design; the statistics hold only for "
                "feasible runs."
            )
    wrong = study_statistics.impossible_noise(runs)
    out += [str(issue) for issue in wrong.issues] if wrong is not None else []
    for name, part in analysis.indices.items():
        disagreeing = [index for index in part.axes if index.agrees is False] if isinstance(part, Indices) else []
        if disagreeing:
            out.append(
                f"{name}: the Sobol indices of {', '.join(index.name for index in disagreeing)} by polynomial chaos "
                "and by RBD-FAST do not agree, so that neither is reliable: use more runs."
            )
    doubts = [text for text in runs.doubts if text]
    if doubts:
        # the same words about other numbers are one reason
        common = [f"{text} ({plural(n, 'run')})" for text, n in Counter(map(_reason, doubts)).most_common(3)]
        out.append(
            f"σ does not hold in {len(doubts)} of {plural(runs.count, 'run')}; their readings are included in all "
            f"statistics: {'; '.join(common)}. The column doubt lists these runs."
        )
    for r in runs.responses:
        missing = int((~r.good & ~runs.failed).sum())
        if missing:
            out.append(f"{r.name} has no finite number in {plural(missing, 'run')} that did not fail.")
    if runs.sampled and failed < runs.count < study_statistics.LEAST:
        out.append(
            f"{plural(runs.count, 'run')} are few: distributions, upper quantiles and sensitivity indices need at "
            f"least {study_statistics.LEAST}, and intervals are wide."
        )
    return out


def _reason(doubt: str) -> str:
    """Return the start of a run's warning, without numbers and spot names, so that equal warnings can be counted."""
    head, _, rest = doubt.partition("; ")
    if "fit of the spots" in head:
        return f"the fit of spots is not good: {rest.partition(':')[0].partition('. ')[0]}"
    return head.removeprefix("σ does not hold: ").partition(" (")[0]


def index_remarks(analysis: StudyAnalysis) -> list[str]:
    """Return sentences on how the sensitivity indices were computed, and for which responses they are doubtful."""
    if analysis.runs.sampled:
        out = [
            f"From the runs ({design_title(analysis.runs.kind)}) by polynomial chaos, with intervals from {RESAMPLES} "
            f"bootstrap resamples. Events in less than {percent(3.7 / max(analysis.runs.count, 4), 1)} of the "
            "factors' distribution may be missed by all runs, and no interval covers them."
        ]
    else:
        out = ["The variance of the complete grid is decomposed exactly, with all combinations equally likely."]
    for name, part in analysis.indices.items():
        if isinstance(part, NoIndices):
            out.append(f"{name}: {part.reason}.")
        elif part.held_out is not None and part.held_out < BAD_MODEL and part.rest - (part.noise or 0.0) >= 0.05:
            out.append(f"{name}: such a poor model gives at best the order of importance (R² of held-out runs).")
    return out


LEAST_SHARE = 0.02
"""Fraction of a response's variance below which a factor is not named among the main factors."""


def verdict(analysis: StudyAnalysis) -> tuple[str, tuple[str, ...]]:
    """Return a study's verdict of two sentences, and the sentences that follow it.

    The verdict says how the requirements are met, or else which factors move the first response, and whether the runs
    suffice.
    """
    runs = analysis.runs
    failed = int(runs.failed.sum())
    first = [f"{plural(runs.count, 'run')}, {failed} failed" if failed else plural(runs.count, "run")]
    known = [r for r in analysis.requirements if r.share is not None]
    if known:
        # the last of several is all together
        worst = min(known, key=lambda r: (r.share, r.name))
        name = f"the requirement {worst.name} ({worst.text})" if worst.name else "all requirements together"
        least = ", the lowest share," if len(known) > 1 else ""
        are = "is" if worst.name else "are"
        whatever = _open_range(worst)
        first.append(
            f"{name} {are} met by {worst.met} of {plural(worst.count, 'run')} with a finite value{least}{whatever}"
        )
    elif runs.responses:
        first.append(f"Response {_response_text(analysis, runs.responses[0])}")
    short = [
        name
        for name, statistics in analysis.convergences.items()
        if not all(convergence.enough for convergence in statistics)
    ]
    if short:
        first.append(
            f"the runs are too few for some statistics of {plural(len(short), 'response')}: see the convergence"
        )
    return answer(*(part for text in first for part in text.split(". ")))


def _open_range(r: Requirement) -> str:
    """Return the possible range of the fraction that meets the requirement, as the end of a sentence.

    The range is open because failed runs may or may not have met it.
    """
    if r.bounds is None:
        return ""
    interval = f" (95% interval {span(r.bounds_interval)})" if r.bounds_interval is not None else ""
    return f", or by {r.met} to {r.most} of all {r.runs} runs, whatever the others would have given{interval}"


def _response_text(analysis: StudyAnalysis, response: study_statistics.Response) -> str:
    about, factors = analysis.descriptions[response.name], main_factors(analysis, response)
    if response.constant:
        return f"{response.name} {factors}: {with_unit(about.low, response.unit, 6)}."
    mean, std = (with_unit(e.value if e else None, response.unit) for e in (about.mean, about.std))
    where = "" if analysis.runs.sampled else " over the grid"
    text = f"{response.name}: mean {mean}, standard deviation {std}{where}."
    return f"{text} Main factors: {factors}." if factors else text


def main_factors(analysis: StudyAnalysis, response: study_statistics.Response) -> str:
    """Return up to three factors with the shares of a response's variance that they explain, or why there are none.

    The shares are total Sobol indices if the study asks for them, otherwise those of the main effects of a grid or of
    the linear model, whose factors count only where their effect exceeds its 95% interval.
    """
    count, model = analysis.descriptions[response.name].count, analysis.linear[response.name]
    if response.constant:
        return f"is the same in all {plural(count, 'run')}" if count else "the value is NaN in all runs"
    sure = set(analysis.runs.study.factors)
    if analysis.runs.sampled and model is not None and not isinstance(analysis.indices.get(response.name), Indices):
        ends = {e.factor: e.swing.interval for e in model.effects}
        sure = {name for name, (low, high) in ends.items() if (low or 0.0) > 0.0 or (high or 0.0) < 0.0}
    shares = analysis.influence(response.name).items()
    named = [(name, value) for name, value in shares if value >= LEAST_SHARE and name in sure]
    return ", ".join(f"{name} {percent(min(value, 1.0), 0)}" for name, value in named[:3])


DASH = "\N{EN DASH}"


def number(value: float | None, digits: int = 4) -> str:
    """Return a number as text with ``digits`` significant digits, or a dash for None."""
    return DASH if value is None else significant(value, digits, floor=0.0)


def with_unit(value: float | None, unit: str, digits: int = 3) -> str:
    """Return a number as text with its unit."""
    sign = study_statistics.typeset(unit)
    space = "" if sign in ("°", "") else " "
    return f"{number(value, digits)}{space}{sign}"


def limits(interval: study_statistics.Interval) -> str:
    """Return an interval as text, with a question mark for an end that is unknown (None)."""
    low, high = interval
    if low is None and high is None:
        return ""
    if low is not None and high is not None:
        decimals = decimals_for(0.5 * abs(high - low))
        if decimals < 7 and max(abs(low), abs(high)) < 1e6:
            return f"{fixed(low, decimals)} … {fixed(high, decimals)}"
    return f"{'?' if low is None else number(low, 4)} … {'?' if high is None else number(high, 4)}"


def with_limits(value: study_statistics.Estimate | None) -> str:
    """Return an estimate with its confidence interval as text; the interval determines the number of decimals."""
    if value is None:
        return DASH
    low, high = value.interval
    if low is not None and high is None and value.value <= low:
        return f"> {number(low)}"
    half = value.half_width
    if half == 0.0:
        return number(value.value)
    if half is not None:
        decimals = decimals_for(half)
        if decimals < 7 and abs(value.value) < 1e6:
            return f"{fixed(value.value, decimals)} ({limits(value.interval)})"
    text = limits(value.interval)
    return f"{number(value.value)} ({text})" if text else number(value.value)


def share(value: study_statistics.Estimate | None) -> str:
    """Return a sensitivity index between 0 and 1 with its confidence interval as text, with three decimals."""
    if value is None:
        return DASH
    low, high = value.interval
    text = fixed(value.value, 3)
    return text if low is None or high is None else f"{text} ({fixed(low, 3)} … {fixed(high, 3)})"


def percent(value: float | None, decimals: int = 1) -> str:
    """Return a fraction as percent; values that would round to 0 or 100 without being equal get a sign < or >."""
    if value is None:
        return DASH
    least = 10.0 ** -(decimals + 2)
    if 0.0 < value < 0.5 * least:
        return f"< {fixed(100.0 * least, decimals)}%"
    if 1.0 - 0.5 * least < value < 1.0:
        return f"> {fixed(100.0 * (1.0 - least), decimals)}%"
    return f"{fixed(100.0 * value, decimals)}%"


def span(interval: tuple[float, float] | None) -> str:
    """Return an interval of a fraction as text in percent, or a dash for None."""
    return DASH if interval is None else f"{percent(interval[0])} … {percent(interval[1])}"


def plural(count: int, noun: str) -> str:
    """Return a count with its noun, such as "1 run" and "2 runs"."""
    return f"{count} {noun}{'' if count == 1 else 's'}"
