"""Commands of `twin.operate` on a simulated life of an instrument: simulate it, and compare estimates with truth."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from scenes.yaml.input_file import read_json
from scenes.yaml.yaml_file import dump_yaml, read_yaml
from twin.framework import durable
from twin.framework.cli import LARGEST_SEED, InputErrorText, Options, check_backend, with_options
from twin.framework.command import Result, finished, progress_shown, run_command
from twin.framework.procedure import Session
from twin.operate.terminal import errors_reported, print_line, print_result

if TYPE_CHECKING:
    from scenes.specs.operation import OperationSetup


@with_options("out", "seed", "export", "strict")
def simulate(
    plan: Annotated[
        Path,
        typer.Argument(metavar="PLAN.yaml", readable=False, help="Plan of the operation, or a life's config.yaml."),
    ],
    options: Options,
    start: Annotated[str, typer.Option("--from", help="UTC of the first reading; time laws count from it.")],
    days: Annotated[float, typer.Option(help="Length of the life, in days.")],
    interval: Annotated[
        str, typer.Option("--every", help="Time from one reading to the next, with its unit: 6d, 12h.")
    ],
    record: Annotated[
        str | None, typer.Argument(metavar="[DIR_OR_URL]", help="Record to create. Without it only files are written.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, max=LARGEST_SEED, help="Seed of all random numbers.")] = 1,
    frames: Annotated[int, typer.Option(min=1, max=1000, help="Frames of every exposure.")] = 10,
    coefficient_error: Annotated[
        str, typer.Option(help="Relative sigma of the factor between the true and the computed effect of heat: 30%.")
    ] = "0%",
    sensor_sigma: Annotated[str, typer.Option(help="Sigma of every sensor of temperature.")] = "0.05 K",
    sensor: Annotated[
        list[str] | None,
        typer.Option(help="Body with a sensor; repeatable. Default: all bodies with a stated temperature."),
    ] = None,
    dead: Annotated[
        list[str] | None, typer.Option(metavar="BODY@UTC", help="Sensor that fails silently at this time.")
    ] = None,
    stuck: Annotated[
        list[str] | None,
        typer.Option(metavar="BODY@UTC", help="Sensor that repeats its last reading from this time on."),
    ] = None,
    event: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME@UTC", help="Event; repeatable. Default: each event of the plan once, at a random date."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            readable=False,
            help="Folder for the files. Default: `simulated` in the record's folder, or runs/life-001.",
        ),
    ] = None,
    truth: Annotated[
        Path | None,
        typer.Option(readable=False, help="File for the truth, or none. Default: life.json among the files."),
    ] = None,
) -> None:
    """Simulate the life of an instrument into a new record.

    Motions are drawn by the plan's time laws, every reading of the monitor is traced, rendered with noise and
    recovered, sensors read temperatures, and events occur. The telemetry of a real instrument is written as files and
    ingested like any others. The truth is written to a separate file, which the operation never reads.

    Example: `python -m twin.operate simulate scenes/examples/operation.yaml life --from 2027-01-01T00:00:00Z
    --days 1096 --every 6d --coefficient-error 30%`

    Exit codes: 0 success, 2 bad input, 1 anything else.
    """
    with errors_reported() as errors, durable.exit_on_terminate():
        check_backend(options.backend)
        from optics.numerics.backend import load_backend
        from twin.operate.simulation_run import simulate_into, simulation

        option_values = {"--from": start, "--days": f"{days:.17g}", "--every": interval, "--frames": str(frames)}
        option_values |= {"--coefficient-error": coefficient_error, "--sensor-sigma": sensor_sigma}
        several = {"--sensor": sensor or [], "--dead": dead or [], "--stuck": stuck or [], "--event": event or []}
        what = simulation(option_values, several, seed)
        with progress_shown(errors, options.silent) as advance:
            done = simulate_into(plan, record, out, truth, options.force, what, load_backend(options.backend), advance)
        destination = done["record"] or done["files"]
        text = f"{done['readings']} readings of the monitor in {destination}"
        lost = "".join(f"\nwarning: {warning}" for warning in done["lost"])
        print_result(
            errors, options, done, lambda console: print_line(console, f"{text}; truth: {done['truth']}{lost}")
        )


@with_options("seed", "export", "backend", "strict")
def judge(
    life: Annotated[Path, typer.Argument(metavar="RECORD", readable=False, help="Record made by `simulate`.")],
    options: Options,
    truth: Annotated[
        Path | None, typer.Option(readable=False, help="File of the truth. Default: life.json among its files.")
    ] = None,
) -> None:
    """Estimate a simulated life reading by reading, and compare the estimates and forecasts with the truth.

    Four estimates are compared: the ground calibration, single readings, the filtered estimate (readings so far) and
    the smoothed one (all readings).

    Example: `python -m twin.operate judge life`

    The run folder gets report.html, judged.json, config.yaml, and figures and tables in artefacts/.

    Exit codes: 0 success, 2 bad input (nothing is written), 1 anything else.
    """

    def resolve() -> tuple[OperationSetup, Path, Path]:
        from scenes.specs.operation import OperationSetup
        from scenes.yaml.spec import validate
        from twin.operate.simulate import FOLDER, LIFE, TELEMETRY

        files = life / FOLDER if (life / FOLDER).is_dir() else life
        truth_file = files / f"{LIFE}.json" if truth is None else truth
        if not (files / TELEMETRY).is_file():
            raise InputErrorText(f"no simulated life in {life}; python -m twin.operate simulate makes one")
        if not truth_file.is_file():
            raise InputErrorText(f"no truth in {truth_file}; --truth names the file that simulate wrote")
        _truth(truth_file)  # a wrong truth is reported before the life is estimated
        return validate(OperationSetup, read_yaml(files / "config.yaml")), files / TELEMETRY, truth_file

    def work(inputs: tuple[OperationSetup, Path, Path], session: Session) -> Result:
        from twin.operate.judged_life import judged, judged_numbers, judged_report

        plan, telemetry, truth_file = inputs
        done = judged(plan, telemetry, _truth(truth_file), session.advance)
        facts: dict[str, Any] = {
            "config": dump_yaml(plan.plain()),
            "command": "judge",
            "input_paths": (telemetry, truth_file),
        }
        facts["again"] = ("twin.operate", "judge", str(life), *(() if truth is None else ("--truth", str(truth))))
        report = judged_report(done, plan.model.instrument.name)
        return finished(session, "judged", report, judged_numbers(done), program="twin.operate", **facts)

    run_command("judged", options, resolve, work)


def _truth(file: Path) -> dict[str, Any]:
    """Return the plain data of a truth. Raise InputErrorText or InputError if it cannot be read or is not one."""
    data = read_json(file)
    if not isinstance(data, dict) or not {"times_us", "cameras"} <= set(data):
        raise InputErrorText(f"{file}: not the truth of a simulated life")
    return data
