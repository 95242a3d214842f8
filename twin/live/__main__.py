"""Command ``python -m twin.live``: shows an instrument with adjustable motions as a page in the browser."""

from __future__ import annotations

if __name__ == "__main__":
    from scenes.yaml.interrupt import end_quietly

    end_quietly()

from collections.abc import Sequence
from typing import Annotated

import typer
from rich.console import Console

from twin.framework.cli import BackendName, InputErrorText, Quiet, check_backend, explained, program

PORT = 8790
TOKEN = "TWIN_LIVE_TOKEN"
"""Environment variable with a token that stays valid when the server is restarted."""
EXTRA = (
    "the live twin needs starlette, uvicorn and websockets, which are not installed; install them with `bash setup.sh`"
)
"""Error message if the optional packages of the live twin are not installed."""

app = program()


@app.command()
def main(
    what: Annotated[
        str,
        typer.Argument(
            help="Instrument of the library or its file, a job's file, a measurement's, a study's, or a run folder."
        ),
    ],
    run: Annotated[
        int | None,
        typer.Option(min=0, help="Number of a study's run to begin with, from 0. Default: the study's base."),
    ] = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port of the server; 0 takes a free one.")] = PORT,
    host: Annotated[
        str, typer.Option(help="Address of the server. Other machines can reach it if it is not 127.0.0.1.")
    ] = "127.0.0.1",
    stay: Annotated[
        bool, typer.Option("--stay", help="Keep running when the last page is closed; end with Ctrl-C.")
    ] = False,
    backend: BackendName = "llvm",
    quiet: Quiet = False,
) -> None:
    """Open an instrument as a page in the browser.

    The page has sliders for every body, the spots on the CCDs, the readings of all estimators beside the truth, a strip
    chart, and the instrument in three dimensions. A single camera has sliders for radii, conic constants, distances and
    the field point, too; the page draws its optics and saves its file.

    Every state is computed as by the main job: the page shows what twin.render writes for the same knobs, seed
    and frames; the page saves that job, and recorded states as a course.

    Example: `python -m twin.live gf7_pair`

    The course of a job can be played: `python -m twin.live scenes/examples/orbit.yaml`, or launch.yaml
    and heat_soak.yaml beside it. A study's factors become knobs:
    `python -m twin.live scenes/examples/study_aperture.yaml`.

    Run folders can be opened, too, by name or by their config.yaml: those of twin.render in their state, with the
    same frames and readings; of a study with its factors, and with --run in the state of one of its runs; of
    twin.uncertainty, and of twin.recover with the instrument as designed; of twin.orbit monitor as a course. Of any
    other it says what it holds and what can be opened in its place.

    The command prints an address; open it in a browser on this machine. The address contains a token: anybody who
    has it can adjust the knobs. The environment variable TWIN_LIVE_TOKEN sets a token that stays valid after a restart.
    The command ends ten seconds after the last page is closed, or with Ctrl-C.

    It needs what bash setup.sh installs; with pip it is the extra `live`.

    Exit codes: 0 ended, 2 bad input, 1 anything else.
    """
    errors = Console(stderr=True)
    with explained(errors):
        check_backend(backend)
        about = _readable(what, run)
        _serve(what, run, host, port, stay, backend, about, None if quiet else Console())


def _readable(what: str, run: int | None) -> tuple[str, ...]:
    """Read the source, and return its description and notes.

    Raises
    ------
    InputError
        The source cannot be read, is not valid, or cannot be opened as a page.
    """
    from twin.live.source import read_source

    source = read_source(what, run)
    return (source.about, *source.notes)


def _serve(
    what: str,
    run: int | None,
    host: str,
    port: int,
    stay: bool,
    backend: str,
    about: Sequence[str],
    console: Console | None,
) -> None:
    """Build the instrument, print the address and serve the page.

    Raises
    ------
    InputErrorText
        The extra is missing, the address is in use, or the instrument cannot be built.
    """
    try:
        from twin.live.server import BadToken, Guard, LiveServer, addresses, listen, new_token
    except ImportError as error:
        raise InputErrorText(f"{EXTRA} ({error.name})") from None
    from twin.live.computer import Computer, ComputerLost

    try:
        token = new_token(TOKEN)
        listening = listen(host, port)
    except BadToken as error:
        raise InputErrorText(str(error)) from None
    except OSError as error:
        raise InputErrorText(f"cannot listen on {host}:{port}: {error.strerror}; choose another --port") from None
    computer = Computer(what, backend, run)
    try:
        if console is None:
            computer.start()
        else:
            with console.status("start") as status:
                computer.start(lambda part: status.update(part))
        bound = listening.getsockname()[1]
        guard = Guard.of(token, host, bound)
        if console is not None:
            for line in about:
                console.print(line, markup=False, highlight=False, soft_wrap=True)
            for line in addresses(host, bound, f"token={token}"):
                console.print(line, highlight=False, soft_wrap=True)
            console.print("Ctrl-C ends it" + ("." if stay else ", and so does closing the last page."))
        LiveServer(computer, guard, stay).run(listening)
    except ComputerLost as error:
        raise InputErrorText(str(error)) from None
    finally:
        computer.stop()
        listening.close()


if __name__ == "__main__":
    app()
