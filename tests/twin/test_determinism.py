"""The same seed gives the same bytes, whatever the number of threads and cores."""

import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")
MANIFEST = "manifest.json"
PAGES = ("report.html",)
"""They name the manifest's times; of the manifest itself all but times and checksums is compared."""
RUNS = {"render": ("twin.render", "scenes/examples/perturb.yaml", "--frames", "2")}
SLOW_RUNS = {
    "angle": ("twin.orbit", "angle", "scenes/orbit/angle.yaml"),
    "course": ("twin.render", "scenes/examples/orbit.yaml", "--frames", "1"),
    "targets": ("twin.render", "scenes/examples/targets.yaml", "--frames", "2"),
    "turntable": ("twin.lab", "turntable", "scenes/lab/turntable.yaml"),
    "distortion": ("twin.lab", "distortion", "scenes/lab/distortion.yaml"),
    "calibrate": ("twin.orbit", "calibrate", "scenes/orbit/calibrate_strip.yaml"),
}


def run(words: tuple[str, ...], out: Path, threads: int) -> None:
    """On one core with one thread, or on two cores with that many threads of every library."""
    environment = {**os.environ, **dict.fromkeys(THREADS, str(threads))}
    cores = set(sorted(os.sched_getaffinity(0))[: 1 if threads == 1 else None])
    done = subprocess.run(
        [sys.executable, "-m", *words, "--out", str(out)],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        timeout=900,
        preexec_fn=lambda: os.sched_setaffinity(0, cores),
    )
    assert done.returncode == 0, done.stderr


def contents(folder: Path) -> dict[str, str]:
    """Checksums of all files but those that hold times."""
    names = [path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()]
    return {
        name: hashlib.sha256((folder / name).read_bytes()).hexdigest()
        for name in sorted(names)
        if name != MANIFEST and name not in PAGES
    }


def same(words: tuple[str, ...], folder: Path) -> None:
    places = {threads: folder / str(threads) for threads in (1, 3)}
    for threads, place in places.items():
        run(words, place, threads)
    first, second = (contents(place) for place in places.values())
    assert len(first) >= 3
    assert [name for name in first if first[name] != second.get(name)] == []
    assert first.keys() == second.keys()


@pytest.mark.slow
@pytest.mark.parametrize("name", RUNS)
def test_threads_change_no_byte(name, tmp_path) -> None:
    same(RUNS[name], tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("name", SLOW_RUNS)
def test_threads_change_no_byte_of_long_runs(name, tmp_path) -> None:
    same(SLOW_RUNS[name], tmp_path)


@pytest.mark.slow
def test_another_seed_changes_the_images(tmp_path) -> None:
    """The comparison above can fail."""
    for seed in ("1", "2"):
        run((*RUNS["render"], "--seed", seed), tmp_path / seed, 2)
    first, second = (contents(tmp_path / seed) for seed in ("1", "2"))
    assert any(name.endswith(".tiff") and first[name] != second[name] for name in first)


@pytest.mark.slow
def test_a_group_of_checks(tmp_path) -> None:
    """All numbers of a group of the validation, times left out."""
    found = []
    for threads in (1, 3):
        out = tmp_path / str(threads)
        run(("twin.validate", "--only", GROUP), out, threads)
        found.append(_without_times(json.loads((out / "validation.json").read_text("utf-8"))))
    assert GROUP in json.dumps(found[0])
    assert found[0] == found[1]


GROUP = "001.eq2"
"""Rendered and measured; its whole group is done with it."""
TIMES = ("_s", "time", "seconds", "started")


def _without_times(data):
    if isinstance(data, dict):
        return {k: _without_times(v) for k, v in data.items() if not k.endswith(TIMES)}
    return [_without_times(v) for v in data] if isinstance(data, list) else data
