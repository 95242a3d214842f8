"""Work that a command keeps beside its run folder while it runs, so that ``--resume`` can go on with it."""

from __future__ import annotations

import os
import re
from itertools import count
from pathlib import Path
from types import TracebackType
from typing import TextIO

from twin.run import durable, owned_files, run_folder

_WRITTEN = re.compile(
    rf"{re.escape(owned_files.STUDY_LOCK)}|trials\.txt"
    rf"|[^/]+/(of\.txt|(chunks/)?{durable.PARTIAL_NAME}|chunks/(index\.txt|[0-9]+\.npz(\.corrupt)?))"
)
"""Files that commands keep there."""


class KeptWork:
    """Context manager over the folder ``OUT.ENDING`` of one command, which nobody else uses until the block ends.

    Without ``--out`` a command that runs beside another one of the same name takes ``STEM.2.ENDING``, and so on. Files
    that no command of this program keeps there are never removed; a folder that holds some is refused.

    Parameters
    ----------
    out : Path or None
        The run folder that the user chose, None for one below ``runs``.
    stem : str
        Name of the run folder where the user chose none.
    ending : str
        What is kept, ``samples`` for instance.
    resume : bool
        Whether to go on with what is there; else it is removed first.

    Examples
    --------
    >>> with KeptWork(Path("out"), "out", "samples", resume=False) as kept:  # doctest: +SKIP
    ...     run(kept.begin())
    ...     kept.finish()
    """

    def __init__(self, out: Path | None, stem: str, ending: str, resume: bool) -> None:
        self._first = Path("runs") / stem if out is None else out
        self._chosen, self._ending, self._resume = out is not None, ending, resume
        self._place: Path | None = None
        self._lock: TextIO | None = None

    def __enter__(self) -> KeptWork:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        """Let others use the folder; one that nothing was kept in yet, when a bad file was told, goes."""
        if self._lock is not None:
            if kind is not None and self._place and owned_files.every_file(self._place) == [owned_files.STUDY_LOCK]:
                self.finish()
            self._lock.close()

    def begin(self) -> Path:
        """Make or take up the folder, and return it.

        Raises
        ------
        RunFolderError
            Another command uses the folder that the user chose, it holds files of somebody else, or it cannot be made.
        """
        try:
            for number in count(1):
                place = self._first.with_name(f"{self._first.name}{'' if number == 1 else f'.{number}'}.{self._ending}")
                self._refuse_others(place)
                if self._locked(place):
                    break
                if self._chosen:
                    text = f"{place} is in use by another command; wait until it has ended, or choose another --out"
                    raise run_folder.RunFolderError(text)
            self._place = place
            if not self._resume:
                owned_files.remove_files(place, {owned_files.STUDY_LOCK})
        except OSError as error:
            raise run_folder.RunFolderError(f"cannot use {place}: {run_folder.reason(error)}") from error
        return place

    def finish(self) -> None:
        """Remove what was kept: its results stand in the run folder."""
        if self._place is not None:
            others = {name for name in owned_files.every_file(self._place) if not _WRITTEN.fullmatch(name)}
            owned_files.remove_files(self._place, others)

    def _refuse_others(self, place: Path) -> None:
        if not (place.exists() or place.is_symlink()):
            return
        if place.is_symlink() or not place.is_dir():
            raise run_folder.RunFolderError(f"{place} is in the way of what is kept for --resume; choose another --out")
        names = owned_files.every_file(place)
        known = owned_files.STUDY_LOCK in names
        if others := [name for name in names if not (known and _WRITTEN.fullmatch(name))]:
            named = owned_files.first_names(others)
            text = f"{place} holds files that this program did not write: {named}; move it, or choose another --out"
            raise run_folder.RunFolderError(text)

    def _locked(self, place: Path) -> bool:
        durable.make_folders(place)
        while True:
            file = place / owned_files.STUDY_LOCK
            lock = file.open("a+", encoding="utf-8")
            if owned_files.take_lock(lock) is False:
                lock.close()
                return False
            if file.exists() and os.path.samestat(os.fstat(lock.fileno()), file.stat()):
                self._lock = lock
                return True
            lock.close()  # its owner has ended and removed it meanwhile
            durable.make_folders(place)
