"""Connections that mean no good, in a process of their own: ``python -m tests.twin.live_crowd PORT NUMBER SECONDS``.

Idle ones say nothing. Slow ones send a request's head, or its body, letter by letter. Half-open ones say half of
something and close their half, or ask and never read. Malformed ones send what is no HTTP and no WebSocket. Whoever is
cut off comes again. At the end it prints how many were open at once at most, how often somebody came, and how many
answers had status 200.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

KINDS = ("idle", "slow head", "slow body", "half head", "half socket", "never reads", "malformed")
AGAIN = 1.0
"""Seconds after which who was cut off comes again."""
WRONG = [
    b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + bytes(range(256)),  # TLS
    b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n",
    b"\x00" * 3000,
    b"GET / HTTP/9.9\r\nHost: x\r\n\r\n",
    b"GET /\xff\xfe HTTP/1.1\r\nHost: x\r\n\r\n",
    b"GET / HTTP/1.1\r\n\r\n",
    b"GET / HTTP/1.1\r\nHost: a\r\nHost: b\r\n\r\n",
    b"GET / HTTP/1.1\r\nHost: x\r\nCookie: \xff\xfe=\xfd; ;;=\r\n\r\n",
    b"GET / HTTP/1.1\r\nHost: x\r\n" + b"A: b\r\n" * 20_000,
    b"GET / HTTP/1.1\r\nHost: x\r\nContent-Length: -5\r\n\r\n",
    b"POST / HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\nzz\r\n",
    b"GET / HTTP/1.1\r\nHost: x\r\n\r\nrubbish that comes while this is answered\r\n\r\n",
    b"GET / HTTP/1.1\r\nHost: x\r\n\r\n" * 50,
    b"GET / HTTP/1.1\r\nHost: x\r\nConnection: upgrade\r\nUpgrade: h2c\r\n\r\n",
    b"GET /live HTTP/1.1\r\nHost: x\r\nConnection: upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n\r\n",
    b"GET /live HTTP/1.1\r\nHost: x\r\nConnection: upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Key: \xe9\r\n\r\n",
    b"A" * 70_000,
]
SOCKET = (
    b"GET /live HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
    b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nOrigin: http://127.0.0.1\r\n"
)


class Crowd:
    """All of them."""

    def __init__(self, port: int, seed: int) -> None:
        self.port, self.rng = port, random.Random(seed)
        self.open = self.most = self.came = self.answered = 0

    async def one(self, number: int) -> None:
        """Somebody who comes again and again, from one of eight addresses."""
        kind, address = KINDS[number % len(KINDS)], f"127.0.0.{2 + number % 8}"
        while True:
            await asyncio.sleep(AGAIN * self.rng.random())
            writer = None
            with contextlib.suppress(OSError):
                reader, writer = await asyncio.open_connection("127.0.0.1", self.port, local_addr=(address, 0))
                self.came += 1
                self.open += 1
                self.most = max(self.most, self.open)
                try:
                    await self._say(kind, reader, writer)
                finally:
                    self.open -= 1
                    writer.close()

    async def _say(self, kind: str, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if kind == "slow head":
            await self._slowly(writer, b"GET / HTTP/1.1\r\nHost: " + b"x" * 5000)
        elif kind == "slow body":
            writer.write(b"POST / HTTP/1.1\r\nHost: x\r\nContent-Length: 5000\r\n\r\n")
            await self._slowly(writer, b"x" * 5000)
        elif kind == "half head":
            writer.write(b"GET / HTTP/1.1\r\nHos")
            if self.rng.random() < 0.5:
                writer.write_eof()
        elif kind == "half socket":
            writer.write(SOCKET + (b"\r\n" if self.rng.random() < 0.5 else b""))
        elif kind == "never reads":
            writer.write(b"GET /three.min.js HTTP/1.1\r\nHost: x\r\n\r\n" * 20)
            await asyncio.sleep(3600)
        elif kind == "malformed":
            writer.write(self.rng.choice(WRONG))
        while text := await reader.read(65536):
            self.answered += b" 200 " in text

    async def _slowly(self, writer: asyncio.StreamWriter, text: bytes) -> None:
        for letter in text:
            if writer.is_closing():
                return
            writer.write(bytes([letter]))
            await writer.drain()
            await asyncio.sleep(0.2)


async def crowd(port: int, number: int, seconds: float) -> str:
    """What was seen of it."""
    out = Crowd(port, seed=1)
    everybody = [asyncio.create_task(out.one(k)) for k in range(number)]
    await asyncio.sleep(seconds)
    for one in everybody:
        one.cancel()
    await asyncio.gather(*everybody, return_exceptions=True)
    return f"{out.most} {out.came} {out.answered}"


@contextmanager
def crowded(port: int, number: int, seconds: float) -> Iterator[subprocess.Popen[str]]:
    """A crowd before a server, until the block ends."""
    words = [sys.executable, "-m", "tests.twin.live_crowd", str(port), str(number), str(seconds)]
    process = subprocess.Popen(words, cwd=Path(__file__).parents[2], stdout=subprocess.PIPE, text=True)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


if __name__ == "__main__":
    os.nice(10)  # it stands for other machines; the cores are those of the server and its user
    print(asyncio.run(crowd(int(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3]))))  # noqa: T201
