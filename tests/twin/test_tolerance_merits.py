"""Merits out of tolerance, of lenses in light of several wavelengths, of an instrument's monitor and of bodies in its
beams: against a trace of altered glasses of its own, and against what other commands say.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from analysis.monitor.limits import split
from analysis.spots.likelihood import maximum_likelihood_fit
from analysis.spots.spot_template import SpotTemplate
from optics.geometry.tree import Motion
from optics.numerics.array_math import UnphysicalError
from optics.numerics.backend import Backend
from scenes.models.camera_model import CameraModel
from scenes.models.disturbances import state_of
from scenes.specs.camera import CameraSpec
from scenes.specs.tolerance import MeritSpec, ToleranceSetup
from scenes.yaml.errors import InputError
from scenes.yaml.yaml_file import dump_yaml
from tests.own_trace import OwnCamera, Traced
from tests.scenes.lens.colour_cameras import colour_camera
from tests.twin.study_bench import TEXTS, budget
from twin.camera.camera_optics import CameraOptics
from twin.camera.varied_beams import RoughWavefrontError, VignettedBeamError
from twin.monitor.image_quality import image_quality
from twin.monitor.monitor_derivative import SMALL, STEPS, noise_as_built, quantity_rows
from twin.monitor.monitor_experiment import TEMPLATE_MARGIN
from twin.monitor.observation import ObservationOptions, observe, shared_detector
from twin.tolerance import monitor_merit, tolerance_bench
from twin.tolerance.monitor_merit import ROTATIONS, obstructed_shares, readings_of
from twin.tolerance.tolerance_bench import ToleranceBench
from twin.tolerance.tolerance_run import TOLERANCE, run_tolerance
from twin.tolerance.variations import states_of
from twin.uncertainty.monitor_limits import expected_covariance, find_limits

D_LINE = 587.5618e-9
FIELDS = [[0.0, 0.0], [1.0, 0.0]]
WAVEFRONT = {"wavefront": {"kind": "wavefront", "at_most": 0.2, "fields": [[0.0, 0.0]]}}


def lens_budget(folder: Path, camera: CameraSpec | None = None, **changes: Any) -> ToleranceSetup:
    """The budget of a camera, an achromat by default, with other keys at its top."""
    (folder / "lens.yaml").write_text(dump_yaml((camera or colour_camera("achromat")).plain()), "utf-8")
    return budget(folder, "lens", **changes)


@pytest.fixture(scope="module")
def bench(backend: Backend, tmp_path_factory: pytest.TempPathFactory) -> ToleranceBench:
    return ToleranceBench(lens_budget(tmp_path_factory.mktemp("light")), backend)


class OwnTrace:
    """The achromat in plain NumPy: the wavefronts of all lines about one point.

    Of the twin it takes the prescription, the catalogue's indices, the stop's radius and the exit pupil's distance.
    """

    def __init__(self, model: CameraModel, stop: float) -> None:
        self.spec, self.stop = model.spec, stop
        self.radius = float(model.first_order.exit_pupil_distance[0])
        s, w = np.polynomial.legendre.leggauss(7)
        angle = 2.0 * np.pi * (np.arange(31) + 0.3) / 31
        r = np.sqrt(0.5 * (1.0 + s))[:, None]
        inner = np.stack([(r * np.cos(angle)).ravel(), (r * np.sin(angle)).ravel()], axis=-1)
        self.points, self.share = np.concatenate([np.zeros((1, 2)), inner]), np.repeat(w / w.sum() / 31, 31)

    def _beam(self, field: list[float], line: float, errors: Mapping[str, float], focus: float) -> Traced:
        """Rays of one wavelength through lenses of another Abbe number and another index, and decentred ones."""
        mirrors = {}
        for name, one in self.spec.mirrors.items():
            new: dict[str, Any] = {"decentre": (errors.get("decentre", 0.0) if name in ("L3", "L4") else 0.0, 0.0)}
            if one.glass is not None:
                at_d, here = one.glass.index(D_LINE, "air"), one.glass.index(line, "air")
                behind = at_d + (here - at_d) / (1.0 + errors.get(f"{name} abbe", 0.0))
                new |= {"glass": None, "index": behind + errors.get(f"{name} index", 0.0)}
            mirrors[name] = one.model_copy(update=new)
        image = self.spec.image.model_copy(update={"z": self.spec.image.z + focus})
        camera = OwnCamera(self.spec.model_copy(update={"mirrors": mirrors, "image": image}))
        radius, (x, y) = self.spec.mirrors["L1"].radius, self.stop * self.points.T
        start = np.stack([x, y, radius - np.sqrt(radius**2 - x**2 - y**2)], axis=-1)
        return camera.trace(start, camera.heading(field[0] * self.spec.field.x, field[1] * self.spec.field.y))

    def square(self, field: list[float], errors: Mapping[str, float], focus: float) -> float:
        """Mean square error over the light, waves of the design wavelength: piston is taken out of every line by
        itself, tilt out of all together.
        """
        assert self.spec.spectrum is not None
        lines, weights = self.spec.spectrum.rule(1)
        beams = [self._beam(field, float(line), errors, focus) for line in lines]
        middle = np.sum([w * beam.place[0] for w, beam in zip(weights, beams, strict=True)], axis=0)
        rows, right, each = [], [], []
        for k, beam in enumerate(beams):
            offset = beam.place - middle
            along = np.sum(beam.way * offset, axis=-1)
            # back along the ray to the sphere about the middle
            back = along + np.sqrt(along**2 + self.radius**2 - np.sum(offset**2, axis=-1)) - self.radius
            error = (beam.path - back)[1:] / self.spec.wavelength
            rows.append(np.column_stack([np.eye(len(lines))[np.full(len(error), k)], self.points[1:]]))
            right.append(error - error.mean())
            each.append(weights[k] * self.share)
        table, value, weight = np.concatenate(rows), np.concatenate(right), np.concatenate(each)
        root = np.sqrt(weight)
        fit, *_ = np.linalg.lstsq(table * root[:, None], value * root, rcond=None)
        return float(weight @ (value - table @ fit) ** 2)

    def adjusted(self, errors: Mapping[str, float]) -> tuple[float, list[float]]:
        """Focus that makes the sum over the fields least, metres along z, and their mean squares."""
        found = minimize_scalar(
            lambda focus: sum(self.square(field, errors, focus) for field in FIELDS),
            bracket=(-1e-4, 1e-4),
            options={"xtol": 1e-9},
        )
        return float(found.x), [self.square(field, errors, float(found.x)) for field in FIELDS]


ALTERED: dict[str, tuple[dict[str, float], dict[str, float]]] = {
    "as designed": ({}, {}),
    "crown of another Abbe number": ({"crown_abbe": 1.0}, {"L1 abbe": 0.01}),
    "flint of another Abbe number": ({"flint_abbe": -1.0}, {"L3 abbe": -0.008}),
    "flint of another index": ({"flint_index": 1.0}, {"L3 index": 5e-4}),
    "all, decentred": (
        {"crown_abbe": -0.7, "flint_abbe": 0.9, "flint_index": -0.5, "decentre": 1.0},
        {"L1 abbe": -0.007, "L3 abbe": 0.0072, "L3 index": -2.5e-4, "decentre": 50e-6},
    ),
}


@pytest.mark.second
@pytest.mark.parametrize("case", ALTERED)
def test_wavefronts_over_the_light_are_those_of_our_own_trace(case: str, bench: ToleranceBench) -> None:
    """With focus refound. A lens that is moved along the camera's x moves along the line."""
    drawn, errors = ALTERED[case]
    x = np.array([[drawn.get(number.name, 0.0) for number in bench.numbers]])
    tried = bench.adjust_cameras(x * bench.sizes)
    model = bench.optics.model
    turned = {key: value for key, value in errors.items() if key != "decentre"}
    if "decentre" in errors:
        body = bench.instrument.assembly.nominal_pose(f"{bench.optics.path.root}/L3").rotation[:, 0]
        root = bench.instrument.assembly.nominal_pose(bench.optics.path.root).rotation
        way = model.camera_frame.rotation @ root.T @ body
        np.testing.assert_allclose(np.abs(way), [1.0, 0.0, 0.0], atol=1e-12)
        turned["decentre"] = float(way[0]) * errors["decentre"]
    focus, squares = OwnTrace(model, bench.optics.path.stop.radius).adjusted(turned)
    # rays aimed to 1e-8 m, wavefronts by polynomials that leave a thousandth of a wave at most
    np.testing.assert_allclose(np.sqrt(tried.parts[0, :2]), np.sqrt(squares), rtol=2e-4)
    assert abs(abs(tried.moves[0, 0]) - abs(focus)) < 2e-6


@pytest.mark.second
def test_an_abbe_number_acts_at_a_design_wavelength_beside_the_d_line(backend: Backend, tmp_path: Path) -> None:
    """The camera of one line, C, is one whose crown has another index there."""
    red = colour_camera("achromat").model_copy(update={"wavelength": 656.2725e-9, "spectrum": None})
    own, twin_index = red.index_behind("L1"), red.index_behind("L1", D_LINE)
    change = (own - twin_index) * (1.0 / 1.01 - 1.0)
    merits = {"wavefront": TEXTS["lens"]["merits"]["wavefront"]}
    tolerances = {
        "abbe": {"motion": "L1 abbe", "limit": "1 percent"},
        "index": {"motion": "L1 index", "limit": abs(change)},
    }
    one = ToleranceBench(lens_budget(tmp_path, red, merits=merits, tolerances=tolerances, compensators={}), backend)
    both = one.adjust_cameras(np.array([[1.0, 0.0], [0.0, np.sign(change)], [0.0, 0.0]]) * one.sizes).parts
    np.testing.assert_allclose(both[0], both[1], rtol=1e-9)
    assert np.max(np.abs(both[0] - both[2])) > 1e-3


@pytest.mark.second
def test_mtfs_over_the_light_are_those_of_the_camera_program(bench: ToleranceBench) -> None:
    x = np.array([[0.0] * 4, [0.8, -0.9, 0.0, 1.0], [0.8, -0.9, 0.6, 1.0]])
    tried = bench.adjust_cameras(x * bench.sizes)
    values = bench.values(tried.parts)[:, 1]
    states = states_of((*bench.numbers, *bench.compensators), np.concatenate([x * bench.sizes, tried.moves], axis=1))
    frequency = np.array([0.0, 30e3])
    # the last has another focal length by 4e-4, and with it another cut-off, which a tolerance run leaves as designed
    for state, value, close in zip(states, values, (1e-7, 2e-5, 4e-4), strict=True):
        mtfs = bench.optics.in_state(state).mtfs(bench.fields, frequency, bench.colours, bench.shares)
        assert value == pytest.approx(min(float(np.min(mtf.values[:, 1])) for mtf in mtfs), abs=close)
    assert values[1] < values[0] - 0.01


def test_light_of_a_band_takes_as_many_wavelengths_as_it_needs(backend: Backend, tmp_path: Path) -> None:
    camera = colour_camera("achromat", "[500 nm, 640 nm]")
    band = ToleranceBench(lens_budget(tmp_path, camera, merits=WAVEFRONT), backend)
    values = band.values(band.adjust_cameras(np.zeros((1, 4))).parts)[0]
    assert len(band.colours) > 3
    assert camera.light is not None
    band._prepare_in(*camera.light.rule(2 * len(band.colours)))
    fine = band.values(band.adjust_cameras(np.zeros((1, 4))).parts)[0]
    np.testing.assert_allclose(values, fine, rtol=0, atol=5e-4)
    design = ToleranceBench(lens_budget(tmp_path, camera, merits=WAVEFRONT, light="design"), backend)
    assert design.colours.tolist() == [D_LINE]
    alone = design.values(design.adjust_cameras(np.zeros((1, 4))).parts)[0]
    assert alone[0] < 0.8 * values[0]


@pytest.mark.parametrize(
    ("changes", "why"), [({"spectrum": "[400 nm, 1000 nm]"}, ""), ({"image": "300 mm"}, ": a transfer function needs")]
)
def test_a_blurred_camera_has_no_mtf_for_tolerances(backend: Backend, tmp_path: Path, changes: dict, why: str) -> None:
    with pytest.raises(InputError, match=rf"merits\.mtf: the MTF of the designed camera has not converged{why}"):
        ToleranceBench(lens_budget(tmp_path, colour_camera("achromat", **changes)), backend)


def test_colours_too_far_apart_for_a_sum_are_told_at_the_light(backend: Backend, tmp_path: Path) -> None:
    camera = colour_camera("achromat", "[350 nm, 2000 nm]")
    with pytest.raises(InputError, match=r"light: merits over .* the lateral colour is too large.*light: design"):
        ToleranceBench(lens_budget(tmp_path, camera, merits=WAVEFRONT), backend)


@pytest.mark.parametrize(
    ("place", "name", "error", "words"),
    [
        (tolerance_bench, "VariedBeams", VignettedBeamError("cut"), "merits: cut.*fields whose light is not vignetted"),
        (tolerance_bench, "VariedBeams", RoughWavefrontError("rough"), "merits: rough.*a sharper camera"),
        (CameraOptics, "colour_pupils", UnphysicalError("more light"), r"merits\.mtf: .* has no MTF: more light"),
    ],
)
def test_light_that_no_merit_is_told_of_is_refused(place, name, error, words, backend, tmp_path, monkeypatch) -> None:
    def refuse(*_: object) -> None:
        raise error

    monkeypatch.setattr(place, name, refuse)
    with pytest.raises(InputError, match=words):
        ToleranceBench(lens_budget(tmp_path), backend)


@pytest.mark.second
def test_a_run_tells_its_light(backend: Backend, tmp_path: Path) -> None:
    told = TOLERANCE(run_tolerance(lens_budget(tmp_path), backend))
    assert told["wavelengths_nm"] == pytest.approx([486.1327, 587.5618, 656.2725])
    assert told["weights"] == pytest.approx([0.25, 0.5, 0.25])
    shares = told["merits"]["wavefront"]["variance_shares"]
    assert shares["crown_abbe"] > 0.01


# --- merits of an instrument's monitor and of bodies in its beams -----------------------------------------------------


ARCSEC = np.radians(1.0 / 3600.0)
NEAR = 1e-4
"""Relative difference of sigmas by their noise alone: it makes 2e-4 of the variances, and the bound of a spot's noise
and what its fit finds, of which the pattern of the pixels cancels in part, differ by a fifth."""


@pytest.fixture(scope="module")
def pair_bench(backend, tmp_path_factory: pytest.TempPathFactory) -> ToleranceBench:
    return ToleranceBench(budget(tmp_path_factory.mktemp("monitor"), "pair"), backend)


def amounts(pair_bench: ToleranceBench, *rows: dict[str, float]) -> np.ndarray:
    """Amounts of the tolerances and compensators by name, in units of the limits, SI, (S, K)."""
    names = [one.name for one in (*pair_bench.numbers, *pair_bench.compensators)]
    shares = np.array([[row.get(name, 0.0) for name in names] for row in rows])
    return shares * [*pair_bench.sizes, *pair_bench.ranges]


def test_the_designed_instrument_is_that_of_the_command_uncertainty(pair_bench: ToleranceBench) -> None:
    experiment = pair_bench.experiment
    limits = find_limits(experiment, expected_covariance(experiment, experiment.resolved.frames), 9)
    assert limits is not None
    said = {
        (one.group, one.key, name): float(limits.splits[name].sigma[k])
        for k, one in enumerate(limits.quantities)
        for name in ("posterior", "derived")
    }
    nothing = pair_bench.values(pair_bench.adjust_cameras(np.zeros((1, len(pair_bench.numbers)))).parts)[0]
    assert nothing[1] == pytest.approx(said["intersection_angle", "change_arcsec", "posterior"] * ARCSEC, rel=NEAR)
    assert nothing[2] == pytest.approx(said["forward", "d_gamma_arcsec", "derived"] * ARCSEC, rel=NEAR)
    assert nothing[3] == pytest.approx(said["forward", "d_f_um", "posterior"] * 1e-6, rel=NEAR)
    # another estimator is another number
    assert said["forward", "d_gamma_arcsec", "derived"] > 1.05 * said["forward", "d_gamma_arcsec", "posterior"]


@pytest.mark.second
def test_a_built_instrument_is_that_of_the_main_job(pair_bench: ToleranceBench) -> None:
    """Its frames are exposed, its spots fitted: sigma of every spot, and those of the readings."""
    monitor, experiment = pair_bench.monitor, pair_bench.experiment
    assert monitor is not None
    # a spot may not leave its CCD in the main job; 1 arcsec of the mirror is 7 px
    x = amounts(
        pair_bench, {"despace": 0.5, "radius": -0.3}, {"tilt": 0.05, "radius": 0.5, "focus": 0.4}, {"focus": 0.9}
    )
    states = states_of((*pair_bench.numbers, *pair_bench.compensators), x)
    found = monitor.variances(x, states)
    record = shared_detector(experiment, experiment.resolved.frames, 1)
    (seen,) = observe(experiment, states, ObservationOptions(record))
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
def test_the_noise_of_blurred_spots_is_that_of_a_fit_to_them(pair_bench: ToleranceBench) -> None:
    """With the shape that they have, as it is calibrated when the instrument is built."""
    monitor, experiment = pair_bench.monitor, pair_bench.experiment
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
def test_derivatives_are_those_of_central_differences(pair_bench: ToleranceBench) -> None:
    """Every stated motion both ways about a built instrument, by the traces that tell spots and truth."""
    monitor, experiment = pair_bench.monitor, pair_bench.experiment
    assert monitor is not None
    x = amounts(pair_bench, {"tilt": 1.0, "radius": 1.0})
    about = states_of((*pair_bench.numbers, *pair_bench.compensators), x)
    motions, designed = experiment.prior, experiment.disturbances
    assert motions is not None
    assert designed is not None
    steps = np.array([{**STEPS, **SMALL}[c.kind] for c in motions.components])
    states = [
        state_of(row, motions.components, experiment.thermal, about[0])
        for row in np.concatenate([np.diag(steps), -np.diag(steps)])
    ]
    spots = np.moveaxis(experiment.path.coarse_trace(states).centre, 1, 2).reshape(-1, len(states))
    truth = experiment.sight.truth(states)
    parameters = np.concatenate([truth.vector(name).T for name in truth.cameras])
    count = len(steps)
    slopes = [(one[:, :count] - one[:, count:]) / (2.0 * steps) * motions.sigma for one in (spots, parameters)]
    stated = replace(designed, spots=slopes[0], parameters=slopes[1])
    noise = noise_as_built(monitor.path, experiment.detector, about)[0]
    row = quantity_rows(experiment.instrument, None)
    found, plain = monitor.exact(about), np.zeros((1, x.shape[1]))
    designed_values = monitor.variances(plain, states_of((*pair_bench.numbers, *pair_bench.compensators), plain))
    for name, key in (("angle", "angle"), ("f", "forward/d_f")):
        sigma = split(row[key], stated, noise, stated.best_gain(noise)).sigma[0]
        value, before = np.sqrt(found[name][0, 0]), np.sqrt(designed_values[name][0, 0])
        assert abs(sigma - before) > 1e-5 * before
        # steps are finite on both sides: 1e-7, a hundredth of what changes
        assert value == pytest.approx(sigma, rel=3e-7)


def test_area_ccds_are_set_to_their_spots(pair_bench: ToleranceBench) -> None:
    """A tilt that takes a spot off its CCD in the main job; and a chip that is moved by whole pixels."""
    monitor = pair_bench.monitor
    assert monitor is not None
    x = amounts(pair_bench, {"tilt": 1.0}, {})
    states = states_of((*pair_bench.numbers, *pair_bench.compensators), x)
    place = pair_bench.experiment.path.coarse_trace(states[:1]).centre
    assert np.max(np.abs(place)) > 0.5 * pair_bench.experiment.path.shape[0]
    assert np.all(np.isfinite(monitor.variances(x, states)["angle"]))
    chip = {"base/forward/focal_plane/left/area_ccd": Motion(shift=(24e-6, -36e-6, 0.0))}
    moved, still = monitor._noise([chip, {}])
    np.testing.assert_allclose(moved, still, rtol=1e-6, atol=1e-12)


@pytest.mark.second
def test_bodies_take_what_image_quality_says(pair_bench: ToleranceBench, backend) -> None:
    """Of the beams of the pixels that are looked at there, in states in which a prism and a mirror are moved."""
    x = amounts(pair_bench, {}, {"prism": 1.0}, {"prism": -0.5, "tilt": 0.5})
    states = states_of((*pair_bench.numbers, *pair_bench.compensators), x)
    path, half = (
        pair_bench.optics.path,
        0.5 * pair_bench.optics.model.spec.line.pixels * pair_bench.optics.model.spec.line.pitch,
    )
    places = np.array([[half, 0.0], [0.0, 0.0], [-half, 0.0]])
    quality = image_quality(pair_bench.instrument, backend, states, (1.0, 0.0, -1.0)).cameras["forward"]
    for s, state in enumerate(states):
        light = path.directions(places, state)
        found = obstructed_shares(path, [state], light, path._launch(light))[0]
        said = sum(share[s] for share in quality.bodies.values())
        np.testing.assert_allclose(found, said, atol=1e-6)
    tried = pair_bench.values(pair_bench.adjust_cameras(x[:, : len(pair_bench.numbers)]).parts)[:, 4]
    merit = next(one for one in pair_bench.merits if one.name == "shadow")
    shares = obstructed_shares(path, states[:2], pair_bench.beams.directions, pair_bench.beams.start)
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
