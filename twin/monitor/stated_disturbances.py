"""What stated disturbances do to the monitor's spots and to the cameras, by the traced instrument."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from analysis.monitor.disturbances import Disturbances, TimeLaw
from optics.numerics.backend import Backend
from scenes.models.disturbances import Component, StatedMotions, state_of
from scenes.models.instrument_model import Instrument
from scenes.models.thermal_model import ThermalModel
from scenes.specs.disturbances import TimeLawSpec
from twin.monitor.monitor_derivative import spot_jacobian
from twin.monitor.monitor_path import MonitorPath
from twin.monitor.motions import ElementaryMotion
from twin.monitor.truth import trace_truth, truth_jacobian

STEPS = {"temperature": 0.1, "gradient": 0.1, "index_gradient": 1e-6}
"""Half steps of the central differences, SI: spots move by some tenths of a pixel, where they are linear to 1e-6."""


def disturbances_of(
    stated: StatedMotions, path: MonitorPath, thermal: ThermalModel, instrument: Instrument, backend: Backend
) -> Disturbances:
    """Stated motions with their derivatives, as the analysis takes them.

    Rigid motions, growth and figures are differentiated by automatic differentiation as all others of this program
    are; temperatures and gradients of indices by central differences of the traced spots, since they reach light by
    many bodies at once.

    Args:
        stated: the motions.
        path: the monitor's light.
        thermal: of the instrument.
        instrument: nominal.
        backend: where to trace.

    Raises:
        AimError, BeamMissedError: a step of a temperature loses the light.
    """
    spots = np.empty((2 * len(path.channels), len(stated.components)))
    parameters = np.empty((4 * len(instrument.cameras), len(stated.components)))
    moved = [k for k, c in enumerate(stated.components) if c.kind not in STEPS]
    if moved:
        motions = [_elementary(stated.components[k]) for k in moved]
        spots[:, moved] = spot_jacobian(path, motions).reshape(-1, len(moved))
        parameters[:, moved] = np.concatenate(list(truth_jacobian(instrument, backend, motions).values()))
    stepped = [k for k, c in enumerate(stated.components) if c.kind in STEPS]
    if stepped:
        own = [stated.components[k] for k in stepped]
        spots[:, stepped], parameters[:, stepped] = _by_differences(own, path, thermal, instrument, backend)
    sigma = stated.sigma
    return Disturbances(
        name=stated.name,
        labels=tuple(c.name for c in stated.components),
        bodies=tuple(c.body for c in stated.components),
        causes=tuple(c.cause for c in stated.components),
        sigmas=np.array([c.sigma / c.unit_size for c in stated.components]),
        units=tuple(c.unit for c in stated.components),
        spots=spots * sigma,
        parameters=parameters * sigma,
        correlation=stated.correlation,
        laws=tuple(_law(law) for law in stated.laws),
    )


def _elementary(component: Component) -> ElementaryMotion:
    return ElementaryMotion(component.body, component.kind, component.axis, component.pivot, component.name)


def _by_differences(
    components: Sequence[Component],
    path: MonitorPath,
    thermal: ThermalModel,
    instrument: Instrument,
    backend: Backend,
) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives of spots (2 C, M), px, and parameters (4 K, M) per SI unit."""
    steps = np.array([STEPS[c.kind] for c in components])
    # all bodies have a temperature of their own in every state, as in states that are drawn, so that none inherits one
    states = [state_of(row, components, thermal) for row in np.concatenate([np.diag(steps), np.diag(-steps)])]
    place = path.coarse_trace(states).place
    count = len(components)
    rows = np.moveaxis(place, 1, 2).reshape(-1, 2 * count)
    truth = trace_truth(instrument, backend, states)
    changes = [np.stack([c.d_alpha, c.d_beta, c.d_gamma, c.d_f]) for c in truth.cameras.values()]
    both = np.concatenate(changes)
    return (rows[:, :count] - rows[:, count:]) / (2.0 * steps), (both[:, :count] - both[:, count:]) / (2.0 * steps)


def _law(law: TimeLawSpec) -> TimeLaw:
    return TimeLaw(law.kind == "white", law.drift, law.period)
