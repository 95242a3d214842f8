"""Test targets in the main job: rendered, exposed and measured for every camera, before and after; the contract of
mtf.json.
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
from twin.framework.random_streams import stream
from twin.sensors.area_detector import FixedPattern
from twin.sensors.line_ccd import LineCcd
from twin.targets.target_images import DIRECTIONS, PLACES, BarDesign, TargetCamera, View, usable_pixels
from twin.targets.target_path import TargetPath

NYQUIST = 0.5
"""Nyquist frequency of any pixel, cycles/pixel."""


@dataclass(frozen=True, eq=False)
class TargetReading:
    """MTF from one target.

    Attributes
    ----------
    reason : str
        Why the frames cannot be measured; empty if they can.
    true_nyquist : float
        MTF of the traced pupil and the detector at ``at_nyquist``.
    at_nyquist : tuple[float, float]
        Frequency of what is called the MTF at Nyquist, (along, track), cycles/pixel.
    true_axis : float
        What ``true_nyquist`` would be without the target's tilt, at the Nyquist frequency along the line or along the
        track: that of image quality at this place.
    """

    reason: str
    true_nyquist: float
    at_nyquist: tuple[float, float]
    true_axis: float


@dataclass(frozen=True, eq=False)
class EdgeReading(TargetReading):
    """MTF from one knife edge.

    Attributes
    ----------
    measured : EdgeMtf | None
        From the frames, None if they cannot be measured.
    frequency : np.ndarray
        (F,) along the edge's normal, cycles/m.
    true : np.ndarray
        (F,) MTF of the traced pupil and the detector there.
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
        """How much noise lengthens the measured MTF at the Nyquist frequency on the average."""
        edge = self.measured
        return None if edge is None else float(np.interp(NYQUIST, edge.frequency, edge.noise_bias))


@dataclass(frozen=True, eq=False)
class BarReading(TargetReading):
    """MTF from one bar target near the Nyquist frequency.

    Attributes
    ----------
    measured : BarMtf | None
        From the frames, None if they cannot be measured.
    """

    measured: BarMtf | None

    @property
    def nyquist(self) -> tuple[float, float] | None:
        """Measured MTF of the bars and its sigma; None if the frames cannot be measured."""
        return None if self.measured is None else (self.measured.mtf, self.measured.sigma)


@dataclass(frozen=True, eq=False)
class TargetShots:
    """All targets at one place in one state.

    Attributes
    ----------
    frames : Mapping[str, np.ndarray]
        Name of the image -> grey values, uint16 (N, H, W).
    column : int
        Of the windows' first pixels on the line.
    edges, bars : Mapping[str, EdgeReading]
        Direction -> reading; empty if not rendered.
    light_lost : float
        Share of the light that bodies in the beam take.
    """

    frames: Mapping[str, np.ndarray]
    column: int
    edges: Mapping[str, EdgeReading]
    bars: Mapping[str, BarReading]
    light_lost: float


@dataclass(frozen=True, eq=False)
class PlaceTargets:
    """Before and after at one place of a line.

    Attributes
    ----------
    place : np.ndarray
        Nominal (along, across) on the focal plane, metres.
    shift : np.ndarray
        True move of the image of a fixed direction on the focal plane, (along, across), metres.
    before, after : TargetShots
        The images.
    """

    place: np.ndarray
    shift: np.ndarray
    before: TargetShots
    after: TargetShots

    @property
    def shots(self) -> dict[str, TargetShots]:
        """By their names in files and results."""
        return {"before": self.before, "after": self.after}


@dataclass(frozen=True, eq=False)
class CameraTargets:
    """One camera.

    Attributes
    ----------
    band : str
        Name of the line CCD's band.
    pitch : float
        Of its pixels, metres.
    places : Mapping[str, PlaceTargets]
        Left, centre, right.
    """

    band: str
    pitch: float
    places: Mapping[str, PlaceTargets]


@dataclass(frozen=True, eq=False)
class TargetRun:
    """All cameras.

    Attributes
    ----------
    cameras : Mapping[str, CameraTargets]
        By name.
    frames : int
        Of each image.
    obstruction : bool
        Whether what stands in the beams is missing in the pupils.
    """

    cameras: Mapping[str, CameraTargets]
    frames: int
    obstruction: bool = True

    def images(self) -> Iterator[tuple[str, str, np.ndarray, FrameFacts]]:
        """Every image: the stem of its file, its name, the frames (N, H, W) and what is known of them."""
        for camera, found in self.cameras.items():
            for place, targets in found.places.items():
                for when, shots in targets.shots.items():
                    for name, frames in shots.frames.items():
                        facts = FrameFacts(
                            f"{camera}, line CCD {found.band}", found.pitch, note=f"{name}, {place}, {when}"
                        )
                        yield f"{camera}_{place}_{name}_{when}", name, frames, facts

    @property
    def has_edges(self) -> bool:
        """Whether there are curves."""
        return any(place.before.edges for camera in self.cameras.values() for place in camera.places.values())

    @property
    def warnings(self) -> tuple[str, ...]:
        """What could not be measured, and why."""
        out = []
        for camera, found in self.cameras.items():
            for place, targets in found.places.items():
                for when, shots in targets.shots.items():
                    kinds = (("knife edge", shots.edges), ("bars", shots.bars))
                    for what, readings in kinds:
                        for direction, reading in readings.items():
                            if reading.measured is None:
                                out.append(
                                    f"{what} ({direction}) at the {place} of {camera} {when}: no MTF at Nyquist, truly "
                                    f"{reading.true_nyquist:.3f}: {reading.reason}"
                                )
        return tuple(out)

    def to_dict(self) -> dict[str, Any]:
        """Contents of mtf.json. What could not be measured is null; ``truth`` has the shape of ``cameras``, and the MTF
        on the axes, which tilted edges and bars do not see, beside it.
        """
        cameras, truth = {}, {}
        for name, camera in self.cameras.items():
            places, true_places = {}, {}
            for place, targets in camera.places.items():
                along, across = (1e3 * targets.place + 0.0).tolist()
                columns = {when: shots.column for when, shots in targets.shots.items()}
                where = {"along_mm": along, "across_mm": across, "columns": columns}
                places[place] = {**where, **_directions(targets, _measured)}
                shift = dict(zip(("along", "across"), (1e6 * targets.shift + 0.0).tolist(), strict=True))
                lost = {when: shots.light_lost for when, shots in targets.shots.items()}
                true_places[place] = {"image_shift_um": shift, "light_lost": lost, **_directions(targets, _true)}
            cameras[name] = {
                "band": camera.band,
                "pitch_um": 1e6 * camera.pitch,
                "nyquist_per_mm": 1e-3 * NYQUIST / camera.pitch,
                "places": places,
            }
            truth[name] = {"places": true_places}
        about = {"frames": self.frames, "obstruction": "traced" if self.obstruction else "ignore"}
        return {**about, "cameras": cameras, "truth": {"cameras": truth}}


def _directions(targets: PlaceTargets, say: Any) -> dict[str, Any]:
    """Direction -> before/after -> what ``say`` makes of the readings."""
    out: dict[str, Any] = {}
    for when, shots in targets.shots.items():
        for direction in sorted({*shots.edges, *shots.bars}):
            out.setdefault(direction, {})[when] = say(shots.edges.get(direction), shots.bars.get(direction))
    return out


def _measured(edge: EdgeReading | None, bars: BarReading | None) -> dict[str, Any]:
    out: dict[str, Any] = {}
    if edge is not None:
        value, sigma = edge.nyquist or (None, None)
        found = edge.measured
        out |= {"mtf_nyquist": value, "mtf_nyquist_sigma": sigma, "mtf_nyquist_noise_bias": edge.nyquist_bias}
        out["curve"] = None if found is None else {**_curve(edge, found.mtf), "mtf_sigma": found.sigma.tolist()}
    if bars is not None:
        value, sigma = bars.nyquist or (None, None)
        out |= {"bars_mtf": value, "bars_mtf_sigma": sigma}
    return out


def _true(edge: EdgeReading | None, bars: BarReading | None) -> dict[str, Any]:
    out: dict[str, Any] = {}
    if edge is not None:
        out |= {"mtf_nyquist": edge.true_nyquist, "curve": _curve(edge, edge.true)}
        out |= {"mtf_nyquist_cycles_per_pixel": list(edge.at_nyquist), "mtf_nyquist_axis": edge.true_axis}
    if bars is not None:
        out |= {"bars_mtf": bars.true_nyquist, "bars_cycles_per_pixel": list(bars.at_nyquist)}
        out["mtf_nyquist_axis"] = bars.true_axis
    return out


def _curve(edge: EdgeReading, mtf: np.ndarray) -> dict[str, list[float]]:
    return {"frequency_per_mm": (1e-3 * edge.frequency).tolist(), "mtf": mtf.tolist()}


CURVE = np.linspace(0.0, 1.0, 65)
"""Frequencies of the measured curves, cycles/pixel: to twice the Nyquist frequency."""

LARGEST_FRAMES = 400_000_000
"""Pixels of all frames together, which are kept: 0.8 GB."""

EVEN_FIELDS = {"dark": 0.0, "bright": 1.0}
"""Recorded with bars: share of the white signal."""

_PATTERN, _EXPOSURE = 3, 4
"""Random streams of the job's seed, beside those of the monitor."""


def target_pixels(resolved: ResolvedJob) -> int:
    """Pixels of all frames of a job's test targets, before and after.

    Parameters
    ----------
    resolved : ResolvedJob
        The job.
    """
    settings, names = resolved.targets, resolved.job.render.target_images
    kinds = sum({"knife_edge": len(DIRECTIONS), "bars": len(DIRECTIONS) + len(EVEN_FIELDS)}.get(n, 1) for n in names)
    each = len(resolved.instrument.cameras) * len(PLACES) * 2 * kinds * settings.region**2
    return each * (settings.frames or 1)


def check_targets(resolved: ResolvedJob) -> None:
    """See before any work whether the targets can be recorded as the job says.

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
            found=str(settings.frames),
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
                found=f"{settings.region} pixels on a line of {pixels}",
                allowed="a smaller region or a longer line",
            )


def _band(resolved: ResolvedJob, name: str) -> str:
    """Name of the band whose line CCD of a camera images targets."""
    return target_band(resolved.cameras[resolved.instrument.cameras[name].camera])


def target_camera(resolved: ResolvedJob, instrument: Instrument, name: str, backend: Backend) -> TargetCamera:
    """A camera of an instrument before targets, with the line CCD, the windows and the obstruction that a job asks for.

    Parameters
    ----------
    resolved : ResolvedJob
        The job, with the data sheets of its line CCDs.
    instrument : Instrument
        As built from it.
    name : str
        Of the camera.
    backend : Backend
        Where to trace.
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
        The job, with targets among its images, as ``check_targets`` lets it pass.
    instrument : Instrument
        As built from it.
    backend : Backend
        Where to trace.
    state : State
        After the perturbation.
    seed : int
        Of the noise.
    advance : Callable[[int, int], None]
        Told how many of how many windows are done.

    Raises
    ------
    TargetLostError
        The perturbation moves the light off.
    """
    settings, images = resolved.targets, resolved.job.render.target_images
    frames = settings.frames or 1
    total = len(instrument.cameras) * len(PLACES) * 2
    cameras, done = {}, 0
    for number, name in enumerate(instrument.cameras):
        camera = target_camera(resolved, instrument, name, backend)
        ccd = camera.ccd
        before = camera.views({})
        after = camera.views(state) if state else before
        pattern = ccd.pattern(stream(seed, _PATTERN, number))
        places = {}
        for k, place in enumerate(PLACES):
            shooter = _Shooter(settings, frames, images, before[place], pattern)
            shots = []
            for when, view in enumerate((before[place], after[place])):
                advance(done, total)
                shots.append(shooter.shoot(view, stream(seed, _EXPOSURE, number, k, when)))
                done += 1
            places[place] = PlaceTargets(camera.places[k], after[place].shift - before[place].shift, *shots)
        cameras[name] = CameraTargets(_band(resolved, name), ccd.band.pitch, places)
    advance(done, total)
    return TargetRun(cameras, frames, resolved.job.render.obstructed)


class _Shooter:
    """Takes the images of all targets at one place."""

    def __init__(
        self, settings: TargetsSpec, frames: int, images: tuple[str, ...], nominal: View, pattern: FixedPattern
    ) -> None:
        self.settings = settings
        self.count = frames
        self.images = images
        self.pattern = pattern
        self.bars = {d: BarDesign.build(nominal, d) for d in DIRECTIONS} if "bars" in images else {}

    def shoot(self, view: View, seed: np.random.SeedSequence) -> TargetShots:
        """Expose and measure every target in one state."""
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
            # the levels as a bench takes them: shutter closed, and the source without a target
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
    """MTF of the traced pupil and the detector at the Nyquist frequency along the line or along the track."""
    axis = np.eye(2)[DIRECTIONS.index(direction)]
    return float(np.abs(view.transfer(NYQUIST / view.band.pitch * axis[None]))[0])


def read_edge(view: View, direction: str, normal: np.ndarray, mean: np.ndarray, frames: int) -> EdgeReading:
    """Measure the mean (H, W) of some frames of a knife edge with this normal, and trace the truth."""
    frequency = CURVE / view.band.pitch
    wanted = np.append(frequency, NYQUIST / view.band.pitch)
    true = np.abs(view.transfer(wanted[:, None] * normal))
    found: EdgeMtf | None = None
    reason = ""
    try:
        found = slanted_edge_mtf(mean, noise=view.ccd.noise, frames=frames, frequency=CURVE, uniform_light=True)
    except EdgeError as error:
        reason = str(error)
    at_nyquist = NYQUIST * float(normal[0]), NYQUIST * float(normal[1])
    own = reason, float(true[-1]), at_nyquist, on_axis(view, direction)
    return EdgeReading(*own, found, frequency, true[:-1])


def read_bars(
    view: View, direction: str, design: BarDesign, mean: np.ndarray, dark: np.ndarray, bright: np.ndarray, frames: int
) -> BarReading:
    """Measure the mean (H, W) of some frames of a bar target, and trace the truth.

    Parameters
    ----------
    view : View
        The place.
    direction : str
        That they measure.
    design : BarDesign
        The bars.
    mean : np.ndarray
        (H, W) of their frames, grey values.
    dark : np.ndarray
        (H, W) of as many frames with the shutter closed.
    bright : np.ndarray
        (H, W) of as many frames of an even field, as bright as the bars.
    frames : int
        How many.
    """
    frequency = design.seen(view)
    true = float(np.abs(view.transfer(frequency[None]))[0])
    along, track = (frequency * view.band.pitch).tolist()
    found: BarMtf | None = None
    reason = ""
    try:
        found = bar_mtf(
            mean[design.group], dark[design.group], bright[design.group], design.per_pixel,
            noise=view.ccd.noise, frames=frames,
        )  # fmt: skip
    except BarError as error:
        reason = str(error)
    return BarReading(reason, true, (along, track), on_axis(view, direction), found)
