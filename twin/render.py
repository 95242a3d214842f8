"""``python -m twin.render``: a perturbed instrument's images, and what can be recovered from them."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.progress import Progress, TaskID
from rich.table import Table

from analysis.monitor.recovery import ESTIMATORS
from optics.numerics.backend import load_backend
from scenes.specs.course import moment
from scenes.specs.resolved import ResolvedJob, resolve
from scenes.yaml.standard_output import FAILURE, Terminal, print_error, print_json, to_stdout
from twin.main_job.render_files import write_run
from twin.main_job.render_job import STAGES, render_job
from twin.main_job.render_results import RenderRun, stated
from twin.pictures.picture import write_pictures
from twin.pictures.picture_light import PictureError
from twin.run.cli import (
    BACKEND_HELP,
    LARGEST_SEED,
    check_backend,
    exit_on_terminate,
    explained,
    print_place,
    print_whole,
    progress_columns,
)
from twin.run.reference_frames import described
from twin.run.run_folder import RunFolder, chosen
from twin.targets.edge_images import DIRECTIONS
from twin.targets.target_images import PLACES
from twin.targets.target_result import EdgeReading, TargetRun

WRITE = "write the run folder"
LABELS = {
    "d_alpha_arcsec": ('d_alpha "', 4),
    "d_beta_arcsec": ('d_beta "', 4),
    "d_gamma_arcsec": ('d_gamma "', 3),
    "d_f_um": ("d_f um", 2),
}
"""How the terminal's table names a parameter, and its decimals."""

_ALONG = dict(zip(DIRECTIONS, ("along line", "along track"), strict=True))
"""How the terminal names the direction in which the MTF is measured."""

app = typer.Typer(add_completion=False, rich_markup_mode="markdown", pretty_exceptions_enable=False)


@app.command()
def main(
    # readable=False: our own loader says what is wrong with a file, in the same words for all files
    job: Annotated[
        Path, typer.Argument(readable=False, help="YAML file of the job, e.g. scenes/examples/perturb.yaml.")
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            readable=False, help="Run folder to make. Default: runs/JOB-001, -002, ... (the first that is free)."
        ),
    ] = None,
    seed: Annotated[
        int | None, typer.Option(min=0, max=LARGEST_SEED, help="Seed of all noise; overrides the file's.")
    ] = None,
    frames: Annotated[
        int | None, typer.Option(min=1, max=10_000, help="Frames per state; overrides the file's.")
    ] = None,
    backend: Annotated[str, typer.Option(help=BACKEND_HELP)] = "llvm",
    picture: Annotated[
        bool,
        typer.Option("--picture", help="Also render pictures of the instrument itself: picture.png and two close-ups."),
    ] = False,
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

    A job with a course, a table of temperatures over time (scenes/examples/orbit.yaml), also gets every time's
    numbers and images: course.json, course.nc and images/CAMERA_SIDE_course.tiff.

    With `render: {images: [spots, knife_edge, bars]}` (also star and pinhole) test targets at infinity are imaged on
    every camera's panchromatic line CCD, in its middle and near its ends, before and after; mtf.json has the MTF
    measured in the images beside that of the traced pupil (scenes/examples/targets.yaml).

    With `render: {stray: true}` ghosts and scattered light are path-traced and added to the images; stray.json lists
    them.

    With `render: {quality: true}` wavefront errors, defocus and MTF on the line CCDs are worked out before and after;
    quality.json has them. What prisms and other bodies take of the cameras' beams is missing in their pupils, here and
    in the targets' images; `render: {obstruction: ignore}` leaves it out.

    With --picture the run folder also gets picture.png (the instrument), picture_prisms.png and
    picture_focal_plane.png, rendered with Mitsuba; this takes about half a minute. If Mitsuba cannot, the rest of the
    run is kept and the exit code is 1.

    Exit codes: 0 success, 2 bad input (nothing is written), 1 anything else.
    """
    errors = Console(stderr=True)
    with explained(errors):
        check_backend(backend)
        resolved = resolve(job)
        folder = RunFolder(chosen(out, job.stem), force)
        run, problem = _run(folder, resolved, backend, frames, seed, picture, silent=as_json or quiet, errors=errors)
    with to_stdout(errors, f"the run is complete in {folder.target}"):
        if as_json:
            parts = {"truth": run.truth_dict(), "recovered": stated(run.recovered_dict())}
            if run.course is not None:
                parts["course"] = run.course.to_dict()
            if run.targets is not None:
                parts["mtf"] = run.targets.to_dict()
            print_json({kind: described(kind, data) for kind, data in parts.items()})
        elif not quiet:
            _print_result(run, folder.target)
    if problem:
        print_error(errors, f"the pictures are not complete: {problem}; all else is in {folder.target}")
        raise typer.Exit(FAILURE)


def _run(
    folder: RunFolder,
    resolved: ResolvedJob,
    backend: str,
    frames: int | None,
    seed: int | None,
    picture: bool,
    silent: bool,
    errors: Console,
) -> tuple[RenderRun, str]:
    """The run, and why its pictures are not complete (empty when they are, or nobody asked for them)."""
    started, clock = time.time(), time.monotonic()
    tracer = load_backend(backend)
    problems: list[str] = []
    hidden = silent or not errors.is_terminal
    with (
        exit_on_terminate(),
        folder,
        Progress(*progress_columns(24), console=errors, disable=hidden, transient=True) as bar,
    ):
        task = bar.add_task("start", total=len(STAGES) + 1)
        parts: dict[str, TaskID] = {}

        def stage(name: str) -> None:
            bar.update(task, description=name, completed=float([*STAGES, WRITE].index(name)))

        def advance(part: str, done: int, total: int) -> None:
            if part not in parts:
                parts[part] = bar.add_task(part, total=total)
            bar.update(parts[part], completed=done)

        run = render_job(resolved, tracer, frames, seed, stage, advance)
        stage(WRITE)

        def pictures() -> None:
            experiment = run.experiment
            try:
                write_pictures(experiment.instrument, tracer, run.state, folder.write_with, run.seed, advance)
            except PictureError as error:  # what took minutes to compute is not thrown away for a picture
                problems.append(str(error))

        clock = time.monotonic() - clock
        write_run(run, folder, started, clock, pictures if picture else lambda: None)
        bar.update(task, completed=len(STAGES) + 1)
    return run, " ".join(problems)


def _print_result(run: RenderRun, target: Path) -> None:
    """Result table and where to look next."""
    table = _table(run)
    console = Terminal()
    print_whole(console, table)
    if run.targets is not None:
        lines = _mtf_table(run.targets)
        if lines is not None:
            console.print(lines)
    console.print(
        "The model assumes that only the line CCD moves and the optics scale; other motions read as these: "
        "see crosstalk in the report.",
        style="dim",
    )
    if run.course is not None:
        count, ends = len(run.course.times), [moment(float(run.course.times[k])) for k in (0, -1)]
        console.print(
            f"course: {count} times from {ends[0]} to {ends[1]} are in course.json, course.nc and the report.",
            highlight=False,
        )
    for warning in run.warnings:
        console.print(f"warning: {warning}", style="yellow", markup=False, soft_wrap=True)
    print_place(console, target)


def _mtf_table(targets: TargetRun) -> Table | None:
    """MTF at the Nyquist frequency from the knife edges, before -> after (true); None if there are none."""
    title = f"MTF at the Nyquist frequency from the knife edge ({targets.frames} frames)"
    title += "\nbefore -> after, below it the true one"
    table = Table(title=title, box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    for head in ("", *PLACES):
        table.add_column(head, no_wrap=True)
    for name, camera in targets.cameras.items():
        for direction in DIRECTIONS:
            pairs = [
                (place.before.edges[direction], place.after.edges[direction])
                for place in camera.places.values()
                if direction in place.before.edges
            ]
            if not pairs:
                return None
            cells = [
                f"{_value(before)} -> {_value(after)}\n[dim]{before.true_nyquist:.3f} -> {after.true_nyquist:.3f}[/]"
                for before, after in pairs
            ]
            table.add_row(f"[bold]{escape(name)}[/] {escape(camera.band)}, {_ALONG[direction]}", *cells)
    return table


def _value(edge: EdgeReading) -> str:
    return "none" if edge.nyquist is None else f"{edge.nyquist[0]:.3f}"


def _table(run: RenderRun) -> Table:
    """What every estimator recovered, beside the truth."""
    truth, recovered = run.truth_dict(), run.recovered_dict()
    title = f"{run.resolved.instrument.name}: recovered from the images ({run.frames} frames, seed {run.seed})"
    if run.course is not None:
        title += f"\nat {moment(float(run.course.times[run.course.shown]))} of the course"
    table = Table(title=title, box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    table.add_column("", no_wrap=True)
    names = (name.replace("_", "\n") for name in ESTIMATORS)
    heads = ("true", *names, "sigma", "model\n- true", "in\nsigma")
    for head in heads:
        table.add_column(head, justify="right", no_wrap=True)

    def add(label: str, key: str, decimals: int, true: float, estimators: Mapping[str, Mapping[str, float]]) -> None:
        model, sigma = estimators["model"][key], estimators["model"][f"{key}_sigma"]
        values = [true, *(estimators[name][key] for name in ESTIMATORS), sigma]
        # adding 0.0 after rounding leaves no minus before a zero
        cells = [f"{round(value, decimals) + 0.0:.{decimals}f}" for value in values]
        table.add_row(label, *cells, f"{model - true:+.{decimals}f}", f"{(model - true) / sigma:+.1f}")

    for camera, estimators in recovered["cameras"].items():
        table.add_row(f"[bold]{escape(camera)}[/]")
        for key, (label, decimals) in LABELS.items():
            add(label, key, decimals, truth["cameras"][camera][key], estimators)
    if "intersection_angle" in truth:
        true = truth["intersection_angle"]["change_arcsec"]
        table.add_row("[bold]both[/]")
        add('angle "', "change_arcsec", 4, true, recovered["intersection_angle"])
    return table


if __name__ == "__main__":
    app()
