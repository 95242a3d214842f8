"""Legal instruments and jobs in which no estimate may mislead: right, or warned of, or refused with key and remedy."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from optics.geometry.tree import Motion
from tests.hunt.dense_images import DenseImages
from tests.hunt.hunt import REFUSED, RIGHT, hunt
from tests.hunt.legal_instruments import legal_instrument
from tests.hunt.legal_jobs import legal_job
from tests.hunt.legal_spans import span_hunt
from tests.hunt.stops import stops
from tests.tiers import quick

FEW, MANY = 6, 1000


@pytest.fixture
def found(tmp_path, backend):
    """Function: first instrument, cases and every how many images are worked out once more -> outcomes."""

    def outcomes(first: int, cases: int, dense: int):
        return list(hunt(first, cases, tmp_path, backend, dense))

    return outcomes


def require_honest(outcomes) -> Counter:
    outcomes = list(outcomes)
    assert not [f"{o.case}: {o.kind}: {o.text}" for o in outcomes if o.defect]
    return Counter(o.kind for o in outcomes)


@pytest.mark.parametrize(
    "cases", [pytest.param(FEW, marks=pytest.mark.second), pytest.param(60, marks=pytest.mark.slow)]
)
def test_nobody_is_misled(found, cases) -> None:
    outcomes = found(0, cases, 12 if cases > FEW else 3)
    counts = require_honest(outcomes)
    # a twin that refuses or warns of everything would be honest, too
    assert counts[RIGHT] > 0.4 * cases
    assert sum(o.checked for o in outcomes) > (2 if cases > FEW else 0)


@pytest.mark.slow
def test_nobody_is_misled_in_a_thousand_cases(found, capsys) -> None:
    """Half an hour of one core."""
    outcomes = found(1000, MANY, 6)
    with capsys.disabled():
        print(f"\n{MANY} cases: {dict(Counter(o.kind for o in outcomes))}")  # noqa: T201 - the test's result
    counts = require_honest(outcomes)
    assert counts[RIGHT] > 0.4 * MANY


@pytest.mark.parametrize(
    "cases", [pytest.param(8, marks=pytest.mark.second), pytest.param(300, marks=pytest.mark.slow)]
)
def test_first_order_data_wherever_the_stop_stands(backend, cases) -> None:
    counts = require_honest(stops(0, cases, backend))
    assert counts[RIGHT] > 0.6 * cases


def test_cases_are_the_same_every_time_and_differ(experiment) -> None:
    nodes = experiment("gf7_pair").instrument.nodes
    assert legal_instrument(7) == legal_instrument(7)
    assert legal_job(7, 1, nodes) == legal_job(7, 1, nodes)
    texts = [str(legal_job(7, k, nodes)) for k in range(50)]
    assert len(set(texts)) == 50
    assert len({legal_instrument(k).text for k in range(50)}) > 40


@pytest.mark.parametrize("defocus", quick(1, [3e-3, 0.0]))
def test_the_reference_agrees_where_images_are_known_to_be_right(experiment, defocus: float) -> None:
    path = experiment("gf7_pair").path
    state = {"base/forward/focal_plane": Motion(shift=(1e-4, 5e-5, defocus))} if defocus else {}
    image = path.photons_of(state)[0]
    rows, columns = np.array([48, 50, 40, 20]), np.array([47, 52, 48, 70])
    dense = DenseImages(path, state)
    dense.trace()
    assert np.abs(dense.photons(0, rows, columns) - image[rows, columns]).max() < 3e-6 * image.max()


@pytest.mark.parametrize("cases", [100, pytest.param(2000, marks=pytest.mark.slow)])
def test_no_span_is_decided_by_rounding(cases: int) -> None:
    counts = require_honest(list(span_hunt(0, cases)))
    assert counts[RIGHT] > 0.15 * cases
    assert counts[REFUSED] > 0.15 * cases
