"""Many frames lie in a file: no bit of them, or of what is made of them, depends on it."""

from __future__ import annotations

import itertools
import time
from typing import Any

import numpy as np
import pytest

from analysis.spots.centroid import mean_frames
from twin.run import frame_store
from twin.run.data_files import FrameFacts, preview_png, tiff
from twin.run.frame_store import frame_room, in_file, kept_bytes, largest_of, let_go, mean_of
from twin.sensors import area_detector, exposure_kernel
from twin.sensors.area_detector import EmvaDetector
from twin.sensors.exposure_kernel import FEWEST

DETECTOR = EmvaDetector(
    quantum_efficiency=0.6,
    full_well_e=30_000.0,
    system_gain_dn_per_e=0.1,
    dark_noise_e=5.0,
    dark_current_e_per_s=20.0,
    prnu=0.01,
    dsnu_e=3.0,
    offset_dn=50.0,
    bit_depth=12,
)


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hardly anything is kept in memory."""
    monkeypatch.setattr(frame_store, "IN_MEMORY", 1000)
    monkeypatch.setattr(frame_store, "PART", 20_000)


def exposed(frames: int, threads: int | None = None, images: int = 3) -> np.ndarray:
    light = np.random.default_rng(2).uniform(0.0, 4000.0, (images, 24, 32))
    pattern = DETECTOR.fixed_pattern((images, 24, 32), 5)
    return DETECTOR.expose(light, pattern, frames, 0.1, 7, threads)


def test_frames_in_a_file_are_those_in_memory(small: None, monkeypatch: pytest.MonkeyPatch) -> None:
    frames = 2 * FEWEST // (3 * 24 * 32)
    stored = exposed(frames)
    monkeypatch.setattr(frame_store, "IN_MEMORY", 1 << 28)
    kept = exposed(frames)
    assert in_file(stored)
    assert in_file(stored[1, 3])
    assert not in_file(kept)
    let_go(stored)
    let_go(kept)
    np.testing.assert_array_equal(stored, kept)
    np.testing.assert_array_equal(mean_of(stored), mean_frames(kept))
    np.testing.assert_array_equal(mean_of(stored), kept.mean(axis=-3))  # as pictures have it: all sums are exact
    np.testing.assert_array_equal(largest_of(stored), kept.max(axis=-3))
    np.testing.assert_array_equal(DETECTOR.saturated(stored).pixels, DETECTOR.saturated(kept).pixels)
    facts = FrameFacts("a camera", 5e-6, 1e-3)
    assert bytes(tiff(stored[1], facts)) == tiff(kept[1], facts)
    assert preview_png(stored[2]) == preview_png(kept[2])


def test_threads_do_not_change_the_frames_of_one_image(monkeypatch: pytest.MonkeyPatch) -> None:
    """Several pieces of one image: a thread must not draw the next one while another draws the last."""
    monkeypatch.setattr(area_detector, "_FRAMES_PIXELS", 32 * 24 * 32)
    frames = 8 * FEWEST // (24 * 32)
    first = exposed(frames, threads=1, images=1)
    drawn, calls = exposure_kernel.words_of, itertools.count()

    def slow(*arguments: Any) -> np.ndarray:
        if next(calls) == 0:
            time.sleep(0.2)
        return drawn(*arguments)

    monkeypatch.setattr(exposure_kernel, "words_of", slow)
    np.testing.assert_array_equal(exposed(frames, threads=4, images=1), first)


def test_a_full_disk_is_said_before(small: None, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(file: int, start: int, size: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(frame_store.os, "posix_fallocate", full)
    with pytest.raises(OSError, match="GB of frames do not fit on the disk"):
        frame_room((2, 100, 30, 30))


def test_what_lies_in_a_file_takes_no_memory() -> None:
    assert kept_bytes(1e6) == 1e6
    assert kept_bytes(1e12) == kept_bytes(5e9) < 0.2e9
