"""A simulated life from the words of a command to a record: what is asked for, checked, computed, written and taken."""

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
from twin.framework.reference_frames import described
from twin.framework.run_folder import RunFolder, chosen, json_text, write_manifest
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.operate.estimate.operation_model import read_plan, store_plan
from twin.operate.record.entries import utc_text
from twin.operate.record.history import History, initialise_record
from twin.operate.record.taking import IngestResult
from twin.operate.record.telemetry import CONFIG, read_table_file, read_telemetry, tables_of
from twin.operate.simulate import FOLDER, LIFE, TELEMETRY, Simulation, simulate_record, truth_numbers, write_simulated
from twin.operate.terminal import input_errors, utc_option

PROGRAM = "twin.operate"
CALIBRATE, TAKE = "calibrate", "take into the record"
NO_TRUTH = "none"
"""In place of the truth's file: it is not written."""
MOST = 100_000
"""Readings of the monitor in one life: some hours, and a gigabyte of results."""
_READING = 2e5
"""Bytes of a reading: of numbers that are kept beside its frames."""
DAY = 86_400.0


def simulation(options: Mapping[str, str], several: Mapping[str, Sequence[str]], seed: int) -> Simulation:
    """What the options of the command ask for.

    Parameters
    ----------
    options : Mapping[str, str]
        By name, as they were written: ``--from``, ``--days``, ``--every``, ``--frames``, ``--coefficient-error``,
        ``--sensor-sigma``.
    several : Mapping[str, Sequence[str]]
        Likewise those that may be given more than once: ``--sensor`` BODY, ``--dead`` and ``--stuck`` BODY@UTC,
        ``--event`` NAME@UTC.
    seed : int
        Of everything that is drawn.

    Raises
    ------
    InputErrorText
        An option that means nothing, by its name.
    """
    every, days = options["--every"], float(options["--days"])
    step = _quantity("--every", every, MOMENT)
    if not step > 0.0:
        raise InputErrorText(f"--every: {every} is not a time from one reading to the next; write 6d, or 12 h")
    if not 0.0 < days * DAY / step <= MOST:
        raise InputErrorText(f"--days: {days:g} days with a reading every {every}; allowed: from 1 to {MOST} readings")
    error = _quantity("--coefficient-error", options["--coefficient-error"], SCALE)
    sigma = _quantity("--sensor-sigma", options["--sensor-sigma"], TEMPERATURE_DIFFERENCE)
    if error < 0.0:
        raise InputErrorText(f"--coefficient-error: {options['--coefficient-error']} is below zero; write 30%, or 0%")
    if not sigma > 0.0:
        raise InputErrorText(f"--sensor-sigma: {options['--sensor-sigma']} is no standard deviation; write 0.05 K")
    start = utc_option("--from", options["--from"])
    dates = tuple((moment, name) for name, moment in (_at("--event", text, EVENTS) for text in several["--event"]))
    return Simulation(
        start,
        days * DAY,
        step,
        seed,
        int(options["--frames"]),
        error,
        sigma,
        tuple(several["--sensor"]) or None,
        dict(_at("--dead", text) for text in several["--dead"]),
        dict(_at("--stuck", text) for text in several["--stuck"]),
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


def _at(option: str, text: str, known: Collection[str] | None = None) -> tuple[str, int]:
    """Name and moment of ``NAME@UTC``."""
    name, sign, moment = text.partition("@")
    if not sign:
        raise InputErrorText(f"{option}: {text!r} does not say when; write {name or 'NAME'}@2027-06-01T00:00:00Z")
    if known is not None:
        _known(option, name, known)
    return name, utc_option(option, moment)


def _known(option: str, name: str, names: Collection[str]) -> None:
    """Raises InputErrorText: none of these names."""
    with input_errors(option):
        if name not in names:
            raise unknown("no such name", name, sorted(names))


class _Options:
    """Options of the command."""

    def error(self, problem: str, key: KeyPath, *, found: object, allowed: str) -> InputErrorText:
        return InputErrorText(f"{key[0]}: {problem}; {found} readings, allowed: {allowed}")


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
    """Simulate a life, write its files and take them into a record, which is made where there is none.

    Parameters
    ----------
    file : Path
        Plan of the operation, which the record keeps; or config.yaml of a life, which holds all that a plan refers to.
    record : str | None
        Folder, or address of a database; None for the files alone.
    out : Path | None
        Folder for what the instrument would send down; None for one in the record's, or the next free run folder.
    truth : Path | None
        File for what only the simulation knows; None for one in that folder, ``none`` for no file.
    force : bool
        Replace the folder, if it is that of such files.
    what : Simulation
        Is simulated.
    backend : Backend
        Where to trace.
    advance : Advance
        Told of the progress.

    Returns
    -------
    dict[str, Any]
        What was done, as plain data.

    Raises
    ------
    InputErrorText
        a record that holds readings already, or is not of simulated ones; no place for the files; an unknown body; more
        memory than there is.
    InputError, RunFolderError, NotARecord, RecordFailed
        Of the plan, the instrument, the folder, the record.
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
    if out is not None:  # what is there is told before there is a record, which is never altered
        RunFolder(out, force)
    advance(CALIBRATE, 0, 1)
    experiment = MonitorExperiment(plan.model, backend)
    experiment.nominal_focus  # noqa: B018 - an instrument without spots is told first
    # before there is a record, which is never altered
    _are_stated(experiment, what)
    with ExitStack() as open_record:
        history = None
        if record is not None:
            initialise_record(record, plan.model, simulated=True)
            history = open_record.enter_context(History(record))
            _is_empty(history)
            # requirements are checked against the instrument; those of a life were when it was simulated
            store_plan(plan if complete else read_plan(file, history), file, history)
        folder = RunFolder(target, force)
        advance(CALIBRATE, 1, 1)
        found = simulate_record(plan, experiment, what, advance)
        if not found.readings:
            raise InputErrorText(f"no state can be read, the first since {found.lost[0][1]}")
        advance(WRITE, 0, 1)
        life = described(LIFE, truth_numbers(plan, what, found))
        told = [f"no reading at {utc_text(moment)}: {why}" for moment, why in found.lost]
        with folder:
            write_simulated(folder, plan, experiment, what, found)
            if truth is None:
                folder.write_json(f"{LIFE}.json", life)
            facts = {"backend": backend.name, "seed": what.seed, "frames": what.frames, "warnings": told}
            facts["again"] = list(_again(truth, what, backend))
            write_manifest(folder, PROGRAM, started, time.monotonic() - clock, test="simulate", **facts)
        if truth is not None and str(truth) != NO_TRUTH:
            _write(truth, json_text(life))
        advance(TAKE, 0, 1)
        taken = [] if history is None else take_files(history, folder.target / TELEMETRY)
        advance(TAKE, 1, 1)
    refused = [reason for one in taken for _, reason in one.refused]
    if refused:
        raise InputErrorText(f"{len(refused)} of what was simulated was refused, the first: {refused[0]}")
    return {
        "record": None if history is None else history.url,
        "instrument": plan.model.instrument.name,
        "files": str(folder.target),
        "truth": str(truth or folder.target / f"{LIFE}.json"),
        "readings": len(found.readings),
        "entries": sum(one.new for one in taken),
        "steps": len(found.life.steps),
        "lost": told,
        "seconds": time.monotonic() - clock,
    }


def _again(truth: Path | None, what: Simulation, backend: Backend) -> Iterator[str]:
    """Words of the command that makes the files again in their folder."""
    yield from (PROGRAM, "simulate", CONFIG, *what.words, "--seed", str(what.seed), "--backend", backend.name)
    if truth is not None:  # nothing outside of the folder is written by who makes a run again
        yield from ("--truth", NO_TRUTH)


def take_files(history: History, file: Path) -> list[IngestResult]:
    """Take all tables that a file names into a record.

    Parameters
    ----------
    history : History
        The record.
    file : Path
        That says what the tables hold.
    """
    spec = read_telemetry(file, history)
    every = ((table, path) for table in spec.readings for path in tables_of(spec, table))
    return [history.ingest(read_table_file(table, path, history)) for table, path in every]


def _is_empty(history: History) -> None:
    """Raises InputErrorText: a record to which simulated readings do not belong."""
    if not history.simulated:
        text = "the record is not one of simulated readings; init --simulated makes such a record in another folder"
        raise InputErrorText(f"{history.url}: {text}")
    if history.status()["entries"]:
        raise InputErrorText(f"{history.url}: the record holds readings already; a life begins in a record without any")


def _are_stated(experiment: MonitorExperiment, what: Simulation) -> None:
    """Raises InputErrorText: a sensor on a body that is not stated to get warmer, or that has none."""
    assert experiment.stated is not None  # a plan states something
    warm = {component.body for component in experiment.stated.components if component.kind == "temperature"}
    for body in what.sensors or ():
        _known("--sensor", body, warm)
    options: Mapping[str, Mapping[str, int]] = {"--dead": what.dead, "--stuck": what.stuck}
    for option, bodies in options.items():
        for body in bodies:
            _known(option, body, warm if what.sensors is None else what.sensors)


def _write(place: Path, text: str) -> None:
    """Raises InputErrorText: the file cannot be written."""
    try:
        write_safely(place, text.encode())
    except OSError as error:
        raise InputErrorText(f"--truth: {place} cannot be written: {error.strerror or error}") from None
