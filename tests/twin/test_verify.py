"""`python -m twin.verify`: whatever is done to a run folder is found, and a run made again is compared by number."""

import csv
import io
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import tifffile
import xarray as xr

from scenes.yaml.errors import InputError
from tests.golden.jobs import BY_NAME, ROOT, SET, UNSET, run
from tests.twin.commands import invoke
from tests.twin.study_bench import REFUSED, write_study
from twin.compare.__main__ import app as compare_app
from twin.compare.folder_difference import file_difference
from twin.compare.verification import DIFFERENT, EXCLUDED, GONE, NEW, ROUNDED, SAME, file_state, folder_state, obstacle
from twin.framework.data_files import FrameFacts, netcdf, preview_png, tiff
from twin.framework.durable import MANIFEST
from twin.framework.run_folder import RunFolder, write_manifest
from twin.study.runs.base_job import BlockResult
from twin.study.runs.blocks import BLOCKS, Engine, journal_of
from twin.study.runs.plan import Plan
from twin.study.runs.setup import resolve_study
from twin.study.study_files import write_data
from twin.verify import app

pytestmark = pytest.mark.drawn


@pytest.fixture
def folder(tmp_path) -> Path:
    """A run folder with files of several kinds."""
    with RunFolder(tmp_path / "run") as made:
        made.write_text("config.yaml", "a: 1\n")
        made.write_json("numbers.json", {"a": 1.5, "b": [1, 2]})
        made.write_bytes("images/frame.tiff", tiff(np.arange(12, dtype=np.uint16).reshape(1, 3, 4), FrameFacts()))
        write_manifest(made, "twin.test", 1.5e9, 2.0, seed=3, again=["twin.test", "config.yaml"], warnings=["mind"])
    return tmp_path / "run"


def flip(place: Path, at: int) -> None:
    content = bytearray(place.read_bytes())
    content[at] ^= 1
    place.write_bytes(content)


@pytest.mark.second
def test_every_changed_byte_of_the_manifest_is_found(folder) -> None:
    """Whatever it hits: a number, a checksum, a name of a file or of a key, white space, a bracket."""
    kept = (folder / MANIFEST).read_bytes()
    damaged, step = 0, 11
    for at in range(0, len(kept), step):
        flip(folder / MANIFEST, at)
        try:
            found = folder_state(folder).changed
        except InputError as error:
            found, damaged = (Path(error.issues[0].file).name,), damaged + 1
        assert MANIFEST in found, kept[at - 20 : at + 20]
        (folder / MANIFEST).write_bytes(kept)
    assert 0 < damaged < len(kept) / step
    assert folder_state(folder).whole


def test_a_manifest_whose_seal_is_taken_off_is_changed(folder) -> None:
    told = json.loads((folder / MANIFEST).read_text())
    del told["digest"]
    (folder / MANIFEST).write_text(json.dumps(told, indent=2) + "\n")
    assert folder_state(folder).changed == (MANIFEST,)


def test_what_is_gone_and_what_was_added_is_named(folder) -> None:
    (folder / "numbers.json").unlink()
    (folder / "images/frame.tiff").unlink()
    (folder / "images/frame.tiff").mkdir()
    (folder / "config.yaml").rename(folder / "images/more.tiff")
    (folder / "config.yaml").symlink_to("images/more.tiff")
    (folder / "link.json").symlink_to("config.yaml")
    state = folder_state(folder)
    assert (state.changed, state.missing) == (("config.yaml", "images/frame.tiff"), ("numbers.json",))
    assert state.additional == ("images/more.tiff", "link.json")


def test_a_changed_config_is_not_run_again(folder) -> None:
    (folder / "config.yaml").write_text("a: 2\n")
    assert obstacle(folder_state(folder)) == "its inputs in the folder were altered: config.yaml"


def test_inputs_that_changed_or_are_gone_are_named(tmp_path) -> None:
    for name in ("first.tiff", "second.tiff", "third.tiff"):
        (tmp_path / name).write_text(name)
    from twin.framework.provenance import inputs_in

    with RunFolder(tmp_path / "run") as made:
        made.write_text("config.yaml", "a: 1\n")
        inputs = inputs_in([str(tmp_path / f"{name}.tiff") for name in ("first", "second", "third")])
        write_manifest(made, "twin.test", 1.5e9, 2.0, again=["twin.test", "config.yaml"], inputs=inputs)
    (tmp_path / "first.tiff").write_text("First.tiff")
    state = folder_state(tmp_path / "run")
    assert state.whole
    assert obstacle(state) == f"files that it read have changed since: {tmp_path / 'first.tiff'}"
    (tmp_path / "second.tiff").unlink()
    state = folder_state(tmp_path / "run")
    assert (state.inputs_changed, state.inputs_gone) == (
        (str(tmp_path / "first.tiff"),),
        (str(tmp_path / "second.tiff"),),
    )
    assert obstacle(state) == f"files that it read are missing: {tmp_path / 'second.tiff'}"


@pytest.fixture(scope="module")
def study(tmp_path_factory) -> Path:
    """The folder of a finished study: numbers that nothing computed, written as the command writes them."""
    place = tmp_path_factory.mktemp("study")
    setup = resolve_study(write_study(place / "in"))
    plan = Plan.of(setup)
    with RunFolder(place / "study") as made, journal_of(setup, place / BLOCKS) as journal:
        journal.keep({str(block): _block(plan, block) for block in range(plan.blocks)})
        write_data(plan, Engine(plan, journal).result(), 1.0, plan.runs, made)
        made.write_bytes(BLOCKS, (place / BLOCKS).read_bytes())
        write_manifest(made, "twin.study", 1.5e9, 2.0, runs=plan.runs, again=["twin.study", "config.yaml"])
    return place / "study"


def _block(plan: Plan, block: int) -> BlockResult:
    runs = np.array(plan.block(block), float)
    values = np.stack([runs, -runs], axis=1)
    return BlockResult(
        values, 0.1 * np.abs(values), np.full(values.shape, np.nan), ("",) * len(runs), 0.5, ("",) * len(runs)
    )


def test_a_changed_byte_in_each_file_of_a_study_is_found(study, tmp_path) -> None:
    """Also in the journal of its blocks."""
    every = sorted(path.relative_to(study).as_posix() for path in study.rglob("*") if path.is_file())
    assert {BLOCKS, "study.nc", "config.yaml"} <= set(every)
    assert folder_state(study).whole
    for name in every:
        copy = tmp_path / "copy"
        shutil.copytree(study, copy)
        if name != MANIFEST:
            flip(copy / name, (copy / name).stat().st_size // 2)
        else:
            (copy / name).write_text((copy / name).read_text().replace('"runs": 100', '"runs": 101'))
        assert folder_state(copy).changed == (name,)
        (copy / name).unlink()
        if name != MANIFEST:
            assert folder_state(copy).missing == (name,)
        shutil.rmtree(copy)


# what is compared, and how


def json_pair(tmp_path: Path, old: object, new: object):
    return pair(tmp_path, "json", *(json.dumps(data).encode() for data in (old, new)))


@pytest.mark.parametrize("case", REFUSED["compared"])
def test_numbers_are_the_same_rounded_or_different(tmp_path, case) -> None:
    old, new, state = REFUSED["compared"][case]
    assert json_pair(tmp_path, old, new).state == state


def test_terms_are_held_against_the_terms_beside_them(tmp_path) -> None:
    """A Zernike term of 1e-12 waves beside one of 0.3 is zero but for rounding; and on another processor more is."""
    old = {"fields": [{"name": "a", "zernike_waves": {"7-foil 0 deg": 1e-12, "coma 90 deg": 0.3}}]}
    new = {"fields": [{"name": "a", "zernike_waves": {"7-foil 0 deg": 2e-12, "coma 90 deg": 0.3}}]}
    assert json_pair(tmp_path, old, new).state == ROUNDED
    alone = [{"fields": [{"name": "a", "zernike_waves": {"7-foil 0 deg": value}}]} for value in (1e-12, 2e-12)]
    assert json_pair(tmp_path, *alone).state == DIFFERENT
    states = [pair(tmp_path, "json", b'{"a": 1.0}', b'{"a": 1.00000001}', where).state for where in (False, True)]
    assert states == [DIFFERENT, ROUNDED]


def test_a_difference_names_key_old_and_new(tmp_path) -> None:
    old = {"cameras": {"forward": {"d_f_um": 4.0, "d_f_um_sigma_noise": 0.5}}, "other": 1.0}
    new = {"cameras": {"forward": {"d_f_um": 3.0, "d_f_um_sigma_noise": 0.5}}, "other": 1.0 + 1e-15}
    found = json_pair(tmp_path, old, new)
    assert (found.state, found.count) == (DIFFERENT, 2)
    first, second = found.quantities
    assert (first.key, first.old, first.new) == ("cameras.forward.d_f_um", 4.0, 3.0)
    assert (first.relative, first.in_sigma, first.rounding) == (0.25, pytest.approx(2.0), False)
    assert (second.key, second.rounding) == ("other", True)


def pair(tmp_path: Path, ending: str, old: bytes, new: bytes, elsewhere: bool = False):
    for name, content in (("old", old), ("new", new)):
        (tmp_path / name).write_bytes(content)
    return file_state(f"a/b.{ending}", tmp_path / "old", tmp_path / "new", elsewhere)


def test_frames_are_the_same_to_the_bit_but_on_another_processor(tmp_path) -> None:
    frames = np.random.default_rng(1).integers(0, 4000, (2, 96, 96)).astype(np.uint16)
    other = frames.copy()
    other[1, 5, 7] += 1
    old, new = (tiff(some, FrameFacts()) for some in (frames, other))
    found = pair(tmp_path, "tiff", old, new)
    assert found.state == DIFFERENT
    assert found.quantities[0].key == "pixels[1, 5, 7]"
    assert pair(tmp_path, "tiff", old, new, elsewhere=True).state == ROUNDED
    other[0] += 1
    assert pair(tmp_path, "tiff", old, tiff(other, FrameFacts()), elsewhere=True).state == DIFFERENT
    assert pair(tmp_path, "tiff", old, tiff(frames[:1], FrameFacts())).quantities[0].old == "shape 2 x 96 x 96"
    tifffile.imwrite(tmp_path / "packed.tiff", frames, compression="lzw", photometric="minisblack")
    assert pair(tmp_path, "tiff", old, (tmp_path / "packed.tiff").read_bytes()).state == SAME


def test_arrays_are_compared_by_their_peak(tmp_path) -> None:
    photons = np.random.default_rng(1).uniform(0.0, 1e4, (3, 4))
    files = {}
    for name, off in (("same", 0.0), ("rounded", 1e-6), ("other", 1e-4)):
        moved = photons.copy()
        moved[2, 1] += off
        files[name] = netcdf(xr.Dataset({"photons": (("row", "column"), moved)}))
    assert pair(tmp_path, "nc", files["same"], files["rounded"]).state == ROUNDED
    found = pair(tmp_path, "nc", files["same"], files["other"])
    assert (found.state, found.quantities[0].key) == (DIFFERENT, "photons[2, 1]")
    assert pair(tmp_path, "nc", files["same"], b"no netCDF").why.startswith("cannot be read")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    with pytest.raises(InputError, match="loop: cannot be read"):
        file_difference("a.nc", tmp_path / "loop", tmp_path / "loop")


def test_tables_pictures_and_texts(tmp_path) -> None:
    def table(value: float) -> bytes:
        text = io.StringIO()
        csv.writer(text).writerows([["camera", "x [um]"], ["forward", value], ["backward", 2.0]])
        return text.getvalue().encode()

    found = pair(tmp_path, "csv", table(1.0), table(1.5))
    assert (found.state, found.quantities[0].key) == (DIFFERENT, "row 2, x [um]")
    assert pair(tmp_path, "csv", table(1.0), table(1.0 + 1e-15)).state == ROUNDED
    pictures = (preview_png(np.roll(np.eye(60)[None], k, axis=1)) for k in (0, 3))
    assert pair(tmp_path, "png", *pictures).state == EXCLUDED
    assert pair(tmp_path, "txt", b"a 1.0 b", b"a 1.0000000000001 b").state == ROUNDED
    assert pair(tmp_path, "txt", b"a 1.0 b", b"a 1.0 c").state == DIFFERENT
    assert pair(tmp_path, "html", b"made on Monday", b"made on Tuesday").state == EXCLUDED
    assert file_state("a.json", tmp_path / "old", tmp_path / "none", False).state == GONE
    assert file_state("a.json", tmp_path / "none", tmp_path / "old", False).state == NEW


# the command


def test_what_is_no_run_folder_is_refused(tmp_path, folder) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "other").mkdir()
    (tmp_path / "other/manifest.json").write_text('{"name": "an extension of a browser"}')
    told = json.loads((folder / MANIFEST).read_text())
    told["sha256"]["n" * 300] = "0" * 64
    (folder / MANIFEST).write_text(json.dumps(told))
    for name, said in (
        ("none", "no such folder"),
        ("run/config.yaml", "is not a folder"),
        ("empty", "it has no manifest.json of a run; allowed: the folder of a finished run"),
        ("other", "other/manifest.json: is not the manifest of a run, or is damaged"),
        ("run", "cannot be read: File name too long"),
    ):
        result = invoke(app, tmp_path / name)
        assert result.exit_code == 2
        assert said in " ".join(result.stderr.split()), result.stderr


def test_options_that_do_not_go_together_are_refused(folder) -> None:
    for words, said in (
        (("--files", "--keep", folder / "x"), "--files repeats nothing"),
        (("--keep", folder), "exists; choose another folder"),
    ):
        result = invoke(app, folder, *words)
        assert (result.exit_code, result.stdout) == (2, "")
        assert said in " ".join(result.stderr.split())


def test_the_files_alone_take_no_computing(folder) -> None:
    result = invoke(app, folder, "--files")
    verdict = "All 3 files are as the run wrote them. The run was not repeated.\n"
    assert (result.exit_code, result.stdout) == (0, verdict)
    flip(folder / "numbers.json", 12)
    result = invoke(app, folder, "--files", "--json")
    assert result.exit_code == 1
    told = json.loads(result.stdout)
    assert (told["whole"], told["changed"], told["made_again"]) == (False, ["numbers.json"], None)
    assert told["verdict"].startswith("numbers.json is not as the run wrote it")


@pytest.fixture(scope="module")
def compared(tmp_path_factory) -> Path:
    """The folder of a real run that takes no second: two hand-made runs compared."""
    place = tmp_path_factory.mktemp("compared")
    for name, value in (("one", 1.0), ("two", 1.5)):
        with RunFolder(place / name) as made:
            made.write_text("config.yaml", "a: 1\n")
            made.write_json("numbers.json", {"a": value, "a_sigma": 0.1})
            write_manifest(made, "twin.test", 1.5e9, 2.0)
    here = Path.cwd()
    os.chdir(place)
    try:
        result = invoke(compare_app, "one", "two", "--out", "out", "--quiet")
    finally:
        os.chdir(here)
    assert result.exit_code == 1, result.stderr
    return place


@pytest.mark.second
def test_a_run_made_again_is_the_same_to_the_byte(compared, tmp_path) -> None:
    """By its own words, in the folder where it was typed; a numpy.py there is not imported."""
    (compared / "numpy.py").write_text("raise SystemExit('executed')")
    result = invoke(app, compared / "out", "--json", "--keep", tmp_path / "again")
    (compared / "numpy.py").unlink()
    assert result.exit_code == 0, result.stdout + result.stderr
    told = json.loads(result.stdout)
    assert told["made_again"]["state"] == SAME
    assert (told["made_again"]["other_program"], told["made_again"]["other_processor"]) == ([], [])
    states = {one["file"]: one["state"] for one in told["made_again"]["files"]}
    assert set(states.values()) == {SAME}
    assert "compare.json" in states
    assert folder_state(tmp_path / "again").whole


def test_a_number_that_the_run_does_not_give_is_found(compared, tmp_path) -> None:
    """Though every checksum is right: whoever wrote the folder wrote another number into it."""
    doctored = tmp_path / "doctored"
    manifest = json.loads((compared / "out" / MANIFEST).read_text())
    with RunFolder(doctored) as made:
        for name in manifest["sha256"]:
            made.write_bytes(
                name, (compared / "out" / name).read_bytes().replace(b'"difference": 0.5', b'"difference": 0.4')
            )
        facts = {key: manifest[key] for key in ("again", "started_in", "inputs", "test")}
        write_manifest(made, manifest["program"], 1.5e9, 2.0, **facts)
    assert folder_state(doctored).whole
    result = invoke(app, doctored, "--json")
    assert result.exit_code == 1
    told = json.loads(result.stdout)
    wrong = next(one for one in told["made_again"]["files"] if one["file"] == "compare.json")
    assert (wrong["state"], wrong["quantities"]) == (DIFFERENT, 1)
    first = wrong["differ_most"][0]
    assert (first["key"].rpartition(".")[2], first["old"], first["new"]) == ("difference", 0.4, 0.5)


def test_inputs_that_changed_since_end_with_two(compared) -> None:
    kept = (compared / "two/numbers.json").read_bytes()
    try:
        (compared / "two/numbers.json").write_bytes(kept.replace(b"1.5", b"1.6"))
        result = invoke(app, compared / "out")
        assert result.exit_code == 2
        assert f"have changed since: {compared}/two/numbers.json" in result.stdout
    finally:
        (compared / "two/numbers.json").write_bytes(kept)


def test_runs_that_cannot_be_made_again_are_told(tmp_path) -> None:
    """Its folder is gone, its command fails; and what is still being written is no run."""
    cases = [(tmp_path / ".run.0123.partial", "a run that was broken off, or is still being written")]
    cases += [(tmp_path / name, "not a run folder") for name in (".hidden", "a.partial")]
    for place, _ in cases:
        place.mkdir()
    for name, facts, said in (
        ("gone", {"started_in": str(tmp_path / "none")}, "the folder in which it was started is missing"),
        ("fails", {"started_in": str(tmp_path)}, "config.yaml ended with exit code 1"),
    ):
        with RunFolder(tmp_path / name) as made:
            made.write_text("config.yaml", "a: 1\n")
            write_manifest(made, "twin.nothing", 1.5e9, 2.0, again=["twin.nothing", "config.yaml"], **facts)
        cases.append((tmp_path / name, said))
    for place, said in cases:
        result = invoke(app, place)
        assert result.exit_code == 2, result.output
        assert said in " ".join(result.output.split()), result.output


# --- run folders of several commands ----------------------------------------------------------------------------------


@pytest.mark.second
@pytest.mark.parametrize("name", ["lab_turntable", "orbit_adjust", "study_gradient"])
def test_a_changed_byte_is_found_and_the_run_comes_out_the_same(name, tmp_path) -> None:
    """A byte in the middle of each file, one file after the other; then the run is made again."""
    done = run(BY_NAME[name], tmp_path)
    assert (done.out / MANIFEST).exists(), done.stderr
    for path in [path for path in done.out.rglob("*") if path.is_file() and path.name != MANIFEST]:
        kept = path.read_bytes()
        content = bytearray(kept or b"x")
        content[len(content) // 2] ^= 1
        path.write_bytes(content)
        assert path.relative_to(done.out).as_posix() in folder_state(done.out).changed
        path.write_bytes(kept)
    environment = {key: value for key, value in os.environ.items() if key not in UNSET} | SET
    command = [sys.executable, "-m", "twin.verify", str(done.out), "--json"]
    found = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stdout + found.stderr
    told = json.loads(found.stdout)["made_again"]
    assert (told["state"], told["other_program"], told["other_processor"]) == ("same", [], [])


AUDITED = """
import json, os, runpy, sys
opened = []
def hook(event, told):
    if event == "open" and isinstance(told[0], (str, bytes)) and not told[2] & (os.O_WRONLY | os.O_RDWR):
        opened.append(os.path.abspath(os.fsdecode(told[0])))
sys.addaudithook(hook)
sys.path.insert(0, os.getcwd())
place, sys.argv = sys.argv[1], sys.argv[2:]
try:
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
finally:
    with open(place, "w") as file:
        json.dump(opened, file)
"""
"""Runs a module and writes down which files were opened to be read."""


@pytest.mark.second
@pytest.mark.parametrize("command", ["orbit check", "lab focus"])
def test_every_file_that_was_read_is_an_input(command, tmp_path) -> None:
    """Whatever a test opens of its measurements stands in the manifest; its own YAML is in config.yaml."""
    program, test = command.split()
    shutil.copytree(ROOT / "scenes" / program / "measured", tmp_path / "in")
    words = [f"twin.{program}", test, tmp_path / f"in/{test}.yaml", "--out", tmp_path / "out", "--quiet"]
    ran = [sys.executable, "-c", AUDITED, tmp_path / "opened.json", *words]
    subprocess.run(list(map(str, ran)), cwd=ROOT, check=True)
    opened = {Path(name) for name in json.loads((tmp_path / "opened.json").read_text())}
    read = {str(path) for path in opened if tmp_path / "in" in path.parents and path.suffix != ".yaml"}
    state = folder_state(tmp_path / "out")
    assert read
    assert read == set(state.manifest.inputs)
