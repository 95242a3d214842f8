"""The main job: perturb the instrument, render and expose images, estimate the changes, compare with the true ones."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial

import numpy as np

from analysis.monitor.recovery import recover_monitor
from analysis.spots.spot_image import SpotError
from optics.geometry.tree import State, compose
from optics.numerics.array_math import UnphysicalError
from optics.numerics.backend import Backend
from scenes.models.camera_sharpness import blur_warnings
from scenes.models.instrument_builder import facet_alignment
from scenes.models.instrument_model import Instrument, MisplacedError
from scenes.models.obstruction import find_obstructions, moved_into_beams
from scenes.models.scenery import measured_finishes
from scenes.specs.instrument import PRISM_180, as_built_of, prism_of
from scenes.specs.job import checked_nodes
from scenes.specs.perturbation import perturbation_text
from scenes.specs.resolved import ResolvedJob
from scenes.yaml.errors import InputError
from twin.camera.first_order_data import obscuration, unmodelled_obscuration
from twin.camera.refocus import job_state_in_focus
from twin.framework.frame_store import mean_of
from twin.framework.procedure import Advance, silent
from twin.main_job.render_files import deformation_warnings
from twin.main_job.render_results import JobRun, RenderRun, StrayPair
from twin.monitor.crosstalk import crosstalk
from twin.monitor.image_quality import ImageQuality, image_quality
from twin.monitor.monitor_beams import SpotFocus
from twin.monitor.monitor_experiment import MonitorExperiment, require_memory
from twin.monitor.observation import LOST, ObservationOptions, light_of, read
from twin.monitor.time_series import run_series, series_states, too_large
from twin.path_tracing.stray_light import NominalPathLost, StrayLight, ghost_warnings, stray_light
from twin.sensors.area_detector import coarse_warnings
from twin.targets.target_images import TargetLostError
from twin.targets.target_measurement import TargetRun, check_targets, render_targets, target_pixels

STAGES = (
    "build the instrument",
    "perturb",
    "trace the truth",
    "calibrate",
    "render the spots",
    "expose",
    "recover",
    "crosstalk",
)

COURSE = "times of the course"
"""Progress label of a long part: the times of a time series."""

STRAY = "trace ghosts and stray light"
"""Progress label of a long part: stray light."""

TARGETS = "render the targets"
"""Progress label of a long part: images of targets."""

QUALITY = "image quality"
"""Progress label of a long part: image quality."""

_FREE_PUPILS = "obstruction: ignore: image quality and targets do not include obstruction by bodies in the beams"
"""Text of the warning that image quality and targets ignore obstructions of the pupils, as the job requests."""

MIN_LIGHT = 0.5
"""Fraction of the nominal light on a CCD below which the user is warned of vignetting or a spot leaving the CCD."""

SHARP = 1.0 / 14.0
"""Wavefront error, in waves RMS, below which a nominal spot counts as diffraction limited.

It is Maréchal's criterion, a Strehl ratio of 0.8.
"""


def render_job(
    resolved: ResolvedJob,
    backend: Backend,
    frames: int | None = None,
    seed: int | None = None,
    advance: Advance = silent,
    experiment: MonitorExperiment | None = None,
    placed: Callable[[Instrument, Backend, State], object] | None = None,
) -> JobRun:
    """Run a job: perturb the instrument, render and expose images, estimate the changes, compare with the true ones.

    For a time series, most of the results describe the single time ``course.detail``. An instrument with a monitor
    gives a `RenderRun`. One without is perturbed and traced, and the images of its cameras are evaluated.

    Parameters
    ----------
    resolved : ResolvedJob
        Job to run.
    backend : Backend
        Backend that traces rays.
    frames : int or None
        Number of frames per state; overrides the job's.
    seed : int or None
        Seed of all noise; overrides the job's.
    advance : Advance
        Called when each of STAGES and QUALITY begins and ends, and for the long parts COURSE, STRAY and TARGETS with
        the number of times, paths or target positions done and their total.
    experiment : MonitorExperiment or None
        The job's instrument if it has been built already; results are the same.
    placed : callable or None
        Called with a monitored instrument and the state that is shown before the rest is computed, so that they can be
        drawn meanwhile.

    Raises
    ------
    InputError
        A body is unknown, memory does not suffice, or the perturbation is so large that light misses the mirrors or a
        spot its CCD.
    """
    frame_count = resolved.frames if frames is None else frames
    run_seed = resolved.job.render.seed if seed is None else seed
    # the run's config.yaml has to repeat the run, overrides included
    resolved = resolved.with_render(frame_count, run_seed)
    check_targets(resolved)
    if resolved.instrument.monitor is None:
        return _without_monitor(resolved, backend, advance, experiment)
    stage = _Stages(advance)
    stage.begin(0)
    experiment = MonitorExperiment(resolved, backend) if experiment is None else experiment
    times = 0 if resolved.job.course is None else len(resolved.job.course.times)
    require_memory(resolved, experiment.size(frame_count, times, target_pixels(resolved)), experiment.detector)
    resolved = resolved.with_job(checked_nodes(resolved.job, experiment.instrument.nodes))
    experiment.prior  # noqa: B018 - what is wrong with it is said before the long parts
    stage.begin(1)
    course = resolved.job.course
    states = (
        [job_state_in_focus(experiment, resolved.job)] if course is None else series_states(experiment, resolved.job)
    )
    shown = 0 if course is None else course.shown
    state = states[shown]
    if placed is not None:
        with suppress(*LOST):  # lost light is reported in its place below
            placed(experiment.instrument, backend, state)
    stage.begin(2)
    try:
        focus = experiment.nominal_focus
    except LOST as error:
        raise _no_spots(experiment, str(error)) from error
    numbers_shown, series = np.array([shown]), None
    with _lost_by_motions(resolved, *LOST):
        stage.begin(3)
        experiment.calibration  # noqa: B018 - before the long parts
        stage.begin(4)
        nominal = experiment.nominal_photons
        light = light_of(experiment, [state], numbers_shown, single=False) if course is None else None
    if light is None:
        series = run_series(experiment, resolved, states, lambda done: advance(COURSE, done, len(states)))
        # a course is rendered in single precision; the run shows the frames that it measured
        light = light_of(experiment, [state], numbers_shown, photons=series.shown_photons[None])
    stray = None
    if resolved.job.render.stray is not None:
        stray = _stray(experiment, resolved, state, run_seed, advance)
        nominal, light = nominal + stray.before.photons, replace(light, photons=light.photons + stray.after.photons)
    stage.begin(5)
    before = experiment.frames_before(frame_count, run_seed, 0.0 if stray is None else stray.before.photons)

    def record(photons: np.ndarray, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        after = experiment.frames_after(photons, frame_count, run_seed, numbers)
        stage.begin(6)
        return before, after

    try:
        observation = read(experiment, light, ObservationOptions(record, resolved.job.analysis.centroid))
    except SpotError as error:
        raise _unmeasured(experiment, before, error, focus) from error
    assert observation is not None
    photons, after = light.photons[0], observation.after[0]
    stage.begin(7)
    tables = crosstalk(experiment, observation.recovery.shift_covariance[0])
    stage.end()
    targets, quality = _images(experiment, resolved, state, run_seed, advance)
    deformed = experiment.deformed(resolved.job)
    of_glass = {e.body for e in experiment.instrument.assembly.elements.values() if e.solid is not None}
    return RenderRun(
        resolved=resolved,
        experiment=experiment,
        state=state,
        frames=frame_count,
        seed=run_seed,
        truth=light.truth,
        photons_before=nominal,
        photons_after=photons,
        before=before,
        after=after,
        recovery=observation.recovery,
        crosstalk=tables,
        warnings=(
            *blur_warnings(resolved, backend),
            *coarse_warnings(resolved),
            *_blurred(experiment, focus),
            *_warnings(experiment, nominal, photons, before, after),
            *moved_into_beams(experiment.instrument, backend, state),
            *deformation_warnings(deformed, [p for p in deformed if stray is not None and p in of_glass]),
            *(text for path, body in experiment.heated(resolved.job).items() for text in body.warnings(path)),
            *(series.warnings if series is not None else ()),
            *(_stray_warnings(experiment, stray) if stray is not None else ()),
            *_image_warnings(experiment, resolved, targets, quality),
        ),
        series=series,
        stray=stray,
        targets=targets,
        quality=quality,
    )


def require_one_state(resolved: ResolvedJob) -> None:
    """Raise InputError if a job of an instrument without a monitor requests results that require one.

    Parameters
    ----------
    resolved : ResolvedJob
        Job to check.

    Raises
    ------
    InputError
        The job has a time series, stray light or disturbances.
    """
    job = resolved.job
    for asked, key, what in (
        (job.course is not None, ("course",), "a course is measured with the monitor's spots"),
        (job.render.stray is not None, ("render", "stray"), "stray light is traced to the monitor's area CCDs"),
        (job.disturbances is not None, ("disturbances",), "a prior on disturbances applies to a monitor's readings"),
    ):
        if asked:
            allowed = "a job without this key, with image quality and targets; or an instrument with a monitor"
            if key == ("course",):
                allowed = (
                    "a study, which computes every row of a table as a state, with image quality: factors such as "
                    "`M2_z: {motion: M2 shift z, table: {file: course.csv, column: M2_z}}` and design: {kind: grid}, "
                    "by python -m twin.study; or an instrument with a monitor"
                )
            raise job.error(f"{what}, and {resolved.instrument.name} has none", key, allowed=allowed)


def _without_monitor(
    resolved: ResolvedJob, backend: Backend, advance: Advance, experiment: MonitorExperiment | None
) -> JobRun:
    """Run the job of an instrument without a monitor: its state, the true changes, and the cameras' images.

    Raises
    ------
    InputError
        The job cannot be run (see `render_job`), or it requests results that require a monitor.
    """
    require_one_state(resolved)
    job = resolved.job
    stage = _Stages(advance)
    stage.begin(0)
    experiment = MonitorExperiment(resolved, backend) if experiment is None else experiment
    job = checked_nodes(job, experiment.instrument.nodes)
    resolved = resolved.with_job(job)
    stage.begin(1)
    state = job_state_in_focus(experiment, job)
    stage.begin(2)
    with _lost_by_motions(resolved, *LOST):
        truth = experiment.sight.truth([state])
    stage.end()
    seed = job.render.seed
    targets, quality = _images(experiment, resolved, state, seed, advance)
    return JobRun(
        resolved=resolved,
        experiment=experiment,
        state=state,
        frames=resolved.frames,
        seed=seed,
        truth=truth,
        warnings=(
            *blur_warnings(resolved, backend),
            *deformation_warnings(experiment.deformed(job), []),
            *(text for path, body in experiment.heated(job).items() for text in body.warnings(path)),
            *_image_warnings(experiment, resolved, targets, quality),
        ),
        targets=targets,
        quality=quality,
    )


def _images(
    experiment: MonitorExperiment, resolved: ResolvedJob, state: State, seed: int, advance: Advance
) -> tuple[TargetRun | None, ImageQuality | None]:
    """Render targets and compute image quality of the cameras, if the job requests them.

    Raises
    ------
    InputError
        The light of the targets is lost.
    """
    render = resolved.job.render
    instrument, backend, targets = experiment.instrument, experiment.backend, None
    with _lost_by_motions(resolved, TargetLostError, UnphysicalError):
        if render.target_images:
            targets = render_targets(resolved, instrument, backend, state, seed, partial(advance, TARGETS))
        if not resolved.quality:
            return targets, None
        advance(QUALITY, 0, 1)
        quality = image_quality(instrument, backend, [{}, state], obstruction=render.obstructed)
    advance(QUALITY, 1, 1)
    return targets, quality


def _image_warnings(
    experiment: MonitorExperiment, resolved: ResolvedJob, targets: TargetRun | None, quality: ImageQuality | None
) -> tuple[str, ...]:
    if targets is None and quality is None:
        return ()
    backend, models = experiment.backend, {m.spec.name: m for m in experiment.instrument.cameras.values()}
    shadows = {name: unmodelled_obscuration(model, obscuration(model, backend)) for name, model in models.items()}
    return (
        *(f"camera {name}: {text}" for name, text in shadows.items() if text),
        *(targets.warnings if targets is not None else ()),
        *(quality.warnings if quality is not None else ()),
        *((_FREE_PUPILS,) if not resolved.job.render.obstructed else ()),
    )


class _Stages:
    """Reporter of the progress, which is called when each of STAGES begins and ends."""

    def __init__(self, advance: Advance) -> None:
        self._advance, self._now = advance, ""

    def begin(self, number: int) -> None:
        self.end()
        self._now = STAGES[number]
        self._advance(self._now, 0, 1)

    def end(self) -> None:
        if self._now:
            self._advance(self._now, 1, 1)


def _stray(
    experiment: MonitorExperiment, resolved: ResolvedJob, state: State, seed: int, advance: Advance
) -> StrayPair:
    """Trace stray light before and after the perturbation.

    Raises
    ------
    InputError
        No light returns to a CCD, or a table of a finish does not suit this instrument.
    """
    assert resolved.job.render.stray is not None
    paths = resolved.job.render.stray.paths
    sources = len(experiment.path.channels) * paths
    with _lost_by_motions(resolved, NominalPathLost):
        measured = measured_finishes(resolved)

        def traced(state: State, first: int) -> StrayLight:
            finishes = None if measured is None else measured.finishes
            return stray_light(
                experiment, state, paths, seed, lambda done, _: advance(STRAY, first + done, 2 * sources), finishes
            )

        before = traced({}, 0)
        obstructions = find_obstructions(experiment.instrument, experiment.backend)
        return StrayPair(before, traced(state, sources) if state else before, obstructions, measured)


def _stray_warnings(experiment: MonitorExperiment, stray: StrayPair) -> Iterator[str]:
    for o in stray.obstructions:
        intended = prism_of(o.body) == PRISM_180 and o.beam == f"{o.body.split('/')[1]}/imaging"
        if o.used == 0.0 and not intended:
            yield f"{o.body} blocks {100.0 * o.share:.1f} % of the beam {o.beam}"
    if stray.measured is not None:
        yield from stray.measured.warnings()
    yield from ghost_warnings(experiment, stray.before)


@contextmanager
def _lost_by_motions(resolved: ResolvedJob, *errors: type[Exception]) -> Iterator[None]:
    """Report errors of the given types as InputError at the key ``perturb`` (a context manager).

    It encloses computations in which such an error means that the job's motions are too large.
    """
    try:
        yield
    except errors as error:
        raise _too_large(resolved, str(error)) from error


def _too_large(resolved: ResolvedJob, reason: str) -> InputError:
    if resolved.job.course is not None:
        return too_large(resolved.job, resolved.job.course.shown, reason)
    moved = ", ".join(resolved.job.perturb) or "nothing"
    allowed = "smaller motions, which keep the beams on the mirrors and the spots on their CCDs"
    if any(what.deformation is not None for what in resolved.job.perturb.values()):
        allowed += "; with a table of rippled nodes, a job without image quality and targets"
    text, value = f"the perturbed instrument cannot be rendered: {reason}", f"motions of {moved}"
    return resolved.job.error(text, ("perturb",), value=value, allowed=allowed)


def _no_spots(experiment: MonitorExperiment, reason: str) -> InputError:
    spec = experiment.resolved.instrument
    if spec.as_built:
        text = f"the monitor of the instrument as built does not work, even without a perturbation: {reason}"
        return InputError(next(iter(spec.as_built.values())).issue(text, allowed=_mounted_facets(experiment)))
    return spec.error(
        f"the monitor does not work as designed, even without a perturbation: {reason}",
        ("monitor",),
        allowed="prism widths, angle_errors, pupil_offset, return_face.aperture and a sharp camera with which the "
        "beams pass the prisms twice, and an area_ccd (rows, columns, pitch) that the spots fall on",
    )


def _mounted_facets(experiment: MonitorExperiment) -> str:
    """Return advice on how to mount the facets of an instrument as built so that its monitor works, as text."""
    instrument, advice = experiment.instrument, "bodies closer to their design positions"
    try:
        rotations = facet_alignment(instrument, experiment.backend)
    except (MisplacedError, *LOST):
        return advice
    bodies = {body.path: body for body in instrument.assembly.tree.bodies}
    positions = as_built_of(compose(instrument.as_built, rotations, bodies))
    aligned = perturbation_text({path: positions[path] for path in rotations})
    return f"{advice}; or facets aligned when mounted: {aligned}"


def _unmeasured(experiment: MonitorExperiment, before: np.ndarray, error: SpotError, focus: SpotFocus) -> InputError:
    """Return the error of a spot that cannot be measured.

    It says that the instrument is the cause if the spots before the change cannot be measured either.
    """
    channels, resolved = experiment.path.channels, experiment.resolved

    def what(error: SpotError) -> str:
        reasons = "; ".join(f"{channels[i % len(channels)].key}: {why}" for i, why in error.reasons.items())
        return f"a spot cannot be measured ({reasons})"

    try:
        mean, centroid = mean_of(before), resolved.job.analysis.centroid
        recover_monitor(mean, mean[None], experiment.calibration, centroid, frames=before.shape[-3])
    except SpotError as first:
        return _no_spots(experiment, "; ".join([what(first), *_blurred(experiment, focus)]))
    return _too_large(resolved, what(error))


def _blurred(experiment: MonitorExperiment, focus: SpotFocus) -> tuple[str, ...]:
    """Return a warning for each camera whose spots are out of focus in the design, which is probably a mistake."""
    warnings = []
    for name in experiment.instrument.cameras:
        indices = [i for i, channel in enumerate(experiment.path.channels) if channel.camera == name]
        worst = max(indices, key=lambda i: focus.error[i])
        if focus.error[worst] > SHARP:
            channel = experiment.path.channels[worst].name
            model = experiment.instrument.cameras[name]
            # image.z counts along the parent axis, +-Z of the focal plane
            shift = model.focal_plane.rotation[2, 2] * focus.defocus[worst]
            warnings.append(
                f"{name}: the spots of camera {model.spec.name} are out of focus as designed, "
                f"{focus.error[worst]:.2g} waves rms in channel {channel}; they are sharpest with image.z "
                f"changed by {1e3 * shift:+.3g} mm"
            )
    return tuple(warnings)


def _warnings(
    experiment: MonitorExperiment, nominal: np.ndarray, photons: np.ndarray, before: np.ndarray, after: np.ndarray
) -> tuple[str, ...]:
    """Return warnings about saturated pixels and lost light in the monitor's images."""
    warnings = []
    channels = experiment.path.channels
    for name, recorded in (("before", before), ("after", after)):
        saturated = experiment.detector.saturated(recorded)
        full = [c.key for c, pixels in zip(channels, np.ravel(saturated.pixels), strict=True) if pixels]
        if full:
            warnings.append(
                f"saturated pixels in the spots {', '.join(full)} ({name}): centroids are biased; reduce the light"
            )
    for i, channel in enumerate(channels):
        share = float(photons[i].sum() / nominal[i].sum())
        if share < MIN_LIGHT:
            warnings.append(f"{channel.key}: only {100 * share:.0f} % of the nominal light reaches the CCD")
    return tuple(warnings)
