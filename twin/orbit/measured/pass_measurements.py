"""Measurements of a pass in the project's conventions of frames, signs and pixel coordinates.

Every analysis uses this form, whether the measurements were read from a satellite's files or simulated.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from analysis.arrays import Array
from twin.orbit.flight.line_camera import LineTimes
from twin.orbit.flight.platform_table import PlatformTable

ROLES = ("control", "check", "tie")
"""Roles of ground points.

The coordinates of control points are used as observations, those of check points only test the result, and those of tie
points are unknown.
"""


@dataclass(frozen=True, eq=False)
class GroundPoints:
    """Ground points of a pass with their names, coordinates, covariances and roles.

    Attributes
    ----------
    ids : (n,) ndarray of object for n points
        Unique names.
    itrs : (n, 3) ndarray
        Coordinates in the ITRS, metres; NaN for tie points without coordinates.
    covariance : (n, 3, 3) ndarray
        Covariance of the coordinates, ITRS axes, m^2; zero for exact coordinates, and for tie points.
    role : (n,) ndarray of object
        Role of each point, one of `ROLES`.
    """

    ids: NDArray[np.object_]
    itrs: Array
    covariance: Array
    role: NDArray[np.object_]

    @classmethod
    def of(cls, ids: ArrayLike, itrs: ArrayLike, covariance: ArrayLike, role: ArrayLike) -> GroundPoints:
        """Make ground points from arrays.

        Parameters
        ----------
        ids : (n,) array_like for n points
            Names.
        itrs : (n, 3) array_like
            Coordinates, metres.
        covariance : array_like
            (n, 3, 3), or one (3, 3) for all, m^2.
        role : array_like
            (n,), or one for all.
        """
        names = np.array(ids, dtype=object)
        spread = np.array(np.broadcast_to(np.asarray(covariance, np.float64), (len(names), 3, 3)))
        sorts = np.array(np.broadcast_to(np.asarray(role, dtype=object), (len(names),)))
        return cls(names, np.array(itrs, np.float64), spread, sorts)

    def __len__(self) -> int:
        return len(self.ids)

    def with_ties(self, names: Sequence[str]) -> GroundPoints:
        """Return these points, followed by tie points of these names without coordinates."""
        ties = GroundPoints.of(names, np.full((len(names), 3), np.nan), np.zeros((3, 3)), "tie")
        return GroundPoints(
            *(np.concatenate([getattr(points, k.name) for points in (self, ties)]) for k in fields(self))
        )

    def taken(self, keep: ArrayLike) -> GroundPoints:
        """Return the ground points that a mask or an array of indices selects."""
        where = np.asarray(keep)
        return GroundPoints(self.ids[where], self.itrs[where], self.covariance[where], self.role[where])


@dataclass(frozen=True, eq=False)
class ImagePoints:
    """Image points of one line camera.

    Attributes
    ----------
    point : (n,) ndarray of int for n image points
        Index of the ground point of each image point.
    line, pixel : (n,) ndarray
        Image coordinates; the centre of the first line's first pixel is (0, 0).
    covariance : (n, 2, 2) ndarray
        Covariance of line and pixel, pixels squared.
    """

    point: NDArray[np.intp]
    line: Array
    pixel: Array
    covariance: Array

    @classmethod
    def of(cls, point: ArrayLike, line: ArrayLike, pixel: ArrayLike, covariance: ArrayLike) -> ImagePoints:
        """Make image points from arrays.

        Parameters
        ----------
        point : (n,) array_like of int for n image points
            Indices of ground points.
        line : (n,) array_like
            Line coordinates.
        pixel : (n,) array_like
            Pixel coordinates.
        covariance : array_like
            (n, 2, 2), or one (2, 2) for all, pixels squared.
        """
        which = np.array(point, np.intp)
        spread = np.array(np.broadcast_to(np.asarray(covariance, np.float64), (len(which), 2, 2)))
        return cls(which, np.array(line, np.float64), np.array(pixel, np.float64), spread)

    def taken(self, keep: ArrayLike) -> ImagePoints:
        """Return the image points that a mask or an array of indices selects."""
        where = np.asarray(keep)
        return ImagePoints(self.point[where], self.line[where], self.pixel[where], self.covariance[where])

    @classmethod
    def joined(cls, parts: Sequence[ImagePoints]) -> ImagePoints:
        """Concatenate one or more sets of image points."""
        return cls(*(np.concatenate([getattr(part, attribute.name) for part in parts]) for attribute in fields(cls)))

    def numbered(self, first: int) -> ImagePoints:
        """Return these image points with the indices of their ground points reduced by ``first``."""
        return replace(self, point=self.point - first)


def point_names(roles: NDArray[np.object_]) -> list[str]:
    """Return names for points: a letter for the role, c, k or t (control, check, tie), and a number."""
    letter = {"control": "c", "check": "k", "tie": "t"}
    return [f"{letter[role]}{k}" for k, role in enumerate(roles.tolist())]


_APART = 0.01
"""Distance of two ground points, in metres, below which they count as the same: images from orbit do not resolve it."""


def duplicates(ids: NDArray[np.object_], coordinates: Array) -> str:
    """Return a warning about points that have the same coordinates under two names; empty where there are none.

    Parameters
    ----------
    ids : (n,) ndarray of object for n points
        Names.
    coordinates : (n, 3) ndarray
        Coordinates, ITRS, metres; NaN where unknown.
    """
    known = np.flatnonzero(np.all(np.isfinite(coordinates), axis=1))
    pairs = sorted(cKDTree(coordinates[known]).query_pairs(_APART))
    if not pairs:
        return ""
    names = listed([f"{ids[known[a]]} = {ids[known[b]]}" for a, b in pairs])
    return f"points with the same coordinates under two names: {names}; counted twice, they make sigmas too small"


_NAMED = 8
"""Largest number of names that a message lists."""


def listed(names: Sequence[str]) -> str:
    """Return a text that lists the first `_NAMED` names and the number of further ones."""
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return ", ".join(names[:_NAMED]) + more


@dataclass(frozen=True, eq=False)
class PassMeasurements:
    """Measurements of one pass.

    Attributes
    ----------
    name : str
        Name of the pass, or of the field that it passes.
    platform : PlatformTable
        Readings of orbit and attitude.
    line_times : mapping of str to LineTimes
        Exposure times of the lines of each line camera.
    ground : GroundPoints
        Control, check and tie points.
    images : mapping of str to ImagePoints
        Image points of each line camera; their attribute `point` is an index into `ground`.
    """

    name: str
    platform: PlatformTable
    line_times: Mapping[str, LineTimes]
    ground: GroundPoints
    images: Mapping[str, ImagePoints]
