"""Measurement of one monitor channel: its frames are searched for artefacts, and its spot is located in every state."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from analysis.monitor.parameters import MonitorCalibration
from analysis.monitor.recovery import measure_spots
from analysis.spots import learnt_template
from analysis.spots.frame_screening import (
    Finding,
    FramesError,
    ScreenedFrames,
    noise_ratio,
    observed_noise,
    screen_frames,
    subtracted_level,
)
from analysis.spots.likelihood import widened
from analysis.spots.noise import NoiseModel
from analysis.spots.photon_transfer import PixelCorrection
from analysis.spots.screened_fit import CORE_SHARE, ScreenedFit, single_template
from analysis.spots.spot_image import NoiseParts, SpotError, SpotPositions, difference_covariance, noise_parts
from analysis.spots.spot_template import SpotTemplate
from analysis.spots.static_defects import Examined, examine, outlier_pixels, refit, repaired_centroid
from scenes.specs.monitor_frames import MeasurementSpec
from scenes.yaml.errors import Issue
from twin.framework.frame_store import mean_of, release_memory
from twin.recover.measured_frames import ChannelFrames, StateFrames, cannot_measure

_MOST_SIGMA_INCREASE = 4.0
"""Largest factor by which missing pixels may increase the sigma of a spot's position; beyond it the spot counts as
lost.
"""
_REMEDIES = (
    ("(saturation", "frames with less light or a shorter exposure"),
    (
        "too near the edge",
        "frames in which the spot is at least 10 pixels from the edge; another crop, or a shifted window",
    ),
    ("saturated", "frames with less light or a shorter exposure"),
    ("no spot", "frames that show the channel's spot: the correct file, with the light on"),
    ("range of the template", "a spot closer to the calibrated position"),
    ("too narrow", "a shape from a model of the instrument, `template: twin`, or a spot of at least 3 pixels FWHM"),
    ("mostly noise", "more frames of the state before, or frames with more light"),
    ("missing", "frames with less light, or with fewer bad pixels at the spot"),
)


@dataclass(frozen=True, eq=False)
class SpotResult:
    """Measured spot of one channel in one state.

    Attributes
    ----------
    frames : StateFrames
        Frames as recorded.
    mean : (H, W) ndarray
        Mean image that was measured, H rows and W columns, DN.
    used : (H, W) ndarray of bool
        Pixels that were used.
    residual : (H, W) ndarray or None
        Mean minus fitted shape, in standard deviations; None where no shape was fitted.
    findings : tuple of Finding
        Artefacts of the frames and how each was treated.
    cost : float
        Relative increase of the position's sigma due to the artefacts.
    core : tuple of (float, int) or None
        Reduced chi-square of the spot's core, and its number of pixels; None where no shape was fitted.
    fits : bool
        True if the core of the spot has the calibrated shape, according to its chi-square.
    noise_ratio : float or None
        Ratio of the frames' temporal noise to that of the detector's data sheet; None where they agree.
    """

    frames: StateFrames
    mean: np.ndarray
    used: np.ndarray
    residual: np.ndarray | None
    findings: tuple[Finding, ...]
    cost: float
    core: tuple[float, int] | None = None
    fits: bool = True
    noise_ratio: float | None = None

    @property
    def clean(self) -> bool:
        """True if no artefact of the frames had to be corrected."""
        return not any(finding.corrects for finding in self.findings)


@dataclass(frozen=True, eq=False)
class ChannelResult:
    """Measured spots of one channel in all states.

    Attributes
    ----------
    channel : ChannelFrames
        Frames and CCD of the channel.
    before : SpotResult
        Spot in the nominal state.
    after : tuple of SpotResult
        Spots in the other states.
    """

    channel: ChannelFrames
    before: SpotResult
    after: tuple[SpotResult, ...]

    def states(self) -> tuple[tuple[str, SpotResult], ...]:
        """Return name and measured spot of each state: "before" and "after", or "after" with a number in a series."""
        many = len(self.after) > 1
        return (
            ("before", self.before),
            *((f"after {k + 1}" if many else "after", measured) for k, measured in enumerate(self.after)),
        )


def remedy(reason: str) -> str:
    """Return advice on what to change when a spot cannot be measured, chosen by words of the ``reason``."""
    return next((remedy for word, remedy in _REMEDIES if word in reason), "other frames of this channel")


class ChannelMeasurement:
    """Measurement of one channel: search its frames for artefacts, then locate its spots.

    Parameters
    ----------
    test : MeasurementSpec
        Measurement.
    channel : ChannelFrames
        Frames of the channel.
    shape : SpotTemplate or None
        Shape of its spot on the whole CCD; None learns it from the frames before.
    """

    def __init__(self, test: MeasurementSpec, channel: ChannelFrames, shape: SpotTemplate | None) -> None:
        self._test, self.channel, self.shape = test, channel, shape
        self._learnt = shape is None
        self._screened: list[ScreenedFrames] = []
        self._noise_ratios: list[float | None] = []
        self._noisy = False
        self._level: tuple[Finding, ...] = ()
        self._examined: list[Examined | None] = []
        self._costs: dict[int, float] = {}
        self._widened: list[float] = []
        self._learnt_from: learnt_template.LearntTemplate | None = None
        self._fitted: list[learnt_template.FittedSpot] = []
        self._shifts: list[learnt_template.LearntShift] = []
        self._templates: dict[tuple[int, int], SpotTemplate] = {}
        self.positions: list[SpotPositions] = []

    @property
    def _searches(self) -> bool:
        return self._test.corrections == "automatic"

    @property
    def plain(self) -> bool:
        """True if these frames need no correction, so that the main job's computation can be used as it is."""
        channel = self.channel
        full_frames = all(state.shape == channel.ccd and not any(state.offset) for state in channel.states)
        equal_counts = len({len(state.frames) for state in channel.after}) == 1
        integers = all(np.issubdtype(state.frames.dtype, np.integer) for state in channel.states)
        uncalibrated = channel.correction is None and channel.transfer is None
        untouched = all(screened.clean for screened in self._screened)
        untouched &= all(examined is None or examined.clean for examined in self._examined)
        uncorrected = uncalibrated and not self._noisy and not self._level
        return (
            full_frames and equal_counts and integers and uncorrected and untouched and self._test.vibration == "none"
        )

    def _template(self, state: StateFrames) -> SpotTemplate:
        assert self.shape is not None
        if state.shape not in self._templates:
            self._templates[state.shape] = single_template(self.shape, 0, state.shape)
        return self._templates[state.shape]

    def search(self) -> list[Issue]:
        """Search the frames for artefacts, by comparison with each other and with the spot's shape.

        The result is the issues that make a measurement impossible.
        """
        issues: list[Issue] = []
        try:
            self._show_level()
        except FramesError as error:
            name = self.channel.name
            return [cannot_measure(self._test, self.channel.before, name, str(error), error.remedy)]
        self._show_noise()
        for number, state in enumerate(self.channel.states):
            saturation = ""
            try:
                screened = self._screen(state)
                saturation = "; ".join(finding.text for finding in screened.findings if finding.kind == "saturation")
                screened = replace(screened, findings=(*screened.findings, *self._level))
                if self.shape is None:
                    screened, self._learnt_from = self._learn(screened)
                    self.shape = self._learnt_from.shape
                self._screened.append(screened)
                self._examined.append(self._examine(number, state))
            except FramesError as error:
                issues.append(cannot_measure(self._test, state, self.channel.name, str(error), error.remedy))
            except SpotError as error:
                issues.append(self._lost(state, error, saturation))
            if issues and number == 0:
                break
        return issues

    def _show_level(self) -> None:
        """Lower the detector's dark level in the noise model where a level was subtracted from the frames.

        Raises
        ------
        FramesError
            A level was subtracted from the frames but not from the dark frames.
        """
        channel = self.channel
        below = max(
            subtracted_level(state.frames, channel.raw_noise, state.bad_part(channel.bad), release_memory)
            for state in channel.states
        )
        if below == 0.0:
            return
        if channel.correction is not None:
            raise FramesError(
                f"beside the spot the frames are {below:.3g} DN darker than without light: a level seems to have been "
                "subtracted from them, but not from the dark frames",
                "frames and dark frames as they were recorded, or no dark frames",
            )
        low = replace(
            channel.raw_noise,
            offset_dn=channel.raw_noise.offset_dn - below,
            saturation_dn=channel.raw_noise.saturation_dn - below,
        )
        self.channel = replace(channel, raw_noise=low, noise=low)
        text = f"{below:.4g} DN were subtracted below the spot; its noise is computed from the light above this level"
        self._level = (Finding("subtracted level", text, corrects=False),)

    def _show_noise(self) -> None:
        """Set the noise model to the noise of the noisiest frames where it exceeds that of the data sheet."""
        channel = self.channel
        dark_noises = []
        for state in channel.states:
            bad = state.bad_part(channel.bad)
            ratio = noise_ratio(state.frames, channel.raw_noise, bad, released=release_memory)
            self._noise_ratios.append(ratio)
            dark_noises.append(observed_noise(state.frames, channel.raw_noise, ratio, bad, release_memory).dark_noise_e)
        most = max(dark_noises)
        if most > channel.raw_noise.dark_noise_e:
            raw, corrected = (replace(model, dark_noise_e=most) for model in (channel.raw_noise, channel.noise))
            self.channel = replace(channel, raw_noise=raw, noise=corrected)
            self._noisy = True

    def _lost(self, state: StateFrames, error: SpotError, saturation: str = "") -> Issue:
        """Return the issue of a spot that cannot be measured; if pixels are saturated, ``saturation`` says so first."""
        reason = "; ".join(error.reasons.values())
        if saturation:
            reason = f"too much of the spot is missing (saturation: {saturation}): {reason}"
        return cannot_measure(self._test, state, self.channel.name, reason, remedy(reason))

    def _screen(self, state: StateFrames) -> ScreenedFrames:
        channel = self.channel
        bad = np.zeros(state.shape, dtype=bool)
        if channel.bad is not None:
            bad |= state.of_ccd(channel.bad)
        if not self._searches:
            values = state.frames
            mean = mean_of(values) if np.issubdtype(values.dtype, np.integer) else np.mean(values, axis=0)
            counts, still = np.full(state.shape, float(len(values))), np.zeros((2, 2))
            screened = ScreenedFrames(np.asarray(mean, np.float64), counts, ~bad, len(values), len(values), still, ())
        else:
            screened = screen_frames(state.frames, channel.raw_noise, bad, release_memory)
        if channel.correction is None:
            return screened
        correction = channel.correction
        dark, response, unusable = (
            state.of_ccd(pixel_map) for pixel_map in (correction.dark, correction.response, correction.bad)
        )
        part = PixelCorrection(dark, response, unusable, correction.noise)
        findings: tuple[Finding, ...] = (
            Finding("dark frames" if self._test.flat is None else "dark and flat frames", "are corrected for"),
        )
        bad_count = np.count_nonzero(part.bad & screened.good)
        if bad_count:
            findings += (Finding("bad pixels", f"{bad_count} found in dark and flat frames are excluded"),)
        good = screened.good & ~part.bad
        return replace(
            screened, mean=part.corrected(screened.mean), good=good, findings=(*screened.findings, *findings)
        )

    def _learn(self, screened: ScreenedFrames) -> tuple[ScreenedFrames, learnt_template.LearntTemplate]:
        """Return frames without outlier pixels, and the spot's shape (template) learnt from them."""
        if self._searches:
            outliers = outlier_pixels(screened, self.channel.noise)
            if np.any(outliers):
                finding = Finding(
                    "bad pixels", f"{np.count_nonzero(outliers)} hot, dead or otherwise deviating pixels are excluded"
                )
                screened = replace(screened, good=screened.good & ~outliers, findings=(*screened.findings, finding))
            screened = learnt_template.without_slopes(screened, self.channel.noise)
        return screened, learnt_template.learn_template(screened, self.channel.noise)

    def _examine(self, number: int, state: StateFrames) -> Examined | None:
        """Search the mean image of state ``number`` for artefacts; return None if no search is requested."""
        screened, test = self._screened[number], self._test
        fitted = test.vibration == "fitted"
        if not self._searches and not fitted and np.all(screened.good):
            return None
        template_source, learnt = self._learnt and number == 0, self._learnt and number > 0
        template, searched = self._template(state), self._searches
        return examine(screened, self.channel.noise, template, fitted, template_source, searched, state.offset, learnt)

    def measure(self) -> list[Issue]:
        """Measure the spot in every state; return the issues of states in which it cannot be measured."""
        issues: list[Issue] = []
        static = np.zeros(self.channel.ccd, dtype=bool)
        for state, examined in zip(self.channel.states, self._examined, strict=True):
            if examined is not None:
                state.of_ccd(static)[...] |= examined.static
        for number, state in enumerate(self.channel.states):
            try:
                self.positions.append(self._position(number, state, state.of_ccd(static)))
                if self._learnt_from is not None and number and self._fitted:
                    first, second = self._fitted[0], self._fitted[-1]
                    noise, ccd = self.channel.noise, self.channel.ccd
                    self._shifts.append(learnt_template.learnt_shift(self._learnt_from, first, second, noise, ccd))
            except SpotError as error:
                issues.append(self._lost(state, error))
        return issues

    def _position(self, number: int, state: StateFrames, static: np.ndarray) -> SpotPositions:
        examined, screened = self._examined[number], self._screened[number]
        if examined is not None and np.any(static & examined.good):
            count = np.count_nonzero(static & examined.good)
            finding = Finding("bad pixels", f"{count} pixels that are bad in another state are excluded here too")
            examined = refit(examined, static, self.channel.noise, self._template(state), (finding,))
            self._examined[number] = examined
        if examined is None or examined.clean:
            positions = self._direct_centroid(screened, state)
        else:
            if examined.fit.missing > _MOST_SIGMA_INCREASE:
                kinds = ", ".join(dict.fromkeys(f.kind for f in examined.findings if f.corrects))
                consequence = f"sigma would grow {1.0 + examined.fit.missing:.1f}-fold"
                raise SpotError({0: f"too much of the spot is missing ({kinds}): {consequence}"})
            positions, self._costs[number] = examined.fit.positions, examined.fit.cost
            if self._test.analysis.centroid != "ml":
                positions, self._costs[number] = self._repaired(examined, state)
        if self._learnt and self._test.analysis.centroid == "ml":
            self._fitted.append(self._as_fitted(positions, number, state))
        self._widened.append(self._widening(number))
        return self._on_ccd(widened(positions, np.array(self._widened[-1:])), state)

    def _widening(self, number: int) -> float:
        """Return the factor by which sigma is increased where a spot's core fits poorly; 1 without a fitted shape."""
        examined, first = self._examined[number], self._examined[0] if self._learnt else None
        if examined is None or (self._learnt and number == 0):
            return 1.0
        return examined.fit.core_widening(None if first is None else first.fit)

    def _as_fitted(self, positions: SpotPositions, number: int, state: StateFrames) -> learnt_template.FittedSpot:
        """Return the data of a spot's fit from which its noise is computed if the spot's shape was learnt."""
        examined, screened = self._examined[number], self._screened[number]
        counts, jitter = screened.counts, screened.jitter / float(np.median(screened.counts))
        others, smear = np.zeros((0, 3)), np.zeros((2, 2))
        if examined is not None and not examined.clean:
            others, smear = examined.fit.others, examined.fit.smear
        return learnt_template.FittedSpot(positions, counts, jitter, others, smear, state.offset)

    def shift_covariance(self, number: int) -> np.ndarray:
        """Return the (1, 2, 2) noise covariance of the spot's shift from before to after, in px^2.

        Parameters
        ----------
        number : int
            Index of the state after, from 1.
        """
        if self._shifts:
            # its noise is computed together with that of the learnt shape, not from the positions
            return self._shifts[number - 1].covariance[None] * max(self._widened[0], self._widened[number]) ** 2
        spread = difference_covariance(self.positions[0], self.positions[number], self.channel.noise)
        return spread + self._doubt(number)

    def _doubt(self, number: int) -> np.ndarray:
        """Return the (2, 2) covariance, in px^2, of a centroid's error due to a reflection in the frames before.

        Such a centroid uses no shape of the spot. The reflection is in the image before, and is added to the image
        after only with the accuracy of the learnt shape. The difference between the centroid's shift and that of a fit
        of the shape is counted as an error.
        """
        first, second = self._examined[0], self._examined[number]
        if not self._learnt or first is None or second is None or not np.any(second.fit.others[:, 2] < 0.0):
            return np.zeros((2, 2))
        shift = (self.positions[number].position - self.positions[0].position)[0]
        shape_shift = (second.fit.positions.position - first.fit.positions.position)[0]
        moved = np.subtract(self.channel.states[number].offset, self.channel.before.offset)
        return np.outer(shift - shape_shift - moved, shift - shape_shift - moved)

    def noise_parts(self, number: int) -> tuple[NoiseParts, NoiseParts]:
        """Return the noise contributions of the spot before and after, for the covariance of a time series of shifts.

        Parameters
        ----------
        number : int
            Index of the state after, from 1.
        """
        if self._shifts:
            return self._shifts[number - 1].parts
        noise = self.channel.noise
        after = noise_parts(self.positions[number], noise)
        after = replace(after, temporal=after.temporal + self._doubt(number))
        return noise_parts(self.positions[0], noise), after

    def _direct_centroid(self, screened: ScreenedFrames, state: StateFrames) -> SpotPositions:
        return self._centroid(screened.mean[None], screened.frames, self.channel.noise, state)

    def _repaired(self, examined: Examined, state: StateFrames) -> tuple[SpotPositions, float]:
        """Return positions by a centroid without a spot shape, and the relative increase of sigma due to corrections.

        It is used for images whose artefacts were corrected.
        """
        screened, noise, template = examined.screened, self.channel.noise, self._template(state)

        def measure(image: np.ndarray, noise_model: NoiseModel) -> SpotPositions:
            return self._centroid(image, screened.frames, noise_model, state)

        return repaired_centroid(screened, examined.fit, noise, template, measure)

    def _centroid(self, mean: np.ndarray, frames: int, noise: NoiseModel, state: StateFrames) -> SpotPositions:
        calibration = MonitorCalibration({}, self._template(state), noise)
        return measure_spots(mean, frames, calibration, self._test.analysis.centroid)

    def _on_ccd(self, positions: SpotPositions, state: StateFrames) -> SpotPositions:
        """Return spot positions in pixels of the whole CCD instead of pixels of the recorded part."""
        if state.shape == self.channel.ccd:
            return positions
        assert positions.gain_maps is not None
        assert positions.light_dn is not None
        gain, light = np.zeros((1, 2, *self.channel.ccd)), np.zeros((1, *self.channel.ccd))
        for axis in (0, 1):
            state.of_ccd(gain[0, axis])[...] = positions.gain_maps[0, axis]
        state.of_ccd(light[0])[...] = positions.light_dn[0]
        row, column = positions.row + state.offset[0], positions.column + state.offset[1]
        return replace(positions, row=row, column=column, gain_maps=gain, light_dn=light)

    def _core_excess(self, number: int, fit: ScreenedFit) -> float:
        """Return the factor by which the variance in a spot's core exceeds that of the noise model, for noisy frames.

        It is computed from differences between frames in the core, but is at most the factor beside the spot, because
        in the light, flicker and movement add to the differences.
        """
        ratio = self._noise_ratios[number]
        if ratio is None or ratio <= 1.0:
            return 1.0
        frames = self.channel.states[number].frames
        light = fit.level - float(fit.level.min())
        core = light > CORE_SHARE * light.max()
        core_ratio = noise_ratio(frames, self.channel.raw_noise, ~fit.used, core, release_memory)
        return 1.0 if core_ratio is None else min(max(core_ratio, 1.0), ratio) ** 2

    def result(self) -> ChannelResult:
        """Return the measured spots of the channel in all states."""
        spots = []
        # with a learnt shape the frames before were fitted as well, during the search
        first = self._examined[0] if self._learnt else None
        learnt = None if first is None else first.fit
        for number, state in enumerate(self.channel.states):
            examined, screened = self._examined[number], self._screened[number]
            fit = None if examined is None else examined.fit
            findings = screened.findings if examined is None else examined.findings
            spots.append(
                SpotResult(
                    frames=state,
                    mean=screened.mean,
                    used=screened.good if examined is None else examined.good,
                    residual=None if fit is None else fit.residual(screened.mean),
                    findings=findings,
                    cost=self._costs.get(number, 0.0),
                    core=None if fit is None else fit.core,
                    fits=fit is None
                    or (self._learnt and number == 0)
                    or fit.core_fits(learnt, self._core_excess(number, fit)),
                    noise_ratio=self._noise_ratios[number],
                )
            )
        return ChannelResult(self.channel, spots[0], tuple(spots[1:]))
