"""The collimator: a target moved out of its focus (Newton), its wavefront in the pupil of a traced camera."""

import numpy as np
import pytest

from optics.geometry import zernike
from optics.geometry.tree import Motion
from optics.numerics import quadrature
from optics.numerics.backend import Backend
from optics.targets.collimator import Collimator, TooNarrowError
from optics.waves.pupil_stack import PupilFunction
from scenes.models.camera_model import ROOT, build_camera_under_test
from scenes.specs.camera_tests import CameraUnderTestSpec
from scenes.specs.load import load_camera
from tests.tiers import quick
from twin.targets.target_path import TargetPath

LONG = 20.0
RADIUS = 0.302
"""Just wider than gf7's beam, so that the wavefront's rms over the aperture is nearly that over the beam."""
MIDDLE, EDGE = np.array([[0.0, 0.0]]), np.array([[0.1, 0.01]])


class Bench:
    """gf7 as designed in front of collimators."""

    def __init__(self, backend: Backend) -> None:
        self.backend = backend
        self.test = build_camera_under_test(CameraUnderTestSpec(camera="gf7"), load_camera("gf7"), backend)

    def pupil(
        self, collimator: Collimator | None, place: np.ndarray = MIDDLE, shift: float = 0.0, detector: float = 0.0
    ) -> PupilFunction:
        """Pupil at a place, for a target moved by ``shift`` or a focal plane moved by ``detector`` along Z'."""
        path = TargetPath(self.test.assembly, ROOT, ROOT, self.test.model, self.backend, collimator)
        state = {f"{ROOT}/focal_plane": Motion(shift=(0.0, 0.0, detector))}
        direction = path.directions(place)
        return path.pupils(state, direction, path.positions(state, direction), shift)[0]


@pytest.fixture(scope="module")
def bench(backend) -> Bench:
    return Bench(backend)


def added(pupil: PupilFunction, without: PupilFunction) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Direction cosines (N, 2) of nodes of the pupil, their weights, and the path that was added, without its mean."""
    nodes = quadrature.disk(8)
    p = 0.999 * (nodes.x + 1j * nodes.y)
    u, v, _ = pupil.cosines(p)
    assert np.allclose(pupil.axes, without.axes, atol=1e-9)
    path = pupil.values(p)[0] - without.values(p)[0]
    return np.stack([u, v], axis=-1), nodes.weight, path - np.average(path, weights=nodes.weight)


def curvatures(pupil: PupilFunction, without: PupilFunction) -> tuple[float, float]:
    """Second derivatives of the added path along both axes of the image, metres."""
    cosines, weight, path = added(pupil, without)
    u, v = cosines.T
    design = np.stack([np.ones_like(u), u, v, 0.5 * u * u, u * v, 0.5 * v * v], axis=-1)
    terms = np.linalg.lstsq(design * np.sqrt(weight)[:, None], path * np.sqrt(weight), rcond=None)[0]
    return float(terms[3]), float(terms[5])


@pytest.mark.second
def test_a_moved_target_is_a_moved_detector(bench, gf7) -> None:
    """Curvature of the added wavefront against that of a detector moved along Z', axis by axis: s (f / F)^2 with the
    focal length of chief rays, which differ by 2.9% in this camera. Downstream image, so upstream detector.
    """
    shift, detector = 1e-3, 100e-6
    nominal = bench.pupil(Collimator(LONG, RADIUS))
    per_metre = np.array(curvatures(bench.pupil(None, detector=detector), bench.pupil(None))) / detector
    # image space is nearly telecentric, and a move along Z' has the same curvature in both directions
    assert per_metre[0] == pytest.approx(per_metre[1], rel=1e-3)
    by_target = np.array(curvatures(bench.pupil(Collimator(LONG, RADIUS), shift=shift), nominal))
    moved = -by_target / per_metre
    focal_length = np.abs(np.diag(gf7.first_order.scale[0]))
    np.testing.assert_allclose(focal_length, [5.5104, 5.6715], rtol=1e-4)
    # coma of the pupil: the beam's edge is 1e-3 off the first-order imaging of the pupil
    np.testing.assert_allclose(moved, shift * (focal_length / LONG) ** 2, rtol=2e-3)
    assert np.all(moved > 0.0)


@pytest.mark.second
@pytest.mark.parametrize("place", [MIDDLE, EDGE])
@pytest.mark.parametrize("term", quick(3, [2, 5, 8, 6, 7, 11]))
def test_the_wavefront_appears_in_the_pupil(bench, term: int, place: np.ndarray) -> None:
    """Sign, orientation and rms: the beam fills 0.99 of the aperture; a wave that is ahead has the shorter path.

    x of the aperture is the camera's Y. Light through +Y of a converging beam travels toward -Y at the image.
    """
    size = 10e-9
    pupil, without = (bench.pupil(Collimator(LONG, RADIUS, w), place) for w in ({term: size}, {}))
    cosines, weight, path = added(pupil, without)
    rms = float(np.sqrt(np.average(path**2, weights=weight)))
    # 0.3 / 0.302 to the power of the term's order, at most 4; the beam's outline is elliptical by 0.5%
    assert rms == pytest.approx(size, rel=0.05)
    ahead = zernike.zernike(term, *aperture_coordinates(cosines - pupil.centre, pupil))
    correlation = float(np.average(-path * ahead, weights=weight) / rms)
    assert correlation == pytest.approx(1.0, abs=0.01)


def aperture_coordinates(cosines: np.ndarray, pupil: PupilFunction) -> tuple[np.ndarray, np.ndarray]:
    """Place in the unit beam of rays by their direction at the image: converging, so opposite in sense."""
    size = np.linalg.norm(pupil.axes, axis=1)
    return -cosines[:, 0] / size[0], -cosines[:, 1] / size[1]


def test_too_small_an_aperture(bench) -> None:
    with pytest.raises(TooNarrowError, match=r"beam is 59\d mm wide .* aperture is only 598 mm"):
        bench.pupil(Collimator(LONG, 0.299 - 1e-9 * LONG))
    with pytest.raises(TooNarrowError, match="aperture is only 500 mm"):
        bench.pupil(Collimator(LONG, 0.25))
