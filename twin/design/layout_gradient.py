"""How what a layout leaves changes with the numbers that describe it.

Where prisms and facets stand is itself found by tracing, so no chain of closed formulas leads from a pupil offset to a
sigma. Two parts do: the sigma's derivative by the traced derivatives A of the spots and by their noise R is exact
matrix calculus (``Information.slopes``); A and R, which are smooth in every number of a layout, are differentiated by
central differences of high order of layouts that are built anew. The stated error has two parts from the same layouts:
the difference from the next lower order, and a jump within the steps, as where a 180-deg prism is exchanged for its
mirror image (``monitor_chain``) of a beam in the plane of symmetry. A slope across a jump does not exist; its error is
as large as itself.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from optics.numerics.frozen_map import FrozenMap
from optics.raytrace.aim import AimError
from optics.raytrace.trace import BeamMissedError
from scenes.models.instrument_builder import build_instrument
from scenes.models.monitor_layout import Layout, layout_spec, number_of, ranges
from scenes.yaml.errors import InputError
from twin.design.layout_bench import LayoutBench
from twin.monitor.information import Information

STEP = 0.01
"""Step of a number, relative to the range in which it may vary: A is smooth over all of it, and aimed to 1e-9 of it."""
ORDER = 6
"""Of the central differences, where nothing else is asked for."""
_WEIGHTS = {
    2: {1: 1.0 / 2.0},
    4: {1: 8.0 / 12.0, 2: -1.0 / 12.0},
    6: {1: 45.0 / 60.0, 2: -9.0 / 60.0, 3: 1.0 / 60.0},
}
"""Order -> weights of central differences by the number of steps (Fornberg, Math. Comp. 51, 699, 1988)."""
_JUMP = {4: {1: 4.0 / 3.0, 2: -1.0 / 3.0}, 6: {1: 1.5, 2: -0.6, 3: 0.1}}
"""Order -> weights of f(k h) + f(-k h) - 2 f(0). Their sum is what that tends to with k, extrapolated by even powers:
nothing of a smooth f. Of a jump J anywhere within the steps it is such a part of J that, over h, it bounds what J does
to the central difference: J of the first step against 0.62 J, J/2 of the second against 0.13 J, J/10 of the third
against 0.02 J for order 6.
"""


@dataclass(frozen=True)
class LayoutNumber:
    """One of the numbers of a layout.

    Attributes:
        beams: the layout.
        beam: which of them, counted from 0.
        name: of the number, one of ``monitor_layout.CONTINUOUS``.
        order: of the differences, 2, 4 or 6.
    """

    beams: Layout
    beam: int
    name: str
    order: int = ORDER

    def moved(self, bench: LayoutBench, by: float) -> Layout:
        """The layout with this number changed.

        Args:
            bench: of the design.
            by: the change, SI.
        """
        own = self.beams[self.beam]
        value = number_of(bench.setup, own, self.name) + by
        return (*self.beams[: self.beam], own.changed({self.name: value}), *self.beams[self.beam + 1 :])


@dataclass(frozen=True, eq=False)
class Slope:
    """Derivative of what a layout leaves by one of its numbers.

    Attributes:
        number: which.
        refused: why it cannot be told, empty where it can; nothing else is then known.
        values: disturbances -> quantity -> d(sigma)/d(number), SI.
        errors: likewise, by how much each may be wrong; empty for differences of second order, below which is none.
        brightest: derivative of how full the brightest pixel of each of C spots is, (C,), per SI unit.
    """

    number: LayoutNumber
    refused: str = ""
    values: Mapping[str, Mapping[str, float]] = field(default_factory=FrozenMap)
    errors: Mapping[str, Mapping[str, float]] = field(default_factory=FrozenMap)
    brightest: np.ndarray = field(default_factory=lambda: np.zeros(0))


def numbers_of(bench: LayoutBench, beams: Layout, order: int = ORDER) -> tuple[LayoutNumber, ...]:
    """All numbers of a layout that may vary.

    Args:
        bench: of the design.
        beams: the layout.
        order: of the differences.
    """
    names = [name for name, (low, high) in ranges(bench.setup).items() if high > low]
    return tuple(LayoutNumber(beams, k, name, order) for k in range(len(beams)) for name in names)


@lru_cache(maxsize=2)
def _known_here(bench: LayoutBench, beams: Layout) -> dict[str, Information]:
    """As ``known_of``, of the layout that all its numbers are differentiated at."""
    return known_of(bench, beams)


def known_of(bench: LayoutBench, beams: Layout) -> dict[str, Information]:
    """What a layout's spots know, by the names of the disturbances, whether or not its bodies have room.

    Args:
        bench: of the design.
        beams: the layout.

    Raises:
        InputError: its prisms or facets cannot be placed.
        BeamMissedError, AimError: light does not come to its area CCDs.
    """
    spec = layout_spec(bench.setup, beams)
    instrument = build_instrument(spec, bench.setup.cameras, bench.backend, free_beams=False, free_bodies=False)
    return bench.information(instrument, beams[0], single=False)


def slope_of(bench: LayoutBench, number: LayoutNumber) -> Slope:
    """Derivative of all sigmas of a layout by one of its numbers.

    Args:
        bench: of the design.
        number: of a layout.
    """
    low, high = ranges(bench.setup)[number.name]
    step, high_order, low_order = STEP * (high - low), _WEIGHTS[number.order], _WEIGHTS.get(number.order - 2, {})
    try:
        here = _known_here(bench, number.beams)
        best, lower, jump = ({name: _Sum.none(one) for name, one in here.items()} for _ in range(3))
        jumps = _JUMP.get(number.order, {})
        for name, one in here.items():
            jump[name].add(-2.0 * sum(jumps.values()) / step, one)
        for k, weight in high_order.items():
            for sign in (1.0, -1.0):
                for name, one in known_of(bench, number.moved(bench, sign * k * step)).items():
                    best[name].add(sign * weight / step, one)
                    lower[name].add(sign * low_order.get(k, 0.0) / step, one)
                    jump[name].add(jumps.get(k, 0.0) / step, one)
    except (InputError, AimError, BeamMissedError, ValueError) as error:
        return Slope(number, refused=str(error))
    values: dict[str, dict[str, float]] = {}
    errors: dict[str, dict[str, float]] = {}
    for name, one in here.items():
        slopes = {key: one.slopes(key) for key in one.quantities if one.sigma(key) > 0.0}
        values[name] = {key: best[name].along(*slope) for key, slope in slopes.items()}
        if low_order:
            errors[name] = {
                key: abs(values[name][key] - lower[name].along(*slope)) + abs(jump[name].along(*slope))
                for key, slope in slopes.items()
            }
    return Slope(number, values=values, errors=errors, brightest=next(iter(best.values())).brightest)


@dataclass(eq=False)
class _Sum:
    """Weighted sum of A, of R, and of how full the brightest pixels are."""

    spots: np.ndarray
    noise: np.ndarray
    brightest: np.ndarray

    @classmethod
    def none(cls, like: Information) -> _Sum:
        return cls(*(np.zeros_like(a) for a in (like.disturbances.spots, like.noise, like.brightest)))

    def add(self, weight: float, one: Information) -> None:
        self.spots += weight * one.disturbances.spots
        self.noise += weight * one.noise
        self.brightest += weight * one.brightest

    def along(self, by_spots: np.ndarray, by_noise: np.ndarray) -> float:
        return float(np.sum(by_spots * self.spots) + np.sum(by_noise * self.noise))
