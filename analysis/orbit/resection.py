"""Space resection of a camera of two or more lines: attitude and angles from one moment's ground points together.

The photogrammetric method that paper 000 compares its planes with. Each point p has a place on its CCD line, hence a
known direction in the line's frame, (tx, ty, 1) up to length: X flight direction, Y along the line, Z toward the scene.
Line k hangs in the body at the look angle look_k, a rotation about the body's Y, positive forward; one line, the
reference, at zero. Its projection centre stands at c_k in the line's frame:

    (tx, ty, 1) ~ Ry(look_k)^T R^T (p - O) - c_k.

Unknown are the rotation R from the body to the ground's frame (three turns: roll, pitch, yaw about the body's X, Y, Z),
the look angles, and where the station is not exact its correction, held by its covariance. Gauss-Newton with analytic
partials; the point's covariance is carried into the image and added to the image's own. Unlike the planes, the
resection uses where along the line a point lies, and one attitude for all lines.

What it assumes: the interior orientation is still the laboratory's, and since then lines have turned against each
other in pitch only. One line in roll or yaw against the rest shows in the chi-square, not in an unknown. Two lines, one
angle, are enough: each alone tells roll, yaw and its own pitch.
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
# A look angle farther than this from the laboratory's, radians, is a mistake and not a change: 1 deg.
_GROSS = 0.0175
# Columns of unit length that combine to less than this part of the largest singular value are dependent. Partials in
# float64 hold 1e-15; three good strips and a station known only from them stay above 5e-3.
_RANK = 1e-9
# A step of less than this many sigmas ends the iteration; rounding of the misclosures is 1e-9 of a sigma.
_CONVERGED = 1e-6


class ResectionError(MeasurementError, ValueError):
    """The points do not determine the unknowns. null_vectors: (k, P) combinations that move no image point."""

    def __init__(self, message: str, null_vectors: Array | None = None) -> None:
        super().__init__(message)
        self.null_vectors = np.empty((0, 0)) if null_vectors is None else null_vectors


@dataclass(frozen=True, eq=False)
class ObservedLine:
    """Points of one strip with their places on the CCD line.

    tangent: (n, 2) tangents (tx across, ty along the line) of the points' directions in the line's frame; tx is what
    the line's distortion makes of it, 0 for a straight line. sigma: of both tangents, image measurement alone.
    look: the laboratory's look angle, radians; NaN where it is not known. It is no observation: results are only
    checked against it. offset: (n, 3) metres, projection centre of each point in the line's frame, from the station.
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
        """The line, checked.

        Raises ResectionError for bad input.

        Parameters
        ----------
        strip : Strip
            Ground points that the line sees, n of them.
        tangent : ArrayLike
            (n,) along the line, or (n, 2).
        sigma : float
            Of the tangents.
        look : float
            The laboratory's look angle, radians; NaN where it is not known.
        offset : ArrayLike
            (n, 3) or (3,).
        """
        given = np.array(tangent, np.float64)
        if given.ndim == 1:
            given = np.column_stack([np.zeros_like(given), given])
        if given.shape != (len(strip.points), 2) or not np.all(np.isfinite(given)):
            raise ResectionError(
                f"resection: {len(strip.points)} points need as many finite tangents, found {given.shape}"
            )
        if not (np.isfinite(sigma) and sigma >= 0):
            raise ResectionError(f"resection: sigma of the tangents must be finite and not negative, found {sigma}")
        place = np.asarray(offset, np.float64)
        if place.shape not in ((3,), (len(given), 3)) or not np.all(np.isfinite(place)):
            raise ResectionError(f"resection: offset must be (3,) or ({len(given)}, 3), finite, found {place.shape}")
        return cls(strip, given, float(sigma), float(look), np.broadcast_to(place, (len(given), 3)))


@dataclass(frozen=True, eq=False)
class Resection:
    """Solution of a space resection.

    attitude: (3, 3) body to the ground's frame. looks: line -> look angle against the reference line, radians, positive
        forward; 0 for the reference. station: (3,) adjusted, metres.
    names: of the unknowns that were solved for. covariance: in their order; rad^2, and m^2 for the station.
    residual: line -> (n, 2) predicted minus given tangents. chi_square, degrees_of_freedom: of all residuals and the
        station's correction. condition: of the weighted partials with unit columns. iterations: Gauss-Newton steps.
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
        """Chance of such a chi-square or a larger one; 1 without redundancy."""
        return statistics.p_value(self.chi_square, self.degrees_of_freedom)

    @property
    def sigma(self) -> dict[str, float]:
        """Standard deviation of each unknown, radians or metres."""
        return dict(zip(self.names, (float(s) for s in np.sqrt(np.diag(self.covariance))), strict=True))

    def angles(self, pairs: Sequence[tuple[str, str]]) -> Array:
        """(m,) look of the first line minus that of the second, radians. ResectionError for a missing line."""
        self._known(pairs)
        return np.array([self.looks[a] - self.looks[b] for a, b in pairs])

    def angle_covariance(self, pairs: Sequence[tuple[str, str]]) -> Array:
        """(m, m) of `angles`, rad^2. ResectionError for a missing line."""
        self._known(pairs)
        root = np.zeros((len(pairs), len(self.names)))
        for row, pair in zip(root, pairs, strict=True):
            for line, sign in zip(pair, (1.0, -1.0), strict=True):
                if (name := f"{line} look") in self.names:
                    row[self.names.index(name)] = sign
        return np.asarray(root @ self.covariance @ root.T)

    def axes(self, line: str) -> Array:
        """(3, 3) from the line's frame, at its look angle, to the ground's."""
        return np.asarray(self.attitude @ _pitched(self.looks[line]))

    def _known(self, pairs: Sequence[tuple[str, str]]) -> None:
        if missing := sorted({line for pair in pairs for line in pair} - set(self.looks)):
            raise ResectionError(f"resection: no {' and no '.join(missing)} line among {', '.join(self.looks)}")


def resect(
    station: Station, lines: Mapping[str, ObservedLine], *, reference: str | None = None, iterations: int = 20
) -> Resection:
    """Attitude, look angles and station from the points of one moment.

    station: its covariance must be zero (exact, not solved for) or positive definite.
    lines: by name. reference: the line whose look angle is zero; None for "nadir", or else the first.
    Raises ResectionError, naming the combination, when the points leave an unknown open; when a look angle comes out
        far from the laboratory's (lines exchanged, or tangents counted from the wrong end); and when it does not
        converge.
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
    free = bool(np.any(station.covariance))
    if free:
        if np.linalg.eigvalsh(station.covariance)[0] <= 0:
            raise ResectionError("resection: the station's covariance must be zero or positive definite")
        names += _STATION
    attitude, looks = _start(station, lines, zero)
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
        step = -statistics.gain(design) @ miss
        attitude = attitude @ Rotation.from_rotvec(step[:3]).as_matrix()
        for name in looks:
            if name != zero:
                looks[name] += float(step[names.index(f"{name} look")])
        if free:
            place = place + step[-3:]
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
    for name, line in lines.items():
        tilt = _pitched(looks[name])
        body = (line.strip.points - place) @ attitude
        arm = body @ tilt
        seen = arm - line.offset
        if np.any(seen[:, 2] <= 0):
            raise ResectionError(f"resection: points of the {name} line lie behind the camera")
        x, y, z = seen.T
        zero = np.zeros_like(z)
        image = np.stack([np.stack([1 / z, zero, -x / z**2], -1), np.stack([zero, 1 / z, -y / z**2], -1)], axis=1)
        # R exp(w) turns the direction by -w x body; a look angle turns it by -(Y x seen)
        turn = np.stack([np.cross(body, axis) for axis in np.eye(3)], axis=-1)
        pitch = np.stack([-arm[:, 2], zero, arm[:, 0]], axis=-1)
        to_line = tilt.T @ attitude.T
        columns = np.zeros((len(z), 2, len(names)))
        columns[:, :, :3] = image @ (tilt.T @ turn)
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
    """From the frame of a line at a look angle to the body."""
    return np.asarray(Rotation.from_rotvec([0.0, look, 0.0]).as_matrix())


def _start(station: Station, lines: Mapping[str, ObservedLine], zero: str) -> tuple[Array, dict[str, float]]:
    """Attitude from the reference line's directions (or another's), look angles from mean directions."""
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
        seen = outer @ attitude
        looks[name] = float(np.arctan2(seen[0], seen[2]) - np.arctan2(inner[0], inner[2]))
    start = looks[zero]
    return attitude @ _pitched(start), {name: 0.0 if name == zero else look - start for name, look in looks.items()}


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
