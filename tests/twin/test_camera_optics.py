"""One camera as designers look at it: wavefront, spot and MTF at fields, against other ways to the same numbers."""

import numpy as np
import pytest

from optics.geometry.tree import Motion
from optics.numerics.array_math import UnphysicalError
from optics.raytrace.trace import BeamMissedError
from scenes.models.camera_model import field_direction
from scenes.models.camera_sharpness import FieldBeams
from tests.oracles.test_reference_cameras import bundle, rms_spot, wavefront_error
from twin.camera import varied_beams
from twin.camera.camera_optics import CameraOptics
from twin.camera.cut_wavefront import RAYS_ACCURACY
from twin.camera.field_maps import through_focus
from twin.camera.varied_beams import VariedBeams
from twin.monitor.image_quality import image_quality

FIELDS = [(0.0, 0.0), (1.0, 0.0), (0.3, -1.0)]


@pytest.fixture(scope="module")
def gf7_alone(backend, gf7) -> CameraOptics:
    return CameraOptics.alone(gf7, backend)


@pytest.mark.second
def test_wavefronts_and_spots_of_rays_traced_in_the_prescription_frame(backend, gf7, gf7_alone) -> None:
    """Other launch points, another frame, another rule over the pupil: the same numbers."""
    for wave, spot in zip(gf7_alone.wavefronts(FIELDS), gf7_alone.spots(FIELDS), strict=True):
        x, y = wave.field[0] * gf7.spec.field.x, wave.field[1] * gf7.spec.field.y
        rays = bundle(backend, gf7, x, y)
        assert wave.rms == pytest.approx(wavefront_error(gf7, rays), rel=1e-6)
        assert spot.rms == pytest.approx(rms_spot(rays[0]), rel=1e-6)
        # prescription x is along the line, y along the track; the focal plane's centre is that of the field
        assert wave.place[0] == pytest.approx(rays[0][0, 0], abs=1e-12)
        assert wave.place[1] == pytest.approx(rays[0][0, 1] - gf7.focal_plane.translation[1], abs=1e-12)


def test_a_defocused_focal_plane_is_the_term_of_defocus(gf7_alone) -> None:
    """dz along the light changes the path by dz (cos - 1): dz NA^2 / (4 sqrt 3) rms of Z4."""
    dz = 50e-6
    f_number = gf7_alone.spot().airy / 1.22 / 650e-9
    # the light comes along the focal plane's +Z
    downstream = gf7_alone.in_state({"camera/focal_plane": Motion(shift=(0.0, 0.0, dz))})
    change = downstream.wavefront().coefficients - gf7_alone.wavefront().coefficients
    size = dz / (2 * f_number) ** 2 / (4 * np.sqrt(3)) / 650e-9
    # positive: an image before the detector has a wavefront that is bent too much, ahead at the edge
    assert change[3] == pytest.approx(size, rel=0.01)  # the beam is 2 % elliptic
    assert np.max(np.abs(np.delete(change, 3))) < 0.05 * size
    assert downstream.spot().rms == pytest.approx(gf7_alone.spot(defocus=dz).rms, rel=1e-9)


@pytest.mark.second
def test_what_prisms_take_is_missing_in_every_table(backend, gf7_pair) -> None:
    """Wavefront, map over the field and through focus are of the same light, a tenth of which prisms take."""
    view = CameraOptics.within(gf7_pair, "forward", backend)
    fields = ((0.0, 0.0), (1.0, 0.0))
    waves = view.wavefronts(fields, points=3)
    whole = CameraOptics.within(gf7_pair, "forward", backend, obstruction=False)
    rms = [wave.rms for wave in waves]
    # maps are of 10 000 rays
    mapped = FieldBeams.field_errors(view.model, backend, fields, 5, view.cut)
    np.testing.assert_allclose(mapped, rms, rtol=RAYS_ACCURACY)
    focus = through_focus(view, fields, False)
    np.testing.assert_allclose(focus.error[:, len(focus.defocus) // 2], mapped, rtol=1e-6)
    quality = image_quality(gf7_pair, backend, [{}], fields=(0.0,)).cameras["forward"]
    taken = sum(float(share[0, 0]) for share in quality.bodies.values())
    assert waves[0].vignetted == pytest.approx(taken, abs=1e-3)
    # over the whole stop it is another number: 0.01815 waves for 0.01710
    assert whole.wavefront((1.0, 0.0)).rms > 1.04 * rms[1]


@pytest.mark.second
def test_beams_of_which_nothing_can_be_told_are_refused(backend, camera, monkeypatch) -> None:
    optics = CameraOptics.alone(camera("ritchey_chretien"), backend)
    beams = VariedBeams(optics, [(0.0, 0.0)], None, None)
    with pytest.raises(BeamMissedError, match="a surface's edge stops light of a field"):
        beams.light([{"camera/M2": Motion(shift=(0.05, 0.0, 0.0))}])
    # more terms than places at which light comes through
    assert np.isfinite(beams.zernike_rows(11)).all()
    few = [one[:9] for one in beams.lit()[0]]
    monkeypatch.setattr(beams, "lit", lambda: [few])
    with pytest.raises(UnphysicalError, match="11 Zernike terms are not independent"):
        beams.zernike_rows(11)
    monkeypatch.setattr(varied_beams, "RESIDUAL", 0.0)
    with pytest.raises(varied_beams.RoughError, match=r"polynomials do not follow: they leave \S+ waves"):
        VariedBeams(optics, [(0.0, 0.0)], None, None)
    rays = VariedBeams._rays

    def cut(self, *states):
        (*light, alive), aimed = rays(self, *states)
        return (*light, np.zeros_like(alive)), aimed

    monkeypatch.setattr(VariedBeams, "_rays", cut)
    with pytest.raises(varied_beams.CutError, match="cut by what is not the stop"):
        VariedBeams(optics, [(0.0, 0.0)], None, None)


def test_fields_are_shares_of_the_half_field(gf7, gf7_alone) -> None:
    light = gf7_alone.directions([(0.5, -1.0)])[0]
    own = field_direction(gf7.spec, 0.5 * gf7.spec.field.x, -gf7.spec.field.y)
    np.testing.assert_allclose(light, gf7.camera_frame.rotation.T @ own, atol=1e-15)
    with pytest.raises(ValueError, match="from -1 to 1"):
        gf7_alone.wavefront((1.2, 0.0))
    with pytest.raises(ValueError, match="pairs"):
        gf7_alone.wavefronts([0.0, 1.0])  # type: ignore[list-item]
