"""The library of optics against poppy and batoid, and against the twin of the same prescription."""

from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest

import optics
from optics.geometry.pose import rotation_matrix
from scenes.specs.load import load_camera
from twin.camera.camera_optics import CameraOptics

pytestmark = pytest.mark.oracle
VANE = 0.45 / 64
"""Width of a vane, metres: 16 cells of a raster of 1024 over the aperture."""


def ritchey_chretien(tilt: float = 0.0, vanes: float = 0.0) -> optics.Camera:
    """A telescope of 0.45 m at F/8 with M2 tilted about x, radians, and four vanes of a width in metres."""
    spider = [(vanes, angle) for angle in np.radians([0.0, 90.0, 180.0, 270.0])] if vanes else []
    m1 = optics.OpticalSurface(-2.4, -0.88, -1.080808, "mirror", diameter=0.45, inner_diameter=0.12, vanes=spider)
    m2 = optics.OpticalSurface(-0.96, 0.96, -5.022727, "mirror", tilt=(tilt, 0.0, 0.0))
    return optics.Camera([m1, m2], wavelength=550e-9)


@pytest.mark.skipif(find_spec("poppy") is None, reason="poppy not installed (extra `oracles`)")
@pytest.mark.parametrize("vanes", [0.0, VANE])
def test_an_obscured_image_is_that_of_poppy(vanes: float) -> None:
    """poppy has a raster in its pupil."""
    import poppy

    count, scale, camera = 64, 550e-9 / 0.45 / 4.0, ritchey_chretien(vanes=vanes)
    ours = optics.psf(camera, scale * camera.focal_length, count)
    system = poppy.OpticalSystem(npix=1024, oversample=1)
    system.add_pupil(poppy.CircularAperture(radius=0.225))
    obscuration = {"n_supports": 4, "support_width": vanes} if vanes else {"n_supports": 0}
    system.add_pupil(poppy.SecondaryObscuration(secondary_radius=0.06, **obscuration))
    system.add_detector(pixelscale=np.degrees(scale) * 3600.0, fov_pixels=count)
    theirs = system.calc_psf(wavelength=550e-9)[0].data
    ours, theirs = ours / ours.sum(), theirs / theirs.sum()
    assert np.max(np.abs(ours - theirs)) < 2e-4 * theirs.max()


@pytest.mark.skipif(find_spec("poppy") is None, reason="poppy not installed (extra `oracles`)")
def test_an_mtf_is_the_autocorrelation_of_poppys_pupil() -> None:
    import poppy

    cells, camera = 1024, ritchey_chretien(vanes=VANE)
    spider = poppy.SecondaryObscuration(secondary_radius=0.06, n_supports=4, support_width=VANE)
    pupil = poppy.CompoundAnalyticOptic([poppy.CircularAperture(radius=0.225), spider]).sample(
        npix=cells, grid_size=0.45
    )
    overlap = np.fft.ifft2(np.abs(np.fft.fft2(pupil, (2 * cells, 2 * cells))) ** 2).real[0, :cells:64]
    frequency = np.arange(0, cells, 64) * (0.45 / cells) / (camera.wavelength * camera.focal_length)
    assert np.max(np.abs(optics.mtf(camera, frequency) - overlap / overlap[0])) < 2e-3


@pytest.mark.skipif(find_spec("batoid") is None, reason="batoid not installed (extra `oracles`)")
def test_rays_are_those_of_batoid() -> None:
    """M2 is tilted by 0.5 mrad."""
    import batoid

    camera, field = ritchey_chretien(tilt=5e-4), (1e-3, -2e-3)
    m1, m2 = (batoid.Quadric(surface.radius, surface.conic) for surface in camera.surfaces)
    turned = batoid.CoordSys([0.0, 0.0, -0.88], batoid.RotX(5e-4))
    image = batoid.CoordSys([0.0, 0.0, 0.08])
    position, direction = optics.launch_rays(camera, field, pupil=[(0.3, 0.2), (-0.9, 0.1), (0.0, 0.0), (0.0, -1.0)])
    ours = optics.trace(camera, position, direction)
    rays = batoid.RayVector(*position.T, *direction.T, 0.0, 550e-9, 1.0)
    m1.reflect(rays)
    m2.reflect(rays, coordSys=turned)
    batoid.Plane().intersect(rays, coordSys=image)
    rays.toCoordSys(batoid.CoordSys())
    assert np.max(np.abs(rays.r - ours.position)) < 1e-12
    assert np.max(np.abs(rays.v - ours.direction)) < 1e-12
    assert np.max(np.abs(rays.t - ours.path)) < 1e-12
    assert ours.valid.tolist() == [True, True, False, True]


@pytest.mark.skipif(find_spec("batoid") is None, reason="batoid not installed (extra `oracles`)")
def test_rays_through_a_moved_asphere_of_glass_are_those_of_batoid() -> None:
    import batoid

    shift, tilt, wave = (1e-3, -2e-3), (2e-3, -3e-3, 0.0), 600e-9
    front = optics.OpticalSurface(
        0.08, 0.006, -0.5, "N-BK7", diameter=0.03, asphere=(20.0, -3e3), decenter=shift, tilt=tilt
    )
    camera = optics.Camera([front, optics.OpticalSurface(-0.3, 0.1)], wave)
    position, direction = optics.launch_rays(camera, (0.02, -0.03), pupil=[(0.0, 0.0), (0.5, 0.5), (-0.9, 0.1)])
    ours = optics.trace(camera, position, direction)
    rays = batoid.RayVector(*position.T, *direction.T, 0.0, wave, 1.0)
    vacuum, glass = (batoid.ConstMedium(n) for n in (1.0, optics.glass("N-BK7").vacuum_index(wave)))
    moved = batoid.CoordSys([*shift, 0.0], rotation_matrix(tilt))
    batoid.Asphere(0.08, -0.5, [20.0, -3e3]).refract(rays, vacuum, glass, coordSys=moved)
    batoid.Quadric(-0.3, 0.0).refract(rays, glass, vacuum, coordSys=batoid.CoordSys([0.0, 0.0, 0.006]))
    batoid.Plane().intersect(rays, coordSys=batoid.CoordSys([0.0, 0.0, 0.106]))
    rays.toCoordSys(batoid.CoordSys())
    assert np.max(np.abs(rays.r - ours.position)) < 1e-14
    assert np.max(np.abs(rays.t - ours.path)) < 1e-14
    assert ours.valid.all()


def test_numbers_of_a_camera_are_those_of_the_twin(backend) -> None:
    """An off-axis three-mirror camera, typed from its file; the twin has fields as shares of half the field."""
    model = CameraOptics.alone(load_camera("gf7_conic"), backend)
    spec, surfaces = model.model.spec, []
    vertices = [mirror.z for mirror in spec.mirrors.values()]
    for mirror, z, after in zip(spec.mirrors.values(), vertices, [*vertices[1:], spec.image.z], strict=True):
        surfaces.append(optics.OpticalSurface(mirror.radius, after - z, mirror.conic, "mirror"))
    surfaces[1] = replace(surfaces[1], diameter=spec.stop_diameter)
    camera = optics.Camera(surfaces, spec.wavelength, stop=1)
    theirs = model.wavefront((0.5, -1.0))
    field = (0.5 * spec.field.x, spec.field_bias - spec.field.y)
    ours = optics.wavefront(camera, field, terms=len(theirs.coefficients))
    assert np.max(np.abs(ours.coefficients - spec.wavelength * theirs.coefficients)) < 1e-14
    assert ours.rms / spec.wavelength == pytest.approx(theirs.rms, rel=1e-6)
    assert ours.strehl == pytest.approx(theirs.strehl, rel=1e-8)
    frequency = np.array([0.0, 20e3, 50e3, 70e3])
    along, across = (optics.mtf(camera, frequency, field, azimuth) for azimuth in (0.0, 0.5 * np.pi))
    assert np.max(np.abs([along, across] - model.mtf((0.5, -1.0), frequency).values)) < 1e-8
