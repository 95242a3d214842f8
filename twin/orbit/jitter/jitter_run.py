"""Search for jitter, simulated or on measurements (``python -m twin.orbit jitter``), and the keys of jitter.json."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from analysis.orbit.jitter import Course, JitterError, JitterSearch, fit_spline, search
from optics.numerics.backend import one_blas_thread
from optics.numerics.number_tree import FrozenMap
from scenes.specs.orbit.jitter_search import AXES, OrbitJitterSpec
from scenes.specs.orbit.setup import AnyJitter, JitterSetup, MeasuredJitterSetup
from twin.framework.procedure import Advance, BenchError, silent, stream
from twin.framework.record import Quantity, Record
from twin.orbit.flight.line_camera import LineTimes, line_cameras
from twin.orbit.flight.platform_table import PlatformTable
from twin.orbit.flight.sensor import NO_EFFECTS, LightEffects, Sensor
from twin.orbit.flight.trajectory import Jitter, Trajectory
from twin.orbit.jitter.sights import Sights, SightsError, sights_of
from twin.orbit.measured.measurement_tables import read_measurements, tested_files
from twin.orbit.measured.pass_measurements import GroundPoints, ImagePoints, PassMeasurements
from twin.sensors.line_ccd import Collection, Motion

if TYPE_CHECKING:
    from optics.numerics.backend import Backend

TEST_FILE = "jitter.yaml"
_WRONG = 20.0
"""Largest error of a simulated wrong match, in pixels."""
_SPARE = 1.3
"""Number of candidates drawn per required point, because some lie beyond the ends of a line."""
_REMEDY = "points that several lines see, spread over the strip; a larger `height_sigma` or another `height`"


@dataclass(frozen=True, eq=False)
class PassJitter:
    """Jitter detected in one pass.

    Attributes
    ----------
    setup : AnyJitter
        Resolved test file and camera.
    sights : Sights
        Observations of the same ground points by several lines, which see them one after the other.
    result : JitterSearch
        Detected oscillations and spectra.
    course : Course or None
        Attitude over time, as a spline; None where the file does not ask for it.
    measurements : PassMeasurements
        Measurements of the pass.
    truth : Jitter or None
        True jitter of a simulation, as a sum of sinusoids; None for measurements.
    """

    setup: AnyJitter
    sights: Sights
    result: JitterSearch
    course: Course | None
    measurements: PassMeasurements
    truth: Jitter | None = None

    @property
    def columns(self) -> list[int]:
        """Indices, among the components X, Y, Z of rotation vectors, of the axes that are searched."""
        return [AXES.index(axis) for axis in self.setup.test.search.axes]

    @property
    def oscillations(self) -> list[Oscillation]:
        """Detected oscillations, the strongest first."""
        return [Oscillation(self, k) for k in range(len(self.result.lines.frequency))]

    @property
    def noise_factors(self) -> dict[str, float]:
        """Standard deviation of each line's residuals divided by that of its points' covariances."""
        return dict(zip(self.sights.lines, np.sqrt(self.result.factors[:-1]).tolist(), strict=True))

    @property
    def next_p_value(self) -> float:
        """p-value of the highest power that remains in the spectrum after the detected oscillations are removed."""
        after = self.result.after
        return float(after.p_value(after.power[after.best]))

    def by_axis(self, values: np.ndarray) -> dict[str, float]:
        """Return the values (A,) of the A searched axes as a mapping, name of the axis -> value."""
        return dict(zip(self.setup.test.search.axes, np.asarray(values).tolist(), strict=True))


@dataclass(frozen=True, eq=False)
class Oscillation:
    """Detected oscillation of the attitude: its frequency, amplitudes and phases about the searched axes.

    Attributes
    ----------
    jitter : PassJitter
        Pass in which it was detected.
    number : int
        Index among the detected oscillations, the strongest first.
    """

    jitter: PassJitter
    number: int

    @property
    def amplitude(self) -> tuple[np.ndarray, np.ndarray]:
        """Amplitudes about the A searched axes, (A,), in radians, and their standard deviations."""
        lines = self.jitter.result.lines
        return lines.amplitude[self.number], lines.amplitude_sigma[self.number]

    @property
    def phase(self) -> np.ndarray:
        """Phases about the A searched axes at the epoch, (A,), in radians."""
        return np.asarray(self.jitter.result.lines.phase[self.number])

    @property
    def pixels(self) -> np.ndarray:
        """Amplitudes about the A searched axes, (A,), in pixels (units of the angle that a pixel subtends)."""
        return np.asarray(self.amplitude[0] / self.jitter.sights.pixel)

    @property
    def truth(self) -> tuple[float, np.ndarray] | None:
        """Frequency (Hz) and amplitudes about the A searched axes (A,) (rad) of the nearest true oscillation.

        None if no true oscillation lies within a resolution element of the spectrum, or for real measurements.
        """
        test, true_jitter = self.jitter.setup.test, self.jitter.truth
        if true_jitter is None or not isinstance(test, OrbitJitterSpec) or test.attitude.jitter is None:
            return None
        distance = np.abs(true_jitter.frequency[: len(test.attitude.jitter.lines)] - self.frequency[0])
        if not len(distance) or distance.min() > 1.0 / self.jitter.sights.observations.span:
            return None
        k = int(np.argmin(distance))
        amplitude = np.hypot(true_jitter.sine[k], true_jitter.cosine[k])
        return float(true_jitter.frequency[k]), amplitude[self.jitter.columns]

    @property
    def frequency(self) -> tuple[float, float]:
        """Frequency in hertz, and its standard deviation."""
        lines = self.jitter.result.lines
        return float(lines.frequency[self.number]), float(lines.frequency_sigma[self.number])

    @property
    def in_search(self) -> bool:
        """True if the frequency lies within the range of frequencies that the file searches."""
        search = self.jitter.setup.test.search
        return bool(search.lowest <= self.frequency[0] <= search.highest)

    @property
    def aliases(self) -> tuple[float, ...]:
        """Other frequencies, in hertz, that explain the observations equally well."""
        return self.jitter.result.lines.aliases[self.number]


@dataclass(frozen=True, eq=False)
class JitterRun:
    """Results of a search for jitter.

    Attributes
    ----------
    setup : AnyJitter
        Resolved test file and camera.
    seed : int
        Seed of all random numbers.
    passes : Mapping[str, PassJitter]
        Results by name of the pass.
    """

    setup: AnyJitter
    seed: int
    passes: Mapping[str, PassJitter]

    @property
    def simulated(self) -> bool:
        """True for a simulation, whose true jitter is known."""
        return isinstance(self.setup, JitterSetup)


@one_blas_thread()
def run_jitter(setup: AnyJitter, backend: Backend | None, seed: int, advance: Advance = silent) -> JitterRun:
    """Simulate or read the passes, and search them for jitter.

    Nothing is ray-traced: the backend is not used.

    Raises
    ------
    InputError
        Files cannot be used.
    BenchError
        No such orbit exists, or the points do not observe the attitude.
    """
    spec = setup.test
    passes: list[tuple[PassMeasurements, Jitter | None]] = []
    if isinstance(setup, MeasuredJitterSetup):
        effects = LightEffects.of(setup.test.effects) if setup.test.effects.corrected else NO_EFFECTS
        passes = [(each, None) for each in read_measurements(setup.data, setup.camera, advance, needed={})]
    else:
        effects = LightEffects.of(setup.test.effects)
        passes = [fly_strip(setup, seed)]
    cameras, results = line_cameras(setup.camera), {}
    for k, (measurements, truth) in enumerate(passes):
        advance("search", k, len(passes))
        try:
            sights = sights_of(measurements, cameras, spec.lines, spec.search, effects)
            observations, sought = sights.observations, spec.search
            fastest = 0.5 / max(measurements.line_times[name].line_time for name in sights.lines)
            lines = search(observations, sought.lowest, sought.highest, sought.false_alarm, fastest)
            used, spline = observations.taken(lines.used), sought.spline
            course = None if spline is None else fit_spline(used, spline.interval, spline.sigma)
        except (JitterError, SightsError, ValueError) as error:
            key = "points" if isinstance(setup, JitterSetup) else "data"
            raise BenchError(f"{measurements.name}: {error}", (key,), _REMEDY) from error
        results[measurements.name] = PassJitter(setup, sights, lines, course, measurements, truth)
    advance("search", len(passes), len(passes))
    return JitterRun(setup, seed, FrozenMap(results))


def fly_strip(setup: JitterSetup, seed: int) -> tuple[PassMeasurements, Jitter | None]:
    """Simulate a pass over points that all lines see, with noise; return its measurements and the true jitter.

    Raises
    ------
    BenchError
        No such orbit exists, or the lines do not see enough of the strip.
    """
    spec: OrbitJitterSpec = setup.test
    root = np.random.SeedSequence(seed)
    trajectory, wanted = Trajectory.of_test(spec, root), spec.points
    rng_point, rng_noise, rng_wrong, rng_error = (np.random.default_rng(stream(root, k)) for k in range(4))
    measured = trajectory.with_errors(spec.errors, int(rng_error.integers(2**31)))
    platform = PlatformTable.sampled(measured, spec.errors.gps.interval, spec.errors.star_tracker.interval)
    count = max(int((trajectory.last - trajectory.first) / spec.line_time) - 1, 1)
    times = LineTimes.even(trajectory.first + 0.5 * spec.line_time, spec.line_time, count)
    names = spec.lines or tuple(setup.camera.lines)
    cameras, effects = line_cameras(setup.camera), LightEffects.of(spec.effects)
    sensors = {
        name: Sensor.of_lines(cameras[name], trajectory, trajectory.orbit.earth, times, effects) for name in names
    }
    many = int(np.ceil(_SPARE * wanted.count))
    first = sensors[names[0]]
    delay = wanted.duration * (rng_point.uniform(size=many) - 0.5)
    if wanted.rows is not None:
        spread, half = wanted.row_spread * np.clip(rng_point.standard_normal(many), -3.0, 3.0), 0.5 * wanted.duration
        delay = np.clip(wanted.rows * np.rint(delay / wanted.rows) + spread, -half, half)
    seconds = spec.time + delay
    pixel = rng_point.uniform(0.0, first.camera.pixels - 1.0, many)
    height = wanted.height + wanted.relief * rng_point.uniform(-1.0, 1.0, many)
    points = first.ground((seconds - first.first_line_time) / first.line_time, pixel, height)
    seen = {name: np.stack(sensor.image(points), axis=-1) for name, sensor in sensors.items()}
    noise = {name: wanted.line_noise.get(name, wanted.noise) for name in names}
    edge = 10.0 * max(noise.values()) + _WRONG
    inside = np.ones(many, bool)
    for name, at in seen.items():
        last = np.array([count, sensors[name].camera.pixels]) - 1.0 - edge
        with np.errstate(invalid="ignore"):
            inside &= np.all((at > edge) & (at < last), axis=1)
    used = np.flatnonzero(inside)[: wanted.count]
    if len(used) < wanted.count:
        problem = f"{len(used)} of {wanted.count} points are seen by all of {', '.join(names)}"
        raise BenchError(problem, ("points", "duration"), "a shorter strip within the orbit, or other `lines`")
    images = {}
    for name, at in seen.items():
        noise_px = noise[name] * rng_noise.standard_normal((len(used), 2))
        bad = rng_wrong.uniform(size=len(used)) < wanted.wrong
        noise_px[bad] += rng_wrong.uniform(-_WRONG, _WRONG, (len(used), 2))[bad]
        position = at[used] + noise_px
        images[name] = ImagePoints.of(np.arange(len(used)), position[:, 0], position[:, 1], wanted.noise**2 * np.eye(2))
    ids = np.array([f"t{k}" for k in range(len(used))], object)
    ground = GroundPoints.of(ids, np.full((len(used), 3), np.nan), np.zeros((3, 3)), "tie")
    strip = PassMeasurements(spec.name, platform, FrozenMap(dict.fromkeys(names, times)), ground, FrozenMap(images))
    return strip, trajectory.jitter if isinstance(trajectory.jitter, Jitter) else None


def exported(run: JitterRun) -> dict[str, str]:
    """Return a folder of measurements with a test file that reads them back, path -> text."""
    spec = run.setup.test
    plain = spec.plain()
    return tested_files(
        [jitter.measurements for jitter in run.passes.values()],
        run.setup.camera.plain(),
        spec,
        TEST_FILE,
        effects={**plain["effects"], "corrected": True} if run.simulated else plain["effects"],
        **({"lines": list(spec.lines)} if spec.lines else {}),
        search=plain["search"],
    )


def transfers(jitter: PassJitter) -> dict[str, dict[str, float]]:
    """Return the MTF at the Nyquist frequency due to all detected oscillations, by line and direction.

    It is the root mean square over the phases of the oscillations, along the line (due to roll) and along the track
    (due to pitch), for lines whose file specifies their exposure (TDI stages).
    """
    directions, by_line = {"roll": "along_line", "pitch": "along_track"}, {}
    swings = [(line.frequency[0], jitter.by_axis(line.pixels)) for line in jitter.oscillations]
    for name in jitter.sights.lines:
        image = jitter.setup.camera.image_of(name)
        if image is None:
            continue
        light = Collection.of(image.tdi, jitter.measurements.line_times[name].line_time)
        by_line[name] = {
            directions[axis]: float(light.mtf(0.5, Motion.of([(f, swing[axis]) for f, swing in swings])))
            for axis in jitter.setup.test.search.axes
            if axis in directions
        }
    return by_line


def _true_amplitudes(of: Oscillation) -> dict[str, float] | None:
    return None if of.truth is None else of.jitter.by_axis(of.truth[1])


LINE: Record[Oscillation] = Record(
    "A detected oscillation.",
    Quantity("frequency_hz", lambda of: of.frequency[0], "frequency"),
    Quantity("frequency_hz_sigma", lambda of: of.frequency[1], "standard deviation"),
    Quantity("amplitude_arcsec", lambda of: of.jitter.by_axis(of.amplitude[0]), "axis -> half of peak to peak"),
    Quantity("amplitude_arcsec_sigma", lambda of: of.jitter.by_axis(of.amplitude[1]), "axis -> standard deviation"),
    Quantity("amplitude_px", lambda of: of.jitter.by_axis(of.pixels), "axis -> amplitude in pixels"),
    Quantity("phase_deg", lambda of: of.jitter.by_axis(of.phase), "axis -> p of sin(2 pi f t + p), t from the epoch"),
    Quantity("p_value", lambda of: of.jitter.result.lines.p_value[of.number], "by noise alone, at any frequency"),
    Quantity("in_search", lambda of: of.in_search, "true if the frequency lies within the search"),
    Quantity("aliases_hz", lambda of: list(of.aliases), "other frequencies that explain the observations as well"),
    Quantity("true_frequency_hz", lambda of: of.truth and of.truth[0], "true frequency", where_known=True),
    Quantity("true_amplitude_arcsec", _true_amplitudes, "axis -> true amplitude", where_known=True),
)


def _gaps(jitter: PassJitter) -> dict[str, float]:
    return {f"{first} to {second}": gap for (first, second), (_, gap, _) in jitter.sights.gaps.items()}


def _detectable(jitter: PassJitter) -> dict[str, float]:
    """Return the median, over the searched frequencies, of the smallest detectable amplitude by axis, in radians."""
    return jitter.by_axis(np.median(jitter.result.detectable[~jitter.result.before.blind], axis=0))


PASS: Record[PassJitter] = Record(
    "Jitter of one pass.",
    Quantity("epoch_utc", lambda jitter: jitter.measurements.platform.epoch, "zero of the times"),
    Quantity("lines", lambda jitter: list(jitter.sights.lines), "lines in the order in which they see a point"),
    Quantity("points", lambda jitter: jitter.sights.points, "number of points seen by two lines or more"),
    Quantity("share_used", lambda jitter: np.mean(jitter.result.used), "share of observations used, not wrong matches"),
    Quantity("gap_ms", _gaps, "pair -> median time between the sightings of a point"),
    Quantity("duration_s", lambda jitter: jitter.sights.observations.span, "time from first to last sighting"),
    Quantity("pixel_arcsec", lambda jitter: jitter.sights.pixel, "angle of a pixel along the line"),
    Quantity("noise_factor", lambda jitter: jitter.noise_factors, "line -> remaining noise over its covariances"),
    Quantity("aliases_sought_to_hz", lambda jitter: jitter.result.beyond, "highest frequency of aliases"),
    Quantity("oscillations", lambda jitter: jitter.oscillations, "the strongest first", record=LINE),
    Quantity("next_p_value", lambda jitter: jitter.next_p_value, "p-value of the highest remaining power"),
    Quantity("detectable_arcsec", _detectable, "axis -> least detectable amplitude, median over frequencies"),
    Quantity("blind_hz", lambda jitter: jitter.result.before.intervals(), "first and last of blind frequencies"),
    Quantity("mtf_at_nyquist", lambda j: transfers(j) or None, "line -> transfer, rms of phases", where_known=True),
)
JITTER: Record[JitterRun] = Record(
    "Content of jitter.json: jitter detected in points that several lines see one after the other.",
    Quantity("axes", lambda run: list(run.setup.test.search.axes), "axes of the body that are searched"),
    Quantity("lowest_hz", lambda run: run.setup.test.search.lowest, "lowest frequency of the search"),
    Quantity("highest_hz", lambda run: run.setup.test.search.highest, "highest frequency of the search"),
    Quantity("false_alarm", lambda run: run.setup.test.search.false_alarm, "probability of any false detection"),
    Quantity("passes", lambda run: run.passes, "each pass by itself", record=PASS),
)
