"""Numbers of a sequence of elements for a batch of systems, ready for the trace.

A *system* is one sequence in one perturbed state. Sequences of the same structure (same kinds of surface in the same
order) can be batched together: the two cameras of an instrument, left and right channels, hundreds of states.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from optics.geometry import zernike
from optics.geometry.aperture import Circle, Ellipse
from optics.geometry.surface import GridFigure, ZernikeFigure
from optics.geometry.tree import AT_REST, COMPLEX_STEP, FIGURE, PlacedBodies, State
from optics.numerics.backend import Backend
from optics.raytrace.assembly import Assembly, Element, Interaction


@dataclass(frozen=True)
class Structure:
    """What decides the code of the kernel (as against the numbers that it works on), for one element."""

    interaction: Interaction
    plane: bool
    even: int
    figure_order: int  # radial order of the Zernike figure, -1 for none
    grid: bool
    aperture: str  # "", "circle", "ring", "rectangle" or "ellipse"
    graded: tuple[bool, bool] = (False, False)  # whether the medium before and the one after has an index gradient


@dataclass(frozen=True, eq=False)
class SystemBatch:
    """Numbers of B systems: element by element, name -> array of shape (B,).

    ``R00..R22``, ``T0..T2`` take the ray from the frame of the element before (the world for the first) into the
    frame of this element; ``W...``/``P...`` are the element's world pose, ``S`` the size of its body.

    Attributes:
        structure: per element.
        values: per element, parameter name -> (B,) float64.
        tangents: the same for the derivative that was asked for, or None.
        grids: per element, spline tables (grid figures are not perturbed), flattened with their size.
        count: B.
        states: number of states S; systems are ordered sequence by sequence, B = sequences * S.
    """

    structure: tuple[Structure, ...]
    values: tuple[Mapping[str, np.ndarray], ...]
    tangents: tuple[Mapping[str, np.ndarray], ...] | None
    grids: tuple[np.ndarray | None, ...]
    count: int
    states: int

    @property
    def size(self) -> np.ndarray:
        """Size of the last element's body relative to nominal, (B,)."""
        return self.values[-1]["S"]

    def upload(self, backend: Backend) -> UploadedSystems:
        """Copy to the backend's memory as kernel inputs; derivatives, if any, become forward-mode gradients."""
        import drjit as dr

        uploaded = []
        for i, values in enumerate(self.values):
            arrays = {}
            for name, value in values.items():
                array = backend.opaque(value)
                if self.tangents is not None:
                    tangent = self.tangents[i].get(name)
                    if tangent is not None:
                        dr.enable_grad(array)
                        dr.set_grad(array, backend.opaque(tangent))
                arrays[name] = array
            uploaded.append(arrays)
        grids = tuple(None if g is None else backend.opaque(g) for g in self.grids)
        return UploadedSystems(self.structure, tuple(uploaded), grids, self.count, self.tangents is not None)

    def take(self, systems: np.ndarray) -> SystemBatch:
        """The systems of the given indices."""
        tangents = (
            None if self.tangents is None else tuple({k: v[systems] for k, v in t.items()} for t in self.tangents)
        )
        values = tuple({k: v[systems] for k, v in e.items()} for e in self.values)
        return SystemBatch(self.structure, values, tangents, self.grids, len(systems), len(systems))


@dataclass(frozen=True, eq=False)
class UploadedSystems:
    """A ``SystemBatch`` in the memory of a backend (Dr.Jit arrays)."""

    structure: tuple[Structure, ...]
    values: tuple[Mapping[str, Any], ...]
    grids: tuple[Any, ...]
    count: int
    differentiable: bool


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
        structures.append(_structures([chain[i] for chain in chains], states, gradients))
    per_chain = []
    for chain, along in zip(chains, media, strict=True):
        per_chain.append(
            [
                {
                    **_numbers(chain, i, structures[i], states, placed, step),
                    **_media_numbers(assembly, chain[i], along[i : i + 2], structures[i], states, placed),
                }
                for i in range(len(chain))
            ]
        )
    values = []
    tangents = []
    for i in range(len(chains[0])):
        joined = {k: np.concatenate([numbers[i][k] for numbers in per_chain]) for k in per_chain[0][i]}
        values.append({k: np.ascontiguousarray(v.real) for k, v in joined.items()})
        tangents.append({k: v.imag / COMPLEX_STEP for k, v in joined.items() if np.iscomplexobj(v)})
    grids = tuple(_grid(chains[0][i]) for i in range(len(chains[0])))
    return SystemBatch(
        tuple(structures),
        tuple(values),
        tuple(tangents) if step is not None else None,
        grids,
        len(chains) * len(states),
        len(states),
    )


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


def _media_numbers(
    assembly: Assembly,
    element: Element,
    media: Sequence[Medium],
    structure: Structure,
    states: Sequence[State],
    placed: PlacedBodies,
) -> dict[str, np.ndarray]:
    """Indices before (n) and after (n_after) an element, (S,) each.

    Where the medium is graded the index is n + (nx, ny, nz) . p at p in the element's frame, likewise after it.
    """
    out = {}
    here = placed.index[element.body]
    turn, origin = placed.rotation[:, here], placed.translation[:, here]
    for name, medium, graded in zip(("n", "n_after"), media, structure.graded, strict=True):
        if medium.solid is None:
            index = np.full(len(states), medium.index)
            gradient = np.zeros((len(states), 3))
        else:
            motions = [state.get(medium.solid, AT_REST) for state in states]
            index = assembly.media[medium.solid] + np.array([m.index for m in motions])
            glass = placed.index[medium.solid]
            own = np.array([m.index_gradient for m in motions])
            world = np.einsum("sij,sj->si", placed.rotation[:, glass], own)
            gradient = np.einsum("sji,sj->si", turn, world)
            if graded:
                index = index + np.einsum("si,si->s", world, origin - placed.translation[:, glass])
        out[name] = index
        if graded:
            out.update({f"{name}{axis}": gradient[:, a] for a, axis in enumerate("xyz")})
    return out


def _structures(elements: Sequence[Element], states: Sequence[State], graded: tuple[bool, bool]) -> Structure:
    """Common structure of the i-th elements of all chains."""
    kinds = {
        (
            e.interaction,
            e.surface.is_plane,
            isinstance(e.surface.figure, GridFigure),
            _aperture_kind(e),
        )
        for e in elements
    }
    if len(kinds) != 1:
        raise ValueError(
            f"elements of different kinds cannot be batched: {', '.join(sorted(e.name for e in elements))}"
        )
    interaction, is_plane, grid, aperture = kinds.pop()
    # a plane may have terms that are zero, and the terms that a surface lacks are
    even = 0 if is_plane else max(len(e.surface.even) for e in elements)
    order = -1
    for e in elements:
        if isinstance(e.surface.figure, ZernikeFigure):
            order = max(order, zernike.order_of(e.surface.figure.terms))
        for state in states:
            motion = state.get(e.body)
            if motion is not None and motion.figure:
                order = max(order, zernike.order_of(motion.figure))
    return Structure(interaction, is_plane, even, order, grid, aperture, graded)


def _aperture_kind(element: Element) -> str:
    if element.aperture is None:
        return ""
    if isinstance(element.aperture, Circle):
        return "ring" if element.aperture.inner else "circle"
    return "ellipse" if isinstance(element.aperture, Ellipse) else "rectangle"


def _grid(element: Element) -> np.ndarray | None:
    figure = element.surface.figure
    return figure.spline.ravel() if isinstance(figure, GridFigure) else None


def _numbers(
    chain: Sequence[Element],
    i: int,
    structure: Structure,
    states: Sequence[State],
    placed: PlacedBodies,
    step: Sequence[tuple[str, str, int]] | None,
) -> dict[str, np.ndarray]:
    """Parameters of element i of a chain, each of shape (S,), complex when a derivative is carried."""
    element = chain[i]
    count = len(states)
    body = placed.index[element.body]
    rotation, translation = placed.rotation[:, body], placed.translation[:, body]
    if i == 0:
        relative = np.swapaxes(rotation, -1, -2)
        offset = -np.einsum("sij,si->sj", rotation, translation)
    else:
        before = placed.index[chain[i - 1].body]
        relative = np.einsum("ski,skj->sij", rotation, placed.rotation[:, before])
        offset = np.einsum("ski,sk->si", rotation, placed.translation[:, before] - translation)
    out: dict[str, np.ndarray] = {}
    for a in range(3):
        out[f"T{a}"] = offset[:, a]
        out[f"P{a}"] = translation[:, a]
        for b in range(3):
            out[f"R{a}{b}"] = relative[:, a, b]
            out[f"W{a}{b}"] = rotation[:, a, b]
    scale = placed.scale[:, body]
    out["S"] = scale.real
    surface = element.surface
    if not structure.plane:
        out["c"] = surface.curvature / scale
        out["k"] = np.full(count, surface.conic)
        for n in range(structure.even):
            term = surface.even[n] if n < len(surface.even) else 0.0
            out[f"A{n}"] = term / scale ** (2 * n + 3)
    if structure.figure_order >= 0:
        out.update(_figure_numbers(element, structure.figure_order, states, step))
    if isinstance(surface.figure, GridFigure):
        x0, _, y0, _ = surface.figure.bounds
        dx, dy = surface.figure.spacing
        rows, columns = surface.figure.values.shape
        grid = {"gx0": x0, "gy0": y0, "gix": 1.0 / dx, "giy": 1.0 / dy, "gnx": float(columns), "gny": float(rows)}
        out.update({name: np.full(count, value) for name, value in grid.items()})
    aperture = element.aperture
    if aperture is not None:
        # an edge has no derivative: it lets a ray pass or stops it
        grown = scale.real
        out["ax"], out["ay"] = grown * aperture.centre[0], grown * aperture.centre[1]
        if isinstance(aperture, Circle):
            out["ar2"], out["ai2"] = (grown * aperture.radius) ** 2, (grown * aperture.inner) ** 2
        else:
            out["ahx"], out["ahy"] = grown * aperture.half_x, grown * aperture.half_y
    return out


def _figure_numbers(
    element: Element, order: int, states: Sequence[State], step: Sequence[tuple[str, str, int]] | None
) -> dict[str, np.ndarray]:
    """Monomial coefficients of the Zernike figure of each state, named F0, F1, ...; centre fx, fy."""
    figure = element.surface.figure
    if isinstance(figure, ZernikeFigure):
        radius, centre, base = figure.radius, figure.centre, dict(figure.terms)
    elif isinstance(element.aperture, Circle):
        radius, centre, base = element.aperture.radius, element.aperture.centre, {}
    elif element.aperture is not None:
        radius, centre, base = (
            float(np.hypot(element.aperture.half_x, element.aperture.half_y)),
            element.aperture.centre,
            {},
        )
    else:
        raise ValueError(f"element {element.name!r} needs an aperture to carry a figure: it sets the disk")
    kind = np.float64 if step is None else np.complex128
    table = np.empty((len(states), zernike.triangle_size(order)), kind)
    for s, state in enumerate(states):
        terms: dict[int, Any] = dict(base)
        for j, amplitude in state.get(element.body, AT_REST).figure.items():
            terms[j] = terms.get(j, 0.0) + amplitude
        if step is not None and step[s][:2] == (element.body, FIGURE):
            terms[step[s][2]] = terms.get(step[s][2], 0.0) + 1j * COMPLEX_STEP
        table[s] = zernike.monomials(terms, order, radius)
    out = {f"F{m}": table[:, m] for m in range(table.shape[1])}
    out["fx"] = np.full(len(states), centre[0])
    out["fy"] = np.full(len(states), centre[1])
    return out
