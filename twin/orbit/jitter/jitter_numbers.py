"""The quantities of a search for jitter, as jitter.json has them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from analysis.arrays import ARCSEC
from scenes.specs.orbit.jitter_search import OrbitJitterSpec
from twin.orbit.jitter.jitter_run import JitterRun, PassJitter
from twin.run.quantity import Quantity, Record
from twin.sensors.charge_transfer import Collection, Motion


@dataclass(frozen=True, eq=False)
class FoundLine:
    """One oscillation that was found.

    Attributes:
        run: the search.
        one: the pass.
        number: which one, the strongest first.
    """

    run: JitterRun
    one: PassJitter
    number: int

    @property
    def truth(self) -> tuple[float, np.ndarray] | None:
        """Frequency, hertz, and amplitudes (A,), radians, of the stated oscillation that it is; None where there is
        none within a resolution element.
        """
        if self.one.truth is None:
            return None
        test, stated = self.run.setup.test, self.one.truth
        assert isinstance(test, OrbitJitterSpec)
        assert test.attitude.jitter is not None
        frequency, lines = self.one.found.lines.frequency[self.number], len(test.attitude.jitter.lines)
        if not lines:
            return None
        k = int(np.argmin(np.abs(stated.frequency[:lines] - frequency)))
        if abs(stated.frequency[k] - frequency) > 1.0 / self.one.sights.observations.span:
            return None
        size = np.hypot(stated.sine[k], stated.cosine[k])[self.run.columns]
        return float(stated.frequency[k]), size

    @property
    def frequency(self) -> tuple[float, float]:
        """Hertz, and its sigma."""
        lines = self.one.found.lines
        return float(lines.frequency[self.number]), float(lines.frequency_sigma[self.number])

    @property
    def in_search(self) -> bool:
        """Return whether the frequency is one of those that were searched."""
        search = self.run.setup.test.search
        return bool(search.lowest <= self.frequency[0] <= search.highest)

    @property
    def aliases(self) -> tuple[float, ...]:
        """Return the other frequencies, hertz, that explain the observations as well."""
        return self.one.found.lines.aliases[self.number]

    def of_axes(self, values: np.ndarray) -> dict[str, float]:
        """Axis -> value of a row (A,)."""
        return {axis: float(v) for axis, v in zip(self.run.axes, values, strict=True)}


@dataclass(frozen=True, eq=False)
class BlindMultiple:
    """A multiple k / dt of a pair's gap.

    Attributes:
        first: line that sees a place first.
        second: the other.
        gap: between their sights, seconds.
        order: k.
        frequency: hertz.
        response: of all lines together there, of the worst axis as against its best.
        blind: whether all lines together are blind there.
    """

    first: str
    second: str
    gap: float
    order: int
    frequency: float
    response: float
    blind: bool


def found_lines(run: JitterRun, one: PassJitter) -> list[FoundLine]:
    """All that were found in a pass."""
    return [FoundLine(run, one, k) for k in range(len(one.found.lines.frequency))]


def blind_multiples(one: PassJitter) -> list[BlindMultiple]:
    """Where each pair of lines by itself is blind, among the frequencies that were looked at."""
    before, out = one.found.before, []
    share = np.min(before.response / np.max(before.response, axis=0), axis=1)
    for (first, second), (_, gap, _) in one.sights.gaps.items():
        for order in range(1, int(before.frequency[-1] * abs(gap)) + 1):
            frequency = order / abs(gap)
            if frequency < before.frequency[0]:
                continue
            k = int(np.argmin(np.abs(before.frequency - frequency)))
            out.append(BlindMultiple(first, second, gap, order, frequency, float(share[k]), bool(before.blind[k])))
    return out


def noise_factors(one: PassJitter) -> dict[str, float]:
    """Return line -> standard deviation of its noise over that of its points' covariances."""
    return dict(zip(one.sights.lines, np.sqrt(one.found.factors[:-1]).tolist(), strict=True))


def transfers(run: JitterRun, one: PassJitter) -> dict[str, dict[str, float]]:
    """Line -> root mean square over the phases of the transfer at Nyquist, along the line (by roll) and along the track
    (by pitch), of all oscillations found together; of the lines whose file says how they collect light.
    """
    lines, out = one.found.lines, {}
    directions = {"roll": "along_line", "pitch": "along_track"}
    for name in one.sights.lines:
        image = run.setup.camera.image_of(name)
        if image is None:
            continue
        light = Collection.of(image.tdi, one.measurements.line_times[name].line_time)
        out[name] = {
            directions[axis]: float(
                light.mtf(
                    0.5,
                    Motion.of(
                        [
                            (float(f), float(a[k] / one.sights.pixel))
                            for f, a in zip(lines.frequency, lines.amplitude, strict=True)
                        ]
                    ),
                )
            )
            for k, axis in enumerate(run.axes)
            if axis in directions
        }
    return out


def _degrees(found: FoundLine) -> dict[str, float]:
    return found.of_axes(np.degrees(found.one.found.lines.phase[found.number]))


def _true_amplitudes(found: FoundLine) -> dict[str, float] | None:
    return None if found.truth is None else found.of_axes(found.truth[1] / ARCSEC)


LINE: Record[FoundLine] = Record(
    "An oscillation that was found.",
    Quantity("frequency_hz", lambda one: one.frequency[0], "of it"),
    Quantity("frequency_hz_sigma", lambda one: one.frequency[1], "standard deviation"),
    Quantity(
        "amplitude_arcsec",
        lambda one: one.of_axes(one.one.found.lines.amplitude[one.number] / ARCSEC),
        "axis -> half of what it swings from end to end",
        converted=False,
    ),
    Quantity(
        "amplitude_arcsec_sigma",
        lambda one: one.of_axes(one.one.found.lines.amplitude_sigma[one.number] / ARCSEC),
        "axis -> standard deviation",
        converted=False,
    ),
    Quantity(
        "amplitude_px",
        lambda one: one.of_axes(one.one.found.lines.amplitude[one.number] / one.one.sights.pixel),
        "axis -> in angles of a pixel: what roll moves along the line, and pitch along the track",
    ),
    Quantity("phase_deg", _degrees, "axis -> p of sin(2 pi f t + p), t from the epoch", converted=False),
    Quantity(
        "chance",
        lambda one: one.one.found.lines.chance[one.number],
        "largest probability that noise alone shows one like it, anywhere",
    ),
    Quantity("in_search", lambda one: one.in_search, "whether the frequency is one of those that were searched"),
    Quantity(
        "aliases_hz",
        lambda one: list(one.aliases),
        "other frequencies that explain the observations as well: the oscillation is at any of these",
    ),
    Quantity(
        "true_frequency_hz",
        lambda one: None if one.truth is None else one.truth[0],
        "of the stated oscillation that it is",
        where_known=True,
    ),
    Quantity("true_amplitude_arcsec", _true_amplitudes, "axis -> likewise", converted=False, where_known=True),
)
MULTIPLE: Record[BlindMultiple] = Record(
    "Where two lines by themselves see nothing: a whole number of periods lies between their sights.",
    Quantity("first", lambda one: one.first, "line that sees a place first"),
    Quantity("second", lambda one: one.second, "the other"),
    Quantity("gap_ms", lambda one: one.gap, "between their sights"),
    Quantity("periods", lambda one: one.order, "in the gap"),
    Quantity("frequency_hz", lambda one: one.frequency, "periods over gap"),
    Quantity("response", lambda one: one.response, "of all lines together, as against their best"),
    Quantity("blind", lambda one: one.blind, "whether all lines together see nothing there either"),
)


def _gaps(one: PassJitter) -> dict[str, float]:
    return {f"{first} to {second}": gap * 1e3 for (first, second), (_, gap, _) in one.sights.gaps.items()}


def _detectable(run: JitterRun, one: PassJitter) -> dict[str, float]:
    """Axis -> median over the frequencies that are looked at."""
    least = one.found.detectable[~one.found.before.blind]
    return dict(zip(run.axes, (np.median(least, axis=0) / ARCSEC).tolist(), strict=True))


@dataclass(frozen=True, eq=False)
class _Searched:
    run: JitterRun
    one: PassJitter


PASS: Record[_Searched] = Record(
    "A pass.",
    Quantity("epoch_utc", lambda s: s.one.epoch, "from which times count"),
    Quantity("lines", lambda s: list(s.one.sights.lines), "in the order in which they see a place"),
    Quantity("points", lambda s: s.one.sights.points, "seen by two lines or more"),
    Quantity("share_used", lambda s: np.mean(s.one.found.used), "of the observations; the others are wrong matches"),
    Quantity("gap_ms", lambda s: _gaps(s.one), "pair -> median time between the sights of a place", converted=False),
    Quantity("duration_s", lambda s: s.one.sights.observations.span, "from the first sight to the last"),
    Quantity("pixel_arcsec", lambda s: s.one.sights.pixel, "angle of a pixel along the line"),
    Quantity(
        "noise_factor",
        lambda s: noise_factors(s.one),
        "line -> what remains without the oscillations, over what the covariances of its points say",
        converted=False,
    ),
    Quantity("aliases_sought_to_hz", lambda s: s.one.found.beyond, "highest frequency of aliases"),
    Quantity("oscillations", lambda s: found_lines(s.run, s.one), "the strongest first", record=LINE),
    Quantity(
        "chance_of_the_next",
        lambda s: s.one.found.after.chance(s.one.found.after.power[s.one.found.after.best]),
        "probability of noise alone of the highest power that is left",
    ),
    Quantity(
        "detectable_arcsec",
        lambda s: _detectable(s.run, s.one),
        "axis -> amplitude that would just be found, median over the frequencies",
        converted=False,
    ),
    Quantity("blind_hz", lambda s: s.one.found.before.intervals(), "first and last of frequencies not looked at"),
    Quantity("blind_multiples", lambda s: blind_multiples(s.one), "of every pair by itself", record=MULTIPLE),
    Quantity(
        "mtf_at_nyquist",
        lambda s: transfers(s.run, s.one) or None,
        "line -> transfer of the oscillations found, root mean square over their phases",
        where_known=True,
    ),
)


def _passes(run: JitterRun) -> Mapping[str, Any]:
    return {name: _Searched(run, one) for name, one in run.passes.items()}


JITTER: Record[JitterRun] = Record(
    "jitter.json. Jitter in what several lines saw one after the other.",
    Quantity("axes", lambda run: list(run.axes), "of the body about which it was sought"),
    Quantity("lowest_hz", lambda run: run.setup.test.search.lowest, "frequency looked at"),
    Quantity("highest_hz", lambda run: run.setup.test.search.highest, "likewise"),
    Quantity(
        "false_alarm", lambda run: run.setup.test.search.false_alarm, "probability of finding any where there is none"
    ),
    Quantity("passes", _passes, "each by itself", record=PASS),
)
