"""How commands start: their help, and what is wrong with a file, wait for nothing that computes or draws; Ctrl-C ends
them without a traceback from the first moment on.
"""

import multiprocessing
import re
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from tests.twin.study_bench import ROOT
from twin.run.cluster import _children_deaf_to_ctrl_c
from twin.run.durable import ending_later

HEAVY = {"mitsuba", "drjit", "matplotlib", "dask", "distributed", "sklearn", "trimesh", "xarray", "pandas", "pint"}
"""What takes long to import and no file is checked with. (pint is asked for units that are not suggested.)"""
READ = (
    ("twin.render",),
    ("twin.live",),
    ("twin.recover",),
    ("twin.camera",),
    ("twin.uncertainty",),
    ("twin.study",),
    ("twin.design",),
    ("twin.lab", "focus"),
    ("twin.orbit", "angle"),
)
"""Commands that read a YAML file; all tests of a program do it in the same way."""
PROGRAMS = (
    *("twin.render", "twin.camera", "twin.lab", "twin.orbit", "twin.study", "twin.design", "twin.validate"),
    *("twin.compare", "twin.doctor", "twin.uncertainty", "twin.live", "twin.recover"),
    *("scenes.lens", "scenes.schema", "analysis.mtf"),
)
BAD = "seed: 1\nno_such_key: [2 arcsec, 3 um, 20 degC]\n"


def run(*words: object, **options) -> subprocess.CompletedProcess:
    command = [sys.executable, *map(str, words)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, **options)


def heavy(words: tuple) -> tuple[int, set[str]]:
    """Exit code of a command, and what it imported of HEAVY."""
    done = run("-X", "importtime", "-m", *words)
    names = set(re.findall(r"^import time:.*\| +([\w.]+)$", done.stderr, re.M))
    assert len(names) > 100
    return done.returncode, {name.split(".")[0] for name in names} & HEAVY


@pytest.mark.second
@pytest.mark.parametrize("program", PROGRAMS)
def test_help_imports_nothing_that_computes(program: str) -> None:
    assert heavy((program, "--help")) == (0, set())


@pytest.mark.second
@pytest.mark.parametrize("words", READ, ids=" ".join)
def test_a_bad_file_is_told_before_anything_that_computes_is_imported(words: tuple, tmp_path: Path) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(BAD, "utf-8")
    assert heavy((*words, path)) == (2, set())


@pytest.mark.second
def test_a_wrong_option_of_the_mtf_is_told_before_anything_is_drawn() -> None:
    assert heavy(("analysis.mtf", "none.png", "--roi", "0,0,64,64", "--pitch", "7 um")) == (2, set())


@pytest.mark.second
@pytest.mark.parametrize("program", PROGRAMS)
def test_ctrl_c_during_imports_leaves_no_traceback(program: str, tmp_path: Path) -> None:
    """One module stands for all: while it is imported, the signal comes."""
    (tmp_path / "typer.py").write_text(
        "import os, signal, time\nos.kill(os.getpid(), signal.SIGINT)\ntime.sleep(60)\n", "utf-8"
    )
    done = run("-m", program, "--help", env={"PYTHONPATH": str(tmp_path), "PATH": "/usr/bin:/bin"})
    assert done.returncode in (130, -2)  # by the signal, which a shell shows as 130
    assert done.stderr == "interrupted\n"


def hears() -> None:
    """In a process of its own: exit code 1 where SIGINT reaches it, else 0."""
    sys.exit(signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, ()))


def exit_code_of_a_worker() -> int:
    """Started by a thread, as Dask starts its workers."""
    codes = []

    def start() -> None:
        process = multiprocessing.get_context("spawn").Process(target=hears)
        process.start()
        process.join(60)
        codes.append(process.exitcode)

    thread = threading.Thread(target=start)
    thread.start()
    thread.join()
    return codes[0]


@pytest.mark.second
def test_workers_leave_ctrl_c_to_their_command() -> None:
    with _children_deaf_to_ctrl_c():
        assert exit_code_of_a_worker() == 0
    assert exit_code_of_a_worker() == 1


def test_a_signal_waits_for_the_end_of_what_cannot_be_broken_off() -> None:
    done = []

    def work() -> None:
        with ending_later():
            signal.raise_signal(signal.SIGINT)
            done.append(True)

    with pytest.raises(KeyboardInterrupt):
        work()
    assert done
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
