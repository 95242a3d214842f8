"""Studies and budgets of tests: a cheap study of a monitor with small CCDs and one frame, and files of text."""

import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import yaml

from scenes.specs.load import INSTRUMENTS, LIBRARY
from scenes.specs.tolerance import ToleranceSetup
from scenes.yaml.yaml_file import dump_yaml
from tests.twin.commands import replaced

ROOT = Path(__file__).resolve().parents[2]
HERE = Path(__file__).parent
TEXTS: dict[str, Any] = yaml.load((HERE / "study_texts.yaml").read_bytes(), yaml.CSafeLoader)
STUDY: str = TEXTS["study"]
REFUSED: dict[str, list[Any]] = yaml.load((HERE / "refused_inputs.yaml").read_bytes(), yaml.CSafeLoader)


def refusals(group: str) -> list[Any]:
    """Return cases for ``parametrize``: rows of a group of refused_inputs.yaml."""
    return [pytest.param(*row, id=str(row[-1])) for row in REFUSED[group]]


def without_mtf_and_many_rays(monkeypatch: pytest.MonkeyPatch) -> None:
    """They take most of the time; few rays sample all states of a beam that edges vignette alike, too."""
    monkeypatch.setattr("twin.camera.camera_run.MAX_WAVES_FOR_MTF", 0.0)
    monkeypatch.setattr("scenes.models.camera_sharpness.EVEN", 1000)


def budget(folder: Path, name: str = "gf7", **changes: Any) -> ToleranceSetup:
    """Read a tolerance budget of study_texts.yaml with other keys at its top from a file."""
    file = folder / "budget.yaml"
    file.write_text(dump_yaml({**TEXTS[name], **changes}), "utf-8")
    return ToleranceSetup.read(file)


def write_study(folder: Path, *changes: tuple[str, str], text: str = STUDY) -> Path:
    """The study and its base in a folder, with changes of its text."""
    instrument = (LIBRARY / INSTRUMENTS / "gf7_pair.yaml").read_text("utf-8")
    small = replaced(instrument, ("name: gf7_pair", "name: small"), ("rows: 96, columns: 96", "rows: 44, columns: 48"))
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "small.yaml").write_text(small, "utf-8")
    (folder / "job.yaml").write_text("instrument: small.yaml\nrender: {frames: 1, seed: 1}\n", "utf-8")
    path = folder / "study.yaml"
    path.write_text(replaced(text, *changes), "utf-8")
    return path


OWN_TO_A_COMMAND = ("study.json", "manifest.json", "blocks.journal")
"""Files of a study that name times and numbers of workers, or whose lines stand as blocks were done."""


def same_bytes(folder: Path) -> dict[str, bytes]:
    """Files of a finished study that are the same whoever did it, at once or in parts, and their contents."""
    names = {path.relative_to(folder).as_posix(): path for path in folder.rglob("*") if path.is_file()}
    assert {"study.nc", "study.csv", "statistics.json", "report.html", "config.yaml", *OWN_TO_A_COMMAND} <= names.keys()
    return {name: place.read_bytes() for name, place in names.items() if name not in OWN_TO_A_COMMAND}


def start(*arguments: object) -> subprocess.Popen:
    """The command as a user starts it."""
    command = [sys.executable, "-m", "twin.study", *(str(argument) for argument in arguments)]
    return subprocess.Popen(
        command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )


def blocks(folder: Path) -> int:
    """Number of blocks that are kept beside the folder of a study that runs."""
    journal = folder.with_name(f"{folder.name}.blocks") / "blocks.journal"
    return max(0, len(journal.read_bytes().splitlines()) - 1) if journal.exists() else 0


def wait_for(condition, seconds: float = 60.0) -> None:
    """Wait until something is so."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)


def children(pid: int) -> list[int]:
    """Processes below a process that are workers of Dask."""
    out = []
    for place in Path("/proc").iterdir():
        if not place.name.isdecimal():
            continue
        try:
            status, command = (place / "stat").read_text(), (place / "cmdline").read_bytes()
        except OSError:
            continue
        if int(status.rpartition(")")[2].split()[1]) == pid and b"spawn_main" in command:
            out.append(int(place.name))
    return out


def alive(pid: int) -> bool:
    """Whether a process is there and not a zombie."""
    try:
        os.kill(pid, 0)
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
