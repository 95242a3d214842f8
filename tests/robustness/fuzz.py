"""Runs commands on spoilt files and says what is wrong with how they took it.

One mutant again, with its files kept in a folder:

    python -m tests.robustness.fuzz --case lab-focus --number 17 --keep /tmp/mutant

Many, for longer than the tests do:

    python -m tests.robustness.fuzz --mutants 20000 --first 5000 --shards 2
"""

from __future__ import annotations

import argparse
import faulthandler
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock

import matplotlib.font_manager  # noqa: F401 - makes its folders at home when it is loaded, whichever case is the first
from typer.testing import CliRunner

from optics.numerics.threads import LIMIT
from tests.robustness.cases import Case, Reached, cases, cut
from tests.robustness.mutate import Mutant, mutate

SECONDS = 20.0
"""For one file, by the wall clock; three times as long where all is built."""
BYTES = 3_000_000_000
"""Of address space that one file may take beyond what is there."""
DEEP = 50
"""Every so many mutants one is built in full, which takes up to ten seconds."""
REACHED = -1
"""In place of an exit code: the file was good and the command began to compute."""
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
        case, number, how: which mutant.
        code: exit code, REACHED, or None for an exception.
        text: what it wrote on stderr.
        seconds: it took.
        wrong: what must not be, empty if all is well.
    """

    case: str
    number: int
    how: str
    code: int | None
    text: str
    seconds: float
    wrong: str

    def __str__(self) -> str:
        again = f"python -m tests.robustness.fuzz --case {self.case} --number {self.number} --keep /tmp/mutant"
        head = f"{self.case} {self.number} ({self.how}), {self.seconds:.1f} s: {self.wrong}"
        return f"{head}\n{self.text[-3000:]}\nagain: {again}"


class _Watch:
    """Notes every file that Python code changes outside of one folder, and every program or connection it starts.

    Audit hooks cannot be removed, so that one is made for the process and switched on where it is wanted.
    """

    allowed: str = ""
    on: bool = False
    seen: list[str]

    def __init__(self) -> None:
        self.seen = []
        self.hooked = False

    @contextmanager
    def within(self, folder: Path) -> Iterator[list[str]]:
        if not self.hooked:
            sys.addaudithook(self._hook)
            self.hooked = True
        self.allowed, self.seen, self.on = os.path.realpath(folder), [], True
        try:
            yield self.seen
        finally:
            self.on = False

    def _hook(self, event: str, args: tuple[Any, ...]) -> None:
        if not self.on:
            return
        if event == "open":
            path, _, flags = args
            writes = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
            if isinstance(path, int) or not (flags & writes):
                return
            self._note(event, path)
        elif event in _CHANGES:
            for path in args[:2] if event in ("os.rename", "os.link", "os.symlink") else args[:1]:
                if not isinstance(path, int):
                    self._note(event, path)
        elif event in _STARTS:
            self.seen.append(f"{event} {args[:2]}")

    def _note(self, event: str, path: Any) -> None:
        text = os.fsdecode(path)
        full = os.path.realpath(os.path.dirname(os.path.abspath(text)))
        if not (full + "/").startswith(self.allowed + "/") and "__pycache__" not in text and text != os.devnull:
            self.seen.append(f"{event} {text}")


_CHANGES = {
    *("os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.symlink", "os.link", "os.truncate", "os.chmod", "os.chown"),
    *(
        "os.utime",
        "os.setxattr",
        "shutil.rmtree",
        "shutil.move",
        "shutil.copyfile",
        "tempfile.mkstemp",
        "tempfile.mkdtemp",
    ),
}
_STARTS = {"subprocess.Popen", "os.system", "os.exec", "os.posix_spawn", "os.fork", "socket.connect", "socket.bind"}
_watch = _Watch()


def mutant(case: Case, number: int) -> Mutant:
    """The mutant of that number; the same in every process."""
    return mutate(case.files[case.target], random.Random(f"{case.name} {number}"))


def write_files(case: Case, folder: Path, content: bytes | None = None) -> list[Path]:
    """The case's files, with ``content`` in place of the target's, and things that one should not read."""
    paths = []
    for name, text in case.files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content if name == case.target and content is not None else text.encode())
        paths.append(path)
    os.mkfifo(folder / "fifo.yaml")
    (folder / "loop.yaml").symlink_to("loop.yaml")
    (folder / "folder.yaml").mkdir()
    (folder / "binary.yaml").write_bytes(bytes(range(256)))
    return paths


def listing(folder: Path) -> dict[str, float]:
    """All names below a folder, with the files' times."""
    return {str(p.relative_to(folder)): p.lstat().st_mtime_ns for p in sorted(folder.rglob("*")) if not p.is_dir()}


@contextmanager
def limited(seconds: float, room: int = BYTES) -> Iterator[None]:
    """TooLong after that time; MemoryError beyond the room. A process stuck in C code ends with all its tracebacks."""

    def ring(number: int, frame: object) -> None:
        raise TooLong

    before = signal.signal(signal.SIGALRM, ring)
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + room, hard))
    faulthandler.dump_traceback_later(3 * seconds + 30, exit=True, file=sys.__stderr__)
    signal.setitimer(signal.ITIMER_REAL, seconds, 1.0)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        faulthandler.cancel_dump_traceback_later()
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
        signal.signal(signal.SIGALRM, before)


def run_mutant(case: Case, number: int, root: Path, spoilt: Mutant | None = None) -> Outcome:
    """One mutant in a fresh folder below ``root``, which is removed again. The current folder is that folder."""
    spoilt = spoilt or mutant(case, number)
    folder = Path(tempfile.mkdtemp(dir=root, prefix=f"{case.name}-{number}-"))
    paths = write_files(case, folder, spoilt.content)
    before = listing(folder)
    # every fifth run takes the default place of the run folder
    out = () if number % 5 == 0 else ("--out", str(folder / "out" / "run"))
    started, code, text, wrong = time.monotonic(), None, "", ""
    old = Path.cwd()
    os.chdir(folder)
    try:
        with (
            cut(soon=number % DEEP != DEEP - 1),
            _watch.within(folder) as seen,
            # one core is no reason for a second process
            mock.patch.dict(os.environ, {LIMIT: "1"}),
            limited(3.0 * SECONDS if number % DEEP == DEEP - 1 else SECONDS),
        ):
            arguments = [*case.words, str(paths[0]), *case.options, *out]
            try:
                result = CliRunner().invoke(case.app, arguments)
            except Reached:
                code = REACHED
            else:
                code, text = result.exit_code, result.output
                error = result.exception
                if error is not None and not isinstance(error, SystemExit):
                    code = None
                    text = "".join(traceback.format_exception(error))
                    wrong = f"raised {type(error).__name__}: {str(error)[:200]}"
    except TooLong:
        code, wrong, text = None, f"took more than {SECONDS:g} s", traceback.format_exc()
    finally:
        os.chdir(old)
    seconds = time.monotonic() - started
    wrong = wrong or _judged(case, code, text, folder, paths, spoilt)
    if not wrong and seen:
        wrong = f"reached beyond its folder: {seen[:3]}"
    left = {k: v for k, v in listing(folder).items() if not (code == REACHED and k.startswith(("out/", "runs/")))}
    if not wrong and left != before:
        wrong = f"left files: {sorted(set(left) ^ set(before))[:5]}"
    shutil.rmtree(folder)
    return Outcome(case.name, number, spoilt.how, code, text.replace(str(folder), "DIR"), seconds, wrong)


def _judged(case: Case, code: int | None, text: str, folder: Path, paths: Sequence[Path], spoilt: Mutant) -> str:
    """What is wrong with a refusal."""
    if code == REACHED:
        return ""
    if code != 2:
        return f"exit code {code}"
    if not text.startswith("error: "):
        return "no error message"
    body = text.removeprefix("error: ")
    silly = _SILLY.search(body.replace(str(folder), ""))
    if silly:
        return f"speaks of {silly[0]!r}"
    if any((ord(c) < 32 and c != "\n") or 0x7F <= ord(c) < 0xA0 for c in text):
        return "control characters in the message"
    first = body.split("\n")[0]
    named = [
        p
        for p in (*paths, *(folder / n for n in ("binary.yaml", "fifo.yaml", "loop.yaml", "folder.yaml")))
        if str(p) in body
    ]
    if not named and "/etc/passwd" not in first and "/proc/" not in first and "/dev/" not in first:
        return "names no file of the user's"
    if len(first) > 6000:  # all nodes of an instrument, or a path of thousands of letters
        return f"a line of {len(first)} characters"
    target = folder / case.target
    lines = max(len(re.split(rb"\r\n|[\r\n\x85]|\xe2\x80[\xa8\xa9]", spoilt.content)), 1)
    for number in re.findall(re.escape(str(target)) + r":(\d+):", body):
        if not 1 <= int(number) <= lines + 1:
            return f"names line {number} of {lines}"
    return ""


def numbers(count: int, first: int, table: Mapping[str, Case]) -> list[tuple[str, int]]:
    """Which mutants make ``count``: spread over the cases by their weights, beginning with number ``first`` of each."""
    total = sum(case.weight for case in table.values())
    out = []
    for name, case in table.items():
        own = max(1, -(-int(1e6 * count * case.weight / total) // 1_000_000))
        out += [(name, first + k) for k in range(own)]
    return out


@dataclass
class Tally:
    """What came of many mutants."""

    codes: Counter[str] = field(default_factory=Counter)
    bad: list[Outcome] = field(default_factory=list)
    slowest: float = 0.0
    messages: Counter[str] = field(default_factory=Counter)

    @property
    def count(self) -> int:
        return sum(self.codes.values())

    def add(self, one: Outcome) -> None:
        self.codes[{REACHED: "built", 2: "refused"}.get(one.code, "bad") if one.code is not None else "bad"] += 1
        self.slowest = max(self.slowest, one.seconds)
        if one.wrong:
            self.bad.append(one)


def run_many(
    which: Sequence[tuple[str, int]],
    root: Path,
    table: Mapping[str, Case],
    say: bool = False,
    until: float | None = None,
) -> Tally:
    """Many mutants one after the other; no more are begun after ``until`` on the monotonic clock."""
    tally = Tally()
    for name, number in which:
        if until is not None and time.monotonic() > until:
            break
        one = run_mutant(table[name], number, root)
        tally.add(one)
        if say and one.wrong:
            sys.stdout.write(f"BAD {one}\n\n")
            sys.stdout.flush()
    return tally


def warm_up(root: Path, table: Mapping[str, Case]) -> Tally:
    """Every case as it is: it has to be good, and what is imported late is imported now."""
    tally = Tally()
    for case in table.values():
        one = run_mutant(case, 1, root, Mutant(case.files[case.target].encode(), "unchanged"))
        if one.code != REACHED and not one.wrong:
            one.wrong = "the unchanged file is refused"
        tally.add(one)
    return tally


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--case", help="only this case")
    parser.add_argument("--number", type=int, help="only this mutant of it")
    parser.add_argument("--keep", type=Path, help="write the mutant's files there")
    parser.add_argument("--mutants", type=int, default=500)
    parser.add_argument("--first", type=int, default=0, help="number of the first mutant of every case")
    parser.add_argument("--shards", type=int, default=1, help="processes")
    parser.add_argument("--shard", type=int, default=-1, help=argparse.SUPPRESS)
    parser.add_argument("--verbose", action="store_true", help="print every outcome")
    options = parser.parse_args()
    table = cases()
    if options.case:
        table = {options.case: table[options.case]}
    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        if options.number is not None:
            case = table[options.case]
            if options.keep:
                options.keep.mkdir(parents=True, exist_ok=True)
                write_files(case, options.keep, mutant(case, options.number).content)
            one = run_mutant(case, options.number, root)
            sys.stdout.write(f"{one}\ncode {one.code}\n")
            return bool(one.wrong)
        if options.shards > 1 and options.shard < 0:
            base = [sys.executable, "-m", "tests.robustness.fuzz", *sys.argv[1:]]
            running = [subprocess.Popen([*base, "--shard", str(k)]) for k in range(options.shards)]
            return max(process.wait() for process in running)
        which = numbers(options.mutants, options.first, table)[max(options.shard, 0) :: options.shards]
        began = time.monotonic()
        if options.verbose:
            for one in (run_mutant(table[n], k, root) for n, k in which):
                head = f"{one.case} {one.number} [{one.how}] {one.code} {one.seconds:.2f}"
                sys.stdout.write(f"{head} {one.text[:300].strip()} {one.wrong}\n")
            return 0
        tally = run_many(which, root, table, say=True)
        took = f"{tally.count} mutants in {time.monotonic() - began:.0f} s"
        sys.stdout.write(f"{took}: {dict(tally.codes)}, slowest {tally.slowest:.1f} s, {len(tally.bad)} bad\n")
        return bool(tally.bad)


if __name__ == "__main__":
    sys.exit(main())
