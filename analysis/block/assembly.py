"""From a block to packets and priors: the unknowns in order, and how every observation meets them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse
from scipy.spatial.transform import Rotation

from analysis.arrays import Array, Indices
from analysis.block.block import Block, CameraKnowledge, CamerasKnowledge, Term
from analysis.block.error_processes import BlockError, Corrections, Part, Support
from analysis.block.point_reduction import FixedPoints, Heights, LineImage, Packets, Pointings, PriorGroup, Reduction
from analysis.orbit.three_line_model import BIAS, DRIFT

OFFSET = ("along", "across", "down")
DATUM = 1000.0
"""Metres: sigma of a common shift of all control points where one is looked for."""
_FLOOR = 1e-10
"""Of the largest eigenvalue of a camera's covariance: what no law lets change changes by 1e-5 sigma."""


@dataclass(frozen=True, eq=False)
class Process:
    """The unknowns of one law in one scope.

    Attributes
    ----------
    name : str
        "PASS attitude walk" and so on.
    support : Support
        Of the law.
    column : int
        Of its first unknown.
    kind : str
        What it corrects.
    """

    name: str
    support: Support
    column: int
    kind: str

    @property
    def columns(self) -> Indices:
        """All of them."""
        return np.arange(self.column, self.column + self.support.size)


@dataclass(frozen=True, eq=False)
class Assembly:
    """A block in equations.

    Attributes
    ----------
    block : Block
        It is of.
    reduction : Reduction
        Its packets and priors.
    processes : Mapping[tuple[str, str], tuple[Process, ...]]
        Kind ("attitude", "station") and pass -> its laws.
    every : tuple[Process, ...]
        All processes, each once.
    changes : Mapping[str, Indices]
        Scene -> (4,) unknowns of its camera. units: scene -> (4,) their sizes, radians and metres.
    datum : Indices
        (0,) or (3,) unknowns of a common shift of the control points.
    axes : Mapping[str, Array]
        Pass -> (3, 3) mean body axes as columns, ITRS.
    images : Mapping[str, int]
        Set of each scene within the reduction.
    """

    block: Block
    reduction: Reduction
    processes: Mapping[tuple[str, str], tuple[Process, ...]]
    every: tuple[Process, ...]
    changes: Mapping[str, Indices]
    units: Mapping[str, Array]
    datum: Indices
    axes: Mapping[str, Array]
    images: Mapping[str, int]

    def names(self) -> tuple[str, ...]:
        """(P,) of the unknowns, where each law is a constant (`network.simplified`)."""
        found = [""] * self.reduction.size
        for one in self.every:
            axes = BIAS if one.kind == "attitude" else tuple(f"offset {n}" for n in OFFSET)
            for k, axis in enumerate(axes):
                found[one.column + k] = f"{one.name} {axis}"
        for scene in self.block.scenes:
            for column, name in zip(self.changes[scene.name].tolist(), DRIFT, strict=True):
                found[column] = f"{scene.of} {scene.camera} {name}"
        return tuple(name or "terrain height" for name in found)

    def corrections(self, of: str, times: Array) -> Corrections:
        """Of a pass at times (n,)."""
        parts = []
        for kind in ("attitude", "station"):
            for one in self.processes[kind, of]:
                parts.append(Part(kind == "attitude", one.column, one.support))
        return Corrections(tuple(parts), self.axes[of], times)


def assembled(block: Block, datum: bool = False) -> Assembly:
    """The equations of a block.

    Parameters
    ----------
    block : Block
        What is observed; its `check` has found nothing.
    datum : bool
        Whether a shift that all control points share is an unknown, known to `DATUM`.

    Raises
    ------
    BlockError
        a block that cannot be used.
    """
    times = _times(block)
    every: list[Process] = []
    by_pass: dict[tuple[str, str], tuple[Process, ...]] = {}
    priors: list[PriorGroup] = []
    size = 0
    scopes: dict[tuple[str, int, str], Process] = {}
    for kind, terms in (("attitude", block.attitude), ("station", block.station)):
        for k, term in enumerate(terms):
            for scope, members in _scopes(block, term, times).items():
                moments = np.concatenate([times[name] for name in members])
                middle = next(p.middle for p in block.passes if p.name == members[0]) if term.scope == "pass" else None
                support = Support.of(term.law, moments, middle)
                made = Process(f"{scope} {term.law.group}".strip(), support, size, kind)
                scopes[kind, k, scope] = made
                every.append(made)
                precision = sparse.csr_matrix(sparse.kron(support.precision, sparse.eye(3)))
                priors.append(PriorGroup(term.law.group, made.columns, precision, np.zeros(support.size)))
                size += support.size
        for one in block.passes:
            if one.name in times:
                by_pass[kind, one.name] = tuple(
                    scopes[kind, k, _scope_of(block, term, one.name)] for k, term in enumerate(terms)
                )
    changes, units, size = _cameras(block, priors, size)
    common = np.zeros(0, np.intp)
    if block.terrain is not None:
        common = np.array([size])
        priors.append(PriorGroup("terrain common", common, _unit(1), np.zeros(1)))
        size += 1
    shift = np.zeros(0, np.intp)
    if datum:
        shift = size + np.arange(3)
        precision = sparse.csr_matrix(sparse.eye(3) / DATUM**2)
        priors.append(PriorGroup("datum", shift, precision, np.zeros(3)))
        size += 3
    priors += _angles(block, scopes)
    axes = {one.name: _axes(block, one.name) for one in block.passes if one.name in times}
    bare = Assembly(
        block,
        Reduction((), priors, size, len(block.points.ids)),
        by_pass,
        tuple(every),
        changes,
        units,
        shift,
        axes,
        {},
    )
    sets, images = _sets(bare, common)
    whole = Reduction(tuple(sets), tuple(priors), size, len(block.points.ids))
    return replace(bare, reduction=whole, images=images)


def _times(block: Block) -> dict[str, Array]:
    """Pass -> times of all its observations; passes without any are left out."""
    found: dict[str, list[Array]] = {}
    for scene in block.scenes:
        if scene.rays.time is not None and len(scene.rays.time):
            found.setdefault(scene.of, []).append(scene.rays.time)
    for one in block.footprints:
        if len(one.time):
            found.setdefault(one.of, []).append(one.time)
    if not found:
        raise BlockError("block: no observations")
    return {name: np.concatenate(found[name]) for name in (p.name for p in block.passes) if name in found}


def _scope_of(block: Block, term: Term, name: str) -> str:
    if term.scope == "pass":
        return name
    return "" if term.scope == "block" else next(p.tracker for p in block.passes if p.name == name)


def _scopes(block: Block, term: Term, times: Mapping[str, Array]) -> dict[str, list[str]]:
    """Scope -> its passes."""
    found: dict[str, list[str]] = {}
    for name in times:
        found.setdefault(_scope_of(block, term, name), []).append(name)
    return found


def _axes(block: Block, name: str) -> Array:
    """(3, 3) the rotation nearest to the mean attitude of a pass."""
    attitudes = [s.rays.attitude for s in block.scenes if s.of == name and len(s.rays.point)]
    attitudes += [f.attitude for f in block.footprints if f.of == name]
    return np.asarray(Rotation.from_matrix(np.concatenate(attitudes)).mean().as_matrix())


def _unit(count: int) -> sparse.csr_matrix:
    return sparse.csr_matrix(sparse.eye(count))


def _cameras(block: Block, priors: list[PriorGroup], size: int) -> tuple[dict[str, Indices], dict[str, Array], int]:
    """Unknowns of the cameras' changes in all passes in which they took an image."""
    order = [one.name for one in block.passes]
    changes: dict[str, Indices] = {}
    units: dict[str, Array] = {}
    together = block.monitored if isinstance(block.monitored, CamerasKnowledge) else None
    joint: list[tuple[Indices, Indices, Array]] = []
    for camera in dict.fromkeys(s.camera for s in block.scenes):
        mine = [s for s in block.scenes if s.camera == camera]
        held = sorted({order.index(s.of) for s in mine})
        where = (4 * np.array(held)[:, None] + np.arange(4)).ravel()
        deviation = np.sqrt(np.maximum(np.diag(block.known[camera].covariance), 0.0)).reshape(-1, 4).max(axis=0)
        if not np.all(deviation > 0.0):
            wrong = DRIFT[int(np.argmin(deviation))]
            raise BlockError(f"block: camera {camera!r}: {wrong} needs a standard deviation above zero")
        unit = np.tile(deviation, len(held))
        columns = size + np.arange(len(where))
        if together is not None:
            joint.append((columns, 4 * len(order) * together.cameras.index(camera) + where, unit))
        else:
            knowledge: CameraKnowledge = _alone(block, camera)
            group = "camera" if block.monitored is None else "monitor"
            spread = knowledge.covariance[np.ix_(where, where)]
            priors.append(_known_group(group, columns, knowledge.mean[held].ravel(), spread, unit))
        for scene in mine:
            place = 4 * held.index(order.index(scene.of))
            changes[scene.name], units[scene.name] = columns[place : place + 4], deviation
        size += len(where)
    if together is not None:
        columns, where, unit = (np.concatenate(part) for part in zip(*joint, strict=True))
        spread = together.covariance[np.ix_(where, where)]
        priors.append(_known_group("monitor", columns, together.mean.ravel()[where], spread, unit))
    return changes, units, size


def _alone(block: Block, camera: str) -> CameraKnowledge:
    """What is known of a camera by itself."""
    assert not isinstance(block.monitored, CamerasKnowledge)
    return (block.monitored or block.known).get(camera, block.known[camera])


def _known_group(group: str, columns: Indices, mean: Array, spread: Array, unit: Array) -> PriorGroup:
    """Knowledge of unknowns with their covariance (k, k), in units (k,)."""
    values, vectors = np.linalg.eigh(spread / unit / unit[:, None])
    # what is exactly known still moves by a hundred thousandth of its size, for it has to have an inverse
    root = np.maximum(values, _FLOOR * max(float(values[-1]), 1.0))
    precision = (vectors / root) @ vectors.T
    return PriorGroup(group, columns, sparse.csr_matrix(0.5 * (precision + precision.T)), mean / unit)


def _angles(block: Block, scopes: Mapping[tuple[str, int, str], Process]) -> list[PriorGroup]:
    """Angles between star trackers as knowledge of the difference of their constants."""
    found = []
    constants = [k for k, term in enumerate(block.attitude) if term.scope == "tracker" and term.law.kind == "constant"]
    for angle in block.angles:
        if not constants:
            raise BlockError("block: an angle between star trackers needs a constant error of each of them")
        pair = [scopes.get(("attitude", constants[0], name)) for name in angle.between]
        if pair[0] is None or pair[1] is None:
            continue  # a tracker that gave no attitude of this block
        size = np.array(pair[0].support.law.sigma)
        use = np.flatnonzero(size > 0)
        columns = np.concatenate([pair[0].columns[use], pair[1].columns[use]])
        value, sigma = np.array(angle.value)[use], np.array(angle.sigma)[use]
        design = np.concatenate([np.diag(size[use] / sigma), -np.diag(size[use] / sigma)], axis=1)
        mean = np.concatenate([value / size[use], np.zeros(len(use))])
        found.append(PriorGroup("tracker angles", columns, sparse.csr_matrix(design.T @ design), mean))
    return found


def _sets(bare: Assembly, common: Indices) -> tuple[list[Packets], dict[str, int]]:
    block = bare.block
    sets: list[Packets] = []
    images: dict[str, int] = {}
    for scene in block.scenes:
        rays = scene.rays
        if not len(rays.point):
            continue
        assert rays.time is not None
        unit = np.broadcast_to(np.eye(2), (len(rays.point), 2, 2)) if rays.spread is None else rays.spread
        white = np.linalg.inv(np.linalg.cholesky(block.image**2 * unit))
        images[scene.name] = len(sets)
        corrections = bare.corrections(scene.of, rays.time)
        change, size = bare.changes[scene.name], bare.units[scene.name]
        sets.append(LineImage(scene.name, block.cameras[scene.camera], rays, white, corrections, change, size))
    for one in block.footprints:
        corrections = bare.corrections(one.of, one.time)
        sets.append(
            Pointings(
                f"{one.of} laser", one.point, one.station, one.attitude, one.aim, one.distance, corrections, one.sigma
            )
        )
    points = block.points
    control = np.flatnonzero(points.role == "control")
    if len(control):
        white = np.linalg.inv(np.linalg.cholesky(points.covariance[control]))
        sets.append(FixedPoints("control", control, points.start[control], white, bare.datum))
    if block.terrain is not None:
        t = block.terrain
        # a model whose heights have nothing in common still needs an unknown
        sets.append(Heights("terrain", t.point, t.place, t.normal, t.sigma, common, max(t.common, 1e-6)))
    return sets, images


def group_ranks(priors: Sequence[PriorGroup]) -> dict[str, int]:
    """Group -> how many observations its priors stand for."""
    found: dict[str, int] = {}
    for one in priors:
        rank = len(one.columns) // 2 if one.group == "tracker angles" else len(one.columns)
        found[one.group] = found.get(one.group, 0) + rank
    return found
