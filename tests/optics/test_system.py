"""Numbers of systems: written over those as designed, they are what each element is worked out to by itself.

Immutable values are equal, hashed, printed and pickled by what they hold, and cannot be changed.
"""

import copy
import dataclasses
import pickle
from dataclasses import dataclass, fields, replace

import numpy as np
import pytest

from optics.geometry.aperture import Circle, Ellipse, Rectangle
from optics.geometry.pose import Pose, about_axis
from optics.geometry.sag_terms import XYPolynomial, ZernikeSag
from optics.geometry.surface import GridFigure, SummedFigure, Surface, ZernikeFigure, plane
from optics.geometry.tree import Body, Motion, RigidTree, State
from optics.geometry.vector_shape import Disk, HalfPlane, Polygon
from optics.materials.glass import GLASSES, Glass, ThermalDispersion
from optics.materials.material import TemperatureRange
from optics.numerics.number_tree import FrozenMap, leaves, map_leaves, with_leaf
from optics.raytrace.assembly import Assembly, Element, Interaction
from optics.raytrace.system import SystemBatch, assemble
from tests.tiers import quick

ROUNDINGS = 8 * np.finfo(float).eps
"""Powers of a size of 1 by products, and sums of a figure's terms in another order."""
SIZES = {"rotate": 1e-5, "shift": 1e-6, "figure": 1e-8, "index": 1e-5, "index_gradient": 1e-6, "abbe": 1e-2}
NAMES = [field.name for field in fields(Motion)]


def motion(names: list[str], rng: np.random.Generator, pivot: str) -> Motion:
    """A motion with these numbers and no others."""
    out = {}
    for name in names:
        size = SIZES.get(name, 1e-4)
        match name:
            case "pivot":
                out[name] = pivot
            case "figure":
                out[name] = dict(zip([4, 7, 11], (size * rng.standard_normal(3)).tolist(), strict=True))
            case "grid":
                out[name] = GridFigure(1e-8 * rng.standard_normal((5, 6)), (-0.2, 0.2, -0.3, 0.3))
            case "rotate" | "shift" | "index_gradient":
                out[name] = tuple((size * rng.standard_normal(3)).tolist())
            case _:
                out[name] = float(size * rng.standard_normal())
    return Motion(**out)


def some_states(assembly: Assembly, names: list[str], seed: int) -> list[State]:
    """The design, and three states in which two of three bodies have such a motion; figures and grids on optics."""
    rng = np.random.default_rng(seed)
    optics = {element.body for element in assembly.elements.values() if element.aperture is not None}
    states: list[State] = [{}]
    for _ in range(3):
        state = {}
        for body in assembly.tree.bodies:
            own = [name for name in names if name not in ("figure", "grid") or body.path in optics]
            if rng.random() < 0.67:
                state[body.path] = motion(own, rng, rng.choice(list(body.pivots)))
        states.append(state)
    return states


def one_by_one(assembly: Assembly, sequences: list[str], states: list[State]) -> SystemBatch:
    """Complex poses: each element is worked out by itself."""
    placed = assembly.place(states)
    poses = {name: getattr(placed, name).astype(complex) for name in ("rotation", "translation")}
    return assemble(assembly, sequences, states, placed=replace(placed, **poses))


@pytest.mark.parametrize("names", quick(3, [NAMES, *([name] for name in NAMES)]), ids=["all", *NAMES])
def test_states_are_written_over_the_design(instrument, names: list[str]) -> None:
    assembly = instrument("gf7_pair").assembly
    states = some_states(assembly, names, 3)
    channels = [name for name in assembly.sequences if name.endswith("/monitor")]
    for sequences in (channels, ["forward/image_to_object", "backward/image_to_object"]):
        found, exact = assemble(assembly, sequences, states), one_by_one(assembly, sequences, states)
        assert found.structure == exact.structure
        glass = any(element.solid for element in assembly.sequence(sequences[0]))
        assert any(any(one.graded) for one in found.structure) == (glass and "index_gradient" in names)
        assert any(one.grid for one in found.structure) == ("grid" in names)
        assert max(one.figure_order for one in found.structure) == (4 if "figure" in names else -1)
        assert found.count == len(sequences) * len(states)
        np.testing.assert_array_equal(found.size, exact.size)
        for grid, other in zip(found.grids, exact.grids, strict=True):
            assert (grid is None) == (other is None)
            assert grid is None or np.array_equal(grid, other)
        rows, others = leaves(found.form), leaves(exact.form)
        assert rows == others
        changed = np.any(found.numbers.reshape(len(rows), len(sequences), -1)[:, :, 1:] != found.numbers[:, :1, None])
        assert changed or names == ["pivot"]
        for path, row in rows.items():
            size = np.max(np.abs(exact.numbers[row]))
            # a coefficient is a sum of terms that may cancel: figures are of 1e-8 m over apertures of 0.1 to 1 m
            size += 1e-6 if "figure" in path else 0.0
            worst = np.max(np.abs(found.numbers[row] - exact.numbers[row]))
            assert worst <= ROUNDINGS * size, (path, worst / size)


def shapes() -> Assembly:
    """A mirror and two lenses of all kinds of terms, figures and apertures."""
    grid = GridFigure(1e-8 * np.random.default_rng(1).standard_normal((5, 6)), (-0.2, 0.2, -0.3, 0.3))
    terms = (XYPolynomial(x2=0.1, x2y=-0.3), ZernikeSag(radius=0.4, x0=0.01, Z7=1e-5, Z5=2e-6))
    mirror = Surface(-0.3, -0.9, (1e-3, 2e-4, -3e-5), SummedFigure(ZernikeFigure(0.3, (0.0, 0.1), {6: 2e-8}), grid))
    face = Surface(0.5, 0.0, (1e-2,), None, terms)
    parts = [
        ("mirror", mirror, Interaction.REFLECT, Circle(0.3, (0.0, 0.1), 0.05), None),
        ("lens/a", face, Interaction.REFRACT, Rectangle(0.2, 0.3, (0.01, 0.02)), "lens"),
        ("lens/b", Surface(-0.4), Interaction.REFRACT, Ellipse(0.2, 0.3), "lens"),
        ("wedge/a", plane(), Interaction.REFRACT, None, "wedge"),
        (
            "wedge/b",
            Surface(0.1, figure=ZernikeFigure(0.2, terms={4: 1e-8})),
            Interaction.REFRACT,
            Circle(0.2),
            "wedge",
        ),
    ]
    paths = ["mirror", "lens", "lens/a", "lens/b", "wedge", "wedge/a", "wedge/b"]
    places = {path: Pose(translation=np.array([0.0, 0.01 * k, 0.1 * k])) for k, path in enumerate(paths)}
    elements = {body: Element(body, body, s, how, edge, solid=solid) for body, s, how, edge, solid in parts}
    tree = RigidTree(tuple(Body(path, places[path]) for path in paths))
    return Assembly(tree, elements, {"all": tuple(elements)}, {"lens": 1.5, "wedge": 1.7}, {"lens": 0.01})


def test_every_kind_of_number_goes_with_a_power_of_its_bodys_size() -> None:
    assembly = shapes()
    states = some_states(assembly, ["scale", "expansion", "index", "abbe", "figure", "radius", "conic"], 5)
    found, exact = assemble(assembly, ["all"], states), one_by_one(assembly, ["all"], states)
    kinds = {path[2:] for path in leaves(found.form[0])}
    assert {("surface", "even", 2), ("surface", "terms", 0, "x2y"), ("surface", "grid", "first")} <= {
        path[1:] for path in leaves(found.form[0])
    }
    assert len(kinds) > 30
    size = np.max(np.abs(exact.numbers), axis=1, keepdims=True)
    size = np.where(size > 0.0, size, 1.0)
    assert np.max(np.abs(found.numbers - exact.numbers) / size) <= ROUNDINGS


def test_systems_of_a_batch_do_not_depend_on_each_other(instrument) -> None:
    assembly = instrument("gf7_pair").assembly
    states = some_states(assembly, ["rotate", "shift", "scale", "index"], 7)
    channels = [name for name in assembly.sequences if name.endswith("/monitor")]
    every = assemble(assembly, channels, states)
    for c, channel in enumerate(channels):
        for s, state in enumerate(states):
            alone = assemble(assembly, [channel], [state])
            np.testing.assert_array_equal(alone.numbers[:, 0], every.numbers[:, c * len(states) + s])
    np.testing.assert_array_equal(every.take(np.array([3, 1])).numbers, every.numbers[:, [3, 1]])


# --- value objects ----------------------------------------------------------------------------------------------------

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
    (GLASSES["N-BK7"], dataclasses.replace(GLASSES["N-BK7"], thermal=None)),
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
