"""The best focal plane of a camera in its state, as a plane of its file and as a motion of its focal plane."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from analysis.arrays import shows
from optics.geometry.pose import rotation_matrix, triple
from optics.geometry.tree import Motion, State, compose
from scenes.models.camera_model import focal_plane_body
from scenes.models.camera_sharpness import FIELDS, FocalPlane
from scenes.models.job_state import motions_of
from scenes.specs.job import JobSpec, checked_nodes
from twin.camera.camera_optics import CameraOptics
from twin.monitor.monitor_experiment import MonitorExperiment


@shows("errors_before [waves]", "errors_after [waves]", "tilt")
@dataclass(frozen=True, eq=False)
class Refocus:
    """Focal plane before and after refocusing.

    Attributes
    ----------
    before, after : FocalPlane
        Plane of the file and the best one. In a perturbed state both are seen from the moved focal plane, which is
        drawn where it was designed to be.
    errors_before, errors_after : ndarray
        Rms wavefront error at the F fields over which the focus is optimised (``FIELDS``), (F,), waves.
    tilt : bool
        True if the plane was tilted as well.
    motion : Motion
        Motion of the focal plane that refocuses, in the axes of its body, which the state may have moved.
    words : tuple of str
        Perturbation of the focal plane that gives the refocused camera, such as ``focal_plane shift z +0.226 mm``.
    moved : bool
        True if ``words`` replace a perturbation that the focal plane has.
    downstream : bool
        True if the +Z of the focal plane, which points toward the scene, is along the light.
    """

    before: FocalPlane
    after: FocalPlane
    errors_before: np.ndarray
    errors_after: np.ndarray
    tilt: bool
    motion: Motion
    words: tuple[str, ...]
    moved: bool
    downstream: bool


def refocused_state(
    optics: CameraOptics, existing: State, tilt: bool = False, mounted: str | None = None
) -> tuple[Refocus, State]:
    """Return the best focal plane of a camera in its state, and the state with it.

    Parameters
    ----------
    optics : CameraOptics
        Camera in its state, within its instrument.
    existing : State
        Motions that the state gives the bodies themselves.
    tilt : bool
        Allow a tilt about the line as well.
    mounted : str or None
        Name of the camera in its instrument.
    """
    plane = focal_plane_body(optics.path.root)
    focus = find_focus(optics, tilt, mounted, existing.get(plane))
    return focus, compose(optics.state, {plane: focus.motion}, {plane: optics.assembly.tree[plane]})


def job_state_in_focus(experiment: MonitorExperiment, job: JobSpec) -> State:
    """Return the state that a job describes, with the best focal plane of every camera if the job has ``refocus``.

    Raises
    ------
    InputError
        See `MonitorExperiment.state`; or the light of a camera has no focus, or its instrument has a monitor.
    """
    if not job.refocus:
        return experiment.state(job)
    if experiment.monitored:
        problem = "an instrument with a monitor is not refocused: its readings refer to the focal planes as they are"
        raise job.error(problem, ("refocus",), allowed="false, or a camera without a monitor")
    job = checked_nodes(job.model_copy(update={"refocus": False}), experiment.instrument.nodes)
    state = experiment.state(job)
    for name in experiment.instrument.cameras:
        optics = CameraOptics.within(experiment.instrument, name, experiment.backend, state)
        _, state = refocused_state(optics, motions_of(job), mounted=name)
    return state


def find_focus(optics: CameraOptics, tilt: bool, mounted: str | None = None, existing: Motion | None = None) -> Refocus:
    """Find the focal plane with the smallest mean square wavefront error over ``FIELDS``.

    Parameters
    ----------
    optics : CameraOptics
        Camera in its state.
    tilt : bool
        Allow a tilt about the line as well.
    mounted : str or None
        Name of the camera in its instrument; None for a camera alone.
    existing : Motion or None
        Motion that the state gives the focal plane itself; None for none.

    Raises
    ------
    InputError
        Light does not pass, or has no focus after the last mirror.
    """
    camera, model = optics.model.spec, optics.model
    beams = optics.beams(FIELDS, 6)
    best, nominal = beams.best_plane(tilt), FocalPlane.of(camera)
    if not beams.reaches(best):
        problem = f"refocusing is not possible: the light has no focus after {list(camera.mirrors)[-1]}"
        raise camera.error(problem, ("mirrors",), allowed="mirrors that make a real image")
    frame = model.focal_plane
    rotation = np.array([0.0, best.tilt - nominal.tilt, 0.0])  # Y of the focal plane is x of the prescription
    normal = frame.rotation @ rotation_matrix(rotation)[:, 2]
    distance = (np.array([0.0, 0.0, best.z]) - frame.translation) @ normal / (frame.rotation[:, 2] @ normal)
    motion = Motion(triple(rotation), (0.0, 0.0, float(distance)))
    body, total = focal_plane_body(optics.path.root), motion
    if existing is not None:
        total = compose({body: existing}, {body: motion}, {body: optics.assembly.tree[body]})[body]
    return Refocus(
        nominal,
        best,
        beams.errors(nominal),
        beams.errors(best),
        tilt,
        motion,
        _motion_words(focal_plane_body(mounted or "").lstrip("/"), total),
        existing is not None,
        bool(model.image_direction @ frame.rotation[:, 2] > 0.0),
    )


def _motion_words(node: str, motion: Motion) -> tuple[str, ...]:
    """Return the motion of a body as texts that ``--perturb`` takes, without rotations below 0.01 arcsec and 10 nm."""
    out = []
    for axis, angle in zip("xyz", np.degrees(motion.rotate) * 3600.0, strict=True):
        if abs(angle) >= 0.01:
            out.append(f"{node} rotate {axis} {angle:+.4g} arcsec")
    for axis, length in zip("xyz", motion.shift, strict=True):
        size, unit = (1e3, "mm") if abs(length) >= 1e-5 else (1e6, "um")
        if abs(length) >= 1e-8 or axis == "z":
            out.append(f"{node} shift {axis} {size * round(length, 12):+.5g} {unit}")
    return tuple(out)
