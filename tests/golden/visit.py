"""Start a command that serves a page, ask it what a page asks, keep the answers as files, and end it with Ctrl-C.

``python -m tests.golden.visit OUT MODULE ARGUMENTS``
"""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

KNOBS = {"type": "state", "knobs": {"base/forward/M2 shift z": 2.0}, "frames": 2, "seed": 5}
ASKED = (
    {**KNOBS, "n": 1},
    {**KNOBS, "n": 2, "noise": False},
    {"type": "view", "n": 3, "view": "wavefront", "camera": "forward", "field": 0.5, "state": {**KNOBS, "n": 3}},
    {"type": "save", "what": "job", "state": {**KNOBS, "n": 4}},
)
"""Messages of the live page."""
CHANGED = {"type": "state", "knobs": {"design/M2 radius": 0.01, "design/M1 conic": 0.001, "field x": 0.05}}
ASKED_OF_CAMERA = (
    {**CHANGED, "n": 1},
    {**CHANGED, "n": 2, "quality": False},
    {"type": "state", "n": 3, "knobs": {"design/M1 thickness": -5000.0}},
    {"type": "save", "what": "camera", "state": {**CHANGED, "n": 4}},
)
"""Messages of the page of a single camera."""


PLACE = re.compile(r"(http://\S+:(\d+))/\?token=(\S+)")
"""In the line by which a command says where its page is."""


def live(address: str, cookie: str, out: Path) -> None:
    """Keep the greeting of the live twin and its answers to ASKED, or to ASKED_OF_CAMERA."""
    from websockets.sync.client import connect

    place = address.replace("http", "ws") + "/live"
    with connect(place, additional_headers={"Cookie": cookie}, origin=address, max_size=2**24) as line:  # type: ignore[arg-type]
        hello = line.recv(120)
        _keep(hello, out / "hello")
        for k, asked in enumerate(ASKED_OF_CAMERA if json.loads(hello)["design"] else ASKED):
            line.send(json.dumps(asked))
            answer: Any = json.dumps({"type": "process"})
            while isinstance(answer, str) and json.loads(answer)["type"] in ("process", "hello", "progress"):
                answer = line.recv(120)
            _keep(answer, out / f"answer_{k}")


def _keep(answer: str | bytes, place: Path) -> None:
    """Write an answer as JSON, and its images as netCDF."""
    if isinstance(answer, str):
        told = json.loads(answer)
        if "text" in told:  # a file, whose comments say on which machine it was made
            told["text"] = [line for line in told["text"].splitlines() if not line.startswith("#")]
        place.with_suffix(".json").write_text(json.dumps(told), "utf-8")
        return
    end = 4 + int.from_bytes(answer[:4], "little")
    told = json.loads(answer[4:end])
    place.with_suffix(".json").write_text(json.dumps(told), "utf-8")
    pixels = np.frombuffer(answer[-(-end // 8) * 8 :], "<u2")
    xr.Dataset({"pixels": ("pixel", pixels)}).to_netcdf(place.with_suffix(".nc"), engine="h5netcdf")


def main(out: Path, module: str, *words: str) -> int:
    """Visit the page of a command; its exit code."""
    out.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-u", "-m", module, *words, "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        assert process.stdout is not None
        try:
            found = next(filter(None, (re.search(PLACE, line) for line in process.stdout)))
            cookie = f"space_camera_twin_{found[2]}={found[3]}"
            live(found[1], cookie, out)
        finally:
            process.send_signal(signal.SIGINT)
    return process.returncode


if __name__ == "__main__":
    raise SystemExit(main(Path(sys.argv[1]), *sys.argv[2:]))
