"""Jitter of a flight: what a TDI line makes of it, and what it does to attitude and images."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from scenes.specs.orbit.flight import AttitudeSpec, ErrorsSpec
from tests.tiers import quick
from tests.twin.pushbroom_bench import LINE_TIME, PLACE, Ground, lines
from twin.orbit.flight.trajectory import Jitter, Trajectory
from twin.orbit.ground.grid import GroundFrame, Terrain
from twin.orbit.images.line_optics import exposures, with_mean_jitter
from twin.orbit.images.patch import window_of
from twin.orbit.images.pushbroom import PushbroomScene, render_patch
from twin.sensors.line_ccd import Collection, Motion

ARCSEC = np.pi / 648000.0
NU = np.array([0.1, 0.25, 0.5, 1.0])
STEP = 0.7e-3


def stated(text: dict, seed: int = 1) -> Jitter:
    spec = AttitudeSpec.model_validate({"jitter": text}).jitter
    assert spec is not None
    found = Jitter.of(spec, np.random.SeedSequence(seed))
    assert found is not None
    return found


def moments(collection: Collection, count: int) -> np.ndarray:
    """Times at which light falls in, by the middle of equal parts of every step: shares no code with the program."""
    part = (np.arange(count) + 0.5) / count - 0.5
    begin = np.arange(collection.steps) - 0.5 * (collection.steps - 1)
    return np.ravel(collection.step * (begin[:, None] + collection.open_share * part))


# --- a TDI line -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("steps", "share"), [(1, 1.0), (8, 1.0), (24, 0.6), (96, 1.0)], ids=["one", "eight", "open-0.6", "ninety-six"]
)
def test_the_transfer_of_an_oscillation_is_that_of_a_time_integration(steps: int, share: float) -> None:
    """From a slow smear to many cycles within the light, to 1e-4; the integration itself is right to (pi f step /
    parts)^2, 1e-5 at the highest frequency.
    """
    light = Collection(steps, STEP, share)
    at = moments(light, 400)
    for frequency, amplitude, phase in itertools.product(
        (0.65, 8.0, 45.0, 130.0, 1.0 / light.length, 1428.5), (0.05, 0.5, 2.0), (0.0, 0.9, 2.5)
    ):
        place = amplitude * np.sin(2.0 * np.pi * frequency * at + phase)
        integral = np.mean(np.exp(-2j * np.pi * NU[:, None] * place), axis=1)
        np.testing.assert_allclose(light.transfer(NU, frequency, amplitude, phase), integral, rtol=0, atol=1e-4)


@pytest.mark.parametrize(("steps", "share"), [(1, 1.0), (32, 1.0), (24, 0.6)], ids=["one", "full", "open-0.6"])
def test_the_mean_square_over_phases_is_that_of_a_time_integration(steps: int, share: float) -> None:
    light = Collection(steps, STEP, share)
    at, phase = moments(light, 60), 2.0 * np.pi * (np.arange(64) + 0.5) / 64
    for frequency, amplitude in itertools.product((3.0, 60.0, 210.0), (0.3, 1.2)):
        place = amplitude * np.sin(2.0 * np.pi * frequency * at + phase[:, None])
        each = [np.abs(np.mean(np.exp(-2j * np.pi * nu * place), axis=1)) ** 2 for nu in NU]
        # |T|^2 is smooth over the phase: the mean over 64 of them is exact
        found = light.mean_square(NU, Motion.of([(frequency, amplitude)]))
        np.testing.assert_allclose(found, np.mean(each, axis=1), rtol=0, atol=1e-4)


@pytest.mark.second
def test_bands_and_lines_together_against_drawn_motions() -> None:
    """The expectation over draws of a band and a line: 4000 of them leave 0.3/sqrt(4000)."""
    light, random = Collection(32, STEP), np.random.default_rng(3)
    motion = Motion.of([(40.0, 0.3)], [(20.0, 120.0, 4e-4)])
    at, parts = moments(light, 2), 50
    found = np.zeros(len(NU))
    for _ in range(4000):
        f = 20.0 + 100.0 * (np.arange(parts) + random.uniform(size=parts)) / parts
        a, b = np.sqrt(4e-4 * 100.0 / parts) * random.standard_normal((2, parts))
        angle = 2.0 * np.pi * f[:, None] * at
        place = a @ np.sin(angle) + b @ np.cos(angle)
        place = place + 0.3 * np.sin(2.0 * np.pi * 40.0 * at + random.uniform(0.0, 2.0 * np.pi))
        found += np.abs(np.mean(np.exp(-2j * np.pi * NU[:, None] * place), axis=1)) ** 2 / 4000
    np.testing.assert_allclose(light.mean_square(NU, motion), found, rtol=0, atol=4.0 * 0.3 / np.sqrt(4000))
    # a small motion blurs as a Gaussian of its own variance about its mean does, to the fourth power of pi nu s
    small = Motion.of([(40.0, 0.03)], [(20.0, 120.0, 4e-6)])
    gauss = np.exp(-2.0 * np.pi**2 * NU**2 * light.smear(small) ** 2)
    np.testing.assert_allclose(light.mtf(NU, small), gauss, rtol=0, atol=2e-5)


def test_gauss_rules_of_a_collection_mean_polynomials() -> None:
    for light in (Collection(1, STEP), Collection(24, STEP, 0.6), Collection(3, STEP, 0.2)):
        at, (place, weight) = moments(light, 20000), light.gauss_rule(4)
        for power in range(8):
            scale = light.length**power
            assert np.isclose(weight @ place**power / scale, np.mean(at**power) / scale, rtol=0, atol=1e-8), power


# --- attitude ---------------------------------------------------------------------------------------------------------


@pytest.mark.second
def test_jitter_has_the_stated_amplitude_phase_and_level() -> None:
    one = stated({"lines": [{"frequency": "0.65 Hz", "amplitude": "2 1 0 arcsec", "phase": "30 90 0 deg"}]})
    t = np.linspace(-3.0, 5.0, 97)
    angle = 2.0 * np.pi * 0.65 * t
    np.testing.assert_allclose(one(t)[:, 0], 2.0 * ARCSEC * np.sin(angle + np.pi / 6.0), rtol=0, atol=1e-18)
    np.testing.assert_allclose(one(t)[:, 1], ARCSEC * np.cos(angle), rtol=0, atol=1e-18)
    assert not np.any(one(t)[:, 2])
    band = {"bands": [{"first": "5 Hz", "last": "25 Hz", "level": "0.02 0.005 0 arcsec^2/Hz"}]}
    many = np.array([stated(band, seed)(np.array([0.0, 1.3])) for seed in range(1500)]) / ARCSEC
    # standard deviation of a variance from 3000 values: sqrt(2/3000)
    np.testing.assert_allclose(np.var(many, axis=(0, 1)), [0.4, 0.1, 0.0], rtol=4.0 * np.sqrt(2.0 / 3000.0))
    long = stated(band)(np.arange(0.0, 8.0, 0.01))[:, 0] / ARCSEC
    power = np.abs(np.fft.rfft(long)) ** 2 * 2.0 * 0.01 / len(long)
    frequency = np.fft.rfftfreq(len(long), 0.01)
    inside = (frequency > 6.0) & (frequency < 24.0)
    assert np.mean(power[inside]) == pytest.approx(0.02, rel=5.0 / np.sqrt(inside.sum()))
    assert np.mean(power[frequency > 30.0]) < 1e-4


def test_the_mean_over_a_collection_is_that_of_its_moments() -> None:
    one = stated({"lines": [{"frequency": "60 Hz", "amplitude": "2 1 0 arcsec"}]})
    light, t = Collection(32, STEP), np.linspace(0.0, 0.1, 13)
    brute = np.mean(one(t[:, None] + moments(light, 50)), axis=1)
    np.testing.assert_allclose(one.over(light)(t), brute, rtol=0, atol=1e-4 * ARCSEC)
    parts = one.exposures(light, ARCSEC, 1e-4)
    assert 2 < len(parts) < 20
    np.testing.assert_allclose(sum(w * part(t) for w, part in parts), brute, rtol=0, atol=3e-4 * ARCSEC)
    with pytest.raises(ValueError, match="too fast"):
        stated({"lines": [{"frequency": "9 kHz", "amplitude": "9 1 0 arcsec"}]}).exposures(light, ARCSEC, 1e-4)


def flight(jitter: dict | None) -> Trajectory:
    base = lines()["nadir"].sensor.trajectory
    assert isinstance(base, Trajectory)
    spec = AttitudeSpec.model_validate({"steering": "yaw", **({"jitter": jitter} if jitter else {})})
    return Trajectory.flown(base.orbit, spec, 5)


def test_the_body_turns_by_it_and_without_it_nothing_changes() -> None:
    t = np.linspace(-20.0, 20.0, 50)
    still = flight(None)
    assert still.jitter is None
    line = {"frequency": "2 Hz", "amplitude": "3 0 0 arcsec", "phase": "0 deg"}
    moved = flight({"lines": [line]}).body_to_itrs(t)
    turn = np.einsum("nji,njk->nik", still.body_to_itrs(t), moved)
    # a right-handed turn about X takes Y toward Z
    np.testing.assert_allclose(turn[:, 2, 1], 3.0 * ARCSEC * np.sin(4.0 * np.pi * t), rtol=0, atol=1e-12)
    assert flight({"lines": [{**line, "amplitude": "0 0 0 arcsec"}]}).jitter is None


def test_readings_follow_slow_jitter_and_not_what_is_faster_than_they() -> None:
    """A star tracker of 8 Hz: a cubic spline through 12 readings a cycle is good to a hundredth; 8 Hz looks still."""
    t = np.linspace(-2.0, 2.0, 300)
    for frequency, rest in (("0.65 Hz", (0.0, 0.01)), ("8 Hz", (0.9, 2.01))):
        true = flight({"lines": [{"frequency": frequency, "amplitude": "1 0 0 arcsec", "phase": "90 deg"}]})
        measured = true.with_errors(ErrorsSpec(), 3)
        turn = np.einsum("nji,njk->nik", measured.body_to_itrs(t), true.body_to_itrs(t))[:, 2, 1] / ARCSEC
        assert rest[0] <= np.max(np.abs(turn)) < rest[1]


# --- images -----------------------------------------------------------------------------------------------------------


@pytest.mark.second
@pytest.mark.parametrize("frequency", quick(1, [62.0, 12.0]))
def test_every_line_of_an_image_is_displaced_and_blurred_by_its_own_transfer(frequency: float) -> None:
    """A wave along the line, 0.3 cycles per pixel, under 32 stages: its amplitude in each line, over that without
    jitter, is the transfer at that line's time. The renderer's places are good to 0.002 pixels, 0.004 of the wave.
    """
    one, frame = lines()["nadir"], GroundFrame(*PLACE)
    assert isinstance(one.sensor.trajectory, Trajectory)
    band = one.optics.ccd.band
    tdi = band.tdi.model_copy(update={"stages": 32, "line_time": LINE_TIME})
    ccd = replace(one.optics.ccd, band=band.model_copy(update={"tdi": tdi}))
    optics = replace(one.optics, ccd=ccd)
    terrain, side = Terrain.flat(500.0), (24, 120)
    window = window_of("nadir", one.sensor, frame, 500.0, side)
    line, pixel = window.middle
    ends = frame.local(one.sensor.ground(np.full(2, line), pixel + np.array([-0.5, 0.5]), 500.0))
    step = np.array([ends[0][1] - ends[0][0], ends[1][1] - ends[1][0]])
    wave = 2.0 * np.pi * 0.3 * step / (step @ step)
    ground = Ground(lambda e, n: 0.3 + 0.2 * np.cos(wave[0] * e + wave[1] * n))
    slope = np.linalg.norm(one.sensor.camera.look_and_slope(np.array([pixel]))[1])
    amplitude = 0.5
    jitter = Jitter(np.array([frequency]), np.array([[amplitude * slope, 0.0, 0.0]]), np.zeros((1, 3)))
    moved = replace(one.sensor, trajectory=replace(one.sensor.trajectory, jitter=jitter))
    fade = np.hanning(side[1] + 2)[1:-1] * np.exp(-2j * np.pi * 0.3 * np.arange(side[1]))
    scene = PushbroomScene(frame, terrain, ground)
    still, shaken = (
        render_patch(s, optics, scene, window, 3).photons @ fade for s in (one.sensor, with_mean_jitter(moved, optics))
    )
    time = one.sensor.time(window.first_line + np.arange(side[0]))
    light = Collection(32, LINE_TIME)
    # a body that rolls by a right-handed turn about X looks farther to -Y: what it saw there goes to +Y, pixel 0
    phase = 2.0 * np.pi * frequency * time + np.pi
    expected = np.array([light.transfer(np.array([0.3]), frequency, amplitude, p)[0] for p in phase])
    np.testing.assert_allclose(shaken / still, expected, rtol=0, atol=0.008)
    assert np.ptp(np.angle(expected)) > 0.1  # displaced
    assert np.min(np.abs(expected)) < 0.96  # and blurred
    assert len(exposures(with_mean_jitter(moved, optics), optics)) > 1
