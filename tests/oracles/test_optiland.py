"""Rays, spots and wavefronts of the reference cameras against optiland."""

import warnings
from importlib.util import find_spec
from typing import Any

import numpy as np
import pytest

from optics.raytrace.system import assemble
from optics.raytrace.trace import make_rays, trace
from scenes.models.camera_model import collimated, field_direction
from tests.oracles.peers import optiland_camera, optiland_rays

# not imported here: each process that runs tests collects this file
pytestmark = [
    pytest.mark.oracle,
    pytest.mark.skipif(find_spec("optiland") is None, reason="optiland not installed (extra `oracles`)"),
]

FIELDS = [(x, y) for x in (-1.0, 0.0, 1.0) for y in (-1.0, 0.0, 1.0)]
RAYS = 1200
TOLERANCE = 1e-12
"""Metres and direction cosines: rounding of some ten metres of path (1e-15) with a lever arm of mirrors; sums of them,
a path or a fitted wavefront, may have some ten times as much."""


def precise(optic: Any) -> Any:
    """The camera with aspheres that are iterated to rounding; optiland's own stop at 1e-6 m moves rays by 0.4 um."""
    for surface in optic.surfaces:
        if hasattr(surface.geometry, "tol"):
            surface.geometry.tol = 1e-14
    return optic


def spot(position: np.ndarray) -> float:
    """Rms distance of rays (N, 3) from their mean in the detector's plane."""
    place = position[:, :2] - position[:, :2].mean(axis=0)
    return float(np.sqrt(np.mean(np.sum(place**2, axis=-1))))


def wavefront(position: np.ndarray, direction: np.ndarray, path: np.ndarray, stop: np.ndarray) -> np.ndarray:
    """Paths to plane waves through the first ray's image, less piston and tilt over the stop, (N,) metres."""
    difference = path - np.sum(direction * (position - position[0]), axis=-1)
    basis = np.column_stack([np.ones(len(stop)), stop])
    return np.asarray(difference - basis @ np.linalg.lstsq(basis, difference, rcond=None)[0])


@pytest.mark.parametrize("name", ["gf7_conic", "gf7", "monitor"])
def test_rays_spots_and_wavefronts(backend, camera, name: str) -> None:
    model = camera(name)
    bare = model.bare_assembly(apertures=False)
    to_stop, imaging = assemble(bare, [model.mirrors[:2]]), assemble(bare, ["imaging"])
    rng = np.random.default_rng(11)
    radius = model.apertures[model.spec.stop].radius
    r, t = radius * np.sqrt(rng.uniform(size=RAYS)), rng.uniform(0.0, 2.0 * np.pi, RAYS)
    stop = np.stack([r * np.cos(t), r * np.sin(t)], axis=-1)
    stop[0] = 0.0
    optic, compared = precise(optiland_camera(model)), 0
    for x, y in FIELDS:
        direction = field_direction(model.spec, x * model.spec.field.x, y * model.spec.field.y)
        launch = collimated(backend, to_stop, direction[None], stop)[0]
        position, leaving, path, valid = (
            a[0] for a in trace(backend, imaging, make_rays(backend, launch, direction)).numpy()
        )
        rays = optiland_rays(launch, direction)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # numba's remarks on optiland's code
            optic.surfaces.trace(rays, record=False)
        assert valid.all()
        theirs = np.stack([rays.x, rays.y, rays.z - model.spec.image.z], axis=-1)
        heading = np.stack([rays.L, rays.M, rays.N], axis=-1)
        np.testing.assert_allclose(theirs, position, rtol=0, atol=TOLERANCE)
        np.testing.assert_allclose(heading, leaving, rtol=0, atol=TOLERANCE)
        np.testing.assert_allclose(rays.opd, path, rtol=0, atol=10.0 * TOLERANCE)
        ours, other = spot(position), spot(theirs)
        assert ours == pytest.approx(other, abs=2.0 * TOLERANCE)
        assert 0.3e-6 < ours < 3e-6
        phase = launch @ direction
        mine, peer = (wavefront(p, d, s + phase, stop) for p, d, s in (
            (position, leaving, path), (theirs, heading, rays.opd)))  # fmt: skip
        np.testing.assert_allclose(mine, peer, rtol=0, atol=20.0 * TOLERANCE)
        assert 1e-9 < np.std(mine) < 50e-9
        compared += len(path)
    assert compared == len(FIELDS) * RAYS >= 10_000
