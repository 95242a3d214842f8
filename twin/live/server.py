"""Server of the live twin: its page, the scene, one WebSocket for each page, and the access control."""

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
from twin.live.guard import EVERYWHERE, HEADERS, Guard, names_of_this_machine
from twin.live.messages import LARGEST_MESSAGE

IDLE_TIMEOUT = 10.0
"""Time without any page after which the server ends, in seconds; a page may be reloaded within it."""
TYPES = {
    "html": "text/html",
    "css": "text/css",
    "js": "text/javascript",
    "svg": "image/svg+xml",
    "glb": "model/gltf-binary",
}
"""Suffix of a file -> its media type."""
_TWIN = Path(__file__).parents[1]
PARTS = {file.name: file for file in (_TWIN / "live" / "page").iterdir()} | {
    "scroll.css": _TWIN / "framework" / "scroll.css",
    "three.min.js": _TWIN / "pictures" / "viewer" / "three.min.js",
}
"""Name -> file of everything that can be requested; the path in a request is never used as a file path."""


class LiveServer:
    """Server of the live twin, which ends with Ctrl-C or when the last page is closed.

    It raises ComputerLost if the computing process ended.

    Parameters
    ----------
    computer
        Object that represents the started computing process.
    guard
        Access control.
    stay
        True to go on when the last page is closed.
    """

    def __init__(self, computer: Computer, guard: Guard, stay: bool = False) -> None:
        self.api, self.guard, self.stay = LiveApi(computer), guard, stay
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
        """True if the server has started to answer requests."""
        return self._uvicorn is not None and self._uvicorn.started

    def run(self, listening: socket.socket) -> None:
        """Serve until Ctrl-C, or until it is stopped.

        Parameters
        ----------
        listening : socket.socket
            Bound socket that does not accept connections yet.

        Raises
        ------
        BaseException
            Exception that ended the scheduler.
        """
        config = uvicorn.Config(
            self.app,
            # foreign requests that are no HTTP are errors to uvicorn, and not to the user
            log_level="critical",
            access_log=False,
            server_header=False,
            date_header=False,
            http="h11",
            ws="websockets-sansio",
            ws_max_size=LARGEST_MESSAGE,
            ws_max_queue=16,
            ws_per_message_deflate=False,
            ws_ping_interval=20.0,
            ws_ping_timeout=30.0,
            timeout_keep_alive=30,
            timeout_graceful_shutdown=2,
            h11_max_incomplete_event_size=1 << 15,
        )
        self._uvicorn = uvicorn.Server(config)
        # uvicorn shuts down in order and then raises the signal again
        with contextlib.suppress(KeyboardInterrupt):
            self._uvicorn.run(sockets=[listening])
        if self._failed is not None:
            raise self._failed

    def stop(self) -> None:
        """End the server after the open requests."""
        if self._uvicorn is not None:
            self._uvicorn.should_exit = True

    @contextlib.asynccontextmanager
    async def _lifespan(self, app: Starlette) -> AsyncIterator[None]:
        """Run the scheduler of requests while the application runs."""
        task = asyncio.create_task(self.api.serve_requests())
        task.add_done_callback(self._ended)
        try:
            yield
        finally:
            task.cancel()
            self.api.computer.leave()

    def _ended(self, task: asyncio.Task[None]) -> None:
        """Stop the server after an error of the scheduler."""
        if not task.cancelled() and (error := task.exception()) is not None:
            self._failed = error
            self.stop()

    async def _index(self, request: Request) -> Response:
        if "token" not in request.query_params:
            return _file("index.html")
        return RedirectResponse("/", 303, headers={"set-cookie": self.guard.cookie})

    async def _part(self, request: Request) -> Response:
        name = request.path_params["name"]
        return _file(name) if name in PARTS else PlainTextResponse("not found\n", 404)

    async def _session(self, request: Request) -> Response:
        """Answer a page that lost its connection and asks whether it may connect again."""
        return JSONResponse({"instrument": self.api.computer.opened.greeting["instrument"], "states": self.api.states})

    async def _scene(self, request: Request) -> Response:
        return Response(self.api.computer.opened.scene, media_type=TYPES["glb"])

    async def _live(self, ws: WebSocket) -> None:
        """Serve one page from its connection to its end."""
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
        """Receive messages of a page and pass them to the scheduler, until the page disconnects."""
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
    """Return a file of the page (HTML, CSS, script) as an HTTP answer."""
    return Response(PARTS[name].read_bytes(), media_type=TYPES[name.rpartition(".")[2]])


class Gate:
    """Middleware that refuses requests which the guard does not accept, and adds security headers to every answer.

    Parameters
    ----------
    app
        Application behind it.
    guard
        Access control.
    """

    def __init__(self, app: ASGIApp, guard: Guard) -> None:
        self.app, self.guard = app, guard

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one HTTP request or WebSocket: refuse it, or pass it on and add the headers to the answer."""
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
            status, refusal_reason = 405, "only GET and HEAD are allowed"
        if refusal_reason:
            answer = PlainTextResponse(f"refused: {refusal_reason}\n", status, headers={"connection": "close"})
            await answer(scope, receive, _with_headers(send))
            return
        await self.app(scope, receive, send if socket_wanted else _with_headers(send))

    def _brings_token(self, scope: Scope) -> bool:
        """Return whether the address in a request for the page contains the token."""
        if scope["path"] != "/":
            return False
        return self.guard.is_token(Request(scope).query_params.get("token", ""))


def _with_headers(send: Send) -> Callable[[Message], Awaitable[None]]:
    """Return a send function that adds the security headers to the start of a response."""

    async def wrapped(message: Message) -> None:
        if message["type"] == "http.response.start":
            added = [(key.lower().encode(), value.encode()) for key, value in HEADERS.items()]
            message = {**message, "headers": [*message.get("headers", []), *added]}
        await send(message)

    return wrapped


def listen(host: str, port: int) -> socket.socket:
    """Return a socket bound to a host and a port; port 0 takes a free one.

    Raises
    ------
    OSError
        The port is in use, or the host does not exist.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    out = socket.socket(family, socket.SOCK_STREAM)
    out.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        out.bind((host, port))
        # connections made before the server runs wait for it
        out.listen()
    except OSError:
        out.close()
        raise
    return out


def addresses(host: str, port: int, words: str) -> list[str]:
    """Return the printed lines with the page's address on this machine and, if reachable, from other machines.

    Parameters
    ----------
    host : str
        Requested host.
    port : int
        Port of the server.
    words : str
        Query of the address, after the question mark.
    """
    everywhere = host in EVERYWHERE
    shown = "127.0.0.1" if everywhere else f"[{host}]" if ":" in host else host
    names = names_of_this_machine()[:1] if everywhere else ()
    others = [f"from other machines: http://{name}:{port}/?{words}" for name in names]
    return [f"open http://{shown}:{port}/?{words}", *others]
