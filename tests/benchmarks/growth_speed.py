"""How the processor time of the monitor grows: with states, pixels of a CCD, bodies and frames.

Slopes are those of straight lines through the logarithms of the upper half of the sizes; a cost in proportion has 1.
``docs/figures/growth.py`` draws the times.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from optics.geometry.pose import Pose
from optics.geometry.tree import Body, Motion, RigidTree
from scenes.specs.job import JobSpec
from scenes.specs.resolved import resolve_job
from tests.benchmarks.monitor_speed import random_states
from tests.benchmarks.workbench import Number, Speed, Work, Workbench, timed
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.observation import ObservationOptions, observe, shared_detector

SIDE = 48
"""Of the CCDs of many states, pixels."""


def with_ccd(bench: Workbench, side: int) -> MonitorExperiment:
    """The pair with area CCDs of so many pixels on a side."""
    resolved = resolve_job(JobSpec(instrument="gf7_pair"))
    spec = resolved.instrument
    assert spec.monitor is not None
    ccd = spec.monitor.area_ccd.model_copy(update={"rows": side, "columns": side})
    monitor = spec.monitor.model_copy(update={"area_ccd": ccd})
    instrument = spec.model_copy(update={"monitor": monitor})
    return MonitorExperiment(resolved.model_copy(update={"instrument": instrument}), bench.backend)


def of_states(bench: Workbench, count: int) -> Callable[[], object]:
    """States observed, with one frame of small CCDs, that nobody keeps."""
    experiment = with_ccd(bench, SIDE)
    how = ObservationOptions(shared_detector(experiment, 1, 1), use_prior=False)
    every = random_states(count, 2)

    def observed() -> int:
        return sum(len(found.numbers) for found in observe(experiment, every, how))

    list(observe(experiment, every[:40], how))
    return observed


def of_pixels(bench: Workbench, side: int) -> Callable[[], object]:
    """One state rendered and exposed, without its fit."""
    experiment = with_ccd(bench, side)
    state = random_states(1, 2)

    def seen() -> object:
        photons = experiment.path.expected_photons(state)
        return experiment.frames_after(photons, 1, 1)

    seen()
    return seen


def of_bodies(bench: Workbench, count: int) -> Callable[[], object]:
    """Bodies of 100 states placed, all of which move, ten on each carrier."""
    pose = Pose(np.eye(3), np.array([0.1, 0.2, 0.3]))
    paths = [f"c{n // 10}" if n % 10 == 0 else f"c{n // 10}/b{n % 10}" for n in range(count)]
    tree = RigidTree(tuple(Body(path, pose) for path in paths))
    states = [{path: Motion(shift=(1e-6 * n, 0.0, 0.0)) for path in paths} for n in range(100)]
    return lambda: tree.place(states)


def of_frames(bench: Workbench, count: int) -> Callable[[], object]:
    """Frames of one CCD of 96 x 96 pixels exposed."""
    experiment = bench.experiment("gf7_pair")
    photons, pattern = experiment.nominal_photons[:1], experiment.pattern(1)
    one = type(pattern)(pattern.gain[:1], pattern.offset_e[:1])
    return lambda: experiment.detector.expose(photons, one, count, experiment.exposure, 1)


GROWTHS: dict[str, tuple[str, tuple[int, ...], tuple[int, ...], Callable[[Workbench, int], Callable[[], object]]]] = {
    "states": ("states", (100, 1000, 10_000, 30_000), (25, 50), of_states),
    "pixels": ("pixels on a side", (32, 64, 128, 256, 512, 1024), (32, 64), of_pixels),
    "bodies": ("bodies", (10, 20, 40, 80, 160), (10, 40), of_bodies),
    "frames": ("frames", (1, 10, 100, 1000, 10_000), (1, 10), of_frames),
}
"""What grows -> its name, the sizes that are measured, those of --quick, and size -> what is timed, ready to be."""


def slope(times: Mapping[int, float]) -> float:
    """Slope of the logarithms of the upper half of some sizes."""
    sizes = sorted(times)[-max(2, (len(times) + 1) // 2) :]
    return float(np.polyfit(np.log(sizes), np.log([times[size] for size in sizes]), 1)[0])


def measure(bench: Workbench, quick: bool) -> Speed:
    """Seconds of processor time at each size, and slopes."""
    numbers = []
    for key, (text, sizes, few, work_of) in GROWTHS.items():
        times = {}
        for size in few if quick else sizes:
            work = work_of(bench, size)
            once = Work(lambda _, work=work: work())
            first = timed(once).cpu_s
            # short work again, for an undisturbed turn
            again = 0 if quick else int(min(20, 1.0 / max(first, 1e-3)))
            times[size] = min([first, *(timed(once).cpu_s for _ in range(again))])
            numbers.append(Number(f"{key}_{size}_s", times[size], f"  {size:,} {text}", "s"))
        numbers.append(Number(f"{key}_slope", slope(times), f"slope with {text}"))
    return Speed(tuple(numbers))
