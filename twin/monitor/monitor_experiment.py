"""The monitoring experiment: perturb the instrument, render what its area CCDs record, and let the analysis recover
it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from copy import copy
from dataclasses import replace
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
from optics.numerics.backend import Backend, one_blas_thread
from optics.thermal.heat import Temperature
from optics.thermal.nodal_deformation import NodalDeformation
from optics.waves.diffraction import UnsampledImageError
from scenes.models.disturbances import StatedMotions, check_heat, stated_motions
from scenes.models.instrument_builder import build_instrument
from scenes.models.instrument_model import Instrument
from scenes.models.job_state import (
    HeatedBody,
    deformed_face,
    heated_body,
    job_state,
    motions_of,
    on_deformed,
    with_heat,
)
from scenes.models.thermal_model import ThermalModel
from scenes.specs.course import NO_MOTION
from scenes.specs.instrument import SIDES
from scenes.specs.job import JobSpec
from scenes.specs.job_tables import DeformationSpec, TableTemperatureSpec
from scenes.specs.resolved import ResolvedJob
from twin.framework.random_streams import stream
from twin.monitor.calibration_cache import CacheEntry
from twin.monitor.monitor_beams import SpotFocus
from twin.monitor.monitor_derivative import disturbances_of, motion_models, spot_jacobian
from twin.monitor.monitor_memory import MonitorSize, require_memory
from twin.monitor.monitor_path import MonitorPath
from twin.monitor.motions import line_family
from twin.monitor.truth import LineSight, Truth, ground_geometry, truth_jacobian
from twin.sensors.area_detector import EmvaDetector, FixedPattern

TEMPLATE_MARGIN = 40
"""Pixels by which the calibrated spot shape is larger than the CCD, so that it can be shifted over it."""

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
"""Attributes of an experiment that depend on its instrument and detectors alone, and are kept on disk."""


@shows("resolved.instrument.name", "resolved.instrument.cameras")
class MonitorExperiment:
    """An instrument with its detectors and its nominal calibration; whatever is derived is worked out once, on demand.

    Of an instrument without a monitor there are states, their truth and the cameras' images; whatever is about spots
    raises InputError.

    Parameters
    ----------
    resolved
        The job with everything it names; its perturbation is not used here.
    backend
        Where to trace.
    free_beams
        As of ``build_instrument``.

    Raises
    ------
    InputError
        a part that cannot be where it is, area CCDs that do not sample the spots, or whose images need more memory than
        there is.
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
        """Keep what is calibrated for the processes to come."""
        self._entry.write({name: vars(self)[name] for name in _CALIBRATED if name in vars(self)})

    @property
    def monitored(self) -> bool:
        """Whether the instrument has a monitor."""
        return self.resolved.instrument.monitor is not None

    @cached_property
    def exposure(self) -> float:
        """Of a frame of the area CCDs, seconds."""
        return self.resolved.instrument.autocollimator.area_ccd.exposure

    @cached_property
    def detector(self) -> EmvaDetector:
        """The area CCDs."""
        return EmvaDetector.from_sheet(self.resolved.area_detector, self.exposure)

    @cached_property
    def path(self) -> MonitorPath:
        """The way of the monitor's light."""
        self.resolved.instrument.autocollimator  # noqa: B018 - says so where there is none
        return MonitorPath(self.instrument, self.backend)

    def _require_sampled(self) -> None:
        try:
            self.path.response  # noqa: B018 - fitted before anything is traced
        except UnsampledImageError as error:
            key = ("monitor", "reticle", "pinhole") if error.of_source else ("monitor", "area_ccd", "pitch")
            problem = f"the area CCDs cannot follow the spots: {error}"
            raise self.resolved.instrument.error(problem, key, allowed=error.remedy) from error

    def size(self, frames: int = 1, times: int = 0, pictures: int = 0) -> MonitorSize:
        """Numbers that decide how much memory a job of this instrument takes; arguments as of ``MonitorSize``."""
        phase = self.path.node_classes.phase_per_pixel
        return MonitorSize(len(self.path.channels), *self.path.shape, phase, frames, times, pictures)

    def stating(self, resolved: ResolvedJob) -> MonitorExperiment:
        """Experiment on the same instrument, with everything computed for it, under the prior of another job.

        Parameters
        ----------
        resolved : ResolvedJob
            The job; its instrument, cameras and detector must be this one's.
        """
        other = copy(self)
        other.resolved = resolved
        for name in ("stated", "disturbances", "motion_models"):
            vars(other).pop(name, None)
        return other

    def with_instrument(self, instrument: Instrument) -> MonitorExperiment:
        """Return an experiment on another instrument with the same detectors, of which nothing is calibrated yet.

        Parameters
        ----------
        instrument : Instrument
            May differ from what the job's files describe, so its calibration is not kept on disk.
        """
        other = copy(self)
        for name in (*_CALIBRATED, "stated", "disturbances", "motion_models", "thermal"):
            vars(other).pop(name, None)
        other.instrument = instrument
        other._entry = replace(self._entry, key=None)
        other._deformed, other._heated, other._patterns = {}, {}, {}
        return other

    @cached_property
    def wide_photons(self) -> np.ndarray:
        """Expected photons of the unperturbed instrument with the template's margin, (C, rows + 2m, columns + 2m).

        In double precision: rounding to single makes noise that the template's factors would have to follow.
        """
        return self.path.expected_photons([{}], margin=TEMPLATE_MARGIN, single=False)[0]

    @cached_property
    def thermal(self) -> ThermalModel:
        """What temperatures do to the instrument."""
        return ThermalModel(self.instrument)

    def state(self, job: JobSpec, progress: Callable[[str], None] = lambda path: None) -> State:
        """The perturbed state that a job describes.

        Parameters
        ----------
        job : JobSpec
            Its perturbation, checked by ``scenes.specs.job.checked_nodes``.
        progress : Callable[[str], None]
            Called with the path of each body whose thermo-elastic solution begins.

        Raises
        ------
        InputError
            a temperature at or below 0 K, or one at which a glass's index is not known.
        """
        return job_state(job, self.thermal, progress, self.motions(job), self.heated(job))

    def motions(self, job: JobSpec, time: int | None = None) -> State:
        """The state that a job describes without its ``fields``: ``motions_of`` on top of its bodies' deformations.

        Raises
        ------
        InputError
            a table of nodes that does not describe its body.
        """
        return on_deformed(self.instrument, self.deformed(job), motions_of(job, time), self.heated(job))

    def fields(self, job: JobSpec, time: int | None = None) -> dict[str, Temperature]:
        """Linear temperatures of a job's bodies, those of its tables added, at time number ``time`` of its course.

        Raises
        ------
        InputError
            a table of temperatures that does not describe its body.
        """
        return with_heat(job.fields(time), self.heated(job))

    def heated(self, job: JobSpec) -> Mapping[str, HeatedBody]:
        """Body -> what the table of temperatures is that warms it; kept, since many states may have the same.

        Raises
        ------
        InputError
            a table that does not describe its body.
        """
        out = {}
        for path, what in job.perturb.items():
            spec = what.heat
            if spec.table is not None:
                # change and gradient beside the table are not its own
                key = path, spec.model_copy(update={"change": 0.0, "gradient": NO_MOTION})
                if key not in self._heated:
                    self._heated[key] = heated_body(self.thermal, job, path, spec)
                out[path] = self._heated[key]
        return out

    def deformed(self, job: JobSpec) -> Mapping[str, NodalDeformation]:
        """Body -> what the table of nodes is that deforms it; kept, since many states may have the same.

        Raises
        ------
        InputError
            a table that does not describe its body.
        """
        out = {}
        for path, what in job.perturb.items():
            if what.deformation is not None:
                if (path, what.deformation) not in self._deformed:
                    face = deformed_face(self.instrument, job, path, what.deformation)
                    self._deformed[path, what.deformation] = face
                out[path] = self._deformed[path, what.deformation]
        return out

    @property
    def nominal_photons(self) -> np.ndarray:
        """Expected photons per pixel and frame of the unperturbed instrument, (C, rows, columns)."""
        m = TEMPLATE_MARGIN
        return self.wide_photons[:, m:-m, m:-m]

    @cached_property
    def nominal_focus(self) -> SpotFocus:
        """Sharpness of the unperturbed instrument's spots.

        Raises
        ------
        BeamMissedError, AimError
            They do not come to their CCDs, or cannot be worked out.
        """
        focus = self.path.focus
        self.nominal_truth  # noqa: B018 - the line's light, too, has to arrive
        self.wide_photons  # noqa: B018 - and the spots have to be right
        return focus

    @cached_property
    def nominal_truth(self) -> Truth:
        """Principal distances and intersection angle of the unperturbed instrument."""
        return self.sight.truth([{}])

    @cached_property
    def sight(self) -> LineSight:
        """What the line CCDs see."""
        return LineSight(self.instrument, self.backend)

    @cached_property
    def _truth_by_family(self) -> dict[str, np.ndarray]:
        """Camera -> (4, 4): its true parameters per unit of the four motions of its own line family."""
        names = list(self.instrument.cameras)
        motions = [motion for name in names for motion in line_family(name)]
        every = truth_jacobian(self.instrument, self.backend, motions)
        return {name: every[name][:, 4 * k : 4 * k + 4] for k, name in enumerate(names)}

    @cached_property
    def cameras(self) -> dict[str, CameraCalibration]:
        """What is calibrated of every camera without an image: geometry and Jacobians of the nominal instrument."""
        families = {name: line_family(name) for name in self.instrument.cameras}
        spots = spot_jacobian(self.path, [motion for family in families.values() for motion in family])
        cameras = {}
        for k, (name, family) in enumerate(families.items()):
            own = list(self.instrument.channels_of(name))
            cameras[name] = CameraCalibration(
                geometry=self.geometry(name),
                look_rad=self.instrument.spec.cameras[name].look,
                spot_jacobian=spots[own, :, 4 * k : 4 * k + 4].reshape(2 * len(own), 4),
                parameter_jacobian=self._truth_by_family[name],
                motions=tuple(motion.label for motion in family),
                channels=tuple(self.path.channels[i].name for i in own),
            )
        return cameras

    @cached_property
    def calibration(self) -> MonitorCalibration:
        """What the analysis may know: geometry, Jacobians and spot shapes of the nominal instrument."""
        photons = self.wide_photons
        with one_blas_thread():  # several threads of a small decomposition wait for each other
            template = SpotTemplate.stack([self._template(image) for image in photons])
        noise = self.detector.noise_model(self.exposure)
        found = MonitorCalibration(self.cameras, template, noise, self.ground)
        # the path counts its images for the manifest: with those of other states it is not kept
        if self.path.checked.images == len(self.path.channels):
            with suppress(PhysicalError, ArithmeticError):  # said where it is asked for
                self.path.focus  # noqa: B018
            vars(self)["calibration"] = found
            self._keep()
        return found

    @cached_property
    def ground(self) -> GroundGeometry | None:
        """How a pair of known altitude sees the ground; None for other instruments.

        Raises
        ------
        InputError
            Its rays do not meet on the ground.
        """
        return ground_geometry(self.instrument, self.nominal_truth.principal_distance)

    @cached_property
    def stated(self) -> StatedMotions | None:
        """What the job states to move, component by component; None for nothing.

        Raises
        ------
        InputError
            a body that the instrument does not have, or that cannot move or be warmed so.
        """
        stated = stated_motions(self.resolved, self.instrument)
        if stated is not None:
            check_heat(self.resolved, stated, self.thermal)
        return stated

    @cached_property
    def disturbances(self) -> Disturbances | None:
        """The prior with its effect on spots and cameras, for the analysis; None without a prior. Raises InputError as
        `stated`.
        """
        stated = self.stated
        if stated is None:
            return None
        return self._entry.part("disturbances", stated).get(
            lambda: disturbances_of(stated, self.path, self.thermal, self.instrument, self.backend)
        )

    @cached_property
    def motion_models(self) -> Mapping[str, MotionModel]:
        """Estimator -> the motions by which it reads, to be traced again. Raises InputError as `stated`."""
        stated, known = self.stated, self.disturbances
        return motion_models(self.path, self.sight, self.cameras, self.thermal, stated, known)

    def geometry(self, camera: str) -> MonitorGeometry:
        """Calibrated numbers for the formulas: principal distance, plate scale across the line, distortion, L, pixel.

        The papers leave alpha and beta of their cos^2 undefined; they are taken as the field angles of the area CCDs.
        """
        by_x, by_y, *_ = self._truth_by_family[camera].T
        given = self.instrument.spec.channels_of(camera)
        one = given[SIDES[0]] if SIDES[0] in given else next(iter(given.values()))
        return MonitorGeometry(
            principal_distance_m=self.nominal_truth.principal_distance[camera],
            separation_m=self.instrument.separation[camera],
            pitch_m=self.path.pitch,
            field_alpha_rad=0.0,
            field_beta_rad=abs(one.field),
            principal_distance_across_m=float(1.0 / abs(by_x[0])),
            d_f_per_alpha_m=float(by_x[3] / by_x[0]),
            d_gamma_per_beta=float(by_y[2] / by_y[1]),
        )

    def _template(self, image: np.ndarray) -> SpotTemplate:
        """Calibrated shape of one spot; its centre is the energy centroid of the core (above 5% of the peak)."""
        row, column = center_of_mass(np.where(image > 0.05 * image.max(), image, 0.0))
        return SpotTemplate.from_image(image, float(row), float(column), self.path.shape)

    def pattern(self, seed: int | Sequence[int]) -> FixedPattern:
        """PRNU and DSNU of all area CCDs, (C, rows, columns); the same before and after. Those of several seeds one
        after the other, (seeds, C, rows, columns).
        """
        key = tuple(seed) if isinstance(seed, Sequence) else seed
        found = self._patterns.get(key)
        if found is None:
            found = self._drawn_pattern(key)
            # kept for one seed at a time: states that are exposed one by one would each draw it anew
            self._patterns = {key: found}
        return found

    def _drawn_pattern(self, seed: int | tuple[int, ...]) -> FixedPattern:
        if isinstance(seed, tuple):
            every = [self._drawn_pattern(one) for one in seed]
            return FixedPattern(np.stack([one.gain for one in every]), np.stack([one.offset_e for one in every]))
        return self.detector.fixed_pattern((len(self.path.channels), *self.path.shape), stream(seed, 0))

    def frames_before(self, frames: int, seed: int | Sequence[int], stray: np.ndarray | float = 0.0) -> np.ndarray:
        """Frames of the nominal state with the given stray photons, uint16 (C, frames, rows, columns).

        Parameters
        ----------
        frames : int
            Of each CCD.
        seed : int | Sequence[int]
            Of CCDs and noise. Of several seeds the frames of each, (seeds, C, frames, rows, columns).
        stray : np.ndarray | float
            Photons beside those of the spots.
        """
        photons = self.nominal_photons + stray
        if not isinstance(seed, Sequence):
            return self.detector.expose(photons, self.pattern(seed), frames, self.exposure, stream(seed, 1))
        every, own = np.broadcast_to(photons, (len(seed), *photons.shape)), [stream(one, 1) for one in seed]
        return self.detector.expose(every, self.pattern(seed), frames, self.exposure, own)

    def frames_after(
        self, photons: np.ndarray, frames: int, seed: int | Sequence[int], first: int | np.ndarray = 0
    ) -> np.ndarray:
        """Frames of perturbed states, uint16 (S, C, frames, rows, columns).

        Parameters
        ----------
        photons : np.ndarray
            Expected photons per pixel and frame, (S, C, rows, columns).
        frames : int
            Per state.
        seed : int | Sequence[int]
            As for ``frames_before``, or one for each state; state number first + s draws from a stream of its own, so
            that the frames of a state do not depend on how a series is cut into pieces.
        first : int | np.ndarray
            Number of the first state, or of each, (S,).
        """
        numbers = first if isinstance(first, np.ndarray) else first + np.arange(len(photons))
        seeds = seed if isinstance(seed, Sequence) else [seed] * len(photons)
        own = [stream(one, 2, int(number)) for one, number in zip(seeds, numbers, strict=True)]
        return self.detector.expose(photons, self.pattern(seed), frames, self.exposure, own)

    def expected_frames(self, photons: np.ndarray) -> np.ndarray:
        """Noise-free, unrounded grey values of a uniform detector, same shape as ``photons``."""
        return self.detector.expected_dn(photons, self.exposure)
