"""Connected pages and the scheduling of their requests: only each page's latest requested state is computed.

A slider sends faster than states can be computed, and a slow connection receives more slowly than they are computed.
Therefore each page has one slot for its next state and one for its next answer, and a later one replaces an earlier
one. No queue grows without limit.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import secrets
import time
from collections import deque
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from typing import Any

from twin.live import messages
from twin.live.computer import BeforeKey, Computer, ComputerLost

MOST_CLIENTS = 8
"""Largest number of connected pages."""
RATE, BURST = 400.0, 2000
"""Messages per second that a page may send on average, and largest number at once (burst).

The rate is four times that of the fastest pointer.
"""
BAD_MESSAGES = 20
"""Number of invalid messages after which a page is disconnected."""
MOST_RECORDED = 20_000
"""Largest number of states in a recording; the oldest are dropped."""
MOST_QUEUED = 32
"""Largest number of text messages queued for a slow connection, in addition to states and pictures."""
SEND_TIMEOUT = 20.0
"""Time that a page may take to receive one answer, in seconds."""
POLICY_VIOLATION, TRY_AGAIN = 1008, 1013
"""Codes with which the server closes a WebSocket: the page violates a rule, or it may try again later."""


class Disconnected(Exception):
    """Disconnection of a page by the server.

    Attributes
    ----------
    code
        Close code of the WebSocket; the message is the reason shown on the page.
    """

    def __init__(self, code: int, reason: str) -> None:
        super().__init__(reason)
        self.code, self.reason = code, reason


@dataclass(eq=False)
class Client:
    """One connected page with its open requests and queued answers.

    Attributes
    ----------
    state : AskedState | None
        State that it requests next.
    view : AskedView | None
        Picture that it requests next.
    saves : deque[Save]
        Requests for job files to be saved.
    factors : Factors | None
        Values of a study's factors that it requests.
    reveal : BlindState | None
        State whose hidden motions it requests to be revealed.
    shown : AskedState | None
        Latest state computed for it.
    before : BeforeKey | None
        Noise, frames and seed of the reference images that it has.
    blind : int | None
        Seed of the hidden motions, which the user is to recognise; None if nothing is hidden.
    recorded : deque[tuple[float, AskedState]] | None
        Recorded states with their seconds since the recording began.
    record_began : float
        Monotonic time at which the recording began; 0 if none is running.
    bad : int
        Number of invalid messages so far.
    """

    state: messages.AskedState | None = None
    view: messages.AskedView | None = None
    saves: deque[messages.Save] = field(default_factory=lambda: deque(maxlen=4))
    factors: messages.Factors | None = None
    reveal: messages.BlindState | None = None
    shown: messages.AskedState | None = None
    before: BeforeKey | None = None
    blind: int | None = None
    recorded: deque[tuple[float, messages.AskedState]] | None = None
    record_began: float = 0.0
    bad: int = 0
    _tokens: float = BURST
    _refilled: float = field(default_factory=time.monotonic)
    _answer: tuple[bytes, BeforeKey] | None = None
    _picture: str | None = None
    _queued_texts: deque[str] = field(default_factory=lambda: deque(maxlen=MOST_QUEUED))
    _to_send: asyncio.Event = field(default_factory=asyncio.Event)

    @property
    def busy(self) -> bool:
        """True if the page has a request that is not served yet."""
        return bool(self.state or self.view or self.factors or self.saves or self.reveal)

    def next_request(self) -> tuple[str, Any]:
        """Remove and return the page's next request, by its kind and message; the page must have one.

        The kind is the name of the attribute that held the request, or "save" for one of ``saves``.
        """
        if self.saves and not (self.factors or self.state or self.reveal):
            return "save", self.saves.popleft()
        kind = next(kind for kind in ("factors", "state", "reveal", "view") if getattr(self, kind) is not None)
        asked = getattr(self, kind)
        setattr(self, kind, None)
        return kind, asked

    def receive(self, text: str | bytes) -> None:
        """Handle a message that the page sent.

        Raises
        ------
        Disconnected
            The page sent too many messages, or too many invalid ones.
        """
        now = time.monotonic()
        self._tokens = min(BURST, self._tokens + RATE * (now - self._refilled)) - 1.0
        self._refilled = now
        if self._tokens < 0.0:
            raise Disconnected(POLICY_VIOLATION, "too many messages")
        try:
            message = messages.read_message(text)
        except messages.BadMessage as error:
            self.bad += 1
            if self.bad > BAD_MESSAGES:
                raise Disconnected(POLICY_VIOLATION, "too many invalid messages") from None
            self.queue_json({"type": "refused", "problem": str(error)})
            return
        self._handle(message, now)

    def _handle(self, message: messages.Message, now: float) -> None:
        """Store the request that a message of the page contains, for the scheduler."""
        match message:
            case messages.AskedState():
                self.state = self._with_hidden(message)
            case messages.AskedView():
                self.view = message
            case messages.Factors():
                self.factors = message
            case messages.Save():
                self.saves.append(message.model_copy(update={"state": self._with_hidden(message.state)}))
            case messages.Blind():
                if message.on:
                    self.blind = secrets.randbelow(messages.LARGEST_SEED)
                elif self.blind is not None:
                    self.reveal = _hiding(self.shown or messages.AskedState(n=0), self.blind)
                    self.blind = None
                self.queue_json({"type": "blind", "on": self.blind is not None})
            case messages.Record():
                if message.on:
                    self.recorded, self.record_began = deque(maxlen=MOST_RECORDED), now
                    if self.shown is not None:
                        self.recorded.append((0.0, self.shown))
                self.queue_json({"type": "record", "on": message.on, "states": len(self.recorded or ())})
                if not message.on:
                    self.record_began = 0.0

    def _with_hidden(self, state: messages.AskedState) -> messages.AskedState:
        """Return a state together with the motions that are hidden from the page."""
        return state if self.blind is None else _hiding(state, self.blind)

    def state_computed(self, state: messages.AskedState) -> None:
        """Remember a computed state as the one shown, and record it if a recording is running."""
        self.shown = state
        if self.recorded is not None and self.record_began and not isinstance(state, messages.BlindState):
            self.recorded.append((time.monotonic() - self.record_began, state))

    def queue_state(self, message: bytes, before: BeforeKey) -> None:
        """Queue the message with a computed state to be sent to the page; a later one replaces it.

        ``before`` identifies the noise, frames and seed of the reference images that it contains.
        """
        self._answer = message, before
        self._to_send.set()

    def queue_picture(self, message: str) -> None:
        """Queue a picture to be sent to the page; a later one replaces it."""
        self._picture = message
        self._to_send.set()

    def queue_text(self, message: str) -> None:
        """Queue a text to be sent to the page after the queued ones."""
        self._queued_texts.append(message)
        self._to_send.set()

    def queue_json(self, data: dict[str, Any]) -> None:
        """Queue plain data to be sent to the page as JSON after the queued texts."""
        self.queue_text(json.dumps(data))

    async def send(
        self, as_text: Callable[[str], Awaitable[None]], as_bytes: Callable[[bytes], Awaitable[None]]
    ) -> None:
        """Send queued messages to the page until it disconnects.

        Raises
        ------
        Disconnected
            The page does not receive them in time.
        """
        while True:
            await self._to_send.wait()
            self._to_send.clear()
            try:
                async with asyncio.timeout(SEND_TIMEOUT):
                    while self._queued_texts:
                        await as_text(self._queued_texts.popleft())
                    if self._answer is not None:
                        (answer, before), self._answer = self._answer, None
                        await as_bytes(answer)
                        self.before = before
                    if self._picture is not None:
                        picture, self._picture = self._picture, None
                        await as_text(picture)
            except TimeoutError:
                raise Disconnected(TRY_AGAIN, "the connection is too slow") from None


def _hiding(state: messages.AskedState, seed: int) -> messages.BlindState:
    """Return a request for a state with the seed of the motions to hide."""
    return messages.BlindState.model_validate({**state.model_dump(), "blind": seed})


class LiveApi:
    """Scheduler that passes the pages' requests to the computing process, page by page, states before pictures.

    Parameters
    ----------
    computer
        Handle of the computing process.
    """

    def __init__(self, computer: Computer) -> None:
        self.computer = computer
        self.clients: list[Client] = []
        self.states = 0
        """Number of states computed so far."""
        self._wake = asyncio.Event()

    def connect(self) -> Client:
        """Add a new page.

        Raises
        ------
        Disconnected
            Too many pages are connected.
        """
        if len(self.clients) >= MOST_CLIENTS:
            raise Disconnected(TRY_AGAIN, f"{MOST_CLIENTS} pages are open already")
        client = Client()
        self.clients.append(client)
        return client

    def disconnect(self, client: Client) -> None:
        """Remove a page from those that are served."""
        with contextlib.suppress(ValueError):
            self.clients.remove(client)

    def notify(self) -> None:
        """Wake the scheduler, because there is a new request."""
        self._wake.set()

    async def serve_requests(self) -> None:
        """Serve requests, without end.

        Raises
        ------
        ComputerLost
            The computing process ended; all pages are told before.
        """
        while True:
            client = self._next()
            if client is None:
                self._wake.clear()
                await self._wake.wait()
                continue
            try:
                await self._answer_request(client, *client.next_request())
            except ComputerLost as error:
                for client in self.clients:
                    client.queue_json({"type": "refused", "problem": str(error)})
                raise

    def _next(self) -> Client | None:
        """Return the next page to be served: one that requests a state, or else any with a request.

        The page that is served moves to the end of the order.
        """
        for wants in (lambda c: c.factors or c.state, lambda c: c.busy):
            for client in self.clients:
                if wants(client):
                    self.clients.remove(client)
                    self.clients.append(client)
                    return client
        return None

    async def _build(self, client: Client, asked: messages.Factors) -> None:
        """Have the instrument built with other values of a study's factors, and inform all pages."""
        for client in self.clients:
            client.queue_json({"type": "building"})
        answer = await self.computer.ask("factors", asked.values)
        if isinstance(answer, str):
            client.queue_json({"type": "refused", "problem": answer})
        else:
            for client in self.clients:
                client.shown = client.before = client.recorded = None
        for client in self.clients:
            client.queue_json({"type": "hello", **self.computer.opened.greeting})

    async def _answer_request(self, client: Client, kind: str, asked: Any) -> None:
        """Have the computing process answer a request of a page, and queue the answer."""
        match kind:
            case "factors":
                await self._build(client, asked)
            case "state":
                key = (asked.noise, asked.frames, asked.seed)
                client.queue_state(await self.computer.ask("state", (asked, client.before)), key)
                client.state_computed(asked)
                self.states += 1
            case "reveal":
                client.queue_text(await self.computer.ask("hidden", asked))
            case "save" if asked.what != "course":
                client.queue_text(await self.computer.ask(asked.what, asked.state))
            case "save":
                client.queue_text(await self.computer.ask("course", list(client.recorded or ())))
            case _:
                client.queue_picture(await self.computer.ask("view", asked))
