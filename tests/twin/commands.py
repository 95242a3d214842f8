"""Commands run inside the test process, and what they leave in a folder."""

from pathlib import Path

from typer import Typer
from typer.testing import CliRunner


def invoke(app: Typer, *arguments: object):
    """A command: exit_code, stdout, stderr. An exception that is no exit is raised."""
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


def files(folder: Path) -> set[str]:
    """Names of all files below a folder."""
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
