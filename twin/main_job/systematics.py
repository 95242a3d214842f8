"""What the crosstalk table says that the estimators must make of a run's motions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from analysis.monitor.disturbances import FALSE_ALARM, Disturbances
from analysis.monitor.limits import quantities, split
from analysis.monitor.parameters import rows_of
from analysis.statistics import limit_of
from optics.geometry.tree import Motion
from scenes.models.job_state import motions_of
from scenes.specs.instrument import BASE, CENTRAL_PRISM
from twin.framework.artefact import plain, shown_unit, significant
from twin.main_job.render_results import RenderRun
from twin.monitor.crosstalk import CameraCrosstalk
from twin.monitor.monitor_derivative import LOST, traced_states
from twin.monitor.motions import ElementaryMotion
from twin.uncertainty.monitor_limits import short_text, unit_text

_FAMILY = 4
"""The first motions of a crosstalk table are the family that the estimators of paper 001 assume."""
SHOWN = 1e-3
"""Least amount of a motion, in its table unit, that is spoken of."""


HEAT = "temperatures (expansion, bending, change of index)"
"""How the effects of temperatures are called; a table of motions of single bodies holds only their carried motions."""


@dataclass(frozen=True, eq=False)
class Systematics:
    """What the crosstalk tables make of a run's motions, for one camera.

    Attributes:
        bias: estimator -> (P,) reading minus truth, to first order, of every reading of the camera, in its unit.
        outside: motions of this camera outside the family, as text with amounts.
        parts: motion, as text with its amount -> its share of the judged estimator's bias, (P,); also motions of other
            cameras where that estimator takes all spots together.
        uncovered: what was moved but is in no row of the table.
    """

    bias: dict[str, np.ndarray]
    outside: tuple[str, ...]
    parts: dict[str, np.ndarray]
    uncovered: tuple[str, ...]


def systematics(run: RenderRun, camera: str) -> Systematics:
    """Sum the crosstalk tables over the motions of a run."""
    amounts = {
        name: np.array([_amount(run, motion) for motion in table.motions]) for name, table in run.crosstalk.items()
    }
    k = list(run.crosstalk).index(camera)
    rows = slice(4 * k, 4 * k + 4)
    moved = np.concatenate([table.spot_shift @ amounts[name] for name, table in run.crosstalk.items()])
    table = run.crosstalk[camera]
    true = table.true @ amounts[camera]
    unit = rows_of(run.reading.cameras[camera])
    bias = {e: unit @ (gain[rows] @ moved) - true for e, gain in run.gains.items()}
    others = [i for i in range(_FAMILY, len(table.motions)) if abs(amounts[camera][i]) > SHOWN]
    outside = tuple(_told(table.motions[i], amounts[camera][i]) for i in others)
    return Systematics(bias, outside, _parts(run, camera, amounts), _uncovered(run, camera, table))


def _parts(run: RenderRun, camera: str, amounts: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Error that each motion contributes, for motions that the judged estimator does not read as they are."""
    names = list(run.crosstalk)
    k = names.index(camera)
    gain = rows_of(run.reading.cameras[camera]) @ run.gains[run.judged][4 * k : 4 * k + 4]
    # what weighs all motions by what is stated takes none of them as it is
    known = 0 if run.estimators[run.judged].stated else _FAMILY
    out: dict[tuple[str, str, int], tuple[str, np.ndarray]] = {}
    own = {name: run.experiment.instrument.coordinates_of(name) for name in names}
    for name, table in run.crosstalk.items():
        for i, motion in enumerate(table.motions):
            if i < known or abs(amounts[name][i]) <= SHOWN:
                continue
            read = gain[:, own[name]] @ table.spot_shift[:, i]
            part = (read - (table.true[:, i] if name == camera else 0.0)) * amounts[name][i]
            if not np.any(part):
                continue
            # what both cameras look at stands in both tables
            key = (motion.body, motion.kind, motion.axis)
            told = _told(motion, amounts[name][i])
            told = told if name == camera or motion.body == CENTRAL_PRISM else f"{name}: {told}"
            before = out.get(key)
            out[key] = (told, part) if before is None else (before[0], before[1] + part)
    return dict(out.values())


def _told(motion: ElementaryMotion, amount: float) -> str:
    return f"{motion.label}, {plain(float(amount), 4)} {shown_unit(motion.unit)}"


def _amount(run: RenderRun, elementary: ElementaryMotion) -> float:
    """How much of an elementary motion the run's state holds, in its table unit; pivots converted to first order."""
    motion = run.state.get(elementary.body)
    if motion is None:
        return 0.0
    if elementary.kind == "shift":
        value = float(_shift_at(run, elementary.body, motion, elementary.pivot)[elementary.axis])
    else:
        value = motion.component(elementary.kind, elementary.axis)
    return value / elementary.unit_size


def _shift_at(run: RenderRun, body: str, motion: Motion, pivot: str) -> np.ndarray:
    """The shift, metres, that makes the same rotation and scale about another pivot the same motion to first order."""
    pivots = next(b for b in run.experiment.instrument.assembly.tree.bodies if b.path == body).pivots
    arm = np.array(pivots[motion.pivot]) - np.array(pivots[pivot])
    return np.asarray(np.array(motion.shift) - np.cross(motion.rotate, arm) - motion.scale * arm)


def _uncovered(run: RenderRun, camera: str, table: CameraCrosstalk) -> tuple[str, ...]:
    """Bodies that moved, reach this camera and have no row in the table."""
    own = f"{BASE}/{camera}"
    bodies = {motion.body for motion in table.motions}
    out = []
    given = run.resolved.job.perturb
    for path, motion in run.state.items():
        if path not in (own, CENTRAL_PRISM) and not path.startswith((f"{own}/", f"{CENTRAL_PRISM}/{camera}_")):
            continue
        deformed = path in given and given[path].deformation is not None
        if (motion.stretch and not deformed) or motion.index or any(motion.index_gradient):
            out.append(HEAT)
        if path not in given:
            continue
        if path not in bodies and (any(motion.rotate) or any(motion.shift) or motion.scale):
            out.append(path)
        if given[path].heat.table is not None:
            continue
        covered = {m.axis for m in table.motions if m.body == path and m.kind == "figure"}
        missing = [f"Z{j}" for j, amplitude in motion.figure.items() if amplitude and j not in covered]
        if deformed:
            missing = ["of a table of nodes"]
        if missing:
            out.append(f"{path} (figure {', '.join(missing)})")
    return tuple(out)


def joined(names: Sequence[str]) -> str:
    """``a; b; c`` without repetitions."""
    return "; ".join(dict.fromkeys(names))


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
