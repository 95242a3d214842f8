"""How commands start: their help, and what is wrong with a file, wait for nothing that computes or draws; Ctrl-C ends
them without a traceback from the first moment on.

Which modules are loaded is the same on every machine; how long it takes is in tests/benchmarks/start_speed.py.
"""

import json
import multiprocessing
import signal
import subprocess
import sys
import threading
from collections.abc import Iterable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from scenes.specs.file_kinds import file_kinds
from tests.tiers import quick
from tests.twin.study_bench import ROOT
from twin.framework import cluster
from twin.framework.cli import InputErrorText
from twin.framework.cluster import _children_ignore_interrupts
from twin.framework.console import PROGRAMS as ALL_PROGRAMS
from twin.framework.durable import ending_later

HEAVY = set(
    "cv2 dask distributed drjit erfa h5netcdf h5py jinja2 matplotlib mitsuba networkx pandas pint pyproj scipy skfem"
    " sklearn sqlalchemy tifffile trimesh xarray".split()
)
"""What takes long to import and no file is checked with. (pint is asked for units that are not suggested.)"""
PROGRAMS = tuple(module for module, _ in ALL_PROGRAMS.values())


def run(*words: object, **options) -> subprocess.CompletedProcess:
    command = [sys.executable, *map(str, words)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, **options)


TOLD = """
import json, sys
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
{before}
print(json.dumps({{"modules": sorted(sys.modules), **globals().get("more", {{}})}}))
"""


def loaded(before: str, *words: object) -> dict[str, Any]:
    """What a process has loaded after these lines of Python.

    Args:
        before: the lines.
        words: its arguments.
    """
    done = run("-c", TOLD.format(before=before), *words)
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def packages(modules: Iterable[str]) -> set[str]:
    return {module.partition(".")[0] for module in modules}


def test_help_waits_for_nothing_that_computes_or_reads() -> None:
    """The parsers of all programs: what --help and a shell's completion need."""
    # last the schemas, whose generator is pydantic's
    names = sorted((module for module, _ in ALL_PROGRAMS.values()), key=lambda name: name == "scenes.schema")
    found = loaded(
        f"from twin.framework.console import parser\nfor name in {names}:\n"
        " more = {'pydantic': 'pydantic' in sys.modules}\n parser(name)"
    )
    assert {"typer", "twin.framework.cli", "twin.study.__main__", "analysis.mtf.__main__"} <= set(found["modules"])
    assert (packages(found["modules"]) & HEAVY, found["pydantic"]) == (set(), False)


REFUSED = """
import importlib
more = {}
for name, module, words in json.loads(sys.argv[1]):
    before = set(sys.modules)
    with redirect_stderr(StringIO()) as told, redirect_stdout(StringIO()):
        try: importlib.import_module(module).app(words)
        except SystemExit as end: code = end.code
    new = sorted({name.partition(".")[0] for name in set(sys.modules) - before})
    more[name] = [code, told.getvalue(), new]
"""


@pytest.mark.second
@pytest.mark.parametrize("command", quick(1, ["status", "ingest", "products"]))
def test_a_record_that_is_not_there_waits_for_no_database(command: str, tmp_path: Path) -> None:
    words = [command, str(tmp_path / "none"), *(["a.yaml"] if command == "ingest" else [])]
    found = loaded(REFUSED, json.dumps([("record", "twin.operate.__main__", words)]))
    code, told, new = found["record"]
    assert code == 2
    assert f"no record at {tmp_path}/none/record.sqlite; python -m twin.operate init" in told.replace("\n", " ")
    assert not set(new) & HEAVY


@pytest.mark.second
def test_a_bad_file_waits_for_nothing_that_computes(tmp_path: Path) -> None:
    """Whatever program reads it, all in one process."""
    (tmp_path / "bad.yaml").write_text("seed: 1\nno_such_key: [2 arcsec, 3 um, 20 degC]\n", "utf-8")
    commands = ("render", "live", "recover", "camera", "uncertainty", "study", "design", "lab focus", "orbit angle")
    runs = []
    for program, *sub in map(str.split, commands):
        module = f"twin.{program}" + ("" if (ROOT / f"twin/{program}.py").exists() else ".__main__")
        runs.append((program, module, [*sub, str(tmp_path / "bad.yaml")]))
    found = loaded(REFUSED, json.dumps(runs))
    for program, _, _ in runs:
        code, told, new = found[program]
        assert (code, set(new) & HEAVY) == (2, set()), (program, told)
        assert "bad.yaml:" in told


def test_import_twin_imports_nothing() -> None:
    found = loaded("import twin")["modules"]
    assert packages(found) & (HEAVY | {"numpy", "pydantic", "rich", "ruamel", "typer"}) == set()


def test_a_kind_is_told_by_keys_that_its_model_requires() -> None:
    """`FileKind.needs` is looked at before the model is imported, so it must say no more than the model does."""
    for kind in file_kinds():
        required = {name for name, item in kind.model.model_fields.items() if item.is_required()}
        assert kind.needs, kind.name
        assert set(kind.needs.split()) <= required, kind.name


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
    with _children_ignore_interrupts():
        assert exit_code_of_a_worker() == 0
    assert exit_code_of_a_worker() == 1


@pytest.mark.second
def test_a_cluster_that_cannot_be_used_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """Workers without the twin, with another one, or none; a scheduler that is gone, or cannot be reached."""
    import dask

    versions, source = cluster._program()

    def client(status: str = "running", **found: object) -> Any:
        return SimpleNamespace(
            run=lambda work, on_error: found or 1 / 0, status=status, scheduler_info=lambda n_workers: {"workers": {}}
        )

    assert cluster._differences(client(w=(versions, source))) == []
    (other,) = cluster._differences(client(w=(versions | {"numpy": "0"}, source)))
    assert other.startswith("the worker w has other package versions: numpy 0 instead of")
    monkeypatch.setattr(cluster, "WORKER_SECONDS", 0.0)
    monkeypatch.setattr(cluster, "CONNECT_SECONDS", 0.5)
    # its own settings are read at its import, and one inside of `set` would be forgotten with the certificates
    import distributed  # noqa: F401

    certificates = {f"distributed.comm.tls.{name}": "/none" for name in ("ca-file", "client.cert", "client.key")}
    for act, said in (
        (lambda: cluster._differences(client(w=ImportError("numpy"))), r"w cannot import the twin \(numpy\)"),
        (lambda: cluster._differences(client(w=(versions, "another"))), "w has other source files of the twin"),
        (lambda: cluster._differences(client()), "the workers do not answer: division"),
        (lambda: cluster.Workers(client("closed"), False).next_finished(), "the connection to the scheduler is lost"),
        (lambda: cluster._wait_for_worker(cluster.Workers(client(), False), "a", print), "a had no workers for 0 s"),
        (lambda: cluster.remote_workers("tcp://127.0.0.1:9", print).__enter__(), "9 cannot be reached"),
        (lambda: cluster._check_address("tls://127.0.0.1:9"), "the certificates configured for Dask cannot be used"),
    ):
        with dask.config.set(certificates), pytest.raises((cluster.ClusterError, InputErrorText), match=said):
            act()


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
