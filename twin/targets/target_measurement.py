"""Test targets of the main job: images, exposure and MTF of every camera before and after its perturbation.

The results are the contents of mtf.json.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from analysis.mtf.bar_mtf import BarError, BarMtf, bar_mtf
from analysis.mtf.edge_location import EdgeError
from analysis.mtf.slanted_edge import EdgeMtf, slanted_edge_mtf
from optics.geometry.tree import State
from optics.numerics.backend import Backend
from optics.targets.target_shapes import TARGETS
from scenes.models.instrument_model import Instrument
from scenes.models.shadow import imaging_shadows
from scenes.specs.instrument import BASE
from scenes.specs.job import TargetsSpec
from scenes.specs.resolved import ResolvedJob, target_band
from twin.framework.data_files import FrameFacts
from twin.framework.procedure import stream
from twin.sensors.area_detector import FixedPattern
from twin.sensors.line_ccd import LineCcd
from twin.targets.target_images import DIRECTIONS, POSITIONS, BarDesign, TargetCamera, View, usable_pixels
from twin.targets.target_path import TargetPath

NYQUIST = 0.5
"""Nyquist frequency of any pixel, in cycles/pixel."""


@dataclass(frozen=True, eq=False)
class TargetReading:
    """MTF measured in the image of one target, with the true MTF computed from the traced pupil.

    Attributes
    ----------
    reason : str
        Reason why the frames cannot be measured; empty if they can.
    true_nyquist : float
        True MTF, of the traced pupil and the detector, at ``at_nyquist``.
    at_nyquist : tuple of float
        Frequency vector (along, track), in cycles/pixel, for which the result "MTF at Nyquist" holds; its magnitude is
        about 0.5.
    true_axis : float
        True MTF exactly along the line or along the track at the Nyquist frequency, which the tilted target does not
        measure; it equals that of the image quality at this position.
    """

    reason: str
    true_nyquist: float
    at_nyquist: tuple[float, float]
    true_axis: float


@dataclass(frozen=True, eq=False)
class EdgeReading(TargetReading):
    """MTF measured in the image of one knife edge, with the true MTF computed from the traced pupil.

    Attributes
    ----------
    measured : EdgeMtf | None
        Result from the frames; None if they cannot be measured.
    frequency : (F,) ndarray
        F frequencies along the edge's normal, in cycles/m.
    true : (F,) ndarray
        MTF of the traced pupil and the detector at these frequencies.
    """

    measured: EdgeMtf | None
    frequency: np.ndarray
    true: np.ndarray

    @property
    def nyquist(self) -> tuple[float, float] | None:
        """Measured MTF at the Nyquist frequency and its sigma; None if the frames cannot be measured."""
        return None if self.measured is None else self.measured.at(NYQUIST)

    @property
    def nyquist_bias(self) -> float | None:
        """Mean amount by which noise increases the measured MTF at the Nyquist frequency; None if not measured."""
        edge = self.measured
        return None if edge is None else float(np.interp(NYQUIST, edge.frequency, edge.noise_bias))


@dataclass(frozen=True, eq=False)
class BarReading(TargetReading):
    """MTF measured in the image of one bar target near the Nyquist frequency, with the true MTF from the traced pupil.

    Attributes
    ----------
    measured : BarMtf | None
        Result from the frames; None if they cannot be measured.
    """

    measured: BarMtf | None

    @property
    def nyquist(self) -> tuple[float, float] | None:
        """Measured MTF of the bars and its sigma; None if the frames cannot be measured."""
        return None if self.measured is None else (self.measured.mtf, self.measured.sigma)


@dataclass(frozen=True, eq=False)
class TargetShots:
    """Recorded images of all test targets at one position on the line, before or after the perturbation, and their MTF.

    Attributes
    ----------
    frames : mapping of str to ndarray
        Name of an image -> grey values of N frames of H x W pixels, uint16 (N, H, W).
    column : int
        Number of the line's pixel at the windows' first column.
    edges, bars : mapping
        Direction (along the line, along the track) -> measured MTF; empty if the target was not rendered.
    light_lost : float
        Fraction of the light that bodies in the beam block.
    """

    frames: Mapping[str, np.ndarray]
    column: int
    edges: Mapping[str, EdgeReading]
    bars: Mapping[str, BarReading]
    light_lost: float


@dataclass(frozen=True, eq=False)
class PlaceTargets:
    """Images of test targets before and after the perturbation at one position on a camera's line CCD.

    Attributes
    ----------
    position : (2,) ndarray
        Nominal position (along, across) on the focal plane, in metres.
    shift : (2,) ndarray
        True displacement of the image of a fixed direction on the focal plane due to the perturbation, (along, across),
        in metres.
    before, after : TargetShots
        Images in both states.
    """

    position: np.ndarray
    shift: np.ndarray
    before: TargetShots
    after: TargetShots

    @property
    def shots(self) -> dict[str, TargetShots]:
        """Name of the state ("before", "after"), as in files and results -> its images and measurements."""
        return {"before": self.before, "after": self.after}


@dataclass(frozen=True, eq=False)
class CameraTargets:
    """Images and MTF measurements of the test targets of one camera.

    Attributes
    ----------
    band : str
        Name of the line CCD's band.
    pitch : float
        Pixel pitch, in metres.
    positions : mapping of str to PlaceTargets
        Targets by position on the line: left, centre, right.
    """

    band: str
    pitch: float
    positions: Mapping[str, PlaceTargets]


@dataclass(frozen=True, eq=False)
class TargetRun:
    """Images and MTF measurements of the test targets of all cameras.

    Attributes
    ----------
    cameras : mapping of str to CameraTargets
        Targets by camera.
    frames : int
        Number of frames of each image.
    obstruction : bool
        True if light blocked by bodies in the beams is missing in the pupils.
    """

    cameras: Mapping[str, CameraTargets]
    frames: int
    obstruction: bool = True

    def images(self) -> Iterator[tuple[str, str, np.ndarray, FrameFacts]]:
        """Yield every image: its file name without suffix, target, N frames (N, H, W) and description.

        Frames have H rows and W columns.
        """
        for camera, position, when, shots in self._shots():
            targets = self.cameras[camera]
            for name, frames in shots.frames.items():
                note = f"{name}, {position}, {when}"
                facts = FrameFacts(f"{camera}, line CCD {targets.band}", targets.pitch, note=note)
                yield f"{camera}_{position}_{name}_{when}", name, frames, facts

    def _shots(self) -> Iterator[tuple[str, str, str, TargetShots]]:
        """Yield camera, position and state of all targets, with their frames and readings."""
        for camera, targets_of_camera in self.cameras.items():
            for position, targets in targets_of_camera.positions.items():
                for when, shots in targets.shots.items():
                    yield camera, position, when, shots

    @property
    def has_edges(self) -> bool:
        """True if knife edges were rendered, so that there are MTF curves."""
        return any(targets.before.edges for camera in self.cameras.values() for targets in camera.positions.values())

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about targets that could not be measured, with the reason."""
        out = []
        for camera, position, when, shots in self._shots():
            for what, readings in (("knife edge", shots.edges), ("bars", shots.bars)):
                for direction, reading in readings.items():
                    if reading.measured is None:
                        out.append(
                            f"{what} ({direction}) at the {position} of {camera} {when}: no MTF at Nyquist "
                            f"(true value {reading.true_nyquist:.3f}): {reading.reason}"
                        )
        return tuple(out)

    def to_dict(self) -> dict[str, Any]:
        """Return the contents of mtf.json.

        Values that could not be measured are null. ``truth`` has the same structure as ``cameras``, with true values,
        and also the MTF exactly along the line and along the track, which tilted edges and bars do not measure.
        """
        cameras, truth = {}, {}
        for name, camera in self.cameras.items():
            measured, true_values = {}, {}
            for position, targets in camera.positions.items():
                along, across = (1e3 * targets.position + 0.0).tolist()
                columns = {when: shots.column for when, shots in targets.shots.items()}
                where = {"along_mm": along, "across_mm": across, "columns": columns}
                measured[position] = {**where, **_directions(targets, _measured)}
                shift = dict(zip(("along", "across"), (1e6 * targets.shift + 0.0).tolist(), strict=True))
                lost = {when: shots.light_lost for when, shots in targets.shots.items()}
                true_values[position] = {"image_shift_um": shift, "light_lost": lost, **_directions(targets, _true)}
            cameras[name] = {
                "band": camera.band,
                "pitch_um": 1e6 * camera.pitch,
                "nyquist_per_mm": 1e-3 * NYQUIST / camera.pitch,
                "places": measured,
            }
            truth[name] = {"places": true_values}
        about = {"frames": self.frames, "obstruction": "traced" if self.obstruction else "ignore"}
        return {**about, "cameras": cameras, "truth": {"cameras": truth}}


def _directions(targets: PlaceTargets, plain: Any) -> dict[str, Any]:
    """Return the measurements by direction and state (before, after), as plain data that ``plain`` makes of each.

    ``plain`` is called with the knife edge's and the bars' measurement, either of which may be None.
    """
    out: dict[str, Any] = {}
    for when, shots in targets.shots.items():
        for direction in sorted({*shots.edges, *shots.bars}):
            out.setdefault(direction, {})[when] = plain(shots.edges.get(direction), shots.bars.get(direction))
    return out


def _measured(edge: EdgeReading | None, bars: BarReading | None) -> dict[str, Any]:
    """Return the measured MTF of one direction, from knife edge and bars, as plain data for mtf.json."""
    out: dict[str, Any] = {}
    if edge is not None:
        value, sigma = edge.nyquist or (None, None)
        result = edge.measured
        out |= {"mtf_nyquist": value, "mtf_nyquist_sigma": sigma, "mtf_nyquist_noise_bias": edge.nyquist_bias}
        out["curve"] = None if result is None else {**_curve(edge, result.mtf), "mtf_sigma": result.sigma.tolist()}
    if bars is not None:
        value, sigma = bars.nyquist or (None, None)
        out |= {"bars_mtf": value, "bars_mtf_sigma": sigma}
    return out


def _true(edge: EdgeReading | None, bars: BarReading | None) -> dict[str, Any]:
    """Return the true MTF of one direction, for knife edge and bars, as plain data for mtf.json."""
    out: dict[str, Any] = {}
    if edge is not None:
        out |= {"mtf_nyquist": edge.true_nyquist, "curve": _curve(edge, edge.true)}
        out |= {"mtf_nyquist_cycles_per_pixel": list(edge.at_nyquist), "mtf_nyquist_axis": edge.true_axis}
    if bars is not None:
        out |= {"bars_mtf": bars.true_nyquist, "bars_cycles_per_pixel": list(bars.at_nyquist)}
        out["mtf_nyquist_axis"] = bars.true_axis
    return out


def _curve(edge: EdgeReading, mtf: np.ndarray) -> dict[str, list[float]]:
    """Return an MTF curve of a knife edge as plain data: frequencies and values."""
    return {"frequency_per_mm": (1e-3 * edge.frequency).tolist(), "mtf": mtf.tolist()}


CURVE = np.linspace(0.0, 1.0, 65)
"""Frequencies of the measured curves, in cycles/pixel, up to twice the Nyquist frequency."""

LARGEST_FRAMES = 400_000_000
"""Largest number of pixels of all frames together, which stay in memory: 0.8 GB."""

EVEN_FIELDS = {"dark": 0.0, "bright": 1.0}
"""Name -> signal of the uniform fields recorded with bar targets, as a fraction of that of a white area."""

_PATTERN, _EXPOSURE = 3, 4
"""Numbers of random streams of the job's seed: pixel patterns and exposures of test targets; others are the monitor's.
"""


def target_pixels(resolved: ResolvedJob) -> int:
    """Return the number of pixels of all frames of a job's test targets, before and after the perturbation.

    Parameters
    ----------
    resolved : ResolvedJob
        Job.
    """
    settings, names = resolved.targets, resolved.job.render.target_images
    kinds = sum({"knife_edge": len(DIRECTIONS), "bars": len(DIRECTIONS) + len(EVEN_FIELDS)}.get(n, 1) for n in names)
    each = len(resolved.instrument.cameras) * len(POSITIONS) * 2 * kinds * settings.region**2
    return each * (settings.frames or 1)


def check_targets(resolved: ResolvedJob) -> None:
    """Raise InputError if the targets cannot be recorded as the job requires, before any work.

    Raises
    ------
    InputError
        The windows do not fit the line, or there are too many frames.
    """
    job, settings = resolved.job, resolved.targets
    if not job.render.target_images:
        return
    frames, pixels = settings.frames or 1, target_pixels(resolved)
    each = pixels // frames
    if pixels > LARGEST_FRAMES:
        raise job.error(
            "the frames of the test targets do not fit into memory",
            ("render", "targets", "frames"),
            value=str(settings.frames),
            allowed=f"at most {LARGEST_FRAMES // each} with regions of {settings.region} pixels",
        )
    for key, mounted in resolved.instrument.cameras.items():
        name = _band(resolved, key)
        camera = resolved.cameras[mounted.camera]
        pixels = camera.bands[name].pixels
        if usable_pixels(pixels, settings.region) <= 0.0:
            raise job.error(
                f"the images of targets do not fit the line CCD {name} of camera {mounted.camera!r}",
                ("render", "targets", "region"),
                value=f"{settings.region} pixels on a line of {pixels}",
                allowed="a smaller region or a longer line",
            )


def _band(resolved: ResolvedJob, name: str) -> str:
    """Return the name of the spectral band of a camera whose line CCD records the test targets."""
    return target_band(resolved.cameras[resolved.instrument.cameras[name].camera])


def target_camera(resolved: ResolvedJob, instrument: Instrument, name: str, backend: Backend) -> TargetCamera:
    """Return a camera that images test targets, with the line CCD, window size and beam obstruction of a job.

    Parameters
    ----------
    resolved : ResolvedJob
        Job with the data sheets of its line CCDs.
    instrument : Instrument
        Instrument built from the job.
    name : str
        Name of the camera.
    backend : Backend
        Backend of the ray trace.
    """
    assert resolved.line_detectors is not None
    model, sheet = instrument.cameras[name], resolved.line_detectors[resolved.instrument.cameras[name].camera]
    shadows = imaging_shadows(instrument, name, backend) if resolved.job.render.obstructed else None
    path = TargetPath(instrument.assembly, name, f"{BASE}/{name}", model, backend, shadows=shadows)
    ccd = LineCcd.from_specs(model.spec.bands[_band(resolved, name)], sheet)
    return TargetCamera(path, ccd, resolved.targets.region)


def render_targets(
    resolved: ResolvedJob,
    instrument: Instrument,
    backend: Backend,
    state: State,
    seed: int,
    advance: Callable[[int, int], None] = lambda done, total: None,
) -> TargetRun:
    """Render, expose and measure the job's test targets.

    Parameters
    ----------
    resolved : ResolvedJob
        Job with targets among its images, accepted by ``check_targets``.
    instrument : Instrument
        Instrument built from the job.
    backend : Backend
        Backend of the ray trace.
    state : State
        State after the perturbation.
    seed : int
        Seed of the noise.
    advance : callable
        Called with the number of windows that are done, and their total.

    Raises
    ------
    TargetLostError
        The perturbation moves the light off the line or the mirrors.
    """
    settings, images = resolved.targets, resolved.job.render.target_images
    frames = settings.frames or 1
    total = len(instrument.cameras) * len(POSITIONS) * 2
    cameras, done = {}, 0
    for number, name in enumerate(instrument.cameras):
        camera = target_camera(resolved, instrument, name, backend)
        ccd = camera.ccd
        before = camera.views({})
        after = camera.views(state) if state else before
        pattern = ccd.pattern(stream(seed, _PATTERN, number))
        targets = {}
        for k, position in enumerate(POSITIONS):
            shooter = _TargetRecorder(settings, frames, images, before[position], pattern)
            shots = []
            for when, view in enumerate((before[position], after[position])):
                advance(done, total)
                shots.append(shooter.shoot(view, stream(seed, _EXPOSURE, number, k, when)))
                done += 1
            targets[position] = PlaceTargets(
                camera.positions[k], after[position].shift - before[position].shift, *shots
            )
        cameras[name] = CameraTargets(_band(resolved, name), ccd.band.pitch, targets)
    advance(done, total)
    return TargetRun(cameras, frames, resolved.job.render.obstructed)


class _TargetRecorder:
    """Renders, exposes and measures all test targets at one position on a line CCD."""

    def __init__(
        self, settings: TargetsSpec, frames: int, images: tuple[str, ...], nominal: View, pattern: FixedPattern
    ) -> None:
        self.settings = settings
        self.count = frames
        self.images = images
        self.pattern = pattern
        self.bars = {d: BarDesign.build(nominal, d) for d in DIRECTIONS} if "bars" in images else {}

    def shoot(self, view: View, seed: np.random.SeedSequence) -> TargetShots:
        """Expose every target in one state of the camera, given by its ``view``, and measure the MTF."""
        frames: dict[str, np.ndarray] = {}
        edges: dict[str, EdgeReading] = {}
        bars: dict[str, BarReading] = {}

        def expose(name: str, share: np.ndarray) -> np.ndarray:
            photons = view.ccd.white_photons(self.settings.white) * view.light.light * share
            frames[name] = view.ccd.expose(photons, view.column, self.pattern, self.count, seed.spawn(1)[0])
            return np.asarray(frames[name].mean(axis=0))

        if "knife_edge" in self.images:
            for direction in DIRECTIONS:
                imager = view.edge(direction, self.settings.angle)
                mean = expose(f"knife_edge_{direction}", view.edge_image(imager))
                edges[direction] = read_edge(view, direction, imager.optics.normal, mean, self.count)
        if self.bars:
            means = {d: expose(f"bars_{d}", view.image(design.target)) for d, design in self.bars.items()}
            # the levels as measured on a bench: shutter closed, and the source without a target
            even = np.ones((view.region, view.region))
            dark, bright = (expose(f"bars_{name}", level * even) for name, level in EVEN_FIELDS.items())
            bars = {
                d: read_bars(view, d, design, means[d], dark, bright, self.count) for d, design in self.bars.items()
            }
        for name in self.images:
            if name in TARGETS:
                expose(name, view.image(TARGETS[name](view.band.pitch, view.region)))
        return TargetShots(frames, view.column, edges, bars, 1.0 - view.light.light)


def on_axis(view: View, direction: str) -> float:
    """Return the true MTF of optics and detector at the Nyquist frequency exactly along the line or along the track."""
    axis = np.eye(2)[DIRECTIONS.index(direction)]
    return float(np.abs(view.transfer(NYQUIST / view.band.pitch * axis[None]))[0])


def read_edge(view: View, direction: str, normal: np.ndarray, mean: np.ndarray, frames: int) -> EdgeReading:
    """Measure the MTF in the mean (H, W) of frames of a knife edge, and compute the true MTF from the traced pupil.

    ``normal`` (2,) is the unit normal of the edge in the image.
    """
    frequency = CURVE / view.band.pitch
    wanted = np.append(frequency, NYQUIST / view.band.pitch)
    true = np.abs(view.transfer(wanted[:, None] * normal))
    measured: EdgeMtf | None = None
    reason = ""
    try:
        measured = slanted_edge_mtf(mean, noise=view.ccd.noise, frames=frames, frequency=CURVE, uniform_light=True)
    except EdgeError as error:
        reason = str(error)
    at_nyquist = NYQUIST * float(normal[0]), NYQUIST * float(normal[1])
    common = reason, float(true[-1]), at_nyquist, on_axis(view, direction)
    return EdgeReading(*common, measured, frequency, true[:-1])


def read_bars(
    view: View, direction: str, design: BarDesign, mean: np.ndarray, dark: np.ndarray, bright: np.ndarray, frames: int
) -> BarReading:
    """Measure the MTF in the mean of frames of a bar target, and compute the true MTF from the traced pupil.

    Images have H rows and W columns.

    Parameters
    ----------
    view : View
        View of the position.
    direction : str
        Direction that the bars measure.
    design : BarDesign
        Design of the bars.
    mean : (H, W) ndarray
        Mean of the frames, in grey values.
    dark : (H, W) ndarray
        Mean of as many frames with the shutter closed.
    bright : (H, W) ndarray
        Mean of as many frames of an even field, as bright as the bars.
    frames : int
        Number of frames.
    """
    frequency = design.seen(view)
    true = float(np.abs(view.transfer(frequency[None]))[0])
    along, track = (frequency * view.band.pitch).tolist()
    measured: BarMtf | None = None
    reason = ""
    try:
        measured = bar_mtf(
            mean[design.group], dark[design.group], bright[design.group], design.per_pixel,
            noise=view.ccd.noise, frames=frames,
        )  # fmt: skip
    except BarError as error:
        reason = str(error)
    return BarReading(reason, true, (along, track), on_axis(view, direction), measured)
