"""What is fuzzed: every command that reads YAML, with the files of the library and of the golden runs' small jobs that
it can read as one's own, their tables and images, and files of other programs. cases.yaml lists them; `file_cases`
makes what no text can be, `run_cases` has run folders.

Commands run as they are up to where they have read, checked, resolved and built everything; there most of them end, by
`Reached`, and some go on to their reports.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from operator import attrgetter
from pathlib import Path
from typing import Any

import typer
import yaml

from scenes.specs.load import SCENES
from tests.robustness.case import JOBS, Case, file_of
from tests.robustness.file_cases import MADE, pass_cases
from twin.framework.console import PROGRAMS

DEFAULT = {"out": "out/run", "weight": 1.0, "whole": 0, "starts": False}


def app_of(program: str) -> typer.Typer:
    """Return the command of a program."""
    module = importlib.import_module(PROGRAMS[program][0])
    return (importlib.import_module(f"{module.__name__}.__main__") if hasattr(module, "__path__") else module).app


def cases(bases: Path | None = None) -> dict[str, Case]:
    """Return all cases by name.

    Args:
        bases: folder with the run folders that commands read, which are made there if they are not; None leaves out
            their cases.
    """
    from tests.robustness.run_cases import run_cases

    every = (*_listed(), *pass_cases(app_of("orbit")), *(run_cases(bases, app_of) if bases is not None else ()))
    return {case.name: case for case in every}


def _content(told: Any) -> bytes:
    """Return the content of a file as cases.yaml describes it."""
    if isinstance(told, str):
        return told.encode() if "\n" in told else file_of(told)
    if "made" in told:
        return MADE[told["made"]]()
    if "config" in told:
        module, _, name = told["config"].partition(":")
        place = (SCENES if "/" in told["of"] else JOBS) / told["of"]
        return bytes(attrgetter(name)(importlib.import_module(module))(place).to_yaml().encode())
    return file_of(told["of"], *told.get("edits", {}).items()) + told.get("more", "").encode()


def _listed() -> Iterator[Case]:
    table = yaml.load(Path(__file__).with_name("cases.yaml").read_bytes(), yaml.CSafeLoader)
    for name, told in table.items():
        program, *words = told["command"].split()
        named = told["files"]
        named = named if isinstance(named, dict) else {Path(one).name: one for one in named.split()}
        files = {file: _content(content) for file, content in named.items()}
        more = {key: told.get(key, value) for key, value in DEFAULT.items()}
        more["options"] = tuple(told.get("options", "").split())
        kinds = told["kind"] if isinstance(told["kind"], dict) else {next(iter(files)): told["kind"]}
        for target, kind in kinds.items():
            own = name if len(kinds) == 1 else f"{name}-{Path(target).stem}"
            yield Case(own, kind, app_of(program), tuple(words), files, target, **more)
