"""The state of one instrument: every kind of measurement against another way to compute it, estimates, moves, input."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from astropy.io import fits
from scipy.linalg import block_diag, null_space

from analysis.instrument_state.state_estimate import Agreement
from analysis.units import ARCSEC
from analysis.wavefront_maps.orientation import Orientation
from optics.geometry import zernike
from optics.numerics.backend import Backend
from optics.numerics.physical_error import UnphysicalError
from scenes.specs.asbuilt import resolve_asbuilt
from scenes.specs.load import EXAMPLES
from scenes.specs.tolerance import MeritSpec
from scenes.yaml.errors import InputError
from scenes.yaml.yaml_file import dump_yaml, parse_yaml
from twin.asbuilt import asbuilt_run
from twin.asbuilt.asbuilt_bench import AsBuiltBench
from twin.asbuilt.asbuilt_run import ASBUILT, _standing, _warnings, motions, require_agreement, run_asbuilt
from twin.asbuilt.next_step import advice, align, expected, wanted_move
from twin.asbuilt.orientation_check import run_check
from twin.camera.camera_optics import CameraOptics
from twin.monitor.image_quality import image_quality
from twin.monitor.monitor_derivative import spot_jacobian
from twin.monitor.motions import ElementaryMotion
from twin.tolerance.merits import Merit

FIVE = [[-1, 0], [-0.5, 0], [0, 0], [0.5, 0], [1, 0]]
MERITS = {"wavefront": {"kind": "wavefront", "at_most": 0.0714}}
PRIOR = parse_yaml("""
name: parts
causes:
  mirrors: {bodies: base/*/M?, shift: 100 um, rotate: 20 arcsec, time: constant, reason: a test}
  figures: {bodies: base/*/M?, figure: {Z5: 10 nm, Z6: 10 nm, Z7: 10 nm, Z8: 10 nm}, time: constant, reason: a test}
  focal_plane: {bodies: base/*/focal_plane, shift: 200 um, rotate: 30 arcsec, time: constant, reason: a test}
""").data
HEAT = {"bodies": "base", "temperature": {"change": "2 K"}, "time": "constant", "reason": "a test"}


def written(folder: Path, measurements: dict, prior: dict | None = None, **more) -> Path:
    """A file of measurements, and its prior beside it."""
    (folder / "parts.yaml").write_text(dump_yaml(PRIOR if prior is None else prior))
    data = {
        "instrument": "gf7",
        "prior": "./parts.yaml",
        "measurements": measurements,
        "merits": MERITS,
        "simulate": {},
    }
    data.update(more)
    if data["simulate"] is None:
        del data["simulate"]
    path = folder / "asbuilt.yaml"
    path.write_text(dump_yaml(data))
    return path


def bench_of(backend: Backend, folder: Path, measurements: dict, prior: dict | None = None, **more) -> AsBuiltBench:
    return AsBuiltBench(resolve_asbuilt(written(folder, measurements, prior, **more)), backend)


EVERY = parse_yaml("""
wavefronts: {interferometer: {fields: [[-1, 0], [-0.5, 0], [0, 0], [0.5, 0], [1, 0]], sigma: 5 nm}}
focus: {collimator: {fields: [[-1, 0], [0, 0], [1, 0]], sigma: 3 um, common: 2 um}}
mtf: {mtf: {fields: [[0, 0], [1, 0]], frequency: 20.0, sigma: 0.01}}
distortion: {turntable: {fields: [-1.0, -0.5, 0.0, 0.5, 1.0], sigma: 0.5 um}}
sight:
  theodolite: {sigma_alpha: 1 arcsec, sigma_beta: 1 arcsec, sigma_gamma: 3 arcsec, sigma_principal_distance: 20 um}
positions: {tracker: {bodies: [M1, M2, M3, focal_plane], sigma: 20 um, frame: free}}
""").data


@pytest.fixture(scope="module")
def whole(backend, tmp_path_factory) -> AsBuiltBench:
    """gf7 with every kind of measurement that a camera alone allows."""
    return bench_of(backend, tmp_path_factory.mktemp("whole"), EVERY)


@pytest.fixture(scope="module")
def states(whole) -> tuple[np.ndarray, list]:
    """Three instruments of the prior: parameters and states."""
    rng = np.random.default_rng(4)
    values = 0.3 * np.stack([whole.draw(rng, "normal") for _ in range(3)])
    return values, whole.parameters.states(values, None)


def kind_named(bench: AsBuiltBench, name: str):
    return next(kind for kind in bench.kinds if kind.name == name)


@pytest.mark.second
def test_wavefronts_are_the_cameras(whole, states) -> None:
    """Zernike terms as ``CameraOptics.wavefronts`` fits them to its own nodes; both leave 1e-3 waves at the most."""
    values, own = states
    found = kind_named(whole, "interferometer").predict(whole.view(values, None)).reshape(3, 5, 8)
    for s, state in enumerate(own):
        optics = CameraOptics.within(whole.experiment.instrument, "gf7", whole.backend, state)
        # beams are those of the designed camera's directions
        waves = [w.parts[3:11] * w.wavelength for w in optics.wavefronts(FIVE, points=5)]
        np.testing.assert_allclose(found[s], waves, atol=1e-3 * whole.merits.wavelength)
    assert np.max(np.abs(found)) > 50e-9


@pytest.mark.second
def test_best_focus_is_that_of_image_quality(whole, states) -> None:
    """Best foci differ by the designed camera's as the image quality of pixels has it.

    There the beam is that of the pixel and not of the direction, and the shift goes along the normal: 1 % and 2 um.
    """
    values, own = states
    kind = kind_named(whole, "collimator")
    found = kind.predict(whole.view(np.concatenate([values, np.zeros_like(values[:1])]), None))
    quality = image_quality(whole.experiment.instrument, whole.backend, [*own, {}], (-1.0, 0.0, 1.0))
    wanted = quality.cameras["gf7"].defocus
    np.testing.assert_allclose(found[:3] - found[3], wanted[:3] - wanted[3], rtol=0.01, atol=2e-6)
    assert np.max(np.abs(found)) > 30e-6


@pytest.mark.second
def test_mtf_is_the_cameras(whole, states) -> None:
    """Along the line and along the track, as ``CameraOptics.mtfs``; wavefronts at fixed nodes are right to 1e-3."""
    values, own = states
    found = kind_named(whole, "mtf").predict(whole.view(values, None)).reshape(3, 2, 2)
    for s, state in enumerate(own):
        optics = CameraOptics.within(whole.experiment.instrument, "gf7", whole.backend, state)
        mtfs = optics.mtfs([[0, 0], [1, 0]], np.array([20e3]))
        np.testing.assert_allclose(found[s], [m.values[:, 0] for m in mtfs], atol=2e-3)


@pytest.mark.second
def test_places_along_the_line_are_where_the_sight_is(whole, states) -> None:
    """The point of the line that looks at an angle, by interpolation of what its points see."""
    values, own = states
    kind = kind_named(whole, "turntable")
    found = kind.predict(whole.view(values, None))
    from scipy.interpolate import CubicSpline

    for s, tangents in enumerate(kind._tangents(own)):
        wanted = CubicSpline(tangents, whole.line)(kind.tangents)
        np.testing.assert_allclose(found[s], wanted, atol=2e-9)
    assert np.std(found, axis=0).max() > 1e-6


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
    prior = {
        "name": "parts",
        "causes": {
            "mirrors": {"bodies": "base/forward/M?", "shift": "10 um", "rotate": "2 arcsec", "reason": "a test"},
            "heat": HEAT,
            "warm": {"bodies": "base/forward", "temperature": {"change": "1 K"}, "reason": "a test"},
        },
    }
    measured = {
        "spots": {"monitor": {"sigma": 0.02}},
        "temperatures": {"sensors": {"bodies": ["base", "forward", "forward/M2", "backward"], "sigma": "0.1 K"}},
    }
    bench = bench_of(backend, tmp_path, measured, prior, instrument="gf7_pair", camera="forward")
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
    prior = {"name": "parts", "causes": {"one": {"bodies": "base/forward/M2", "shift": "1 um", "reason": "a test"}}}
    measured = {
        "spots": {
            "frames": {"file": "recovered.json", "state": "after", "sigma": 0.02},
            "table": {"file": "spots.csv", "sigma": 0.02},
        }
    }
    bench = bench_of(backend, tmp_path, measured, prior, instrument="gf7_pair", camera="forward", simulate=None)
    frames, table = bench.data()
    np.testing.assert_allclose(frames, table, atol=1e-12)
    places = bench.experiment.path.coarse
    middle = 0.5 * (np.array(bench.experiment.path.shape) - 1.0)
    mean = np.einsum("n,bnk->bk", places.nodes.share, places.rays([{}]).position[..., 1::-1]) / places.pitch
    np.testing.assert_allclose(frames.reshape(-1, 2)[1], np.array([41.0, 49.0]) - middle - mean[1], atol=1e-9)
    (tmp_path / "spots.csv").write_text("camera,channel\nforward,left\n")
    with pytest.raises(InputError, match="not a spot"):
        bench.data()


@pytest.mark.second
def test_an_instrument_is_found(whole) -> None:
    """Of a drawn instrument each combination and motion lies within what its sigma says, and order does not matter.

    30 combinations: within 4.2 standard deviations at 1e-3.
    """
    rng = np.random.default_rng(8)
    true = whole.draw(rng, "uniform")
    data = whole.measured(true, rng)
    found = whole.estimate(data)
    assert found.converged
    assert not found.left_out
    assert found.whole.holds()
    assert np.all(np.abs(found.mean - true) < 4.2 * found.sigma)
    assert np.min(found.sigma / found.prior.sigma) < 0.3
    # the same from another start, and with the measurements the other way round
    other = whole.estimate(data, true)
    np.testing.assert_allclose(other.mean, found.mean, atol=2e-3 * float(np.min(found.sigma / found.prior.sigma)))
    assert np.max(np.abs(other.mean - found.mean) / found.sigma) < 0.02


@pytest.mark.second
def test_a_gross_error_of_one_field_is_named(whole) -> None:
    """Coma of 150 nm too much at one field: it is left out, and the rest tells the same state."""
    rng = np.random.default_rng(9)
    true = whole.draw(rng, "normal")
    data = list(whole.measured(true, rng))
    clean = whole.estimate(data)
    assert not clean.left_out
    table = data[0].reshape(5, 8).copy()
    table[3, 4] += 150e-9
    found = whole.estimate([table.ravel(), *data[1:]])
    assert [(name, block) for name, block, _ in found.left_out] == [("interferometer", "field (0.5, 0)")]
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
    assert not np.any(wanted_move(still, np.zeros(len(still.parameters.labels)), None).amounts)


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
    stated = {
        "fields": [[0, 0], [1, 0]],
        "sigma": "5 nm",
        "double_pass": True,
        "orientation": name,
        "sign": -1,
        "reference": "reference.csv",
    }
    measured = {"maps": {**stated, "maps": maps}, "table": {**stated, "zernikes": "table.csv"}}
    bench = bench_of(backend, tmp_path, {"wavefronts": measured}, simulate=None)
    of_maps, of_table = (values.reshape(2, 8) for values in bench.data())
    np.testing.assert_allclose(of_maps, wanted, atol=0.01 * np.abs(wanted).max())
    np.testing.assert_allclose(of_table, wanted, atol=1e-15)


COMA = {
    "actuators": {"x": {"motion": "M2 shift x", "range": "2 mm"}, "y": {"motion": "M2 shift y", "range": "2 mm"}},
    "moves": {"poke": {"by": {"x": "700 um", "y": "400 um"}}},
}


def checked(backend: Backend, folder: Path, one: Orientation, **more):
    """The check of drawn wavefronts that lie so, before and after a known move that makes half a micron of coma."""
    own = {"fields": FIVE, "sigma": "5 nm", "orientation": one.name, "sign": one.sign}
    measured = {"before": own, "later": {**own, "after": "poke"}} if more else {"before": own}
    return run_check(resolve_asbuilt(written(folder, {"wavefronts": measured}, **more)), backend)


def test_an_orientation_is_found_after_a_move(backend, tmp_path) -> None:
    """With a move that is known the reading is found; of a camera that was only assembled others are named with it."""
    one = Orientation.named("mirrored diagonal", -1)
    found = checked(backend, tmp_path, one, **COMA)
    assert found.evidence.found == one
    assert found.code == 0
    alone = checked(backend, tmp_path, one)
    assert alone.code == 0
    assert one in alone.evidence.together
    assert len(alone.evidence.together) > 1


def test_files_of_the_laboratory_are_read(backend, tmp_path) -> None:
    """Best foci and places along the line from the JSON files of the laboratory's runs."""
    focus = {
        "rounds": [
            {"sites": [{"band": "P", "field": x, "defocus_um": 3.0 * x} for x in (-0.9, 0.0, 0.9)]},
            {
                "sites": [
                    *({"band": "P", "field": x, "defocus_um": 2.0 * x + 1.0} for x in (-0.9, 0.0, 0.9)),
                    {"band": "B1", "field": 0.0, "defocus_um": 50.0},
                ]
            },
        ]
    }
    points = [
        {"field_deg": w, "position_mm": 96.0 * w, "distortion_compensated_um_sigma": 0.5 + abs(w)} for w in (-1, 0, 1)
    ]
    (tmp_path / "focus.json").write_text(json.dumps(focus))
    (tmp_path / "distortion.json").write_text(json.dumps({"points": points}))
    (tmp_path / "spoilt.json").write_text("{")
    measured = {
        "focus": {"lab": {"file": "focus.json", "sigma": "3 um"}},
        "distortion": {"lab_too": {"file": "distortion.json"}},
    }
    bench = bench_of(backend, tmp_path, measured, simulate=None)
    foci, places = bench.data()
    np.testing.assert_allclose(foci, [0.8e-6, -1e-6, -2.8e-6], atol=1e-15)
    np.testing.assert_allclose(places, [-0.096, 0.0, 0.096])
    np.testing.assert_allclose(np.sqrt(np.diagonal(bench.kinds[1].covariance())), [1.5e-6, 0.5e-6, 1.5e-6])
    measured["focus"]["lab"]["file"] = "spoilt.json"
    with pytest.raises(InputError, match="not a JSON file"):
        bench_of(backend, tmp_path, measured, simulate=None)


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
    numbers = bench.merit_numbers

    def without(values, after, further=None):
        if np.any(np.all(values == draws[3], axis=1)):
            raise UnphysicalError("lost")
        return numbers(values, after, further)

    monkeypatch.setattr(bench, "merit_numbers", without)
    told = expected(bench, draws, None)
    assert np.isnan(told[3])
    np.testing.assert_allclose(np.delete(told, 3), np.delete(whole, 3), rtol=1e-9)
    step = advice(bench, found, draws, rng)
    assert step.before == pytest.approx(np.mean(np.delete(whole, 3)), rel=1e-9)
    assert np.isfinite(step.after)


@pytest.mark.second
def test_an_alignment_comes_near_perfect_knowledge(backend, tmp_path) -> None:
    """Two drawn cameras, two moves each: within 10 % of what perfect knowledge reaches, and far from the beginning."""
    shims = {"range": "1 mm", "step": "5 um"}
    turns = {"range": "10 arcmin", "step": "5 arcsec"}
    actuators = {
        f"{m}_{a}": {"motion": f"{m} shift {a}", **shims} for m, axes in (("M2", "xyz"), ("M3", "xy")) for a in axes
    }
    actuators["focus"] = {"motion": "focal_plane shift z", **shims, "range": "3 mm"}
    actuators |= {a: {"motion": f"focal_plane rotate {a}", **turns} for a in "xy"}
    corners = [[-1, -1], [1, -1], [0, 0], [-1, 1], [1, 1]]
    measured = {
        "wavefronts": {"interferometer": {"fields": corners, "sigma": "5 nm"}},
        "focus": {"collimator": {"fields": [[-1, 0], [0, 0], [1, 0]], "sigma": "3 um"}},
    }
    bench = bench_of(backend, tmp_path, measured, actuators=actuators)
    rng = np.random.default_rng(3)
    for _ in range(2):
        found = align(bench, bench.draw(rng, "uniform"), 2, rng, ("interferometer", "collimator"))
        assert found.merits[-1] < 1.1 * found.perfect + 0.02
        assert found.merits[-1] < 0.2 * found.merits[0]


def test_a_run_from_file_to_numbers(backend, tmp_path) -> None:
    """Numbers of a whole run: those of the estimate in the units of the file, and the truth where it is said to be."""
    setup = resolve_asbuilt(
        written(
            tmp_path,
            {"wavefronts": {"interferometer": {"fields": [[-1, 0], [0, 0], [1, 0]], "sigma": "5 nm"}}},
            merits={**MERITS, "boresight": {"kind": "boresight", "at_most": "1 arcmin"}},
            actuators={"focus": {"motion": "focal_plane shift z", "range": "1 mm", "step": "5 um"}},
            candidates={"focus": {"collimator": {"fields": [[0, 0]], "sigma": "3 um"}}},
            draws=40,
        )
    )
    streams = []
    with pytest.MonkeyPatch.context() as patch:
        own = asbuilt_run.stream
        patch.setattr(asbuilt_run, "stream", lambda *numbers: streams.append(numbers) or own(*numbers))
        run = run_asbuilt(setup, backend)
    assert len(set(streams)) == len(streams) == 5
    told = ASBUILT(run)
    assert told["whole"]["agrees"]
    assert run.warnings == ()
    for merit in told["merits"].values():
        for name in ("prior", "as_built", "after_move"):
            values = list(merit[name].values())
            assert values == sorted(values)
        assert merit["true"] is not None
    assert told["next_move"]["merit_after"] <= told["next_move"]["merit_before"]
    assert told["next_move"]["worth"]["collimator"] > 0.0
    sigmas = [one["sigma"] for one in told["combinations"]]
    assert sigmas == sorted(sigmas)
    assert sigmas[-1] == pytest.approx(1.0, abs=1e-6)
    # a chi-square that contradicts the prior makes every sigma larger by its root per degree of freedom
    whole = replace(run.found.whole, chi_square=4.0 * run.found.whole.degrees)
    wide = replace(run, found=replace(run.found, whole=whole))
    sizes = {"um": 1e-6, "arcsec": ARCSEC, "nm": 1e-9}
    for factor, rows in ((1.0, motions(run)), (2.0, motions(wide))):
        for k, row in enumerate(rows):
            size = sizes[row["unit"]]
            assert row["value"] == pytest.approx(run.found.mean[k] / size)
            assert row["true"] == pytest.approx(run.true[k] / size)
            assert row["prior_sigma"] == pytest.approx(np.sqrt(run.found.prior.covariance[k, k]) / size)
            assert row["sigma"] == pytest.approx(factor * np.sqrt(run.found.covariance[k, k]) / size)
    assert [one["sigma"] for one in ASBUILT(wide)["combinations"]] == pytest.approx(
        np.minimum(1.0, 2.0 * np.array(sigmas))
    )


def test_quantiles_and_chances_of_a_merit_are_those_of_its_draws() -> None:
    """Draws without light meet no requirement and are in no quantile; a value on its limit meets it."""
    merit = Merit("w", MeritSpec.model_validate({"kind": "wavefront", "at_most": 0.5}), np.array([0]), slice(0, 1))
    rng = np.random.default_rng(2)
    before, now = (rng.uniform(0.0, 1.0, (60, 1)) ** 2 for _ in range(2))
    now[:4], now[4] = np.nan, 0.25
    found = _standing(merit, np.array([0.01]), (before, now, None), np.array([0.09]))
    shares = (2.5, 16.0, 50.0, 84.0, 97.5)
    assert found.before == pytest.approx(np.percentile(np.sqrt(before), shares))
    assert found.now == pytest.approx(np.percentile(np.sqrt(now[4:]), shares))
    assert found.meets == np.sum(np.sqrt(now[4:]) <= 0.5) / 60.0
    assert (found.designed, found.true) == pytest.approx((0.1, 0.3))
    assert found.moved == ()
    assert np.isnan(found.meets_moved)
    moved = _standing(merit, np.array([0.01]), (before, now, before), None)
    assert (moved.moved, moved.meets_moved) == (moved.before, np.mean(np.sqrt(before) <= 0.5))
    assert np.isnan(moved.true)


def state(**changes) -> SimpleNamespace:
    """Return an estimate of two measurements that agree, but for what is changed."""
    good = [Agreement.of(name, 9.0, 10) for name in ("focus", "sight")]
    own = {"left_out": (), "whole": Agreement.of("", 20.0, 20), "measurements": good, "variance_factor": 1.0}
    own |= {"converged": True, "steps": 3, "settled": 0.001}
    return SimpleNamespace(**{**own, **changes})


def test_each_warning_is_there_where_it_holds_and_no_other() -> None:
    lit = np.ones((5, 2))
    # 29.59 is exceeded by chi-square of ten degrees once in a thousand, 32.0 once in two thousand: two are looked at
    assert _warnings(state(measurements=[Agreement.of("focus", 31.0, 10), Agreement.of("sight", 9.0, 10)]), lit) == []
    dark = lit.copy()
    dark[2, 1] = np.nan
    bad = Agreement.of("focus", 45.0, 10)
    for found, parts, text in (
        (
            state(left_out=[("focus", "field 0", bad)]),
            lit,
            "focus: field 0 contradicts all other measurements (chi-square 45",
        ),
        (
            state(whole=Agreement.of("", 80.0, 20), variance_factor=4.0),
            lit,
            "all measurements together do not agree with the prior and their errors (chi-square 80 of 20); "
            "all sigmas are 2 times larger",
        ),
        (state(measurements=[bad, bad.of("sight", 1.0, 10)]), lit, "focus does not agree with what all others predict"),
        (state(), dark, "1 of 5 states of the posterior have no light; they count as failed"),
    ):
        (said,) = _warnings(found, parts)
        assert said.startswith(text)


@pytest.mark.second
def test_estimates_that_do_not_settle_or_contradict_themselves_are_refused(whole) -> None:
    """Nine times the degrees of freedom is still an estimate; more names what agrees least."""
    names = [kind.name for kind in whole.kinds]
    each = [Agreement.of(name, 30.0 if name == "mtf" else 9.0, 10) for name in names]
    require_agreement(whole, state(whole=Agreement.of("", 180.0, 20), measurements=each))
    with pytest.raises(InputError, match="miss what the instrument can do by 3 standard deviations") as caught:
        require_agreement(whole, state(whole=Agreement.of("", 180.1, 20), measurements=each))
    assert "measurements.mtf.mtf" in str(caught.value)
    with pytest.raises(InputError, match=r"not settled after 3 steps: one more changes the predicted readings by 0\.5"):
        require_agreement(whole, state(converged=False, settled=0.5))


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


BAD = [
    ("{measurements: {}}", "nothing was measured"),
    ("{measurements: {wavefronts: {one: {fields: [[0, 1.5]], sigma: 5 nm}}}}", "at most 1"),
    ("{measurements: {wavefronts: {one: {fields: [[0, 0]], sigma: 5}}}}", "unit"),
    ("{measurements: {wavefronts: {one: {fields: [[0, 0]], sigma: 0 nm}}}}", "greater than zero"),
    ("{measurements: {wavefronts: {one: {fields: [[0, 0]], sigma: 5 nm, after: x}}}}", "no such move"),
    ("{measurements: {positions: {one: {bodies: [M9], sigma: 5 um}}}}", "M9"),
    ("{measurements: {spots: {one: {sigma: 0.1}}}}", "no monitor"),
    ("{camera: nadir}", "no such camera"),
    ("{actuators: {z: {motion: M7 shift z, range: 1 mm}}}", "M7"),
    ("{moves: {one: {by: {z: 1 um}}}}", "no such actuator"),
    ("{simulate: null}", "no data"),
    ("{merits: {one: {kind: monitor_angle, at_most: 1 arcsec}}}", "twin.uncertainty"),
]


@pytest.mark.parametrize(("changes", "words"), BAD, ids=[case[1] for case in BAD])
def test_bad_input_has_one_message(backend, tmp_path, changes, words) -> None:
    """File, line, key and what is allowed."""
    given = {"measurements": {"wavefronts": {"one": {"fields": [[0, 0]], "sigma": "5 nm"}}}} | parse_yaml(changes).data
    with pytest.raises(InputError) as caught:
        AsBuiltBench(resolve_asbuilt(written(tmp_path, **given)), backend)
    assert words in str(caught.value)
    assert "asbuilt.yaml" in str(caught.value)


def test_a_prior_of_nothing_is_refused(backend, tmp_path) -> None:
    """Standard deviations of zero leave nothing to estimate."""
    nothing = {"name": "parts", "causes": {"one": {"bodies": "base/*/M?", "shift": "0 um", "reason": "a test"}}}
    with pytest.raises(InputError, match="nothing is expected to move"):
        bench_of(backend, tmp_path, {"wavefronts": {"one": {"fields": [[0, 0]], "sigma": "5 nm"}}}, nothing)


FILES = {
    "focus.json": '{"rounds": [{}]}',
    "places.json": '{"points": [{}]}',
    "far.json": '{"points": [{"field_deg": 80.0, "position_mm": 1.0, "distortion_compensated_um_sigma": 1.0}]}',
    "spots.json": '{"spots": 3}',
    "few.json": '{"spots": {"forward": {"left": {"after": {"row": 1.0, "column": 2.0}}}}}',
    "short.csv": "# order: noll\n# normalised: rms\n# unit: nm\nZ4,Z5\n1,2\n",
    "rows.csv": "# order: noll\n# normalised: rms\n# unit: nm\nZ4,Z5,Z6\n1,2,3\n1,2,3\n",
    "no.csv": "x",
    "no.fits": "x",
}
ONE = "fields: [[0, 0]], sigma: 5 nm, terms: [Z4, Z6]"
UNREAD = [
    ("focus: {one: {file: focus.json, sigma: 3 um}}", "no best foci in it"),
    ("distortion: {one: {file: places.json}}", "no places in it"),
    ("distortion: {one: {file: far.json}}", "angles beyond the camera's field"),
    ("spots: {one: {file: spots.json, state: after, sigma: 0.02}}", "no spots in it"),
    ("spots: {one: {file: few.json, state: after, sigma: 0.02}}", "no spot right of forward"),
    (f"wavefronts: {{one: {{{ONE}, zernikes: short.csv}}}}", "the table has no Z6"),
    (f"wavefronts: {{one: {{{ONE}, zernikes: rows.csv}}}}", "2 wavefronts in the table, 1 fields in the test"),
    (f"wavefronts: {{one: {{{ONE}, zernikes: no.csv}}}}", "measurements.wavefronts.one.zernikes"),
    (f"wavefronts: {{one: {{{ONE}, maps: [no.fits]}}}}", "map 1: "),
]


@pytest.mark.parametrize(("measured", "words"), UNREAD, ids=[case[1] for case in UNREAD])
def test_files_that_hold_no_measurement_are_refused(backend, tmp_path, measured, words) -> None:
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    prior = {"name": "parts", "causes": {"one": {"bodies": "base/forward/M2", "shift": "1 um", "reason": "a test"}}}
    pair = {"instrument": "gf7_pair", "camera": "forward"} if measured.startswith("spots") else {}
    with pytest.raises(InputError, match=re.escape(words)):
        bench_of(backend, tmp_path, parse_yaml(measured).data, prior if pair else None, simulate=None, **pair).data()


def test_what_no_state_can_be_estimated_of_is_refused(backend, tmp_path) -> None:
    one = {"wavefronts": {"one": {"fields": [[0, 0]], "sigma": "5 nm"}}}
    prior = {"name": "parts", "causes": {"one": {"bodies": "base/forward/M2", "shift": "1 um", "reason": "a test"}}}
    with pytest.raises(InputError, match="an instrument as built already"):
        bench_of(backend, tmp_path, one, instrument=str(EXAMPLES / "as_built_pair.yaml"))
    with pytest.raises(InputError, match="the instrument has several cameras"):
        bench_of(backend, tmp_path, one, prior, instrument="gf7_pair")
    focus = {"focus": {"one": {"fields": [[0, 0]], "sigma": "3 um"}}}
    with pytest.raises(InputError, match="no wavefronts whose orientation could be told"):
        run_check(resolve_asbuilt(written(tmp_path, focus)), backend)
    two = {
        "wavefronts": {**one["wavefronts"], "two": {"fields": [[0, 0]], "sigma": "5 nm", "orientation": "turned 90"}}
    }
    with pytest.raises(InputError, match="other terms or another orientation than the first wavefronts"):
        run_check(resolve_asbuilt(written(tmp_path, two)), backend)
