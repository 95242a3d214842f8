"""Rigid-body tree: bodies with poses relative to their parents, named pivots, and small motions of any of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from optics.geometry.pose import Pose, rotation_matrix, triple
from optics.geometry.surface import GridFigure
from optics.numerics.array_math import matvec, product
from optics.numerics.number_tree import FrozenMap

ORIGIN = "origin"


@dataclass(frozen=True)
class Body:
    """Node of the rigid-body tree.

    Attributes
    ----------
    path : str
        Full name, parts joined by ``/``; the parent is the path without its last part.
    pose : Pose
        Pose relative to the parent.
    pivots : mapping of str to tuple of float
        Named points in the body's own frame, metres; ``origin`` always exists.
    scales : bool
        True when a scale applied to an ancestor also scales the interior of this body. (A focal plane moves with the
        structure that carries it but its detectors keep their size.)
    """

    path: str
    pose: Pose = field(default_factory=Pose)
    pivots: Mapping[str, tuple[float, float, float]] = field(default_factory=FrozenMap)
    scales: bool = True

    def __post_init__(self) -> None:
        """Make the mapping of pivots immutable."""
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
        """Return the body with a new nominal pose: the present one changed by a rigid motion."""
        local_rotation, offset, _ = _affine([motion], [self])
        rotation, translation = self.pose.rotation, self.pose.translation
        return replace(self, pose=Pose(product(rotation, local_rotation[0]), translation + matvec(rotation, offset[0])))


@dataclass(frozen=True)
class Motion:
    """Small motion of one body about a pivot, in its own frame: first the rotation vector, then the shift.

    Attributes
    ----------
    rotate : tuple of float
        Rotation vector, radians.
    shift : tuple of float
        Translation, metres.
    pivot : str
        Name of one of the body's pivots.
    scale : float
        Relative expansion of the body and everything it carries about the pivot (isotropic), e.g. 20e-6.
    figure : mapping of int to float
        Surface error of a mirror or face, Noll index -> amplitude in metres of sag (see ``optics.geometry.surface``).
    expansion : float
        Relative expansion of the body itself about the pivot: its surface, and the distances to what it carries. Unlike
        ``scale`` it does not enlarge the bodies that it carries (each has a temperature of its own).
    index : float
        Change of the refractive index of a glass body.
    index_gradient : tuple of float
        Gradient of the index change in the body's frame, 1/m; the index change that it causes is zero at the body's
        origin.
    grid : GridFigure, optional
        Surface error of a mirror or face on a grid, in addition to ``figure``.
    radius : float
        Relative change of the vertex radius of curvature of a mirror or face, e.g. 100e-6.
    conic : float
        Change of the conic constant of a mirror or face.
    abbe : float
        Relative change of the Abbe number of a glass body. The index at the d line stays; the difference of the index
        at any other wavelength from it changes with the inverse of the Abbe number.
    """

    rotate: tuple[float, float, float] = (0.0, 0.0, 0.0)
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    pivot: str = ORIGIN
    scale: float = 0.0
    figure: Mapping[int, float] = field(default_factory=FrozenMap)
    expansion: float = 0.0
    index: float = 0.0
    index_gradient: tuple[float, float, float] = (0.0, 0.0, 0.0)
    grid: GridFigure | None = None
    radius: float = 0.0
    conic: float = 0.0
    abbe: float = 0.0

    def __post_init__(self) -> None:
        """Make the mapping of figure terms immutable."""
        object.__setattr__(self, "figure", FrozenMap(self.figure))

    @property
    def dispersion(self) -> float:
        """Relative change of a glass's dispersion, 1 / (1 + ``abbe``) - 1, due to the change of its Abbe number."""
        return 1.0 / (1.0 + self.abbe) - 1.0

    def plus(self, added: Motion) -> Motion:
        """Return the motion with another's rotation vector, shift and scale added to its own, about the other's pivot.

        To first order it is that of one motion after the other; `compose` is exact.
        """
        rotate, shift = (triple(np.add(*pair)) for pair in ((self.rotate, added.rotate), (self.shift, added.shift)))
        return replace(self, rotate=rotate, shift=shift, pivot=added.pivot, scale=self.scale + added.scale)

    def component(self, kind: str, axis: int) -> float:
        """Return one number of the motion, in SI units.

        Parameters
        ----------
        kind : str
            ``rotate``, ``shift``, ``scale``, ``radius``, ``conic``, ``index``, ``abbe`` or ``figure``.
        axis : int
            Axis 0, 1 or 2 of a rotation or shift, or Noll index of a figure term; ignored by the other kinds.

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
"""Motion of a body that a perturbed state does not list: no displacement and no other change."""

State = Mapping[str, Motion]
"""Perturbed state: body path -> motion; bodies not named stay at their nominal pose.

It may have the keys ``WAVEFRONT`` besides bodies.
"""

WAVEFRONT = ("wavefront", "wavefront along the line", "wavefront along the track")
"""Keys of a state whose ``figure`` holds Zernike terms of the wavefront that no body causes, metres.

They are the terms of the middle of the field and their changes to the edges of the field, along the line and along the
track. ``twin.camera.varied_beams`` adds them to the wavefronts of traced rays.
"""


@dataclass(frozen=True, eq=False)
class PlacedBodies:
    """World poses of all bodies in S states (complex when a complex-step derivative is taken).

    Attributes
    ----------
    index : mapping of str to int
        Body path -> index along the second axis.
    rotation : (S, bodies, 3, 3) ndarray
        Rotation matrices from each body's frame to the world.
    translation : (S, bodies, 3) ndarray
        World positions of the bodies' origins, metres.
    scale : (S, bodies) ndarray
        Size of each body itself relative to nominal.
    """

    index: Mapping[str, int]
    rotation: np.ndarray
    translation: np.ndarray
    scale: np.ndarray

    def pose(self, path: str, state: int = 0) -> Pose:
        """Return the world pose of one body in one state; if poses are complex (with a derivative), their real part."""
        i = self.index[path]
        return Pose(self.rotation[state, i].real, self.translation[state, i].real)

    def size(self, path: str) -> np.ndarray:
        """Return the size of one body relative to nominal in each of S states, (S,); if complex, the real part."""
        return np.asarray(self.scale[:, self.index[path]].real)


@dataclass(frozen=True)
class RigidTree:
    """Rigid bodies, ordered so that parents come before their children."""

    bodies: tuple[Body, ...]

    def __post_init__(self) -> None:
        """Check that names are unique and that parents come before their children."""
        seen: set[str] = set()
        for body in self.bodies:
            if body.path in seen:
                raise ValueError(f"body {body.path!r} appears twice")
            if body.parent and body.parent not in seen:
                raise ValueError(f"body {body.path!r} comes before its parent {body.parent!r}")
            seen.add(body.path)

    def __getitem__(self, path: str) -> Body:
        """Return the body at a path; raise KeyError when it is unknown."""
        for body in self.bodies:
            if body.path == path:
                return body
        raise KeyError(path)

    @property
    def paths(self) -> tuple[str, ...]:
        """All body paths, parents first."""
        return tuple(body.path for body in self.bodies)

    def with_nominal(self, state: State) -> RigidTree:
        """Return the tree whose nominal poses are the poses of a state of this tree.

        A state of the new tree comes on top of that state: ``compose(state, then, bodies)`` places the bodies of this
        tree where ``then`` places those of the new one.

        Parameters
        ----------
        state : mapping of str to Motion
            Body path -> rigid motion.

        Raises
        ------
        KeyError
            The state names an unknown body or pivot.
        ValueError
            The state expands a body.
        """
        for path, motion in state.items():
            if path not in self._index:
                raise KeyError(path)
            if motion.pivot not in self[path].pivots:
                raise KeyError(f"{path}: pivot {motion.pivot!r}")
            if motion.scale or motion.expansion:
                raise ValueError(f"{path}: a nominal state can only move bodies rigidly, not scale or expand them")
        return RigidTree(tuple(body.moved(state[body.path]) if body.path in state else body for body in self.bodies))

    def place(
        self, states: Sequence[State] = ({},), step: Sequence[tuple[str, str, int]] | None = None
    ) -> PlacedBodies:
        """Return the world poses of all bodies in each of several states.

        Parameters
        ----------
        states : sequence of State
            S perturbed states.
        step : sequence of (str, str, int), optional
            One (path, kind, axis) per state with kind ``rotate``, ``shift``, ``scale`` or ``figure`` (the axis is then
            the Noll index). Adds an imaginary step of ``COMPLEX_STEP`` to that component, so that imag/COMPLEX_STEP is
            the exact derivative.

        Raises
        ------
        KeyError
            A state names an unknown body or pivot.
        """
        index, nominal = self._index, self._nominal if step is None else self._nominal_complex
        moved = {path for state in states for path in state} - set(WAVEFRONT)
        for path in moved:
            if path not in index:
                raise KeyError(path)
        if step is not None:
            moved |= {path for path, *_ in step}
        elif not moved and len(states) == 1:
            return self._nominal_state
        count = len(states)
        dtype: Any = np.complex128 if step is not None else np.float64
        rotation = np.empty((count, len(index), 3, 3), dtype)
        translation = np.empty((count, len(index), 3), dtype)
        rotation[:], translation[:] = nominal
        scale = np.ones((count, len(index)), dtype)
        passed_on = np.ones((count, len(index)), dtype)
        for body, parent in zip(self.bodies, self._parents, strict=True):
            if parent in moved:
                moved.add(body.path)  # its carrier moves it
        carried = [body for body in self.bodies if body.path in moved]
        row = {body.path: k for k, body in enumerate(carried)}
        motion, offset, local_scale, expansion = _local_motions(carried, states, step, dtype)
        # all bodies of one depth are placed together
        for level in self._levels:
            bodies = [body for body in level if body.path in moved]
            if not bodies:
                continue
            i, k = ([table[body.path] for body in bodies] for table in (index, row))
            local = [np.array([getattr(body.pose, part) for body in bodies]) for part in ("rotation", "translation")]
            if bodies[0].parent:
                p = [index[body.parent] for body in bodies]
                base_rotation, base_translation = rotation[:, p], translation[:, p]
                inherited, distances = passed_on[:, p], scale[:, p]
            else:
                base_rotation = np.broadcast_to(np.eye(3, dtype=dtype), (count, len(bodies), 3, 3))
                base_translation = np.zeros((count, len(bodies), 3), dtype)
                inherited = distances = np.ones((count, len(bodies)), dtype)
            world = product(base_rotation, local[0])
            inherited_scale = np.where([body.scales for body in bodies], inherited, 1.0)
            rotation[:, i] = product(world, np.swapaxes(motion[k], 0, 1))
            translation[:, i] = (
                matvec(base_rotation, distances[..., None] * local[1])
                + base_translation
                + matvec(world, np.swapaxes(offset[k], 0, 1))
            )
            passed_on[:, i] = inherited_scale * local_scale[k].T
            scale[:, i] = inherited_scale * local_scale[k].T * expansion[k].T
        return PlacedBodies(index, rotation, translation, scale)

    @cached_property
    def _index(self) -> FrozenMap[str, int]:
        """Body path -> index of the body."""
        return FrozenMap({path: i for i, path in enumerate(self.paths)})

    @cached_property
    def _parents(self) -> tuple[str, ...]:
        """Path of each body's parent."""
        return tuple(body.parent for body in self.bodies)

    @cached_property
    def _levels(self) -> tuple[tuple[Body, ...], ...]:
        """Bodies grouped by their depth in the tree, from the roots on."""
        far: dict[str, int] = {}
        for body in self.bodies:
            far[body.path] = far[body.parent] + 1 if body.parent else 0
        return tuple(
            tuple(b for b in self.bodies if far[b.path] == n) for n in range(max(far.values(), default=-1) + 1)
        )

    @cached_property
    def _nominal_state(self) -> PlacedBodies:
        """World poses of all bodies in the nominal state; shared by all callers and therefore read-only."""
        rotation, translation = (array[None].copy() for array in self._nominal)
        scale = np.ones(rotation.shape[:2])
        for array in (rotation, translation, scale):
            array.setflags(write=False)
        return PlacedBodies(self._index, rotation, translation, scale)

    @cached_property
    def _nominal(self) -> tuple[np.ndarray, np.ndarray]:
        """Nominal world rotations (bodies, 3, 3) and translations (bodies, 3), metres."""
        return self._at_rest(np.float64)

    @cached_property
    def _nominal_complex(self) -> tuple[np.ndarray, np.ndarray]:
        """Nominal world poses computed in complex arithmetic, which rounds differently."""
        return self._at_rest(np.complex128)

    def _at_rest(self, dtype: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return nominal world rotations (bodies, 3, 3) and translations (bodies, 3), metres, as ``dtype``.

        ``dtype`` is the NumPy type float or complex; the poses are computed in its arithmetic.
        """
        rotation, translation = np.empty((len(self.bodies), 3, 3), dtype), np.empty((len(self.bodies), 3), dtype)
        for i, body in enumerate(self.bodies):
            rotation[i], translation[i] = body.pose.rotation, body.pose.translation
            if body.parent:
                p = self._index[body.parent]
                # summed in the same order as a batch of states
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
    """Return the rotation, translation, scale and expansion of motions in each body's frame.

    The shapes are (B, S, 3, 3), (B, S, 3), (B, S) and (B, S) for B bodies in S states; translations are in metres.
    """
    size = len(bodies), len(states)
    rotate, shift = np.zeros((*size, 3), dtype), np.zeros((*size, 3), dtype)
    scale, expansion = np.ones(size, dtype), np.ones(size, dtype)
    pivot = np.zeros((*size, 3))
    for b, body in enumerate(bodies):
        motions = {s: state[body.path] for s, state in enumerate(states) if body.path in state}
        if motions:
            columns = list(motions)
            numbers = np.array([(*m.rotate, *m.shift, m.scale, m.expansion) for m in motions.values()])
            rotate[b, columns], shift[b, columns] = numbers[:, :3], numbers[:, 3:6]
            scale[b, columns], expansion[b, columns] = 1.0 + numbers[:, 6], 1.0 + numbers[:, 7]
            for name in {motion.pivot for motion in motions.values()}:
                if name not in body.pivots:
                    raise KeyError(f"{body.path}: pivot {name!r}")
                pivot[b, [s for s, motion in motions.items() if motion.pivot == name]] = body.pivots[name]
        for s, (path, kind, axis) in enumerate(step or ()):
            if path != body.path:
                continue
            if kind == "rotate":
                rotate[b, s, axis] += 1j * COMPLEX_STEP
            elif kind == "shift":
                shift[b, s, axis] += 1j * COMPLEX_STEP
            elif kind == "scale":
                scale[b, s] += 1j * COMPLEX_STEP
            elif kind != FIGURE:  # a figure changes the surface, not the pose: see ``optics.raytrace.system``
                raise ValueError(f"unknown kind of motion {kind!r}")
    rotation = rotation_matrix(rotate)
    offset = pivot + shift - (scale * expansion)[..., None] * np.einsum("bsij,bsj->bsi", rotation, pivot)
    return rotation, offset, scale, expansion


def compose(first: State, then: State, bodies: Mapping[str, Body]) -> State:
    """Return the state that applies ``then`` on top of ``first``.

    A point x in a body's frame is moved by ``then`` first, and the result by ``first``, both in the body's frame: x
    goes to first(then(x)). The result is exact for rotations, shifts and scales; figures, changes of the conic constant
    and of the refractive index are added.

    Raises
    ------
    ValueError
        Both have a grid figure of the same body, on different samples.
    """
    return composed((first, then), bodies)


def composed(states: Sequence[State], bodies: Mapping[str, Body]) -> State:
    """Return one state that applies several states, each on top of the one before it in every body's frame."""
    return compose_each([states], bodies)[0]


def compose_each(sequences: Sequence[Sequence[State]], bodies: Mapping[str, Body]) -> list[State]:
    """Return, for each sequence of states, the one state that applies them all; the sequences are computed together."""
    chains: list[dict[str, list[Motion]]] = [{} for _ in sequences]
    for chain, states in zip(chains, sequences, strict=True):
        for state in states:
            for path, motion in state.items():
                chain.setdefault(path, []).append(motion)
    out = [{path: motions[0] for path, motions in chain.items()} for chain in chains]
    # first the second motions of all bodies together, then the third ones
    for k in range(1, max((len(motions) for chain in chains for motions in chain.values()), default=0)):
        keys = [(s, path) for s, chain in enumerate(chains) for path, motions in chain.items() if len(motions) > k]
        pairs = [(out[s][path], chains[s][path][k]) for s, path in keys]
        for (s, path), motion in zip(keys, _composed_pairs(pairs, [bodies[path] for _, path in keys]), strict=True):
            out[s][path] = motion
    return [*out]


def _composed_pairs(pairs: Sequence[tuple[Motion, Motion]], bodies: Sequence[Body]) -> list[Motion]:
    """Return, for each of N bodies, the one motion that is equal to a pair of motions (first, then).

    Its pivot is the body's origin; a point x moves to first(then(x)).
    """
    (rot_1, offset_1, scale), (rot_2, offset_2, _) = (_affine([pair[k] for pair in pairs], bodies) for k in range(2))
    rotation, offset = product(rot_1, rot_2), matvec(rot_1, scale[:, None] * offset_2) + offset_1
    rotate = _composed_rotations(pairs, rotation)
    return [
        Motion(
            rotate=rotate[k],
            shift=triple(offset[k]),
            scale=(1.0 + before.scale) * (1.0 + motion.scale) - 1.0,
            figure={j: before.figure.get(j, 0.0) + motion.figure.get(j, 0.0) for j in {*before.figure, *motion.figure}},
            expansion=(1.0 + before.expansion) * (1.0 + motion.expansion) - 1.0,
            index=before.index + motion.index,
            index_gradient=triple([a + b for a, b in zip(before.index_gradient, motion.index_gradient, strict=True)]),
            grid=_sum(before.grid, motion.grid),
            radius=(1.0 + before.radius) * (1.0 + motion.radius) - 1.0,
            conic=before.conic + motion.conic,
            abbe=(1.0 + before.abbe) * (1.0 + motion.abbe) - 1.0,
        )
        for k, (before, motion) in enumerate(pairs)
    ]


def _composed_rotations(
    pairs: Sequence[tuple[Motion, Motion]], rotations: np.ndarray
) -> list[tuple[float, float, float]]:
    """Return the rotation vectors of N composed rotations with matrices ``rotations`` (N, 3, 3).

    Where one motion of the pair does not rotate, the other's vector is returned unchanged.
    """
    out = [then.rotate if any(then.rotate) else first.rotate for first, then in pairs]
    indices = [k for k, (first, then) in enumerate(pairs) if any(first.rotate) and any(then.rotate)]
    if indices:
        # imported late: scipy takes 0.25 s, and commands that only check files import this module
        from scipy.spatial.transform import Rotation

        for k, vector in zip(indices, Rotation.from_matrix(rotations[indices]).as_rotvec(), strict=True):
            out[k] = triple(vector)
    return out


def _sum(first: GridFigure | None, then: GridFigure | None) -> GridFigure | None:
    """Return the sum of two grid figures, of which either may be None."""
    if first is None or then is None:
        return then if first is None else first
    return first.plus(then)


def _affine(motions: Sequence[Motion], bodies: Sequence[Body]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return each motion as the map of a point x of its body to R s x + offset, in metres, in the body's frame.

    Rotation R (N, 3, 3), offset (N, 3) and scale s (N,) are given for N bodies.
    """
    pivot = np.array([body.pivots[motion.pivot] for motion, body in zip(motions, bodies, strict=True)])
    rotate, shift = (np.array([getattr(motion, name) for motion in motions]) for name in ("rotate", "shift"))
    scale = np.array([(1.0 + motion.scale) * (1.0 + motion.expansion) for motion in motions])
    rotation = rotation_matrix(rotate)
    return rotation, pivot + shift - scale[:, None] * matvec(rotation, pivot), scale
