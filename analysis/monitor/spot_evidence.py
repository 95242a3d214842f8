"""What the fits of all spots of a measurement say together: does sigma hold, by how much was it widened, and why.

Three causes make spots differ from the fit, and the place of the difference separates them. Noise that differs from
the data sheet is in every pixel of every frame, a changed shape in the core of a spot alone, and a wrongly calibrated
shape in the spots before as in those after.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.arrays import Array
from analysis.spots.likelihood import FALSE_ALARM, FitStates

ALIKE = 2.0
"""Times that a core's chi-square may be that of the frames' noise where this explains both."""
LOUD = 1.3
"""Noise of the frames over the stated one, squared, above which it is too large: 6 sigma of an image's median."""
NOISE, BEFORE, AFTER = "noise", "before", "shape"
"""Causes: noise of the frames, the shape of the spots before, their shape after alone."""


@dataclass(frozen=True)
class SpotDoubt:
    """Why sigma does not hold for a state.

    Attributes:
        cause: `noise`, `before` or `shape`.
        spots: which of the C spots do not fit.
        widening: largest factor by which the sigma of a spot was widened.
        text: in words, without a sentence's end.
    """

    cause: str
    spots: tuple[int, ...]
    widening: float
    text: str


@dataclass(frozen=True, eq=False)
class SpotEvidence:
    """Fits of C spots in S states.

    Attributes:
        before: (1, C) or (S, C), of the nominal state.
        after: (S, C).
    """

    before: FitStates
    after: FitStates

    def at(self, states: slice) -> SpotEvidence:
        """The evidence of some states.

        Args:
            states: which.
        """
        before = self.before if len(self.before.whole) == 1 else self.before.at(states)
        return SpotEvidence(before, self.after.at(states))

    @classmethod
    def joined(cls, parts: Sequence[SpotEvidence]) -> SpotEvidence:
        """The evidence of several series against one nominal state, one after the other.

        Args:
            parts: at least one.
        """
        return cls(parts[0].before, FitStates.joined([one.after for one in parts]))

    @property
    def holds(self) -> NDArray[np.bool_]:
        """(S,) whether all spots before and after are as assumed."""
        return np.asarray(np.all(self.before.fits, axis=1) & np.all(self.after.fits, axis=1))

    @property
    def widening(self) -> Array:
        """(S, C) factor of the sigma of each spot's place, before and after whichever is larger."""
        return np.asarray(np.maximum(self.before.widening, self.after.widening))

    @property
    def worst(self) -> int:
        """Number of the state whose spots fit least."""
        return int(np.argmax(np.max(self.widening, axis=1)))

    def course_doubt(self, moments: Sequence[str], names: Sequence[str]) -> str | None:
        """Why sigma does not hold at the worst of the states; None where it holds at all.

        Args:
            moments: of the states, in words.
            names: of the spots.
        """
        told, bad = self.doubt(self.worst, names), int(np.count_nonzero(~self.holds))
        return None if told is None else f"at {moments[self.worst]}, the worst of {bad} times: {told.text}"

    def doubt(self, state: int = 0, names: Sequence[str] = ()) -> SpotDoubt | None:
        """Why sigma does not hold for a state; None where it does.

        Args:
            state: its number.
            names: of the spots; their numbers if not given.
        """
        if self.holds[state]:
            return None
        first = self.before.at(slice(0, 1) if len(self.before.whole) == 1 else slice(state, state + 1))
        last = self.after.at(slice(state, state + 1))
        off = [~one.fits[0] for one in (first, last)]
        spots = tuple(np.flatnonzero(off[0] | off[1]).tolist())
        worst = max((float(one.widening[0, k]), k) for one in (first, last) for k in spots)
        own = last if off[1][worst[1]] else first
        whole, core, noise = (float(v[0, worst[1]]) for v in (own.whole, own.core, own.noise))
        if all(_noisy(one, k) for one, beyond in ((first, off[0]), (last, off[1])) for k in spots if beyond[k]):
            cause = NOISE
            why = (
                f"the noise of the frames is {np.sqrt(noise):.3g} times that of the data sheet, both beside the spots "
                "and in them: another gain, read-out noise or number of bits, or light that varies"
            )
        elif np.any(off[0]):
            cause = BEFORE
            why = (
                "the spots before do not have the calibrated shape either: a camera that is blurred or aberrated "
                "otherwise than calibrated, a reflection, or stray light"
            )
        else:
            cause = AFTER
            why = (
                "the shape of the spots differs from the calibration: a motion blurs or aberrates them, or they "
                "contain a "
                "reflection or stray light, and a position on a changed spot is not that on the calibrated one"
            )
        named = ", ".join(names[k] if names else str(k) for k in spots)
        limit = float(own.core_limit[0, worst[1]]), float(own.whole_limit[0, worst[1]])
        size = (
            f"reduced chi-square {_number(core)} of the core (limit {limit[0]:.2f}) and {_number(whole)} of the image "
            f"(limit {limit[1]:.2f}, false-alarm rate {FALSE_ALARM:g} a fit)"
        )
        text = (
            f"σ does not hold: the fit of the spots {named} is not good, {size}; {why}. The noise of their positions "
            f"was widened up to {_number(worst[0])} times, which does not cover the effect of a changed shape"
            if cause != NOISE
            else f"σ does not hold: the fit of the spots {named} is not good, {size}; {why}. The noise of "
            f"their positions was widened up to {_number(worst[0])} times"
        )
        return SpotDoubt(cause, spots, worst[0], text)


def _noisy(one: FitStates, k: int) -> bool:
    """Whether the noise of the frames explains the fit of spot k: all pixels have it, its core not much more."""
    noise, whole, core = (float(v[0, k]) for v in (one.noise, one.whole, one.core))
    return noise > LOUD and whole < LOUD * noise and core < ALIKE * noise


def _number(value: float) -> str:
    return f"{value:.3g}" if value < 1e3 else f"{value:.0f}"
