"""Connectivity of a block: scenes that share points, and combinations of unknowns that are not determined.

Every error model of a pass is replaced by one constant here (`simplified`): three rotations and three shifts of each
pass and the cameras' changes suffice to describe what the observations leave undetermined. If a constant is
undetermined, a slow variation of it is so, too, and listing it would tell the user nothing new.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse
from scipy.linalg import eigh
from scipy.sparse.csgraph import connected_components

from analysis.arrays import Array
from analysis.block.assembly import assembled
from analysis.block.block import Block, ModelScene, Term
from analysis.block.block_adjustment import BlockAdjustment
from analysis.block.error_processes import Law
from analysis.block.point_reduction import State
from analysis.orbit.calibration_parameters import echelon, shown
from analysis.orbit.forward_intersection import level_axes

_SHOWN = 0.25
"""Smallest coefficient at which an unknown is listed in a linear combination, relative to the largest coefficient."""
_MOST_UNKNOWNS = 6
"""Largest number of unknowns that are listed for one linear combination."""
_NOTHING = 1e-3
"""Ratio of a combination's prior sigma to its sigma from the observations below which the latter determine nothing."""
_MOST = 12
"""Largest number of weakly determined linear combinations of unknowns that are listed, the least determined first."""


@dataclass(frozen=True)
class Network:
    """Groups of scenes of a block that are connected by common points.

    Attributes
    ----------
    parts : tuple of tuple of str
        Scenes that points connect, the largest part first; scenes without observations belong to none.
    controlled : tuple of bool
        For each part, True if it sees a control point or a laser footprint.
    alone : tuple of str
        Scenes that share no point with another.
    empty : tuple of str
        Scenes without image points.
    """

    parts: tuple[tuple[str, ...], ...]
    controlled: tuple[bool, ...]
    alone: tuple[str, ...]
    empty: tuple[str, ...]


def network_of(block: Block) -> Network:
    """Return the connected parts of a block: scenes that see the same point belong together."""
    scenes = [s for s in block.scenes if len(s.rays.point)]
    count = len(block.points.ids)
    rows = np.concatenate([np.full(len(s.rays.point), k) for k, s in enumerate(scenes)])
    columns = np.concatenate([s.rays.point for s in scenes])
    sees = sparse.csr_matrix((np.ones(len(rows)), (rows, columns)), shape=(len(scenes), count))
    together = sees @ sees.T
    _, label = connected_components(together, directed=False)
    control = block.points.role == "control"
    for footprints in block.footprints:
        control = control.copy()
        control[footprints.point] = True
    order = sorted(set(label.tolist()), key=lambda k: -int(np.sum(label == k)))
    parts = tuple(tuple(s.name for s, k in zip(scenes, label.tolist(), strict=True) if k == part) for part in order)
    controlled = tuple(bool((sees[np.flatnonzero(label == part)] @ control).sum() > 0) for part in order)
    shared = np.asarray((together > 0).sum(axis=1)).ravel()
    alone = tuple(s.name for s, n in zip(scenes, shared.tolist(), strict=True) if n <= 1)
    empty = tuple(s.name for s in block.scenes if not len(s.rays.point))
    return Network(parts, controlled, alone, empty)


def simplified(block: Block) -> Block:
    """Return the block with its error models replaced by one constant rotation and one constant shift of each pass.

    Their variances are the sums of those of all error models at the ends of the longest pass. The correction of an
    image that is a function of the ground becomes a shift, with the sum of the variances of its terms.
    """
    spans: dict[str, list[float]] = {}
    for scene in block.line_scenes:
        if scene.rays.time is not None and len(scene.rays.time):
            ends = [float(scene.rays.time.min()), float(scene.rays.time.max())]
            spans[scene.of] = [min(spans.get(scene.of, ends)[0], ends[0]), max(spans.get(scene.of, ends)[1], ends[1])]
    half = max((0.5 * (b - a) for a, b in spans.values()), default=0.0)

    def whole(terms: tuple[Term, ...]) -> tuple[Term, ...]:
        sigma = np.sqrt(np.sum([np.square(t.law.spread(half)) for t in terms], axis=0)) if terms else np.zeros(3)
        a, b, c = np.maximum(sigma, 1e-12).tolist()
        return (Term(Law("", "constant", (a, b, c))),)

    def shift(sigma: Mapping[str, tuple[float, float]]) -> dict[str, tuple[float, float]]:
        line, sample = np.sqrt(np.sum(np.square(list(sigma.values())), axis=0)).tolist()
        return {"shift": (line, sample)}

    scenes = tuple(
        replace(scene, sigma=shift(scene.sigma)) if isinstance(scene, ModelScene) else scene for scene in block.scenes
    )
    shared = tuple(replace(errors, sigma=shift(errors.sigma)) for errors in block.shared)
    attitude, station = whole(block.attitude), whole(block.station)
    return replace(block, scenes=scenes, attitude=attitude, station=station, angles=(), shared=shared)


@dataclass(frozen=True)
class OpenCombination:
    """Linear combination of unknowns that the observations determine less well than the priors.

    Attributes
    ----------
    names : tuple of str
        Unknowns that take part.
    change : tuple of float
        Change of each unknown in `names` for a change of the combination by one standard deviation (the smaller of
        those from the observations and from the prior), in metres and radians.
    sigma_ratio : float
        Ratio of the prior's sigma to that of the observations alone: 0 if they determine nothing, always below 1.
    """

    names: tuple[str, ...]
    change: tuple[float, ...]
    sigma_ratio: float

    def __str__(self) -> str:
        parts = [shown(name, change) for name, change in zip(self.names, self.change, strict=True)]
        return f"{', '.join(parts)} (prior sigma is {100.0 * self.sigma_ratio:.2g} % of that of the observations)"


def open_combinations(adjustment: BlockAdjustment) -> tuple[OpenCombination, ...]:
    """Return the linear combinations of a block's unknowns that only the priors determine, the weakest first.

    Combinations that the observations do not determine (to less than a thousandth of the prior's weight) and those that
    they determine weakly are two separate spaces. In each space, a combination has an unknown that is in no other one
    (`echelon`), because the eigenvectors of similar eigenvalues are arbitrary.
    """
    plain = assembled(simplified(adjustment.assembly.block))
    ground = np.where(np.isfinite(adjustment.ground), adjustment.ground, adjustment.assembly.block.points.start)
    weight = tuple(np.ones(len(space.point)) for space in plain.reduction.sets)
    data = plain.reduction.eliminated(State(np.zeros(plain.reduction.size), ground, weight, {})).data.toarray()
    prior = plain.reduction.prior({}).toarray()
    # eigenvalues of the observations' normal matrix relative to that of the priors
    values, vectors = eigh(data, prior)
    names, sizes = plain.names(), _sizes(plain.block, plain.names())
    spaces = np.split(vectors[:, values < 1.0], [int(np.sum(values < _NOTHING**2))], axis=1)
    combinations = []
    for vector in np.concatenate([echelon(space) for space in spaces], axis=1).T:
        vector = vector / np.sqrt(vector @ prior @ vector)
        members = np.flatnonzero(np.abs(vector) >= _SHOWN * np.abs(vector).max())
        members = members[np.argsort(-np.abs(vector[members]), kind="stable")][:_MOST_UNKNOWNS]
        change = vector * sizes * np.sign(vector[members[0]])
        sigma_ratio = float(np.sqrt(max(float(vector @ data @ vector), 0.0)))
        combinations.append(
            OpenCombination(tuple(names[i] for i in members.tolist()), tuple(change[members].tolist()), sigma_ratio)
        )
    return tuple(sorted(combinations, key=lambda combination: combination.sigma_ratio)[:_MOST])


def _sizes(block: Block, names: tuple[str, ...]) -> Array:
    """Return the unit in which each of the P unknowns of a simplified block is expressed, in radians or metres."""
    rotation, shift = block.attitude[0].law.sigma, block.station[0].law.sigma
    sizes: dict[str, float] = {}
    for block_pass in block.passes:
        for axis, size in zip(("roll", "pitch", "yaw"), rotation, strict=True):
            sizes[f"{block_pass.name} {axis}"] = size
        for axis, size in zip(("along", "across", "down"), shift, strict=True):
            sizes[f"{block_pass.name} offset {axis}"] = size
        for camera, prior in block.known.items():
            camera_sigma = np.sqrt(np.diag(prior.covariance)).reshape(-1, 4).max(axis=0)
            for axis, size in zip(("d_alpha", "d_beta", "d_gamma", "d_f"), camera_sigma.tolist(), strict=True):
                sizes[f"{block_pass.name} {camera} {axis}"] = size
    for image in block.model_scenes:
        for axis, size in zip(("line", "sample"), image.sigma["shift"], strict=True):
            sizes[f"{image.name} shift of {axis}"] = size
    common = 1.0 if block.terrain is None else max(block.terrain.common, 1e-6)
    return np.array([sizes.get(name, common) for name in names])


@dataclass(frozen=True)
class DatumTest:
    """Common shift of all control points relative to the orbit, attitude and other measurements, with its test.

    Attributes
    ----------
    east, north, up : float
        Shift of the surveyed coordinates against the rest of the block, in metres.
    sigma : (3,) tuple of float
        Standard deviations of the shift, in metres.
    chi_square : float
        Chi-square of the shift, with three degrees of freedom under the hypothesis of no shift.
    """

    east: float
    north: float
    up: float
    sigma: tuple[float, float, float]
    chi_square: float


def datum_test(adjustment: BlockAdjustment) -> DatumTest | None:
    """Return the common shift of the control points with its test, or None if the adjustment did not estimate it."""
    shift = adjustment.datum()
    if shift is None:
        return None
    value, covariance = shift
    points = adjustment.assembly.block.points
    middle = np.mean(points.start[points.role == "control"], axis=0)
    axes = level_axes(middle[None])[0]
    level, spread = axes @ value, axes @ covariance @ axes.T
    a, b, c = np.sqrt(np.diag(spread)).tolist()
    east, north, up = level.tolist()
    return DatumTest(east, north, up, (a, b, c), float(level @ np.linalg.solve(spread, level)))
