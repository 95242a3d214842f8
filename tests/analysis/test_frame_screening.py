"""Frames are searched a few at a time: neither what is found nor the memory depends on how many there are."""

from dataclasses import astuple

import numpy as np
import pytest

from analysis.spots import frame_screening
from analysis.spots.frame_screening import noise_ratio, observed_noise, screen_frames
from analysis.spots.noise import NoiseModel
from tests.tiers import quick

NOISE = NoiseModel(0.5, 4.0, 0.1, 50.0, 0.005, 1.0, 4095.0)
SHAPE = 40, 44


def recorded(count: int, *, real: bool = False, moving: float = 0.0) -> np.ndarray:
    """Frames of a spot with shot and read noise and some cosmic rays; real ones also have pixels without a value."""
    rng = np.random.default_rng(3)
    row, column = np.mgrid[: SHAPE[0], : SHAPE[1]]
    out = np.empty((count, *SHAPE))
    for k, frame in enumerate(out):
        electrons = rng.poisson(20.0 + 3000.0 * np.exp(-((row - 20.1) ** 2 + (column - 21.3 - moving * k) ** 2) / 8.0))
        frame[:] = np.rint(50.0 + 0.5 * (electrons + 4.0 * rng.standard_normal(SHAPE)))
        frame[rng.integers(SHAPE[0]), rng.integers(SHAPE[1])] += 900.0
    if not real:
        return out.clip(0.0, 4095.0).astype(np.uint16)
    out[rng.uniform(size=out.shape) < 0.01] = np.nan
    return out


@pytest.mark.parametrize("real", [False, True])
@pytest.mark.parametrize(("count", "moving"), quick(1, [(9, 0.0), (2, 0.0), (30, 0.02)]))
def test_pieces_change_nothing(count: int, moving: float, real: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    frames, bad = recorded(count, real=real, moving=moving), np.zeros(SHAPE, bool)
    bad[3, 5] = True
    noisy = np.rint(frames + 20.0 * np.random.default_rng(5).standard_normal(frames.shape))
    told: list[int] = []

    def found() -> tuple:
        screened = screen_frames(frames, NOISE, bad, lambda some: told.append(len(some)))
        ratio = noise_ratio(noisy, NOISE, bad)
        assert ratio is not None
        return *astuple(screened), ratio, observed_noise(noisy, NOISE, ratio, bad).dark_noise_e

    whole, passes = found(), len(told)
    assert any(finding.kind == "cosmic rays" for finding in screen_frames(frames, NOISE, bad).findings)
    monkeypatch.setattr(frame_screening, "_BATCH_BYTES", 3 * frames[0].nbytes)
    for one, other in zip(found(), whole, strict=True):
        np.testing.assert_array_equal(one, other)
    assert len(told) > 2 * passes
