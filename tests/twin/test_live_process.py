"""The process that computes is killed while it starts and afterwards: what is told."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from twin.live.computer import Computer, ComputerLost
from twin.live.messages import AskedState

pytestmark = pytest.mark.second


@contextmanager
def computer(what: str):
    """A process that is not started yet."""
    made = Computer(what, "llvm")
    try:
        yield made
    finally:
        made.stop()


def test_an_interrupt_while_the_process_imports_is_one_line() -> None:
    """Ctrl-C of a terminal reaches both processes; the second is there before it has imported anything."""
    command = [sys.executable, "-m", "twin.live", "gf7", "--port", "0"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, start_new_session=True) as made:
        end = time.monotonic() + 60.0
        while not any("spawn_main" in line for line in _children(made.pid)) and time.monotonic() < end:
            time.sleep(0.01)
        time.sleep(0.3)
        os.killpg(made.pid, signal.SIGINT)
        assert made.communicate(timeout=60)[1] == b"interrupted: nothing was kept\n"
        assert made.returncode == 130


def _children(pid: int) -> list[str]:
    """The command lines of a process's children."""
    with suppress(OSError):
        names = Path(f"/proc/{pid}/task/{pid}/children").read_text("utf-8").split()
        return [Path(f"/proc/{name}/cmdline").read_text("utf-8") for name in names]
    return []


def test_a_process_that_cannot_start_says_why() -> None:
    with computer("nowhere.yaml") as process, pytest.raises(ComputerLost, match=r"nowhere\.yaml"):
        process.start()
    with computer("gf7_pair") as process:
        with pytest.raises(ComputerLost, match="killed by SIGKILL"):
            process.start(lambda part: process._process.kill())


def test_a_process_that_ends_while_nobody_asks_is_told_at_the_next_request() -> None:
    with computer("gf7") as process:
        process.start()
        process._process.kill()
        with pytest.raises(ComputerLost, match="killed by SIGKILL"):
            asyncio.run(process.ask("state", (AskedState(n=1), None)))
