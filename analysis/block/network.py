"""What holds a block together: scenes that share points, and what the observations leave to the readings' priors.

Every law of a pass is taken for one constant here (`simplified`): three turns and three shifts of each pass and the
cameras' changes say by name what is open; that a slow course of the attitude is open, too, adds nothing to the name.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse
from scipy.linalg import eigh
from scipy.sparse.csgraph import connected_components

from analysis.arrays import Array
from analysis.block.assembly import assembled
from analysis.block.block import Block, Term
from analysis.block.block_adjustment import BlockAdjustment
from analysis.block.error_processes import Law
from analysis.block.point_reduction import State
from analysis.orbit.calibration_parameters import echelon, shown
from analysis.orbit.forward_intersection import level_axes

_SHOWN = 0.25
"""Of the largest part: smaller parts of a combination are not named."""
_TAKING = 6
"""Unknowns of one combination that are named."""
_NOTHING = 1e-3
"""Sigma of the prior over that of the observations, below which they tell nothing."""
_MOST = 12
"""Combinations that are named, the widest open first."""


@dataclass(frozen=True)
class Network:
    """How scenes hang together.

    Attributes
    ----------
    parts : tuple[tuple[str, ...], ...]
        Scenes that points connect, the largest part first; scenes with no observation are in none.
    controlled : tuple[bool, ...]
        Of each part, whether a control point, or footprint, is seen in it.
    alone : tuple[str, ...]
        Scenes that share no point with any other.
    empty : tuple[str, ...]
        Scenes without image points.
    """

    parts: tuple[tuple[str, ...], ...]
    controlled: tuple[bool, ...]
    alone: tuple[str, ...]
    empty: tuple[str, ...]


def network_of(block: Block) -> Network:
    """Parts of a block: scenes that see a point together are in one."""
    scenes = [s for s in block.scenes if len(s.rays.point)]
    count = len(block.points.ids)
    rows = np.concatenate([np.full(len(s.rays.point), k) for k, s in enumerate(scenes)])
    columns = np.concatenate([s.rays.point for s in scenes])
    sees = sparse.csr_matrix((np.ones(len(rows)), (rows, columns)), shape=(len(scenes), count))
    together = sees @ sees.T
    _, label = connected_components(together, directed=False)
    held = block.points.role == "control"
    for one in block.footprints:
        held = held.copy()
        held[one.point] = True
    order = sorted(set(label.tolist()), key=lambda k: -int(np.sum(label == k)))
    parts = tuple(tuple(s.name for s, k in zip(scenes, label.tolist(), strict=True) if k == part) for part in order)
    controlled = tuple(bool((sees[np.flatnonzero(label == part)] @ held).sum() > 0) for part in order)
    shared = np.asarray((together > 0).sum(axis=1)).ravel()
    alone = tuple(s.name for s, n in zip(scenes, shared.tolist(), strict=True) if n <= 1)
    empty = tuple(s.name for s in block.scenes if not len(s.rays.point))
    return Network(parts, controlled, alone, empty)


def simplified(block: Block) -> Block:
    """The block with one constant turn and one constant shift of each pass, of the size that all laws have together."""
    spans: dict[str, list[float]] = {}
    for scene in block.scenes:
        if scene.rays.time is not None and len(scene.rays.time):
            ends = [float(scene.rays.time.min()), float(scene.rays.time.max())]
            spans[scene.of] = [min(spans.get(scene.of, ends)[0], ends[0]), max(spans.get(scene.of, ends)[1], ends[1])]
    half = max((0.5 * (b - a) for a, b in spans.values()), default=0.0)

    def whole(terms: tuple[Term, ...]) -> tuple[Term, ...]:
        sigma = np.sqrt(np.sum([np.square(t.law.spread(half)) for t in terms], axis=0)) if terms else np.zeros(3)
        a, b, c = np.maximum(sigma, 1e-12).tolist()
        return (Term(Law("", "constant", (a, b, c))),)

    return replace(block, attitude=whole(block.attitude), station=whole(block.station), angles=())


@dataclass(frozen=True)
class Open:
    """A change that the observations tell less well than the priors.

    Attributes
    ----------
    names : tuple[str, ...]
        Unknowns that take part.
    change : tuple[float, ...]
        Of each, for one sigma of what the observations allow, at most that of the prior; metres and radians.
    told : float
        Sigma of the prior over that of the observations alone: 0 where they say nothing, below 1.
    """

    names: tuple[str, ...]
    change: tuple[float, ...]
    told: float

    def __str__(self) -> str:
        parts = [shown(name, change) for name, change in zip(self.names, self.change, strict=True)]
        return f"{', '.join(parts)} (told to {100.0 * self.told:.2g}% of the prior)"


def open_combinations(found: BlockAdjustment) -> tuple[Open, ...]:
    """What of the block's unknowns the observations leave to the priors, by name, the widest open first.

    What is told to less than a thousandth, and the rest, are a space each, and a combination has an unknown that is in
    no other one of its space (`echelon`): the eigenvectors of a space whose eigenvalues are alike are any.
    """
    plain = assembled(simplified(found.assembly.block))
    ground = np.where(np.isfinite(found.ground), found.ground, found.assembly.block.points.start)
    weight = tuple(np.ones(len(one.point)) for one in plain.reduction.sets)
    data = plain.reduction.eliminated(State(np.zeros(plain.reduction.size), ground, weight, {})).data.toarray()
    prior = plain.reduction.prior({}).toarray()
    # eigenvalues of the observations' information in units of the priors'
    values, vectors = eigh(data, prior)
    names, sizes = plain.names(), _sizes(plain.block, plain.names())
    spaces = np.split(vectors[:, values < 1.0], [int(np.sum(values < _NOTHING**2))], axis=1)
    combinations = []
    for vector in np.concatenate([echelon(one) for one in spaces], axis=1).T:
        vector = vector / np.sqrt(vector @ prior @ vector)
        taking = np.flatnonzero(np.abs(vector) >= _SHOWN * np.abs(vector).max())
        taking = taking[np.argsort(-np.abs(vector[taking]), kind="stable")][:_TAKING]
        change = vector * sizes * np.sign(vector[taking[0]])
        told = float(np.sqrt(max(float(vector @ data @ vector), 0.0)))
        combinations.append(Open(tuple(names[i] for i in taking.tolist()), tuple(change[taking].tolist()), told))
    return tuple(sorted(combinations, key=lambda one: one.told)[:_MOST])


def _sizes(block: Block, names: tuple[str, ...]) -> Array:
    """(P,) SI size of a unit of each unknown of a simplified block."""
    turn, shift = block.attitude[0].law.sigma, block.station[0].law.sigma
    sizes: dict[str, float] = {}
    for one in block.passes:
        for axis, size in zip(("roll", "pitch", "yaw"), turn, strict=True):
            sizes[f"{one.name} {axis}"] = size
        for axis, size in zip(("along", "across", "down"), shift, strict=True):
            sizes[f"{one.name} offset {axis}"] = size
        for camera, known in block.known.items():
            own = np.sqrt(np.diag(known.covariance)).reshape(-1, 4).max(axis=0)
            for axis, size in zip(("d_alpha", "d_beta", "d_gamma", "d_f"), own.tolist(), strict=True):
                sizes[f"{one.name} {camera} {axis}"] = size
    common = 1.0 if block.terrain is None else max(block.terrain.common, 1e-6)
    return np.array([sizes.get(name, common) for name in names])


@dataclass(frozen=True)
class DatumTest:
    """A shift that all control points have in common, as the readings and the other sensors see it.

    Attributes
    ----------
    east, north, up : float
        Of the given coordinates against the rest of the block, metres.
    sigma : tuple[float, float, float]
        Of each.
    chi_square : float
        Of the three, with three degrees of freedom where there is no such shift.
    """

    east: float
    north: float
    up: float
    sigma: tuple[float, float, float]
    chi_square: float


def datum_test(found: BlockAdjustment) -> DatumTest | None:
    """The shift of an adjustment that looked for one; None where it did not."""
    shift = found.datum()
    if shift is None:
        return None
    value, covariance = shift
    points = found.assembly.block.points
    middle = np.mean(points.start[points.role == "control"], axis=0)
    axes = level_axes(middle[None])[0]
    level, spread = axes @ value, axes @ covariance @ axes.T
    a, b, c = np.sqrt(np.diag(spread)).tolist()
    east, north, up = level.tolist()
    return DatumTest(east, north, up, (a, b, c), float(level @ np.linalg.solve(spread, level)))
