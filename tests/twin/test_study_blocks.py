"""What is kept of a study while it runs: whose it is, what is damaged, and which program may go on with it."""

import hashlib
import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import twin.framework.provenance
import twin.study.__main__ as command
from tests.twin.commands import invoke
from tests.twin.study_bench import write_study
from twin.framework.cli import Incomplete
from twin.framework.provenance import source_digest, sources
from twin.framework.run_folder import RunFolderError
from twin.study.runs.base_job import BlockResult
from twin.study.runs.blocks import BLOCKS, Engine, OtherProgramError, Task, evaluate, journal_of
from twin.study.runs.plan import Plan
from twin.study.runs.setup import StudySetup, resolve_study

run = partial(invoke, command.app)


@pytest.fixture(scope="module")
def setup(tmp_path_factory) -> StudySetup:
    return resolve_study(write_study(tmp_path_factory.mktemp("in")))


def block(plan: Plan, number: int) -> BlockResult:
    runs = np.array(plan.block(number), float)
    values = np.stack([runs, -runs], axis=1)
    return BlockResult(values, values, values, ("",) * len(runs), 0.5, ("",) * len(runs))


@pytest.fixture
def kept(setup, tmp_path) -> Path:
    """The journal of a study of four blocks."""
    plan, file = Plan.of(setup), tmp_path / BLOCKS
    with journal_of(setup, file) as journal:
        for number in range(plan.blocks):
            journal.keep({str(number): block(plan, number)})
    return file


def opened(setup: StudySetup, file: Path) -> tuple[list[int], list[str]]:
    """Return the blocks that are missing, and what is told of the journal."""
    told: list[str] = []
    with journal_of(setup, file) as journal:
        return Engine(Plan.of(setup), journal, warn=told.append).missing, told


def test_what_is_kept_is_read(setup, kept) -> None:
    with journal_of(setup, kept) as journal:
        result = Engine(Plan.of(setup), journal).result()
    np.testing.assert_array_equal(result.values[:, 0], np.arange(100.0))
    with kept.open("ab") as file:
        file.write(b'0123456789abcdef {"of": "5')  # the power failed
    assert opened(setup, kept) == ([], [])


def doctored(part: str, value: object) -> bytes:
    """A line with its right checksum and a block that no program writes."""
    number = {"array": "float64", "shape": [25, 2], "data": "AAAA" * 133 + "AA=="}
    block = {"values": number, "sigmas": number, "noises": number, "messages": [""] * 25, "doubts": [""] * 25}
    text = json.dumps({"of": "1", "is": {"class": "BlockResult", "with": block | {"seconds": 0.5, part: value}}})
    return hashlib.sha256(text.encode()).hexdigest()[:16].encode() + b" " + text.encode()


@pytest.mark.parametrize(
    "line",
    [
        *(b"", b"[]", b"null", b"\xff\xfe", b"[" * 100_000),
        doctored("values", 1.0),
        doctored("values", {"array": "float64", "shape": [25, 3], "data": "AAAA"}),
        doctored("sigmas", {"array": "object", "shape": [1], "data": "AAAAAAAAAAA="}),
        doctored("noises", {"array": "float64", "shape": [1, 1], "data": "AAAAAAAAAAA="}),
        doctored("messages", [0] * 25),
        doctored("doubts", ["x"]),
        doctored("more", 1),
    ],
)
def test_a_doctored_line_is_computed_again(setup, kept, line) -> None:
    lines = kept.read_bytes().split(b"\n")
    lines[2] = line
    kept.write_bytes(b"\n".join(lines))
    assert opened(setup, kept)[0] == [1]


def test_a_damaged_line_is_told_and_a_damaged_head_refused(setup, kept) -> None:
    lines = kept.read_bytes().split(b"\n")
    kept.write_bytes(b"\n".join([lines[0], lines[1][:-9], *lines[2:]]))
    missing, (told,) = opened(setup, kept)
    assert missing == [0]
    assert told.endswith("1 line of it is corrupt; what it held is computed again")
    kept.write_bytes(b"\n".join([lines[0][:-9], *lines[1:]]))
    with pytest.raises(RunFolderError, match="cannot be read; begin anew without --resume"):
        opened(setup, kept)


@pytest.mark.parametrize("kind", ["link", "folder"])
def test_only_a_file_in_the_folder_is_read(setup, kept, tmp_path, kind) -> None:
    elsewhere = kept.rename(tmp_path / "elsewhere")
    kept.symlink_to(elsewhere) if kind == "link" else kept.mkdir()
    with pytest.raises(RunFolderError, match="cannot use"):
        opened(setup, kept)


@pytest.mark.parametrize("change", ["edited", "new", "gone"])
def test_other_code_is_not_mixed_in(setup, kept, monkeypatch, change) -> None:
    """The detector's quantum efficiency halved in the source between two commands, and the like."""
    other, before, fingerprint = dict(sources()), kept.read_bytes(), replace(setup).fingerprint
    if change == "gone":
        del other["twin/sensors/area_detector.py"]
    else:
        other["twin/sensors/area_detector.py" if change == "edited" else "twin/new.py"] = "0" * 16
    monkeypatch.setattr(twin.framework.provenance, "sources", lambda: other)
    named = "twin/new.py" if change == "new" else "twin/sensors/area_detector.py"
    with pytest.raises(RunFolderError, match=rf"another version of the program.*changed: {named}.*--resume.*--out"):
        opened(setup, kept)
    assert kept.read_bytes() == before
    assert replace(setup).fingerprint != fingerprint


def test_another_version_of_a_package_is_named(setup, kept, monkeypatch) -> None:
    other = twin.framework.provenance.versions() | {"numpy": "1.0"}
    monkeypatch.setattr("twin.framework.provenance.versions", lambda: other)
    with pytest.raises(RunFolderError, match=r"numpy was [0-9.]+ and is 1\.0"):
        opened(setup, kept)


def test_sources_change_with_the_files(tmp_path, monkeypatch) -> None:
    for name in ("optics/a.py", "twin/b.py", "twin/validation/c.py", "scenes/d.yaml"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("x = 1\n")
    monkeypatch.setattr(twin.framework.provenance, "ROOT", tmp_path)
    read = sources.__wrapped__
    first = read()
    assert set(first) == {"optics/a.py", "twin/b.py"}
    (tmp_path / "twin/b.py").write_text("x = 2\n")
    assert read()["twin/b.py"] != first["twin/b.py"]
    assert read()["optics/a.py"] == first["optics/a.py"]


def test_a_worker_with_other_code_computes_nothing(setup) -> None:
    """Files that are edited while a study runs: a worker that is started afterwards refuses its task."""
    plan = Plan.of(setup)
    with pytest.raises(OtherProgramError, match="other source files"):
        evaluate(Task(plan.config, "0" * 64, "llvm", (plan.run(0),)))
    assert not evaluate(Task(plan.config, source_digest(), "llvm", (plan.run(0),))).failed.any()


SIGMA = "[recovered, cameras, forward, model, d_f_um_sigma]"
DF = f"  df: {{key: [recovered, cameras, forward, model, d_f_um], sigma: {SIGMA}}}\n"
TRUE = "  true_df: {key: [truth, cameras, forward, d_f_um]}\n"


def test_words_may_be_others_when_a_study_is_gone_on_with(setup, kept, tmp_path) -> None:
    """Names, units and what the report shows change no run."""
    more = ("name: study", "name: renamed\ndescription: all of it\nreport: {sobol: true}\nlimits: {runs: 999}")
    unit = (TRUE, "  is: {key: [truth, cameras, forward, d_f_um], unit: mm}\n")
    words = resolve_study(write_study(tmp_path / "words", more, unit))
    assert words.content == setup.content
    assert opened(words, kept) == ([], [])


@pytest.mark.parametrize("change", [(f"{DF}{TRUE}", f"{TRUE}{DF}"), ("seed: 3", "seed: 4"), (f", sigma: {SIGMA}", "")])
def test_what_makes_other_numbers_may_not(kept, tmp_path, change) -> None:
    """Also responses in another order: a block keeps them by their places."""
    with pytest.raises(RunFolderError, match="holds another study"):
        opened(resolve_study(write_study(tmp_path / "other", change)), kept)


def test_what_was_begun_is_gone_on_with_or_dropped(tmp_path, monkeypatch) -> None:
    """Neither by mistake: without --resume and --force a command refuses; with --force the old folder stands."""
    file, out, seen = write_study(tmp_path / "in"), tmp_path / "run", []

    def broken(setup, session, place, *_: object) -> None:
        plan = Plan.of(setup)
        with journal_of(setup, place / BLOCKS) as journal:
            seen.append([*journal.known])
            journal.keep({str(len(journal.known)): block(plan, len(journal.known))})
        raise Incomplete("the workers died")

    monkeypatch.setattr("twin.study.study_command.run_study", broken)
    first = run(file, "--out", out)
    again = f"the workers died; what is done is kept, go on with: python -m twin.study {file} --out {out} --resume"
    assert (first.exit_code, again in first.stderr) == (1, True), first.stderr
    refused = run(file, "--out", out)
    assert (refused.exit_code, "begin anew with --force" in refused.stderr) == (2, True)
    assert run(file, "--out", out, "--resume").exit_code == 1
    assert run(file, "--out", out, "--force").exit_code == 1
    assert seen == [[], ["0"], []]
    assert not out.exists()
    out.mkdir()
    (out / "mine.txt").write_text("mine")
    for word in ("--resume", "--force"):
        assert run(file, "--out", out, word).exit_code == 2
    assert (out / "mine.txt").read_text() == "mine"
