"""The benchmarks page: all numbers of one run, in a table or as JSON."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

from tests.benchmarks.limits import Limits, unquiet
from tests.benchmarks.machine import Machine
from tests.benchmarks.number import Number, Speed, keeps, shown
from twin.run.cli import print_whole


@dataclass(frozen=True)
class Page:
    """One run.

    Attributes:
        machine: where.
        speeds: benchmark -> its numbers.
        quick: small sizes: no limit is judged.
        limits: of the numbers, and the machine of reference.
    """

    machine: Machine
    speeds: dict[str, Speed]
    quick: bool
    limits: Limits

    @property
    def missed(self) -> bool:
        """Whether a limit is."""
        return any(self._met(name, number) is False for name, number in self._numbers())

    def _numbers(self) -> Iterator[tuple[str, Number]]:
        return ((name, number) for name, speed in self.speeds.items() for number in speed.numbers)

    def _met(self, name: str, number: Number) -> bool | None:
        return None if self.quick else self.limits.met(name, number, self.speeds[name])

    def _reached(self, name: str, number: Number) -> bool | None:
        """Whether a number is at its target, if it has one and that is judged."""
        if number.target is None or self.quick or unquiet(number, self.speeds[name]):
            return None
        return keeps(self.limits.value(number, self.speeds[name]), number.target, number.least)

    @property
    def data(self) -> dict[str, Any]:
        """For the JSON: numbers as measured and on the machine of reference; what is not judged has ``met`` or
        ``reached`` null.
        """
        limits, targets = [], []
        for name, number in self._numbers():
            value = self.limits.value(number, self.speeds[name])
            base = {"number": f"{name}.{number.key}", "value": value}
            side = "at_least" if number.least else "at_most"
            if number.limited:
                limit = self.limits.limit(name, number)
                bound = None if limit is None else limit.bound
                limits.append({**base, side: bound, "met": self._met(name, number)})
            if number.target is not None:
                targets.append({**base, side: number.target, "reached": self._reached(name, number)})
        out: dict[str, Any] = {name: speed.data for name, speed in self.speeds.items()}
        reference = self.limits.yardsticks
        return {
            **out,
            "at_reference": {name: speed.at_reference(reference) for name, speed in self.speeds.items()},
            "yardsticks": {name: dict(speed.yardsticks) for name, speed in self.speeds.items()},
            "reference": {"machine": self.limits.machine, "yardsticks": dict(reference)},
            "machine": self.machine.data,
            "quick": self.quick,
            "notes": self._notes,
            "limits": limits,
            "targets": targets,
        }

    @property
    def _notes(self) -> list[str]:
        return [note for speed in self.speeds.values() for note in speed.notes]

    def print(self, console: Console) -> None:
        """Table, remarks, yardsticks, machine."""
        table = Table(title="Speed", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
        heads = {"what": "left", "measured": "right", "at reference": "right", "unit": "left", "limit": "right"}
        for head, side in {**heads, "": "left", "target": "right", " ": "left", "scales with": "left"}.items():
            table.add_column(head, justify=side, no_wrap=True)  # type: ignore[arg-type]
        for name, speed in self.speeds.items():
            for number in speed.numbers:
                table.add_row(*self._row(name, number, speed))
            table.add_section()
        print_whole(console, table)
        for line in (*self._notes, *self._remarks(), *self.machine.lines):
            console.print(line, markup=False, highlight=False, soft_wrap=True)

    def _row(self, name: str, number: Number, speed: Speed) -> tuple[str, ...]:
        limit = self.limits.limit(name, number)
        target = "" if number.target is None else f"{number.target:,g}"
        reached = {True: "reached", False: "not reached", None: "not judged" if target else ""}
        return (
            number.text,
            shown(number.value),
            "" if number.pace is None else shown(self.limits.value(number, speed)),
            number.unit,
            "" if limit is None else limit.text,
            self._verdict(name, number),
            target,
            reached[self._reached(name, number)],
            "" if number.pace is None else number.pace.text,
        )

    def _verdict(self, name: str, number: Number) -> str:
        if not number.limited:
            return ""
        if self.limits.limit(name, number) is None:
            return "no limit yet"
        return {True: "[green]met[/]", False: "[bold red]missed[/]", None: "not judged"}[self._met(name, number)]

    def _remarks(self) -> Iterator[str]:
        """What the verdicts rest on."""
        if self.quick:
            yield "quick: small sizes; the numbers are only a sign of life and no limit is judged"
        for name, number in self._numbers():
            limit = self.limits.limit(name, number)
            if limit is not None and not limit.steady:
                yield f"{name}.{number.key}: scatters by {limit.scatter:.0%} between rounds; its limit has room for it"
        for name, speed in self.speeds.items():
            if any(unquiet(number, speed) for number in speed.numbers):
                taken = f"other programs took {speed.others:.0%} of the machine"
                yield f"{name}: {taken}, so that times of the wall clock are not judged"
        for name, speed in self.speeds.items():
            if speed.yardsticks:
                ratios = {key: here / self.limits.yardsticks[key] for key, here in speed.yardsticks.items()}
                listed = ", ".join(f"{key} {ratio:.2f}" for key, ratio in ratios.items())
                yield f"yardsticks of {name}, times those of reference: {listed}"
        yield f"reference: {self.limits.machine}"
