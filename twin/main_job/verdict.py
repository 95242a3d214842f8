"""Verdict of a run in sentences computed from its numbers, and warnings about misleading estimates."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import ndtr, ndtri

from analysis.monitor import parameters
from analysis.monitor.monitor_formulas import PER_SI
from analysis.monitor.parameters import ANGLE_GROUP, GROUND_GROUP
from optics.geometry.tree import Motion
from scenes.models.job_state import beyond_prior
from scenes.specs.course import moment
from twin.framework.artefact import FAR, SAME, plain, residual_text, significant
from twin.framework.report import answer
from twin.main_job.monitor_reading import rounded
from twin.main_job.render_results import JobRun, RenderRun
from twin.main_job.systematics import (
    NOISE,
    combination,
    contradiction,
    doubted,
    joined,
    limits,
    share_text,
    systematics,
    unobserved_perturbations,
)
from twin.monitor.image_quality import ImageQuality
from twin.monitor.reading_table import Reading
from twin.monitor.time_series import TimeSeries

FALSE_ALARM = 1e-3
"""Probability that noise and disturbances of the prior alone cause any warning of a wrong estimate in a run."""
_EXPLAINED = 0.2
"""Fraction of an error that first-order crosstalk may leave unexplained if the error still counts as explained."""
_SOFTER = 0.05
"""Smallest relative loss of MTF at the Nyquist frequency that is reported."""
MOST_FRAMES = 10_000
"""Largest number of frames per state that the verdict recommends."""
_DIMMED = 0.5
"""Fraction of its nominal light below which a spot is reported as dimmed."""


@dataclass(frozen=True)
class Judgement:
    """Verdict of a run in at most two sentences, the text that follows, and all warnings.

    Warnings about wrong estimates come last.
    """

    verdict: str
    more: tuple[str, ...]
    warnings: tuple[str, ...]


def readings(run: RenderRun, estimator: str) -> tuple[Reading, ...]:
    """Return all changes estimated by an estimator: of cameras, of the angle between two, and on the ground.

    For a time series they are RMS values over its times.
    """
    return run.series.readings.rms.of(estimator) if run.series else run.reading.table.of(estimator)


def judge(run: JobRun) -> Judgement:
    """Return the verdict of a run, from its estimates, sigmas, true changes and crosstalk.

    Without a monitor, the verdict is based on the true changes and the images.
    """
    if not isinstance(run, RenderRun):
        return Judgement(*answer(*_changed(run)), run.warnings)
    rows = readings(run, run.judged)
    wrong = [r for r in rows if r.far]
    if run.series is not None:
        first, *others = _series_verdict(run, run.series, rows, wrong)
    elif not any(map(_moves, run.state.values())):
        first, *others = _nothing(run, rows, wrong)
    elif wrong:
        first, *others = _misled(run, rows, wrong)
    else:
        first, *others = _recovered(run, rows)
    unobserved = (*unobserved_perturbations(run), *run.reading.unobserved)
    computed = (*run.warnings, *doubted(run), *contradiction(run), *unobserved)
    warnings = (*computed, *_beyond_prior(run, rows, unobserved), *_misreadings(run))
    doubt = "σ does not hold for this measurement: see the warnings" if not run.sigma_holds else ""
    if contradicted := _contradicted_course(run):
        first, doubt = contradicted, first
    verdict, more = answer(first, doubt, *others, limited(run), _lost_light(run), _blurred(run))
    return Judgement(verdict, more, warnings)


def _changed(run: JobRun) -> tuple[str, str]:
    """Return two texts on how the perturbation changes geometry and images of an instrument without a monitor."""
    moved = any(map(_moves, run.state.values()))
    cameras = len(run.truth.cameras) > 1
    parts = [
        f"{parameter.symbol} {'of ' + group + ' ' if cameras and group in run.truth.cameras else ''}"
        f"{significant(value, 3, sign=True)} {parameter.unit}"
        for group, parameter, value in run.true_changes()
        if group != GROUND_GROUP and abs(value) > 0.5 * 10.0**-parameter.decimals
    ]
    text = f"The perturbation changes the geometry by {', '.join(parts)}"
    if not parts or not moved:
        text = "The perturbation does not change the geometry" if moved else "Nothing is perturbed"
    if run.quality is None:
        return text, ""
    worst: list[str] = []
    for name, camera in run.quality.cameras.items():
        before, after = (float(np.max(errors)) for errors in camera.wfe)
        camera_text = f" of {name}" if cameras else ""
        if not np.isfinite(before):
            worst.append(f"the image quality{camera_text} is not known: {camera.reasons[0]}")
        elif not np.isfinite(after):
            worst.append(f"the image quality{camera_text} after it is not known: {camera.reasons[1]}")
        elif moved:
            change = f"from {significant(before, 3)} to {significant(after, 3)} waves rms"
            worst.append(f"the worst wavefront error{camera_text} goes {change}")
        else:
            worst.append(f"the worst wavefront error{camera_text} is {significant(before, 3)} waves rms")
    share, _, change = sharpness_lost(run.quality)
    mtf_text = f", the largest loss of MTF with the pixel at Nyquist is {change}" if moved and share > 0.0 else ""
    return text, f"{', '.join(worst)}{mtf_text}"


def recovered_numbers(run: RenderRun) -> dict[str, Any]:
    """Return the contents of recovered.json: estimated changes, verdict and warnings."""
    judgement = judge(run)
    return {**rounded(run.recovered_dict()), "verdict": judgement.verdict, "warnings": list(judgement.warnings)}


def _moves(motion: Motion) -> bool:
    moved = (*motion.rotate, *motion.shift, motion.scale, motion.expansion, motion.index, *motion.index_gradient)
    return any(moved) or any(motion.figure.values()) or motion.grid is not None


def _undetectable(run: RenderRun, rows: tuple[Reading, ...]) -> str:
    """Return the smallest detectable changes of the cameras' parameters, as text."""
    sigmas = {p: [r.sigma for r in rows if r.parameter == p] for p in parameters.CAMERA_PARAMETERS.values()}
    parts = [
        f"{p.symbol} {significant(FAR * max(sigma_values), 2, floor=0.0)} {p.unit}"
        for p, sigma_values in sigmas.items()
        if sigma_values
    ]
    source = "noise and disturbances hide"
    if _noise_only(run):
        source = f"with {run.frames} frames the noise of the images hides"
    return f"{source} changes below {', '.join(parts)} ({FAR:g} σ)"


def _noise_only(run: RenderRun) -> bool:
    return run.experiment.disturbances is None


def _title(run: RenderRun) -> str:
    return run.estimators[run.judged].title


def _within(run: RenderRun, rows: tuple[Reading, ...], reference: str, prefix: str = "") -> str:
    """Return a text such as ``all 12 readings ... are within 3 σ of the truth``, with what σ is based on."""
    prior = run.experiment.disturbances
    basis = "noise alone" if prior is None else f"noise and disturbances {prior.name}"
    return f"all {len(rows)} readings of the {_title(run)} are within {FAR:g} σ of {reference} ({prefix}σ: {basis})"


def _nothing(run: RenderRun, rows: tuple[Reading, ...], wrong: list[Reading]) -> tuple[str, ...]:
    if not wrong:
        return f"Nothing was perturbed, and {_within(run, rows, 'zero')}", _undetectable(run, rows)
    worst = max(wrong, key=lambda r: abs(r.ratio))
    probability = _exceedance(worst.ratio, len(rows))
    why = "check the warnings and the spots" if probability < FALSE_ALARM else "this is consistent with chance"
    return (
        f"Nothing was perturbed, but {len(wrong)} of {len(rows)} readings of the {_title(run)} "
        f"{_are(wrong)} beyond {FAR:g} σ",
        f"the worst is {worst.name}, {worst.read}; chance alone causes such a reading in {100.0 * probability:.2g} % "
        f"of such runs: {why}",
    )


def _exceedance(ratio: float, count: int) -> float:
    """Return the probability that the largest of ``count`` standard normal numbers exceeds ``ratio`` in magnitude."""
    return float(-np.expm1(count * np.log1p(-2.0 * ndtr(-abs(ratio)))))


def _are(what: list[Reading]) -> str:
    return "is" if len(what) == 1 else "are"


def _changes(rows: tuple[Reading, ...]) -> list[Reading]:
    """Return the changes of cameras and angle, without the errors on the ground, which follow from them."""
    return [r for r in rows if r.group != GROUND_GROUP]


def _recovered(run: RenderRun, rows: tuple[Reading, ...]) -> tuple[str, ...]:
    clear_changes = [r for r in rows if abs(r.true) > FAR * r.sigma]
    clear = _changes(rows)
    largest = max(clear, key=lambda r: abs(r.true) / r.sigma if r.sigma else abs(r.true))
    if clear_changes:
        return (
            _within(run, rows, "the truth"),
            f"{len(clear_changes)} of the changes exceed{'s' * (len(clear_changes) == 1)} {FAR:g} σ; the clearest "
            f"is {largest.name}, with a reading of {largest.read} and a true value of {largest.shown(largest.true)}",
            f"{_undetectable(run, rows)}{_frames(run, rows)}",
        )
    if not any(abs(r.true) > SAME * r.sigma for r in rows):
        return f"The perturbation changes no camera, and {_within(run, rows, 'zero')}", _undetectable(run, rows)
    times = abs(largest.true) / largest.sigma if largest.sigma else 0.0
    size = f"{significant(abs(largest.true), 2)} {largest.parameter.unit}, {significant(times, 2)} σ"
    beneath = "the noise" if _noise_only(run) else "the effect of noise and disturbances"
    return (
        f"The perturbation is below {beneath}: no true change reaches {FAR:g} σ, and the clearest is that of "
        f"{largest.name} ({size})",
        _within(run, rows, "the truth"),
        _undetectable(run, rows),
        _needed(run, largest),
    )


def _frames(run: RenderRun, rows: tuple[Reading, ...]) -> str:
    """Return a sentence on whether more frames would improve the accuracy; they lower only the noise."""
    if any(r.noise**2 > 0.5 * r.sigma**2 for r in _changes(rows)):
        return "; more frames or more light would reveal smaller changes"
    return "; more frames do not lower this limit"


def _needed(run: RenderRun, clearest: Reading) -> str:
    """Return a text with the number of frames that would make a change detectable; empty if none would."""
    allowed = (clearest.true / FAR) ** 2 - (clearest.sigma**2 - clearest.noise**2)
    need = math.ceil(run.frames * clearest.noise**2 / allowed) if allowed > 0.0 else math.inf
    return f"about {need} frames would reveal the clearest change" if need <= MOST_FRAMES else ""


def limited(run: RenderRun) -> str:
    """Return the body that limits the accuracy of the angle between two cameras, as text.

    Without an angle it is the body that limits the least accurate change. The text is empty without a prior.
    """
    if _noise_only(run):
        return ""
    rows = readings(run, run.judged)
    quantity = next((r for r in rows if r.group == ANGLE_GROUP), max(rows, key=lambda r: abs(r.ratio)))
    body, share = limits(run.reading, quantity)
    cause = f"{body} causes" if body == NOISE else f"motions of {body} cause"
    return (
        f"{cause} {share_text(share)} of the variance of {quantity.name} (σ {significant(quantity.sigma, 2)} "
        f"{quantity.parameter.unit})"
    )


def _misled(run: RenderRun, rows: tuple[Reading, ...], wrong: list[Reading]) -> tuple[str, ...]:
    candidates = [r for r in wrong if r.camera] or _changes(tuple(wrong)) or wrong
    worst = max(candidates, key=lambda r: abs(r.ratio))
    share = ", larger than the change itself"
    if abs(worst.error) <= abs(worst.true):
        share = f" or {significant(100.0 * abs(worst.error / worst.true), 2, floor=0.0)} % of the change"
    return (
        _score(rows, wrong),
        f"the worst is {worst.name}, with a reading of {worst.read} and a true value of {worst.shown(worst.true)}: an "
        f"error of {residual_text(abs(worst.ratio)).lstrip('+')} σ{share}",
        _cause(run, worst, len(rows)),
    )


def _score(rows: tuple[Reading, ...], wrong: list[Reading], suffix: str = "") -> str:
    good = len(rows) - len(wrong)
    if not good:
        return f"None of the {len(rows)} changes is recovered within {FAR:g} σ{suffix}"
    are = "is" if good == 1 else "are"
    return f"{good} of {len(rows)} changes {are} recovered within {FAR:g} σ{suffix}, {len(wrong)} {_are(wrong)} not"


def _misread_reason(run: RenderRun) -> str:
    """Return a sentence on why an estimator reports wrong changes for the motion of this run."""
    if run.estimators[run.judged].needs_prior:
        return "larger than the prior expects"
    return f"outside the family of the {_title(run)}"


def _cause(run: RenderRun, worst: Reading, count: int) -> str:
    """Return the cause of an error, as far as the crosstalk table explains it, and where to look, as text.

    ``count`` is the number of all estimated changes.
    """
    cameras = list(run.crosstalk)
    biases = {name: systematics(run, name) for name in cameras}
    # a change of one camera, or what the angle and the ground are made of, per unit of the results
    weights = combination(run.reading, worst.group, worst.parameter.key).reshape(-1, 4) / PER_SI
    used = [name for name, weight in zip(cameras, weights, strict=True) if np.any(weight)]
    bias = sum(float(w @ biases[name].bias[run.judged][:4]) for name, w in zip(cameras, weights, strict=True))
    probability = _exceedance(worst.ratio, count)
    if probability > FALSE_ALARM and abs(bias) < 0.5 * abs(worst.error):
        advice = "take more frames" if _noise_only(run) else "take more measurements"
        return f"chance alone causes such an error in {100.0 * probability:.2g} % of such runs: {advice} to decide"
    parts: dict[str, float] = {}
    for name in used:
        for text, vector in biases[name].parts.items():
            parts[text] = parts.get(text, 0.0) + float(weights[cameras.index(name)] @ vector[:4])
    explained = worst.camera and abs(worst.error - bias) <= max(FAR * worst.noise, _EXPLAINED * abs(worst.error))
    if parts and explained:
        text, part = max(parts.items(), key=lambda pair: pair[1] / worst.error)
        share = part / worst.error
        if share > 0.5:
            most = "the cause is" if share > 1.0 - _EXPLAINED else "most of it is"
            return (
                f"{most} a motion {_misread_reason(run)} ({text}), read as {worst.parameter.symbol} by "
                f"{worst.shown(part, sign=True)} {worst.parameter.unit}; more frames do not reduce it: see Crosstalk"
            )
        return f"motions {_misread_reason(run)} cause it together ({_largest(parts)}): see Crosstalk"
    uncovered = joined([name for camera in used for name in biases[camera].uncovered])
    if uncovered and run.estimators[run.judged].needs_prior:
        return f"{uncovered} contribute, which the crosstalk table does not contain: see Residuals"
    if uncovered:
        return (
            f"the {_title(run)} does not model {uncovered}, and the crosstalk table does not contain them; "
            "more frames do not reduce the error: see Residuals"
        )
    if parts:
        return f"motions {_misread_reason(run)} contribute ({_largest(parts)}): see Crosstalk and Residuals"
    return "first-order crosstalk does not explain the error, motions may be too large for it: see Residuals"


NAMED = 4
"""Largest number of motions that a sentence of the verdict names."""


def _largest(parts: Mapping[str, float]) -> str:
    """Return the motions with the largest contributions to an error, as text."""
    return joined(sorted(parts, key=lambda text: -abs(parts[text]))[:NAMED])


def _series_verdict(
    run: RenderRun, series: TimeSeries, rows: tuple[Reading, ...], wrong: list[Reading]
) -> tuple[str, ...]:
    span = f"over {len(series.times)} times from {moment(float(series.times[0]))} to {moment(float(series.times[-1]))}"
    if not wrong:
        return f"{_within(run, rows, 'the truth', 'RMS; ')}, {span}", _undetectable(run, rows)
    worst = max([r for r in wrong if r.camera] or wrong, key=lambda r: abs(r.ratio))
    unit = worst.parameter.unit
    uncovered = joined([name for camera in run.crosstalk for name in systematics(run, camera).uncovered])
    cause = f"motions {_misread_reason(run)} contribute"
    if uncovered and not run.estimators[run.judged].needs_prior:
        cause = f"the {_title(run)} does not model {uncovered}"
    size = "the noise is" if _noise_only(run) else "σ is"
    return (
        f"{_score(rows, wrong, ' (RMS)')}, {span}",
        f"the worst is {worst.name}, with an error of {worst.shown(worst.error)} {unit} RMS for a true change of "
        f"{worst.shown(worst.true)} {unit} RMS; {size} {worst.shown(worst.sigma)} {unit}",
        f"{cause}; more frames do not reduce the error: see Time course",
    )


def _contradicted_course(run: RenderRun) -> str:
    """Return the first sentence of the verdict if a time series contradicts its prior; else an empty text.

    The sentence gives the largest error of the filtered and smoothed changes.
    """
    series = run.series
    if series is None or series.smoothed is None or series.smoothed.consistency.agrees:
        return ""
    true = {(row.group, row.parameter.key): row.true for row in series.readings}
    changes = [row for row in series.smoothed.changes if row.group != GROUND_GROUP]
    worst = max(float(np.max(np.abs(r.value - true[r.group, r.parameter.key]) / r.sigma)) for r in changes)
    error_text = f": they are off by up to {significant(worst, 3)} σ" if worst > FAR else ""
    return (
        f"the course contradicts the prior {series.smoothed.name} or its time laws, and σ of filtered and smoothed "
        f"changes does not hold{error_text}"
    )


def _lost_light(run: RenderRun) -> str:
    """Return a sentence on spots that lost more than half of their light in the state shown; empty if none did."""
    share = run.photons_after.sum(axis=(1, 2)) / run.photons_before.sum(axis=(1, 2))
    lost = [(c.key, s) for c, s in zip(run.experiment.path.channels, share, strict=True) if s < _DIMMED]
    if not lost:
        return ""
    names = ", ".join(f"{name} {100.0 * share:.0f} %" for name, share in lost)
    return f"spots have lost light ({names} of the nominal light)"


def sharpness_lost(quality: ImageQuality) -> tuple[float, str, str]:
    """Return the largest relative loss of MTF with the pixel at Nyquist on the line CCDs.

    Its position and the values before and after are returned as two texts.
    """
    losses = [
        (1.0 - float(mtf[1, k] / mtf[0, k]), name, direction, field, float(mtf[0, k]), float(mtf[1, k]))
        for name, camera in quality.cameras.items()
        for direction, mtf in (("line", camera.mtf_along_line), ("track", camera.mtf_along_track))
        for k, field in enumerate(quality.fields)
        if mtf[0, k] > 0.0
    ]
    if not losses:
        return 0.0, "", ""
    share, name, direction, field, before, after = max(losses)
    where = f"of {name} along the {direction}, at {plain(field)} of half the line"
    return share, where, f"from {before:.3f} to {after:.3f}"


def _blurred(run: RenderRun) -> str:
    """Return a sentence on the loss of MTF in the cameras' images; empty if it is below the reported limit."""
    if run.quality is None:
        return ""
    share, where, change = sharpness_lost(run.quality)
    return f"the MTF with the pixel at Nyquist {where}, falls {change}: see Image quality" if share > _SOFTER else ""


def alarm_limit(count: int) -> float:
    """Return the limit, in sigmas, that none of ``count`` normal errors exceeds, up to a probability of FALSE_ALARM."""
    return -float(ndtri(0.5 * FALSE_ALARM / count))


def _beyond_prior(run: RenderRun, rows: tuple[Reading, ...], warned: tuple[str, ...]) -> tuple[str, ...]:
    """Return a warning if estimates are wrong beyond chance since the job moves bodies more than its prior expects.

    In a real measurement this would go unnoticed. Bodies that have a warning already are omitted.
    """
    limit = alarm_limit(len(rows))
    wrong = [r for r in rows if abs(r.ratio) > limit]
    if not wrong or run.series is not None:
        return ()
    excesses = beyond_prior(run.resolved, run.experiment.prior)
    unwarned = [excess for excess in excesses if not any(text.startswith(f"{excess.body}:") for text in warned)]
    if not unwarned:
        return ()
    largest = joined([excess.text for excess in unwarned[:NAMED]])
    more = f" and {len(unwarned) - NAMED} more" if len(unwarned) > NAMED else ""
    prior = run.experiment.prior
    reason = "there is no prior" if prior is None else f"the prior {prior.name} expects less"
    return (
        f"σ does not hold for {joined([r.name for r in wrong])}: the job moves {largest}{more}, but {reason}; a real "
        "measurement would not show this",
    )


def _misreadings(run: RenderRun) -> tuple[str, ...]:
    """Return a warning for every estimate that is wrong by more than its change, and by more than chance allows."""
    changes: dict[tuple[str, str], list[Reading]] = {}
    for reading in (candidate for estimator in run.estimators for candidate in readings(run, estimator)):
        changes.setdefault((reading.group, reading.parameter.key), []).append(reading)
    limit = alarm_limit(sum(map(len, changes.values())))
    out = []
    for same in changes.values():
        wrong = [r for r in same if abs(r.error) > max(abs(r.true), limit * r.sigma, SAME)]
        if not wrong:
            continue
        first = wrong[0]
        how = "over the course (RMS) " if run.series is not None else ""
        who: dict[str, list[str]] = {}
        for r in wrong:
            who.setdefault(f"{r.shown(r.value)} ± {r.shown(r.sigma)}", []).append(run.estimators[r.estimator].title)
        values_read = ", ".join(f"{value} ({'; '.join(titles)})" for value, titles in who.items())
        out.append(
            f"{first.name} [{first.parameter.unit}] is misread by more than the change itself: {how}it is "
            f"{first.shown(first.true)}, read as {values_read}"
        )
    return tuple(out)
