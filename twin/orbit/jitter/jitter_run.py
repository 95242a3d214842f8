"""A search for jitter: ``python -m twin.orbit jitter``, on a simulated pass or on measured ones.

The quantities of a search for jitter, as jitter.json has them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from analysis.orbit.jitter import Course, JitterSearch, JitterError, search, fit_spline
from optics.numerics.backend import one_blas_thread
from optics.numerics.number_tree import FrozenMap
from scenes.specs.orbit.jitter_search import AXES, OrbitJitterSpec
from scenes.specs.orbit.setup import AnyJitter, JitterSetup, MeasuredJitterSetup
from scenes.yaml.yaml_file import dump_yaml
from twin.framework.procedure import Advance, BenchError, silent
from twin.framework.random_streams import stream
from twin.framework.record import Quantity, Record
from twin.orbit.flight.earth import Earth
from twin.orbit.flight.light_effects import NO_EFFECTS, LightEffects
from twin.orbit.flight.line_camera import LineTimes, line_cameras
from twin.orbit.flight.orbit import propagate
from twin.orbit.flight.platform_table import PlatformTable
from twin.orbit.flight.sensor import Sensor
from twin.orbit.flight.trajectory import Jitter, Trajectory
from twin.orbit.jitter.sights import Sights, SightsError, sights_of
from twin.orbit.measured.measurement_tables import CAMERA_FILE, campaign_files, read_measurements
from twin.orbit.measured.pass_measurements import GroundPoints, ImagePoints, PassMeasurements
from twin.sensors.line_ccd import Collection, Motion

if TYPE_CHECKING:
    from optics.numerics.backend import Backend

TEST_FILE = "jitter.yaml"
_WRONG = 20.0
"""Pixels: within which a wrong match lies."""
_SPARE = 1.3
"""Times as many places are drawn as are asked for: some lie beyond an edge of a line."""
_REMEDY = "points that several lines see, spread over the strip; a larger `height_sigma` or another `height`"


@dataclass(frozen=True, eq=False)
class PassJitter:
    """What was found in a pass.

    Attributes
    ----------
    setup : AnyJitter
        What the test's file says.
    sights : Sights
        What lines saw of the same points.
    found : Found
        Oscillations, spectra.
    course : Course | None
        The attitude as a spline; None where none was asked for.
    measurements : PassMeasurements
        What it was found in.
    truth : Jitter | None
        The jitter of a simulation, with what it is of lines; None on measurements.
    """

    setup: AnyJitter
    sights: Sights
    found: JitterSearch
    course: Course | None
    measurements: PassMeasurements
    truth: Jitter | None = None

    @property
    def columns(self) -> list[int]:
        """Columns of rotation vectors, for the axes that were searched."""
        return [AXES.index(axis) for axis in self.setup.test.search.axes]

    @property
    def oscillations(self) -> list[Oscillation]:
        """All that were found, the strongest first."""
        return [Oscillation(self, k) for k in range(len(self.found.lines.frequency))]

    @property
    def noise_factors(self) -> dict[str, float]:
        """Line -> standard deviation of its noise over that of its points' covariances."""
        return dict(zip(self.sights.lines, np.sqrt(self.found.factors[:-1]).tolist(), strict=True))

    @property
    def chance_of_the_next(self) -> float:
        """Probability that noise alone has the highest power that is left."""
        after = self.found.after
        return float(after.chance(after.power[after.best]))

    def by_axis(self, values: np.ndarray) -> dict[str, float]:
        """Axis -> value of a row (A,)."""
        return dict(zip(self.setup.test.search.axes, np.asarray(values).tolist(), strict=True))


@dataclass(frozen=True, eq=False)
class Oscillation:
    """An oscillation that was found.

    Attributes
    ----------
    one : PassJitter
        The pass.
    number : int
        Which one, the strongest first.
    """

    one: PassJitter
    number: int

    @property
    def amplitude(self) -> tuple[np.ndarray, np.ndarray]:
        """(A,) radians about the axes, and their sigmas."""
        lines = self.one.found.lines
        return lines.amplitude[self.number], lines.amplitude_sigma[self.number]

    @property
    def phase(self) -> np.ndarray:
        """(A,) phases at the epoch, radians."""
        return np.asarray(self.one.found.lines.phase[self.number])

    @property
    def pixels(self) -> np.ndarray:
        """(A,) amplitudes in angles of a pixel."""
        return np.asarray(self.amplitude[0] / self.one.sights.pixel)

    @property
    def truth(self) -> tuple[float, np.ndarray] | None:
        """Frequency, hertz, and amplitudes (A,), radians, of the stated oscillation that it is; None where there is
        none within a resolution element.
        """
        test, stated = self.one.setup.test, self.one.truth
        if stated is None or not isinstance(test, OrbitJitterSpec) or test.attitude.jitter is None:
            return None
        away = np.abs(stated.frequency[: len(test.attitude.jitter.lines)] - self.frequency[0])
        if not len(away) or away.min() > 1.0 / self.one.sights.observations.span:
            return None
        k = int(np.argmin(away))
        return float(stated.frequency[k]), np.hypot(stated.sine[k], stated.cosine[k])[self.one.columns]

    @property
    def frequency(self) -> tuple[float, float]:
        """Hertz, and its sigma."""
        lines = self.one.found.lines
        return float(lines.frequency[self.number]), float(lines.frequency_sigma[self.number])

    @property
    def in_search(self) -> bool:
        """Return whether the frequency is one of those that were searched."""
        search = self.one.setup.test.search
        return bool(search.lowest <= self.frequency[0] <= search.highest)

    @property
    def aliases(self) -> tuple[float, ...]:
        """Return the other frequencies, hertz, that explain the observations as well."""
        return self.one.found.lines.aliases[self.number]


@dataclass(frozen=True, eq=False)
class JitterRun:
    """A search.

    Attributes
    ----------
    setup : AnyJitter
        What its file says.
    seed : int
        Of all random numbers.
    passes : Mapping[str, PassJitter]
        By name.
    """

    setup: AnyJitter
    seed: int
    passes: Mapping[str, PassJitter]

    @property
    def simulated(self) -> bool:
        """Whether there is a truth."""
        return isinstance(self.setup, JitterSetup)


@one_blas_thread()
def run_jitter(setup: AnyJitter, backend: Backend | None, seed: int, advance: Advance = silent) -> JitterRun:
    """Fly or read, and search; nothing is traced, so that the backend is not used.

    Raises
    ------
    InputError
        Files that cannot be used.
    BenchError
        No such orbit, or points that tell nothing of jitter.
    """
    spec = setup.test
    passes: list[tuple[PassMeasurements, Jitter | None]] = []
    if isinstance(setup, MeasuredJitterSetup):
        effects = LightEffects.of(setup.test.effects) if setup.test.effects.corrected else NO_EFFECTS
        passes = [(one, None) for one in read_measurements(setup.data, setup.camera, advance, needed={})]
    else:
        effects = LightEffects.of(setup.test.effects)
        passes = [fly_strip(setup, seed)]
    cameras, found = line_cameras(setup.camera), {}
    for k, (one, truth) in enumerate(passes):
        advance("search", k, len(passes))
        try:
            sights = sights_of(one, cameras, spec.lines, spec.search, effects)
            given = sights.observations
            sought = spec.search
            fastest = 0.5 / max(one.line_times[name].line_time for name in sights.lines)
            lines = search(given, sought.lowest, sought.highest, sought.false_alarm, fastest)
            spline = spec.search.spline
            kept = given.taken(lines.used)
            course = None if spline is None else fit_spline(kept, spline.interval, spline.sigma)
        except (JitterError, SightsError, ValueError) as error:
            key = "points" if isinstance(setup, JitterSetup) else "data"
            raise BenchError(f"{one.name}: {error}", (key,), _REMEDY) from error
        found[one.name] = PassJitter(setup, sights, lines, course, one, truth)
    advance("search", len(passes), len(passes))
    return JitterRun(setup, seed, FrozenMap(found))


def fly_strip(setup: JitterSetup, seed: int) -> tuple[PassMeasurements, Jitter | None]:
    """Places that all lines of a simulated pass saw, with noise, and the true jitter.

    Raises
    ------
    BenchError
        No such orbit, or lines that do not see enough of the strip.
    """
    spec: OrbitJitterSpec = setup.test
    root = np.random.SeedSequence(seed)
    earth, wanted = Earth.from_spec(spec.earth), spec.points
    try:
        trajectory = Trajectory.flown(propagate(spec.orbit, earth), spec.attitude, root)
    except ValueError as error:
        raise BenchError(str(error), ("orbit",), "an orbit that the satellite can fly") from error
    place, image, false, data = (np.random.default_rng(stream(root, k)) for k in range(4))
    measured = trajectory.with_errors(spec.errors, int(data.integers(2**31)))
    platform = PlatformTable.sampled(measured, spec.errors.gps.interval, spec.errors.star_tracker.interval)
    count = max(int((trajectory.last - trajectory.first) / spec.line_time) - 1, 1)
    times = LineTimes.even(trajectory.first + 0.5 * spec.line_time, spec.line_time, count)
    names = spec.lines or tuple(setup.camera.lines)
    cameras, effects = line_cameras(setup.camera), LightEffects.of(spec.effects)
    sensors = {name: Sensor.of_lines(cameras[name], trajectory, earth, times, effects) for name in names}
    many = int(np.ceil(_SPARE * wanted.count))
    first = sensors[names[0]]
    away = wanted.duration * (place.uniform(size=many) - 0.5)
    if wanted.rows is not None:
        spread = wanted.row_spread * np.clip(place.standard_normal(many), -3.0, 3.0)
        away = np.clip(wanted.rows * np.rint(away / wanted.rows) + spread, *(0.5 * wanted.duration * np.array([-1, 1])))
    seconds = spec.time + away
    pixel = place.uniform(0.0, first.camera.pixels - 1.0, many)
    height = wanted.height + wanted.relief * place.uniform(-1.0, 1.0, many)
    points = first.ground((seconds - first.first_line_time) / first.line_time, pixel, height)
    seen = {name: np.stack(sensor.image(points), axis=-1) for name, sensor in sensors.items()}
    noise = {name: wanted.line_noise.get(name, wanted.noise) for name in names}
    edge = 10.0 * max(noise.values()) + _WRONG
    inside = np.ones(many, bool)
    for name, at in seen.items():
        last = np.array([count, sensors[name].camera.pixels]) - 1.0 - edge
        with np.errstate(invalid="ignore"):
            inside &= np.all((at > edge) & (at < last), axis=1)
    kept = np.flatnonzero(inside)[: wanted.count]
    if len(kept) < wanted.count:
        problem = f"{len(kept)} of {wanted.count} places are seen by all of {', '.join(names)}"
        raise BenchError(problem, ("points", "duration"), "a shorter strip within the orbit, or other `lines`")
    images = {}
    for name, at in seen.items():
        off = noise[name] * image.standard_normal((len(kept), 2))
        bad = false.uniform(size=len(kept)) < wanted.wrong
        off[bad] += false.uniform(-_WRONG, _WRONG, (len(kept), 2))[bad]
        found = at[kept] + off
        images[name] = ImagePoints.of(np.arange(len(kept)), found[:, 0], found[:, 1], wanted.noise**2 * np.eye(2))
    ids = np.array([f"t{k}" for k in range(len(kept))], object)
    ground = GroundPoints.of(ids, np.full((len(kept), 3), np.nan), np.zeros((3, 3)), "tie")
    one = PassMeasurements(spec.name, platform, FrozenMap(dict.fromkeys(names, times)), ground, FrozenMap(images))
    return one, trajectory.jitter if isinstance(trajectory.jitter, Jitter) else None


def exported(run: JitterRun) -> dict[str, str]:
    """Path -> text of a folder of measurements with a test file that reads them back."""
    spec = run.setup.test
    plain = spec.plain()
    files = campaign_files([one.measurements for one in run.passes.values()], run.setup.camera.plain())
    test = {
        "name": spec.name,
        "description": spec.description,
        "camera": f"./{CAMERA_FILE}",
        "data": ".",
        "effects": {**plain["effects"], "corrected": True} if run.simulated else plain["effects"],
        **({"lines": list(spec.lines)} if spec.lines else {}),
        "search": plain["search"],
    }
    return files | {TEST_FILE: dump_yaml(test)}


@dataclass(frozen=True, eq=False)
class BlindMultiple:
    """A multiple k / dt of a pair's gap.

    Attributes
    ----------
    first : str
        Line that sees a place first.
    second : str
        The other.
    gap : float
        Between their sights, seconds.
    order : int
        k.
    frequency : float
        hertz.
    response : float
        Of all lines together there, of the worst axis as against its best.
    blind : bool
        Whether all lines together are blind there.
    """

    first: str
    second: str
    gap: float
    order: int
    frequency: float
    response: float
    blind: bool


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


def transfers(one: PassJitter) -> dict[str, dict[str, float]]:
    """Line -> root mean square over the phases of the transfer at Nyquist, along the line (by roll) and along the track
    (by pitch), of all oscillations found together; of the lines whose file says how they collect light.
    """
    directions, out = {"roll": "along_line", "pitch": "along_track"}, {}
    swings = [(line.frequency[0], one.by_axis(line.pixels)) for line in one.oscillations]
    for name in one.sights.lines:
        image = one.setup.camera.image_of(name)
        if image is None:
            continue
        light = Collection.of(image.tdi, one.measurements.line_times[name].line_time)
        out[name] = {
            directions[axis]: float(light.mtf(0.5, Motion.of([(f, swing[axis]) for f, swing in swings])))
            for axis in one.setup.test.search.axes
            if axis in directions
        }
    return out


def _true_amplitudes(of: Oscillation) -> dict[str, float] | None:
    return None if of.truth is None else of.one.by_axis(of.truth[1])


LINE: Record[Oscillation] = Record(
    "An oscillation that was found.",
    Quantity("frequency_hz", lambda of: of.frequency[0], "of it"),
    Quantity("frequency_hz_sigma", lambda of: of.frequency[1], "standard deviation"),
    Quantity("amplitude_arcsec", lambda of: of.one.by_axis(of.amplitude[0]), "axis -> half of what it swings in all"),
    Quantity("amplitude_arcsec_sigma", lambda of: of.one.by_axis(of.amplitude[1]), "axis -> standard deviation"),
    Quantity("amplitude_px", lambda of: of.one.by_axis(of.pixels), "axis -> in angles of a pixel"),
    Quantity("phase_deg", lambda of: of.one.by_axis(of.phase), "axis -> p of sin(2 pi f t + p), t from the epoch"),
    Quantity("chance", lambda of: of.one.found.lines.chance[of.number], "largest, of noise alone, anywhere"),
    Quantity("in_search", lambda of: of.in_search, "whether the frequency is one of those that were searched"),
    Quantity("aliases_hz", lambda of: list(of.aliases), "other frequencies that explain the observations as well"),
    Quantity("true_frequency_hz", lambda of: of.truth and of.truth[0], "of the stated one", where_known=True),
    Quantity("true_amplitude_arcsec", _true_amplitudes, "axis -> likewise", where_known=True),
)
MULTIPLE: Record[BlindMultiple] = Record(
    "Where two lines by themselves see nothing: a whole number of periods lies between their sights.",
    Quantity("first", lambda one: one.first, "line that sees a place first", "first"),
    Quantity("second", lambda one: one.second, "the other", "second"),
    Quantity("gap_ms", lambda one: one.gap, "between their sights", "gap", 2),
    Quantity("periods", lambda one: one.order, "in the gap", "periods"),
    Quantity("frequency_hz", lambda one: one.frequency, "periods over gap", "frequency [Hz]", 3),
    Quantity("response", lambda one: one.response, "of all lines together, as against their best", "response", 3),
    Quantity("blind", lambda one: one.blind, "whether all lines together see nothing there either", "by all lines"),
)


def _gaps(one: PassJitter) -> dict[str, float]:
    return {f"{first} to {second}": gap for (first, second), (_, gap, _) in one.sights.gaps.items()}


def _detectable(one: PassJitter) -> dict[str, float]:
    """Axis -> median over the frequencies that are looked at, radians."""
    return one.by_axis(np.median(one.found.detectable[~one.found.before.blind], axis=0))


PASS: Record[PassJitter] = Record(
    "A pass.",
    Quantity("epoch_utc", lambda one: one.measurements.platform.epoch, "from which times count"),
    Quantity("lines", lambda one: list(one.sights.lines), "in the order in which they see a place"),
    Quantity("points", lambda one: one.sights.points, "seen by two lines or more"),
    Quantity("share_used", lambda one: np.mean(one.found.used), "of the observations; the others are wrong matches"),
    Quantity("gap_ms", _gaps, "pair -> median time between the sights of a place"),
    Quantity("duration_s", lambda one: one.sights.observations.span, "from the first sight to the last"),
    Quantity("pixel_arcsec", lambda one: one.sights.pixel, "angle of a pixel along the line"),
    Quantity("noise_factor", lambda one: one.noise_factors, "line -> what remains over what its covariances say"),
    Quantity("aliases_sought_to_hz", lambda one: one.found.beyond, "highest frequency of aliases"),
    Quantity("oscillations", lambda one: one.oscillations, "the strongest first", record=LINE),
    Quantity("chance_of_the_next", lambda one: one.chance_of_the_next, "of noise alone, of the highest power left"),
    Quantity("detectable_arcsec", _detectable, "axis -> amplitude that would just be found, median over frequencies"),
    Quantity("blind_hz", lambda one: one.found.before.intervals(), "first and last of frequencies not looked at"),
    Quantity("blind_multiples", blind_multiples, "of every pair by itself", record=MULTIPLE),
    Quantity("mtf_at_nyquist", lambda one: transfers(one) or None, "line -> transfer, rms of phases", where_known=True),
)
JITTER: Record[JitterRun] = Record(
    "jitter.json. Jitter in what several lines saw one after the other.",
    Quantity("axes", lambda run: list(run.setup.test.search.axes), "of the body about which it was sought"),
    Quantity("lowest_hz", lambda run: run.setup.test.search.lowest, "frequency looked at"),
    Quantity("highest_hz", lambda run: run.setup.test.search.highest, "likewise"),
    Quantity("false_alarm", lambda run: run.setup.test.search.false_alarm, "probability of any where there is none"),
    Quantity("passes", lambda run: run.passes, "each by itself", record=PASS),
)
