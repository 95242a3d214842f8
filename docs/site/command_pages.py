"""Page of the commands: every program, its arguments and options, generated from its parser."""

from __future__ import annotations

import ast
import inspect
from functools import cache
from itertools import groupby
from pathlib import Path
from textwrap import dedent
from typing import Any

from docs.site.markdown import anchor, code, prose, sentence, table
from docs.site.spec_keys import bound_text
from twin.framework.console import parser

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("twin", "analysis", "scenes", "optics")
FIRST = ("twin.render", "twin.recover", "twin.lab", "twin.orbit", "twin.study", "twin.design")
"""Programs listed first; the others follow by name."""
NOT_FOR_USERS = {"twin.framework.doctor_probe": "the doctor's own helper"}
"""Modules that can be run but are not commands, with the reason."""


@cache
def programs() -> tuple[str, ...]:
    """Return the modules for users that can be run by ``python -m``."""
    found = []
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            if _runs(path):
                name = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__main__")
                found.append(name)
    rank = {name: k for k, name in enumerate(FIRST)}
    return tuple(sorted((n for n in found if n not in NOT_FOR_USERS), key=lambda n: (rank.get(n, len(rank)), n)))


def _runs(path: Path) -> bool:
    """Return True if a file, run as a program, starts one at its end."""
    text = path.read_text("utf-8")
    last = ast.parse(text).body[-1:] if '__name__ == "__main__"' in text else []
    return any(isinstance(node, ast.If) and ast.unparse(node.test) == "__name__ == '__main__'" for node in last)


def commands(program: str) -> dict[str, Any]:
    """Return all subcommands of a program by the words that call them."""
    command = parser(program)
    below = getattr(command, "commands", None)
    return {f"{program} {name}": one for name, one in below.items()} if below else {program: command}


def command_page() -> str:
    """Return the page in Markdown."""
    introduction = """# Commands

Each is `.venv/bin/python -m NAME` (an environment of your own: `python -m NAME`), or `camtwin` with the last part of
the name, `camtwin render`, and has a `--help` with the same text as this page. All that make a run folder share
`--out`, `--seed`, `--backend`, `--force`, `--json` and `--quiet`;
[the next page](run_folders/index.md) describes the folders. Exit codes: 0 success, 2 bad input (one line for
each fault with file, line and key; nothing is written), 1 anything else, 130 interrupted.
"""
    return "\n".join([introduction, *map(_program, programs())])


def _program(program: str) -> str:
    """Return the section of a program."""
    group, below = parser(program), commands(program)
    if program in below:
        return f"## {code(program)}\n\n{_command(program, group)}"
    parts = [f"## {code(program)}\n\n{help_text(group)}"]
    return "\n".join([*parts, *(f"### {code(words)}\n\n{_command(words, one)}" for words, one in below.items())])


def help_text(command: Any) -> str:
    """Return the text of ``--help`` above the options; its indented lines are shown verbatim."""
    text = inspect.cleandoc(command.help or "").replace("\b", "").replace("\f", "")
    out: list[str] = []
    for indented, blocks in groupby(text.split("\n\n"), lambda block: block.startswith(" ")):
        if indented:
            out.append(f"```text\n{dedent(chr(10).join(blocks)).strip()}\n```")
        else:
            out += [prose(" ".join(block.split())) for block in blocks]
    return "\n\n".join(out) + "\n"


def _command(words: str, command: Any) -> str:
    """Return usage, help and options of a command."""
    arguments = [p for p in command.params if not p.opts[0].startswith("-")]
    usage = " ".join(["python -m", words, *(p.name.upper() for p in arguments), "[OPTIONS]"])
    rows = [_row(words, p) for p in command.params]
    options = table(["Option", "Takes", "Default", "Meaning"], rows, "options")
    return f"```text\n{usage}\n```\n\n{help_text(command)}\n{options}"


def _row(words: str, param: Any) -> list[str]:
    """Return the table row of an option or argument."""
    is_option = param.opts[0].startswith("-")
    names = [*param.opts, *param.secondary_opts] if is_option else [param.name.upper()]
    shown = ", ".join(map(code, names))
    place = f"{words} {names[0]}".replace(".", "-")
    default = "must be given" if param.required else "" if param.default in (None, False) else code(str(param.default))
    return [f"{anchor(place)}{shown}", _takes(param), default, prose(sentence(param.help or ""))]


def _takes(param: Any) -> str:
    """Return the type and limits of a parameter as text."""
    if getattr(param, "is_flag", False):
        return "nothing"
    sort = getattr(param.type_descriptor, "annotation", str)
    known = {int: "whole number", float: "number", str: "text", Path: "path"}
    what = known.get(sort, getattr(sort, "__name__", str(sort)))
    limits = (("at least", getattr(param, "min", None)), ("at most", getattr(param, "max", None)))
    bounds = [f"{words} {bound_text(value)}" for words, value in limits if value is not None]
    return "; ".join((what, *bounds))
