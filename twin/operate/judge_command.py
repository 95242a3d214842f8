"""``python -m twin.operate judge``: a simulated life, followed and held against its truth, as a run folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from scenes.specs.operation import OperationSetup
from scenes.yaml.input_file import read_json
from scenes.yaml.spec import validate
from scenes.yaml.yaml_file import dump_yaml, read_yaml
from twin.operate.lives.simulate import FOLDER, LIFE, TELEMETRY
from twin.operate.record.run_readings import CONFIG
from twin.run.cli import InputErrorText, Options
from twin.run.command import Result, finished, run_command
from twin.run.procedure import Session

KIND = "judged"


def judge_life(place: Path, truth: Path | None, options: Options) -> None:
    """Follow a life and write what was said of it against the truth.

    Args:
        place: folder of its record, or of its files.
        truth: file of the truth; None for that among the files.
        options: of the command.
    """
    files = place / FOLDER if (place / FOLDER).is_dir() else place
    known = files / f"{LIFE}.json" if truth is None else truth

    def resolve() -> OperationSetup:
        if not (files / TELEMETRY).is_file():
            raise InputErrorText(f"no simulated life in {place}; python -m twin.operate simulate makes one")
        if not known.is_file():
            raise InputErrorText(f"no truth in {known}; --truth names the file that simulate wrote")
        _truth(known)  # a wrong one is told before anything is followed
        return validate(OperationSetup, read_yaml(files / CONFIG))

    def work(plan: OperationSetup, session: Session) -> Result:
        from twin.operate.lives.judged_life import judged
        from twin.operate.lives.judged_report import judged_numbers, judged_report

        life = judged(plan, files / TELEMETRY, _truth(known), session.advance)
        numbers = judged_numbers(life)
        named = (str(place), *(() if truth is None else ("--truth", str(truth))))
        again = ("twin.operate", "judge", *named)
        facts: dict[str, Any] = {
            "config": dump_yaml(plan.plain()),
            "command": "judge",
            "again": again,
            "given": (files / TELEMETRY, known),
        }
        report = judged_report(life, plan.model.instrument.name)
        return finished(session, KIND, report, numbers, program="twin.operate", **facts)

    run_command("judged", options, resolve, work)


def _truth(file: Path) -> dict[str, Any]:
    """Plain data of a truth. Raises InputErrorText, InputError: it cannot be read, or is none."""
    data = read_json(file)
    if not isinstance(data, dict) or not {"times_us", "cameras"} <= set(data):
        raise InputErrorText(f"{file}: not the truth of a simulated life")
    return data
