"""Finished chunks of a study on disk: each in a file of its own, listed with its checksum once it is safely there.

The index is a file to which lines are added. A line begins with its own checksum, so that one that was half written
when the power failed is seen and left out. Whatever is not listed is not there.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from twin.study.block_result import BlockResult
from twin.study.plan import Plan
from twin.study.safe_file import PARTIAL, write_safely

FOLDER, INDEX = "chunks", "index.txt"


class ChunkError(Exception):
    """A chunk file does not hold what was written."""


@dataclass(frozen=True)
class Entry:
    """A listed chunk.

    Attributes:
        file: name in the folder.
        first: number of its first block.
        blocks: number of blocks.
        runs: number of runs.
        sha256: of the file.
    """

    file: str
    first: int
    blocks: int
    runs: int
    sha256: str

    @property
    def range(self) -> range:
        """Numbers of its blocks."""
        return range(self.first, self.first + self.blocks)


class ChunkStore:
    """Chunks of one study below its folder.

    Args:
        folder: of the study.
        plan: of the study.
    """

    def __init__(self, folder: Path, plan: Plan) -> None:
        self.folder = folder / FOLDER
        self.plan = plan
        self.entries: dict[int, Entry] = {}
        self.corrupt: list[str] = []

    def open(self) -> None:
        """Read the index and check every chunk in it; corrupt ones are moved aside, their names kept in ``corrupt``."""
        self.folder.mkdir(parents=True, exist_ok=True)
        for left in self.folder.glob(f"*{PARTIAL}"):
            left.unlink(missing_ok=True)
        listed = self._listed()
        for entry in listed:
            try:
                self.read(entry)
            except ChunkError:
                self._set_aside(entry)
                continue
            self.entries[entry.first] = entry
        for left in self.folder.glob("*.npz"):
            # written, but not listed before the end: nobody vouches for it
            if left.name not in {entry.file for entry in self.entries.values()}:
                left.unlink(missing_ok=True)
        if self.corrupt or self._index_is_damaged(listed):
            self._rewrite_index()

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
        name = f"{first:05d}.npz"
        write_safely(self.folder / name, content)
        entry = Entry(name, first, len(parts), len(whole.messages), hashlib.sha256(content).hexdigest())
        with (self.folder / INDEX).open("ab") as index:
            index.write(_line(entry))
            index.flush()
            os.fsync(index.fileno())
        self.entries[first] = entry

    def read(self, entry: Entry) -> BlockResult:
        """What a chunk holds.

        Raises:
            ChunkError: not what was written.
        """
        try:
            content = (self.folder / entry.file).read_bytes()
        except OSError as error:
            raise ChunkError(f"{entry.file}: {error.strerror}") from error
        if hashlib.sha256(content).hexdigest() != entry.sha256:
            raise ChunkError(f"{entry.file}: its checksum is wrong")
        runs = [number for block in entry.range for number in self.plan.block(block)]
        with np.load(io.BytesIO(content), allow_pickle=False) as file:
            result = BlockResult(
                file["values"], file["sigmas"], tuple(json.loads(file["messages"].tobytes())), float(file["seconds"])
            )
        if len(result.messages) != len(runs):
            raise ChunkError(f"{entry.file}: {len(result.messages)} runs instead of {len(runs)}")
        return result

    def result(self) -> BlockResult:
        """Results of all runs, in order; all blocks must be there.

        Raises:
            ChunkError: a chunk has been damaged since it was checked.
        """
        return BlockResult.joined([self.read(self.entries[first]) for first in sorted(self.entries)])

    def _listed(self) -> list[Entry]:
        """Entries of the index, the last one for each file; lines that are not whole are left out."""
        entries: dict[int, Entry] = {}
        for line in self._index_lines():
            entry = _entry(line)
            if entry is not None and entry.first + entry.blocks <= self.plan.blocks:
                entries[entry.first] = entry
        taken: set[int] = set()
        out = []
        for entry in entries.values():
            if taken.isdisjoint(entry.range):
                taken.update(entry.range)
                out.append(entry)
        return out

    def _index_lines(self) -> list[bytes]:
        try:
            return (self.folder / INDEX).read_bytes().splitlines()
        except FileNotFoundError:
            return []

    def _index_is_damaged(self, listed: list[Entry]) -> bool:
        content = (self.folder / INDEX).read_bytes() if (self.folder / INDEX).exists() else b""
        return content != b"".join(_line(entry) for entry in listed)

    def _set_aside(self, entry: Entry) -> None:
        place = self.folder / entry.file
        self.corrupt.append(entry.file)
        if place.exists():
            place.replace(place.with_name(f"{entry.file}.corrupt"))

    def _rewrite_index(self) -> None:
        write_safely(self.folder / INDEX, b"".join(_line(entry) for entry in self.entries.values()))


def _packed(first: int, blocks: int, result: BlockResult) -> bytes:
    out = io.BytesIO()
    messages = np.frombuffer(json.dumps(list(result.messages)).encode(), np.uint8)
    np.savez(
        out,
        values=result.values,
        sigmas=result.sigmas,
        messages=messages,
        seconds=np.float64(result.seconds),
        blocks=np.array([first, blocks]),
    )
    return out.getvalue()


def _line(entry: Entry) -> bytes:
    text = json.dumps(vars(entry), sort_keys=True)
    return f"{hashlib.sha256(text.encode()).hexdigest()[:16]} {text}\n".encode()


def _entry(line: bytes) -> Entry | None:
    check, _, text = line.partition(b" ")
    if hashlib.sha256(text).hexdigest()[:16].encode() != check:
        return None
    data: dict[str, Any] = json.loads(text)
    return Entry(**data)
