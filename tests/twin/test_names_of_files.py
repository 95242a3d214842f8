"""Names that no file can have: one line, and an exit code."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.tiers import quick

ROOT = Path(__file__).resolve().parents[2]
LONG = "x" * 5000
COMMANDS = [
    ("twin.operate", "status", LONG),
    ("twin.verify", LONG),
    ("twin.export", LONG),
    ("twin.orbit", "export", LONG),
    ("twin.compare", LONG, LONG),
]


def run(*words: str, **how: object) -> subprocess.CompletedProcess[str]:
    own = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    done = subprocess.run([sys.executable, "-m", *words], cwd=ROOT, env=own, stderr=subprocess.PIPE, text=True, **how)
    assert "Traceback" not in done.stderr
    return done


@pytest.mark.parametrize("words", quick(1, [(words,) for words in COMMANDS]))
def test_a_name_too_long_is_bad_input(words: tuple[str, ...]) -> None:
    done = run(*words, stdout=subprocess.PIPE)
    assert done.returncode == 2
    assert "File name too long" in done.stderr
