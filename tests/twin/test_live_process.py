"""The process that computes is killed while it starts and while it answers: what is told, and what stays."""

from __future__ import annotations

import asyncio
import json
import threading
from contextlib import contextmanager, suppress

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
