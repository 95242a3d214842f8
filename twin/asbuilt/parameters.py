"""Parameters of an as-built estimate: the motions of the prior, and response and errors of the actuators.

A parameter vector holds the components of the prior (motions and temperatures of bodies), then one gain error for each
actuator whose response is uncertain (travel divided by commanded amount, minus 1), then one error for each actuator of
each move. The state at a time is the sum of the components and of all moves until then.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from analysis.instrument_state.state_estimate import StatePrior
from optics.geometry.tree import WAVEFRONT, State
from optics.numerics.number_tree import FrozenMap
from optics.thermal.heat import Temperature
from scenes.models.disturbances import HEAT, Component, DisturbancePrior
from scenes.models.instrument_model import Instrument
from scenes.models.thermal_model import ThermalModel
from scenes.specs.asbuilt import AsBuiltSpec, WavefrontPriorSpec
from scenes.specs.course import noll
from scenes.specs.disturbances import TimeLawSpec
from scenes.specs.perturbation import short_name
from scenes.specs.tolerance import amount_si
from twin.tolerance.variations import BodyMove, ParameterMaker, VariedParameter, heat_moves, states_of


@dataclass(frozen=True, eq=False)
class Parameters:
    """Parameters of an as-built estimate.

    Array dimensions: M components, J moves, C actuators.

    Attributes
    ----------
    disturbances : DisturbancePrior
        Prior of the M components (motions and temperatures of bodies).
    words : tuple of str
        Description of each component with the shortest name of its body, (M,).
    numbers : tuple of VariedParameter
        Effect of one SI unit of each component.
    actuators : tuple of VariedParameter
        Effect of one SI unit of each of the C actuators.
    names : tuple of str
        Names of the actuators.
    gains : tuple of int
        Indices of the actuators whose response (travel divided by commanded amount) is uncertain.
    gain_sigmas : ndarray
        Standard deviations of their responses, relative.
    moves : tuple of str
        Names of the moves.
    wanted : (J, C) ndarray
        Commanded amount of each move, SI units.
    errors : tuple of tuple
        Indices (move, actuator) of each error of a move.
    error_sigmas : ndarray
        Standard deviations of these errors, SI units.
    """

    disturbances: DisturbancePrior
    words: tuple[str, ...]
    numbers: tuple[VariedParameter, ...]
    actuators: tuple[VariedParameter, ...]
    names: tuple[str, ...]
    gains: tuple[int, ...]
    gain_sigmas: np.ndarray
    moves: tuple[str, ...]
    wanted: np.ndarray
    errors: tuple[tuple[int, int], ...]
    error_sigmas: np.ndarray

    @classmethod
    def of(
        cls, test: AsBuiltSpec, prior: DisturbancePrior, instrument: Instrument, thermal: ThermalModel
    ) -> Parameters:
        """Return the parameters to be estimated in a test.

        Raises
        ------
        InputError
            The body of an actuator does not exist or does not allow its motion.
        """
        actuators = tuple(
            ParameterMaker(test, instrument, thermal).compensator(name, entry, "actuators")
            for name, entry in test.actuators.items()
        )
        names = tuple(test.actuators)
        wanted = np.zeros((len(test.moves), len(names)))
        errors, sigmas = [], []
        for j, move in enumerate(test.moves.values()):
            for name, amount in move.by.items():
                k, entry = names.index(name), test.actuators[name]
                wanted[j, k] = amount_si(amount, entry.parts[1])
                errors.append((j, k))
                sigmas.append(np.hypot(entry.move_error * wanted[j, k], entry.accuracy_si))
        gains = tuple(k for k, entry in enumerate(test.actuators.values()) if entry.response > 0.0)
        return cls(
            prior,
            tuple(_words(entry, instrument) for entry in prior.components),
            component_parameters(prior.components, instrument, thermal),
            actuators,
            names,
            gains,
            np.array([test.actuators[names[k]].response for k in gains]),
            tuple(test.moves),
            wanted,
            tuple(errors),
            np.array(sigmas),
        )

    @property
    def components(self) -> tuple[Component, ...]:
        """Components of the prior: motions and temperatures of bodies."""
        return self.disturbances.components

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of all parameters, in the order of the parameter vector."""
        return (
            *self.words,
            *(f"response of {self.names[k]}" for k in self.gains),
            *(f"error of {self.moves[j]} {self.names[k]}" for j, k in self.errors),
        )

    @property
    def prior(self) -> StatePrior:
        """Prior mean and covariance of all estimated parameters."""
        count, rest = len(self.components), np.concatenate([self.gain_sigmas, self.error_sigmas])
        covariance = np.zeros((count + len(rest), count + len(rest)))
        covariance[:count, :count] = self.disturbances.covariance
        covariance[count:, count:] = np.diag(rest**2)
        return StatePrior.of(self.labels, covariance)

    def moved(self, values: np.ndarray, after: str | None) -> np.ndarray:
        """Return the total travel of C actuators in S states, (S, C), SI units.

        Parameters
        ----------
        values : (S, K) ndarray
            K parameters of each state.
        after : str, optional
            Name of the last move that was made; None before the first.
        """
        out = np.zeros((len(values), len(self.names)))
        if after is None or not self.moves:
            return out
        last = self.moves.index(after)
        out += np.sum(self.wanted[: last + 1], axis=0) * self.gain(values)
        start = len(self.components) + len(self.gains)
        for e, (j, k) in enumerate(self.errors):
            if j <= last:
                out[:, k] += values[:, start + e]
        return out

    def gain(self, values: np.ndarray) -> np.ndarray:
        """Return the ratio of travel to commanded amount for C actuators in S states, (S, C); 1 where it is certain."""
        out = np.ones((len(values), len(self.names)))
        start = len(self.components)
        out[:, list(self.gains)] += values[:, start : start + len(self.gains)]
        return out

    def states(self, values: np.ndarray, after: str | None, further: np.ndarray | None = None) -> list[State]:
        """Return the states of the instrument for S sets of parameters, after the moves made until then.

        Parameters
        ----------
        values : (S, K) ndarray
            K parameters of each state.
        after : str, optional
            Name of the last move that was made; None before the first.
        further : (C,) or (S, C) ndarray, optional
            Commanded amounts of a further move of C actuators, SI units.
        """
        moved = self.moved(values, after)
        if further is not None:
            moved = moved + further * self.gain(values)
        amounts = np.concatenate([values[:, : len(self.components)], moved], axis=1)
        return states_of((*self.numbers, *self.actuators), amounts)

    def temperatures(self, values: np.ndarray, bodies: Sequence[str]) -> np.ndarray:
        """Return the temperatures of the named bodies above nominal, (S, bodies) for S states, kelvin.

        A body without its own temperature has that of the nearest body that carries it.
        """
        out = np.zeros((len(values), len(bodies)))
        heated = {component.body for component in self.components if component.kind == "temperature"}
        for b, body in enumerate(bodies):
            above = next((path for path in _upward(body) if path in heated), None)
            for k, component in enumerate(self.components):
                if component.kind == "temperature" and component.body == above:
                    out[:, b] += values[:, k]
        return out


def with_wavefront(prior: DisturbancePrior, spec: WavefrontPriorSpec | None) -> DisturbancePrior:
    """Return a prior with the Zernike terms of the wavefront at the exit pupil as further components."""
    if spec is None:
        return prior
    parts = zip(WAVEFRONT, (spec.constant, spec.linear, spec.linear), strict=True)
    terms = tuple(
        Component("wavefront", key, "figure", noll(term), "origin", sigma)
        for key, sigmas in parts
        for term, sigma in sigmas.items()
    )
    laws = (*prior.laws, *[TimeLawSpec(kind="constant")] * len(terms))
    correlation = block_diag(prior.correlation, np.eye(len(terms)))
    return replace(prior, components=(*prior.components, *terms), correlation=correlation, laws=laws)


def _words(component: Component, instrument: Instrument) -> str:
    if component.body in WAVEFRONT:
        return f"{component.body} Z{component.axis}"
    return f"{short_name(component.body, instrument.nodes)} {component.what}"


def _upward(path: str) -> list[str]:
    parts = path.split("/")
    return ["/".join(parts[:n]) for n in range(len(parts), 0, -1)]


def component_parameters(
    components: Sequence[Component], instrument: Instrument, thermal: ThermalModel
) -> tuple[VariedParameter, ...]:
    """Return the effect of one SI unit of each component of a prior, thermal ones to the first order.

    Parameters
    ----------
    components : sequence of Component
        Components of one prior; a body with its own temperature does not follow the body that carries it.
    instrument : Instrument
        Instrument with the bodies.
    thermal : ThermalModel
        Thermal model of the instrument.
    """
    warm = {component.body: Temperature() for component in components if component.kind in HEAT}
    return tuple(
        VariedParameter(c.name, c.name, c.kind, c.sigma, _does(c, instrument, thermal, warm)) for c in components
    )


def _does(
    component: Component, instrument: Instrument, thermal: ThermalModel, warm: Mapping[str, Temperature]
) -> FrozenMap[str, BodyMove]:
    if component.kind in HEAT:
        return heat_moves(thermal, instrument, component.body, component.kind, component.axis, component.sigma, warm)
    if component.kind == "figure":
        return FrozenMap({component.body: BodyMove(figure=FrozenMap({component.axis: 1.0}))})
    axis = np.eye(3)[component.axis] if component.kind in ("shift", "rotate") else np.zeros(3)
    about = np.array(instrument.assembly.tree[component.body].pivots[component.pivot])
    match component.kind:
        case "shift":
            move = BodyMove(shift=axis)
        case "rotate":
            move = BodyMove(rotate=axis, pivot=about)
        case "scale":
            move = BodyMove(shift=-about, shape=FrozenMap({"scale": 1.0}))
        case kind:
            move = BodyMove(shape=FrozenMap({kind: 1.0}))
    return FrozenMap({component.body: move})
