"""Numbers of one element of a sequence, in all states: its frame, its surface, its aperture and the indices beside it.

What decides the code of a kernel, as against the numbers that it works on, is a `Structure`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from optics.geometry import zernike
from optics.geometry.aperture import ApertureNumbers
from optics.geometry.sag_terms import SagTerm, grown, kinds_of, of_kinds
from optics.geometry.surface import (
    Figure,
    FigureNumbers,
    GridFigure,
    GridNumbers,
    SummedFigure,
    SurfaceNumbers,
    ZernikeFigure,
)
from optics.geometry.tree import AT_REST, COMPLEX_STEP, FIGURE, PlacedBodies, State
from optics.numerics.number_tree import map_leaves
from optics.raytrace.assembly import Assembly, Element, Interaction


@dataclass(frozen=True)
class Structure:
    """What decides the code of the kernel (as against the numbers that it works on), for one element."""

    interaction: Interaction
    plane: bool
    even: int
    terms: tuple[type[SagTerm], ...]  # kinds of further terms of the sag
    figure_order: int  # radial order of the Zernike figure, -1 for none
    grid: bool
    aperture: type[ApertureNumbers] | None
    graded: tuple[bool, bool] = (False, False)  # whether the medium before and the one after has an index gradient


@dataclass(frozen=True, eq=False)
class CoordinateNumbers:
    """One coordinate of a rigid transform: ``shift`` + ``turn`` . p, metres."""

    shift: Any
    turn: tuple[Any, Any, Any]


@dataclass(frozen=True, eq=False)
class FrameNumbers:
    """A rigid transform of points, coordinate by coordinate."""

    x: CoordinateNumbers
    y: CoordinateNumbers
    z: CoordinateNumbers

    @classmethod
    def of(cls, rotation: np.ndarray, translation: np.ndarray) -> FrameNumbers:
        """From arrays (S, 3, 3) and (S, 3)."""
        rows = ((rotation[:, a, 0], rotation[:, a, 1], rotation[:, a, 2]) for a in range(3))
        return cls(*(CoordinateNumbers(translation[:, a], row) for a, row in enumerate(rows)))

    @property
    def coordinates(self) -> tuple[CoordinateNumbers, CoordinateNumbers, CoordinateNumbers]:
        """Of x, y and z."""
        return self.x, self.y, self.z


@dataclass(frozen=True, eq=False)
class IndexNumbers:
    """Refractive index of a medium: ``index`` + ``gradient`` . p at p in the element's frame; no gradient: None."""

    index: Any
    gradient: tuple[Any, Any, Any] | None = None


@dataclass(frozen=True, eq=False)
class ElementNumbers:
    """All that the trace reads of one element.

    Attributes:
        frame: from the frame of the element before (the world for the first) into this element's.
        surface: its shape; aperture: its clear aperture, None for an unlimited one.
        before, after: refractive index on the side that light comes from and on the one that it goes to.
    """

    frame: FrameNumbers
    surface: SurfaceNumbers
    aperture: ApertureNumbers | None
    before: IndexNumbers
    after: IndexNumbers


@dataclass(frozen=True)
class Medium:
    """What light travels in: a glass body of the assembly, or something homogeneous of a given index."""

    solid: str | None = None
    index: float = 1.0


def media_along(chain: Sequence[Element]) -> list[Medium]:
    """The medium before the first element, between the elements and after the last one."""
    out = [Medium()]
    for element in chain:
        before = out[-1]
        if element.interaction is Interaction.REFRACT and element.solid is not None:
            out.append(Medium() if before.solid == element.solid else Medium(element.solid))
        elif element.solid is not None or before.solid is not None:
            out.append(before)
        else:
            out.append(Medium(None, element.index_after))
    return out


def structure_of(elements: Sequence[Element], states: Sequence[State], graded: tuple[bool, bool]) -> Structure:
    """Common structure of the i-th elements of all chains."""
    grid = any(_has_grid(e, states) for e in elements)
    kinds = {
        (
            e.interaction,
            e.surface.is_plane,
            None if e.aperture is None else type(e.aperture.numbers()),
        )
        for e in elements
    }
    if len(kinds) != 1:
        raise ValueError(
            f"elements of different kinds cannot be batched: {', '.join(sorted(e.name for e in elements))}"
        )
    interaction, is_plane, aperture = kinds.pop()
    # a plane may have terms that are zero, and the terms that a surface lacks are
    terms = kinds_of([term for e in elements for term in e.surface.terms])
    even = 0 if is_plane else max(len(e.surface.even) for e in elements)
    order = -1
    for e in elements:
        if e.surface.zernike_figure is not None:
            order = max(order, zernike.order_of(e.surface.zernike_figure.terms))
        for state in states:
            motion = state.get(e.body)
            if motion is not None and motion.figure:
                order = max(order, zernike.order_of(motion.figure))
    return Structure(interaction, is_plane, even, terms, order, grid, aperture, graded)


def _known_figure(element: Element) -> Figure | None:
    """The figure of an element's surface; ValueError for one that the trace would leave out."""
    match element.surface.figure:
        case None | ZernikeFigure() | GridFigure() | SummedFigure() as figure:
            return figure
        case other:
            raise ValueError(f"element {element.name!r}: the trace knows no figure of type {type(other).__name__}")


def _has_grid(element: Element, states: Sequence[State]) -> bool:
    """Whether a surface has a figure on a grid, of its own or in some state."""
    _known_figure(element)
    own = element.surface.grid_figure is not None
    return own or any(state.get(element.body, AT_REST).grid is not None for state in states)


def touched_bodies(assembly: Assembly, states: Sequence[State], placed: PlacedBodies) -> set[str]:
    """Bodies that some state names, or that stand or are otherwise than designed because their carriers do."""
    nominal = assembly.place()
    other = np.any(placed.rotation != nominal.rotation, axis=(0, 2, 3))
    other |= np.any(placed.translation != nominal.translation, axis=(0, 2))
    other |= np.any(placed.scale != nominal.scale, axis=0)
    return {path for path, i in placed.index.items() if other[i]}.union(*states)


def bodies_of(chain: Sequence[Element], i: int, media: Sequence[Medium]) -> set[str]:
    """Bodies on which the numbers of element i of a chain depend."""
    bodies = {chain[i].body, *(medium.solid for medium in media[i : i + 2] if medium.solid is not None)}
    return bodies | {chain[i - 1].body} if i else bodies


def numbers_of(
    assembly: Assembly,
    chain: Sequence[Element],
    i: int,
    media: Sequence[Medium],
    structure: Structure,
    states: Sequence[State],
    placed: PlacedBodies,
    step: Sequence[tuple[str, str, int]] | None,
) -> ElementNumbers:
    """Numbers of element i of a chain, each of shape (S,), complex when a derivative is carried."""
    element = chain[i]
    body = placed.index[element.body]
    rotation, translation = placed.rotation[:, body], placed.translation[:, body]
    if i == 0:
        relative = np.swapaxes(rotation, -1, -2)
        offset = -np.einsum("sij,si->sj", rotation, translation)
    else:
        before = placed.index[chain[i - 1].body]
        relative = np.einsum("ski,skj->sij", rotation, placed.rotation[:, before])
        offset = np.einsum("ski,sk->si", rotation, placed.translation[:, before] - translation)
    scale = placed.scale[:, body]
    sides = zip(media[i : i + 2], structure.graded, strict=True)
    outer, inner = (_index_numbers(assembly, element, medium, graded, states, placed) for medium, graded in sides)
    return ElementNumbers(
        FrameNumbers.of(relative, offset),
        _surface_numbers(element, structure, scale, states, step),
        # an edge has no derivative: it lets a ray pass or stops it
        None if element.aperture is None else element.aperture.numbers(scale.real),
        outer,
        inner,
    )


def _index_numbers(
    assembly: Assembly,
    element: Element,
    medium: Medium,
    graded: bool,
    states: Sequence[State],
    placed: PlacedBodies,
) -> IndexNumbers:
    """Index (S,) of a medium beside an element, with its gradient in the element's frame where it is graded."""
    if medium.solid is None:
        index = np.full(len(states), medium.index)
        gradient = np.zeros((len(states), 3)) if graded else None
    else:
        motions = [state.get(medium.solid, AT_REST) for state in states]
        index = assembly.media[medium.solid] + np.array([m.index for m in motions])
        gradient = None
        if graded:
            here, glass = placed.index[element.body], placed.index[medium.solid]
            own = np.array([m.index_gradient for m in motions])
            world = np.einsum("sij,sj->si", placed.rotation[:, glass], own)
            gradient = np.einsum("sji,sj->si", placed.rotation[:, here], world)
            away = placed.translation[:, here] - placed.translation[:, glass]
            index = index + np.einsum("si,si->s", world, away)
    return IndexNumbers(index, None if gradient is None else (gradient[:, 0], gradient[:, 1], gradient[:, 2]))


def _surface_numbers(
    element: Element,
    structure: Structure,
    scale: np.ndarray,
    states: Sequence[State],
    step: Sequence[tuple[str, str, int]] | None,
) -> SurfaceNumbers:
    surface, count = element.surface, len(states)
    curvature, conic, even = None, None, []
    if not structure.plane:
        curvature, conic = surface.curvature / scale, np.full(count, surface.conic)
        for n in range(structure.even):
            term = surface.even[n] if n < len(surface.even) else 0.0
            even.append(term / scale ** (2 * n + 3))
    terms = tuple(grown(term, scale) for term in of_kinds(surface.terms, structure.terms))
    figure = _figure_numbers(element, structure.figure_order, states, step) if structure.figure_order >= 0 else None
    return SurfaceNumbers(curvature, conic, tuple(even), terms, figure)


def _figure_numbers(
    element: Element, order: int, states: Sequence[State], step: Sequence[tuple[str, str, int]] | None
) -> FigureNumbers:
    """Monomial coefficients of the Zernike figure of each state."""
    figure = element.figure_disk
    kind = np.float64 if step is None else np.complex128
    table = np.empty((len(states), zernike.triangle_size(order)), kind)
    for s, state in enumerate(states):
        terms: dict[int, Any] = dict(figure.terms)
        for j, amplitude in state.get(element.body, AT_REST).figure.items():
            terms[j] = terms.get(j, 0.0) + amplitude
        if step is not None and step[s][:2] == (element.body, FIGURE):
            terms[step[s][2]] = terms.get(step[s][2], 0.0) + 1j * COMPLEX_STEP
        table[s] = zernike.monomials(terms, order, figure.radius)
    x, y = (np.full(len(states), c) for c in figure.centre)
    return FigureNumbers(x, y, tuple(table[:, m] for m in range(table.shape[1])))


_NO_GRID = GridFigure(np.zeros((4, 4)), (-1.0, 1.0, -1.0, 1.0))
"""What a system without a grid reads where others of its batch have one."""


def grid_numbers(elements: Sequence[Element], states: Sequence[State]) -> tuple[GridNumbers, np.ndarray]:
    """Numbers of the grids of the i-th elements of all chains in all states, (chains * states,) each, and one table of
    the coefficients of all.
    """
    first: dict[int, int] = {}
    figures, numbers, tables, length = [], [], [], 0
    for element in elements:
        own: dict[int, GridFigure] = {}  # a grid that many states share is added to the element's and stored once
        for state in states:
            motion = state.get(element.body, AT_REST)
            if id(motion.grid) not in own:
                own[id(motion.grid)] = element.grid_in(motion) or _NO_GRID
            figure = own[id(motion.grid)]
            if id(figure) not in first:
                first[id(figure)] = length
                figures.append(figure)  # so that its id remains its own
                tables.append(figure.spline.ravel())
                length += tables[-1].size
            numbers.append(replace(figure.numbers, first=float(first[id(figure)])))
    return map_leaves(lambda *values: np.array(values), numbers[0], *numbers[1:]), np.concatenate(tables)
