"""Who may speak to a server of pages, how many at once, and how long each may take.

The address that the command prints carries a random token. The first request with it gets the token as a cookie, which
no script can read and no other site can send, and is led to the page without it. Every other request, and the WebSocket
before it is accepted, needs the cookie, a Host that is the server's own (a page elsewhere may have its name resolve to
127.0.0.1) and, where the browser tells it, an Origin that is the page's own.

uvicorn's own limits turn against the user here: ``limit_concurrency`` counts connections that say nothing, so that
whoever opens enough of them locks everybody out, and ``timeout_keep_alive`` begins with the first answer. So a
connection that has not yet shown the token is a **stranger** until it does, which a browser does within its first
request. Strangers never take a place of somebody who has the token: they have places of their own, few for each
address, and if these are taken the one that has waited longest makes room. Every request's head, answer and silence
after it has its time.
"""

from __future__ import annotations

import asyncio
import os
import secrets
import socket as sockets
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

SHORTEST = 22
"""Characters of a token that the environment sets."""
COOKIE = "space_camera_twin_{port}"
"""Name of the cookie. Browsers keep one jar for a host, whatever the port: two servers on one host, two names."""
LOOPBACK = ("127.0.0.1", "localhost", "[::1]")
EVERYWHERE = ("0.0.0.0", "::")
"""Hosts that stand for all numbers of this machine."""
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
HEADERS: Mapping[str, str] = {
    "Content-Security-Policy": POLICY,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}
"""Headers of every answer."""


class BadToken(ValueError):
    """A token that somebody could guess."""


def new_token(variable: str) -> str:
    """The token of a server: random, or the environment's.

    Parameters
    ----------
    variable : str
        Of the environment, with a token that stays the same when the server is started again.

    Raises
    ------
    BadToken
        The environment's is too short, or has characters that a cookie cannot have.
    """
    named = os.environ.get(variable, "")
    if not named:
        return secrets.token_urlsafe(24)
    if len(named) < SHORTEST or not all(c.isascii() and (c.isalnum() or c in "-_") for c in named):
        raise BadToken(f"{variable} needs {SHORTEST} or more characters of A-Z, a-z, 0-9, - and _")
    return named


@dataclass(frozen=True)
class Guard:
    """What a request needs.

    Attributes
    ----------
    token : str
        The secret.
    hosts : tuple[str, ...]
        Names under which the server is called, with their port.
    port : int
        It listens on.
    """

    token: str
    hosts: tuple[str, ...]
    port: int

    @classmethod
    def of(cls, token: str, host: str, port: int) -> Guard:
        """The guard of a server that listens on a host and a port."""
        named = f"[{host}]" if ":" in host else host.lower()
        names = LOOPBACK if host in ("127.0.0.1", "localhost", "::1") else (named, *LOOPBACK)
        if host in EVERYWHERE:
            names = (*names, *(name.lower() for name in names_of_this_machine()))
        return cls(token, tuple(_called(name, port) for name in names), port)

    @property
    def cookie_name(self) -> str:
        """Name of the cookie with the token."""
        return COOKIE.format(port=self.port)

    @property
    def cookie(self) -> str:
        """What sets the cookie; the token is renewed with every server, so that it needs no date."""
        return f"{self.cookie_name}={self.token}; HttpOnly; SameSite=Strict; Path=/"

    def knows(self, token: str) -> bool:
        """Whether it is the token; takes as long whatever is wrong with it."""
        return secrets.compare_digest(token.encode(), self.token.encode())

    def knows_cookie(self, headers: Mapping[str, str]) -> bool:
        """Whether a request brings the token as its cookie.

        Parameters
        ----------
        headers : Mapping[str, str]
            Of the request, names in small letters.
        """
        return any(map(self.knows, _cookies(headers.get("cookie", ""), self.cookie_name)))

    def refuses_host(self, headers: Mapping[str, str], reached: str = "") -> str:
        """Why a request's host or origin is not the server's own; empty if it is.

        Parameters
        ----------
        headers : Mapping[str, str]
            Of the request, names in small letters.
        reached : str
            Number of this machine under which the request came here. A page elsewhere whose name resolves to it calls
            it by that name.
        """
        host = headers.get("host", "").lower()
        plain = reached.removeprefix("::ffff:")
        own = _called(f"[{plain}]" if ":" in plain else plain, self.port)
        if host not in self.hosts and not (plain and host == own):
            return "this server has another name"
        origin = headers.get("origin")
        if origin is not None and origin.lower() != f"http://{host}":
            return "the page comes from elsewhere"
        if headers.get("sec-fetch-site", "none") not in ("same-origin", "none"):
            return "the page comes from elsewhere"
        return ""

    def refuses(self, headers: Mapping[str, str], socket: bool = False, reached: str = "") -> str:
        """Why a request is refused; empty if it is not.

        Parameters
        ----------
        headers : Mapping[str, str]
            Of the request, names in small letters.
        socket : bool
            Whether it asks for a WebSocket, for which browsers always tell the origin.
        reached : str
            As of `refuses_host`.
        """
        why = self.refuses_host(headers, reached)
        if not why and socket and "origin" not in headers:
            why = "no origin"
        if not why and not self.knows_cookie(headers):
            why = "open the address that the command printed"
        return why


def _called(name: str, port: int) -> str:
    """A host as browsers write it: without the port that is HTTP's own."""
    return name if port == 80 else f"{name}:{port}"


def names_of_this_machine() -> tuple[str, ...]:
    """By which other machines may call it, the shortest first."""
    return tuple(sorted({name for name in (sockets.gethostname(), sockets.getfqdn()) if name}, key=len))


def _cookies(header: str, name: str) -> Iterator[str]:
    """Values of all cookies of a name; those of other programs on this host may be written in any way."""
    for part in header.split(";"):
        found, _, value = part.strip().partition("=")
        if found == name:
            yield value


HEAD = 5.0
"""Seconds in which the head of a request has to be there, from the connection's beginning or the head's first byte."""
ANSWER = 60.0
"""Seconds in which an answer has to be taken."""
SILENCE = 30.0
"""Seconds between an answer and the next request."""
MOST_STRANGERS, MOST_OF_ONE = 128, 64
"""Connections without the token, in all and of one address."""
MOST_KNOWN = 64
"""Connections with the token that carry no page's WebSocket: eight pages of a browser open six each."""
AT_ONCE = 16
"""Connections that are accepted before anybody who waits is served: an eighth of the strangers, so that several looks
at what has arrived come before a newcomer can be the one that makes room."""
QUEUE = 1024
"""Connections that the system keeps waiting to be accepted."""
INVALID_TEXT = 1007
"""Code with which a WebSocket is closed whose text is not UTF-8."""
UNREAD = 5.0
"""Seconds that a page which is sent away may take for the rest of its answer."""


class Connections:
    """All that are open and carry no WebSocket.

    Parameters
    ----------
    knows
        Whether a request's headers, names in small letters, hold the token.
    """

    def __init__(self, knows: Callable[[Mapping[str, str]], bool]) -> None:
        self.knows = knows
        # in the order in which they came
        self._strangers: dict[Connection, str] = {}
        self._known: dict[Connection, None] = {}

    def __len__(self) -> int:
        return len(self._strangers) + len(self._known)

    def protocol(self) -> type[Connection]:
        """The class of which uvicorn makes one for each connection."""
        return type("BoundConnection", (Connection,), {"all": self})

    def came(self, one: Connection, address: str) -> None:
        """A stranger came; it, or who makes room for it, is cut off when there are too many."""
        self._strangers[one] = address
        count = Counter(self._strangers.values())
        if count[address] > MOST_OF_ONE:
            self._cut(address)
        elif len(self._strangers) > MOST_STRANGERS:
            self._cut(count.most_common(1)[0][0])

    def is_known(self, one: Connection) -> None:
        """Count a stranger that showed the token among the known; the oldest of these makes room."""
        if self._strangers.pop(one, None) is None:
            return
        self._known[one] = None
        if len(self._known) > MOST_KNOWN:
            first = next(iter(self._known))
            self.went(first)
            first.cut()

    def went(self, one: Connection) -> None:
        """Forget a connection that is closed, or carries a WebSocket from now on."""
        self._strangers.pop(one, None)
        self._known.pop(one, None)

    def _cut(self, address: str) -> None:
        """The oldest stranger of an address."""
        oldest = next(one for one, its in self._strangers.items() if its == address)
        self.went(oldest)
        oldest.cut()


class Connection(H11Protocol):
    """One of them: its requests, each in its time."""

    all: ClassVar[Connections]
    _due: asyncio.TimerHandle | None = None
    _silent = False

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Somebody is there and has so long to say what is wanted."""
        super().connection_made(transport)
        self._within(HEAD)
        self.all.came(self, self.client[0] if self.client else "")

    def data_received(self, data: bytes) -> None:
        """A piece of a request."""
        if self._silent:
            self._silent = False
            self._within(HEAD)
        before = self.cycle
        super().data_received(data)
        if self.cycle is not before:
            self._asked()

    def _asked(self) -> None:
        """A request's head is there."""
        if self.all.knows({key.decode("latin-1"): value.decode("latin-1") for key, value in self.headers}):
            self.all.is_known(self)
        if not self.cycle.response_complete:
            self._within(ANSWER)

    def on_response_complete(self) -> None:
        """An answer was handed to the system, or is on its way there."""
        answered = self.cycle
        self._silent = True
        self._within(ANSWER if self.transport.get_write_buffer_size() else SILENCE)
        super().on_response_complete()
        if self.cycle is not answered:  # the next request was there already
            self._silent = False
            self._asked()

    def send_400_response(self, msg: str) -> None:
        """What came is no request; while something is being answered there is no place for saying so."""
        if self.cycle is None or self.cycle.response_complete:
            try:
                super().send_400_response(msg)
                return
            except Exception:  # h11 is past a state in which it could answer
                pass
        self.cut()

    def handle_websocket_upgrade(self, event: Any) -> None:
        """Stop counting a connection that becomes a page's WebSocket, or is refused at once."""
        self._within(None)
        self.all.went(self)
        super().handle_websocket_upgrade(event)

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget a connection that is closed."""
        self._within(None)
        self.all.went(self)
        super().connection_lost(exc)

    def cut(self) -> None:
        """End it now; what it has not taken is lost."""
        self._within(None)
        if self.transport.get_write_buffer_size():
            self.transport.abort()
        else:
            self.transport.close()

    def _within(self, seconds: float | None) -> None:
        """What is awaited of it has to come within this time; None: nothing is."""
        if self._due is not None:
            self._due.cancel()
        self._due = None if seconds is None else self.loop.call_later(seconds, self.cut)


class PageSocket(WebSocketsSansIOProtocol):
    """A page's WebSocket."""

    def send_receive_event_to_app(self) -> None:
        """Hand a whole message on; a text that is not UTF-8 ends the line, and no terminal has to be told of it."""
        if self.curr_msg_data_type == "text" and not self.close_sent:
            try:
                b"".join(self.frames).decode()
            except UnicodeDecodeError:
                self.frames = []
                self.conn.fail(INVALID_TEXT, "a page sends UTF-8")
                self.handle_parser_exception()
                return
        super().send_receive_event_to_app()

    async def run_asgi(self) -> None:
        """Serve the page. What it does not take although it was sent away does not stay here for ever."""
        await super().run_asgi()
        self._end_soon()

    def keepalive_timeout(self) -> None:
        """End a page that does not answer, and may not read either."""
        super().keepalive_timeout()
        self._end_soon()

    def _end_soon(self) -> None:
        """Who closes a connection waits for ever until all was taken that was sent; not here."""
        if self.transport.get_write_buffer_size():
            self.loop.call_later(UNREAD, self.transport.abort)


class PatientServer(uvicorn.Server):
    """uvicorn's server with a long queue before it, of which it takes few at once."""

    async def startup(self, sockets: Any = None) -> None:
        """Listen. asyncio takes as many connections at once as it lets wait; here these are two numbers."""
        await super().startup(sockets)
        for one in sockets or ():
            one.listen(QUEUE)
