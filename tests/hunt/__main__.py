"""``python -m tests.hunt [CASES] [FIRST] [KIND]``: hunt for cases in which the twin misleads its user, and print them.

CASES of each kind (60), beginning with number FIRST (0); KIND is one of jobs, stops, spans and telescopes.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from optics.numerics.backend import load_backend
from tests.daily import report
from tests.hunt.hunt import hunt
from tests.hunt.legal_spans import span_hunt
from tests.hunt.legal_telescopes import telescopes
from tests.hunt.stops import stops


def main(cases: str = "60", first: str = "0", kind: str = "") -> int:
    """Return how many cases mislead."""
    count, number, backend = int(cases), int(first), load_backend("llvm")
    with tempfile.TemporaryDirectory() as folder:
        kinds = {
            "jobs": lambda: hunt(number, count, Path(folder), backend, 6),
            "stops": lambda: stops(number, count, backend),
            "spans": lambda: span_hunt(number, count),
            "telescopes": lambda: telescopes(number, count, Path(folder), backend),
        }
        return sum(report(find()) for name, find in kinds.items() if kind in ("", name))


if __name__ == "__main__":
    sys.exit(1 if main(*sys.argv[1:]) else 0)
