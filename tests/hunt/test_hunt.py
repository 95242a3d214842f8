"""Legal instruments and jobs in which no estimate may mislead: right, or warned of, or refused with key and remedy.

Kept cases and new ones of the day; many more by ``python -m tests.hunt``.
"""

from __future__ import annotations

import numpy as np
import pytest

from optics.geometry.tree import Motion
from tests.daily import first_of_today, require_good
from tests.hunt.dense_images import DenseImages
from tests.hunt.hunt import REFUSED, RIGHT, hunt
from tests.hunt.legal_spans import span_hunt
from tests.hunt.legal_telescopes import telescopes
from tests.hunt.stops import stops

FAILED: dict[str, list[int]] = {"jobs": [], "stops": [], "spans": [], "telescopes": []}
"""Numbers of cases that misled once."""


@pytest.mark.second
def test_nobody_is_misled(tmp_path, backend) -> None:
    kept = list(hunt(0, 6, tmp_path / "kept", backend, 3))
    # a twin that refuses or warns of everything would be honest, too
    assert require_good(kept)[RIGHT] > 2
    assert any(one.checked for one in kept)
    for first in (*FAILED["jobs"], first_of_today()):
        require_good(hunt(first, 8, tmp_path / "new", backend, 12))


@pytest.mark.second
def test_first_order_data_wherever_the_stop_stands(backend) -> None:
    assert require_good(stops(0, 6, backend))[RIGHT] > 3
    for first in (*FAILED["stops"], first_of_today()):
        require_good(stops(first, 6, backend))


@pytest.mark.parametrize("cases", [100, pytest.param(300, marks=pytest.mark.second)])
def test_no_span_is_decided_by_rounding(cases: int) -> None:
    for first in (0, *FAILED["spans"]) if cases == 100 else (first_of_today(),):
        counts = require_good(span_hunt(first, cases))
        assert counts[RIGHT] > 0.15 * cases
        assert counts[REFUSED] > 0.15 * cases


@pytest.mark.parametrize("cases", [2, pytest.param(6, marks=pytest.mark.second)])
def test_shadows_and_figures_of_telescopes_are_those_by_hand(tmp_path, backend, cases: int) -> None:
    """With stop planes, dummies, folds, holes and stated edges."""
    for first in (8, *FAILED["telescopes"]) if cases == 2 else (first_of_today(),):
        assert require_good(telescopes(first, cases, tmp_path, backend)) == {RIGHT: cases}


@pytest.mark.second
def test_the_reference_agrees_where_images_are_known_to_be_right(experiment) -> None:
    path = experiment("gf7_pair").path
    state = {"base/forward/focal_plane": Motion(shift=(1e-4, 5e-5, 3e-3))}
    image = path.photons_of(state)[0]
    rows, columns = np.array([48, 50, 40, 20]), np.array([47, 52, 48, 70])
    dense = DenseImages(path, state)
    dense.trace()
    assert np.abs(dense.photons(0, rows, columns) - image[rows, columns]).max() < 3e-6 * image.max()
