"""Server of the live twin: its page, the scene, one WebSocket for each page, and the access control.

The address that the command prints contains a random token. The first request with it sets the token as a cookie, which
no script can read and no other site can send, and is redirected to the page without the token. Every other request, and
the WebSocket before it is accepted, needs the cookie, a Host header of this server (another site's name may resolve to
127.0.0.1) and, where the browser sends it, an Origin header of the page itself.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import secrets
import socket
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator, Mapping
from dataclasses import dataclass
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
from twin.live.messages import LARGEST_MESSAGE

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
        address = _host_text(f"[{plain}]" if ":" in plain else plain, self.port)
        if host not in self.hosts and not (plain and host == address):
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
    return tuple(sorted({name for name in (socket.gethostname(), socket.getfqdn()) if name}, key=len))


def _cookies(header: str, name: str) -> Iterator[str]:
    """Yield the values of all cookies of a name; cookies of other programs on this host may have any form."""
    for part in header.split(";"):
        key, _, value = part.strip().partition("=")
        if key == name:
            yield value


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
