"""python -m twin.recover on a series: filter and smoother are those of the main job's course, through files."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import tifffile

from optics.geometry.tree import State
from scenes.specs.job import JobSpec
from scenes.specs.measured.monitor_frames import resolve_measurement
from scenes.specs.resolved import ResolvedJob, resolve_job
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.time_series import TimeSeries, run_series, series_states
from twin.recover.recover_report import recover_numbers, recover_report
from twin.recover.recover_run import RecoverRun, run_recover

TIMES = ("0 min", "12 min", "0.5 h", "50 min")
FRAMES, SEED = 3, 7
COURSE = {
    "instrument": "gf7_pair",
    "disturbances": "orbit",
    "course": {
        "times": list(TIMES),
        "detail": "12 min",
        "temperature": {"base/forward": {"change": ["0 K", "0.08 K", "0.15 K", "0.05 K"]}},
        "motion": {
            "base/forward/M2": {
                "shift": [[f"{x} um", "0 um", f"{z} um"] for x, z in ((0, 0), (0.1, 0.2), (0.2, 0.3), (0.1, 0))]
            }
        },
    },
    "render": {"frames": FRAMES, "seed": SEED},
}


@dataclass
class Course:
    """The main job's course, and the frames that it was measured in as files."""

    job: ResolvedJob
    experiment: MonitorExperiment
    series: TimeSeries
    states: list[State]
    folder: Path

    def measured(self, backend, text: str, name: str = "series.yaml") -> RecoverRun:
        file = self.folder / name
        file.write_text(text)
        return run_recover(resolve_measurement(file), backend, experiment=self.experiment)

    def text(self, times=TIMES, which=None, **other: str) -> str:
        """A measurement's file; other: channel -> file in place of that of the second time."""
        out = f"instrument: gf7_pair\ndisturbances: orbit\ntimes: [{', '.join(times)}]\nframes:\n"
        for channel in self.experiment.path.channels:
            stem = f"{channel.camera}_{channel.name}"
            files = [f"{stem}_{k}.tiff" for k in (range(len(times)) if which is None else which)]
            if stem in other:
                files[1] = other[stem]
            out += f"  {channel.key}: {{before: {stem}_before.tiff, after: [{', '.join(files)}]}}\n"
        return out


@pytest.fixture(scope="module")
def course(experiment, tmp_path_factory) -> Course:
    job = resolve_job(JobSpec.model_validate(COURSE))
    pair = experiment("gf7_pair").stating(job)
    states = series_states(pair, job.job)
    series = run_series(pair, job, states)
    folder = tmp_path_factory.mktemp("series")
    before = pair.frames_before(FRAMES, SEED)
    after = pair.frames_after(pair.path.expected_photons(states), FRAMES, SEED)
    for i, channel in enumerate(pair.path.channels):
        stem = f"{channel.camera}_{channel.name}"
        for name, frames in (("before", before[i]), *((k, after[k, i]) for k in range(len(states)))):
            tifffile.imwrite(folder / f"{stem}_{name}.tiff", frames, photometric="minisblack", compression="lzw")
    return Course(job, pair, series, states, folder)


def dicts(run_or_series) -> tuple:
    """All that the smoother says."""
    found = run_or_series.smoothed
    return found.changes.groups(), found.between_dict(), found.to_dict()


@pytest.mark.second
def test_the_smoothed_series_is_the_main_jobs_to_the_last_bit(course, backend):
    found = course.measured(backend, course.text())
    assert dicts(found) == dicts(course.series)
    for k, reading in enumerate(found.readings):
        np.testing.assert_array_equal(reading.recovery.shift[0], course.series.shift[k])
        np.testing.assert_array_equal(reading.recovery.shift_covariance[0], course.series.shift_covariance[k])
    numbers = recover_numbers(found)
    written = course.series.to_dict()
    for name, every in numbers["smoothed"]["cameras"].items():
        for estimator in ("filtered", "smoothed"):
            assert every[estimator] == written["cameras"][name][estimator]
    assert numbers["smoothed"]["between"] == written["between"]
    assert numbers["smoothed"]["disturbances"] == written["disturbances"]
    # from the last time on nothing comes, so that both are one
    filtered, smoothed = (found.smoothed.changes.of(name)[:4] for name in ("filtered", "smoothed"))
    assert [row.value[-1] for row in filtered] == pytest.approx([row.value[-1] for row in smoothed], rel=1e-9)
    assert all(b.sigma[0] <= a.sigma[0] * (1.0 + 1e-9) for a, b in zip(filtered, smoothed, strict=True))
    assert recover_report(found).warnings == ()


@pytest.mark.second
def test_the_worst_time_is_told_wherever_it_is(course, backend):
    """The frames of the second time are those of a spot that nothing stated could have moved so."""
    frames = tifffile.imread(course.folder / "forward_left_1.tiff")
    tifffile.imwrite(course.folder / "moved.tiff", np.roll(frames, 14, axis=1), photometric="minisblack")
    found = course.measured(backend, course.text(forward_left="moved.tiff"))
    assert found.last.consistency.agrees
    assert found.worst[0] == 1
    told = " ".join(recover_report(found).warnings)
    assert "orbit at 12 min, the worst of 4 times" in told
    assert "for the series" in told
    assert not found.smoothed.consistency.agrees


@pytest.mark.second
def test_a_single_time_and_one_without_statements_are_not_smoothed(course, backend):
    alone = course.measured(backend, course.text(TIMES[:1]))
    assert alone.smoothed is None
    assert "smoothed" not in recover_numbers(alone)
    text = course.text().replace("disturbances: orbit", "disturbances: none")
    (course.folder / "none.yaml").write_text(text)
    plain = run_recover(resolve_measurement(course.folder / "none.yaml"), backend)
    assert plain.smoothed is None
    assert recover_report(plain).sections[0].text == ()
