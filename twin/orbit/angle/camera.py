"""The lines whose angles are tested: as the laboratory knows them, and as they are in orbit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from optics.aim import AimError
from optics.backend import Backend
from optics.frozen_map import FrozenMap
from optics.rotation import rotation_matrix
from optics.trace import BeamMissedError
from optics.tree import State
from scenes.errors import InputError
from scenes.instrument_builder import build_instrument
from scenes.instrument_model import Instrument
from scenes.job import JobSpec, perturbation_issues
from scenes.thermal_model import TemperatureError, ThermalModel
from twin.experiment import motions_of
from twin.orbit.line_camera import LineCamera, line_cameras, traced_line_cameras
from twin.trial.bench_error import BenchError
from twin.truth import trace_truth

if TYPE_CHECKING:
    from scenes.orbit_angle import OrbitAngleSpec
    from scenes.orbit_setup import AngleSetup


@dataclass(frozen=True, eq=False)
class AngleCamera:
    """Lines on their common base.

    Attributes:
        laboratory: line -> what was measured before launch, which the analysis knows.
        cameras: line -> what it is in orbit.
        trace: angle -> how it has changed by `twin.truth.trace_truth`, radians; only for the two cameras of a pair.
    """

    laboratory: Mapping[str, LineCamera]
    cameras: Mapping[str, LineCamera]
    trace: Mapping[str, float]


def angle_camera(setup: AngleSetup, backend: Backend | None) -> AngleCamera:
    """The lines of a payload turned as the test says, or those of an instrument traced without and with its changes.

    Args:
        setup: the test with its camera.
        backend: where to trace an instrument; a payload needs none.

    Raises:
        InputError: a change of what the instrument does not have, or a temperature that cannot be.
        BenchError: the changes move the image off the mirrors.
    """
    spec = setup.test
    if setup.camera is not None:
        laboratory = line_cameras(setup.camera)
        turns = {name: rotation_matrix(change.rotate).T for name, change in spec.changes.items()}
        turned = {
            name: replace(camera, directions=camera.directions @ turns[name]) if name in turns else camera
            for name, camera in laboratory.items()
        }
        return AngleCamera(FrozenMap(laboratory), FrozenMap(turned), FrozenMap())
    if setup.instrument is None or backend is None:
        raise ValueError("an instrument's lines need a backend to be traced")
    instrument = build_instrument(setup.instrument, setup.cameras, backend)
    state = changed_state(spec, instrument)
    laboratory = traced_line_cameras(instrument, backend)
    try:
        cameras = traced_line_cameras(instrument, backend, state)
        change = float(trace_truth(instrument, backend, [state]).angle_change[0])
    except (AimError, BeamMissedError) as error:
        raise BenchError(str(error), ("changes",), "smaller changes, which leave the image on the mirrors") from error
    trace = {name: change for name, pair in setup.angles.items() if len(cameras) == 2 and set(pair) == set(cameras)}
    return AngleCamera(FrozenMap(laboratory), FrozenMap(cameras), FrozenMap(trace))


def changed_state(spec: OrbitAngleSpec, instrument: Instrument) -> State:
    """The state that a test's changes put an instrument into.

    Raises:
        InputError: a node that does not exist or does not allow what is done to it, or a temperature that cannot be.
    """
    issues = [
        issue
        for path, what in spec.changes.items()
        for issue in perturbation_issues(spec, instrument.nodes, path, what, ("changes", path))
    ]
    if issues:
        raise InputError(*issues)
    job = JobSpec.model_construct(instrument=spec.camera, perturb=spec.changes)
    thermal = ThermalModel(instrument)
    try:
        thermal.check(job.fields())
        return thermal.state(job.fields(), motions_of(job))
    except TemperatureError as error:
        raise spec.error(str(error), ("changes", error.origin, "temperature"), allowed=error.allowed) from error
