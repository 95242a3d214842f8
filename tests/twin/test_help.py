"""What --help teaches: every command has an example, whose program, options and files are there."""

import importlib
import re
import shlex

import pytest
import typer
from typer.testing import CliRunner

from scenes.kinds.file_kinds import kind_of
from scenes.yaml.yaml_file import read_yaml
from tests.twin.study_bench import ROOT
from twin.validation.registry import GROUPS, select

PROGRAMS = (
    "twin.render",
    "twin.live",
    "twin.recover",
    "twin.lab",
    "twin.orbit",
    "twin.study",
    "twin.design",
    "twin.validate",
    "twin.compare",
    "analysis.mtf",
)
FUNCTIONS = ("twin.doctor", "scenes.schema")
"""Programs of one function."""
OPENED = ("job", "study")
"""Kinds of files that twin.live opens beside the commands that read them."""
MADE = "runs/"
"""Beginning of files that other examples make."""


def app_of(program: str) -> typer.Typer:
    if program in FUNCTIONS:
        app = typer.Typer()
        app.command()(importlib.import_module(program).main)
        return app
    module = importlib.import_module(program)
    if hasattr(module, "__path__"):  # a package
        module = importlib.import_module(f"{program}.__main__")
    return module.app


def command_of(program: str):
    """The command line interface of a program."""
    return typer.main.get_command(app_of(program))


def helps():
    """(program and subcommand, its command, the words of its help)."""
    for program in (*PROGRAMS, *FUNCTIONS):
        command = command_of(program)
        yield (program,), command, command.help
        for name, below in getattr(command, "commands", {}).items():
            yield (program, name), below, below.help


HELPS = list(helps())


@pytest.mark.parametrize(("name", "command", "text"), HELPS, ids=[" ".join(name) for name, _, _ in HELPS])
def test_the_examples_of_a_help_can_be_run(name, command, text) -> None:
    assert "Usage" in CliRunner().invoke(app_of(name[0]), [*name[1:], "--help"]).stdout
    text = " ".join(text.split())
    examples = re.findall(r"`python -m ([^`]+)`", text) or re.findall(
        r"python -m ([\w. ]+(?: --[\w-]+| [\w./-]+)*)", text
    )
    assert examples, "no example"
    assert any(example.startswith(" ".join(name)) for example in examples)
    assert "Exit code" in text or len(name) > 1 or name == ("scenes.schema",)
    for example in examples:
        program, *words = shlex.split(example)
        assert program in (*PROGRAMS, *FUNCTIONS)
        command = command_of(program)
        sub = [words.pop(0)] if getattr(command, "commands", None) else []
        target = command.commands[sub[0]] if sub else command
        known = {option for parameter in target.params for option in parameter.opts}
        assert {word for word in words if word.startswith("--")} <= known
        for word in words:
            if word.endswith((".yaml", ".tiff")) and not word.startswith(MADE):
                kind = kind_of(read_yaml(ROOT / word).data)
                assert kind is not None
                assert kind.command == " ".join([program, *sub]) or (program == "twin.live" and kind.name in OPENED)
        if "--only" in words:
            select(GROUPS, words[words.index("--only") + 1])


def test_files_that_are_named_are_there() -> None:
    named = {
        word for *_, text in HELPS for word in re.findall(r"\bscenes/(?:examples|lab|orbit|library)/[\w./-]+\w", text)
    }
    assert len(named) > 10
    assert [word for word in named if not (ROOT / word).exists()] == []
