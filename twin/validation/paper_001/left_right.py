"""Paper 001's section 2 in the displacements of the left and the right spot, equation by equation, as printed.

A displacement is before - after, in any unit of length; X is across the line, Y along it, L at its +Y end.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np

Value = TypeVar("Value", float, np.ndarray)


def roll_displacement(x_left: Value, x_right: Value) -> Value:
    """Eq. (4): how far a roll of the camera moves a spot across the line."""
    return (x_left - x_right) / 2.0


def scale_displacement(y_left: Value, y_right: Value) -> Value:
    """Eq. (6): how far a change of the focal length moves a spot along the line; (y11 - y01) is minus the left Y."""
    return (y_right - y_left) / 2.0


def superposed(first: Value, second: Value) -> Value:
    """Eq. (8), of one side: the displacement by two changes at once from those by each of them."""
    return first + second


def right_of_focal_length(left: Value) -> Value:
    """Eq. (9): Y of the right spot from that of the left one when the focal length changes."""
    return -left


def right_of_rotation(left: Value) -> Value:
    """Eq. (9): the same when the line of sight turns about X."""
    return left


def parts_along(left: Value, right: Value) -> tuple[Value, Value]:
    """Eq. (10): the shares of the focal length and of the turn about X in Y."""
    return (left - right) / 2.0, (left + right) / 2.0


def parts_across(left: Value, right: Value) -> tuple[Value, Value]:
    """Eq. (11): the shares of the turn about Y and of the roll in X."""
    return (left + right) / 2.0, (left - right) / 2.0
