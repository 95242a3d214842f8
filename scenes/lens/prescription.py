"""A sequential prescription as other optical programs write it: surfaces one after the other, each in its own frame."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from optics.geometry.aperture import Aperture
from optics.geometry.pose import Pose
from optics.geometry.surface import Surface
from optics.geometry.surface_edge import Edge
from optics.geometry.tree import Body, RigidTree
from optics.numerics.frozen_map import FrozenMap
from optics.raytrace.assembly import Assembly, Element, Interaction
from scenes.yaml.errors import InputError, Issue

SEQUENCE = "imaging"
"""Name of the way of the light in a prescription's assembly."""

FARTHEST = 1e8
"""An object beyond this distance is at infinity, metres; programs write it as 1e10 or 1e13 millimetres."""

Glasses = Mapping[str, Callable[[float], float]]
"""Name of a glass as ``glass_key`` makes it -> refractive index by wavelength, metres."""


@dataclass(frozen=True)
class Note:
    """What of a foreign file did not come along, or how it was taken.

    Attributes:
        line: of the file, counted from 1; 0 for the file as a whole.
        statement: as it stands there.
        text: what became of it.
    """

    line: int
    statement: str
    text: str

    def __str__(self) -> str:
        place = f"line {self.line}: " if self.line else ""
        return f"{place}{self.statement}: {self.text}" if self.statement else f"{place}{self.text}"


@dataclass(frozen=True, eq=False)
class LensSurface:
    """One surface of a prescription.

    Attributes:
        name: unique in it.
        pose: its frame in the prescription's, z along the axis that light enters along; metres.
        surface: its shape.
        interaction: reflects, refracts or lets pass.
        index: refractive index of what lies behind it for the light, at the prescription's wavelength.
        aperture: clear aperture, None for an unlimited one.
        edges: what cuts light there beside the clear aperture: obscurations, vanes.
        line: where it begins in the file.
        glass: name of what lies behind it, empty for the medium of the object.
    """

    name: str
    pose: Pose
    surface: Surface
    interaction: Interaction
    index: float = 1.0
    aperture: Aperture | None = None
    line: int = 0
    glass: str = ""
    edges: tuple[Edge, ...] = ()

    @property
    def every_edge(self) -> tuple[Edge, ...]:
        """The clear aperture among its edges."""
        return (*(() if self.aperture is None else (Edge(self.aperture),)), *self.edges)


@dataclass(frozen=True)
class Pupil:
    """How a file says how wide the beam is: by the diameter of the entrance pupil (metres), the F-number in image
    space, the numerical aperture in object space, or the radius of the stop (metres).

    Attributes:
        kind: ``diameter``, ``f_number``, ``object_na`` or ``stop``.
        value: of it.
        line: where it stands.
    """

    kind: str
    value: float
    line: int = 0


@dataclass(frozen=True, eq=False)
class Prescription:
    """A sequential system, in metres and radians.

    Frame: that of the first surface after the object, before its own decentre; light enters toward +z.

    Attributes:
        name: of the file's title, or of the file.
        file: its path, as the user gave it.
        surfaces: in the order of the light, the image last; planes that do nothing are left out.
        stop: index of the surface that is the aperture stop.
        wavelength: at which indices hold, metres.
        wavelengths: all that the file names, metres.
        fields: directions (x, y) from which light comes as their tangents' angles, radians; empty where the file has
            other fields than angles.
        field_kind: what the file's fields are, for messages.
        pupil: how wide the beam is; None where the file does not say.
        object_distance: from the object to the frame's origin, metres; infinite for a scene.
        notes: what did not come along.
    """

    name: str
    file: str
    surfaces: tuple[LensSurface, ...]
    stop: int
    wavelength: float
    wavelengths: tuple[float, ...] = ()
    fields: tuple[tuple[float, float], ...] = ()
    field_kind: str = "angles"
    pupil: Pupil | None = None
    object_distance: float = float("inf")
    notes: tuple[Note, ...] = ()

    @property
    def image(self) -> LensSurface:
        """The last surface."""
        return self.surfaces[-1]

    def error(
        self, problem: str, line: int | None = None, found: str | None = None, allowed: str | None = None
    ) -> InputError:
        """What is wrong with the file at a line."""
        return InputError(Issue(problem, self.file, line or None, (), found, allowed))

    def with_notes(self, *notes: Note) -> Prescription:
        """The same with more of them."""
        return replace(self, notes=(*self.notes, *notes))

    def assembly(self, apertures: bool = True) -> Assembly:
        """What the tracer traces: one body and one element for each surface, the way of the light as ``SEQUENCE``.

        Args:
            apertures: whether clear apertures stop rays.
        """
        bodies = tuple(Body(s.name, s.pose) for s in self.surfaces)
        elements = {
            s.name: Element(
                s.name, s.name, s.surface, s.interaction, s.aperture if apertures else None, index_after=s.index
            )
            for s in self.surfaces
        }
        return Assembly(RigidTree(bodies), elements, {SEQUENCE: tuple(s.name for s in self.surfaces)})


def glass_key(name: str) -> str:
    """A glass's name as it is looked for: letters and digits alone, without the maker's name behind ``_``.

    CODE V writes NBK7_SCHOTT for what Zemax and its makers call N-BK7.
    """
    head = name.strip("'\"").partition("_")[0] or name
    return "".join(c for c in head.upper() if c.isalnum())


@dataclass
class Chain:
    """Surfaces as a reader meets them, one frame after the other; a reader's own workspace.

    Attributes:
        pose: frame that the next surface stands in.
        surfaces: so far.
    """

    pose: Pose = field(default_factory=Pose)
    surfaces: list[LensSurface] = field(default_factory=list)

    def move(self, shift: Sequence[float] = (0.0, 0.0, 0.0), rotation: np.ndarray | None = None) -> None:
        """Go on in a frame that is shifted by a vector in the present axes and then turned about its own."""
        self.pose = self.pose @ Pose(np.eye(3) if rotation is None else rotation, np.array(shift, np.float64))

    def add(self, surface: LensSurface) -> None:
        """One more surface, under another name where its own is taken."""
        names = {s.name for s in self.surfaces}
        name, k = surface.name, 2
        while name in names:
            name, k = f"{surface.name}_{k}", k + 1
        self.surfaces.append(replace(surface, name=name))


NO_GLASSES: Glasses = FrozenMap()
