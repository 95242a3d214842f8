"""Runs a command on a spoilt file and says what is wrong with how it took it."""

from __future__ import annotations

import faulthandler
import gc
import os
import random
import re
import resource
import shutil
import signal
import sys
import tempfile
import threading
import time
import traceback
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any
from unittest import mock

import matplotlib.font_manager  # noqa: F401 - makes its folders at home when it is loaded, whichever case is the first
import psutil
from typer.testing import CliRunner

from optics.numerics.backend import THREADS_VARIABLE
from tests.robustness.case import Case, Reached, cut
from tests.robustness.mutate import Mutant, mutate
from twin.framework.run_folder import is_run_folder

SECONDS = {"soon": 20.0, "built": 60.0, "whole": 120.0}
"""Of a processor for one file, by how far the command goes."""
PATIENCE = 5.0
"""Times as long by the wall clock, on a machine that has other work, too."""
BYTES = 3_000_000_000
"""Of address space that one file may take beyond what is there."""
DEEP = 50
"""Every so many mutants one is built in full, which takes up to ten seconds."""
REACHED = -1
"""In place of an exit code: the file was good and the command began to compute."""
TELLING = (RuntimeWarning, UserWarning, FutureWarning, SyntaxWarning)
"""Warnings that Python prints by itself."""
_SILLY = re.compile(
    r"Traceback|validation error|pydantic|Input should|<class|object at 0x|type=|Error\(|Exception|ufunc|NoneType|"
    r"ndarray|np\.|dtype|broadcast|unpack|'NoneType'|\bassert|errors\.pydantic"
)
"""Words of the program's inside, which no user can act on."""


class TooLong(BaseException):
    """The time of one file is over."""


@dataclass
class Outcome:
    """How a command took one mutant.

    Attributes:
        case, kind, number, how: which mutant.
        depth: how far the command might go: "soon", "built" or "whole".
        code: exit code, REACHED, or None for an exception.
        text: what it wrote on stderr.
        seconds: of a processor.
        wrong: what must not be, empty if all is well.
    """

    case: str
    kind: str
    number: int
    how: str
    depth: str
    code: int | None
    text: str
    seconds: float
    wrong: str

    @property
    def end(self) -> str:
        """What became of it, in a word."""
        if self.wrong:
            return "bad"
        return {REACHED: "built", 0: "ran", 2: "refused"}.get(self.code if self.code is not None else 1, "told")

    def __str__(self) -> str:
        again = f"python -m tests.robustness 1 {self.number} {self.case} --keep /tmp/mutant"
        head = f"{self.case} {self.number} ({self.how}), {self.depth}, {self.seconds:.1f} s: {self.wrong}"
        return f"{head}\n{self.text[-3000:]}\nagain: {again}"


_CHANGES = {
    *("os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.symlink", "os.link", "os.truncate", "os.chmod", "os.chown"),
    *("os.utime", "os.setxattr", "shutil.rmtree", "shutil.move", "shutil.copyfile"),
    *("tempfile.mkstemp", "tempfile.mkdtemp"),
}
_STARTS = {"subprocess.Popen", "os.system", "os.exec", "os.posix_spawn", "os.fork", "socket.connect", "socket.bind"}
_WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
_watched: list[tuple[str, bool, list[str]]] = []
"""The folder that is watched, whether programs may start, and what was seen beyond; empty while nothing is watched."""


@contextmanager
def _watching(folder: Path, starts: bool) -> Iterator[list[str]]:
    """Note every file that Python code changes outside of a folder, and every program or connection it starts."""
    _hook()
    _watched.append((os.path.realpath(folder), starts, []))
    try:
        yield _watched[-1][2]
    finally:
        _watched.clear()


@cache
def _hook() -> None:
    """Make the audit hook, once for the process: it cannot be removed."""
    sys.addaudithook(_note)


def _note(event: str, args: tuple[Any, ...]) -> None:
    if not _watched:
        return
    allowed, starts, seen = _watched[0]
    paths: tuple[Any, ...] = ()
    if event == "open":
        paths = args[:1] if args[2] & _WRITES else ()
    elif event in _CHANGES:
        paths = args[:2] if event in ("os.rename", "os.link", "os.symlink") else args[:1]
    elif event in _STARTS and not starts:
        seen.append(f"{event} {args[:2]}")
    for path in paths:
        text = "" if isinstance(path, int) else os.fsdecode(path)
        # the folder itself is made where it is, and so not at all
        if text in ("", os.devnull) or "__pycache__" in text or os.path.realpath(text) == allowed:
            continue
        if not (os.path.realpath(os.path.dirname(os.path.abspath(text))) + "/").startswith(allowed + "/"):
            seen.append(f"{event} {text}")


def mutant(case: Case, number: int) -> Mutant:
    """The mutant of that number; the same in every process."""
    return mutate(case.target, case.files[case.target], random.Random(f"{case.name} {number}"))


def depth_of(case: Case, number: int) -> str:
    """How far a command goes with the mutant of that number."""
    if case.whole and number % case.whole == case.whole - 1:
        return "whole"
    return "built" if number % DEEP == DEEP - 1 else "soon"


def write_files(case: Case, folder: Path, content: bytes | None = None) -> Path:
    """The case's files, with ``content`` in place of the target's, and things that one should not read; what the
    command is given.
    """
    for name, own in case.files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content if name == case.target and content is not None else own)
    os.mkfifo(folder / "fifo.yaml")
    (folder / "ring.yaml").symlink_to("ring.yaml")
    (folder / "folder.yaml").mkdir()
    (folder / "binary.yaml").write_bytes(bytes(range(256)))
    for name in ("out", "tmp"):
        (folder / name).mkdir()
    return folder / (case.given or next(iter(case.files)))


def arguments(case: Case, folder: Path, given: Path, number: int) -> list[str]:
    """Of the command. Every fifth run takes the default place of the run folder."""
    out = [] if not case.out or (case.out == "out/run" and number % 5 == 0) else ["--out", str(folder / case.out)]
    return [word.replace("{here}", str(folder)) for word in (*case.words, str(given), *case.options, *out)]


def listing(folder: Path) -> dict[str, float]:
    """All names below a folder, with the files' times."""
    return {str(p.relative_to(folder)): p.lstat().st_mtime_ns for p in sorted(folder.rglob("*")) if not p.is_dir()}


@contextmanager
def limited(seconds: float, room: int = BYTES, errors: int = 2) -> Iterator[None]:
    """TooLong after that time of a processor, or PATIENCE times that by the clock; MemoryError beyond the room.

    A process stuck in C code ends with all its tracebacks, on the file of that number.
    """

    def ring(number: int, frame: object) -> None:
        raise TooLong

    clocks = {signal.SIGALRM: (signal.ITIMER_REAL, PATIENCE * seconds), signal.SIGPROF: (signal.ITIMER_PROF, seconds)}
    before = {number: signal.signal(number, ring) for number in clocks}
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + room, hard))
    faulthandler.dump_traceback_later(1.5 * PATIENCE * seconds + 30, exit=True, file=errors)
    for clock, after in clocks.values():
        signal.setitimer(clock, after, 1.0)
    try:
        yield
    finally:
        for clock, _ in clocks.values():
            signal.setitimer(clock, 0.0)
        faulthandler.cancel_dump_traceback_later()
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def _stderr_into(place: Path) -> Iterator[int]:
    """Let what libraries in C write on stderr go into a file; the number of the true one."""
    true = os.dup(2)
    with place.open("wb") as file:
        os.dup2(file.fileno(), 2)
    try:
        yield true
    finally:
        os.dup2(true, 2)
        os.close(true)


def run_mutant(case: Case, number: int, root: Path, spoilt: Mutant | None = None, depth: str = "") -> Outcome:
    """One mutant in a fresh folder below ``root``, which is removed again. The current folder is that folder."""
    spoilt, depth = spoilt or mutant(case, number), depth or depth_of(case, number)
    folder = Path(tempfile.mkdtemp(dir=root, prefix=f"{case.name}-{number}-"))
    given = write_files(case, folder, spoilt.content)
    before, threads, children = listing(folder), set(threading.enumerate()), _children()
    told, raw = [], root / f"raw-{os.getpid()}"
    code, text, wrong, printed = None, "", "", ""
    old, seconds = Path.cwd(), SECONDS[depth]
    started = time.process_time()
    os.chdir(folder)
    try:
        with (
            nullcontext() if depth == "whole" else cut(soon=depth == "soon"),
            mock.patch.object(tempfile, "tempdir", str(folder / "tmp")),
            # one core is no reason for a second process
            mock.patch.dict(
                os.environ, {THREADS_VARIABLE: "1", "TMPDIR": str(folder / "tmp"), "TWIN_CALIBRATIONS": "off"}
            ),
            _stderr_into(raw) as errors,
            warnings.catch_warnings(record=True) as told,
            _watching(folder, case.starts and depth == "whole") as seen,
            limited(seconds, errors=errors),
        ):
            warnings.simplefilter("always")
            try:
                result = CliRunner().invoke(case.app, arguments(case, folder, given, number))
            except Reached:
                code = REACHED
            else:
                code, text, printed = result.exit_code, result.stderr, result.stdout
                error = result.exception
                if error is not None and not isinstance(error, SystemExit):
                    code = None
                    text = "".join(traceback.format_exception(error))
                    wrong = f"raised {type(error).__name__}: {str(error)[:200]}"
                    del error
                del result
    except TooLong:
        code, wrong, text = None, f"took more than {seconds:g} s", traceback.format_exc()
    finally:
        os.chdir(old)
    spent = time.process_time() - started
    wrong = wrong or _judged(case, code, text, printed, folder, spoilt)
    wrong = wrong or _said(told, raw) or _left(case, code, folder, before)
    if not wrong and seen:
        wrong = f"reached beyond its folder: {seen[:3]}"
    if not wrong and depth == "whole":
        wrong = _running(threads, children, case)
    shutil.rmtree(folder)
    shown = text.replace(str(folder), "DIR")
    return Outcome(case.name, case.kind, number, spoilt.how, depth, code, shown, spent, wrong)


def _judged(case: Case, code: int | None, text: str, printed: str, folder: Path, spoilt: Mutant) -> str:
    """What is wrong with an end."""
    if code == REACHED:
        return ""
    if any((ord(c) < 32 and c not in "\n\t") or 0x7F <= ord(c) < 0xA0 for c in printed + text):
        return "control characters in what it printed"
    complete = case.out != "out/run" or any(map(is_run_folder, (folder / "out/run", *folder.glob("runs/*"))))
    if code != 2 and "error: " not in text:
        # a comparison, and a check of conventions, answer by their exit codes
        answers = (0, 1, 3, 4) if case.words[:1] == ("check",) or "compare" in case.name else (0,)
        if code not in answers:
            return f"exit code {code} without a word"
        return "" if complete else "no run folder"
    if code not in (1, 2):
        return f"exit code {code} with an error"
    body = text[text.find("error: ") :].removeprefix("error: ") if "error: " in text else ""
    if not body:
        return "no error message"
    silly = _SILLY.search(body.replace(str(folder), ""))
    if silly:
        return f"speaks of {silly[0]!r}"
    first = body.split("\n")[0]
    if code == 2 and str(folder) not in body and not re.search("/etc/passwd|/proc/|/dev/", first):
        return "names no file of the user's"
    if len(first) > 6000:  # all nodes of an instrument, or a path of thousands of letters
        return f"a line of {len(first)} characters"
    lines = max(len(re.split(rb"\r\n|[\r\n\x85]|\xe2\x80[\xa8\xa9]", spoilt.content)), 1)
    for number in re.findall(re.escape(str(folder / case.target)) + r":(\d+):", body):
        if b"\0" not in spoilt.content and not 1 <= int(number) <= lines + 1:
            return f"names line {number} of {lines}"
    return ""


def _said(told: list[warnings.WarningMessage], raw: Path) -> str:
    """Warnings of Python, and what libraries in C wrote, that the user gets to see as they are."""
    for one in told:
        if issubclass(one.category, TELLING):
            return f"prints {one.category.__name__}: {str(one.message)[:150]} ({one.filename}:{one.lineno})"
    written = raw.read_bytes()
    return f"a library writes {written[:200]!r}" if written.strip() else ""


def _left(case: Case, code: int | None, folder: Path, before: dict[str, float]) -> str:
    """Files that should not be there, or are still open."""
    # a command that was cut leaves what it would have removed
    results = (
        *case.changes,
        *(() if code == 2 else ("out/", "runs/", "tmp/") if code == REACHED else ("out/", "runs/")),
    )
    left = listing(folder)
    kept = {name: at for name, at in left.items() if not name.startswith(results)} if results else left
    was = {name: at for name, at in before.items() if not name.startswith(results)} if results else before
    if kept != was:
        return f"left files: {sorted({name for name, _ in set(kept.items()) ^ set(was.items())})[:5]}"
    for name in left:
        if (
            re.search(r"\.partial$|\.old$|\.part$|(^|/)\.[^/]*-[0-9a-f]{6,}", name)
            and name not in before
            and code != REACHED
        ):
            return f"left half a file: {name}"
    if _open(folder):
        gc.collect()
        if still := _open(folder):
            return f"still open: {still[:3]}"
    return ""


def _open(folder: Path) -> list[str]:
    return [one.path for one in psutil.Process().open_files() if one.path.startswith(str(folder))]


def _children() -> dict[int, str]:
    """Processes that this one has started and that have not ended, by number."""
    return {one.pid: one.name() for one in psutil.Process().children() if one.status() != psutil.STATUS_ZOMBIE}


def _running(threads: set[threading.Thread], before: dict[int, str], case: Case) -> str:
    """Processes and threads that the case started and that go on; others' of the same process do not count."""
    until = time.monotonic() + (10.0 if case.starts else 2.0)
    while True:
        children = [name for number, name in _children().items() if number not in before]
        # a scheduler's threads and Python's own keeper of shared memory serve the next study, too
        others = [one.name for one in set(threading.enumerate()) - threads if not case.starts and not one.daemon]
        if case.starts:
            children = []
        if not children and not others:
            return ""
        if time.monotonic() > until:
            return f"still running: {children}{others}"
        time.sleep(0.1)
