"""Several runs against the first of them, and what compare.json says of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scenes.yaml.errors import InputError, Issue
from twin.compare.run_differences import Differences, RunResults, differences, read_run

PROGRAM = "twin.compare"
KIND = "compare"


@dataclass(frozen=True, eq=False)
class Comparison:
    """Runs of one kind beside each other.

    Attributes:
        runs: the first is the reference.
        found: of every other one, what differs from the reference.
        rtol: numbers that agree to this part are the same.
        sigmas: differences within so many sigma do not count, None where all do.
    """

    runs: tuple[RunResults, ...]
    found: tuple[Differences, ...]
    rtol: float
    sigmas: float | None

    @property
    def same(self) -> bool:
        """Whether no result of any run differs from the reference's."""
        return all(one.same for one in self.found)

    @property
    def names(self) -> tuple[str, ...]:
        """What tells the folders apart, shortest first: their names, or their paths where two have one name."""
        names = [run.folder.resolve().name for run in self.runs]
        return tuple(names if len(set(names)) == len(names) else [str(run.folder) for run in self.runs])


def compare(folders: Sequence[Path], rtol: float, sigmas: float | None) -> Comparison:
    """Read run folders and compare them with the first.

    Raises:
        InputError: fewer than two, no run folder, or runs of several kinds.
    """
    if len(folders) < 2:
        raise InputError(Issue("a comparison needs two runs or more", found=f"{len(folders)}"))
    runs = tuple(read_run(folder) for folder in folders)
    return Comparison(runs, tuple(differences(runs[0], other, rtol, sigmas) for other in runs[1:]), rtol, sigmas)


def numbers(comparison: Comparison) -> Mapping[str, Any]:
    """Contents of compare.json."""
    others = []
    for run, found in zip(comparison.runs[1:], comparison.found, strict=True):
        others.append(
            {
                "run": str(run.folder),
                "same": found.same,
                "compared": found.compared,
                "inputs": [vars(one) for one in found.inputs],
                "numbers": [
                    {**vars(one), "difference": _finite(one.difference), "in_sigma": _finite(one.in_sigma)}
                    for one in found.numbers
                ],
                "arrays": [vars(one) for one in found.arrays],
            }
        )
    return {
        "kind": comparison.runs[0].kind,
        "reference": str(comparison.runs[0].folder),
        "same": comparison.same,
        "rtol": comparison.rtol,
        "sigmas": comparison.sigmas,
        "others": others,
    }


def _finite(value: float | None) -> float | None:
    return value if value is not None and abs(value) < float("inf") else None


def verdict(comparison: Comparison) -> str:
    """The answer in a sentence or two."""
    parts = []
    for name, found in zip(comparison.names[1:], comparison.found, strict=True):
        inputs = f"{len(found.inputs)} input{'s' * (len(found.inputs) != 1)}" if found.inputs else "no input"
        if found.same:
            parts.append(
                f"{name} gave the same as {comparison.names[0]} ({inputs} changed, {found.compared} compared)."
            )
            continue
        what = [f"{len(found.numbers)} numbers"] * bool(found.numbers) + [f"{len(found.arrays)} images"] * bool(
            found.arrays
        )
        text = (
            f"{name} differs from {comparison.names[0]} in {' and '.join(what)} of {found.compared}; {inputs} changed"
        )
        far = max(found.numbers, key=lambda one: abs(one.in_sigma or 0.0), default=None)
        if far is not None and far.in_sigma is not None:
            text += f"; the largest change for its sigma is {far.key}, {far.in_sigma:+.3g} sigma"
        parts.append(text + ".")
    return " ".join(parts)
