"""The benchmarks page: all numbers of one run, in a table or as JSON."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

from tests.benchmarks.machine import Machine
from tests.benchmarks.number import Number, Speed
from twin.run.cli import print_whole


@dataclass(frozen=True)
class Page:
    """One run.

    Attributes:
        machine: where.
        speeds: benchmark -> its numbers.
        quick: small sizes: no limit is judged.
    """

    machine: Machine
    speeds: dict[str, Speed]
    quick: bool

    @property
    def missed(self) -> bool:
        """Whether a limit is."""
        return not self.quick and any(not n.met for speed in self.speeds.values() for n in speed.numbers)

    @property
    def data(self) -> dict[str, Any]:
        """For the JSON; a limit of a quick run has ``met`` null."""
        limits = [
            {
                "number": f"{name}.{number.key}",
                "value": number.value,
                ("at_least" if number.limit.least else "at_most"): number.limit.bound,
                "met": None if self.quick else number.met,
            }
            for name, speed in self.speeds.items()
            for number in speed.numbers
            if number.limit is not None
        ]
        out: dict[str, Any] = {name: speed.data for name, speed in self.speeds.items()}
        notes = [note for speed in self.speeds.values() for note in speed.notes]
        return {**out, "machine": self.machine.data, "quick": self.quick, "notes": notes, "limits": limits}

    def print(self, console: Console) -> None:
        """Table, remarks, machine."""
        table = Table(title="Speed", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
        for head, side in (("what", "left"), ("number", "right"), ("unit", "left"), ("limit", "right"), ("", "left")):
            table.add_column(head, justify=side, no_wrap=True)  # type: ignore[arg-type]
        for speed in self.speeds.values():
            for number in speed.numbers:
                limit = "" if number.limit is None else number.limit.text
                table.add_row(number.text, shown(number.value), number.unit, limit, self._verdict(number))
            table.add_section()
        print_whole(console, table)
        notes = [note for speed in self.speeds.values() for note in speed.notes]
        if self.quick:
            notes.append("quick: small sizes; the numbers are only a sign of life and no limit is judged")
        for line in (*notes, *self.machine.lines):
            console.print(line, markup=False, highlight=False, soft_wrap=True)

    def _verdict(self, number: Number) -> str:
        if number.limit is None:
            return ""
        if self.quick:
            return "not judged"
        return "[green]met[/]" if number.met else "[bold red]missed[/]"


def shown(value: float) -> str:
    """Three digits, with commas; powers of ten for what is tiny."""
    if value == 0.0 or not math.isfinite(value):
        return f"{value:g}"
    if abs(value) < 1e-3:
        return f"{value:.1e}"
    digits = 2 - math.floor(math.log10(abs(value)))
    return f"{round(value, digits):,.{max(digits, 0)}f}"
