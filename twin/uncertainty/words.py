"""Quantities, bodies and motions in the words of reports."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from analysis.monitor.disturbances import Disturbances
from analysis.monitor.limits import ANGLE_GROUP, GROUND_GROUP, LeastSeen, Quantity, unseen
from scenes.specs.instrument import BASE
from twin.run.artefact import SYMBOLS, shown_unit, significant
from twin.uncertainty.monitor_limits import MonitorLimits


def quantity_text(quantity: Quantity) -> str:
    """With its unit: ``forward Δα [arcsec]``."""
    return f"{short_text(quantity)} [{unit_text(quantity)}]"


def short_text(quantity: Quantity) -> str:
    """Without its unit: ``forward Δα``, ``intersection angle``, ``height``."""
    name = quantity.key.rpartition("_")[0]
    if quantity.group == ANGLE_GROUP:
        return "intersection angle"
    if quantity.group == GROUND_GROUP:
        return name if name == "height" else f"{name} the track"
    return f"{quantity.group} {SYMBOLS[name]}"


def unit_text(quantity: Quantity) -> str:
    """Its unit."""
    return shown_unit(quantity.key.rpartition("_")[2])


def unseen_texts(
    stated: Disturbances, noise: np.ndarray, quantities: Sequence[Quantity], gain: np.ndarray
) -> tuple[str, ...]:
    """A warning for each stated body whose motions have next to no derivative in the spots and yet make sigma.

    Args:
        stated: what moves.
        noise: (D, D) of the shifts, px^2.
        quantities: Q of them.
        gain: (4 K, D) of the estimator that is judged by.
    """
    rows = np.stack([quantity.row for quantity in quantities])
    out = []
    for body, shares in unseen(rows, stated, noise, gain).items():
        worst = int(np.argmax(shares))
        out.append(
            f"{body}: its motions that are stated move no spot; {100.0 * float(shares[worst]):.0f} % of the variance "
            f"of {short_text(quantities[worst])} are from the statement, not from the spots, and nothing that is "
            "measured can contradict it"
        )
    return tuple(out)


def body_text(body: str) -> str:
    """A body, or a motion of it, without the base that all stand on."""
    return body.removeprefix(f"{BASE}/")


def part_of(body: str) -> str:
    """What a body is, whichever camera's it is: ``M2``, ``prism_180``, ``camera``, ``central_prism``."""
    below = body.split("/")[1:]
    if not below:
        return "base"
    if len(below) == 1:
        return below[0] if below[0] == "central_prism" else "camera"
    return below[-1]


def combination_text(limits: MonitorLimits, number: int, most: int = 4) -> str:
    """The motions that hide best, in words.

    Args:
        limits: of an instrument.
        number: of the quantity.
        most: motions that are named.
    """
    seen, quantity, stated = limits.least_seen[number], limits.quantities[number], limits.stated
    order = sorted(range(len(seen.amounts)), key=lambda k: -abs(seen.amounts[k]))[:most]
    named = [
        f"{body_text(stated.labels[k])} {significant(seen.amounts[k] * stated.sigmas[k], 2, sign=True)} "
        f"{shown_unit(stated.units[k])}"
        for k in order
        if seen.amounts[k]
    ]
    change = f"{significant(seen.change, 2)} {unit_text(quantity)}"
    return f"{', '.join(named)}: {change}, while no spot moves by more than {_moved(seen)}"


def _moved(seen: LeastSeen) -> str:
    """How far spots move with a combination, beside their noise."""
    moved, noise = float(abs(seen.spots).max()), float(seen.noise.max())
    return f"{moved:.1g} px (noise {noise:.1g} px)"
