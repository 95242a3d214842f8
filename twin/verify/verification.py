"""A run made again from what its folder holds, and the verdict on that folder.

A whole run is made by its command in a process of its own; of a study one chunk is computed here.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from scenes.yaml.errors import InputError
from scenes.yaml.input_file import why_unreadable
from twin.monitor.calibration_cache import recomputed
from twin.run import cli, data_files, provenance, report, run_folder
from twin.study.runs import setup, task
from twin.study.runs.base_job import BlockResult
from twin.study.runs.chunk_store import FOLDER, ChunkError, ChunkStore, examined
from twin.study.runs.plan import Plan
from twin.study.study_files import make_dataset, summary
from twin.verify import file_difference as difference
from twin.verify.folder_state import Elsewhere, FolderState, elsewhere

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
        if not self.state.whole or (self.repetition is not None and self.repetition.state == difference.DIFFERENT):
            return UNEQUAL
        return CANNOT if self.obstacle else EQUAL

    @property
    def verdict(self) -> str:
        """In a few sentences: are the files as they were, does the run come out the same, and where was it made."""
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
        return " ".join(map(report.sentence, (first, *self._repeated())))

    def _repeated(self) -> list[str]:
        if self.obstacle:
            return [f"it cannot be made again: {self.obstacle}"]
        made = self.repetition
        if made is None:
            return ["it was not made again"]
        what = made.what or "the run"
        compared = [one for one in made.files if one.state != difference.LEFT_OUT]
        if made.state == difference.SAME:
            out = [f"made again, {what} came out the same in all {len(compared)} files that hold numbers"]
        elif made.state == difference.ROUNDED:
            rounded = [one for one in compared if one.state in (difference.ROUNDED, difference.REDRAWN)]
            out = [
                f"made again, {what} came out the same but for rounding in {len(rounded)} of {len(compared)} files: "
                f"numbers by {_largest(rounded)} at most"
            ]
        else:
            worst = [
                one for one in compared if one.state not in (difference.SAME, difference.ROUNDED, difference.REDRAWN)
            ]
            out = [f"made again, {what} came out different in {_named([one.file for one in worst])}"]
        where = made.elsewhere
        if not where.known:
            out.append("the manifest does not name the processor and the source that made it")
        if where.program:
            out.append(f"another program made it: {_named(where.program)}")
        if where.processor:
            out.append(f"it was made elsewhere: {_named(where.processor)}")
        if made.state != difference.SAME and where.known and not where.program and not where.processor:
            out.append("the program and the processor are the same")
        return out

    def numbers(self) -> dict[str, Any]:
        """What was found as plain data, for ``--json``."""
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
            if one.state in (difference.SAME, difference.LEFT_OUT):
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
    return cli.time_text(state.manifest.wall_time_s)


def _plain(one: difference.FileDifference) -> dict[str, Any]:
    return {
        "file": one.file,
        "state": one.state,
        "quantities": one.count,
        "why": one.why,
        "differ_most": [asdict(found) for found in one.quantities],
    }


def _largest(files: list[difference.FileDifference]) -> str:
    relative = max((one.largest for one in files if not one.drawn), default=0.0)
    in_sigma = [one.largest_in_sigma for one in files if one.largest_in_sigma is not None]
    return f"{relative:.2g} of them" + (f" and {max(in_sigma):.2g} sigma" if in_sigma else "")


def _named(names: Any) -> str:
    every = list(names)
    return ", ".join(every[:NAMED]) + (f" and {len(every) - NAMED} more" if len(every) > NAMED else "")


def _files(names: tuple[str, ...]) -> str:
    return f"{_named(names)} {'is' if len(names) == 1 else 'are'}"


CONFIG = "config.yaml"


class CannotRepeat(Exception):
    """A run cannot be made again; the message says why."""


@dataclass(frozen=True)
class Repetition:
    """A run that was made again.

    Attributes:
        files: every file of the folder that was compared.
        elsewhere: what is not the same here as where the run was made.
        seconds: that it took.
        what: was made again, where that is not the whole run.
    """

    files: tuple[difference.FileDifference, ...]
    elsewhere: Elsewhere
    seconds: float
    what: str = ""

    @property
    def state(self) -> str:
        """SAME, ROUNDED or DIFFERENT: of the file that differs most."""
        states = {one.state for one in self.files}
        if states - {difference.SAME, difference.ROUNDED, difference.REDRAWN, difference.LEFT_OUT}:
            return difference.DIFFERENT
        return difference.ROUNDED if states & {difference.ROUNDED, difference.REDRAWN} else difference.SAME


def obstacle(state: FolderState) -> str:
    """Why a run cannot be made again from its folder; empty where it can."""
    manifest = state.manifest
    if not manifest.again:
        if manifest.provenance is None:
            return "it was made by an older version, whose manifest does not say by which command"
        return (
            "it holds measurements that a test wrote beside its run (--export); the run folder of the test can be "
            "verified"
        )
    made_of = [name for name in (*state.changed, *state.missing) if _goes_in(name)]
    if made_of:
        return f"what it was made of is not as it was: {', '.join(made_of)}"
    if state.inputs_gone:
        return f"files that it read are gone: {', '.join(state.inputs_gone)}"
    if state.inputs_changed:
        return f"files that it read have changed since: {', '.join(state.inputs_changed)}"
    return ""


def _goes_in(name: str) -> bool:
    """Whether a file of a run folder is what the run was made of."""
    return name == CONFIG or name.split("/")[0] in ("deformation", "temperature", "finish")


@recomputed()  # a repetition takes nothing over from the run that it checks
def repeat(state: FolderState, place: Path, quiet: bool) -> Repetition:
    """Make a whole run again, and compare every file.

    Args:
        state: of its folder; nothing is in the way.
        place: where to make it; does not exist.
        quiet: tell nothing meanwhile.

    Raises:
        CannotRepeat: the command does not make it.
    """
    manifest, began = state.manifest, time.monotonic()
    words = [str(state.folder.resolve() / CONFIG) if word == CONFIG else word for word in manifest.again]
    started_in = manifest.started_in or str(place.parent)
    if not Path(started_in).is_dir():
        raise CannotRepeat(f"the folder in which it was started is gone: {started_in}")
    # modules are those of this program, whatever lies in the folder where it starts
    command = [sys.executable, "-P", "-m", f"{provenance.BEFORE}{words[0]}", *words[1:], "--out", str(place.absolute())]
    command += ["--quiet"] if quiet and manifest.program != "twin.validate" else []
    paths = os.pathsep.join(
        filter(
            None, (str(provenance.ROOT.parent if provenance.BEFORE else provenance.ROOT), os.environ.get("PYTHONPATH"))
        )
    )
    with subprocess.Popen(
        command,
        cwd=started_in,
        env={**os.environ, "PYTHONPATH": paths},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE if quiet else None,
        text=True,
    ) as process:
        try:
            _, said = process.communicate()
        except BaseException:
            process.send_signal(signal.SIGTERM)
            process.wait()
            raise
    made = run_folder.read_manifest(place)
    if made is None:
        told = " ".join((said or "").split()[-60:])
        raise CannotRepeat(f"{' '.join(words)} ended with exit code {process.returncode}{': ' if told else ''}{told}")
    where = elsewhere(manifest, made.provenance, made.versions)
    other = bool(where.processor)
    names = dict.fromkeys((*manifest.sha256, *made.sha256))
    files = [difference.file_difference(name, state.folder / name, place / name, other) for name in names]
    return Repetition(tuple(of_rounded(files)), where, time.monotonic() - began)


def of_rounded(files: Sequence[difference.FileDifference]) -> Iterator[difference.FileDifference]:
    """Pictures of numbers that are the same but for rounding are not different results.

    Args:
        files: of one run, as compared.
    """
    numbers = {one.state for one in files if not one.drawn}
    rounded = difference.ROUNDED in numbers and not numbers - {difference.SAME, difference.ROUNDED, difference.LEFT_OUT}
    for one in files:
        yield (
            replace(one, state=difference.REDRAWN)
            if rounded and one.drawn and one.state == difference.DIFFERENT
            else one
        )


@recomputed()
def repeat_chunk(state: FolderState) -> Repetition:
    """Make one chunk of a study again, the one in the middle, and hold all chunks against the study's data set.

    Args:
        state: of its folder; nothing is in the way.

    Raises:
        CannotRepeat: its chunks are not there, or not whole.
        InputError: its config.yaml cannot be read.
    """
    began, folder = time.monotonic(), state.folder
    try:
        plan = Plan.of(setup.resolve_study(folder / CONFIG))
        store = ChunkStore(folder, plan)
        store.entries.update({entry.first: entry for entry in examined(folder).whole})
        whole = store.result() if not store.missing else None
    except (ChunkError, InputError) as error:
        raise CannotRepeat(str(error)) from error
    if whole is None:
        raise CannotRepeat("its chunks are not whole; --all makes the whole study again")
    entry = store.entries[sorted(store.entries)[len(store.entries) // 2]]
    runs = [number for block in entry.range for number in plan.block(block)]
    config, backend = plan.setup.to_yaml(), state.manifest.backend or "llvm"
    blocks = tuple(tuple(some) for some in plan.runs_of(entry.range))
    made = BlockResult.joined(
        task.evaluate(task.Task(config, provenance.source_digest(), backend, entry.first, blocks))
    )
    where = elsewhere(state.manifest, provenance.Provenance.here(), provenance.versions())
    chunk = _chunk_difference(f"{FOLDER}/{entry.file}", store.read(entry), made, plan)
    files = (chunk, *_data_difference(folder, plan, whole))
    what = f"runs {runs[0]} to {runs[-1]} of {plan.runs}"
    return Repetition(files, where, time.monotonic() - began, what)


def _chunk_difference(name: str, old: BlockResult, new: BlockResult, plan: Plan) -> difference.FileDifference:
    """The responses of a chunk, run by run."""
    found: list[difference.QuantityDifference | None] = []
    for r, response in enumerate(plan.setup.study.responses):
        for ending, part in (("", "values"), (" sigma", "sigmas"), (" noise", "noises")):
            first, second = (getattr(result, part)[:, r] for result in (old, new))
            found.append(difference.array_difference(f"{response}{ending}", first, second))
    for part in ("messages", "doubts"):
        texts = [np.array(getattr(result, part), object) for result in (old, new)]
        found.append(difference.array_difference(part, texts[0], texts[1]))
    return difference.judged(name, found)


def _data_difference(folder: Path, plan: Plan, whole: BlockResult) -> Iterable[difference.FileDifference]:
    """study.nc and study.json against what the chunks hold."""
    name = "study.nc"
    try:
        data = data_files.read_netcdf((folder / name).read_bytes())
        kept = {str(key): np.asarray(data[key].values) for key in data.data_vars}
        told = json.loads((folder / "study.json").read_bytes())
    # readers of spoilt files fail in ways that cannot be foreseen
    except Exception as error:
        return (difference.FileDifference(name, difference.DIFFERENT, why=f"cannot be read: {why_unreadable(error)}"),)
    made = make_dataset(plan, whole)
    found = [
        difference.array_difference(str(key), kept.get(str(key), np.array([])), np.asarray(made[key].values))
        for key in made.data_vars
    ]
    numbers = summary(made, plan)
    # the data set is the chunks', and what is told of it is that of the data set
    return difference.judged(name, found), difference.judged(
        "study.json", difference.data_differences({key: told.get(key) for key in numbers}, numbers)
    )
