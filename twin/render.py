"""``python -m twin.render``: a perturbed instrument's images, and what can be recovered from them."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from optics.backend import NAMES, BackendUnavailable, load_backend
from optics.llvm import LibraryMissing
from scenes.errors import InputError
from scenes.resolved import resolve
from twin.output import write_run
from twin.render_job import STAGES, render_job
from twin.results import RenderRun
from twin.run_folder import RunFolder, RunFolderError, next_free

WRITE = "write the run folder"
BAD_INPUT, FAILURE = 2, 1
LABELS = {
    "d_alpha_arcsec": 'd_alpha ["]',
    "d_beta_arcsec": 'd_beta ["]',
    "d_gamma_arcsec": 'd_gamma ["]',
    "d_f_um": "d_f [um]",
}

app = typer.Typer(add_completion=False, rich_markup_mode="markdown", pretty_exceptions_enable=False)


@app.command()
def main(
    job: Annotated[Path, typer.Argument(help="YAML file of the job, e.g. scenes/examples/perturb.yaml.")],
    out: Annotated[
        Path | None,
        typer.Option(help="Run folder to make. Default: runs/<name of the job>-<number>, the first that is free."),
    ] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Seed of all noise; overrides the file's.")] = None,
    frames: Annotated[
        int | None, typer.Option(min=1, max=10_000, help="Frames per state; overrides the file's.")
    ] = None,
    backend: Annotated[str, typer.Option(help=f"Where to trace: {' or '.join(NAMES)}.")] = "llvm",
    force: Annotated[bool, typer.Option("--force", help="Replace the run folder if it exists.")] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print truth and recovered as JSON on stdout, and nothing else.")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print nothing but errors.")] = False,
) -> None:
    """Perturb an instrument, render the spot images of its autocollimation monitor and recover the perturbation from
    them.

    The job file names an instrument and says what moves:

        instrument: gf7_pair

        perturb:

          base/backward/focal_plane: {rotate: [2 arcsec, -1.5 arcsec, 10 arcsec], pivot: rear_node}

          base/forward/M2: {shift: [0 um, 0 um, 3 um]}

        render: {images: [spots], frames: 9, seed: 1}

    Every quantity carries its unit. The run folder gets the images (TIFF), the expected irradiance (netCDF),
    truth.json, recovered.json, crosstalk.json, a self-contained report.html and scene.glb. A run's own config.yaml
    can be given as the job to repeat it.

    Exit codes: 0 success, 2 bad input (nothing is written), 1 anything else.
    """
    errors = Console(stderr=True)
    try:
        if backend not in NAMES:
            raise InputErrorText(f"unknown backend {backend!r}; choose {' or '.join(NAMES)}")
        resolved = resolve(job)
        folder = RunFolder(out if out is not None else next_free(Path("runs"), job.stem), force)
        run = _run(folder, resolved, backend, frames, seed, silent=as_json or quiet, errors=errors)
    except (InputError, InputErrorText, RunFolderError) as error:
        errors.print(f"error: {error}", style="bold red", markup=False, highlight=False, soft_wrap=True)
        raise typer.Exit(BAD_INPUT) from None
    except (BackendUnavailable, LibraryMissing) as error:
        errors.print(f"error: {error}", style="bold red", markup=False, highlight=False, soft_wrap=True)
        raise typer.Exit(FAILURE) from None
    if as_json:
        json.dump({"truth": run.truth_dict(), "recovered": run.recovered_dict()}, sys.stdout, allow_nan=False)
        sys.stdout.write("\n")
    elif not quiet:
        _print_result(run, folder.target)


class InputErrorText(Exception):
    """Bad input that has no file to point at."""


def _run(
    folder: RunFolder,
    resolved: object,
    backend: str,
    frames: int | None,
    seed: int | None,
    silent: bool,
    errors: Console,
) -> RenderRun:
    started, clock = time.time(), time.monotonic()
    columns = (
        SpinnerColumn(),
        TextColumn("{task.description:24}"),
        BarColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    with folder, Progress(*columns, console=errors, disable=silent, transient=True) as bar:
        task = bar.add_task("start", total=len(STAGES) + 1)

        def stage(name: str) -> None:
            bar.update(task, description=name, completed=float([*STAGES, WRITE].index(name)))

        run = render_job(resolved, load_backend(backend), frames, seed, stage)  # type: ignore[arg-type]
        stage(WRITE)
        write_run(run, folder, started, time.monotonic() - clock)
        bar.update(task, completed=len(STAGES) + 1)
    return run


def _print_result(run: RenderRun, target: Path) -> None:
    """Result table and where to look next."""
    console = Console()
    truth, recovered = run.truth_dict(), run.recovered_dict()
    table = Table(
        title=f"{run.resolved.instrument.name}: recovered from the images ({run.frames} frames, seed {run.seed})"
    )
    table.add_column("camera")
    table.add_column("parameter")
    table.add_column("true", justify="right")
    for estimator in next(iter(recovered["cameras"].values())):
        table.add_column(estimator, justify="right")
    table.add_column("model - true", justify="right")
    table.add_column("in sigma", justify="right")
    for camera, estimators in recovered["cameras"].items():
        for key, label in LABELS.items():
            true, model = truth["cameras"][camera][key], estimators["model"]
            difference, sigma = model[key] - true, model[f"{key}_sigma"]
            cells = [f"{e[key]:.4f}" for e in estimators.values()]
            cells[-1] += f" +- {sigma:.4f}"
            table.add_row(camera, label, f"{true:.4f}", *cells, f"{difference:+.4f}", f"{difference / sigma:+.1f}")
        table.add_section()
    if "intersection_angle" in truth:
        true = truth["intersection_angle"]["change_arcsec"]
        angles = recovered["intersection_angle"]
        difference = angles["model"]["change_arcsec"] - true
        sigma = angles["model"]["change_arcsec_sigma"]
        cells = [f"{a['change_arcsec']:.4f}" for a in angles.values()]
        cells[-1] += f" +- {sigma:.4f}"
        table.add_row("both", 'angle ["]', f"{true:.4f}", *cells, f"{difference:+.4f}", f"{difference / sigma:+.1f}")
    console.print(table)
    console.print(
        "The model assumes that only the line CCD moves and the optics scale; other motions read as these: "
        "see crosstalk in the report.",
        style="dim",
    )
    for warning in run.warnings:
        console.print(f"warning: {warning}", style="yellow", markup=False)
    console.print(f"run folder: {target}   report: {target / 'report.html'}", markup=False, highlight=False)


if __name__ == "__main__":
    app()
