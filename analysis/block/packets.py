"""Observations of ground points in packets: rows that one measurement of one point gives, and what they depend on.

A packet of d rows observes one point p and w of the unknowns x. Sets of packets of one kind are linearised together,
whitened by their a-priori covariance: miss + by_x dx + by_point dp. The core (`point_reduction`) knows no cameras.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from analysis.arrays import Array, Indices
from analysis.block.corrections import Corrections, by_rotation_vector, cross, turned, turned_back
from analysis.orbit.three_line_model import LineModel, Rays


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

    def taken(self, which: Indices, point: Indices) -> Packets:
        """Some of the packets, (k,), whose points have other numbers, (k,)."""


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
        corrections = self.corrections.taken(which)
        turn, shift = corrections.at(x)
        attitude = rays.attitude[which]
        arm = ground - rays.station[which] - shift @ corrections.axes.T
        body = turned_back(turn, np.einsum("nji,nj->ni", attitude, arm))
        seen = camera.seen(body, rays.image[which])
        white = self.white[which]
        by_body = white @ seen.by_body
        by_measured = turned(turn, by_body)
        by_ground = by_measured @ np.swapaxes(attitude, 1, 2)
        # a small turn s of the body moves the arm by arm x s, and t . (arm x s) = (t x arm) . s
        by_turn = by_rotation_vector(turn, cross(by_body, body[:, None]))
        slopes = corrections.slopes(by_turn, -by_ground)
        return (
            np.einsum("nij,nj->ni", white, seen.miss),
            np.concatenate([slopes, white @ (seen.by_drift * self.unit)], axis=2),
            by_ground,
        )

    def taken(self, which: Indices, point: Indices) -> LineImage:
        """See `Packets`."""
        rays = replace(self.rays.taken(which), point=point)
        return replace(self, rays=rays, white=self.white[which], corrections=self.corrections.taken(which))


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
        corrections = self.corrections.taken(which)
        turn, shift = corrections.at(x)
        attitude = self.attitude[which]
        arm = ground - self.station[which] - shift @ corrections.axes.T
        arm = turned_back(turn, np.einsum("nji,nj->ni", attitude, arm))
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
        by_turn = by_rotation_vector(turn, cross(by_arm, arm[:, None]))
        by_point = turned(turn, by_arm) @ np.swapaxes(attitude, 1, 2)
        return miss, corrections.slopes(by_turn, -by_point), by_point

    def taken(self, which: Indices, point: Indices) -> Pointings:
        """See `Packets`."""
        rows = (self.station, self.attitude, self.aim, self.distance)
        station, attitude, aim, distance = (row[which] for row in rows)
        return replace(
            self,
            point=point,
            station=station,
            attitude=attitude,
            aim=aim,
            distance=distance,
            corrections=self.corrections.taken(which),
        )


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

    def taken(self, which: Indices, point: Indices) -> FixedPoints:
        """See `Packets`."""
        return replace(self, point=point, given=self.given[which], white=self.white[which])


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

    def taken(self, which: Indices, point: Indices) -> Heights:
        """See `Packets`."""
        place, normal, sigma = self.place[which], self.normal[which], self.sigma[which]
        return replace(self, point=point, place=place, normal=normal, sigma=sigma)
