"""``python -m twin.live``: turn a knob, the spots move, the readings follow."""

from __future__ import annotations

if __name__ == "__main__":
    from scenes.yaml.interrupt import end_quietly

    end_quietly()

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from twin.run.cli import BackendName, InputErrorText, Quiet, check_backend, explained

PORT = 8790
EXTRA = (
    "the live twin needs starlette, uvicorn and websockets, which are not installed; install them with "
    "`bash setup.sh --live`"
)

app = typer.Typer(add_completion=False, rich_markup_mode="markdown", pretty_exceptions_enable=False)


@app.command()
def main(
    what: Annotated[
        str,
        typer.Argument(
            help="Instrument of the library or its file, a job's file, a run folder of twin.render, a study."
        ),
    ],
    port: Annotated[int, typer.Option(min=0, max=65535, help="To listen on; 0 takes one that is free.")] = PORT,
    host: Annotated[
        str, typer.Option(help="Address to listen on. Others than this machine can reach it if it is not 127.0.0.1.")
    ] = "127.0.0.1",
    stay: Annotated[bool, typer.Option("--stay", help="Go on when the last page is closed; end with Ctrl-C.")] = False,
    backend: BackendName = "llvm",
    quiet: Quiet = False,
) -> None:
    """Open an instrument as a page in the browser: sliders for every body, the spots as the CCDs see them, the readings
    of all estimators beside the truth, a strip chart, and the instrument in three dimensions.

    Every state takes the way of the main job: what the page shows is what twin.render writes for the same knobs, seed
    and frames; the page saves that job, and what was recorded as a course.

    Example: `python -m twin.live gf7_pair`

    Of a job with a course the course can be played: `python -m twin.live scenes/examples/orbit.yaml`. A study's factors
    become knobs: `python -m twin.live scenes/examples/study_aperture.yaml`. A run folder of twin.render is opened in
    the state that it shows.

    The command prints an address; open it in a browser on this machine. The address holds a token: whoever has it can
    turn the knobs. The environment variable TWIN_LIVE_TOKEN sets a token that stays when the command is started again.
    The command ends ten seconds after the last page is closed, or with Ctrl-C.

    It needs what the extra `live` installs: bash setup.sh --live

    Exit codes: 0 ended, 2 bad input, 1 anything else.
    """
    errors = Console(stderr=True)
    with explained(errors):
        check_backend(backend)
        _serve(_readable(what), host, port, stay, backend, None if quiet else Console())


def _readable(what: str) -> str:
    """What is to be opened, checked as far as reading it can tell.

    Raises:
        InputError: it cannot be read or is not valid.
        InputErrorText: it is a folder without a run.
    """
    from scenes.specs.load import INSTRUMENTS, library_names

    path = Path(what)
    if path.is_dir():
        config = path / "config.yaml"
        if not config.is_file():
            raise InputErrorText(f"{what} is not a run folder: it has no config.yaml; name a run of twin.render")
        what = str(config)
    if what not in library_names(INSTRUMENTS):
        from twin.live.source import read_source

        read_source(what)
    return what


def _serve(what: str, host: str, port: int, stay: bool, backend: str, console: Console | None) -> None:
    """Build, listen, print the address, serve.

    Raises:
        InputErrorText: the extra is missing, the address is taken, or the instrument cannot be built.
    """
    try:
        from twin.live.server import LiveServer, listen
    except ImportError as error:
        raise InputErrorText(f"{EXTRA} ({error.name})") from None
    from twin.live.computer import CannotStart, Computer
    from twin.live.guard import BadToken, Guard, new_token

    try:
        token = new_token()
        listening = listen(host, port)
    except BadToken as error:
        raise InputErrorText(str(error)) from None
    except OSError as error:
        raise InputErrorText(f"cannot listen on {host}:{port}: {error.strerror}; choose another --port") from None
    computer = Computer(what, backend)
    try:
        if console is None:
            computer.start()
        else:
            with console.status("start") as status:
                computer.start(lambda part: status.update(part))
        bound = listening.getsockname()[1]
        guard = Guard.of(token, host, bound)
        if console is not None:
            shown = "127.0.0.1" if host in ("0.0.0.0", "::") else f"[{host}]" if ":" in host else host
            console.print(f"open http://{shown}:{bound}/?token={token}", highlight=False, soft_wrap=True)
            console.print("Ctrl-C ends it" + ("." if stay else ", and so does closing the last page."))
        LiveServer(computer, guard, stay).run(listening)
    except CannotStart as error:
        raise InputErrorText(str(error)) from None
    finally:
        computer.stop()
        listening.close()


if __name__ == "__main__":
    app()
