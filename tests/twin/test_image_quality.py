"""Image quality of perturbed states in a batch, against single traces, batoid and one pupil's transfer function."""

import json
from functools import partial

import numpy as np
import pytest

from optics.geometry.pose import rotation_matrix
from optics.geometry.tree import Motion
from optics.numerics import quadrature
from optics.raytrace.assembly import points_to_world
from optics.raytrace.first_order import chief_rays
from optics.raytrace.system import assemble
from optics.waves.imaging import aim_collimated, fit_part, path_to_sphere
from scenes.models.camera_model import LAUNCH_DISTANCE
from twin.monitor.image_quality import FIELDS, QUALITY
from twin.monitor.image_quality import image_quality as quality_of

WAVELENGTH, ARCSEC = 650e-9, np.pi / 180 / 3600
NODES = quadrature.disk(12)
POINTS = np.concatenate([np.zeros((1, 2)), np.stack([NODES.x, NODES.y], axis=-1)])
CAMERA = "forward"
ROOT = f"base/{CAMERA}"
MOVED = {
    f"{ROOT}/M1": Motion(shift=(20e-6, -10e-6, 15e-6), rotate=(5 * ARCSEC, -8 * ARCSEC, 0.0)),
    f"{ROOT}/M2": Motion(shift=(-15e-6, 30e-6, -40e-6), rotate=(10 * ARCSEC, 4 * ARCSEC, 20 * ARCSEC)),
    f"{ROOT}/M3": Motion(rotate=(-6 * ARCSEC, 7 * ARCSEC, 0.0), figure={6: 20e-9, 8: 15e-9, 11: 10e-9}),
    f"{ROOT}/focal_plane": Motion(shift=(0.0, 40e-6, 25e-6), rotate=(20 * ARCSEC, 60 * ARCSEC, 0.0)),
}
# the whole camera turns: the image of a fixed direction moves by 3 mm, but not that of a pixel
TURNED = {ROOT: Motion(rotate=(100 * ARCSEC, -50 * ARCSEC, 30 * ARCSEC))}
STATES = [{}, MOVED, TURNED]
image_quality = partial(quality_of, obstruction=False)
"""Of free pupils; tests/twin/test_obstruction.py has those with shadows."""
LOST = {f"{ROOT}/M2": Motion(rotate=(0.08, 0.0, 0.0))}
CUT = {f"{ROOT}/M3": Motion(shift=(0.0, 25e-3, 0.0))}


@pytest.fixture(scope="module")
def quality(gf7_pair, backend):
    return image_quality(gf7_pair, backend, STATES)


def place_of(instrument, field: float) -> np.ndarray:
    band = instrument.cameras[CAMERA].spec.bands["P"]
    return np.array([[band.offset, field * 0.5 * band.pixels * band.pitch, 0.0]])


def light_of(instrument, backend, state, field: float) -> np.ndarray:
    """Direction of the light that a pixel sees in a state, (3,), by its chief ray."""
    assembly, model = instrument.assembly, instrument.cameras[CAMERA]
    placed = assembly.place([state])
    ways = [assemble(assembly, [f"{CAMERA}/{w}"], [state], placed=placed) for w in ("image_to_stop", "image_to_object")]
    pixel = points_to_world(placed, f"{ROOT}/focal_plane/line", place_of(instrument, field)).real
    guess = model.toward_optics(placed.rotation[:, placed.index[f"{ROOT}/focal_plane"]].real)
    return -chief_rays(backend, *ways, pixel, guess[:, None], np.array([0.0, 1.0, 0.0]))[1][0, 0]


def launched(instrument, backend, state, direction: np.ndarray) -> np.ndarray:
    """Points of the plane wavefront whose rays meet POINTS of the stop, (N, 3)."""
    model = instrument.cameras[CAMERA]
    to_stop = assemble(instrument.assembly, [f"{CAMERA}/to_stop"], [state])
    start = instrument.assembly.nominal_pose(f"{ROOT}/M1").translation - LAUNCH_DISTANCE * direction
    radius = model.apertures[model.spec.stop].bounds[1]
    # the rim itself may fall outside by rounding; no node lies there
    return aim_collimated(backend, to_stop, direction, start, radius * POINTS)[0][0]


def rms(difference: np.ndarray) -> float:
    return float(fit_part(NODES.x, NODES.y, NODES.weight, difference[1:]).rms) / WAVELENGTH


def test_a_camera_that_turns_as_a_whole_is_as_sharp(quality) -> None:
    """It sees other things as well as before."""
    turned = quality.cameras[CAMERA]
    np.testing.assert_allclose(turned.wfe[2], turned.wfe[0], atol=1e-8)
    np.testing.assert_allclose(turned.mtf_along_line[2], turned.mtf_along_line[0], atol=1e-8)
    assert [len(outlines) for outlines in turned.pupils] == [len(FIELDS)] * len(STATES)


@pytest.mark.second
@pytest.mark.oracle
def test_wavefront_error_against_batoid(gf7_pair, backend) -> None:
    batoid = pytest.importorskip("batoid")
    from tests.oracles.peers import batoid_camera, batoid_rays

    model = gf7_pair.cameras[CAMERA]
    state = {path: Motion(m.rotate, m.shift) for path, m in MOVED.items() if path != f"{ROOT}/focal_plane"}
    found = image_quality(gf7_pair, backend, [state]).cameras[CAMERA].wfe[0]
    peer = batoid_camera(model)
    for path, motion in state.items():
        peer = peer.withGloballyShiftedOptic(path.rsplit("/", 1)[1], motion.shift)
        peer = peer.withLocallyRotatedOptic(path.rsplit("/", 1)[1], rotation_matrix(motion.rotate))
    to_world = gf7_pair.assembly.nominal_pose(ROOT) @ model.camera_frame.inverse()
    for field, value in zip(FIELDS, found, strict=True):
        direction = light_of(gf7_pair, backend, state, field)
        launch = to_world.inverse().apply(launched(gf7_pair, backend, state, direction))
        own = to_world.rotation.T @ direction
        rays = batoid_rays(launch, own)
        peer.trace(rays)
        rays.toCoordSys(batoid.CoordSys())
        path = path_to_sphere(rays.r, rays.v, rays.t + launch @ own, rays.r[:1])
        # required: 1e-3 waves; both are exact, and the reference sphere is flat here
        assert rms(path - path[0]) == pytest.approx(value, abs=1e-6)


def test_a_state_is_the_same_alone_and_among_others_one_of_which_is_lost(gf7_pair, backend, quality) -> None:
    several = image_quality(gf7_pair, backend, [LOST, MOVED, CUT, {}, MOVED])
    for name, camera in several.cameras.items():
        alone = quality.cameras[name]
        for k, s in ((1, 1), (3, 0), (4, 1)):
            # aiming stops within 1e-12 m of its target, wherever the iterations of the whole batch leave a ray
            for key, atol in (("wfe", 1e-9), ("wfe_refocused", 1e-9), ("defocus", 1e-12), ("mtf_along_line", 1e-9)):
                np.testing.assert_allclose(getattr(camera, key)[k], getattr(alone, key)[s], rtol=0, atol=atol)
            assert not camera.reasons[k]
    lost, kept = several.cameras[CAMERA], several.cameras["backward"]
    for k in (0, 2):
        assert np.isnan(lost.wfe[k]).all()
        assert np.isnan(lost.mtf_along_track[k]).all()
        np.testing.assert_allclose(kept.wfe[k], quality.cameras["backward"].wfe[0], atol=1e-9)
    assert "mirrors" in lost.reasons[0] or "no ray" in lost.reasons[0]
    assert "vignettes" in lost.reasons[2]
    assert not any(kept.reasons)
    written = QUALITY(several)["before"]["cameras"][CAMERA]
    assert written["wfe_rms_waves"] is None
    assert written["defocus_um"] == {"left": None, "centre": None, "right": None}
    assert written["reason"] == lost.reasons[0]
    json.dumps(QUALITY(several), allow_nan=False)


@pytest.mark.second
def test_too_rough_a_wavefront_has_no_mtf_but_an_error(gf7_pair, backend) -> None:
    rough = {f"{ROOT}/M1": Motion(figure={60: 1e-6})}
    found = image_quality(gf7_pair, backend, [rough, {}]).cameras[CAMERA]
    assert np.all(found.wfe[0] > 0.5)
    assert np.isnan(found.mtf_along_line[0]).all()
    assert found.reasons[0].startswith("no MTF")
    assert np.isfinite(found.mtf_along_line[1]).all()


def test_fields_outside_of_the_line_are_refused(gf7_pair, backend) -> None:
    for fields in ((), (0.0, 1.2)):
        with pytest.raises(ValueError, match="fields"):
            image_quality(gf7_pair, backend, [{}], fields)
