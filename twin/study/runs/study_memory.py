"""What the table of a study's runs takes of the memory of the process that keeps it, told before the first run."""

from __future__ import annotations

from scenes.specs.study import GRID
from scenes.yaml.errors import KeyPath
from twin.run.memory import LIMIT, amount_text, free_memory, largest
from twin.study.runs.sampling import run_count
from twin.study.runs.setup import StudySetup

STARTED = 110e6
"""Of a study of any size when its report is written, beside the imported program, bytes."""
CELL = 120.0
"""Of a number of a run: as it is computed and kept, in the data set, and in the table of text that becomes a file;
bytes."""
_KEPT = 5
"""Columns of every study: number, failed, message, doubt, seed."""


def study_bytes(setup: StudySetup, runs: int) -> float:
    """Memory of the process that keeps the results, beside the imported program, bytes.

    Args:
        setup: the study.
        runs: of it.
    """
    responses = setup.study.responses.values()
    columns = _KEPT + len(setup.study.factors) + sum(1 + len(one.stated) for one in responses)
    return STARTED + CELL * columns * runs


def require_study_memory(setup: StudySetup) -> None:
    """See whether the results of all runs fit into the memory that is free and that the study may use.

    Args:
        setup: the study.

    Raises:
        InputError: they do not; with the number of runs that would.
    """
    study, runs = setup.study, run_count(setup.study)
    free = free_memory()
    own = study.limits.bytes < free
    most = min(free, study.limits.bytes)
    need = study_bytes(setup, runs)
    if need <= most:
        return
    fewer = largest(lambda n: study_bytes(setup, n) <= most, runs)
    key: KeyPath = ("factors",) if study.design.kind == GRID else ("design", "runs")
    more = (
        "a larger limits.memory" if own else f"more memory (the environment variable {LIMIT}, as 8 GB, says how much)"
    )
    raise setup.error(
        f"the results of {runs} runs need about {amount_text(need)} of memory, and {amount_text(most)} may be taken",
        key,
        allowed=f"at most {fewer} runs, or {more}",
    )
