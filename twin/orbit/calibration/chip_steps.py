"""How large a step between the CCDs of a line would have to be for the points at hand to show it, and whether they do.

A calibration takes the places of chips from the camera's file. Steps are looked for at the file's joints between chips,
in a line of one chip at its middle; they are no unknowns, and a step below the threshold stays in f, x and y unseen.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Self

import numpy as np
from scipy.stats import norm

from analysis.orbit.adjustment import Adjustment
from analysis.orbit.residual_tests import Steps
from twin.orbit.calibration.campaign import Campaign
from twin.run.artefact import Cell, Table

FALSE_ALARM = 1e-4
"""Of all steps of a run together."""


@dataclass(frozen=True)
class StepNumbers:
    """A step of x (along the track) or y within a line.

    Attributes:
        line: camera.
        axis: x or y.
        place_m: y of the joint in the focal plane.
        step_m: what the residuals say of it, of everything beyond the joint.
        sigma_m: of that, all steps together.
        seen_from_m: step that is told in half of all cases; None where the points tell none.
        found: whether this one is told, false alarm 1e-4 for all together.
    """

    line: str
    axis: str
    place_m: float
    step_m: float
    sigma_m: float | None
    seen_from_m: float | None
    found: bool

    @classmethod
    def of(cls, campaign: Campaign, together: Adjustment) -> tuple[Self, ...]:
        """Of all lines of a campaign, by the adjustment of all fields."""
        steps = Steps(_joints(campaign))
        unseen = together.unseen(steps)
        limit = float(norm.isf(0.5 * FALSE_ALARM / max(steps.size, 1)))
        found = []
        for k, (value, sigma) in enumerate(zip(unseen.estimate.tolist(), unseen.sigma.tolist(), strict=True)):
            line, place = steps.places[k // 2]
            told = bool(np.isfinite(sigma))
            found.append(
                cls(
                    line,
                    "xy"[k % 2],
                    place,
                    value if told else 0.0,
                    sigma if told else None,
                    limit * sigma if told else None,
                    told and abs(value) > limit * sigma,
                )
            )
        return tuple(found)


def _joints(campaign: Campaign) -> tuple[tuple[str, float], ...]:
    """(line, y) of the joints between chips; the middle of a line of one chip."""
    data = campaign.passes[0].data
    found = []
    for name in campaign.lines:
        ccds = () if data.lines is None else data.lines[name].ccds or ()
        pixels = [0.5 * (a.last + b.first) for a, b in pairwise(ccds)]
        pixels = pixels or [0.5 * (data.sensors[name].camera.pixels - 1)]
        found += [(name, float(y)) for y in data.places(name, np.array(pixels))[:, 1]]
    return tuple(found)


def steps_table(numbers: tuple[StepNumbers, ...]) -> Table:
    """What the points say, joint by joint, in micrometres."""
    rows: list[tuple[Cell, ...]] = [
        (
            n.line,
            n.axis,
            1e3 * n.place_m,
            1e6 * n.step_m,
            None if n.sigma_m is None else 1e6 * n.sigma_m,
            None if n.seen_from_m is None else 1e6 * n.seen_from_m,
        )
        for n in numbers
    ]
    return Table(
        "chip-steps",
        "Steps between chips that these points would show",
        "Steps are no unknowns: what the residuals say of one at each joint of the camera's file, at the middle of a "
        "line of one chip, micrometres. Seen from: told in half of all cases, one false alarm in 10 000 runs.",
        ("line", "axis", "at y [mm]", "step", "σ", "seen from"),
        rows,
        (None, None, 2, 2, 2, 2),
    )


def step_warnings(numbers: tuple[StepNumbers, ...]) -> list[str]:
    """Steps that the residuals show."""
    found = [n for n in numbers if n.found]
    if not found:
        return []
    listed = ", ".join(
        f"{n.line} {n.axis} {1e6 * n.step_m:+.1f} ± {1e6 * (n.sigma_m or 0.0):.1f} µm at {1e3 * n.place_m:.1f} mm"
        for n in found
    )
    return [f"residuals show a step within a line: {listed}; its chips lie otherwise than the camera's file says"]
