"""Surfaces of a scene in one perturbed state: mirrors, faces of glass bodies, plates and detectors, each with its exact
shape, its finish, and triangles that decide what a path hits.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from optics.geometry.aperture import Aperture, Circle, Rectangle
from optics.geometry.pose import Pose
from optics.geometry.solid import Coating, Face, Solid, solid_mesh
from optics.geometry.surface import Surface, plane
from optics.geometry.tree import AT_REST, Motion, PlacedBodies, State
from optics.materials.scatter import ABSORBER, BARE, BLACK, COATED, GROUND, MIRROR, SILICON, Finish
from optics.raytrace.assembly import Assembly, Element, Interaction
from scenes.models.meshes import polygon_mesh, sheet_mesh
from scenes.specs.baffle import Plate

LEAST_CLEARANCE = 1e-5
"""How far beyond a surface that it leaves a path looks for the next one, metres: some twenty roundings of float32 at
4 m; for curved surfaces so much more as the triangles depart from them."""

IN_PLANE = 1e-9
"""How well an element lies in a face when it is taken to be on it, metres and radians."""


@dataclass(frozen=True)
class Finishes:
    """Finish of every kind of surface.

    Attributes:
        mirror: optical side of the mirrors; mirror_back: their back.
        metallised: mirror faces of glass bodies, None for that of the mirrors.
        coated, bare, ground: faces of glass bodies, see ``Coating``.
        detector: light-sensitive faces; board: what carries them.
        baffle: of baffles, None for each one's own.
    """

    mirror: Finish = MIRROR
    mirror_back: Finish = BLACK
    coated: Finish = COATED
    bare: Finish = BARE
    ground: Finish = GROUND
    detector: Finish = SILICON
    board: Finish = BLACK
    baffle: Finish | None = None
    metallised: Finish | None = None

    def of(self, coating: Coating) -> Finish:
        """The finish of a glass face."""
        return {
            Coating.MIRROR: self.mirror if self.metallised is None else self.metallised,
            Coating.TRANSMITTING: self.coated,
            Coating.TOTAL: self.bare,
            Coating.GROUND: self.ground,
        }[coating]


@dataclass(frozen=True)
class Detector:
    """A pixel grid in the frame of its surface: columns along x, rows along y, centred.

    Attributes:
        name: of the surface and, where there is one, of the element.
        columns, rows: number of pixels.
        pitch: along x and y, metres.
    """

    name: str
    columns: int
    rows: int
    pitch: tuple[float, float]

    @property
    def shape(self) -> tuple[int, int]:
        """Rows, columns."""
        return self.rows, self.columns


@dataclass(frozen=True, eq=False)
class SceneSurface:
    """One surface in one state.

    Attributes:
        name: unique; part: what it is called in the results (plates of one baffle share it).
        elements: names of the assembly's elements on it.
        pose: of its frame in the world, float64.
        surface: shape, grown as the state says.
        vertices, triangles: (V, 3) in its frame, metres, and (T, 3).
        front, back, outside: finish met from +z, from -z, and outside the clear apertures.
        apertures: none, one or two clear apertures.
        ends: nothing is there outside the clear apertures (else ``outside`` is).
        solid: path of the glass body behind it (-z side), and ``index``, that body's refractive index.
        detector: name of the detector on its front, None for none.
        clearance: how far beyond it a leaving path looks for the next surface, metres.
    """

    name: str
    part: str
    elements: tuple[str, ...]
    pose: Pose
    surface: Surface
    vertices: np.ndarray
    triangles: np.ndarray
    front: Finish
    back: Finish
    outside: Finish = ABSORBER
    apertures: tuple[Aperture, ...] = ()
    ends: bool = True
    solid: str | None = None
    index: float = 1.0
    detector: str | None = None
    clearance: float = LEAST_CLEARANCE


def mirror_surface(
    element: Element, placed: PlacedBodies, finishes: Finishes, lit_side: float = 1.0, motion: Motion = AT_REST
) -> SceneSurface:
    """The surface of a reflecting element that is not a face of a solid.

    Args:
        element: with a clear aperture.
        placed: bodies of one state.
        finishes: what surfaces do with light.
        lit_side: +1 when the optical side is +z, -1 when it is -z; the other one is the substrate's back.
        motion: of the mirror's body in that state; only what it adds to the figure is taken from it.

    Raises:
        ValueError: no clear aperture, or a figure that cannot be added (``Element.figured``).
    """
    if element.aperture is None:
        raise ValueError(f"{element.name}: a mirror without a clear aperture cannot stand in a scene")
    size = float(placed.size(element.body)[0])
    surface, aperture = element.figured(motion).grown(size), element.aperture.grown(size)
    vertices, triangles, apart = sheet_mesh(surface, aperture)
    optical, rear = finishes.mirror, finishes.mirror_back
    return SceneSurface(
        element.name,
        element.name,
        (element.name,),
        placed.pose(element.body),
        surface,
        vertices,
        triangles,
        front=optical if lit_side > 0.0 else rear,
        back=rear if lit_side > 0.0 else optical,
        apertures=(aperture,),
        clearance=LEAST_CLEARANCE + apart,
    )


def solid_surfaces(
    solid: Solid, assembly: Assembly, placed: PlacedBodies, state: State, finishes: Finishes
) -> list[SceneSurface]:
    """The faces of a glass body, named ``<solid>/<face>``.

    Outside its elements' clear apertures a face has the same coating, but the path counts as another one than the
    nominal; a body that light does not enter is ground there.

    Raises:
        ValueError: a face carries more than two elements with apertures.
    """
    mesh = solid_mesh(solid, placed)
    own = placed.pose(solid.path)
    index = assembly.index(solid.path, state.get(solid.path, AT_REST)) if solid.transparent else 1.0
    nominal = assembly.place()
    out = []
    for face, polygon in zip(solid.faces, mesh.polygons, strict=True):
        if not len(polygon):
            continue
        on_it = _elements_on(face, solid, assembly, nominal)
        scale = float(placed.size(face.body)[0])
        apertures = tuple(dict.fromkeys(aperture.grown(scale) for _, aperture in on_it if aperture is not None))
        if len(apertures) > 2:
            raise ValueError(f"{solid.path}: face {face.name!r} has {len(apertures)} clear apertures; at most two")
        pose = placed.pose(face.body) @ Pose(face.pose.rotation, scale * face.pose.translation)
        vertices, triangles = polygon_mesh(pose.inverse().apply(own.apply(polygon)))
        finish = finishes.of(face.coating)
        name = f"{solid.path}/{face.name}"
        out.append(
            SceneSurface(
                name,
                name,
                tuple(name for name, _ in on_it),
                pose,
                plane(),
                vertices,
                triangles,
                front=finish,
                back=finish,
                outside=finish if solid.transparent or not apertures else finishes.ground,
                apertures=apertures,
                ends=False,
                solid=solid.path,
                index=index,
            )
        )
    return out


def _elements_on(
    face: Face, solid: Solid, assembly: Assembly, nominal: PlacedBodies
) -> list[tuple[str, Aperture | None]]:
    """Elements that lie in a face, with their clear apertures in the face's frame.

    An element may stand on a body of its own that the face carries; its own small motions are left out.
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
                raise ValueError(f"{element.name}: its clear aperture is turned against the face {face.name!r}")
            x, y, _ = pose.apply(np.array([*aperture.centre, 0.0]))
            aperture = replace(aperture, centre=(float(x), float(y)))
        out.append((element.name, aperture))
    return out


def plate_surfaces(plates: Iterable[Plate], placed: PlacedBodies, baffle: Finish | None = None) -> list[SceneSurface]:
    """The surfaces of baffles, named ``<name>/<number>``, with a finish for all or each its own."""
    out = []
    for number, plate in enumerate(plates):
        vertices, triangles, _ = sheet_mesh(plane(), plate.outline)
        out.append(
            SceneSurface(
                f"{plate.name}/{number}",
                plate.name,
                (),
                placed.pose(plate.body) @ plate.pose,
                plane(),
                vertices,
                triangles,
                plate.finish if baffle is None else baffle,
                plate.finish if baffle is None else baffle,
                apertures=(plate.outline,),
            )
        )
    return out


def detector_surface(
    detector: Detector, pose: Pose, finishes: Finishes, elements: tuple[str, ...] = ()
) -> SceneSurface:
    """The light-sensitive face of a detector, which looks along its +z; its back is the board's."""
    half_x, half_y = 0.5 * detector.columns * detector.pitch[0], 0.5 * detector.rows * detector.pitch[1]
    outline = Rectangle(half_x, half_y)
    vertices, triangles, _ = sheet_mesh(plane(), outline)
    return SceneSurface(
        detector.name,
        detector.name,
        elements,
        pose,
        plane(),
        vertices,
        triangles,
        front=finishes.detector,
        back=finishes.board,
        apertures=(outline,),
        detector=detector.name,
    )
