"""Memory is estimated before anything is computed: what does not fit is refused with the number that does; from the
command line at file, line and key.
"""

from __future__ import annotations

import importlib
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile

from optics.numerics.backend import Backend
from scenes.specs.load import EXAMPLES, SCENES
from scenes.specs.resolved import resolve
from scenes.yaml.errors import InputError
from tests.limits.extremes import STUDIES_BEYOND, Extreme
from tests.twin.commands import files, invoke
from tests.twin.study_bench import REFUSED
from twin.framework import memory
from twin.framework.console import PROGRAMS
from twin.framework.memory import LIMIT, amount_text, free_memory, largest
from twin.main_job.render_job import render_job
from twin.monitor import monitor_experiment
from twin.monitor.monitor_experiment import MonitorExperiment, MonitorSize, require_memory
from twin.sensors.area_detector import ReadNoise
from twin.study.runs.plan import require_study_memory, study_bytes
from twin.study.runs.setup import resolve_study


@pytest.mark.parametrize(("text", "number"), [("8 GB", 8e9), ("500MB", 5e8), (" 1.5 GB ", 1.5e9)])
def test_the_environment_says_what_may_be_taken(text: str, number: float, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(LIMIT, text)
    assert free_memory() == pytest.approx(number)


@pytest.mark.parametrize("text", ["8", "much", "-1 GB", "1 TB"])
def test_another_text_is_bad_input(text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(LIMIT, text)
    with pytest.raises(InputError, match="is not an amount of memory"):
        free_memory()


def test_what_the_system_leaves(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(LIMIT, raising=False)
    assert 1e6 < free_memory() < math.inf
    # a container of 1 GB in one of 2 GB, of which 0.3 and 1.5 GB are taken
    inner = tmp_path / "outer" / "inner"
    inner.mkdir(parents=True)
    for folder, most, used in ((inner.parent, "2000000000", "1500000000"), (inner, "1000000000", "300000000")):
        (folder / "memory.max").write_text(most)
        (folder / "memory.current").write_text(used)
    (tmp_path / "memory.max").write_text("max")
    group = tmp_path / "cgroup"
    group.write_text("0::/outer/inner\n")
    monkeypatch.setattr(memory, "_GROUP", group)
    monkeypatch.setattr(memory, "_GROUPS", tmp_path)
    assert free_memory() == 5e8


def test_the_largest_that_fits() -> None:
    assert largest(lambda n: n <= 37, 1000, 1) == 37
    assert largest(lambda n: False, 1000, 23) == 23
    assert (amount_text(3.14159e9), amount_text(4.2e8)) == ("3.14 GB", "420 MB")


@pytest.fixture(scope="module")
def experiment(backend: Backend) -> MonitorExperiment:
    return MonitorExperiment(resolve(EXAMPLES / "aligned.yaml"), backend)


@pytest.fixture
def nothing_is_ordinary(monkeypatch: pytest.MonkeyPatch) -> None:
    """Small jobs are refused, too."""
    monkeypatch.setattr(memory, "ORDINARY", 0.0)
    monkeypatch.setattr(memory, "reusable_memory", lambda: 0.0)


@pytest.mark.usefixtures("nothing_is_ordinary")
@pytest.mark.parametrize(
    ("changes", "key", "unit"),
    [
        ({"frames": 10_000}, "frames", "frames"),
        ({"rows": 2000, "columns": 3000}, "monitor.area_ccd.columns", "rows and columns"),
    ],
    ids=["frames", "ccd"],
)
def test_what_would_fit_is_told(changes, key, unit, experiment, monkeypatch) -> None:
    """The number that is told fits, and the next one does not."""
    resolved, detector = experiment.resolved, replace(experiment.detector, noise=(ReadNoise(1.0),))
    size = replace(experiment.size(), **changes)
    limit = f"{0.5e-6 * (size.bytes(detector) + experiment.size().bytes(detector)):.0f} MB"
    monkeypatch.setenv(LIMIT, limit)
    with pytest.raises(InputError, match=r"needs about \d.* and .* may be used") as caught:
        require_memory(resolved, size, detector)
    assert ".".join(map(str, caught.value.key)).endswith(key)
    told = re.match(rf"at most (\d+) {unit}", caught.value.allowed or "")
    assert told is not None, caught.value.allowed
    most = int(told[1])

    def lowered(n: int) -> MonitorSize:
        return replace(size, **{name: min(value, n) for name, value in changes.items()})

    require_memory(resolved, lowered(most), detector)
    with pytest.raises(InputError):
        require_memory(resolved, lowered(most + 1), detector)


@pytest.mark.usefixtures("nothing_is_ordinary")
def test_frames_are_counted_before_anything_is_rendered(experiment, backend, monkeypatch) -> None:
    monkeypatch.setenv(LIMIT, "350 MB")
    done: list[str] = []
    monkeypatch.setattr(experiment, "detector", replace(experiment.detector, noise=(ReadNoise(1.0),)))
    with pytest.raises(InputError, match="10000 frames of area CCDs") as caught:
        render_job(
            experiment.resolved, backend, 10_000, advance=lambda part, *_: done.append(part), experiment=experiment
        )
    assert caught.value.key == ("render", "frames")
    assert set(done) == {"build the instrument"}


def test_frames_in_a_file_take_no_more_than_a_gibibyte(experiment, monkeypatch) -> None:
    """However many they are, and on the way there: what is kept in memory is small against what a job takes anyway."""
    monkeypatch.setenv(LIMIT, "1 GB")
    noisy = replace(experiment.detector, noise=(ReadNoise(1.0),))
    monkeypatch.setattr(monitor_experiment, "cores", lambda: 64)
    for frames in (100, 900, 1000, 3600, 10_000):
        size = replace(experiment.size(), frames=frames)
        for detector in (experiment.detector, noisy):
            require_memory(experiment.resolved, size, detector)
            assert size.bytes(detector) < 2**30


@pytest.mark.second
def test_a_large_ccd_is_refused_wherever_an_instrument_is_used(tmp_path, backend, monkeypatch) -> None:
    monkeypatch.setenv(LIMIT, "4 GB")
    job = Extreme(((r"rows: 96, columns: 96", "rows: 4096, columns: 4096"),)).write(tmp_path)
    with pytest.raises(InputError, match=r"instrument\.yaml:11: monitor\.area_ccd\.rows: this needs about [\d.]+ GB"):
        MonitorExperiment(resolve(job), backend)


def test_runs_of_a_study_are_counted(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv(LIMIT, "1 GB")
    monkeypatch.setattr(memory, "reusable_memory", lambda: 0.0)
    setup = resolve_study(STUDIES_BEYOND["ten million runs"].write(tmp_path))
    with pytest.raises(InputError, match=r"this needs about [\d.]+ GB of memory, and 1 GB may be used") as caught:
        require_study_memory(setup)
    assert caught.value.key == ("design", "runs")
    told = re.match(r"at most (\d+) runs", caught.value.allowed or "")
    assert told is not None
    assert study_bytes(setup, int(told[1])) <= 1e9 < study_bytes(setup, int(told[1]) + 1)
    # the study's own limit, where that is less
    monkeypatch.setenv(LIMIT, "900 GB")
    with pytest.raises(InputError, match=r"4 GB may be used; .*, or a larger limits\.memory"):
        require_study_memory(setup)


BEYOND = REFUSED["beyond_memory"]
"""Command -> a file of ``scenes``, what stands there for what, the key that is named then, and the number's unit."""


def check_refused(done: object, file: Path | None, key: str, unit: str, folder: Path) -> None:
    """Exit code 2 with file, line, key and the number that fits; nothing was written."""
    assert done.exit_code == 2, done.output  # type: ignore[attr-defined]
    said = " ".join(done.stderr.split())  # type: ignore[attr-defined]
    assert re.search(rf"{re.escape(key)}: .*this needs about [\d.]+ GB of memory, and 1 GB may be used", said), said
    assert re.search(rf"allowed: at most \d+ {unit}, or more memory", said), said
    if file is not None:
        assert re.search(rf"{re.escape(file.name)}:\d+: {re.escape(key)}", said), said
    assert files(folder) == ({file.name} if file is not None else set())


@pytest.mark.parametrize("name", BEYOND)
def test_more_memory_than_there_is_is_refused(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    place, edits, key, unit = BEYOND[name]
    text = (SCENES / place).read_text("utf-8")
    for old, new in (edit.split(">") for edit in edits.split("|")):
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    file = tmp_path / "test.yaml"
    file.write_text(text, "utf-8")
    monkeypatch.setenv(LIMIT, "1 GB")
    program, _, command = name.partition(" ")
    module = PROGRAMS[program][0]
    app = importlib.import_module(module if module == "twin.lab" else f"{module}.__main__").app
    done = invoke(app, *([command] if command else []), file, "--out", tmp_path / "run")
    check_refused(done, file, key, unit, tmp_path)


def test_a_long_life_is_refused_by_its_option(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from twin.operate.__main__ import app

    monkeypatch.setenv(LIMIT, "1 GB")
    words = ("--from", "2027-01-01T00:00:00Z", "--days", "4000", "--every", "1h")
    done = invoke(app, "simulate", EXAMPLES / "operation.yaml", *words, "--out", tmp_path / "run")
    check_refused(done, None, "--every", "readings", tmp_path)


def test_a_long_series_of_frames_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By the headers of the files, before any frame is read."""
    from twin.recover.__main__ import app

    tifffile.imwrite(tmp_path / "frames.tiff", np.zeros((3, 600, 600), np.uint16), photometric="minisblack")
    times = ", ".join(f"{k} min" for k in range(20))
    geometry = "{principal_distance: 5.5 m, separation: 0.2 m, pitch: 5 um}"
    each = f"{{before: frames.tiff, after: [{', '.join(['[frames.tiff]'] * 20)}]}}"
    file = tmp_path / "measurement.yaml"
    file.write_text(
        f"geometry: {{a: {geometry}}}\ndetector: monitor_ccd\nexposure: 10 ms\ntemplate: measured\n"
        f"times: [{times}]\nframes: {{a/left: {each}, a/right: {each}}}\n",
        "utf-8",
    )
    monkeypatch.setenv(LIMIT, "1 GB")
    done = invoke(app, file, "--out", tmp_path / "run")
    (tmp_path / "frames.tiff").unlink()
    check_refused(done, file, "times", "times", tmp_path)
