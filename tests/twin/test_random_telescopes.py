"""Telescopes drawn at random: numbers within bounds and the MTF of a dense raster of traced rays, or a refusal."""

import numpy as np
import pytest

from optics.numerics.physical_error import PhysicalError
from scenes.specs.camera import CameraSpec
from scenes.yaml.errors import InputError
from scenes.yaml.spec import validate
from scenes.yaml.yaml_file import parse_yaml
from tests.scenes.test_camera_edges import dense_mtf
from tests.tiers import quick
from twin.camera.camera_optics import CameraOptics

FEW, MANY = 10, 200
MOST_REFUSED = 0.02
CELLS = 400
APART = 4e-3
"""A raster has no parts of cells: vanes of a few of them are right to a tenth of one."""


def edges(rng: np.random.Generator, radius: float) -> list[str]:
    """What stands before the pupil: a disk on or off the axis, vanes, a clear circle that cuts the rim."""
    out = [f"{{blocks: circle, radius: {rng.uniform(0.15, 0.45) * radius:.6f} m, centre: "
           f"[{rng.normal(0.0, 0.02) * radius:.6f} m, {rng.normal(0.0, 0.02) * radius:.6f} m]}}"]  # fmt: skip
    first, count = rng.uniform(0.0, 360.0), rng.integers(0, 5)
    for k in range(count):
        turn = (first + k * 360.0 / count) % 360.0
        out.append(f"{{blocks: ray, width: {rng.uniform(0.01, 0.04) * radius:.6f} m, turn: {turn:.4f} deg}}")
    if rng.uniform() < 0.3:
        out.append(f"{{clear: circle, radius: {rng.uniform(0.9, 1.0) * radius:.6f} m, centre: "
                   f"[{rng.normal(0.0, 0.05) * radius:.6f} m, 0 m]}}")  # fmt: skip
    if rng.uniform() < 0.3:
        out.append(f"{{blocks: rectangle, half: [{rng.uniform(0.05, 0.2) * radius:.6f} m, "
                   f"{rng.uniform(0.05, 0.2) * radius:.6f} m], centre: [{rng.uniform(0.0, 0.8) * radius:.6f} m, 0 m], "
                   f"turn: {rng.uniform(0.0, 90.0):.4f} deg}}")  # fmt: skip
    return out


def telescope(seed: int) -> str:
    """A two-mirror telescope between a Cassegrain and an aplanat, some behind a window of glass."""
    rng = np.random.default_rng(seed)
    diameter, ratio, m, k = rng.uniform(0.1, 1.5), rng.uniform(2.0, 4.0), rng.uniform(2.5, 5.0), rng.uniform(0.2, 0.35)
    f1 = ratio * diameter
    focal, away = m * f1, (1.0 - k) * f1
    beta = m * k - (1.0 - k)
    aplanat = rng.uniform(0.0, 1.0)
    k1 = -1.0 - aplanat * 2.0 * (1.0 + beta) / (m**2 * (m - beta))
    k2 = -(((m + 1.0) / (m - 1.0)) ** 2) - aplanat * 2.0 * m * (m + 1.0) / ((m - beta) * (m - 1.0) ** 3)
    r2 = 2.0 * m * k * f1 / (m - 1.0)
    half = np.degrees(rng.uniform(2e-4, 8e-4))
    window = ""
    if rng.uniform() < 0.3:
        index, z = rng.uniform(1.4, 1.8), -away - 0.3 * f1
        window = f"""
  L1: {{z: {z:.9f} m, radius: flat, light: refracts, index: {index:.6f}}}
  L2: {{z: {z + 0.05 * diameter:.9f} m, radius: flat, light: refracts, index: 1}}"""
    defocus = rng.normal(0.0, 0.3) * 2.0 * 650e-9 * (m * ratio) ** 2
    cut = "\n".join(f"      - {edge}" for edge in edges(rng, 0.5 * diameter))
    return f"""
name: drawn
focal_length: {focal:.6f} m
entrance_pupil: {diameter:.9f} m
field_bias: 0 deg
field: {{x: {half:.9f} deg, y: {half:.9f} deg}}
wavelength: 650 nm
stop: M1
mirrors:{window}
  P1:
    z: {-away - 0.05 * f1:.9f} m
    radius: flat
    light: passes
    edges:
{cut}
  M1: {{z: 0 m, radius: {-2.0 * f1:.9f} m, conic: {k1:.12f}}}
  M2: {{z: {-away:.9f} m, radius: {-r2:.9f} m, conic: {k2:.12f}}}
image: {{z: {beta * f1 + defocus:.9f} m}}
line: {{pixels: 1000, pitch: 7 um}}
"""


def is_right(backend, seed: int) -> bool:
    """Hold one telescope to its raster; False where it is refused with a cause."""
    rng = np.random.default_rng(seed + 10_000)
    field = (float(rng.uniform(-1.0, 1.0)), float(rng.uniform(-1.0, 1.0)))
    try:
        optics = CameraOptics.alone(validate(CameraSpec, parse_yaml(telescope(seed))), backend)
        wave, spot = optics.wavefront(field, points=17), optics.spot(field)
        (pupil,) = optics.pupils([field])
        cutoff = float(np.max(pupil.cutoff(np.eye(2), wave.wavelength)))
        frequency = np.linspace(0.0, 0.9, 10) * cutoff
        mtf = optics.mtf(field, frequency)
    except (PhysicalError, InputError):
        return False
    np.testing.assert_allclose(
        mtf.values, dense_mtf(optics, field, frequency, CELLS), rtol=0, atol=APART, err_msg=str(seed)
    )
    assert 0.0 <= wave.vignetted <= 1.0
    assert 0.0 <= wave.strehl <= 1.0
    assert pupil.light == pytest.approx(1.0 - wave.vignetted, abs=5e-3)
    assert np.isfinite([wave.rms, spot.rms, spot.farthest]).all()
    assert spot.rms <= spot.farthest
    return True


@pytest.mark.parametrize("seed", quick(3, range(FEW)))
def test_a_telescope_drawn_at_random(backend, seed: int) -> None:
    assert is_right(backend, seed)


@pytest.mark.slow
def test_two_hundred_telescopes_drawn_at_random(backend) -> None:
    refused = sum(not is_right(backend, seed) for seed in range(FEW, MANY))
    assert refused <= MOST_REFUSED * MANY
