"""The process that computes is killed while it starts and while it answers: what is told, and what stays."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from twin.live.computer import CannotStart, Computer, ComputerLost
from twin.live.messages import AskedState

pytestmark = pytest.mark.second
ASKED = AskedState(n=1), None


@contextmanager
def computer(what: str):
    """A process that is not started yet."""
    made = Computer(what, "llvm")
    try:
        yield made
    finally:
        made.stop()


def test_values_of_a_studys_factors_stay_when_the_process_is_started_again() -> None:
    async def session(process: Computer) -> None:
        async def readings() -> list[object]:
            said = await process.ask("state", ASKED)
            head = json.loads(said[4 : 4 + int.from_bytes(said[:4], "little")])
            return [head["readings"], head["truth"]]

        first = await readings()
        (factor, *_) = process.opened.greeting["factors"]
        await process.ask("factors", {factor["name"]: 0.9 * factor["now"]})
        expected = await readings()
        assert expected != first
        process.kill()
        with pytest.raises(ComputerLost, match="killed by SIGKILL"):
            await process.ask("state", ASKED)
        await process.restart()
        assert process.opened.greeting["factors"][0]["now"] == pytest.approx(0.9 * factor["now"])
        assert await readings() == expected

    with computer("scenes/examples/study_aperture.yaml") as process:
        process.start()
        asyncio.run(session(process))


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
    with computer("nowhere.yaml") as process, pytest.raises(CannotStart, match=r"nowhere\.yaml"):
        process.start()
    ended = threading.Event()
    with computer("gf7_pair") as process:

        def kill() -> None:
            while not ended.wait(0.1):
                with suppress(AttributeError):  # it has not begun
                    process.kill()

        with pytest.raises(CannotStart, match="killed by SIGKILL"):
            process.start(lambda part: process.kill())
        threading.Thread(target=kill, daemon=True).start()
        with pytest.raises(CannotStart, match="3 times during its restart"):
            asyncio.run(process.restart())
        ended.set()
