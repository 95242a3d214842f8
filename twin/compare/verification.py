"""A run repeated from its folder, and the verdict on the folder and the run.

A whole run is repeated by its command in a process of its own; of a study one block is computed here.
"""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from scenes.yaml.errors import InputError
from scenes.yaml.input_file import read_json
from twin.compare import folder_difference as difference
from twin.compare.folder_difference import ArrayDifference, FileDifference, Leaf, NumberDifference
from twin.compare.folder_state import Elsewhere, FolderState, elsewhere
from twin.framework import provenance, report, run_folder
from twin.framework.journal import read_pieces
from twin.framework.owned_files import first_names
from twin.monitor.calibration_cache import recomputed
from twin.study.runs import blocks, setup
from twin.study.runs.base_job import BlockResult
from twin.study.runs.plan import Plan
from twin.study.study_files import make_dataset, summary

EQUAL, UNEQUAL, CANNOT = 0, 1, 2
"""Exit codes."""
CONFIG = "config.yaml"
NAMED = 5
"""Quantities of a file that are printed at most."""
SHOWN = 20
"""Quantities of a file in the JSON at most: those that differ most."""
SAME, ROUNDED, DIFFERENT, LEFT_OUT = "same", "rounding", "different", "left out"
REDRAWN = "drawn otherwise"
"""State of a picture of numbers that differ by rounding: its lines have other corners."""
GONE, NEW = "only in the run", "only made again"
LEFT_OUT_FILES: Mapping[str, str] = {
    "html": "a page, which says when and where it was made; its numbers are those of the other files",
    "md": "a page, which says how long it took; its numbers are those of the other files",
    blocks.BLOCKS: "runs in the order in which they were done; their numbers are those of study.nc",
}
"""Endings or names of files that are not compared, and why."""

RELATIVE = 1e-9
"""Part of the largest number of its sort, or of an array's peak, up to which a difference is rounding: sums in another
order, as those of stray light, move numbers by 1e-14, and readings of 1.5 arcsec by 1e-11 of what they are."""
RELATIVE_ELSEWHERE = 1e-6
"""The part that counts as rounding on another processor, whose linear algebra rounds otherwise: fits with a condition
of 1e8 and more move by 1e-8 of themselves (orthonormal Zernike terms by 4e-8). No number here is known to a millionth.
"""
OF_SIGMA = 1e-3
"""Part of the number's standard deviation up to which a difference is rounding: the least digit that a file states is
a millionth of it."""
OF_A_SIGMA = 1e-6
"""Relative, of a standard deviation itself: it is worked out from matrices with a condition of 1e4 and more."""
FEW, SMALL = 1e-4, 2
"""Share of the pixels of recorded frames, and grey levels, by which frames of another processor may differ: of those
whose expectation stands on the edge of two numbers of photons."""
OF_A_PICTURE = 4
"""Grey levels of 255 by which drawn pictures may differ: edges are drawn through a pixel's part."""
OF_GEOMETRY = 1e-6
"""Part of the peak for what is drawn in single precision."""


@dataclass(frozen=True)
class Quantity:
    """A number, text or array that a repeated run gives otherwise.

    Attributes
    ----------
    key : str
        In the file.
    old, new : Leaf
        Of the run and of the repeated one; of arrays the element that differs most.
    relative : float | None
        The difference over the largest number of its sort in the file, of arrays over the peak; None of what is no
        number.
    in_sigma : float | None
        Over the number's standard deviation, None where it has none.
    rounding : bool
        Whether it is rounding.
    """

    key: str
    old: Leaf
    new: Leaf
    relative: float | None = None
    in_sigma: float | None = None
    rounding: bool = False


@dataclass(frozen=True)
class FileState:
    """A file of a run folder and of its repeated run.

    Attributes
    ----------
    file : str
        In the folder.
    state : str
        SAME, ROUNDED or another text above.
    quantities : tuple[Quantity, ...]
        That differ, the largest first, SHOWN at most.
    count : int
        How many do.
    why : str
        Why it was left out, or cannot be read.
    """

    file: str
    state: str
    quantities: tuple[Quantity, ...] = ()
    count: int = 0
    why: str = ""

    @property
    def drawn(self) -> bool:
        """Whether it is a picture."""
        return difference.ending(self.file) in ("svg", "png", "glb")


def file_state(name: str, old: Path, new: Path, elsewhere: bool) -> FileState:
    """Compare a file of the run with that of the repeated one.

    Parameters
    ----------
    name : str
        In the run folder.
    old : Path
        The run's.
    new : Path
        Of the repeated run.
    elsewhere : bool
        Whether that was on another processor, which rounds otherwise; a few pixels may then differ.
    """
    if not (old.is_file() and new.is_file()):
        return FileState(name, GONE if old.is_file() else NEW)
    if old.read_bytes() == new.read_bytes():
        return FileState(name, SAME)
    if why := LEFT_OUT_FILES.get(name) or LEFT_OUT_FILES.get(difference.ending(name)):
        return FileState(name, LEFT_OUT, why=why)
    try:
        return judged(difference.file_difference(name, old, new), elsewhere)
    except InputError as error:
        return FileState(name, DIFFERENT, why=error.issues[0].problem)


def judged(compared: FileDifference, elsewhere: bool = False) -> FileState:
    """Judge whether a file differs by rounding; where nothing differs only the way in which it is packed differs.

    Parameters
    ----------
    compared : FileDifference
        Its differences; sentences count where nothing else differs.
    elsewhere : bool
        See `file_state`.
    """
    every = [*(_number(one, elsewhere) for one in compared.numbers)]
    every += [_array(one, compared.drawn, elsewhere) for one in compared.arrays]
    if not every:
        every = [Quantity(one.key, _short(one.reference), _short(one.other)) for one in compared.statements]
    every.sort(key=lambda one: (one.rounding, -(math.inf if one.relative is None else one.relative)))
    state = DIFFERENT if any(not one.rounding for one in every) else ROUNDED if every else SAME
    return FileState(compared.file, state, tuple(every[:SHOWN]), len(every))


def _number(one: NumberDifference, elsewhere: bool) -> Quantity:
    off = None if one.difference is None else abs(one.difference)
    if off is None or not math.isfinite(off):
        return Quantity(one.key, _short(one.reference), _short(one.other))
    in_sigma = off / (one.sigma / math.sqrt(2.0)) if one.sigma else None  # sigma is that of a difference of two
    size = max(abs(float(one.reference or 0)), abs(float(one.other or 0)), one.scale)
    relative = off / size if size else 0.0
    limit = OF_A_SIGMA if difference.is_sigma(one.key) else RELATIVE_ELSEWHERE if elsewhere else RELATIVE
    rounding = relative <= limit or (in_sigma is not None and in_sigma <= OF_SIGMA)
    return Quantity(one.key, one.reference, one.other, relative, in_sigma, rounding)


def _array(one: ArrayDifference, drawn: bool, elsewhere: bool) -> Quantity:
    name = one.name or "pixels"
    if one.share is None:
        shapes = (one.shape, one.other_shape)
        old, new = ("none" if s is None else f"shape {' x '.join(map(str, s))}" for s in shapes)
        return Quantity(name, old, new)
    key = f"{name}[{', '.join(map(str, one.where))}]" if one.where else name
    if one.largest is None or one.peak is None:
        return Quantity(key, _short(one.reference), _short(one.other))
    worst = one.largest if one.finite else math.inf
    if drawn and one.depth:
        rounding = worst <= OF_A_PICTURE * (257 if one.depth == 2 else 1)
    elif elsewhere and one.depth:
        rounding = worst <= SMALL and one.share <= FEW
    else:
        rounding = worst <= (OF_GEOMETRY if drawn else RELATIVE_ELSEWHERE if elsewhere else RELATIVE) * one.peak
    relative = worst / one.peak if one.peak and one.finite else None
    return Quantity(key, one.reference, one.other, relative, None, rounding)


def _short(value: Any) -> Leaf:
    if isinstance(value, str) and len(value) > 200:
        return f"{value[:197]}..."
    return value if value is None or isinstance(value, int | float | str | bool) else str(value)[:200]


class CannotRepeat(Exception):
    """A run cannot be repeated; the message says why."""


@dataclass(frozen=True)
class Repetition:
    """A repeated run.

    Attributes
    ----------
    files : tuple[FileState, ...]
        Every file of the folder that was compared.
    elsewhere : Elsewhere
        Differences to where the run was made.
    seconds : float
        That it took.
    what : str
        Was repeated, where that is not the whole run.
    """

    files: tuple[FileState, ...]
    elsewhere: Elsewhere
    seconds: float
    what: str = ""

    @property
    def state(self) -> str:
        """SAME, ROUNDED or DIFFERENT: of the file that differs most."""
        states = {one.state for one in self.files} - {SAME, LEFT_OUT}
        return DIFFERENT if states - {ROUNDED, REDRAWN} else ROUNDED if states else SAME


def obstacle(state: FolderState) -> str:
    """Return why a run cannot be repeated from its folder; empty where it can."""
    manifest = state.manifest
    if not manifest.again:
        return (
            "it holds measurements that a test wrote beside its run (--export); the run folder of the test can be "
            "verified"
        )
    made_of = (CONFIG, "deformation", "temperature", "finish")
    changed = [name for name in (*state.changed, *state.missing) if name.split("/")[0] in made_of]
    for names, text in (
        (changed, "what it was made of is not as it was"),
        (state.inputs_gone, "files that it read are gone"),
        (state.inputs_changed, "files that it read have changed since"),
    ):
        if names:
            return f"{text}: {', '.join(names)}"
    return ""


@recomputed()  # a repetition takes nothing over from the run that it checks
def repeat(state: FolderState, place: Path, quiet: bool) -> Repetition:
    """Repeat a whole run, and compare every file.

    Parameters
    ----------
    state : FolderState
        Of its folder; there is no `obstacle`.
    place : Path
        Where to make it; does not exist.
    quiet : bool
        Print nothing meanwhile.

    Raises
    ------
    CannotRepeat
        The command does not make it.
    """
    manifest, began = state.manifest, time.monotonic()
    words = [str(state.folder.resolve() / CONFIG) if word == CONFIG else word for word in manifest.again]
    started_in = manifest.started_in or str(place.parent)
    if not Path(started_in).is_dir():
        raise CannotRepeat(f"the folder in which it was started is gone: {started_in}")
    # modules are those of this program, whatever lies in the folder where it starts
    command = [sys.executable, "-P", "-m", f"{provenance.BEFORE}{words[0]}", *words[1:], "--out", str(place.absolute())]
    command += ["--quiet"] if quiet and manifest.program != "twin.validate" else []
    root = provenance.ROOT.parent if provenance.BEFORE else provenance.ROOT
    paths = os.pathsep.join(filter(None, (str(root), os.environ.get("PYTHONPATH"))))
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
            _, printed = process.communicate()
        except BaseException:
            process.send_signal(signal.SIGTERM)
            process.wait()
            raise
    made = run_folder.read_manifest(place)
    if made is None:
        text = " ".join((printed or "").split()[-60:])
        raise CannotRepeat(f"{' '.join(words)} ended with exit code {process.returncode}{': ' if text else ''}{text}")
    where = elsewhere(manifest, made.provenance, made.versions)
    names = dict.fromkeys((*manifest.sha256, *made.sha256))
    files = [file_state(name, state.folder / name, place / name, bool(where.processor)) for name in names]
    return Repetition(tuple(redrawn(files)), where, time.monotonic() - began)


def redrawn(files: Sequence[FileState]) -> Iterator[FileState]:
    """Pictures of numbers that are the same but for rounding are not different results.

    Parameters
    ----------
    files : Sequence[FileState]
        Of one run, as compared.
    """
    numbers = {one.state for one in files if not one.drawn} - {SAME, LEFT_OUT}
    for one in files:
        yield replace(one, state=REDRAWN) if numbers == {ROUNDED} and one.drawn and one.state == DIFFERENT else one


@recomputed()
def repeat_block(state: FolderState) -> Repetition:
    """Repeat one block of a study, the one in the middle, and hold all blocks against the study's data set.

    Parameters
    ----------
    state : FolderState
        Of its folder; there is no `obstacle`.

    Raises
    ------
    CannotRepeat
        Its blocks are not there, or not whole; config.yaml cannot be read.
    """
    began, folder = time.monotonic(), state.folder
    try:
        plan = Plan.of(setup.resolve_study(folder / CONFIG))
        content = (folder / blocks.BLOCKS).read_bytes()
    except (OSError, InputError) as error:
        raise CannotRepeat(str(error)) from error
    with blocks.journal_of(plan.setup, None) as journal:
        journal.known = read_pieces(content, journal.classes)[1]
        engine = blocks.Engine(plan, journal, state.manifest.backend or "llvm")
        if engine.missing:
            raise CannotRepeat("its blocks are not whole; --all makes the whole study again")
        middle, whole = plan.blocks // 2, engine.result()
        kept, made = journal.known[str(middle)], blocks.evaluate(engine.task(middle))
    block = difference.content_difference(f"{blocks.BLOCKS}: {middle}", _responses(kept, plan), _responses(made, plan))
    where = elsewhere(state.manifest, provenance.Provenance.here(), provenance.versions())
    files, runs = (judged(block), *_data_states(folder, plan, whole)), plan.block(middle)
    return Repetition(files, where, time.monotonic() - began, f"runs {runs[0]} to {runs[-1]} of {plan.runs}")


def _responses(result: BlockResult, plan: Plan) -> difference.Content:
    """Return the responses of a block, run by run."""
    arrays = {
        f"{response}{ending}": getattr(result, part)[:, r]
        for r, response in enumerate(plan.setup.study.responses)
        for ending, part in (("", "values"), (" sigma", "sigmas"), (" noise", "noises"))
    }
    texts = {part: np.array(getattr(result, part), object) for part in ("messages", "doubts")}
    return difference.Content({}, arrays | texts, {})


def _data_states(folder: Path, plan: Plan, whole: BlockResult) -> Iterable[FileState]:
    """Compare study.nc and study.json with what the blocks hold."""
    name = "study.nc"
    try:
        kept = difference.content_of(folder / name, name).arrays
        stored = read_json(folder / "study.json")
    except InputError as error:
        return (FileState(name, DIFFERENT, why=error.issues[0].problem),)
    data = make_dataset(plan, whole)
    made = {str(key): np.asarray(data[key].values) for key in data.data_vars}
    held = {key: values for key, values in kept.items() if key in made}
    again = summary(data, plan)
    arrays = (name, difference.Content({}, held, {}), difference.Content({}, made, {}))
    # the data set is the blocks', and the summary that of the data set
    numbers = ("study.json", difference.plain({key: stored.get(key) for key in again}), difference.plain(again))
    return [judged(difference.content_difference(*pair)) for pair in (arrays, numbers)]


@dataclass(frozen=True)
class Verification:
    """A verified run folder.

    Attributes
    ----------
    state : FolderState
        Of its files.
    repetition : Repetition | None
        The repeated run, None where it was not.
    obstacle : str
        Why it was not, empty where nobody asked for it.
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
        """In a few sentences: are the files as they were, does the run come out the same, and where was it made."""
        state = self.state
        changed = f"not as the run wrote {'them' if len(state.changed) > 1 else 'it'}"
        first = [
            f"{first_names(names)} {'is' if len(names) == 1 else 'are'} {what}"
            for names, what in (
                (state.changed, changed),
                (state.missing, "missing"),
                (state.additional, "not of the run"),
            )
            if names
        ]
        whole = f"All {len(state.manifest.sha256)} files are as the run wrote them"
        return " ".join(map(report.sentence, ("; ".join(first) or whole, *self._repeated())))

    def _repeated(self) -> list[str]:
        if self.obstacle:
            return [f"it cannot be made again: {self.obstacle}"]
        made = self.repetition
        if made is None:
            return ["it was not made again"]
        compared = [one for one in made.files if one.state != LEFT_OUT]
        rounded = [one for one in compared if one.state in (ROUNDED, REDRAWN)]
        others = [one.file for one in compared if one.state != SAME and one not in rounded]
        text = {
            SAME: f"the same in all {len(compared)} files that hold numbers",
            ROUNDED: f"the same but for rounding in {len(rounded)} of {len(compared)} files: numbers by "
            f"{_largest(rounded)} at most",
            DIFFERENT: f"different in {first_names(others)}",
        }[made.state]
        out = [f"made again, {made.what or 'the run'} came out {text}"]
        where = made.elsewhere
        if not where.known:
            out.append("the manifest does not name the processor and the source that made it")
        if where.program:
            out.append(f"another program made it: {first_names(where.program)}")
        if where.processor:
            out.append(f"it was made elsewhere: {first_names(where.processor)}")
        if made.state != SAME and where.known and not where.program and not where.processor:
            out.append("the program and the processor are the same")
        return out

    def numbers(self) -> dict[str, Any]:
        """Plain data of the verification, for ``--json``."""
        state, made = self.state, self.repetition
        manifest = state.manifest
        return {
            "run": str(state.folder),
            "of": manifest.kind,
            "whole": state.whole,
            "files": len(manifest.sha256),
            **{name: list(getattr(state, name)) for name in ("changed", "missing", "additional")},
            "sealed": state.sealed,
            **{name: list(getattr(state, name)) for name in ("inputs_changed", "inputs_gone")},
            "made_again": None
            if made is None
            else {
                "state": made.state,
                "what": made.what or "the whole run",
                "seconds": made.seconds,
                "other_program": list(made.elsewhere.program),
                "other_processor": list(made.elsewhere.processor),
                "provenance_known": made.elsewhere.known,
                "files": [
                    {
                        "file": one.file,
                        "state": one.state,
                        "quantities": one.count,
                        "why": one.why,
                        "differ_most": [asdict(quantity) for quantity in one.quantities],
                    }
                    for one in made.files
                ],
            },
            "cannot": self.obstacle,
            "checks": manifest.checks,
            "verdict": self.verdict,
        }

    def lines(self) -> list[str]:
        """Return what a reader should know beside the verdict, line by line."""
        state, out = self.state, []
        out += [f"read by the run and changed since: {name}" for name in state.inputs_changed]
        out += [f"read by the run and gone: {name}" for name in state.inputs_gone]
        for one in () if self.repetition is None else self.repetition.files:
            if one.state in (SAME, LEFT_OUT):
                continue
            count = f", {one.count} quantities" if one.count else ""
            out.append(f"{one.file}: {one.state}{count}{f', {one.why}' if one.why else ''}")
            for quantity in one.quantities[:NAMED]:
                size = "" if quantity.relative is None else f", {quantity.relative:.2g} of it"
                sigma = "" if quantity.in_sigma is None else f", {quantity.in_sigma:.2g} sigma"
                out.append(f"    {quantity.key}: {quantity.old!r} then, {quantity.new!r} now{size}{sigma}")
        return out


def _largest(files: Sequence[FileState]) -> str:
    """Return the largest differences of numbers, relative and over sigma, in words."""
    numbers = [one for file in files if not file.drawn for one in file.quantities]
    relative = max((one.relative or 0.0 for one in numbers), default=0.0)
    in_sigma = max((one.in_sigma or 0.0 for one in numbers), default=0.0)
    return f"{relative:.2g} of them" + (f" and {in_sigma:.2g} sigma" if in_sigma else "")
