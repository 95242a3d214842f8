"""Records of an instrument and what is taken into them, for tests and benchmarks."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

from scenes.specs.resolved import ResolvedJob, resolve_with
from twin.operate.record.entries import Entry, FileContent, digest_of_data, micros
from twin.operate.record.history import History, initialise_record

ROOT = Path(__file__).resolve().parents[2]
START = micros("2026-01-01T00:00:00Z")
MINUTE = 60_000_000
"""Microseconds."""
A_DAY = 16
"""Readings of the monitor."""


@cache
def pair() -> ResolvedJob:
    return resolve_with("gf7_pair")


def made(place: Path | str, simulated: bool = True) -> History:
    """A new record of gf7_pair."""
    initialise_record(str(place), pair(), simulated)
    return History(str(place))


def given(name: str, entries: list[Entry]) -> FileContent:
    """A file that holds readings."""
    return FileContent(name, digest_of_data([one.digest for one in entries]), "", entries, {})


def temperatures(first: int, count: int, subject: str = "base") -> list[Entry]:
    """Readings of a body, one a minute."""
    content = {"sigma": 0.05, "unit": "K"}
    return [
        Entry("temperature", subject, START + MINUTE * k, {**content, "values": [293.0 + 1e-3 * (k % 997)]}, k + 2)
        for k in range(first, first + count)
    ]


def table(first: int, count: int) -> str:
    """The same as a table for `TELEMETRY`."""
    rows = []
    for k in range(first, first + count):
        days, minute = divmod(k, 1440)
        hour, rest = divmod(minute, 60)
        rows.append(
            f"2026-{1 + days // 28:02d}-{1 + days % 28:02d}T{hour:02d}:{rest:02d}:00Z,{20 + 1e-3 * (k % 997):.3f}"
        )
    return "UTC,T\n" + "\n".join(rows) + "\n"


TELEMETRY = """instrument: gf7_pair
readings:
  - {kind: temperature, files: "t_*.csv", time: UTC, columns: {base: {column: T, unit: degC, sigma: 0.05 K}}}
"""


def spots(before: float) -> dict[str, Any]:
    """Spots of one camera; those in the reference images stand at the same place along row and column."""
    place = {"row": before, "column": before, "row_sigma": 0.001, "column_sigma": 0.001}
    return {"forward": {side: {"before": place, "after": {**place, "row": 50.0}} for side in ("left", "right")}}


def run_folder(
    folder: Path, angle: float = 1.0, config: str | None = None, frame: bytes = b"frame", before: float | None = None
) -> Path:
    """What a run of the main job leaves, as far as a record reads it; the angle makes one differ from the other."""
    (folder / "images").mkdir(parents=True)
    reading = {"d_alpha_arcsec": angle, "d_alpha_arcsec_sigma": 0.1, "d_alpha_arcsec_sigma_noise": 0.01}
    angles = {"change_arcsec": angle, "change_arcsec_sigma": 0.1, "change_arcsec_sigma_noise": 0.01}
    results = {"schema": "recovered 2", "cameras": {"forward": {"posterior": reading}}, "sigma_holds": True}
    results |= {"intersection_angle": {"posterior": angles}, "frames": 2}
    if before is not None:
        results["spots"] = spots(before)
    (folder / "recovered.json").write_text(json.dumps(results), "utf-8")
    (folder / "config.yaml").write_text(pair().to_yaml() if config is None else config, "utf-8")
    (folder / "images/forward_left_after.tiff").write_bytes(frame)
    names = ("recovered.json", "config.yaml", "images/forward_left_after.tiff")
    digests = {name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in names}
    manifest = {"program": "twin.render", "versions": {"space-camera-twin": "1.0.0"}, "started_unix_s": 0.0}
    (folder / "manifest.json").write_text(json.dumps({**manifest, "wall_time_s": 1.0, "sha256": digests}), "utf-8")
    return folder


def ingesting(record: Path | str, *words: object) -> subprocess.Popen[str]:
    """A process that takes files into a record."""
    return operating("ingest", record, *words)


def operating(command: str, record: Path | str, *words: object) -> subprocess.Popen[str]:
    """A process that runs a command of twin.operate."""
    line = [sys.executable, "-m", "twin.operate", command, str(record), *map(str, words)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.Popen(line, cwd=ROOT, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def postgres_programs() -> Path | None:
    """Folder of the programs of Debian's newest PostgreSQL; None where it is not installed."""
    found = [path.parent for path in Path("/usr/lib/postgresql").glob("*/bin/initdb")]
    return max(found, key=lambda path: int(path.parent.name), default=None)


@contextmanager
def postgres_server(programs: Path, folder: Path) -> Iterator[str]:
    """A server of one's own in a folder, reached by a socket there; gives the address of its database.

    The server refuses to run as root, so root starts it as the user ``nobody``.
    """
    folder.mkdir(parents=True)
    data, as_user = folder / "data", []
    if os.geteuid() == 0:
        shutil.chown(folder, "nobody")
        as_user = ["setpriv", "--reuid=nobody", "--regid=nogroup", "--clear-groups"]

    def call(program: str, *words: str) -> None:
        subprocess.run([*as_user, str(programs / program), *words], check=True, capture_output=True, cwd=folder)

    call("initdb", "-D", str(data), "-U", "twin", "-A", "trust", "-E", "UTF8", "--locale=C.UTF-8")
    options = f"-c listen_addresses='' -c unix_socket_directories='{folder}'"
    call("pg_ctl", "-D", str(data), "-l", str(folder / "log"), "-w", "-o", options, "start")
    try:
        call("createdb", "-h", str(folder), "-U", "twin", "record")
        yield f"postgresql://twin@/record?host={folder}"
    finally:
        call("pg_ctl", "-D", str(data), "-m", "immediate", "-w", "stop")
