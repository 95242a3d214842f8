"""A server of pages: what it listens on, its parts by name, and the gate before everything else."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Mapping, Sequence
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

import uvicorn
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.routing import BaseRoute, Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from twin.serving.guard import (
    AT_ONCE,
    EVERYWHERE,
    HEADERS,
    SILENCE,
    Connections,
    Guard,
    PageSocket,
    PatientServer,
    names_of_this_machine,
)

POLICY_VIOLATION = 1008
"""Code with which a WebSocket is closed that the guard refuses."""
TYPES = {
    "html": "text/html",
    "css": "text/css",
    "js": "text/javascript",
    "svg": "image/svg+xml",
    "glb": "model/gltf-binary",
}
_ROOM = Path(__file__).parents[1]
SHARED: Mapping[str, Traversable] = {
    "scroll.css": _ROOM / "run" / "scroll.css",
    "page.css": files(__package__) / "page" / "page.css",
    "format.js": files(__package__) / "page" / "format.js",
    "scene.js": files(__package__) / "page" / "scene.js",
    "three.min.js": _ROOM / "pictures" / "viewer" / "three.min.js",
}
"""Parts of every page that shows an instrument: scrolling sideways, looks, numbers, the view in three dimensions."""


class PageServer:
    """One server of a page.

    Args:
        guard: who may speak to it.
        parts: everything that can be asked for by name, ``index.html`` among them; no path of a request is ever one of
            the file system.
        routes: what else is answered; they stand before the parts.
        tasks: that run as long as the server does. If one of them fails, the server ends.
        leave: called when it ends.
        largest: bytes of a message of a WebSocket.
    """

    def __init__(
        self,
        guard: Guard,
        parts: Mapping[str, Traversable],
        routes: Sequence[BaseRoute] = (),
        tasks: Sequence[Callable[[], Coroutine[Any, Any, None]]] = (),
        leave: Callable[[], None] = lambda: None,
        largest: int = 1 << 16,
    ) -> None:
        self.guard, self.parts, self._largest = guard, parts, largest
        self.connections = Connections(guard.knows_cookie)
        self._tasks, self._leave = tasks, leave
        self._uvicorn: uvicorn.Server | None = None
        self._failed: BaseException | None = None
        self.app = Starlette(
            routes=[Route("/", self._index), *routes, Route("/{name}", self._part)],
            middleware=[Middleware(Gate, guard=guard)],
            lifespan=self._lifespan,
        )

    @property
    def started(self) -> bool:
        """Whether it answers."""
        return self._uvicorn is not None and self._uvicorn.started

    def run(self, listening: socket.socket) -> None:
        """Serve until Ctrl-C, or until it is told to stop.

        Args:
            listening: bound and not yet accepting.

        Raises:
            BaseException: what ended one of its tasks.
        """
        config = uvicorn.Config(
            self.app,
            # whatever a stranger sends is nothing to tell a terminal; errors of the program are
            log_level="error",
            access_log=False,
            server_header=False,
            date_header=False,
            http=self.connections.protocol(),
            ws=PageSocket,
            ws_max_size=self._largest,
            ws_max_queue=16,
            ws_per_message_deflate=False,
            ws_ping_interval=20.0,
            ws_ping_timeout=30.0,
            timeout_keep_alive=int(SILENCE),
            timeout_graceful_shutdown=2,
            h11_max_incomplete_event_size=1 << 15,
            backlog=AT_ONCE,
        )
        self._uvicorn = PatientServer(config)
        # it ends in order and then repeats the signal, which here is no accident
        with contextlib.suppress(KeyboardInterrupt):
            self._uvicorn.run(sockets=[listening])
        if self._failed is not None:
            raise self._failed

    def stop(self) -> None:
        """End in order."""
        if self._uvicorn is not None:
            self._uvicorn.should_exit = True

    @contextlib.asynccontextmanager
    async def _lifespan(self, app: Starlette) -> AsyncIterator[None]:
        tasks = [asyncio.create_task(make()) for make in self._tasks]
        for task in tasks:
            task.add_done_callback(self._ended)
        try:
            yield
        finally:
            for task in tasks:
                task.cancel()
            self._leave()

    def _ended(self, task: asyncio.Task[None]) -> None:
        """What the server is for cannot go on: nothing is left to serve."""
        if not task.cancelled() and (error := task.exception()) is not None:
            self._failed = error
            self.stop()

    async def _index(self, request: Request) -> Response:
        if "token" not in request.query_params:
            return self.part("index.html")
        return RedirectResponse("/", 303, headers={"set-cookie": self.guard.cookie})

    async def _part(self, request: Request) -> Response:
        name = request.path_params["name"]
        return self.part(name) if name in self.parts else PlainTextResponse("nothing is here\n", 404)

    def part(self, name: str) -> Response:
        """A part of the page."""
        return Response(self.parts[name].read_bytes(), media_type=TYPES[name.rpartition(".")[2]])


class Gate:
    """Before everything else: refuses what the guard refuses, and gives every answer its headers.

    Args:
        app: behind it.
        guard: who may pass.
    """

    def __init__(self, app: ASGIApp, guard: Guard) -> None:
        self.app, self.guard = app, guard

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One request, or one WebSocket that is asked for."""
        if scope["type"] not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return
        headers = {key.decode("latin-1"): value.decode("latin-1") for key, value in scope["headers"]}
        if len(headers) != len(scope["headers"]) and [k for k, _ in scope["headers"]].count(b"host") > 1:
            headers["host"] = ""
        socket_wanted = scope["type"] == "websocket"
        reached = (scope.get("server") or ("", None))[0]
        why = self.guard.refuses(headers, socket_wanted, reached)
        if why and not socket_wanted and self._brings_token(scope):
            why = self.guard.refuses_host(headers, reached)
        if why and socket_wanted:
            # closed before it is accepted: the browser gets status 403
            await send({"type": "websocket.close", "code": POLICY_VIOLATION, "reason": why})
            return
        status = 403
        if not why and not socket_wanted and scope["method"] not in ("GET", "HEAD"):
            status, why = 405, "this server only shows"
        if why:
            answer = PlainTextResponse(f"refused: {why}\n", status, headers={"connection": "close"})
            await answer(scope, receive, _with_headers(send))
            return
        await self.app(scope, receive, send if socket_wanted else _with_headers(send))

    def _brings_token(self, scope: Scope) -> bool:
        if scope["path"] != "/":
            return False
        return self.guard.knows(Request(scope).query_params.get("token", ""))


def _with_headers(send: Send) -> Callable[[Message], Awaitable[None]]:
    async def wrapped(message: Message) -> None:
        if message["type"] == "http.response.start":
            added = [(key.lower().encode(), value.encode()) for key, value in HEADERS.items()]
            message = {**message, "headers": [*message.get("headers", []), *added]}
        await send(message)

    return wrapped


def listen(host: str, port: int) -> socket.socket:
    """A socket on a host and a port; port 0 takes a free one.

    Raises:
        OSError: somebody listens there already, or there is no such host.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    out = socket.socket(family, socket.SOCK_STREAM)
    out.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        out.bind((host, port))
        # who opens the address before the server is up waits for it
        out.listen()
    except OSError:
        out.close()
        raise
    return out


def addresses(host: str, port: int, words: str) -> list[str]:
    """Lines that a command prints: where its page is, from this machine and, if it listens everywhere, from others.

    Args:
        host: that was asked for.
        port: on which it listens.
        words: after the question mark of the address.
    """
    everywhere = host in EVERYWHERE
    shown = "127.0.0.1" if everywhere else f"[{host}]" if ":" in host else host
    names = names_of_this_machine()[:1] if everywhere else ()
    others = [f"from other machines: http://{name}:{port}/?{words}" for name in names]
    return [f"open http://{shown}:{port}/?{words}", *others]
