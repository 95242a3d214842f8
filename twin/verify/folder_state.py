"""What has become of a run folder and of the files that its run read, since it was made; nothing is computed."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scenes.yaml.errors import InputError, Issue
from twin.run.owned_files import MANIFEST, PARTIAL, STUDY_LOCK, STUDY_STATE, digest, every_file
from twin.run.provenance import Provenance
from twin.run.run_folder import Manifest, altered, json_text, read_manifest, seal
from twin.study.runs.chunk_store import FOLDER, examined
from twin.study.runs.study_folder import PROGRAM as STUDY


@dataclass(frozen=True)
class FolderState:
    """A run folder against its manifest.

    Attributes:
        folder: where.
        manifest: of the run.
        changed: files that are not as the run wrote them.
        missing: files of the run that are gone.
        additional: files that the run did not write.
        inputs_changed: files outside the folder that the run read and that hold something else now.
        inputs_gone: those that are not there any more.
        sealed: whether the manifest has a checksum of itself; those of older versions have none.
    """

    folder: Path
    manifest: Manifest
    changed: tuple[str, ...]
    missing: tuple[str, ...]
    additional: tuple[str, ...]
    inputs_changed: tuple[str, ...]
    inputs_gone: tuple[str, ...]
    sealed: bool

    @property
    def whole(self) -> bool:
        """Whether the folder holds what the run left, and nothing else."""
        return not (self.changed or self.missing or self.additional)

    @property
    def is_study(self) -> bool:
        """Whether it is of a study's runs, which has chunks."""
        return self.manifest.program == STUDY and not self.manifest.gradient


def folder_state(folder: Path) -> FolderState:
    """Look at every file of a run folder.

    Raises:
        InputError: it is none, or the run in it is not finished.
    """
    manifest = _manifest(folder)
    content = (folder / MANIFEST).read_bytes()
    told = json.loads(content)
    try:
        wrong = altered(folder, manifest)
    except OSError as error:
        raise InputError(Issue(f"cannot be read: {error.strerror}", str(error.filename or folder))) from None
    missing = [name for name in wrong if not (folder / name).exists() and not (folder / name).is_symlink()]
    changed = [name for name in wrong if name not in missing]
    # a manifest that says where it was made has a seal
    sealed = manifest.digest is not None or manifest.provenance is not None
    if sealed and (manifest.digest != seal(told) or content != json_text(told).encode()):
        changed.append(MANIFEST)
    known = {MANIFEST, *manifest.sha256}
    if manifest.program == STUDY and not manifest.gradient:
        chunks = examined(folder)
        gone = {name for name in chunks.damaged if not (folder / name).exists()}
        changed += [name for name in chunks.damaged if name not in gone]
        missing += sorted(gone)
        known |= {name for name in every_file(folder) if name.startswith(f"{FOLDER}/")} - set(chunks.unlisted)
        if not chunks.damaged and sum(chunk.runs for chunk in chunks.whole) != manifest.runs:
            changed.append(f"{FOLDER}/index.txt")
        lock = folder / STUDY_LOCK
        if lock.exists():
            known.add(STUDY_LOCK)
            changed += [STUDY_LOCK] if lock.stat().st_size else []
    additional = [name for name in every_file(folder) if name not in known]
    gone_inputs, other_inputs = _inputs(manifest)
    return FolderState(
        folder,
        manifest,
        tuple(sorted(changed)),
        tuple(sorted(missing)),
        tuple(additional),
        other_inputs,
        gone_inputs,
        sealed,
    )


def _manifest(folder: Path) -> Manifest:
    """The manifest of a finished run.

    Raises:
        InputError: there is none, with what the folder is instead.
    """
    remedy = "the folder of a finished run, as a command of the twin leaves it"
    if not folder.is_dir():
        what = "is not a folder" if folder.exists() else "no such folder"
        raise InputError(Issue(what, str(folder), allowed=remedy))
    manifest = read_manifest(folder)
    if manifest is not None:
        return manifest
    if (folder / MANIFEST).exists():
        text = "is not the manifest of a run, or is damaged: nothing tells what the folder held"
        raise InputError(Issue(text, str(folder / MANIFEST), allowed="a copy of it, or the run made again"))
    if (folder / STUDY_STATE).exists():
        text = "a study that is not finished"
        raise InputError(Issue(text, str(folder), allowed="the same twin.study command with --resume, then verify it"))
    if folder.name.startswith(".") and folder.name.endswith(f".{PARTIAL}"):
        text = "a run that was broken off, or is still being written"
        raise InputError(Issue(text, str(folder), allowed="the run folder that its command names when it ends"))
    raise InputError(Issue(f"not a run folder: it has no {MANIFEST} of a run", str(folder), allowed=remedy))


def _inputs(manifest: Manifest) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Those that are gone, and those that changed."""
    gone = tuple(name for name in manifest.inputs if not Path(name).is_file())
    changed = []
    for name, known in manifest.inputs.items():
        try:
            if name not in gone and digest(Path(name)) != known:
                changed.append(name)
        except OSError:
            changed.append(name)
    return gone, tuple(changed)


@dataclass(frozen=True)
class Elsewhere:
    """What is not the same here as where a run was made.

    Attributes:
        program: the source, or packages: other numbers may be meant.
        processor: what rounds otherwise, and nothing more: processor, linear algebra, C library.
        known: whether the manifest says where the run was made.
    """

    program: tuple[str, ...]
    processor: tuple[str, ...]
    known: bool


def elsewhere(manifest: Manifest, here: Provenance | None, now: Mapping[str, str]) -> Elsewhere:
    """What differs between where a run was made and where it was made again.

    Args:
        manifest: of the run.
        here: where it was made again.
        now: versions that made it again.
    """
    then = manifest.versions
    program = [
        f"{name} {then.get(name, 'none')} then, {now.get(name, 'none')} now"
        for name in sorted({*now, *then})
        if now.get(name) != then.get(name)
    ]
    made = manifest.provenance
    if made is None or here is None:
        return Elsewhere(tuple(program), (), False)
    if made.source != here.source:
        program.insert(0, f"source {made.source[:12]} then, {here.source[:12]} now")
    program += [
        f"{name} {made.packages.get(name, 'none')} then, {here.packages.get(name, 'none')} now"
        for name in sorted({*made.packages, *here.packages})
        if made.packages.get(name) != here.packages.get(name)
    ]
    processor = [
        f"{what} {_said(before)} then, {_said(now_)} now"
        for what, before, now_ in (
            ("processor", made.processor, here.processor),
            ("instructions", made.simd, here.simd),
            ("C library", made.libc, here.libc),
            ("settings", _that_round(made.settings), _that_round(here.settings)),
        )
        if before != now_
    ]
    kernels, others = _kernels(made), _kernels(here)
    processor += [
        f"{library} with kernels for {kernels[library]} then, {others[library]} now"
        for library in sorted(kernels.keys() & others.keys())
        if kernels[library] != others[library]
    ]
    return Elsewhere(tuple(program), tuple(processor), True)


def _kernels(where: Provenance) -> dict[str, str]:
    """Library of linear algebra -> processor that its sums are for. No number depends on how many threads it has."""
    return {f"{one.name} {one.version}": one.kernels for one in where.blas}


def _that_round(settings: Mapping[str, str]) -> dict[str, str]:
    """Variables of the environment that change how numbers are rounded."""
    return {name: value for name, value in settings.items() if not name.endswith("THREADS")}


def _said(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{key}={one}" for key, one in value.items()) or "none"
    return ", ".join(value) or "none" if isinstance(value, list) else str(value)
