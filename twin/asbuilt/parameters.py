"""What is estimated of an instrument: the motions of its prior, and what its actuators made of each move.

A parameter vector holds the components of the prior, then one gain error for each actuator whose response is in doubt,
then one error for each actuator of each move. A state at a time is the sum of the components and of all moves until
then.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from analysis.instrument_state.state_estimate import StatePrior
from optics.geometry.tree import State
from optics.numerics.number_tree import FrozenMap
from optics.thermal.heat import Temperature
from scenes.models.disturbances import HEAT, Component, StatedMotions
from scenes.models.instrument_model import Instrument
from scenes.models.thermal_model import ThermalModel
from scenes.specs.asbuilt import AsBuiltSpec
from scenes.specs.motion_text import short_name
from scenes.specs.tolerance import amount_si
from twin.tolerance.variations import BodyMove, VariedNumber, actuator_number, heat_moves, states_of


@dataclass(frozen=True, eq=False)
class Parameters:
    """All that is estimated.

    Attributes
    ----------
    stated : StatedMotions
        The prior's components, M.
    words : tuple[str, ...]
        What each is called, with the shortest name of its body, (M,).
    numbers : tuple[VariedNumber, ...]
        What one SI unit of each component does.
    actuators : tuple[VariedNumber, ...]
        What one SI unit of each actuator does, C.
    names : tuple[str, ...]
        Of the actuators.
    gains : tuple[int, ...]
        Numbers of the actuators whose response is in doubt.
    gain_sigmas : np.ndarray
        Of those, shares.
    moves : tuple[str, ...]
        Names of the moves.
    wanted : np.ndarray
        What each move was meant to be, (J, C), SI.
    errors : tuple[tuple[int, int], ...]
        (move, actuator) of each error of a move.
    error_sigmas : np.ndarray
        Of those, SI.
    """

    stated: StatedMotions
    words: tuple[str, ...]
    numbers: tuple[VariedNumber, ...]
    actuators: tuple[VariedNumber, ...]
    names: tuple[str, ...]
    gains: tuple[int, ...]
    gain_sigmas: np.ndarray
    moves: tuple[str, ...]
    wanted: np.ndarray
    errors: tuple[tuple[int, int], ...]
    error_sigmas: np.ndarray

    @classmethod
    def of(cls, test: AsBuiltSpec, stated: StatedMotions, instrument: Instrument, thermal: ThermalModel) -> Parameters:
        """Parameters of a test.

        Raises
        ------
        InputError
            An actuator of a body that is not there, or that does not move so.
        """
        actuators = tuple(actuator_number(test, instrument, thermal, name, one) for name, one in test.actuators.items())
        names = tuple(test.actuators)
        wanted = np.zeros((len(test.moves), len(names)))
        errors, sigmas = [], []
        for j, move in enumerate(test.moves.values()):
            for name, amount in move.by.items():
                k, one = names.index(name), test.actuators[name]
                wanted[j, k] = amount_si(amount, one.parts[1])
                errors.append((j, k))
                sigmas.append(np.hypot(one.move_error * wanted[j, k], one.accuracy_si))
        gains = tuple(k for k, one in enumerate(test.actuators.values()) if one.response > 0.0)
        return cls(
            stated,
            tuple(f"{short_name(one.body, instrument.nodes)} {one.what}" for one in stated.components),
            component_numbers(stated.components, instrument, thermal),
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
        """Components of the prior."""
        return self.stated.components

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of all parameters."""
        return (
            *self.words,
            *(f"response of {self.names[k]}" for k in self.gains),
            *(f"error of {self.moves[j]} {self.names[k]}" for j, k in self.errors),
        )

    @property
    def prior(self) -> StatePrior:
        """Of all parameters."""
        count, rest = len(self.components), np.concatenate([self.gain_sigmas, self.error_sigmas])
        covariance = np.zeros((count + len(rest), count + len(rest)))
        covariance[:count, :count] = self.stated.covariance
        covariance[count:, count:] = np.diag(rest**2)
        return StatePrior.of(self.labels, covariance)

    def moved(self, values: np.ndarray, after: str | None) -> np.ndarray:
        """What the actuators have come to in states of parameters (S, K), (S, C), SI.

        Parameters
        ----------
        values : np.ndarray
            The parameters.
        after : str | None
            Name of the last move that was made; None for none.
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
        """Response of each actuator over the traced one, (S, C)."""
        out = np.ones((len(values), len(self.names)))
        start = len(self.components)
        out[:, list(self.gains)] += values[:, start : start + len(self.gains)]
        return out

    def states(self, values: np.ndarray, after: str | None, further: np.ndarray | None = None) -> list[State]:
        """States of the instrument.

        Parameters
        ----------
        values : np.ndarray
            Parameters, (S, K).
        after : str | None
            Name of the last move that was made; None for none.
        further : np.ndarray | None
            What is moved beyond that, as it is meant, (C,) or (S, C), SI.
        """
        moved = self.moved(values, after)
        if further is not None:
            moved = moved + further * self.gain(values)
        amounts = np.concatenate([values[:, : len(self.components)], moved], axis=1)
        return states_of((*self.numbers, *self.actuators), amounts)

    def temperatures(self, values: np.ndarray, bodies: Sequence[str]) -> np.ndarray:
        """Temperatures of bodies above nominal, (S, bodies), kelvin: their own, or of what carries them."""
        out = np.zeros((len(values), len(bodies)))
        own = {component.body for component in self.components if component.kind == "temperature"}
        for b, body in enumerate(bodies):
            above = next((path for path in _upward(body) if path in own), None)
            for k, component in enumerate(self.components):
                if component.kind == "temperature" and component.body == above:
                    out[:, b] += values[:, k]
        return out


def _upward(path: str) -> list[str]:
    parts = path.split("/")
    return ["/".join(parts[:n]) for n in range(len(parts), 0, -1)]


def component_numbers(
    components: Sequence[Component], instrument: Instrument, thermal: ThermalModel
) -> tuple[VariedNumber, ...]:
    """What one SI unit of each component of a prior does, heat to the first order about none.

    Parameters
    ----------
    components : Sequence[Component]
        Of one statement; a body with a temperature of its own does not follow what carries it.
    instrument : Instrument
        Whose bodies move.
    thermal : ThermalModel
        What heat does to it.
    """
    warm = {component.body: Temperature() for component in components if component.kind in HEAT}
    return tuple(
        VariedNumber(one.name, one.name, one.kind, one.sigma, _does(one, instrument, thermal, warm))
        for one in components
    )


def _does(
    one: Component, instrument: Instrument, thermal: ThermalModel, warm: Mapping[str, Temperature]
) -> FrozenMap[str, BodyMove]:
    if one.kind in HEAT:
        return heat_moves(thermal, instrument, one.body, one.kind, one.axis, one.sigma, warm)
    axis = np.eye(3)[one.axis] if one.kind in ("shift", "rotate") else np.zeros(3)
    about = np.array(instrument.assembly.tree[one.body].pivots[one.pivot])
    match one.kind:
        case "shift":
            move = BodyMove(shift=axis)
        case "rotate":
            move = BodyMove(rotate=axis, pivot=about)
        case "figure":
            move = BodyMove(figure=FrozenMap({one.axis: 1.0}))
        case "scale":
            move = BodyMove(shift=-about, shape=FrozenMap({"scale": 1.0}))
        case kind:
            move = BodyMove(shape=FrozenMap({kind: 1.0}))
    return FrozenMap({one.body: move})
