"""``python -m twin.uncertainty``: what limits an instrument's monitor, and whether the sigmas hold in random states."""

from __future__ import annotations

from dataclasses import dataclass, field

from optics.numerics.backend import Backend
from scenes.models.camera_sharpness import blur_warnings
from scenes.specs.resolved import ResolvedJob
from scenes.yaml.errors import InputError, Issue
from twin.monitor.image_sampling import ImageChecks
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.run.procedure import Advance, silent
from twin.sensors.area_detector import coarse_warnings
from twin.uncertainty.coverage import Coverage, run_states
from twin.uncertainty.monitor_limits import MonitorLimits, expected_covariance, find_limits
from twin.uncertainty.words import unseen_texts

SPREAD = "what is stated to move"
"""A part of the work."""


@dataclass(frozen=True, eq=False)
class UncertaintyRun:
    """What was found.

    Attributes:
        resolved: the job with everything it names.
        limits: of its instrument under its disturbances.
        seed: of the random states.
        coverage: of the random states, None if none were asked for.
        warnings: blurred cameras, coarse grey values, and stated motions that no spot sees.
        images: what the checks of its images found.
    """

    resolved: ResolvedJob
    limits: MonitorLimits
    seed: int
    coverage: Coverage | None = None
    warnings: tuple[str, ...] = ()
    images: ImageChecks = field(default_factory=ImageChecks)


def run_uncertainty(
    resolved: ResolvedJob, backend: Backend, states: int = 0, advance: Advance = silent
) -> UncertaintyRun:
    """Work out what limits the readings of a job's instrument; what the job does to it is not looked at.

    Args:
        resolved: the job, with its seed and its number of frames.
        backend: where to trace.
        states: how many random states are drawn, rendered and recovered.
        advance: told what is being done.

    Raises:
        InputError: nothing is stated to move, or what is stated cannot be.
    """
    if resolved.disturbances is None:
        raise InputError(
            Issue(
                "nothing is stated to move, so that nothing can be said but the noise",
                allowed="`disturbances: NAME` in the job or the instrument, or --disturbances NAME",
            )
        )
    advance(SPREAD, 0, 1)
    experiment = MonitorExperiment(resolved, backend)
    noise = expected_covariance(experiment, resolved.frames)
    limits = find_limits(experiment, noise, resolved.frames, second_monitor=True)
    if limits is None:
        raise InputError(
            Issue(
                "nothing that is stated to move changes a camera, so that there is nothing to be measured",
                found=str(resolved.disturbances.name),
                allowed="disturbances of cameras, their mirrors or focal planes",
            )
        )
    advance(SPREAD, 1, 1)
    seed, coverage = resolved.job.render.seed, None
    if states:
        coverage = run_states(experiment, limits.quantities, states, resolved.frames, seed, advance)
    hidden = unseen_texts(limits.stated, noise, limits.quantities, limits.gain)
    given = (*blur_warnings(resolved, backend), *coarse_warnings(resolved))
    return UncertaintyRun(resolved, limits, seed, coverage, (*given, *hidden), experiment.path.checked)
