"""Command ``python -m twin.show``: what a YAML file is, which command reads it, and its keys with their defaults."""

from __future__ import annotations

if __name__ == "__main__":
    from scenes.yaml.interrupt import end_quietly

    end_quietly()

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from scenes.yaml.standard_output import Terminal, print_json, to_stdout
from twin.framework import cli

if TYPE_CHECKING:
    from scenes.yaml.named import FileKind

app = cli.program()

_LONGEST = 40
"""Characters of a value in the terminal; --json has the whole value."""


def described(data: Mapping[str, Any], kind: FileKind) -> list[dict[str, Any]]:
    """Return the keys at the top of a file of a kind: those that it has, in its order, then the others with defaults.

    Parameters
    ----------
    data : mapping
        Content of the file.
    kind : FileKind
        Its kind.

    Returns
    -------
    list of dict
        ``key``, ``value``, ``set`` (whether the file has the key), and ``meaning``.
    """
    from scenes.schema import json_schema

    schema = json_schema(kind.name)
    keys, required = schema["properties"], schema.get("required", ())
    rows = []
    for key in (*data, *(key for key in keys if key not in data and key not in required)):
        item = keys.get(key, {})
        value = data[key] if key in data else item.get("default")
        rows.append({"key": key, "value": value, "set": key in data, "meaning": item.get("description", "")})
    return rows


def _short(value: Any) -> str:
    """Return a value as files write it, cut at ``_LONGEST`` characters; a dash for a key without a default."""
    if value is None:
        return "-"
    if isinstance(value, Mapping):
        text = ", ".join(map(str, value))
        text = f"{{{text}}}"
    else:
        text = str(value)
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 3]}..."


@app.command()
def main(
    file: Annotated[Path, typer.Argument(readable=False, help="YAML file of any kind, or the config.yaml of a run.")],
    as_json: cli.AsJson = False,
) -> None:
    """Show what a YAML file is: its kind, the command that reads it, the keys that it sets, and the defaults of others.

        python -m twin.show scenes/examples/perturb.yaml

    Nothing is computed and nothing is written. [Every key](docs/keys.md) has units and limits, also of the keys below
    those at the top of a file.

    Exit codes: 0 success, 2 it is not a file of the twin.
    """
    errors = Console(stderr=True)
    with cli.explained(errors):
        from scenes.specs.file_kinds import content_of, file_kinds, kinds_of
        from scenes.yaml.errors import InputError, Issue
        from scenes.yaml.yaml_file import read_yaml

        data = read_yaml(file).data
        kinds = kinds_of(data)
        if len(kinds) != 1:
            allowed = ", ".join(kind.what for kind in kinds or file_kinds())
            raise InputError(Issue("it is not clear what kind of file this is", str(file), allowed=allowed))
        (kind,) = kinds
        rows = described(content_of(data), kind)
    reads = f"python -m {kind.command} {file}" if kind.command else ""
    with to_stdout(errors):
        if as_json:
            print_json({"file": str(file), "kind": kind.name, "what": kind.what, "command": reads, "keys": rows})
            return
        console = Terminal()
        console.print(f"{file} is {kind.what}.", highlight=False, markup=False)
        for text, value in (("run it:    ", reads), ("named by:  ", kind.place)):
            if value:
                console.print(f"{text}{value}", highlight=False, markup=False)
        from rich.table import Table

        for title, chosen in (("set in the file", True), ("defaults of the other keys", False)):
            shown = [row for row in rows if row["set"] == chosen]
            if shown:
                table = Table("key", "value", "meaning", title=title, title_justify="left", box=None, pad_edge=False)
                for row in shown:
                    table.add_row(row["key"], _short(row["value"]), row["meaning"])
                console.print(table, markup=False, highlight=False)


if __name__ == "__main__":
    app()
