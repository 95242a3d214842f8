"""A search for jitter: ``python -m twin.orbit jitter``, on a simulated pass or on measured ones."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from analysis.orbit.jitter import Course, Found, JitterError, search, splined

from optics.numerics.backend import one_blas_thread
from optics.numerics.number_tree import FrozenMap
from scenes.specs.measured.orbit_data_setup import AnyJitter, MeasuredJitterSetup
from scenes.specs.orbit.jitter_search import AXES, OrbitJitterSpec
from scenes.specs.orbit.setup import JitterSetup
from scenes.yaml.yaml_file import dump_yaml
from twin.orbit.flight.earth import Earth
from twin.orbit.flight.jitter import Jitter
from twin.orbit.flight.light_effects import NO_EFFECTS, LightEffects
from twin.orbit.flight.line_camera import LineTimes, line_cameras
from twin.orbit.flight.orbit import propagate
from twin.orbit.flight.platform_table import PlatformTable
from twin.orbit.flight.sensor import Sensor
from twin.orbit.flight.trajectory import Trajectory
from twin.orbit.jitter.sights import Sights, SightsError, sights_of
from twin.orbit.measured.measurement_tables import CAMERA_FILE, campaign_files, read_measurements
from twin.orbit.measured.pass_measurements import GroundPoints, ImagePoints, PassMeasurements
from twin.run.procedure import Advance, BenchError, silent
from twin.run.random_streams import stream

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

    Attributes:
        name: of the pass.
        epoch: UTC from which times count.
        sights: what lines saw of the same points.
        found: oscillations, spectra.
        course: the attitude as a spline; None where none was asked for.
        measurements: what it was found in.
        truth: the jitter of a simulation, with what it is of lines; None on measurements.
    """

    name: str
    epoch: str
    sights: Sights
    found: Found
    course: Course | None
    measurements: PassMeasurements
    truth: Jitter | None = None


@dataclass(frozen=True, eq=False)
class JitterRun:
    """A search.

    Attributes:
        setup: what its file says.
        seed: of all random numbers.
        passes: by name.
    """

    setup: AnyJitter
    seed: int
    passes: Mapping[str, PassJitter]

    @property
    def axes(self) -> tuple[str, ...]:
        """About which jitter was sought."""
        return tuple(self.setup.test.search.axes)

    @property
    def columns(self) -> list[int]:
        """Of rotation vectors, for the axes."""
        return [AXES.index(axis) for axis in self.setup.test.search.axes]

    @property
    def simulated(self) -> bool:
        """Whether there is a truth."""
        return isinstance(self.setup, JitterSetup)


@one_blas_thread()
def run_jitter(setup: AnyJitter, backend: Backend | None, seed: int, advance: Advance = silent) -> JitterRun:
    """Fly or read, and search; nothing is traced, so that the backend is not used.

    Raises:
        InputError: files that cannot be used.
        BenchError: no such orbit, or points that tell nothing of jitter.
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
            course = None if spline is None else splined(kept, spline.interval, spline.sigma)
        except (JitterError, SightsError, ValueError) as error:
            key = "points" if isinstance(setup, JitterSetup) else "data"
            raise BenchError(f"{one.name}: {error}", (key,), _REMEDY) from error
        found[one.name] = PassJitter(one.name, one.platform.epoch, sights, lines, course, one, truth)
    advance("search", len(passes), len(passes))
    return JitterRun(setup, seed, FrozenMap(found))


def fly_strip(setup: JitterSetup, seed: int) -> tuple[PassMeasurements, Jitter | None]:
    """Places that all lines of a simulated pass saw, with noise, and the true jitter.

    Raises:
        BenchError: no such orbit, or lines that do not see enough of the strip.
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
