"""`python -m twin.compare`: what differs is found, what does not is not, and the exit code says which."""

import json
import shutil
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace

import h5py
import numpy as np
import pytest
import tifffile
from matplotlib.image import imread
from typer.testing import CliRunner

from twin.compare import compare_report
from twin.compare.__main__ import app
from twin.compare.compare_report import compare, verdict
from twin.compare.folder_difference import array_difference, sigma_of
from twin.framework.run_folder import RunFolder, write_manifest
from twin.main_job.render_job import render_job
from twin.scripting.instrument_twin import load


def write(folder: Path, name: str, shift: int = 3, seed: int = 1) -> None:
    """Data of a small job, as the command writes them."""
    from twin.main_job.render_files import irradiance_file, write_results

    twin = load("monitor_pair").perturbed({"base/forward/M2": {"shift": f"0 0 {shift} um"}})
    with RunFolder(folder / name) as target:
        run = render_job(twin.resolved, twin.experiment.backend, 2, seed, experiment=twin.experiment)
        write_results(run, target)
        target.write_bytes("irradiance.nc", irradiance_file(run))
        write_manifest(target, "twin.render", 0.0, 1.0, seed=seed, warnings=[])


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four jobs: a, b with another despace, a once more, and a with another seed."""
    folder = tmp_path_factory.mktemp("runs")
    write(folder, "a")
    write(folder, "b", shift=4)
    write(folder, "again")
    write(folder, "seed", seed=2)
    return folder


def run(*words: object) -> tuple[int, str]:
    done = CliRunner().invoke(app, [str(word) for word in words])
    return done.exit_code, done.output


@pytest.mark.second
def test_a_run_is_the_same_as_itself_again(runs: Path, tmp_path: Path) -> None:
    code, text = run(runs / "a", runs / "again", "--out", tmp_path / "out")
    assert code == 0
    assert "again has the same results as a (no input changed" in text
    found = json.loads((tmp_path / "out/compare.json").read_text())
    assert found["same"]
    assert found["others"][0]["compared"] > 1000


@pytest.mark.second
def test_what_differs_is_found(runs: Path, tmp_path: Path) -> None:
    code, text = run(runs / "a", runs / "b", "--out", tmp_path / "out", "--json")
    assert code == 1
    found = json.loads(text)["others"][0]
    assert found["inputs"] == [{"key": "job.perturb.base/forward/M2.shift[2]", "reference": "3 um", "other": "4 um"}]
    changed = {(one["file"], one["key"]): one for one in found["numbers"]}
    true = changed["truth.json", "cameras.forward.d_f_um"]
    a, b = (json.loads((runs / name / "truth.json").read_text())["cameras"]["forward"]["d_f_um"] for name in "ab")
    assert (true["reference"], true["other"], true["difference"]) == (a, b, b - a)
    assert true["in_sigma"] is None
    read = changed["recovered.json", "cameras.forward.model.d_f_um"]
    sigmas = [
        json.loads((runs / name / "recovered.json").read_text())["cameras"]["forward"]["model"]["d_f_um_sigma_noise"]
        for name in "ab"
    ]
    assert read["sigma"] == pytest.approx(np.hypot(*sigmas), rel=1e-12)
    assert read["in_sigma"] == pytest.approx(read["difference"] / read["sigma"], rel=1e-12)
    # the other camera keeps its truth, and its frames to the byte
    assert not any("backward.d_" in key for file, key in changed if file == "truth.json")
    images = {one["file"] for one in found["arrays"]}
    assert images == {"irradiance.nc", "images/forward_left_after.tiff", "images/forward_right_after.tiff"}
    largest = next(one["largest"] for one in found["arrays"] if one["file"] == "images/forward_left_after.tiff")
    frames = [tifffile.imread(runs / name / "images/forward_left_after.tiff").astype(float) for name in "ab"]
    assert largest == np.max(np.abs(frames[1] - frames[0]))
    # the other way round only signs turn; several runs are held against the first
    there, back = (
        compare([runs / "a", runs / "again", runs / "b"], 1e-9, None),
        compare([runs / "b", runs / "a"], 1e-9, None),
    )
    assert [one.same for one in there.diffs] == [True, False]
    forward, backward = ({(n.file, n.key): n.difference for n in f.diffs[-1].numbers} for f in (there, back))
    assert forward.keys() == backward.keys()
    assert all(value is None or value == -backward[key] for key, value in forward.items())


@pytest.mark.second
def test_noise_alone_is_within_some_sigma(runs: Path, tmp_path: Path) -> None:
    """Another seed: every reading moves, none by more than 5 sigma (some 70 of them: 4e-5)."""
    folders = [runs / "a", runs / "seed"]
    strict, loose = compare(folders, 1e-9, None), compare(folders, 1e-9, 5.0)
    readings = [one for one in strict.diffs[0].numbers if one.in_sigma is not None]
    assert len(readings) > 40
    # also of the chi-square of the shifts, by their noise
    assert any(one.key == "disturbances.chi_square" for one in readings)
    assert loose.same
    assert loose.diffs[0].compared > 500
    assert "no input" not in " ".join(verdict(strict))  # the seed stands in config.yaml


def test_the_verdict_begins_with_what_a_reader_of_cameras_looks_for(tmp_path: Path) -> None:
    """Worst error, lowest MTF and focal length, with the digits in which they differ; nothing where one is unknown."""

    def camera(name: str, wfe: float | None, mtf: float, focal: float) -> Path:
        fields = [{"field": [x, 0.0], "along_line": 0.4, "along_track": mtf + x} for x in (0.0, 0.1)]
        found = {"wfe_worst_waves": wfe, "mtf_at_nyquist": fields, "first_order": {"focal_length_m": focal}}
        with RunFolder(tmp_path / name) as target:
            target.write_bytes("optics.json", json.dumps(found).encode())
            write_manifest(target, "twin.camera", 0.0, 1.0, seed=1, warnings=[])
        return tmp_path / name

    a, b = camera("a", 0.009364, 0.375, 3.2), camera("b", 0.0241, 0.3, 3.20006)
    said = verdict(compare([a, b, camera("c", None, 0.375, 3.2)], 1e-9, None))
    assert said[0] == (
        "from a to b: worst wavefront error [waves] 0.00936, then 0.0241; lowest MTF of the optics at Nyquist 0.375, "
        "then 0.3; focal length [m] 3.2, then 3.2001"
    )
    assert said[1].startswith("run b differs from a in 4 numbers of")
    assert said[2].startswith("run c differs from a in 1 numbers of")
    assert verdict(compare([a, a], 1e-9, None))[0].startswith("run ")


def test_a_sigma_says_what_it_is_of() -> None:
    """Where a file has both, it is that of the noise."""
    both = {"x": 1.0, "x_sigma": 0.6, "x_sigma_noise": 0.1, "y": 1.0, "y_sigma": 0.3}
    found = {name: sigma_of(both, both, name) for name in ("x", "y", "z")}
    assert found["x"] == (pytest.approx(0.1 * 2**0.5), "noise")
    assert found["y"] == (pytest.approx(0.3 * 2**0.5), "stated")
    assert found["z"] == (None, "")


@pytest.mark.second
def test_small_differences_count_by_the_tolerance(runs: Path, tmp_path: Path) -> None:
    """A truth that is 1e-7 off, and a pixel of an image: found, and not found with a wider tolerance."""
    copy = tmp_path / "copy"
    shutil.copytree(runs / "a", copy)
    truth = json.loads((copy / "truth.json").read_text())
    truth["cameras"]["forward"]["d_f_um"] *= 1.0 + 1e-7
    (copy / "truth.json").write_text(json.dumps(truth))
    with h5py.File(copy / "irradiance.nc", "r+") as data:
        data["photons"][0, 0, 5, 5] += 1e-7 * data["photons"][...].max()
    fine, wide = (compare([runs / "a", copy], rtol, None).diffs[0] for rtol in (1e-9, 1e-6))
    assert [one.key for one in fine.numbers] == ["cameras.forward.d_f_um"]
    assert [(one.name, round(one.share * 4 * 2 * 96 * 96)) for one in fine.arrays] == [("photons", 1)]
    assert wide.same


@pytest.mark.second
def test_a_changed_file_of_a_run(runs: Path, tmp_path: Path) -> None:
    """A key that only one has is told, another unit is no difference, and what is no run is named."""
    copy = shutil.copytree(runs / "a", tmp_path / "copy")

    def written(name: str, old: str, new: str) -> None:
        text = (copy / name).read_text()
        assert old in text
        (copy / name).write_text(text.replace(old, new))

    def refused(said: str, *folders: Path) -> None:
        code, text = run(*folders, "--out", tmp_path / "out")
        assert (code, said in text, (tmp_path / "out").exists()) == (2, True, False), text

    written("config.yaml", "3 um", "0.003 mm")
    (found,) = compare([runs / "a", copy], 1e-9, None).diffs
    assert not found.inputs
    assert found.same
    written("truth.json", '"nominal_deg"', '"other_deg"')
    (found,) = compare([runs / "a", copy], 1e-9, None).diffs
    assert {(one.key, one.other is None) for one in found.numbers} == {
        ("intersection_angle.nominal_deg", True),
        ("intersection_angle.other_deg", False),
    }
    (copy / "irradiance.nc").write_bytes(b"CDF")
    refused("cannot be read as a netCDF file", runs / "a", copy)
    written("manifest.json", "twin.render", "twin.orbit")
    refused("the runs are of different kinds", runs / "a", copy)
    (copy / "truth.json").write_text("{")
    written("manifest.json", "twin.orbit", "twin.render")
    refused("not JSON", runs / "a", copy)
    refused("two runs", runs / "a")
    refused("no such folder", runs / "a", tmp_path / "none")
    (tmp_path / "empty").mkdir()
    refused("not a run folder", runs / "a", tmp_path / "empty")


def test_numbers_at_the_end_of_the_range_are_compared_without_a_warning() -> None:
    with np.errstate(all="raise"):
        far = array_difference("a.nc", "x", np.array([1e200, 0.0]), np.array([-1e200, 0.0]))
        beyond = array_difference("a.nc", "x", np.array([1e308]), np.array([-1e308]))
    assert far is not None
    assert beyond is not None
    assert far.largest == 2e200
    assert far.rms == pytest.approx(2e200 / np.sqrt(2.0))
    assert np.isinf(beyond.largest)


@pytest.mark.second
def test_other_versions_and_warnings_of_a_run_are_told(runs: Path) -> None:
    folders = [runs / "a", runs / "again"]
    comparison = compare(folders, 1e-9, None)
    assert compare_report._warnings(comparison) == ()
    first, other = comparison.runs
    manifest = other.manifest.model_copy(
        update={"warnings": ("dim",), "versions": {**other.manifest.versions, "numpy": "1"}}
    )
    changed = replace(comparison, runs=(first, replace(other, manifest=manifest)))
    said = compare_report._warnings(changed)
    assert said[0] == f"again was made with other versions: numpy {first.manifest.versions['numpy']} and 1"
    assert said[1:] == ("again: dim",)
    turned = compare_report._warnings(replace(changed, runs=(changed.runs[1], first)))
    assert turned[-1].endswith(" only: dim")


def test_a_map_with_nan_outside_a_pupil_keeps_its_scale(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a scale all of the pupil has one colour."""
    x, y = np.meshgrid(*[np.linspace(-1.0, 1.0, 33)] * 2)
    first = np.where(np.hypot(x, y) <= 1.0, x**2 - y, np.nan)[None].repeat(3, axis=0)
    arrays = {"a": first, "b": first + 0.25}
    array = array_difference("optics.nc", "wavefront", arrays["a"], arrays["b"])
    nowhere = array_difference("optics.nc", "wavefront", np.full_like(first, np.nan), arrays["b"])

    def content(path: Path, _: str) -> SimpleNamespace:
        return SimpleNamespace(arrays={"wavefront": arrays[path.parent.name]})

    monkeypatch.setattr(compare_report.difference, "content_of", content)
    sides = [SimpleNamespace(folder=Path(name)) for name in "ab"]
    (figure,) = compare_report._pictures(*sides, SimpleNamespace(arrays=[array]), ("a", "b"), 0)
    assert figure.caption == "Differences up to 0.250."
    pixels = imread(BytesIO(figure.png))[..., :3]
    left = pixels[:, : pixels.shape[1] // 4].reshape(-1, 3)
    assert len(np.unique(left, axis=0)) > 100
    arrays["a"] = np.full_like(first, np.nan)
    assert compare_report._pictures(*sides, SimpleNamespace(arrays=[nowhere]), ("a", "b"), 0) == []
