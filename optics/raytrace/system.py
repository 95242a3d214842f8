"""Numbers of a sequence of elements for a batch of systems, ready for the trace.

A *system* is one sequence in one perturbed state. Sequences of the same structure (same kinds of surface in the same
order) can be batched together: the two cameras of an instrument, left and right channels, hundreds of states.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np

from optics.geometry.tree import COMPLEX_STEP, PlacedBodies, State
from optics.numerics.backend import Backend
from optics.numerics.number_tree import map_leaves
from optics.raytrace.assembly import Assembly
from optics.raytrace.element_numbers import (
    ElementNumbers,
    FrameNumbers,
    Structure,
    bodies_of,
    grid_numbers,
    media_along,
    numbers_of,
    structure_of,
    touched_bodies,
)

Numbers = TypeVar("Numbers", ElementNumbers, FrameNumbers)
Tree = TypeVar("Tree")


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
        kept: per element, what keeps its numbers in a backend's memory, where no state touches it, else None.
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
    kept: tuple[KeptNumbers | None, ...]

    def upload(self, backend: Backend, own: bool = False) -> UploadedSystems:
        """Copy to the backend's memory as kernel inputs; derivatives, if any, become forward-mode gradients.

        Args:
            backend: where to.
            own: all arrays are this upload's own, so that they may be differentiated by; else those of elements that no
                state touches are shared with other uploads.
        """
        if self.tangents is None:
            # numbers that were replaced since are no longer those that are kept
            known = [
                kept.on(backend) if kept is not None and kept.numbers is values and not own else None
                for kept, values in zip(self.kept, self.values, strict=True)
            ]
            new = tuple(values for values, there in zip(self.values, known, strict=True) if there is None)
            uploaded, world = _uploaded(backend, (new, self.world.last()))
            others = iter(uploaded)
            values = tuple(next(others) if there is None else there for there in known)
            grids = tuple(None if g is None else backend.opaque(g) for g in self.grids)
            return UploadedSystems(self.structure, values, world, grids, self.count, False)
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
        return UploadedSystems(self.structure, values, world, grids, self.count, self.tangents is not None)

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
            (None,) * len(self.values),
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
        """Of the last elements."""
        return FrameNumbers.of(self.rotation[:, -1], self.translation[:, -1])


@dataclass(frozen=True, eq=False)
class KeptNumbers:
    """Numbers of elements as designed, (B,) each, which many states share; what was uploaded of them stays.

    Attributes:
        numbers: of the i-th elements of some chains, one after the other.
    """

    numbers: ElementNumbers
    _uploaded: dict[str, ElementNumbers] = field(default_factory=dict)

    def on(self, backend: Backend) -> ElementNumbers:
        """The numbers in a backend's memory."""
        if backend.name not in self._uploaded:
            self._uploaded[backend.name] = _uploaded(backend, self.numbers)
        return self._uploaded[backend.name]


def _uploaded(backend: Backend, tree: Tree) -> Tree:
    """A tree of arrays of one size in a backend's memory."""
    parts: list[np.ndarray] = []
    map_leaves(parts.append, tree)
    arrays = iter(backend.opaque_each(parts))
    return map_leaves(lambda value: next(arrays), tree)


@dataclass(frozen=True, eq=False)
class UploadedSystems:
    """A ``SystemBatch`` in the memory of a backend (Dr.Jit arrays); ``world`` is the last element's pose."""

    structure: tuple[Structure, ...]
    values: tuple[ElementNumbers, ...]
    world: FrameNumbers
    grids: tuple[Any, ...]
    count: int
    differentiable: bool

    def section(self, first: int, last: int) -> UploadedSystems:
        """Elements ``first`` to ``last - 1`` alone, for rays in the frame of the element before them; ``world`` remains
        the last element's of all.
        """
        part = slice(first, last)
        return replace(self, structure=self.structure[part], values=self.values[part], grids=self.grids[part])


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
    structures = []
    for i in range(len(chains[0])):
        gradients = (
            any(m[i].solid in graded for m in media),
            any(m[i + 1].solid in graded for m in media),
        )
        structures.append(structure_of([chain[i] for chain in chains], states, gradients))
    real = step is None and not np.iscomplexobj(placed.rotation)
    touched = touched_bodies(assembly, states, placed) if real else None

    parts = list(zip(chains, media, strict=True))

    def known_of(i: int) -> KeptNumbers | None:
        """The numbers of the i-th elements of all chains if no state touches them, as they are kept."""
        if touched is None or any(not touched.isdisjoint(bodies_of(chain, i, along)) for chain, along in parts):
            return None
        key = (i, tuple(tuple(element.name for element in chain[: i + 2]) for chain in chains), structures[i])
        known = assembly.known_numbers
        if key not in known:
            nominal = assembly.place()
            own = [numbers_of(assembly, c, i, m, structures[i], ({},), nominal, None) for c, m in parts]
            known[key] = KeptNumbers(_joined(own))
        out: KeptNumbers = known[key]
        return out

    def joined(i: int, known: KeptNumbers | None) -> ElementNumbers:
        """The numbers of the i-th elements of all chains."""
        if known is None:
            return _joined([numbers_of(assembly, c, i, m, structures[i], states, placed, step) for c, m in parts])
        # each system's number for all its states
        one = known.numbers
        return one if len(states) == 1 else map_leaves(lambda value: np.repeat(value, len(states)), one)

    kept = [known_of(i) for i in range(len(chains[0]))]
    values = [joined(i, known) for i, known in enumerate(kept)]
    tables: list[np.ndarray | None] = [None] * len(values)
    for i, structure in enumerate(structures):
        if structure.grid:
            grid, tables[i] = grid_numbers([chain[i] for chain in chains], states)
            values[i] = replace(values[i], surface=replace(values[i].surface, grid=grid))
            kept[i] = None
    bodies = [[placed.index[element.body] for element in chain] for chain in chains]
    world = Poses(*(np.concatenate([a[:, own] for own in bodies]) for a in (placed.rotation, placed.translation)))
    size = np.concatenate([placed.size(chain[-1].body) for chain in chains])
    return SystemBatch(
        tuple(structures),
        # joined arrays are contiguous
        tuple(values) if real else tuple(map_leaves(_real, value) for value in values),
        world if real else map_leaves(_real, world),
        tuple(map_leaves(_tangent, value) for value in values) if step is not None else None,
        map_leaves(_tangent, world) if step is not None else None,
        size,
        tuple(tables),
        len(chains) * len(states),
        len(states),
        tuple(known if len(states) == 1 else None for known in kept),
    )


def _joined(parts: Sequence[Numbers]) -> Numbers:
    """The numbers of all chains, (S,) each, one after the other."""
    return map_leaves(lambda *arrays: np.concatenate(arrays), parts[0], *parts[1:])


def _real(value: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(value.real)


def _tangent(value: np.ndarray) -> np.ndarray | None:
    return value.imag / COMPLEX_STEP if np.iscomplexobj(value) else None
