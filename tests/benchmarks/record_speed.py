"""An instrument in operation: one reading more after one year and after ten, in the record and in the estimate, and the
whole past smoothed.
"""

from __future__ import annotations

import json
import tempfile
import time
from pathlib import Path

import numpy as np

from scenes.specs.operation import read_operation
from tests.benchmarks.workbench import Number, Speed, Workbench
from tests.twin.record_bench import A_DAY, START, given, made
from twin.operate.estimate.operation_filter import Operation
from twin.operate.record import FILE
from twin.operate.record.entries import Entry
from twin.operate.record.history import History

DAYS = 365
REPEATS = 41
CAMERAS, ESTIMATORS = ("forward", "backward"), ("paper_single", "paper_joint", "derived", "model", "posterior")
NUMBERS = ("d_alpha_arcsec", "d_beta_arcsec", "d_gamma_arcsec", "d_f_um")
NOISE = 8e-4
"""Px of a spot's coordinate."""
PLAN = "scenes/examples/operation.yaml"


def reading(k: int) -> Entry:
    """A reading of the monitor with as many numbers as `twin.recover` gives of two cameras that do not move."""
    value = 1.0 / (k + 3.0)
    one = {f"{name}{end}": value for name in NUMBERS for end in ("", "_sigma", "_sigma_noise")}
    places = iter((47.5 + NOISE * np.random.default_rng(k).standard_normal(8)).tolist())
    sigma = {"row_sigma": NOISE, "column_sigma": NOISE}
    start = {"row": 47.5, "column": 47.5, **sigma}
    spots = {
        camera: {
            side: {"before": start, "after": {"row": next(places), "column": next(places), **sigma}}
            for side in ("left", "right")
        }
        for camera in CAMERAS
    }
    cameras = {camera: dict.fromkeys(ESTIMATORS, one) for camera in CAMERAS}
    numbers = {"cameras": cameras, "spots": spots, "sigma_holds": True}
    step = 86_400_000_000 // A_DAY
    return Entry("monitor", "monitor", START + step * k, {"numbers": numbers, "state": 0}, None, f"{k:064x}")


def measure(bench: Workbench, quick: bool) -> Speed:
    """Medians by the clock, the disk included, and of processor time; and the size of the record."""
    years = (1,) if quick else (1, 5, 10)
    numbers, clocks, medians, followed, done = [], [], [], [], 0
    plan = read_operation(PLAN)
    with tempfile.TemporaryDirectory() as name:
        with made(Path(name) / "record") as history:
            for year in years:
                done = _filled(history, done, DAYS * A_DAY * year)
                estimate = Operation(history, plan)
                assert estimate.estimator_state
                clock, spent, more = [], [], []
                for _ in range(REPEATS):
                    start, begun = time.process_time(), time.perf_counter()
                    assert history.ingest(given(f"one{done}", [reading(done)])).new == 1
                    taken = time.process_time()
                    clock.append(time.perf_counter() - begun)
                    estimate = estimate.updated()
                    assert estimate.estimator_state
                    spent.append(taken - start)
                    more.append(time.process_time() - taken)
                    done += 1
                clocks.append(1e3 * sorted(clock)[REPEATS // 2])
                medians.append(1e3 * sorted(spent)[REPEATS // 2])
                followed.append(1e3 * sorted(more)[REPEATS // 2])
                text = f"one reading after {year} year{'s' if year > 1 else ''} of {A_DAY} a day"
                after = "  and of the estimate after it"
                numbers += [
                    Number(f"reading_{year}_ms", clocks[-1], text, "ms"),
                    Number(f"reading_{year}_cpu_ms", medians[-1], "  processor time", "ms"),
                    Number(f"estimate_{year}_cpu_ms", followed[-1], after, "ms"),
                ]
            start = time.process_time()
            estimate.smoothed(START + 86_400_000_000 * np.arange(DAYS * years[-1], dtype=np.int64))
            spent_s = time.process_time() - start
            text = f"the state of every day of {years[-1]} years by all {done} readings: processor time"
            numbers.append(Number("smoothed_s", spent_s, text, "s"))
        size = (Path(name) / "record" / FILE).stat().st_size
    if not quick:
        numbers.append(Number("grows", medians[-1] / medians[0], "  after ten years over after one"))
        ratio = followed[-1] / followed[0]
        numbers.append(Number("estimate_grows", ratio, "  of the estimate"))
    per = len(json.dumps(reading(0).content))
    numbers.append(Number("size_MB", 1e-6 * size, f"  size of the record then, {per} letters a reading", "MB"))
    return Speed(tuple(numbers))


def _filled(history: History, done: int, count: int) -> int:
    """Add readings up to a count, a month's at once."""
    while done < count:
        upto = min(done + 30 * A_DAY, count)
        history.ingest(given(f"month{done}", [reading(k) for k in range(done, upto)]))
        done = upto
    return done
