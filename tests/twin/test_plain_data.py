"""Numbers of a run as JSON holds them, from dataclasses whose fields are the keys."""

import json
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pytest

from optics.numerics.number_tree import FrozenMap
from twin.framework.record import plain_data


@dataclass(frozen=True)
class Place:
    x_um: float
    y_um: float


@dataclass(frozen=True)
class Shift(Place):
    sigma_um: np.ndarray
    of: Mapping[str, Place]
    rounds: tuple[Place, ...] = ()
    why: str | None = None


PLACES = FrozenMap({"b": Place(1.0, 2.0), "a": Place(3.0, 4.0)})
SHIFT = Shift(1.5, -0.0, np.array([[0.1, 0.2]]), PLACES, (Place(5, 6),))


def test_fields_are_keys_in_their_order_those_of_a_base_first() -> None:
    assert json.dumps(plain_data(SHIFT)) == (
        '{"x_um": 1.5, "y_um": -0.0, "sigma_um": [[0.1, 0.2]], '
        '"of": {"b": {"x_um": 1.0, "y_um": 2.0}, "a": {"x_um": 3.0, "y_um": 4.0}}, '
        '"rounds": [{"x_um": 5, "y_um": 6}], "why": null}'
    )


@pytest.mark.parametrize(
    ("value", "plain"),
    [
        (np.float64(0.1), 0.1),
        (np.float32(0.1), 0.10000000149011612),
        (np.int64(3), 3),
        (np.bool_(True), True),
        (True, True),
        (np.array(2.5), 2.5),
        (np.array([True, False]), [True, False]),
        ((), []),
        ({}, {}),
    ],
)
def test_numbers_keep_their_kind_and_all_digits(value, plain) -> None:
    found = plain_data(value)
    assert found == plain
    assert type(found) is type(plain)


def test_plain_data_stay_as_they_are() -> None:
    once = plain_data(SHIFT)
    assert plain_data(once) == once


@pytest.mark.parametrize("value", [1j, {1: "one"}, {"a", "b"}, object(), Place, np.array([1j]), [b"bytes"]])
def test_what_json_cannot_hold_is_refused(value) -> None:
    with pytest.raises(TypeError):
        plain_data(value)
