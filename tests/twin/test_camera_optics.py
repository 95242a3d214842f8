"""One camera as designers look at it: wavefront, spot, MTF, colours, against other ways to the same numbers."""

from dataclasses import replace

import numpy as np
import pytest

from optics.geometry.tree import Motion
from optics.numerics.array_math import UnphysicalError
from optics.raytrace.trace import BeamMissedError
from optics.waves.optical_transfer import polychromatic_transfer
from scenes.models.camera_model import field_direction
from scenes.specs.spectrum import SpectrumSpec
from tests.oracles.test_reference_cameras import bundle, rms_spot, wavefront_error
from tests.scenes.lens.colour_cameras import colour_camera
from twin.camera import varied_beams
from twin.camera.aberrations import through_focus
from twin.camera.camera_optics import RAYS_ACCURACY, CameraOptics
from twin.camera.colour import axial_colour, lateral_colour, spectral_mtfs
from twin.camera.varied_beams import VariedBeams
from twin.monitor.image_quality import image_quality
from twin.targets import target_images

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
        assert wave.position[0] == pytest.approx(rays[0][0, 0], abs=1e-12)
        assert wave.position[1] == pytest.approx(rays[0][0, 1] - gf7.focal_plane.translation[1], abs=1e-12)


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
    mapped = view.errors(fields, 5)
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
    with pytest.raises(BeamMissedError, match="the edge of a surface blocks light of a field"):
        beams.light([{"camera/M2": Motion(shift=(0.05, 0.0, 0.0))}])
    # more terms than places at which light comes through
    assert np.isfinite(beams.zernike_rows(11)).all()
    few = [one[:9] for one in beams.illuminated_nodes()[0]]
    monkeypatch.setattr(beams, "illuminated_nodes", lambda: [few])
    with pytest.raises(UnphysicalError, match="11 Zernike terms are not independent"):
        beams.zernike_rows(11)
    monkeypatch.setattr(varied_beams, "RESIDUAL", 0.0)
    with pytest.raises(
        varied_beams.RoughWavefrontError, match=r"polynomials do not represent the wavefronts: they leave \S+ waves"
    ):
        VariedBeams(optics, [(0.0, 0.0)], None, None)
    rays = VariedBeams._rays

    def cut(self, *states):
        (*light, alive), aimed = rays(self, *states)
        return (*light, np.zeros_like(alive)), aimed

    monkeypatch.setattr(VariedBeams, "_rays", cut)
    with pytest.raises(varied_beams.VignettedBeamError, match="vignetted by a surface that is neither the stop"):
        VariedBeams(optics, [(0.0, 0.0)], None, None)


def test_fields_are_shares_of_the_half_field(gf7, gf7_alone) -> None:
    light = gf7_alone.directions([(0.5, -1.0)])[0]
    own = field_direction(gf7.spec, 0.5 * gf7.spec.field.x, -gf7.spec.field.y)
    np.testing.assert_allclose(light, gf7.camera_frame.rotation.T @ own, atol=1e-15)
    with pytest.raises(ValueError, match="from -1 to 1"):
        gf7_alone.wavefront((1.2, 0.0))
    with pytest.raises(ValueError, match="a field is a pair"):
        gf7_alone.wavefronts([0.0, 1.0])  # type: ignore[list-item]


def test_a_field_with_a_unit_is_its_share(gf7_alone) -> None:
    """As results and reports print it, too; gf7's half field is 1.25 by 0.15 deg."""
    shares = gf7_alone.fractions(["0.25 -0.075 deg", ("0.25 deg", "-4.5 arcmin"), "(0.25, -0.075) deg", (0.2, -0.5)])
    np.testing.assert_allclose(shares, [[0.2, -0.5]] * 4, rtol=1e-12)
    wave = gf7_alone.wavefront("0.25 -0.075 deg")
    assert wave.rms == gf7_alone.wavefront(wave.field).rms
    assert "field (0.25, -0.075) deg" in repr(wave)
    assert gf7_alone.spot("0.25 0 deg", "20 um").rms == gf7_alone.spot((0.2, 0.0), 20e-6).rms
    assert gf7_alone.at("486 nm").wavelength == 486e-9
    # four digits of the field's edge are inside it, and a pair that mixes both is neither
    assert np.all(gf7_alone.fractions([("1.2502 deg", "0 deg")]) == [[1.0, 0.0]])
    for wrong in ("0.2 deg", "1.3 0 deg", "0.2 0", ("0.2 deg", 0.1), "0.2 0 um", (np.nan, 0.0), None):
        with pytest.raises(ValueError, match=r"field: .* angles from its middle, such as '0.625 0.075 deg', up to"):
            gf7_alone.wavefront(wrong)


def test_an_mtf_takes_the_unit_that_it_shows(gf7_alone) -> None:
    mtf = gf7_alone.mtf()
    assert "nyquist 71.43 cycles/mm" in repr(mtf)
    assert np.all(mtf.at("50 cycles/mm") == mtf.at(50e3))
    assert np.all(gf7_alone.mtf(frequency=["0 cycles/mm", "50 cycles/mm"]).frequency == [0.0, 50e3])
    for wrong, told in (
        ("50 deg", "a unit of an angle"),
        (2e5, "outside the tabulated range, 0 to 142857"),
        (np.nan, ""),
    ):
        with pytest.raises(ValueError, match=f"frequency: .*{told}"):
            mtf.at(wrong)
    # beyond the cut-off there is no contrast
    coarse = gf7_alone.at("2 um").mtf()
    assert coarse.frequency[-1] < coarse.nyquist
    assert np.all(coarse.at(coarse.nyquist) < 1e-3)


# --- over all wavelengths of its light --------------------------------------------------------------------------------


TWO_FIELDS = [(0.0, 0.0), (1.0, 1.0)]


@pytest.fixture(scope="module")
def achromat(backend) -> CameraOptics:
    return CameraOptics.alone(colour_camera("achromat"), backend)


@pytest.mark.second
def test_a_camera_of_one_colour_is_that_of_its_wavelength(achromat, backend) -> None:
    """The same file with another design wavelength, but for its stop and pupil."""
    blue = 486.1327e-9
    other = CameraOptics.alone(
        colour_camera("achromat").model_copy(update={"wavelength": blue, "spectrum": None}), backend
    )
    for ours, theirs in zip(achromat.at(blue).wavefronts(TWO_FIELDS), other.wavefronts(TWO_FIELDS), strict=True):
        assert ours.wavelength == blue
        # the reference sphere's radius is that of the design's exit pupil: second order in the error
        assert ours.rms == pytest.approx(theirs.rms, rel=1e-5)
        np.testing.assert_allclose(ours.position, theirs.position, atol=1e-12)
    assert achromat.at(achromat.wavelength).wavefront().rms == achromat.wavefront().rms
    with pytest.raises(ValueError, match="outside the range"):
        achromat.at(5e-6)


@pytest.mark.second
def test_lateral_colour_is_in_the_pupils(achromat) -> None:
    """The phase of a line's transfer function is that of where its light falls, seen from the design's chief ray."""
    lines, field, frequency = np.array([486.1327e-9, 656.2725e-9]), (1.0, 0.0), np.array([0.0, 100.0, 40e3])
    moved = lateral_colour(achromat, [field], lines, achromat.wavelength)[0, :, 0]
    (both,) = achromat.colour_pupils([field], lines)
    design, values = achromat.spot(field), []
    for k, (line, pupil) in enumerate(zip(lines, both, strict=True)):
        own = polychromatic_transfer(pupil, frequency[:, None] * [1.0, 0.0], np.array([line]), np.ones(1), np.zeros(1))
        values.append(own[0])
        spot = achromat.at(float(line)).spot(field)
        assert spot.position[0] - design.position[0] == pytest.approx(moved[k], abs=1e-13)
        middle = np.angle(own[0, 1]) / (-2.0 * np.pi * frequency[1])
        assert middle == pytest.approx(moved[k] + spot.centroid[0], abs=2e-9)
    assert abs(moved[0] - moved[1]) > 1e-7
    mtf = achromat.mtfs([field], frequency, lines, np.array([1.0, 3.0]))[0]
    assert mtf.values[0, 2] == pytest.approx(abs(values[0][2] + 3.0 * values[1][2]) / 4.0, rel=1e-12)
    assert mtf.weights.tolist() == [0.25, 0.75]


@pytest.mark.second
def test_rules_of_more_wavelengths_until_nothing_changes(achromat, monkeypatch) -> None:
    light, frequency = SpectrumSpec.evenly(500e-9, 640e-9), np.array([0.0, 30e3, 70e3])
    (mtf,) = spectral_mtfs(achromat, [(0.0, 0.0)], light, frequency)
    (fine,) = achromat.mtfs([(0.0, 0.0)], frequency, *light.rule(24))
    assert 0.0 < mtf.error <= target_images.WORST_CHANGE
    np.testing.assert_allclose(mtf.values, fine.values, atol=mtf.error)
    monkeypatch.setattr(target_images, "LARGEST_RULE", 9)
    monkeypatch.setattr(target_images, "WORST_CHANGE", 1e-9)
    with pytest.raises(UnphysicalError, match="still changes by"):
        spectral_mtfs(achromat, [(0.0, 0.0)], light, frequency)


def test_axial_colour_is_that_of_the_state(achromat, backend) -> None:
    """Of a moved focal plane, and of a lens whose last face has moved: as of a file that says so."""
    lines, middle, step = np.array([486.1327e-9, 656.2725e-9]), [(0.0, 0.0)], 20e-6
    spec = achromat.model.spec
    still = axial_colour(achromat, middle, lines)
    away = replace(achromat, state={"camera/focal_plane": Motion(shift=(0.0, 0.0, step))})
    moved = axial_colour(away, middle, lines) - still
    np.testing.assert_allclose(np.abs(moved), step, rtol=1e-6)
    last = list(spec.mirrors)[-1]
    mirrors = {**spec.mirrors, last: spec.mirrors[last].model_copy(update={"z": spec.mirrors[last].z + step})}
    written = CameraOptics.alone(spec.model_copy(update={"mirrors": mirrors}), backend)
    bent = replace(achromat, state={f"camera/{last}": Motion(shift=(0.0, 0.0, step))})
    found, wanted = axial_colour(bent, middle, lines) - still, axial_colour(written, middle, lines) - still
    assert np.min(np.abs(wanted)) > 0.1 * step
    np.testing.assert_allclose(found, wanted, rtol=1e-3, atol=1e-9)


def test_no_colours_without_named_glass(achromat, backend) -> None:
    lenses = {**achromat.model.spec.mirrors}
    lenses["L1"] = lenses["L1"].model_copy(update={"glass": None, "index": 1.5168})
    old = replace(achromat, path=CameraOptics.alone(
        achromat.model.spec.model_copy(update={"mirrors": lenses, "spectrum": None}), backend).path)  # fmt: skip
    with pytest.raises(ValueError, match="give its glass"):
        old.at(500e-9)
    with pytest.raises(ValueError, match="give its glass"):
        axial_colour(old, [(0.0, 0.0)], np.array([500e-9]))
