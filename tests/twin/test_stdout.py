"""Results that cannot be written: a full disk is one sentence and exit code 1, a reader that has gone no word."""

import io
import os
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import pytest
import typer
from rich.console import Console

from scenes.yaml.standard_output import Terminal, print_json, to_stdout
from tests.twin.study_bench import ROOT
from twin.framework.durable import exit_on_terminate

FULL = "/dev/full"
SCHEMA = ("scenes.schema", "--out", "{tmp}/schemas")
LAB = ("twin.lab", "distortion", "scenes/lab/distortion.yaml", "--out", "{tmp}/run")
COMMANDS = [(*LAB, "--json"), SCHEMA]


@contextmanager
def closed_pipe():
    """The end to write to of a pipe that nobody reads."""
    read, write = os.pipe()
    os.close(read)
    with open(write, "wb") as file:
        yield file


def run(words, tmp_path, stdout) -> tuple[int, str]:
    """Exit code and stderr, without lines of progress, which come when the machine is slow."""
    words = [word.format(tmp=tmp_path) for word in words]
    done = subprocess.run(
        [sys.executable, "-m", *words], cwd=ROOT, stdout=stdout, stderr=subprocess.PIPE, text=True, timeout=300
    )
    errors = [line for line in done.stderr.splitlines(keepends=True) if not line.startswith("progress: ")]
    return done.returncode, "".join(errors)


@pytest.mark.second
@pytest.mark.parametrize("words", COMMANDS)
def test_a_full_disk(words, tmp_path) -> None:
    with open(FULL, "w") as full:
        code, errors = run(words, tmp_path, full)
    assert code == 1
    assert errors.startswith("error: cannot write to the standard output: No space left on device")
    assert len(errors.splitlines()) == 1, errors
    if "{tmp}/run" in words:
        assert f"complete in {tmp_path / 'run'}" in errors
        assert (tmp_path / "run" / "manifest.json").exists()


@pytest.mark.second
@pytest.mark.parametrize("words", COMMANDS)
def test_a_reader_that_has_gone(words, tmp_path) -> None:
    with closed_pipe() as pipe:
        code, errors = run(words, tmp_path, pipe)
    assert (code, errors) == (128 + signal.SIGPIPE, "")


@pytest.fixture(params=["json", "table", "much"])
def printed(request):
    """Something to print."""
    much = {"x": ["0123456789" * 10] * 10_000}
    return {
        "json": lambda: print_json({"x": 1.5}),
        "table": lambda: Terminal().print("a line"),
        "much": lambda: print_json(much),
    }[request.param]


def outcome(printed, stdout, monkeypatch) -> tuple[int, str]:
    """Exit code and message when ``printed`` goes to a file."""
    said = io.StringIO()
    with open(os.dup(stdout.fileno()), "w") as file:
        monkeypatch.setattr(sys, "stdout", file)
        with pytest.raises(typer.Exit) as left, to_stdout(Console(file=said, width=200), "kept in run"):
            printed()
        file.flush()  # what the interpreter does at its end says nothing more
    return left.value.exit_code, said.getvalue()


def test_a_full_disk_in_process(printed, monkeypatch) -> None:
    with open(FULL, "w") as full:
        code, text = outcome(printed, full, monkeypatch)
    assert code == 1
    assert text == "error: cannot write to the standard output: No space left on device; kept in run\n"


def test_a_reader_that_has_gone_in_process(printed, monkeypatch) -> None:
    with closed_pipe() as pipe:
        assert outcome(printed, pipe, monkeypatch) == (128 + signal.SIGPIPE, "")


@pytest.mark.parametrize(
    ("number", "kind"), [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, SystemExit), (signal.SIGHUP, SystemExit)]
)
def test_a_signal_ends_the_program_whatever_becomes_of_its_exception(number, kind) -> None:
    """Compiled modules raise errors of their own in its place, and clearing up can fail after it."""

    def work() -> None:
        with exit_on_terminate():
            try:
                signal.raise_signal(number)
            except BaseException as error:
                raise ImportError("a module could not be initialised") from error

    with pytest.raises(kind) as left:
        work()
    assert getattr(left.value, "code", 128 + number) == 128 + number


def test_signals_leave_in_order_and_where_they_are_meant() -> None:
    """Also when the signal comes again while the block clears up; not under nohup, and not from another thread."""
    cleared = []

    def work(number: int) -> bool:
        with exit_on_terminate():
            try:
                signal.raise_signal(number)
            finally:
                signal.raise_signal(number)
                cleared.append(number)
        return True

    for number in (signal.SIGTERM, signal.SIGHUP):
        before = signal.getsignal(number)
        with pytest.raises(SystemExit) as left:
            work(number)
        assert (left.value.code, cleared.pop(), signal.getsignal(number)) == (128 + number, number, before)
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        assert work(signal.SIGHUP)
        with ThreadPoolExecutor(1) as pool:
            assert pool.submit(work, signal.SIGHUP).result(10.0)
    finally:
        signal.signal(signal.SIGHUP, before)
