"""How far the formulas hold under defocus, for other pupil offsets, fields and kinds of return."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from optics.geometry.pose import Pose, about_axis
from optics.geometry.surface import plane
from optics.geometry.tree import Body, Motion, RigidTree, State
from optics.numerics.backend import Backend
from optics.numerics.number_tree import FrozenMap
from optics.raytrace.assembly import Assembly, Element, Interaction
from scenes.models.instrument_model import Instrument
from scenes.specs.instrument import BASE
from scenes.specs.resolved import ResolvedJob
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.validation.checks.group import load_printed
from twin.validation.paper_001.ranges.curves import CORRECTED, FORMS, Bench, Curves, sampled
from twin.validation.paper_001.ranges.turns import CLAIMED, FINE, NAMES, motion_of

RETURNS = ("plane", "roof", "roof along", "corner")
"""Kinds of return: a mirror facet; a roof whose ridge lies across the line, or along it; a corner cube."""
SHIFT = 60e-6
"""Shift of the line CCD, metres."""
_OFFSETS: dict[str, tuple[float, float] | None] = {
    "plane": None,
    "roof": None,
    "roof along": (0.0, 3e-3),
    "corner": (0.0, 0.0),
}
_NOTES = {
    "plane": "as built",
    "roof": "as built; the ridge lies across the line",
    "roof along": "the ridge lies along the line; the area CCD stands beside its pinhole along the line",
    "corner": "the spot falls on its own pinhole: the area CCD must see it through a beam splitter",
}
CONFOCAL = load_printed("004").number("alignment.confocal_mm") / 1e3
"""How well paper 004 sets the line CCD to the focus, metres."""
SMALL = {"d_alpha": 2.0, "d_beta": 2.0, "d_gamma": 40.0, "d_f": 1500.0}
"""Single changes whose readings are compared in a defocused camera and at other fields: a third of the area CCD."""


def variant(
    resolved: ResolvedJob,
    backend: Backend,
    camera: str,
    pixels: int | None = None,
    pupil_offset: tuple[float, float] | None = None,
    field: float | None = None,
    ccd_offset: tuple[float, float] | None = None,
) -> MonitorExperiment:
    """The experiment with one camera of an instrument, changed and built anew.

    Args:
        resolved: the instrument as its file gives it.
        backend: where to trace.
        camera: the camera that is kept.
        pixels: rows and columns of the area CCDs.
        pupil_offset: centre (X, Y) of the monitor's sub-aperture in the entrance pupil, metres.
        field: of the area CCDs, radians.
        ccd_offset: (X, Y) from the pinhole to the area CCD's centre, metres.

    Raises:
        InputError: the prisms cannot stand so.
    """
    spec = resolved.instrument
    site = spec.cameras[camera]
    if pupil_offset is not None:
        site = site.model_copy(update={"pupil_offset": pupil_offset})
    of_ccd: dict[str, Any] = {} if pixels is None else {"rows": pixels, "columns": pixels}
    if ccd_offset is not None:
        of_ccd["offset"] = ccd_offset
    of_monitor: dict[str, Any] = {"area_ccd": spec.autocollimator.area_ccd.model_copy(update=of_ccd)}
    if field is not None:
        of_monitor["field"] = field
    changed = {
        "cameras": FrozenMap({camera: site}),
        "monitor": spec.autocollimator.model_copy(update=of_monitor),
        "baffles": FrozenMap({}),
    }
    return MonitorExperiment(resolved.model_copy(update={"instrument": spec.model_copy(update=changed)}), backend)


def with_return(experiment: MonitorExperiment, kind: str) -> MonitorExperiment:
    """Return the experiment with another kind of return.

    The facet becomes an opening of the same size, behind which two or three mirrors stand square to each other and
    meet in its middle. Rays meet them in one order; the other orders give the same ray, as turns by half a turn do not
    depend on theirs.

    Args:
        experiment: with the plane return that was built.
        kind: of RETURNS.

    Raises:
        ValueError: it is no such kind.
    """
    if kind not in RETURNS:
        raise ValueError(f"no return {kind!r}; there are {', '.join(RETURNS)}")
    if kind == "plane":
        return experiment
    instrument = experiment.instrument
    return experiment.with_instrument(replace(instrument, assembly=_returning(instrument, kind)))


def _returning(instrument: Instrument, kind: str) -> Assembly:
    """The assembly with mirrors square to each other behind every facet's opening."""
    old = instrument.assembly
    bodies, elements, sequences = list(old.tree.bodies), dict(old.elements), dict(old.sequences)
    for channel in instrument.channels:
        name = f"{channel.key}/return_face"
        elements[name] = replace(old.elements[name], interaction=Interaction.PASS)
        added = []
        for k, pose in enumerate(_mirrors(kind)):
            body, mirror = Body(f"{channel.face_body}/mirror_{k}", pose), f"{name}/mirror_{k}"
            bodies.append(body)
            elements[mirror] = Element(mirror, body.path, plane(), Interaction.REFLECT)
            added.append(mirror)
        way = old.sequences[f"{channel.key}/monitor"]
        at = way.index(name)
        sequences[f"{channel.key}/monitor"] = (*way[: at + 1], *added, *way[at + 1 :])
    return Assembly(RigidTree(tuple(bodies)), elements, sequences, old.media)


def _mirrors(kind: str) -> list[Pose]:
    """Poses of the mirrors in the facet's frame (x along the line, y across it, z to the light)."""
    if kind.startswith("roof"):
        ridge = 1 if kind == "roof" else 0
        return [Pose(about_axis(ridge, side * math.pi / 4)) for side in (1.0, -1.0)]
    lean = math.acos(1.0 / math.sqrt(3.0))  # of a cube's faces to its diagonal
    return [Pose(about_axis(2, 2.0 * math.pi * k / 3.0) @ about_axis(0, lean)) for k in range(3)]


@dataclass(frozen=True, eq=False)
class Response:
    """What a kind of return does.

    Attributes:
        kind: of variants.RETURNS.
        across, along: (2,) motion of the spots (left, right) over the motion of the line CCD across and along the line.
        gain: (4,) corrected reading over truth, single changes.
        note: how pinhole and area CCD had to stand.
    """

    kind: str
    across: np.ndarray
    along: np.ndarray
    gain: np.ndarray
    note: str


def responses(resolved: ResolvedJob, backend: Backend, like: Bench) -> list[Response]:
    """All kinds of return, by rendered images."""
    camera, pitch = like.cameras[0], resolved.instrument.autocollimator.area_ccd.pitch
    out = []
    for kind in RETURNS:
        built = with_return(variant(resolved, backend, camera, ccd_offset=_OFFSETS[kind]), kind)
        bench = Bench(built, like)
        states = [{}, piston(camera, 0.0, along=(SHIFT, 0.0)), piston(camera, 0.0, along=(0.0, SHIFT))]
        place = bench.positions(states)
        moved = (place[1:] - place[0]) * pitch / SHIFT
        # columns run along -X, rows along +Y
        out.append(Response(kind, -moved[0, :, 1], moved[1, :, 0], gains(bench)[CORRECTED], _NOTES[kind]))
    return out


def depth_of_focus(resolved: ResolvedJob, camera: str) -> float:
    """2 λ N², where a quarter of a wave of defocus is reached at the monitor's wavelength, metres."""
    spec = resolved.cameras[resolved.instrument.cameras[camera].camera]
    return 2.0 * resolved.instrument.autocollimator.wavelength * (spec.focal_length / spec.entrance_pupil) ** 2


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
