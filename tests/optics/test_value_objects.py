"""Immutable values are equal, hashed, printed and pickled by what they hold, and cannot be changed."""

import copy
import dataclasses
import pickle
from dataclasses import dataclass

import numpy as np
import pytest

from optics.geometry.aperture import Circle
from optics.geometry.pose import Pose, about_axis
from optics.geometry.surface import Surface, ZernikeFigure
from optics.geometry.tree import Body, Motion
from optics.geometry.vector_shape import Disk, HalfPlane, Polygon
from optics.materials.glass import N_BK7, Glass, ThermalDispersion
from optics.materials.material import TemperatureRange
from optics.numerics.number_tree import FrozenMap, leaves, map_leaves, with_leaf
from optics.raytrace.assembly import Element, Interaction

FIGURE = ZernikeFigure(0.5, (0.1, 0.0), {4: 1e-7, 5: 2e-7})
SURFACE = Surface(-0.15, -1.5, (1e-5, 2e-6), FIGURE)
# each with another value of its class
VALUES = [
    (Pose(about_axis(0, 0.3), np.array([1.0, 2.0, 3.0])), Pose()),
    (Body("a/b", Pose(), {"tip": (1.0, 2.0, 3.0)}), Body("a/b", Pose(), {"tip": (1.0, 2.0, 3.5)})),
    (Motion((1e-6, 0.0, 0.0), (0.0, 1e-6, 0.0), "tip", 1e-6, {4: 1e-9}), Motion(figure={4: 1e-9})),
    (FIGURE, ZernikeFigure(0.5)),
    (SURFACE, SURFACE.with_figure(None)),
    (Element("e", "a/b", SURFACE, Interaction.REFLECT, Circle(1.0)), Element("e", "a/b", SURFACE, Interaction.PASS)),
    (N_BK7, dataclasses.replace(N_BK7, thermal=None)),
    (FrozenMap({1: 2.0}), FrozenMap({1: 3.0})),
]
CLASSES = (Pose, Body, Motion, ZernikeFigure, Surface, Glass, ThermalDispersion, TemperatureRange, FrozenMap)
NAMESPACE = {c.__name__: c for c in CLASSES} | {"array": np.array}


@pytest.mark.parametrize(("value", "other"), VALUES, ids=[type(v).__name__ for v, _ in VALUES])
def test_values(value, other) -> None:
    assert value == copy.deepcopy(value)
    assert value != other
    assert value != "something else"
    assert len({value, copy.deepcopy(value), other}) == 2
    assert pickle.loads(pickle.dumps(value)) == value
    assert repr(value) != repr(other)
    if not isinstance(value, Element):
        with np.printoptions(floatmode="unique", precision=17):
            assert eval(repr(value), dict(NAMESPACE)) == value
    if isinstance(value, FrozenMap):
        with pytest.raises(TypeError, match="cannot be changed"):
            value[1] = 5.0
        return
    for field in dataclasses.fields(value):
        with pytest.raises(dataclasses.FrozenInstanceError):
            setattr(value, field.name, None)
        inner = getattr(value, field.name)
        assert not isinstance(inner, list | set)
        if isinstance(inner, dict):
            with pytest.raises(TypeError, match="cannot be changed"):
                inner.clear()
        if isinstance(inner, np.ndarray):
            with pytest.raises(ValueError, match="read-only"):
                inner[...] = 0.0


def test_shapes_are_pickled_and_cannot_be_changed() -> None:
    corners = np.array([[3.0, 1.0], [9.0, 0.0], [7.0, 4.0]])
    for shape in (Polygon(corners), Disk((1e-5, 0.0), 2e-5), HalfPlane((0.0, 1.0), (1.0, 2.0))):
        again = pickle.loads(pickle.dumps(shape))
        for name, value in vars(shape).items():
            np.testing.assert_array_equal(getattr(again, name), value)
            if isinstance(value, np.ndarray):
                with pytest.raises(ValueError, match="read-only"):
                    value[...] = 0.0


def test_a_value_does_not_follow_its_argument() -> None:
    terms = {4: 1e-9}
    motion, figure = Motion(figure=terms), ZernikeFigure(1.0, terms=terms)
    terms[4] = 5.0
    assert motion.figure[4] == figure.terms[4] == 1e-9


@dataclass(frozen=True)
class Inner:
    slope: float | None
    terms: tuple[float | None, ...] = ()


@dataclass(frozen=True)
class Outer:
    size: float
    inner: Inner | None = None


TREE = Outer(1.0, Inner(2.0, (3.0, 4.0)))


def test_numbers_of_a_tree_by_their_paths() -> None:
    terms = {("inner", "terms", 0): 3.0, ("inner", "terms", 1): 4.0}
    assert leaves(TREE) == {("size",): 1.0, ("inner", "slope"): 2.0} | terms
    assert leaves(Outer(1.0)) == {("size",): 1.0}
    assert map_leaves(lambda x: 2.0 * x, TREE) == Outer(2.0, Inner(4.0, (6.0, 8.0)))
    assert map_leaves(lambda x: 2.0 * x, Outer(1.0)) == Outer(2.0)
    steps = Outer(10.0, Inner(None, (20.0, None)))
    assert map_leaves(lambda x, step: x if step is None else step, TREE, steps) == Outer(10.0, Inner(2.0, (20.0, 4.0)))
    assert map_leaves(lambda x, step: step, TREE, None) == Outer(None, Inner(None, (None, None)))
    assert with_leaf(TREE, ("inner", "terms", 1), 5.0) == Outer(1.0, Inner(2.0, (3.0, 5.0)))
    for wrong in (("inner", "terms", 2), ("inner",), ("c",)):
        with pytest.raises(KeyError, match="no number"):
            with_leaf(TREE, wrong, 0.0)
