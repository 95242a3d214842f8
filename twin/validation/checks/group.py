"""A group of checks that share work, and what it is given to work with."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from optics.numerics.backend import Backend
from scenes.specs.job import JobSpec
from scenes.specs.resolved import resolve_job
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.run.artefact import Artefact
from twin.validation.checks.check import Check, CheckResult


def matches(identifier: str, prefix: str) -> bool:
    """Whether an id lies under a prefix: ``001.table3`` takes ``001.table3.x`` and itself, but not ``001.table33``."""
    return identifier == prefix or identifier.startswith(f"{prefix}.")


@dataclass(eq=False)
class Context:
    """What the function of a group may use.

    Attributes:
        backend: where to trace.
        seed: of all noise; the same seed must give the same results.
        fast: whether fewer trials have to do; the verdicts must not depend on it.
        selected: ids that are wanted; others need no work, and their results are not kept.
        checks: id -> check, of the whole group.
        report_progress: takes the fraction of the group's work that is done, and what is being done.
        folder: where the group may put files of its own, which the report lists; None when nothing is written.
        experiments: instrument -> experiment, shared by all groups.
        artefacts: added so far.
    """

    backend: Backend
    seed: int
    selected: frozenset[str]
    checks: Mapping[str, Check]
    fast: bool = False
    report_progress: Callable[[float, str], None] = lambda fraction, text: None
    folder: Path | None = None
    experiments: dict[str, MonitorExperiment] = field(default_factory=dict)
    artefacts: list[Artefact] = field(default_factory=list)

    def wants(self, *prefixes: str) -> bool:
        """Whether any selected id lies under one of the prefixes."""
        return any(matches(identifier, prefix) for identifier in self.selected for prefix in prefixes)

    def count(self, full: int, fast: int) -> int:
        """How many trials to make, by the length of the run."""
        return fast if self.fast else full

    def check(self, identifier: str) -> Check:
        """One of the group's checks, to be evaluated.

        Raises:
            KeyError: the group has none of that id.
        """
        return self.checks[identifier]

    def progress(self, fraction: float, text: str) -> None:
        """Say how far the group is, from 0 to 1, and what it does next."""
        self.report_progress(min(max(fraction, 0.0), 1.0), text)

    def experiment(self, instrument: str) -> MonitorExperiment:
        """The monitoring experiment on an instrument of the library, built once for all groups."""
        if instrument not in self.experiments:
            self.experiments[instrument] = MonitorExperiment(resolve_job(JobSpec(instrument=instrument)), self.backend)
        return self.experiments[instrument]

    def add(self, artefact: Artefact) -> None:
        """Show a figure, table or data in the report and keep it in the run folder.

        Raises:
            ValueError: the group has another of that name.
        """
        if any((artefact.name, artefact.kind) == (other.name, other.kind) for other in self.artefacts):
            raise ValueError(f"two artefacts {artefact.name}.{artefact.kind} in one group")
        self.artefacts.append(artefact)


Run = Callable[[Context], Iterable[CheckResult]]


@dataclass(frozen=True)
class CheckGroup:
    """Checks that share work.

    Attributes:
        prefix: name of the group, beginning with the paper's number; where all its ids share a prefix, that.
        title: what it is about, for the report.
        seconds: rough computing time on two cores.
        checks: everything it checks.
        run: does it; yields one result for every selected check, as soon as it has it.
        fast_seconds: rough time of the fast run, None where that is the same.
    """

    prefix: str
    title: str
    seconds: float
    checks: tuple[Check, ...]
    run: Run
    fast_seconds: float | None = None

    def __post_init__(self) -> None:
        """Refuse groups that cannot be told apart or shown."""
        if not self.checks or self.seconds <= 0 or (self.fast_seconds is not None and self.fast_seconds <= 0):
            raise ValueError(f"group {self.prefix!r} needs checks and a rough time > 0")
        if not self.prefix.replace(".", "").replace("_", "").isalnum():
            raise ValueError(f"group prefix {self.prefix!r}: only letters, digits, _ and dots can be used")
        if any(check.paper != self.prefix.partition(".")[0] for check in self.checks):
            raise ValueError(f"group {self.prefix!r} holds checks of another paper")

    def rough_seconds(self, fast: bool) -> float:
        """Rough computing time of the full or the fast run."""
        return self.seconds if self.fast_seconds is None or not fast else self.fast_seconds

    @property
    def ids(self) -> tuple[str, ...]:
        """Ids of its checks."""
        return tuple(check.id for check in self.checks)
