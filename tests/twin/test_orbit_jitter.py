"""Jitter of a pass, found in what the lines of a camera saw: simulated, exported, read back."""

from dataclasses import replace

import numpy as np
import pytest

from analysis.orbit.jitter import JitterSearch, search
from scenes.specs.load import ORBIT, SCENES
from scenes.specs.orbit.jitter_search import OrbitJitterSpec
from scenes.specs.orbit.setup import JitterSetup, load_three_line_camera
from scenes.specs.procedures import PROCEDURES
from scenes.yaml.yaml_file import read_yaml
from tests.tiers import quick
from twin.orbit.flight.line_camera import line_cameras
from twin.orbit.flight.platform_table import TabulatedTrajectory
from twin.orbit.flight.sensor import LightEffects
from twin.orbit.jitter import sights
from twin.orbit.jitter.jitter_report import _warnings as jitter_warnings
from twin.orbit.jitter.jitter_run import JITTER, JitterRun, fly_strip, run_jitter
from twin.orbit.jitter.sights import SightsError, SteadyPlatform, sights_of

ARCSEC = np.pi / 648000.0
READINGS = 0.25
"""Seconds between readings of the attitude: 4 Hz."""
RATE = 0.01


def setup(**change) -> JitterSetup:
    data = dict(read_yaml(SCENES / ORBIT / "jitter.yaml").data)
    data["orbit"] = {**data["orbit"], "before": "10 s", "after": "10 s"}
    data["points"] = {"count": 160, "duration": "10 s", "noise": 0.1, "height": "300 m", "relief": "100 m"}
    data |= change
    test = OrbitJitterSpec.model_validate(data)
    camera = PROCEDURES["orbit jitter"].resolve(SCENES / ORBIT / "jitter.yaml").camera
    return JitterSetup.model_construct(test=test, camera=camera)


def attitude(*lines: dict) -> dict:
    return {"steering": "yaw", "jitter": {"lines": list(lines)}}


OSCILLATION = {"frequency": "0.65 Hz", "amplitude": "2.4 1 0 arcsec", "phase": "40 10 0 deg"}


def searched(one: JitterSetup, seed: int) -> JitterSearch:
    spec = one.test
    measured, _ = fly_strip(one, seed)
    seen = sights_of(measured, line_cameras(one.camera), spec.lines, spec.search, LightEffects.of(spec.effects))
    return search(seen.observations, spec.search.lowest, spec.search.highest, spec.search.false_alarm)


@pytest.fixture(scope="module")
def oscillating() -> JitterRun:
    """1 px of roll and 0.4 px of pitch at 0.65 Hz through geometry, light, attitude readings and matching noise."""
    return run_jitter(setup(attitude=attitude(OSCILLATION), search={"highest": "12 Hz", "height": "250 m"}), None, 3)


def test_every_warning_of_a_search_is_told_when_and_only_when_it_holds(oscillating: JitterRun) -> None:
    """Too many wrong matches, noise beyond the covariances, and a frequency that may be another."""
    one = oscillating.passes["jitter"]

    def told(**changes) -> tuple[str, ...]:
        changed = replace(one, result=replace(one.result, **changes))
        return jitter_warnings(replace(oscillating, passes={"jitter": changed}))

    lines, used = one.result.lines, np.arange(len(one.result.used)) / len(one.result.used)
    for nothing in ({}, {"used": used < 0.71}, {"factors": 0.0 * one.result.factors + 1.29**2}):
        assert told(**nothing) == (), nothing
    assert any("31% of the observations of jitter were rejected as wrong" in text for text in told(used=used < 0.69))
    assert any("the remaining noise in jitter is" in text for text in told(factors=0.0 * one.result.factors + 1.31**2))
    (text,) = told(lines=replace(lines, aliases=((8.5, 9.1),)))
    assert "jitter: 0.65 Hz may also be 8.5, 9.1 Hz" in text.replace(f"{lines.frequency[0]:.4g}", "0.65")
    (text,) = told(lines=replace(lines, frequency=np.array([21.0])))
    assert "jitter: 21 Hz lies beyond the search" in text


def test_an_oscillation_of_the_body_is_found_about_its_axes(oscillating: JitterRun) -> None:
    """Frequency, amplitudes, phases and their sigmas, the gaps between the lines and where each pair is blind."""
    found = oscillating
    one = found.passes["jitter"]
    lines = one.result.lines
    assert one.sights.lines == ("blue", "green", "red", "nir")
    # no match is wrong here: the oscillation itself must not make any seem so
    assert one.result.used.mean() > 0.98
    assert len(lines.frequency) == 1
    assert lines.frequency[0] == pytest.approx(0.65, abs=4.0 * lines.frequency_sigma[0])
    away = (lines.amplitude[0] / ARCSEC - [2.4, 1.0]) / (lines.amplitude_sigma[0] / ARCSEC)
    assert np.all(np.abs(away) < 4.0)
    np.testing.assert_allclose(np.degrees(lines.phase[0]), [40.0, 10.0], rtol=0, atol=8.0)
    assert np.mean(one.result.factors[:-1]) == pytest.approx(1.0, abs=5.0 * np.sqrt(2.0 / one.result.after.freedom))
    gaps = {pair: gap[1] for pair, gap in one.sights.gaps.items()}
    assert gaps["blue", "green"] == pytest.approx(0.1216, abs=2e-4)
    assert gaps["green", "red"] == pytest.approx(0.1024, abs=2e-4)
    numbers = JITTER(found)["passes"]["jitter"]
    assert numbers["oscillations"][0]["true_amplitude_arcsec"] == pytest.approx({"roll": 2.4, "pitch": 1.0})


@pytest.mark.second
@pytest.mark.parametrize(("pair", "blind"), quick(1, [(("blue", "green"), 8.223), (("green", "red"), 9.765)]))
def test_two_bands_are_blind_at_the_inverse_of_their_gap(pair: tuple[str, str], blind: float) -> None:
    """An oscillation of 1 px there is not found by the two, but by all four."""
    line = {"frequency": f"{blind} Hz", "amplitude": "2.4 0 0 arcsec", "phase": "0 deg"}
    ask = {"lowest": "5 Hz", "highest": "12 Hz", "height": "300 m"}
    two = searched(setup(attitude=attitude(line), lines=pair, search=ask), 4)
    assert not len(two.lines.frequency)
    assert any(a < blind < b for a, b in two.before.intervals())
    four = searched(setup(attitude=attitude(line), search=ask), 4)
    assert four.lines.frequency[0] == pytest.approx(blind, abs=0.01)


def quiet() -> JitterSetup:
    """Without jitter, with readings of the attitude that are as noisy as half a pixel."""
    tracker = {"interval": f"{READINGS} s", "noise": "1 1 1 arcsec"}
    return setup(
        attitude={"steering": "yaw"},
        lines=("blue", "nir"),
        errors={"star_tracker": tracker, "gps": {"noise": "0.3 0.3 0.3 m"}},
        points={"count": 120, "duration": "6 s", "noise": 0.05, "height": "300 m", "relief": "100 m"},
        search={"highest": "9 Hz", "height": "300 m", "false_alarm": RATE},
    )


@pytest.mark.second
def test_readings_of_the_attitude_leave_no_period(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without jitter none is found; against readings joined by a spline it would be, below half of their rate."""
    assert not [seed for seed in range(3) if len(searched(quiet(), seed).lines.frequency)]

    class Joined(SteadyPlatform):
        @classmethod
        def of(cls, path: TabulatedTrajectory, first: float, last: float) -> TabulatedTrajectory:
            return path

    monkeypatch.setattr(sights, "SteadyPlatform", Joined)
    false = [searched(quiet(), seed).lines.frequency for seed in range(2)]
    assert all(len(one) for one in false)
    assert np.max(np.concatenate(false)) < 1.0 / READINGS


@pytest.mark.second
def test_the_noise_of_measured_lines_gives_rows_no_oscillation() -> None:
    """Rows of 10 Hz that are uneven by 1 ms, seen with 0.5 px of noise, which is 0.4 ms: noise and the moments that
    follow from it go together, and without care every pass shows four times the rate of the rows.
    """
    points = {"count": 160, "duration": "10 s", "rows": "100 ms", "row_spread": "1 ms", "noise": 0.5, "relief": "100 m"}
    ask = {"lowest": "25 Hz", "highest": "45 Hz", "height": "300 m"}
    one = setup(attitude={"steering": "yaw"}, points={**points, "height": "300 m"}, search=ask)
    assert not [seed for seed in range(3) if len(searched(one, seed).lines.frequency)]


@pytest.mark.second
def test_steady_readings_are_those_of_a_pass_without_noise() -> None:
    """Polynomials through exact readings: the orbit to a millimetre, the attitude to a thousandth of an arcsecond."""
    one = setup(attitude={"steering": "yaw"}, errors={})
    path = TabulatedTrajectory(fly_strip(one, 1)[0].platform)
    steady = SteadyPlatform.of(path, -4.0, 4.0)
    t = np.linspace(-4.0, 4.0, 33)
    np.testing.assert_allclose(steady.position(t), path.position(t), rtol=0, atol=1e-3)
    turn = np.einsum("nji,njk->nik", path.body_to_itrs(t), steady.body_to_itrs(t))
    np.testing.assert_allclose(turn, np.broadcast_to(np.eye(3), turn.shape), rtol=0, atol=1e-3 * ARCSEC)


def test_lines_without_points_cannot_be_searched() -> None:
    one = setup()
    measured, _ = fly_strip(one, 1)
    with pytest.raises(SightsError, match="0 points"):
        sights_of(measured, {"blue": line_cameras(one.camera)["blue"]}, None, one.test.search, LightEffects())


@pytest.mark.second
def test_lines_of_which_one_looks_elsewhere_cannot_be_searched() -> None:
    """A thousand pixels across, which no height explains: half of them in each line, where 200 may be."""
    one = setup()
    measured, _ = fly_strip(one, 1)
    (name, moved), *others = measured.images.items()
    away = replace(measured, images=dict(others) | {name: replace(moved, pixel=(moved.pixel + 1000.0) % 8799.0)})
    cameras, more = line_cameras(one.camera), (one.test.lines, one.test.search, LightEffects.of(one.test.effects))
    with pytest.raises(SightsError, match="no point is seen by two lines within 200 pixels"):
        sights_of(away, cameras, *more)


@pytest.mark.second
def test_lines_at_large_angles_tell_of_roll_whatever_the_heights() -> None:
    """The three lines of th1 see a place 33 s after one another and at 25 degrees: along the track they tell heights,
    and across it the roll of all three moments.
    """
    line = {"frequency": "0.65 Hz", "amplitude": "1 0 0 arcsec", "phase": "40 0 0 deg"}
    data = dict(setup(attitude=attitude(line)).test.plain())
    data["orbit"] = {**data["orbit"], "before": "60 s", "after": "60 s"}
    data |= {"lines": ["forward", "nadir", "backward"], "line_time": "0.7 ms", "time": "-33 s"}
    data["search"] = {"highest": "2 Hz", "axes": ["roll"], "height": "350 m"}
    test = OrbitJitterSpec.model_validate(data)
    lines = searched(JitterSetup.model_construct(test=test, camera=load_three_line_camera("th1")), 1).lines
    assert lines.frequency[0] == pytest.approx(0.65, abs=4.0 * lines.frequency_sigma[0])
    assert lines.amplitude[0, 0] / ARCSEC == pytest.approx(1.0, abs=4.0 * lines.amplitude_sigma[0, 0] / ARCSEC)
