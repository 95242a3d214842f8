"""What the recovery from measured frames takes of memory and time, from their files' headers."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from analysis.images.image_file import ImageFile
from analysis.images.image_header import ImageError
from twin.monitor.monitor_memory import GREY, MonitorSize
from twin.run.cost import Cost, Lowered
from twin.run.frame_store import IN_MEMORY, PART
from twin.sensors.area_detector import EmvaDetector

if TYPE_CHECKING:
    from scenes.specs.measured.monitor_frames import MeasurementSetup

STARTED, STARTED_SECONDS = 290e6, 5.6
"""Of a recovery from few frames of small CCDs: kernels, and what draws its report; bytes and seconds."""
PIXEL, PIXEL_SECONDS = 77.0, 4e-6
"""Bytes and seconds per pixel of a state's mean image: maps of the search, of the fits and of their covariance."""
SEARCHED_SECONDS, READ_SECONDS = 3.2e-7, 1e-7
"""Seconds per pixel of a frame that is searched for defects, and of one whose noise alone is looked at."""


def recover_cost(setup: MeasurementSetup) -> Cost:
    """What `run_recover` and its report take.

    Args:
        setup: the measurement; headers of one file of each channel and state are read. One that cannot be read is told
            later.
    """
    test, pixels, frames, kept, passed = setup.test, 0.0, 0.0, 0.0, 0.0
    states = 1 + (1 if test.times is None else len(test.times))
    assert not isinstance(test.frames, str)
    for files in test.frames.values():
        for these, count in ((files.before, 1), (test.states(files)[0], states - 1)):
            image, pages = _size(these)
            pixels += count * image
            frames += count * image * pages
            size = image * pages * GREY
            kept += count * size if size <= IN_MEMORY else 0.0
            passed = max(passed, min(size, PART))
    started = STARTED + passed
    if setup.model is not None:
        ccd = setup.model.instrument.autocollimator.area_ccd
        monitor = MonitorSize.stated(setup.model, setup.model.frames)
        started += monitor.parts(EmvaDetector.from_sheet(setup.detector, ccd.exposure))["ccd"]
    each = (pixels * PIXEL + kept) / states

    def needed(count: int) -> float:
        return started + count * each

    each_frame = SEARCHED_SECONDS if test.corrections == "automatic" else READ_SECONDS
    seconds = STARTED_SECONDS + pixels * PIXEL_SECONDS + frames * each_frame
    lower = None
    if test.times is not None:
        lower = Lowered(test, ("times",), states - 1, "times", lambda count: needed(count + 1))
    return Cost(needed(states), seconds, lower)


def _size(files: tuple[str, ...]) -> tuple[int, int]:
    """Pixels of a frame, and how many frames there are, if all files are as the first."""
    try:
        head = ImageFile.open(Path(files[0]), choose="").header
    except (ImageError, OSError):
        return 0, 0
    return head.rows * head.columns, len(head.pages) * len(files)
