"""One battery that every immutable value passes."""

import copy
import dataclasses
import pickle

import numpy as np
import pytest

from optics.geometry.aperture import Circle, Ellipse, Rectangle
from optics.geometry.pose import Pose, about_axis
from optics.geometry.solid import Coating, Face, Solid
from optics.geometry.surface import Surface, ZernikeFigure
from optics.geometry.tree import Body, Motion
from optics.materials.glass import N_BK7, Glass, ThermalDispersion
from optics.materials.material import Material, TemperatureRange, material
from optics.numerics.frozen_map import FrozenMap
from optics.raytrace.assembly import Element, Interaction
from optics.raytrace.element_numbers import Medium

FIGURE = ZernikeFigure(0.5, (0.1, 0.0), {4: 1e-7, 5: 2e-7})
SURFACE = Surface(-0.15, -1.5, (1e-5, 2e-6), FIGURE)
FACE = Face("window", "a", Coating.TRANSMITTING, Pose(about_axis(0, 0.3), np.array([1.0, 2.0, 3.0])))
# each with another value of its class
VALUES = [
    (Pose(about_axis(0, 0.3), np.array([1.0, 2.0, 3.0])), Pose()),
    (Body("a/b", Pose(), {"tip": (1.0, 2.0, 3.0)}), Body("a/b", Pose(), {"tip": (1.0, 2.0, 3.5)})),
    (Motion((1e-6, 0.0, 0.0), (0.0, 1e-6, 0.0), "tip", 1e-6, {4: 1e-9}), Motion(figure={4: 1e-9})),
    (
        Motion(stretch=1e-6, index=1e-5, index_gradient=(1e-6, 0.0, 2e-6)),
        Motion(stretch=1e-6, index=1e-5, index_gradient=(1e-6, 0.0, 3e-6)),
    ),
    (Circle(1.0, (0.1, 0.2), 0.3), Circle(1.0)),
    (Ellipse(1.0, 2.0, (0.1, 0.2)), Ellipse(1.0, 2.0)),
    (Rectangle(1.0, 2.0, (0.1, 0.2)), Rectangle(1.0, 2.0)),
    (FIGURE, ZernikeFigure(0.5)),
    (SURFACE, SURFACE.with_figure(None)),
    (Element("e", "a/b", SURFACE, Interaction.REFLECT, Circle(1.0)), Element("e", "a/b", SURFACE, Interaction.PASS)),
    (Element("e", "a", SURFACE, Interaction.TOTAL, solid="a"), Element("e", "a", SURFACE, Interaction.TOTAL)),
    (FACE, Face("window", "a", Coating.TRANSMITTING, Pose())),
    (Solid("a", "N-BK7", (FACE,)), Solid("a", "N-BK7", (FACE,), transparent=False)),
    (Medium("a"), Medium(None, 1.5)),
    (N_BK7, dataclasses.replace(N_BK7, thermal=None)),
    (ThermalDispersion(1.0, 2.0, 3.0, 4.0, 5.0, 6.0), ThermalDispersion(1.0, 2.0, 3.0, 4.0, 5.0, 6.5)),
    (material("Invar"), material("SiC")),
    (FrozenMap({1: 2.0}), FrozenMap({1: 3.0})),
]
NAMESPACE = {
    c.__name__: c
    for c in (
        Pose,
        Body,
        Motion,
        Circle,
        Ellipse,
        Rectangle,
        Medium,
        ZernikeFigure,
        Surface,
        Element,
        Glass,
        Material,
        FrozenMap,
    )
} | {"array": np.array, "ThermalDispersion": ThermalDispersion, "TemperatureRange": TemperatureRange}


@pytest.mark.parametrize(("value", "other"), VALUES, ids=[type(v).__name__ for v, _ in VALUES])
class TestValue:
    def test_equality(self, value, other) -> None:
        assert value == copy.deepcopy(value)
        assert value != other
        assert value != "something else"

    def test_hash(self, value, other) -> None:
        assert hash(value) == hash(copy.deepcopy(value))
        assert len({value, copy.deepcopy(value), other}) == 2

    def test_repr_says_what_it_is(self, value, other) -> None:
        assert repr(value).startswith(type(value).__name__)
        assert repr(value) != repr(other)
        if not any(enum in repr(value) for enum in ("Interaction", "Coating")):
            with np.printoptions(floatmode="unique", precision=17):
                assert eval(repr(value), dict(NAMESPACE)) == value

    def test_pickle(self, value, other) -> None:
        for protocol in range(2, pickle.HIGHEST_PROTOCOL + 1):
            assert pickle.loads(pickle.dumps(value, protocol)) == value

    def test_immutability(self, value, other) -> None:
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


def test_it_does_not_follow_its_argument() -> None:
    terms = {4: 1e-9}
    motion, figure = Motion(figure=terms), ZernikeFigure(1.0, terms=terms)
    terms[4] = 5.0
    assert motion.figure[4] == figure.terms[4] == 1e-9
