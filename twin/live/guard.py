"""Access control of the page's server, limits on its connections, and timeouts.

The address that the command prints contains a random token. The first request with it sets the token as a cookie, which
no script can read and no other site can send, and is redirected to the page without the token. Every other request, and
the WebSocket before it is accepted, needs the cookie, a Host header of this server (another site's name may resolve to
127.0.0.1) and, where the browser sends it, an Origin header of the page itself.

uvicorn's own limits do not suffice: ``limit_concurrency`` counts idle connections, so that anybody who opens enough of
them locks out all others, and ``timeout_keep_alive`` begins only with the first answer. Therefore a connection is
**unauthenticated** until it shows the token, which a browser does with its first request. Unauthenticated connections
have separate limits, in total and for each address, and never displace an authenticated one; if a limit is reached, the
oldest is closed. The head of every request, its answer and the idle time after it have timeouts.
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
"""Smallest length of a token set by the environment, in characters."""
COOKIE = "space_camera_twin_{port}"
"""Name of the cookie. Browsers share cookies among all ports of a host, so that the name contains the port."""
LOOPBACK = ("127.0.0.1", "localhost", "[::1]")
EVERYWHERE = ("0.0.0.0", "::")
"""Host addresses that stand for all interfaces of this machine."""
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
"""HTTP security headers that every answer contains."""


class BadToken(ValueError):
    """Error that the token set by the user is too easy to guess or has forbidden characters."""


def new_token(variable: str) -> str:
    """Return the token of a server: random, or set by the environment.

    Parameters
    ----------
    variable : str
        Environment variable with a token that stays valid when the server is restarted.

    Raises
    ------
    BadToken
        The token of the environment is too short, or has characters that a cookie cannot have.
    """
    token = os.environ.get(variable, "")
    if not token:
        return secrets.token_urlsafe(24)
    if len(token) < SHORTEST or not all(c.isascii() and (c.isalnum() or c in "-_") for c in token):
        raise BadToken(f"{variable} needs {SHORTEST} or more characters of A-Z, a-z, 0-9, - and _")
    return token


@dataclass(frozen=True)
class Guard:
    """Access control: conditions that a request must meet to be accepted.

    Attributes
    ----------
    token : str
        The secret token.
    hosts : tuple[str, ...]
        Host names of the server, with its port.
    port : int
        Port of the server.
    """

    token: str
    hosts: tuple[str, ...]
    port: int

    @classmethod
    def of(cls, token: str, host: str, port: int) -> Guard:
        """Return the guard of a server that listens on a host and a port."""
        named = f"[{host}]" if ":" in host else host.lower()
        names = LOOPBACK if host in ("127.0.0.1", "localhost", "::1") else (named, *LOOPBACK)
        if host in EVERYWHERE:
            names = (*names, *(name.lower() for name in names_of_this_machine()))
        return cls(token, tuple(_host_text(name, port) for name in names), port)

    @property
    def cookie_name(self) -> str:
        """Name of the cookie with the token."""
        return COOKIE.format(port=self.port)

    @property
    def cookie(self) -> str:
        """Set-Cookie header; it has no expiry date, since every server has a new token."""
        return f"{self.cookie_name}={self.token}; HttpOnly; SameSite=Strict; Path=/"

    def is_token(self, token: str) -> bool:
        """Return whether a text equals the token; the comparison takes the same time for every text."""
        return secrets.compare_digest(token.encode(), self.token.encode())

    def has_token_cookie(self, headers: Mapping[str, str]) -> bool:
        """Return whether a request has the token as its cookie.

        Parameters
        ----------
        headers : Mapping[str, str]
            Headers of the request, names in lower case.
        """
        return any(map(self.is_token, _cookies(headers.get("cookie", ""), self.cookie_name)))

    def host_refusal(self, headers: Mapping[str, str], local_address: str = "") -> str:
        """Return why a request's host or origin is not the server's own; empty if it is.

        Parameters
        ----------
        headers : Mapping[str, str]
            Headers of the request, names in lower case.
        local_address : str
            Address of this machine at which the request arrived, which is accepted as a host name. A page of another
            site whose name resolves to it sends that name instead.
        """
        host = headers.get("host", "").lower()
        plain = local_address.removeprefix("::ffff:")
        own = _host_text(f"[{plain}]" if ":" in plain else plain, self.port)
        if host not in self.hosts and not (plain and host == own):
            return "the Host header does not name this server"
        origin = headers.get("origin")
        if origin is not None and origin.lower() != f"http://{host}":
            return "the request comes from another site"
        if headers.get("sec-fetch-site", "none") not in ("same-origin", "none"):
            return "the request comes from another site"
        return ""

    def refusal(self, headers: Mapping[str, str], socket: bool = False, local_address: str = "") -> str:
        """Return why a request is refused; empty if it is accepted.

        Parameters
        ----------
        headers : Mapping[str, str]
            Headers of the request, names in lower case.
        socket : bool
            Whether it requests a WebSocket, for which browsers always send the origin.
        local_address : str
            Address of this machine at which the request arrived, which is accepted as a host name.
        """
        why = self.host_refusal(headers, local_address)
        if not why and socket and "origin" not in headers:
            why = "the Origin header is missing"
        if not why and not self.has_token_cookie(headers):
            why = "open the address that the command printed"
        return why


def _host_text(name: str, port: int) -> str:
    """Return a host as browsers write it: without the default port of HTTP."""
    return name if port == 80 else f"{name}:{port}"


def names_of_this_machine() -> tuple[str, ...]:
    """Return the host names of this machine, the shortest first."""
    return tuple(sorted({name for name in (sockets.gethostname(), sockets.getfqdn()) if name}, key=len))


def _cookies(header: str, name: str) -> Iterator[str]:
    """Yield the values of all cookies of a name; cookies of other programs on this host may have any form."""
    for part in header.split(";"):
        key, _, value = part.strip().partition("=")
        if key == name:
            yield value


HEAD_TIMEOUT = 5.0
"""Time for the head of a request, from the connection's beginning or the head's first byte, in seconds."""
ANSWER_TIMEOUT = 60.0
"""Time in which an answer has to be received, in seconds."""
KEEP_ALIVE = 30.0
"""Idle time between an answer and the next request, in seconds."""
MOST_UNAUTHENTICATED, MOST_OF_ONE_ADDRESS = 128, 64
"""Largest numbers of connections that have not been authenticated yet: in all, and from one address."""
MOST_AUTHENTICATED = 64
"""Largest number of authenticated connections without a WebSocket: eight pages of a browser open six each."""
ACCEPT_BACKLOG = 16
"""Number of connections accepted at a time: an eighth of the limit for unauthenticated ones.

Data received on open connections are therefore read several times before a new connection can cause one of them to be
closed.
"""
QUEUE = 1024
"""Number of connections that the operating system queues for acceptance."""
INVALID_TEXT = 1007
"""Close code of a WebSocket whose text is not UTF-8."""
CLOSE_TIMEOUT = 5.0
"""Time that a disconnected page may take to receive the rest of its answer, in seconds."""


class Connections:
    """All open connections without a WebSocket.

    Parameters
    ----------
    is_token
        Function that returns whether a request's headers, names in lower case, contain the token.
    """

    def __init__(self, is_token: Callable[[Mapping[str, str]], bool]) -> None:
        self.is_token = is_token
        # in the order of their connection
        self._unauthenticated: dict[Connection, str] = {}
        self._authenticated: dict[Connection, None] = {}

    def __len__(self) -> int:
        return len(self._unauthenticated) + len(self._authenticated)

    def protocol(self) -> type[Connection]:
        """Return the protocol class that uvicorn instantiates for each new connection, bound to this list."""
        return type("BoundConnection", (Connection,), {"all": self})

    def register(self, one: Connection, address: str) -> None:
        """Add an unauthenticated connection, and close the oldest one if there are too many."""
        self._unauthenticated[one] = address
        count = Counter(self._unauthenticated.values())
        if count[address] > MOST_OF_ONE_ADDRESS:
            self._close_oldest(address)
        elif len(self._unauthenticated) > MOST_UNAUTHENTICATED:
            self._close_oldest(count.most_common(1)[0][0])

    def authenticate(self, one: Connection) -> None:
        """Move a connection that showed the token to the authenticated ones; close the oldest if there are too many."""
        if self._unauthenticated.pop(one, None) is None:
            return
        self._authenticated[one] = None
        if len(self._authenticated) > MOST_AUTHENTICATED:
            first = next(iter(self._authenticated))
            self.forget(first)
            first.cut()

    def forget(self, one: Connection) -> None:
        """Remove a connection that is closed, or that has become a WebSocket."""
        self._unauthenticated.pop(one, None)
        self._authenticated.pop(one, None)

    def _close_oldest(self, address: str) -> None:
        """Close the oldest unauthenticated connection of an address."""
        oldest = next(one for one, its in self._unauthenticated.items() if its == address)
        self.forget(oldest)
        oldest.cut()


class Connection(H11Protocol):
    """HTTP connection with timeouts for each request, its answer and the idle time after it."""

    all: ClassVar[Connections]
    _deadline: asyncio.TimerHandle | None = None
    _idle = False

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Register the connection, and start the timeout of its first request."""
        super().connection_made(transport)
        self._set_deadline(HEAD_TIMEOUT)
        self.all.register(self, self.client[0] if self.client else "")

    def data_received(self, data: bytes) -> None:
        """Handle received bytes, which may be a part of a request."""
        if self._idle:
            self._idle = False
            self._set_deadline(HEAD_TIMEOUT)
        before = self.cycle
        super().data_received(data)
        if self.cycle is not before:
            self._request_received()

    def _request_received(self) -> None:
        """Handle the complete head of a request: check its token and start the timeout of its answer."""
        if self.all.is_token({key.decode("latin-1"): value.decode("latin-1") for key, value in self.headers}):
            self.all.authenticate(self)
        if not self.cycle.response_complete:
            self._set_deadline(ANSWER_TIMEOUT)

    def on_response_complete(self) -> None:
        """Start the next timeout after an answer was handed to the system."""
        answered = self.cycle
        self._idle = True
        self._set_deadline(ANSWER_TIMEOUT if self.transport.get_write_buffer_size() else KEEP_ALIVE)
        super().on_response_complete()
        if self.cycle is not answered:  # the next request had arrived already
            self._idle = False
            self._request_received()

    def send_400_response(self, msg: str) -> None:
        """Answer data that is not a request; while another answer is being sent, close the connection instead."""
        if self.cycle is None or self.cycle.response_complete:
            try:
                super().send_400_response(msg)
                return
            except Exception:  # h11 is in a state in which it cannot answer
                pass
        self.cut()

    def handle_websocket_upgrade(self, event: Any) -> None:
        """Stop counting a connection that becomes a WebSocket, whether it is then accepted or refused."""
        self._set_deadline(None)
        self.all.forget(self)
        super().handle_websocket_upgrade(event)

    def connection_lost(self, exc: Exception | None) -> None:
        """Remove a closed connection from the lists and end its timeouts."""
        self._set_deadline(None)
        self.all.forget(self)
        super().connection_lost(exc)

    def cut(self) -> None:
        """Close the connection at once; unsent data are lost."""
        self._set_deadline(None)
        if self.transport.get_write_buffer_size():
            self.transport.abort()
        else:
            self.transport.close()

    def _set_deadline(self, seconds: float | None) -> None:
        """Close the connection after this time, in seconds, unless the deadline is set again; None for no deadline."""
        if self._deadline is not None:
            self._deadline.cancel()
        self._deadline = None if seconds is None else self.loop.call_later(seconds, self.cut)


class PageSocket(WebSocketsSansIOProtocol):
    """WebSocket of a page, which never waits forever for a page that does not receive or answer."""

    def send_receive_event_to_app(self) -> None:
        """Pass on a complete message; silently close the connection if its text is not UTF-8."""
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
        """Serve the page, and do not wait forever for a disconnected page to receive its data."""
        await super().run_asgi()
        self._end_soon()

    def keepalive_timeout(self) -> None:
        """Close the connection of a page that does not answer."""
        super().keepalive_timeout()
        self._end_soon()

    def _end_soon(self) -> None:
        """Abort the connection after a timeout if unsent data remain; closing it would wait forever."""
        if self.transport.get_write_buffer_size():
            self.loop.call_later(CLOSE_TIMEOUT, self.transport.abort)


class PatientServer(uvicorn.Server):
    """Server of uvicorn with a long queue of connections, of which it accepts few at a time."""

    async def startup(self, sockets: Any = None) -> None:
        """Listen with separate limits for queued and accepted connections, which asyncio sets equal."""
        await super().startup(sockets)
        for one in sockets or ():
            one.listen(QUEUE)
