"""The files of an instrument as built: the instrument itself, and what is still unknown of it."""

from __future__ import annotations

from collections.abc import Mapping

from optics.geometry.tree import Motion
from scenes.models.disturbances import HEAT
from twin.asbuilt.asbuilt_run import AsBuiltRun


def built_motions(run: AsBuiltRun) -> Mapping[str, Motion]:
    """Body -> how it stands against the drawing, as estimated, with all moves that were made and without heat."""
    values = run.found.mean.copy()
    for k, one in enumerate(run.bench.parameters.components):
        if one.kind in HEAT:
            values[k] = 0.0
    return run.bench.parameters.states(values[None], run.bench.last)[0]


def instrument_text(run: AsBuiltRun) -> str:
    """The instrument's file."""
    return "# later\n"


def posterior_text(run: AsBuiltRun) -> str:
    """The disturbances file of what is still unknown."""
    return "# later\n"
