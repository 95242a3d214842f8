"""A cheap study for tests of the engine: a monitor with small CCDs and one frame."""

import os
import subprocess
import sys
import time
from pathlib import Path

from scenes.specs.load import INSTRUMENTS, LIBRARY
from tests.twin.commands import replaced

ROOT = Path(__file__).resolve().parents[2]
STUDY = """name: study
base: {command: render, file: job.yaml}
factors:
  m2z: {key: [job, perturb, base/forward/M2, shift, 2], normal: {mean: 0 um, sigma: 1 um}}
  m2x: {key: [job, perturb, base/forward/M2, shift, 0], uniform: [-1 um, 1 um]}
design: {kind: monte_carlo, runs: 100, seed: 3}
responses:
  df: {key: [recovered, cameras, forward, model, d_f_um], sigma: [recovered, cameras, forward, model, d_f_um_sigma]}
  true_df: {key: [truth, cameras, forward, d_f_um]}
"""


def write_study(folder: Path, *changes: tuple[str, str], text: str = STUDY) -> Path:
    """The study and its base in a folder, with changes of its text."""
    instrument = (LIBRARY / INSTRUMENTS / "gf7_pair.yaml").read_text("utf-8")
    small = replaced(instrument, ("name: gf7_pair", "name: small"), ("rows: 96, columns: 96", "rows: 48, columns: 48"))
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "small.yaml").write_text(small, "utf-8")
    (folder / "job.yaml").write_text("instrument: small.yaml\nrender: {frames: 1, seed: 1}\n", "utf-8")
    path = folder / "study.yaml"
    path.write_text(replaced(text, *changes), "utf-8")
    return path


OWN_TO_A_COMMAND = ("study.json", "manifest.json")
"""Files of a study that name times and numbers of workers; its chunks do, too."""


def same_bytes(folder: Path) -> dict[str, bytes]:
    """Files of a finished study that are the same whoever did it, at once or in parts, and their contents."""
    names = {path.relative_to(folder).as_posix(): path for path in folder.rglob("*") if path.is_file()}
    own = {name for name in names if name in OWN_TO_A_COMMAND or name.startswith("chunks/")}
    assert {"study.nc", "study.csv", "statistics.json", "report.html", "config.yaml"} <= names.keys() - own
    return {name: names[name].read_bytes() for name in names.keys() - own}


def start(*arguments: object) -> subprocess.Popen:
    """The command as a user starts it."""
    command = [sys.executable, "-m", "twin.study", *(str(argument) for argument in arguments)]
    return subprocess.Popen(
        command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )


def chunks(folder: Path) -> int:
    """Number of chunks that are listed as done."""
    index = folder / "chunks" / "index.txt"
    return len(index.read_text("utf-8").splitlines()) if index.exists() else 0


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
