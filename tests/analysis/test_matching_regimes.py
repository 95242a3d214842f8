"""Do places keep in their covariances where structure runs along one direction, is fixed to the pixels, or moves?

Half of chi-square a point by simulation; a point may be refused instead. Truth is how the pairs were drawn.
"""

import numpy as np
import pytest

from analysis.matching.matches import Reason
from tests.analysis.matching_regimes import REGIMES, RegimePair, pair_of
from tests.analysis.stereo_pairs import layered
from tests.tiers import quick

MOST = 1.5
"""Mean half of chi-square of the accepted points; 1 where covariances are those of the errors."""


def squares(pair: RegimePair) -> np.ndarray:
    """Return halves of chi-square of the accepted points."""
    found = pair.matched()
    error, used = pair.error(found.place, found.covariance), found.accepted
    return 0.5 * np.einsum("ni,nij,nj->n", error[used], np.linalg.inv(found.covariance[used]), error[used])


@pytest.mark.parametrize(
    ("name", "share"),
    quick(1, [("PRNU of 1%, noise 4", 0.8), ("checks of 12 px, noise 4", 0.4), ("stripes, texture 10", 0.0)]),
)
def test_places_of_misleading_structure_hold_or_are_refused(name: str, share: float) -> None:
    """36 points: the mean's limit is 1.5 and three standard deviations of it, 1 / sqrt(n). Without coarse detail as a
    witness the first two are at 27 and 7; without the lock stripes put a third beyond 0.5 px, at 40.
    """
    half = squares(pair_of(REGIMES[name], 1, 240))
    assert len(half) >= share * 36
    assert not len(half) or half.mean() < MOST + 3.0 / np.sqrt(len(half))


@pytest.mark.second
def test_the_blocks_of_a_compression_are_recognised() -> None:
    """JPEG of quality 30 keeps little of a weak texture: all places would lock to whole pixels. Of a strong one it
    keeps enough.
    """
    found = pair_of(REGIMES["JPEG 30 of little texture"], 1, 240).matched()
    assert not found.accepted.any()
    assert (found.reason == Reason.BLOCKS).mean() > 0.9
    assert "blocks" in found.text
    assert not (pair_of(REGIMES["JPEG 30"], 1, 240).matched().reason == Reason.BLOCKS).any()


def depth(step: float, seed: int) -> RegimePair:
    """Return two layers with edges of depth of so many pixels."""
    pair = layered(7, step=step, seed=20 + seed)[0]
    return RegimePair(pair.first, pair.second, pair.places, pair.true, np.zeros((0, len(pair.places), 2)))


EXCEEDED = ("stripes, texture 10", "edges, texture 5", "clouds by 2 px", "clouds by 4 px")
"""Regimes that do not hold: docs/orbit.md names them with their figures."""
DEPTHS = {f"depth of {step} px": step for step in (0.5, 1.5, 3.0)}


@pytest.mark.slow
def test_regimes_in_figures() -> None:
    """Three pairs of each regime, and edges of depth of 0.5 to 3 px; printed, judged where 20 points are accepted."""
    wrong = []
    for name in (*REGIMES, *DEPTHS):
        pairs = [
            pair_of(REGIMES[name], seed) if name in REGIMES else depth(DEPTHS[name], seed) for seed in (11, 12, 13)
        ]
        half = np.concatenate([squares(pair) for pair in pairs])
        share = len(half) / sum(len(pair.places) for pair in pairs)
        text = f"{name}: {share:.0%} accepted" + (
            f", chi2/2 {half.mean():.2f}, the largest {half.max():.0f}" if len(half) else ""
        )
        print(text, flush=True)  # noqa: T201
        if len(half) >= 20 and half.mean() > MOST and name not in EXCEEDED:
            wrong.append(text)
    assert not wrong, "\n".join(wrong)
