"""Colours of cameras with lenses against batoid, optiland and NumPy: lateral and axial colour, MTF, point images."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.polynomial import chebyshev

from optics.numerics.quadrature import disk
from scenes.lens.batoid_reader import read_batoid
from scenes.models.camera_model import CameraModel, field_direction
from scenes.models.camera_sharpness import FieldBeams, FocalPlane
from tests.oracles.peers import LENSES
from tests.scenes.lens.colour_cameras import KINDS, colour_camera
from tests.tiers import quick
from twin.camera.camera_optics import CameraOptics
from twin.camera.colour import FOCUS_RINGS, axial_colour, lateral_colour, spectral_mtfs

pytestmark = pytest.mark.oracle
FIELDS = [(0.0, 0.0), (1.0, 0.0), (0.6, -1.0)]
COLOURS = np.array([486.1327e-9, 540e-9, 656.2725e-9])
SAMPLES = 300
"""Across the pupil of the longest wavelength."""
DEGREE = 10
"""Of the polynomials through batoid's rays over the pupil."""


def traced(model: CameraModel, peer: Any, field: tuple[float, float], stop: np.ndarray, wavelength: float) -> Any:
    """A peer's rays of a field through points (N, 2) of the stop in units of its radius, in the prescription frame.

    The stop is the first surface, so no aiming is needed: rays start before the points where they meet it.
    """
    spec = model.spec
    assert spec.stop == model.mirrors[0]
    direction = field_direction(spec, field[0] * spec.field.x, field[1] * spec.field.y)
    x, y = (model.apertures[spec.stop].bounds[1] * stop).T
    met = np.stack([x, y, model.surfaces[spec.stop].sag(x, y)], axis=-1) + model.vertex(spec.stop)
    # a plane wavefront a metre before the vertex
    way = 1.0 + (met - model.vertex(spec.stop)) @ direction
    return peer(met - way[:, None] * direction, direction, wavelength)


CASES = sorted(product(KINDS, LENSES), key=lambda case: case not in list(zip(KINDS, LENSES, strict=False)))
"""Every lens by every program, those first that have each once."""


@pytest.fixture(scope="module", params=quick(3, [pytest.param(case) for case in CASES]), ids="-".join)
def case(request: pytest.FixtureRequest, backend) -> tuple[CameraOptics, Any]:
    kind, peer = request.param
    if peer != "numpy":
        pytest.importorskip(peer)
    optics = CameraOptics.alone(colour_camera(kind), backend)
    return optics, LENSES[peer](optics.model)


def test_lateral_colour_of_batoids_chief_rays(case) -> None:
    optics, peer = case
    model, middle, reference = optics.model, np.zeros((1, 2)), optics.model.spec.wavelength
    own = lateral_colour(optics, FIELDS, COLOURS, reference)
    for f, field in enumerate(FIELDS):
        start = traced(model, peer, field, middle, reference).r[0, :2]
        for k, colour in enumerate(COLOURS):
            place = traced(model, peer, field, middle, colour).r[0, :2]
            np.testing.assert_allclose(own[f, k], place - start, rtol=0.0, atol=1e-14)
    assert np.max(np.abs(own[1:])) > 1e-10  # there is some


def test_axial_colour_of_batoids_beams(case, backend) -> None:
    """Through the same search for the best plane, and against the defocus that is left on it by Zernike terms."""
    optics, peer = case
    model, nodes = optics.model, disk(FOCUS_RINGS)
    stop = np.concatenate([np.zeros((1, 2)), np.stack([nodes.x, nodes.y], axis=-1)])
    own = axial_colour(optics, FIELDS, COLOURS)
    plane = FocalPlane.of(model.spec)
    for f, field in enumerate(FIELDS):
        for k, colour in enumerate(COLOURS):
            beams = FieldBeams.trace(model, backend, (field,), FOCUS_RINGS, wavelength=colour)
            rays = traced(model, peer, field, stop, colour)
            theirs = replace(beams, position=rays.r[None], direction=_unit(rays.v)[None], path=rays.t[None])
            np.testing.assert_allclose(beams.position, theirs.position, rtol=0.0, atol=1e-13)
            downstream = np.sign(rays.v[0, 2])
            there = theirs.best_plane()
            assert own[f, k] == pytest.approx(downstream * (there.z - plane.z), abs=1e-10)
            # no other defocus than what the least mean square leaves to spherical aberration: none to first order
            left = theirs.wavefronts(there)[0]
            reach = 1e-6
            less, more = (theirs.errors(FocalPlane(there.z + dz, there.tilt))[0] for dz in (-reach, reach))
            assert more == pytest.approx(less, rel=1e-4)
            assert less >= float(np.sqrt(nodes.share @ left**2)) * (1.0 - 1e-12)
    assert np.ptp(own[0]) > 1e-6


def test_the_glass_of_batoids_lsst_comes_along() -> None:
    batoid = pytest.importorskip("batoid")
    lens = read_batoid(Path(batoid.__file__).parent / "data/LSST/LSST_r.yaml", 620e-9)
    face = batoid.Optic.fromYaml("LSST_r.yaml")["L1_entrance"]
    own = next(surface for surface in lens.surfaces if surface.name == "L1_entrance")
    for wavelength in (450e-9, 620e-9, 900e-9):
        assert lens.glasses[own.glass](wavelength) == pytest.approx(face.outMedium.getN(wavelength), rel=1e-15)


@pytest.mark.second
@pytest.mark.parametrize("case", CASES[:3], indirect=True, ids="-".join)
def test_mtf_over_the_light_of_batoids_wavefronts(case, backend) -> None:
    """Each wavelength's pupil on a grid of direction cosines with its true edge, shifted against itself and summed."""
    optics, peer = case
    model, spectrum = optics.model, optics.model.spec.spectrum
    colours, weights = spectrum.rule(3)
    mtfs = spectral_mtfs(optics, FIELDS, spectrum)
    aperture = 0.61 * model.spec.wavelength / optics.spot().airy
    step = 2.0 * aperture / (float(np.max(colours)) * SAMPLES)  # of the frequency, cycles/m
    order = np.arange(0, SAMPLES, 20)
    blurred = 0.0
    for f, field in enumerate(FIELDS):
        place = traced(model, peer, field, np.zeros((1, 2)), model.spec.wavelength).r[0]
        total = np.zeros((2, len(order)), complex)
        for colour, weight in zip(colours, weights, strict=True):
            pupil = _pupil(model, peer, field, colour, place, colour * step)
            power = np.sum(np.abs(pupil) ** 2)
            for direction in range(2):
                turned = pupil.T if direction == 0 else pupil
                for k, shift in enumerate(order):
                    overlap = np.sum(turned[shift:] * np.conj(turned[: len(turned) - shift]))
                    total[direction, k] += weight * overlap / power
        ours = np.array([np.interp(order * step, mtfs[f].frequency, row) for row in mtfs[f].values])
        exact = optics.mtfs([field], order * step, colours, weights)[0]
        within = order * step <= mtfs[f].frequency[-1]
        np.testing.assert_allclose(ours[:, within], exact.values[:, within], atol=2e-3)  # but for the straight lines
        np.testing.assert_allclose(exact.values, np.abs(total), rtol=0.0, atol=1e-3)
        blurred = max(blurred, float(np.max(exact.limit - exact.values)))
    assert blurred > 0.02


def _pupil(
    model: CameraModel, peer: Any, field: tuple[float, float], colour: float, place: np.ndarray, step: float
) -> np.ndarray:
    """The complex pupil of batoid's rays about a place of the image over direction cosines (v rows, u columns)."""
    nodes = disk(12)
    rays = traced(model, peer, field, np.stack([nodes.x, nodes.y], axis=-1), colour)
    cosine = _unit(rays.v)
    eikonal = rays.t + np.sum((place - rays.r) * cosine, axis=-1)
    eikonal = eikonal - np.mean(eikonal)
    centre = nodes.share @ cosine[:, :2]
    reach = 1.02 * np.max(np.abs(cosine[:, :2] - centre))
    local = (cosine[:, :2] - centre) / reach
    orders = np.add.outer(np.arange(DEGREE + 1), np.arange(DEGREE + 1)) <= DEGREE
    basis = chebyshev.chebvander2d(*local.T, [DEGREE, DEGREE])[:, orders.ravel()]
    wanted = np.stack([nodes.x, nodes.y, eikonal], axis=-1)
    found = np.linalg.lstsq(basis, wanted, rcond=None)[0]
    np.testing.assert_allclose(basis @ found[:, 2], eikonal, rtol=0.0, atol=1e-4 * colour)
    axis = step * np.arange(-int(1.1 * reach / step) - 1, int(1.1 * reach / step) + 2) / reach
    tables = np.zeros((3, DEGREE + 1, DEGREE + 1))
    tables[:, orders] = found.T
    # rows along v, columns along u
    x, y, path = (chebyshev.chebgrid2d(axis, axis, table).T for table in tables)
    (x_v, x_u), (y_v, y_u) = np.gradient(x), np.gradient(y)
    light = np.where(np.hypot(x, y) <= 1.0, np.sqrt(np.abs(x_u * y_v - x_v * y_u)), 0.0)
    return np.asarray(light * np.exp(2j * np.pi / colour * path))


def _unit(velocity: np.ndarray) -> np.ndarray:
    return np.asarray(velocity / np.linalg.norm(velocity, axis=-1, keepdims=True))
