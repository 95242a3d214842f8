"""The state of one instrument: every kind of measurement against another way to compute it, estimates, moves, input."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
from astropy.io import fits
from scipy.interpolate import CubicSpline
from scipy.linalg import block_diag, null_space

from analysis.arrays import ARCSEC
from analysis.instrument_state.state_estimate import ConsistencyTest
from analysis.wavefront_maps.pupil_fit import Orientation
from optics.geometry import zernike
from optics.numerics.array_math import UnphysicalError
from optics.numerics.backend import Backend
from optics.raytrace.trace import BeamMissedError
from scenes.specs.asbuilt import AsBuiltSetup
from scenes.specs.load import EXAMPLES
from scenes.specs.tolerance import MeritSpec
from scenes.yaml.errors import InputError
from scenes.yaml.yaml_file import dump_yaml
from tests.twin.study_bench import TEXTS, refusals
from twin.asbuilt import asbuilt_run
from twin.asbuilt.asbuilt_bench import AsBuiltBench
from twin.asbuilt.asbuilt_run import ASBUILT, _prediction, _warnings, motions, require_consistency, run_asbuilt
from twin.asbuilt.next_step import advice, expected, optimal_move
from twin.asbuilt.orientation_check import run_check
from twin.camera.camera_optics import CameraOptics
from twin.camera.varied_beams import VariedBeams
from twin.monitor.image_quality import image_quality
from twin.monitor.monitor_derivative import spot_jacobian
from twin.monitor.truth import ElementaryMotion
from twin.tolerance.monitor_merit import Merit

FIVE = [[-1, 0], [-0.5, 0], [0, 0], [0.5, 0], [1, 0]]
ONE = {"wavefronts": {"one": {"fields": [[0, 0]], "sigma": "5 nm"}}}
MERITS = {"wavefront": {"kind": "wavefront", "at_most": 0.0714}}


def written(folder: Path, measurements: dict, prior: str = "parts", **more) -> Path:
    """A file of measurements, and its prior beside it; a key of None is left out."""
    (folder / "parts.yaml").write_text(dump_yaml(TEXTS[prior]))
    data = {"instrument": "gf7", "prior": "./parts.yaml", "measurements": measurements, "merits": MERITS} | more
    data = {key: value for key, value in {"simulate": {}, **data}.items() if value is not None}
    (folder / "asbuilt.yaml").write_text(dump_yaml(data))
    return folder / "asbuilt.yaml"


def bench_of(backend: Backend, folder: Path, measurements: dict, prior: str = "parts", **more) -> AsBuiltBench:
    return AsBuiltBench(AsBuiltSetup.read(written(folder, measurements, prior, **more)), backend)


@pytest.fixture(scope="module")
def whole(backend, tmp_path_factory) -> AsBuiltBench:
    """gf7 with every kind of measurement that a camera alone allows."""
    return bench_of(backend, tmp_path_factory.mktemp("whole"), TEXTS["measured"])


def kind_named(bench: AsBuiltBench, name: str):
    return next(kind for kind in bench.kinds if kind.name == name)


@pytest.mark.second
def test_predictions_are_what_other_commands_trace(whole) -> None:
    """Of three instruments of the prior, and of the designed one.

    Zernike terms and MTFs of ``CameraOptics``, fitted to nodes of its own: both leave 1e-3 waves at the most. Best foci
    differ by the designed camera's as the image quality of pixels has it; there the beam is that of the pixel and not
    of the direction, and the shift goes along the normal: 1 % and 2 um. The point of the line that looks at an angle is
    interpolated from what its points see.
    """
    rng = np.random.default_rng(4)
    values = 0.3 * np.stack([*(whole.draw(rng, "normal") for _ in range(3)), np.zeros(len(whole.parameters.labels))])
    own, instrument = whole.parameters.states(values, None), whole.experiment.instrument
    found = {kind.name: kind.predict(whole.view(values, None)) for kind in whole.kinds}
    foci, wanted = found["collimator"], image_quality(instrument, whole.backend, own, (-1.0, 0.0, 1.0)).cameras["gf7"]
    np.testing.assert_allclose(foci[:3] - foci[3], wanted.defocus[:3] - wanted.defocus[3], rtol=0.01, atol=2e-6)
    turntable = kind_named(whole, "turntable")
    for s, tangents in enumerate(turntable._tangents(own)):
        optics = CameraOptics.within(instrument, "gf7", whole.backend, own[s])
        # beams are those of the designed camera's directions
        waves = [w.parts[3:11] * w.wavelength for w in optics.wavefronts(FIVE, points=5)]
        np.testing.assert_allclose(found["interferometer"][s].reshape(5, 8), waves, atol=1e-3 * whole.merits.wavelength)
        mtfs = [m.values[:, 0] for m in optics.mtfs([[0, 0], [1, 0]], np.array([20e3]))]
        np.testing.assert_allclose(found["mtf"][s].reshape(2, 2), mtfs, atol=2e-3)
        places = CubicSpline(tangents, whole.line)(turntable.tangents)
        np.testing.assert_allclose(found["turntable"][s], places, atol=2e-9)
    for name, least in (("interferometer", 50e-9), ("collimator", 30e-6)):
        assert np.max(np.abs(found[name])) > least
    assert np.std(found["turntable"], axis=0).max() > 1e-6


@pytest.mark.second
def test_positions_are_those_of_the_bodies(whole) -> None:
    """A shift of a body along its own axes stands in those of the base; a rigid motion of all is the free frame's."""
    kind = kind_named(whole, "tracker")
    values = np.zeros((1, len(whole.parameters.labels)))
    names = list(whole.parameters.words)
    values[0, names.index("M2 shift x")] = 1e-4
    found = kind.predict(whole.view(values, None)).reshape(-1, 3)
    pose = whole.experiment.instrument.assembly.nominal_pose("base/gf7/M2")
    root = whole.experiment.instrument.assembly.nominal_pose("base")
    np.testing.assert_allclose(found[1], root.rotation.T @ pose.rotation[:, 0] * 1e-4, atol=1e-12)
    assert not np.any(found[[0, 2, 3]])
    columns, sigmas, _ = kind.biases()
    assert np.all(np.isinf(sigmas))
    assert columns.shape == (12, 6)
    # a turn of the frame moves points by its cross product with their places
    np.testing.assert_allclose(columns[:3, 3], np.cross([1.0, 0.0, 0.0], kind.nominal[0]))


@pytest.mark.second
def test_spots_and_temperatures_of_a_pair(backend, tmp_path) -> None:
    """Derivatives of spots by motions are those of automatic differentiation; a body's temperature is its own, or that
    of what carries it.
    """
    measured = {
        "spots": {"monitor": {"sigma": 0.02}},
        "temperatures": {"sensors": {"bodies": ["base", "forward", "forward/M2", "backward"], "sigma": "0.1 K"}},
    }
    bench = bench_of(backend, tmp_path, measured, "heated", instrument="gf7_pair", camera="forward")
    names = list(bench.parameters.words)
    slope = bench.slope(np.zeros(len(names)))
    pivot = next(one.pivot for one in bench.parameters.components if one.name == "base/forward/M3 rotate y")
    motions = [ElementaryMotion("base/forward/M2", "shift", 0), ElementaryMotion("base/forward/M3", "rotate", 1, pivot)]
    exact = spot_jacobian(bench.experiment.path, motions).reshape(-1, 2)
    columns = [names.index("forward/M2 shift x"), names.index("forward/M3 rotate y")]
    assert np.max(np.abs(exact), axis=0) == pytest.approx(
        np.max(np.abs(slope[: len(exact), columns]), axis=0), rel=1e-4
    )
    np.testing.assert_allclose(slope[: len(exact), columns], exact, atol=1e-4 * np.max(np.abs(exact)))
    warm = slope[len(exact) :]
    own = [names.index("base temperature"), names.index("forward temperature")]
    np.testing.assert_allclose(warm[:, own], [[1, 0], [0, 1], [0, 1], [1, 0]], atol=1e-9)


def test_spots_of_recovered_frames_and_of_tables_are_read(backend, tmp_path) -> None:
    """The same places from recovered.json and from a CSV file, against where the design has the spots."""
    channels = [("forward", "left"), ("forward", "right"), ("backward", "left"), ("backward", "right")]
    spots: dict = {"forward": {}, "backward": {}}
    for k, (camera, channel) in enumerate(channels):
        spots[camera][channel] = {"before": {"row": 1.0, "column": 2.0}, "after": {"row": 40.0 + k, "column": 50.0 - k}}
    (tmp_path / "recovered.json").write_text(json.dumps({"spots": spots}))
    rows = "".join(f"{camera},{channel},{40.0 + k},{50.0 - k}\n" for k, (camera, channel) in enumerate(channels))
    (tmp_path / "spots.csv").write_text(f"camera,channel,row_px,column_px\n{rows}")
    frames = {"file": "recovered.json", "state": "after", "sigma": 0.02}
    measured = {"spots": {"frames": frames, "table": {"file": "spots.csv", "sigma": 0.02}}}
    bench = bench_of(backend, tmp_path, measured, "moving", instrument="gf7_pair", camera="forward", simulate=None)
    frames, table = bench.data()
    np.testing.assert_allclose(frames, table, atol=1e-12)
    places = bench.experiment.path.coarse
    middle = 0.5 * (np.array(bench.experiment.path.shape) - 1.0)
    mean = np.einsum("n,bnk->bk", places.nodes.share, places.rays([{}]).position[..., 1::-1]) / places.pitch
    np.testing.assert_allclose(frames.reshape(-1, 2)[1], np.array([41.0, 49.0]) - middle - mean[1], atol=1e-9)


@pytest.mark.second
def test_a_gross_error_of_one_field_is_named(whole) -> None:
    """Coma of 150 nm too much at one field: it is left out, and the rest tells the same state."""
    rng = np.random.default_rng(9)
    true = whole.draw(rng, "normal")
    data = list(whole.measured(true, rng))
    clean = whole.estimate(data)
    assert not clean.excluded
    table = data[0].reshape(5, 8).copy()
    table[3, 4] += 150e-9
    found = whole.estimate([table.ravel(), *data[1:]])
    assert [(name, block) for name, block, _ in found.excluded] == [("interferometer", "field (0.5, 0)")]
    assert np.max(np.abs(found.mean - clean.mean) / found.sigma) < 3.0


@pytest.mark.second
def test_moves_are_part_of_the_state(backend, tmp_path) -> None:
    """What was moved is known but for its error: the estimate after a move tells where the parts stood before, and how
    far the actuator really went.
    """
    actuators = {"z": {"motion": "M2 shift z", "range": "1 mm", "response": 0.2, "move_error": 0.001}}
    two = {name: {"fields": FIVE, "sigma": "2 nm", "focus": "1 um"} for name in ("before", "later")}
    two["later"]["after"] = "poke"
    bench = bench_of(
        backend, tmp_path, {"wavefronts": two}, actuators=actuators, moves={"poke": {"by": {"z": "200 um"}}}
    )
    assert bench.parameters.labels[-2:] == ("response of z", "error of poke z")
    rng = np.random.default_rng(2)
    true = bench.draw(rng, "normal")
    true[-2] = 0.13
    found = bench.estimate(bench.measured(true, rng))
    assert abs(found.mean[-2] - 0.13) < 3.5 * found.sigma[-2]
    assert found.sigma[-2] < 0.02
    # without a range nothing more is moved
    still = bench_of(
        backend, tmp_path, {"wavefronts": {"one": two["before"]}}, actuators={"z": {**actuators["z"], "range": "0 um"}}
    )
    assert not np.any(optimal_move(still, np.zeros(len(still.parameters.labels)), None).amounts)


def written_maps(folder: Path, coefficients: np.ndarray, orientation: Orientation) -> list[str]:
    """FITS files of wavefronts (F, 8) of Z4 to Z11, as an interferometer has them that lies so."""
    names = []
    axis = np.linspace(-1.0, 1.0, 121)
    x, y = np.meshgrid(axis, axis)
    basis = zernike.basis(11, x.ravel(), y.ravel())
    for k, row in enumerate(coefficients):
        values = (basis[:, 3:] @ row).reshape(x.shape) + 40e-9 * x + 200e-9
        values[np.hypot(x, y) > 1.0] = np.nan
        turned = orientation.inverse.values(values)
        card = fits.PrimaryHDU(turned * 1e9)
        card.header["BUNIT"] = "nm"
        names.append(f"field_{k}.fits")
        card.writeto(folder / names[-1])
    return names


@pytest.mark.parametrize(
    "name", ["mirrored diagonal", *(pytest.param(one, marks=pytest.mark.second) for one in ("as it is", "turned 90"))]
)
def test_maps_and_tables_hold_the_same(backend, tmp_path, name) -> None:
    """Coefficients of double-pass maps on a grid of 121 points are those that made them, to 1 %; of a table exactly."""
    rng = np.random.default_rng(1)
    wanted = 50e-9 * rng.standard_normal((2, 8))
    lies = Orientation.named(name, -1)
    reference = 4e-9 * np.arange(4, 12)
    shown = 2.0 * wanted + lies.coefficients(reference[None], tuple(range(4, 12)))
    maps = written_maps(tmp_path, shown, lies)
    (tmp_path / "reference.csv").write_text(
        "# order: noll\n# normalised: rms\n# unit: nm\nindex,coefficient\n"
        + "".join(f"{j},{4 * j}\n" for j in range(4, 12))
    )
    turned = lies.inverse.coefficients(shown, tuple(range(4, 12)))
    lines = "".join(",".join(repr(float(value) * 1e9) for value in row) + "\n" for row in turned)
    head = ",".join(f"Z{j}" for j in range(4, 12))
    (tmp_path / "table.csv").write_text(f"# order: noll\n# normalised: rms\n# unit: nm\n{head}\n{lines}")
    stated = TEXTS["maps"] | {"orientation": name}
    measured = {"maps": {**stated, "maps": maps}, "table": {**stated, "zernikes": "table.csv"}}
    bench = bench_of(backend, tmp_path, {"wavefronts": measured}, simulate=None)
    of_maps, of_table = (values.reshape(2, 8) for values in bench.data())
    np.testing.assert_allclose(of_maps, wanted, atol=0.01 * np.abs(wanted).max())
    np.testing.assert_allclose(of_table, wanted, atol=1e-15)
    (tmp_path / "sphere").mkdir()
    (sphere,) = written_maps(tmp_path / "sphere", lies.coefficients(reference[None], tuple(range(4, 12))), lies)
    measured = {"maps": {**stated, "maps": maps, "reference": f"sphere/{sphere}"}}
    (less,) = bench_of(backend, tmp_path, {"wavefronts": measured}, simulate=None).data()
    np.testing.assert_allclose(less.reshape(2, 8), of_maps, atol=0.01 * np.abs(wanted).max())


def test_a_reference_of_another_size_is_refused(backend, tmp_path) -> None:
    maps = written_maps(tmp_path, np.zeros((2, 8)), Orientation.named("turned 90"))
    fits.PrimaryHDU(np.zeros((50, 50)), fits.Header({"BUNIT": "nm"})).writeto(tmp_path / "small.fits")
    measured = {"maps": {**TEXTS["maps"], "maps": maps, "reference": "small.fits"}}
    with pytest.raises(InputError, match="the reference has another number of points"):
        bench_of(backend, tmp_path, {"wavefronts": measured}, simulate=None).data()


@pytest.mark.second
def test_an_orientation_is_found_after_a_move(backend, tmp_path) -> None:
    """With a move that is known the reading is found; of a camera that was only assembled others are named with it."""
    one, before = Orientation.named("mirrored diagonal", -1), TEXTS["mirrored"]
    for measured, more in (
        ({"before": before, "later": before | {"after": "poke"}}, TEXTS["poked"]),
        ({"one": before}, {}),
    ):
        found = run_check(AsBuiltSetup.read(written(tmp_path, {"wavefronts": measured}, **more)), backend)
        assert (found.code, one in found.evidence.indistinguishable) == (0, True)
        assert (found.evidence.determined == one) == (len(found.evidence.indistinguishable) == 1) == bool(more)


def test_files_of_the_laboratory_are_read(backend, tmp_path) -> None:
    """Best foci and places along the line from the JSON files of the laboratory's runs."""
    for name in ("focus.json", "distortion.json"):
        (tmp_path / name).write_text(json.dumps(TEXTS[name]))
    focus, distortion = {"file": "focus.json", "sigma": "3 um"}, {"file": "distortion.json"}
    bench = bench_of(backend, tmp_path, {"focus": {"f": focus}, "distortion": {"d": distortion}}, simulate=None)
    foci, places = bench.data()
    np.testing.assert_allclose(foci, [0.8e-6, -1e-6, -2.8e-6], atol=1e-15)
    np.testing.assert_allclose(places, [-0.096, 0.0, 0.096])
    np.testing.assert_allclose(np.sqrt(np.diagonal(bench.kinds[1].covariance())), [1.5e-6, 0.5e-6, 1.5e-6])


@pytest.mark.second
def test_one_state_without_light_leaves_the_others(backend, tmp_path, monkeypatch) -> None:
    """Its merit is not known, those of the others are as alone, and the next move is still told."""
    measured = {"focus": {"collimator": {"fields": [[0, 0]], "sigma": "3 um"}}}
    actuators = {"focus": {"motion": "focal_plane shift z", "range": "1 mm"}}
    bench = bench_of(backend, tmp_path, measured, actuators=actuators)
    rng = np.random.default_rng(1)
    found = bench.estimate(bench.measured(bench.draw(rng, "normal"), rng))
    draws = found.draw(rng, 5)
    whole = expected(bench, draws, None)
    numbers = bench.merit_residuals

    def without(values, after, further=None):
        if np.any(np.all(values == draws[3], axis=1)):
            raise UnphysicalError("lost")
        return numbers(values, after, further)

    monkeypatch.setattr(bench, "merit_residuals", without)
    told = expected(bench, draws, None)
    assert np.isnan(told[3])
    np.testing.assert_allclose(np.delete(told, 3), np.delete(whole, 3), rtol=1e-9)
    step = advice(bench, found, draws, rng)
    assert step.before == pytest.approx(np.mean(np.delete(whole, 3)), rel=1e-9)
    assert np.isfinite(step.after)


def test_a_run_from_file_to_numbers(backend, tmp_path) -> None:
    """Numbers of a whole run: those of the estimate in the units of the file, and the truth where it is said to be."""
    setup = AsBuiltSetup.read(written(tmp_path, **TEXTS["whole_run"]))
    streams = []
    with pytest.MonkeyPatch.context() as patch:
        own = asbuilt_run.stream
        patch.setattr(asbuilt_run, "stream", lambda *numbers: streams.append(numbers) or own(*numbers))
        run = run_asbuilt(setup, backend)
    assert len(set(streams)) == len(streams) == 5
    told = ASBUILT(run)
    assert told["whole"]["agrees"]
    assert run.warnings == ()
    assert told["next_move"]["merit_after"] <= told["next_move"]["merit_before"]
    assert told["next_move"]["merit_reductions"]["collimator"] > 0.0
    sigmas = [one["sigma"] for one in told["combinations"]]
    assert sigmas == sorted(sigmas)
    assert sigmas[-1] == pytest.approx(1.0, abs=1e-6)
    # a chi-square that contradicts the prior makes every sigma larger by its root per degree of freedom
    whole = replace(run.estimate.whole, chi_square=4.0 * run.estimate.whole.degrees)
    wide = replace(run, estimate=replace(run.estimate, whole=whole))
    sizes = {"um": 1e-6, "arcsec": ARCSEC, "nm": 1e-9}
    for factor, rows in ((1.0, motions(run)), (2.0, motions(wide))):
        for k, row in enumerate(rows):
            size = sizes[row["unit"]]
            assert row["value"] == pytest.approx(run.estimate.mean[k] / size)
            assert row["true"] == pytest.approx(run.true[k] / size)
            assert row["prior_sigma"] == pytest.approx(np.sqrt(run.estimate.prior.covariance[k, k]) / size)
            assert row["sigma"] == pytest.approx(factor * np.sqrt(run.estimate.covariance[k, k]) / size)
    assert [one["sigma"] for one in ASBUILT(wide)["combinations"]] == pytest.approx(
        np.minimum(1.0, 2.0 * np.array(sigmas))
    )


def test_quantiles_and_chances_of_a_merit_are_those_of_its_draws() -> None:
    """Draws without light meet no requirement and are in no quantile; a value on its limit meets it."""
    merit = Merit("w", MeritSpec.model_validate({"kind": "wavefront", "at_most": 0.5}), np.array([0]), slice(0, 1))
    rng = np.random.default_rng(2)
    before, now = (rng.uniform(0.0, 1.0, (60, 1)) ** 2 for _ in range(2))
    now[:4], now[4] = np.nan, 0.25
    found = _prediction(merit, np.array([0.01]), (before, now, None), np.array([0.09]))
    shares = (2.5, 16.0, 50.0, 84.0, 97.5)
    assert found.before == pytest.approx(np.percentile(np.sqrt(before), shares))
    assert found.now == pytest.approx(np.percentile(np.sqrt(now[4:]), shares))
    assert found.meets == np.sum(np.sqrt(now[4:]) <= 0.5) / 60.0
    assert (found.designed, found.true) == pytest.approx((0.1, 0.3))
    assert found.moved == ()
    assert np.isnan(found.meets_moved)
    moved = _prediction(merit, np.array([0.01]), (before, now, before), None)
    assert (moved.moved, moved.meets_moved) == (moved.before, np.mean(np.sqrt(before) <= 0.5))
    assert np.isnan(moved.true)


def state(**changes) -> SimpleNamespace:
    """Return an estimate of two measurements that agree, but for what is changed."""
    good = [ConsistencyTest.of(name, 9.0, 10) for name in ("focus", "sight")]
    own = {"excluded": (), "whole": ConsistencyTest.of("", 20.0, 20), "measurements": good, "variance_factor": 1.0}
    own |= {"converged": True, "steps": 3, "settled": 0.001}
    return SimpleNamespace(**{**own, **changes})


def test_each_warning_is_there_where_it_holds_and_no_other() -> None:
    lit = np.ones((5, 2))
    # 29.59 is exceeded by chi-square of ten degrees once in a thousand, 32.0 once in two thousand: two are looked at
    assert (
        _warnings(
            state(measurements=[ConsistencyTest.of("focus", 31.0, 10), ConsistencyTest.of("sight", 9.0, 10)]), lit
        )
        == []
    )
    dark = lit.copy()
    dark[2, 1] = np.nan
    bad = ConsistencyTest.of("focus", 45.0, 10)
    for found, parts, text in (
        (
            state(excluded=[("focus", "field 0", bad)]),
            lit,
            "focus: field 0 contradicts all other measurements (chi-square 45",
        ),
        (
            state(whole=ConsistencyTest.of("", 80.0, 20), variance_factor=4.0),
            lit,
            "the measurements do not agree with the prior and their specified errors (chi-square 80 for 20 degrees of "
            "freedom); all sigmas are multiplied by 2",
        ),
        (
            state(measurements=[bad, bad.of("sight", 1.0, 10)]),
            lit,
            "focus does not agree with the prediction from all others",
        ),
        (state(), dark, "1 of 5 states of the posterior have no light; they count as failed"),
    ):
        (said,) = _warnings(found, parts)
        assert said.startswith(text)


@pytest.mark.second
def test_estimates_that_do_not_settle_or_contradict_themselves_are_refused(whole) -> None:
    """Nine times the degrees of freedom is still an estimate; more names what agrees least."""
    names = [kind.name for kind in whole.kinds]
    each = [ConsistencyTest.of(name, 30.0 if name == "mtf" else 9.0, 10) for name in names]
    require_consistency(whole, state(whole=ConsistencyTest.of("", 180.0, 20), measurements=each))
    with pytest.raises(InputError, match="their residuals are 3 standard deviations on average") as caught:
        require_consistency(whole, state(whole=ConsistencyTest.of("", 180.1, 20), measurements=each))
    assert "measurements.mtf.mtf" in str(caught.value)
    with pytest.raises(
        InputError, match=r"not converged after 3 steps: one more changes the predicted readings by 0\.5"
    ):
        require_consistency(whole, state(converged=False, settled=0.5))


@pytest.mark.second
def test_the_posterior_is_that_of_the_joint_normal_distribution(whole) -> None:
    """Dense conditioning on all numbers at once, with biases as random numbers; free ones are projected out."""
    rng = np.random.default_rng(5)
    found = whole.estimate(whole.measured(0.1 * whole.draw(rng, "normal"), rng))
    rows, noises = [], []
    slope, first = whole.slope(found.mean), 0
    for kind in whole.kinds:
        own = slope[first : first + len(kind.labels)]
        first += len(kind.labels)
        columns, sigmas, _ = kind.biases()
        free = np.isinf(sigmas)
        noise = kind.covariance() + (columns[:, ~free] * sigmas[~free] ** 2) @ columns[:, ~free].T
        keep = null_space(columns[:, free].T).T if free.any() else np.eye(len(own))
        rows.append(keep @ own)
        noises.append(keep @ noise @ keep.T)
    h, r, prior = np.concatenate(rows), block_diag(*noises), found.prior.covariance
    gain = prior @ h.T @ np.linalg.inv(h @ prior @ h.T + r)
    scale = np.sqrt(np.outer(np.diag(prior), np.diag(prior)))
    np.testing.assert_allclose(found.covariance / scale, (prior - gain @ h @ prior) / scale, atol=2e-4)
    np.testing.assert_allclose(found.sigma, np.sqrt(np.diag(found.covariance)), rtol=1e-9)
    draws = found.draw(rng, 4000)
    # a standard deviation of 4000 draws is right to 1.1 %; 4.5 of them, of some 30 motions
    np.testing.assert_allclose(np.std(draws, axis=0), found.sigma, rtol=0.05)
    # where everything together contradicts what is stated, draws are wider by the root of chi-square per degree
    doubted = replace(found, whole=replace(found.whole, chi_square=9.0 * found.whole.degrees))
    np.testing.assert_allclose(np.std(doubted.draw(rng, 4000), axis=0), 3.0 * found.sigma, rtol=0.05)


@pytest.mark.parametrize(("changes", "words"), refusals("asbuilt"))
def test_bad_input_has_one_message(backend, tmp_path, changes, words) -> None:
    """File, line, key and what is allowed."""
    with pytest.raises(InputError) as caught:
        AsBuiltBench(AsBuiltSetup.read(written(tmp_path, **{"measurements": ONE, **changes})), backend)
    assert words in str(caught.value)
    assert "asbuilt.yaml" in str(caught.value)


def test_a_measurement_that_no_light_comes_to_is_told_at_its_key(backend, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(VariedBeams, "_rays", Mock(side_effect=BeamMissedError("light is lost")))
    with pytest.raises(InputError, match=r"asbuilt\.yaml:\d+: measurements\.wavefronts\.one: light is lost"):
        bench_of(backend, tmp_path, ONE)


@pytest.mark.parametrize(("kind", "keys", "files", "text", "words"), refusals("unread"))
def test_files_that_hold_no_measurement_are_refused(backend, tmp_path, kind, keys, files, text, words) -> None:
    names = [name for value in files.values() for name in ([value] if isinstance(value, str) else value)]
    (tmp_path / names[0]).write_text(text)
    pair = {"instrument": "gf7_pair", "camera": "forward", "prior": "moving"} if kind == "spots" else {}
    with pytest.raises(InputError, match=re.escape(words)):
        bench_of(backend, tmp_path, {kind: {"one": keys | files}}, simulate=None, **pair).data()


@pytest.mark.parametrize(("run", "changes", "words"), refusals("states"))
def test_what_no_state_can_be_estimated_of_is_refused(backend, tmp_path, run, changes, words) -> None:
    setup = AsBuiltSetup.read(written(tmp_path, **{"measurements": ONE, **changes}))
    with pytest.raises(InputError, match=words):
        (run_asbuilt if run == "estimate" else run_check)(setup, backend)


def test_an_instrument_as_built_is_not_drawn(backend, tmp_path) -> None:
    with pytest.raises(InputError, match="this instrument is already as built"):
        bench_of(backend, tmp_path, ONE, instrument=str(EXAMPLES / "as_built_pair.yaml"))
