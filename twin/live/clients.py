"""Pages that are connected, and what is to be computed for them: of each only the last state that it asked for.

A slider sends faster than states can be computed, and a slow line takes less than is computed. So there is one
place for a page's next state and one for its next answer, and what comes later takes the place of what was there.
Nothing grows.
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
from twin.live.computer import BeforeKey, Computer, ComputerLost, Kind

MOST_CLIENTS = 8
RATE, BURST = 400.0, 2000
"""Messages a second that a page may send, and how many at once: four times what the fastest pointer does."""
BAD_MESSAGES = 20
"""Messages that are none, after which a page is sent away."""
MOST_RECORDED = 20_000
"""States of a recording; the oldest are forgotten."""
MOST_LETTERS = 32
"""Answers beside states and pictures that wait for a slow line."""
LOOK = 0.25
"""Seconds from one look at the process that computes to the next."""
STOPPED = 10.0
"""Seconds for which it may be stopped by a signal; then it is started again."""
PATIENCE = 20.0
"""Seconds that a page may take to receive one answer."""
POLICY_VIOLATION, TRY_AGAIN = 1008, 1013
"""Codes with which a WebSocket is closed."""


AGAIN = "{}; it is started again, and the knobs stay"
HALTED = (
    "the process that computes ({pid}) was stopped by a signal; `kill -CONT {pid}` lets it go on, after "
    "{seconds:.0f} s it is started again; the knobs stay"
)
"""What pages are told of the process that computes."""


class Goodbye(Exception):
    """A page is sent away.

    Attributes
    ----------
    code
        Of the WebSocket; reason: for the page.
    """

    def __init__(self, code: int, reason: str) -> None:
        super().__init__(reason)
        self.code, self.reason = code, reason


@dataclass(frozen=True, eq=False)
class _Wish:
    """Something that a page wants.

    Attributes
    ----------
    kind : str
        The attribute of `Client` in which it stood, one of ``saves`` for "save".
    asked : Any
        The message.
    """

    kind: str
    asked: Any


@dataclass(eq=False)
class Client:
    """One page.

    Attributes
    ----------
    state : messages.AskedState | None
        That it wants next; view: picture that it wants next.
    shown : messages.AskedState | None
        Last state that was computed for it.
    before : BeforeKey | None
        For which noise, frames and seed it has the images before.
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
    _letters: deque[str] = field(default_factory=lambda: deque(maxlen=MOST_LETTERS))
    _to_send: asyncio.Event = field(default_factory=asyncio.Event)

    @property
    def busy(self) -> bool:
        """Whether it waits for something."""
        return bool(self.state or self.view or self.factors or self.saves or self.reveal)

    def next_wish(self) -> _Wish:
        """What it wants next, which it then no longer wants. It has to want something."""
        if self.saves and not (self.factors or self.state or self.reveal):
            return _Wish("save", self.saves.popleft())
        kind = next(kind for kind in ("factors", "state", "reveal", "view") if getattr(self, kind) is not None)
        wish = _Wish(kind, getattr(self, kind))
        setattr(self, kind, None)
        return wish

    def put_back(self, wish: _Wish) -> None:
        """Keep a wish that could not be served; a later wish of the same kind goes before it."""
        if wish.kind == "save":
            self.saves.appendleft(wish.asked)
        elif getattr(self, wish.kind) is None:
            setattr(self, wish.kind, wish.asked)

    def take(self, text: str | bytes) -> None:
        """Take a message of the page.

        Raises
        ------
        Goodbye
            Too many, or too many that are none.
        """
        now = time.monotonic()
        self._tokens = min(BURST, self._tokens + RATE * (now - self._refilled)) - 1.0
        self._refilled = now
        if self._tokens < 0.0:
            raise Goodbye(POLICY_VIOLATION, "too many messages")
        try:
            message = messages.read_message(text)
        except messages.BadMessage as error:
            self.bad += 1
            if self.bad > BAD_MESSAGES:
                raise Goodbye(POLICY_VIOLATION, "too many messages that are none") from None
            self.tell({"type": "refused", "problem": str(error)})
            return
        self._do(message, now)

    def _do(self, message: messages.Message, now: float) -> None:
        match message:
            case messages.AskedState():
                self.state = self._own(message)
            case messages.AskedView():
                self.view = message
            case messages.Factors():
                self.factors = message
            case messages.Save():
                self.saves.append(message.model_copy(update={"state": self._own(message.state)}))
            case messages.Blind():
                if message.on:
                    self.blind = secrets.randbelow(messages.LARGEST_SEED)
                elif self.blind is not None:
                    self.reveal = _hiding(self.shown or messages.AskedState(n=0), self.blind)
                    self.blind = None
                self.tell({"type": "blind", "on": self.blind is not None})
            case messages.Record():
                if message.on:
                    self.recorded, self.record_began = deque(maxlen=MOST_RECORDED), now
                    if self.shown is not None:
                        self.recorded.append((0.0, self.shown))
                self.tell({"type": "record", "on": message.on, "states": len(self.recorded or ())})
                if not message.on:
                    self.record_began = 0.0

    def _own(self, state: messages.AskedState) -> messages.AskedState:
        """With what is hidden from the page."""
        return state if self.blind is None else _hiding(state, self.blind)

    def kept(self, state: messages.AskedState) -> None:
        """A state was computed."""
        self.shown = state
        if self.recorded is not None and self.record_began and not isinstance(state, messages.BlindState):
            self.recorded.append((time.monotonic() - self.record_began, state))

    def answer(self, message: bytes, before: BeforeKey) -> None:
        """Send a state with the images before for this noise, frames and seed; the last one wins."""
        self._answer = message, before
        self._to_send.set()

    def picture(self, message: str) -> None:
        """Send a picture; the last one wins."""
        self._picture = message
        self._to_send.set()

    def letter(self, message: str) -> None:
        """Send a text, after those that wait."""
        self._letters.append(message)
        self._to_send.set()

    def tell(self, told: dict[str, Any]) -> None:
        """Send plain data, after those that wait."""
        self.letter(json.dumps(told))

    async def send(
        self, as_text: Callable[[str], Awaitable[None]], as_bytes: Callable[[bytes], Awaitable[None]]
    ) -> None:
        """Send for ever what there is to send.

        Raises
        ------
        Goodbye
            The page does not take it.
        """
        while True:
            await self._to_send.wait()
            self._to_send.clear()
            try:
                async with asyncio.timeout(PATIENCE):
                    while self._letters:
                        await as_text(self._letters.popleft())
                    if self._answer is not None:
                        (answer, before), self._answer = self._answer, None
                        await as_bytes(answer)
                        self.before = before
                    if self._picture is not None:
                        picture, self._picture = self._picture, None
                        await as_text(picture)
            except TimeoutError:
                raise Goodbye(TRY_AGAIN, "the line is too slow") from None


def _hiding(state: messages.AskedState, seed: int) -> messages.BlindState:
    return messages.BlindState.model_validate({**state.model_dump(), "blind": seed})


class Desk:
    """Hands the pages' wishes to the computer, one page after the other, states before pictures.

    Parameters
    ----------
    computer
        That computes.
    """

    def __init__(self, computer: Computer) -> None:
        self.computer = computer
        self.clients: list[Client] = []
        self.states = 0
        """Number of states computed so far."""
        self.trouble: dict[str, Any] = {}
        """What is wrong with the process that computes, as pages are told; empty if nothing is."""
        self._wake = asyncio.Event()
        self._suspect: object = None

    def enter(self) -> Client:
        """A new page.

        Raises
        ------
        Goodbye
            There are too many.
        """
        if len(self.clients) >= MOST_CLIENTS:
            raise Goodbye(TRY_AGAIN, f"{MOST_CLIENTS} pages are open already")
        client = Client()
        self.clients.append(client)
        return client

    def leave(self, client: Client) -> None:
        """A page is gone."""
        with contextlib.suppress(ValueError):
            self.clients.remove(client)

    def wake(self) -> None:
        """Somebody wants something."""
        self._wake.set()

    async def work(self) -> None:
        """Answer for ever.

        Raises
        ------
        CannotStart
            The process that computes ended and cannot be started again.
        """
        while True:
            if self.computer.condition == "ended":
                await self._start_again()
            client = self._next()
            if client is None:
                self._wake.clear()
                await self._wake.wait()
                continue
            wish = client.next_wish()
            try:
                await self._serve(client, wish)
            except ComputerLost as error:
                self._lost(client, wish, str(error))
                await self._start_again()

    async def watch(self) -> None:
        """Look for ever how the process that computes is; tell the pages when it does not run, and what comes next."""
        since = 0.0
        while True:
            await asyncio.sleep(LOOK)
            condition, known = self.computer.condition, self.trouble.get("state", "runs")
            if condition == "ended":
                self._tell_of("ended", AGAIN.format(self.computer.ending))
                self.wake()
            elif condition == "stopped" and known != "stopped":
                since = time.monotonic()
                self._tell_of("stopped", HALTED.format(pid=self.computer.pid, seconds=STOPPED))
            elif condition == "stopped" and time.monotonic() - since > STOPPED:
                self.computer.kill()
            elif condition == "runs":
                self._goes_on()

    async def _ask(self, kind: Kind, question: Any) -> Any:
        """The computer's answer. An answer that comes while the pages still believe the process stopped shows that it
        goes on, and they are told so before they get it, however long the next look at the process is away.

        Raises
        ------
        ComputerLost
            The process ended.
        """
        answer = await self.computer.ask(kind, question)
        if self.trouble and self.computer.condition == "runs":
            self._goes_on()
        return answer

    def _goes_on(self) -> None:
        """Tell the pages that the process runs, if what they know is that it was stopped."""
        if self.trouble.get("state") == "stopped":
            self._tell_of("runs")

    def _tell_of(self, state: str, problem: str = "") -> None:
        """Tell all pages, those that come later too, how it is with the process that computes; each news once."""
        told = {"type": "computing", "state": state, "problem": problem}
        if told == self.trouble or (state == "ended" and self.trouble.get("state") == "ended"):
            return
        self.trouble = told if problem else {}
        for one in self.clients:
            one.tell(told)

    def _lost(self, client: Client, wish: _Wish, problem: str) -> None:
        """The process ended over a wish. It is kept, unless the process has ended over it before."""
        self._tell_of("ended", AGAIN.format(problem))
        if wish.asked is self._suspect:
            client.tell({"type": "refused", "problem": f"{problem} twice over the same {wish.kind}, which is left out"})
        else:
            self._suspect = wish.asked
            client.put_back(wish)

    async def _start_again(self) -> None:
        """Start the process that computes anew; who waits goes on waiting."""
        self._tell_of("ended", AGAIN.format(self.computer.ending))
        before = self.computer.opened.greeting
        await self.computer.start_again()
        for one in self.clients:
            one.before = None
            if self.computer.opened.greeting != before:  # its files were changed meanwhile
                one.tell({"type": "hello", **self.computer.opened.greeting})
        self._tell_of("runs")

    def _next(self) -> Client | None:
        """The next page that wants a state, else anything; a page that was served goes to the end."""
        for wants in (lambda c: c.factors or c.state, lambda c: c.busy):
            for client in self.clients:
                if wants(client):
                    self.clients.remove(client)
                    self.clients.append(client)
                    return client
        return None

    async def _build(self, client: Client, asked: messages.Factors) -> None:
        for one in self.clients:
            one.tell({"type": "building"})
        found = await self._ask("factors", asked.values)
        if isinstance(found, str):
            client.tell({"type": "refused", "problem": found})
        else:
            for one in self.clients:
                one.shown = one.before = one.recorded = None
        for one in self.clients:
            one.tell({"type": "hello", **self.computer.opened.greeting})

    async def _serve(self, client: Client, wish: _Wish) -> None:
        asked = wish.asked
        match wish.kind:
            case "factors":
                await self._build(client, asked)
            case "state":
                key = (asked.noise, asked.frames, asked.seed)
                client.answer(await self._ask("state", (asked, client.before)), key)
                client.kept(asked)
                self.states += 1
            case "reveal":
                client.letter(await self._ask("hidden", asked))
            case "save" if asked.what == "job":
                client.letter(await self._ask("job", asked.state))
            case "save":
                client.letter(await self._ask("course", list(client.recorded or ())))
            case _:
                client.picture(await self._ask("view", asked))
