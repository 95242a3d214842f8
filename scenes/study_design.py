"""The design of a study: which combinations of its factors are run."""

import re
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from scenes.errors import Problem, shown
from scenes.spec import Seed, Spec, Whole
from scenes.study_factor import MOST_RUNS


class DesignSpec(Spec):
    """Which combinations of the factors' values are run.

    Attributes:
        kind: grid, every combination; latin_hypercube and sobol, evenly spread over all factors; monte_carlo, drawn
            independently.
        runs: number of runs; a grid has as many as there are combinations.
        seed: of what is drawn, and of the noise of every run.
    """

    kind: Literal["grid", "latin_hypercube", "sobol", "monte_carlo"] = "grid"
    runs: Annotated[Whole, Field(ge=1, le=MOST_RUNS)] | None = None
    seed: Seed = 0

    @model_validator(mode="after")
    def _has_runs(self) -> "DesignSpec":
        if self.kind == "grid" and self.runs is not None:
            found = f"runs: {self.runs}"
            raise Problem("a grid has as many runs as combinations", found, "no runs", within=("runs",))
        if self.kind != "grid" and self.runs is None:
            raise Problem(f"a design of kind {self.kind} needs its number of runs", None, "runs: 1000")
        return self


_MEMORY = re.compile(r"[0-9]{1,6}(\.[0-9]{1,3})? ?(MB|GB)")


def _amount(text: str) -> str:
    if not _MEMORY.fullmatch(text):
        raise Problem("not an amount of memory", shown(text), "a number with MB or GB: 4 GB")
    return text


class LimitsSpec(Spec):
    """What a study may use.

    Attributes:
        runs: more than these are run only with --yes.
        memory: of all processes together, with its unit MB or GB.
    """

    runs: Annotated[Whole, Field(ge=1, le=MOST_RUNS)] = 20_000
    memory: Annotated[str, Field(strict=True), AfterValidator(_amount)] = "4 GB"

    @property
    def bytes(self) -> float:
        """The memory, bytes."""
        return float(self.memory[:-2]) * (1e9 if self.memory.endswith("GB") else 1e6)
