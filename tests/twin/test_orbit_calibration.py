"""In-orbit calibration over fields: recovery, statistics, schemes, drifting cameras, strips of tie points."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.linalg import eigh
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from analysis.arrays import ARCSEC
from analysis.orbit.calibration_parameters import CalibrationError, Noise
from analysis.orbit.forward_intersection import check_errors, intersect
from analysis.orbit.three_line_model import misclosure
from optics.numerics.number_tree import FrozenMap
from scenes.specs.load import ORBIT, SCENES
from scenes.specs.orbit.angle import LINES, EffectsSpec
from scenes.specs.orbit.calibration import CameraDriftSpec
from scenes.specs.orbit.flight import ThermalDriftSpec
from scenes.specs.orbit.setup import CalibrationSetup
from tests.twin.strip_prediction import predicted
from twin.framework.procedure import stream
from twin.orbit.calibration import campaign_adjustment
from twin.orbit.calibration.calibration_numbers import CALIBRATION
from twin.orbit.calibration.calibration_report import calibration_report
from twin.orbit.calibration.calibration_run import run_calibration, true_values
from twin.orbit.calibration.campaign import Campaign, PassData, image_sigma, interior_names, line_model
from twin.orbit.calibration.campaign_adjustment import GAUGE, calibrated_alone, fit_latitude, rate_priors, simultaneous
from twin.orbit.calibration.flown_campaign import fly_fields
from twin.orbit.calibration.influences import unexpected_changes
from twin.orbit.calibration.schemes import (
    FieldErrors,
    adjust_field_with_readings,
    adjust_pass_strip,
    adjust_with_readings,
    laboratory_errors,
    scheme_errors,
    values_of,
    with_monitor,
)
from twin.orbit.calibration.schemes import check_point_errors as at_checks
from twin.orbit.calibration.schemes import strip_check_errors as in_strip
from twin.orbit.flight.line_camera import drifted_payload
from twin.orbit.flight.sensor import NO_EFFECTS
from twin.orbit.measured.pass_measurements import ImagePoints

EXAMPLE = SCENES / ORBIT / "calibrate.yaml"
SETUP = CalibrationSetup.read(EXAMPLE)
NO_LIGHT = EffectsSpec(light_time=False, aberration=False, refraction=False)
INNER = interior_names(LINES)
FIELDS = tuple(SETUP.test.fields)


def setup_with(thermal: bool = True, effects: EffectsSpec = NO_LIGHT, **errors) -> CalibrationSetup:
    """The example with other errors, without effects on the light."""
    test = SETUP.test
    if not thermal:
        errors["star_tracker"] = test.errors.star_tracker.model_copy(update={"thermal": ThermalDriftSpec()})
    update = {"errors": test.errors.model_copy(update=errors), "effects": effects}
    return SETUP.model_copy(update={"test": test.model_copy(update=update)})


@pytest.fixture(scope="module")
def full():
    """The example as it is."""
    return run_calibration(SETUP, None, 1)


@pytest.mark.second
def test_the_verdict_says_where_calibration_makes_errors_larger(full) -> None:
    """With parameters of the laboratory that were right, meeting the limits is no merit of the calibration."""
    assert calibration_report(full).verdict.startswith("Calibration makes the errors at check points smaller: from 1")
    one = next(iter(full.schemes.values()))
    better = {name: replace(errors, plan_rms=0.2, height_rms=0.3) for name, errors in one.items()}
    verdict = calibration_report(replace(full, before=better)).verdict
    assert "larger in plan and height: from 0.200 m in plan and 0.300 m in height to" in verdict
    assert "in every field, as the laboratory's parameters alone do: see" in verdict


def interior_of_the_file() -> dict[str, float]:
    """True interior orientation, from the files' numbers alone, metres."""
    found: dict[str, float] = {}
    for name in LINES:
        line, change = SETUP.camera.lines[name], SETUP.test.perturb[name]
        values = np.array([line.principal_distance, *line.principal_point])
        values += [change.principal_distance, *change.principal_point]
        found |= dict(zip((f"{name} f", f"{name} x", f"{name} y"), values, strict=True))
    return found


@pytest.mark.second
def test_exact_data_return_everything_that_is_observable() -> None:
    """The sensor's times and places are solved to 1e-7 lines and pixels, 1e-12 m in the image, and converge beyond; the
    smallest change is 50 um. Biases: the star trackers' rotation, turned back."""
    setup = setup_with(switched_on=False, season=(0.0, 0.0, 0.0))
    found = simultaneous(fly_fields(setup, np.random.SeedSequence(2)))
    truth = interior_of_the_file()
    laboratory = {
        f"{k} {n}": v for k in LINES for n, v in zip("xy", SETUP.camera.lines[k].principal_point, strict=True)
    }
    for name in INNER:
        start = laboratory.get(name, 0.65)
        assert found.value(name) - start == pytest.approx(truth[name] - start, rel=1e-6, abs=1e-15)
    turn = Rotation.from_rotvec(SETUP.test.errors.star_tracker.bias).inv().as_euler("XYZ")
    for name in FIELDS:
        assert found.bias(name) == pytest.approx(turn, rel=1e-6)
    # what is open is named: x of all lines against the pitch of all fields
    (only,) = found.open
    assert set(only.names) == {*(f"{k} x" for k in LINES), *(f"{k} pitch" for k in FIELDS)}
    assert "nadir x" in str(found.gauge)


@pytest.mark.second
def test_numbers_say_what_their_sigmas_hold(full) -> None:
    """With the drift of the biases during a pass as the fields tell it, and with what launch leaves of the gauge.
    Errors of the outer lines' x beyond 4 sigmas are a false alarm of 1e-3 with Student's five degrees of freedom."""
    found, plain = CALIBRATION(full)["parameters"], simultaneous(full.campaign).sigma
    expected = SETUP.test.launch.interior
    for name in ("forward x", "backward x"):
        one = found[name]
        assert abs(one["value"] - one["truth"]) < 4.0 * one["sigma"]
        assert one["sigma"] > 1.2 * plain[name]
        # a shift of nadir x turns the whole camera
        assert one["sigma_with_gauge"] == pytest.approx(np.hypot(one["sigma"], expected), rel=0.01)
    assert (found["nadir x"]["held"], found["nadir x"]["sigma_with_gauge"]) == (True, pytest.approx(expected))
    # descending at 0.06 deg/s, 4 arcsec times the change of the sine of latitude; measured to true is the way back
    rate = -SETUP.test.errors.star_tracker.thermal.amplitude[1] * np.radians(-0.063)
    assert found["pitch rate"]["truth"] == pytest.approx(rate, rel=0.05)
    # Student's distribution of two degrees of freedom has no variance
    for count in (4, 5):
        few = fit_latitude("yaw", np.linspace(0.5, 0.8, count), np.linspace(1e-4, 2e-4, count), 1e-12 * np.eye(count))
        assert len(rate_priors(full.campaign, (few,))) == (count == 5)


# Effects on the light


@pytest.mark.second
def test_a_camera_100_m_wrong_takes_the_light_out_to_a_hundredth_of_a_pixel() -> None:
    """Image points by the true sensor with all effects; what is left is seen by the true camera and the true orbit at
    the same exposure times, as straight lines."""
    campaign = fly_fields(setup_with(effects=EffectsSpec(), image=0.0, control=0.0), np.random.SeedSequence(4))

    def left(one, given: bool) -> float:
        images, ground = (one.control_images, one.control_ground) if given else (one.check_images, one.check_ground)
        worst = 0.0
        for line, rays in (one.control.rays if given else one.check).items():
            seconds = one.data.sensors[line].time(images[line].line)
            true = replace(
                rays, station=one.trajectory.position(seconds), attitude=one.trajectory.body_to_itrs(seconds)
            )
            miss = misclosure(campaign.truth[line], true, ground, np.zeros(3), np.zeros(3))
            worst = max(worst, float(np.abs(miss).max()) / SETUP.camera.pitch)
        return worst

    for one in campaign.passes:
        # heights are given: what remains is 60 arcsec of attitude in v/c, 1.2e-3 px; else 110 m of height in refraction
        assert left(one, given=True) < 2e-3
        assert left(one, given=False) < 1e-2
    # by hand: v/c = 2.5e-5 of 0.65 m is 2.5 px; the Earth turns by 0.6 m at 40 degrees while the light is under way
    for one in campaign.without_effects(NO_EFFECTS).passes:
        assert 2.0 < left(one, given=False) < 3.0
    no_light_time = campaign.without_effects(replace(campaign.effects, light_time=False))
    at = 7.292e-5 * 6371e3 * np.cos(SETUP.test.fields["Beijing"].latitude) * 550e3 / 299792458.0 / 500e3 * 0.65
    assert left(no_light_time.passes[0], given=True) == pytest.approx(at / SETUP.camera.pitch, rel=0.15)


def one_field(position: tuple[float, float, float]) -> PassData:
    """What is known of a pass over Beijing, all lines' cameras at a place in the body."""
    test = SETUP.test.model_copy(update={"fields": FrozenMap({"Beijing": SETUP.test.fields["Beijing"]})})
    lines = {k: v.model_copy(update={"position": position}) for k, v in SETUP.camera.lines.items()}
    camera = SETUP.camera.model_copy(update={"lines": FrozenMap(lines)})
    setup = SETUP.model_copy(update={"test": test, "camera": camera})
    return fly_fields(setup, np.random.SeedSequence(3)).passes[0].data


def test_covariances_of_line_and_pixel_keep_their_sign_in_the_focal_plane() -> None:
    """What an error of a line and of a pixel does to the misclosures of a point is found by exposing it a line later
    and by moving it a pixel. The covariance in the focal plane is that of these, but for the spacing of lines: it is
    taken for flat ground ahead, 3% too large where the Earth bends away. A later line acts as a smaller x: the
    correlation changes its sign."""
    data = one_field((0.0, 0.0, 0.0))
    still = np.zeros(3)
    for name in LINES:
        spread = np.array([[0.04, 0.03], [0.03, 0.09]])
        plain = data.positions(name, np.array([0.0, 5999.5, 11_999.0]))
        assert plain == pytest.approx(SETUP.camera.pitch * np.array([[0.0, -5999.5], [0.0, 0.0], [0.0, 5999.5]]))
        line, pixel = 42_857.0, 6000.0
        row = ImagePoints.of([0], [line], [pixel], spread)
        ground = data.sensors[name].ground(np.array([line]), np.array([pixel]), np.array([400.0]))
        slopes = []
        for step in np.eye(2):
            sides = []
            for way in (1.0, -1.0):
                moved = ImagePoints.of([0], [line + way * step[0]], [pixel + way * step[1]], spread)
                rays = data.rays({name: moved})[name]
                sides.append(misclosure(data.models[name], rays, ground, still, still)[0])
            slopes.append(0.5 * (sides[0] - sides[1]))
        by = np.array(slopes).T
        given = replace(data, unit=1e-6).rays({name: row})[name].spread
        assert given is not None
        expected = by @ spread @ by.T / 1e-12
        assert given[0] == pytest.approx(expected, rel=0.08)
        assert expected[0, 1] < 0.0


@pytest.mark.second
def test_light_that_is_left_in_goes_into_the_parameters(full) -> None:
    """Aberration turns the camera's view by v/c, 5.2 arcsec about the pitch axis, which the bias takes up."""
    every = full.campaign.independent
    clean = every.without_effects(every.effects)
    base = simultaneous(clean)
    left = {
        name: every.without_effects(replace(every.effects, **dict.fromkeys(names, False)))
        for name, names in (("aberration", ["aberration"]), ("refraction", ["refraction"]))
    }
    left["all"] = every.without_effects(NO_EFFECTS)
    turned = simultaneous(left["aberration"])
    turn = turned.value("Beijing pitch") - base.value("Beijing pitch")
    assert np.abs(turn) == pytest.approx(7612.0 / 299792458.0, rel=0.03)
    # refraction tilts the outer lines' rays alike: heights before calibration, 1.5 m over tan 25 deg
    before = [values_of(laboratory_errors(one), "height_rms").mean() for one in (left["refraction"], clean)]
    assert before[0] - before[1] == pytest.approx(1.5 / np.tan(np.radians(25.0)), rel=0.25)
    # of the sigma of x, 0.33 um with what is not known of the drift of the bias
    everything, sigma = simultaneous(left["all"]), full.together.sigma
    changes = [(everything.value(n) - base.value(n)) / sigma[n] for n in INNER if sigma[n] > 0.0]
    assert np.abs(changes).max() > 5.0
    after = [errors_of_own_parameters(one) for one in (clean, *left.values())]
    for errors in after:
        assert errors == pytest.approx(after[0], rel=0.01)


def errors_of_own_parameters(campaign: Campaign) -> tuple[float, float]:
    """Return the means of the fields' RMS errors in plan and in height, each field with its own parameters, metres."""
    alone = {one.name: calibrated_alone(campaign, one) for one in campaign.passes}
    errors = list(scheme_errors(campaign, alone).values())[-1]
    return values_of(errors, "plan_rms").mean(), values_of(errors, "height_rms").mean()


# Biases against latitude


def test_latitude_fit_is_as_good_as_it_says() -> None:
    """400 draws of seven biases with a season; 5 sigmas of a mean, and of a spread with 5 degrees of freedom (kurtosis
    9 of Student's distribution: the spread of 400 is known to 7%)."""
    random = np.random.default_rng(8)
    latitude = np.radians([40.0, 32.0, 44.0, 29.6, 46.0, 44.0, 28.0])
    own = 0.1 * np.eye(7) ** 2 + 1.0  # a common error as yaw has it
    root = np.linalg.cholesky(own)
    ratios, rests = [], []
    for _ in range(400):
        season = 1.5 * random.standard_normal(7)
        value = 4.0 * np.sin(latitude - 0.66) + 25.0 + season + root @ random.standard_normal(7)
        fit = fit_latitude("yaw", latitude, value, own)
        ratios.append((fit.amplitude - 4.0) / fit.amplitude_sigma)
        rests.append(fit.remainder**2)
    assert abs(np.mean(ratios)) < 5.0 * np.sqrt(5.0 / 3.0 / 400.0)
    assert np.std(ratios) == pytest.approx(np.sqrt(5.0 / 3.0), rel=5.0 * 0.07)
    # a variance of 5 degrees of freedom: relative sigma sqrt(2 / 5)
    assert np.mean(rests) == pytest.approx(1.5**2, rel=5.0 * np.sqrt(2.0 / 5.0 / 400.0))


# Datum, seam, campaigns


@pytest.mark.second
def test_a_wrong_datum_is_taken_up_and_told(full) -> None:
    """100 m in plan are 100 m over 500 km = 41 arcsec of roll and pitch; in height 100/500 000 of f. The offsets, held
    by 0.3 m, take up nothing."""
    right = fly_fields(setup_with(), np.random.SeedSequence(1)).independent
    base = simultaneous(right)
    for shift in ((100.0, 0.0, 0.0), (0.0, 100.0, 0.0), (0.0, 0.0, 100.0)):
        wrong = fly_fields(setup_with(datum=shift), np.random.SeedSequence(1)).independent
        found = simultaneous(wrong)
        change = dict(zip(found.names, found.values - base.values, strict=True))
        turn, offset = (
            np.mean([[change[f"{name} {part}"] for part in parts] for name in FIELDS], axis=0)
            for parts in (("roll", "pitch"), ("offset along", "offset across", "offset down"))
        )
        assert np.hypot(*turn) == pytest.approx(np.hypot(*shift[:2]) / 500e3, rel=0.02, abs=1e-6)
        assert np.abs(offset).max() < 0.2
    assert change["nadir f"] == pytest.approx(-100.0 / 500e3 * 0.65, rel=0.02)
    # 100 m of height are far beyond the interior's sigmas, and long before a warning
    assert max(abs(change[n]) / base.sigma[n] for n in INNER if base.sigma[n] > 0.0) > 20.0
    assert unexpected_changes(wrong, found) == ()
    assert errors_of_own_parameters(wrong)[1] == pytest.approx(100.0, rel=0.03)
    assert full.unexpected_changes == ()
    campaign = fly_fields(setup_with(datum=(400.0, 0.0, 0.0)), np.random.SeedSequence(1))
    found = unexpected_changes(campaign, simultaneous(campaign.independent))
    assert found[0].name.endswith("roll")
    # launch 40 arcsec, season 1
    assert found[0].ratio == pytest.approx((400.0 / 500e3 / ARCSEC + 25.0) / 40.0, rel=0.1)


@pytest.mark.second
def test_geodetic_control_is_refused(full) -> None:
    one = full.campaign.passes[0]
    lon, lat, height = one.data.earth.geodetic(one.control_ground)
    geodetic = np.column_stack([np.degrees(lon), np.degrees(lat), height])
    with pytest.raises(CalibrationError, match="geocentric"):
        one.data.control_field(one.control_images, geodetic, 1.0, full.campaign.effects)


@pytest.mark.second
def test_image_points_from_elsewhere(full) -> None:
    """Points in another order and with numbers of their own give the same rays; sigma is that of x and y."""
    one = full.campaign.passes[0]
    # drawn at the field's height, weighed at the mean of its points
    drawn = replace(one.data, height=SETUP.test.fields[one.name].height)
    assert image_sigma(one.control_images, drawn) == pytest.approx(0.3 * SETUP.camera.pitch, rel=1e-12)
    # 7.62 km/s against the stars are 7.69 against the Earth at 97 degrees inclination: lines of 0.7 ms are 4.99 m apart
    # on the ground, pixels 5 m
    assert one.data.pixels_per_line("nadir") == pytest.approx(0.998, rel=5e-3)
    turned = {line: row.taken(np.arange(len(row.point))[::-1]) for line, row in one.control_images.items()}
    field = one.data.control_field(turned, one.control_ground, 1.0, full.campaign.effects)
    for line, rays in field.rays.items():
        before = one.control.rays[line]
        assert np.array_equal(rays.point, before.point[::-1])
        np.testing.assert_allclose(rays.image[::-1], before.image, rtol=0.0, atol=1e-15)


@pytest.mark.second
def test_short_fields_have_honest_sigmas() -> None:
    """1 km and no relief: all points of a field are exposed within one or two readings of the star trackers. Errors
    against covariance, false alarm 1e-6."""
    setup = setup_with(thermal=False)
    fields = {k: f.model_copy(update={"relief": 0.0}) for k, f in setup.test.fields.items() if k in FIELDS[:3]}
    points = setup.test.points.model_copy(update={"length": 1e3})
    test = setup.test.model_copy(update={"fields": fields, "points": points})
    total, count = 0.0, 0
    for seed in range(2):
        campaign = fly_fields(setup.model_copy(update={"test": test}), np.random.SeedSequence(seed))
        found = simultaneous(campaign)
        free = np.array([name not in GAUGE.held for name in found.names])
        error = (found.values - true_values(campaign, found.names))[free]
        total += error @ np.linalg.solve(found.covariance[np.ix_(free, free)], error)
        count += len(error)
    assert 1e-6 < chi2.sf(total, count) < 1.0 - 1e-6


# The command


def test_rates_that_residuals_show_are_assumed_with_their_uncertainty(monkeypatch) -> None:
    """Of two passes the larger of each axis; of a rate that nothing settles nothing is known."""
    estimate, sigma = 1e-6 * np.array([[3.0, 0.0, 1.0, 1.0, 0.0, 9.0], [4.0, 2.0, 0.0, 1.0, 1.0, np.inf]])
    rates = SimpleNamespace(p_value=0.0, estimate=estimate, sigma=sigma)
    found = SimpleNamespace(rates=rates, slow_variations=SimpleNamespace(p_value=0.5), factors={"attitude walk": 4.0})
    monkeypatch.setattr(campaign_adjustment, "simultaneous", lambda *_, **__: found)
    campaign = Campaign(SETUP.test, {"nadir": SimpleNamespace(interior=(0.5,))}, Noise(1e-6), ())
    drifts = campaign_adjustment.with_detected_drift(campaign).drifts
    assert drifts.rate == pytest.approx((5e-6, 2e-6, 1e-6))
    assert drifts.walk == pytest.approx(4e-6)


# --- cameras that drift from field to field, with and without an on-board monitor -------------------------------------


MONITORED = CalibrationSetup.read(SCENES / ORBIT / "calibrate_monitor.yaml")
KEPT = ("Beijing", "Anhui", "Xinjiang")
SEED = np.random.SeedSequence(3)


def drifting(drift: bool = True) -> Campaign:
    """Three fields of the example without effects on the light, without noise, and without a bias that changes from
    field to field or in a pass."""
    test = MONITORED.test
    tracker = test.errors.star_tracker.model_copy(update={"thermal": ThermalDriftSpec()})
    errors = {"switched_on": False, "season": (0.0, 0.0, 0.0), "star_tracker": tracker}
    update = {
        "fields": FrozenMap({k: test.fields[k] for k in KEPT}),
        "schemes": (KEPT[:1], KEPT),
        "errors": test.errors.model_copy(update=errors),
        "effects": NO_LIGHT,
        "drift": test.drift if drift else FrozenMap({"forward": CameraDriftSpec()}),
    }
    setup = MONITORED.model_copy(update={"test": test.model_copy(update=update)})
    return fly_fields(setup, stream(SEED)).independent


def height_per_arcsec(campaign: Campaign) -> float:
    """Mean height error of the first field, metres, for 1 arcsec of d_alpha of the forward line."""
    one, cameras = campaign.passes[0], dict(campaign.truth)
    turned = {**cameras, "forward": cameras["forward"].drifted(np.array([ARCSEC, 0.0, 0.0, 0.0]))}
    ground = [intersect(one.check, seen, campaign.noise, bias=one.bias).ground for seen in (cameras, turned)]
    return float(check_errors(ground[1], ground[0]).error[:, 2].mean())


def test_the_drifted_camera_is_the_one_of_the_analysis() -> None:
    """To rounding: 1e-15 of f and of a rotation's elements, 1e-9 of the drift."""
    drift = {"backward": np.array([30 * ARCSEC, -20 * ARCSEC, 50 * ARCSEC, 40e-6])}
    turned = line_model(drifted_payload(MONITORED.camera, drift), "backward")
    expected = line_model(MONITORED.camera, "backward").drifted(drift["backward"])
    np.testing.assert_allclose(turned.to_body, expected.axes, rtol=0, atol=1e-14)
    assert turned.interior[0] == pytest.approx(expected.principal_distance, abs=1e-15)


@pytest.mark.second
def test_exact_readings_return_everything() -> None:
    """Places of the sensor are solved to 1e-12 m; 1e-6 of the drift is 20 pm, and 1e-6 of 1 um is as good."""
    campaign = drifting()
    found = adjust_with_readings(campaign)
    for one in campaign.passes:
        assert np.abs(one.truth.drift["forward"]).max() > 0.1 * ARCSEC
        assert not np.any(one.truth.drift["nadir"])
        cameras = found.cameras_of(one.name)
        for line in LINES:
            np.testing.assert_allclose(
                cameras[line].drift[:3], one.truth.drift[line][:3], rtol=1e-6, atol=1e-6 * ARCSEC
            )
            np.testing.assert_allclose(cameras[line].drift[3], one.truth.drift[line][3], rtol=1e-6, atol=1e-11)
            np.testing.assert_allclose(cameras[line].interior, campaign.truth[line].interior, rtol=0, atol=1e-11)
        errors = at_checks(campaign, one, cameras, found.bias(one.name))
        assert max(errors.plan_rms, errors.height_rms) < 1e-4  # 1e-6 of 40 arcsec of bias, over 500 km
    assert with_monitor(campaign).schemes["1"].height_rms < 1e-3


@pytest.mark.second
def test_drift_without_a_monitor_shifts_heights_as_its_angle_says() -> None:
    """By hand, over a flat Earth: 1 arcsec of one outer line is H / sin(2 look) per radian, 3.2 m; the curved Earth
    takes 7% off. Heights of a field differ by its d_alpha, forward less backward, against the mean of all, to the same
    few per cent of metres per arcsec over latitudes, and d_beta, d_gamma and d_f act at the ends of the line."""
    campaign, metres = drifting(), height_per_arcsec(drifting(drift=False))
    by_hand = MONITORED.test.altitude / np.sin(np.radians(50.0)) * ARCSEC
    assert abs(metres) == pytest.approx(by_hand, rel=0.1)
    found = simultaneous(campaign)
    angle = np.array([(p.truth.drift["forward"] - p.truth.drift["backward"])[0] / ARCSEC for p in campaign.passes])
    height = [at_checks(campaign, p, found.cameras, found.bias(p.name)).error[:, 2].mean() for p in campaign.passes]
    # cameras that do not have the drift see the opposite of it
    assert np.array(height) == pytest.approx(-metres * (angle - angle.mean()), abs=0.05 * abs(metres) * np.ptp(angle))
    assert np.ptp(height) > 1.0


@pytest.mark.second
def test_a_constant_error_of_the_monitor_goes_into_the_interior() -> None:
    """1 arcsec of the forward line in all readings is 3.15 um of x, f times it, and no error of heights. In the reading
    of one tested pass alone it is that pass's error, metres per arcsec."""
    campaign = drifting()
    wrong = np.array([ARCSEC, 0.0, 0.0, 0.0])

    def off(one):
        return replace(one, readings=FrozenMap({**one.readings, "forward": one.readings["forward"] + wrong}))

    all_off = replace(campaign, passes=tuple(off(p) for p in campaign.passes))
    found = adjust_with_readings(all_off)
    moved = abs(found.value("forward x") - campaign.truth["forward"].interior[1])
    assert moved == pytest.approx(0.65 * ARCSEC, rel=0.01)
    assert with_monitor(all_off).together.height_rms < 0.02
    alone = adjust_field_with_readings(campaign, campaign.passes[0])
    last = off(campaign.passes[-1])
    cameras = {k: alone.cameras[k].drifted(last.readings[k]) for k in LINES}
    errors = at_checks(campaign, last, cameras, alone.bias(KEPT[0]))
    assert FieldErrors.pooled([errors]).height_rms == pytest.approx(abs(height_per_arcsec(campaign)), rel=0.05)


# --- passes adjusted on tie points before check points are intersected ------------------------------------------------


STRIP = CalibrationSetup.read(SCENES / ORBIT / "calibrate_strip.yaml")


def strip_with(slow: float) -> CalibrationSetup:
    """One field, no effects on the light and no drift with latitude; slow errors of so many arcseconds.

    Readings every 0.5 s are a quarter of the example's unknowns.
    """
    test = STRIP.test
    tracker = test.errors.star_tracker
    update = {
        "interval": 0.5,
        "thermal": ThermalDriftSpec(),
        "slow": tracker.slow.model_copy(update={"noise": (slow * ARCSEC,) * 3}),
    }
    errors = test.errors.model_copy(update={"star_tracker": tracker.model_copy(update=update)})
    none = EffectsSpec(light_time=False, aberration=False, refraction=False)
    changes = {"fields": FrozenMap({"Beijing": test.fields["Beijing"]}), "schemes": (("Beijing",),), "effects": none}
    changes |= {"errors": errors, "strip": test.strip.model_copy(update={"ties": 200})}
    return STRIP.model_copy(update={"test": test.model_copy(update=changes)})


@pytest.mark.second
def test_slow_errors_are_taken_out_as_the_covariances_say() -> None:
    """Two passes with the true camera, 5 arcsec every 20 s, 200 ties; false alarm 1e-3 for each limit.

    Looked at are the three shapes of height errors over the points that gain most (variances fall to a tenth, a
    quarter, a half): what is left of them and what was taken out are independent and each have their predicted
    variance. Nothing taken out is refused for certain.
    """
    fits, passes = np.zeros(2), 2
    for seed in range(passes):
        campaign = fly_fields(strip_with(5.0), np.random.SeedSequence(seed))
        one = campaign.passes[0]
        strip = adjust_pass_strip(campaign, one, campaign.truth, one.bias)
        before = at_checks(campaign, one, campaign.truth, one.bias)
        after = in_strip(campaign, one, strip, campaign.truth, one.bias)
        assert 1e-6 < strip.p_value < 1.0 - 1e-6
        heights = [law[:, 2, :, 2] for law in predicted(campaign, one)]
        gains, shapes = eigh(*heights)
        left, taken = (after.error[:, 2] @ shapes, (before.error - after.error)[:, 2] @ shapes)
        fits += np.sum(left[-3:] ** 2), np.sum(taken[-3:] ** 2 / (gains[-3:] - 1.0))
        assert gains[-1] > 5.0
    for fit in fits:
        assert 5e-4 < chi2.sf(fit, passes * 3) < 1.0 - 5e-4
    # of the RMS; it changes with places of points by some thousandths
    assert np.sqrt(np.trace(heights[1]) / np.trace(heights[0])) == pytest.approx(0.52, abs=0.01)
