"""Commands that are started in a folder with a numpy.py, an optics.py, a random.py run none of them.

Neither do their second process and their workers: tests/test_wheel.py, in such a folder.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from docs.site.command_pages import commands, programs
from tests.tiers import quick
from twin.framework.console import COMPLETE, PROGRAMS

ROOT = Path(__file__).resolve().parents[1]
CONSOLE = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["scripts"]["camtwin"]
OURS = ("optics", "scenes", "twin", "analysis")


def folder_of_traps(place: Path, *spared: str) -> Path:
    """A folder with a module of every name that a command could import; each says that it was run, and fails."""
    names = {*sys.stdlib_module_names, *OURS, "numpy", "typer", "rich", "pydantic", "drjit", "matplotlib", "dask"}
    for name in names - {*spared}:
        text = f"open({str(place / 'hit')!r}, 'a').write({name!r} + '\\n')\nraise ImportError({name!r})\n"
        (place / f"{name}.py").write_text(text, "utf-8")
    return place


def started(place: Path, *words: str, here: str = "") -> subprocess.CompletedProcess[str]:
    """Python with these words in a folder; this checkout's packages are on its path, as installed ones are."""
    # after it comes what measures which lines a test runs, where something does
    paths = [str(ROOT), *filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    environment.pop("PYTHONSAFEPATH", None)
    return subprocess.run([sys.executable, *words], cwd=here or place, env=environment, capture_output=True, text=True)


def console(place: Path) -> str:
    """The script that pip makes of the entry point, in a folder of its own."""
    module, _, name = CONSOLE.partition(":")
    script = place / "bin" / "camtwin"
    script.parent.mkdir(exist_ok=True)
    script.write_text(f"import sys\nfrom {module} import {name}\nsys.exit({name}())\n", "utf-8")
    return str(script)


def hits(place: Path) -> str:
    return (place / "hit").read_text("utf-8") if (place / "hit").exists() else ""


@pytest.mark.second
@pytest.mark.parametrize("module", quick(1, ["twin.render", "scenes.lens", "analysis.mtf"]))
def test_a_module_runs_nothing_of_the_folder_where_it_is_started(tmp_path, module):
    """One of the program's own name cannot be helped: Python looks for that there before this program is found."""
    place = folder_of_traps(tmp_path, module.partition(".")[0])
    done = started(place, "-m", module, "--help")
    assert (done.returncode, hits(place)) == (0, ""), done.stderr
    assert "Usage" in done.stdout


def test_the_console_command_runs_nothing_of_it_either(tmp_path):
    place = folder_of_traps(tmp_path)
    done = started(place, console(place), "doctor", "--help")
    assert (done.returncode, hits(place)) == (0, ""), done.stderr
    assert "Usage" in done.stdout


def test_the_traps_work(tmp_path):
    place = folder_of_traps(tmp_path)
    assert started(place, "-c", "import numpy").returncode == 1
    assert hits(place) == "numpy\n"


def test_a_checkout_is_taken_where_it_is(tmp_path):
    """From its root, whatever else is installed; its child processes likewise."""
    (tmp_path / "twin").mkdir()
    text = (ROOT / "twin/__init__.py").read_text("utf-8")
    (tmp_path / "twin/__init__.py").write_text(text, "utf-8")
    (tmp_path / "twin/where.py").write_text("import os, sys\nprint(sys.path[0], os.environ.get('PYTHONSAFEPATH'))\n")
    assert started(tmp_path, "-m", "twin.where").stdout.split() == [str(tmp_path), "None"]


def test_programs_of_others_keep_their_folder(tmp_path):
    """A script or a module of a user that imports the twin finds its neighbours, as ever."""
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/__init__.py").write_text("import twin, scenes, analysis\n")
    (tmp_path / "mine/run.py").write_text("import neighbour\n")
    (tmp_path / "neighbour.py").write_text("print('found')\n")
    assert started(tmp_path, "-m", "mine.run").stdout == "found\n"
    (tmp_path / "script.py").write_text("import twin\nimport neighbour\n")
    assert started(tmp_path, "script.py").stdout == "found\n"


def test_the_console_command_knows_every_program(tmp_path):
    modules = [module for module, _ in PROGRAMS.values()]
    assert sorted(modules) == sorted(programs())
    for module, line in PROGRAMS.values():
        assert [name for name in commands(module) if len(commands(module)) > 2 and name.split()[-1] not in line] == []
    script = console(tmp_path)
    listed = started(tmp_path, script, "--help")
    told = " ".join(listed.stdout.split())  # long ones take two lines
    assert all(f" {name} {line} " in f"{told} " for name, (_, line) in PROGRAMS.items())
    assert started(tmp_path, script).returncode == 2
    wrong = started(tmp_path, script, "rendre")
    assert wrong.returncode == 2
    assert "Did you mean 'render'" in wrong.stderr
    assert started(tmp_path, script, "--version").stdout.endswith(f" from {ROOT}\n")


@pytest.mark.second
def test_the_console_command_lists_without_importing_what_it_lists(tmp_path):
    done = started(tmp_path, "-X", "importtime", console(tmp_path), "--help")
    found = set(re.findall(r"\| +([\w.]+)$", done.stderr, re.M))
    assert "typer" in found
    assert not {"numpy", "pydantic", "rich", "optics", "scenes", *(module for module, _ in PROGRAMS.values())} & found


@pytest.mark.second
@pytest.mark.parametrize(
    ("typed", "offered"), quick(1, [("or", {"orbit"}), ("lab f", {"focus"}), ("mtf --pitc", {"--pitch"})])
)
def test_shells_are_offered_programs_subcommands_and_options(tmp_path, monkeypatch, typed, offered):
    words = ["camtwin", *typed.split(" ")]
    for name, value in ((COMPLETE, "complete_bash"), ("COMP_WORDS", " ".join(words)), ("COMP_CWORD", len(words) - 1)):
        monkeypatch.setenv(name, str(value))
    assert set(started(tmp_path, console(tmp_path)).stdout.split()) == offered
    monkeypatch.delenv(COMPLETE)
    # Typer looks for a shell among the ancestors, which a test in the background has none of
    monkeypatch.setenv("_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION", "1")
    assert COMPLETE in started(tmp_path, console(tmp_path), "--show-completion", "bash").stdout
