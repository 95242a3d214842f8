"""Finished chunks of a study on disk, each in a file that outlives a failure of the power.

The index is a file to which lines are added. A line begins with its own checksum, so that one that was half written
when the power failed is seen and left out. Whatever is not listed is not there.
"""

from __future__ import annotations

import errno
import hashlib
import io
import json
import os
import re
import stat
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from twin.run.durable import PARTIAL_NAME, make_folders, sync_folder, write_safely
from twin.study.runs.base_job import BlockResult
from twin.study.runs.plan import Plan

FOLDER, INDEX = "chunks", "index.txt"
PARTS = ("values", "sigmas", "noises", "messages", "doubts", "seconds", "blocks")
"""Arrays in the file of a chunk."""


class ChunkError(Exception):
    """A chunk file does not hold what was written."""


class Entry(BaseModel):
    """A listed chunk.

    Attributes:
        file: name in the folder; it follows from ``first``.
        first: number of its first block.
        blocks: number of blocks.
        runs: number of runs.
        sha256: of the file.
    """

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid")

    file: str
    first: Annotated[int, Field(ge=0)]
    blocks: Annotated[int, Field(ge=1)]
    runs: Annotated[int, Field(ge=1)]
    sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]

    @model_validator(mode="after")
    def _named(self) -> Self:
        if self.file != _file(self.first):
            raise ValueError(f"the chunk from block {self.first} on is not in {self.file!r}")
        return self

    @property
    def range(self) -> range:
        """Numbers of its blocks."""
        return range(self.first, self.first + self.blocks)


class ChunkStore:
    """Chunks of one study below its folder.

    Args:
        folder: of the study.
        plan: of the study.

    Attributes:
        entries: chunks that are there, by their first blocks.
        corrupt: what was found damaged when the folder was opened, and what becomes of it, a sentence each.
    """

    def __init__(self, folder: Path, plan: Plan) -> None:
        self.folder = folder / FOLDER
        self.plan = plan
        self.entries: dict[int, Entry] = {}
        self.corrupt: list[str] = []

    def open(self) -> None:
        """Read the index and check every chunk in it; corrupt ones are moved aside and told in ``corrupt``."""
        make_folders(self.folder)
        for left in list(self.folder.iterdir()):
            if re.fullmatch(PARTIAL_NAME, left.name):
                left.unlink(missing_ok=True)
        listed = self._listed()
        for entry in listed:
            try:
                self.read(entry)
            except ChunkError:
                self._set_aside(entry)
                continue
            self.entries[entry.first] = entry
        known = {entry.file for entry in self.entries.values()}
        for left in list(self.folder.iterdir()):
            # written, but not listed before the end: nobody vouches for it
            if re.fullmatch(r"[0-9]{5,}\.npz", left.name) and left.name not in known:
                left.unlink(missing_ok=True)
        if self.corrupt or self._index() != b"".join(map(_line, listed)):
            write_safely(self.folder / INDEX, b"".join(map(_line, self.entries.values())))

    @property
    def done(self) -> set[int]:
        """Numbers of the blocks that are there."""
        return {block for entry in self.entries.values() for block in entry.range}

    @property
    def missing(self) -> list[int]:
        """Numbers of the blocks that are not, in order."""
        done = self.done
        return [block for block in range(self.plan.blocks) if block not in done]

    @property
    def runs(self) -> int:
        """Number of runs that are there."""
        return sum(entry.runs for entry in self.entries.values())

    def write(self, first: int, parts: list[BlockResult]) -> None:
        """Keep the results of consecutive blocks.

        Args:
            first: number of the first block.
            parts: result of each.

        Raises:
            OSError: the disk is full, or gone.
        """
        whole = BlockResult.joined(parts)
        content = _packed(first, len(parts), whole)
        name = _file(first)
        write_safely(self.folder / name, content)
        entry = Entry(
            file=name,
            first=first,
            blocks=len(parts),
            runs=len(whole.messages),
            sha256=hashlib.sha256(content).hexdigest(),
        )
        first_line = not (self.folder / INDEX).exists()
        with (self.folder / INDEX).open("ab") as index:
            index.write(_line(entry))
            index.flush()
            os.fsync(index.fileno())
        if first_line:
            sync_folder(self.folder)
        self.entries[first] = entry

    def read(self, entry: Entry) -> BlockResult:
        """What a chunk holds.

        Raises:
            ChunkError: not what was written.
        """
        try:
            content = _content(self.folder / entry.file)
        except OSError as error:
            raise ChunkError(f"{entry.file}: {error.strerror}") from error
        if hashlib.sha256(content).hexdigest() != entry.sha256:
            raise ChunkError(f"{entry.file}: its checksum is wrong")
        runs = [number for block in entry.range for number in self.plan.block(block)]
        try:
            return _unpacked(content, entry, (len(runs), len(self.plan.setup.study.responses)))
        except Exception as error:  # whatever a doctored file makes of the libraries
            raise ChunkError(f"{entry.file}: {error}") from error

    def result(self) -> BlockResult:
        """Results of all runs, in order; all blocks must be there.

        Raises:
            ChunkError: a chunk has been damaged since it was checked.
        """
        return BlockResult.joined([self.read(self.entries[first]) for first in sorted(self.entries)])

    def _listed(self) -> list[Entry]:
        """Entries of the index, the last one for each file; lines that are not whole are left out."""
        entries: dict[int, Entry] = {}
        content = self._index()
        for number, line in enumerate(content.splitlines(keepends=True), 1):
            entry = _entry(line)
            if entry is not None and self._fits(entry):
                entries[entry.first] = entry
            elif line.endswith(b"\n"):  # else it was being written when the power failed
                self.corrupt.append(f"line {number} of {INDEX} is corrupt; what it listed is computed again")
        taken: set[int] = set()
        out = []
        for entry in entries.values():
            if taken.isdisjoint(entry.range):
                taken.update(entry.range)
                out.append(entry)
        return out

    def _fits(self, entry: Entry) -> bool:
        """Whether a chunk is one of this plan's."""
        if entry.range.stop > self.plan.blocks:
            return False
        return entry.runs == sum(len(self.plan.block(block)) for block in entry.range)

    def _index(self) -> bytes:
        try:
            return _content(self.folder / INDEX)
        except FileNotFoundError:
            return b""

    def _set_aside(self, entry: Entry) -> None:
        place = self.folder / entry.file
        text = "it is computed again"
        if place.exists() or place.is_symlink():
            place.replace(place.with_name(f"{entry.file}.corrupt"))
            text = f"it was moved aside as {entry.file}.corrupt and is computed again"
        self.corrupt.append(f"chunk {entry.file} is corrupt; {text}")


@dataclass(frozen=True)
class ChunkFiles:
    """The chunks of a study as they stand on the disk.

    Attributes:
        damaged: files that are not as they were written, the index among them; paths in the study's folder.
        unlisted: files that the index does not know.
        whole: chunks that are.
    """

    damaged: tuple[str, ...]
    unlisted: tuple[str, ...]
    whole: tuple[Entry, ...]


def examined(study: Path) -> ChunkFiles:
    """What has become of the chunks of a finished study, by their own checksums; nothing is touched.

    Args:
        study: its folder.
    """
    folder, damaged, listed = study / FOLDER, [], set()
    good: list[Entry] = []
    try:
        lines = _content(folder / INDEX).splitlines(keepends=True)
    except OSError:
        lines = []
    entries = [_entry(line) if line.endswith(b"\n") else None for line in lines]
    if not entries or None in entries:
        damaged.append(INDEX)
    for entry in entries:
        if entry is None or entry.file in listed:
            continue
        listed.add(entry.file)
        try:
            whole = hashlib.sha256(_content(folder / entry.file)).hexdigest() == entry.sha256
        except OSError:
            whole = False
        if whole:
            good.append(entry)
        else:
            damaged.append(entry.file)
    there = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if not path.is_dir()}
    others = sorted(there - listed - {INDEX})
    in_study = [tuple(f"{FOLDER}/{name}" for name in names) for names in (damaged, others)]
    return ChunkFiles(in_study[0], in_study[1], tuple(good))


def _packed(first: int, blocks: int, result: BlockResult) -> bytes:
    out = io.BytesIO()
    messages, doubts = (
        np.frombuffer(json.dumps(list(texts)).encode(), np.uint8) for texts in (result.messages, result.doubts)
    )
    np.savez(
        out,
        values=result.values,
        sigmas=result.sigmas,
        noises=result.noises,
        messages=messages,
        doubts=doubts,
        seconds=np.float64(result.seconds),
        blocks=np.array([first, blocks]),
    )
    return out.getvalue()


def _unpacked(content: bytes, entry: Entry, shape: tuple[int, int]) -> BlockResult:
    """The inverse of ``_packed``.

    Raises:
        ValueError, KeyError, zipfile.BadZipFile, ...: it is not its output for runs and responses of this shape.
    """
    with np.load(io.BytesIO(content), allow_pickle=False) as file:
        packed = {name: file[name] for name in PARTS}
    numbers = ("values", "sigmas", "noises")
    for name in numbers:
        if packed[name].dtype != np.float64 or packed[name].shape != shape:
            raise ValueError(f"{name} are {packed[name].dtype} {packed[name].shape} instead of float64 {shape}")
    if packed["blocks"].tolist() != [entry.first, entry.blocks]:
        raise ValueError("it is of other blocks")
    messages, doubts = (json.loads(packed[name].tobytes()) for name in ("messages", "doubts"))
    for texts in (messages, doubts):
        if not (isinstance(texts, list) and len(texts) == shape[0] and all(isinstance(m, str) for m in texts)):
            raise ValueError("it has not one message for each run")
    seconds = packed["seconds"]
    if seconds.dtype != np.float64 or seconds.shape != () or not seconds >= 0.0:
        raise ValueError("it does not say how long it took")
    values, sigmas, noises = (packed[name] for name in numbers)
    return BlockResult(values, sigmas, noises, tuple(messages), float(seconds), tuple(doubts))


def _content(place: Path) -> bytes:
    """A file's content; no link is followed, out of the folder for instance, and nothing waited for.

    Raises:
        OSError: it is not there, or no file.
    """
    with open(os.open(place, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise OSError(errno.EINVAL, "not a file", str(place))
        return file.read()


def _file(first: int) -> str:
    """Name of the chunk that begins with this block."""
    return f"{first:05d}.npz"


def _line(entry: Entry) -> bytes:
    text = json.dumps(entry.model_dump(), sort_keys=True)
    return f"{hashlib.sha256(text.encode()).hexdigest()[:16]} {text}\n".encode()


def _entry(line: bytes) -> Entry | None:
    """The entry of a line of the index, None when it is not one that this program writes."""
    check, _, text = line.removesuffix(b"\n").partition(b" ")
    if hashlib.sha256(text).hexdigest()[:16].encode() != check:
        return None
    try:
        return Entry.model_validate_json(text)
    except ValidationError:
        return None
