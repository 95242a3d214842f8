"""The server of the live twin: its page, the scene, and one WebSocket for each page."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import AsyncIterator, Awaitable, Callable
from importlib.resources import files
from pathlib import Path

import uvicorn
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, RedirectResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket

from twin.live.clients import POLICY_VIOLATION, TOO_BIG, Client, Desk, Goodbye
from twin.live.computer import Computer
from twin.live.guard import AT_ONCE, HEADERS, SILENCE, Connections, Guard, PageSocket, PatientServer
from twin.live.messages import LARGEST_MESSAGE

LINGER = 10.0
"""Seconds without any page after which the server ends, so that a page may be loaded again."""
_TYPES = {
    "html": "text/html",
    "css": "text/css",
    "js": "text/javascript",
    "svg": "image/svg+xml",
    "glb": "model/gltf-binary",
}
_PAGE = files(__package__) / "page"
PARTS = {
    "index.html": _PAGE / "index.html",
    "icon.svg": _PAGE / "icon.svg",
    "live.css": _PAGE / "live.css",
    "scroll.css": Path(__file__).parents[1] / "run" / "scroll.css",
    "live.js": _PAGE / "live.js",
    "knobs.js": _PAGE / "knobs.js",
    "numbers.js": _PAGE / "numbers.js",
    "spots.js": _PAGE / "spots.js",
    "readings.js": _PAGE / "readings.js",
    "scene.js": _PAGE / "scene.js",
    "three.min.js": Path(__file__).parents[1] / "pictures" / "viewer" / "three.min.js",
}
"""Everything that can be asked for by name; no path of a request is ever one of the file system."""


class LiveServer:
    """One server.

    Args:
        computer: started.
        guard: who may speak to it.
        stay: go on when the last page is closed.
    """

    def __init__(self, computer: Computer, guard: Guard, stay: bool = False) -> None:
        self.desk = Desk(computer)
        self.guard = guard
        self.stay = stay
        self._last: asyncio.TimerHandle | None = None
        self.connections = Connections(guard.knows_cookie)
        self._uvicorn: uvicorn.Server | None = None
        self._failed: BaseException | None = None
        self.app = Starlette(
            routes=[
                Route("/", self._index),
                Route("/session", self._session),
                Route("/scene.glb", self._scene),
                Route("/{name}", self._part),
                WebSocketRoute("/live", self._live),
            ],
            middleware=[Middleware(_Gate, guard=guard)],
            lifespan=self._lifespan,
        )

    def run(self, listening: socket.socket) -> None:
        """Serve until Ctrl-C, or until the last page is closed.

        Args:
            listening: bound and not yet accepting.

        Raises:
            CannotStart: the computing ended and cannot be started again; anything else is a fault of the program.
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
            ws_max_size=LARGEST_MESSAGE,
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

    @contextlib.asynccontextmanager
    async def _lifespan(self, app: Starlette) -> AsyncIterator[None]:
        tasks = [asyncio.create_task(what) for what in (self.desk.work(), self.desk.watch())]
        for task in tasks:
            task.add_done_callback(self._ended)
        try:
            yield
        finally:
            for task in tasks:
                task.cancel()
            self.desk.computer.leave()

    def _ended(self, task: asyncio.Task[None]) -> None:
        """The computing cannot be started again: nothing is left to serve."""
        if not task.cancelled() and (error := task.exception()) is not None:
            self._failed = error
            self._stop()

    async def _index(self, request: Request) -> Response:
        if "token" in request.query_params:
            return RedirectResponse("/", 303, headers={"set-cookie": self.guard.cookie})
        return _part("index.html")

    async def _session(self, request: Request) -> Response:
        """Whether a page that lost its line may come back."""
        return JSONResponse(
            {"instrument": self.desk.computer.opened.greeting["instrument"], "states": self.desk.states}
        )

    async def _scene(self, request: Request) -> Response:
        return Response(self.desk.computer.opened.scene, media_type=_TYPES["glb"])

    async def _part(self, request: Request) -> Response:
        name = request.path_params["name"]
        return _part(name) if name in PARTS else PlainTextResponse("nothing is here\n", 404)

    async def _live(self, ws: WebSocket) -> None:
        """One page, from its coming to its going."""
        try:
            client = self.desk.enter()
        except Goodbye as bye:
            await ws.accept()
            await ws.close(bye.code, str(bye))
            return
        self._came()
        await ws.accept()
        client.tell({"type": "hello", **self.desk.computer.opened.greeting})
        if self.desk.trouble:
            client.tell(self.desk.trouble)
        reading = asyncio.create_task(self._read(ws, client))
        sending = asyncio.create_task(client.send(ws.send_text, ws.send_bytes))
        try:
            done, _ = await asyncio.wait({reading, sending}, return_when=asyncio.FIRST_COMPLETED)
            error = next(iter(done)).exception()
            if isinstance(error, Goodbye):
                with contextlib.suppress(Exception):
                    async with asyncio.timeout(1.0):
                        await ws.close(error.code, str(error))
        finally:
            for task in (reading, sending):
                task.cancel()
            await asyncio.gather(reading, sending, return_exceptions=True)
            self.desk.leave(client)
            self._went()

    async def _read(self, ws: WebSocket, client: Client) -> None:
        while True:
            said = await ws.receive()
            if said["type"] == "websocket.disconnect":
                return
            text = said.get("text")
            if text is None:
                raise Goodbye(POLICY_VIOLATION, "a page sends texts")
            if len(text.encode()) > LARGEST_MESSAGE:
                raise Goodbye(TOO_BIG, "the message is too long")
            client.take(text)
            if client.busy:
                self.desk.wake()

    def _came(self) -> None:
        if self._last is not None:
            self._last.cancel()
            self._last = None

    def _went(self) -> None:
        if not self.stay and not self.desk.clients and self._last is None:
            self._last = asyncio.get_running_loop().call_later(LINGER, self._stop)

    def _stop(self) -> None:
        if self._uvicorn is not None:
            self._uvicorn.should_exit = True


class _Gate:
    """Before everything else: refuses what the guard refuses, and gives every answer its headers."""

    def __init__(self, app: ASGIApp, guard: Guard) -> None:
        self.app, self.guard = app, guard

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
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
        if why or (not socket_wanted and scope["method"] not in ("GET", "HEAD")):
            text = f"refused: {why or 'this server only shows'}\n"
            answer = PlainTextResponse(text, 403 if why else 405, headers={"connection": "close"})
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


def _part(name: str) -> Response:
    media = _TYPES[name.rpartition(".")[2]]
    return Response(PARTS[name].read_bytes(), media_type=media)


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
