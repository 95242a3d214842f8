"""Merits of an instrument's monitor and of bodies in its beams, out of tolerance: against what other commands say."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from analysis.monitor.limits import split
from analysis.spots.likelihood import maximum_likelihood_fit
from analysis.spots.spot_template import SpotTemplate
from optics.geometry.tree import Motion
from scenes.models.disturbances import state_of
from scenes.specs.tolerance import MeritSpec
from scenes.yaml.errors import InputError
from tests.twin.study_bench import TEXTS, budget
from twin.monitor.image_quality import image_quality
from twin.monitor.information import built_noise, quantity_rows
from twin.monitor.monitor_derivative import SMALL, STEPS
from twin.monitor.monitor_experiment import TEMPLATE_MARGIN
from twin.monitor.observation import Observing, observe, one_detector
from twin.tolerance import monitor_merit
from twin.tolerance.monitor_merit import ROTATIONS, obstructed_shares, readings_of
from twin.tolerance.tolerance_bench import ToleranceBench
from twin.tolerance.tolerance_run import TOLERANCE, run_tolerance
from twin.tolerance.variations import states_of
from twin.uncertainty.monitor_limits import expected_covariance, find_limits

ARCSEC = np.radians(1.0 / 3600.0)
NEAR = 1e-4
"""Relative difference of sigmas by their noise alone: it makes 2e-4 of the variances, and the bound of a spot's noise
and what its fit finds, of which the pattern of the pixels cancels in part, differ by a fifth."""


@pytest.fixture(scope="module")
def bench(backend, tmp_path_factory: pytest.TempPathFactory) -> ToleranceBench:
    return ToleranceBench(budget(tmp_path_factory.mktemp("monitor"), "pair"), backend)


def amounts(bench: ToleranceBench, *rows: dict[str, float]) -> np.ndarray:
    """Amounts of the tolerances and compensators by name, in units of the limits, SI, (S, K)."""
    names = [one.name for one in (*bench.numbers, *bench.compensators)]
    shares = np.array([[row.get(name, 0.0) for name in names] for row in rows])
    return shares * [*bench.sizes, *bench.ranges]


def test_the_designed_instrument_is_that_of_the_command_uncertainty(bench: ToleranceBench) -> None:
    experiment = bench.experiment
    limits = find_limits(experiment, expected_covariance(experiment, experiment.resolved.frames), 9)
    assert limits is not None
    said = {
        (one.group, one.key, name): float(limits.splits[name].sigma[k])
        for k, one in enumerate(limits.quantities)
        for name in ("posterior", "derived")
    }
    nothing = bench.values(bench.try_out(np.zeros((1, len(bench.numbers)))).parts)[0]
    assert nothing[1] == pytest.approx(said["intersection_angle", "change_arcsec", "posterior"] * ARCSEC, rel=NEAR)
    assert nothing[2] == pytest.approx(said["forward", "d_gamma_arcsec", "derived"] * ARCSEC, rel=NEAR)
    assert nothing[3] == pytest.approx(said["forward", "d_f_um", "posterior"] * 1e-6, rel=NEAR)
    # another estimator is another number
    assert said["forward", "d_gamma_arcsec", "derived"] > 1.05 * said["forward", "d_gamma_arcsec", "posterior"]


@pytest.mark.second
def test_a_built_instrument_is_that_of_the_main_job(bench: ToleranceBench) -> None:
    """Its frames are exposed, its spots fitted: sigma of every spot, and those of the readings."""
    monitor, experiment = bench.monitor, bench.experiment
    assert monitor is not None
    # a spot may not leave its CCD in the main job; 1 arcsec of the mirror is 7 px
    x = amounts(bench, {"despace": 0.5, "radius": -0.3}, {"tilt": 0.05, "radius": 0.5, "focus": 0.4}, {"focus": 0.9})
    states = states_of((*bench.numbers, *bench.compensators), x)
    found = monitor.variances(x, states)
    record = one_detector(experiment, experiment.resolved.frames, 1)
    (seen,) = observe(experiment, states, Observing(record))
    assert list(seen.numbers) == [0, 1, 2]
    fitted = seen.recovery.sigma_after.reshape(3, -1)
    bound = np.sqrt(0.5 * np.diagonal(monitor._noise(states), axis1=1, axis2=2))
    # the shape that is fitted is that of the sharp spot, and slopes are differences between pixels: up to 3e-3
    np.testing.assert_allclose(bound, fitted, rtol=0.01)
    angle = seen.recovery.angle["posterior"].sigma_rad
    distance = seen.recovery.parameters["forward"]["posterior"].error_covariance[:, 3, 3]
    # the main job's derivatives are those of the designed instrument, so that it differs by what these change
    np.testing.assert_allclose(np.sqrt(found["angle"][:, 0]), angle, rtol=1e-3)
    np.testing.assert_allclose(np.sqrt(found["f"][:, 0]), np.sqrt(distance), rtol=1e-3)


@pytest.mark.second
def test_the_noise_of_blurred_spots_is_that_of_a_fit_to_them(bench: ToleranceBench) -> None:
    """With the shape that they have, as it is calibrated when the instrument is built."""
    monitor, experiment = bench.monitor, bench.experiment
    assert monitor is not None
    blurred = {"base/forward/M2": Motion(figure={5: 2e-6, 7: 5e-7})}
    bound = np.sqrt(0.5 * np.diag(monitor._noise([blurred])[0])).reshape(-1, 2)
    assert np.all(bound[:2] > 1.3 * np.sqrt(0.5 * np.diag(monitor.noise)).reshape(-1, 2)[:2])
    wide = monitor.images.expected_photons([blurred], margin=TEMPLATE_MARGIN, single=False)[0]
    shape = SpotTemplate.stack([experiment._template(image) for image in wide])
    inner = wide[:, TEMPLATE_MARGIN:-TEMPLATE_MARGIN, TEMPLATE_MARGIN:-TEMPLATE_MARGIN]
    noise, frames = experiment.calibration.noise, experiment.resolved.frames
    fit = maximum_likelihood_fit(experiment.expected_frames(inner), frames, noise, shape)
    fitted = np.stack([fit.sigma_row, fit.sigma_column], axis=-1)
    np.testing.assert_allclose(bound[: len(fitted)], fitted, rtol=0.01)


@pytest.mark.second
def test_derivatives_are_those_of_central_differences(bench: ToleranceBench) -> None:
    """Every stated motion both ways about a built instrument, by the traces that tell spots and truth."""
    monitor, experiment = bench.monitor, bench.experiment
    assert monitor is not None
    x = amounts(bench, {"tilt": 1.0, "radius": 1.0})
    about = states_of((*bench.numbers, *bench.compensators), x)
    motions, designed = experiment.stated, experiment.disturbances
    assert motions is not None
    assert designed is not None
    steps = np.array([{**STEPS, **SMALL}[c.kind] for c in motions.components])
    states = [
        state_of(row, motions.components, experiment.thermal, about[0])
        for row in np.concatenate([np.diag(steps), -np.diag(steps)])
    ]
    spots = np.moveaxis(experiment.path.coarse_trace(states).place, 1, 2).reshape(-1, len(states))
    truth = experiment.sight.truth(states)
    parameters = np.concatenate([truth.vector(name).T for name in truth.cameras])
    count = len(steps)
    slopes = [(one[:, :count] - one[:, count:]) / (2.0 * steps) * motions.sigma for one in (spots, parameters)]
    stated = replace(designed, spots=slopes[0], parameters=slopes[1])
    noise = built_noise(monitor.path, experiment.detector, about)[0]
    row = quantity_rows(experiment.instrument, None)
    found, plain = monitor.exact(about), np.zeros((1, x.shape[1]))
    designed_values = monitor.variances(plain, states_of((*bench.numbers, *bench.compensators), plain))
    for name, key in (("angle", "angle"), ("f", "forward/d_f")):
        sigma = split(row[key], stated, noise, stated.best_gain(noise)).sigma[0]
        value, before = np.sqrt(found[name][0, 0]), np.sqrt(designed_values[name][0, 0])
        assert abs(sigma - before) > 1e-5 * before
        # steps are finite on both sides: 1e-7, a hundredth of what changes
        assert value == pytest.approx(sigma, rel=3e-7)


def test_area_ccds_are_set_to_their_spots(bench: ToleranceBench) -> None:
    """A tilt that takes a spot off its CCD in the main job; and a chip that is moved by whole pixels."""
    monitor = bench.monitor
    assert monitor is not None
    x = amounts(bench, {"tilt": 1.0}, {})
    states = states_of((*bench.numbers, *bench.compensators), x)
    place = bench.experiment.path.coarse_trace(states[:1]).place
    assert np.max(np.abs(place)) > 0.5 * bench.experiment.path.shape[0]
    assert np.all(np.isfinite(monitor.variances(x, states)["angle"]))
    chip = {"base/forward/focal_plane/left/area_ccd": Motion(shift=(24e-6, -36e-6, 0.0))}
    moved, still = monitor._noise([chip, {}])
    np.testing.assert_allclose(moved, still, rtol=1e-6, atol=1e-12)


@pytest.mark.second
def test_bodies_take_what_image_quality_says(bench: ToleranceBench, backend) -> None:
    """Of the beams of the pixels that are looked at there, in states in which a prism and a mirror are moved."""
    x = amounts(bench, {}, {"prism": 1.0}, {"prism": -0.5, "tilt": 0.5})
    states = states_of((*bench.numbers, *bench.compensators), x)
    path, half = bench.optics.path, 0.5 * bench.optics.model.spec.line.pixels * bench.optics.model.spec.line.pitch
    places = np.array([[half, 0.0], [0.0, 0.0], [-half, 0.0]])
    quality = image_quality(bench.instrument, backend, states, (1.0, 0.0, -1.0)).cameras["forward"]
    for s, state in enumerate(states):
        light = path.directions(places, state)
        found = obstructed_shares(path, [state], light, path._launch(light))[0]
        said = sum(share[s] for share in quality.bodies.values())
        np.testing.assert_allclose(found, said, atol=1e-6)
    tried = bench.values(bench.try_out(x[:, : len(bench.numbers)]).parts)[:, 4]
    merit = next(one for one in bench.merits if one.name == "shadow")
    shares = obstructed_shares(path, states[:2], bench.beams.directions, bench.beams.start)
    np.testing.assert_allclose(tried[:2], shares[:, merit.fields].max(axis=1), atol=1e-6)
    assert abs(tried[1] - tried[0]) > 5e-4


@pytest.mark.second
def test_a_run_tells_of_the_monitor(backend, tmp_path) -> None:
    merits = {name: TEXTS["pair"]["merits"][name] for name in ("wavefront", "angle", "f")}
    tolerances = {name: TEXTS["pair"]["tolerances"][name] for name in ("despace", "radius")}
    setup = budget(tmp_path, "pair", merits=merits, tolerances=tolerances, disturbances="launch")
    run = run_tolerance(setup, backend)
    numbers = TOLERANCE(run)
    angle = numbers["merits"]["angle"]
    assert angle["unit"] == "arcsec"
    assert angle["nominal"] == pytest.approx(0.159, abs=0.001)  # of `launch`, not of the instrument's own
    assert 0.0 < angle["interpolation_error"] < 1e-5
    assert numbers["merits"]["f"]["unit"] == "um"
    assert all("disturbances: launch" in text for text in run.jobs.values())


def test_which_readings_count(tmp_path) -> None:
    one = MeritSpec.model_validate({"kind": "monitor_angle", "at_most": "1 arcsec"})
    assert readings_of(one, ("a", "b")) == ("angle",)
    assert readings_of(one, ("a",)) == ROTATIONS
    angle, setup = one.model_copy(update={"reading": "angle"}), budget(tmp_path, "pair")
    two, three = (SimpleNamespace(instrument=SimpleNamespace(cameras=names)) for names in ("ab", "abc"))
    assert monitor_merit._readings(setup, two, "angle", angle, "a") == ["angle"]
    with pytest.raises(InputError, match=r"merits\.angle\.reading: .*of two cameras, and there are 3.*d_gamma"):
        monitor_merit._readings(setup, three, "angle", angle, "a")
