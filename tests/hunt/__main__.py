"""``python -m tests.hunt [CASES] [FIRST]``: hunt for cases in which the twin misleads its user, and print them."""

from __future__ import annotations

import sys
import tempfile
import time
from collections import Counter
from itertools import chain
from pathlib import Path

from optics.numerics.backend import load_backend
from tests.hunt.hunt import hunt
from tests.hunt.legal_spans import span_hunt
from tests.hunt.legal_telescopes import telescopes
from tests.hunt.lives import lives
from tests.hunt.stops import stops


def main(cases: int = 60, first: int = 0, dense: int = 6) -> int:
    """Print defects as they come, and what became of all cases; how many defects there are."""
    began, counts, checked, defects = time.monotonic(), Counter(), 0, 0
    with tempfile.TemporaryDirectory() as folder:
        backend = load_backend("llvm")
        jobs = hunt(first, cases, Path(folder), backend, dense)
        others = (stops(first, cases, backend), lives(first, cases), span_hunt(first, cases))
        for outcome in chain(jobs, *others, telescopes(first, cases, Path(folder), backend)):
            counts[outcome.kind] += 1
            checked += outcome.checked
            if outcome.defect:
                defects += 1
                print(f"{outcome.case}: {outcome.kind}: {outcome.text}", flush=True)
            elif outcome.kind == "refused":
                print(f"{outcome.case}: refused: " + outcome.text.splitlines()[-1][:220], flush=True)
    spent = time.monotonic() - began
    print(f"{cases} cases of each kind in {spent:.0f} s, {checked} with dense images: {dict(counts)}")
    return defects


if __name__ == "__main__":
    sys.exit(1 if main(*map(int, sys.argv[1:])) else 0)
