"""Pictures of a camera in a perturbed state: wavefront, spots, MTF, through focus, knife edge on its line CCD."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from matplotlib.figure import Figure

from optics.geometry.tree import State
from optics.waves.optical_transfer import polychromatic_transfer
from scenes.models.camera_sharpness import field_text
from scenes.specs.job import TargetsSpec
from scenes.specs.resolved import ResolvedJob, resolve_job
from scenes.yaml.errors import InputError
from twin.camera.camera_results import Field
from twin.camera.camera_view import CameraView, draw_mtf, draw_spot, draw_wavefront
from twin.framework.random_streams import stream
from twin.framework.svg import AFTER, BEFORE, BLUE, GRAY, GREY, INK, VERMILION, look, to_svg
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.targets.target_images import DIRECTIONS, TargetCamera
from twin.targets.target_measurement import EdgeReading, read_edge, target_camera

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
                {"wavefront": _wavefront, "spot": _spot, "mtf": _mtf, "focus": _focus}[view](figure, views, field)
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


def _wavefront(figure: Figure, views: list[CameraView], field: Field) -> None:
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
        for column, ink, way in ((0, BLUE, "along the line"), (1, VERMILION, "along the track")):
            axes.plot(1e6 * shift, values[:, column], color=ink, ls=style, label=f"{name}, {way}")
    axes.axvline(0.0, color=INK, lw=0.6)
    axes.set_xlabel(f"the line CCD moved downstream by [{UM}]")
    axes.set_ylabel("MTF of the optics at Nyquist")
    axes.set_title(f"through focus, field {field_text(views[0].model.spec, field)}")
    axes.set_ylim(bottom=0.0)
    axes.legend(fontsize=7)
