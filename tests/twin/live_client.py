"""The live twin's server with a stand-in for what computes, and a client of it; for tests."""

from __future__ import annotations

import asyncio
import http.client
import json
import socket
import threading
import time
from contextlib import contextmanager
from typing import Any

from websockets.sync import client as client_of

from twin.live.messages import Opened, packed
from twin.live.server import COOKIE, Guard, LiveServer, listen

SECRET = "a-secret-of-enough-letters"


class StandIn:
    """Answers with the state's number, after a while, and remembers what it was asked."""

    def __init__(self, seconds: float = 0.0, bytes_each: int = 8) -> None:
        self.opened = Opened({"instrument": "stand-in", "channels": []}, b"glb")
        self.seconds, self.bytes_each = seconds, bytes_each
        self.asked: list[tuple[str, Any]] = []

    def leave(self) -> None:
        pass

    async def ask(self, kind: str, question: Any) -> Any:
        self.asked.append((kind, question))
        await asyncio.sleep(self.seconds)
        if kind == "state":
            return packed({"type": "state", "n": question[0].n, "pad": "x" * self.bytes_each}, {})
        return json.dumps({"type": kind})


@contextmanager
def serving(computer: StandIn, stay: bool = True, host: str = "127.0.0.1", port: int = 0, secret: str = SECRET):
    """A server, by itself on a free port: its port and itself."""
    listening = listen(host, port)
    port = listening.getsockname()[1]
    server = LiveServer(computer, Guard.of(secret, host, port), stay)  # type: ignore[arg-type]
    thread = threading.Thread(target=server.run, args=(listening,), daemon=True)
    thread.start()
    for _ in range(200):
        if server.started:
            break
        time.sleep(0.02)
    try:
        yield port, server
    finally:
        server.stop()
        thread.join(60)  # a guard against one that never ends, on a machine with other work
        assert not thread.is_alive()


def ask(
    port: int, path: str = "/", cookie: str | None = SECRET, method: str = "GET", to: str = "127.0.0.1", **headers: str
) -> tuple[int, dict[str, str], bytes]:
    line = http.client.HTTPConnection(to, port, timeout=5)
    own = {"Host": f"127.0.0.1:{port}", **headers}
    if cookie is not None:
        own["Cookie"] = f"{COOKIE.format(port=port)}={cookie}"
    line.request(method, path, headers=own)
    answer = line.getresponse()
    out = answer.status, {k.lower(): v for k, v in answer.getheaders()}, answer.read()
    line.close()
    return out


def connect(port: int, cookie: str | None = SECRET, origin: str | None = "own", host: str | None = None):
    headers = {} if cookie is None else {"Cookie": f"{COOKIE.format(port=port)}={cookie}"}
    own = f"http://127.0.0.1:{port}" if origin == "own" else origin
    name = f"127.0.0.1:{port}" if host is None else host
    line = socket.create_connection(("127.0.0.1", port), timeout=5)
    return client_of.connect(
        f"ws://{name}/live", sock=line, additional_headers=headers, origin=own, max_size=2**24, close_timeout=1
    )


def state(n: int, **other: Any) -> str:
    return json.dumps({"type": "state", "n": n, **other})


def numbered(message: bytes) -> int:
    return json.loads(message[4 : 4 + int.from_bytes(message[:4], "little")])["n"]
