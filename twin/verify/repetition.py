"""A run made again from what its folder holds: by its command in a process of its own; of a study one chunk."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from scenes.yaml.errors import InputError
from scenes.yaml.input_file import why_unreadable
from twin.run.data_files import read_netcdf
from twin.run.provenance import BEFORE, ROOT, Provenance, source_digest, versions
from twin.run.run_folder import read_manifest
from twin.study.runs.block_result import BlockResult
from twin.study.runs.chunk_store import FOLDER, ChunkError, ChunkStore, examined
from twin.study.runs.plan import Plan
from twin.study.runs.setup import resolve_study
from twin.study.runs.task import Task, evaluate
from twin.study.study_files import make_dataset, summary
from twin.verify.file_difference import (
    DIFFERENT,
    LEFT_OUT,
    REDRAWN,
    ROUNDED,
    SAME,
    FileDifference,
    QuantityDifference,
    array_difference,
    data_differences,
    file_difference,
    judged,
)
from twin.verify.folder_state import Elsewhere, FolderState, elsewhere

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

    files: tuple[FileDifference, ...]
    elsewhere: Elsewhere
    seconds: float
    what: str = ""

    @property
    def state(self) -> str:
        """SAME, ROUNDED or DIFFERENT: of the file that differs most."""
        states = {one.state for one in self.files}
        if states - {SAME, ROUNDED, REDRAWN, LEFT_OUT}:
            return DIFFERENT
        return ROUNDED if states & {ROUNDED, REDRAWN} else SAME


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
    command = [sys.executable, "-P", "-m", f"{BEFORE}{words[0]}", *words[1:], "--out", str(place.absolute())]
    command += ["--quiet"] if quiet and manifest.program != "twin.validate" else []
    paths = os.pathsep.join(filter(None, (str(ROOT.parent if BEFORE else ROOT), os.environ.get("PYTHONPATH"))))
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
    made = read_manifest(place)
    if made is None:
        told = " ".join((said or "").split()[-60:])
        raise CannotRepeat(f"{' '.join(words)} ended with exit code {process.returncode}{': ' if told else ''}{told}")
    where = elsewhere(manifest, made.provenance, made.versions)
    other = bool(where.processor)
    names = dict.fromkeys((*manifest.sha256, *made.sha256))
    files = [file_difference(name, state.folder / name, place / name, other) for name in names]
    return Repetition(tuple(of_rounded(files)), where, time.monotonic() - began)


def of_rounded(files: Sequence[FileDifference]) -> Iterator[FileDifference]:
    """Pictures of numbers that are the same but for rounding are not different results.

    Args:
        files: of one run, as compared.
    """
    numbers = {one.state for one in files if not one.drawn}
    rounded = ROUNDED in numbers and not numbers - {SAME, ROUNDED, LEFT_OUT}
    for one in files:
        yield replace(one, state=REDRAWN) if rounded and one.drawn and one.state == DIFFERENT else one


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
        plan = Plan.of(resolve_study(folder / CONFIG))
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
    made = BlockResult.joined(evaluate(Task(config, source_digest(), backend, entry.first, blocks)))
    where = elsewhere(state.manifest, Provenance.here(), versions())
    chunk = _chunk_difference(f"{FOLDER}/{entry.file}", store.read(entry), made, plan)
    files = (chunk, *_data_difference(folder, plan, whole))
    what = f"runs {runs[0]} to {runs[-1]} of {plan.runs}"
    return Repetition(files, where, time.monotonic() - began, what)


def _chunk_difference(name: str, old: BlockResult, new: BlockResult, plan: Plan) -> FileDifference:
    """The responses of a chunk, run by run."""
    found: list[QuantityDifference | None] = []
    for r, response in enumerate(plan.setup.study.responses):
        for ending, part in (("", "values"), (" sigma", "sigmas"), (" noise", "noises")):
            first, second = (getattr(result, part)[:, r] for result in (old, new))
            found.append(array_difference(f"{response}{ending}", first, second))
    for part in ("messages", "doubts"):
        texts = [np.array(getattr(result, part), object) for result in (old, new)]
        found.append(array_difference(part, texts[0], texts[1]))
    return judged(name, found)


def _data_difference(folder: Path, plan: Plan, whole: BlockResult) -> Iterable[FileDifference]:
    """study.nc and study.json against what the chunks hold."""
    name = "study.nc"
    try:
        data = read_netcdf((folder / name).read_bytes())
        kept = {str(key): np.asarray(data[key].values) for key in data.data_vars}
        told = json.loads((folder / "study.json").read_bytes())
    # readers of spoilt files fail in ways that cannot be foreseen
    except Exception as error:
        return (FileDifference(name, DIFFERENT, why=f"cannot be read: {why_unreadable(error)}"),)
    made = make_dataset(plan, whole)
    found = [
        array_difference(str(key), kept.get(str(key), np.array([])), np.asarray(made[key].values))
        for key in made.data_vars
    ]
    numbers = summary(made, plan)
    # the data set is the chunks', and what is told of it is that of the data set
    return judged(name, found), judged("study.json", data_differences({key: told.get(key) for key in numbers}, numbers))
