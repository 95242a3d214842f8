"""The live twin's server among connections that mean no good, beside other servers, and after a restart."""

from __future__ import annotations

import socket
import time
from contextlib import ExitStack, suppress

import numpy as np
import pytest

pytest.importorskip("uvicorn", reason="the extra `live` is not installed")
pytest.importorskip("websockets.sync.client", reason="the extra `live` is not installed")

from websockets.frames import Frame, Opcode

from tests.twin.live_client import SECRET, StandIn, ask, connect, numbered, serving, state
from twin.live.server import COOKIE, Guard, names_of_this_machine

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
PROMPT = 0.2
"""Seconds in which a user's page is answered."""


def lines(stack: ExitStack, port: int, number: int, said: bytes = b"", source: str = "127.0.0.1"):
    """Connections that say something."""
    out = []
    for _ in range(number):
        line = stack.enter_context(socket.create_connection(("127.0.0.1", port), 5, (source, 0)))
        line.sendall(said)
        out.append(line)
    return out


def answered(port: int, ws, rounds: int, secret: str = SECRET) -> np.ndarray:
    """Seconds that parts of the page and states took, on a new connection and on the page's own."""
    out = []
    for n in range(1, rounds + 1):
        for path in ("/", "/live.js", "/session"):
            began = time.perf_counter()
            assert ask(port, path, secret)[0] == 200
            out.append(time.perf_counter() - began)
        began = time.perf_counter()
        ws.send(state(n))
        while not isinstance(said := ws.recv(10), bytes) or numbered(said) != n:
            pass
        out.append(time.perf_counter() - began)
        time.sleep(0.01)
    return np.array(out)


def test_who_says_nothing_or_nonsense_locks_nobody_out(capfd):
    """300 idle connections and requests that are none: the page is answered promptly, and nothing is printed."""
    with serving(StandIn()) as (port, _), ExitStack() as stack:
        for k in range(10):
            lines(stack, port, 30, source=f"127.0.0.{2 + k}")
        for text in WRONG:
            lines(stack, port, 2, text)
        with connect(port) as ws:
            ws.recv(5)
            # a machine on which much else runs holds up one answer or the other
            assert np.quantile(answered(port, ws, 20), 0.9) < PROMPT
    said = capfd.readouterr()
    assert (said.out, said.err) == ("", "")


@pytest.mark.second
def test_a_page_that_never_reads_is_dropped(monkeypatch):
    """A client of its own: others read by themselves, in a thread."""
    monkeypatch.setattr("twin.live.clients.SEND_TIMEOUT", 0.3)
    with serving(StandIn(bytes_each=30_000_000)) as (port, server), ExitStack() as stack:
        head = SOCKET.replace(b"127.0.0.1", f"127.0.0.1:{port}".encode())
        said = head + f"Cookie: {COOKIE.format(port=port)}={SECRET}\r\n\r\n".encode()
        [line] = lines(stack, port, 1, said)
        assert b" 101 " in line.recv(4096)
        came, n = time.monotonic(), 0
        while server.api.clients:
            assert time.monotonic() - came < 20.0
            n += 1
            with suppress(OSError):  # it may be cut off by now
                line.sendall(Frame(Opcode.TEXT, state(n).encode()).serialize(mask=True))
            time.sleep(0.1)
        assert server.api.states >= 2


# --- several servers, other names -------------------------------------------------------------------------------------


@pytest.mark.second
def test_cookies_of_other_programs_do_not_hide_ours():
    with serving(StandIn()) as (port, _):
        mine = f"space_camera_twin_{port}={SECRET}"
        for others in ('{"a": 1}; ', "a b=c; ", "x=\xe9\xff; ", "=; ;; ", f"space_camera_twin_{port}=wrong; "):
            headers = {"Cookie": others + mine}
            assert ask(port, "/session", cookie=None, **headers)[0] == 200


@pytest.mark.second
def test_servers_on_one_host_and_a_restart_know_their_own_cookie():
    """A browser keeps the cookies of a host, whatever the port; with the same token it is known after a restart."""
    tokens = ["the-token-of-the-first-server", "the-token-of-the-second-one"]
    with ExitStack() as stack:
        ports = [stack.enter_context(serving(StandIn(), secret=token))[0] for token in tokens]
        jar = "; ".join(f"{COOKIE.format(port=port)}={token}" for port, token in zip(ports, tokens, strict=True))
        assert [ask(port, "/session", None, Cookie=jar)[0] for port in ports] == [200, 200]
    for token, status in ((tokens[0], 200), ("another-token-of-enough-letters", 403)):
        with serving(StandIn(), port=ports[0], secret=token):
            assert ask(ports[0], "/session", None, Cookie=jar)[0] == status


def test_every_name_of_this_machine_and_no_other():
    """With ``--host 0.0.0.0``; a request for one of its numbers says so in its Host, and came in at it."""
    with serving(StandIn(), host="0.0.0.0") as (port, _):
        for name in ("127.0.0.1", "localhost", *names_of_this_machine()):
            assert ask(port, "/session", Host=f"{name}:{port}")[0] == 200
        assert ask(port, "/session", to="127.0.0.2", Host=f"127.0.0.2:{port}")[0] == 200
        for name in (f"127.0.0.3:{port}", "127.0.0.2", f"evil.example:{port}", "0.0.0.0", f"127.0.0.2:{port + 1}"):
            assert ask(port, "/session", to="127.0.0.2", Host=name)[0] == 403
        assert ask(port, "/session", None, to="127.0.0.2", Host=f"127.0.0.2:{port}")[0] == 403


def test_the_port_of_http_is_not_written():
    guard = Guard.of(SECRET, "127.0.0.1", 80)
    headers = {"host": "127.0.0.1", "origin": "http://127.0.0.1", "cookie": f"space_camera_twin_80={SECRET}"}
    assert guard.refusal(headers, socket=True) == ""


@pytest.mark.parametrize("site", [None, "none", "same-origin", "same-site", "cross-site", ""])
def test_a_request_of_another_site_is_refused(site) -> None:
    """Another port of this host is another page, though the browser calls it the same site."""
    headers = {"host": "127.0.0.1:5", "cookie": f"space_camera_twin_5={SECRET}"}
    headers |= {} if site is None else {"sec-fetch-site": site}
    found = Guard.of(SECRET, "127.0.0.1", 5).refusal(headers)
    assert found == ("" if site in (None, "none", "same-origin") else "the request comes from another site")


@pytest.mark.second
@pytest.mark.skipif(not socket.has_ipv6, reason="no IPv6")
def test_over_ipv6():
    try:
        with serving(StandIn(), host="::1") as (port, _):
            assert ask(port, "/session", to="::1", Host=f"[::1]:{port}")[0] == 200
            assert ask(port, "/session", to="::1", Host=f"[::2]:{port}")[0] == 403
    except OSError:
        pytest.skip("no IPv6 here")
