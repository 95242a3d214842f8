"""The main job: perturb, render, detect, recover, compare."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from analysis.recovery import Recovery, recover
from analysis.spot_positions import SpotError
from optics.aim import AimError
from optics.backend import Backend
from optics.trace import BeamMissedError
from scenes.errors import InputError
from scenes.job import check_nodes
from scenes.resolved import ResolvedJob
from twin.crosstalk import crosstalk
from twin.experiment import MonitorExperiment
from twin.results import RenderRun
from twin.truth import trace_truth

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

MIN_LIGHT = 0.5
"""Share of the nominal light on a CCD below which the user is warned: vignetting, or a spot that leaves the CCD."""

Progress = Callable[[str], None]


def render_job(
    resolved: ResolvedJob,
    backend: Backend,
    frames: int | None = None,
    seed: int | None = None,
    progress: Progress = lambda stage: None,
) -> RenderRun:
    """Run a job.

    Args:
        resolved: the job.
        backend: where to trace.
        frames: per state; overrides the job's.
        seed: of all noise; overrides the job's.
        progress: called with each of STAGES when it begins.

    Raises:
        InputError: an unknown node, or a perturbation so large that light misses the mirrors or a spot its CCD.
    """
    count = resolved.frames if frames is None else frames
    number = resolved.job.render.seed if seed is None else seed
    # the run's config.yaml has to repeat the run, overrides included
    resolved = resolved.with_render(count, number)
    progress(STAGES[0])
    experiment = MonitorExperiment(resolved, backend)
    check_nodes(resolved.job, experiment.instrument.nodes)
    progress(STAGES[1])
    state = experiment.state(resolved.job)
    try:
        progress(STAGES[2])
        truth = trace_truth(experiment.instrument, backend, [state])
        progress(STAGES[3])
        calibration = experiment.calibration
        progress(STAGES[4])
        nominal = experiment.nominal_photons
        photons = experiment.path.expected_photons([state])
    except (AimError, BeamMissedError) as error:
        raise _too_large(resolved, str(error)) from error
    progress(STAGES[5])
    before = experiment.frames_before(count, number)
    after = experiment.frames_after(photons, count, number)
    progress(STAGES[6])
    try:
        recovery = recover(before, after, calibration, resolved.job.analysis.centroid)
    except SpotError as error:
        channels = experiment.path.channels
        reasons = "; ".join(f"{channels[i % len(channels)].key}: {reason}" for i, reason in error.reasons.items())
        raise _too_large(resolved, f"a spot cannot be measured ({reasons})") from error
    progress(STAGES[7])
    tables = crosstalk(experiment, _covariances(recovery))
    return RenderRun(
        resolved=resolved,
        experiment=experiment,
        state=state,
        frames=count,
        seed=number,
        truth=truth,
        photons_before=nominal,
        photons_after=photons[0],
        before=before,
        after=after[0],
        recovery=recovery,
        crosstalk=tables,
        warnings=_warnings(experiment, resolved, nominal, photons[0], before, after[0]),
    )


def _covariances(recovery: Recovery) -> dict[str, np.ndarray]:
    return {name: recovery.shift_covariance[0, k] for k, name in enumerate(recovery.parameters)}


def _too_large(resolved: ResolvedJob, reason: str) -> InputError:
    moved = ", ".join(resolved.job.perturb) or "nothing"
    return resolved.job.error(
        f"the perturbed instrument cannot be rendered: {reason}",
        ("perturb",),
        found=f"motions of {moved}",
        allowed="motions that keep the beams on the mirrors and the spots on their CCDs; make them smaller",
    )


def _warnings(
    experiment: MonitorExperiment,
    resolved: ResolvedJob,
    nominal: np.ndarray,
    photons: np.ndarray,
    before: np.ndarray,
    after: np.ndarray,
) -> tuple[str, ...]:
    """What the user should know before using the numbers."""
    out = []
    channels = experiment.path.channels
    for name, recorded in (("before", before), ("after", after)):
        saturated = experiment.detector.saturated(recorded)
        bad = [c.key for c, pixels in zip(channels, np.ravel(saturated.pixels), strict=True) if pixels]
        if bad:
            out.append(
                f"saturated pixels in the spots {', '.join(bad)} ({name}): centroids are biased; reduce the light"
            )
    for i, channel in enumerate(channels):
        share = float(photons[i].sum() / nominal[i].sum())
        if share < MIN_LIGHT:
            out.append(f"{channel.key}: only {100 * share:.0f}% of the nominal light reaches the CCD")
    return tuple(out)
