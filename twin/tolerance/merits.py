"""Merits of a camera that is out of tolerance: smooth parts of each, and what they come to.

What bodies of an instrument take of the beams of one of its cameras, in many states: prisms, housings, baffles,
parts of other cameras, each where the state puts it. The camera's own mirrors are its prescription's matter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from analysis.units import ARCSEC
from optics.geometry.tree import State
from optics.numerics import quadrature
from optics.raytrace.system import assemble
from optics.waves.imaging import imaging_rays
from scenes.models.shadow import TracedBeams
from scenes.specs.tolerance import MERIT_UNITS, MeritSpec, ToleranceSetup
from scenes.yaml.units import LENGTH
from twin.run.artefact import shown_unit
from twin.targets.target_path import TargetPath
from twin.tolerance.monitor_merit import readings_of


@dataclass(frozen=True, eq=False)
class Merit:
    """One merit of a budget.

    Its **parts** change smoothly with small motions, which its value, as the worst of some fields, does not: mean
    square wavefront errors by field, MTF by field and direction, components of a turn, residual places along the line,
    shares of a beam by field, variances of readings.

    Attributes:
        name: in the file.
        spec: what is asked.
        fields: numbers of its fields among those of the bench, (F,).
        parts: columns of the bench's parts that are its own.
    """

    name: str
    spec: MeritSpec
    fields: np.ndarray
    parts: slice

    def values(self, parts: np.ndarray) -> np.ndarray:
        """What parts (..., P) of the bench come to, (...,), SI; of a change its size."""
        own = parts[..., self.parts]
        match self.spec.kind:
            case "wavefront":
                return np.sqrt(np.maximum(np.max(own, axis=-1), 0.0))
            case "monitor_angle" | "monitor_focus":
                return np.sqrt(np.maximum(np.max(own, axis=-1), 0.0))
            case "mtf":
                return np.asarray(np.min(own, axis=-1))
            case "chief_ray":
                return np.asarray(np.max(np.hypot(own[..., ::2], own[..., 1::2]), axis=-1))
            case "boresight":
                return np.asarray(np.hypot(own[..., 0], own[..., 1]))
            case _:
                return np.asarray(np.max(np.abs(own), axis=-1))

    def passes(self, values: np.ndarray) -> np.ndarray:
        """Whether values meet the requirement; what is not known does not."""
        if self.spec.more_is_better:
            return np.asarray(values >= self.spec.requirement)
        return np.asarray(values <= self.spec.requirement)

    def margin(self, values: np.ndarray) -> np.ndarray:
        """How far values are beyond the requirement, in units of it; negative where they meet it."""
        ratio = values / self.spec.requirement
        return np.asarray(1.0 - ratio if self.spec.more_is_better else ratio - 1.0)

    def worse(self, values: np.ndarray, than: float | np.ndarray) -> np.ndarray:
        """By how much values are worse than another."""
        return np.asarray(than - values if self.spec.more_is_better else values - than)


PART_COUNTS = {"boresight": 2, "roll": 1, "principal_distance": 1}
AT_FIELDS = ("wavefront", "mtf", "chief_ray", "obstruction")
"""Kinds of merits that have fields."""
"""Kind of a merit -> number of its parts, where that does not depend on fields."""


def part_count(spec: MeritSpec, line_points: int, cameras: Sequence[str] = ()) -> int:
    """Number of a merit's parts."""
    match spec.kind:
        case "monitor_angle" | "monitor_focus":
            return len(readings_of(spec, cameras))
        case "wavefront" | "obstruction":
            return len(spec.fields)
        case "mtf":
            return len(spec.fields) * (2 if spec.direction == "worse" else 1)
        case "chief_ray":
            return 2 * len(spec.fields)
        case "distortion":
            return line_points
        case kind:
            return PART_COUNTS[kind]


def merits_of(
    specs: dict[str, MeritSpec], line_points: int, cameras: Sequence[str] = ()
) -> tuple[tuple[Merit, ...], np.ndarray]:
    """The merits of a budget, and the fields (F, 2) that any of them has.

    Args:
        specs: by name.
        line_points: at which distortion is told.
        cameras: of the instrument.
    """
    fields: dict[tuple[float, float], int] = {}
    out, start = [], 0
    for name, spec in specs.items():
        used = spec.fields if spec.kind in AT_FIELDS else ()
        numbers = np.array([fields.setdefault(place, len(fields)) for place in used], dtype=int)
        count = part_count(spec, line_points, cameras)
        out.append(Merit(name, spec, numbers, slice(start, start + count)))
        start += count
    return tuple(out), np.array(list(fields)).reshape(-1, 2)


def shown_merit(value: float, merit: Merit) -> float | None:
    """A value in the unit in which people read the merit; None where it is not known."""
    return float(value / merit_unit(merit)[1]) if np.isfinite(value) else None


def merit_head(merit: Merit) -> str:
    """Name of a merit with its unit, for the head of a column."""
    unit = merit_unit(merit)[0]
    return f"{merit.name} [{shown_unit(unit)}]" if unit else merit.name


def merit_unit(merit: Merit) -> tuple[str, float]:
    """Unit in which people read a merit, and its size in SI."""
    unit = MERIT_UNITS[merit.spec.kind]
    if unit is None:
        return ("waves", 1.0) if merit.spec.kind == "wavefront" else ("", 1.0)
    return ("um", 1e-6) if unit is LENGTH else ("arcsec", ARCSEC)


KIND = "obstruction"
RINGS = 7
"""Rings of the rays over the stop, as those of an image's quality."""
AT_ONCE = 40
"""States traced in one launch, to bound memory."""


def require_bodies(setup: ToleranceSetup, path: TargetPath) -> None:
    """Raise InputError where a budget asks for an obstruction and nothing can stand in the beams of the camera."""
    for name, merit in setup.test.merits.items():
        if merit.kind == KIND and (path.shadows is None or not path.shadows.casters):
            problem = f"no body of {setup.base.instrument.name} can stand in the beams of {path.name}"
            allowed = "an instrument with a monitor, baffles or another camera; or other merits"
            raise setup.test.error(problem, ("merits", name, "kind"), allowed=allowed)


def obstructed_shares(
    path: TargetPath, states: Sequence[State], directions: np.ndarray, start: np.ndarray
) -> np.ndarray:
    """Share of the stop's area that bodies together take of every beam, (S, F).

    Args:
        path: the camera's, with its shadows.
        states: S states.
        directions: of the light, world, (F, 3).
        start: a point of each beam before the first mirror, world, (F, 3).

    Raises:
        AimError, BeamMissedError: the light of a state is lost.
        UnphysicalError: shadows that cannot be.
    """
    assert path.shadows is not None
    nodes, fields = quadrature.disk(RINGS), len(directions)
    axis = path.assembly.nominal_pose(path.root).rotation[:, 1]
    out = np.empty((len(states), fields))
    for first in range(0, len(states), AT_ONCE):
        some = states[first : first + AT_ONCE]
        placed, owner = path.assembly.place(some), np.repeat(np.arange(len(some)), fields)
        imaging, to_stop = (
            assemble(path.assembly, [f"{path.name}/{way}"], some, placed=placed).take(owner)
            for way in ("imaging", "to_stop")
        )
        heading, launch = (np.tile(one, (len(some), 1)) for one in (directions, start))
        rays = imaging_rays(path.backend, imaging, to_stop, heading, launch, path.stop, nodes, first=axis)
        shadows = path.shadows.cast(TracedBeams(path.assembly, placed, owner, imaging, rays, heading, nodes))
        out[first : first + len(some)] = np.sum(shadows.areas, axis=1).reshape(-1, fields) / np.pi
    return out
