"""Elements on the tree of bodies, and the sequences in which light meets them."""

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
    """What happens to a ray at a surface."""

    REFLECT = "reflect"
    REFRACT = "refract"
    PASS = "pass"
    TOTAL = "total"
    """Total reflection inside glass; a ray that is not beyond the critical angle is lost."""

    # a member is one object; by its name, as Python has it, it takes as long to find a recorded trace as to launch it
    __hash__ = object.__hash__


@dataclass(frozen=True)
class Element:
    """One surface in the assembly.

    Attributes
    ----------
    name : str
        Unique name, e.g. ``forward/M1``.
    body : str
        Path of the rigid body that carries it; the surface's frame is the body's frame.
    surface : Surface
        Its shape.
    interaction : Interaction
        Reflect, refract or pass.
    aperture : Aperture | None
        Clear aperture in the surface's x, y, outside of which rays are lost; None is unlimited.
    edges : tuple[Edge, ...]
        What the surface's file states of its clear aperture. The trace lets rays pass them, and images cut them out of
        the pupil; figures are over what they leave.
    index_after : float
        Refractive index on the side the light goes to (the index before is that of the element before it); for surfaces
        that are not faces of a solid.
    solid : str | None
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
        """The outer edge of the clear aperture: the smallest that its file states, else that of ``aperture``."""
        return outer_edge(self.aperture, self.edges)

    def clear(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return which points of the surface, in its own x and y, lie in its clear aperture."""
        outer = self.outer_edge
        inside = np.ones(np.shape(x), bool) if outer is None else np.asarray(outer.contains(x, y))
        return inside & np.all([edge.passes(x, y) for edge in self.edges], axis=0)

    @property
    def figure_disk(self) -> ZernikeFigure:
        """Return what the terms of a state's figure are added to: ``Surface.figure_disk`` over the clear aperture.

        Raises
        ------
        ValueError
            Neither a Zernike figure nor an aperture sets the disk.
        """
        outer = self.outer_edge
        if outer is None and self.surface.zernike_figure is None:
            raise ValueError(f"element {self.name!r} needs an aperture to carry a figure: it sets the disk")
        return self.surface.figure_disk(outer)

    def figured(self, motion: Motion) -> Surface:
        """The surface with what a motion does to its radius and conic constant and adds to its figure.

        Raises
        ------
        ValueError
            Nothing sets the disk of that figure, or two grids stand on different samples.
        """
        own = self.surface
        if motion.radius or motion.conic:
            own = replace(own, curvature=own.curvature / (1.0 + motion.radius), conic=own.conic + motion.conic)
        if not motion.figure and motion.grid is None:
            return own
        grid = self.grid_in(motion)
        if not motion.figure and own.zernike_figure is None:
            return own.with_figure(grid)
        disk = self.figure_disk
        terms = {**disk.terms}
        for j, amplitude in motion.figure.items():
            terms[j] = terms.get(j, 0.0) + amplitude
        whole = replace(disk, terms=terms)
        return own.with_figure(whole if grid is None else SummedFigure(whole, grid))

    def grid_in(self, motion: Motion) -> GridFigure | None:
        """The grid figure of the surface with the one that a motion adds to it.

        Raises
        ------
        ValueError
            They stand on different samples.
        """
        own = self.surface.grid_figure
        if own is None or motion.grid is None:
            return motion.grid if own is None else own
        try:
            return own.plus(motion.grid)
        except ValueError as error:
            raise ValueError(f"element {self.name!r}: {error}") from None


@dataclass(frozen=True)
class Assembly:
    """Optical elements on a tree of rigid bodies; immutable, "with" methods return a changed copy.

    Attributes
    ----------
    tree : RigidTree
        Where everything stands.
    elements : Mapping[str, Element]
        Name -> element.
    sequences : Mapping[str, tuple[str, ...]]
        Name -> element names in the order in which light meets them (an element may come twice).
    media : Mapping[str, float]
        Path of a glass body -> its refractive index in vacuum.
    above_d : Mapping[str, float]
        Path of a glass body whose dispersion is known -> that index less the one at the d line.
    """

    tree: RigidTree
    elements: Mapping[str, Element]
    sequences: Mapping[str, tuple[str, ...]]
    media: Mapping[str, float] = field(default_factory=FrozenMap)
    above_d: Mapping[str, float] = field(default_factory=FrozenMap)

    def __post_init__(self) -> None:
        """Freeze and check that every name exists."""
        paths = set(self.tree.paths)
        for name, element in self.elements.items():
            if name != element.name:
                raise ValueError(f"element {element.name!r} is filed under {name!r}")
            if element.body not in paths:
                raise ValueError(f"element {name!r} stands on unknown body {element.body!r}")
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
    def worked_out(self) -> dict[Any, Any]:
        """What ``optics.raytrace.system.assemble`` keeps of the elements as designed, by its own keys."""
        return {}

    def index(self, solid: str, motion: Motion = AT_REST) -> float:
        """Refractive index of a glass body with a motion, where its own frame begins."""
        return self.media[solid] + motion.index + self.above_d.get(solid, 0.0) * motion.dispersion

    def sequence(self, name: str) -> tuple[Element, ...]:
        """The elements of a named sequence.

        Raises
        ------
        KeyError
            Unknown sequence.
        """
        return tuple(self.elements[n] for n in self.sequences[name])

    def face(self, body: str) -> Element:
        """Return the optical surface of a body, the widest where several elements use it.

        Raises
        ------
        ValueError
            The body has none with a clear aperture.
        """
        own = [e for e in self.elements.values() if e.body == body and e.interaction is not Interaction.PASS]
        sizes = [(e.aperture.enclosing.radius, e) for e in own if e.aperture is not None]
        return max(sizes, key=lambda one: one[0])[1]

    def with_element(self, element: Element) -> Assembly:
        """A copy in which the element of that name is replaced or added."""
        return replace(self, elements={**self.elements, element.name: element})

    def standing(self, state: State) -> Assembly:
        """The assembly that is by itself as this one is in a state: poses of bodies, shapes of surfaces and refractive
        indices of glass bodies.

        States of it come on top, as ``optics.geometry.tree.compose`` has it.

        Parameters
        ----------
        state : State
            Body path -> motion without growth and without gradients of an index.

        Raises
        ------
        KeyError
            It names an unknown body or pivot.
        ValueError
            a motion that no assembly can have by itself, or a figure on a surface that cannot carry it.
        """
        for path, motion in state.items():
            if any(motion.index_gradient):
                raise ValueError(f"{path}: an assembly has no gradients of refractive indices by itself")
        return replace(
            self,
            tree=self.tree.standing(state),
            elements={
                name: replace(element, surface=element.figured(state[element.body]))
                if element.body in state
                else element
                for name, element in self.elements.items()
            },
            media={path: index + state[path].index if path in state else index for path, index in self.media.items()},
        )

    def place(
        self, states: Sequence[State] = ({},), step: Sequence[tuple[str, str, int]] | None = None
    ) -> PlacedBodies:
        """World poses of all bodies for each state; see ``RigidTree.place``."""
        return self.tree.place(states, step)

    def nominal_pose(self, body: str) -> Pose:
        """World pose of a body in the unperturbed assembly."""
        return self.place().pose(body)


def points_to_world(placed: PlacedBodies, body: str, points: np.ndarray) -> np.ndarray:
    """Where points of a body are in each state, world, (S, P, 3), metres; complex where ``placed`` is.

    Parameters
    ----------
    placed : PlacedBodies
        The bodies.
    body : str
        Its path.
    points : np.ndarray
        Of its material, named by their places on the nominal body, (P, 3), metres in its frame: they move apart as the
        body grows. A place in space that is told in the body's frame, as a ray's hit, takes its ``pose``.
    """
    i = placed.index[body]
    grown = placed.scale[:, i, None, None] * points
    return np.asarray(np.einsum("sij,spj->spi", placed.rotation[:, i], grown) + placed.translation[:, i, None])
