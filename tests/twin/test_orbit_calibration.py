"""In-orbit calibration over fields, end to end: recovery, statistics, schemes, and as a user runs it."""

import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

import twin.orbit.__main__ as command
from scenes.load import LIBRARY, ORBIT
from scenes.orbit_angle import LINES
from scenes.orbit_setup import CalibrationSetup, resolve_calibration
from scenes.orbit_spec import ThermalDriftSpec
from tests.twin.commands import files, invoke, refused
from twin.orbit.calibration_analysis import GAUGE, INNER, run_calibration_passes, simultaneous, true_values
from twin.orbit.calibration_test import fly_fields
from twin.trial.result import silent

run = partial(invoke, command.app)
EXAMPLE = LIBRARY / ORBIT / "calibrate.yaml"
SETUP = resolve_calibration(EXAMPLE)
FIELDS = tuple(SETUP.test.fields)
ARCSEC = np.pi / 648000


def setup_with(thermal: bool = True, **errors) -> CalibrationSetup:
    """The example with other errors."""
    test = SETUP.test
    if not thermal:
        errors["star_tracker"] = test.errors.star_tracker.model_copy(update={"thermal": ThermalDriftSpec()})
    update = {"errors": test.errors.model_copy(update=errors)}
    return SETUP.model_copy(update={"test": test.model_copy(update=update)})


@pytest.fixture(scope="module")
def full():
    """The example as it is."""
    return run_calibration_passes(SETUP, 1, silent)


def interior_of_the_file() -> dict[str, float]:
    """True interior orientation, from the files' numbers alone, metres."""
    found: dict[str, float] = {}
    for name in LINES:
        line, change = SETUP.camera.lines[name], SETUP.test.changes[name]
        values = np.array([line.focal_length, *line.principal_point])
        values += [change.focal_length, *change.principal_point]
        found |= dict(zip((f"{name} f", f"{name} x", f"{name} y"), values, strict=True))
    return found


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


def test_errors_are_as_large_as_their_sigmas() -> None:
    """Three runs without the drift during a pass, which no sigma contains; false alarm 1e-6 to either side."""
    setup, total, count, fit, freedom = setup_with(thermal=False), 0.0, 0, 0.0, 0
    for seed in range(3):
        campaign = fly_fields(setup, np.random.SeedSequence(100 + seed))
        found = simultaneous(campaign)
        free = np.array([name not in GAUGE.held for name in found.names])
        error = (found.values - true_values(campaign, found.names))[free]
        scale = np.sqrt(np.diag(found.covariance))[free]
        unit = found.covariance[np.ix_(free, free)] / scale / scale[:, None]
        total += error / scale @ np.linalg.solve(unit, error / scale)
        count += len(error)
        fit, freedom = fit + found.chi_square, freedom + found.degrees_of_freedom
    assert 1e-6 < chi2.sf(total, count) < 1.0 - 1e-6
    # attitude between two readings is interpolated, with 0.76 to 1 of their variance: the fit is better than claimed
    assert 0.9 < fit / freedom < 1.0 + 5.0 * np.sqrt(2.0 / freedom)


def test_sigmas_are_those_of_the_paper(full) -> None:
    """Interior to the 0.01 mm class and biases to the 1 arcsec class, and so are the errors."""
    found = full.together
    truth = interior_of_the_file()
    assert max(found.sigma[name] for name in INNER) < 0.01e-3
    assert max(abs(found.value(name) - truth[name]) for name in INNER) < 0.02e-3
    for one in full.campaign.passes:
        assert np.abs(found.bias(one.name) - one.bias).max() < 2.0 * ARCSEC


def test_before_calibration_errors_are_of_the_100_m_class(full) -> None:
    """By hand: in plan roll and pitch times 500 km, in height the change of x of forward minus aft, an angle a that
    moves a point by 500 km a / cos^2 25 deg, over the base, 2 tan 25 deg. In plan 30%, for changes of y and f are left
    out; in height 10%, for the curved Earth lets the outer rays converge more steeply."""
    test = SETUP.test
    shift = np.hypot(*test.errors.star_tracker.bias[:2]) * 500e3
    x = {k: test.changes[k].principal_point[0] / 0.65 for k in ("forward", "aft")}
    look = np.radians(25.0)
    height = abs(x["forward"] - x["aft"]) * 500e3 / np.cos(look) ** 2 / (2.0 * np.tan(look))
    for errors in full.before.values():
        assert 50.0 < errors.plan_rms < 200.0
        assert errors.plan_rms == pytest.approx(shift, rel=0.3)
        assert errors.height_rms == pytest.approx(height, rel=0.1)


def test_third_differences_show_the_white_noise(full) -> None:
    """5 sigmas; a circular orbit adds 8 mm to the orbit's, and the drift less than its step of 14 mm in a second."""
    errors = SETUP.test.errors
    for field in full.fields.values():
        attitude, orbit = field.attitude, field.orbit
        away = attitude.white_sigma - errors.star_tracker.noise[0]
        assert np.all(np.abs(away) < 5.0 * attitude.white_sigma_error)
        assert np.all(np.abs(orbit.white_sigma - errors.gps.noise[0]) < 5.0 * orbit.white_sigma_error + 5e-3)


def test_schemes(full) -> None:
    """Five, each on all fields. With its own parameters a field is left with noise, which scheme 5 tells: at most 2 m
    in plan (0.3 px of 5 m and 0.5 arcsec, three lines). Of a scheme's mean the bias of a field differs by the season
    and the latitude, 1 to 2 arcsec, 2.4 to 5 m."""
    assert list(full.schemes) == ["1", "2", "3", "4", "5"]
    for errors in full.schemes.values():
        assert tuple(errors) == FIELDS
        for one in errors.values():
            assert one.count == SETUP.test.points.check
            assert 0.5 < one.plan_rms < 15.0
            assert 1.0 < one.height_rms < 6.0
    assert max(e.plan_rms for e in full.schemes["5"].values()) < 2.5
    assert full.schemes["1"]["Beijing"].plan_rms == pytest.approx(full.schemes["5"]["Beijing"].plan_rms, rel=1e-12)
    # What a scheme leaves in plan is the difference of its bias from the field's own, over 500 km. Each axis has 0.4 m
    # of two orbits' offsets and 0.35 m of two estimates of 0.1 arcsec beside it: 4 sigmas.
    expected, found = [], []
    own = {p.name: p.bias for p in full.campaign.passes}
    noise = np.mean([e.plan_rms for e in full.schemes["5"].values()])
    for scheme, names in zip(full.schemes, SETUP.test.schemes, strict=False):
        mean = np.mean([own[name] for name in names], axis=0)
        for name, errors in full.schemes[scheme].items():
            expected.append(np.hypot(np.linalg.norm((mean - own[name])[:2]) * 500e3, noise))
            found.append(errors.plan_rms)
    assert found == pytest.approx(expected, abs=4.0 * np.hypot(0.42, 0.35))
    assert np.corrcoef(found, expected)[0, 1] > 0.9


def test_the_papers_finding(full) -> None:
    finding = full.finding
    assert len(finding.plan) == 4
    assert finding.plan[-1] < finding.plan[0]
    assert finding.plan_spread[-1] < finding.plan_spread[0]
    assert finding.height_change < 0.2
    assert finding.holds


# The command


def write(folder: Path, old: str, new: str) -> Path:
    text = EXAMPLE.read_text("utf-8")
    assert text.count(old) == 1, old
    path = folder / "small.yaml"
    path.write_text(text.replace(old, new), "utf-8")
    return path


def test_command(tmp_path: Path) -> None:
    path = write(tmp_path, "control: 60, check: 100", "control: 20, check: 20")
    result = run("calibrate", path, "--out", tmp_path / "run", "--seed", 5, "--json")
    assert result.exit_code == 0, result.stderr
    data = json.loads(result.stdout)
    assert data == json.loads((tmp_path / "run" / "calibration.json").read_text("utf-8"))
    contract = {"parameters", "correlations", "null_vectors", "gauge", "fields", "schemes", "before"}
    assert contract <= set(data)
    assert set(INNER) <= set(data["parameters"])
    assert {"value", "sigma", "truth"} <= set(data["parameters"]["forward f"])
    truth = interior_of_the_file()
    assert data["parameters"]["aft y"]["truth"] == pytest.approx(truth["aft y"], rel=1e-12)
    matrix, names = np.array(data["correlations"]["matrix"]), data["correlations"]["names"]
    assert matrix.shape == (len(names), len(names))
    assert set(data["schemes"]) == {"1", "2", "3", "4", "5"}
    for errors in (data["before"], *data["schemes"].values()):
        assert tuple(errors) == FIELDS
        assert all({"plan_rms_m", "height_rms_m"} == set(e) for e in errors.values())
    assert data["verdict"]["before"] is False
    assert data["verdict"]["schemes"]["4"] is True
    assert "nadir x" in data["null_vectors"][0]["change"]
    tables = {"schemes", "plan", "height", "interior", "biases", "fields", "correlations", "third-differences"}
    expected = {"manifest.json", "config.yaml", "calibration.json", "report.html"}
    assert files(tmp_path / "run") == expected | {f"artefacts/{name}.csv" for name in tables}
    assert "python -m twin.orbit calibrate config.yaml" in (tmp_path / "run" / "report.html").read_text("utf-8")
    # the same seed gives the same numbers, another one others
    again = run("calibrate", tmp_path / "run" / "config.yaml", "--out", tmp_path / "again", "--quiet")
    assert again.exit_code == 0, again.stderr
    first = (tmp_path / "run" / "calibration.json").read_bytes()
    assert (tmp_path / "again" / "calibration.json").read_bytes() == first
    other = run("calibrate", path, "--out", tmp_path / "other", "--seed", 6, "--quiet")
    assert (other.exit_code, other.stdout) == (0, "")
    assert (tmp_path / "other" / "calibration.json").read_bytes() != first


# what is wrong, key, what to do about it
BAD = {
    "few points": ("control: 60,", "control: 3,", "points.control", ["too few points", "6 or more"]),
    "gauge": (
        "nadir: {focal_length: -70 um}",
        "nadir: {principal_point: [9 um, 0 um]}",
        "changes.nadir",
        ["is the gauge", "star_tracker.bias"],
    ),
    "field": ("- [Beijing, Anhui]", "- [Beijing, Anhuy]", "schemes", ["no such field", "did you mean 'Anhui'"]),
    "outside the line": ("last: 11599", "last: 12000", "points.last", ["outside the line", "11999.5"]),
    "short pass": ("span: 60 s ", "span: 20 s ", "span", ["seen by all three lines", "a longer pass"]),
    "narrow": ("first: 400, last: 11599", "first: 5990, last: 6000", "points", ["the points cannot tell"]),
    "few readings": ("interval: 1 s", "interval: 100 s", "errors", ["five samples"]),
    "longer field": ("span: 60 s ", "span: 3 s ", "span", ["shorter than the field"]),
    "never passed": ("latitude: 44 deg, longitude: 87.5", "latitude: 89 deg, longitude: 87.5", "fields", ["never"]),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input(case: str, tmp_path: Path) -> None:
    old, new, key, words = BAD[case]
    path = write(tmp_path, old, new)
    refused(run, "calibrate", path, key, words)
