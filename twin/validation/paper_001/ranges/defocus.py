"""Defocus of the line CCD, seen by a beam that leaves through a part of the pupil; and the area CCDs' field."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optics.backend import Backend
from optics.tree import Motion, State
from scenes.channel import BASE
from scenes.resolved import ResolvedJob
from twin.validation.paper_001.ranges.bench import CORRECTED, FORMS, Bench
from twin.validation.paper_001.ranges.curves import Curves, sampled
from twin.validation.paper_001.ranges.singles import CLAIMED, FINE, NAMES, motion_of
from twin.validation.paper_001.ranges.variants import variant

CONFOCAL = 40e-6
"""How well paper 004 sets the line CCD to the focus, metres."""
SMALL = {"d_alpha": 2.0, "d_beta": 2.0, "d_gamma": 40.0, "d_f": 1500.0}
"""Single changes whose readings are compared in a defocused camera and at other fields: a third of the area CCD."""


def depth_of_focus(resolved: ResolvedJob, camera: str) -> float:
    """2 λ N², where a quarter of a wave of defocus is reached at the monitor's wavelength, metres."""
    spec = resolved.cameras[resolved.instrument.cameras[camera].camera]
    return 2.0 * resolved.instrument.monitor.wavelength * (spec.focal_length / spec.entrance_pupil) ** 2


def piston(camera: str, amount: float, *, along: tuple[float, float] = (0.0, 0.0), turn: float = 0.0) -> State:
    """The line CCD moved along Z (and along X and Y, and turned about Z), metres and radians."""
    return {f"{BASE}/{camera}/focal_plane": Motion(rotate=(0.0, 0.0, turn), shift=(*along, amount))}


def false_slopes(bench: Bench, form: str, pistons: Sequence[float]) -> np.ndarray:
    """Reading minus truth per metre of piston between before and after, (4,), table units, by images."""
    camera = bench.cameras[0]
    states = [piston(camera, z) for z in pistons]
    readings = bench.readings(bench.positions([{}]), bench.positions(states))[camera][form]
    false = readings - bench.truth(states)[camera]
    z = np.array(pistons)
    return np.asarray(z @ false / (z @ z))


@dataclass(frozen=True, eq=False)
class PupilStudy:
    """False readings per piston over the place of the monitor's sub-aperture in the pupil.

    Attributes:
        offset: (N, 2) X, Y of the sub-aperture, metres.
        slope: (N, 4) table units per metre of piston, corrected form.
        gradient: (4, 2) change of the slope by X and Y, table units per m^2.
        rest: (4,) rms of the slopes about that plane, table units per metre.
    """

    offset: np.ndarray
    slope: np.ndarray
    gradient: np.ndarray
    rest: np.ndarray


def pupil_study(
    resolved: ResolvedJob, backend: Backend, like: Bench, offsets: Sequence[tuple[float, float]], depth: float
) -> PupilStudy:
    """Build the instrument anew with each sub-aperture and defocus it."""
    slopes = []
    for offset in offsets:
        bench = Bench(variant(resolved, backend, like.cameras[0], pupil_offset=offset), like)
        slopes.append(false_slopes(bench, CORRECTED, (-depth, depth)))
    place, slope = np.array(offsets), np.array(slopes)
    design = np.column_stack([np.ones(len(place)), place])
    solved, *_ = np.linalg.lstsq(design, slope, rcond=None)
    rest = np.sqrt(np.mean((slope - design @ solved) ** 2, axis=0))
    return PupilStudy(place, slope, solved[1:].T, rest)


def piston_curves(bench: Bench, count: int) -> Curves:
    """The false readings of the corrected form over the piston (metres), as shares of FINE and CLAIMED, the worse of
    the two directions.
    """
    camera, origin = bench.cameras[0], bench.positions([{}])

    def shares(size: np.ndarray) -> dict[str, np.ndarray]:
        states = [piston(camera, sign * z) for sign in (1.0, -1.0) for z in size]
        readings = bench.readings(origin, bench.positions(states))[camera][CORRECTED]
        false = np.abs(readings - bench.truth(states)[camera]).reshape(2, len(size), 4).max(axis=0)
        out = {}
        for k, name in enumerate(NAMES):
            out[f"{name} fine"] = false[:, k] / FINE[name]
            out[f"{name} claimed"] = false[:, k] / CLAIMED[name]
        return out

    return sampled(shares, np.geomspace(10e-6, 4e-3, count).tolist())


def gains(bench: Bench, constant: float = 0.0) -> dict[str, np.ndarray]:
    """Form -> (4,) reading over truth of SMALL single changes, with the same piston (metres) before and after."""
    camera = bench.cameras[0]
    states: list[State] = [piston(camera, constant)]
    for name in NAMES:
        motion, unit = motion_of(camera, name, bench.geometry(camera))
        amount = unit * SMALL[name]
        if name == "d_f":
            states.append({**piston(camera, constant), motion.body: motion.motion(amount)})
        elif name == "d_gamma":
            states.append(piston(camera, constant, turn=amount))
        else:
            along = (amount, 0.0) if name == "d_alpha" else (0.0, amount)
            states.append(piston(camera, constant, along=along))
    place, truth = bench.positions(states), bench.truth(states)[camera]
    change = np.diag(truth[1:] - truth[:1])
    readings = bench.readings(place[:1], place[1:])[camera]
    return {form: np.diag(readings[form]) / change for form in FORMS}


@dataclass(frozen=True, eq=False)
class FieldPoint:
    """The formulas with the area CCDs at another field.

    Attributes:
        field: radians. separation: of the area CCDs, metres.
        gains: form -> (4,) reading over truth.
        slope: (4,) false reading per metre of piston, corrected form, table units.
    """

    field: float
    separation: float
    gains: dict[str, np.ndarray]
    slope: np.ndarray


def field_study(
    resolved: ResolvedJob, backend: Backend, camera: str, fields: Sequence[float], depth: float
) -> list[FieldPoint]:
    """Build the instrument anew with the area CCDs at each field (radians)."""
    out = []
    for field in fields:
        bench = Bench(variant(resolved, backend, camera, field=field))
        slope = false_slopes(bench, CORRECTED, (-depth, depth))
        out.append(FieldPoint(field, bench.geometry(camera).separation_m, gains(bench), slope))
    return out
