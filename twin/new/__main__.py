"""Command ``python -m twin.new``: commented input files for a camera, which the other commands run at once."""

from __future__ import annotations

if __name__ == "__main__":
    from scenes.yaml.interrupt import end_quietly

    end_quietly()

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from inspect import Parameter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from scenes.lens.__main__ import check_out
from scenes.lens.__main__ import new as new_camera
from scenes.yaml.standard_output import to_stdout
from twin.framework import cli

if TYPE_CHECKING:
    from scenes.yaml.errors import InputError
    from twin.new.camera_numbers import CameraNumbers

app = cli.program(no_args_is_help=True)
app.command("camera", help=(new_camera.__doc__ or "").replace("scenes.lens new", "twin.new camera"))(new_camera)


@dataclass(frozen=True)
class Question:
    """Number of a new file that an option or an answer in the terminal gives.

    Attributes
    ----------
    text : str
        What it is, for help and prompt.
    default : str
        Default as a file has it; the name of a property of `CameraNumbers` for one that follows from the camera.
    shown : str
        Where the default comes from, for help; the default itself if empty.
    """

    text: str
    default: str
    shown: str = ""


@dataclass(frozen=True)
class NewFile:
    """Kind of new file that a template beside this module writes.

    Attributes
    ----------
    about : str
        What the file is for: first sentence of the command's help.
    runs : str
        Command that reads the file; empty for a file that other files refer to.
    questions : tuple of str
        Names in `QUESTIONS`.
    """

    about: str
    runs: str
    questions: tuple[str, ...]


QUESTIONS = {
    "decentre": Question("Limit of decentres and despaces of mirrors and lenses", "10 um"),
    "tilt": Question("Limit of their tilts", "5 arcsec"),
    "figure": Question("Limit of figure errors, rms", "figure", "a hundredth of the wavelength"),
    "requirement": Question(
        "Largest rms wavefront error, in waves", "requirement", "1/14, more if the design leaves no margin"
    ),
    "compensator": Question("Body that is refocused: focal_plane, or a mirror or lens", "focal_plane"),
    "samples": Question("Number of cameras that are drawn", "200"),
    "runs": Question("Number of runs", "50"),
    "sigma": Question("Standard deviation of the interferometer's Zernike terms", "5 nm"),
    "boresight": Question("Largest change of the line of sight", "2 arcsec"),
}
NEW = {
    "job": NewFile(
        "a job: one perturbation of the camera, or of an instrument with its monitor", "render", ("decentre", "tilt")
    ),
    "tolerance": NewFile(
        "a tolerance budget with a compensator",
        "tolerance",
        ("decentre", "tilt", "figure", "requirement", "compensator", "samples"),
    ),
    "study": NewFile(
        "a study of motions within their tolerances, and the job that it varies, FILE_job.yaml",
        "study",
        ("decentre", "tilt", "requirement", "runs"),
    ),
    "asbuilt": NewFile(
        "measurements of one instrument, simulated until yours replace them",
        "asbuilt",
        ("decentre", "tilt", "figure", "requirement", "sigma"),
    ),
    "instrument": NewFile("an instrument: the camera with a monitor to begin with", "uncertainty", ()),
    "operation": NewFile(
        "a plan of operation; a camera alone gets the monitor of `twin.new instrument`",
        "operate simulate",
        ("boresight",),
    ),
}
"""Kinds of files by name, beside `camera`."""
Camera = Annotated[
    str | None,
    typer.Option(
        help="The camera or instrument: a name in the library (gf7), or the path of a file.", show_default=False
    ),
]
_FILE = "File to write, .yaml; - prints it"
"""Last question, if no option names the file."""
Out = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE.yaml", readable=False, help="The file to write. Default: standard output.", show_default=False
    ),
]
Force = Annotated[bool, typer.Option("--force", help="Replace the file if it exists.")]


@app.callback()
def main() -> None:
    """Write a commented input file for your camera, which the other commands run at once.

        python -m twin.new camera ritchey-chretien --aperture "0.4 m" --f-number 8 --out my.yaml

        python -m twin.new tolerance --camera my.yaml --out tolerance.yaml

        python -m twin.tolerance tolerance.yaml

    Defaults follow from the camera: bodies, diffraction limit, depth of focus, room for a monitor. In a terminal the
    command asks for options that are missing, the file last, and asks again where an answer is not allowed; Enter takes
    the default. Comments say what each key does and where its number comes from.

    Exit codes: 0 success, 2 bad input (nothing is written), 1 anything else.
    """


def _is_terminal() -> bool:
    """Return whether somebody can answer questions."""
    return sys.stdin.isatty() and sys.stderr.isatty()


def _ask(text: str, default: str | None, check: Callable[[str], object]) -> str:
    """Ask in the terminal until the answer passes a check, which raises InputError for what is not allowed."""
    from scenes.yaml.errors import InputError

    def checked(value: str) -> str:
        try:
            check(value)
        except InputError as error:
            raise typer.BadParameter(_reason(error)) from None
        return value

    return str(typer.prompt(text, default=default, err=True, value_proc=checked))


def _reason(error: InputError) -> str:
    """Return the first fault of an input without its place in a file that is not yet written."""
    return str(replace(error.issues[0], file="", line=None, key=())).removeprefix("input: ")


def _answers(kind: str, options: Mapping[str, str | None], numbers: CameraNumbers) -> dict[str, str]:
    """Return the answer to every question: the option, what the user types in a terminal, or the default.

    Each is checked at once in the new file, the options before the questions.
    """
    from scenes.yaml.errors import InputError, Issue
    from twin.new.camera_numbers import checked_text

    questions = NEW[kind].questions
    out = {name: str(getattr(numbers, QUESTIONS[name].default, QUESTIONS[name].default)) for name in questions}

    def check(name: str = "", value: str = "") -> None:
        changed = {name: value} if name else {}
        checked_text(kind, numbers, {**out, **changed, "file": f"{kind}.yaml", "base": "job.yaml"})

    for name, value in options.items():
        if value is not None:
            try:
                check(name, value)
            except InputError as error:
                raise InputError(Issue(f"--{name}: {_reason(error)}")) from None
            out[name] = value
    check()
    for name in questions:
        if options[name] is None and _is_terminal():
            out[name] = _ask(QUESTIONS[name].text, out[name], partial(check, name))
    return out


def _targets(kind: str, out: Path, force: bool) -> list[Path]:
    """Return the files that are written; raise InputError if one cannot be."""
    from scenes.yaml.errors import InputError, Issue

    targets = [out, *([_job_of(out)] if kind == "study" else [])]
    for path in targets:
        check_out(path, (".yaml", ".yml"), force)
        if not path.parent.is_dir():
            raise InputError(Issue("there is no such folder", str(path.parent)))
    return targets


def _write_new(kind: str, camera: str | None, out: Path | None, force: bool, options: Mapping[str, str | None]) -> None:
    """Write a new file of a kind, or print it."""
    errors = Console(stderr=True)
    with cli.explained(errors):
        from scenes.yaml.errors import InputError, Issue

        if camera is None and not _is_terminal():
            raise InputError(Issue("which camera is it for?", allowed="--camera NAME or FILE"))
        if out is not None:
            _targets(kind, out, force)
        from twin.framework.durable import write_all_safely
        from twin.new.camera_numbers import checked_text, numbers_of, reference_from

        if camera is None:
            camera = _ask(
                "Camera or instrument: name in the library, or file", None, lambda name: numbers_of(name, Path())
            )
        numbers = numbers_of(camera, Path())
        answers = _answers(kind, options, numbers)
        if out is None and _is_terminal():
            asked = _ask(_FILE, "-", lambda name: name == "-" or _targets(kind, Path(name), force))
            out = None if asked == "-" else Path(asked)
        targets = [] if out is None else _targets(kind, out, force)
        if out is not None:
            numbers = replace(numbers, reference=reference_from(camera, out.parent))
        job = Path("job.yaml") if out is None else _job_of(out)
        texts = [checked_text(kind, numbers, {**answers, "file": str(out or f"{kind}.yaml"), "base": job.name})]
        if kind == "study":
            texts.append(checked_text("job", numbers, {"decentre": "", "file": str(job)}))
        write_all_safely((path, text.encode()) for path, text in zip(targets, texts, strict=False))
    with to_stdout(errors, "" if out is None else f"the file is complete in {out}"):
        if out is None:
            sys.stdout.write(texts[0])
            return
        sys.stdout.write("".join(f"{path}\n" for path in targets))
        sys.stdout.write(f"what it is: python -m twin.show {out}\n")
        more = " life --from 2027-01-01T00:00:00Z --days 14 --every 2d" if kind == "operation" else ""
        sys.stdout.write(f"run it: python -m twin.{NEW[kind].runs} {out}{more}\n")


def _job_of(study: Path) -> Path:
    """Return the path of the job that a study varies."""
    return study.with_name(f"{study.stem}_job.yaml")


def _command(kind: str) -> Callable[..., None]:
    """Return the command that writes a kind of file, with an option for each of its questions."""

    def command(camera: str | None, out: Path | None, force: bool, **options: Any) -> None:
        _write_new(kind, camera, out, force, options)

    new = NEW[kind]
    command.__doc__ = f"Write {new.about}.\n\n    python -m twin.new {kind} --camera my.yaml --out {kind}.yaml\n"
    options: list[tuple[str, Any, Any]] = [("camera", Camera, None), ("out", Out, None)]
    for name in new.questions:
        question = QUESTIONS[name]
        shown = question.shown or question.default
        option = typer.Option(help=f"{question.text}.", show_default=shown)
        options.append((name, Annotated[str | None, option], None))
    options.append(("force", Force, False))
    parameters = [Parameter(n, Parameter.KEYWORD_ONLY, default=d, annotation=a) for n, a, d in options]
    return cli.with_parameters(command, parameters)


for _kind in NEW:
    app.command(_kind)(_command(_kind))

if __name__ == "__main__":
    app()
