"""Design of a camera on the live page: knobs of its prescription and of the field point, and the optics that follow.

A knob changes a number of the camera's file: a radius of curvature relatively, a conic constant, or the distance from a
surface to the next, which shifts all later surfaces along the parent axis. The changed camera is built as `python -m
twin.camera` builds a file with these numbers, so that its stop, its clear apertures and its frames follow the design.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from optics.geometry.tree import State
from optics.numerics import quadrature
from optics.numerics.array_math import PhysicalError
from optics.numerics.backend import Backend
from optics.numerics.number_tree import FrozenMap
from optics.waves.optical_transfer import polychromatic_transfer
from scenes.models.camera_design import sheets_by_path
from scenes.models.camera_model import IMAGE, CameraModel, derive_camera
from scenes.models.camera_sharpness import field_text
from scenes.specs.camera import CameraSpec
from scenes.specs.job import TargetsSpec
from scenes.specs.resolved import ResolvedJob, resolve_job
from scenes.yaml.errors import InputError, Issue
from twin.camera.camera_optics import INSIDE, CameraOptics
from twin.camera.camera_results import Field, Spot
from twin.camera.camera_view import (
    INCOMING,
    CameraView,
    begun,
    draw_mtf,
    draw_spot,
    draw_wavefront,
    section_lines,
    section_rays,
)
from twin.framework.artefact import rounded_down
from twin.framework.procedure import stream
from twin.framework.svg import AFTER, BEFORE, BLUE, GRAY, GREY, INK, VERMILION, look, to_svg
from twin.live.knobs import Knob
from twin.monitor.image_quality import MOST_BLUR
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.targets.target_images import DIRECTIONS, TargetCamera
from twin.targets.target_measurement import EdgeReading, read_edge, target_camera

DESIGN, FIELD = "design", "field"
"""First parts of the names of knobs: of the camera's prescription, and of the field point."""
RANGE_WAVES = 2.0
"""Change of the wavefront at the middle of the field at the end of a slider, waves rms, where the camera allows it."""
MAP_POINTS, FREQUENCIES, PIXELS = 49, 33, 80
"""Points of a wavefront map on each side, frequencies of an MTF, pixels of a point image on each side."""
PSF_HALF, MOST_PHASE, EVEN = 4.0, 250.0, 3000
"""Half width of a sharp point image in wavelengths over the numerical aperture, largest phase in radians between chief
ray and stop's edge in the picture of a wider one, and smallest number of rays of a vignetted stop.
"""
AIRY = 0.61
"""Radius of the Airy disk in wavelengths over the numerical aperture."""
BLURRED = f"image quality is computed up to {MOST_BLUR:g} waves rms"
"""Message where a camera is too far from sharp."""
DEGREE = math.pi / 180.0


class _Quantity(NamedTuple):
    """Number of a surface that has a knob.

    Attributes
    ----------
    unit : str
        Unit of the knob.
    step : float
        Change from which the range of the slider is computed.
    widest, limit : float
        Largest half range of a slider, and largest absolute value that may be typed.
    """

    unit: str
    step: float
    widest: float
    limit: float


QUANTITIES: Mapping[str, _Quantity] = {
    "radius": _Quantity("percent", 1e-4, 5.0, 50.0),
    "conic": _Quantity("", 1e-5, 1.0, 100.0),
    "thickness": _Quantity("mm", 1e-4, 50.0, 10_000.0),
}
"""Number of a surface -> its knob. A wavefront changes by 1e-3 waves or more with these steps, and linearly."""


@dataclass(frozen=True, eq=False)
class CameraDesign:
    """Camera whose prescription has knobs.

    Attributes
    ----------
    name : str
        Name of the camera in its instrument.
    reference : str
        Name of its prescription in the instrument's file.
    spec : CameraSpec
        The prescription as opened.
    knobs : Mapping[str, Knob]
        Name -> knob of the prescription or of the field point.
    """

    name: str
    reference: str
    spec: CameraSpec
    knobs: Mapping[str, Knob]

    @classmethod
    def of(cls, name: str, reference: str, spec: CameraSpec, backend: Backend) -> CameraDesign:
        """Return the design of a camera, with sliders whose ends change its wavefront by some waves.

        Parameters
        ----------
        name, reference : str
            Name of the camera in its instrument, and of its prescription.
        spec : CameraSpec
            The prescription.
        backend : Backend
            Backend that traces the rays.
        """
        knobs = {}
        for axis, half in zip("xy", (spec.field.x, spec.field.y), strict=True):
            end = float(f"{half / DEGREE:.12g}")
            knobs[f"{FIELD} {axis}"] = Knob(f"{FIELD} {axis}", FIELD, FIELD, axis, "deg", 0.0, end, end)
        nominal = _wavefront(spec, backend)
        for surface, mirror in spec.mirrors.items():
            for key, (unit, step, widest, limit) in QUANTITIES.items():
                if key != "thickness" and math.isinf(mirror.radius):
                    continue
                knob = f"{DESIGN}/{surface} {key}"
                change = np.sqrt(np.nanmean((_wavefront(changed_camera(spec, {knob: step}), backend) - nominal) ** 2))
                half_range = min(RANGE_WAVES * step / max(float(change), 1e-12), widest)
                extent = float(f"{rounded_down(half_range):.12g}") if math.isfinite(half_range) else 1.0
                knobs[knob] = Knob(knob, f"{DESIGN}/{surface}", DESIGN, key, unit, 0.0, extent, limit)
        return cls(name, reference, spec, FrozenMap(knobs))

    @property
    def nodes(self) -> tuple[str, ...]:
        """Paths of the page's tree under which the knobs are."""
        return (FIELD, DESIGN, *dict.fromkeys(knob.node for knob in self.knobs.values() if knob.kind == DESIGN))

    def field(self, values: Mapping[str, float]) -> Field:
        """Return the field point of knobs, as fractions of the half angles."""
        x, y = (values.get(f"{FIELD} {axis}", 0.0) / self.knobs[f"{FIELD} {axis}"].limit for axis in "xy")
        return x, y


def _wavefront(spec: CameraSpec, backend: Backend) -> np.ndarray:
    """Return the wavefront map of a camera at the middle of its field, waves; zero-dimensional NaN without light."""
    try:
        return CameraOptics.alone(spec, backend).wavefronts([(0.0, 0.0)], 33, 4, by_rays=True)[0].map
    except (InputError, PhysicalError, ValueError):
        return np.array(np.nan)


def changed_camera(spec: CameraSpec, values: Mapping[str, float]) -> CameraSpec:
    """Return the camera with the prescription that knobs set.

    Parameters
    ----------
    spec : CameraSpec
        The camera.
    values : Mapping[str, float]
        Knob of the prescription -> its value; the others are zero.

    Raises
    ------
    InputError
        A surface would pass the next.
    """
    places = [*(mirror.z for mirror in spec.mirrors.values()), spec.image.z]
    names = [*spec.mirrors, IMAGE]
    mirrors, moved, heading = {}, 0.0, 1.0
    for k, (name, mirror) in enumerate(spec.mirrors.items()):
        radius, conic, longer = (values.get(f"{DESIGN}/{name} {key}", 0.0) for key in QUANTITIES)
        numbers = {
            "z": mirror.z + moved,
            "radius": mirror.radius * (1.0 + 0.01 * radius),
            "conic": mirror.conic + conic,
        }
        # -950.114 mm, not -950.1139999999999
        changed = {key: float(f"{number:.15g}") for key, number in numbers.items() if number != getattr(mirror, key)}
        mirrors[name] = mirror.model_copy(update=changed)
        heading = heading if mirror.light else -heading
        gap = places[k + 1] - places[k]
        if longer and abs(gap) + 1e-3 * longer < 0.0:
            problem = f"{names[k + 1]} would be on the other side of {name}"
            raise InputError(Issue(problem, value=f"{longer:g} mm", allowed=f"{-1e3 * abs(gap):.6g} mm or more"))
        moved += math.copysign(1e-3 * longer, longer * (gap or heading))
    image = spec.image.model_copy(update={"z": float(f"{spec.image.z + moved:.15g}") if moved else spec.image.z})
    # without the file that it came from, whose lines have other numbers
    return CameraSpec.model_construct(**{**dict(spec), "mirrors": FrozenMap(mirrors), "image": image})


def with_traced_focal_length(spec: CameraSpec, backend: Backend) -> CameraSpec:
    """Return the camera whose file states the traced focal length of its surfaces, in focus or not.

    Raises
    ------
    InputError
        Light does not reach the image, or has no focus.
    """
    traced = abs(derive_camera(spec, backend, check_stated=False).paraxial.focal_length)
    return CameraSpec.model_construct(**{**dict(spec), "focal_length": float(f"{traced:.6g}")})


def camera_text(spec: CameraSpec, original: CameraSpec, remark: str) -> str:
    """Return the text of a changed camera's file; data sheets beside the original file get their absolute path."""
    plain = spec.plain()
    bands = sheets_by_path(plain.get("bands") or {}, Path(original.source.file).parent)
    return spec.file_text(remark, **({"bands": bands} if bands else {}))


def optics_data(optics: CameraOptics, field: Field) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return what the page draws of a camera's optics at a field point, and the images of wavefront and point image.

    Wavefront, spot and MTF are those of `twin.camera`; rays alone sample the light of a vignetted wavefront. Images are
    uint16 (1, n, n): of the wavefront 1 to 65535 from -``scale_waves`` to ``scale_waves`` and 0 without light, of the
    point image 65535 at the peak. A picture that cannot be computed has ``problem`` instead of its numbers.

    Parameters
    ----------
    optics : CameraOptics
        Camera in its state.
    field : Field
        Field point, as fractions of the half angles.

    Raises
    ------
    AimError, BeamMissedError, ValueError
        The light is lost.
    """
    wave = optics.wavefronts([field], MAP_POINTS, 4, by_rays=True)[0]
    spot = optics.spot(field)
    scale = float(np.nanmax(np.abs(wave.map)))
    shade = 1.0 + np.rint(32767.0 * (1.0 + wave.map / (scale or 1.0)))
    images = {"wavefront": np.nan_to_num(shade).astype(np.uint16)[None]}
    focal_length = abs(optics.model.paraxial.focal_length)
    data: dict[str, Any] = {
        "field_deg": [angle / DEGREE for angle in wave.field_rad],
        "wavefront": {
            "rms_waves": wave.rms,
            "peak_to_valley_waves": wave.peak_to_valley,
            "scale_waves": scale,
            "wavelength_nm": 1e9 * wave.wavelength,
        },
        "spot": {
            "rms_um": 1e6 * spot.rms,
            "airy_um": 1e6 * spot.airy,
            "half_um": 1e6 * spot.half_width,
            "rays_um": _rounded(1e6 * (spot.rays - spot.centroid), 4),
        },
        "layout": {
            **_layout(optics.model, optics.path.backend, field),
            "focal_length_m": focal_length,
            "f_number": focal_length / optics.model.entrance_pupil,
        },
    }
    if wave.rms > MOST_BLUR:
        return {**data, "mtf": {"problem": BLURRED}, "psf": {"problem": BLURRED}}, images
    try:
        mtf = optics.mtf(field, np.linspace(0.0, 2.0 * optics.nyquist, FREQUENCIES))
        along, across = mtf.at(mtf.nyquist)
        curves = {"values": _rounded(mtf.values, 5), "limit": _rounded(mtf.limit, 5)}
        frequency = _rounded(1e-3 * mtf.frequency, 4)
        data["mtf"] = {**curves, "frequency": frequency, "along": float(along), "across": float(across)}
    except (PhysicalError, ValueError) as error:
        data["mtf"] = {"problem": str(error)}
    try:
        half = image_width(spot)
        image = point_image(optics, field, spot, np.linspace(-half, half, PIXELS))
        data["psf"] = {"half_um": 1e6 * half, "strehl": wave.strehl}
        images["psf"] = np.rint(65535.0 * image / np.max(image)).astype(np.uint16)[None]
    except (PhysicalError, ValueError) as error:
        data["psf"] = {"problem": str(error)}
    return data, images


def _rounded(values: np.ndarray, decimals: int) -> Any:
    """Return an array as rounded lists, whose text is shorter."""
    return np.round(values, decimals).tolist()


def image_width(spot: Spot) -> float:
    """Return half the width of the picture of a point image, in metres: it contains the rays of the spot."""
    return max(PSF_HALF * spot.airy / AIRY, 1.3 * float(np.max(np.abs(spot.rays))))


def point_image(optics: CameraOptics, field: Field, spot: Spot, places: np.ndarray) -> np.ndarray:
    """Return the diffraction image of a point about its chief ray, (P, P), relative to the peak of a perfect image.

    It is the sum of the waves of rays, by Gauss' rule for a clear stop. Edges that vignette the light fall between
    rays, which costs some percent of the peak.

    Parameters
    ----------
    optics : CameraOptics
        Camera in its state.
    field : Field
        Field point.
    spot : Spot
        Spot there.
    places : (P,) ndarray
        Coordinates of the columns along the line and of the rows along the track, in metres.

    Raises
    ------
    ValueError
        The image is too wide for the sum.
    """
    half = float(np.max(np.abs(places)))
    phase = 2.0 * math.pi * AIRY * half / spot.airy
    if phase > MOST_PHASE:
        width = 2e6 * half
        raise ValueError(
            f"the light spreads over {width:.3g} \N{MICRO SIGN}m; the spot shows where, waves only a sharper image"
        )
    nodes = quadrature.disk_for(1.3 * phase)
    if optics.model.edges:
        nodes = quadrature.even_disk(max(EVEN, 2 * nodes.count))
    rays = optics.rays([field], INSIDE * np.concatenate([[[0.0, 0.0]], np.stack([nodes.x, nodes.y], axis=-1)]))
    wave_number = 2.0 * np.pi / optics.wavelength
    share = nodes.weight * rays.valid[0, 1:]
    tilt = rays.direction[0, 1:, 1::-1] - rays.direction[0, 0, 1::-1]
    wave, along, across = (
        np.exp(1j * (wave_number * path).astype(np.float32))
        for path in (optics.path_error(rays)[0, 1:], *(np.outer(places, tilt[:, k]) for k in (0, 1)))
    )
    amplitude = (across * (wave * share)) @ along.T / np.sum(share)
    return np.asarray(np.abs(amplitude) ** 2, float)


def _layout(model: CameraModel, backend: Backend, field: Field) -> dict[str, Any]:
    """Return surfaces and rays in the plane of symmetry, as points (z, y) in metres.

    The fields of the rays are both ends along the track and the field point; each has chief, lower and upper ray.
    """
    points = section_rays(model, backend, 1, [(0.0, -1.0), (0.0, 1.0), field])
    z = points[1:, ..., 2]
    drawn = begun(points, float(z.min() - INCOMING * np.ptp(z)))[..., [2, 1]]
    lines = section_lines(model, 1, 41).items()
    passes = {name for name, mirror in model.spec.mirrors.items() if mirror.light == "passes"}
    return {
        "surfaces": [
            {"name": name, "passes": name in passes, "points": _rounded(line[:, [2, 1]], 6)} for name, line in lines
        ],
        "rays": _rounded(np.moveaxis(drawn, 0, 2), 6),
    }


SIZE = (7.6, 3.5)
"""Size of a picture, in inches."""
FOCUS = 150e-6
"""Largest defocus of the through-focus picture on either side, in metres."""
STEPS = 49
"""Number of defocus values of the through-focus picture."""
LINE_POSITION = "centre"
"""Name of the position on the line CCD at which the knife edge is imaged."""
UM = "\N{MICRO SIGN}m"


class CameraPictures:
    """Drawing of an instrument's cameras in their present and in the nominal state; unchanging data are cached.

    Parameters
    ----------
    experiment
        Monitor experiment of the instrument.
    """

    def __init__(self, experiment: MonitorExperiment) -> None:
        self.experiment = experiment
        self._bench = lru_cache(maxsize=4)(_new_bench)

    def draw(
        self,
        view: str,
        camera: str,
        field: Field,
        state: State,
        frames: int,
        seed: int,
        now: MonitorExperiment | None = None,
    ) -> str:
        """Return a picture of a camera in a state, beside the nominal one, as SVG.

        Parameters
        ----------
        view : str
            ``wavefront``, ``spot``, ``mtf``, ``focus`` or ``target``.
        camera : str
            Name of the camera.
        field : Field
            Field point, as fractions of the half angles; a target is always at the centre of the line.
        state : State
            Body -> motion.
        frames : int
            Number of frames of the target.
        seed : int
            Seed of their noise.
        now : MonitorExperiment, optional
            Instrument with another design of the camera, which has the state.

        Raises
        ------
        InputError
            The camera does not exist, or cannot image targets.
        ValueError
            The camera's light is lost in this state.
        """
        both = [(self.experiment, {}), (now or self.experiment, state)]
        if camera not in self.experiment.instrument.cameras:
            raise ValueError(f"no camera {camera!r}")
        with look(f"live-{view}"):
            figure = Figure(figsize=SIZE, layout="constrained")
            if view == "target":
                self._target(figure, camera, both, frames, seed)
            else:
                views = [
                    CameraView.within(experiment.instrument, camera, experiment.backend, moved)
                    for experiment, moved in both
                ]
                {"wavefront": _wavefront_images, "spot": _spot, "mtf": _mtf, "focus": _focus}[view](
                    figure, views, field
                )
            return to_svg(figure)

    def _target(
        self, figure: Figure, camera: str, both: Sequence[tuple[MonitorExperiment, State]], frames: int, seed: int
    ) -> None:
        """Draw the knife edge before and after, and the MTF from both images."""
        shots: list[tuple[np.ndarray, EdgeReading]] = []
        for when, (experiment, state) in enumerate(both):
            bench, settings = self._bench(experiment, camera)
            pattern = bench.ccd.pattern(stream(seed, 3, 0))
            view_of_target = bench.views(state)[LINE_POSITION]
            imager = view_of_target.edge(DIRECTIONS[0], settings.angle)
            photons = (
                view_of_target.ccd.white_photons(settings.white)
                * view_of_target.light.light
                * view_of_target.edge_image(imager)
            )
            taken = view_of_target.ccd.expose(photons, view_of_target.column, pattern, frames, stream(seed, 4, when))
            mean = np.asarray(taken.mean(axis=0))
            shots.append((mean, read_edge(view_of_target, DIRECTIONS[0], imager.optics.normal, mean, frames)))
        images = figure.subplots(1, 3, width_ratios=(1.0, 1.0, 1.5))
        top = max(float(mean.max()) for mean, _ in shots)
        curve = images[2]
        for axes, (mean, reading), name, colour in zip(
            images, shots, ("before", "after"), (BEFORE, AFTER), strict=False
        ):
            axes.imshow(mean, cmap=GRAY, vmin=0.0, vmax=top, interpolation="nearest")
            axes.set_xticks([])
            axes.set_yticks([])
            axes.set_title(f"knife edge {name}")
            curve.plot(1e-3 * reading.frequency, reading.true, color=colour, lw=1.2, label=f"{name}, traced")
            if reading.measured is not None:
                measured = reading.measured
                pitch = 1e3 * bench.ccd.band.pitch
                curve.plot(
                    measured.frequency / pitch, measured.mtf, ".", color=colour, ms=3.0, label=f"{name}, from the image"
                )
            nyquist_mtf = reading.nyquist
            text = reading.reason if nyquist_mtf is None else f"{nyquist_mtf[0]:.4f} ± {nyquist_mtf[1]:.4f} at Nyquist"
            axes.set_xlabel(text, fontsize=7.5)
        curve.axvline(0.5e-3 / bench.ccd.band.pitch, color=GREY, lw=0.8, ls=":")
        curve.set_xlabel("cycles/mm")
        curve.set_ylim(0.0, 1.05)
        curve.set_title("MTF with the pixel, along the line")
        curve.legend(fontsize=7)


def _new_bench(experiment: MonitorExperiment, camera: str) -> tuple[TargetCamera, TargetsSpec]:
    """Return the camera prepared for imaging test targets, and the settings of the targets."""
    resolved = _with_targets(experiment.resolved)
    return target_camera(resolved, experiment.instrument, camera, experiment.backend), resolved.targets


def _with_targets(resolved: ResolvedJob) -> ResolvedJob:
    """Return the job with knife-edge targets added to it, and with the data sheets of its line CCDs.

    Raises
    ------
    ValueError
        The cameras have no line CCD that can image targets.
    """
    if resolved.line_detectors is not None:
        return resolved
    render = resolved.job.render.model_copy(update={"images": ("spots", "knife_edge")})
    try:
        made = resolve_job(resolved.job.model_copy(update={"render": render}))
    except InputError as error:
        raise ValueError(f"no targets can be imaged: {error}") from error
    return made.model_copy(update={"cameras": resolved.cameras})


def _wavefront_images(figure: Figure, views: list[CameraView], field: Field) -> None:
    """Draw the wavefront of the nominal and of the perturbed camera."""
    waves = [view.wavefront(field, points=65) for view in views]
    most = max(float(np.nanmax(np.abs(wave.map))) for wave in waves)
    meshes = []
    for axes, wave, name in zip(figure.subplots(1, 2), waves, ("as designed", "now"), strict=True):
        meshes.append(draw_wavefront(axes, wave, most))
        axes.set_title(f"{name}: {wave.rms:.3g} waves rms, {wave.peak_to_valley:.3g} PV")
        axes.set_xlabel("x / stop radius")
    figure.colorbar(meshes[0], ax=figure.axes, label=f"waves of {1e9 * waves[0].wavelength:.0f} nm", shrink=0.85)


def _spot(figure: Figure, views: list[CameraView], field: Field) -> None:
    """Draw the spot diagram of the nominal and of the perturbed camera."""
    spots = [view.spot(field) for view in views]
    half = max(spot.half_width for spot in spots)
    for axes, spot, name in zip(figure.subplots(1, 2), spots, ("as designed", "now"), strict=True):
        draw_spot(axes, spot, half)
        axes.set_title(f"{name}: rms radius {1e6 * spot.rms:.3g} {UM}")
        axes.set_xlabel(f"along the line [{UM}]")
        axes.set_ylabel(f"along the track [{UM}]")


def _mtf(figure: Figure, views: list[CameraView], field: Field) -> None:
    """Draw the MTF of the nominal and of the perturbed camera."""
    for axes, view, name in zip(figure.subplots(1, 2, sharey=True), views, ("as designed", "now"), strict=True):
        mtf = view.mtf(field)
        draw_mtf(axes, mtf)
        along, across = mtf.at(mtf.nyquist)
        axes.set_title(f"optics {name}: {along:.3f} along, {across:.3f} across at Nyquist")
    figure.axes[0].legend(fontsize=7)


def _focus(figure: Figure, views: list[CameraView], field: Field) -> None:
    """Draw the MTF at the Nyquist frequency through focus, of the nominal and of the perturbed camera."""
    axes = figure.subplots()
    shift = np.linspace(-FOCUS, FOCUS, STEPS)
    for view, name, style in zip(views, ("as designed", "now"), ((0, (3, 2)), "-"), strict=True):
        pupil = view.pupils([field])[0]
        colour = np.array([view.model.spec.wavelength])
        frequency = view.nyquist * np.eye(2)
        values = np.abs(polychromatic_transfer(pupil, frequency, colour, np.ones(1), shift))
        for column, ink, direction in ((0, BLUE, "along the line"), (1, VERMILION, "along the track")):
            axes.plot(1e6 * shift, values[:, column], color=ink, ls=style, label=f"{name}, {direction}")
    axes.axvline(0.0, color=INK, lw=0.6)
    axes.set_xlabel(f"the line CCD moved downstream by [{UM}]")
    axes.set_ylabel("MTF of the optics at Nyquist")
    axes.set_title(f"through focus, field {field_text(views[0].model.spec, field)}")
    axes.set_ylim(bottom=0.0)
    axes.legend(fontsize=7)
