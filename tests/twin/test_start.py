"""How commands start: their help, and what is wrong with a file, wait for nothing that computes or draws; Ctrl-C ends
them without a traceback from the first moment on.

Which modules are loaded is the same on every machine; how long it takes is in tests/benchmarks/start_speed.py.
"""

import json
import multiprocessing
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest

from scenes.kinds.file_kinds import FILE_KINDS
from tests.tiers import quick
from tests.twin.study_bench import ROOT
from twin.run.cluster import _children_deaf_to_ctrl_c
from twin.run.console import PROGRAMS as ALL_PROGRAMS
from twin.run.durable import ending_later

DRAWS = {"matplotlib", "mitsuba", "trimesh", "xarray"}
HEAVY = {
    *(
        "cv2",
        "dask",
        "distributed",
        "drjit",
        "erfa",
        "h5netcdf",
        "h5py",
        "jinja2",
        "networkx",
        "pandas",
        "pint",
        "pyproj",
    ),
    *("scipy", "skfem", "sklearn", "sqlalchemy", "tifffile"),
    *DRAWS,
}
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
PROGRAMS = tuple(module for module, _ in ALL_PROGRAMS.values())
BAD = "seed: 1\nno_such_key: [2 arcsec, 3 um, 20 degC]\n"


def run(*words: object, **options) -> subprocess.CompletedProcess:
    command = [sys.executable, *map(str, words)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, **options)


def heavy(words: tuple, of: set[str] = HEAVY) -> tuple[int, set[str]]:
    """Exit code of a command, and what it imported of some packages."""
    done = run("-X", "importtime", "-m", *words)
    names = set(re.findall(r"^import time:.*\| +([\w.]+)$", done.stderr, re.M))
    assert len(names) > 100
    return done.returncode, {name.split(".")[0] for name in names} & of


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
        f"from twin.run.console import parser\nfor name in {names}:\n"
        " more = {'pydantic': 'pydantic' in sys.modules}\n parser(name)"
    )
    assert {"typer", "twin.run.cli", "twin.study.__main__", "analysis.mtf.__main__"} <= set(found["modules"])
    assert (packages(found["modules"]) & HEAVY, found["pydantic"]) == (set(), False)


PLACE = {"twin.live": "job", "twin.uncertainty": "job"}
"""Programs that read a kind of file which another program has for its own, and whose name is in `FILE_KINDS`."""
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


def refused(folder: Path, named: str, command: str, text: str) -> tuple[str, str, list[str]]:
    """A command and the words by which it reads a file of this text, as ``REFUSED`` takes them.

    Args:
        folder: where the file is written.
        named: the case.
        command: the program, with its subcommand.
        text: of the file.
    """
    file = folder / f"{named}.yaml"
    file.write_text(text, "utf-8")
    program, *sub = command.split()
    module = program if (ROOT / f"{program.replace('.', '/')}.py").exists() else f"{program}.__main__"
    return named, module, [*sub, str(file)]


@pytest.mark.second
def test_a_bad_file_of_every_kind_waits_for_nothing_that_computes(tmp_path: Path) -> None:
    """A key that its kind does not know, beside those by which the kind is told; whatever command reads it."""
    runs = []
    for kind in FILE_KINDS:
        keys = "".join(f"{key}: {{}}\n" for key in (*kind.needs, *kind.one_of[:1]))
        commands = [kind.command, *(program for program, read in PLACE.items() if read == kind.name)]
        # a plan and tables of readings are read into a record, see below
        for command in (one for one in commands if one and not one.startswith("twin.operate")):
            runs.append(refused(tmp_path, f"{kind.name} {command}", command, f"{keys}no_such_key: 1\n"))
    assert len(runs) > 20
    assert {f"{module.removesuffix('.__main__')}" for _, module, _ in runs} >= {
        *("twin.render", "twin.recover", "twin.camera", "twin.lab", "twin.orbit", "twin.design", "twin.study"),
        *("twin.asbuilt", "twin.tolerance", "twin.live", "twin.uncertainty"),
    }
    found = loaded(REFUSED, json.dumps(runs))
    for named, _, _ in runs:
        code, told, new = found[named]
        assert (code, set(new) & HEAVY) == (2, set()), (named, told)
        assert f"{named}.yaml:" in told
        assert "no_such_key: unknown key; found 'no_such_key'" in told


@pytest.mark.parametrize("command", quick(1, ["status", "ingest", "forecast", "report", "products"]))
def test_a_record_that_is_not_there_waits_for_no_database(command: str, tmp_path: Path) -> None:
    words = [command, str(tmp_path / "none"), *(["a.yaml"] if command == "ingest" else [])]
    found = loaded(REFUSED, json.dumps([("record", "twin.operate.__main__", words)]))
    code, told, new = found["record"]
    assert code == 2
    assert f"no record at {tmp_path}/none/record.sqlite; python -m twin.operate init" in told.replace("\n", " ")
    assert not set(new) & HEAVY


def test_an_unknown_check_waits_for_no_check() -> None:
    words = ["--only", "001.eq2,004.equation"]
    found = loaded(REFUSED, json.dumps([("check", "twin.validate", words)]))
    code, told, new = found["check"]
    assert (code, set(new) & HEAVY) == (2, set())
    assert "no check '004.equation'" in told
    # nor is YAML read
    assert not {"ruamel", "twin.validation.checks.group"} & {*packages(found["modules"]), *found["modules"]}


def test_a_bad_job_waits_for_no_other_kind_of_file(tmp_path: Path) -> None:
    """Nor is a model built that it does not need."""
    file = tmp_path / "job.yaml"
    file.write_text("instrument: gf7_pair\nno_such_key: 1\n", "utf-8")
    found = loaded(
        REFUSED + "from scenes.yaml.spec import Spec\n"
        "def below(model):\n return [model, *(one for part in model.__subclasses__() for one in below(part))]\n"
        "more['built'] = [model.__name__ for model in below(Spec) if model.__pydantic_complete__]",
        json.dumps([("job", "twin.render", [str(file)])]),
    )
    modules = set(found["modules"])
    assert "scenes.specs.job" in modules
    kinds = {kind.described.partition(":")[0] for kind in FILE_KINDS}
    assert not {name for name in modules & kinds if name.startswith(("scenes.specs.orbit", "scenes.specs.measured"))}
    assert not modules & {"scenes.specs.study", "scenes.specs.tolerance", "scenes.specs.operation"}
    assert "JobSpec" in found["built"]
    assert not {"InstrumentSpec", "CameraSpec", "DisturbancesSpec"} & set(found["built"])


def test_import_twin_imports_nothing() -> None:
    found = loaded("import twin")["modules"]
    assert packages(found) & (HEAVY | {"numpy", "pydantic", "rich", "ruamel", "typer"}) == set()


@pytest.mark.second
def test_the_main_job_imports_only_what_it_uses() -> None:
    """The first process nothing that draws, the second one neither data frames nor a scheduler; xarray brings both."""
    first = loaded("import twin.main_job.render_command, twin.main_job.render_cost")["modules"]
    assert "twin.main_job.render_folder" in first
    assert packages(first) & {*DRAWS, "dask", "distributed", "h5netcdf", "networkx", "pandas", "sqlalchemy"} == set()
    assert "scipy.stats" not in first
    second = loaded("from twin.main_job.render_drawings import load_drawing\nload_drawing()")["modules"]
    assert {"h5netcdf", "matplotlib", "trimesh"} <= packages(second)
    assert packages(second) & {"dask", "distributed", "mitsuba", "pandas", "pyarrow", "xarray"} == set()
    assert "scipy.stats" not in second


def test_a_kind_is_told_by_keys_that_its_model_requires() -> None:
    """`FileKind.needs` is looked at before the model is imported, so it must say no more than the model does."""
    for kind in FILE_KINDS:
        required = {name for name, item in kind.model.model_fields.items() if item.is_required()}
        assert kind.needs, kind.name
        assert set(kind.needs) <= required, kind.name


@pytest.mark.second
def test_a_wrong_option_of_the_mtf_is_told_before_anything_is_drawn() -> None:
    assert heavy(("analysis.mtf", "none.png", "--roi", "0,0,64,64", "--pitch", "7 um"), DRAWS) == (2, set())


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
