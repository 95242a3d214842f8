"""The page of an instrument in operation: trends, jumps, alarms, spots and the instrument in three dimensions.

It is served as the live twin is (`twin.serving`), and follows the record: when another program takes readings into it,
open pages show them. Who has the token of the address can read; who has the second one can acknowledge alarms, which
is all that a page can change.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import Awaitable, Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from importlib.resources import files
from importlib.resources.abc import Traversable
from typing import Any, TypeVar

from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from analysis.images.image_file import ImageError
from twin.operate.desk import Desk
from twin.operate.record.place import RecordFailed
from twin.operate.shown_readings import frame_numbered, frame_png
from twin.serving.guard import Guard
from twin.serving.server import SHARED, TYPES, PageServer, nothing

LOOK = 3.0
"""Seconds from one look at the record to the next."""
LONGEST_POST = 4096
"""Bytes of what a page posts."""
SLOWEST_POST = 10.0
"""Seconds within which the whole of it has to come."""
LONGEST_NAME, LONGEST_NOTE = 80, 500
"""Letters of who acknowledges, and of the note."""
_PAGE = files(__package__) / "page"
_OWN = ("index.html", "icon.svg", "operate.css", "operate.js", "chart.js", "panels.js", "reading.js")
PARTS: Mapping[str, Traversable] = {name: _PAGE / name for name in _OWN} | dict(SHARED)
"""Everything that can be asked for by name."""
T = TypeVar("T")


class BadQuestion(ValueError):
    """What a page asked or posted is nothing that can be answered; the message says what can."""


class OperateServer(PageServer):
    """One server; it ends with Ctrl-C.

    Args:
        desk: that has read the record.
        guard: who may read, and who may acknowledge.
        look: seconds from one look at the record to the next.
    """

    def __init__(self, desk: Desk, guard: Guard, look: float = LOOK) -> None:
        self.desk, self.look = desk, look
        self.trouble = ""
        """Why the record could not be read at the last look; empty if it could."""
        # what needs the estimate waits in a queue of its own: minutes at the beginning of a long record
        self._estimating, self._reading_record = ThreadPoolExecutor(1, "estimate"), ThreadPoolExecutor(2, "record")
        ways: dict[str, Callable[[Request], Awaitable[Response]]] = {
            "news": self._news,
            "state": self._state,
            "trend": self._trend,
            "reading": self._reading,
            "frame": self._frame,
            "motions": self._motions,
            "scene.glb": self._scene,
        }
        routes = [Route(f"/{name}", _answered(way)) for name, way in ways.items()]
        routes.append(Route("/acknowledge", _answered(self._acknowledge), methods=["POST"]))
        posts = frozenset({"/acknowledge"})
        super().__init__(guard, PARTS, routes, posts, (self._watch,), self._leave_threads)

    def _leave_threads(self) -> None:
        for threads in (self._estimating, self._reading_record):
            threads.shutdown(wait=False, cancel_futures=True)

    async def _estimate(self, work: Callable[[], T]) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._estimating, work)

    async def _read(self, work: Callable[[], T]) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._reading_record, work)

    async def _watch(self) -> None:
        """Look for ever whether the record has something new."""
        while True:
            try:
                await self._estimate(self.desk.look)
                await self._estimate(self.desk.work_ahead)
                self.trouble = ""
            except RecordFailed as error:  # a disk or a server that may be back at the next look
                self.trouble = str(error)
            await asyncio.sleep(self.look)

    async def _news(self, request: Request) -> Response:
        """Whether a page has to ask again, and whether it may acknowledge."""
        return JSONResponse(
            {
                "version": self.desk.version,
                "trouble": self.trouble,
                "may_write": self.guard.may_write(_headers(request)),
                "writable": bool(self.guard.write),
            }
        )

    async def _state(self, request: Request) -> Response:
        return _json(self.desk.state)

    async def _trend(self, request: Request) -> Response:
        begin, end = _whole(request, "from"), _whole(request, "to")
        if not begin < end:
            raise BadQuestion("a span begins before it ends")
        return _json(await self._estimate(partial(self.desk.trend, begin, end)))

    async def _reading(self, request: Request) -> Response:
        found = await self._read(partial(self.desk.reading, _whole(request, "time")))
        return nothing("the record has no reading of the monitor") if found is None else _json(found)

    async def _frame(self, request: Request) -> Response:
        number = _whole(request, "number")
        try:
            png = await self._read(partial(self._picture, number))
        except ImageError as error:
            return nothing(str(error))
        return nothing("that frame is gone or has changed") if png is None else Response(png, media_type=TYPES["png"])

    def _picture(self, number: int) -> bytes | None:
        """A frame, if its file is there and is still what the record says: no other file is ever read."""
        file = frame_numbered(self.desk.history, number)
        return frame_png(file.path) if file is not None and file.state == "there" else None

    async def _motions(self, request: Request) -> Response:
        return _json(await self._estimate(partial(self.desk.motions, _whole(request, "time"))))

    async def _scene(self, request: Request) -> Response:
        return Response(self.desk.scene, media_type=TYPES["glb"])

    async def _acknowledge(self, request: Request) -> Response:
        told = await _posted(request)
        alarm, by, note = told.get("alarm"), told.get("by"), told.get("note", "")
        if not isinstance(alarm, int) or isinstance(alarm, bool):
            raise BadQuestion("alarm: its number")
        if not isinstance(by, str) or not 0 < len(by.strip()) <= LONGEST_NAME or not by.isprintable():
            raise BadQuestion(f"by: who acknowledges, 1 to {LONGEST_NAME} letters")
        if not isinstance(note, str) or len(note) > LONGEST_NOTE or not note.isprintable():
            raise BadQuestion(f"note: at most {LONGEST_NOTE} letters on one line")
        problem = await self._read(partial(self.desk.acknowledge, alarm, by.strip(), note.strip()))
        if problem:
            return Response(f"{problem}\n", 409, media_type="text/plain")
        return JSONResponse({"version": self.desk.version})


def _answered(way: Callable[[Request], Awaitable[Response]]) -> Callable[[Request], Awaitable[Response]]:
    """A way that says what is wrong with a question, and what the record cannot do now."""

    async def answered(request: Request) -> Response:
        try:
            return await way(request)
        except BadQuestion as error:
            return Response(f"{error}\n", 400, media_type="text/plain")
        except RecordFailed as error:
            return Response(f"the database cannot do it: {error}\n", 503, media_type="text/plain")

    return answered


def _headers(request: Request) -> dict[str, str]:
    return {key.lower(): value for key, value in request.headers.items()}


def _whole(request: Request, name: str) -> int:
    """A whole number that a page asks with. Raises BadQuestion."""
    text = request.query_params.get(name, "")
    try:
        value = int(text) if len(text) <= 20 else None
    except ValueError:
        value = None
    if value is None or abs(value) >= 2**62:
        raise BadQuestion(f"{name}: a whole number")
    return value


async def _posted(request: Request) -> dict[str, Any]:
    """The plain data that a page posts. Raises BadQuestion."""
    body = b""
    try:
        async with asyncio.timeout(SLOWEST_POST):
            async for piece in request.stream():
                body += piece
                if len(body) > LONGEST_POST:
                    raise BadQuestion(f"at most {LONGEST_POST} bytes")
    except TimeoutError:
        raise BadQuestion(f"the whole of it within {SLOWEST_POST:g} s") from None
    try:
        told = json.loads(body)
    except (ValueError, RecursionError):
        raise BadQuestion("not JSON") from None
    if not isinstance(told, dict):
        raise BadQuestion('{"alarm": 1, "by": "name", "note": ""}')
    return told


def _json(content: bytes) -> Response:
    return Response(content, media_type="application/json")
