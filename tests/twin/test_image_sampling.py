"""Images of blurred, cut and rough beams: right, or refused; never aliased."""

from collections.abc import Callable, Sequence

import numpy as np
import pytest

from optics.geometry.tree import Motion, State
from optics.numerics import quadrature
from optics.numerics.quadrature import PupilNodes
from scenes.models.instrument_builder import build_instrument
from scenes.specs.load import load_camera, load_instrument
from tests.hunt.dense_images import DenseImages
from twin.monitor import monitor_beams, monitor_path
from twin.monitor.monitor_beams import NodeClasses, UncertainImageError, energy_excess
from twin.monitor.monitor_path import MonitorPath

ACCURACY = 3e-6  # of the peak: what classes of blurred spots are chosen for, in double precision
DEFOCUS = (0.03, 0.1, 0.15)  # metres of image.z: 0.3, 1 and 1.5 waves rms in the monitor's narrow beam


@pytest.fixture(scope="module")
def blurred(backend) -> Callable[[float], MonitorPath]:
    """Function: how far the image plane stands off its place, metres -> the monitor of one such camera."""
    spec = load_instrument("gf7_pair")
    alone = replace_cameras(spec)
    camera = load_camera("gf7")

    def path(defocus: float) -> MonitorPath:
        out = camera.model_copy(update={"image": camera.image.model_copy(update={"z": camera.image.z + defocus})})
        return MonitorPath(build_instrument(alone, {"gf7": out}, backend), backend)

    return path


def replace_cameras(spec):
    return spec.model_copy(update={"cameras": {"forward": spec.cameras["forward"]}, "baffles": {}})


def with_nodes(path: MonitorPath, nodes: PupilNodes) -> MonitorPath:
    return MonitorPath(path.instrument, path.backend, nodes)


def largest(got: np.ndarray, want: np.ndarray) -> float:
    """Largest difference, of each image's peak."""
    return float(np.max(np.abs(got - want).max(axis=(-2, -1)) / want.max(axis=(-2, -1))))


@pytest.mark.second
@pytest.mark.parametrize("defocus", DEFOCUS)
def test_blurred_images_are_those_of_many_more_nodes(blurred, defocus: float) -> None:
    path = blurred(defocus)
    shift: State = {"base/forward/focal_plane": Motion(shift=(1e-4, -5e-5, 0.0))}
    states: Sequence[State] = [{}, shift]
    got = path.expected_photons(states, single=False)
    chosen = path.class_of(path.coarse_trace(states))
    dense = quadrature.disk_for(2.0 * path.node_classes.phase(int(np.max(chosen))))
    assert largest(got, with_nodes(path, dense).expected_photons(states, single=False)) < ACCURACY


@pytest.mark.second
def test_the_check_finds_what_the_choice_overlooks(blurred, monkeypatch) -> None:
    """A wavefront whose blur the few rays do not show: more nodes are taken until two rules agree."""
    path = blurred(DEFOCUS[1])
    want = path.expected_photons([{}], single=False)
    blind = with_nodes(path, None)
    monkeypatch.setattr(monitor_beams, "BLUR_PHASE", 0.0)
    assert path.class_of(path.coarse_trace([{}]))[0] < 2
    path.class_beams(0)  # its own nodes are chosen before
    got = blind.expected_photons([{}], single=False)
    assert largest(got, want) < monitor_beams.GOOD


@pytest.mark.second
def test_what_no_nodes_can_do_is_refused(blurred, monkeypatch) -> None:
    path = blurred(0.3)
    path.expected_photons([{}])
    monkeypatch.setattr(monitor_beams, "BLUR_PHASE", 0.0)
    monkeypatch.setattr(monitor_beams, "MOST_PHASE", 50.0)
    with pytest.raises(UncertainImageError, match=r"forward/\w+ is uncertain by .* % of its peak: .* too rough"):
        path.expected_photons([{}])


def test_spots_blurred_beyond_the_last_class_are_refused(blurred) -> None:
    with pytest.raises(UncertainImageError, match=r"too blurred for its image .* spread over \S+ px or .* mm; refocus"):
        blurred(2.0).expected_photons([{}])


def test_light_is_that_of_the_rays(blurred, monkeypatch) -> None:
    """An image with a fifth more light than its rays bring is refused."""
    path = blurred(0.0)
    path.expected_photons([{}])
    true = monitor_path.image
    monkeypatch.setattr(monitor_beams, "quadrature_difference", lambda images, *_: np.zeros(len(images)))
    monkeypatch.setattr(monitor_path, "image", lambda *arguments: 1.2 * true(*arguments))
    with pytest.raises(UncertainImageError, match="of its light too much"):
        path.expected_photons([{}])
    monkeypatch.setattr(monitor_path, "image", lambda *arguments: 0.5 * true(*arguments))
    with pytest.raises(UncertainImageError, match="of its light too little"):
        path.expected_photons([{}])


def test_energy_leaves_room_for_diffraction_alone() -> None:
    half, wings = np.array([10.0, 10.0]), np.array([3.0])
    place = np.array([[[0.0, 0.0], [9.0, 0.0], [0.0, -12.0], [14.0, 0.0]]])
    share = np.full((1, 4), 0.25)
    # one quarter is surely on the image, one surely not
    for light, expected in ((0.1, -0.07), (0.2, 0.0), (0.8, 0.0), (0.9, 0.07)):
        assert energy_excess(np.array([light]), place, share, half, wings)[0] == pytest.approx(expected)


def test_classes_grow_to_the_most_phase() -> None:
    classes = NodeClasses(0.5, (48.0, 48.0))
    assert np.all(np.diff(classes.reached) > 0.0)
    assert classes.phase(len(classes.reached) - 1) <= monitor_beams.MOST_PHASE
    still = np.zeros((2, 3, 2))
    blur = np.array([[0.0, 50.0, 0.0], [1.0, 0.0, 1e4]])
    number = classes.class_of(still, blur=blur)
    assert number[0] == 0
    assert 0 < number[1] < len(classes.reached)
    assert number[2] == len(classes.reached)
    assert classes.class_of(still[:, :1], widening=np.full((2, 1), 2.0))[0] > 0


@pytest.mark.second
def test_figures_with_fine_structure_move_rays_about(blurred) -> None:
    """15 nm of high order on a facet turn rays so that they meet the camera 30 um beside; against a plain sum over rays
    whose density is differentiated on a polar grid. With fourth-order terms alone the image is wrong by 2 %.
    """
    path = blurred(0.0)
    state: State = {"base/central_prism/forward_right": Motion(figure={9: 19e-9, 22: 15e-9})}
    image = path.photons_of(state)[1]
    row, column = np.unravel_index(np.argmax(image), image.shape)
    rows, columns = row + np.array([0, 1, -3, 9]), column + np.array([0, -2, 3, 8])
    dense = DenseImages(path, state)
    dense.trace()
    assert np.abs(dense.photons(1, rows, columns) - image[rows, columns]).max() < 1e-5 * image.max()


@pytest.mark.second
def test_figures_that_are_too_rough_are_refused(blurred, monkeypatch) -> None:
    """Spots that are not blurred beyond all nodes do not come so far; the limit is lowered."""
    monkeypatch.setattr(monitor_beams, "TOO_ROUGH", 1e-9)
    with pytest.raises(UncertainImageError, match=r"too rough for an image: .* use smaller figures"):
        blurred(0.0).photons_of({"base/central_prism/forward_right": Motion(figure={9: 19e-9, 22: 15e-9})})
