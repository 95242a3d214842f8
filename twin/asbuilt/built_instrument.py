"""Files of an instrument as built: the instrument itself, and the posterior covariance as a disturbances file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from optics.geometry.tree import WAVEFRONT, Motion
from scenes.models.disturbances import HEAT, Component, joint_disturbances, joint_files
from scenes.specs.instrument import as_built_file
from scenes.specs.load import CAMERAS, INSTRUMENTS, is_path, library_names
from twin.asbuilt.asbuilt_run import AsBuiltRun

POSTERIOR = "posterior"
"""Name of the disturbances file that holds the posterior covariance of the motions."""
CORRELATION = f"{POSTERIOR}_correlation"
"""Name of the table with the correlations of the posterior."""


def built_motions(run: AsBuiltRun) -> Mapping[str, Motion]:
    """Return the estimated motion of each body relative to the drawing, with all moves but without thermal effects."""
    values = run.estimate.mean.copy()
    for k, component in enumerate(run.bench.parameters.components):
        if component.kind in HEAT:
            values[k] = 0.0
    state = run.bench.parameters.states(values[None], run.bench.last)[0]
    return {body: motion for body, motion in state.items() if body not in WAVEFRONT}


def instrument_text(run: AsBuiltRun) -> str:
    """Return the instrument's file, which refers to the drawing and lists the motion of each body relative to it."""
    test, base = run.setup.test, run.setup.base.instrument.name
    design: str | dict[str, Any] = test.instrument
    if is_path(test.instrument):
        design = str((Path(test.source.file).parent / test.instrument).resolve())
    elif test.instrument not in (*library_names(INSTRUMENTS), *library_names(CAMERAS)):
        design = run.setup.base.instrument_file()
    return as_built_file(
        f"{base}_as_built",
        design,
        built_motions(run),
        f"./{POSTERIOR}.yaml",
        f"{base} as estimated from {', '.join(kind.name for kind in run.bench.kinds)}",
        "The instrument as built; every command accepts it as its instrument",
    )


def unknown(run: AsBuiltRun) -> tuple[list[Component], np.ndarray]:
    """Return the C uncertain components of bodies' motions and their posterior covariance (C, C), SI units.

    Thermal components and terms of the wavefront are omitted. Errors of actuator moves are added to the components of
    the bodies that were moved.
    """
    parameters, estimate = run.bench.parameters, run.estimate
    components = [c for c in parameters.components if c.kind not in HEAT and c.body not in WAVEFRONT]
    indices = {(component.body, component.kind, component.axis): k for k, component in enumerate(components)}
    rows: dict[int, np.ndarray] = {}
    for k, component in enumerate(parameters.components):
        if component in components:
            rows[indices[component.body, component.kind, component.axis]] = np.eye(len(estimate.mean))[k]
    tree = run.bench.experiment.instrument.assembly.tree

    def add(body: str, kind: str, axis: int, pivot: str, amount: np.ndarray) -> None:
        index = indices.setdefault((body, kind, axis), len(components))
        if index == len(components):
            components.append(Component("moves", body, kind, axis, pivot, 0.0))
        rows[index] = rows.get(index, np.zeros(len(estimate.mean))) + amount

    for k, number in enumerate(parameters.actuators):
        pull = _pull(run, k)
        if not np.any(pull):
            continue
        for body, move in number.moves.items():
            for axis in range(3):
                if move.shift[axis]:
                    add(body, "shift", axis, "origin", move.shift[axis] * pull)
                if move.rotate[axis]:
                    rotation_index = indices.get((body, "rotate", axis))
                    pivot = "origin" if rotation_index is None else components[rotation_index].pivot
                    add(body, "rotate", axis, pivot, move.rotate[axis] * pull)
                    offset = np.cross(
                        move.rotate[axis] * np.eye(3)[axis], np.array(tree[body].pivots[pivot]) - move.pivot
                    )
                    for other in np.flatnonzero(np.abs(offset) > 1e-12):
                        add(body, "shift", int(other), "origin", offset[other] * pull)
            for term, amount in move.figure.items():
                add(body, "figure", term, "origin", amount * pull)
            for kind in ("radius", "conic", "index"):
                if kind in move.shape:
                    add(body, kind, 0, "origin", move.shape[kind] * pull)
    table = np.stack([rows[k] for k in range(len(components))])
    spread = table @ estimate.spread
    return components, np.asarray(estimate.variance_factor * spread @ spread.T)


def _pull(run: AsBuiltRun, actuator: int) -> np.ndarray:
    """Return the derivatives of one actuator's total travel with respect to all estimated parameters, (K,).

    They are in SI units; K is the number of parameters.
    """
    parameters, last = run.bench.parameters, run.bench.last
    count = len(run.estimate.mean)
    if last is None:
        return np.zeros(count)
    steps = np.concatenate([np.zeros((1, count)), np.eye(count)])
    moved = parameters.moved(steps, last)[:, actuator]
    return np.asarray(moved[1:] - moved[0])


def posterior_files(run: AsBuiltRun) -> tuple[str, str | None]:
    """Return the text of the disturbances file of the posterior, and of its table of correlations, if any."""
    components, covariance = unknown(run)
    kinds = ", ".join(kind.name for kind in run.bench.kinds)
    spec = joint_disturbances(
        POSTERIOR,
        components,
        covariance,
        run.bench.experiment.instrument.nodes,
        f"posterior covariance of an estimate from {kinds}",
        f"Posterior uncertainty of {run.setup.base.instrument.name} as built.",
    )
    files = joint_files(spec, POSTERIOR, "Posterior uncertainty of the instrument as built")
    text = files[f"{POSTERIOR}.yaml"].replace(f"{POSTERIOR}.csv", f"{CORRELATION}.csv")
    return text, files.get(f"{POSTERIOR}.csv")
