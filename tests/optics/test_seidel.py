"""Seidel sums against the exact trace: what they say of wavefronts, distortion and colour comes out as beams shrink."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import optics
from optics import Camera, OpticalSurface

WAVE = 550e-9
LENS = [
    OpticalSurface(0.026, 0.004, material=1.62),
    OpticalSurface(-0.3, 0.006),
    OpticalSurface(-0.025, 0.0015, 0.4, material=1.62, asphere=(700.0,)),
    OpticalSurface(0.024, 0.005, diameter=0.004),
    OpticalSurface(0.12, 0.004, material="N-BK7"),
    OpticalSurface(-0.022, 0.03, -0.7),
]
TELESCOPE = [
    OpticalSurface(-2.4, -0.88, -1.0, "mirror", diameter=0.2),
    OpticalSurface(-0.96, 0.96, -4.0, "mirror", asphere=(0.4,)),
]
PLATE = [  # the stop in front, at the centre of curvature of a mirror that bends a second mirror's light
    OpticalSurface(thickness=1.1, diameter=0.08),
    OpticalSurface(-1.1, -0.4, material="mirror"),
    OpticalSurface(3.0, 0.2, material="mirror"),
]


def cameras() -> dict[str, tuple[Camera, float]]:
    """Centred cameras with the edges of their fields, radians."""
    return {
        "lens": (Camera(LENS, WAVE, stop=3).refocused(), 0.1),
        "telescope": (Camera(TELESCOPE, WAVE).refocused(), 0.01),
        "plate": (Camera(PLATE, WAVE).refocused(), 0.04),
    }


def smaller(camera: Camera, scale: float) -> Camera:
    """The camera with a smaller stop."""
    surfaces = list(camera.surfaces)
    stop = surfaces[camera.stop]
    surfaces[camera.stop] = replace(stop, diameter=scale * stop.diameter)
    return replace(camera, surfaces=surfaces)


def traced(camera: Camera, field: float) -> np.ndarray:
    """W040, W131, W222 and defocus W020 of the traced wavefront, from its Zernike terms, metres."""
    terms = optics.wavefront(camera, (0.0, field)).coefficients
    return np.array(
        [6.0 * np.sqrt(5.0) * terms[10], 3.0 * np.sqrt(8.0) * terms[6], -2.0 * np.sqrt(6.0) * terms[5],
         2.0 * np.sqrt(3.0) * terms[3]]
    )  # fmt: skip


@pytest.mark.parametrize("name", cameras())
def test_traced_wavefronts_become_those_of_the_sums(name: str) -> None:
    """The rest is of higher order: halving stop and field quarters it relative to the third order."""
    camera, field = cameras()[name]
    rest = []
    for scale in (0.5, 0.25):
        small = smaller(camera, scale)
        w040, w131, w222, w220, _ = optics.seidel(small, scale * field).wavefront.sum(axis=0)
        predicted = np.array([w040, w131, w222, w220 + 0.5 * w222 + w040])
        rest.append(np.max(np.abs(traced(small, scale * field) - predicted)) / np.max(np.abs(predicted)))
    assert rest[1] < 0.02
    assert rest[1] < 0.35 * rest[0]


@pytest.mark.parametrize("name", cameras())
def test_traced_distortion_becomes_that_of_the_sums(name: str) -> None:
    """A chief ray lies off its paraxial image by S_V / (2 n' u') of the marginal ray's slope u'."""
    camera, field = cameras()[name]
    rest = []
    for scale in (0.5, 0.25):
        angle = scale * field
        sums = optics.seidel(camera, angle)
        ray = optics.trace(camera, *optics.launch_rays(camera, (0.0, angle), pupil=[(0.0, 0.0)]))
        # the paraxial image height times n'u' of the marginal ray is the invariant
        height = np.copysign(camera.focal_length * np.tan(angle), ray.position[0, 1])
        predicted = sums.sums[:, 4].sum() / (2.0 * sums.invariant) * height
        off = ray.position[0, 1] - height
        rest.append(abs(off / predicted - 1.0))
    assert rest[1] < 0.02
    assert rest[1] < 0.35 * rest[0]


def test_chromatic_sums_are_the_traced_colours() -> None:
    """Two lines that are near: C_I moves the focus by C_I / (n' u'^2), C_II the chief ray by C_II / (n' u')."""
    camera, field, ends = cameras()["lens"][0], 1e-3, (WAVE - 1e-10, WAVE + 1e-10)
    sums = optics.seidel(camera, field, ends)
    axial, lateral = sums.colour.sum(axis=0)
    short, long = (camera.at(wavelength) for wavelength in ends)
    focus = short.paraxial.back_focal_length - long.paraxial.back_focal_length
    na = 0.5 * camera.entrance_pupil_diameter / camera.focal_length
    assert axial == pytest.approx(-focus * na**2, rel=1e-4)
    y = [
        optics.trace(c, *optics.launch_rays(c, (0.0, field), pupil=[(0.0, 0.0)])).position[0, 1] for c in (short, long)
    ]
    assert lateral == pytest.approx((y[0] - y[1]) * sums.invariant / (camera.focal_length * field), rel=1e-3)


def test_a_mirror_with_its_stop_at_the_centre_has_no_coma_and_the_field_of_its_radius() -> None:
    """Every chief ray is a radius; the image lies on the sphere of half of it."""
    mirror = OpticalSurface(-2.0, -1.0, material="mirror")
    sums = optics.seidel(Camera([OpticalSurface(thickness=2.0, diameter=0.2), mirror], WAVE), 0.02)
    assert np.abs(sums.sums[:, [1, 2]]).max() < 1e-18
    assert sums.petzval == pytest.approx(-1.0, rel=1e-12)
    lens = optics.seidel(Camera([replace(LENS[0], diameter=0.01), OpticalSurface(thickness=0.04)], WAVE), 0.02)
    assert lens.petzval == pytest.approx(-0.62 / 1.62 / 0.026, rel=1e-12)


def test_surfaces_off_the_axis_are_refused() -> None:
    mirror = OpticalSurface(-4.0, -2.0, -1.0, "mirror", diameter=0.25)
    for moved in ({"tilt": (1e-3, 0.0, 0.0)}, {"decenter": (0.0, 1e-3)}, {"offset": (0.0, 0.1)}):
        with pytest.raises(ValueError, match="surfaces of revolution about one axis"):
            optics.seidel(Camera([replace(mirror, **moved)], WAVE), 0.01)
