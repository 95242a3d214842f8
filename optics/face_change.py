"""What a deformation does to an optical face: a rigid motion and a figure in Zernike terms."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from optics import quadrature, zernike
from optics.aperture import Aperture, Circle, Ellipse
from optics.elastic_field import Displacement, rigid_modes
from optics.figure import ZernikeFigure
from optics.frozen_map import FrozenMap
from optics.pose import Pose
from optics.surface import Surface

_HELD_TERMS = 1e-6  # combinations of terms that show on the aperture by less than this share of their size are left out


@dataclass(frozen=True)
class FaceChange:
    """How an optical face moved and changed, in the face's own nominal frame.

    Attributes:
        rotate: small rotation vector about the frame's origin, radians.
        shift: of the frame's origin, metres.
        figure: Noll index -> metres rms over the disk, change of sag along +z; from Z4 on.
        residual_rms: what rotate, shift and figure leave of the change of sag, rms over the aperture, metres.
    """

    rotate: tuple[float, float, float]
    shift: tuple[float, float, float]
    figure: Mapping[int, float]
    residual_rms: float


def face_change(
    displacement: Displacement, surface: Surface, aperture: Aperture, pose: Pose, terms: int = 15
) -> FaceChange:
    """Rigid motion and change of figure of a face, by least squares over its aperture.

    First the rigid motion nearest to the displacement of the material is taken off. What is left changes the sag at
    fixed x, y by u_z - s_x u_x - s_y u_y (first order in u); into it Zernike terms from Z4 on are fitted, together with
    the piston and tilts that a further rigid motion of this surface makes, which then go to the rigid motion. Of a
    plane, rotate, shift and figure together thus hold the whole normal displacement but the residual.

    The disk of the terms is that of the surface's Zernike figure, else the aperture's circle, else the circle around
    the rectangle, as in the ray trace. On a narrow rectangle some combinations of terms hardly differ; those that
    show on the aperture by less than 1e-6 of their coefficients are left out, and the others serve only inside of it.

    Args:
        displacement: of the body.
        surface: the face's nominal shape.
        aperture: the part of it to look at, which must lie on the body.
        pose: of the face's frame in the mesh's.
        terms: highest Noll index, 3 for none.

    Raises:
        ValueError: the aperture reaches beyond the body, or ``terms`` is below 3.
    """
    if not 3 <= terms <= zernike.MAX_NOLL:
        raise ValueError(f"a face's terms must end between Z3 and Z{zernike.MAX_NOLL}, found {terms}")
    x, y, weight = _samples(aperture)
    radius, centre = _figure_disk(surface, aperture)
    points = np.stack([x, y, surface.sag(x, y)], axis=-1)
    moved = displacement.at(pose.apply(points)) @ pose.rotation
    root = np.sqrt(weight)
    modes = rigid_modes(points).reshape(6, -1, 3)
    scale = np.array([1.0, 1.0, 1.0, 1.0 / radius, 1.0 / radius, 1.0 / radius])
    matrix = (modes * root[:, None]).reshape(6, -1).T
    rigid = np.linalg.lstsq(matrix * scale, (moved * root[:, None]).ravel(), rcond=None)[0] * scale
    rest = moved - np.einsum("k,kpx->px", rigid, modes)
    # differences over 1e-5 of the aperture: slopes to about 1e-10, far below what a displacement needs
    h = 1e-5 * radius
    slope = np.stack([surface.sag(x + h, y) - surface.sag(x - h, y), surface.sag(x, y + h) - surface.sag(x, y - h)])
    slope = slope / (2.0 * h)

    def sag_change(u: np.ndarray) -> np.ndarray:
        return np.asarray(u[..., 2] - slope[0] * u[..., 0] - slope[1] * u[..., 1])

    change = sag_change(rest)
    z = zernike.basis(terms, (x - centre[0]) / radius, (y - centre[1]) / radius)[:, 3:]
    further = sag_change(modes[2:5]).T * scale[2:5]  # piston and two tilts, of the size of the terms
    columns = np.concatenate([further, z], axis=1)
    fitted = np.linalg.lstsq(columns * root[:, None], change * root, rcond=_HELD_TERMS)[0]
    rigid[2:5] += fitted[:3] * scale[2:5]
    residual = change - columns @ fitted
    return FaceChange(
        (float(rigid[3]), float(rigid[4]), float(rigid[5])),
        (float(rigid[0]), float(rigid[1]), float(rigid[2])),
        FrozenMap({j: float(a) for j, a in zip(range(4, terms + 1), fitted[3:], strict=True)}),
        float(np.sqrt(np.sum(weight * residual**2))),
    )


def _samples(aperture: Aperture) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Quadrature nodes x, y over an aperture and weights of a mean, each shape (P,)."""
    if isinstance(aperture, Circle):
        nodes = quadrature.disk(10, inner=aperture.inner / aperture.radius)
        half = (aperture.radius, aperture.radius)
        u, v, weight = nodes.x, nodes.y, nodes.share
    elif isinstance(aperture, Ellipse):
        nodes = quadrature.disk(10)
        half = (aperture.half_x, aperture.half_y)
        u, v, weight = nodes.x, nodes.y, nodes.share
    else:
        s, w = quadrature.gauss(16)
        half = (aperture.half_x, aperture.half_y)
        u, v, weight = np.tile(s, 16), np.repeat(s, 16), np.outer(w, w).ravel() / 4.0
    return aperture.centre[0] + half[0] * u, aperture.centre[1] + half[1] * v, weight


def _figure_disk(surface: Surface, aperture: Aperture) -> tuple[float, tuple[float, float]]:
    """Radius and centre of the disk on which the trace counts a figure's terms."""
    if isinstance(surface.figure, ZernikeFigure):
        return surface.figure.radius, surface.figure.centre
    if isinstance(aperture, Circle):
        return aperture.radius, aperture.centre
    return float(np.hypot(aperture.half_x, aperture.half_y)), aperture.centre
