"""Which elementary motions a factor is made of, and how fast each of them grows with it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

from optics.frozen_map import FrozenMap
from optics.tree import Motion, State
from twin.motions import ElementaryMotion
from twin.study.gradient_chain import SHARES

CAP = {"shift": 1e-3, "rotate": 3e-4, "scale": 1e-3, "figure": 1e-6}
"""Largest steps of differences, SI: they move the beam on the mirrors by a few millimetres at most."""
ROUNDING = 1e-9
"""Of a motion's size per step: motions that are smaller come from rounding in a composition of motions."""

Slopes = Mapping[ElementaryMotion, float]


def motion_slopes(about: State, state: Callable[[float], State], step: float) -> Slopes | None:
    """Derivative of a state's motions by a factor; None if the factor changes more than motions, figures and scales.

    Args:
        about: the state of the base.
        state: change of the factor -> the state.
        step: a change of the factor. Motions are linear in it, or nearly so where temperatures add to them.
    """
    at = [state(share * step) for share in SHARES]
    slopes: dict[ElementaryMotion, float] = {}
    for path in {path for one in at for path in one}:
        base = about.get(path, Motion())
        several = [one.get(path, base) for one in at]
        if any(_rest(motion) != _rest(base) for motion in several):
            return None
        terms = sorted({j for motion in several for j in motion.figure})
        kinds = [(kind, axis) for kind in ("rotate", "shift") for axis in range(3)]
        for kind, axis in (*kinds, ("scale", 0), *(("figure", j) for j in terms)):
            a, b, c, d = (_component(motion, kind, axis) for motion in several)
            wide, narrow = (a - b) / (2.0 * step), (c - d) / step
            slope = narrow + (narrow - wide) / 3.0
            if abs(slope * step) > ROUNDING * max(abs(_component(base, kind, axis)), CAP[kind] * ROUNDING):
                slopes[ElementaryMotion(path, kind, axis, base.pivot)] = slope
    return slopes


def _component(motion: Motion, kind: str, axis: int) -> float:
    if kind == "figure":
        return motion.figure.get(axis, 0.0)
    return motion.scale if kind == "scale" else (motion.rotate if kind == "rotate" else motion.shift)[axis]


def _rest(motion: Motion) -> Motion:
    """What is no elementary motion: the pivot, and what temperatures do."""
    nothing = (0.0, 0.0, 0.0)
    return replace(motion, rotate=nothing, shift=nothing, scale=0.0, figure=FrozenMap({}))
