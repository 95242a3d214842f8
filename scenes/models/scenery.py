"""What stands where for the path tracer: every surface of an instrument in one perturbed state, with its finish.

Figure errors of mirrors and gradients of the refractive index are left out: they turn a ray by less than a microradian
and decide nothing about stray light. So are motions of single footprints on a glass face. Bodies must stay 20 um apart
from each other.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from optics.geometry.aperture import Rectangle
from optics.geometry.pose import Pose
from optics.geometry.tree import AT_REST, PlacedBodies, State
from optics.materials.scatter import CoatingTable, Finish
from optics.raytrace.assembly import Element, Interaction
from scenes.models import scenery_parts
from scenes.models.camera_model import line_body
from scenes.models.instrument_model import Instrument
from scenes.specs.baffle import Plate
from scenes.specs.instrument import BASE
from scenes.specs.job_tables import FinishSpec
from scenes.specs.resolved import ResolvedJob
from scenes.yaml.finish_files import MeasuredScatter, read_bsdf, read_coating

RECIPROCAL_TO = 0.3
"""Rms of the relative difference of a BSDF with its directions exchanged above which is warned."""


@dataclass(frozen=True, eq=False)
class MeasuredFinishes:
    """Measured finishes.

    Attributes:
        finishes: of all surfaces, the measured ones among them.
        scatter: kind of surface -> its table of scattering.
        coatings: kind of surface -> its coating.
    """

    finishes: scenery_parts.Finishes
    scatter: Mapping[str, MeasuredScatter]
    coatings: Mapping[str, CoatingTable]

    def to_dict(self) -> dict[str, Any]:
        """What the tables are, for stray.json: kind of surface -> numbers."""
        out: dict[str, dict[str, Any]] = {}
        for kind, scatter in self.scatter.items():
            angles = scatter.table.incidence
            rms = scatter.table.reciprocity()
            out.setdefault(kind, {})["bsdf"] = {
                "incidence_deg": np.degrees(angles).tolist(),
                "total_scatter": [scatter.table.total(float(angle)) for angle in angles],
                "total_scatter_stated": list(scatter.stated),
                "not_reciprocal_rms": None if np.isnan(rms) else rms,
            }
        for kind, coating in self.coatings.items():
            through = coating.transmittance
            out.setdefault(kind, {})["coating"] = {
                "incidence_deg": np.degrees(coating.angles).tolist(),
                "reflectance": coating.reflectance.tolist(),
                "transmittance": None if through is None else through.tolist(),
            }
        return out

    def warnings(self) -> tuple[str, ...]:
        """What the user should know of the tables."""
        out = []
        for kind, scatter in self.scatter.items():
            rms = scatter.table.reciprocity()
            if rms > RECIPROCAL_TO:
                out.append(
                    f"the BSDF of {kind} surfaces is not reciprocal: with its directions exchanged it differs by "
                    f"{100.0 * rms:.0f} % rms; paths take it as measured, for light that arrives as it was lit"
                )
        return tuple(out)


def measured_finishes(resolved: ResolvedJob) -> MeasuredFinishes | None:
    """The finishes that a job has measured; None where there are none.

    Raises:
        InputError: a coating that does not hold the monitor's wavelength, or a table that scatters more than is
            reflected.
    """
    stray = resolved.job.render.stray
    if stray is None or stray.finishes is None:
        return None
    built_in = scenery_parts.Finishes()
    changed: dict[str, Finish] = {}
    scatter: dict[str, MeasuredScatter] = {}
    coatings: dict[str, CoatingTable] = {}
    for kind, spec in stray.finishes.given.items():
        key = ("render", "stray", "finishes", kind)
        base = built_in.board if kind == "black" else getattr(built_in, kind)
        if spec.coating is not None:
            try:
                coatings[kind] = read_coating(spec.coating.table).at(resolved.instrument.autocollimator.wavelength)
            except ValueError as error:
                text = f"the monitor's wavelength is not in the coating's table: {error}"
                raise resolved.job.error(text, (*key, "coating"), found=spec.coating.table) from None
        if spec.bsdf is not None:
            scatter[kind] = read_bsdf(spec.bsdf.table)
        try:
            changed[kind] = _finish(base, spec, kind, scatter.get(kind), coatings.get(kind))
        except ValueError as error:
            allowed = "shares of the incident light, together at most what is reflected"
            raise resolved.job.error(str(error), key, allowed=allowed) from None
    finishes = built_in
    if "mirror" in changed:
        # glass keeps its own: its light arrives from inside, where nobody measures
        finishes = replace(finishes, mirror=changed["mirror"], metallised=built_in.mirror)
    if "black" in changed:
        black = changed["black"]
        finishes = replace(finishes, mirror_back=black, board=black, baffle=black)
    for kind in ("coated", "detector"):
        if kind in changed:
            finishes = replace(finishes, **{kind: changed[kind]})
    return MeasuredFinishes(finishes, scatter, coatings)


def _finish(
    base: Finish, spec: FinishSpec, kind: str, scatter: MeasuredScatter | None, coating: CoatingTable | None
) -> Finish:
    """A built-in finish with what was measured in its place."""
    if kind == "black":
        assert scatter is not None
        return Finish(table=scatter.table, scattered_only=True)
    if spec.reflectance is not None:
        base = replace(base, reflectance=spec.reflectance)
    if coating is not None:
        base = replace(base, coating=coating)
    return base if scatter is None else replace(base, scatter=None, table=scatter.table)


BOARD = 0.002
BOARD_EDGE = 0.02
"""How far the board stands behind the detectors, and how far it reaches beyond them, metres."""

FACING_THE_LIGHT = Pose(np.diag([-1.0, 1.0, -1.0]))
"""From a focal plane's frame, along whose +Z light arrives, to that of a detector that faces it."""


@dataclass(frozen=True, eq=False)
class Scenery:
    """All surfaces of a scene and its detectors; the position in ``surfaces`` is a surface's number."""

    surfaces: tuple[scenery_parts.SceneSurface, ...]
    detectors: tuple[scenery_parts.Detector, ...] = ()
    _by_element: Mapping[str, int] = field(init=False)

    def __post_init__(self) -> None:
        """Check the names."""
        names = [s.name for s in self.surfaces]
        twice = sorted({n for n in names if names.count(n) > 1})
        if twice:
            raise ValueError(f"surfaces of the same name: {', '.join(twice)}")
        known = {d.name for d in self.detectors}
        unknown = sorted({s.detector for s in self.surfaces if s.detector is not None} - known)
        if unknown:
            raise ValueError(f"surfaces name unknown detectors: {', '.join(unknown)}")
        index = {e: i for i, s in enumerate(self.surfaces) for e in s.elements}
        object.__setattr__(self, "_by_element", index)

    @property
    def parts(self) -> tuple[str, ...]:
        """Names of the parts, in the order of their first surfaces."""
        return tuple(dict.fromkeys(s.part for s in self.surfaces))

    def of_element(self, element: str) -> int:
        """Number of the surface on which an element lies; KeyError when there is none."""
        return self._by_element[element]


def build_scenery(
    instrument: Instrument,
    state: State,
    finishes: scenery_parts.Finishes | None = None,
    baffles: Iterable[Plate] = (),
    whole_focal_planes: bool = False,
) -> Scenery:
    """Surfaces of an instrument in one state.

    Args:
        instrument: the instrument.
        state: what is perturbed.
        finishes: what surfaces do with light; by default those of ``Finishes``.
        baffles: more parts than the instrument's own.
        whole_focal_planes: make each focal plane one large detector, named ``CAMERA/focal_plane``, in the place
            of its CCDs and its board: for light from the scene.
    """
    finishes = finishes or scenery_parts.Finishes()
    assembly = instrument.assembly
    placed = assembly.place([state])
    glass = [
        surface
        for solid in instrument.solids
        for surface in scenery_parts.solid_surfaces(solid, assembly, placed, state, finishes)
    ]
    on_glass = {name for surface in glass for name in surface.elements}
    surfaces = [
        scenery_parts.mirror_surface(
            element, placed, finishes, _lit_side(instrument, element), state.get(element.body, AT_REST)
        )
        for element in assembly.elements.values()
        if element.interaction is Interaction.REFLECT and element.name not in on_glass
    ]
    surfaces += glass
    detectors: list[scenery_parts.Detector] = []
    for camera in instrument.cameras:
        more, grids = _focal_plane(instrument, camera, placed, finishes, whole_focal_planes)
        surfaces += more
        detectors += grids
    surfaces += scenery_parts.plate_surfaces((*instrument.baffles, *baffles), placed, finishes.baffle)
    return Scenery(tuple(surfaces), tuple(detectors))


def _lit_side(instrument: Instrument, element: Element) -> float:
    """+1 when light meets a mirror from its +z side, -1 from its -z side: where the neighbours in a sequence stand."""
    nominal = instrument.assembly.place()
    own = nominal.pose(element.body).inverse()
    for names in instrument.assembly.sequences.values():
        if element.name in names[1:]:
            before = instrument.assembly.elements[names[names.index(element.name, 1) - 1]]
            there = own.apply(nominal.pose(before.body).apply(_middle(before)))
            return float(np.sign(there[2] - _middle(element)[2]))
    return 1.0


def _middle(element: Element) -> np.ndarray:
    """Where the middle of an element's clear aperture lies on its surface, in its own frame, (3,), metres."""
    x, y = (0.0, 0.0) if element.aperture is None else element.aperture.centre
    return np.array([x, y, float(element.surface.sag(x, y))])


def _reach(instrument: Instrument, camera: str) -> tuple[float, float]:
    """Half the size of a focal plane's board, metres."""
    line = instrument.cameras[camera].spec.line
    channels = [c for c in instrument.channels if c.camera == camera]
    half_line = 0.5 * line.pixels * line.pitch
    x = max((abs(c.pinhole[0]) for c in channels), default=0.0)
    return x + BOARD_EDGE, max(half_line, *(abs(c.ccd[1]) for c in channels)) + BOARD_EDGE


def _focal_plane(
    instrument: Instrument, camera: str, placed: PlacedBodies, finishes: scenery_parts.Finishes, whole: bool
) -> tuple[list[scenery_parts.SceneSurface], list[scenery_parts.Detector]]:
    """Detectors of one focal plane and the board behind them."""
    model = instrument.cameras[camera]
    body = f"{BASE}/{camera}/focal_plane"
    line, element = model.spec.line, f"{camera}/line"
    channels = [c for c in instrument.channels if c.camera == camera]
    reach_x, reach_y = _reach(instrument, camera)
    facing = placed.pose(body) @ FACING_THE_LIGHT
    if whole:
        pitch = 1e-3
        name = f"{camera}/focal_plane"
        grid = scenery_parts.Detector(name, round(2.0 * reach_x / pitch), round(2.0 * reach_y / pitch), (pitch, pitch))
        return [scenery_parts.detector_surface(grid, facing, finishes, (element,))], [grid]
    chip = line_body(f"{BASE}/{camera}")
    pitch = line.pitch * float(placed.size(chip)[0])
    grids = [scenery_parts.Detector(element, 1, line.pixels, (pitch, pitch))]
    surfaces = [scenery_parts.detector_surface(grids[0], placed.pose(chip) @ FACING_THE_LIGHT, finishes, (element,))]
    ccd = instrument.spec.autocollimator.area_ccd
    for channel in channels:
        name = f"{channel.key}/area_ccd"
        pitch = ccd.pitch * float(placed.size(channel.ccd_body)[0])
        grid = scenery_parts.Detector(name, ccd.columns, ccd.rows, (pitch, pitch))
        grids.append(grid)
        surfaces.append(scenery_parts.detector_surface(grid, placed.pose(channel.ccd_body), finishes, (name,)))
    board = Pose(np.eye(3), np.array([0.0, 0.0, BOARD]))
    plate = Plate(f"{camera}/board", body, board, Rectangle(reach_x, reach_y), finishes.board)
    return surfaces + scenery_parts.plate_surfaces([plate], placed), grids
