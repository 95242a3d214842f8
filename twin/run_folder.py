"""A run folder: written under a temporary name beside its place and renamed when complete, so that none is ever half
there.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
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
    error nothing is left behind.

    Args:
        target: where the folder shall stand.
        force: replace an existing run folder. Only a folder that holds a manifest (or nothing) is ever replaced.

    Raises:
        RunFolderError: the target exists, or cannot be written.
    """

    def __init__(self, target: Path, force: bool = False) -> None:
        self.target = Path(target)
        self.force = force
        self.path = self.target
        self._check_target()

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
        if any(target.iterdir()) and not (target / MANIFEST).is_file():
            raise RunFolderError(
                f"output folder {target} is not a run folder (it has no {MANIFEST}), so --force does not replace it; "
                "choose another with --out"
            )

    def __enter__(self) -> RunFolder:
        """Make the temporary folder."""
        try:
            self.target.parent.mkdir(parents=True, exist_ok=True)
            self.path = Path(
                tempfile.mkdtemp(prefix=f".{self.target.name}.", suffix=".partial", dir=self.target.parent)
            )
            os.chmod(self.path, 0o755)
        except OSError as error:
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
                shutil.rmtree(self.path, ignore_errors=True)
                raise RunFolderError(
                    f"cannot put the output folder {self.target} in place: {_reason(failure)}"
                ) from failure
        shutil.rmtree(self.path, ignore_errors=True)
        if isinstance(error, OSError) and not isinstance(error, RunFolderError):
            raise RunFolderError(f"cannot write to {self.target}: {_reason(error)}; nothing was kept") from error

    def _publish(self) -> None:
        if self.force and self.target.exists():
            old = Path(tempfile.mkdtemp(prefix=f".{self.target.name}.", suffix=".old", dir=self.target.parent))
            os.rename(self.target, old / "run")
            try:
                os.rename(self.path, self.target)
            except OSError:
                os.rename(old / "run", self.target)
                raise
            finally:
                shutil.rmtree(old, ignore_errors=True)
        else:
            os.rename(self.path, self.target)

    def write_json(self, name: str, data: Any) -> None:
        """Write a JSON file; NaN and infinities are refused, since JSON has none."""
        self.write_text(name, json.dumps(data, indent=2, allow_nan=False) + "\n")

    def write_text(self, name: str, text: str) -> None:
        """Write a UTF-8 text file."""
        place = self.path / name
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_text(text, encoding="utf-8")

    def write_with(self, name: str, writer: Callable[[Path], None]) -> None:
        """Let ``writer`` make the file of that name."""
        place = self.path / name
        place.parent.mkdir(parents=True, exist_ok=True)
        writer(place)

    def checksums(self) -> dict[str, str]:
        """SHA-256 of every file written so far, by path relative to the folder."""
        out = {}
        for file in sorted(self.path.rglob("*")):
            if file.is_file():
                out[file.relative_to(self.path).as_posix()] = hashlib.sha256(file.read_bytes()).hexdigest()
        return out


def next_free(folder: Path, stem: str) -> Path:
    """First of stem-001, stem-002, ... that does not exist in ``folder``."""
    for number in range(1, 1_000_000):
        candidate = folder / f"{stem}-{number:03d}"
        if not candidate.exists():
            return candidate
    raise RunFolderError(f"no free name {stem}-NNN in {folder}; choose one with --out")


def _reason(error: OSError) -> str:
    return error.strerror or str(error)
