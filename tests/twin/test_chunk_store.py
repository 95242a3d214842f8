"""Chunks of a study on disk: whatever is done to them, they are what was written or are computed again."""

import hashlib
import io
import json
import os

import numpy as np
import pytest

from tests.twin.study_bench import write_study
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


WRONG = {
    "a text for a number": {"first": "1"},
    "a fraction": {"blocks": 1.5},
    "true for a number": {"blocks": True},
    "null": {"sha256": None},
    "a list": {"file": ["00001.npz"]},
    "a negative block": {"first": -1, "file": "-0001.npz"},
    "no blocks": {"blocks": 0, "runs": 0},
    "negative blocks": {"blocks": -2},
    "more blocks than there are": {"blocks": 10**9},
    "more digits than a number has": {"blocks": 10**4000},
    "another number of runs": {"runs": 51},
    "a path that leaves the folder": {"file": "../00001.npz"},
    "an absolute path": {"file": "/etc/hostname"},
    "another chunk's file": {"file": "00003.npz"},
    "an extra key": {"note": "x"},
    "no checksum": {"sha256": "0123"},
    "a NUL": {"file": "0000\0.npz"},
}


@pytest.mark.parametrize("wrong", WRONG)
def test_a_doctored_line_is_computed_again(store, wrong) -> None:
    found = entries(store)
    found[1] |= WRONG[wrong]
    texts = [json.dumps(entry, sort_keys=True).encode() for entry in found]
    write_index(store, texts)
    again = opened(store)
    assert again.missing == [1, 2]
    assert any("corrupt" in text and "computed again" in text for text in again.corrupt), again.corrupt
    # the folder is whole again: nothing more is told of it
    once_more = opened(store)
    assert once_more.corrupt == []
    assert once_more.missing == [1, 2]


@pytest.mark.parametrize(
    "text", [b"", b"{}", b"[]", b"7", b"null", b"\xff\xfe", b'"x"', b"[" * 100_000, b"{" * 100_000]
)
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
    """File of block 0, doctored."""
    runs = np.arange(25.0)
    parts = {
        "values": np.stack([runs, runs], 1),
        "sigmas": np.stack([runs, runs], 1),
        "noises": np.stack([runs, runs], 1),
        "messages": np.frombuffer(json.dumps([""] * 25).encode(), np.uint8),
        "doubts": np.frombuffer(json.dumps([""] * 25).encode(), np.uint8),
        "seconds": np.float64(0.5),
        "blocks": np.array([0, 1]),
    } | changes
    out = io.BytesIO()
    np.savez(out, **{name: part for name, part in parts.items() if part is not None})
    return out.getvalue()


def messages(data: object) -> dict:
    return {"messages": np.frombuffer(json.dumps(data).encode(), np.uint8)}


DOCTORED = {
    "empty": b"",
    "no archive": b"x" * 1000,
    "half an archive": packed()[:500],
    "an array": np.arange(3).tobytes(),
    "no values": packed(values=None),
    "a run too many": packed(values=np.zeros((26, 2))),
    "a response too few": packed(values=np.zeros((25, 1))),
    "one dimension": packed(sigmas=np.zeros(50)),
    "no noise": packed(noises=None),
    "whole numbers": packed(values=np.zeros((25, 2), np.int64)),
    "texts": packed(values=np.full((25, 2), "x")),
    "objects": packed(values=np.array([[{}, {}]] * 25, dtype=object)),
    "other blocks": packed(blocks=np.array([1, 1])),
    "messages that are a text": packed(**messages("x" * 25)),
    "messages that are numbers": packed(**messages([0] * 25)),
    "too few messages": packed(**messages([""])),
    "too few doubts": packed(doubts=np.frombuffer(json.dumps([""]).encode(), np.uint8)),
    "messages that are no JSON": packed(messages=np.zeros(7, np.uint8)),
    "several times": packed(seconds=np.zeros(3)),
    "no time": packed(seconds=np.float64("nan")),
}


def test_the_doctored_files_can_be_good(store) -> None:
    replace_chunk(store, packed())
    assert opened(store).corrupt == []


def replace_chunk(store: ChunkStore, content: bytes) -> None:
    """Replace the first chunk and its checksum."""
    found = entries(store)
    found[0]["sha256"] = hashlib.sha256(content).hexdigest()
    (store.folder / "00000.npz").write_bytes(content)
    write_index(store, [json.dumps(entry, sort_keys=True).encode() for entry in found])


@pytest.mark.parametrize("doctored", DOCTORED)
def test_a_doctored_chunk_is_computed_again(store, doctored) -> None:
    """With the right checksum, so that only its contents tell."""
    replace_chunk(store, DOCTORED[doctored])
    again = opened(store)
    assert again.missing == [0]
    assert again.corrupt == [
        "chunk 00000.npz is corrupt; it was moved aside as 00000.npz.corrupt and is computed again"
    ]
    assert (store.folder / "00000.npz.corrupt").read_bytes() == DOCTORED[doctored]


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
