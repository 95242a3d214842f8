"""Assembly of a block into observations and priors, with the order and columns of the unknowns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse
from scipy.spatial.transform import Rotation

from analysis.arrays import Array, Indices
from analysis.block.block import Block, CameraPrior, JointCameraPrior, ModelScene, Term
from analysis.block.error_processes import BlockError, Corrections, Part, Support
from analysis.block.point_reduction import (
    FixedPoints,
    Heights,
    LineImage,
    ModelImage,
    Packets,
    Pointings,
    PriorGroup,
    Reduction,
)
from analysis.orbit.three_line_model import BIAS, DRIFT

OFFSET = ("along", "across", "down")
"""Names of the axes of an orbit error: along track, across track and down, the mean body axes of a pass."""
DATUM = 1000.0
"""A-priori standard deviation of the common shift of all control points, in metres, if that shift is an unknown."""
_FLOOR = 1e-10
"""Lower bound of the eigenvalues of a camera's prior covariance, relative to the largest, which keeps it invertible:
unknowns that the prior fixes may still change by 1e-5 sigma.
"""


@dataclass(frozen=True, eq=False)
class Process:
    """Unknowns of one error model of attitude or station in one scope (a pass, a star tracker or the block).

    Attributes
    ----------
    name : str
        Name such as "PASS attitude walk".
    support : Support
        Unknowns of the error model, with their prior precision.
    column : int
        Index of the first unknown among all unknowns of the adjustment.
    kind : str
        Quantity that the error model corrects, "attitude" or "station".
    """

    name: str
    support: Support
    column: int
    kind: str

    @property
    def columns(self) -> Indices:
        """Indices of the process's unknowns among all unknowns of the adjustment."""
        return np.arange(self.column, self.column + self.support.size)


@dataclass(frozen=True, eq=False)
class Assembly:
    """Observations, priors and order of the unknowns of a block that is to be adjusted.

    Attributes
    ----------
    block : Block
        Block that is adjusted.
    reduction : Reduction
        Observation equations and priors of the block.
    processes : mapping of (str, str) to tuple of Process
        Processes of each kind ("attitude", "station") and pass.
    all_processes : tuple of Process
        All processes, each once.
    changes : mapping of str to ndarray of int
        For the camera of each scene, indices (4,) of the unknowns d_alpha, d_beta, d_gamma (rotations about its Y, X
        and Z axes) and d_f (change of the principal distance); for a scene that is a function of the ground, indices
        (2 K,) of the K coefficients of its correction of the line, then of the sample.
    units : mapping of str to ndarray
        Scale of each of these unknowns: the change, in radians, metres or pixels, for a value of 1.
    datum : (0,) or (3,) ndarray of int
        Indices of the unknown common shift of the control points; empty if none is estimated.
    axes : mapping of str to (3, 3) ndarray
        Mean body axes of each pass as columns, ITRS.
    images : mapping of str to int
        Position of each scene's image observations in the reduction's list of observation sets.
    """

    block: Block
    reduction: Reduction
    processes: Mapping[tuple[str, str], tuple[Process, ...]]
    all_processes: tuple[Process, ...]
    changes: Mapping[str, Indices]
    units: Mapping[str, Array]
    datum: Indices
    axes: Mapping[str, Array]
    images: Mapping[str, int]

    def names(self) -> tuple[str, ...]:
        """Return the names of all P unknowns of a block whose error models are all constants.

        `network.simplified` returns such a block.
        """
        names = [""] * self.reduction.size
        for process in self.all_processes:
            axes = BIAS if process.kind == "attitude" else tuple(f"offset {n}" for n in OFFSET)
            for k, axis in enumerate(axes):
                names[process.column + k] = f"{process.name} {axis}"
        for scene in self.block.line_scenes:
            for column, name in zip(self.changes[scene.name].tolist(), DRIFT, strict=True):
                names[column] = f"{scene.of} {scene.camera} {name}"
        for image in self.block.model_scenes:
            for column, name in zip(self.changes[image.name].tolist(), correction_names(image), strict=True):
                names[column] = f"{image.name} {name}"
        return tuple(name or "terrain height" for name in names)

    def corrections(self, of: str, times: Array) -> Corrections:
        """Return the attitude and station corrections of a pass at n times, as linear functions of the unknowns.

        `of` is the name of the pass, `times` are in seconds. The station is the position of the satellite.
        """
        parts = []
        for kind in ("attitude", "station"):
            for process in self.processes[kind, of]:
                parts.append(Part(kind == "attitude", process.column, process.support))
        return Corrections(tuple(parts), self.axes[of], times)


def assembled(block: Block, datum: bool = False) -> Assembly:
    """Assemble the equations of a block.

    Parameters
    ----------
    block : Block
        Block that has passed its `check`.
    datum : bool
        True to estimate a shift that all control points share, with the a-priori sigma `DATUM`.

    Raises
    ------
    BlockError
        The block cannot be adjusted.
    """
    times = _times(block)
    all_processes: list[Process] = []
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
                process = Process(f"{scope} {term.law.group}".strip(), support, size, kind)
                scopes[kind, k, scope] = process
                all_processes.append(process)
                precision = sparse.csr_matrix(sparse.kron(support.precision, sparse.eye(3)))
                priors.append(PriorGroup(term.law.group, process.columns, precision, np.zeros(support.size)))
                size += support.size
        for block_pass in block.passes:
            if block_pass.name in times:
                by_pass[kind, block_pass.name] = tuple(
                    scopes[kind, k, _scope_of(block, term, block_pass.name)] for k, term in enumerate(terms)
                )
    changes, units, size = _cameras(block, priors, size)
    coefficients: dict[str, list[Indices]] = {}
    for image in block.model_scenes:
        columns = size + np.arange(2 * len(image.sigma)).reshape(2, -1)
        for k, name in enumerate(image.sigma):
            coefficients.setdefault(name, []).append(columns[:, k])
        changes[image.name], units[image.name] = columns.ravel(), np.array(list(image.sigma.values())).T.ravel()
        size += columns.size
    for name, parts in coefficients.items():
        columns = np.concatenate(parts)
        precision = _with_shared(block, name, columns, changes)
        priors.append(PriorGroup(name, columns, precision, np.zeros(len(columns))))
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
    axes = {block_pass.name: _axes(block, block_pass.name) for block_pass in block.passes if block_pass.name in times}
    without_sets = Assembly(
        block,
        Reduction((), priors, size, len(block.points.ids)),
        by_pass,
        tuple(all_processes),
        changes,
        units,
        shift,
        axes,
        {},
    )
    sets, images = _sets(without_sets, common)
    reduction = Reduction(tuple(sets), tuple(priors), size, len(block.points.ids))
    return replace(without_sets, reduction=reduction, images=images)


def _times(block: Block) -> dict[str, Array]:
    """Return the times of all observations of each pass; passes without observations are omitted."""
    times: dict[str, list[Array]] = {}
    for scene in block.line_scenes:
        if scene.rays.time is not None and len(scene.rays.time):
            times.setdefault(scene.of, []).append(scene.rays.time)
    for footprints in block.footprints:
        if len(footprints.time):
            times.setdefault(footprints.of, []).append(footprints.time)
    if not times and not any(len(image.rays.point) for image in block.model_scenes):
        raise BlockError("block: no observations")
    return {name: np.concatenate(times[name]) for name in (p.name for p in block.passes) if name in times}


def _scope_of(block: Block, term: Term, name: str) -> str:
    """Return the name of the scope of an error model for a pass: the pass, its star tracker, or the block."""
    if term.scope == "pass":
        return name
    return "" if term.scope == "block" else next(p.tracker for p in block.passes if p.name == name)


def _scopes(block: Block, term: Term, times: Mapping[str, Array]) -> dict[str, list[str]]:
    """Return the passes that share each realisation (scope) of an error model, by the name of the scope."""
    scopes: dict[str, list[str]] = {}
    for name in times:
        scopes.setdefault(_scope_of(block, term, name), []).append(name)
    return scopes


def _axes(block: Block, name: str) -> Array:
    """Return the mean body axes of a pass as columns, ITRS: the (3, 3) rotation nearest to its mean attitude."""
    attitudes = [s.rays.attitude for s in block.line_scenes if s.of == name and len(s.rays.point)]
    attitudes += [f.attitude for f in block.footprints if f.of == name]
    return np.asarray(Rotation.from_matrix(np.concatenate(attitudes)).mean().as_matrix())


def _unit(count: int) -> sparse.csr_matrix:
    """Return a sparse identity matrix of the given size."""
    return sparse.csr_matrix(sparse.eye(count))


def _cameras(block: Block, priors: list[PriorGroup], size: int) -> tuple[dict[str, Indices], dict[str, Array], int]:
    """Add the priors of the camera changes to a list and return the indices and units of these unknowns.

    Only passes that have an image by the camera count. The third result is the number of all unknowns so far.
    """
    order = [block_pass.name for block_pass in block.passes]
    changes: dict[str, Indices] = {}
    units: dict[str, Array] = {}
    joint_prior = block.monitored if isinstance(block.monitored, JointCameraPrior) else None
    joint_parts: list[tuple[Indices, Indices, Array]] = []
    for camera in dict.fromkeys(s.camera for s in block.line_scenes):
        camera_scenes = [s for s in block.line_scenes if s.camera == camera]
        pass_numbers = sorted({order.index(s.of) for s in camera_scenes})
        rows = (4 * np.array(pass_numbers)[:, None] + np.arange(4)).ravel()
        deviation = np.sqrt(np.maximum(np.diag(block.known[camera].covariance), 0.0)).reshape(-1, 4).max(axis=0)
        if not np.all(deviation > 0.0):
            component = DRIFT[int(np.argmin(deviation))]
            raise BlockError(f"block: camera {camera!r}: {component} needs a standard deviation above zero")
        unit = np.tile(deviation, len(pass_numbers))
        columns = size + np.arange(len(rows))
        if joint_prior is not None:
            joint_parts.append((columns, 4 * len(order) * joint_prior.cameras.index(camera) + rows, unit))
        else:
            prior: CameraPrior = _alone(block, camera)
            group = "camera" if block.monitored is None else "monitor"
            spread = prior.covariance[np.ix_(rows, rows)]
            priors.append(_known_group(group, columns, prior.mean[pass_numbers].ravel(), spread, unit))
        for scene in camera_scenes:
            start = 4 * pass_numbers.index(order.index(scene.of))
            changes[scene.name], units[scene.name] = columns[start : start + 4], deviation
        size += len(rows)
    if joint_prior is not None:
        columns, rows, unit = (np.concatenate(part) for part in zip(*joint_parts, strict=True))
        spread = joint_prior.covariance[np.ix_(rows, rows)]
        priors.append(_known_group("monitor", columns, joint_prior.mean.ravel()[rows], spread, unit))
    return changes, units, size


def _alone(block: Block, camera: str) -> CameraPrior:
    """Return the prior of one camera's changes; a joint prior of several cameras is marginalised."""
    assert not isinstance(block.monitored, JointCameraPrior)
    return (block.monitored or block.known).get(camera, block.known[camera])


def _known_group(group: str, columns: Indices, mean: Array, spread: Array, unit: Array) -> PriorGroup:
    """Return the prior of k unknowns from their mean and covariance (k, k), converted to the unknowns' units (k,)."""
    values, vectors = np.linalg.eigh(spread / unit / unit[:, None])
    # fixed combinations keep a small variance, so that the covariance has an inverse
    root = np.maximum(values, _FLOOR * max(float(values[-1]), 1.0))
    precision = (vectors / root) @ vectors.T
    return PriorGroup(group, columns, sparse.csr_matrix(0.5 * (precision + precision.T)), mean / unit)


def _angles(block: Block, scopes: Mapping[tuple[str, int, str], Process]) -> list[PriorGroup]:
    """Return the angles between star trackers as priors on differences of their constant errors."""
    groups = []
    constants = [k for k, term in enumerate(block.attitude) if term.scope == "tracker" and term.law.kind == "constant"]
    for angle in block.angles:
        if not constants:
            raise BlockError("block: an angle between star trackers needs a constant error of each of them")
        pair = [scopes.get(("attitude", constants[0], name)) for name in angle.between]
        if pair[0] is None or pair[1] is None:
            continue  # the tracker measured no attitude in this block
        size = np.array(pair[0].support.law.sigma)
        axes = np.flatnonzero(size > 0)
        columns = np.concatenate([pair[0].columns[axes], pair[1].columns[axes]])
        value, sigma = np.array(angle.value)[axes], np.array(angle.sigma)[axes]
        design = np.concatenate([np.diag(size[axes] / sigma), -np.diag(size[axes] / sigma)], axis=1)
        mean = np.concatenate([value / size[axes], np.zeros(len(axes))])
        groups.append(PriorGroup("tracker angles", columns, sparse.csr_matrix(design.T @ design), mean))
    return groups


def _sets(assembly: Assembly, common: Indices) -> tuple[list[Packets], dict[str, int]]:
    """Return the sets of observation equations of a block, and the index of each scene's set among them."""
    block = assembly.block
    sets: list[Packets] = []
    images: dict[str, int] = {}
    for image in block.model_scenes:
        if len(image.rays.point):
            white = np.linalg.inv(np.linalg.cholesky(block.image**2 * image.rays.spread))
            images[image.name] = len(sets)
            sets.append(ModelImage(image, white, assembly.changes[image.name], assembly.units[image.name]))
    for scene in block.line_scenes:
        rays = scene.rays
        if not len(rays.point):
            continue
        assert rays.time is not None
        unit = np.broadcast_to(np.eye(2), (len(rays.point), 2, 2)) if rays.spread is None else rays.spread
        white = np.linalg.inv(np.linalg.cholesky(block.image**2 * unit))
        images[scene.name] = len(sets)
        corrections = assembly.corrections(scene.of, rays.time)
        change, size = assembly.changes[scene.name], assembly.units[scene.name]
        sets.append(LineImage(scene.name, block.cameras[scene.camera], rays, white, corrections, change, size))
    for footprints in block.footprints:
        corrections = assembly.corrections(footprints.of, footprints.time)
        sets.append(
            Pointings(
                f"{footprints.of} laser",
                footprints.point,
                footprints.station,
                footprints.attitude,
                footprints.aim,
                footprints.distance,
                corrections,
                footprints.sigma,
            )
        )
    points = block.points
    control = np.flatnonzero(points.role == "control")
    if len(control):
        white = np.linalg.inv(np.linalg.cholesky(points.covariance[control]))
        sets.append(FixedPoints("control", control, points.start[control], white, assembly.datum))
    if block.terrain is not None:
        terrain = block.terrain
        # the unknown is needed even without a common height error
        sets.append(
            Heights(
                "terrain",
                terrain.point,
                terrain.place,
                terrain.normal,
                terrain.sigma,
                common,
                max(terrain.common, 1e-6),
            )
        )
    return sets, images


def _with_shared(block: Block, term: str, columns: Indices, changes: Mapping[str, Indices]) -> sparse.csr_matrix:
    """Return the precision of the coefficients of a term of all images' corrections, in their own sigmas.

    Images that share an error of standard deviation c beside their own ones u have the covariance I + v v' with v = c /
    u, whose inverse is I - v v' / (1 + v' v).
    """
    scenes = {image.name: image for image in block.model_scenes}
    place = {int(column): k for k, column in enumerate(columns.tolist())}
    parts: list[tuple[Indices, Indices, Array]] = [(np.arange(len(columns)),) * 2 + (np.ones(len(columns)),)]
    for shared in block.shared:
        for axis, common in enumerate(shared.sigma.get(term, ())):
            members = [scenes[name] for name in shared.scenes]
            ratio = np.array([common / image.sigma[term][axis] for image in members])
            where = np.array(
                [place[int(changes[i.name].reshape(2, -1)[axis, list(i.sigma).index(term)])] for i in members]
            )
            inner = -np.outer(ratio, ratio) / (1.0 + ratio @ ratio)
            parts.append((np.repeat(where, len(where)), np.tile(where, len(where)), inner.ravel()))
    row, column, value = (np.concatenate(part) for part in zip(*parts, strict=True))
    return sparse.csr_matrix((value, (row, column)), shape=(len(columns), len(columns)))


def correction_names(image: ModelScene) -> tuple[str, ...]:
    """Return the names of the 2 K coefficients of an image's correction, in the order of the unknowns."""
    return tuple(f"{term} of {axis}" for axis in ("line", "sample") for term in image.sigma)


def group_ranks(priors: Sequence[PriorGroup]) -> dict[str, int]:
    """Return the number of pseudo-observations of the priors of each variance group."""
    ranks: dict[str, int] = {}
    for prior in priors:
        rank = len(prior.columns) // 2 if prior.group == "tracker angles" else len(prior.columns)
        ranks[prior.group] = ranks.get(prior.group, 0) + rank
    return ranks
