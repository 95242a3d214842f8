"""Motions that a job perturbs, that change a camera and that no spot tells.

A body may move no spot at all, as the line CCD alone, or move the spots as all that is stated to move does together:
its motion is then read as something likelier, and the test of the shifts against the statement does not find it.
"""

from __future__ import annotations

import numpy as np

from analysis.chi_square import limit_of
from analysis.monitor.disturbances import FALSE_ALARM, Disturbances
from analysis.monitor.limits import quantities, split
from optics.geometry.tree import Motion
from scenes.models.job_state import motions_of
from twin.main_job.render_results import RenderRun
from twin.monitor.line_curvature import LOST, traced_states
from twin.run.artefact import significant
from twin.uncertainty.words import short_text, unit_text

__all__ = ["BLIND", "perturbed_unseen"]

BLIND = 4.0
"""Sigmas by which a reading is wrong from which on it is told that no spot says so. Of what is drawn from the statement
itself a motion does as much in one of 20 000 runs."""


def perturbed_unseen(run: RenderRun) -> tuple[str, ...]:
    """A warning for each perturbed body by which readings are wrong while the spots do not show it: what the
    perturbation of that body alone does to spots and cameras, traced, against what would be read of it.

    Args:
        run: of a state, or of the time of a course that is shown.
    """
    job, noise = run.resolved.job, run.recovery.shift_covariance[0]
    shown = None if run.series is None else run.series.shown
    if not np.any(noise):
        return ()
    moved = {path: motion for path, motion in motions_of(job, shown).items() if motion != Motion(pivot=motion.pivot)}
    if not moved:
        return ()
    try:
        found = traced_states(run.experiment.path, run.experiment.sight, [{path: m} for path, m in moved.items()])
    except LOST:
        # together with others the body may keep its light; alone there is nothing to be said
        return ()
    reading, stated = run.reading, run.reading.disturbances
    gain = run.gains[run.judged]
    every = quantities(reading.cameras, reading.ground)
    rows = np.stack([quantity.row for quantity in every])
    sigma = _sigmas(rows, stated, noise, gain)
    spread = noise if stated is None else stated.spot_covariance + noise
    limit = float(limit_of(FALSE_ALARM, len(noise))) - len(noise)
    out = []
    for path, shift, true in zip(moved, found.spots, found.parameters, strict=True):
        wrong = rows @ (gain @ shift - true)
        far = np.abs(wrong) / np.where(sigma > 0.0, sigma, np.inf)
        worst = int(np.argmax(far))
        still = float(np.max(np.abs(shift) / np.sqrt(np.diag(noise))))
        told = float(shift @ np.linalg.solve(spread, shift))
        if far[worst] < BLIND or (still > BLIND if stated is None else told > limit):
            continue
        how = "moves no spot beyond its noise" if still < 1.0 else "moves the spots as likelier motions do"
        unit = unit_text(every[worst])
        is_, read = (significant(float(rows[worst] @ value), 3) for value in (true, gain @ shift))
        out.append(
            f"{path}: what is perturbed of it {how}; {short_text(every[worst])} changes by {is_} {unit} and {read} "
            f"{unit} are read, wrong by {far[worst]:.1f} σ; neither σ nor a test of the shifts can show it: of this "
            "body σ holds as far as its statement does"
        )
    return tuple(out)


def _sigmas(rows: np.ndarray, stated: Disturbances | None, noise: np.ndarray, gain: np.ndarray) -> np.ndarray:
    """(Q,) of the readings by an estimator."""
    if stated is not None:
        return split(rows, stated, noise, gain).sigma
    return np.sqrt(np.einsum("qd,de,qe->q", rows @ gain, noise, rows @ gain))
