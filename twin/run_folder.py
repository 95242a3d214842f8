"""A run folder: written under a temporary name beside its place and renamed when complete; none is ever half there."""

from __future__ import annotations

import hashlib
import json
import os
import secrets
import shutil
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any

MANIFEST = "manifest.json"


class RunFolderError(Exception):
    """A run folder cannot be made; the message says why and what to do."""


class RunFolder:
    """Context manager that makes a run folder.

    Inside the ``with`` block write files below ``path``; on success they appear as ``target`` in one rename, on any
    error, and on an interrupt, nothing is left behind.

    Args:
        target: where the folder shall stand.
        force: replace an existing run folder. Only a folder that is empty or holds a run's manifest is ever replaced.

    Raises:
        RunFolderError: the target exists, or cannot be written.
    """

    def __init__(self, target: Path, force: bool = False) -> None:
        self.target = Path(target)
        self.force = force
        self.path = self.target
        self._made_parents: list[Path] = []
        try:
            self._check_target()
        except OSError as error:
            raise RunFolderError(f"cannot look at the output folder {self.target}: {_reason(error)}") from error

    def _check_target(self) -> None:
        target = self.target
        if not (target.exists() or target.is_symlink()):
            return
        if not target.is_dir() or target.is_symlink():
            raise RunFolderError(f"output {target} exists and is not a folder; choose another with --out")
        if not self.force:
            raise RunFolderError(
                f"output folder {target} exists; choose another with --out, or replace it with --force"
            )
        if any(target.iterdir()) and not is_run_folder(target):
            raise RunFolderError(
                f"output folder {target} is not a run folder (it has no {MANIFEST} of a run), so --force does not "
                "replace it; choose another with --out"
            )

    def __enter__(self) -> RunFolder:
        """Make the temporary folder."""
        try:
            self._make_parents()
            self.path = self._beside("partial")
            self.path.mkdir()
        except OSError as error:
            self._remove()
            raise RunFolderError(f"cannot make the output folder {self.target}: {_reason(error)}") from error
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Rename when all went well, else remove."""
        if error is None:
            try:
                self._publish()
                return
            except OSError as failure:
                self._remove()
                raise RunFolderError(
                    f"cannot put the output folder {self.target} in place: {_reason(failure)}"
                ) from failure
            except BaseException:
                self._remove()
                raise
        self._remove()
        if isinstance(error, OSError):
            raise RunFolderError(f"cannot write to {self.target}: {_reason(error)}; nothing was kept") from error

    def _beside(self, ending: str) -> Path:
        """A fresh hidden name in the folder of the target."""
        return self.target.parent / f".{self.target.name}.{secrets.token_hex(4)}.{ending}"

    def _make_parents(self) -> None:
        """Make the folders above the target, and remember which of them were not there."""
        missing = [parent for parent in self.target.parents if not parent.exists()]
        for parent in reversed(missing):
            parent.mkdir(exist_ok=True)
            self._made_parents.insert(0, parent)

    def _remove(self) -> None:
        """Take back everything that was made."""
        if self.path != self.target:
            shutil.rmtree(self.path, ignore_errors=True)
        for parent in self._made_parents:
            try:
                parent.rmdir()
            except OSError:  # somebody else has put something there
                break

    def _publish(self) -> None:
        if self.force and self.target.exists():
            old = self._beside("old")
            os.rename(self.target, old)
            try:
                os.rename(self.path, self.target)
            except BaseException:
                os.rename(old, self.target)
                raise
            shutil.rmtree(old, ignore_errors=True)
        else:
            os.rename(self.path, self.target)

    def write_json(self, name: str, data: Any) -> None:
        """Write a JSON file; NaN and infinities are refused, since JSON has none."""
        self.write_text(name, json.dumps(data, indent=2, allow_nan=False) + "\n")

    def write_text(self, name: str, text: str) -> None:
        """Write a UTF-8 text file."""
        place = self._place(name)
        place.write_text(text, encoding="utf-8")

    def write_bytes(self, name: str, content: bytes | memoryview) -> None:
        """Write a binary file."""
        self._place(name).write_bytes(content)

    def write_with(self, name: str, writer: Callable[[Path], None]) -> None:
        """Let ``writer`` make the file of that name."""
        writer(self._place(name))

    def _place(self, name: str) -> Path:
        place = self.path / name
        place.parent.mkdir(parents=True, exist_ok=True)
        return place

    def checksums(self) -> dict[str, str]:
        """SHA-256 of every file written so far, by path relative to the folder."""
        out = {}
        for file in sorted(self.path.rglob("*")):
            if file.is_file():
                out[file.relative_to(self.path).as_posix()] = hashlib.sha256(file.read_bytes()).hexdigest()
        return out


def is_run_folder(folder: Path) -> bool:
    """Whether a folder holds the manifest of a run. Other programs call their files manifest.json as well."""
    try:
        manifest = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(manifest, dict) and str(manifest.get("program", "")).startswith("twin.") and "sha256" in manifest


def next_free(folder: Path, stem: str) -> Path:
    """First of stem-001, stem-002, ... that does not exist in ``folder``."""
    for number in range(1, 1_000_000):
        candidate = folder / f"{stem}-{number:03d}"
        if not (candidate.exists() or candidate.is_symlink()):
            return candidate
    raise RunFolderError(f"no free name {stem}-NNN in {folder}; choose one with --out")


def _reason(error: OSError) -> str:
    """In a few words; HDF5 puts a page into strerror."""
    return os.strerror(error.errno) if error.errno else str(error)
