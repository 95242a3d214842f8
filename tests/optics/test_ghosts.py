"""Ghosts of windows and lenses: analytic focus, size and strength, and the same sequence of surfaces in optiland."""

from __future__ import annotations

import warnings
from itertools import combinations
from typing import Any

import numpy as np
import pytest

import optics
from optics import Camera, OpticalSurface
from optics.camera.ghosts import PUPIL
from tests.oracles.peers import optiland_rays

WAVE = 550e-9
MIRROR = OpticalSurface(-4.0, -1.8, -1.0, "mirror", diameter=0.1)
DOUBLET = [  # cemented, and a filter of another glass before the image
    OpticalSurface(0.0615, 0.006, material=1.5168, diameter=0.02),
    OpticalSurface(-0.0446, 0.0025, 0.3, material=1.6727),
    OpticalSurface(-0.1299, 0.085),
    OpticalSurface(thickness=0.002, material=1.45),
    OpticalSurface(thickness=0.008),
]


def fresnel(n: float, m: float = 1.0) -> float:
    """Reflectance at normal incidence."""
    return ((n - m) / (n + m)) ** 2


@pytest.mark.parametrize("index", [1.33, 1.5, 2.4])
def test_a_window_in_a_converging_beam_makes_the_ghost_of_its_textbook(index: float) -> None:
    """2 t / n before the image, as wide as the cone there, of strength R^2; the beam's F/20 changes R by 1e-7."""
    thickness = 0.006
    window = [OpticalSurface(thickness=-thickness, material=index), OpticalSurface(thickness=-0.2)]
    camera = Camera([MIRROR, *window], WAVE).refocused()
    (ghost,) = optics.ghosts(camera, detector=0.0)
    assert (ghost.back, ghost.forward) == ("s2", "s1")
    assert ghost.focus == pytest.approx(-2.0 * thickness / index, rel=1e-9)
    assert ghost.energy == pytest.approx(fresnel(index) ** 2, rel=1e-5)
    # a paraboloid's cone: tan u = y / (f - y^2 / 4 f), in glass by Snell's law; the plate's spherical aberration adds
    tangent = 0.05 / (2.0 - 0.05**2 / 8.0)
    sine = tangent / np.hypot(1.0, tangent) / index
    inside = sine / np.sqrt(1.0 - sine**2)
    assert ghost.diameter == pytest.approx(2.0 * thickness * (3.0 * inside - tangent / index), rel=1e-7)
    airy = 1.22 * WAVE / np.sin(np.arctan(tangent))
    assert ghost.irradiance == pytest.approx(ghost.energy * (airy / ghost.diameter) ** 2, rel=1e-4)


def test_a_thin_lens_makes_the_ghost_of_its_formula() -> None:
    """1 / f_ghost = (3 n - 1) / (n - 1) / f for two reflections inside a thin lens, here 1e-7 f thick."""
    n, f = 1.6, 0.2
    radius = 2.0 * (n - 1.0) * f
    lens = [OpticalSurface(radius, 2e-8, material=n, diameter=1e-3), OpticalSurface(-radius, f)]
    (ghost,) = optics.ghosts(Camera(lens, WAVE), detector=0.0)
    assert ghost.focus == pytest.approx((n - 1.0) / (3.0 * n - 1.0) * f - f, rel=1e-5)


def by_matrices(camera: Camera, back: int, forward: int, detector: float) -> tuple[float, float]:
    """Return focus from the image plane and strength of a path with two bounces: paraxial (y, n u) and Fresnel.

    Light toward -z has a negative index; a reflection at vertex curvature c has the power -2 n c.
    """
    last, image = len(camera.surfaces), camera.vertices[-1]
    power = [0.0 if np.isinf(s.radius) else 1.0 / s.radius for s in camera.surfaces] + [0.0]
    index = [1.0, *camera.indices]  # before surface k, and behind the last
    share = [fresnel(index[k + 1], index[k]) for k in range(last)] + [detector]
    ray, here, strength, n = np.array([1.0, 0.0]), camera.vertices[0], 1.0, 1.0
    there_and_back = [*range(back), back, *range(back - 1, forward, -1), forward, *range(forward + 1, last)]
    passed: set[int] = set()
    for step, k in enumerate(there_and_back):
        ray = np.array([ray[0] + (camera.vertices[k] - here) / n * ray[1], ray[1]])
        here, turns = camera.vertices[k], step in (back, 2 * back - forward)
        if turns:
            after, strength = -n, strength * share[k]
        else:
            after = index[k + 1] if n > 0.0 else -index[k]
            strength *= 1.0 - share[k] if k in passed else 1.0  # the image's light passes it once as well
            passed.add(k)
        ray, n = np.array([ray[0], ray[1] - (after - n) * power[k] * ray[0]]), after
    return float(here - n * ray[0] / ray[1] - image), strength


def test_every_pair_of_a_singlet_and_a_window_has_the_focus_and_strength_of_its_matrices() -> None:
    """Four surfaces and the detector, at F/100, where Fresnel's formulas at the rays' angles differ by 1e-4."""
    lens = [OpticalSurface(0.6, 0.006, material=1.5168, diameter=0.005), OpticalSurface(-0.5, 0.3)]
    window = [OpticalSurface(thickness=0.004, material=1.7), OpticalSurface(thickness=0.05)]
    camera = Camera([*lens, *window], WAVE).refocused()
    found = {(g.back, g.forward): g for g in optics.ghosts(camera, detector=0.2)}
    last, compared = len(camera.surfaces), 0
    for forward, back in combinations(range(last + 1), 2):
        ghost = found["image" if back == last else f"s{back}", f"s{forward}"]
        focus, strength = by_matrices(camera, back, forward, 0.2)
        assert ghost.focus == pytest.approx(focus, rel=1e-6)
        if forward:  # the lens's front, the stop, cuts what comes back to it
            assert ghost.energy == pytest.approx(strength, rel=1e-3)
            compared += 1
    assert compared == 6


def test_strength_of_coatings_and_of_the_detector() -> None:
    """By hand: two reflections, and two more passes through every face between them."""
    window = [OpticalSurface(thickness=-0.006, material=1.5), OpticalSurface(thickness=-0.2)]
    camera = Camera([MIRROR, *window], WAVE).refocused()
    bare = fresnel(1.5)
    found = {(g.back, g.forward): g.energy for g in optics.ghosts(camera, detector=0.5, coatings={1: 0.01})}
    expected = {("s2", "s1"): 0.01 * bare, ("image", "s2"): 0.5 * bare, ("image", "s1"): 0.5 * 0.01 * (1.0 - bare) ** 2}
    assert found == pytest.approx(expected, rel=1e-5)
    strongest = [g.irradiance for g in optics.ghosts(camera)]
    assert strongest == sorted(strongest, reverse=True)
    assert optics.ghosts(Camera([MIRROR], WAVE)) == ()
    for wrong, message in (
        ({"detector": 1.5}, "reflectance of image must be from 0 to 1"),
        ({"coatings": {0: 0.1}}, "'s0', which is no refracting surface"),
    ):
        with pytest.raises(ValueError, match=message):
            optics.ghosts(camera, **wrong)


def test_a_diaphragm_on_the_third_passage_takes_its_share() -> None:
    """Light of the detector and a thin window is three times as wide halfway between them as the image's light."""
    window = OpticalSurface(thickness=-1e-6, material=1.5)

    def ghost(diameter: float) -> optics.Ghost:
        back = [OpticalSurface(thickness=-0.1), OpticalSurface(thickness=-0.1, diameter=diameter)]
        found = optics.ghosts(Camera([MIRROR, window, *back], WAVE).refocused())
        return next(g for g in found if (g.back, g.forward) == ("image", "s2"))

    beam = 0.1 / 20.0
    whole, cut = ghost(3.1 * beam), ghost(1.5 * beam)
    assert cut.energy / whole.energy == pytest.approx(0.25, abs=0.01)  # 400 rays count it to 1 %
    assert cut.diameter / whole.diameter == pytest.approx(0.5, abs=0.02)


def by_optiland(camera: Camera, steps: list[tuple[int, int]], rays: tuple[np.ndarray, np.ndarray]) -> Any:
    """Trace rays along steps (surface, index in the list of media behind it, or -1 for a reflection), in optiland."""
    from optiland.materials import IdealMaterial
    from optiland.optic import Optic

    optic, media = Optic(), [1.0, *camera.indices]
    optic.surfaces.add(index=0, z=-np.inf)
    for i, (k, behind) in enumerate(steps, start=1):
        surface = camera.surfaces[k] if k < len(camera.surfaces) else OpticalSurface()
        material = "mirror" if behind < 0 else IdealMaterial(media[behind])
        optic.surfaces.add(
            index=i, z=float(camera.vertices[k]), radius=surface.radius, conic=surface.conic, material=material,
            is_stop=i == 1,
        )  # fmt: skip
    optic.surfaces.add(index=len(steps) + 1, z=float(camera.vertices[-1]))
    optic.wavelengths.add(1e6 * WAVE, is_primary=True)
    sent = optiland_rays(*rays, 1e6 * WAVE)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        optic.surfaces.trace(sent)
    return sent


@pytest.mark.second
@pytest.mark.oracle
def test_ghosts_of_a_doublet_and_a_filter_are_those_of_optiland() -> None:
    """Every path as a sequence of surfaces with explicit mirrors: focus of rays near the axis, and spot."""
    pytest.importorskip("optiland")
    camera = Camera(DOUBLET, WAVE).refocused()
    last = len(camera.surfaces)
    found = {(g.back, g.forward): g for g in optics.ghosts(camera)}
    rays = optics.launch_rays(camera, pupil=PUPIL)
    for i, j in combinations(range(last + 1), 2):
        steps = [(k, k + 1) for k in range(j)] + [(j, -1)] + [(k, k) for k in range(j - 1, i, -1)] + [(i, -1)]
        steps += [(k, k + 1) for k in range(i + 1, last)]
        sent = by_optiland(camera, steps, rays)
        x, y = np.asarray(sent.x), np.asarray(sent.y)
        name = ("image" if j == last else f"s{j}", f"s{i}")
        slope = np.asarray(sent.L)[1] / abs(np.asarray(sent.N)[1])
        assert found[name].focus == pytest.approx(-x[1] / slope, rel=1e-6, abs=1e-9)
        if i:  # the first lens, the stop, cuts what comes back to it
            assert found[name].diameter == pytest.approx(2.0 * np.hypot(x, y)[5:].max(), rel=1e-6)
    assert len(found) == 15
