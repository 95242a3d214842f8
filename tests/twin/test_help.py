"""What --help teaches: every command has an example, whose program, options and files are there."""

import re
import shlex

import pytest

from scenes.specs.file_kinds import kind_of
from scenes.yaml.yaml_file import read_yaml
from tests.twin.study_bench import ROOT
from twin.framework.console import parser
from twin.validation import registry

TAUGHT = (
    "twin.render twin.live twin.recover twin.lab twin.orbit twin.study twin.design twin.validate twin.compare"
    " twin.doctor twin.show analysis.mtf scenes.schema"
).split()
OPENED = ("job", "study")
"""Kinds of files that twin.live opens beside the commands that read them."""
MADE = "runs/"
"""Beginning of files that other examples make."""


def helps():
    """(program and subcommand, its command, the words of its help)."""
    for program in TAUGHT:
        command = parser(program)
        yield (program,), command, command.help
        for name, below in getattr(command, "commands", {}).items():
            yield (program, name), below, below.help


@pytest.mark.second
def test_the_examples_of_a_help_can_be_run() -> None:
    """Program, options and files of every example are there."""
    for name, _, text in helps():
        words = " ".join(text.split())
        examples = re.findall(r"`python -m ([^`]+)`", words) or re.findall(
            r"python -m ([\w. ]+(?: --[\w-]+| [\w./-]+)*)", words
        )
        assert any(example.startswith(" ".join(name)) for example in examples), name
        for example in examples:
            program, *rest = shlex.split(example)
            command = parser(program)
            sub = [rest.pop(0)] if getattr(command, "commands", None) else []
            target = command.commands[sub[0]] if sub else command
            known = {option for parameter in target.params for option in parameter.opts}
            assert {word for word in rest if word.startswith("--")} <= known, example
            for word in rest:
                if word.endswith((".yaml", ".tiff")) and not word.startswith(MADE):
                    kind = kind_of(read_yaml(ROOT / word).data)
                    same = kind.command == " ".join([program, *sub])
                    assert same or (program == "twin.live" and kind.name in OPENED), example
            if "--only" in rest:
                registry.select(registry.GROUPS, rest[rest.index("--only") + 1])
        for word in re.findall(r"\bscenes/(?:examples|lab|orbit|library)/[\w./-]+\w", text):
            assert (ROOT / word).exists(), word
