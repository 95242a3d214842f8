"""Scene of the path tracer: every surface of an instrument in one perturbed state, with its finish.

A finish says how a surface reflects, transmits and scatters light. The surfaces are mirrors, faces of glass bodies,
plates and detectors, each with its exact shape, its finish, and triangles for the search of intersections. Figure
errors of mirrors and gradients of the refractive index are omitted: they deflect a ray by less than a microradian and
do not matter for stray light. So are motions of single footprints on a glass face. Bodies must stay 20 um apart from
each other.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from optics.geometry.aperture import Aperture, Circle, Rectangle
from optics.geometry.pose import Pose
from optics.geometry.solid import Coating, Face, Solid, solid_mesh
from optics.geometry.surface import Surface, plane
from optics.geometry.tree import AT_REST, Motion, PlacedBodies, State
from optics.materials import fresnel_scatter
from optics.raytrace.assembly import Assembly, Element, Interaction
from scenes.models.camera_model import line_body
from scenes.models.instrument_model import Instrument
from scenes.models.meshes import polygon_mesh, sheet_mesh
from scenes.specs.baffle import Plate
from scenes.specs.instrument import BASE
from scenes.specs.job_tables import FinishSpec
from scenes.specs.resolved import ResolvedJob
from scenes.yaml.finish_files import MeasuredScatter, read_bsdf, read_coating

LEAST_CLEARANCE = 1e-5
"""Distance beyond a surface at which a leaving path starts to look for the next one, in metres: some twenty rounding
errors of float32 coordinates of 4 m. For curved surfaces the distance between triangles and surface is added.
"""

IN_PLANE = 1e-9
"""Tolerance, in metres and radians, within which an element lies in a face."""


@dataclass(frozen=True)
class Finishes:
    """Finish of every kind of surface: how it reflects, transmits and scatters light.

    Attributes
    ----------
    mirror : Finish
        Optical side of the mirrors.
    mirror_back : Finish
        Back of the mirrors.
    coated, bare, ground : Finish
        Faces of glass bodies: anti-reflection coated, polished without coating, or ground.
    detector : Finish
        Light-sensitive faces.
    board : Finish
        Boards that carry the detectors.
    baffle : Finish or None
        Finish of all baffles; None if each has the finish of its own plate.
    metallised : Finish or None
        Mirror faces of glass bodies; None for the finish of the mirrors.
    """

    mirror: fresnel_scatter.Finish = fresnel_scatter.MIRROR
    mirror_back: fresnel_scatter.Finish = fresnel_scatter.BLACK
    coated: fresnel_scatter.Finish = fresnel_scatter.COATED
    bare: fresnel_scatter.Finish = fresnel_scatter.BARE
    ground: fresnel_scatter.Finish = fresnel_scatter.GROUND
    detector: fresnel_scatter.Finish = fresnel_scatter.SILICON
    board: fresnel_scatter.Finish = fresnel_scatter.BLACK
    baffle: fresnel_scatter.Finish | None = None
    metallised: fresnel_scatter.Finish | None = None

    def of(self, coating: Coating) -> fresnel_scatter.Finish:
        """Return the finish of a face of a glass body that has this coating."""
        return {
            Coating.MIRROR: self.mirror if self.metallised is None else self.metallised,
            Coating.TRANSMITTING: self.coated,
            Coating.TOTAL: self.bare,
            Coating.GROUND: self.ground,
        }[coating]


@dataclass(frozen=True)
class Detector:
    """Pixel grid in the frame of its surface: columns along x, rows along y, centred.

    Attributes
    ----------
    name : str
        Name of the surface and, where there is one, of the element.
    columns, rows : int
        Number of pixels.
    pitch : tuple[float, float]
        Pixel pitch along x and y, in metres.
    """

    name: str
    columns: int
    rows: int
    pitch: tuple[float, float]

    @property
    def shape(self) -> tuple[int, int]:
        """Number of rows and number of columns of its pixels."""
        return self.rows, self.columns


@dataclass(frozen=True, eq=False)
class SceneSurface:
    """Surface of a scene in one state.

    Attributes
    ----------
    name : str
        Unique name.
    part : str
        Name in the results (plates of one baffle share it).
    elements : tuple[str, ...]
        Names of the assembly's elements on it.
    pose : Pose
        Pose of its frame in the world.
    surface : Surface
        Shape, expanded as in the state.
    vertices : (V, 3) ndarray
        Coordinates of its V vertices in its frame, in metres.
    triangles : (T, 3) ndarray of int
        Vertex numbers of its T triangles.
    front, back, outside : Finish
        Finish on the +z side, on the -z side, and outside the clear apertures.
    apertures : tuple[Aperture, ...]
        Up to two clear apertures.
    ends : bool
        Whether the surface ends at the clear apertures; otherwise ``outside`` is the finish beyond them.
    solid : str or None
        Path of the glass body behind it (-z side).
    index : float
        Refractive index of that body.
    detector : str or None
        Name of the detector on its front, if there is one.
    clearance : float
        Distance beyond it at which a leaving path starts to look for the next surface, in metres.
    """

    name: str
    part: str
    elements: tuple[str, ...]
    pose: Pose
    surface: Surface
    vertices: np.ndarray
    triangles: np.ndarray
    front: fresnel_scatter.Finish
    back: fresnel_scatter.Finish
    outside: fresnel_scatter.Finish = fresnel_scatter.ABSORBER
    apertures: tuple[Aperture, ...] = ()
    ends: bool = True
    solid: str | None = None
    index: float = 1.0
    detector: str | None = None
    clearance: float = LEAST_CLEARANCE


def mirror_surface(
    element: Element, placed: PlacedBodies, finishes: Finishes, optical_side: float = 1.0, motion: Motion = AT_REST
) -> SceneSurface:
    """Return the surface of a reflecting element that is not a face of a solid.

    Parameters
    ----------
    element : Element
        Element with a clear aperture.
    placed : PlacedBodies
        Bodies of one state.
    finishes : Finishes
        Finishes of all kinds of surfaces.
    optical_side : float
        +1 if the optical side is +z, -1 if it is -z; the other one is the substrate's back.
    motion : Motion
        Motion of the mirror's body in that state, of which only the change of figure is used here.

    Raises
    ------
    ValueError
        The element has no clear aperture, or a figure that cannot be added (``Element.figured``).
    """
    if element.aperture is None:
        raise ValueError(f"{element.name}: a mirror of a scene needs a clear aperture")
    size = float(placed.size(element.body)[0])
    surface, aperture = element.figured(motion).scaled(size), element.aperture.scaled(size)
    vertices, triangles, apart = sheet_mesh(surface, aperture)
    optical, rear = finishes.mirror, finishes.mirror_back
    name, pose, sides = element.name, placed.pose(element.body), (optical, rear)
    sides = sides if optical_side > 0.0 else sides[::-1]
    limits: dict[str, Any] = {"apertures": (aperture,), "clearance": LEAST_CLEARANCE + apart}
    return SceneSurface(name, name, (name,), pose, surface, vertices, triangles, *sides, **limits)


def solid_surfaces(
    solid: Solid, assembly: Assembly, placed: PlacedBodies, state: State, finishes: Finishes
) -> list[SceneSurface]:
    """Return the faces of a glass body, named ``<solid>/<face>``.

    Outside its elements' clear apertures a face has the same coating, but paths there are not counted as nominal; a
    body that light does not enter is ground there.

    Raises
    ------
    ValueError
        A face carries more than two elements with apertures.
    """
    mesh = solid_mesh(solid, placed)
    pose_of_solid = placed.pose(solid.path)
    index = assembly.index(solid.path, state.get(solid.path, AT_REST)) if solid.transparent else 1.0
    nominal = assembly.place()
    out = []
    for face, polygon in zip(solid.faces, mesh.polygons, strict=True):
        if not len(polygon):
            continue
        elements = _elements_on(face, solid, assembly, nominal)
        scale = float(placed.size(face.body)[0])
        apertures = tuple(dict.fromkeys(aperture.scaled(scale) for _, aperture in elements if aperture is not None))
        if len(apertures) > 2:
            raise ValueError(f"{solid.path}: face {face.name!r} has {len(apertures)} clear apertures, not at most 2")
        pose = placed.pose(face.body) @ Pose(face.pose.rotation, scale * face.pose.translation)
        vertices, triangles = polygon_mesh(pose.inverse().apply(pose_of_solid.apply(polygon)))
        finish = finishes.of(face.coating)
        name = f"{solid.path}/{face.name}"
        names, mesh_of_face = tuple(name for name, _ in elements), (vertices, triangles)
        outside = finish if solid.transparent or not apertures else finishes.ground
        body: dict[str, Any] = {
            "apertures": apertures,
            "outside": outside,
            "ends": False,
            "solid": solid.path,
            "index": index,
        }
        out.append(SceneSurface(name, name, names, pose, plane(), *mesh_of_face, finish, finish, **body))
    return out


def _elements_on(
    face: Face, solid: Solid, assembly: Assembly, nominal: PlacedBodies
) -> list[tuple[str, Aperture | None]]:
    """Return the elements that lie in a face, with their clear apertures in the face's frame.

    An element may belong to a separate body that the face carries; the small motions of that body are ignored.
    """
    frame = (nominal.pose(face.body) @ face.pose).inverse()
    out: list[tuple[str, Aperture | None]] = []
    for element in assembly.elements.values():
        carried = element.body == face.body or element.body.startswith((f"{face.body}/", f"{solid.path}/"))
        if not (carried or element.solid == solid.path) or element.interaction is Interaction.PASS:
            continue
        pose = frame @ nominal.pose(element.body)
        if (
            abs(pose.translation[2]) > IN_PLANE
            or np.linalg.norm(pose.rotation[:2, 2]) > IN_PLANE
            or pose.rotation[2, 2] < 0.0
        ):
            continue
        aperture = element.aperture
        if aperture is not None:
            if abs(pose.rotation[0, 1]) > IN_PLANE and not isinstance(aperture, Circle):
                raise ValueError(f"{element.name}: its clear aperture is rotated relative to the face {face.name!r}")
            x, y, _ = pose.apply(np.array([*aperture.centre, 0.0]))
            aperture = replace(aperture, centre=(float(x), float(y)))
        out.append((element.name, aperture))
    return out


def plate_surfaces(
    plates: Iterable[Plate], placed: PlacedBodies, baffle: fresnel_scatter.Finish | None = None
) -> list[SceneSurface]:
    """Return the surfaces of baffle plates, named ``<name>/<number>``.

    Parameters
    ----------
    plates : iterable of Plate
        The plates.
    placed : PlacedBodies
        Poses of the bodies that carry them.
    baffle : Finish or None
        Finish of all plates; None for the finish of each plate.
    """
    out = []
    for number, plate in enumerate(plates):
        vertices, triangles, _ = sheet_mesh(plane(), plate.outline)
        pose, finish = placed.pose(plate.body) @ plate.pose, plate.finish if baffle is None else baffle
        shape = (plane(), vertices, triangles, finish, finish)
        name = f"{plate.name}/{number}"
        out.append(SceneSurface(name, plate.name, (), pose, *shape, apertures=(plate.outline,)))
    return out


def detector_surface(
    detector: Detector, pose: Pose, finishes: Finishes, elements: tuple[str, ...] = ()
) -> SceneSurface:
    """Return the light-sensitive face of a detector, which looks along its +z; its back has the board's finish."""
    half_x, half_y = 0.5 * detector.columns * detector.pitch[0], 0.5 * detector.rows * detector.pitch[1]
    outline = Rectangle(half_x, half_y)
    vertices, triangles, _ = sheet_mesh(plane(), outline)
    name, shape, finish = detector.name, (plane(), vertices, triangles), (finishes.detector, finishes.board)
    return SceneSurface(name, name, elements, pose, *shape, *finish, apertures=(outline,), detector=name)


RECIPROCAL_TO = 0.3
"""Rms of the relative change of a BSDF on exchange of its directions above which a warning is given."""


@dataclass(frozen=True, eq=False)
class MeasuredFinishes:
    """Finishes of a job of which some are measured.

    Attributes
    ----------
    finishes : Finishes
        Finishes of all surfaces, measured ones included.
    scatter : Mapping[str, MeasuredScatter]
        Kind of surface -> its table of scattering.
    coatings : Mapping[str, CoatingTable]
        Kind of surface -> its coating.
    """

    finishes: Finishes
    scatter: Mapping[str, MeasuredScatter]
    coatings: Mapping[str, fresnel_scatter.CoatingTable]

    def to_dict(self) -> dict[str, Any]:
        """Return a summary of the tables for stray.json: kind of surface -> numbers."""
        out: dict[str, dict[str, Any]] = {}
        for kind, scatter in self.scatter.items():
            angles = scatter.table.incidence
            rms = scatter.table.reciprocity()
            out.setdefault(kind, {})["bsdf"] = {
                "incidence_deg": np.degrees(angles).tolist(),
                "total_scatter": [scatter.table.total(float(angle)) for angle in angles],
                "total_scatter_stated": list(scatter.tis),
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
        """Return a warning for each table of scattering that is not reciprocal, with the rms of the difference."""
        out = []
        for kind, scatter in self.scatter.items():
            rms = scatter.table.reciprocity()
            if rms > RECIPROCAL_TO:
                out.append(
                    f"the BSDF of {kind} surfaces is not reciprocal: with its directions exchanged it differs by "
                    f"{100.0 * rms:.0f} % rms; it is used as measured, with the incident light of the measurement"
                )
        return tuple(out)


def measured_finishes(resolved: ResolvedJob) -> MeasuredFinishes | None:
    """Return the finishes of a job with measured ones, or None if it has none.

    Raises
    ------
    InputError
        A coating's table does not include the monitor's wavelength, or a table scatters more than is reflected.
    """
    stray = resolved.job.render.stray
    if stray is None or stray.finishes is None:
        return None
    built_in = Finishes()
    changed: dict[str, fresnel_scatter.Finish] = {}
    scatter: dict[str, MeasuredScatter] = {}
    coatings: dict[str, fresnel_scatter.CoatingTable] = {}
    for kind, spec in stray.finishes.by_kind.items():
        key = ("render", "stray", "finishes", kind)
        base = built_in.board if kind == "black" else getattr(built_in, kind)
        if spec.coating is not None:
            try:
                coatings[kind] = read_coating(spec.coating.table).at(resolved.instrument.autocollimator.wavelength)
            except ValueError as error:
                text = f"the monitor's wavelength is not in the coating's table: {error}"
                raise resolved.job.error(text, (*key, "coating"), value=spec.coating.table) from None
        if spec.bsdf is not None:
            scatter[kind] = read_bsdf(spec.bsdf.table)
        try:
            changed[kind] = _finish(base, spec, kind, scatter.get(kind), coatings.get(kind))
        except ValueError as error:
            allowed = "fractions of the incident light that add up to at most the reflectance"
            raise resolved.job.error(str(error), key, allowed=allowed) from None
    finishes = built_in
    if "mirror" in changed:
        # Glass keeps its built-in finish: its light arrives from inside, where finishes are not measured.
        finishes = replace(finishes, mirror=changed["mirror"], metallised=built_in.mirror)
    if "black" in changed:
        black = changed["black"]
        finishes = replace(finishes, mirror_back=black, board=black, baffle=black)
    for kind in ("coated", "detector"):
        if kind in changed:
            finishes = replace(finishes, **{kind: changed[kind]})
    return MeasuredFinishes(finishes, scatter, coatings)


def _finish(
    base: fresnel_scatter.Finish,
    spec: FinishSpec,
    kind: str,
    scatter: MeasuredScatter | None,
    coating: fresnel_scatter.CoatingTable | None,
) -> fresnel_scatter.Finish:
    """Return a built-in finish in which measured values replace its own."""
    if kind == "black":
        assert scatter is not None
        return fresnel_scatter.Finish(table=scatter.table, scattered_only=True)
    if spec.reflectance is not None:
        base = replace(base, reflectance=spec.reflectance)
    if coating is not None:
        base = replace(base, coating=coating)
    return base if scatter is None else replace(base, scatter=None, table=scatter.table)


BOARD = 0.002
BOARD_EDGE = 0.02
"""Distance of the board behind the detectors (``BOARD``), and its margin beyond them (``BOARD_EDGE``), in metres."""

FACING_THE_LIGHT = Pose(np.diag([-1.0, 1.0, -1.0]))
"""Pose of a detector that faces the light, in a focal plane's frame, along whose +Z light arrives."""


@dataclass(frozen=True, eq=False)
class Scenery:
    """All surfaces of a scene and its detectors; a surface's number is its index in ``surfaces``."""

    surfaces: tuple[SceneSurface, ...]
    detectors: tuple[Detector, ...] = ()
    _by_element: Mapping[str, int] = field(init=False)

    def __post_init__(self) -> None:
        """Raise ValueError for repeated names of surfaces, and for surfaces that name an unknown detector."""
        names = [s.name for s in self.surfaces]
        twice = sorted({n for n in names if names.count(n) > 1})
        if twice:
            raise ValueError(f"several surfaces have the same name: {', '.join(twice)}")
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
        """Return the number of the surface on which an element lies; raise KeyError if there is none."""
        return self._by_element[element]


def build_scenery(
    instrument: Instrument,
    state: State,
    finishes: Finishes | None = None,
    baffles: Iterable[Plate] = (),
    whole_focal_planes: bool = False,
) -> Scenery:
    """Return the surfaces of an instrument in one state.

    Parameters
    ----------
    instrument : Instrument
        The instrument.
    state : State
        Perturbed state.
    finishes : Finishes or None
        Finishes of the surfaces; by default those of ``Finishes``.
    baffles : iterable of Plate
        Plates in addition to the instrument's own.
    whole_focal_planes : bool
        Replace CCDs and board of each focal plane by one large detector, named ``CAMERA/focal_plane``, for light from
        the scene.
    """
    finishes = finishes or Finishes()
    assembly = instrument.assembly
    placed = assembly.place([state])
    glass = [
        surface for solid in instrument.solids for surface in solid_surfaces(solid, assembly, placed, state, finishes)
    ]
    on_glass = {name for surface in glass for name in surface.elements}
    surfaces = [
        mirror_surface(element, placed, finishes, _optical_side(instrument, element), state.get(element.body, AT_REST))
        for element in assembly.elements.values()
        if element.interaction is Interaction.REFLECT and element.name not in on_glass
    ]
    surfaces += glass
    detectors: list[Detector] = []
    for camera in instrument.cameras:
        more, grids = _focal_plane(instrument, camera, placed, finishes, whole_focal_planes)
        surfaces += more
        detectors += grids
    surfaces += plate_surfaces((*instrument.baffles, *baffles), placed, finishes.baffle)
    return Scenery(tuple(surfaces), tuple(detectors))


def _optical_side(instrument: Instrument, element: Element) -> float:
    """Return +1 if light meets a mirror from its +z side, -1 if from its -z side, by its neighbours in a sequence."""
    nominal = instrument.assembly.place()
    to_body = nominal.pose(element.body).inverse()
    for names in instrument.assembly.sequences.values():
        if element.name in names[1:]:
            before = instrument.assembly.elements[names[names.index(element.name, 1) - 1]]
            there = to_body.apply(nominal.pose(before.body).apply(_middle(before)))
            return float(np.sign(there[2] - _middle(element)[2]))
    return 1.0


def _middle(element: Element) -> np.ndarray:
    """Return the surface point at the middle of an element's clear aperture, in its own frame, (3,), in metres."""
    x, y = (0.0, 0.0) if element.aperture is None else element.aperture.centre
    return np.array([x, y, float(element.surface.sag(x, y))])


def _half_extent(instrument: Instrument, camera: str) -> tuple[float, float]:
    """Return half the size of a focal plane's board along its x and y, in metres."""
    line = instrument.cameras[camera].spec.line
    channels = [c for c in instrument.channels if c.camera == camera]
    half_line = 0.5 * line.pixels * line.pitch
    x = max((abs(c.pinhole[0]) for c in channels), default=0.0)
    return x + BOARD_EDGE, max(half_line, *(abs(c.ccd[1]) for c in channels)) + BOARD_EDGE


def _focal_plane(
    instrument: Instrument, camera: str, placed: PlacedBodies, finishes: Finishes, whole: bool
) -> tuple[list[SceneSurface], list[Detector]]:
    """Return the surfaces of one focal plane, detectors and the board behind them, and its detectors."""
    model = instrument.cameras[camera]
    body = f"{BASE}/{camera}/focal_plane"
    line, element = model.spec.line, f"{camera}/line"
    channels = [c for c in instrument.channels if c.camera == camera]
    half_x, half_y = _half_extent(instrument, camera)
    facing = placed.pose(body) @ FACING_THE_LIGHT
    if whole:
        pitch = 1e-3
        name = f"{camera}/focal_plane"
        grid = Detector(name, round(2.0 * half_x / pitch), round(2.0 * half_y / pitch), (pitch, pitch))
        return [detector_surface(grid, facing, finishes, (element,))], [grid]
    chip = line_body(f"{BASE}/{camera}")
    pitch = line.pitch * float(placed.size(chip)[0])
    grids = [Detector(element, 1, line.pixels, (pitch, pitch))]
    surfaces = [detector_surface(grids[0], placed.pose(chip) @ FACING_THE_LIGHT, finishes, (element,))]
    ccd = instrument.spec.autocollimator.area_ccd
    for channel in channels:
        name = f"{channel.key}/area_ccd"
        pitch = ccd.pitch * float(placed.size(channel.ccd_body)[0])
        grid = Detector(name, ccd.columns, ccd.rows, (pitch, pitch))
        grids.append(grid)
        surfaces.append(detector_surface(grid, placed.pose(channel.ccd_body), finishes, (name,)))
    board = Pose(np.eye(3), np.array([0.0, 0.0, BOARD]))
    plate = Plate(f"{camera}/board", body, board, Rectangle(half_x, half_y), finishes.board)
    return surfaces + plate_surfaces([plate], placed), grids
