"""The live twin's server: who may speak to it, what it takes, and that nothing piles up; computing is a stand-in."""

from __future__ import annotations

import json
import re
import threading
import time
from contextlib import ExitStack, contextmanager
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("uvicorn", reason="the extra `live` is not installed")
pytest.importorskip("websockets.sync.client", reason="the extra `live` is not installed")

from websockets.exceptions import ConnectionClosed, InvalidStatus

from tests.twin.live_client import SECRET, StandIn, ask, connect, numbered, serving, state
from twin.framework.cli import InputErrorText
from twin.live.__main__ import TOKEN, _serve
from twin.live.clients import BAD_MESSAGES, Client, Disconnected
from twin.live.computer import ComputerLost
from twin.live.messages import LARGEST_MESSAGE, AskedState, BadMessage, BlindState, read_message
from twin.live.server import BadToken, Guard, LiveServer, listen, new_token


@contextmanager
def pages(computer: StandIn, count: int = 1):
    """A server's port and itself, and pages that were greeted."""
    with serving(computer) as (port, server), ExitStack() as stack:
        lines = [stack.enter_context(connect(port)) for _ in range(count)]
        for line in lines:
            line.recv(5)
        yield port, server, *lines


def wait_for(ws, n: int) -> None:
    """Wait until a page is told a state."""
    while numbered(ws.recv(5)) != n:
        pass


def told(*lines) -> list[dict[str, Any]]:
    return [json.loads(line.recv(5)) for line in lines]


@pytest.fixture(scope="module")
def running():
    with serving(StandIn()) as (port, server):
        yield port, server


def alive(port: int) -> bool:
    with connect(port) as ws:
        assert json.loads(ws.recv(5))["type"] == "hello"
        ws.send(state(7))
        return numbered(ws.recv(5)) == 7


# --- who may speak ----------------------------------------------------------------------------------------------------
def test_the_token_becomes_a_cookie_and_leaves_the_address(running):
    port, _ = running
    status, headers, _ = ask(port, f"/?token={SECRET}", cookie=None)
    assert (status, headers["location"]) == (303, "/")
    cookie = headers["set-cookie"]
    assert SECRET in cookie
    assert "HttpOnly" in cookie
    assert "SameSite=Strict" in cookie
    status, headers, body = ask(port)
    assert status == 200
    assert b"<title>" in body
    policy = headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    assert "http:" not in policy
    assert headers["x-content-type-options"] == "nosniff"


@pytest.mark.parametrize("path", ["/", "/live.js", "/scene.glb", "/session", "/?token=wrong", "/?token=", "/nothing"])
def test_without_the_cookie_nothing_is_told(running, path):
    port, _ = running
    for cookie in (None, "", "wrong", SECRET[:-1], SECRET + "x"):
        status, headers, body = ask(port, path, cookie)
        assert status == 403
        assert SECRET.encode() not in body
        assert "set-cookie" not in headers


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:80", "127.0.0.1", "127.0.0.1:1", "", "localhost.evil.example"]
)
def test_another_host_is_refused(running, host):
    port, _ = running
    assert ask(port, Host=host)[0] in (400, 403)
    assert ask(port, f"/?token={SECRET}", None, Host=host)[0] in (400, 403)


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "https://127.0.0.1", "http://127.0.0.1:1"])
def test_another_origin_is_refused(running, origin):
    port, _ = running
    assert ask(port, Origin=origin)[0] == 403
    with pytest.raises(InvalidStatus):
        connect(port, origin=origin)
    assert ask(port, **{"Sec-Fetch-Site": "cross-site"})[0] == 403


@pytest.mark.parametrize(
    ("cookie", "origin", "host"),
    [(None, "own", None), ("wrong", "own", None), (SECRET, None, None), (SECRET, "own", "evil.example")],
)
def test_a_socket_is_refused_before_it_is_accepted(running, cookie, origin, host):
    port, server = running
    before = len(server.api.clients)
    with pytest.raises(InvalidStatus) as refused:
        connect(port, cookie, origin, host)
    assert refused.value.response.status_code == 403
    assert len(server.api.clients) == before


@pytest.mark.parametrize(
    "path",
    ["/../../etc/passwd", "/%2e%2e/%2e%2e/etc/passwd", "/..%2fserver.py", "/page/live.js", "//etc/passwd",
     "/live.js%00", "/live.js/..", "/__init__.py", "/%5c..%5cserver.py", "/live"],
)  # fmt: skip
def test_no_path_leads_to_a_file(running, path):
    port, _ = running
    status, _, body = ask(port, path)
    assert status in (400, 404)
    assert b"root:" not in body
    assert b"import" not in body


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "OPTIONS", "TRACE"])
def test_the_server_only_shows(running, method):
    port, _ = running
    assert ask(port, method=method)[0] == 405


def test_a_token_of_the_environment(monkeypatch):
    monkeypatch.delenv(TOKEN, raising=False)
    assert new_token(TOKEN) != new_token(TOKEN)
    assert len(new_token(TOKEN)) >= 32
    monkeypatch.setenv(TOKEN, SECRET)
    assert new_token(TOKEN) == SECRET
    monkeypatch.setenv(TOKEN, 22 * "x")
    assert new_token(TOKEN) == 22 * "x"
    for bad in ("short", "x" * 21, "x" * 30 + ";", "x" * 30 + " ", "ü" * 30):
        monkeypatch.setenv(TOKEN, bad)
        with pytest.raises(BadToken):
            new_token(TOKEN)


# --- what it takes ----------------------------------------------------------------------------------------------------
GOOD = [
    state(
        1,
        t=0.5,
        knobs={"base/forward/M2 shift z": 1.5},
        pivots={"base": "origin"},
        noise=True,
        frames=3,
        seed=9,
        time=None,
    ),
    json.dumps(
        {"type": "view", "n": 1, "state": json.loads(state(2)), "view": "mtf", "camera": "forward", "field": 0.5}
    ),
    json.dumps({"type": "factors", "values": {"aperture": 20.0}}),
    json.dumps({"type": "blind", "on": True}),
    json.dumps({"type": "record", "on": False}),
    json.dumps({"type": "save", "what": "job", "state": json.loads(state(3))}),
]
NASTY = [
    "NaN",
    "1e999",
    "-1",
    "null",
    "[]",
    "{}",
    '"' + "x" * 300 + '"',
    "true",
    "9" * 400,
    '"\\u0000"',
    "[" * 200 + "]" * 200,
]


def sent_away(ws, *messages: str | bytes) -> int | None:
    """The code with which a page is sent away that says this."""
    try:
        for message in messages:
            ws.send(message)
        while True:
            ws.recv(5)
    except ConnectionClosed as closed:
        return None if closed.rcvd is None else closed.rcvd.code


def test_every_value_of_a_message_that_is_none_of_its_kind_is_refused_in_few_words():
    """Each value of each good message in turn becomes each of the nasty ones; the message is read, or refused."""
    refused = count = 0
    for text in GOOD:
        assert read_message(text).type == json.loads(text)["type"]
        for place in re.finditer(r'(?<=: )("[^"]*"|[\d.]+|true|false|null|\{\})(?=[,}])', text):
            for nasty in NASTY:
                count += 1
                try:
                    read_message(text[: place.start()] + nasty + text[place.end() :])
                except BadMessage as error:
                    refused += len(str(error)) <= 400
    assert count > 200
    assert 0.8 * count < refused < count


@pytest.mark.parametrize(
    ("messages", "code"),
    [(["nonsense"] * (BAD_MESSAGES + 5), 1008), (["x" * (LARGEST_MESSAGE + 1)], 1009), ([b"\x00\x01"], 1008)],
    ids=["no sense", "too long", "binary"],
)
def test_a_page_that_says_nothing_sensible_is_sent_away(running, messages, code):
    port, _ = running
    with connect(port) as ws:
        assert sent_away(ws, *messages) == code
    assert alive(port)


def test_a_long_message_is_refused_before_it_has_come(running):
    """By the length that its frame announces; whoever reads it as it comes holds it in memory."""
    port, _ = running
    with connect(port) as ws:
        ws.recv(5)
        ws.socket.sendall(b"\x81\xff" + (100 * LARGEST_MESSAGE).to_bytes(8, "big") + b"\0" * 20)
        with pytest.raises(ConnectionClosed) as closed:
            ws.recv(5)
        assert closed.value.rcvd is not None
        assert closed.value.rcvd.code == 1009
    with pytest.raises(BadMessage, match="more than 65536"):
        read_message(GOOD[0] + " " * LARGEST_MESSAGE)
    assert read_message(GOOD[0] + " " * (LARGEST_MESSAGE - len(GOOD[0]))).type == "state"


def test_a_page_may_say_so_much(monkeypatch):
    """2000 messages at once and 400 a second after them."""
    now = [time.monotonic() + 60.0]
    # this module's clock alone: a server of this file that took the other would sleep a minute
    monkeypatch.setattr("twin.live.clients.time", SimpleNamespace(monotonic=lambda: now[0]))
    client = Client()
    for count, wait in ((2000, 0.5), (200, 0.0)):
        for _ in range(count):
            client.receive(GOOD[0])
        now[0] += wait
    with pytest.raises(Disconnected, match="too many messages"):
        client.receive(GOOD[0])


def test_too_many_pages(running):
    port, server = running
    for _ in range(100):
        if not server.api.clients:
            break
        time.sleep(0.05)
    with ExitStack() as stack:
        for _ in range(8):
            stack.enter_context(connect(port)).recv(5)
        with connect(port) as ws, pytest.raises(ConnectionClosed) as closed:
            ws.recv(5)
        assert closed.value.rcvd is not None
        assert closed.value.rcvd.code == 1013
    time.sleep(0.2)
    assert alive(port)


# --- nothing piles up -------------------------------------------------------------------------------------------------
@pytest.mark.second
def test_of_1000_fast_states_the_last_is_shown_and_few_are_computed():
    computer = StandIn(seconds=0.02)
    with pages(computer) as (_, _, ws):
        for n in range(1, 1001):
            ws.send(state(n))
        wait_for(ws, 1000)
        with pytest.raises(TimeoutError):
            ws.recv(0.3)
    numbers = [question[0].n for kind, question in computer.asked]
    assert numbers[-1] == 1000
    assert numbers == sorted(numbers)
    assert len(numbers) < 100


@pytest.mark.second
def test_two_pages_take_turns():
    with pages(StandIn(seconds=0.02), 2) as (_, _, one, two):
        for n in range(1, 301):
            one.send(state(n))
        two.send(state(5))
        began = time.monotonic()
        assert numbered(two.recv(5)) == 5
        # one state of the other page may be before it
        assert time.monotonic() - began < 1.0
        wait_for(one, 300)


@pytest.mark.second
def test_a_slow_reader_hinders_nobody_and_holds_one_answer():
    """A page that reads nothing: answers of 1 MB do not pile up, and the other page is served."""
    with pages(StandIn(bytes_each=1_000_000), 2) as (_, server, slow, quick):
        for n in range(1, 120):
            slow.send(state(n))
            quick.send(state(n))
            time.sleep(0.002)
        wait_for(quick, 119)
        waiting = [client for client in server.api.clients if client._answer is not None]
        assert len(waiting) <= 1
        # what the system holds for a line that is not read, and then the last state
        wait_for(slow, 119)


def test_a_recording_is_bounded_and_has_no_hidden_states():
    client = Client()
    client.receive(json.dumps({"type": "record", "on": True}))
    for one in (*(AskedState(n=n) for n in range(5)), BlindState(n=9, blind=3)):
        client.state_computed(one)
    client.receive(json.dumps({"type": "record", "on": False}))
    client.state_computed(AskedState(n=6))
    assert client.recorded is not None
    assert [one.n for _, one in client.recorded] == list(range(5))


@pytest.mark.second
def test_the_computer_is_told_what_the_page_has():
    """Images before are sent again where noise, frames or seed are others."""
    computer = StandIn()
    with pages(computer) as (_, _, ws):
        for n, more in enumerate(({}, {"seed": 5}, {"frames": 3}, {"noise": False}, {}), 1):
            ws.send(state(n, **more))
            assert numbered(ws.recv(5)) == n
    asked, known = zip(*(question for _, question in computer.asked), strict=True)
    assert known == (None, *((one.noise, one.frames, one.seed) for one in asked[:-1]))
    assert len(set(known)) == 5


def test_messages_and_what_waits_for_a_page_are_bounded():
    knobs = {str(k): 0.5 for k in range(401)}
    for words, good, bad in (("frames", 64, 65), ("seed", 2**53 - 1, 2**53), ("knobs", {"0": 0.5}, knobs)):
        assert read_message(state(1, **{words: good}))
        with pytest.raises(BadMessage, match=words):
            read_message(state(1, **{words: bad}))
    assert read_message(state(1, knobs=dict(list(knobs.items())[:400])))
    for unknown in ("blind", "file"):  # what is hidden no page can say
        with pytest.raises(BadMessage, match=unknown):
            read_message(state(1, **{unknown: 5}))
    client = Client()
    for k in range(40):
        client.queue_json({"k": k})
    assert [json.loads(one)["k"] for one in client._queued_texts] == list(range(8, 40))


def test_what_is_hidden_is_chosen_here_and_stays_until_it_is_revealed():
    client = Client()
    client.receive(json.dumps({"type": "blind", "on": True}))
    client.receive(state(1))
    assert isinstance(client.state, BlindState)
    hidden = client.state.blind
    client.receive(json.dumps({"type": "save", "what": "job", "state": {"type": "state", "n": 1}}))
    assert isinstance(client.saves[0].state, BlindState)
    client.receive(state(2))
    assert client.state.blind == hidden
    client.receive(json.dumps({"type": "blind", "on": False}))
    assert isinstance(client.reveal, BlindState)
    assert client.reveal.blind == hidden
    client.receive(state(3))
    assert not isinstance(client.state, BlindState)


def test_a_computer_that_ends_is_told_to_every_page_and_ends_the_server_with_the_reason():
    class Fragile(StandIn):
        async def ask(self, kind: str, question: Any) -> Any:
            raise ComputerLost("the computing process ended (killed by SIGKILL)")

    listening = listen("127.0.0.1", 0)
    port = listening.getsockname()[1]
    server = LiveServer(Fragile(), Guard.of(SECRET, "127.0.0.1", port), True)  # type: ignore[arg-type]
    told = []

    def page() -> None:
        with connect(port) as ws, connect(port) as other:
            for one in (ws, other):
                one.recv(5)
            ws.send(state(1))
            told.extend(json.loads(one.recv(5)) for one in (ws, other))

    thread = threading.Thread(target=page)
    thread.start()
    with pytest.raises(ComputerLost, match="killed by SIGKILL"):
        server.run(listening)
    thread.join(10)
    assert [(one["type"], "killed by SIGKILL" in one["problem"]) for one in told] == [("refused", True)] * 2


def test_an_instrument_that_cannot_be_built_is_told_by_the_command(monkeypatch):
    def start(*words: object) -> None:
        raise ComputerLost("job.yaml: no such file")

    monkeypatch.setattr("twin.live.computer.Computer.start", start)
    with pytest.raises(InputErrorText, match=r"job\.yaml: no such file"):
        _serve("job.yaml", None, "127.0.0.1", 0, True, "llvm", (), None)


@pytest.mark.second
def test_the_server_ends_when_the_last_page_is_closed(monkeypatch):
    monkeypatch.setattr("twin.live.server.IDLE_TIMEOUT", 0.3)
    with serving(StandIn(), stay=False) as (port, server):
        with connect(port) as ws:
            ws.recv(5)
        with connect(port) as ws:  # loaded again in time
            ws.recv(5)
            time.sleep(0.6)
            assert server._uvicorn is not None
            assert not server._uvicorn.should_exit
        time.sleep(1.0)
        assert server._uvicorn.should_exit
