"""The server of the live twin: its page, the scene, one WebSocket for each page, and the gate before everything."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path

import uvicorn
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, RedirectResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket

from twin.live.clients import POLICY_VIOLATION, Client, Disconnected, LiveApi
from twin.live.computer import Computer
from twin.live.guard import (
    ACCEPT_BACKLOG,
    EVERYWHERE,
    HEADERS,
    KEEP_ALIVE,
    Connections,
    Guard,
    PageSocket,
    PatientServer,
    names_of_this_machine,
)
from twin.live.messages import LARGEST_MESSAGE

IDLE_TIMEOUT = 10.0
"""Seconds without any page after which the server ends, so that a page may be loaded again."""
TYPES = {
    "html": "text/html",
    "css": "text/css",
    "js": "text/javascript",
    "svg": "image/svg+xml",
    "glb": "model/gltf-binary",
}
_TWIN = Path(__file__).parents[1]
PARTS = {file.name: file for file in (_TWIN / "live" / "page").iterdir()} | {
    "scroll.css": _TWIN / "framework" / "scroll.css",
    "three.min.js": _TWIN / "pictures" / "viewer" / "three.min.js",
}
"""Everything that can be asked for by name; no path of a request is ever one of the file system."""


class LiveServer:
    """One server. It ends with Ctrl-C or when the last page is closed, and raises CannotStart if the process that
    computes ended and cannot be started again.

    Parameters
    ----------
    computer
        started.
    guard
        Who may speak to it.
    stay
        Go on when the last page is closed.
    """

    def __init__(self, computer: Computer, guard: Guard, stay: bool = False) -> None:
        self.api, self.guard, self.stay = LiveApi(computer), guard, stay
        self.connections = Connections(guard.has_token_cookie)
        self._last: asyncio.TimerHandle | None = None
        self._uvicorn: uvicorn.Server | None = None
        self._failed: BaseException | None = None
        self.app = Starlette(
            routes=[
                Route("/", self._index),
                Route("/session", self._session),
                Route("/scene.glb", self._scene),
                WebSocketRoute("/live", self._live),
                Route("/{name}", self._part),
            ],
            middleware=[Middleware(Gate, guard=guard)],
            lifespan=self._lifespan,
        )

    @property
    def started(self) -> bool:
        """Whether it answers."""
        return self._uvicorn is not None and self._uvicorn.started

    def run(self, listening: socket.socket) -> None:
        """Serve until Ctrl-C, or until it is told to stop.

        Parameters
        ----------
        listening : socket.socket
            Bound and not yet accepting.

        Raises
        ------
        BaseException
            What ended one of its tasks.
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
            timeout_keep_alive=int(KEEP_ALIVE),
            timeout_graceful_shutdown=2,
            h11_max_incomplete_event_size=1 << 15,
            backlog=ACCEPT_BACKLOG,
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
        tasks = [asyncio.create_task(make()) for make in (self.api.serve_requests, self.api.watch_process)]
        for task in tasks:
            task.add_done_callback(self._ended)
        try:
            yield
        finally:
            for task in tasks:
                task.cancel()
            self.api.computer.leave()

    def _ended(self, task: asyncio.Task[None]) -> None:
        """What the server is for cannot go on: nothing is left to serve."""
        if not task.cancelled() and (error := task.exception()) is not None:
            self._failed = error
            self.stop()

    async def _index(self, request: Request) -> Response:
        if "token" not in request.query_params:
            return _file("index.html")
        return RedirectResponse("/", 303, headers={"set-cookie": self.guard.cookie})

    async def _part(self, request: Request) -> Response:
        name = request.path_params["name"]
        return _file(name) if name in PARTS else PlainTextResponse("nothing is here\n", 404)

    async def _session(self, request: Request) -> Response:
        """Whether a page that lost its line may come back."""
        return JSONResponse({"instrument": self.api.computer.opened.greeting["instrument"], "states": self.api.states})

    async def _scene(self, request: Request) -> Response:
        return Response(self.api.computer.opened.scene, media_type=TYPES["glb"])

    async def _live(self, ws: WebSocket) -> None:
        """One page, from its coming to its going."""
        try:
            client = self.api.connect()
        except Disconnected as bye:
            await ws.accept()
            await ws.close(bye.code, str(bye))
            return
        if self._last is not None:
            self._last.cancel()
            self._last = None
        await ws.accept()
        client.queue_json({"type": "hello", **self.api.computer.opened.greeting})
        if self.api.process_trouble:
            client.queue_json(self.api.process_trouble)
        reading = asyncio.create_task(self._read(ws, client))
        sending = asyncio.create_task(client.send(ws.send_text, ws.send_bytes))
        try:
            done, _ = await asyncio.wait({reading, sending}, return_when=asyncio.FIRST_COMPLETED)
            error = next(iter(done)).exception()
            if isinstance(error, Disconnected):
                with contextlib.suppress(Exception):
                    async with asyncio.timeout(1.0):
                        await ws.close(error.code, str(error))
        finally:
            for task in (reading, sending):
                task.cancel()
            await asyncio.gather(reading, sending, return_exceptions=True)
            self.api.disconnect(client)
            if not self.stay and not self.api.clients and self._last is None:
                self._last = asyncio.get_running_loop().call_later(IDLE_TIMEOUT, self.stop)

    async def _read(self, ws: WebSocket, client: Client) -> None:
        while True:
            message = await ws.receive()
            if message["type"] == "websocket.disconnect":
                return
            text = message.get("text")
            if text is None:
                raise Disconnected(POLICY_VIOLATION, "a page sends texts")
            client.receive(text)
            if client.busy:
                self.api.notify()


def _file(name: str) -> Response:
    """Answer with a part of the page."""
    return Response(PARTS[name].read_bytes(), media_type=TYPES[name.rpartition(".")[2]])


class Gate:
    """Before everything else: refuses what the guard refuses, and gives every answer its headers.

    Parameters
    ----------
    app
        Behind it.
    guard
        Who may pass.
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
        local_address = (scope.get("server") or ("", None))[0]
        refusal_reason = self.guard.refusal(headers, socket_wanted, local_address)
        if refusal_reason and not socket_wanted and self._brings_token(scope):
            refusal_reason = self.guard.host_refusal(headers, local_address)
        if refusal_reason and socket_wanted:
            # closed before it is accepted: the browser gets status 403
            await send({"type": "websocket.close", "code": POLICY_VIOLATION, "reason": refusal_reason})
            return
        status = 403
        if not refusal_reason and not socket_wanted and scope["method"] not in ("GET", "HEAD"):
            status, refusal_reason = 405, "this server only shows"
        if refusal_reason:
            answer = PlainTextResponse(f"refused: {refusal_reason}\n", status, headers={"connection": "close"})
            await answer(scope, receive, _with_headers(send))
            return
        await self.app(scope, receive, send if socket_wanted else _with_headers(send))

    def _brings_token(self, scope: Scope) -> bool:
        if scope["path"] != "/":
            return False
        return self.guard.is_token(Request(scope).query_params.get("token", ""))


def _with_headers(send: Send) -> Callable[[Message], Awaitable[None]]:
    async def wrapped(message: Message) -> None:
        if message["type"] == "http.response.start":
            added = [(key.lower().encode(), value.encode()) for key, value in HEADERS.items()]
            message = {**message, "headers": [*message.get("headers", []), *added]}
        await send(message)

    return wrapped


def listen(host: str, port: int) -> socket.socket:
    """A socket on a host and a port; port 0 takes a free one.

    Raises
    ------
    OSError
        Somebody listens there already, or there is no such host.
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

    Parameters
    ----------
    host : str
        That was asked for.
    port : int
        On which it listens.
    words : str
        After the question mark of the address.
    """
    everywhere = host in EVERYWHERE
    shown = "127.0.0.1" if everywhere else f"[{host}]" if ":" in host else host
    names = names_of_this_machine()[:1] if everywhere else ()
    others = [f"from other machines: http://{name}:{port}/?{words}" for name in names]
    return [f"open http://{shown}:{port}/?{words}", *others]
