"""Images of a far point by the perturbed gf7 camera through its full aperture."""

import numpy as np
import pytest

from optics.geometry import zernike
from optics.geometry.tree import Motion, State
from optics.numerics import quadrature
from optics.numerics.quadrature import PupilNodes
from optics.raytrace.assembly import Assembly
from optics.raytrace.system import assemble
from optics.raytrace.trace import BeamMissedError, make_rays, trace
from optics.waves.diffraction import Grid, PupilField, image
from optics.waves.imaging import aim_collimated, imaging_field
from scenes.models.camera_model import IMAGE, field_direction

ARCSEC = np.pi / 180 / 3600
WAVELENGTH = 650e-9
PERTURBED: State = {
    "M2": Motion(rotate=(20 * ARCSEC, -15 * ARCSEC, 0.0), shift=(20e-6, -30e-6, 15e-6)),
    "M3": Motion(rotate=(-5 * ARCSEC, 8 * ARCSEC, 0.0)),
}
FINE = quadrature.disk(16, 64)
AXIS = Grid(-15.5 * 3e-6, 3e-6, 32)


def huygens(
    points: np.ndarray,
    path: np.ndarray,
    direction: np.ndarray,
    amplitude: np.ndarray,
    wavelength: float,
    pixels: np.ndarray,
    normal: np.ndarray | None = None,
    chunk: int = 256,
) -> np.ndarray:
    """Irradiance by Huygens' sum of spherical wavelets from points on the exit wavefront; slow, the check of ``image``.

    Args:
        points: (N, 3) points on the exit reference sphere, metres.
        path: (N,) optical path at these points.
        direction: (N, 3) unit ray directions there.
        amplitude: (N,) area element times field amplitude at the points (m^2 * field).
        wavelength: metres.
        pixels: (M, 3) points where the irradiance is wanted.
        normal: (3,) unit normal of the detector: each wavelet counts with the root of the cosine of its incidence, so
            that the result is power per detector area, as in ``image``; None: square to the light.
        chunk: pixels done at once, to bound memory.

    Returns:
        (M,) irradiance, 1/m^2 for unit power (sum amplitude * field = 1).
    """
    k = 2.0 * np.pi / wavelength
    out = np.empty(len(pixels))
    for start in range(0, len(pixels), chunk):
        arm = pixels[start : start + chunk, None, :] - points[None]
        distance = np.linalg.norm(arm, axis=-1)
        obliquity = np.einsum("mnx,nx->mn", arm, direction) / distance
        if normal is not None:
            obliquity = obliquity * np.sqrt(np.abs(arm @ normal) / distance)
        phase = k * ((path - path[0]) + (distance - distance[:, :1]))
        field = np.sum(amplitude * obliquity / distance * np.exp(1j * phase), axis=1) / wavelength
        out[start : start + chunk] = np.abs(field) ** 2
    return out


class Camera:
    """The camera in its prescription frame, looking at one point of the field's edge."""

    def __init__(self, backend, gf7, state: State) -> None:
        self.backend, self.stop = backend, gf7.apertures["M2"]
        self.assembly: Assembly = gf7.bare_assembly()
        self.systems = assemble(self.assembly, ["imaging"], [state])
        self.to_stop = assemble(self.assembly, [gf7.mirrors[:2]], [state])
        self.direction = field_direction(gf7.spec, np.radians(1.0), np.radians(0.05))
        self.launch = -3.0 * self.direction
        self.frame = self.assembly.place([state]).pose(IMAGE)
        self.centre = trace(backend, self.systems, self.rays(np.zeros((1, 2)))[0]).numpy()[0][0, 0]

    def rays(self, target: np.ndarray):
        position, _ = aim_collimated(self.backend, self.to_stop, self.direction, self.launch, target)
        return make_rays(self.backend, position[0], self.direction), position[0]

    def field(self, nodes: PupilNodes, origin: np.ndarray | None = None) -> PupilField:
        origin = self.centre if origin is None else origin
        return imaging_field(
            self.backend, self.systems, self.to_stop, self.direction, self.launch, self.stop, nodes, WAVELENGTH, origin
        )


def focal_plane_at(dz: float) -> State:
    return {**PERTURBED, IMAGE: Motion(shift=(0.0, 0.0, dz))}


@pytest.mark.second
@pytest.mark.parametrize("dz", [-100e-6, 0.0, 100e-6])
@pytest.mark.parametrize("where", ["behind M3", "exit pupil"])
def test_against_huygens(backend, gf7, dz: float, where: str) -> None:
    """Wavelets from points of the reference sphere, where the traced rays really cross it, with the ray tube's area.

    gf7's exit pupil lies 181 m behind its image (it is nearly telecentric): there the light has passed its focus and
    the sum runs back in time. The second sphere stands between M3 and the image, where Debye's plane waves are good to
    the order of 1 / Fresnel number, 1e-4.
    """
    camera = Camera(backend, gf7, focal_plane_at(dz))
    got = image(camera.field(FINE), AXIS, AXIS)[0]

    nodes = quadrature.disk(20, 72)
    rays, launch = camera.rays(camera.stop.radius * np.stack([nodes.x, nodes.y], axis=-1))
    traced = trace(backend, camera.systems, rays, world=True)
    assert traced.world is not None
    position, direction, path, valid = (a[0] for a in traced.numpy(traced.world))
    assert valid.all()
    focus = Camera(backend, gf7, PERTURBED).frame.apply(Camera(backend, gf7, PERTURBED).centre)
    radius = float(gf7.first_order.exit_pupil_distance[0]) if where == "exit pupil" else 1.9
    offset = position - focus
    along = np.sum(offset * direction, axis=-1)
    step = -along - np.sign(radius) * np.sqrt(along**2 - np.sum(offset**2, axis=-1) + radius**2)
    points = position + step[:, None] * direction
    np.testing.assert_allclose(np.linalg.norm(points - focus, axis=-1), abs(radius), rtol=1e-12)

    basis = zernike.basis(45, nodes.x, nodes.y)
    slopes = [zernike.gradient_basis(45, nodes.x, nodes.y, axis) for axis in (0, 1)]
    root = np.sqrt(nodes.weight)[:, None]

    def tube(surface: np.ndarray) -> np.ndarray:
        """Area on a surface of points (N, 3) per area of the stop's unit disk."""
        terms, *_ = np.linalg.lstsq(basis * root, surface * root, rcond=None)
        return np.linalg.norm(np.cross(slopes[0] @ terms, slopes[1] @ terms), axis=-1)

    entrance = tube(launch)
    amplitude = np.sqrt(tube(points - focus) * entrance / np.sum(entrance * nodes.weight)) * nodes.weight
    x, y = np.meshgrid(AXIS.points(), AXIS.points())
    pixels = camera.frame.apply(camera.centre + np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3))
    sense = np.sign(radius)
    normal = camera.frame.rotation[:, 2]
    want = huygens(points, sense * (path + step), sense * direction, amplitude, WAVELENGTH, pixels, normal)
    error = np.max(np.abs(got.ravel() - want)) / np.max(want)
    assert error < (2e-6 if where == "exit pupil" else 1e-4)
    assert np.max(want) * (3e-6) ** 2 > 0.03  # there is an image on these pixels
    assert np.sum(want) * (3e-6) ** 2 == pytest.approx(0.977, abs=0.005)


def test_a_blocked_beam_is_an_explained_error(backend, gf7) -> None:
    camera = Camera(backend, gf7, {"M3": Motion(shift=(2.0, 0.0, 0.0))})
    with pytest.raises(BeamMissedError, match="imaging path"):
        camera.field(FINE)
