"""Images of targets against closed forms, against brute force, and the makers of targets."""

import numpy as np
import pytest
from scipy.special import j0, j1, struve

from optics.geometry.vector_shape import HalfPlane
from optics.numerics import quadrature
from optics.targets.target_image import EdgeProfile, target_image
from optics.targets.target_shapes import Target, bar_group, pinhole, siemens_star, slanted_edge
from optics.waves.diffraction import Grid, airy

WAVELENGTH, F_NUMBER, PITCH = 650e-9, 9.2, 7e-6
CUTOFF = 1.0 / (WAVELENGTH * F_NUMBER)
COARSE, COARSE_CUTOFF = 28e-6, 241e3
FAINT = 1e-6  # what the periods' copies may add, see target_image
TILT = np.radians(5.0)


def diffraction(cutoff: float = CUTOFF, pitch: float = 0.0, shift: tuple[float, float] = (0.0, 0.0)):
    """Clear circular pupil, square pixel, image shift."""

    def transfer(fx, fy):
        q = np.minimum(np.hypot(fx, fy) / cutoff, 1.0)
        mtf = 2.0 / np.pi * (np.arccos(q) - q * np.sqrt(1.0 - q * q))
        phase = np.exp(-2j * np.pi * (fx * shift[0] + fy * shift[1]))
        return mtf * np.sinc(fx * pitch) * np.sinc(fy * pitch) * phase

    return transfer


def centred(count: int, step: float) -> Grid:
    return Grid(-0.5 * (count - 1) * step, step, count)


# edge profiles


def test_edge_of_a_clear_circular_pupil() -> None:
    """Its line spread is fc H1(2 pi fc d)/(pi fc d)^2 with Struve's H1; its tail falls as 2/(pi^3 fc d)."""
    reach = 400e-6
    profile = EdgeProfile.build(diffraction(), np.array([1.0, 0.0]), CUTOFF, reach)
    node, weight = np.polynomial.legendre.leggauss(400)
    for d in (1e-7, 3e-6, 17e-6, 120e-6, reach):
        z = np.pi * CUTOFF * 0.5 * d * (node + 1.0)
        half = 0.5 * d * np.sum(weight * CUTOFF * struve(1, 2.0 * z) / z**2)
        np.testing.assert_allclose(profile(np.array([d, -d])), [0.5 + half, 0.5 - half], rtol=0, atol=1e-8)
    assert 1.0 - profile(reach) == pytest.approx(2.0 / (np.pi**3 * CUTOFF * reach), rel=0.01)


def test_slanted_edge_runs_and_brightens_as_said() -> None:
    x = centred(33, PITCH)
    upright = target_image(slanted_edge(TILT, "y"), diffraction(), CUTOFF, x, x)
    assert upright[16, 0] < 0.05 < 0.95 < upright[16, -1]
    lying = target_image(slanted_edge(TILT, "x"), diffraction(), CUTOFF, x, x)
    assert lying[0, 16] < 0.05 < 0.95 < lying[-1, 16]
    # turned from +x toward +y: the upright edge leans toward -x at larger y
    rows = np.arange(33) - 16.0
    place = [np.interp(0.5, row, rows) for row in upright]
    assert np.polyfit(rows, place, 1)[0] == pytest.approx(
        -np.tan(TILT), rel=0.05
    )  # crossings between pixels are taken on straight lines


def test_profile_is_reused_for_other_offsets() -> None:
    x = centred(16, PITCH)
    normal = np.array([np.cos(TILT), np.sin(TILT)])
    profile = EdgeProfile.build(diffraction(pitch=PITCH), normal, CUTOFF, 2e-4)
    for offset in (0.0, 2.7e-6):
        edge = HalfPlane((offset, 0.0), normal)
        want = target_image(Target(0.0, ((1.0, edge),)), diffraction(pitch=PITCH), CUTOFF, x, x)
        np.testing.assert_allclose(profile.image(edge, x, x), want, rtol=0, atol=1e-8)
    with pytest.raises(ValueError, match="normal"):
        profile.image(HalfPlane((0.0, 0.0), (1.0, 0.0)), x, x)
    with pytest.raises(ValueError, match="the edge profile extends to"):
        profile.image(HalfPlane((1e-3, 0.0), normal), x, x)


# finite shapes


def test_pinhole_is_the_airy_pattern_spread_over_a_disk() -> None:
    diameter, place = 20e-6, np.array([1.3e-6, -2.1e-6])
    x, y = centred(24, 3e-6), centred(20, 3e-6)
    target = pinhole(diameter).mapped(lambda points: points + place)
    got = target_image(target, diffraction(), CUTOFF, x, y)
    nodes = quadrature.disk(24, 96)
    u = x.points()[:, None] - place[0] - 0.5 * diameter * nodes.x
    v = y.points()[:, None] - place[1] - 0.5 * diameter * nodes.y
    peak = 0.25 * np.pi * CUTOFF**2
    spot = airy(np.hypot(u[None, :], v[:, None]), WAVELENGTH, F_NUMBER)
    want = spot @ (peak * 0.25 * diameter**2 * nodes.weight)
    np.testing.assert_allclose(got, want, rtol=0, atol=FAINT)
    assert want.max() > 0.8


@pytest.mark.parametrize("radius", [1e-5, 1e-4, 4e-4])
def test_middle_of_a_disk_is_the_encircled_energy(radius: float) -> None:
    """1 - J0^2 - J1^2 (Rayleigh), also for a disk that reaches far beyond the window."""
    x = centred(65, PITCH)
    z = np.pi * radius * CUTOFF
    middle = target_image(pinhole(2.0 * radius), diffraction(), CUTOFF, x, x)[32, 32]
    assert middle == pytest.approx(1.0 - j0(z) ** 2 - j1(z) ** 2, abs=FAINT)


@pytest.mark.second
def test_shift_of_the_target_is_a_phase_of_the_transfer_function() -> None:
    shift = (2.3e-6, -1.7e-6)
    x, y = centred(28, PITCH), centred(24, PITCH)
    for target in (siemens_star(6, 7e-5), slanted_edge(TILT), pinhole(5e-5)):
        moved = target.mapped(lambda points: points + shift)
        plain = target_image(moved, diffraction(pitch=PITCH), CUTOFF, x, y)
        phased = target_image(target, diffraction(pitch=PITCH, shift=shift), CUTOFF, x, y)
        # rounding; an edge profile interpolates at other places
        np.testing.assert_allclose(plain, phased, rtol=0, atol=1e-8)
        assert np.max(np.abs(plain - target_image(target, diffraction(pitch=PITCH), CUTOFF, x, y))) > 0.01


def test_levels_add() -> None:
    """Babinet: a dark disk on bright is bright less a bright disk; an edge and a disk beside it sum."""
    x = centred(24, PITCH)
    transfer = diffraction(pitch=PITCH)
    (_, disk), (_, edge) = pinhole(4e-5).parts[0], slanted_edge(TILT).parts[0]
    alone = target_image(Target(0.0, ((1.0, disk),)), transfer, CUTOFF, x, x)
    np.testing.assert_allclose(
        target_image(Target(0.9, ((-0.7, disk),)), transfer, CUTOFF, x, x), 0.9 - 0.7 * alone, rtol=0, atol=1e-13
    )
    away = edge.mapped(lambda points: points + np.array([4e-5, 0.0]))
    both = target_image(Target(0.1, ((0.5, away), (0.2, disk))), transfer, CUTOFF, x, x)
    lone = target_image(Target(0.0, ((1.0, away),)), transfer, CUTOFF, x, x)
    np.testing.assert_allclose(both, 0.1 + 0.5 * lone + 0.2 * alone, rtol=0, atol=1e-13)


@pytest.mark.second
@pytest.mark.parametrize(
    "target", [siemens_star(12, 2e-4, 1e-5), pinhole(4.4e-4), pinhole(9e-4)], ids=["star", "disk", "huge"]
)
def test_default_guard(target: Target) -> None:
    """It agrees with copies 3 mm away to the stated error."""
    x = centred(64, PITCH)
    got = target_image(target, diffraction(pitch=PITCH), CUTOFF, x, x)
    want = target_image(target, diffraction(pitch=PITCH), CUTOFF, x, x, guard=3e-3)
    np.testing.assert_allclose(got, want, rtol=0, atol=FAINT)


# the makers


def test_bar_group_has_half_of_its_period_bright() -> None:
    target = bar_group(50e3, 4, 1e-4)
    edges = np.array([shape.bounds for _, shape in target.parts])
    np.testing.assert_allclose(edges[:, 1] - edges[:, 0], 10e-6, rtol=1e-12)
    np.testing.assert_allclose(np.diff(edges[:, 0]), 20e-6, rtol=1e-12)
    np.testing.assert_allclose([np.mean(edges[:, :2]), *edges[0, 2:]], [0.0, -5e-5, 5e-5], atol=1e-18)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: image_of(pinhole(1e-3), guard=1e-4), "enlarge the guard"),
        (lambda: image_of(pinhole(1e-5), cutoff=0.0), "cutoff must be positive"),
        (lambda: image_of(pinhole(1e-5), guard=0.0), "guard must be positive"),
        (lambda: image_of(pinhole(1e-5), guard=np.inf), "guard must be positive"),
        (lambda: image_of(pinhole(1e-5), transfer=lambda fx, fy: np.nan * fx), "finite number"),
    ],
)
def test_bad_input_is_refused(make, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


def image_of(target: Target, cutoff: float = CUTOFF, guard: float | None = None, transfer=None) -> np.ndarray:
    x = centred(8, PITCH)
    return target_image(target, transfer or diffraction(), cutoff, x, x, guard)
