"""The file of the test with two autocollimators, and the bench that is built from it."""

import math

import numpy as np
import pytest

from optics.geometry.tree import Motion
from optics.numerics.backend import Backend
from scenes.specs.load import load_autocollimator_test
from scenes.yaml.errors import InputError
from twin.laboratory import autocollimator_bench as model
from twin.laboratory.autocollimator_bench import AutocollimatorPath

SPEC = load_autocollimator_test().spec
ANGLES = [math.radians(15), math.radians(30)]


@pytest.mark.parametrize(
    ("part", "key", "value"), [("reticle", "pinhole", 200e-6), ("area_ccd", "pitch", 120e-6)], ids=["pinhole", "pitch"]
)
def test_ccds_that_cannot_follow_the_spots(part: str, key: str, value: float, backend: Backend) -> None:
    collimator = SPEC.autocollimator
    changed = getattr(collimator, part).model_copy(update={key: value})
    spec = SPEC.model_copy(update={"autocollimator": collimator.model_copy(update={part: changed})})
    with pytest.raises(InputError, match="do not sample the spots") as caught:
        AutocollimatorPath(model.build_bench(spec, ANGLES[0]), backend)
    assert caught.value.key == ("autocollimator", part, key)
    assert caught.value.allowed is not None


@pytest.mark.parametrize("half_angle", ANGLES)
def test_mirrors_are_square_to_their_autocollimators(half_angle: float) -> None:
    bench = model.build_bench(SPEC, half_angle)
    placed = bench.assembly.place()
    for unit in model.UNITS:
        view = placed.pose(model.autocollimator_body(unit)).rotation[:, 2]
        mirror = placed.pose(model.mirror_body(unit))
        np.testing.assert_allclose(mirror.rotation[:, 2], -view, atol=1e-15)
        # the view passes through the mirror's middle and the turntable's centre
        lens = placed.pose(model.autocollimator_body(unit)).translation
        np.testing.assert_allclose(np.cross(mirror.translation - lens, view), 0.0, atol=1e-15)
        np.testing.assert_allclose(np.cross(lens, view), 0.0, atol=1e-15)
        # pinhole and CCD lie symmetric about the view
        ends = [placed.pose(body(unit)).translation - lens for body in (model.pinhole_body, model.ccd_body)]
        np.testing.assert_allclose(np.cross(ends[0] + ends[1], view), 0.0, atol=1e-15)
        np.testing.assert_allclose(bench.frame(unit), placed.pose(model.autocollimator_body(unit)).rotation, atol=1e-15)
    one, two = (bench.frame(unit) for unit in model.UNITS)
    assert math.acos(one[:, 2] @ two[:, 2]) == pytest.approx(2 * half_angle, abs=1e-12)
    np.testing.assert_allclose(one[:, 0], two[:, 0], atol=1e-15)
    # Y1 = Y2 cos b - Z2 sin b, Z1 = Y2 sin b + Z2 cos b
    c, s = math.cos(2 * half_angle), math.sin(2 * half_angle)
    np.testing.assert_allclose(one[:, 1], c * two[:, 1] - s * two[:, 2], atol=1e-15)
    np.testing.assert_allclose(one[:, 2], s * two[:, 1] + c * two[:, 2], atol=1e-15)


def test_the_table_carries_the_mirrors_and_nothing_else() -> None:
    bench = model.build_bench(SPEC, ANGLES[0])
    for k, axis in enumerate("XYZ"):
        turn = [0.0, 0.0, 0.0]
        turn[k] = 0.1
        placed = bench.assembly.place([{}, {model.axis_body(axis): Motion(rotate=(turn[0], turn[1], turn[2]))}])
        from scipy.spatial.transform import Rotation

        matrix = Rotation.from_rotvec(turn).as_matrix()
        for unit in model.UNITS:
            before, after = (placed.pose(model.mirror_body(unit), s) for s in (0, 1))
            np.testing.assert_allclose(after.rotation, matrix @ before.rotation, atol=1e-14)
            np.testing.assert_allclose(after.translation, matrix @ before.translation, atol=1e-14)
            assert placed.pose(model.ccd_body(unit), 1) == placed.pose(model.ccd_body(unit), 0)


def test_the_lens_is_a_collimator(backend: Backend) -> None:
    # the beam at the mirror is flat to the lens's field curvature, and the pinhole's image falls on the CCD's middle
    bench = model.build_bench(SPEC, ANGLES[1])
    assert bench.focal_length == pytest.approx(0.5, abs=1e-6)
    path = AutocollimatorPath(bench, backend)
    position, _, _, valid = path.rays([{}])
    assert valid.all()
    middle = np.einsum("n,bnk->bk", path.nodes.share, position)[:, :2]
    assert np.max(np.abs(middle)) < 0.05 * path.pitch
    # every ray within the Airy radius
    airy = 0.61 * SPEC.autocollimator.wavelength / bench.numerical_aperture
    assert np.max(np.abs(position[..., :2])) < airy


def test_a_larger_autocollimator_has_a_longer_focal_length(backend: Backend) -> None:
    bench = model.build_bench(SPEC, ANGLES[0])
    path = AutocollimatorPath(bench, backend)
    turn = Motion(rotate=(2e-3, 0.0, 0.0))
    grown = {model.autocollimator_body(1): Motion(scale=1e-3)}
    position = path.rays([{}, {model.axis_body("X"): turn}, grown, {model.axis_body("X"): turn, **grown}])[0]
    column = np.einsum("n,bnk->bk", path.nodes.share, position)[:4, 0]
    assert column[1] - column[0] == pytest.approx(0.5 * math.tan(4e-3), rel=1e-3)
    assert (column[3] - column[2]) / (column[1] - column[0]) - 1 == pytest.approx(1e-3, rel=0.02)
