"""The live twin's command as a user starts it, and its page in a browser; for tests and benchmarks."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

CHROMIUM = shutil.which("chromium")
# As a browser without a graphics card: pages are put together by the processor, and so is WebGL. No services of the
# browser's maker.
FLAGS = [
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-gpu-compositing",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-quic",
    "--disable-sync",
    "--no-first-run",
]


class Command:
    """``python -m twin.live`` in a process of its own."""

    def __init__(self, what: str, *options: str, cwd: Path | None = None, **environment: str) -> None:
        env = {**os.environ, "PYTHONUNBUFFERED": "1", **environment}
        self.process = subprocess.Popen(
            [sys.executable, "-m", "twin.live", what, *options],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env=env,
            cwd=cwd or Path(__file__).parents[2],
        )
        self.said = ""
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.said += line
            found = re.search(r"open (http://\S+)", line)
            if found:
                self.address = found[1]
                return
        raise AssertionError(f"no address: {self.said}")

    @property
    def place(self) -> tuple[int, str]:
        """Port and token."""
        found = re.search(r":(\d+)/\?token=(\S+)", self.address)
        assert found is not None
        return int(found[1]), found[2]

    def end(self) -> int:
        """Ctrl-C; the exit code."""
        self.process.send_signal(signal.SIGINT)
        return self.process.wait(20)


@contextmanager
def running(what: str, *options: str, cwd: Path | None = None, **environment: str) -> Iterator[Command]:
    """The command until the block ends; in this checkout if not told where."""
    command = Command(what, *options, cwd=cwd, **environment)
    try:
        yield command
    finally:
        if command.process.poll() is None:
            command.process.kill()
        command.process.wait(20)


class Page:
    """A page that is open, and what went wrong on it."""

    def __init__(self, browser: Any, address: str, width: int = 1500, height: int = 950) -> None:
        self.context = browser.new_context(viewport={"width": width, "height": height}, accept_downloads=True)
        self.page = self.context.new_page()
        self.wrong: list[str] = []
        self.host = address.split("/")[2]
        self.page.on("console", lambda told: self._note(told.type, told.text))
        self.page.on("pageerror", lambda error: self.wrong.append(str(error)))
        self.page.on("request", lambda asked: self._asked(asked.url))
        self.page.goto(address)

    def _note(self, kind: str, text: str) -> None:
        if kind in ("error", "warning") and "GPU stall" not in text:  # the software renderer says that of itself
            self.wrong.append(text)

    def _asked(self, address: str) -> None:
        if not address.startswith((f"http://{self.host}/", f"ws://{self.host}/", "blob:")):
            self.wrong.append(f"asked for {address}")

    def until(self, expression: str, seconds: float = 20.0) -> Any:
        """Wait until an expression of the page is true; the page's policy forbids what Playwright waits with."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            found = self.page.evaluate(expression)
            if found:
                return found
            self.page.wait_for_timeout(20)
        raise AssertionError(f"never true: {expression}; {self.wrong}")

    def ready(self) -> None:
        """Wait for the first state and the scene."""
        self.until("window.liveTwin && liveTwin.shown > 0", 40.0)
        self.until("document.getElementById('scene').dataset.ready === 'yes'", 40.0)

    def still(self) -> int:
        """Wait until the last state that was asked for is painted; its number."""
        self.page.wait_for_timeout(50)
        return int(
            self.until("!liveTwin.dirty && !liveTwin.waiting.size && liveTwin.shown === liveTwin.n && liveTwin.n")
        )

    def unfold(self, *paths: str) -> None:
        """Open bodies of the tree."""
        for path in paths:
            self.page.evaluate('path => { document.querySelector(`details[data-path="${path}"]`).open = true }', path)

    def slider(self, knob: str) -> Any:
        """The slider of a knob in the tree."""
        return self.page.locator(f'#tree .knob[data-knob="{knob}"] input[type=range]')

    def number(self, knob: str) -> Any:
        """The number beside it."""
        return self.page.locator(f'#tree .knob[data-knob="{knob}"] > input.number')

    def drag(self, knob: str, by: float, steps: int = 12) -> None:
        """Drag a slider's handle by pixels, as a hand does."""
        self.slider(knob).scroll_into_view_if_needed()
        box = self.slider(knob).bounding_box()
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        self.page.mouse.move(x, y)
        self.page.mouse.down()
        for k in range(1, steps + 1):
            self.page.mouse.move(x + by * k / steps, y)
            self.page.wait_for_timeout(16)
        self.page.mouse.up()

    def close(self) -> None:
        """Close the page."""
        self.context.close()
