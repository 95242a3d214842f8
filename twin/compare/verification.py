"""Repetition of a run from its folder, by its command in another process, and the verdict on folder and run.

State of a run folder: which files differ from its manifest; and differences of machine and program between two runs.

The manifest is the file of a run folder that lists its files with checksums, its inputs and how it was made.
"""

import json
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from scenes.yaml.errors import InputError, Issue
from twin.compare import folder_difference as difference
from twin.compare.folder_difference import ArrayDifference, FileDifference, Leaf, NumberDifference
from twin.framework import provenance, report, run_folder
from twin.framework.durable import MANIFEST, PARTIAL, digest, files_below, first_names
from twin.framework.provenance import Provenance
from twin.framework.run_folder import Manifest
from twin.monitor.calibration_cache import recomputed
from twin.study.runs.blocks import BLOCKS


@dataclass(frozen=True)
class FolderState:
    """State of a run folder compared with its manifest, which lists the run's files with checksums.

    Attributes
    ----------
    folder : Path
        Folder of the run.
    manifest : Manifest
        Manifest of the run.
    changed : tuple[str, ...]
        Files that were altered after the run.
    missing : tuple[str, ...]
        Files of the run that are missing.
    additional : tuple[str, ...]
        Files that the run did not write.
    inputs_changed : tuple[str, ...]
        Input files outside the folder that have changed since the run.
    inputs_gone : tuple[str, ...]
        Input files that are missing.
    """

    folder: Path
    manifest: Manifest
    changed: tuple[str, ...]
    missing: tuple[str, ...]
    additional: tuple[str, ...]
    inputs_changed: tuple[str, ...]
    inputs_gone: tuple[str, ...]

    @property
    def whole(self) -> bool:
        """True if the folder holds exactly the files of the run."""
        return not (self.changed or self.missing or self.additional)

    @property
    def sealed(self) -> bool:
        """True if the manifest contains a checksum of itself, so that changes to it are detected."""
        return self.manifest.digest is not None


def folder_state(folder: Path) -> FolderState:
    """Compare every file of a run folder, and every input file, with the checksums in the run's manifest.

    Raises
    ------
    InputError
        The folder is not a run folder, or its run is not finished.
    """
    manifest = _manifest(folder)
    content = (folder / MANIFEST).read_bytes()
    written = json.loads(content)
    try:
        wrong = run_folder.altered(folder, manifest)
    except OSError as error:
        raise InputError(Issue(f"cannot be read: {error.strerror}", str(error.filename or folder))) from None
    inputs = {name: _as_read(Path(name), known) for name, known in manifest.inputs.items()}
    changed, gone = (tuple(name for name, now in inputs.items() if now == what) for what in ("changed", "gone"))
    state = FolderState(folder, manifest, (), (), (), changed, gone)
    whole = manifest.digest == run_folder.seal(written) and content == run_folder.json_text(written).encode()
    if not whole:
        wrong.append(MANIFEST)
    known = {MANIFEST, *manifest.sha256}
    missing = {name for name in wrong if not os.path.lexists(folder / name)}
    additional = tuple(name for name in files_below(folder) if name not in known)
    return replace(
        state, changed=tuple(sorted({*wrong} - missing)), missing=tuple(sorted(missing)), additional=additional
    )


def _as_read(path: Path, known: str) -> str:
    """Return ``gone`` or ``changed`` for an input file by its checksum ``known``; empty if it is as the run read it."""
    if not path.is_file():
        return "gone"
    try:
        return "" if digest(path) == known else "changed"
    except OSError:
        return "changed"


def _manifest(folder: Path) -> Manifest:
    """Return the manifest of a finished run.

    Raises
    ------
    InputError
        The folder has no manifest of a finished run; the message says what the folder is instead.
    """
    manifest = run_folder.read_manifest(folder)
    if manifest is not None:
        return manifest
    remedy = "the folder of a finished run, as a command of the twin leaves it"
    broken = folder.name.startswith(".") and folder.name.endswith(PARTIAL)
    if not folder.is_dir():
        issue = Issue("is not a folder" if folder.exists() else "no such folder", str(folder), allowed=remedy)
    elif (folder / MANIFEST).exists():
        text = "is not the manifest of a run, or is damaged: nothing tells what the folder held"
        issue = Issue(text, str(folder / MANIFEST), allowed="a copy of it, or the run made again")
    elif broken:
        text = "a run that was broken off, or is still being written"
        issue = Issue(text, str(folder), allowed="the run folder that its command names when it ends")
    else:
        issue = Issue(f"not a run folder: it has no {MANIFEST} of a run", str(folder), allowed=remedy)
    raise InputError(issue)


@dataclass(frozen=True)
class Elsewhere:
    """Differences of program and machine between a run and its repetition.

    Attributes
    ----------
    program : tuple[str, ...]
        Differences of the source or of packages, which may change results.
    processor : tuple[str, ...]
        Differences that only change rounding: processor, linear algebra, C library.
    known : bool
        Whether the manifest records the machine and program of the run.
    """

    program: tuple[str, ...]
    processor: tuple[str, ...]
    known: bool


def elsewhere(old: Manifest, new: Manifest) -> Elsewhere:
    """Compare the program and machine of a run, by its manifest, with those of its repetition."""
    program, made, here = _changes(old.versions, new.versions), old.provenance, new.provenance
    if made is None or here is None:
        return Elsewhere((*program,), (), False)
    program = [*_changes({"source": made.source[:12]}, {"source": here.source[:12]}), *program]
    program += _changes(made.packages, here.packages)
    return Elsewhere((*program,), (*_changes(_machine(made), _machine(here)),), True)


def _changes(then: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    names = [name for name in sorted({*then, *now}) if then.get(name) != now.get(name)]
    return [f"{name} {then.get(name, 'none')} then, {now.get(name, 'none')} now" for name in names]


def _machine(where: Provenance) -> dict[str, str]:
    """Return the properties of a machine that change rounding; the number of threads does not."""
    settings = [f"{key}={value}" for key, value in where.settings.items() if not key.endswith("THREADS")]
    return {
        "processor": where.processor,
        "instructions": ", ".join(where.simd) or "none",
        "C library": where.libc,
        "settings": ", ".join(settings) or "none",
        **{f"{library.name} {library.version} with kernels for": library.kernels for library in where.blas},
    }


EQUAL, UNEQUAL, NOT_REPEATED = 0, 1, 2
"""Exit codes of the command: the repeated run agrees, it differs, or the run could not be repeated."""
CONFIG = "config.yaml"
MOST_PRINTED = 5
"""Largest number of differing quantities that are printed for a file."""
MOST_LISTED = 20
"""Largest number of differing quantities of a file in the JSON output; those that differ most are listed."""
SAME, ROUNDED, DIFFERENT, EXCLUDED = "same", "rounding", "different", "excluded"
GONE, NEW = "only in the run", "only in the repeated run"
EXCLUDED_FILES: Mapping[str, str] = {
    "html": "a page that states when and where it was made; its numbers are those of the other files",
    "md": "a page that states how long it took; its numbers are those of the other files",
    **dict.fromkeys(("svg", "png", "glb"), "a picture; the numbers that it shows are those of the other files"),
    BLOCKS: "runs in the order of their computation; their numbers are those of study.nc",
}
"""Suffix or name of files that are not compared -> the reason."""

RELATIVE = 1e-9
"""Largest difference that counts as rounding, relative to the largest number of its kind or to an array's peak.

Sums in a different order, as those of stray light, change numbers by a relative 1e-14, and recovered angles of 1.5
arcsec by a relative 1e-11.
"""
RELATIVE_ELSEWHERE = 1e-6
"""Largest relative difference that counts as rounding on a different processor.

Its linear algebra rounds otherwise. Fits with a condition number of 1e8 and more change by a relative 1e-8 (orthonormal
Zernike terms by 4e-8). No number here is known to a millionth.
"""
SIGMA_SHARE = 1e-3
"""Largest difference of a number, relative to its standard deviation, that counts as rounding.

Files give numbers to a millionth of their standard deviation.
"""
RELATIVE_OF_SIGMAS = 1e-6
"""Largest relative difference of standard deviations that counts as rounding.

They are computed from matrices with a condition number of 1e4 and more.
"""
PIXEL_SHARE, GREY_LEVELS = 1e-4, 2
"""Largest fraction of pixels that may differ between frames of two processors, and largest difference in DN.

Where the expected photons of a pixel lie, within rounding, at a value where the random number of photons changes by
one, the frames differ.
"""


@dataclass(frozen=True)
class Quantity:
    """Number, text or array with a different value in the repeated run.

    Attributes
    ----------
    key : str
        Key in the file.
    old, new : Leaf
        Values of the run and of the repetition; for arrays those of the element that differs most.
    relative : float | None
        Difference relative to the largest number of its kind in the file, or to an array's peak; None if it is not
        numeric.
    in_sigma : float | None
        Difference divided by the number's standard deviation; None without one.
    rounding : bool
        Whether the difference is rounding.
    """

    key: str
    old: Leaf
    new: Leaf
    relative: float | None = None
    in_sigma: float | None = None
    rounding: bool = False


@dataclass(frozen=True)
class FileState:
    """Comparison of a file of the run folder with that of the repeated run.

    Attributes
    ----------
    file : str
        Path in the folder.
    state : str
        ``SAME``, ``ROUNDED`` (equal within rounding), ``DIFFERENT``, ``EXCLUDED`` (not compared), ``GONE``
        (only in the run) or ``NEW`` (only in the repeated run).
    quantities : tuple[Quantity, ...]
        Quantities that differ, the largest difference first, at most `MOST_LISTED`.
    count : int
        Number of quantities that differ.
    why : str
        Reason why the file was excluded, or cannot be read.
    """

    file: str
    state: str
    quantities: tuple[Quantity, ...] = ()
    count: int = 0
    why: str = ""


def file_state(name: str, old: Path, new: Path, elsewhere: bool) -> FileState:
    """Compare a file of the run with that of the repeated run.

    Parameters
    ----------
    name : str
        Path in the run folder.
    old : Path
        File of the run.
    new : Path
        File of the repeated run.
    elsewhere : bool
        Whether the run was repeated on a different processor, which rounds otherwise; a few pixels may then differ.
    """
    if not (old.is_file() and new.is_file()):
        return FileState(name, GONE if old.is_file() else NEW)
    if old.read_bytes() == new.read_bytes():
        return FileState(name, SAME)
    if why := EXCLUDED_FILES.get(name) or EXCLUDED_FILES.get(difference.ending(name)):
        return FileState(name, EXCLUDED, why=why)
    try:
        return file_state_of(difference.file_difference(name, old, new), elsewhere)
    except InputError as error:
        return FileState(name, DIFFERENT, why=error.issues[0].problem)


def file_state_of(compared: FileDifference, elsewhere: bool = False) -> FileState:
    """Return whether a file is equal, equal within rounding, or different.

    A file without differing values differs only in its compression.

    Parameters
    ----------
    compared : FileDifference
        Differences of the file; sentences count only if nothing else differs.
    elsewhere : bool
        Whether the run was repeated on a different processor, which rounds otherwise.
    """
    quantities = [*(_number(entry, elsewhere) for entry in compared.numbers)]
    quantities += [_array(array, elsewhere) for array in compared.arrays]
    if not quantities:
        quantities = [
            Quantity(claim.key, _short(claim.reference), _short(claim.other)) for claim in compared.statements
        ]
    quantities.sort(key=lambda entry: (entry.rounding, -(math.inf if entry.relative is None else entry.relative)))
    state = DIFFERENT if any(not entry.rounding for entry in quantities) else ROUNDED if quantities else SAME
    return FileState(compared.file, state, tuple(quantities[:MOST_LISTED]), len(quantities))


def _number(number: NumberDifference, elsewhere: bool) -> Quantity:
    """Return the difference of a number or text in two files, with the decision whether it is rounding.

    ``elsewhere`` is True if the run was repeated on a different processor.
    """
    off = None if number.difference is None else abs(number.difference)
    if off is None or not math.isfinite(off):
        return Quantity(number.key, _short(number.reference), _short(number.other))
    in_sigma = off / (number.sigma / math.sqrt(2.0)) if number.sigma else None  # sigma is that of the difference of two
    size = max(abs(float(number.reference or 0)), abs(float(number.other or 0)), number.scale)
    relative = off / size if size else 0.0
    limit = RELATIVE_OF_SIGMAS if difference.is_sigma(number.key) else RELATIVE_ELSEWHERE if elsewhere else RELATIVE
    rounding = relative <= limit or (in_sigma is not None and in_sigma <= SIGMA_SHARE)
    return Quantity(number.key, number.reference, number.other, relative, in_sigma, rounding)


def _array(array: ArrayDifference, elsewhere: bool) -> Quantity:
    """Return the largest difference of an array in two files, with the decision whether it is rounding.

    ``elsewhere`` is True if the run was repeated on a different processor.
    """
    name = array.name or "pixels"
    if array.share is None:
        shapes = (array.shape, array.other_shape)
        old, new = ("none" if s is None else f"shape {' x '.join(map(str, s))}" for s in shapes)
        return Quantity(name, old, new)
    key = f"{name}[{', '.join(map(str, array.where))}]" if array.where else name
    if array.largest is None or array.peak is None:
        return Quantity(key, _short(array.reference), _short(array.other))
    worst = array.largest if array.finite else math.inf
    if elsewhere and array.depth:
        rounding = worst <= GREY_LEVELS and array.share <= PIXEL_SHARE
    else:
        rounding = worst <= (RELATIVE_ELSEWHERE if elsewhere else RELATIVE) * array.peak
    relative = worst / array.peak if array.peak and array.finite else None
    return Quantity(key, array.reference, array.other, relative, None, rounding)


def _short(value: Any) -> Leaf:
    """Return a value with texts shortened to 200 characters."""
    if isinstance(value, str) and len(value) > 200:
        return f"{value[:197]}..."
    return value if value is None or isinstance(value, int | float | str | bool) else str(value)[:200]


class CannotRepeat(Exception):
    """Error: a run cannot be repeated; the message gives the reason."""


@dataclass(frozen=True)
class Repetition:
    """Repeated run.

    Attributes
    ----------
    files : tuple[FileState, ...]
        Every compared file of the folder.
    elsewhere : Elsewhere
        Differences of program and machine from those of the run.
    seconds : float
        Duration of the repetition, in seconds.
    """

    files: tuple[FileState, ...]
    elsewhere: Elsewhere
    seconds: float

    @property
    def state(self) -> str:
        """SAME, ROUNDED or DIFFERENT: the state of the file that differs most."""
        states = {file.state for file in self.files} - {SAME, EXCLUDED}
        return DIFFERENT if states - {ROUNDED} else ROUNDED if states else SAME

    def numbers(self) -> dict[str, Any]:
        """Return the repetition as plain data."""
        there = self.elsewhere
        about = {"state": self.state, "seconds": self.seconds}
        about |= {"other_program": list(there.program), "other_processor": list(there.processor)}
        files = [
            {"file": f.file, "state": f.state, "quantities": f.count, "why": f.why}
            | {"differ_most": [asdict(quantity) for quantity in f.quantities]}
            for f in self.files
        ]
        return {**about, "provenance_known": there.known, "files": files}


def obstacle(state: FolderState) -> str:
    """Return the reason why a run cannot be repeated from its folder; empty if it can be."""
    manifest = state.manifest
    if not manifest.again:
        return "it holds files written beside a run (--export) or from a record; verify the run folder of the test"
    made_of = (CONFIG, "deformation", "temperature", "finish")
    changed = [name for name in (*state.changed, *state.missing) if name.split("/")[0] in made_of]
    for names, text in (
        (changed, "its inputs in the folder were altered"),
        (state.inputs_gone, "files that it read are missing"),
        (state.inputs_changed, "files that it read have changed since"),
    ):
        if names:
            return f"{text}: {', '.join(names)}"
    return ""


@recomputed()  # a repetition must not reuse results of the run that it checks
def repeat(state: FolderState, folder: Path, quiet: bool) -> Repetition:
    """Repeat a run, and compare every file.

    Parameters
    ----------
    state : FolderState
        State of its folder, for which `obstacle` is empty.
    folder : Path
        Folder of the repeated run, which must not exist.
    quiet : bool
        Do not print progress.

    Raises
    ------
    CannotRepeat
        The command does not finish the run.
    """
    manifest, began = state.manifest, time.monotonic()
    arguments = [str(state.folder.resolve() / CONFIG) if word == CONFIG else word for word in manifest.again]
    started_in = manifest.started_in or str(folder.parent)
    if not Path(started_in).is_dir():
        raise CannotRepeat(f"the folder in which it was started is missing: {started_in}")
    # -P: never import modules from the folder in which the run was started
    program = f"{provenance.BEFORE}{arguments[0]}"
    command = [sys.executable, "-P", "-m", program, *arguments[1:], "--out", str(folder.absolute())]
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
    repetition = run_folder.read_manifest(folder)
    if repetition is None:
        text = " ".join((printed or "").split()[-60:])
        raise CannotRepeat(
            f"{' '.join(arguments)} ended with exit code {process.returncode}{': ' if text else ''}{text}"
        )
    where = elsewhere(manifest, repetition)
    names = dict.fromkeys((*manifest.sha256, *repetition.sha256))
    files = [file_state(name, state.folder / name, folder / name, bool(where.processor)) for name in names]
    return Repetition(tuple(files), where, time.monotonic() - began)


@dataclass(frozen=True)
class Verification:
    """Verification of a run folder.

    Attributes
    ----------
    state : FolderState
        State of its files.
    repetition : Repetition | None
        The repeated run; None if it was not repeated.
    obstacle : str
        Reason why it was not repeated; empty if no repetition was requested.
    """

    state: FolderState
    repetition: Repetition | None = None
    obstacle: str = ""

    @property
    def code(self) -> int:
        """Exit code of the command: 0 without a difference, 1 with a changed file or result, 2 if not repeatable."""
        if not self.state.whole or (self.repetition is not None and self.repetition.state == DIFFERENT):
            return UNEQUAL
        return NOT_REPEATED if self.obstacle else EQUAL

    @property
    def verdict(self) -> str:
        """Verdict in a few sentences.

        It states whether the files are unchanged, whether the repetition agrees, and where the run was made.
        """
        state = self.state
        changed = f"not as the run wrote {'them' if len(state.changed) > 1 else 'it'}"
        first = [
            f"{first_names(names)} {'is' if len(names) == 1 else 'are'} {what}"
            for names, what in (
                (state.changed, changed),
                (state.missing, "missing"),
                (state.additional, "not part of the run"),
            )
            if names
        ]
        whole = f"All {len(state.manifest.sha256)} files are as the run wrote them"
        return " ".join(map(report.sentence, ("; ".join(first) or whole, *self._repeated())))

    def _repeated(self) -> list[str]:
        """Return the sentences of the verdict on whether the repeated run agrees."""
        if self.obstacle:
            return [f"the run cannot be repeated: {self.obstacle}"]
        repetition = self.repetition
        if repetition is None:
            return ["the run was not repeated"]
        compared = [file for file in repetition.files if file.state != EXCLUDED]
        rounded = [comparison for comparison in compared if comparison.state == ROUNDED]
        others = [comparison.file for comparison in compared if comparison.state != SAME and comparison not in rounded]
        text = {
            SAME: f"has the same numbers in all {len(compared)} files",
            ROUNDED: f"is the same within rounding; {len(rounded)} of {len(compared)} files differ, by at most "
            f"{_largest(rounded)}",
            DIFFERENT: f"differs in {first_names(others)}",
        }[repetition.state]
        out = [f"a repetition of the run {text}"]
        where = repetition.elsewhere
        if not where.known:
            out.append("the manifest does not name the processor and the source that made it")
        if where.program:
            out.append(f"it was made by another version of the program: {first_names(where.program)}")
        if where.processor:
            out.append(f"it was made on another machine: {first_names(where.processor)}")
        if repetition.state != SAME and where.known and not where.program and not where.processor:
            out.append("the program and the processor are the same")
        return out

    def numbers(self) -> dict[str, Any]:
        """Return the verification as plain data, for the command's option ``--json``."""
        state, repetition = self.state, self.repetition
        manifest = state.manifest
        made_again = None if repetition is None else repetition.numbers()
        return {
            "run": str(state.folder),
            "of": manifest.kind,
            "whole": state.whole,
            "files": len(manifest.sha256),
            **{name: list(getattr(state, name)) for name in ("changed", "missing", "additional")},
            "sealed": state.sealed,
            **{name: list(getattr(state, name)) for name in ("inputs_changed", "inputs_gone")},
            "made_again": made_again,
            "cannot": self.obstacle,
            "checks": manifest.checks,
            "verdict": self.verdict,
        }

    def lines(self) -> list[str]:
        """Return details of the verification as lines of text: changed inputs, differing files and their quantities."""
        state, out = self.state, []
        out += [f"read by the run and changed since: {name}" for name in state.inputs_changed]
        out += [f"read by the run and missing now: {name}" for name in state.inputs_gone]
        for comparison in () if self.repetition is None else self.repetition.files:
            if comparison.state in (SAME, EXCLUDED):
                continue
            count = f", {comparison.count} quantities" if comparison.count else ""
            out.append(f"{comparison.file}: {comparison.state}{count}{f', {comparison.why}' if comparison.why else ''}")
            for quantity in comparison.quantities[:MOST_PRINTED]:
                size = "" if quantity.relative is None else f", {quantity.relative:.2g} of it"
                sigma = "" if quantity.in_sigma is None else f", {quantity.in_sigma:.2g} sigma"
                out.append(f"    {quantity.key}: {quantity.old!r} then, {quantity.new!r} now{size}{sigma}")
        return out


def _largest(files: Sequence[FileState]) -> str:
    """Return a text with the largest differences of numbers, relative to their size and in sigmas."""
    numbers = [quantity for file in files for quantity in file.quantities]
    relative = max((number.relative or 0.0 for number in numbers), default=0.0)
    in_sigma = max((number.in_sigma or 0.0 for number in numbers), default=0.0)
    return f"{relative:.2g} of their value" + (f" and {in_sigma:.2g} sigma" if in_sigma else "")
