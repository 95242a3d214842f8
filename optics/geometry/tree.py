"""The rigid-body tree: bodies with poses relative to their parents, named pivots, and small motions of any of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from optics.geometry.pose import Pose, rotation_matrix, triple
from optics.geometry.surface import GridFigure
from optics.numerics.array_math import product, turned
from optics.numerics.number_tree import FrozenMap

ORIGIN = "origin"


@dataclass(frozen=True)
class Body:
    """One node of the tree.

    Attributes
    ----------
    path : str
        Full name, parts joined by ``/``; the parent is the path without its last part.
    pose : Pose
        Pose relative to the parent.
    pivots : Mapping[str, tuple[float, float, float]]
        Named points in the body's own frame, metres; ``origin`` always exists.
    scales : bool
        Whether a scale applied to an ancestor also scales the interior of this body (a focal plane moves with the
        structure that carries it but its detectors keep their size).
    """

    path: str
    pose: Pose = field(default_factory=Pose)
    pivots: Mapping[str, tuple[float, float, float]] = field(default_factory=FrozenMap)
    scales: bool = True

    def __post_init__(self) -> None:
        """Freeze the pivots."""
        pivots = {
            ORIGIN: (0.0, 0.0, 0.0),
            **{k: (float(v[0]), float(v[1]), float(v[2])) for k, v in self.pivots.items()},
        }
        object.__setattr__(self, "pivots", FrozenMap(pivots))

    @property
    def parent(self) -> str:
        """Path of the parent, empty for a root."""
        return self.path.rpartition("/")[0]

    def moved(self, motion: Motion) -> Body:
        """The body at rest where a rigid motion takes it."""
        turn, offset, _ = _affine([motion], [self])
        rotation, translation = self.pose.rotation, self.pose.translation
        return replace(self, pose=Pose(product(rotation, turn[0]), translation + turned(rotation, offset[0])))


@dataclass(frozen=True)
class Motion:
    """A small motion of one body about a pivot, in its own frame: first the rotation vector, then the shift.

    Attributes
    ----------
    rotate : tuple[float, float, float]
        Rotation vector, radians.
    shift : tuple[float, float, float]
        metres.
    pivot : str
        Name of one of the body's pivots.
    scale : float
        Relative growth of the body and all it carries about the pivot (isotropic expansion), e.g. 20e-6.
    figure : Mapping[int, float]
        Surface error of a mirror or face, Noll index -> amplitude in metres of sag (see ``optics.geometry.surface``).
    stretch : float
        Relative growth of the body itself about the pivot: its surface, and the distances to what it carries; unlike
        ``scale`` it does not enlarge the bodies that it carries (each has a temperature of its own).
    index : float
        Change of the refractive index of a glass body.
    index_gradient : tuple[float, float, float]
        Gradient of that change in the body's frame, zero at its origin, 1/m.
    grid : GridFigure | None
        Surface error of a mirror or face beyond ``figure``, on a grid.
    radius : float
        Relative change of the vertex radius of curvature of a mirror or face, e.g. 100e-6.
    conic : float
        Change of its conic constant.
    abbe : float
        Relative change of the Abbe number of a glass body. Its index at the d line stays, and what the index differs
        from that at any other wavelength goes with the inverse of the Abbe number.
    """

    rotate: tuple[float, float, float] = (0.0, 0.0, 0.0)
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    pivot: str = ORIGIN
    scale: float = 0.0
    figure: Mapping[int, float] = field(default_factory=FrozenMap)
    stretch: float = 0.0
    index: float = 0.0
    index_gradient: tuple[float, float, float] = (0.0, 0.0, 0.0)
    grid: GridFigure | None = None
    radius: float = 0.0
    conic: float = 0.0
    abbe: float = 0.0

    def __post_init__(self) -> None:
        """Freeze the figure."""
        object.__setattr__(self, "figure", FrozenMap(self.figure))

    @property
    def dispersion(self) -> float:
        """Relative change of a glass's dispersion, which its Abbe number makes."""
        return 1.0 / (1.0 + self.abbe) - 1.0

    def component(self, kind: str, axis: int) -> float:
        """One number of the motion, SI: ``rotate`` or ``shift`` by an axis, a ``figure`` term, or one of ``scale``,
        ``radius``, ``conic``, ``index`` and ``abbe``.

        Raises
        ------
        ValueError
            There is no such kind of motion.
        """
        match kind:
            case "rotate":
                return float(self.rotate[axis])
            case "shift":
                return float(self.shift[axis])
            case "scale" | "radius" | "conic" | "index" | "abbe":
                return float(getattr(self, kind))
            case "figure":
                return float(self.figure.get(axis, 0.0))
            case _:
                known = "rotate, shift, scale, radius, conic, index, abbe or figure"
                raise ValueError(f"a motion is a {known}, not a {kind!r}")


AT_REST = Motion()
"""Motion of a body that a state does not name."""

State = Mapping[str, Motion]
"""A perturbed state: body path -> motion; bodies not named stand at their nominal pose."""


@dataclass(frozen=True, eq=False)
class PlacedBodies:
    """World poses of every body for a batch of S states (complex when a complex-step derivative is taken).

    Attributes
    ----------
    index : Mapping[str, int]
        Body path -> position along the second axis.
    rotation : np.ndarray
        (S, bodies, 3, 3); translation: (S, bodies, 3), metres.
    scale : np.ndarray
        (S, bodies), size of the body itself relative to nominal.
    """

    index: Mapping[str, int]
    rotation: np.ndarray
    translation: np.ndarray
    scale: np.ndarray

    def pose(self, path: str, state: int = 0) -> Pose:
        """World pose of one body in one state (real part)."""
        i = self.index[path]
        return Pose(self.rotation[state, i].real, self.translation[state, i].real)

    def size(self, path: str) -> np.ndarray:
        """Size of one body relative to nominal in each state, (S,) (real part)."""
        return np.asarray(self.scale[:, self.index[path]].real)


@dataclass(frozen=True)
class RigidTree:
    """Bodies in an order in which parents come before their children."""

    bodies: tuple[Body, ...]

    def __post_init__(self) -> None:
        """Check names and the order."""
        seen: set[str] = set()
        for body in self.bodies:
            if body.path in seen:
                raise ValueError(f"body {body.path!r} appears twice")
            if body.parent and body.parent not in seen:
                raise ValueError(f"body {body.path!r} comes before its parent {body.parent!r}")
            seen.add(body.path)

    def __getitem__(self, path: str) -> Body:
        """The body of that path; KeyError when unknown."""
        for body in self.bodies:
            if body.path == path:
                return body
        raise KeyError(path)

    @property
    def paths(self) -> tuple[str, ...]:
        """All body paths, parents first."""
        return tuple(body.path for body in self.bodies)

    def standing(self, state: State) -> RigidTree:
        """The tree whose bodies stand by themselves as they do here in a state.

        A state of that tree is one on top of this: ``compose(state, then, bodies)`` places the bodies here where
        ``then`` places them there.

        Parameters
        ----------
        state : State
            Body path -> rigid motion.

        Raises
        ------
        KeyError
            It names an unknown body or pivot.
        ValueError
            It lets a body grow.
        """
        for path, motion in state.items():
            if path not in self._index:
                raise KeyError(path)
            if motion.pivot not in self[path].pivots:
                raise KeyError(f"{path}: pivot {motion.pivot!r}")
            if motion.scale or motion.stretch:
                raise ValueError(f"{path}: a body that has grown is another body, and no other place of it")
        return RigidTree(tuple(body.moved(state[body.path]) if body.path in state else body for body in self.bodies))

    def place(
        self, states: Sequence[State] = ({},), step: Sequence[tuple[str, str, int]] | None = None
    ) -> PlacedBodies:
        """World poses for each state.

        Parameters
        ----------
        states : Sequence[State]
            S perturbed states.
        step : Sequence[tuple[str, str, int]] | None
            Optional, one (path, kind, axis) per state with kind ``rotate``, ``shift``, ``scale`` or ``figure`` (the
            axis is then the Noll index): adds an imaginary step of ``COMPLEX_STEP`` to that component, so that
            imag/COMPLEX_STEP is the exact derivative.

        Raises
        ------
        KeyError
            a state names an unknown body or pivot.
        """
        index, nominal = self._index, self._nominal if step is None else self._nominal_complex
        moved = {path for state in states for path in state}
        for path in moved:
            if path not in index:
                raise KeyError(path)
        if step is not None:
            moved |= {path for path, *_ in step}
        elif not moved and len(states) == 1:
            return self._designed
        count = len(states)
        dtype: Any = np.complex128 if step is not None else np.float64
        rotation = np.empty((count, len(index), 3, 3), dtype)
        translation = np.empty((count, len(index), 3), dtype)
        rotation[:], translation[:] = nominal
        scale = np.ones((count, len(index)), dtype)
        passed_on = np.ones((count, len(index)), dtype)
        for body, parent in zip(self.bodies, self._parents, strict=True):
            if parent in moved:
                moved.add(body.path)  # it is carried along
        carried = [body for body in self.bodies if body.path in moved]
        place = {body.path: k for k, body in enumerate(carried)}
        motion, offset, growth, stretch = _local_motions(carried, states, step, dtype)
        # bodies as far from the root are placed together
        for level in self._levels:
            bodies = [body for body in level if body.path in moved]
            if not bodies:
                continue
            i, k = ([table[body.path] for body in bodies] for table in (index, place))
            own = [np.array([getattr(body.pose, part) for body in bodies]) for part in ("rotation", "translation")]
            if bodies[0].parent:
                p = [index[body.parent] for body in bodies]
                base_rotation, base_translation = rotation[:, p], translation[:, p]
                inherited, distances = passed_on[:, p], scale[:, p]
            else:
                base_rotation = np.broadcast_to(np.eye(3, dtype=dtype), (count, len(bodies), 3, 3))
                base_translation = np.zeros((count, len(bodies), 3), dtype)
                inherited = distances = np.ones((count, len(bodies)), dtype)
            here = product(base_rotation, own[0])
            inner = np.where([body.scales for body in bodies], inherited, 1.0)
            rotation[:, i] = product(here, np.swapaxes(motion[k], 0, 1))
            translation[:, i] = (
                turned(base_rotation, distances[..., None] * own[1])
                + base_translation
                + turned(here, np.swapaxes(offset[k], 0, 1))
            )
            passed_on[:, i] = inner * growth[k].T
            scale[:, i] = inner * growth[k].T * stretch[k].T
        return PlacedBodies(index, rotation, translation, scale)

    @cached_property
    def _index(self) -> FrozenMap[str, int]:
        """Path -> number of a body."""
        return FrozenMap({path: i for i, path in enumerate(self.paths)})

    @cached_property
    def _parents(self) -> tuple[str, ...]:
        """Parent of each body."""
        return tuple(body.parent for body in self.bodies)

    @cached_property
    def _levels(self) -> tuple[tuple[Body, ...], ...]:
        """The bodies by their distance from the root."""
        far: dict[str, int] = {}
        for body in self.bodies:
            far[body.path] = far[body.parent] + 1 if body.parent else 0
        return tuple(
            tuple(b for b in self.bodies if far[b.path] == n) for n in range(max(far.values(), default=-1) + 1)
        )

    @cached_property
    def _designed(self) -> PlacedBodies:
        """One state that nothing moves; everybody's, so that nobody may write to it."""
        rotation, translation = (array[None].copy() for array in self._nominal)
        scale = np.ones(rotation.shape[:2])
        for array in (rotation, translation, scale):
            array.setflags(write=False)
        return PlacedBodies(self._index, rotation, translation, scale)

    @cached_property
    def _nominal(self) -> tuple[np.ndarray, np.ndarray]:
        """Rotations (bodies, 3, 3) and translations (bodies, 3) of bodies that nothing moves."""
        return self._at_rest(np.float64)

    @cached_property
    def _nominal_complex(self) -> tuple[np.ndarray, np.ndarray]:
        """Nominal poses as complex sums round them."""
        return self._at_rest(np.complex128)

    def _at_rest(self, dtype: Any) -> tuple[np.ndarray, np.ndarray]:
        rotation, translation = np.empty((len(self.bodies), 3, 3), dtype), np.empty((len(self.bodies), 3), dtype)
        for i, body in enumerate(self.bodies):
            rotation[i], translation[i] = body.pose.rotation, body.pose.translation
            if body.parent:
                p = self._index[body.parent]
                # one state, in the order in which many are summed
                rotation[i] = product(rotation[None, p], body.pose.rotation)[0]
                carried = np.einsum("sij,sj->si", rotation[None, p], body.pose.translation[None].astype(dtype))[0]
                translation[i] = carried + translation[p]
        return rotation, translation


FIGURE = "figure"
COMPLEX_STEP = 1e-40
"""Imaginary step of the complex-step derivative; products of two steps vanish in float64, so it is exact."""


def _local_motions(
    bodies: Sequence[Body], states: Sequence[State], step: Sequence[tuple[str, str, int]] | None, dtype: Any
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Rotation (B, S, 3, 3), translation (B, S, 3) in each body's frame, growth and stretch (B, S) of their motions."""
    size = len(bodies), len(states)
    rotate, shift = np.zeros((*size, 3), dtype), np.zeros((*size, 3), dtype)
    growth, stretch = np.ones(size, dtype), np.ones(size, dtype)
    pivot = np.zeros((*size, 3))
    for b, body in enumerate(bodies):
        named = {s: state[body.path] for s, state in enumerate(states) if body.path in state}
        if named:
            own = list(named)
            numbers = np.array([(*m.rotate, *m.shift, m.scale, m.stretch) for m in named.values()])
            rotate[b, own], shift[b, own] = numbers[:, :3], numbers[:, 3:6]
            growth[b, own], stretch[b, own] = 1.0 + numbers[:, 6], 1.0 + numbers[:, 7]
            for name in {motion.pivot for motion in named.values()}:
                if name not in body.pivots:
                    raise KeyError(f"{body.path}: pivot {name!r}")
                pivot[b, [s for s, motion in named.items() if motion.pivot == name]] = body.pivots[name]
        for s, (path, kind, axis) in enumerate(step or ()):
            if path != body.path:
                continue
            if kind == "rotate":
                rotate[b, s, axis] += 1j * COMPLEX_STEP
            elif kind == "shift":
                shift[b, s, axis] += 1j * COMPLEX_STEP
            elif kind == "scale":
                growth[b, s] += 1j * COMPLEX_STEP
            elif kind != FIGURE:  # a figure changes the surface, not the pose: see ``optics.raytrace.system``
                raise ValueError(f"unknown kind of motion {kind!r}")
    turned = rotation_matrix(rotate)
    offset = pivot + shift - (growth * stretch)[..., None] * np.einsum("bsij,bsj->bsi", turned, pivot)
    return turned, offset, growth, stretch


def compose(first: State, then: State, bodies: Mapping[str, Body]) -> State:
    """One state that does ``then`` on top of ``first``: x -> first(then(x)) in every body's frame.

    Exact for the rigid parts; figures, conic constants and indices add.

    Raises
    ------
    ValueError
        Both have a grid figure of the same body, on different samples.
    """
    return composed((first, then), bodies)


def composed(states: Sequence[State], bodies: Mapping[str, Body]) -> State:
    """One state that does several, each on top of the one before it, as ``compose`` has it of two."""
    return each_composed([states], bodies)[0]


def each_composed(several: Sequence[Sequence[State]], bodies: Mapping[str, Body]) -> list[State]:
    """The same of some sequences of states: one state for each, worked out together."""
    along: list[dict[str, list[Motion]]] = [{} for _ in several]
    for own, states in zip(along, several, strict=True):
        for state in states:
            for path, motion in state.items():
                own.setdefault(path, []).append(motion)
    out = [{path: motions[0] for path, motions in own.items()} for own in along]
    # the second motions of all bodies together, then the third ones
    for k in range(1, max((len(motions) for own in along for motions in own.values()), default=0)):
        places = [(s, path) for s, own in enumerate(along) for path, motions in own.items() if len(motions) > k]
        pairs = [(out[s][path], along[s][path][k]) for s, path in places]
        for (s, path), motion in zip(places, _both(pairs, [bodies[path] for _, path in places]), strict=True):
            out[s][path] = motion
    return [*out]


def _both(pairs: Sequence[tuple[Motion, Motion]], bodies: Sequence[Body]) -> list[Motion]:
    """First motions with second ones on top, about the origins of N bodies."""
    (turn_1, offset_1, growth), (turn_2, offset_2, _) = (_affine([pair[k] for pair in pairs], bodies) for k in range(2))
    turn, offset = product(turn_1, turn_2), turned(turn_1, growth[:, None] * offset_2) + offset_1
    rotate = _turned_both(pairs, turn)
    return [
        Motion(
            rotate=rotate[k],
            shift=triple(offset[k]),
            scale=(1.0 + before.scale) * (1.0 + motion.scale) - 1.0,
            figure={j: before.figure.get(j, 0.0) + motion.figure.get(j, 0.0) for j in {*before.figure, *motion.figure}},
            stretch=(1.0 + before.stretch) * (1.0 + motion.stretch) - 1.0,
            index=before.index + motion.index,
            index_gradient=triple([a + b for a, b in zip(before.index_gradient, motion.index_gradient, strict=True)]),
            grid=_sum(before.grid, motion.grid),
            radius=(1.0 + before.radius) * (1.0 + motion.radius) - 1.0,
            conic=before.conic + motion.conic,
            abbe=(1.0 + before.abbe) * (1.0 + motion.abbe) - 1.0,
        )
        for k, (before, motion) in enumerate(pairs)
    ]


def _turned_both(pairs: Sequence[tuple[Motion, Motion]], turn: np.ndarray) -> list[tuple[float, float, float]]:
    """Rotation vectors of two motions together, whose matrices are ``turn``, (N, 3, 3); most motions turn nothing."""
    out = [then.rotate if any(then.rotate) else first.rotate for first, then in pairs]
    both = [k for k, (first, then) in enumerate(pairs) if any(first.rotate) and any(then.rotate)]
    if both:
        # messages about files and help wait for this module, and scipy takes a quarter of a second
        from scipy.spatial.transform import Rotation

        for k, vector in zip(both, Rotation.from_matrix(turn[both]).as_rotvec(), strict=True):
            out[k] = triple(vector)
    return out


def _sum(first: GridFigure | None, then: GridFigure | None) -> GridFigure | None:
    if first is None or then is None:
        return then if first is None else first
    return first.plus(then)


def _affine(motions: Sequence[Motion], bodies: Sequence[Body]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rotation (N, 3, 3), offset (N, 3) and growth (N,) of x -> R growth x + offset, as ``RigidTree.place`` has it."""
    pivot = np.array([body.pivots[motion.pivot] for motion, body in zip(motions, bodies, strict=True)])
    rotate, shift = (np.array([getattr(motion, name) for motion in motions]) for name in ("rotate", "shift"))
    growth = np.array([(1.0 + motion.scale) * (1.0 + motion.stretch) for motion in motions])
    turn = rotation_matrix(rotate)
    return turn, pivot + shift - growth[:, None] * turned(turn, pivot), growth
