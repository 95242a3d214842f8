"""Colours of cameras with lenses against batoid, optiland and NumPy: lateral and axial colour, MTF, point images."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from optics.numerics.quadrature import disk
from scenes.lens.batoid_reader import read_batoid
from scenes.models.camera_model import CameraModel, field_direction
from scenes.models.camera_sharpness import FieldBeams, FocalPlane
from tests.oracles.peers import LENSES
from tests.scenes.lens.colour_cameras import KINDS, colour_camera
from tests.tiers import quick
from twin.camera.camera_optics import CameraOptics
from twin.camera.colour import FOCUS_RINGS, axial_colour, lateral_colour

pytestmark = pytest.mark.oracle
FIELDS = [(0.0, 0.0), (1.0, 0.0), (0.6, -1.0)]
COLOURS = np.array([486.1327e-9, 540e-9, 656.2725e-9])


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


@pytest.fixture(scope="module", params=quick(1, [pytest.param(case) for case in CASES]), ids="-".join)
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


@pytest.mark.second
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


def _unit(velocity: np.ndarray) -> np.ndarray:
    return np.asarray(velocity / np.linalg.norm(velocity, axis=-1, keepdims=True))
