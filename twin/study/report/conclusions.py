"""What a study found, in sentences."""

from __future__ import annotations

from twin.study.report.analysis import StudyAnalysis
from twin.study.report.sensitivity_indices import Indices
from twin.study.report.statistics import LEAST
from twin.study.report.study_runs import Response, typeset
from twin.study.report.wording import listed, number, percent, plural, span, with_unit

WORTH = 0.02
"""Smaller shares of the variance are not named."""
LINEAR = 0.5
"""Below this share of the variance a linear model says little about a response."""


def conclusions(found: StudyAnalysis) -> list[str]:
    """The sentences at the top of the report, the requirements first."""
    out = [_requirement_text(found)] if found.requirements else []
    out += [_knee(found, k) for k in range(len(found.fronts))]
    out += [_contributors(found, response) for response in found.runs.responses]
    # a stated sigma is a response of its own where it is all a grid is about; among drawn runs it hardly changes
    if not found.runs.drawn:
        out += [_contributors(found, sigma) for sigma in found.runs.sigmas]
    return [text for text in out if text]


def _requirement_text(found: StudyAnalysis) -> str:
    texts = []
    for r in found.requirements:
        name = f"{r.name} ({r.text})" if r.name else "All requirements together"
        if r.share is None:
            texts.append(f"{name}: no run has a number.")
            continue
        of = f" (95% interval {span(r.interval)})" if r.interval is not None else " of the grid"
        are = "is" if r.name else "are"
        texts.append(f"{name} {are} met by {percent(r.share)} of the runs, {r.met} of {r.count}{of}.")
    return " ".join(texts)


def _contributors(found: StudyAnalysis, response: Response) -> str:
    about = found.descriptions[response.name]
    name = response.name
    if about.count == 0:
        return f"{name}: no run has a number."
    if response.constant:
        return f"{name} is the same in all {plural(about.count, 'run')}: {with_unit(about.low, response.unit, 6)}."
    assert about.mean is not None
    assert about.std is not None
    mean = with_unit(about.mean.value, response.unit)
    std = with_unit(about.std.value, response.unit)
    where = "" if found.runs.drawn else " over the grid"
    text = f"{name}: mean {mean}, standard deviation {std}{where}."
    indices = found.indices.get(name)
    if isinstance(indices, Indices):
        big = [index for index in indices.axes if index.total.value >= WORTH][:3]
        parts = [f"{index.name} {percent(index.total.value, 0)}" for index in big]
        if parts:
            together = sum(index.first.value for index in indices.axes) < 0.5 and indices.rest < 0.5
            text += f" Total shares of its variance: {listed(parts)}{', mostly together' if together else ''}."
        left = indices.rest
        if indices.method == "chaos" and left > 0.05:
            text += f" {percent(left, 0)} are explained by no factor ({_rest_reason(indices)})."
        return text
    if found.effects[name]:
        unit = typeset(response.unit)
        parts = [f"{e.factor} {number(e.swing, 3)}" for e in found.effects[name][:3] if e.swing > 0.0]
        if parts:
            text += f" Largest main effects: {listed(parts)}{' ' + unit if unit else ''}."
        return text
    model = found.linear[name]
    if model is None:
        return f"{text} {plural(about.count, 'run')} are too few to tell what moves it."
    sure = [e for e in model.effects if _sure(e.swing.interval)]
    share = max(model.adjusted, 0.0)
    if share < LINEAR and about.count >= LEAST:
        return f"{text} Hardly linear in the factors ({percent(share, 0)} of its variance): its curves tell more."
    if not sure:
        text += " No factor has a linear effect that stands out of the scatter."
    else:
        parts = [f"{e.factor} {with_unit(e.swing.value, response.unit)}" for e in sure[:3]]
        text += f" Largest changes over the middle 90% of a factor: {listed(parts)}."
    text += f" All factors together explain {percent(share, 0)} of its variance linearly."
    if about.count < LEAST:
        text += f" With {about.count} runs this is a first look only."
    return text


def _sure(interval: tuple[float | None, float | None]) -> bool:
    low, high = interval
    return low is not None and high is not None and (low > 0.0 or high < 0.0)


def _rest_reason(indices: Indices) -> str:
    if indices.noise is None:
        return "noise, or a shape that the model does not follow"
    if indices.noise > 0.7 * indices.rest:
        return f"noise: the runs' own sigmas state {percent(min(indices.noise, 1.0), 0)}"
    return f"the runs' own sigmas state only {percent(indices.noise, 0)}; the model does not follow the rest"


def _knee(found: StudyAnalysis, k: int) -> str:
    front = found.fronts[k]
    x, y = found.runs.find(front.spec.x), found.runs.find(front.spec.y)
    pair = f"{x.name} against {y.name}"
    if len(front.runs) == 0:
        return f"{pair}: no run has both numbers."
    if front.knee is None:
        if len(front.runs) == 1:
            return f"{pair}: run {front.runs[0]} is best in both; they do not compete."
        return f"{pair}: {len(front.runs)} runs are best compromises; the front has no knee."
    run = int(front.runs[front.knee])
    x_text = with_unit(float(front.x[front.knee]), x.unit)
    places = f"{x.name} {x_text}, {y.name} {with_unit(float(front.y[front.knee]), y.unit)}"
    return f"{pair}: of {len(front.runs)} best compromises run {run} is the knee ({places})."
