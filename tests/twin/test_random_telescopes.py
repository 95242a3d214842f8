"""Telescopes drawn at random: numbers within bounds and the MTF of a dense raster of other rays, or a refusal.

The raster shares neither the rays nor the quadrature with the product: ``tests.own_trace`` traces them by NumPy, evenly
in direction cosines at the image, and the transfer function is the autocorrelation of what comes through.
"""

import numpy as np
import pytest

from optics.numerics.array_math import PhysicalError
from scenes.yaml.errors import InputError
from tests.oracles.pupil_raster import raster_of
from tests.own_trace import OwnCamera
from tests.random_telescopes import KINDS, telescope
from twin.camera.camera_optics import CameraOptics

FEW = len(KINDS)
CELLS = 256
APART = 1e-3
"""What an MTF is to be right to; the raster's own error, of cells with their shares at edges, is some 2e-4."""

SHIFTS = 12


def deviation(backend, seed: int) -> float | str:
    """By how much an MTF differs from its raster's, or the cause of a refusal."""
    rng = np.random.default_rng(seed + 10_000)
    field = (float(rng.uniform(-1.0, 1.0)), float(rng.uniform(-1.0, 1.0)))
    spec = telescope(seed)
    try:
        optics = CameraOptics.alone(spec, backend)
        wave, spot = optics.wavefront(field, points=17), optics.spot(field)
        (pupil,) = optics.pupils([field])
    except (PhysicalError, InputError) as error:
        return " ".join(str(error).split())
    own = OwnCamera(spec, optics.model.apertures[spec.stop].radius)
    reach = 0.5 * 1.1 * spec.entrance_pupil
    grid = raster_of(own.beam(field[0] * spec.field.x, field[1] * spec.field.y, reach), spec.wavelength, CELLS)
    shifts = grid.shifts(SHIFTS)
    mtf = optics.mtf(field, shifts * grid.step / grid.wavelength)
    assert 0.0 <= wave.vignetted <= 1.0, seed
    assert 0.0 <= wave.strehl <= 1.0, seed
    assert pupil.light == pytest.approx(1.0 - wave.vignetted, abs=5e-3), seed
    assert np.isfinite([wave.rms, spot.rms, spot.farthest]).all(), seed
    assert spot.rms <= spot.farthest, seed
    # piston and tilt out, over the light: what a raster has
    lit = grid.share > 0.5
    u, v = np.meshgrid(*2 * [np.arange(CELLS) / CELLS])
    design = np.column_stack([np.ones(lit.sum()), u[lit], v[lit]])
    weight = np.sqrt(grid.share[lit]) * grid.amplitude[lit]
    path = grid.path[lit] / grid.wavelength
    left = path - design @ np.linalg.lstsq(design * weight[:, None], path * weight, rcond=None)[0]
    rms = float(np.sqrt(np.sum(weight**2 * left**2) / np.sum(weight**2)))
    assert wave.rms == pytest.approx(rms, rel=0.02, abs=2e-3), seed
    return float(max(np.max(np.abs(mtf.values - grid.mtf(shifts))), np.max(np.abs(mtf.limit - grid.mtf(shifts, True)))))


@pytest.mark.second
@pytest.mark.parametrize("seed", range(FEW))
def test_a_telescope_drawn_at_random(backend, seed: int) -> None:
    found = deviation(backend, seed)
    assert not isinstance(found, str), found
    assert found < APART
