"""Batches of systems: the numbers of element sequences in perturbed states, ready for the trace.

A *system* is one sequence in one perturbed state. Sequences of the same structure (same kinds of surface in the same
order) can be batched together: the two cameras of an instrument, left and right channels, hundreds of states. The
sequences of a batch are its *chains*. All numbers of a batch form one table, with a row for each number.

The assembly caches the numbers of the nominal design. States overwrite them: frames, indices and their gradients,
radii, conic constants and Zernike figures; and each number of an expanded body is scaled by a power of its size.
Elements are computed one by one only for derivatives and for grid figures.
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
from optics.raytrace import element_numbers
from optics.raytrace.assembly import Assembly, Element


def changed_bodies(assembly: Assembly, states: Sequence[State], placed: PlacedBodies) -> set[str]:
    """Return the bodies that some state names, or whose pose or size it changes through the bodies that carry them."""
    nominal = assembly.place()
    changed = np.any(placed.rotation != nominal.rotation, axis=(0, 2, 3))
    changed |= np.any(placed.translation != nominal.translation, axis=(0, 2))
    changed |= np.any(placed.scale != nominal.scale, axis=0)
    return {path for path, i in placed.index.items() if changed[i]}.union(*states)


def frames_of(placed: PlacedBodies, bodies: np.ndarray) -> np.ndarray:
    """Return the transforms into each element's frame from that of the element before, for all sequences and states.

    Parameters
    ----------
    placed : PlacedBodies
        World poses of the bodies in S states.
    bodies : (C, K) ndarray of int
        Indices of the elements' bodies, for C sequences of K elements.

    Returns
    -------
    (K, 12, C * S) ndarray
        Numbers of ``FrameNumbers`` per element, sequence by sequence.
    """
    rotation, translation = placed.rotation[:, bodies], placed.translation[:, bodies]
    relative, offset = np.empty_like(rotation), np.empty_like(translation)
    relative[:, :, 0] = np.swapaxes(rotation[:, :, 0], -1, -2)
    offset[:, :, 0] = -np.einsum("scij,sci->scj", rotation[:, :, 0], translation[:, :, 0])
    relative[:, :, 1:] = np.einsum("sckmi,sckmj->sckij", rotation[:, :, 1:], rotation[:, :, :-1])
    step = translation[:, :, :-1] - translation[:, :, 1:]
    offset[:, :, 1:] = np.einsum("sckmi,sckm->scki", rotation[:, :, 1:], step)
    numbers = np.concatenate([offset[..., None], relative], axis=-1).transpose(2, 3, 4, 1, 0)
    return np.ascontiguousarray(numbers).reshape(len(numbers), 12, -1)


@dataclass(frozen=True, eq=False)
class SystemBatch:
    """Numbers of B systems (sequences of elements in perturbed states), as a table with a row for each of L numbers.

    Attributes
    ----------
    structure : tuple of Structure
        Structure of each element.
    form : (tuple of ElementNumbers, FrameNumbers)
        Numbers that the trace reads per element, and the pose of the last element; each number replaced by its row in
        ``numbers``.
    numbers : (L, B) ndarray
        Values of all numbers, row by row.
    world : Poses
        Poses of the elements in the world.
    tangents : tuple of ElementNumbers, optional
        Derivatives of ``values`` with respect to the requested parameter (None for a number that does not depend on
        it); None if no derivative was requested.
    world_tangents : Poses, optional
        Derivatives of ``world``.
    size : (B,) ndarray
        Size of the last element's body relative to nominal.
    grids : tuple of ndarray, optional
        Per element, the spline coefficients of all systems' grid figures, one after the other; None without any.
    states : int
        Number of states S; systems are ordered sequence by sequence, B = sequences * S.
    """

    structure: tuple[element_numbers.Structure, ...]
    form: tuple[tuple[element_numbers.ElementNumbers, ...], element_numbers.FrameNumbers]
    numbers: np.ndarray
    world: Poses
    tangents: tuple[element_numbers.ElementNumbers, ...] | None
    world_tangents: Poses | None
    size: np.ndarray
    grids: tuple[np.ndarray | None, ...]
    states: int

    @property
    def count(self) -> int:
        """Number B of systems (element sequences in a perturbed state)."""
        return int(self.numbers.shape[1])

    @cached_property
    def values(self) -> tuple[element_numbers.ElementNumbers, ...]:
        """Numbers that the trace reads per element, each of shape (B,) for B systems."""
        return map_leaves(lambda row: self.numbers[row], self.form[0])

    def upload(self, backend: Backend, separate: bool = False) -> UploadedSystems:
        """Copy to the backend's memory as kernel inputs; derivatives, if any, become forward-mode gradients.

        Parameters
        ----------
        backend : Backend
            Backend to upload to.
        separate : bool
            True: each number is an array of its own, so that results can be differentiated with respect to it; False:
            the numbers of several systems share one array.
        """
        grids = tuple(None if g is None else backend.opaque(g) for g in self.grids)
        if self.tangents is None:
            # a single system has one value of each number for all rays, so that no lookup is needed
            individually = separate or self.count == 1
            numbers = tuple(backend.opaque_each(list(self.numbers))) if individually else backend.opaque(self.numbers)
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
        """Return a batch of some of the systems, given by their indices."""
        if np.array_equal(systems, np.arange(self.count)):
            return self

        def taken(value: np.ndarray) -> np.ndarray:
            return np.asarray(value[systems])

        parts = ("world", "tangents", "world_tangents")
        update: dict[str, Any] = {name: map_leaves(taken, getattr(self, name)) for name in parts}
        numbers, size = self.numbers[:, systems], self.size[systems]
        return replace(self, numbers=numbers, size=size, states=len(systems), **update)


@dataclass(frozen=True, eq=False)
class Poses:
    """Poses of the K elements of B systems in the world.

    Attributes
    ----------
    rotation : (B, K, 3, 3) ndarray
        Rotations from element frame to world.
    translation : (B, K, 3) ndarray
        Origins of the elements, metres.
    """

    rotation: np.ndarray
    translation: np.ndarray

    def last(self) -> element_numbers.FrameNumbers:
        """Return the world poses of the last element of each system, as ``FrameNumbers``."""
        return element_numbers.FrameNumbers.of(self.last_rows())

    def last_rows(self) -> np.ndarray:
        """Return the poses of the last elements of B systems as 12 numbers each, (12, B).

        For each axis of the world these are the shift and the row of the rotation matrix, in the order of
        ``FrameNumbers``.
        """
        both = np.concatenate([self.translation[:, -1, :, None], self.rotation[:, -1]], axis=-1)
        return np.ascontiguousarray(both.reshape(len(both), 12).T)


@dataclass(frozen=True, eq=False)
class UploadedSystems:
    """Numbers of B systems (a ``SystemBatch``) in the memory of a backend.

    Attributes
    ----------
    backend : Backend
        Backend of the arrays.
    structure : tuple of Structure
        Structure of each element.
    form : (tuple of ElementNumbers, FrameNumbers)
        For each element and for the last pose, its numbers, each replaced by its row in the table of L numbers.
    numbers : Dr.Jit arrays
        L arrays (B,); or one array (L * B,), number by number.
    grids : tuple
        Per element, the spline coefficients of all systems' grid figures; None without any.
    count : int
        Number of systems B.
    differentiable : bool
        True when numbers carry derivatives.
    first : int, optional
        Row of the first element's first number, where the elements are part of a longer sequence; else None.
    """

    backend: Backend
    structure: tuple[element_numbers.Structure, ...]
    form: tuple[tuple[element_numbers.ElementNumbers, ...], element_numbers.FrameNumbers]
    numbers: Any
    grids: tuple[Any, ...]
    count: int
    differentiable: bool
    first: int | None = None

    @cached_property
    def values(self) -> tuple[element_numbers.ElementNumbers, ...]:
        """Numbers that the trace reads per element, as Dr.Jit arrays with one value for each of B systems, (B,)."""
        import drjit as dr

        if isinstance(self.numbers, tuple):
            return map_leaves(lambda index: self.numbers[index], self.form[0])
        system = dr.arange(self.backend.UInt, self.count)
        return map_leaves(
            lambda index: dr.gather(self.backend.Float, self.numbers, system + index * self.count), self.form[0]
        )

    def section(self, first: int, last: int) -> UploadedSystems:
        """Return elements ``first`` to ``last - 1`` alone, for rays in the frame of the element before them.

        The pose remains that of the last element of the whole sequence.
        """
        part = slice(first, last)
        form = self.form[0][part], self.form[1]
        row = None if isinstance(self.numbers, tuple) else form[0][0].frame.x.shift
        return replace(self, structure=self.structure[part], form=form, grids=self.grids[part], first=row)


@dataclass(frozen=True, eq=False)
class _Shapes:
    """Changes of shape and refractive index in a set of states for which a kernel needs other code.

    Attributes
    ----------
    orders : mapping of str to int
        Body -> highest radial order of the Zernike figures that states give it.
    gridded : frozenset of str
        Bodies to which a state gives a grid figure.
    graded : frozenset of str
        Glass bodies with an index gradient in a state.
    """

    orders: Mapping[str, int]
    gridded: frozenset[str]
    graded: frozenset[str]

    @classmethod
    def of(cls, states: Sequence[State]) -> _Shapes:
        """Return the bodies to which the motions of the states give figures or index gradients."""
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
    """Sequences of optical elements that are traced together: C chains of K elements each.

    Attributes
    ----------
    elements, media : tuple of tuple
        Elements of each chain, and the media before, between and after them.
    bodies : (C, K) ndarray of int
        Indices of the elements' bodies.
    depends : tuple of frozenset of str
        Per element of the chains, the bodies whose shape or index may affect it.
    nominal : tuple of Structure
        Structure of the nominal elements.
    """

    elements: tuple[tuple[Element, ...], ...]
    media: tuple[tuple[element_numbers.Medium, ...], ...]
    bodies: np.ndarray
    depends: tuple[frozenset[str], ...]
    nominal: tuple[element_numbers.Structure, ...]

    @classmethod
    def of(cls, assembly: Assembly, sequences: tuple[str | tuple[str, ...], ...]) -> _Chains:
        """Return the chains that named sequences of an assembly form; raise ValueError where their lengths differ."""
        named = [assembly.sequences[s] if isinstance(s, str) else s for s in sequences]
        chains = tuple(tuple(assembly.elements[name] for name in names) for names in named)
        lengths = {len(chain) for chain in chains}
        if len(lengths) != 1:
            raise ValueError(f"sequences of different lengths cannot be batched: {sorted(lengths)}")
        media = tuple(tuple(element_numbers.media_along(chain)) for chain in chains)
        index = assembly.place().index
        depends = []
        for i in range(len(chains[0])):
            glass = {m.solid for along in media for m in along[i : i + 2] if m.solid is not None}
            depends.append(frozenset(glass.union(chain[i].body for chain in chains)))
        bodies = np.array([[index[element.body] for element in chain] for chain in chains])
        designed = tuple(element_numbers.structure_of(column) for column in zip(*chains, strict=True))
        return cls(chains, media, bodies, tuple(depends), designed)

    def radius(self, i: int, c: int) -> float:
        """Return the radius of the disk of Zernike figures of element ``i`` of chain ``c``, metres."""
        if (i, c) not in self._radii:
            self._radii[i, c] = self.elements[c][i].figure_disk.radius
        return self._radii[i, c]

    @cached_property
    def _radii(self) -> dict[tuple[int, int], float]:
        """Cache of ``radius``: (element, chain) -> radius of the disk of Zernike figures, metres."""
        return {}

    def elements_at(self, i: int) -> list[Element]:
        """Return the elements at position ``i`` of all chains."""
        return [chain[i] for chain in self.elements]

    def structure(self, shapes: _Shapes) -> tuple[element_numbers.Structure, ...]:
        """Return the structure of each element, including what the states' changes of shape add to it."""
        changed, out = shapes.orders.keys() | shapes.gridded | shapes.graded, list(self.nominal)
        for i, nominal in enumerate(out):
            if changed.isdisjoint(self.depends[i]):
                continue
            bodies = {element.body for element in self.elements_at(i)}
            out[i] = replace(
                nominal,
                figure_order=max(nominal.figure_order, *(shapes.orders.get(body, -1) for body in bodies)),
                grid=nominal.grid or not shapes.gridded.isdisjoint(bodies),
                graded=(self._graded(i, shapes), self._graded(i + 1, shapes)),
            )
        return tuple(out)

    def _graded(self, medium: int, shapes: _Shapes) -> bool:
        """Return True when medium number ``medium`` of a chain has an index gradient, in some chain and state."""
        return any(media[medium].solid in shapes.graded for media in self.media)

    def local_numbers(
        self,
        assembly: Assembly,
        i: int,
        structure: element_numbers.Structure,
        states: Sequence[State],
        placed: PlacedBodies,
        step: Sequence[tuple[str, str, int]] | None = None,
    ) -> tuple[element_numbers.LocalNumbers, np.ndarray | None]:
        """Return shapes and indices of the elements at position ``i``, and the tables of their grid figures.

        Each number has the shape (C * S,) for C chains in S states. An element that several chains share is computed
        once.
        """
        by_key: dict[tuple[str, element_numbers.Medium, element_numbers.Medium], element_numbers.LocalNumbers] = {}
        keys = [(chain[i].name, m[i], m[i + 1]) for chain, m in zip(self.elements, self.media, strict=True)]
        for key in keys:
            if key not in by_key:
                name, before, after = key
                by_key[key] = element_numbers.local_numbers_of(
                    assembly, assembly.elements[name], (before, after), structure, states, placed, step
                )
        parts = [by_key[key] for key in keys]
        numbers = map_leaves(lambda *arrays: np.concatenate(arrays), parts[0], *parts[1:])
        if not structure.grid:
            return numbers, None
        grid, spline = element_numbers.grid_numbers(self.elements_at(i), states)
        return replace(numbers, surface=replace(numbers.surface, grid=grid)), spline


@dataclass(frozen=True, eq=False)
class _Sides:
    """Places in the table of numbers that hold the refractive index of one glass body.

    The index is needed at each side, before or after, of an optical element that the glass body fills.

    Attributes
    ----------
    rows, chains, bodies : (N,) ndarray of int
        For each of N sides of elements, the row of its index in the table of numbers, its chain, and the index of the
        element's body.
    gradient : (G,) ndarray of int
        Those G of the N sides whose numbers include an index gradient.
    slopes : (3, G) ndarray of int
        Rows of the three components of the gradient, for these sides.
    """

    rows: np.ndarray
    chains: np.ndarray
    bodies: np.ndarray
    gradient: np.ndarray
    slopes: np.ndarray


@dataclass(frozen=True, eq=False)
class _Design:
    """Numbers of C chains of K elements in the nominal state, and which of them a perturbed state changes.

    The L numbers of a chain (poses, shapes, refractive indices) form a column of a table.

    Attributes
    ----------
    chains : _Chains
        The chains.
    structure, form : tuple
        Structure of each element; and the elements' numbers, each replaced by its row in the table.
    numbers : (L, C) ndarray
        Nominal numbers; those of frames are not set.
    grids : tuple of ndarray, optional
        Per element, the spline coefficients of all chains' grid figures; None without any.
    scaling : mapping of int to (ndarray, ndarray, ndarray)
        Power -> rows and chains of the numbers that scale with that power of their bodies' sizes, and the indices of
        these bodies.
    glass : mapping of str to _Sides
        Glass body -> sides of elements that it fills.
    frame_rows : (K + 1, 12) ndarray of int
        Rows of the 12 numbers of each element's frame, and of the pose of the last element.
    """

    chains: _Chains
    structure: tuple[element_numbers.Structure, ...]
    form: tuple[tuple[element_numbers.ElementNumbers, ...], element_numbers.FrameNumbers]
    numbers: np.ndarray
    grids: tuple[np.ndarray | None, ...]
    scaling: Mapping[int, tuple[np.ndarray, np.ndarray, np.ndarray]]
    glass: Mapping[str, _Sides]
    frame_rows: np.ndarray

    @classmethod
    def of(cls, assembly: Assembly, chains: _Chains, structure: tuple[element_numbers.Structure, ...]) -> _Design:
        """Return the nominal numbers of chains whose elements have a given structure."""
        placed, frame = assembly.place(), element_numbers.FrameNumbers.of(np.zeros((12, len(chains.elements))))
        twice = replace(placed, scale=np.full_like(placed.scale, 2.0))

        def values(placed: PlacedBodies) -> tuple[tuple[element_numbers.ElementNumbers, ...], list[np.ndarray | None]]:
            local, grids = zip(
                *(chains.local_numbers(assembly, i, kind, ({},), placed) for i, kind in enumerate(structure)),
                strict=True,
            )
            return tuple(
                element_numbers.ElementNumbers(frame, o.surface, o.aperture, o.before, o.after) for o in local
            ), grids

        designed, grids = values(placed)
        form = form_of((designed, frame))
        numbers, doubled = (
            np.array(numbers_in((element_form, frame))) for element_form in (designed, values(twice)[0])
        )
        # each scales with a power of its body's size, which follows exactly from the numbers at twice the size
        known = (numbers != 0.0) & (doubled != 0.0)
        power = np.frexp(np.divide(doubled, numbers, out=np.ones_like(numbers), where=known))[1] - 1
        element = np.zeros(len(numbers), int)
        for i, element_form in enumerate(form[0]):
            element[numbers_in(element_form)] = i
        scaling = {}
        for exponent in set(power.ravel().tolist()) - {0}:
            rows, columns = np.nonzero(power == exponent)
            scaling[exponent] = rows, columns, chains.bodies[columns, element[rows]]
        frames = np.array([numbers_in(f) for f in (*(element_form.frame for element_form in form[0]), form[1])])
        return cls(chains, structure, form, numbers, tuple(grids), scaling, cls._sides(chains, form[0]), frames)

    @staticmethod
    def _sides(chains: _Chains, form: tuple[element_numbers.ElementNumbers, ...]) -> dict[str, _Sides]:
        """Return a mapping from each glass body to the sides of elements that it fills."""
        by_solid: dict[str, list[tuple[Any, int, int]]] = {}
        for c, media in enumerate(chains.media):
            for i, element in enumerate(form):
                for medium, side in ((media[i], element.before), (media[i + 1], element.after)):
                    if medium.solid is not None:
                        by_solid.setdefault(medium.solid, []).append((side, c, int(chains.bodies[c, i])))
        out = {}
        for solid, sides in by_solid.items():
            index, columns, bodies = (
                np.array(column) for column in zip(*((s.index, c, b) for s, c, b in sides), strict=True)
            )
            graded = np.array([k for k, (side, _, _) in enumerate(sides) if side.gradient is not None], int)
            slopes = np.array([sides[k][0].gradient for k in graded], int).reshape(-1, 3).T
            out[solid] = _Sides(index, columns, bodies, graded, slopes)
        return out

    def in_states(self, assembly: Assembly, states: Sequence[State], placed: PlacedBodies) -> np.ndarray:
        """Return the L numbers of C chains in S states, (L, C * S), except grid figures."""
        count = len(states)
        out = np.repeat(self.numbers[:, :, None], count, axis=2)
        if np.any(placed.scale != 1.0):
            self._apply_scale(out, placed)
        paths = {path for state in states for path in state}
        for solid in paths.intersection(self.glass):
            self._set_index(out, assembly, solid, states, placed)
        known: dict[tuple[str, int, float], np.ndarray] = {}
        for i, structure in enumerate(self.structure):
            if not paths.isdisjoint(self.chains.depends[i]):
                self._apply_shape(out, i, structure, states, known)
        flat = out.reshape(len(out), -1)
        flat[self.frame_rows[:-1]] = frames_of(placed, self.chains.bodies)
        return flat

    def _apply_scale(self, out: np.ndarray, placed: PlacedBodies) -> None:
        """Scale the numbers of expanded bodies in ``out`` by the body's size, to the power that their unit requires."""
        for power, (rows, columns, bodies) in self.scaling.items():
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
        """Set the refractive index of a glass body, and its gradient, in ``out`` for each state."""
        sides, glass = self.glass[solid], placed.index[solid]
        motions = [state.get(solid, AT_REST) for state in states]
        out[sides.rows, sides.chains] = [assembly.index(solid, motion) for motion in motions]
        if not sides.gradient.size:
            return
        columns, faces = sides.chains[sides.gradient], sides.bodies[sides.gradient]
        world = np.einsum("sij,sj->si", placed.rotation[:, glass], [motion.index_gradient for motion in motions])
        out[sides.slopes, columns] = np.einsum("snji,sj->ins", placed.rotation[:, faces], world)
        offset = placed.translation[:, faces] - placed.translation[:, glass, None]
        out[sides.rows[sides.gradient], columns] += np.einsum("si,sni->ns", world, offset)

    def _apply_shape(
        self,
        out: np.ndarray,
        i: int,
        structure: element_numbers.Structure,
        states: Sequence[State],
        known: dict[tuple[str, int, float], np.ndarray],
    ) -> None:
        """Apply to ``out`` the states' changes of the shapes of the elements at position ``i`` of the chains.

        They are changes of radius, conic constant and Zernike figure; ``known`` caches figures by body, order and
        radius.
        """
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
    """Return the figures of S motions as T coefficients of x^a y^b each, (T, S), up to the degree ``order``.

    ``radius`` is that of the disk of the Zernike terms, metres.
    """
    amplitudes = np.zeros((len(motions), max(j for motion in motions for j in motion.figure)))
    for s, motion in enumerate(motions):
        for j, amplitude in motion.figure.items():
            amplitudes[s, j - 1] = amplitude
    # summed in a fixed order on every processor
    return np.asarray(np.einsum("sj,jt->ts", amplitudes, zernike.unit_monomials(amplitudes.shape[1], order, radius)))


def assemble(
    assembly: Assembly,
    sequences: Sequence[str | Sequence[str]],
    states: Sequence[State] = ({},),
    step: Sequence[tuple[str, str, int]] | None = None,
    placed: PlacedBodies | None = None,
) -> SystemBatch:
    """Compute the numbers of every sequence in every state.

    Parameters
    ----------
    assembly : Assembly
        The instrument.
    sequences : sequence of str or of sequence of str
        Names of sequences, or tuples of element names, all of the same structure.
    states : sequence of State
        S perturbed states.
    step : sequence of (str, str, int), optional
        Motion with respect to which the numbers are differentiated: one (body, kind, axis) per state; kind ``rotate``,
        ``shift``, ``scale`` or ``figure`` (the axis is then a Noll index that the state's figure names, with 0 if there
        is none).
    placed : PlacedBodies, optional
        World poses of the bodies in these states, if already computed.

    Returns
    -------
    SystemBatch
        Batch of len(sequences) * S systems, sequence by sequence.

    Raises
    ------
    ValueError
        The sequences differ in structure.
    """
    placed = assembly.place(states, step) if placed is None else placed
    cache = assembly.system_cache
    key = tuple(s if isinstance(s, str) else tuple(s) for s in sequences)
    chains = cache.get(key)
    if chains is None:
        chains = cache[key] = _Chains.of(assembly, key)
    shapes = _Shapes.of(states)
    structure = chains.structure(shapes)
    design = cache.get((key, structure))
    if design is None:
        design = cache[key, structure] = _Design.of(assembly, chains, structure)
    world = Poses(*(np.concatenate([a[:, b] for b in chains.bodies]) for a in (placed.rotation, placed.translation)))
    size = np.concatenate([placed.size(chain[-1].body) for chain in chains.elements])
    grids = list(design.grids)
    if step is None and not np.iscomplexobj(placed.rotation):
        numbers = design.in_states(assembly, states, placed)
        numbers[design.frame_rows[-1]] = world.last_rows()
        for i, element in enumerate(design.form[0]):
            if not shapes.gridded.isdisjoint(chains.depends[i]):
                local, grids[i] = chains.local_numbers(assembly, i, structure[i], states, placed)
                rows = numbers_in((element.surface, element.aperture, element.before, element.after))
                numbers[rows] = numbers_in((local.surface, local.aperture, local.before, local.after))
        return SystemBatch(structure, design.form, numbers, world, None, None, size, tuple(grids), len(states))
    values = []
    for i, frame in enumerate(frames_of(placed, chains.bodies)):
        local, grids[i] = chains.local_numbers(assembly, i, structure[i], states, placed, step)
        values.append(
            element_numbers.ElementNumbers(
                element_numbers.FrameNumbers.of(frame), local.surface, local.aperture, local.before, local.after
            )
        )
    numbers = np.array([number.real for number in numbers_in((tuple(values), world.last()))])
    tangents, world_tangents = None, None
    if step is not None:
        tangents, world_tangents = tuple(map_leaves(_tangent, v) for v in values), map_leaves(_tangent, world)
    world = map_leaves(lambda value: np.ascontiguousarray(value.real), world)
    return SystemBatch(
        structure, design.form, numbers, world, tangents, world_tangents, size, tuple(grids), len(states)
    )


def _tangent(value: np.ndarray) -> np.ndarray | None:
    """Return the derivative that the imaginary part of a complex-step value carries; None for a real value."""
    return value.imag / COMPLEX_STEP if np.iscomplexobj(value) else None
