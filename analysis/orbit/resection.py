"""Space resection of a three-line camera: attitude and intersection angles from one moment's ground points together.

The photogrammetric method that paper 000 compares its planes with. Each point p has a place on its CCD line, hence a
known direction in the line's frame, (tx, ty, 1) up to length: X flight direction, Y along the line, Z toward the scene.
Line k hangs in the body at the look angle +alpha (forward), 0 (nadir) or -beta (aft), a rotation about the body's Y:

    (tx, ty, 1) ~ Ry(look_k)^T R^T (p - O).

Unknown are the rotation R from the body to the ground's frame (three turns: roll, pitch, yaw about the body's X, Y, Z),
alpha and beta, and where the station is not exact its correction, held by its covariance. Gauss-Newton with analytic
partials; the point's covariance is carried into the image and added to the image's own. Unlike the planes, the
resection uses where along the line a point lies, and one attitude for all lines.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from analysis.orbit.planes import Station, Strip

__all__ = ["LINES", "ObservedLine", "Resection", "ResectionError", "resect"]

Array = NDArray[np.float64]
LINES = ("forward", "nadir", "aft")
_NAMES = ("roll", "pitch", "yaw", "alpha", "beta")
_STATION = ("station x", "station y", "station z")
# Derivative of a line's look angle with respect to alpha and beta.
_LOOK = {"forward": (1.0, 0.0), "nadir": (0.0, 0.0), "aft": (0.0, -1.0)}
# Columns of unit length that combine to less than this part of the largest singular value are dependent. Partials in
# float64 hold 1e-15; three good strips and a station known only from them stay above 5e-3.
_RANK = 1e-9
# A step of less than this many sigmas ends the iteration; rounding of the misclosures is 1e-9 of a sigma.
_CONVERGED = 1e-6


class ResectionError(ValueError):
    """The points do not determine the unknowns. null_vectors: (k, P) combinations that move no image point."""

    def __init__(self, message: str, null_vectors: Array | None = None) -> None:
        super().__init__(message)
        self.null_vectors = np.empty((0, 0)) if null_vectors is None else null_vectors


@dataclass(frozen=True, eq=False)
class ObservedLine:
    """Points of one strip with their places on the CCD line.

    tangent: (n, 2) tangents (tx across, ty along the line) of the points' directions in the line's frame; tx is what
    the line's distortion makes of it, 0 for a straight line. sigma: of both tangents, image measurement alone.
    """

    strip: Strip
    tangent: Array
    sigma: float

    @classmethod
    def of(cls, strip: Strip, tangent: ArrayLike, sigma: float = 0.0) -> ObservedLine:
        """tangent: (n,) along the line, or (n, 2). Raises ResectionError for bad input."""
        given = np.array(tangent, np.float64)
        if given.ndim == 1:
            given = np.column_stack([np.zeros_like(given), given])
        if given.shape != (len(strip.points), 2) or not np.all(np.isfinite(given)):
            raise ResectionError(
                f"resection: {len(strip.points)} points need as many finite tangents, found {given.shape}"
            )
        if not (np.isfinite(sigma) and sigma >= 0):
            raise ResectionError(f"resection: sigma of the tangents must be finite and not negative, found {sigma}")
        return cls(strip, given, float(sigma))


@dataclass(frozen=True, eq=False)
class Resection:
    """Solution of a space resection.

    attitude: (3, 3) body to the ground's frame. alpha, beta: look angles of forward and aft against nadir, radians,
        positive; NaN where the line was not given. station: (3,) adjusted, metres.
    names: of the unknowns that were solved for. covariance: in their order; rad^2, and m^2 for the station.
    residual: line -> (n, 2) predicted minus given tangents. chi_square, degrees_of_freedom: of all residuals and the
        station's correction. condition: of the weighted partials with unit columns. iterations: Gauss-Newton steps.
    """

    attitude: Array
    alpha: float
    beta: float
    station: Array
    names: tuple[str, ...]
    covariance: Array
    residual: Mapping[str, Array]
    chi_square: float
    degrees_of_freedom: int
    condition: float
    iterations: int

    @property
    def p_value(self) -> float:
        """Chance of such a chi-square or a larger one; 1 without redundancy."""
        return float(chi2.sf(self.chi_square, self.degrees_of_freedom)) if self.degrees_of_freedom > 0 else 1.0

    @property
    def sigma(self) -> dict[str, float]:
        """Standard deviation of each unknown, radians or metres."""
        return dict(zip(self.names, (float(s) for s in np.sqrt(np.diag(self.covariance))), strict=True))

    @property
    def angle_covariance(self) -> Array:
        """(2, 2) of alpha and beta, rad^2. Raises ResectionError when one of them was not solved for."""
        if not {"alpha", "beta"} <= set(self.names):
            raise ResectionError("resection: alpha and beta were not both solved for")
        where = [self.names.index("alpha"), self.names.index("beta")]
        return np.asarray(self.covariance[np.ix_(where, where)])


def resect(station: Station, lines: Mapping[str, ObservedLine], *, iterations: int = 20) -> Resection:
    """Attitude, look angles and station from the points of one moment.

    station: its covariance must be zero (exact, not solved for) or positive definite.
    lines: by name, "nadir" and one or both of "forward" and "aft".
    Raises ResectionError, naming the combination, when the points leave an unknown open; when a look angle comes out
        on the wrong side (lines exchanged, or tangents counted from the wrong end); and when it does not converge.
    """
    unknown = set(lines) - set(LINES)
    if unknown or not lines:
        raise ResectionError(f"resection: lines must be named {', '.join(LINES)}, found {sorted(lines)}")
    for name, line in lines.items():
        if len(line.strip.points) < 1:
            raise ResectionError(f"resection: the {name} line has no points")
    names = [n for n in _NAMES if n not in ("alpha", "beta")]
    names += [n for n, line in (("alpha", "forward"), ("beta", "aft")) if line in lines]
    free = bool(np.any(station.covariance))
    if free:
        if np.linalg.eigvalsh(station.covariance)[0] <= 0:
            raise ResectionError("resection: the station's covariance must be zero or positive definite")
        names += _STATION
    attitude, looks = _start(station, lines)
    place = station.position.copy()
    prior = np.linalg.inv(np.linalg.cholesky(station.covariance)) if free else np.empty((0, 3))
    held = np.zeros((len(prior), len(names)))
    if free:
        held[:, -3:] = prior

    def system() -> tuple[Array, Array, dict[str, Array]]:
        """Partials and misclosures of the points and of the station's prior, and the plain residuals."""
        design, miss, plain = _system(place, attitude, looks, lines, names)
        return np.vstack([design, held]), np.concatenate([miss, prior @ (place - station.position)]), plain

    count, size = 0, np.inf
    while not size < _CONVERGED:
        if count == iterations:
            raise ResectionError(f"resection: no convergence in {count} steps, the last of {size:.3g} sigmas")
        count += 1
        design, miss, _ = system()
        length = np.linalg.norm(design, axis=0)
        _check_rank(design, length, names)
        step = -np.linalg.lstsq(design / length, miss, rcond=None)[0] / length
        attitude = attitude @ Rotation.from_rotvec(step[:3]).as_matrix()
        for k, name in enumerate(names):
            if name in looks:
                looks[name] += float(step[k])
        if free:
            place = place + step[-3:]
        size = float(np.max(np.abs(step * length)))
    for name in looks:
        if name in names and looks[name] <= 0:
            raise ResectionError(
                f"resection: {name} came out as {np.degrees(looks[name]):.4g} deg; are lines exchanged, or are pixels"
                " counted from the other end?"
            )
    design, miss, residual = system()
    length = np.linalg.norm(design, axis=0)
    inverse = np.linalg.pinv(design / length) / length[:, None]
    return Resection(
        attitude=attitude,
        alpha=looks["alpha"] if "forward" in lines else float("nan"),
        beta=looks["beta"] if "aft" in lines else float("nan"),
        station=place,
        names=tuple(names),
        covariance=inverse @ inverse.T,
        residual=residual,
        chi_square=float(miss @ miss),
        degrees_of_freedom=len(miss) - len(names),
        condition=float(np.linalg.cond(design / length)),
        iterations=count,
    )


def _system(
    place: Array, attitude: Array, looks: Mapping[str, float], lines: Mapping[str, ObservedLine], names: list[str]
) -> tuple[Array, Array, dict[str, Array]]:
    """Whitened partials (M, P), whitened misclosures (M,), and the plain residuals of each line."""
    rows, misses, plain = [], [], {}
    for name in (n for n in LINES if n in lines):
        line = lines[name]
        signs = _LOOK[name]
        tilt = Rotation.from_rotvec([0.0, signs[0] * looks["alpha"] + signs[1] * looks["beta"], 0.0]).as_matrix()
        body = (line.strip.points - place) @ attitude
        seen = body @ tilt
        if np.any(seen[:, 2] <= 0):
            raise ResectionError(f"resection: points of the {name} line lie behind the camera")
        x, y, z = seen.T
        zero = np.zeros_like(z)
        image = np.stack([np.stack([1 / z, zero, -x / z**2], -1), np.stack([zero, 1 / z, -y / z**2], -1)], axis=1)
        # R exp(w) turns the direction by -w x body; a look angle turns it by -(Y x seen)
        turn = np.stack([np.cross(body, axis) for axis in np.eye(3)], axis=-1)
        pitch = np.stack([-z, zero, x], axis=-1)
        to_line = tilt.T @ attitude.T
        columns = np.empty((len(z), 2, len(names)))
        columns[:, :, :3] = image @ (tilt.T @ turn)
        for k, n in enumerate(names):
            if n == "alpha":
                columns[:, :, k] = signs[0] * np.einsum("nij,nj->ni", image, pitch)
            elif n == "beta":
                columns[:, :, k] = signs[1] * np.einsum("nij,nj->ni", image, pitch)
        if names[-1] == _STATION[-1]:
            columns[:, :, -3:] = -image @ to_line
        miss = np.stack([x / z, y / z], axis=-1) - line.tangent
        to_image = image @ to_line
        spread = to_image @ line.strip.covariance @ np.swapaxes(to_image, 1, 2) + line.sigma**2 * np.eye(2)
        root = np.linalg.inv(np.linalg.cholesky(spread))
        rows.append((root @ columns).reshape(-1, len(names)))
        misses.append(np.einsum("nij,nj->ni", root, miss).ravel())
        plain[name] = miss
    return np.vstack(rows), np.concatenate(misses), plain


def _start(station: Station, lines: Mapping[str, ObservedLine]) -> tuple[Array, dict[str, float]]:
    """Attitude from the nadir line's directions (or another's), look angles from the mean directions of the others."""
    spread = {name: float(np.ptp(line.tangent[:, 1])) for name, line in lines.items()}
    base = "nadir" if spread.get("nadir", 0.0) > 0 else max(spread, key=lambda name: spread[name])
    if spread[base] <= 0:
        raise ResectionError("resection: no line has two points at different places along it; yaw has no start value")

    def directions(name: str) -> tuple[Array, Array]:
        line = lines[name]
        inside = np.column_stack([line.tangent, np.ones(len(line.tangent))])
        arm = line.strip.points - station.position
        return inside / np.linalg.norm(inside, axis=1)[:, None], arm / np.linalg.norm(arm, axis=1)[:, None]

    inside, outside = directions(base)
    u, _, vt = np.linalg.svd(outside.T @ inside)
    attitude = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    looks = {"alpha": 0.0, "beta": 0.0}
    for name, key, sign in (("forward", "alpha", 1.0), ("aft", "beta", -1.0)):
        if name in lines and name != base:
            middle = directions(name)[1].mean(axis=0) @ attitude
            looks[key] = float(sign * np.arctan2(middle[0], middle[2]))
    return attitude, looks


def _check_rank(design: Array, length: Array, names: list[str]) -> None:
    """ResectionError that names what the points cannot tell."""
    scaled = design / np.where(length > 0, length, 1.0)
    # rows of zeros, so that all P right vectors come out of fewer observations than unknowns, too
    padded = np.vstack([scaled, np.zeros((max(len(names) - len(scaled), 0), len(names)))])
    _, values, vt = np.linalg.svd(padded, full_matrices=False)
    null = vt[values <= _RANK * max(float(values[0]), 1e-300)]
    if not len(null):
        return
    vectors = null / np.where(length > 0, length, 1.0)
    vectors = vectors / np.abs(vectors).max(axis=1, keepdims=True)
    text = "; ".join(
        " ".join(f"{v:+.3g} x {n}" for v, n in zip(row, names, strict=True) if abs(v) > 1e-6) for row in vectors
    )
    raise ResectionError(f"resection: the points cannot tell: {text}; these changes move no image point", vectors)
