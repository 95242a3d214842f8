"""What every command takes of memory and time: for each of them its model, or the reason why it needs none."""

from __future__ import annotations

from collections.abc import Mapping

from scenes.specs.procedures import PROCEDURES, Brief
from scenes.yaml.named import Named

MODELS: Mapping[str, Named] = {
    "render": Named("twin.main_job.render_cost:render_cost"),
    "recover": Named("twin.recover.recover_cost:recover_cost"),
    "study": Named("twin.study.runs.plan:study_cost"),
    "tolerance": Named("twin.tolerance.tolerance_cost:tolerance_cost"),
    "operate simulate": Named("twin.operate.lives.life_cost:simulation_cost"),
    "operate judge": Named("twin.operate.lives.life_cost:judging_cost"),
    "uncertainty": Named("twin.uncertainty.coverage_cost:coverage_cost"),
    "validate": Named("twin.validation.runner:validation_cost"),
}
"""Command after ``camtwin`` -> what it takes, a function of what its files and options say."""

_RECORD = "It reads and adds to a record; a reading takes milliseconds, and how many there are the record alone knows."
BRIEF: Mapping[str, Brief] = {
    "live": Brief("It shows one state at a time; more memory than there is the monitor itself refuses."),
    "orbit export": Brief("Models are fitted at some ten thousand points of each line, however long its images are."),
    **{
        f"operate {name}": Brief(_RECORD)
        for name in (
            "init",
            "ingest",
            "status",
            "export",
            "forecast",
            "alarms",
            "products",
            "report",
            "exclude",
        )
    },
    "camera": Brief("Fields, rays and frequencies are the same for every camera: some 12 s and 0.4 GB."),
    "lens read": Brief("A prescription has 2000 surfaces at most."),
    "lens write": Brief("A prescription has 2000 surfaces at most."),
    "mtf": Brief("A region of more than four million pixels is refused by the reader of images: 1 GB."),
    "compare": Brief("It reads the numbers and pictures of run folders."),
    "verify": Brief("It compares checksums; what it repeats is the run's own command, which says what it takes."),
    "export": Brief("It copies frames and tables file by file."),
    "schema": Brief("It writes schemas of files."),
    "doctor": Brief("It looks at the machine."),
}
"""Command after ``camtwin`` -> why it never takes much."""


def every_cost() -> dict[str, Named | Brief | None]:
    """Command after ``camtwin`` -> its model, or why it needs none; None where neither is stated. Tests of
    `PROCEDURES` state theirs there.
    """
    return {**{name: one.cost for name, one in PROCEDURES.items()}, **MODELS, **BRIEF}
