"""Observations of ground points in packets: rows that one measurement of one point gives, and what they depend on.

A packet of d rows observes one point p and w of the unknowns x. Sets of packets of one kind are linearised together,
whitened by their a-priori covariance: miss + by_x dx + by_point dp. The core (`point_reduction`) knows no cameras.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from analysis.orbit.three_line_model import LineModel, Rays, misclosure, partials

__all__ = ["Corrections", "FixedPoints", "Heights", "LineImage", "Packets", "Part", "Pointings"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
_NOTHING = np.zeros(3)


class Packets(Protocol):
    """A set of packets."""

    @property
    def name(self) -> str:
        """Of the set, for messages: the scene."""

    @property
    def group(self) -> str:
        """Variance group."""

    @property
    def rows(self) -> int:
        """d, of each packet."""

    @property
    def point(self) -> Indices:
        """(n,) ground point that each packet observes."""

    @property
    def columns(self) -> Indices:
        """(n, w) unknowns that each packet meets."""

    def linearised(self, which: Indices, x: Array, ground: Array) -> tuple[Array, Array, Array]:
        """Misclosures (k, d), their derivatives by the columns (k, d, w) and by the points (k, d, 3), whitened.

        Args:
            which: packets, (k,).
            x: all unknowns, (P,).
            ground: points of these packets, (k, 3), ITRS, metres.
        """


@dataclass(frozen=True, eq=False)
class Part:
    """One law's share of a correction at the times of n observations.

    Attributes:
        turns: whether it turns the body, radians; else it shifts the station along the axes of the pass, metres.
        first: of its unknowns, three axes of each number.
        sigma: (3,) of the axes.
        number: (n, w) of the law's numbers that each time meets. blend: (n, w) how much of each.
    """

    turns: bool
    first: int
    sigma: Array
    number: NDArray[np.int32]
    blend: Array

    def value(self, which: Indices, x: Array) -> Array:
        """(k, 3) at observations (k,)."""
        number, blend = self.number[which], self.blend[which]
        own = x[self.first + 3 * number[:, :, None] + np.arange(3)]
        return np.asarray(self.sigma * np.einsum("nw,nwa->na", blend, own))


@dataclass(frozen=True, eq=False)
class Corrections:
    """Corrections of attitude and station at the times of n observations, linear in the unknowns.

    Attributes:
        parts: of the laws; those that turn come first.
        axes: (3, 3) axes of the pass (along, across, down) as columns, ITRS.
        count: n.
    """

    parts: tuple[Part, ...]
    axes: Array
    count: int

    @property
    def columns(self) -> Indices:
        """(n, w) unknowns of all parts."""
        every = [np.zeros((self.count, 0), np.intp)]
        for one in self.parts:
            columns = one.first + 3 * one.number[:, :, None].astype(np.intp) + np.arange(3)
            every.append(columns.reshape(self.count, -1))
        return np.concatenate(every, axis=1)

    def factors(self, turns: bool) -> tuple[Indices, Array]:
        """Unknowns (n, w, 3) of the turns or of the shifts, and their coefficients (n, w, 3), SI."""
        columns, factors = [np.zeros((self.count, 0, 3), np.intp)], [np.zeros((self.count, 0, 3))]
        for one in self.parts:
            if one.turns == turns:
                columns.append(one.first + 3 * one.number[:, :, None].astype(np.intp) + np.arange(3))
                factors.append(one.blend[:, :, None] * one.sigma)
        return np.concatenate(columns, axis=1), np.concatenate(factors, axis=1)

    def at(self, which: Indices, x: Array) -> tuple[Array, Array]:
        """Turns (k, 3), radians, and shifts (k, 3) along the axes of the pass, metres."""
        found = [np.zeros((len(which), 3)), np.zeros((len(which), 3))]
        for one in self.parts:
            found[0 if one.turns else 1] += one.value(which, x)
        return found[0], found[1]

    def slopes(self, which: Indices, by_turn: Array, by_station: Array) -> Array:
        """(k, d, 3 a + 3 s) derivatives of d rows by the unknowns.

        Args:
            which: observations, (k,).
            by_turn: derivatives by the rotation vector, (k, d, 3), 1/rad.
            by_station: by the station, ITRS, (k, d, 3), 1/m.
        """
        count, depth = by_turn.shape[:2]
        along = by_station @ self.axes
        parts = [np.zeros((count, depth, 0))]
        for one in self.parts:
            by = (by_turn if one.turns else along) * one.sigma
            parts.append((by[:, :, None, :] * one.blend[which][:, None, :, None]).reshape(count, depth, -1))
        return np.concatenate(parts, axis=2)

    def applied(self, which: Indices, x: Array, station: Array, attitude: Array) -> tuple[Array, Array, Array]:
        """Corrected station (k, 3) and attitude (k, 3, 3), and the Jacobian (k, 3, 3) of the turn: a change of the
        rotation vector as a small turn about the corrected body's axes.

        Args:
            which: observations, (k,).
            x: all unknowns, (P,).
            station: readings, ITRS, (k, 3), metres.
            attitude: readings, body to ITRS, (k, 3, 3).
        """
        turn, shift = self.at(which, x)
        matrix, jacobian = _rotation(turn)
        return station + shift @ self.axes.T, attitude @ matrix, jacobian


def _rotation(turn: Array) -> tuple[Array, Array]:
    """Rotation matrices (k, 3, 3) of rotation vectors (k, 3), and their right Jacobians.

    Series to the third order: turns are below a degree, so that 1e-9 of them is left out at most.
    """
    x, y, z = turn.T
    zero = np.zeros_like(x)
    skew = np.stack([np.stack([zero, -z, y], -1), np.stack([z, zero, -x], -1), np.stack([-y, x, zero], -1)], axis=1)
    square = skew @ skew
    angle = np.sum(turn**2, axis=1)[:, None, None]
    eye = np.eye(3)
    return (
        eye + (1.0 - angle / 6.0) * skew + (0.5 - angle / 24.0) * square,
        eye - (0.5 - angle / 24.0) * skew + square / 6.0,
    )


@dataclass(frozen=True, eq=False)
class LineImage:
    """Image points of one line camera in one pass.

    Attributes:
        name: of the scene.
        camera: as it is known, before its changes in this pass.
        rays: image points with readings of station and attitude.
        white: (n, 2, 2) whitens their misclosures.
        corrections: of the readings.
        change: (4,) unknowns of the camera's d_alpha, d_beta, d_gamma, d_f.
        unit: (4,) size of each, radians and metres.
        group: variance group.
    """

    name: str
    camera: LineModel
    rays: Rays
    white: Array
    corrections: Corrections
    change: Indices
    unit: Array
    group: str = "image"
    rows: int = 2

    @property
    def point(self) -> Indices:
        """(n,)."""
        return self.rays.point

    @property
    def columns(self) -> Indices:
        """(n, w)."""
        own = np.broadcast_to(self.change, (len(self.rays.point), len(self.change)))
        return np.concatenate([self.corrections.columns, own], axis=1)

    def linearised(self, which: Indices, x: Array, ground: Array) -> tuple[Array, Array, Array]:
        """See `Packets`.

        Args:
            which: packets, (k,).
            x: all unknowns, (P,).
            ground: points of these packets, (k, 3), ITRS, metres.
        """
        rays, camera = self.rays, self.camera.drifted(self.unit * x[self.change])
        station, attitude, jacobian = self.corrections.applied(which, x, rays.station[which], rays.attitude[which])
        here = Rays(rays.point[which], rays.image[which], station, attitude)
        by = partials(camera, here, ground, _NOTHING, _NOTHING)
        miss = misclosure(camera, here, ground, _NOTHING, _NOTHING)
        white = self.white[which]
        slopes = self.corrections.slopes(which, white @ by.attitude @ jacobian, -white @ by.ground)
        changes = white @ (by.drift * self.unit)
        return (
            np.einsum("nij,nj->ni", white, miss),
            np.concatenate([slopes, changes], axis=2),
            white @ by.ground,
        )


@dataclass(frozen=True, eq=False)
class Pointings:
    """Laser altimeter footprints: range, and where the beam points in the body frame.

    Attributes:
        name: of the pass.
        point: (n,) footprints.
        station: (n, 3) readings, ITRS, metres. attitude: (n, 3, 3) body to ITRS.
        aim: (n, 3) unit vectors of the beam in the body frame.
        distance: (n,) measured, metres.
        corrections: of the readings.
        sigma: of the range, metres, and of the pointing about each of two axes, radians, with the beam's width.
        group: variance group.
    """

    name: str
    point: Indices
    station: Array
    attitude: Array
    aim: Array
    distance: Array
    corrections: Corrections
    sigma: tuple[float, float]
    group: str = "laser"
    rows: int = 3

    @property
    def columns(self) -> Indices:
        """(n, w)."""
        return self.corrections.columns

    def linearised(self, which: Indices, x: Array, ground: Array) -> tuple[Array, Array, Array]:
        """See `Packets`: range, then the beam's two components.

        Args:
            which: packets, (k,).
            x: all unknowns, (P,).
            ground: points of these packets, (k, 3), ITRS, metres.
        """
        station, attitude, jacobian = self.corrections.applied(which, x, self.station[which], self.attitude[which])
        arm = np.einsum("nji,nj->ni", attitude, ground - station)
        far = np.linalg.norm(arm, axis=1)
        unit = arm / far[:, None]
        aim = self.aim[which]
        first = np.cross(aim, np.eye(3)[np.abs(aim[0]).argmin()])
        first = first / np.linalg.norm(first, axis=1, keepdims=True)
        across = np.stack([first, np.cross(aim, first)], axis=1)
        miss = np.concatenate(
            [
                (far - self.distance[which])[:, None] / self.sigma[0],
                np.einsum("nij,nj->ni", across, unit) / self.sigma[1],
            ],
            axis=1,
        )
        flat = np.eye(3) - unit[:, :, None] * unit[:, None, :]
        by_arm = np.concatenate(
            [unit[:, None] / self.sigma[0], across @ flat / (self.sigma[1] * far[:, None, None])], axis=1
        )
        # a small turn s of the body moves the arm by arm x s
        spun = np.stack([np.cross(arm, axis) for axis in np.eye(3)], axis=-1)
        by_point = by_arm @ np.swapaxes(attitude, 1, 2)
        return miss, self.corrections.slopes(which, by_arm @ spun @ jacobian, -by_point), by_point


@dataclass(frozen=True, eq=False)
class FixedPoints:
    """Given coordinates of control points, with a shift that they may have in common.

    Attributes:
        name: of the set.
        point: (n,).
        given: (n, 3) ITRS, metres.
        white: (n, 3, 3) whitens their misclosures.
        datum: (0,) or (3,) unknowns of what all given coordinates are too large by, along ITRS axes, metres.
        group: variance group.
    """

    name: str
    point: Indices
    given: Array
    white: Array
    datum: Indices = field(default_factory=lambda: np.zeros(0, np.intp))
    group: str = "control"
    rows: int = 3

    @property
    def columns(self) -> Indices:
        """(n, 0) or (n, 3)."""
        return np.broadcast_to(self.datum, (len(self.point), len(self.datum)))

    def linearised(self, which: Indices, x: Array, ground: Array) -> tuple[Array, Array, Array]:
        """See `Packets`.

        Args:
            which: packets, (k,).
            x: all unknowns, (P,).
            ground: points of these packets, (k, 3), ITRS, metres.
        """
        white = self.white[which]
        shift = x[self.datum] if len(self.datum) else np.zeros(3)
        miss = np.einsum("nij,nj->ni", white, ground - self.given[which] + shift)
        return miss, white[:, :, : len(self.datum)], white


@dataclass(frozen=True, eq=False)
class Heights:
    """Heights of a terrain model at points, with an error that the model has everywhere.

    Attributes:
        name: of the model.
        point: (n,).
        place: (n, 3) where the model's surface lies at the point's first place, ITRS, metres.
        normal: (n, 3) of the surface there; unit vectors.
        sigma: (n,) of a height, independent from point to point, metres.
        common: (1,) unknown of the model's common error. unit: its size, metres.
        group: variance group.
    """

    name: str
    point: Indices
    place: Array
    normal: Array
    sigma: Array
    common: Indices
    unit: float
    group: str = "terrain"
    rows: int = 1

    @property
    def columns(self) -> Indices:
        """(n, 1)."""
        return np.broadcast_to(self.common, (len(self.point), 1))

    def linearised(self, which: Indices, x: Array, ground: Array) -> tuple[Array, Array, Array]:
        """See `Packets`.

        Args:
            which: packets, (k,).
            x: all unknowns, (P,).
            ground: points of these packets, (k, 3), ITRS, metres.
        """
        normal, sigma = self.normal[which], self.sigma[which]
        above = np.sum(normal * (ground - self.place[which]), axis=1) - self.unit * float(x[self.common[0]])
        by_x = np.broadcast_to(-self.unit / sigma[:, None, None], (len(which), 1, 1))
        return (above / sigma)[:, None], by_x, (normal / sigma[:, None])[:, None]
