"""The limits of the page's numbers: what was reached on a machine of reference, with a margin. `limits.json` has them.

A number is judged by its value on the machine whose yardsticks the file states (`tests.benchmarks.yardsticks`).
``python -m tests.benchmarks --tighten`` sets limits to what some rounds reach. It makes none wider, unless ``--loosen``
names it and ``--why`` gives the reason.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from statistics import median
from typing import Any

from tests.benchmarks.beside import commit_here
from tests.benchmarks.machine import Machine
from tests.benchmarks.number import Number, Speed, keeps
from twin.run.cli import InputErrorText
from twin.run.durable import write_safely

FILE = Path(__file__).with_name("limits.json")
MARGIN = 0.2
"""Between what was reached and its limit."""
STEADY = 0.15
"""Scatter between rounds up to which a limit stands on their middle; beyond it stands on the worst of them."""
QUIET = 0.1
"""Share of the machine that other programs may take while a time of the wall clock is judged."""


@dataclass(frozen=True)
class Limit:
    """A bound, and what gave it.

    Attributes:
        bound: at least (``least``) or at most so much, on the machine of reference.
        least: which of both.
        reached: what the bound stands on, there; None for one that was stated and not reached.
        scatter: largest over least value of the rounds, less 1; None of one round.
        date, commit, machine: of the rounds.
        yardsticks: of their middle round, seconds: those of the number's pace.
        why: of a bound that stands on more than what was reached.
    """

    bound: float
    least: bool
    reached: float | None = None
    scatter: float | None = None
    date: str = ""
    commit: str = ""
    machine: str = ""
    yardsticks: Mapping[str, float] = field(default_factory=dict)
    why: str = ""

    def met(self, value: float) -> bool:
        """Whether a number keeps to it; NaN does not."""
        return keeps(value, self.bound, self.least)

    @property
    def steady(self) -> bool:
        """Whether the number scatters as little as the margin supposes."""
        return self.scatter is None or self.scatter <= STEADY

    @property
    def text(self) -> str:
        """With its sign."""
        return f"{'>=' if self.least else '<='} {self.bound:,.10g}"

    @property
    def data(self) -> dict[str, Any]:
        """For the file; what is not known is left out."""
        known = {key: value for key, value in asdict(self).items() if key not in ("bound", "least") and value}
        return {("at_least" if self.least else "at_most"): self.bound, **known}

    @classmethod
    def of(cls, data: Mapping[str, Any]) -> Limit:
        """Of the file."""
        least = "at_least" in data
        others = {key: value for key, value in data.items() if key not in ("at_least", "at_most")}
        return cls(data["at_least" if least else "at_most"], least, **others)


@dataclass(frozen=True)
class Origin:
    """What gave limits: the day, the commit, the machine."""

    date: str
    commit: str
    machine: str

    @classmethod
    def here(cls, machine: Machine) -> Origin:
        """Today's, of the sources that run."""
        words = f"{machine.processor}, {machine.cores} cores"
        return cls(datetime.now(UTC).date().isoformat(), commit_here(), words)


@dataclass(frozen=True)
class Limits:
    """All limits.

    Attributes:
        machine: of reference, in words.
        yardsticks: yardstick -> seconds on it.
        limits: benchmark and number, with a dot between them -> limit.
    """

    machine: str
    yardsticks: Mapping[str, float]
    limits: Mapping[str, Limit]

    @classmethod
    def read(cls, file: Path = FILE) -> Limits:
        """Those of a file."""
        data = json.loads(file.read_text("utf-8"))
        limits = {key: Limit.of(one) for key, one in data["limits"].items()}
        return cls(data["reference"]["machine"], data["reference"]["yardsticks"], limits)

    def write(self, file: Path = FILE) -> None:
        """Into a file, in the order of their names."""
        data = {
            "reference": {"machine": self.machine, "yardsticks": dict(self.yardsticks)},
            "limits": {key: one.data for key, one in sorted(self.limits.items())},
        }
        write_safely(file, (json.dumps(data, indent=2) + "\n").encode())

    def value(self, number: Number, speed: Speed) -> float:
        """A number on the machine of reference."""
        return number.at_reference(speed.yardsticks, self.yardsticks)

    def limit(self, benchmark: str, number: Number) -> Limit | None:
        """That of a number, if it is to have one and has one yet."""
        return self.limits.get(f"{benchmark}.{number.key}") if number.limited else None

    def met(self, benchmark: str, number: Number, speed: Speed) -> bool | None:
        """Whether a number keeps to its limit; None where that is not judged."""
        limit = self.limit(benchmark, number)
        if limit is None or unquiet(number, speed):
            return None
        return limit.met(self.value(number, speed))

    def tightened(
        self, rounds: Sequence[Mapping[str, Speed]], origin: Origin, loosened: Mapping[str, str]
    ) -> tuple[Limits, list[str]]:
        """Limits that stand on what some rounds reached, where these are narrower than before.

        Args:
            rounds: benchmark -> what it gave, of each round.
            origin: of the rounds.
            loosened: names of numbers whose limit may become wider -> why.

        Returns:
            The limits, and a line on each number.

        Raises:
            InputErrorText: a name that is to be loosened is not among the numbers that have a limit.
        """
        numbers = {
            f"{name}.{number.key}": (name, number)
            for name, speed in rounds[0].items()
            for number in speed.numbers
            if number.limited
        }
        if unknown := loosened.keys() - numbers.keys():
            raise InputErrorText(f"no limit {', '.join(sorted(unknown))}; there are {', '.join(numbers)}")
        found, lines = dict(self.limits), []
        for key, (name, number) in numbers.items():
            speeds = [one[name] for one in rounds]
            if any(unquiet(number, speed) for speed in speeds):
                lines.append(f"{key}: left, since other programs were at work while the clock ran")
                continue
            values = [self.value(_numbered(speed, number.key), speed) for speed in speeds]
            new, old = self._standing_on(values, number, speeds, origin), found.get(key)
            wider = old is not None and not keeps(new.bound, old.bound, old.least)
            same = old is not None and old.reached is not None and new.bound == old.bound  # its reason stays, too
            if old is not None and key not in loosened and (wider or same):
                lines.append(f"{key}: stays {old.text}, reached {_least_of(new):.3g} (--loosen {key} --why TEXT)")
                continue
            if old is not None and key in loosened:
                why = f"loosened from {old.bound:g}: {loosened[key]}"
                new = replace(new, why="; ".join(part for part in (new.why, why) if part))
            found[key] = new
            lines.append(f"{key}: {'new' if old is None else old.text} -> {new.text}, reached {_least_of(new):.3g}")
        return replace(self, limits=found), lines

    def _standing_on(self, values: list[float], number: Number, speeds: list[Speed], origin: Origin) -> Limit:
        scatter = max(values) / min(values) - 1.0 if len(values) > 1 else None
        steady = scatter is None or scatter <= STEADY
        reached = median(values) if steady else (min(values) if number.least else max(values))
        why = "" if steady else f"scatters by {scatter:.0%}: stands on the worst of {len(values)} rounds"
        return Limit(
            beyond(reached, number.least),
            number.least,
            float(f"{reached:.4g}"),
            None if scatter is None else round(scatter, 3),
            origin.date,
            origin.commit,
            origin.machine,
            {name: _middle(speeds, name) for name in (number.pace.shares if number.pace else ())},
            why,
        )


def unquiet(number: Number, speed: Speed) -> bool:
    """Whether a number is of the wall clock, and other programs were at work."""
    return number.clock and speed.others > QUIET


def beyond(reached: float, least: bool) -> float:
    """What was reached with the margin, to two digits, the last of which leaves more room.

    Args:
        reached: positive.
        least: whether more is better.
    """
    bound = reached / (1.0 + MARGIN) if least else reached * (1.0 + MARGIN)
    step = math.floor(math.log10(bound)) - 1
    digits = bound / 10.0**step
    # what is two digits already stays so whatever the last bit says
    whole = math.floor(digits + 1e-9) if least else math.ceil(digits - 1e-9)
    return float(f"{whole}e{step}")


def _numbered(speed: Speed, key: str) -> Number:
    return next(number for number in speed.numbers if number.key == key)


def _middle(speeds: list[Speed], name: str) -> float:
    return float(f"{median(speed.yardsticks[name] for speed in speeds):.3g}")


def _least_of(limit: Limit) -> float:
    assert limit.reached is not None
    return limit.reached
