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


@pytest.mark.second
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
