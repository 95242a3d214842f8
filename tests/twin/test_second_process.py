"""The second process of a command: the same results with it and without, whatever becomes of it."""

import gc
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import psutil
import pytest

import twin.framework.second_process as module
from twin.framework.second_process import SecondProcess

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(autouse=True)
def two_cores(monkeypatch) -> None:
    monkeypatch.setattr(module, "cores", lambda: 2)


def nothing() -> None:
    pass


def square(number: int, seconds: float = 0.0) -> tuple[int, int]:
    time.sleep(seconds)
    return number**2, os.getpid()


def large(number: int) -> np.ndarray:
    return np.full(200_000, float(number))


def refuse() -> None:
    raise ValueError("not this one")


def end_itself(first: int) -> int:
    if os.getpid() != first:
        os.kill(os.getpid(), signal.SIGKILL)
    return 5


def run(tasks: dict[str, Callable[[], object]], wanted: bool) -> dict[str, object]:
    with SecondProcess(nothing, wanted) as beside:
        beside.start(tasks)
        return beside.results()


def interrupted() -> None:
    with SecondProcess(nothing) as beside:
        beside.start({str(k): partial(time.sleep, 600.0) for k in range(9)})
        raise KeyboardInterrupt


def open_files() -> int:
    gc.collect()  # those of earlier processes
    return len(os.listdir("/proc/self/fd"))


def children() -> list[int]:
    """Processes below this one that have not been waited for, without those of other tests."""
    return [child.pid for child in psutil.Process().children() if child.pid not in OTHERS]


OTHERS: set[int] = set()


@pytest.fixture(autouse=True)
def _others():
    """What earlier tests of this process keep running, as Dask's resource tracker."""
    OTHERS.clear()
    OTHERS.update(child.pid for child in psutil.Process().children())


def test_it_works_while_the_first_does_not_know_all_tasks_yet() -> None:
    """Tasks that come one after the other, of which it does some before the last are known."""
    own = os.getpid()
    with SecondProcess(nothing) as beside:
        beside.start({"a": partial(square, 1), "b": partial(square, 2)}, ("b",))
        assert "a" in beside
        assert "c" not in beside
        time.sleep(0.5)
        beside.start({"c": partial(large, 3)}, ("c",))
        beside.start({})
        beside.start({"d": lambda: own})  # cannot be sent
        beside.start({str(k): partial(square, k, 0.02) for k in range(10)})
        found = beside.results()
    assert list(found) == [*"abcd", *map(str, range(10))]
    assert (found["a"][0], found["b"][0], found["c"][-1], found["d"]) == (1, 4, 3.0, own)
    assert own not in {found["a"][1], found["b"][1]}
    assert len({found[str(k)][1] for k in range(10)}) == 2


@pytest.mark.second
@pytest.mark.parametrize("wanted", [True, False])
def test_what_a_task_raises_comes_out(wanted) -> None:
    with pytest.raises(ValueError, match="not this one"):
        run({"good": partial(square, 2), "bad": refuse}, wanted)
    assert not children()


@pytest.mark.second
def test_a_process_that_dies_loses_nothing() -> None:
    with SecondProcess(nothing) as beside:
        beside.start({str(k): partial(end_itself, os.getpid()) for k in range(6)})
        time.sleep(0.3)  # it takes the first one and ends
        found = beside.results()
    assert found == {str(k): 5 for k in range(6)}


@pytest.mark.second
def test_a_process_that_hangs_is_ended(monkeypatch) -> None:
    monkeypatch.setattr(module, "PATIENCE", 0.3)
    own = os.getpid()
    with SecondProcess(nothing) as beside:
        beside.start({"a": partial(_stuck_elsewhere, own), "b": partial(_stuck_elsewhere, own)})
        time.sleep(0.3)
        assert beside.results() == {"a": own, "b": own}
    assert not children()


def _stuck_elsewhere(first: int) -> int:
    if os.getpid() != first:
        time.sleep(600.0)
    return first


def test_no_second_process_on_one_core_or_beside_other_threads(monkeypatch) -> None:
    found: list[int] = []

    def use() -> None:
        with SecondProcess(nothing) as beside:
            beside.start({"a": partial(square, 1)})
            found.append(beside.results()["a"][1])

    thread = threading.Thread(target=use)
    thread.start()
    thread.join()
    monkeypatch.setattr(module, "cores", lambda: 1)
    use()
    assert found == [os.getpid()] * 2


@pytest.mark.second
def test_nothing_is_left_behind() -> None:
    before = open_files()
    for stop in (False, True):
        with SecondProcess(nothing) as beside:
            if not stop:
                beside.start({"a": partial(square, 1)})
                beside.results()
        with pytest.raises(KeyboardInterrupt):
            interrupted()
    assert open_files() == before
    assert not children()


@pytest.mark.second
def test_it_ends_with_a_command_that_is_killed() -> None:
    """Also its copy of what the command had open, so that a reader of the output sees the end and a lock is free."""
    code = (
        "import os, time; import twin.framework.second_process as m; m.cores = lambda: 2\n"
        "with m.SecondProcess(lambda: None) as beside:\n"
        "    print(beside._child.pid, flush=True)\n"
        "    time.sleep(600)\n"
    )
    with subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, stdout=subprocess.PIPE, text=True) as command:
        assert command.stdout is not None
        child = int(command.stdout.readline())
        command.kill()
        assert command.stdout.read() == ""
    last = time.monotonic() + 20.0
    while Path(f"/proc/{child}/stat").exists() and " Z " not in Path(f"/proc/{child}/stat").read_text():
        assert time.monotonic() < last
        time.sleep(0.01)
