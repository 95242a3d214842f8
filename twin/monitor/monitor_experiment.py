"""Monitoring experiment: perturb the instrument, render images of its area CCDs, and estimate the perturbation."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.ndimage import center_of_mass

from analysis.arrays import shows
from analysis.monitor.disturbances import Disturbances
from analysis.monitor.monitor_formulas import GroundGeometry, MonitorGeometry
from analysis.monitor.parameters import CameraCalibration, MonitorCalibration
from analysis.monitor.recovery import MotionModel
from analysis.spots.spot_template import SpotTemplate
from optics.geometry.tree import State
from optics.numerics.array_math import PhysicalError
from optics.numerics.backend import Backend, cores, one_blas_thread
from optics.thermal.heat import Temperature
from optics.thermal.nodal_deformation import NodalDeformation
from optics.waves.diffraction import UnsampledImageError
from scenes.models.disturbances import DisturbancePrior, check_heat, disturbance_prior
from scenes.models.instrument_builder import build_instrument
from scenes.models.instrument_model import Instrument
from scenes.models.job_state import (
    HeatedBody,
    deformations_of,
    heated_bodies,
    job_state,
    motions_of,
    on_deformed,
    with_heat,
)
from scenes.models.thermal_model import ThermalModel
from scenes.specs.course import FEWEST
from scenes.specs.detector import LEAST_SIDE
from scenes.specs.instrument import SIDES
from scenes.specs.job import JobSpec
from scenes.specs.job_tables import DeformationSpec, TableTemperatureSpec
from scenes.specs.resolved import ResolvedJob
from scenes.yaml.errors import KeyPath
from scenes.yaml.spec import Spec
from twin.framework import memory
from twin.framework.frame_store import IN_MEMORY, resident_bytes
from twin.framework.memory import STARTED, Lowered, amount_text
from twin.framework.procedure import stream
from twin.monitor.calibration_cache import CacheEntry
from twin.monitor.monitor_beams import NodeClasses, SpotFocus
from twin.monitor.monitor_derivative import disturbances_of, motion_models, spot_jacobian
from twin.monitor.monitor_path import MonitorPath
from twin.monitor.truth import LineSight, Truth, ground_geometry, line_family, truth_jacobian
from twin.sensors.area_detector import EmvaDetector, FixedPattern

TEMPLATE_MARGIN = 40
"""Margin of the calibrated spot shape beyond the CCD, in pixels, so that it can be shifted over the CCD."""

_CALIBRATED = (
    "instrument",
    "path",
    "wide_photons",
    "sight",
    "nominal_truth",
    "_truth_by_family",
    "cameras",
    "calibration",
    "ground",
)
"""Attributes of an experiment that depend only on its instrument and detectors; they are cached on disk."""


@shows("resolved.instrument.name", "resolved.instrument.cameras")
class MonitorExperiment:
    """Experiment with an instrument, its detectors and nominal calibration.

    Derived data are computed once, on demand.

    For an instrument without a monitor, only states, their true changes and the cameras' images are available;
    attributes about spots raise InputError.

    Parameters
    ----------
    resolved
        Job together with all files that it names; its perturbation is not used here.
    backend
        Backend of the ray trace.
    free_beams
        True to refuse bodies that block the monitor's beams.

    Raises
    ------
    InputError
        A part is in an impossible position, area CCDs do not sample the spots, or their images need more memory than
        available.
    """

    def __init__(self, resolved: ResolvedJob, backend: Backend, free_beams: bool = True) -> None:
        self.backend = backend
        self.resolved = resolved
        specs = resolved.instrument, *resolved.cameras.values()
        self._entry = CacheEntry.of(backend, specs, tuple(resolved.cameras), resolved.detector, free_beams)
        known = self._entry.read()
        if known is None:
            self.instrument: Instrument = build_instrument(resolved.instrument, resolved.cameras, backend, free_beams)
        else:
            vars(self).update(known)
        if self.monitored:
            self._require_sampled()
            require_memory(resolved, self.size(), self.detector)
        if known is None:
            self._keep()
        self._deformed: dict[tuple[str, DeformationSpec], NodalDeformation] = {}
        self._heated: dict[tuple[str, TableTemperatureSpec], HeatedBody] = {}
        self._patterns: dict[int | tuple[int, ...], FixedPattern] = {}

    def _keep(self) -> None:
        """Store the calibration in the disk cache for later processes."""
        self._entry.write({name: vars(self)[name] for name in _CALIBRATED if name in vars(self)})

    @property
    def monitored(self) -> bool:
        """True if the instrument has a monitor."""
        return self.resolved.instrument.monitor is not None

    @cached_property
    def exposure(self) -> float:
        """Exposure time of a frame of the area CCDs, in seconds."""
        return self.resolved.instrument.autocollimator.area_ccd.exposure

    @cached_property
    def detector(self) -> EmvaDetector:
        """Model of the area CCDs, with the numbers of their data sheet."""
        return EmvaDetector.from_sheet(self.resolved.area_detector, self.exposure)

    @cached_property
    def path(self) -> MonitorPath:
        """Optical path of the monitor's light, which computes spots and images."""
        self.resolved.instrument.autocollimator  # noqa: B018 - raises an error if there is none
        return MonitorPath(self.instrument, self.backend)

    def _require_sampled(self) -> None:
        """Raise InputError if the pixels are too coarse to sample the spots."""
        try:
            self.path.response  # noqa: B018 - fitted before anything is traced
        except UnsampledImageError as error:
            key = ("monitor", "reticle", "pinhole") if error.of_source else ("monitor", "area_ccd", "pitch")
            problem = f"the area CCDs do not sample the spots: {error}"
            raise self.resolved.instrument.error(problem, key, allowed=error.remedy) from error

    def size(self, frames: int = 1, times: int = 0, pictures: int = 0) -> MonitorSize:
        """Return the numbers from which the memory of a job is estimated.

        Parameters
        ----------
        frames : int
            Number of frames of each state.
        times : int
            Number of times of a time series of states; 0 if there is none.
        pictures : int
            Number of pixels of all other images.
        """
        phase = self.path.node_classes.phase_per_pixel
        return MonitorSize(len(self.path.channels), *self.path.shape, phase, frames, times, pictures)

    def stating(self, resolved: ResolvedJob) -> MonitorExperiment:
        """Return an experiment on the same instrument with the prior of another job, sharing all computed data.

        Parameters
        ----------
        resolved : ResolvedJob
            Job whose instrument, cameras and detector are those of this experiment.
        """
        other = copy(self)
        other.resolved = resolved
        for name in ("prior", "disturbances", "motion_models"):
            vars(other).pop(name, None)
        return other

    def with_instrument(self, instrument: Instrument) -> MonitorExperiment:
        """Return an uncalibrated experiment on another instrument with the same detectors.

        Parameters
        ----------
        instrument : Instrument
            Instrument, which may differ from the job's files; its calibration is therefore not cached on disk.
        """
        other = copy(self)
        for name in (*_CALIBRATED, "prior", "disturbances", "motion_models", "thermal"):
            vars(other).pop(name, None)
        other.instrument = instrument
        other._entry = replace(self._entry, key=None)
        other._deformed, other._heated, other._patterns = {}, {}, {}
        return other

    @cached_property
    def wide_photons(self) -> np.ndarray:
        """Expected photons of the unperturbed instrument's spots with a margin around each CCD, in double precision.

        The array is (C, rows + 2 m, columns + 2 m) for C channels and a margin of m = ``TEMPLATE_MARGIN`` pixels.
        Rounding to single precision would add noise that the fit of a spot's template would have to follow.
        """
        return self.path.expected_photons([{}], margin=TEMPLATE_MARGIN, single=False)[0]

    @cached_property
    def thermal(self) -> ThermalModel:
        """Thermal model of the instrument: how temperatures deform its bodies and change its glasses."""
        return ThermalModel(self.instrument)

    def state(self, job: JobSpec, progress: Callable[[str], None] = lambda path: None) -> State:
        """Return the perturbed state that a job describes.

        Parameters
        ----------
        job : JobSpec
            Job with a perturbation checked by ``scenes.specs.job.checked_nodes``.
        progress : callable
            Called with the path of each body whose thermo-elastic solution begins.

        Raises
        ------
        InputError
            A temperature is at or below 0 K, or outside the range in which a glass's index is known.
        """
        return job_state(job, self.thermal, progress, self.motions(job), self.heated(job))

    def motions(self, job: JobSpec, time: int | None = None) -> State:
        """Return the state that a job describes at a time, without the temperatures of the bodies (see ``fields``).

        Rigid and figure motions from the job are added to the deformations of bodies from tables of nodes.

        Raises
        ------
        InputError
            A table of nodes does not describe its body.
        """
        return on_deformed(self.instrument, self.deformed(job), motions_of(job, time), self.heated(job))

    def fields(self, job: JobSpec, time: int | None = None) -> dict[str, Temperature]:
        """Return the linear temperature field of each body at the time with index ``time``, including those of tables.

        Raises
        ------
        InputError
            A table of temperatures does not describe its body.
        """
        return with_heat(job.fields(time), self.heated(job))

    def heated(self, job: JobSpec) -> Mapping[str, HeatedBody]:
        """Return the table of temperatures of each body from the job's files.

        The tables are read once, since many states may share them.

        Raises
        ------
        InputError
            A table does not describe its body.
        """
        return heated_bodies(job, self.thermal, self._heated)

    def deformed(self, job: JobSpec) -> Mapping[str, NodalDeformation]:
        """Return the deformation of each body from a table of nodes in the job's files.

        The tables are read once, since many states may share them.

        Raises
        ------
        InputError
            A table does not describe its body.
        """
        return deformations_of(job, self.instrument, self._deformed)

    @property
    def nominal_photons(self) -> np.ndarray:
        """Expected photons per pixel and frame of the unperturbed instrument, (C, rows, columns).

        Dimensions: C channels.
        """
        m = TEMPLATE_MARGIN
        return self.wide_photons[:, m:-m, m:-m]

    @cached_property
    def nominal_focus(self) -> SpotFocus:
        """Sharpness of the unperturbed instrument's spots: wavefront error and defocus of each.

        Raises
        ------
        BeamMissedError, AimError
            The light does not reach the CCDs, or the spots cannot be computed.
        """
        focus = self.path.focus
        self.nominal_truth  # noqa: B018 - the line's light has to arrive, too
        self.wide_photons  # noqa: B018 - and the spots have to be accurate
        return focus

    @cached_property
    def nominal_truth(self) -> Truth:
        """Principal distances and intersection angle of the unperturbed instrument."""
        return self.sight.truth([{}])

    @cached_property
    def sight(self) -> LineSight:
        """Ray trace of the lines of sight of the cameras' line CCDs."""
        return LineSight(self.instrument, self.backend)

    @cached_property
    def _truth_by_family(self) -> dict[str, np.ndarray]:
        """Camera -> true change of its four parameters, (4, 4), per unit of each of four motions.

        They are the motions for which paper 001 (Wang et al. 2018) derives its formulas.
        """
        names = list(self.instrument.cameras)
        motions = [motion for name in names for motion in line_family(name)]
        jacobians = truth_jacobian(self.instrument, self.backend, motions)
        return {name: jacobians[name][:, 4 * k : 4 * k + 4] for k, name in enumerate(names)}

    @cached_property
    def cameras(self) -> dict[str, CameraCalibration]:
        """Camera -> its calibration without images: geometry, and Jacobians of spots and parameters.

        The Jacobians are with respect to the four motions that paper 001 (Wang et al. 2018) considers.
        """
        families = {name: line_family(name) for name in self.instrument.cameras}
        spots = spot_jacobian(self.path, [motion for family in families.values() for motion in family])
        cameras = {}
        for k, (name, family) in enumerate(families.items()):
            channels = list(self.instrument.channels_of(name))
            cameras[name] = CameraCalibration(
                geometry=self.geometry(name),
                look_rad=self.instrument.spec.cameras[name].look,
                spot_jacobian=spots[channels, :, 4 * k : 4 * k + 4].reshape(2 * len(channels), 4),
                parameter_jacobian=self._truth_by_family[name],
                motions=tuple(motion.label for motion in family),
                channels=tuple(self.path.channels[i].name for i in channels),
            )
        return cameras

    @cached_property
    def calibration(self) -> MonitorCalibration:
        """Calibration available to the analysis: geometry, Jacobians and spot shapes of the nominal instrument."""
        photons = self.wide_photons
        with one_blas_thread():  # in a small decomposition, threads would only wait for each other
            template = SpotTemplate.stack([self._template(image) for image in photons])
        noise = self.detector.noise_model(self.exposure)
        calibration = MonitorCalibration(self.cameras, template, noise, self.ground)
        # the path counts its images for the manifest, so it is not cached with those of other states
        if self.path.checked.images == len(self.path.channels):
            with suppress(PhysicalError, ArithmeticError):  # reported where the focus is used
                self.path.focus  # noqa: B018
            vars(self)["calibration"] = calibration
            self._keep()
        return calibration

    @cached_property
    def ground(self) -> GroundGeometry | None:
        """Ground geometry of a stereo pair of known altitude; None for other instruments.

        Raises
        ------
        InputError
            The rays of the pair do not intersect on the ground.
        """
        return ground_geometry(self.instrument, self.nominal_truth.principal_distance)

    @cached_property
    def prior(self) -> DisturbancePrior | None:
        """Motions of the bodies in the job's prior, by component; None without a prior.

        Raises
        ------
        InputError
            The prior names a body that the instrument does not have, or that cannot move or be heated in this way.
        """
        prior = disturbance_prior(self.resolved, self.instrument)
        if prior is not None:
            check_heat(self.resolved, prior, self.thermal)
        return prior

    @cached_property
    def disturbances(self) -> Disturbances | None:
        """Prior of the job with its effects on spots and cameras, for the analysis; None without a prior.

        InputError is raised if the prior names a body that does not exist or cannot move in this way.
        """
        prior = self.prior
        if prior is None:
            return None
        return self._entry.part("disturbances", prior).get(
            lambda: disturbances_of(prior, self.path, self.thermal, self.instrument, self.backend)
        )

    @cached_property
    def motion_models(self) -> Mapping[str, MotionModel]:
        """Estimator -> the motions that it assumes; a ray trace of these motions checks its results.

        InputError is raised if the prior names a body that does not exist or cannot move in this way.
        """
        prior, known = self.prior, self.disturbances
        return motion_models(self.path, self.sight, self.cameras, self.thermal, prior, known)

    def geometry(self, camera: str) -> MonitorGeometry:
        """Return the calibrated numbers that the formulas of paper 001 (Wang et al. 2018) use for one camera.

        They are principal distance, plate scale, distortion, distance of the area CCDs and pixel pitch. The papers
        leave alpha and beta of their cos^2 undefined; they are taken as the field angles of the area CCDs.
        """
        by_x, by_y, *_ = self._truth_by_family[camera].T
        channels = self.instrument.spec.channels_of(camera)
        channel = channels[SIDES[0]] if SIDES[0] in channels else next(iter(channels.values()))
        return MonitorGeometry(
            principal_distance_m=self.nominal_truth.principal_distance[camera],
            separation_m=self.instrument.separation[camera],
            pitch_m=self.path.pitch,
            field_alpha_rad=0.0,
            field_beta_rad=abs(channel.field),
            principal_distance_across_m=float(1.0 / abs(by_x[0])),
            d_f_per_alpha_m=float(by_x[3] / by_x[0]),
            d_gamma_per_beta=float(by_y[2] / by_y[1]),
        )

    def _template(self, image: np.ndarray) -> SpotTemplate:
        """Return the calibrated shape of a spot, centred on the energy centroid of its core (above 5 % of the peak)."""
        row, column = center_of_mass(np.where(image > 0.05 * image.max(), image, 0.0))
        return SpotTemplate.from_image(image, float(row), float(column), self.path.shape)

    def pattern(self, seed: int | Sequence[int]) -> FixedPattern:
        """Return the fixed pattern (response and offset of every pixel) of all area CCDs, (C, rows, columns).

        It is the same in the images before and after the change. Several seeds give (seeds, C, rows, columns).

        Dimensions: C channels.
        """
        key = tuple(seed) if isinstance(seed, Sequence) else seed
        pattern = self._patterns.get(key)
        if pattern is None:
            pattern = self._drawn_pattern(key)
            # stored for one seed at a time, so that states exposed one by one do not draw it again
            self._patterns = {key: pattern}
        return pattern

    def _drawn_pattern(self, seed: int | tuple[int, ...]) -> FixedPattern:
        """Return the random response (PRNU) and offset (DSNU) of every pixel of all area CCDs, determined by a seed."""
        if isinstance(seed, tuple):
            patterns = [self._drawn_pattern(pattern) for pattern in seed]
            return FixedPattern(
                np.stack([pattern.gain for pattern in patterns]), np.stack([pattern.offset_e for pattern in patterns])
            )
        return self.detector.fixed_pattern((len(self.path.channels), *self.path.shape), stream(seed, 0))

    def frames_before(self, frames: int, seed: int | Sequence[int], stray: np.ndarray | float = 0.0) -> np.ndarray:
        """Return frames of the nominal state with stray light, uint16 (C, frames, rows, columns).

        Dimensions: C channels.

        Parameters
        ----------
        frames : int
            Number of frames of each CCD.
        seed : int | sequence of int
            Seed of the CCDs and the noise; several seeds give (seeds, C, frames, rows, columns).
        stray : ndarray | float
            Photons added to those of the spots.
        """
        photons = self.nominal_photons + stray
        if not isinstance(seed, Sequence):
            return self.detector.expose(photons, self.pattern(seed), frames, self.exposure, stream(seed, 1))
        repeated = np.broadcast_to(photons, (len(seed), *photons.shape))
        streams = [stream(single_seed, 1) for single_seed in seed]
        return self.detector.expose(repeated, self.pattern(seed), frames, self.exposure, streams)

    def frames_after(
        self, photons: np.ndarray, frames: int, seed: int | Sequence[int], first: int | np.ndarray = 0
    ) -> np.ndarray:
        """Return frames of perturbed states, uint16 (S, C, frames, rows, columns).

        Dimensions: S states, C channels.

        Parameters
        ----------
        photons : (S, C, rows, columns) ndarray
            Expected photons per pixel and frame.
        frames : int
            Number of frames per state.
        seed : int | sequence of int
            Seed of the CCDs' fixed pattern and of the noise, or one for each state. Each state has its own random
            stream, numbered ``first`` + its index, so that its frames do not depend on how a series is divided.
        first : int | (S,) ndarray
            Number of the first state, or of each state.
        """
        numbers = first if isinstance(first, np.ndarray) else first + np.arange(len(photons))
        seeds = seed if isinstance(seed, Sequence) else [seed] * len(photons)
        streams = [stream(state_seed, 2, int(number)) for state_seed, number in zip(seeds, numbers, strict=True)]
        return self.detector.expose(photons, self.pattern(seed), frames, self.exposure, streams)

    def expected_frames(self, photons: np.ndarray) -> np.ndarray:
        """Return noise-free, unrounded grey values of a uniform detector, with the shape of ``photons``."""
        return self.detector.expected_dn(photons, self.exposure)


CHUNK = 25
"""Largest number of states rendered at once, to limit memory; fewer if their frames are large."""
LARGEST_FRAMES = 200_000_000
"""Largest number of pixels of all frames that are exposed at once."""


def largest_piece(each: int) -> int:
    """Return how many states of a series may be rendered at once without exceeding the memory limit.

    Parameters
    ----------
    each : int
        Pixels of all frames of one state.
    """
    return max(1, min(CHUNK, LARGEST_FRAMES // each))


def pieces(count: int, each: int) -> Iterator[slice]:
    """Yield slices of the states of a series; the frames of one slice are processed at once.

    Parameters
    ----------
    count : int
        Number of states.
    each : int
        Pixels of all frames of one state.
    """
    size = largest_piece(each)
    for start in range(0, count, size):
        yield slice(start, min(start + size, count))


DRAWN = 410e6
"""Memory for drawing figures and writing files of a job, in bytes; for small jobs it is most of the memory."""
_PIXEL = 380.0
"""Bytes per pixel of a spot's image during the measurement and the analysis of its limits: photons 24, fixed pattern
16, mean frames and maps of the fits before and after 64, images and maps of a state of the prior 85, the current fit
190.
"""
_RAY = 600.0
"""Bytes per traced ray, including its derivatives, aim parameters and Zernike polynomials at its pupil node."""
GREY = 2.0
"""Bytes per pixel of a recorded frame."""
_OF_COURSE = 6.0
"""Bytes per pixel and time of a time series of states: single-precision photons and a first frame."""
WRITTEN = 60.0
"""Bytes per pixel of a spot's image for drawing and writing: photons, their file, and means over frames."""
_OF_STATE = 24.0
"""Bytes per pixel of each state rendered at once: its photons, and the effect of their noise on the spot's position."""


@dataclass(frozen=True)
class MonitorSize:
    """Numbers that determine the memory of a monitor's job.

    Attributes
    ----------
    spots : int
        Number of channels (one spot each) of all cameras.
    rows, columns : int
        Size of an area CCD, in pixels.
    phase : float
        Phase difference between the centre and the edge of the pupil for a point one pixel off the spot, in radians per
        pixel.
    frames : int
        Number of frames of each state.
    times : int
        Number of times of a time series of states, 0 if there is none.
    pictures : int
        Number of pixels of the frames of all other images.
    """

    spots: int
    rows: int
    columns: int
    phase: float
    frames: int = 1
    times: int = 0
    pictures: int = 0

    @property
    def rays(self) -> int:
        """Number of traced rays that sharp spots of all channels need, wherever they are on their CCDs."""
        return self.spots * NodeClasses(self.phase, (0.5 * self.rows, 0.5 * self.columns)).sharp_count

    def parts(self, detector: EmvaDetector) -> Mapping[str, float]:
        """Return the memory in bytes that each part of the job needs: CCDs, frames, times and other pictures.

        Parameters
        ----------
        detector : EmvaDetector
            Model of the area CCDs.
        """
        image = self.rows * self.columns
        pixels, frames = self.spots * image, self.frames
        states = min(self.times, largest_piece(pixels * frames)) if self.times else 1
        threads = min(cores(), 8, self.spots * states)  # that expose images
        return {
            "ccd": pixels * (_PIXEL + (states - 1) * _OF_STATE) + self.rays * _RAY,
            "frames": resident_bytes(pixels * frames * GREY)
            + resident_bytes(states * pixels * frames * GREY)
            + detector.exposing_bytes(frames, image, threads),
            "times": self.times * pixels * _OF_COURSE,
            "pictures": self.pictures * GREY,
        }

    def bytes(self, detector: EmvaDetector) -> float:
        """Return the memory of all parts, in bytes, in addition to the imported program.

        Parameters
        ----------
        detector : EmvaDetector
            Model of the area CCDs.
        """
        parts = self.parts(detector)
        pixels = self.spots * self.rows * self.columns
        stack = pixels * self.frames * GREY
        written = pixels * WRITTEN + 2.0 * resident_bytes(stack)
        written += stack / self.spots if stack <= IN_MEMORY else resident_bytes(stack)
        return max(STARTED + sum(parts.values()), DRAWN + written + parts["times"] + parts["pictures"])


def require_memory(resolved: ResolvedJob, size: MonitorSize, detector: EmvaDetector) -> None:
    """Raise InputError if a job does not fit into the free memory.

    Parameters
    ----------
    resolved : ResolvedJob
        Job, with the numbers of its files.
    size : MonitorSize
        Size of the job.
    detector : EmvaDetector
        Model of its area CCDs.

    Raises
    ------
    InputError
        The job does not fit; the error is at the key that needs most memory, with the number that would fit.
    """
    parts = size.parts(detector)
    worst = max(parts, key=lambda name: parts[name])
    what, lower = _lowered(resolved, size, worst, detector)
    memory.require_memory(lower, started=0.0, shares=f"{amount_text(parts[worst])} of it {what}")


def _lowered(resolved: ResolvedJob, size: MonitorSize, part: str, detector: EmvaDetector) -> tuple[str, Lowered]:
    """Return a description of a part of the memory, and which number in the files must be lowered to reduce it."""
    job, rows, columns, frames = resolved.job, size.rows, size.columns, size.frames
    owner: Spec = job
    least = 1
    if part == "ccd":
        what, unit = f"for the images of area CCDs of {rows} x {columns} pixels", "rows and columns"
        owner, least, number = resolved.instrument, LEAST_SIDE, max(rows, columns)
        key: KeyPath = ("monitor", "area_ccd", "rows" if rows >= columns else "columns")
        each = {"rows": 1, "columns": 1}
    elif part == "times":
        assert job.course is not None
        what, unit, each = f"for {size.times} times of the course", "times", {"times": 1}
        owner, least, number, key = job.course, FEWEST, size.times, ("times",)
    elif part == "pictures":
        number, unit, key = resolved.targets.frames or frames, "frames", ("render", "targets", "frames")
        each, what = {"pictures": size.pictures // number}, f"for {number} frames of test targets"
    else:
        what, unit, number = f"for {frames} frames of area CCDs of {rows} x {columns} pixels", "frames", frames
        in_job, each = job.render.frames is not None, {"frames": 1}
        owner, key = (job if in_job else resolved.instrument), ("render" if in_job else "monitor", "frames")

    def needed(n: int) -> float:
        fewer = {name: min(getattr(size, name), n * count_per_unit) for name, count_per_unit in each.items()}
        return replace(size, **fewer).bytes(detector)

    return what, Lowered(owner, key, number, unit, needed, least)
