"""Commands run inside the test process, and what they leave in a folder."""

import re
from collections.abc import Callable, Sequence
from pathlib import Path

from typer import Typer
from typer.testing import CliRunner


def invoke(app: Typer, *arguments: object, **options: object):
    """A command: exit_code, stdout, stderr. An exception that is no exit is raised."""
    result = CliRunner().invoke(app, [str(argument) for argument in arguments], **options)
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


def files(folder: Path) -> set[str]:
    """Names of all files below a folder."""
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


def refused(run: Callable, command: str, path: Path, key: str, words: Sequence[str]) -> int:
    """A command refuses the file ``path``: exit code 2, nothing written beside the file, a message that names file,
    line and key and holds all words. Returns the line.
    """
    before = files(path.parent)
    result = run(command, path, "--out", path.parent / "run", "--json")
    assert result.exit_code == 2
    assert result.stdout == ""
    assert files(path.parent) == before
    assert not (path.parent / "run").exists()
    found = re.search(rf"{re.escape(str(path))}:(\d+): {re.escape(key)}", result.stderr)
    assert found, result.stderr
    for word in words:
        assert word in result.stderr, result.stderr
    return int(found[1])


def replaced(text: str, *changes: tuple[str, str]) -> str:
    """Return a text with texts replaced, each of which stands in it exactly once."""
    for old, new in changes:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    return text


def edited_copy(source: Path, folder: Path, *changes: tuple[str, str]) -> Path:
    """Write the text of a file into a folder, with changes."""
    path = folder / "small.yaml"
    path.write_text(replaced(source.read_text("utf-8"), *changes), "utf-8")
    return path
