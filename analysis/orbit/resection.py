"""Space resection of a camera of two or more lines: attitude and angles from one moment's ground points together.

This is the photogrammetric method that paper 000 (Liu and Huang 2014) compares its planes with. Each point p has a
position on its CCD line, hence a known direction in the line's frame, (tx, ty, 1) up to length: X flight direction, Y
along the line, Z toward the scene. Line k is mounted in the body at the look angle look_k, a rotation about the body's
Y, positive forward; that of one line, the reference, is zero. Its projection centre is at c_k in the line's frame:

    (tx, ty, 1) ~ Ry(look_k)^T R^T (p - O) - c_k.

The unknowns are the rotation R from the body to the ground frame (three angles: roll, pitch, yaw about the body's X, Y,
Z), the look angles, and a correction of the station, constrained by its covariance, unless the station is error-free.
The solution is Gauss-Newton with analytic partials; each point's covariance is propagated to the image and added to
that of the image measurement. Unlike the planes, the resection uses the position of a point along the line, and one
attitude for all lines.

Assumptions: the interior orientation is still the laboratory's, and since then the lines have rotated against each
other in pitch only. A roll or yaw of one line against the rest shows in the chi-square, not in an unknown. Two lines
(one angle) suffice: each alone determines roll, yaw and its own pitch.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from analysis import statistics
from analysis.arrays import Array, MeasurementError
from analysis.orbit.planes import Station, Strip

_ATTITUDE = ("roll", "pitch", "yaw")
_STATION = ("station x", "station y", "station z")
_GROSS = 0.0175
"""Largest plausible change of a look angle from the laboratory's, in radians: 1 deg."""
_RANK = 1e-9
"""Smallest singular value, relative to the largest, of a Jacobian with columns of unit length that counts as having
full rank. Partials in float64 are accurate to 1e-15; with three strips of well-distributed points and an unknown
station the ratio stays above 5e-3.
"""
_CONVERGED = 1e-6
"""Largest step of a converged iteration, in sigmas; the rounding of the misclosures is 1e-9 sigma."""


class ResectionError(MeasurementError, ValueError):
    """Error raised for points that do not determine the unknowns of a resection.

    Attributes
    ----------
    null_vectors : (k, P) ndarray
        The k linear combinations of the P unknowns that can change without moving an image point.
    """

    def __init__(self, message: str, null_vectors: Array | None = None) -> None:
        super().__init__(message)
        self.null_vectors = np.empty((0, 0)) if null_vectors is None else null_vectors


@dataclass(frozen=True, eq=False)
class ObservedLine:
    """Points of one strip with their positions on the CCD line.

    Attributes
    ----------
    strip : Strip
        Ground points that the line sees, n of them.
    tangent : (n, 2) ndarray
        Tangents (tx across, ty along the line) of the points' directions in the line's frame; tx follows from the
        line's distortion, 0 for a straight line.
    sigma : float
        Standard deviation of both tangents, from the image measurement alone.
    look : float
        The laboratory's look angle, in radians; NaN if unknown. It is not an observation: results are only checked
        against it.
    offset : (n, 3) ndarray
        Projection centre of each point in the line's frame, from the station, in metres.
    """

    strip: Strip
    tangent: Array
    sigma: float
    look: float
    offset: Array

    @classmethod
    def of(
        cls,
        strip: Strip,
        tangent: ArrayLike,
        sigma: float = 0.0,
        *,
        look: float = float("nan"),
        offset: ArrayLike = (0.0, 0.0, 0.0),
    ) -> ObservedLine:
        """Return an observed line after checking shapes and values.

        Parameters
        ----------
        strip : Strip
            Ground points that the line sees, n of them.
        tangent : (n,) or (n, 2) array_like
            Tangents along the line, or across and along it.
        sigma : float
            Standard deviation of the tangents.
        look : float
            The laboratory's look angle, in radians; NaN if unknown.
        offset : (3,) or (n, 3) array_like
            Projection centre in the line's frame, from the station, in metres.

        Raises
        ------
        ResectionError
            A shape is wrong, a value is not finite, or sigma is negative.
        """
        tangents = np.array(tangent, np.float64)
        if tangents.ndim == 1:
            tangents = np.column_stack([np.zeros_like(tangents), tangents])
        if tangents.shape != (len(strip.points), 2) or not np.all(np.isfinite(tangents)):
            raise ResectionError(
                f"resection: {len(strip.points)} points need as many finite tangents, found {tangents.shape}"
            )
        if not (np.isfinite(sigma) and sigma >= 0):
            raise ResectionError(f"resection: sigma of the tangents must be finite and not negative, found {sigma}")
        centre = np.asarray(offset, np.float64)
        if centre.shape not in ((3,), (len(tangents), 3)) or not np.all(np.isfinite(centre)):
            raise ResectionError(
                f"resection: offset must be (3,) or ({len(tangents)}, 3), finite, found {centre.shape}"
            )
        return cls(strip, tangents, float(sigma), float(look), np.broadcast_to(centre, (len(tangents), 3)))


@dataclass(frozen=True, eq=False)
class Resection:
    """Attitude, look angles and station that a space resection estimated, with their covariance.

    Attributes
    ----------
    attitude : (3, 3) ndarray
        Rotation from the body to the ground frame.
    looks : mapping of str to float
        Look angle of each line against the reference line, in radians, positive forward; 0 for the reference.
    station : (3,) ndarray
        Adjusted station, in metres.
    names : tuple of str
        Names of the P estimated unknowns.
    covariance : (P, P) ndarray
        Covariance of the unknowns in their order, in rad^2, and m^2 for the station.
    residual : mapping of str to (n, 2) ndarray
        Predicted minus observed tangents of each line.
    chi_square : float
        Chi-square of all residuals and of the station's correction.
    degrees_of_freedom : int
        Degrees of freedom of the chi-square.
    condition : float
        Condition number of the weighted partials with unit columns.
    iterations : int
        Number of Gauss-Newton steps.
    """

    attitude: Array
    looks: Mapping[str, float]
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
        """p-value of the chi-square; 1 without redundancy."""
        return statistics.p_value(self.chi_square, self.degrees_of_freedom)

    @property
    def sigma(self) -> dict[str, float]:
        """Standard deviation of each unknown, radians or metres."""
        return dict(zip(self.names, (float(s) for s in np.sqrt(np.diag(self.covariance))), strict=True))

    def angles(self, pairs: Sequence[tuple[str, str]]) -> Array:
        """Return the look angles of the first minus the second line of each of m pairs, (m,), in radians.

        Raises
        ------
        ResectionError
            A line is missing.
        """
        self._known(pairs)
        return np.array([self.looks[a] - self.looks[b] for a, b in pairs])

    def angle_covariance(self, pairs: Sequence[tuple[str, str]]) -> Array:
        """Return the covariance of the differences of look angles of m pairs of lines (`angles`), (m, m), in rad^2.

        Raises
        ------
        ResectionError
            A line is missing.
        """
        self._known(pairs)
        root = np.zeros((len(pairs), len(self.names)))
        for row, pair in zip(root, pairs, strict=True):
            for line, sign in zip(pair, (1.0, -1.0), strict=True):
                if (name := f"{line} look") in self.names:
                    row[self.names.index(name)] = sign
        return np.asarray(root @ self.covariance @ root.T)

    def axes(self, line: str) -> Array:
        """Return the (3, 3) rotation from a line's frame, at its look angle, to the ground frame."""
        return np.asarray(self.attitude @ _pitched(self.looks[line]))

    def _known(self, pairs: Sequence[tuple[str, str]]) -> None:
        if missing := sorted({line for pair in pairs for line in pair} - set(self.looks)):
            raise ResectionError(f"resection: no {' and no '.join(missing)} line among {', '.join(self.looks)}")


def resect(
    station: Station, lines: Mapping[str, ObservedLine], *, reference: str | None = None, iterations: int = 20
) -> Resection:
    """Estimate attitude, look angles and station from the ground points of one moment.

    Parameters
    ----------
    station : Station
        Measured station; its covariance must be zero (error-free, not estimated) or positive definite.
    lines : mapping of str to ObservedLine
        Observed lines, by name.
    reference : str, optional
        Line whose look angle is zero; "nadir" if there is one, or else the first, by default.
    iterations : int
        Largest number of Gauss-Newton steps.

    Raises
    ------
    ResectionError
        The points leave a combination of unknowns undetermined, which the message lists; a look angle is far from the
        laboratory's (lines exchanged, or tangents counted from the wrong end); or the iteration does not converge.
    """
    if not lines:
        raise ResectionError("resection: no lines")
    zero = reference or ("nadir" if "nadir" in lines else next(iter(lines)))
    if zero not in lines:
        raise ResectionError(f"resection: the reference {zero!r} is none of the lines {', '.join(lines)}")
    for name, line in lines.items():
        if len(line.strip.points) < 1:
            raise ResectionError(f"resection: the {name} line has no points")
    names = [*_ATTITUDE, *(f"{name} look" for name in lines if name != zero)]
    station_estimated = bool(np.any(station.covariance))
    if station_estimated:
        if np.linalg.eigvalsh(station.covariance)[0] <= 0:
            raise ResectionError("resection: the station's covariance must be zero or positive definite")
        names += _STATION
    attitude, looks = _start(station, lines, zero)
    position = station.position.copy()
    prior = np.linalg.inv(np.linalg.cholesky(station.covariance)) if station_estimated else np.empty((0, 3))
    station_rows = np.zeros((len(prior), len(names)))
    if station_estimated:
        station_rows[:, -3:] = prior

    def system() -> tuple[Array, Array, dict[str, Array]]:
        """Return whitened partials and misclosures of points and station prior, and the residuals of each line."""
        design, miss, plain = _system(position, attitude, looks, lines, names)
        return np.vstack([design, station_rows]), np.concatenate([miss, prior @ (position - station.position)]), plain

    steps, size = 0, np.inf
    while not size < _CONVERGED:
        if steps == iterations:
            raise ResectionError(f"resection: no convergence in {steps} steps, the last of {size:.3g} sigmas")
        steps += 1
        design, miss, _ = system()
        length = np.linalg.norm(design, axis=0)
        null, text = statistics.null_combinations(design, names, _RANK, 1e-6)
        if len(null):
            raise ResectionError(
                f"resection: the points do not determine: {text}; these changes move no image point", null
            )
        step = -statistics.gain(design) @ miss
        attitude = attitude @ Rotation.from_rotvec(step[:3]).as_matrix()
        for name in looks:
            if name != zero:
                looks[name] += float(step[names.index(f"{name} look")])
        if station_estimated:
            position = position + step[-3:]
        size = float(np.max(np.abs(step * length)))
    for name, look in looks.items():
        expected = lines[name].look - lines[zero].look
        if abs(look - expected) > _GROSS:
            raise ResectionError(
                f"resection: {name} looks {np.degrees(look):.4g} deg ahead of {zero}, in the laboratory"
                f" {np.degrees(expected):.4g}; are lines exchanged, or are pixels counted from the other end?"
            )
    design, miss, residual = system()
    length = np.linalg.norm(design, axis=0)
    inverse = statistics.gain(design)
    return Resection(
        attitude=attitude,
        looks=looks,
        station=position,
        names=tuple(names),
        covariance=inverse @ inverse.T,
        residual=residual,
        chi_square=float(miss @ miss),
        degrees_of_freedom=len(miss) - len(names),
        condition=float(np.linalg.cond(design / length)),
        iterations=steps,
    )


def _system(
    station: Array, attitude: Array, looks: Mapping[str, float], lines: Mapping[str, ObservedLine], names: list[str]
) -> tuple[Array, Array, dict[str, Array]]:
    """Return the Jacobian and misclosures of the image points, both whitened, and the residuals of each line.

    The Jacobian is (M, P) for M equations and P unknowns. Residuals are tangents, not whitened.
    """
    rows, misses, plain = [], [], {}
    for name, line in lines.items():
        tilt = _pitched(looks[name])
        body = (line.strip.points - station) @ attitude
        arm = body @ tilt
        camera = arm - line.offset
        if np.any(camera[:, 2] <= 0):
            raise ResectionError(f"resection: points of the {name} line lie behind the camera")
        x, y, z = camera.T
        zero = np.zeros_like(z)
        image = np.stack([np.stack([1 / z, zero, -x / z**2], -1), np.stack([zero, 1 / z, -y / z**2], -1)], axis=1)
        # R exp(w) rotates the direction by -w x body; a look angle rotates it by -(Y x camera)
        rotation = np.stack([np.cross(body, axis) for axis in np.eye(3)], axis=-1)
        pitch = np.stack([-arm[:, 2], zero, arm[:, 0]], axis=-1)
        to_line = tilt.T @ attitude.T
        columns = np.zeros((len(z), 2, len(names)))
        columns[:, :, :3] = image @ (tilt.T @ rotation)
        if (unknown := f"{name} look") in names:
            columns[:, :, names.index(unknown)] = np.einsum("nij,nj->ni", image, pitch)
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


def _pitched(look: float) -> Array:
    """Return the rotation from the frame of a line at a look angle to the body."""
    return np.asarray(Rotation.from_rotvec([0.0, look, 0.0]).as_matrix())


def _start(station: Station, lines: Mapping[str, ObservedLine], zero: str) -> tuple[Array, dict[str, float]]:
    """Return start values: the attitude from the points of one line, and look angles from mean directions."""
    spread = {name: float(np.ptp(line.tangent[:, 1])) for name, line in lines.items()}
    base = zero if spread[zero] > 0 else max(spread, key=lambda name: spread[name])
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
    looks = {}
    for name in lines:
        inner, outer = (side.mean(axis=0) for side in directions(name))
        direction = outer @ attitude
        looks[name] = float(np.arctan2(direction[0], direction[2]) - np.arctan2(inner[0], inner[2]))
    start = looks[zero]
    return attitude @ _pitched(start), {name: 0.0 if name == zero else look - start for name, look in looks.items()}
