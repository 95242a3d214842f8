"""What the crosstalk table says that the estimators must make of a run's motions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from analysis.monitor.estimators import ESTIMATORS
from optics.geometry.tree import Motion
from scenes.specs.channel import BASE, CENTRAL_PRISM
from twin.main_job.render_results import RenderRun
from twin.monitor.crosstalk import CameraCrosstalk
from twin.monitor.motions import ElementaryMotion
from twin.run.artefact import plain, shown_unit

FAMILY = 4
"""The first motions of a crosstalk table are the family that the estimators assume."""
SHOWN = 1e-3
"""Least amount of a motion, in its table unit, that is spoken of."""


HEAT = "temperatures (expansion, bending, change of index)"
"""How the effects of temperatures are called; a table of motions of single bodies holds only their carried motions."""


@dataclass(frozen=True, eq=False)
class Systematics:
    """What the crosstalk table makes of a run's motions, for one camera.

    Attributes:
        bias: estimator -> (4,) reading minus truth, to first order, in the units of the results.
        outside: motions of this run outside the family, as text with amounts.
        parts: of each of these its share of the model's bias, (4,).
        uncovered: what was moved but is in no row of the table.
    """

    bias: dict[str, np.ndarray]
    outside: tuple[str, ...]
    parts: tuple[np.ndarray, ...]
    uncovered: tuple[str, ...]


def systematics(run: RenderRun, camera: str) -> Systematics:
    """Sum the crosstalk table over the motions of a run."""
    table = run.crosstalk[camera]
    amounts = np.array([_amount(run, motion) for motion in table.motions])
    bias = {e: (table.readings[e] - table.true) @ amounts for e in ESTIMATORS}
    others = [k for k in range(FAMILY, len(amounts)) if abs(amounts[k]) > SHOWN]
    names = [(table.motions[k], plain(float(amounts[k]), 4)) for k in others]
    outside = tuple(f"{motion.label}, {amount} {shown_unit(motion.unit)}" for motion, amount in names)
    wrong = table.readings["model"] - table.true
    parts = tuple(wrong[:, k] * amounts[k] for k in others)
    return Systematics(bias, outside, parts, _uncovered(run, camera, table))


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
        if motion.stretch or motion.index or any(motion.index_gradient):
            out.append(HEAT)
        if path not in given:
            continue
        if path not in bodies and (any(motion.rotate) or any(motion.shift) or motion.scale):
            out.append(path)
        covered = {m.axis for m in table.motions if m.body == path and m.kind == "figure"}
        missing = [f"Z{j}" for j, amplitude in motion.figure.items() if amplitude and j not in covered]
        if missing:
            out.append(f"{path} (figure {', '.join(missing)})")
    return tuple(out)


def joined(names: Sequence[str]) -> str:
    """``a; b; c`` without repetitions."""
    return "; ".join(dict.fromkeys(names))
