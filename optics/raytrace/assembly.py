"""Optical elements on the rigid-body tree, and the sequences in which light meets them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import cached_property
from typing import Any

import numpy as np

from optics.geometry.aperture import Aperture, Edge, outer_edge
from optics.geometry.pose import Pose
from optics.geometry.surface import GridFigure, SummedFigure, Surface, ZernikeFigure
from optics.geometry.tree import AT_REST, Motion, PlacedBodies, RigidTree, State
from optics.numerics.number_tree import FrozenMap


class Interaction(Enum):
    """Interaction of a ray with a surface: reflection, refraction, total reflection, or none."""

    REFLECT = "reflect"
    REFRACT = "refract"
    PASS = "pass"
    TOTAL = "total"
    """Total internal reflection in glass; a ray whose angle of incidence is below the critical angle is lost."""

    # hash by identity: hashing by name makes looking up a recorded trace as slow as launching it
    __hash__ = object.__hash__


@dataclass(frozen=True)
class Element:
    """Optical surface in an assembly.

    Attributes
    ----------
    name : str
        Unique name, e.g. ``forward/M1``.
    body : str
        Path of the rigid body that carries it; the surface's frame is the body's frame.
    surface : Surface
        Shape of the surface.
    interaction : Interaction
        Reflection, refraction, total reflection or passage.
    aperture : Circle, Rectangle or Ellipse, optional
        Clear aperture in the surface's x, y, outside of which rays are lost; None is unlimited.
    edges : tuple of Edge
        Edges that the surface's file gives for its clear aperture. The trace lets rays pass them; images remove the
        blocked parts from the pupil, and figures are defined over the part that remains.
    index_after : float
        Refractive index on the side the light goes to (the index before is that of the element before it); for surfaces
        that are not faces of a solid.
    solid : str, optional
        Path of the glass body whose face this is, behind it (on its -z side). A refracted ray enters it when it comes
        from outside and leaves it when it comes from inside; the index is the assembly's for that solid.
    """

    name: str
    body: str
    surface: Surface
    interaction: Interaction
    aperture: Aperture | None = None
    index_after: float = 1.0
    solid: str | None = None
    edges: tuple[Edge, ...] = ()

    @property
    def outer_edge(self) -> Aperture | None:
        """Outer edge of the clear aperture: the smallest that its file gives, else that of ``aperture``."""
        return outer_edge(self.aperture, self.edges)

    def clear(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the mask of points of the surface, in its own x and y, that lie in its clear aperture."""
        outer = self.outer_edge
        inside = np.ones(np.shape(x), bool) if outer is None else np.asarray(outer.contains(x, y))
        return inside & np.all([edge.passes(x, y) for edge in self.edges], axis=0)

    @property
    def figure_disk(self) -> ZernikeFigure:
        """Zernike figure to whose disk the Zernike terms of a perturbed state refer (``Surface.figure_disk``).

        Raises
        ------
        ValueError
            There is neither a Zernike figure nor an aperture to define the disk.
        """
        outer = self.outer_edge
        if outer is None and self.surface.zernike_figure is None:
            raise ValueError(f"element {self.name!r} needs an aperture, which defines the disk of a figure")
        return self.surface.figure_disk(outer)

    def figured(self, motion: Motion) -> Surface:
        """Return the surface with the changes of radius, conic constant and figure error that a motion of its body has.

        Raises
        ------
        ValueError
            No disk is defined for the figure, or two grids have different samples.
        """
        surface = self.surface
        if motion.radius or motion.conic:
            surface = replace(
                surface, curvature=surface.curvature / (1.0 + motion.radius), conic=surface.conic + motion.conic
            )
        if not motion.figure and motion.grid is None:
            return surface
        grid = self.grid_in(motion)
        if not motion.figure and surface.zernike_figure is None:
            return surface.with_figure(grid)
        disk = self.figure_disk
        terms = {**disk.terms}
        for j, amplitude in motion.figure.items():
            terms[j] = terms.get(j, 0.0) + amplitude
        figure = replace(disk, terms=terms)
        return surface.with_figure(figure if grid is None else SummedFigure(figure, grid))

    def grid_in(self, motion: Motion) -> GridFigure | None:
        """Return the sum of the grid figure of the surface and that of a motion; None without either.

        Raises
        ------
        ValueError
            They have different samples.
        """
        nominal = self.surface.grid_figure
        if nominal is None or motion.grid is None:
            return motion.grid if nominal is None else nominal
        try:
            return nominal.plus(motion.grid)
        except ValueError as error:
            raise ValueError(f"element {self.name!r}: {error}") from None


@dataclass(frozen=True)
class Assembly:
    """Optical elements on a tree of rigid bodies; immutable, "with" methods return a changed copy.

    Attributes
    ----------
    tree : RigidTree
        Nominal poses of all bodies.
    elements : mapping of str to Element
        Name -> element.
    sequences : mapping of str to tuple of str
        Name -> element names in the order in which light meets them (an element may occur twice).
    media : mapping of str to float
        Path of a glass body -> its refractive index in vacuum.
    above_d : mapping of str to float
        Path of a glass body of known dispersion -> that index minus the index at the d line (587.6 nm).
    """

    tree: RigidTree
    elements: Mapping[str, Element]
    sequences: Mapping[str, tuple[str, ...]]
    media: Mapping[str, float] = field(default_factory=FrozenMap)
    above_d: Mapping[str, float] = field(default_factory=FrozenMap)

    def __post_init__(self) -> None:
        """Make the mappings immutable, and check that every body and element that they name exists."""
        paths = set(self.tree.paths)
        for name, element in self.elements.items():
            if name != element.name:
                raise ValueError(f"element {element.name!r} has the key {name!r}; the two must be equal")
            if element.body not in paths:
                raise ValueError(f"element {name!r} is on unknown body {element.body!r}")
            if element.solid is not None and element.solid not in self.media:
                raise ValueError(f"element {name!r} is a face of {element.solid!r}, which has no refractive index")
        for path in self.media:
            if path not in paths:
                raise ValueError(f"a refractive index is given for unknown body {path!r}")
        for sequence, names in self.sequences.items():
            for name in names:
                if name not in self.elements:
                    raise ValueError(f"sequence {sequence!r} names unknown element {name!r}")
        object.__setattr__(self, "elements", FrozenMap(self.elements))
        object.__setattr__(self, "media", FrozenMap(self.media))
        object.__setattr__(self, "above_d", FrozenMap(self.above_d))
        object.__setattr__(self, "sequences", FrozenMap({k: tuple(v) for k, v in self.sequences.items()}))

    @cached_property
    def system_cache(self) -> dict[Any, Any]:
        """Cache of the numbers of the nominal elements, which ``optics.raytrace.system.assemble`` fills and reads."""
        return {}

    def index(self, solid: str, motion: Motion = AT_REST) -> float:
        """Return the vacuum refractive index of a glass body, changed by a motion, at the origin of its frame."""
        return self.media[solid] + motion.index + self.above_d.get(solid, 0.0) * motion.dispersion

    def sequence(self, name: str) -> tuple[Element, ...]:
        """Return the elements of a named sequence.

        Raises
        ------
        KeyError
            The sequence is unknown.
        """
        return tuple(self.elements[n] for n in self.sequences[name])

    def face(self, body: str) -> Element:
        """Return the optical surface of a body, the largest where several elements use it.

        Raises
        ------
        ValueError
            The body has none with a clear aperture.
        """
        candidates = [e for e in self.elements.values() if e.body == body and e.interaction is not Interaction.PASS]
        sizes = [(e.aperture.enclosing.radius, e) for e in candidates if e.aperture is not None]
        return max(sizes, key=lambda pair: pair[0])[1]

    def with_element(self, element: Element) -> Assembly:
        """Return a copy in which the element of that name is replaced or added."""
        return replace(self, elements={**self.elements, element.name: element})

    def with_nominal(self, state: State) -> Assembly:
        """Return the assembly whose nominal poses, surfaces and refractive indices are those of a state of this one.

        A state of the new assembly is applied on top of that state (``optics.geometry.tree.compose``).

        Parameters
        ----------
        state : mapping of str to Motion
            Body path -> motion without scale or expansion and without index gradients.

        Raises
        ------
        KeyError
            The state names an unknown body or pivot.
        ValueError
            A motion cannot be part of a nominal assembly, or a surface cannot carry a figure.
        """
        for path, motion in state.items():
            if any(motion.index_gradient):
                raise ValueError(f"{path}: a nominal state cannot have a gradient of the refractive index")
        elements = dict(self.elements)
        for name, element in self.elements.items():
            if element.body in state:
                elements[name] = replace(element, surface=element.figured(state[element.body]))
        media = {path: index + state[path].index if path in state else index for path, index in self.media.items()}
        return replace(self, tree=self.tree.with_nominal(state), elements=elements, media=media)

    def place(
        self, states: Sequence[State] = ({},), step: Sequence[tuple[str, str, int]] | None = None
    ) -> PlacedBodies:
        """Return the world poses of all bodies in each state, with an imaginary step for derivatives if one is given.

        Parameters
        ----------
        states : sequence of State
            S perturbed states.
        step : sequence of (str, str, int), optional
            One (body path, kind of motion, axis) per state, to which an imaginary step is added: the imaginary part
            divided by ``COMPLEX_STEP`` is the derivative.
        """
        return self.tree.place(states, step)

    def nominal_pose(self, body: str) -> Pose:
        """Return the world pose of a body in the unperturbed assembly."""
        return self.place().pose(body)


def points_to_world(placed: PlacedBodies, body: str, points: np.ndarray) -> np.ndarray:
    """Return the world positions of P material points of a body in each of S states, (S, P, 3), metres.

    They are complex where ``placed`` is.

    Parameters
    ----------
    placed : PlacedBodies
        World poses of the bodies in S states.
    body : str
        Path of the body.
    points : (P, 3) ndarray
        Points of its material, given by their positions on the nominal body, metres in its frame: they move apart as
        the body expands. A position in space in the body's frame, such as a ray's intersection, is transformed by its
        ``pose`` instead.
    """
    i = placed.index[body]
    scaled = placed.scale[:, i, None, None] * points
    return np.asarray(np.einsum("sij,spj->spi", placed.rotation[:, i], scaled) + placed.translation[:, i, None])
