"""Command that simulates the operation of an instrument: options, checks, computation, files, ingest into a record."""

from __future__ import annotations

import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from optics.numerics.backend import Backend
from scenes.specs.operation import EVENTS, OperationSetup, read_operation
from scenes.yaml.errors import KeyPath, unknown
from scenes.yaml.spec import validate
from scenes.yaml.units import MOMENT, SCALE, TEMPERATURE_DIFFERENCE, Kind, parse_quantity
from scenes.yaml.yaml_file import read_yaml
from twin.framework.cli import InputErrorText
from twin.framework.durable import write_safely
from twin.framework.memory import Lowered, require_memory
from twin.framework.procedure import WRITE, Advance
from twin.framework.record import described
from twin.framework.run_folder import RunFolder, chosen, json_text, write_manifest
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.operate.estimate.operation_model import read_plan, store_plan
from twin.operate.record.entries import utc_text
from twin.operate.record.history import History, initialise_record
from twin.operate.record.ingest import IngestResult
from twin.operate.record.telemetry import CONFIG, read_table_file, read_telemetry, tables_of
from twin.operate.simulate import FOLDER, LIFE, TELEMETRY, Simulation, simulate_record, truth_numbers, write_simulated
from twin.operate.terminal import input_errors, utc_option

PROGRAM = "twin.operate"
CALIBRATE, INGEST = "calibrate", "ingest into the record"
NO_TRUTH = "none"
"""Value of the option --truth for which no file of the truth is written."""
MOST = 100_000
"""Largest number of monitor readings in one simulated life: so many take some hours, and a gigabyte of results."""
_READING = 2e5
"""Memory per reading, in bytes, for the numbers stored beside its frames."""
DAY = 86_400.0


def simulation(options: Mapping[str, str], several: Mapping[str, Sequence[str]], seed: int) -> Simulation:
    """Return the parameters of a simulation from the options of the command.

    Parameters
    ----------
    options : Mapping[str, str]
        Option -> its text: ``--from``, ``--days``, ``--every``, ``--frames``, ``--coefficient-error``,
        ``--sensor-sigma``.
    several : Mapping[str, Sequence[str]]
        Repeatable options: ``--sensor`` BODY, ``--dead`` and ``--stuck`` BODY@UTC, ``--event`` NAME@UTC.
    seed : int
        Seed of all random numbers.

    Raises
    ------
    InputErrorText
        An option is not valid.
    """
    interval, days = options["--every"], float(options["--days"])
    step = _quantity("--every", interval, MOMENT)
    if not step > 0.0:
        raise InputErrorText(f"--every: {interval} is not a time from one reading to the next; write 6d, or 12 h")
    if not 0.0 < days * DAY / step <= MOST:
        raise InputErrorText(
            f"--days: {days:g} days with a reading every {interval}; allowed: from 1 to {MOST} readings"
        )
    error = _quantity("--coefficient-error", options["--coefficient-error"], SCALE)
    sigma = _quantity("--sensor-sigma", options["--sensor-sigma"], TEMPERATURE_DIFFERENCE)
    if error < 0.0:
        raise InputErrorText(f"--coefficient-error: {options['--coefficient-error']} is below zero; write 30%, or 0%")
    if not sigma > 0.0:
        raise InputErrorText(
            f"--sensor-sigma: {options['--sensor-sigma']} is not a standard deviation above zero; write 0.05 K"
        )
    start = utc_option("--from", options["--from"])
    dates = tuple(
        (moment, name) for name, moment in (_name_and_time("--event", text, EVENTS) for text in several["--event"])
    )
    return Simulation(
        start,
        days * DAY,
        step,
        seed,
        int(options["--frames"]),
        error,
        sigma,
        tuple(several["--sensor"]) or None,
        dict(_name_and_time("--dead", text) for text in several["--dead"]),
        dict(_name_and_time("--stuck", text) for text in several["--stuck"]),
        dates or None,
        (*(word for pair in options.items() for word in pair), *_words(several)),
    )


def _words(several: Mapping[str, Sequence[str]]) -> Iterator[str]:
    for option, texts in several.items():
        for text in texts:
            yield from (option, text)


def _quantity(option: str, text: str, kind: Kind) -> float:
    with input_errors(option):
        return parse_quantity(text, kind)


def _name_and_time(option: str, text: str, known: Collection[str] | None = None) -> tuple[str, int]:
    """Return name and time of ``NAME@UTC``."""
    name, sign, moment = text.partition("@")
    if not sign:
        raise InputErrorText(f"{option}: {text!r} has no time; write {name or 'NAME'}@2027-06-01T00:00:00Z")
    if known is not None:
        _require_name(option, name, known)
    return name, utc_option(option, moment)


def _require_name(option: str, name: str, names: Collection[str]) -> None:
    """Raise InputErrorText if a name is unknown."""
    with input_errors(option):
        if name not in names:
            raise unknown("no such name", name, sorted(names))


class _Options:
    """Source of error messages about too little memory, which refer to the command-line options."""

    def error(self, problem: str, key: KeyPath, *, value: object, allowed: str) -> InputErrorText:
        return InputErrorText(f"{key[0]}: {problem}; {value} readings, allowed: {allowed}")


def simulate_into(
    file: Path,
    record: str | None,
    out: Path | None,
    truth: Path | None,
    force: bool,
    what: Simulation,
    backend: Backend,
    advance: Advance,
) -> dict[str, Any]:
    """Simulate a life, write its files and ingest them into a record, which is created if it does not exist.

    Parameters
    ----------
    file : Path
        Plan of the operation, which the record stores; or config.yaml of a life, which contains all files of a plan.
    record : str | None
        Folder, or address of a database; None to write only files.
    out : Path | None
        Folder for the telemetry; None for a subfolder of the record, or the next free run folder.
    truth : Path | None
        File for the truth; None for one in the folder of the telemetry, ``none`` for no file.
    force : bool
        True to replace the folder if it has the files of an earlier simulation.
    what : Simulation
        Parameters of the simulation.
    backend : Backend
        Backend that traces.
    advance : Advance
        Callback that receives the progress.

    Returns
    -------
    dict[str, Any]
        Summary of the run as plain data.

    Raises
    ------
    InputErrorText
        The record holds readings already, or is not one of simulated readings; there is no place for the files; a body
        is unknown; or the memory does not suffice.
    InputError, RunFolderError, NotARecord, RecordFailed
        The plan, the instrument, the folder or the record cannot be used.
    """
    started, clock = time.time(), time.monotonic()
    text = read_yaml(file)
    complete = isinstance(text.data, dict) and "model" in text.data
    plan = validate(OperationSetup, text) if complete else read_operation(file)
    if out is None and record is not None and "://" in record:
        raise InputErrorText("--out: a database holds no files; name a folder for those that are simulated")
    target = Path(record) / FOLDER if out is None and record is not None else chosen(out, LIFE)
    readings = len(what.times)
    require_memory(Lowered(_Options(), ("--every",), readings, "readings", lambda count: count * _READING))
    if out is not None:  # report an existing folder before the record, which cannot be altered, is created
        RunFolder(out, force)
    advance(CALIBRATE, 0, 1)
    experiment = MonitorExperiment(plan.model, backend)
    experiment.nominal_focus  # noqa: B018 - an instrument without spots is told first
    # check before the record, which cannot be altered, is created
    _require_known_sensors(experiment, what)
    with ExitStack() as open_record:
        history = None
        if record is not None:
            initialise_record(record, plan.model, simulated=True)
            history = open_record.enter_context(History(record))
            _require_empty(history)
            # requirements are checked against the instrument; those of a config.yaml were checked already
            store_plan(plan if complete else read_plan(file, history), file, history)
        folder = RunFolder(target, force)
        advance(CALIBRATE, 1, 1)
        simulated = simulate_record(plan, experiment, what, advance)
        if not simulated.readings:
            raise InputErrorText(f"the monitor can read no state; the first because: {simulated.lost[0][1]}")
        advance(WRITE, 0, 1)
        life = described(LIFE, truth_numbers(plan, what, simulated))
        lost_readings = [f"no reading at {utc_text(moment)}: {why}" for moment, why in simulated.lost]
        with folder:
            write_simulated(folder, plan, experiment, what, simulated)
            if truth is None:
                folder.write_json(f"{LIFE}.json", life)
            facts = {"backend": backend.name, "seed": what.seed, "frames": what.frames, "warnings": lost_readings}
            facts["again"] = list(_again(truth, what, backend))
            write_manifest(folder, PROGRAM, started, time.monotonic() - clock, test="simulate", **facts)
        if truth is not None and str(truth) != NO_TRUTH:
            _write_truth(truth, json_text(life))
        advance(INGEST, 0, 1)
        ingested = [] if history is None else ingest_files(history, folder.target / TELEMETRY)
        advance(INGEST, 1, 1)
    refused = [reason for result in ingested for _, reason in result.refused]
    if refused:
        raise InputErrorText(f"{len(refused)} simulated readings were refused, the first: {refused[0]}")
    return {
        "record": None if history is None else history.url,
        "instrument": plan.model.instrument.name,
        "files": str(folder.target),
        "truth": str(truth or folder.target / f"{LIFE}.json"),
        "readings": len(simulated.readings),
        "entries": sum(result.new for result in ingested),
        "steps": len(simulated.life.steps),
        "lost": lost_readings,
        "seconds": time.monotonic() - clock,
    }


def _again(truth: Path | None, what: Simulation, backend: Backend) -> Iterator[str]:
    """Yield the words of the command line that reproduces the files, to be run in their folder."""
    yield from (PROGRAM, "simulate", CONFIG, *what.words, "--seed", str(what.seed), "--backend", backend.name)
    if truth is not None:  # a repetition writes no files outside its folder
        yield from ("--truth", NO_TRUTH)


def ingest_files(history: History, file: Path) -> list[IngestResult]:
    """Ingest all tables that a file describes into a record.

    Parameters
    ----------
    history : History
        Record of the instrument in operation.
    file : Path
        YAML file that describes the tables.
    """
    spec = read_telemetry(file, history)
    table_files = ((table, path) for table in spec.readings for path in tables_of(spec, table))
    return [history.ingest(read_table_file(table, path, history)) for table, path in table_files]


def _require_empty(history: History) -> None:
    """Raise InputErrorText if a record is not an empty one of simulated readings."""
    if not history.simulated:
        text = "the record is not one of simulated readings; init --simulated makes such a record in another folder"
        raise InputErrorText(f"{history.url}: {text}")
    if history.status()["entries"]:
        raise InputErrorText(
            f"{history.url}: the record holds readings already; a simulated life needs an empty record"
        )


def _require_known_sensors(experiment: MonitorExperiment, what: Simulation) -> None:
    """Raise InputErrorText for a sensor on a body without a prior temperature, or a faulty one not simulated."""
    assert experiment.prior is not None  # a plan states something
    warm = {component.body for component in experiment.prior.components if component.kind == "temperature"}
    for body in what.sensors or ():
        _require_name("--sensor", body, warm)
    options: Mapping[str, Mapping[str, int]] = {"--dead": what.dead, "--stuck": what.stuck}
    for option, bodies in options.items():
        for body in bodies:
            _require_name(option, body, warm if what.sensors is None else what.sensors)


def _write_truth(path: Path, text: str) -> None:
    """Write the truth. Raise InputErrorText if it cannot be written."""
    try:
        write_safely(path, text.encode())
    except OSError as error:
        raise InputErrorText(f"--truth: {path} cannot be written: {error.strerror or error}") from None
