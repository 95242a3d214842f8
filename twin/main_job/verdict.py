"""What a run found, in one sentence worked out from its numbers, and the readings that mislead, as warnings."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import ndtr, ndtri

from analysis.monitor.estimators import ESTIMATORS
from analysis.monitor.monitoring import PER_SI
from analysis.units import ARCSEC
from optics.geometry.tree import Motion
from scenes.specs.course import moment
from twin.main_job.render_results import RenderRun, stated
from twin.main_job.report_labels import ANGLE, PARAMETERS, Parameter
from twin.main_job.systematics import joined, systematics
from twin.monitor.image_quality import ImageQuality
from twin.monitor.time_series import TimeSeries
from twin.run.artefact import FAR, SAME, decimals_for, fixed, plain, residual_text, significant

__all__ = [
    "FALSE_ALARM",
    "Judgement",
    "Reading",
    "alarm_limit",
    "judge",
    "readings",
    "recovered_numbers",
    "sharpness_lost",
]

JUDGED = "model"
"""Estimator that the sentence is about; warnings are about all."""
FALSE_ALARM = 1e-3
"""Chance that noise alone makes any warning of a misreading in a run."""
EXPLAINED = 0.2
"""Share of an error that may be left over where it is called explained to first order."""
SOFTER = 0.05
"""Relative loss of MTF at Nyquist from which it is spoken of."""
MOST_FRAMES = 10_000
"""More frames than that are no advice."""
DIMMED = 0.5
"""Share of its nominal light below which a spot counts as dimmed, as for the warning about it."""


@dataclass(frozen=True)
class Reading:
    """What an estimator reads of one change beside what truly happened, in the parameter's unit.

    Over a course, true, value and error are root mean squares over its times.

    Attributes:
        camera: whose; empty for the angle between the cameras.
        parameter: which of its changes.
        estimator: who reads it.
        true, value, sigma, error: error is value minus true.
    """

    camera: str
    parameter: Parameter
    estimator: str
    true: float
    value: float
    sigma: float
    error: float

    @property
    def ratio(self) -> float:
        """Error in sigmas; without noise it is infinite unless it is rounding."""
        if self.sigma > 0.0:
            return self.error / self.sigma
        return 0.0 if abs(self.error) < SAME else math.copysign(math.inf, self.error)

    @property
    def far(self) -> bool:
        """Whether reports mark it."""
        return abs(self.ratio) > FAR

    @property
    def name(self) -> str:
        """``Δα of forward``."""
        return f"{self.parameter.symbol} of {self.camera}" if self.camera else self.parameter.symbol

    def shown(self, value: float, sign: bool = False) -> str:
        """A number of this reading with the digits that its sigma deserves."""
        return fixed(value, decimals_for(self.sigma), sign)

    @property
    def read(self) -> str:
        """Value, sigma and unit."""
        return f"{self.shown(self.value)} ± {self.shown(self.sigma)} {self.parameter.unit}"


@dataclass(frozen=True)
class Judgement:
    """A run in one sentence, and all its warnings, those of misreadings last."""

    verdict: str
    warnings: tuple[str, ...]


def readings(run: RenderRun, estimator: str) -> tuple[Reading, ...]:
    """All readings of an estimator: four of each camera, then the angle; over a course root mean squares."""
    return tuple(_series_readings(run.series, estimator) if run.series else _state_readings(run, estimator))


def _state_readings(run: RenderRun, estimator: str) -> Iterator[Reading]:
    recovered, truth = run.recovered_dict(), run.truth_dict()
    for camera, estimators in recovered["cameras"].items():
        for p in PARAMETERS:
            yield _reading(camera, p, estimator, truth["cameras"][camera], estimators[estimator])
    if "intersection_angle" in truth:
        yield _reading("", ANGLE, estimator, truth["intersection_angle"], recovered["intersection_angle"][estimator])


def _reading(
    camera: str, p: Parameter, estimator: str, truth: Mapping[str, float], found: Mapping[str, float]
) -> Reading:
    true, value = truth[p.key], found[p.key]
    return Reading(camera, p, estimator, true, value, found[f"{p.key}_sigma"], value - true)


def _series_readings(series: TimeSeries, estimator: str) -> Iterator[Reading]:
    for camera, estimators in series.parameters.items():
        found = estimators[estimator]
        for k, p in enumerate(PARAMETERS):
            true, value, sigma = (
                PER_SI[k] * v for v in (series.truth[camera][k], found.vector[:, k], found.sigma[:, k])
            )
            yield Reading(camera, p, estimator, _rms(true), _rms(value), _rms(sigma), _rms(value - true))
    if series.recovered_angle:
        angle = series.recovered_angle[estimator]
        true, value, sigma = (v / ARCSEC for v in (series.angle_change, angle.change_rad, angle.sigma_rad))
        yield Reading("", ANGLE, estimator, _rms(true), _rms(value), _rms(sigma), _rms(value - true))


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def judge(run: RenderRun) -> Judgement:
    """Judge a run by its readings, sigmas, truth and crosstalk."""
    found = readings(run, JUDGED)
    off = [r for r in found if r.far]
    if run.series is not None:
        verdict = _series_verdict(run, run.series, found, off)
    elif not any(_moves(motion) for motion in run.state.values()):
        verdict = _nothing(run, found, off)
    elif off:
        verdict = _misled(run, found, off)
    else:
        verdict = _recovered(run, found)
    return Judgement(f"{verdict}{_dimmed(run)}{_blurred(run)}.", (*run.warnings, *_misreadings(run)))


def recovered_numbers(run: RenderRun) -> dict[str, Any]:
    """Contents of recovered.json: what was read, the verdict and the warnings."""
    told = judge(run)
    return {**stated(run.recovered_dict()), "verdict": told.verdict, "warnings": list(told.warnings)}


def _moves(motion: Motion) -> bool:
    moved = (*motion.rotate, *motion.shift, motion.scale, motion.stretch, motion.index, *motion.index_gradient)
    return any(moved) or any(motion.figure.values())


def _noise(run: RenderRun, found: tuple[Reading, ...]) -> str:
    """The least changes that the noise lets through, of the parameters of the cameras."""
    parts = []
    for p in PARAMETERS:
        worst = max((r for r in found if r.parameter == p), key=lambda r: r.sigma)
        parts.append(f"{p.symbol} {significant(FAR * worst.sigma, 2, floor=0.0)} {p.unit}")
    return f"with {run.frames} frames the noise of the images hides changes below {', '.join(parts)} ({FAR:g} σ)"


def _within(found: tuple[Reading, ...]) -> str:
    return f"all {len(found)} readings of the model are within {FAR:g} σ of"


def _nothing(run: RenderRun, found: tuple[Reading, ...], off: list[Reading]) -> str:
    if not off:
        return f"Nothing was perturbed and nothing is read: {_within(found)} zero; {_noise(run, found)}"
    worst = max(off, key=lambda r: abs(r.ratio))
    chance = _chance(worst.ratio, len(found))
    why = "look at the warnings and at the spots" if chance < FALSE_ALARM else "which noise alone does now and then"
    return (
        f"Nothing was perturbed, but {len(off)} of {len(found)} readings of the model {_are(off)} beyond {FAR:g} σ, "
        f"the worst {worst.name}, {worst.read}; noise reaches that in {100.0 * chance:.2g} % of such runs: {why}"
    )


def _chance(ratio: float, count: int) -> float:
    """Probability that the largest of ``count`` normal numbers is as far out."""
    return float(-np.expm1(count * np.log1p(-2.0 * ndtr(-abs(ratio)))))


def _are(what: list[Reading]) -> str:
    return "is" if len(what) == 1 else "are"


def _recovered(run: RenderRun, found: tuple[Reading, ...]) -> str:
    seen = [r for r in found if abs(r.true) > FAR * r.sigma]
    largest = max(found, key=lambda r: abs(r.true) / r.sigma if r.sigma else abs(r.true))
    if seen:
        hidden = len(found) - len(seen)
        others = f" and {hidden} hide{'s' * (hidden == 1)} in it" if hidden else ""
        return (
            f"Recovered: {_within(found)} the truth, {len(seen)} of the changes stand{'s' * (len(seen) == 1)} out of "
            f"the noise{others}; the clearest, {largest.name}, is read as {largest.read} and is "
            f"{largest.shown(largest.true)}; {_noise(run, found)}, more frames or light would show more"
        )
    if not any(abs(r.true) > SAME * r.sigma for r in found):
        return f"What was perturbed changes no camera, and nothing is read: {_within(found)} zero; {_noise(run, found)}"
    times = abs(largest.true) / largest.sigma if largest.sigma else 0.0
    need = math.ceil(run.frames * (FAR / times) ** 2) if times > 0.0 else math.inf
    advice = f"; about {need} frames would show it" if need <= MOST_FRAMES else ""
    size = f"{significant(abs(largest.true), 2)} {largest.parameter.unit}, {significant(times, 2)} σ"
    return (
        f"The perturbation stays beneath the noise: no true change reaches {FAR:g} σ, the clearest is that of "
        f"{largest.name} ({size}), and {_within(found)} the truth; {_noise(run, found)}{advice}"
    )


def _misled(run: RenderRun, found: tuple[Reading, ...], off: list[Reading]) -> str:
    own = [r for r in off if r.camera] or off
    worst = max(own, key=lambda r: abs(r.ratio))
    return (
        f"{_score(found, off)}: the worst, {worst.name}, is read as {worst.read} and is {worst.shown(worst.true)}, "
        f"wrong by {residual_text(abs(worst.ratio)).lstrip('+')} σ{_share(worst)}; {_cause(run, worst, len(found))}"
    )


def _score(found: tuple[Reading, ...], off: list[Reading], how: str = "") -> str:
    good = len(found) - len(off)
    if not good:
        return f"None of the {len(found)} changes is recovered within {FAR:g} σ{how}"
    are = "is" if good == 1 else "are"
    return f"{good} of {len(found)} changes {are} recovered within {FAR:g} σ{how}, {len(off)} {_are(off)} not"


def _share(worst: Reading) -> str:
    if abs(worst.error) > abs(worst.true):
        return ", which is more than the change itself"
    return f" or {significant(100.0 * abs(worst.error / worst.true), 2, floor=0.0)} % of the change"


def _cause(run: RenderRun, worst: Reading, count: int) -> str:
    """What makes an error, as far as the crosstalk table knows, and where to look; ``count``: of all readings."""
    cameras = [worst.camera] if worst.camera else list(run.crosstalk)
    # the angle is made of the cameras' rotations about Y
    k = PARAMETERS.index(worst.parameter) if worst.camera else 0
    found = [systematics(run, name) for name in cameras]
    bias = sum(float(one.bias[JUDGED][k]) for one in found)
    chance = _chance(worst.ratio, count)
    if chance > FALSE_ALARM and abs(bias) < 0.5 * abs(worst.error):
        return f"noise alone does as much in {100.0 * chance:.2g} % of such runs, so look at more frames"
    parts = [(text, float(part[k])) for one in found for text, part in zip(one.outside, one.parts, strict=True)]
    names = joined([text for text, _ in parts])
    explained = worst.camera and abs(worst.error - bias) <= max(FAR * worst.sigma, EXPLAINED * abs(worst.error))
    if parts and explained:
        text, part = max(parts, key=lambda pair: pair[1] / worst.error)
        share = part / worst.error
        if share > 0.5:
            most = "the cause is" if share > 1.0 - EXPLAINED else "most of it is"
            return (
                f"{most} a motion that the model does not know ({text}), read as {worst.parameter.symbol} by "
                f"{worst.shown(part, sign=True)} {worst.parameter.unit}, which more frames do not cure: see Crosstalk"
            )
        return f"motions that the model does not know add up to it ({names}): see Crosstalk"
    uncovered = joined([name for one in found for name in one.uncovered])
    if uncovered:
        return (
            f"the model knows nothing of {uncovered}, nor does the crosstalk table, and more frames do not cure it: "
            "see Residuals"
        )
    if parts:
        return f"motions that the model does not know take part ({names}): see Crosstalk and Residuals"
    return "first-order crosstalk does not explain it, motions may be too large for it: see Residuals"


def _series_verdict(run: RenderRun, series: TimeSeries, found: tuple[Reading, ...], off: list[Reading]) -> str:
    span = f"over {len(series.times)} times from {moment(float(series.times[0]))} to {moment(float(series.times[-1]))}"
    if not off:
        return f"Followed {span}: {_within(found)} the truth (RMS); {_noise(run, found)}"
    worst = max([r for r in off if r.camera] or off, key=lambda r: abs(r.ratio))
    unit = worst.parameter.unit
    uncovered = joined([name for camera in run.crosstalk for name in systematics(run, camera).uncovered])
    why = f"the model knows nothing of {uncovered}" if uncovered else "motions that the model does not know take part"
    return (
        f"{_score(found, off, ' (RMS)')}, {span}: the worst, {worst.name}, is wrong by {worst.shown(worst.error)} "
        f"{unit} RMS where it truly changes by {worst.shown(worst.true)} {unit} RMS and the noise is "
        f"{worst.shown(worst.sigma)} {unit}; {why}, which more frames do not cure: see Time course"
    )


def _dimmed(run: RenderRun) -> str:
    """Spots that lost more than half of their light, of the state that is shown."""
    share = run.photons_after.sum(axis=(1, 2)) / run.photons_before.sum(axis=(1, 2))
    lost = [(c.key, s) for c, s in zip(run.experiment.path.channels, share, strict=True) if s < DIMMED]
    if not lost:
        return ""
    names = ", ".join(f"{name} {100.0 * share:.0f} %" for name, share in lost)
    return f"; light is lost on the way ({names} of the nominal light left)"


def sharpness_lost(quality: ImageQuality) -> tuple[float, str, str]:
    """Largest relative loss of MTF at Nyquist on the lines, where it is, and its values before and after."""
    lost = [
        (1.0 - float(mtf[1, k] / mtf[0, k]), name, direction, field, float(mtf[0, k]), float(mtf[1, k]))
        for name, camera in quality.cameras.items()
        for direction, mtf in (("line", camera.mtf_along_line), ("track", camera.mtf_along_track))
        for k, field in enumerate(quality.fields)
        if mtf[0, k] > 0.0
    ]
    if not lost:
        return 0.0, "", ""
    share, name, direction, field, before, after = max(lost)
    where = f"of {name} along the {direction}, at {plain(field)} of half the line"
    return share, where, f"from {before:.3f} to {after:.3f}"


def _blurred(run: RenderRun) -> str:
    """What the perturbation does to the cameras' own images, where it matters."""
    if run.quality is None:
        return ""
    share, where, change = sharpness_lost(run.quality)
    return f"; the MTF at Nyquist {where}, falls {change}: see Image quality" if share > SOFTER else ""


def alarm_limit(count: int) -> float:
    """Sigmas that noise alone exceeds in any of ``count`` readings with a chance of FALSE_ALARM at most."""
    return -float(ndtri(0.5 * FALSE_ALARM / count))


def _misreadings(run: RenderRun) -> tuple[str, ...]:
    """A warning for every change whose reading is wrong by more than the change, and by more than noise can be."""
    table = {estimator: readings(run, estimator) for estimator in ESTIMATORS}
    limit = alarm_limit(sum(map(len, table.values())))
    out = []
    for same in zip(*table.values(), strict=True):
        wrong = [r for r in same if abs(r.error) > max(abs(r.true), limit * r.sigma, SAME)]
        if not wrong:
            continue
        first = wrong[0]
        how = "over the course (RMS) " if run.series is not None else ""
        who: dict[str, list[str]] = {}
        for r in wrong:
            who.setdefault(f"{r.shown(r.value)} ± {r.shown(r.sigma)}", []).append(ESTIMATORS[r.estimator].title)
        said = ", ".join(f"{value} ({'; '.join(titles)})" for value, titles in who.items())
        out.append(
            f"{first.name} [{first.parameter.unit}] is misread by more than the change itself: {how}it is "
            f"{first.shown(first.true)}, read as {said}"
        )
    return tuple(out)
