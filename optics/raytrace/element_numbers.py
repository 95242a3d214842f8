"""Numbers of one element for the trace: its frame, shape and clear aperture, and the media on both sides.

``Structure`` holds the properties that determine the code of a kernel (such as the kind of a surface); all others are
numbers that the kernel reads.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from optics.geometry import zernike
from optics.geometry.aperture import ApertureNumbers
from optics.geometry.sag_terms import SagTerm, kinds_of, of_kinds, scaled_term
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
    """Properties of an element that determine the code of the kernel that traces it, e.g. the kind of its surface."""

    interaction: Interaction
    plane: bool
    even: int
    terms: tuple[type[SagTerm], ...]  # kinds of the further sag terms
    figure_order: int  # radial order of the Zernike figure, -1 for none
    grid: bool
    aperture: type[ApertureNumbers] | None
    graded: tuple[bool, bool] = (False, False)  # index gradient in the medium before and after


@dataclass(frozen=True, eq=False)
class CoordinateNumbers:
    """Row of a rigid transform: a point p has the new coordinate ``shift`` + ``row`` . p, in metres."""

    shift: Any
    row: tuple[Any, Any, Any]


@dataclass(frozen=True, eq=False)
class FrameNumbers:
    """Rigid transform of points into another frame, as 12 numbers: a shift and a row of the rotation per coordinate."""

    x: CoordinateNumbers
    y: CoordinateNumbers
    z: CoordinateNumbers

    @classmethod
    def of(cls, rows: np.ndarray) -> FrameNumbers:
        """Return the transform from its numbers (12, ...) in the order of the fields."""
        return cls(*(CoordinateNumbers(c[0], (c[1], c[2], c[3])) for c in rows.reshape(3, 4, *rows.shape[1:])))

    @property
    def coordinates(self) -> tuple[CoordinateNumbers, CoordinateNumbers, CoordinateNumbers]:
        """Shift and row of the rotation for each of the coordinates x, y and z."""
        return self.x, self.y, self.z


@dataclass(frozen=True, eq=False)
class IndexNumbers:
    """Refractive index of a medium: ``index`` + ``gradient`` . p at a point p of the element's frame, metres.

    The gradient (1/m) is None in a homogeneous medium.
    """

    index: Any
    gradient: tuple[Any, Any, Any] | None = None


@dataclass(frozen=True, eq=False)
class ElementNumbers:
    """Numbers of one element that the trace reads.

    Attributes
    ----------
    frame : FrameNumbers
        Transform from the frame of the element before (the world for the first) into this element's.
    surface : SurfaceNumbers
        Shape of the surface.
    aperture : DiskNumbers, RingNumbers, RectangleNumbers or EllipseNumbers, optional
        Clear aperture; None if unlimited.
    before, after : IndexNumbers
        Refractive indices on the side that light comes from and on the side that it goes to.
    """

    frame: FrameNumbers
    surface: SurfaceNumbers
    aperture: ApertureNumbers | None
    before: IndexNumbers
    after: IndexNumbers


@dataclass(frozen=True, eq=False)
class LocalNumbers:
    """Numbers of an element that do not depend on its pose: surface, aperture, and the indices on both sides."""

    surface: SurfaceNumbers
    aperture: ApertureNumbers | None
    before: IndexNumbers
    after: IndexNumbers


@dataclass(frozen=True)
class Medium:
    """Medium that light travels in: a glass body of the assembly, or a homogeneous medium of a given index."""

    solid: str | None = None
    index: float = 1.0


def media_along(chain: Sequence[Element]) -> list[Medium]:
    """Return the media before the first element, between the elements and after the last one."""
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


def structure_of(elements: Sequence[Element]) -> Structure:
    """Return the structure of elements at one position of several sequences, so that one kernel can trace them all."""
    grid = any(_known_figure(e) is not None and e.surface.grid_figure is not None for e in elements)
    apertures = [None if e.aperture is None else type(e.aperture.numbers()) for e in elements]
    kinds = {(e.interaction, e.surface.is_plane, kind) for e, kind in zip(elements, apertures, strict=True)}
    if len(kinds) != 1:
        names = ", ".join(sorted(e.name for e in elements))
        raise ValueError(f"elements of different kinds cannot be batched: {names}")
    interaction, is_plane, aperture = kinds.pop()
    # terms that a surface lacks are zero, also on a plane
    terms = kinds_of([term for e in elements for term in e.surface.terms])
    even = 0 if is_plane else max(len(e.surface.even) for e in elements)
    figures = [e.surface.zernike_figure for e in elements]
    order = max(-1 if figure is None else zernike.order_of(figure.terms) for figure in figures)
    return Structure(interaction, is_plane, even, terms, order, grid, aperture)


def _known_figure(element: Element) -> Figure | None:
    """Return the figure error of an element's surface; raise ValueError if the ray trace does not support its type."""
    match element.surface.figure:
        case None | ZernikeFigure() | GridFigure() | SummedFigure() as figure:
            return figure
        case other:
            raise ValueError(f"element {element.name!r}: the trace supports no figure of type {type(other).__name__}")


def local_numbers_of(
    assembly: Assembly,
    element: Element,
    media: tuple[Medium, Medium],
    structure: Structure,
    states: Sequence[State],
    placed: PlacedBodies,
    step: Sequence[tuple[str, str, int]] | None,
) -> LocalNumbers:
    """Return shape, aperture and refractive indices of an element between two media, in S states.

    Each number has shape (S,), and is complex when a derivative is carried.
    """
    scale = placed.scale[:, placed.index[element.body]]
    sides = zip(media, structure.graded, strict=True)
    outer, inner = (_index_numbers(assembly, element, medium, graded, states, placed) for medium, graded in sides)
    return LocalNumbers(
        _surface_numbers(element, structure, scale, states, step),
        # an aperture has no derivative: it passes a ray or blocks it
        None if element.aperture is None else element.aperture.numbers(scale.real),
        outer,
        inner,
    )


def _index_numbers(
    assembly: Assembly, element: Element, medium: Medium, graded: bool, states: Sequence[State], placed: PlacedBodies
) -> IndexNumbers:
    """Return the index of a medium next to an element in S states, (S,), and its gradient in the element's frame.

    The gradient is None in a medium without one.
    """
    if medium.solid is None:
        index = np.full(len(states), medium.index)
        gradient = np.zeros((len(states), 3)) if graded else None
    else:
        motions = [state.get(medium.solid, AT_REST) for state in states]
        index = np.array([assembly.index(medium.solid, m) for m in motions])
        gradient = None
        if graded:
            face, glass = placed.index[element.body], placed.index[medium.solid]
            gradients = np.array([m.index_gradient for m in motions])
            world = np.einsum("sij,sj->si", placed.rotation[:, glass], gradients)
            gradient = np.einsum("sji,sj->si", placed.rotation[:, face], world)
            offset = placed.translation[:, face] - placed.translation[:, glass]
            index = index + np.einsum("si,si->s", world, offset)
    return IndexNumbers(index, None if gradient is None else (gradient[:, 0], gradient[:, 1], gradient[:, 2]))


def _surface_numbers(
    element: Element,
    structure: Structure,
    scale: np.ndarray,
    states: Sequence[State],
    step: Sequence[tuple[str, str, int]] | None,
) -> SurfaceNumbers:
    """Return the numbers of an element's shape (curvature, conic, figure) in each state, except its grid figure."""
    surface = element.surface
    curvature, conic, even = None, None, []
    if not structure.plane:
        motions = [state.get(element.body, AT_REST) for state in states]
        radius = scale * (1.0 + np.array([motion.radius for motion in motions]))
        curvature, conic = surface.curvature / radius, surface.conic + np.array([motion.conic for motion in motions])
        for n in range(structure.even):
            term = surface.even[n] if n < len(surface.even) else 0.0
            even.append(term / scale ** (2 * n + 3))
    terms = tuple(scaled_term(term, scale) for term in of_kinds(surface.terms, structure.terms))
    figure = _figure_numbers(element, structure.figure_order, states, step) if structure.figure_order >= 0 else None
    return SurfaceNumbers(curvature, conic, tuple(even), terms, figure)


def _figure_numbers(
    element: Element, order: int, states: Sequence[State], step: Sequence[tuple[str, str, int]] | None
) -> FigureNumbers:
    """Return the Zernike figure of an element in each state, as coefficients of x^a y^b up to the degree ``order``."""
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
"""Figure of zeros on a grid, for an element without a grid figure that is traced together with elements that have one.
"""


def grid_numbers(elements: Sequence[Element], states: Sequence[State]) -> tuple[GridNumbers, np.ndarray]:
    """Return sampling and spline coefficients of the grid figures of elements at one position of all sequences.

    The sampling numbers have shape (sequences * states,) each; the one table holds the coefficients of all grids.
    """
    first: dict[int, int] = {}
    figures, numbers, tables, length = [], [], [], 0
    for element in elements:
        by_motion: dict[int, GridFigure] = {}  # a grid shared by many states is added and stored once
        for state in states:
            motion = state.get(element.body, AT_REST)
            if id(motion.grid) not in by_motion:
                by_motion[id(motion.grid)] = element.grid_in(motion) or _NO_GRID
            figure = by_motion[id(motion.grid)]
            if id(figure) not in first:
                first[id(figure)] = length
                figures.append(figure)  # kept alive, so that its id stays unique
                tables.append(figure.spline.ravel())
                length += tables[-1].size
            numbers.append(replace(figure.numbers, first=float(first[id(figure)])))
    return map_leaves(lambda *values: np.array(values), numbers[0], *numbers[1:]), np.concatenate(tables)
