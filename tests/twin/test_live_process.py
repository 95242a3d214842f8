"""The process that computes is stopped and killed under a page: what is told when, and what stays."""

from __future__ import annotations

import json
import os
import signal
import time

import pytest

pytest.importorskip("uvicorn", reason="the extra `live` is not installed")
pytest.importorskip("websockets.sync.client", reason="the extra `live` is not installed")

from tests.twin.live_client import connect, numbered, state
from tests.twin.live_page import running

PROMPT = 2.0
"""Seconds within which a page is told that its readings do not come."""
KNOBS = {"base/forward/M2 shift z": 2.0}


def reading(message: bytes) -> dict:
    told = json.loads(message[4 : 4 + int.from_bytes(message[:4], "little")])
    return {key: told[key] for key in ("readings", "truth")}


def told(ws, wanted: str, seconds: float) -> str:
    """Wait until the page is told this of the process; what it is told."""
    last = time.monotonic() + seconds
    while True:
        said = ws.recv(max(0.0, last - time.monotonic()))
        if isinstance(said, str) and json.loads(said).get("state") == wanted:
            return json.loads(said)["problem"]


def answer(ws, n: int, seconds: float = 120.0) -> dict:
    """Wait for the answer to a state."""
    last = time.monotonic() + seconds
    while True:
        said = ws.recv(max(0.0, last - time.monotonic()))
        if isinstance(said, bytes) and numbered(said) == n:
            return reading(said)


@pytest.mark.slow
def test_a_stopped_and_a_killed_process_are_told_and_the_state_stays():
    with running("gf7_pair", "--port", "0", "--stay") as command, connect(*command.place) as ws:
        ws.recv(5)
        ws.send(state(1, knobs=KNOBS, frames=9, seed=5))
        expected = answer(ws, 1)

        # stopped while nobody asks, and goes on
        os.kill(command.computer(), signal.SIGSTOP)
        assert f"kill -CONT {command.computer()}" in told(ws, "stopped", PROMPT)
        ws.send(state(2, knobs=KNOBS, frames=9, seed=5))
        os.kill(command.computer(), signal.SIGCONT)
        assert told(ws, "runs", PROMPT) == ""
        assert answer(ws, 2) == expected

        # killed while nobody asks
        first = command.computer()
        os.kill(first, signal.SIGKILL)
        assert "killed by SIGKILL" in told(ws, "ended", PROMPT)
        told(ws, "runs", 240.0)
        assert command.computer() != first
        ws.send(state(3, knobs=KNOBS, frames=9, seed=5))
        assert answer(ws, 3) == expected

        # killed over a state: it is answered all the same
        os.kill(command.computer(), signal.SIGSTOP)
        ws.send(state(4, knobs=KNOBS, frames=9, seed=5))
        told(ws, "stopped", PROMPT)
        os.kill(command.computer(), signal.SIGKILL)
        told(ws, "ended", PROMPT)
        assert answer(ws, 4, 240.0) == expected

        # stopped for good: after a while it is started again, as it was
        os.kill(command.computer(), signal.SIGSTOP)
        ws.send(state(5, knobs=KNOBS, frames=9, seed=5))
        told(ws, "stopped", PROMPT)
        told(ws, "ended", 15.0)
        assert answer(ws, 5, 240.0) == expected

        # a stopped process does not keep the server from ending
        os.kill(command.computer(), signal.SIGSTOP)
        ws.send(state(6, knobs=KNOBS))
        told(ws, "stopped", PROMPT)
        began = time.monotonic()
        assert command.end() == 0
        assert time.monotonic() - began < 6.0
        assert "Traceback" not in command.process.stdout.read()


@pytest.mark.slow
def test_values_of_a_studys_factors_stay_when_the_process_is_started_again():
    with running("scenes/examples/study_aperture.yaml", "--port", "0", "--stay") as command:
        with connect(*command.place) as ws:
            greeting = json.loads(ws.recv(5))
            name, first = greeting["factors"][0]["name"], greeting["factors"][0]["now"]
            ws.send(json.dumps({"type": "factors", "values": {name: 0.9 * first}}))
            hello = {}
            while hello.get("type") != "hello":
                hello = json.loads(ws.recv(60))
            assert hello["factors"][0]["now"] == pytest.approx(0.9 * first)
            ws.send(state(1))
            expected = answer(ws, 1)
            os.kill(command.computer(), signal.SIGKILL)
            told(ws, "runs", 240.0)
            ws.send(state(2))
            assert answer(ws, 2) == expected
        assert command.end() == 0
