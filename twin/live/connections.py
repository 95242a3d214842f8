"""Connections of the live twin's server: how many there may be, and how long each may take for what it says.

uvicorn's own limits turn against the user here: ``limit_concurrency`` counts connections that say nothing, so that
whoever opens enough of them locks everybody out, and ``timeout_keep_alive`` begins with the first answer. So a
connection that has not yet shown the token is a **stranger** until it does, which a browser does within its first
request. Strangers never take a place of somebody who has the token: they have places of their own, few for each
address, and if these are taken the one that has waited longest makes room. Every request's head, answer and silence
after it has its time.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

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

    Args:
        knows: whether a request's headers, names in small letters, hold the token.
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
        """It showed the token."""
        if self._strangers.pop(one, None) is None:
            return
        self._known[one] = None
        if len(self._known) > MOST_KNOWN:
            first = next(iter(self._known))
            self.went(first)
            first.cut()

    def went(self, one: Connection) -> None:
        """It is closed, or carries a WebSocket from now on."""
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
        """It becomes a page's WebSocket, or is refused at once; either is no longer counted here."""
        self._within(None)
        self.all.went(self)
        super().handle_websocket_upgrade(event)

    def connection_lost(self, exc: Exception | None) -> None:
        """It is closed."""
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
        """It does not answer, and may not read either."""
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
