"""Numbers of a sequence of elements for a batch of systems, ready for the trace.

What decides the code of a kernel, as against the numbers that it works on, is a `Structure`.

A *system* is one sequence in one perturbed state. Sequences of the same structure (same kinds of surface in the same
order) can be batched together: the two cameras of an instrument, left and right channels, hundreds of states.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, TypeVar

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
from optics.numerics.backend import Backend
from optics.numerics.number_tree import form_of, map_leaves, numbers_in
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
        """Numbers of the coordinates x, y and z."""
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


@dataclass(frozen=True, eq=False)
class OwnNumbers:
    """Numbers of an element that do not depend on where it stands; as of ``ElementNumbers``."""

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
    apertures = [None if e.aperture is None else type(e.aperture.numbers()) for e in elements]
    kinds = {(e.interaction, e.surface.is_plane, own) for e, own in zip(elements, apertures, strict=True)}
    if len(kinds) != 1:
        names = ", ".join(sorted(e.name for e in elements))
        raise ValueError(f"elements of different kinds cannot be batched: {names}")
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


def reshaped_bodies(states: Sequence[State], placed: PlacedBodies) -> set[str]:
    """Bodies that have another size, shape or refractive index than designed in some state."""
    other = np.any(placed.scale != 1.0, axis=0)
    found = {path for path, i in placed.index.items() if other[i]}
    return found.union(path for state in states for path, motion in state.items() if motion.reshapes)


def frames_of(placed: PlacedBodies, bodies: np.ndarray) -> list[FrameNumbers]:
    """Per element of chains, the transform into its frame from that of the element before, each number (C * S,), chain
    by chain.

    Args:
        placed: the bodies of S states.
        bodies: numbers of those of the elements, (C, K).
    """
    rotation, translation = placed.rotation[:, bodies], placed.translation[:, bodies]
    turn, offset = np.empty_like(rotation), np.empty_like(translation)
    turn[:, :, 0] = np.swapaxes(rotation[:, :, 0], -1, -2)
    offset[:, :, 0] = -np.einsum("scij,sci->scj", rotation[:, :, 0], translation[:, :, 0])
    turn[:, :, 1:] = np.einsum("sckmi,sckmj->sckij", rotation[:, :, 1:], rotation[:, :, :-1])
    away = translation[:, :, :-1] - translation[:, :, 1:]
    offset[:, :, 1:] = np.einsum("sckmi,sckm->scki", rotation[:, :, 1:], away)
    numbers = np.concatenate([offset[..., None], turn], axis=-1).transpose(2, 3, 4, 1, 0)
    rows = np.ascontiguousarray(numbers).reshape(*numbers.shape[:3], -1)
    return [FrameNumbers(*(CoordinateNumbers(c[0], (c[1], c[2], c[3])) for c in element)) for element in rows]


def own_numbers_of(
    assembly: Assembly,
    element: Element,
    media: tuple[Medium, Medium],
    structure: Structure,
    states: Sequence[State],
    placed: PlacedBodies,
    step: Sequence[tuple[str, str, int]] | None,
) -> OwnNumbers:
    """Shape, aperture and indices of an element between two media, each number (S,), complex when a derivative is
    carried.
    """
    scale = placed.scale[:, placed.index[element.body]]
    sides = zip(media, structure.graded, strict=True)
    outer, inner = (_index_numbers(assembly, element, medium, graded, states, placed) for medium, graded in sides)
    return OwnNumbers(
        _surface_numbers(element, structure, scale, states, step),
        # an edge has no derivative: it lets a ray pass or stops it
        None if element.aperture is None else element.aperture.numbers(scale.real),
        outer,
        inner,
    )


def _index_numbers(
    assembly: Assembly, element: Element, medium: Medium, graded: bool, states: Sequence[State], placed: PlacedBodies
) -> IndexNumbers:
    """Index (S,) of a medium beside an element, with its gradient in the element's frame where it is graded."""
    if medium.solid is None:
        index = np.full(len(states), medium.index)
        gradient = np.zeros((len(states), 3)) if graded else None
    else:
        motions = [state.get(medium.solid, AT_REST) for state in states]
        index = np.array([assembly.index(medium.solid, m) for m in motions])
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
    surface = element.surface
    curvature, conic, even = None, None, []
    if not structure.plane:
        motions = [state.get(element.body, AT_REST) for state in states]
        radius = scale * (1.0 + np.array([motion.radius for motion in motions]))
        curvature, conic = surface.curvature / radius, surface.conic + np.array([motion.conic for motion in motions])
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


Numbers = TypeVar("Numbers", ElementNumbers, OwnNumbers)


@dataclass(frozen=True, eq=False)
class SystemBatch:
    """Numbers of B systems: element by element, each an array of shape (B,), float64.

    Attributes:
        structure: per element.
        values: per element, what the trace reads.
        world: poses of the elements in the world.
        tangents: ``values`` for the derivative that was asked for (None for a number that has none), or None.
        world_tangents: likewise of ``world``.
        size: of the last element's body relative to nominal, (B,).
        grids: per element, the spline tables of all systems' grid figures, one after the other; None without any.
        count: B.
        states: number of states S; systems are ordered sequence by sequence, B = sequences * S.
        form: of ``values`` and the pose of the last element, with the place of each number.
    """

    structure: tuple[Structure, ...]
    values: tuple[ElementNumbers, ...]
    world: Poses
    tangents: tuple[ElementNumbers, ...] | None
    world_tangents: Poses | None
    size: np.ndarray
    grids: tuple[np.ndarray | None, ...]
    count: int
    states: int
    form: tuple[tuple[ElementNumbers, ...], FrameNumbers]

    def upload(self, backend: Backend, own: bool = False) -> UploadedSystems:
        """Copy to the backend's memory as kernel inputs; derivatives, if any, become forward-mode gradients.

        Args:
            backend: where to.
            own: each number of the systems is an array of its own, so that it may be differentiated by; else those of
                several systems lie in one.
        """
        if self.tangents is None:
            grids = tuple(None if g is None else backend.opaque(g) for g in self.grids)
            parts = numbers_in((self.values, self.world.last()))
            # of a single system each number is one for all rays, which no ray needs to look up
            alone = own or self.count == 1
            numbers = tuple(backend.opaque_each(parts)) if alone else backend.opaque(np.array(parts))
            return UploadedSystems(backend, self.structure, self.form, numbers, grids, self.count, False)
        import drjit as dr

        def copied(value: np.ndarray, tangent: np.ndarray | None = None) -> Any:
            array = backend.opaque(value)
            if tangent is not None:
                dr.enable_grad(array)
                dr.set_grad(array, backend.opaque(tangent))
            return array

        values = map_leaves(copied, self.values, self.tangents)
        last = None if self.world_tangents is None else self.world_tangents.last()
        world = map_leaves(copied, self.world.last(), last)
        grids = tuple(None if g is None else backend.opaque(g) for g in self.grids)
        numbers = tuple(numbers_in((values, world)))
        return UploadedSystems(backend, self.structure, self.form, numbers, grids, self.count, True)

    def take(self, systems: np.ndarray) -> SystemBatch:
        """The systems of the given indices."""
        if np.array_equal(systems, np.arange(self.count)):
            return self

        def taken(value: np.ndarray) -> np.ndarray:
            return np.asarray(value[systems])

        return SystemBatch(
            self.structure,
            map_leaves(taken, self.values),
            map_leaves(taken, self.world),
            map_leaves(taken, self.tangents),
            map_leaves(taken, self.world_tangents),
            self.size[systems],
            self.grids,
            len(systems),
            len(systems),
            self.form,
        )


@dataclass(frozen=True, eq=False)
class Poses:
    """Poses of the K elements of B systems in the world.

    Attributes:
        rotation: element frame to world, (B, K, 3, 3); translation: its origin, metres, (B, K, 3).
    """

    rotation: np.ndarray
    translation: np.ndarray

    def last(self) -> FrameNumbers:
        """Poses of the last elements."""
        return FrameNumbers.of(self.rotation[:, -1], self.translation[:, -1])


@dataclass(frozen=True, eq=False)
class UploadedSystems:
    """A ``SystemBatch`` in the memory of a backend.

    Attributes:
        backend: whose arrays they are.
        structure: per element.
        form: as of ``SystemBatch``.
        numbers: L Dr.Jit arrays (B,); or one of all of them, (L * B,), number by number.
        grids: as of ``SystemBatch``.
        count: B.
        differentiable: whether numbers carry derivatives.
    """

    backend: Backend
    structure: tuple[Structure, ...]
    form: tuple[tuple[ElementNumbers, ...], FrameNumbers]
    numbers: Any
    grids: tuple[Any, ...]
    count: int
    differentiable: bool

    @cached_property
    def values(self) -> tuple[ElementNumbers, ...]:
        """Per element its numbers, Dr.Jit arrays (B,)."""
        import drjit as dr

        if isinstance(self.numbers, tuple):
            return map_leaves(lambda place: self.numbers[place], self.form[0])
        system = dr.arange(self.backend.UInt, self.count)
        return map_leaves(
            lambda place: dr.gather(self.backend.Float, self.numbers, system + place * self.count), self.form[0]
        )

    def section(self, first: int, last: int) -> UploadedSystems:
        """Elements ``first`` to ``last - 1`` alone, for rays in the frame of the element before them; the pose remains
        the last element's of all.
        """
        part = slice(first, last)
        form = self.form[0][part], self.form[1]
        return replace(self, structure=self.structure[part], form=form, grids=self.grids[part])


def assemble(
    assembly: Assembly,
    sequences: Sequence[str | Sequence[str]],
    states: Sequence[State] = ({},),
    step: Sequence[tuple[str, str, int]] | None = None,
    placed: PlacedBodies | None = None,
) -> SystemBatch:
    """Work out the numbers of every sequence in every state.

    Args:
        assembly: the instrument.
        sequences: names of sequences, or element-name tuples, all of the same structure.
        states: S perturbed states.
        step: optional derivative: one (body, kind, axis) per state; kind ``rotate``, ``shift``, ``scale`` or ``figure``
            (the axis is then a Noll index that the state's figure names, with 0 if there is none).
        placed: the bodies of these states, when already placed.

    Returns:
        A batch of len(sequences) * S systems, sequence by sequence.

    Raises:
        ValueError: the sequences differ in structure.
    """
    placed = assembly.place(states, step) if placed is None else placed
    chains = [
        tuple(assembly.elements[n] for n in (assembly.sequences[s] if isinstance(s, str) else s)) for s in sequences
    ]
    lengths = {len(chain) for chain in chains}
    if len(lengths) != 1:
        raise ValueError(f"sequences of different lengths cannot be batched: {sorted(lengths)}")
    media = [media_along(chain) for chain in chains]
    graded = {path for state in states for path, motion in state.items() if any(motion.index_gradient)}
    real = step is None and not np.iscomplexobj(placed.rotation)
    reshaped = reshaped_bodies(states, placed) if real else set(placed.index)
    known = assembly.worked_out
    names = tuple(tuple(element.name for element in chain) for chain in chains)

    def structure(i: int) -> Structure:
        """Of the i-th elements of all chains."""
        before, after = (any(m[k].solid in graded for m in media) for k in (i, i + 1))
        elements = [chain[i] for chain in chains]
        if not reshaped.isdisjoint(e.body for e in elements):
            return structure_of(elements, states, (before, after))
        key = ("structure", i, names, before, after)
        if key not in known:
            known[key] = structure_of(elements, (), (before, after))
        found: Structure = known[key]
        return found

    structures = tuple(structure(i) for i in range(len(chains[0])))

    def own_of(i: int) -> OwnNumbers:
        """Shapes and indices of the i-th elements of all chains, each number (C * S,)."""
        depends = {chain[i].body for chain in chains}
        depends |= {m.solid for along in media for m in along[i : i + 2] if m.solid is not None}
        if not depends.isdisjoint(reshaped):
            return joined(i, states, placed, step)
        # as designed: each system's number for all its states
        key = (i, names, structures[i])
        if key not in known:
            known[key] = joined(i, ({},), assembly.place(), None)
        one: OwnNumbers = known[key]
        return one if len(states) == 1 else map_leaves(lambda value: np.repeat(value, len(states)), one)

    def joined(i: int, states: Sequence[State], placed: PlacedBodies, step: Any) -> OwnNumbers:
        """The same worked out; once for an element that several chains share."""
        found: dict[tuple[str, Medium, Medium], OwnNumbers] = {}
        keys = [(chain[i].name, along[i], along[i + 1]) for chain, along in zip(chains, media, strict=True)]
        for key in keys:
            if key not in found:
                name, before, after = key
                found[key] = own_numbers_of(
                    assembly, assembly.elements[name], (before, after), structures[i], states, placed, step
                )
        return _joined([found[key] for key in keys])

    bodies = np.array([[placed.index[element.body] for element in chain] for chain in chains])
    values = []
    tables: list[np.ndarray | None] = []
    for i, frame in enumerate(frames_of(placed, bodies)):
        own, spline = own_of(i), None
        if structures[i].grid:
            grid, spline = grid_numbers([chain[i] for chain in chains], states)
            own = replace(own, surface=replace(own.surface, grid=grid))
        tables.append(spline)
        values.append(ElementNumbers(frame, own.surface, own.aperture, own.before, own.after))
    world = Poses(*(np.concatenate([a[:, own] for own in bodies]) for a in (placed.rotation, placed.translation)))
    size = np.concatenate([placed.size(chain[-1].body) for chain in chains])
    form = known.get(structures)
    if form is None:
        form = known[structures] = form_of((tuple(values), world.last()))
    return SystemBatch(
        structures,
        tuple(values) if real else tuple(map_leaves(_real, value) for value in values),
        world if real else map_leaves(_real, world),
        tuple(map_leaves(_tangent, value) for value in values) if step is not None else None,
        map_leaves(_tangent, world) if step is not None else None,
        size,
        tuple(tables),
        len(chains) * len(states),
        len(states),
        form,
    )


def _joined(parts: Sequence[Numbers]) -> Numbers:
    """The numbers of all chains, (S,) each, one after the other."""
    return map_leaves(lambda *arrays: np.concatenate(arrays), parts[0], *parts[1:])


def _real(value: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(value.real)


def _tangent(value: np.ndarray) -> np.ndarray | None:
    return value.imag / COMPLEX_STEP if np.iscomplexobj(value) else None
