"""Instruments and cameras in a script: load, perturb, render, and recover the changes from the images.

A camera can be examined as optical designers do, and perturbed as the instrument that it is or belongs to.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from analysis.arrays import shows
from analysis.monitor import parameters
from analysis.monitor.recovery import recover_monitor
from optics.geometry.tree import ORIGIN, State
from optics.numerics.backend import Backend, load_backend
from optics.numerics.number_tree import FrozenMap
from scenes.models.camera_design import with_plane
from scenes.models.camera_model import focal_plane_body
from scenes.models.camera_sharpness import blur_warnings
from scenes.models.instrument_builder import build_instrument
from scenes.models.job_state import motions_of
from scenes.specs.camera import CameraSpec
from scenes.specs.course import noll
from scenes.specs.job import JobSpec, PerturbationSpec, checked_nodes, with_tables
from scenes.specs.load import INSTRUMENTS, find_disturbances, is_path, library_names
from scenes.specs.load import load_camera as read_camera
from scenes.specs.perturbation import (
    AXES,
    FORMS,
    NodeInfo,
    find_node,
    matching_nodes,
    motion_of,
    perturbation_in_words,
    perturbation_text,
)
from scenes.specs.resolved import ResolvedJob, resolve, resolve_job
from scenes.yaml.errors import InputError, Issue, Problem, names_text, nearest, shown, unknown
from scenes.yaml.spec import validate
from scenes.yaml.yaml_file import YamlFile, read_yaml
from twin.camera.camera_optics import CameraOptics
from twin.camera.camera_view import CameraView
from twin.camera.first_order_data import FIRST_ORDER, first_order_data
from twin.camera.refocus import find_focus, job_state_in_focus
from twin.framework.record import frames_text
from twin.main_job.monitor_reading import MonitorReading
from twin.main_job.render_job import render_job
from twin.monitor.crosstalk import estimator_gains
from twin.monitor.monitor_derivative import spot_jacobian
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.truth import ElementaryMotion, truth_jacobian
from twin.scripting.results import Recovered, Shot, as_frames, name_html, recovered_of
from twin.scripting.results import shot_of as _shot_of
from twin.sensors.area_detector import coarse_warnings

Perturbation = Mapping[str, Mapping[str, Any]] | str
"""Motion in words, ``"M2 shift z 3 um"``, or body -> keys of `perturb:` in a job's YAML."""


@shows("name", "model.mirrors", "model.paraxial.focal_length [m]", "model.entrance_pupil [mm]", "twin.perturbed_by")
@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class CameraTwin(CameraView):
    """Camera of an instrument in one state, made by `load_camera` and `InstrumentTwin.camera`.

    Attributes
    ----------
    twin : InstrumentTwin
        The instrument; it may consist of this camera alone.
    name : str
        Name of the camera in it.
    obstruction : bool
        Whether light that other bodies block is removed from its beam.
    """

    twin: InstrumentTwin = field(repr=False)
    name: str
    obstruction: bool = True

    @classmethod
    def of(cls, twin: InstrumentTwin, name: str, obstruction: bool = True) -> CameraTwin:
        """Return a camera of an instrument, in the instrument's state.

        Parameters
        ----------
        twin : InstrumentTwin
            The instrument.
        name : str
            Name of the camera in it.
        obstruction : bool
            Whether light that other bodies block is removed from its beam.
        """
        experiment = twin.experiment
        seen = CameraView.within(experiment.instrument, name, experiment.backend, twin.state, obstruction)
        return cls(seen.path, seen.state, built=seen.built, twin=twin, name=name, obstruction=obstruction)

    def perturbed(self, *perturb: Perturbation | Sequence[Perturbation]) -> CameraTwin:
        """Return the same camera with bodies of its instrument perturbed, in addition to what they are already.

        Parameters
        ----------
        perturb : str, Mapping[str, Mapping[str, Any]] or a list of them
            Motions in words, such as ``"M2 shift z 20 um"``, or path of a body -> keys of `perturb:` in a job's YAML,
            such as ``{"base/gf7/M2": {"shift": "0 0 20 um"}}``.

        Raises
        ------
        InputError
            No such body, or a motion that it does not allow.
        """
        return CameraTwin.of(self.twin.perturbed(*perturb), self.name, self.obstruction)

    def refocused(self, tilt: bool = False) -> CameraTwin:
        """Return the camera with its image plane at the least mean square wavefront error over 15 fields.

        Parameters
        ----------
        tilt : bool
            Whether the plane is tilted about the line as well.

        Raises
        ------
        InputError
            The camera's light has no focus after the last mirror.
        """
        return CameraTwin.of(self.twin.refocused(self.name, tilt), self.name, self.obstruction)

    @property
    def first_order(self) -> Mapping[str, Any]:
        """First-order data of the camera in its state, as in optics.json: names end in their unit.

        Raises
        ------
        AimError, BeamMissedError, AfocalError
            Light does not pass, or has no focus.
        """
        return FIRST_ORDER(first_order_data(self))


class _Bench:
    """Model of an instrument for ray tracing, built once and shared by all perturbed copies of the instrument."""

    def __init__(self, resolved: ResolvedJob, backend: str, like: _Bench | None = None) -> None:
        self._resolved, self.name, self._like = resolved, backend, like

    @cached_property
    def backend(self) -> Backend:
        """Backend that traces the rays."""
        return load_backend(self.name) if self._like is None else self._like.backend

    @cached_property
    def experiment(self) -> MonitorExperiment:
        """Model of the instrument and its monitor that renders and analyses images."""
        if self._like is not None:
            return self._like.experiment.stating(self._resolved)
        return MonitorExperiment(self._resolved, self.backend)

    def stating(self, resolved: ResolvedJob) -> _Bench:
        """Return the model of the same instrument with the disturbance prior of the job ``resolved``."""
        return _Bench(resolved, self.name, self)

    def building(self, resolved: ResolvedJob) -> _Bench:
        """Return the model of an instrument with other cameras, which is not calibrated and not cached on disk."""
        bench = _Bench(resolved, self.name, self)
        built = build_instrument(resolved.instrument, resolved.cameras, self.backend)
        bench.experiment = self.experiment.with_instrument(built).stating(resolved)
        return bench


@dataclass(frozen=True, eq=False)
class InstrumentTwin:
    """Instrument with its cameras, detectors and autocollimation monitor, nominal or perturbed; immutable.

    Instances are made by `load` and by `perturbed`. Copies share what was built and calibrated, so that a loop over
    perturbations builds the instrument once.

    Attributes
    ----------
    resolved : ResolvedJob
        The job that the instance represents, with everything that it names.
    """

    resolved: ResolvedJob
    _bench: _Bench = field(repr=False)

    @classmethod
    def of(cls, resolved: ResolvedJob, backend: str = "llvm", like: InstrumentTwin | None = None) -> InstrumentTwin:
        """Return the twin of a job that has been read.

        Parameters
        ----------
        resolved : ResolvedJob
            The job.
        backend : str
            Backend that traces the rays, ``llvm`` or ``cuda``.
        like : InstrumentTwin or None
            Twin of the same instrument, cameras and detector, whose built instrument is reused.

        Raises
        ------
        BackendUnavailable
            This machine does not have the backend.
        """
        return cls(resolved, _Bench(resolved, backend) if like is None else like._bench.stating(resolved))

    @property
    def name(self) -> str:
        """Name of the instrument."""
        return self.resolved.instrument.name

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the instrument's cameras."""
        return tuple(self.resolved.instrument.cameras)

    @property
    def perturbations(self) -> Mapping[str, Any]:
        """Path of each perturbed body -> its perturbation, with the keys and unit strings of the YAML."""
        plain = self._plain.get("perturb", {})
        return {
            node: {key: plain[node][key] for key in (*what.uses(), *_pivot(what.uses(), plain[node]))}
            for node, what in self.resolved.job.perturb.items()
        }

    @property
    def nodes(self) -> pd.DataFrame:
        """Table of all bodies that can be perturbed, with the motions that they allow and their pivot points."""
        rows = {
            path: {"allows": ", ".join(sorted(info.allows)), "pivots": ", ".join(info.pivots)}
            for path, info in self._nodes.items()
        }
        return pd.DataFrame.from_dict(rows, orient="index").rename_axis("node")

    @property
    def _nodes(self) -> Mapping[str, NodeInfo]:
        """Path of each body -> the motions that a perturbation may give it, and the names of its pivots."""
        return self._bench.experiment.instrument.nodes

    @property
    def experiment(self) -> MonitorExperiment:
        """Model of the instrument and its monitor, for computations that this class does not offer."""
        return self._bench.experiment

    @cached_property
    def state(self) -> State:
        """Path of each moved body -> its motion in SI units, due to all perturbations and the thermal deformations.

        Raises
        ------
        InputError
            The materials have no data for a temperature.
        """
        return job_state_in_focus(self._bench.experiment, self.resolved.job)

    @property
    def perturbed_by(self) -> str:
        """All perturbations as text that `perturbed` takes, separated by semicolons; empty without any."""
        return perturbation_text(self.resolved.job.perturb)

    def perturbed(self, *perturb: Perturbation | Sequence[Perturbation]) -> InstrumentTwin:
        """Return this instrument with the given bodies perturbed, in addition to the perturbations that they have.

        Parameters
        ----------
        perturb : str, Mapping[str, Mapping[str, Any]] or a list of them
            Motions in words, such as ``"M2 shift z 3 um"``, or node -> keys and unit strings of `perturb:` in a job's
            YAML, such as ``{"base/forward/M2": {"shift": "0 0 3 um"}}``. The last parts of a node's path are enough
            where only one node ends with them. Amounts of the same component add: shifts and rotation vectors,
            temperatures, figure terms and other changes.

        Raises
        ------
        InputError
            No such node, a motion that it does not allow, or one that cannot be added: a rotation about another pivot.
        """
        twin = self
        for addition in self._additions(perturb):
            before = twin.resolved.job.perturb
            twin = twin.with_perturbations(addition)
            added = twin.resolved.job.perturb
            twice = {path: _sum_of(path, before[path], added[path]) for path in addition if path in before}
            twin = twin.with_perturbations(twice) if twice else twin
        return twin

    def _additions(self, perturb: Sequence[Perturbation | Sequence[Perturbation]]) -> list[dict[str, Any]]:
        """Return the requested perturbations by the bodies' full paths: all texts together, then each mapping."""
        asked = [entry for item in perturb for entry in (item if isinstance(item, list | tuple) else [item])]
        try:
            wrong = [entry for entry in asked if not isinstance(entry, str | Mapping)]
            if wrong:
                raise Problem(
                    "not a perturbation", shown(wrong[0]), f"{FORMS}, or a mapping as below perturb in a file"
                )
            words = perturbation_in_words(entry for entry in asked if isinstance(entry, str))
        except Problem as problem:
            raise InputError(problem.at("", key=("perturb",))) from None
        return [self._by_path(entry) for entry in (words, *asked) if isinstance(entry, Mapping) and entry]

    def _by_path(self, perturb: Mapping[str, Any]) -> dict[str, Any]:
        """Return a perturbation by the bodies' full paths; unknown names stay and are reported later."""
        out: dict[str, Any] = {}
        for name, motion in perturb.items():
            try:
                path = find_node(name, self._nodes) if matching_nodes(name, self._nodes) else name
                if path in out:
                    raise Problem("this node is perturbed twice", shown(name), f"{path} once, under one name")
            except Problem as problem:
                raise InputError(problem.at("", key=("perturb",))) from None
            out[path] = motion
        return out

    def with_perturbations(self, perturb: Mapping[str, Mapping[str, Any]]) -> InstrumentTwin:
        """Return this instrument with the perturbations of these bodies replaced; other bodies keep theirs.

        Parameters
        ----------
        perturb : Mapping[str, Mapping[str, Any]]
            Node -> keys and unit strings of `perturb:` in a job's YAML, as for `perturbed`. An empty mapping, ``{}``,
            takes the perturbation away.

        Raises
        ------
        InputError
            No such node, or a motion that it does not allow.
        """
        twin = self._with_job({**self._plain, "perturb": {**self._plain.get("perturb", {}), **self._by_path(perturb)}})
        job = checked_nodes(twin.resolved.job, self._nodes)
        return InstrumentTwin(twin.resolved.with_job(job), twin._bench)

    def with_cameras(self, cameras: Mapping[str, CameraSpec]) -> InstrumentTwin:
        """Return this instrument with other prescriptions of its cameras; perturbations stay.

        Parameters
        ----------
        cameras : Mapping[str, CameraSpec]
            Reference in the instrument's file -> prescription; other cameras keep theirs.

        Raises
        ------
        InputError
            The light of a camera does not reach its image, or bodies overlap.
        """
        resolved = self.resolved.model_copy(update={"cameras": FrozenMap({**self.resolved.cameras, **cameras})})
        return InstrumentTwin(resolved, self._bench.building(resolved))

    def with_disturbances(self, disturbances: str | Mapping[str, Any]) -> InstrumentTwin:
        """Return this instrument with another disturbance prior, on which `posterior` and all total sigmas are based.

        The prior is the expected covariance of the bodies' motions and temperatures between two measurements.

        Parameters
        ----------
        disturbances : str or Mapping[str, Any]
            Value of `disturbances:` in a job's YAML: name of a file of the library (``launch``), path of a file,
            ``none`` for no prior, or ``{"file": ..., "causes": {...}, "without": [...]}``. It replaces the previous
            prior.

        Raises
        ------
        InputError
            No such file, or one that is not valid for this instrument.
        """
        reference = disturbances if isinstance(disturbances, str) else dict(disturbances)
        plain = {**self._plain, "disturbances": reference}
        job = self._with_job(plain).resolved.job
        prior = find_disturbances(job, self.resolved.instrument)
        resolved = self.resolved.model_copy(update={"job": job, "disturbances": prior})
        twin = InstrumentTwin(resolved, self._bench.stating(resolved))
        twin.experiment.prior  # noqa: B018 - raises now if the instrument lacks a body
        return twin

    def render(self, frames: int | None = None, seed: int | None = None, **render: Any) -> Shot:
        """Render the nominal and the perturbed instrument, and expose its detectors.

        Parameters
        ----------
        frames : int or None
            Number of frames of each exposure; by default that of the job or the instrument.
        seed : int or None
            Seed of all noise; by default that of the job (1 unless it sets another).
        render : keyword arguments
            Further keys of `render:` in a job's YAML, such as ``stray=True``, ``quality=True`` or ``images=["spots",
            "knife_edge"]``.

        Raises
        ------
        InputError
            A key is wrong, or a perturbation is so large that light misses the mirrors or a spot its CCD.
        """
        arguments = {"frames": frames, "seed": seed}
        chosen = {key: value for key, value in arguments.items() if value is not None}
        job = self._with_job({**self._plain, "render": {**self._plain.get("render", {}), **chosen, **render}}).resolved
        started, backend = time.time(), self._bench.backend
        return _shot_of(render_job(job, backend, experiment=self._bench.experiment), backend, started)

    def recover(self, before: Any, after: Any, centroid: str | None = None) -> Recovered:
        """Estimate the changes of the cameras from images, by every estimator.

        The changes are rotations d_alpha, d_beta, d_gamma and the change d_f of the principal distance of each camera.
        The estimators use the calibration of the unperturbed instrument and its disturbance prior.

        Parameters
        ----------
        before : DataArray or ndarray
            Frames of the unperturbed instrument, grey values, (channel, frame, row, column) in the order of
            ``shot.before.channel``.
        after : DataArray or ndarray
            Frames of the perturbed instrument, likewise.
        centroid : str or None
            Name of a method of `analysis.spots.CENTROIDS`; by default that of the job.

        Raises
        ------
        ValueError
            Frames have another shape, or there is no such centroid.
        SpotError
            A spot cannot be measured.
        """
        method = self.resolved.job.analysis.centroid if centroid is None else centroid
        experiment = self._bench.experiment
        path = experiment.path
        keys = [channel.key for channel in path.channels]
        frames_before = as_frames(before, "before", keys, path.shape)
        frames_after = as_frames(after, "after", keys, path.shape)
        prior = experiment.disturbances
        motion_models = experiment.motion_models
        recovery = recover_monitor(
            frames_before, frames_after[None], experiment.calibration, method, disturbances=prior, motions=motion_models
        )
        reading = MonitorReading(
            channels=tuple((channel.camera, channel.name) for channel in path.channels),
            cameras=experiment.cameras,
            ground=experiment.ground,
            disturbances=prior,
            recovery=recovery,
            crosstalk={},
            frames=frames_after.shape[1],
            centroid=method,
        )
        warnings = (*blur_warnings(self.resolved, self._bench.backend), *coarse_warnings(self.resolved))
        return recovered_of(reading, warnings)

    def jacobian(self, motions: Sequence[str]) -> xr.Dataset:
        """Return exact derivatives of spots and camera parameters with respect to elementary motions of bodies.

        They are taken at the unperturbed instrument.

        Parameters
        ----------
        motions : sequence of str
            Motions such as ``base/forward/M2 shift z``, ``base/backward/focal_plane rotate x about rear_node``,
            ``base/forward scale`` or ``base/forward/M1 figure Z5``.

        Returns
        -------
        xr.Dataset
            Derivatives with respect to each motion, per um, arcsec, ppm or nm of it (coordinate ``per``): ``spots``
            (channel, axis, motion), spot positions in px; ``true`` (camera, parameter, motion), the camera parameters
            by exact tracing; ``readings`` (camera, estimator, parameter, motion), the parameters that each estimator
            computes from the spots. Parameters are in arcsec or um, according to the end of their names.

        Raises
        ------
        InputError
            No such node, pivot or motion.
        """
        experiment = self._bench.experiment
        names = list(self.cameras)
        keys = [channel.key for channel in experiment.path.channels]
        elementary = [_motion_named(text, self._nodes) for text in motions]
        size = np.array([motion.unit_size for motion in elementary])
        spots = spot_jacobian(experiment.path, elementary)
        truth = truth_jacobian(experiment.instrument, self._bench.backend, elementary)
        gains = estimator_gains(experiment.cameras, experiment.disturbances)
        spot_shifts = spots.reshape(-1, len(elementary))
        parameter_rows = {name: parameters.rows_of(experiment.cameras[name]) for name in names}
        readings = [
            [rows @ (gain[4 * k : 4 * k + 4] @ spot_shifts) * size for gain in gains.values()]
            for k, rows in enumerate(parameter_rows.values())
        ]
        true = np.stack([rows @ truth[name] * size for name, rows in parameter_rows.items()])
        return xr.Dataset(
            {
                "spots": (("channel", "axis", "motion"), spots * size, {"units": "px"}),
                "true": (("camera", "parameter", "motion"), true),
                "readings": (("camera", "estimator", "parameter", "motion"), np.array(readings)),
            },
            coords={
                "motion": list(motions),
                "per": ("motion", [motion.unit for motion in elementary]),
                "channel": keys,
                "axis": ["row", "column"],
                "camera": names,
                "parameter": [parameter.key for parameter in parameters.CAMERA_PARAMETERS.values()],
                "estimator": list(gains),
            },
            attrs={"reference_frames": frames_text("crosstalk")},
        )

    def camera(self, name: str = "", obstruction: bool = True) -> CameraTwin:
        """Return one of the instrument's cameras in this state, for analysis as optical designers do.

        Parameters
        ----------
        name : str
            Name of the camera; optional if there is only one.
        obstruction : bool
            Whether light that prisms and other bodies block is removed from its beam.

        Raises
        ------
        InputError
            There is no camera of that name.
        """
        return CameraTwin.of(self, self._camera_name(name), obstruction)

    def _camera_name(self, name: str) -> str:
        """Return the name of a camera, that of the only one for an empty name; raise `InputError` for another."""
        name = name or (self.cameras[0] if len(self.cameras) == 1 else "")
        if name not in self.cameras:
            raise InputError(unknown("no such camera", name, self.cameras).at())
        return name

    def refocused(self, camera: str = "", tilt: bool = False) -> InstrumentTwin:
        """Return this instrument with the image plane of a camera at the least mean square error over its field.

        In the nominal state the plane of the prescription moves, in every camera of the instrument that has this
        prescription. In another state the camera's focal plane moves, which ``perturbed_by`` then lists.

        Parameters
        ----------
        camera : str
            Name of the camera; optional if there is only one.
        tilt : bool
            Whether the plane is tilted about the line as well.

        Raises
        ------
        InputError
            There is no such camera, or the light has no focus.
        """
        name, resolved, backend = self._camera_name(camera), self.resolved, self._bench.backend
        mounted = resolved.instrument.cameras[name].camera
        if not resolved.job.perturb and not resolved.instrument.as_built:
            design = resolved.cameras[mounted]
            moved = with_plane(design, find_focus(CameraOptics.alone(design, backend), tilt).after)
            cameras = FrozenMap({**resolved.cameras, mounted: moved})
            return InstrumentTwin.of(resolved.model_copy(update={"cameras": cameras}), self._bench.name)
        optics = self.camera(name)
        plane = focal_plane_body(optics.path.root)
        plane_motion = motions_of(checked_nodes(resolved.job, self._nodes)).get(plane)
        others = {node: keys for node, keys in dict(self._plain.get("perturb") or {}).items() if node != plane}
        unmoved = self._with_job({**self._plain, "perturb": others}) if plane_motion is not None else self
        return unmoved.perturbed(*find_focus(optics, tilt, name, plane_motion).words)

    def to_yaml(self) -> str:
        """Return the text of a self-contained job file for this instrument, for `load` and the commands."""
        return self.resolved.to_yaml()

    @cached_property
    def _plain(self) -> Mapping[str, Any]:
        """Content of the job's file: keys and values as plain data."""
        return self.resolved.job.plain()

    def _with_job(self, plain: Mapping[str, Any]) -> InstrumentTwin:
        """Return the same instrument with another job, from the content of the job's file as plain data."""
        source = self.resolved.job.source
        job = validate(JobSpec, YamlFile("", dict(plain), {})).with_source(source)
        assert isinstance(job, JobSpec)
        job = with_tables(job)
        if job.render.target_images and self.resolved.line_detectors is None:
            return InstrumentTwin(resolve_job(job), self._bench)
        return InstrumentTwin(self.resolved.with_job(job), self._bench)

    def __repr__(self) -> str:
        return f"<{self.name}: cameras {', '.join(self.cameras)}; perturbed by {self.perturbed_by or 'nothing'}>"

    def _repr_html_(self) -> str:
        return name_html(self.name, self.cameras, self.perturbations)


def _pivot(uses: Sequence[str], plain: Mapping[str, Any]) -> tuple[str, ...]:
    """Return ``("pivot",)`` if a perturbation has a rotation or a scale about a pivot that it names; else ``()``.

    ``uses`` are the kinds of motion in the perturbation, and ``plain`` are its keys and values.
    """
    return ("pivot",) if {"rotate", "scale"} & set(uses) and "pivot" in plain else ()


def _sum_of(path: str, first: PerturbationSpec, second: PerturbationSpec) -> dict[str, Any]:
    """Return the sum of two perturbations of a body as plain data; raise `InputError` where there is none."""
    try:
        return first.plus(second).plain()
    except Problem as problem:
        raise InputError(problem.below(path).at("", key=("perturb",))) from None


def load(
    what: str | Path, backend: str = "llvm", disturbances: str | Mapping[str, Any] | None = None
) -> InstrumentTwin:
    """Load an instrument.

    Parameters
    ----------
    what : str or Path
        Name of an instrument in the library (``gf7_pair``), or path of an instrument's file, of a job, or of the
        config.yaml of a run; a job's perturbations are applied.
    backend : str
        Backend that traces the rays, ``llvm`` or ``cuda``.
    disturbances : str or Mapping[str, Any] or None
        Disturbance prior: name or path of a file, ``none``, or the mapping of `disturbances:` in a job's YAML; by
        default that of the job or the instrument.

    Raises
    ------
    InputError
        No such name, or a file that cannot be read or is not valid, with line and key.
    BackendUnavailable
        This machine does not have the backend.
    """
    loaded = _load(what, backend)
    return loaded if disturbances is None else loaded.with_disturbances(disturbances)


def _load(what: str | Path, backend: str) -> InstrumentTwin:
    """Load an instrument with the disturbance prior that its file names."""
    text = str(what)
    if text not in library_names(INSTRUMENTS) or isinstance(what, Path):
        data = read_yaml(what).data if isinstance(what, Path) or "/" in text or text.endswith((".yaml", ".yml")) else {}
        if isinstance(data, dict) and ("job" in data or "instrument" in data):
            resolved = resolve(what)
            return InstrumentTwin.of(resolved, backend)
        text = str(Path(what).resolve()) if data else text
    resolved = resolve_job(validate(JobSpec, YamlFile("", {"instrument": text}, {})))
    return InstrumentTwin.of(resolved, backend)


def load_camera(what: str | Path, backend: str = "llvm") -> CameraTwin:
    """Load a single camera for analysis as optical designers do; its method ``perturbed`` moves and heats its parts.

    Parameters
    ----------
    what : str or Path
        Name of a camera in the library (``gf7``), or path of a camera's file.
    backend : str
        Backend that traces the rays, ``llvm`` or ``cuda``.

    Raises
    ------
    InputError
        No such name, a file that cannot be read or is not valid, or a prescription that brings no light through the
        stop to the image.
    """
    camera = read_camera(what)  # raises an error about cameras if it is not one
    return _load(Path(what) if is_path(what) else str(what), backend).camera(camera.name)


RIGID = ("shift", "rotate", "scale", "figure")
"""Kinds of motions of a body for which ``InstrumentTwin.jacobian`` has derivatives."""
_FORMS = "NODE shift x|y|z, NODE rotate x|y|z, NODE scale, NODE figure Z5; rotate and scale may end in 'about PIVOT'"


def _motion_named(text: str, nodes: Mapping[str, NodeInfo]) -> ElementaryMotion:
    """Return the elementary motion that a text names.

    Parameters
    ----------
    text : str
        ``NODE shift x``, ``NODE rotate x``, ``NODE scale`` or ``NODE figure Z5``, optionally with ``about PIVOT``.
    nodes : Mapping[str, NodeInfo]
        Path -> properties, for all bodies of the instrument.

    Returns
    -------
    ElementaryMotion
        The motion, labelled with the text.

    Raises
    ------
    InputError
        The text has another form, or names an unknown node or pivot, or a motion that the node does not allow.
    """
    try:
        name, kind, axis, amount, pivot = motion_of(text)
        node = find_node(name, nodes)
    except Problem as problem:
        raise InputError(problem.at("", key=("motions",))) from None
    if amount:
        raise _wrong("not a motion of a node", text, _FORMS)
    info, pivot = nodes[node], pivot or ORIGIN
    rigid = tuple(kind for kind in RIGID if kind in info.allows)
    if kind not in rigid:
        raise _wrong(f"{node} has no derivative with respect to this", kind, names_text(rigid), nearest(kind, rigid))
    known = tuple(dict.fromkeys((ORIGIN, *info.pivots)))
    if pivot not in known:
        raise _wrong(f"{node} has no such pivot", pivot, names_text(known), nearest(pivot, known))
    number = noll(axis) if kind == "figure" else AXES.get(axis, 0)
    return ElementaryMotion(node, kind, number, pivot, text)


def _wrong(problem: str, value: str, allowed: str, suggestion: str | None = None) -> InputError:
    """Return an error about a motion's text, with what is allowed and the nearest valid name as suggestion."""
    return InputError(Issue(problem, value=repr(value), allowed=allowed, suggestion=suggestion))
