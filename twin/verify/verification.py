"""What is said of a run folder that was verified: one verdict, and the numbers it rests on."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from twin.run.cli import time_text
from twin.run.report import one_sentence
from twin.verify.file_difference import DIFFERENT, LEFT_OUT, REDRAWN, ROUNDED, SAME, FileDifference
from twin.verify.folder_state import FolderState
from twin.verify.repetition import Repetition

EQUAL, UNEQUAL, CANNOT = 0, 1, 2
"""Exit codes."""
NAMED = 5
"""Files that a sentence names at most."""


@dataclass(frozen=True)
class Verification:
    """A verified run folder.

    Attributes:
        state: of its files.
        repetition: the run made again, None where it was not.
        obstacle: why it was not, empty where nobody asked for it.
    """

    state: FolderState
    repetition: Repetition | None = None
    obstacle: str = ""

    @property
    def code(self) -> int:
        """Exit code."""
        if not self.state.whole or (self.repetition is not None and self.repetition.state == DIFFERENT):
            return UNEQUAL
        return CANNOT if self.obstacle else EQUAL

    @property
    def verdict(self) -> str:
        """In one sentence: are the files as they were, does the run come out the same, and where was it made."""
        state, count = self.state, len(self.state.manifest.sha256)
        told = [
            f"{_files(names)} {what}"
            for names, what in (
                (state.changed, "not as the run wrote them" if len(state.changed) > 1 else "not as the run wrote it"),
                (state.missing, "missing"),
                (state.additional, "not of the run"),
            )
            if names
        ]
        first = "; ".join(told) if told else f"All {count} files are as the run wrote them"
        return one_sentence(first, *self._repeated())

    def _repeated(self) -> list[str]:
        if self.obstacle:
            return [f"it cannot be made again: {self.obstacle}"]
        made = self.repetition
        if made is None:
            return ["it was not made again"]
        what = made.what or "the run"
        compared = [one for one in made.files if one.state != LEFT_OUT]
        if made.state == SAME:
            out = [f"made again, {what} came out the same in all {len(compared)} files that hold numbers"]
        elif made.state == ROUNDED:
            rounded = [one for one in compared if one.state in (ROUNDED, REDRAWN)]
            out = [
                f"made again, {what} came out the same but for rounding in {len(rounded)} of {len(compared)} files: "
                f"numbers by {_largest(rounded)} at most"
            ]
        else:
            worst = [one for one in compared if one.state not in (SAME, ROUNDED, REDRAWN)]
            out = [f"made again, {what} came out different in {_named([one.file for one in worst])}"]
        where = made.elsewhere
        if not where.known:
            out.append("the manifest does not say on which processor and by which source it was made")
        if where.program:
            out.append(f"another program made it: {_named(where.program)}")
        if where.processor:
            out.append(f"it was made elsewhere: {_named(where.processor)}")
        if made.state != SAME and where.known and not where.program and not where.processor:
            out.append("the program and the processor are the same")
        return out

    def numbers(self) -> dict[str, Any]:
        """As plain data, for ``--json``."""
        state, made = self.state, self.repetition
        manifest = state.manifest
        return {
            "run": str(state.folder),
            "of": " ".join(filter(None, (manifest.program, manifest.test))),
            "whole": state.whole,
            "files": len(manifest.sha256),
            "changed": list(state.changed),
            "missing": list(state.missing),
            "additional": list(state.additional),
            "sealed": state.sealed,
            "inputs_changed": list(state.inputs_changed),
            "inputs_gone": list(state.inputs_gone),
            "made_again": None
            if made is None
            else {
                "state": made.state,
                "what": made.what or "the whole run",
                "seconds": made.seconds,
                "other_program": list(made.elsewhere.program),
                "other_processor": list(made.elsewhere.processor),
                "provenance_known": made.elsewhere.known,
                "files": [_plain(one) for one in made.files],
            },
            "cannot": self.obstacle,
            "checks": manifest.checks,
            "verdict": self.verdict,
        }

    def lines(self) -> list[str]:
        """What a reader should know beside the verdict."""
        state, out = self.state, []
        if not state.sealed:
            out.append("the manifest has no checksum of itself: it is of an older version")
        out += [f"read by the run and changed since: {name}" for name in state.inputs_changed]
        out += [f"read by the run and gone: {name}" for name in state.inputs_gone]
        for one in () if self.repetition is None else self.repetition.files:
            if one.state in (SAME, LEFT_OUT):
                continue
            count = f", {one.count} quantities" if one.count else ""
            out.append(f"{one.file}: {one.state}{count}{f', {one.why}' if one.why else ''}")
            for found in one.quantities[:NAMED]:
                size = "" if found.relative is None else f", {found.relative:.2g} of it"
                sigma = "" if found.in_sigma is None else f", {found.in_sigma:.2g} sigma"
                out.append(f"    {found.key}: {found.old!r} then, {found.new!r} now{size}{sigma}")
        return out


def expected_time(state: FolderState) -> str:
    """How long making a run again will take, as one says it."""
    return time_text(state.manifest.wall_time_s)


def _plain(one: FileDifference) -> dict[str, Any]:
    return {
        "file": one.file,
        "state": one.state,
        "quantities": one.count,
        "why": one.why,
        "differ_most": [asdict(found) for found in one.quantities],
    }


def _largest(files: list[FileDifference]) -> str:
    relative = max((one.largest for one in files if not one.drawn), default=0.0)
    in_sigma = [one.largest_in_sigma for one in files if one.largest_in_sigma is not None]
    return f"{relative:.2g} of them" + (f" and {max(in_sigma):.2g} sigma" if in_sigma else "")


def _named(names: Any) -> str:
    every = list(names)
    return ", ".join(every[:NAMED]) + (f" and {len(every) - NAMED} more" if len(every) > NAMED else "")


def _files(names: tuple[str, ...]) -> str:
    return f"{_named(names)} {'is' if len(names) == 1 else 'are'}"
