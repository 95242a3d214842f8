"""Conclusions of a study as sentences, formatting of its numbers, and its warnings."""

from collections import Counter
from collections.abc import Sequence

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
                f"{name}: the Sobol indices of {listed([index.name for index in disagreeing])} by polynomial chaos and "
                "by "
                "RBD-FAST do not agree, so that neither is reliable: use more runs."
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


def indices_texts(analysis: StudyAnalysis) -> list[str]:
    """Return sentences on how the sensitivity indices were computed, and how accurate they are."""
    if analysis.runs.sampled:
        out = [
            f"From the runs ({design_title(analysis.runs.kind)}) by polynomial chaos, with intervals from {RESAMPLES} "
            "bootstrap resamples. Events in less than "
            f"{percent(3.7 / max(analysis.runs.count, 4), 1)} of the "
            "factors' distribution may be missed by all runs, and no interval covers them."
        ]
    else:
        out = ["The variance of the complete grid is decomposed exactly, with all combinations equally likely."]
    for name, part in analysis.indices.items():
        if isinstance(part, NoIndices):
            out.append(f"{name}: {part.reason}.")
        elif part.method == "chaos":
            out.append(_model_text(name, part))
        elif part.noise is not None and part.noise > 0.01:
            out.append(f"{name}: the runs report {percent(part.noise)} of the variance as noise.")
    return out


def _model_text(name: str, part: Indices) -> str:
    assert part.held_out is not None
    text = (
        f"{name}: polynomial of degree {part.degree}, {plural(part.terms, 'term')}, R² of its predictions of held-out "
        f"runs {part.held_out:.4f}, {percent(part.rest)} of the variance not explained"
    ).replace("-", "\N{MINUS SIGN}" if part.held_out < 0 else "-")
    if part.noise is not None:
        text += f" (reported noise: {percent(part.noise)})"
    explained = part.rest - (part.noise or 0.0) < 0.05
    if part.held_out < BAD_MODEL and not explained:
        text += "; such a poor model gives at best the order of importance"
    return f"{text}."


LEAST_SHARE = 0.02
"""Fraction of a response's variance below which a factor is not named in the conclusions."""
LINEAR = 0.5
"""Coefficient of determination (R²) of the linear model below which the report says that the model is poor."""


def conclusions(analysis: StudyAnalysis) -> list[str]:
    """Return the sentences at the top of the report, the requirements first."""
    out = [_requirement_text(analysis)] if analysis.requirements else []
    out += [_knee(analysis, k) for k in range(len(analysis.fronts))]
    out += [_contributors(analysis, response) for response in analysis.runs.responses]
    # the reported sigmas of a grid count as responses; among drawn runs they hardly vary
    if not analysis.runs.sampled:
        out += [_contributors(analysis, sigma) for sigma in analysis.runs.sigmas]
    return [text for text in out if text]


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
        first.append(f"Response {_contributors(analysis, runs.responses[0])}")
    short = [r.name for r in runs.responses if runs.sampled and not r.constant and analysis.few_runs(r.name)]
    if short:
        first.append(f"the runs are too few for some statistics of {plural(len(short), 'response')}: see the intervals")
    return answer(*(part for text in first for part in text.split(". ")))


def _requirement_text(analysis: StudyAnalysis) -> str:
    texts = []
    for r in analysis.requirements:
        name = f"{r.name} ({r.text})" if r.name else "All requirements together"
        if r.share is None:
            texts.append(f"{name}: the value is NaN in all runs.")
            continue
        of = f" (95% interval {span(r.interval)})" if r.interval is not None else " of the grid"
        are = "is" if r.name else "are"
        texts.append(f"{name} {are} met by {percent(r.share)} of the runs, {r.met} of {r.count}{of}{_open_range(r)}.")
    return " ".join(texts)


def _open_range(r: Requirement) -> str:
    """Return the possible range of the fraction that meets the requirement, as the end of a sentence.

    The range is open because failed runs may or may not have met it.
    """
    if r.bounds is None:
        return ""
    interval = f" (95% interval {span(r.bounds_interval)})" if r.bounds_interval is not None else ""
    return f", or by {r.met} to {r.most} of all {r.runs} runs, whatever the others would have given{interval}"


def _contributors(analysis: StudyAnalysis, response: study_statistics.Response) -> str:
    about = analysis.descriptions[response.name]
    name = response.name
    if about.count == 0:
        return f"{name}: the value is NaN in all runs."
    if response.constant:
        return f"{name} is the same in all {plural(about.count, 'run')}: {with_unit(about.low, response.unit, 6)}."
    assert about.mean is not None
    assert about.std is not None
    mean = with_unit(about.mean.value, response.unit)
    std = with_unit(about.std.value, response.unit)
    where = "" if analysis.runs.sampled else " over the grid"
    text = f"{name}: mean {mean}, standard deviation {std}{where}."
    indices = analysis.indices.get(name)
    if isinstance(indices, Indices):
        big = [index for index in indices.axes if index.total.value >= LEAST_SHARE][:3]
        parts = [f"{index.name} {percent(index.total.value, 0)}" for index in big]
        if parts:
            together = sum(index.first.value for index in indices.axes) < 0.5 and indices.rest < 0.5
            text += f" Total Sobol indices: {listed(parts)}{', mostly by interaction' if together else ''}."
        rest = indices.rest
        if indices.method == "chaos" and rest > 0.05:
            text += f" {percent(rest, 0)} of the variance is not explained by the factors ({_rest_reason(indices)})."
        return text
    if analysis.effects[name]:
        unit = study_statistics.typeset(response.unit)
        parts = [f"{e.factor} {number(e.swing, 3)}" for e in analysis.effects[name][:3] if e.swing > 0.0]
        if parts:
            text += f" Largest main effects: {listed(parts)}{' ' + unit if unit else ''}."
        return text
    model = analysis.linear[name]
    if model is None:
        return f"{text} {plural(about.count, 'run')} are too few to find its main factors."
    sure = [e for e in model.effects if _sure(e.swing.interval)]
    share = max(model.adjusted, 0.0)
    if share < LINEAR and about.count >= study_statistics.LEAST:
        return f"{text} It is hardly linear in the factors (adjusted R² {percent(share, 0)}): see its response curves."
    if not sure:
        text += " No linear effect of a factor exceeds the scatter."
    else:
        parts = [f"{e.factor} {with_unit(e.swing.value, response.unit)}" for e in sure[:3]]
        text += f" Largest changes over the middle 90% of a factor: {listed(parts)}."
    text += f" All factors together explain {percent(share, 0)} of its variance linearly."
    if about.count < study_statistics.LEAST:
        text += f" With {about.count} runs this is only a first indication."
    return text


def _sure(interval: tuple[float | None, float | None]) -> bool:
    low, high = interval
    return low is not None and high is not None and (low > 0.0 or high < 0.0)


def _rest_reason(indices: Indices) -> str:
    if indices.noise is None:
        return "noise, or a shape that the model does not fit"
    if indices.noise > 0.7 * indices.rest:
        return f"noise: the runs report {percent(indices.noise, 0)}"
    return f"the runs report only {percent(indices.noise, 0)} as noise; the model does not fit the rest"


def _knee(analysis: StudyAnalysis, k: int) -> str:
    front = analysis.fronts[k]
    x, y = analysis.runs.find(front.spec.x), analysis.runs.find(front.spec.y)
    pair = f"{x.name} against {y.name}"
    if len(front.runs) == 0:
        return f"{pair}: no run has both values."
    if front.knee is None:
        if len(front.runs) == 1:
            return f"{pair}: run {front.runs[0]} is best in both; they do not compete."
        return f"{pair}: the Pareto front has {len(front.runs)} runs and no knee."
    run = int(front.runs[front.knee])
    x_text = with_unit(float(front.x[front.knee]), x.unit)
    position = f"{x.name} {x_text}, {y.name} {with_unit(float(front.y[front.knee]), y.unit)}"
    return f"{pair}: of {len(front.runs)} runs on the Pareto front run {run} is the knee ({position})."


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


def listed(texts: Sequence[str]) -> str:
    """Return texts joined as in "a, b and c"."""
    return texts[0] if len(texts) == 1 else f"{', '.join(texts[:-1])} and {texts[-1]}"


def plural(count: int, noun: str) -> str:
    """Return a count with its noun, such as "1 run" and "2 runs"."""
    return f"{count} {noun}{'' if count == 1 else 's'}"
