"""Truncated, mis-encoded and hostile prescriptions: they are read, or refused with file and line; nothing else."""

import random
import time
from collections.abc import Callable
from pathlib import Path
from typing import cast

import pytest

from scenes.lens.batoid_reader import read_batoid
from scenes.lens.camera_reader import camera_of
from scenes.lens.codev_reader import read_codev
from scenes.lens.glass_catalogue import own_glasses, read_catalogue
from scenes.lens.prescription import Prescription
from scenes.lens.zemax_reader import read_zemax
from scenes.yaml.errors import InputError, Issue
from tests.robustness.mutate import spoilt
from tests.scenes.lens.files import AGF, BATOID, CODEV, SINGLET, TMA

GLASSES = own_glasses()
KINDS: dict[str, tuple[tuple[bytes, ...], Callable[[Path], object]]] = {
    ".zmx": ((TMA.encode("utf-16"), TMA.encode(), SINGLET.encode()), lambda path: read_zemax(path, GLASSES)),
    ".seq": ((CODEV.encode(), CODEV.encode("utf-16-le")), lambda path: read_codev(path, GLASSES)),
    ".yaml": ((BATOID.encode(),), lambda path: read_batoid(path, 650e-9)),
    ".agf": ((AGF.encode(), AGF.encode("utf-16")), read_catalogue),
}
LONGEST = 30.0
"""Seconds for one file, on a machine that has other work, too: the largest YAML takes two, a pattern that goes astray
minutes."""


def issues_of(work: Callable[[], object]) -> tuple[Issue, ...]:
    try:
        work()
    except InputError as error:
        return error.issues
    return ()


def check(folder: Path, suffix: str, count: int, seed: int) -> tuple[int, int]:
    """How many spoilt files were read and refused."""
    contents, read = KINDS[suffix]
    chance, path, done = random.Random(seed), folder / f"spoilt{suffix}", [0, 0]
    for k in range(count):
        path.write_bytes(spoilt(chance.choice(contents), chance))
        begun = time.monotonic()
        issues = issues_of(lambda: read(path))
        done[bool(issues)] += 1
        # of a file that was not read for its length there is no line
        placed = (issue.file == str(path) and (issue.line or issue.problem == "too large") for issue in issues)
        assert all(placed), (k, issues)
        assert not any("\n" in str(issue) for issue in issues), (k, issues)
        assert time.monotonic() - begun < LONGEST, k
    return done[0], done[1]


@pytest.mark.parametrize("suffix", KINDS)
def test_spoilt_files_are_read_or_refused(tmp_path: Path, suffix: str) -> None:
    read, refused = check(tmp_path, suffix, 150, 1)
    assert read >= 10
    assert refused >= 30


@pytest.mark.slow
@pytest.mark.parametrize("suffix", KINDS)
def test_two_thousand_spoilt_files_are_read_or_refused(tmp_path: Path, suffix: str) -> None:
    read, refused = check(tmp_path, suffix, 2000, 2)
    assert read >= 200
    assert refused >= 500


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".zmx", ".seq", ".yaml"])
def test_cameras_of_spoilt_files_trace_as_they_do_or_are_refused(tmp_path: Path, backend, suffix: str) -> None:
    contents, read = KINDS[suffix]
    chance, path, made = random.Random(3), tmp_path / f"spoilt{suffix}", 0
    for _ in range(150):
        path.write_bytes(spoilt(chance.choice(contents), chance))
        issues = issues_of(lambda: camera_of(cast(Prescription, read(path)), "c", backend))
        made += not issues
        assert all(issue.file == str(path) for issue in issues)
    assert made >= 10 or suffix == ".yaml"
