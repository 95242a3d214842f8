"""docs/promises.md: every promise names tests that would fail, and these are there."""

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def test_a_promise_names_tests_that_are_there() -> None:
    text = (ROOT / "docs/promises.md").read_text("utf-8")
    promises = re.findall(r"^- .*(?:\n  .*)*", text, re.M)
    assert len(promises) >= 35
    gone = []
    for promise in promises:
        named = re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", promise)
        assert named, f"no test would fail: {promise}"
        assert len(named) == promise.count("::"), f"a test that is not written as the others: {promise}"
        for file, name in named:
            source = (ROOT / file).read_text("utf-8") if (ROOT / file).exists() else ""
            gone += [] if re.search(rf"^ *(async )?def {name}\(", source, re.M) else [f"{file}::{name}"]
    assert gone == []
