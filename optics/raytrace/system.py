"""Numbers of a sequence of elements for a batch of systems, ready for the trace.

A *system* is one sequence in one perturbed state. Sequences of the same structure (same kinds of surface in the same
order) can be batched together: the two cameras of an instrument, left and right channels, hundreds of states.

The assembly keeps the numbers of the design. States are written over them: frames, indices and their gradients, radii,
conic constants and Zernike figures; and each number of a body that has grown goes with a power of its size. Elements
are worked out one by one only for derivatives and for figures on a grid.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from optics.geometry import zernike
from optics.geometry.tree import AT_REST, COMPLEX_STEP, Motion, PlacedBodies, State
from optics.numerics.backend import Backend
from optics.numerics.number_tree import form_of, map_leaves, numbers_in
from optics.raytrace.assembly import Assembly, Element
from optics.raytrace.element_numbers import (
    ElementNumbers,
    FrameNumbers,
    Medium,
    OwnNumbers,
    Structure,
    grid_numbers,
    media_along,
    own_numbers_of,
    structure_of,
)


def touched_bodies(assembly: Assembly, states: Sequence[State], placed: PlacedBodies) -> set[str]:
    """Bodies that some state names, or that stand or are otherwise than designed because their carriers do."""
    nominal = assembly.place()
    other = np.any(placed.rotation != nominal.rotation, axis=(0, 2, 3))
    other |= np.any(placed.translation != nominal.translation, axis=(0, 2))
    other |= np.any(placed.scale != nominal.scale, axis=0)
    return {path for path, i in placed.index.items() if other[i]}.union(*states)


def frames_of(placed: PlacedBodies, bodies: np.ndarray) -> np.ndarray:
    """Per element of chains, the transform into its frame from that of the element before: numbers of
    ``FrameNumbers``, (K, 12, C * S), chain by chain.

    Parameters
    ----------
    placed : PlacedBodies
        The bodies of S states.
    bodies : np.ndarray
        Numbers of those of the elements, (C, K).
    """
    rotation, translation = placed.rotation[:, bodies], placed.translation[:, bodies]
    turn, offset = np.empty_like(rotation), np.empty_like(translation)
    turn[:, :, 0] = np.swapaxes(rotation[:, :, 0], -1, -2)
    offset[:, :, 0] = -np.einsum("scij,sci->scj", rotation[:, :, 0], translation[:, :, 0])
    turn[:, :, 1:] = np.einsum("sckmi,sckmj->sckij", rotation[:, :, 1:], rotation[:, :, :-1])
    away = translation[:, :, :-1] - translation[:, :, 1:]
    offset[:, :, 1:] = np.einsum("sckmi,sckm->scki", rotation[:, :, 1:], away)
    numbers = np.concatenate([offset[..., None], turn], axis=-1).transpose(2, 3, 4, 1, 0)
    return np.ascontiguousarray(numbers).reshape(len(numbers), 12, -1)


@dataclass(frozen=True, eq=False)
class SystemBatch:
    """Numbers of B systems.

    Attributes
    ----------
    structure : tuple[Structure, ...]
        Per element.
    form : tuple[tuple[ElementNumbers, ...], FrameNumbers]
        Per element what the trace reads, and the pose of the last element, with the row of each number.
    numbers : np.ndarray
        (L, B).
    world : Poses
        Poses of the elements in the world.
    tangents : tuple[ElementNumbers, ...] | None
        ``values`` for the derivative that was asked for (None for a number that has none), or None.
    world_tangents : Poses | None
        Likewise of ``world``.
    size : np.ndarray
        Of the last element's body relative to nominal, (B,).
    grids : tuple[np.ndarray | None, ...]
        Per element, the spline tables of all systems' grid figures, one after the other; None without any.
    states : int
        Number of states S; systems are ordered sequence by sequence, B = sequences * S.
    """

    structure: tuple[Structure, ...]
    form: tuple[tuple[ElementNumbers, ...], FrameNumbers]
    numbers: np.ndarray
    world: Poses
    tangents: tuple[ElementNumbers, ...] | None
    world_tangents: Poses | None
    size: np.ndarray
    grids: tuple[np.ndarray | None, ...]
    states: int

    @property
    def count(self) -> int:
        """B."""
        return int(self.numbers.shape[1])

    @cached_property
    def values(self) -> tuple[ElementNumbers, ...]:
        """Per element, what the trace reads, each number (B,)."""
        return map_leaves(lambda row: self.numbers[row], self.form[0])

    def upload(self, backend: Backend, own: bool = False) -> UploadedSystems:
        """Copy to the backend's memory as kernel inputs; derivatives, if any, become forward-mode gradients.

        Parameters
        ----------
        backend : Backend
            Where to.
        own : bool
            Each number of the systems is an array of its own, so that it may be differentiated by; else those of
            several systems lie in one.
        """
        grids = tuple(None if g is None else backend.opaque(g) for g in self.grids)
        if self.tangents is None:
            # of a single system each number is one for all rays, which no ray needs to look up
            alone = own or self.count == 1
            numbers = tuple(backend.opaque_each(list(self.numbers))) if alone else backend.opaque(self.numbers)
            return UploadedSystems(backend, self.structure, self.form, numbers, grids, self.count, False)
        import drjit as dr

        def copied(row: int, tangent: np.ndarray | None = None) -> Any:
            array = backend.opaque(self.numbers[row])
            if tangent is not None:
                dr.enable_grad(array)
                dr.set_grad(array, backend.opaque(tangent))
            return array

        last = None if self.world_tangents is None else self.world_tangents.last()
        derived = map_leaves(copied, self.form, (self.tangents, last))
        return UploadedSystems(backend, self.structure, self.form, tuple(numbers_in(derived)), grids, self.count, True)

    def take(self, systems: np.ndarray) -> SystemBatch:
        """The systems of the given indices."""
        if np.array_equal(systems, np.arange(self.count)):
            return self

        def taken(value: np.ndarray) -> np.ndarray:
            return np.asarray(value[systems])

        return SystemBatch(
            self.structure,
            self.form,
            self.numbers[:, systems],
            map_leaves(taken, self.world),
            map_leaves(taken, self.tangents),
            map_leaves(taken, self.world_tangents),
            self.size[systems],
            self.grids,
            len(systems),
        )


@dataclass(frozen=True, eq=False)
class Poses:
    """Poses of the K elements of B systems in the world.

    Attributes
    ----------
    rotation : np.ndarray
        Element frame to world, (B, K, 3, 3); translation: its origin, metres, (B, K, 3).
    """

    rotation: np.ndarray
    translation: np.ndarray

    def last(self) -> FrameNumbers:
        """Poses of the last elements."""
        return FrameNumbers.of(self.last_rows())

    def last_rows(self) -> np.ndarray:
        """The numbers of ``last`` in their order, (12, B)."""
        both = np.concatenate([self.translation[:, -1, :, None], self.rotation[:, -1]], axis=-1)
        return np.ascontiguousarray(both.reshape(len(both), 12).T)


@dataclass(frozen=True, eq=False)
class UploadedSystems:
    """A ``SystemBatch`` in the memory of a backend.

    Attributes
    ----------
    backend : Backend
        Whose arrays they are.
    structure : tuple[Structure, ...]
        Per element.
    form : tuple[tuple[ElementNumbers, ...], FrameNumbers]
        As of ``SystemBatch``.
    numbers : Any
        L Dr.Jit arrays (B,); or one of all of them, (L * B,), number by number.
    grids : tuple[Any, ...]
        As of ``SystemBatch``.
    count : int
        B.
    differentiable : bool
        Whether numbers carry derivatives.
    first : int | None
        Row of the first element's first number, where the elements are part of a longer sequence; else None.
    """

    backend: Backend
    structure: tuple[Structure, ...]
    form: tuple[tuple[ElementNumbers, ...], FrameNumbers]
    numbers: Any
    grids: tuple[Any, ...]
    count: int
    differentiable: bool
    first: int | None = None

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
        row = None if isinstance(self.numbers, tuple) else form[0][0].frame.x.shift
        return replace(self, structure=self.structure[part], form=form, grids=self.grids[part], first=row)


@dataclass(frozen=True, eq=False)
class _Shapes:
    """What some states do to shapes, in so far as it decides the code of a kernel.

    Attributes
    ----------
    orders : Mapping[str, int]
        Body -> highest radial order of its figures.
    gridded : frozenset[str]
        Bodies with a figure on a grid.
    graded : frozenset[str]
        Glass bodies with a gradient of their index.
    """

    orders: Mapping[str, int]
    gridded: frozenset[str]
    graded: frozenset[str]

    @classmethod
    def of(cls, states: Sequence[State]) -> _Shapes:
        """Look through the motions of states."""
        orders: dict[str, int] = {}
        gridded, graded = set(), set()
        for state in states:
            for path, motion in state.items():
                if motion.figure:
                    orders[path] = max(orders.get(path, -1), zernike.order_of(motion.figure))
                if motion.grid is not None:
                    gridded.add(path)
                if any(motion.index_gradient):
                    graded.add(path)
        return cls(orders, frozenset(gridded), frozenset(graded))


@dataclass(frozen=True, eq=False)
class _Chains:
    """Sequences of C chains of K elements each.

    Attributes
    ----------
    elements, media : tuple[tuple[Element, ...], ...]
        Of each chain: the elements, and what light travels in before, between and after them.
    bodies : np.ndarray
        Numbers of the elements' bodies, (C, K).
    depends : tuple[frozenset[str], ...]
        Per element of the chains, the bodies whose shape or index it may have to do with.
    designed : tuple[Structure, ...]
        Structure of the elements as designed.
    """

    elements: tuple[tuple[Element, ...], ...]
    media: tuple[tuple[Medium, ...], ...]
    bodies: np.ndarray
    depends: tuple[frozenset[str], ...]
    designed: tuple[Structure, ...]

    @classmethod
    def of(cls, assembly: Assembly, sequences: tuple[str | tuple[str, ...], ...]) -> _Chains:
        """The chains of sequences; ValueError where their lengths differ."""
        named = [assembly.sequences[s] if isinstance(s, str) else s for s in sequences]
        chains = tuple(tuple(assembly.elements[name] for name in names) for names in named)
        lengths = {len(chain) for chain in chains}
        if len(lengths) != 1:
            raise ValueError(f"sequences of different lengths cannot be batched: {sorted(lengths)}")
        media = tuple(tuple(media_along(chain)) for chain in chains)
        index = assembly.place().index
        depends = []
        for i in range(len(chains[0])):
            glass = {m.solid for along in media for m in along[i : i + 2] if m.solid is not None}
            depends.append(frozenset(glass.union(chain[i].body for chain in chains)))
        bodies = np.array([[index[element.body] for element in chain] for chain in chains])
        designed = tuple(structure_of(column) for column in zip(*chains, strict=True))
        return cls(chains, media, bodies, tuple(depends), designed)

    def radius(self, i: int, c: int) -> float:
        """Of the disk of a figure of the i-th element of a chain, metres."""
        if (i, c) not in self._radii:
            self._radii[i, c] = self.elements[c][i].figure_disk.radius
        return self._radii[i, c]

    @cached_property
    def _radii(self) -> dict[tuple[int, int], float]:
        return {}

    def elements_at(self, i: int) -> list[Element]:
        """The i-th ones of all chains."""
        return [chain[i] for chain in self.elements]

    def structure(self, shapes: _Shapes) -> tuple[Structure, ...]:
        """Of the elements with what states do to their shapes."""
        changed, out = shapes.orders.keys() | shapes.gridded | shapes.graded, list(self.designed)
        for i, one in enumerate(out):
            if changed.isdisjoint(self.depends[i]):
                continue
            bodies = {element.body for element in self.elements_at(i)}
            out[i] = replace(
                one,
                figure_order=max(one.figure_order, *(shapes.orders.get(body, -1) for body in bodies)),
                grid=one.grid or not shapes.gridded.isdisjoint(bodies),
                graded=(self._graded(i, shapes), self._graded(i + 1, shapes)),
            )
        return tuple(out)

    def _graded(self, medium: int, shapes: _Shapes) -> bool:
        return any(media[medium].solid in shapes.graded for media in self.media)

    def own(
        self,
        assembly: Assembly,
        i: int,
        structure: Structure,
        states: Sequence[State],
        placed: PlacedBodies,
        step: Sequence[tuple[str, str, int]] | None = None,
    ) -> tuple[OwnNumbers, np.ndarray | None]:
        """Shapes and indices of the i-th elements, each number (C * S,), and the tables of their grids; worked out once
        for an element that several chains share.
        """
        found: dict[tuple[str, Medium, Medium], OwnNumbers] = {}
        keys = [(chain[i].name, m[i], m[i + 1]) for chain, m in zip(self.elements, self.media, strict=True)]
        for key in keys:
            if key not in found:
                name, before, after = key
                found[key] = own_numbers_of(
                    assembly, assembly.elements[name], (before, after), structure, states, placed, step
                )
        parts = [found[key] for key in keys]
        own = map_leaves(lambda *arrays: np.concatenate(arrays), parts[0], *parts[1:])
        if not structure.grid:
            return own, None
        grid, spline = grid_numbers(self.elements_at(i), states)
        return replace(own, surface=replace(own.surface, grid=grid)), spline


@dataclass(frozen=True, eq=False)
class _Sides:
    """Sides of elements on which one glass body lies.

    Attributes
    ----------
    rows, chains, bodies : np.ndarray
        Row of the index on each, its chain, and the number of the element's body, (N,).
    gradient : np.ndarray
        Which sides have a gradient of the index; slopes: its rows, (3, of these).
    """

    rows: np.ndarray
    chains: np.ndarray
    bodies: np.ndarray
    gradient: np.ndarray
    slopes: np.ndarray


@dataclass(frozen=True, eq=False)
class _Design:
    """Numbers of C chains of one structure as designed, and what a state does to them.

    Attributes
    ----------
    chains : _Chains
        Whose they are.
    structure, form : tuple[Structure, ...]
        As of ``SystemBatch``.
    numbers : np.ndarray
        (L, C); those of frames are left open.
    grids : tuple[np.ndarray | None, ...]
        As of ``SystemBatch``.
    grown : Mapping[int, tuple[np.ndarray, np.ndarray, np.ndarray]]
        Power -> rows and chains of the numbers that grow with that power of their bodies' sizes, and these bodies'
        numbers.
    glass : Mapping[str, _Sides]
        Glass body -> the sides of elements that it lies on.
    frame_rows : np.ndarray
        Rows of the elements' frames and of the last pose, (K + 1, 12).
    """

    chains: _Chains
    structure: tuple[Structure, ...]
    form: tuple[tuple[ElementNumbers, ...], FrameNumbers]
    numbers: np.ndarray
    grids: tuple[np.ndarray | None, ...]
    grown: Mapping[int, tuple[np.ndarray, np.ndarray, np.ndarray]]
    glass: Mapping[str, _Sides]
    frame_rows: np.ndarray

    @classmethod
    def of(cls, assembly: Assembly, chains: _Chains, structure: tuple[Structure, ...]) -> _Design:
        """Work them out."""
        placed, frame = assembly.place(), FrameNumbers.of(np.zeros((12, len(chains.elements))))
        twice = replace(placed, scale=np.full_like(placed.scale, 2.0))

        def values(placed: PlacedBodies) -> tuple[tuple[ElementNumbers, ...], list[np.ndarray | None]]:
            own, grids = zip(
                *(chains.own(assembly, i, one, ({},), placed) for i, one in enumerate(structure)), strict=True
            )
            return tuple(ElementNumbers(frame, o.surface, o.aperture, o.before, o.after) for o in own), grids

        designed, grids = values(placed)
        form = form_of((designed, frame))
        numbers, doubled = (np.array(numbers_in((own, frame))) for own in (designed, values(twice)[0]))
        # each goes with a power of its body's size, which can be read off without rounding at twice the size
        known = (numbers != 0.0) & (doubled != 0.0)
        power = np.frexp(np.divide(doubled, numbers, out=np.ones_like(numbers), where=known))[1] - 1
        element = np.zeros(len(numbers), int)
        for i, own in enumerate(form[0]):
            element[numbers_in(own)] = i
        grown = {}
        for one in set(power.ravel().tolist()) - {0}:
            rows, columns = np.nonzero(power == one)
            grown[one] = rows, columns, chains.bodies[columns, element[rows]]
        frames = np.array([numbers_in(f) for f in (*(own.frame for own in form[0]), form[1])])
        return cls(chains, structure, form, numbers, tuple(grids), grown, cls._sides(chains, form[0]), frames)

    @staticmethod
    def _sides(chains: _Chains, form: tuple[ElementNumbers, ...]) -> dict[str, _Sides]:
        found: dict[str, list[tuple[Any, int, int]]] = {}
        for c, media in enumerate(chains.media):
            for i, own in enumerate(form):
                for medium, side in ((media[i], own.before), (media[i + 1], own.after)):
                    if medium.solid is not None:
                        found.setdefault(medium.solid, []).append((side, c, int(chains.bodies[c, i])))
        out = {}
        for solid, sides in found.items():
            index, columns, bodies = (
                np.array(column) for column in zip(*((s.index, c, b) for s, c, b in sides), strict=True)
            )
            graded = np.array([k for k, (side, _, _) in enumerate(sides) if side.gradient is not None], int)
            slopes = np.array([sides[k][0].gradient for k in graded], int).reshape(-1, 3).T
            out[solid] = _Sides(index, columns, bodies, graded, slopes)
        return out

    def in_states(self, assembly: Assembly, states: Sequence[State], placed: PlacedBodies) -> np.ndarray:
        """The numbers in S states, but for grids, (L, C * S)."""
        count = len(states)
        out = np.repeat(self.numbers[:, :, None], count, axis=2)
        if np.any(placed.scale != 1.0):
            self._grow(out, placed)
        paths = {path for state in states for path in state}
        for solid in paths.intersection(self.glass):
            self._set_index(out, assembly, solid, states, placed)
        known: dict[tuple[str, int, float], np.ndarray] = {}
        for i, structure in enumerate(self.structure):
            if not paths.isdisjoint(self.chains.depends[i]):
                self._reshape(out, i, structure, states, known)
        flat = out.reshape(len(out), -1)
        flat[self.frame_rows[:-1]] = frames_of(placed, self.chains.bodies)
        return flat

    def _grow(self, out: np.ndarray, placed: PlacedBodies) -> None:
        for power, (rows, columns, bodies) in self.grown.items():
            size = placed.scale[:, bodies].T
            factor = size
            for _ in range(abs(power) - 1):
                factor = factor * size
            if power > 0:
                out[rows, columns] *= factor
            else:
                out[rows, columns] /= factor

    def _set_index(
        self, out: np.ndarray, assembly: Assembly, solid: str, states: Sequence[State], placed: PlacedBodies
    ) -> None:
        sides, glass = self.glass[solid], placed.index[solid]
        motions = [state.get(solid, AT_REST) for state in states]
        out[sides.rows, sides.chains] = [assembly.index(solid, motion) for motion in motions]
        if not sides.gradient.size:
            return
        columns, here = sides.chains[sides.gradient], sides.bodies[sides.gradient]
        world = np.einsum("sij,sj->si", placed.rotation[:, glass], [motion.index_gradient for motion in motions])
        out[sides.slopes, columns] = np.einsum("snji,sj->ins", placed.rotation[:, here], world)
        away = placed.translation[:, here] - placed.translation[:, glass, None]
        out[sides.rows[sides.gradient], columns] += np.einsum("si,sni->ns", world, away)

    def _reshape(
        self,
        out: np.ndarray,
        i: int,
        structure: Structure,
        states: Sequence[State],
        known: dict[tuple[str, int, float], np.ndarray],
    ) -> None:
        """Add what states do to the shape of the i-th elements; ``known``: body, order and radius -> figures."""
        surface = self.form[0][i].surface
        for c, element in enumerate(self.chains.elements_at(i)):
            motions = [state.get(element.body, AT_REST) for state in states]
            if surface.curvature is not None and any(m.radius or m.conic for m in motions):
                out[surface.curvature, c] /= [1.0 + motion.radius for motion in motions]
                out[surface.conic, c] += [motion.conic for motion in motions]
            if surface.figure is None or not any(motion.figure for motion in motions):
                continue
            key = element.body, structure.figure_order, self.chains.radius(i, c)
            if key not in known:
                known[key] = _figures(motions, *key[1:])
            out[list(surface.figure.coefficients), c] += known[key]


def _figures(motions: Sequence[Motion], order: int, radius: float) -> np.ndarray:
    """Coefficients that figures of S motions add, (T, S), as ``zernike.monomials`` has them."""
    amplitudes = np.zeros((len(motions), max(j for motion in motions for j in motion.figure)))
    for s, motion in enumerate(motions):
        for j, amplitude in motion.figure.items():
            amplitudes[s, j - 1] = amplitude
    # in one order on every processor
    return np.asarray(np.einsum("sj,jt->ts", amplitudes, zernike.unit_monomials(amplitudes.shape[1], order, radius)))


def assemble(
    assembly: Assembly,
    sequences: Sequence[str | Sequence[str]],
    states: Sequence[State] = ({},),
    step: Sequence[tuple[str, str, int]] | None = None,
    placed: PlacedBodies | None = None,
) -> SystemBatch:
    """Work out the numbers of every sequence in every state.

    Parameters
    ----------
    assembly : Assembly
        The instrument.
    sequences : Sequence[str | Sequence[str]]
        Names of sequences, or element-name tuples, all of the same structure.
    states : Sequence[State]
        S perturbed states.
    step : Sequence[tuple[str, str, int]] | None
        Optional derivative: one (body, kind, axis) per state; kind ``rotate``, ``shift``, ``scale`` or ``figure`` (the
        axis is then a Noll index that the state's figure names, with 0 if there is none).
    placed : PlacedBodies | None
        The bodies of these states, when already placed.

    Returns
    -------
    SystemBatch
        A batch of len(sequences) * S systems, sequence by sequence.

    Raises
    ------
    ValueError
        The sequences differ in structure.
    """
    placed = assembly.place(states, step) if placed is None else placed
    known = assembly.worked_out
    along = tuple(s if isinstance(s, str) else tuple(s) for s in sequences)
    chains = known.get(along)
    if chains is None:
        chains = known[along] = _Chains.of(assembly, along)
    shapes = _Shapes.of(states)
    structure = chains.structure(shapes)
    design = known.get((along, structure))
    if design is None:
        design = known[along, structure] = _Design.of(assembly, chains, structure)
    world = Poses(*(np.concatenate([a[:, b] for b in chains.bodies]) for a in (placed.rotation, placed.translation)))
    size = np.concatenate([placed.size(chain[-1].body) for chain in chains.elements])
    grids = list(design.grids)
    if step is None and not np.iscomplexobj(placed.rotation):
        numbers = design.in_states(assembly, states, placed)
        numbers[design.frame_rows[-1]] = world.last_rows()
        for i, here in enumerate(design.form[0]):
            if not shapes.gridded.isdisjoint(chains.depends[i]):
                own, grids[i] = chains.own(assembly, i, structure[i], states, placed)
                rows = numbers_in((here.surface, here.aperture, here.before, here.after))
                numbers[rows] = numbers_in((own.surface, own.aperture, own.before, own.after))
        return SystemBatch(structure, design.form, numbers, world, None, None, size, tuple(grids), len(states))
    values = []
    for i, frame in enumerate(frames_of(placed, chains.bodies)):
        own, grids[i] = chains.own(assembly, i, structure[i], states, placed, step)
        values.append(ElementNumbers(FrameNumbers.of(frame), own.surface, own.aperture, own.before, own.after))
    numbers = np.array([number.real for number in numbers_in((tuple(values), world.last()))])
    tangents, world_tangents = None, None
    if step is not None:
        tangents, world_tangents = tuple(map_leaves(_tangent, v) for v in values), map_leaves(_tangent, world)
    world = map_leaves(lambda value: np.ascontiguousarray(value.real), world)
    return SystemBatch(
        structure, design.form, numbers, world, tangents, world_tangents, size, tuple(grids), len(states)
    )


def _tangent(value: np.ndarray) -> np.ndarray | None:
    return value.imag / COMPLEX_STEP if np.iscomplexobj(value) else None
