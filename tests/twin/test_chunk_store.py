"""Chunks of a study on disk: whatever is done to them, they are what was written or are computed again."""

import hashlib
import io
import json
import os

import numpy as np
import pytest

from tests.twin.study_bench import refusals, write_study
from twin.study.runs.base_job import BlockResult
from twin.study.runs.chunk_store import ChunkError, ChunkStore
from twin.study.runs.plan import Plan
from twin.study.runs.setup import resolve_study

BLOCKS = 4


@pytest.fixture(scope="module")
def plan(tmp_path_factory) -> Plan:
    return Plan.of(resolve_study(write_study(tmp_path_factory.mktemp("in"))))


def block_result(plan: Plan, block: int) -> BlockResult:
    runs = np.array(plan.block(block), float)
    values = np.stack([runs, -runs], axis=1)
    return BlockResult(values, 0.1 * values, 0.01 * values, ("",) * len(runs), 0.5, ("",) * len(runs))


@pytest.fixture
def store(plan, tmp_path) -> ChunkStore:
    """Four blocks in three chunks: 0, 1 to 2, 3."""
    assert plan.blocks == BLOCKS
    made = ChunkStore(tmp_path / "study", plan)
    made.open()
    for first, count in ((0, 1), (1, 2), (3, 1)):
        made.write(first, [block_result(plan, first + k) for k in range(count)])
    return made


def opened(store: ChunkStore) -> ChunkStore:
    again = ChunkStore(store.folder.parent, store.plan)
    again.open()
    return again


def entries(store: ChunkStore) -> list[dict]:
    lines = (store.folder / "index.txt").read_bytes().splitlines()
    return [json.loads(line.partition(b" ")[2]) for line in lines]


def write_index(store: ChunkStore, texts: list[bytes]) -> None:
    """An index with these texts, each with its right checksum."""
    lines = [hashlib.sha256(text).hexdigest()[:16].encode() + b" " + text + b"\n" for text in texts]
    (store.folder / "index.txt").write_bytes(b"".join(lines))


def test_what_is_written_is_read(store) -> None:
    again = opened(store)
    assert again.corrupt == []
    assert again.missing == []
    np.testing.assert_array_equal(again.result().values[:, 0], np.arange(100.0))


@pytest.mark.parametrize("wrong", refusals("entries"))
def test_a_doctored_line_is_computed_again(store, wrong) -> None:
    found = entries(store)
    found[1] |= wrong
    write_index(store, [json.dumps(entry, sort_keys=True).encode() for entry in found])
    again = opened(store)
    assert again.missing == [1, 2]
    assert any("corrupt" in text and "computed again" in text for text in again.corrupt), again.corrupt
    # the folder is whole again: nothing more is told of it
    once_more = opened(store)
    assert (once_more.corrupt, once_more.missing) == ([], [1, 2])


@pytest.mark.parametrize("text", [b"", b"[]", b"null", b"\xff\xfe", b"[" * 100_000])
def test_a_line_that_is_no_entry(store, text) -> None:
    write_index(store, [json.dumps(entry, sort_keys=True).encode() for entry in entries(store)] + [text])
    again = opened(store)
    assert again.missing == []
    assert any(f"line {BLOCKS}" in told for told in again.corrupt), again.corrupt


def test_a_torn_last_line_is_left_out_without_a_word(store) -> None:
    with (store.folder / "index.txt").open("ab") as index:
        index.write(b'0123456789abcdef {"file": "00')
    again = opened(store)
    assert (again.missing, again.corrupt) == ([], [])


def test_overlapping_entries_count_once(store) -> None:
    first = entries(store)
    write_index(store, [json.dumps(entry, sort_keys=True).encode() for entry in [*first, *first[::-1]]])
    again = opened(store)
    np.testing.assert_array_equal(again.result().values[:, 0], np.arange(100.0))


def packed(**changes: object) -> bytes:
    """File of block 0, doctored: arrays as they are, anything else as JSON, None left out."""
    numbers = np.zeros((25, 2))
    parts = {"values": numbers, "sigmas": numbers, "noises": numbers, "messages": [""] * 25, "doubts": [""] * 25}
    parts |= {"seconds": np.float64(0.5), "blocks": np.array([0, 1])} | changes
    texts = {name: np.frombuffer(json.dumps(part).encode(), np.uint8) for name, part in parts.items()
             if isinstance(part, list | str)}  # fmt: skip
    out = io.BytesIO()
    np.savez(out, **{name: part for name, part in (parts | texts).items() if part is not None})
    return out.getvalue()


DOCTORED = {
    "empty": b"",
    "half an archive": packed()[:500],
    "no values": packed(values=None),
    "a run too many": packed(values=np.zeros((26, 2))),
    "a response too few": packed(sigmas=np.zeros((25, 1))),
    "whole numbers": packed(noises=np.zeros((25, 2), np.int64)),
    "objects": packed(values=np.array([[{}, {}]] * 25, dtype=object)),
    "other blocks": packed(blocks=np.array([1, 1])),
    "messages that are a text": packed(messages="x" * 25),
    "messages that are numbers": packed(messages=[0] * 25),
    "too few doubts": packed(doubts=[""]),
    "messages that are no JSON": packed(messages=np.zeros(7, np.uint8)),
    "several times": packed(seconds=np.zeros(3)),
    "no time": packed(seconds=np.float64("nan")),
}


@pytest.mark.parametrize("doctored", DOCTORED)
def test_a_doctored_chunk_is_computed_again(store, doctored) -> None:
    """With the right checksum, so that only its contents tell; a good file stays."""
    for content in (packed(), DOCTORED[doctored]):
        found = entries(store)
        found[0]["sha256"] = hashlib.sha256(content).hexdigest()
        (store.folder / "00000.npz").write_bytes(content)
        write_index(store, [json.dumps(entry, sort_keys=True).encode() for entry in found])
        again = opened(store)
        assert again.missing == [0] * (content != packed())
    (told,) = again.corrupt
    assert told == "chunk 00000.npz is corrupt; it was moved aside as 00000.npz.corrupt and is computed again"
    assert (store.folder / "00000.npz.corrupt").read_bytes() == content


@pytest.mark.parametrize("kind", ["link", "pipe", "folder"])
def test_only_files_in_the_folder_are_read(store, tmp_path, kind) -> None:
    """A link out of the folder is not followed, a pipe not waited for; what a link leads to stays."""
    place = store.folder / "00000.npz"
    elsewhere = tmp_path / "elsewhere.npz"
    place.rename(elsewhere)
    {"link": lambda: place.symlink_to(elsewhere), "pipe": lambda: os.mkfifo(place), "folder": place.mkdir}[kind]()
    again = opened(store)
    assert again.missing == [0]
    assert len(again.corrupt) == 1
    assert elsewhere.is_file()


def test_a_chunk_of_another_checksum_is_computed_again(store) -> None:
    (store.folder / "00000.npz").write_bytes(packed())
    again = opened(store)
    assert (again.missing, len(again.corrupt)) == ([0], 1)
    entry = store.entries[0]
    with pytest.raises(ChunkError, match=r"00000\.npz"):
        store.read(entry)
