"""What no number of a camera can be is an error with its cause; each such number is made here on purpose."""

from dataclasses import replace

import numpy as np
import pytest

from optics.numerics.array_math import UnphysicalError, check_at_most, check_close, check_range
from optics.waves import pupil_stack
from scenes.models import shadow
from scenes.specs.load import load_camera
from twin.camera import camera_optics
from twin.camera.camera_optics import CameraOptics
from twin.monitor import image_quality as quality
from twin.monitor.image_quality import image_quality


@pytest.fixture(scope="module")
def telescope(backend) -> CameraOptics:
    return CameraOptics.alone(load_camera("ritchey_chretien"), backend)


def test_bounds_are_held_to_their_rounding_and_say_what_left_them() -> None:
    check_range("a share", np.array([0.0, 1.0 + 1e-9, np.nan]), 0.0, 1.0, 1e-6)
    for value in (-0.1, 1.1, 2.4e24, np.inf):
        with pytest.raises(UnphysicalError, match=r"a share: .* outside the physical range 0 to 1"):
            check_range("a share", np.array([0.5, value]), 0.0, 1.0, 1e-6)
    check_at_most("an error", np.array([1.0, np.nan]), np.array([1.0, 0.0]), "another", 1e-6)
    with pytest.raises(UnphysicalError, match="an error: 2 exceeds another, 1"):
        check_at_most("an error", np.array([0.0, 2.0]), 1.0, "another", 1e-6)
    check_close("light", 1.0, np.array([1.001, np.nan]), "rays", 0.01)
    with pytest.raises(UnphysicalError, match=r"light: 0\.5 differs from rays, 0\.6"):
        check_close("light", np.array([0.5]), 0.6, "rays", 0.01)


@pytest.mark.second
def test_an_mtf_above_one_or_above_the_perfect_one_is_none(telescope, monkeypatch) -> None:
    few = np.array([0.0, 2e4, 3e4])  # uneven, for the way by pieces
    mtf = telescope.mtf((1.0, 0.0), few)
    assert np.all(mtf.values <= mtf.limit + 1e-9)
    true = camera_optics.polychromatic_transfer
    monkeypatch.setattr(camera_optics, "polychromatic_transfer", lambda *given: 1.1 * true(*given))
    with pytest.raises(UnphysicalError, match=r"an MTF: 1\.1"):
        telescope.mtf((1.0, 0.0), few)

    def swapped(pupil, *given):
        """The perfect wavefront's in place of the other's, and the other way round."""
        perfect = not np.any(pupil.eikonal_terms)
        return (0.9 if perfect else 1.0) * true(pupil, *given)

    monkeypatch.setattr(camera_optics, "polychromatic_transfer", swapped)
    with pytest.raises(UnphysicalError, match="exceeds that of the perfect wavefront"):
        telescope.mtf((1.0, 0.0), few)
    monkeypatch.setattr(camera_optics, "polychromatic_transfer", lambda *given: 0.9 * true(*given))
    with pytest.raises(UnphysicalError, match=r"at zero frequency: 0\.9"):
        telescope.mtf((1.0, 0.0), few)


def test_light_of_a_pupil_beyond_all_of_it_is_none(telescope, monkeypatch) -> None:
    monkeypatch.setattr(pupil_stack.PupilFunction, "light", property(lambda pupil: 2.4e24))
    with pytest.raises(UnphysicalError, match=r"leaves: 2\.4e\+24"):
        telescope.pupils([(0.0, 0.0)])


@pytest.mark.second
@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"strehl": 1.2}, "a Strehl ratio: 1.2"),
        ({"rms": 7.9e11}, "an rms wavefront error in waves: "),
        ({"residual_rms": 1.0}, "the sum of squares of a wavefront error's parts"),
    ],
)
def test_statistics_of_a_wavefront_that_cannot_be_are_none(telescope, monkeypatch, wrong, said) -> None:
    true = camera_optics.fit_part
    monkeypatch.setattr(camera_optics, "fit_part", lambda *given: replace(true(*given), **wrong))
    with pytest.raises(UnphysicalError, match=said):
        telescope.wavefront((1.0, 0.0), points=3)


@pytest.mark.second
def test_shares_of_bodies_beyond_the_stop_are_none(backend, gf7_pair, monkeypatch) -> None:
    """What a sliver of a shadow once made of image quality: 2.4e24 of the stop."""
    true = shadow.Shadows.shares
    monkeypatch.setattr(shadow.Shadows, "shares", lambda self: {k: v + 2.4e24 for k, v in true(self).items()})
    with pytest.raises(UnphysicalError, match=r"that a body blocks: 2\.4e\+24"):
        image_quality(gf7_pair, backend, [{}], (1.0,))
    monkeypatch.setattr(shadow.Shadows, "shares", lambda self: {k: 0.5 * v for k, v in true(self).items()})
    with pytest.raises(UnphysicalError, match=r"that bodies block: .* differs from that of points in it"):
        image_quality(gf7_pair, backend, [{}], (1.0,))


def test_image_quality_that_cannot_be_is_none(backend, gf7_pair, monkeypatch) -> None:
    true = pupil_stack.PupilStack.transfer
    monkeypatch.setattr(pupil_stack.PupilStack, "transfer", lambda *given: 4.0 * true(*given))
    with pytest.raises(UnphysicalError, match="an MTF of the optics of camera forward: "):
        image_quality(gf7_pair, backend, [{}], (0.0,))
    monkeypatch.undo()
    bench = quality._CameraBench(gf7_pair, "forward", backend, (0.0,), None)
    good = np.array([[0.1], [0.05], [0.04], [1e-6], [0.3], [0.3]])
    bench._require_possible(good, np.zeros(1), None)
    for row, value, said in (
        (1, 7.9e11, "a wavefront error of camera forward in waves: 7.9e"),
        (2, 0.06, "at best focus: 0.06"),
        (4, -0.5, "an MTF of camera forward: -0.5"),
        (0, -0.1, "that bodies block: -0.1"),
    ):
        wrong = good.copy()
        wrong[row] = value
        with pytest.raises(UnphysicalError, match=said):
            bench._require_possible(wrong, np.zeros(1), None)
    # of a beam that is all but dark nothing is told, and nothing held
    dark = good.copy()
    dark[[1, 0]] = [[7.9e11], [0.999]]
    bench._require_possible(dark, np.zeros(1), None)
