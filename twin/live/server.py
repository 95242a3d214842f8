"""The server of the live twin: its page, the scene, and one WebSocket for each page."""

from __future__ import annotations

import asyncio
import contextlib
from importlib.resources import files

from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket

from twin.live.clients import POLICY_VIOLATION, Client, Desk, Goodbye
from twin.live.computer import Computer
from twin.live.messages import LARGEST_MESSAGE
from twin.serving.guard import Guard
from twin.serving.server import SHARED, TYPES, PageServer

LINGER = 10.0
"""Seconds without any page after which the server ends, so that a page may be loaded again."""
_PAGE = files(__package__) / "page"
_OWN = ("index.html", "icon.svg", "live.css", "live.js", "knobs.js", "numbers.js", "spots.js", "readings.js")
PARTS = {name: _PAGE / name for name in _OWN} | dict(SHARED)
"""Everything that can be asked for by name."""


class LiveServer(PageServer):
    """One server. It ends with Ctrl-C or when the last page is closed, and raises CannotStart if the process that
    computes ended and cannot be started again.

    Args:
        computer: started.
        guard: who may speak to it.
        stay: go on when the last page is closed.
    """

    def __init__(self, computer: Computer, guard: Guard, stay: bool = False) -> None:
        self.desk = Desk(computer)
        self.stay = stay
        self._last: asyncio.TimerHandle | None = None
        routes = [
            Route("/session", self._session),
            Route("/scene.glb", self._scene),
            WebSocketRoute("/live", self._live),
        ]
        tasks = (self.desk.work, self.desk.watch)
        super().__init__(guard, PARTS, routes, tasks=tasks, leave=self._leave_desk, largest=LARGEST_MESSAGE)

    def _leave_desk(self) -> None:
        self.desk.computer.leave()

    async def _session(self, request: Request) -> Response:
        """Whether a page that lost its line may come back."""
        return JSONResponse(
            {"instrument": self.desk.computer.opened.greeting["instrument"], "states": self.desk.states}
        )

    async def _scene(self, request: Request) -> Response:
        return Response(self.desk.computer.opened.scene, media_type=TYPES["glb"])

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
            client.take(text)
            if client.busy:
                self.desk.wake()

    def _came(self) -> None:
        if self._last is not None:
            self._last.cancel()
            self._last = None

    def _went(self) -> None:
        if not self.stay and not self.desk.clients and self._last is None:
            self._last = asyncio.get_running_loop().call_later(LINGER, self.stop)
