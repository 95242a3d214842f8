"""State of a run folder: which files differ from its manifest; and differences of machine and program between two runs.

The manifest is the file of a run folder that lists its files with checksums, its inputs and how it was made.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from scenes.yaml.errors import InputError, Issue
from twin.framework import run_folder
from twin.framework.owned_files import MANIFEST, PARTIAL, digest, files_below
from twin.framework.provenance import Provenance
from twin.framework.run_folder import Manifest


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

    @property
    def is_study(self) -> bool:
        """True if the folder is that of a study (many runs of one job), of which a part can be repeated."""
        return self.manifest.program == "twin.study" and not self.manifest.gradient


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
    broken = folder.name.startswith(".") and folder.name.endswith(f".{PARTIAL}")
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


def elsewhere(manifest: Manifest, here: Provenance | None, now: Mapping[str, str]) -> Elsewhere:
    """Compare the program and machine of a run with those of its repetition.

    Parameters
    ----------
    manifest : Manifest
        Manifest of the run.
    here : Provenance | None
        Record of program and machine of the repetition.
    now : Mapping[str, str]
        Versions of the packages of the repetition.
    """
    program, made = _changes(manifest.versions, now), manifest.provenance
    if made is None or here is None:
        return Elsewhere((*program,), (), False)
    program = [*_changes({"source": made.source[:12]}, {"source": here.source[:12]}), *program]
    program += _changes(made.packages, here.packages)
    kernels, others = _kernels(made), _kernels(here)
    common = kernels.keys() & others.keys()
    processor = _changes(_machine(made), _machine(here))
    processor += [
        f"{library} with kernels for {kernels[library]} then, {others[library]} now"
        for library in sorted(common)
        if kernels[library] != others[library]
    ]
    return Elsewhere((*program,), (*processor,), True)


def _changes(then: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    names = [name for name in sorted({*then, *now}) if then.get(name) != now.get(name)]
    return [f"{name} {then.get(name, 'none')} then, {now.get(name, 'none')} now" for name in names]


def _machine(where: Provenance) -> dict[str, str]:
    """Return the properties of a machine that change rounding, except the linear algebra's kernels.

    The number of threads does not change rounding.
    """
    settings = [f"{key}={value}" for key, value in where.settings.items() if not key.endswith("THREADS")]
    return {
        "processor": where.processor,
        "instructions": ", ".join(where.simd) or "none",
        "C library": where.libc,
        "settings": ", ".join(settings) or "none",
    }


def _kernels(where: Provenance) -> dict[str, str]:
    """Return name of each linear-algebra library -> processor type for which the kernels that it used are made."""
    return {f"{library.name} {library.version}": library.kernels for library in where.blas}
