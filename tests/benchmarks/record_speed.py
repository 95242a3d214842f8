"""The record of an instrument in operation: one reading more after one year and after ten."""

from __future__ import annotations

import json
import tempfile
import time
from pathlib import Path

from tests.benchmarks.number import Limit, Number, Speed
from tests.benchmarks.workbench import Workbench
from tests.twin.record_bench import A_DAY, START, given, made
from twin.operate.database import FILE
from twin.operate.entries import Entry
from twin.operate.history import History

MS = 50.0
GROWS = 1.5
"""Most times longer that a reading may take after ten years than after one: noise of the disk, and no growth."""
DAYS = 365
REPEATS = 41
CAMERAS, ESTIMATORS = ("forward", "backward"), ("paper_single", "paper_joint", "derived", "model", "posterior")
NUMBERS = ("d_alpha_arcsec", "d_beta_arcsec", "d_gamma_arcsec", "d_f_um")


def reading(k: int) -> Entry:
    """A reading of the monitor with as many numbers as `twin.recover` gives of two cameras."""
    value = 1.0 / (k + 3.0)
    one = {f"{name}{end}": value for name in NUMBERS for end in ("", "_sigma", "_sigma_noise")}
    spots = {"row": value, "column": value, "row_sigma": value, "column_sigma": value}
    first = dict.fromkeys(spots, 1.0)  # of the same reference images
    numbers = {
        "cameras": {camera: dict.fromkeys(ESTIMATORS, one) for camera in CAMERAS},
        "spots": {
            camera: {side: {"before": first, "after": spots} for side in ("left", "right")} for camera in CAMERAS
        },
        "sigma_holds": True,
    }
    step = 86_400_000_000 // A_DAY
    return Entry("monitor", "monitor", START + step * k, {"numbers": numbers, "state": 0}, None, f"{k:064x}")


def measure(bench: Workbench, quick: bool) -> Speed:
    """Milliseconds by wall clock, the disk included, median; and the size of the record."""
    years = (1,) if quick else (1, 5, 10)
    numbers, medians, done = [], [], 0
    with tempfile.TemporaryDirectory() as name:
        with made(Path(name) / "record") as history:
            for year in years:
                done = _filled(history, done, DAYS * A_DAY * year)
                spent = []
                for _ in range(REPEATS):
                    start = time.perf_counter()
                    assert history.take(given(f"one{done}", [reading(done)])).new == 1
                    spent.append(time.perf_counter() - start)
                    done += 1
                medians.append(1e3 * sorted(spent)[REPEATS // 2])
                text = f"one reading after {year} year{'s' if year > 1 else ''} of {A_DAY} a day"
                numbers.append(Number(f"reading_{year}_ms", medians[-1], text, "ms", Limit(MS)))
        size = (Path(name) / "record" / FILE).stat().st_size
    if not quick:
        numbers.append(Number("grows", medians[-1] / medians[0], "  after ten years over after one", "", Limit(GROWS)))
    per = len(json.dumps(reading(0).content))
    numbers.append(Number("size_MB", 1e-6 * size, f"  size of the record then, {per} letters a reading", "MB"))
    return Speed(tuple(numbers))


def _filled(history: History, done: int, count: int) -> int:
    """Add readings up to a count, a month's at once."""
    while done < count:
        upto = min(done + 30 * A_DAY, count)
        history.take(given(f"month{done}", [reading(k) for k in range(done, upto)]))
        done = upto
    return done
