"""A prescription as an optimiser sees it: mirrors of revolution that stand in one plane of symmetry, and what may vary.

z runs along the parent axis, light enters toward +z, y lies in the plane of symmetry. A surface stands at (0, y, z),
turned by ``tilt`` about its own x axis.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from optics.geometry.pose import Pose, about_axis
from optics.geometry.surface import Surface
from optics.geometry.tree import Body, RigidTree
from optics.numerics.number_tree import FrozenMap, Path, leaves, map_leaves, with_leaf
from optics.raytrace.assembly import Assembly, Element, Interaction
from optics.raytrace.system import SystemBatch, assemble

SHAPE = ("curvature", "conic", "A4", "A6", "A8")
STAND = ("z", "y", "tilt")
BIAS = "field_bias"
_STEPS = {"z": ("", "shift", 2), "y": ("", "shift", 1), "tilt": ("/face", "rotate", 0)}
_NUMBERS: Mapping[str, Path] = FrozenMap(
    {
        "curvature": ("surface", "curvature"),
        "conic": ("surface", "conic"),
        "A4": ("surface", "even", 0),
        "A6": ("surface", "even", 1),
        "A8": ("surface", "even", 2),
    }
)


@dataclass(frozen=True)
class Variable:
    """A number that may vary.

    Attributes
    ----------
    element : str
        Name of a surface; empty for the field bias.
    quantity : str
        One of ``SHAPE``, ``STAND`` or ``field_bias``.
    low, high : float
        Its bounds, SI.
    """

    element: str
    quantity: str
    low: float = -np.inf
    high: float = np.inf

    @property
    def name(self) -> str:
        """For tables and messages, e.g. ``M1 conic``."""
        return f"{self.element} {self.quantity}".strip()


@dataclass(frozen=True)
class Stand:
    """Where a surface's vertex stands, metres, and how it is turned about its x axis, radians."""

    z: float
    y: float = 0.0
    tilt: float = 0.0


@dataclass(frozen=True)
class Prescription:
    """Mirrors in the order of the light, and the image surface.

    Attributes
    ----------
    surfaces : Mapping[str, Surface]
        Name -> shape, the image last.
    stands : Mapping[str, Stand]
        Name -> where it stands.
    stop : str
        Name of the mirror whose vertex the chief rays meet.
    field_bias : float
        Angle of the field's centre from the parent axis, radians.
    """

    surfaces: Mapping[str, Surface]
    stands: Mapping[str, Stand]
    stop: str
    field_bias: float

    def __post_init__(self) -> None:
        """Freeze and check the names."""
        object.__setattr__(self, "surfaces", FrozenMap(self.surfaces))
        object.__setattr__(self, "stands", FrozenMap(self.stands))
        if set(self.surfaces) != set(self.stands) or self.stop not in self.names[:-1]:
            raise ValueError("every surface needs a stand, and the stop is one of the mirrors")

    @property
    def names(self) -> tuple[str, ...]:
        """All surfaces, in the order of the light."""
        return tuple(self.surfaces)

    def value(self, variable: Variable) -> float:
        """A number of the prescription, SI.

        Raises
        ------
        KeyError
            There is no such number.
        """
        if variable.quantity == BIAS:
            return self.field_bias
        surface, stand = self.surfaces[variable.element], self.stands[variable.element]
        if variable.quantity in STAND:
            return float(getattr(stand, variable.quantity))
        if variable.quantity in ("curvature", "conic"):
            return float(getattr(surface, variable.quantity))
        term = SHAPE.index(variable.quantity) - 2 if variable.quantity in SHAPE else None
        if term is None:
            raise KeyError(variable.name)
        return surface.even[term] if term < len(surface.even) else 0.0

    def values(self, variables: Sequence[Variable]) -> np.ndarray:
        """The numbers of all variables, (V,)."""
        return np.array([self.value(v) for v in variables])

    def with_values(self, variables: Sequence[Variable], values: np.ndarray) -> Prescription:
        """The prescription with other numbers (V,). Aspheric terms that the variables name come to exist."""
        surfaces, stands, bias = dict(self.surfaces), dict(self.stands), self.field_bias
        for variable, number in zip(variables, (float(v) for v in values), strict=True):
            name, quantity = variable.element, variable.quantity
            if quantity == BIAS:
                bias = number
            elif quantity in STAND:
                stands[name] = replace(stands[name], **{quantity: number})
            elif quantity == "curvature":
                surfaces[name] = replace(surfaces[name], curvature=number)
            elif quantity == "conic":
                surfaces[name] = replace(surfaces[name], conic=number)
            else:
                term = SHAPE.index(quantity) - 2
                even = list(surfaces[name].even) + [0.0] * (term + 1 - len(surfaces[name].even))
                even[term] = number
                surfaces[name] = replace(surfaces[name], even=tuple(even))
        return Prescription(surfaces, stands, self.stop, bias)

    @cached_property
    def assembly(self) -> Assembly:
        """The surfaces as bodies and elements, with the sequences ``imaging`` and ``to_stop``; no apertures."""
        bodies, elements = [], {}
        for name, surface in self.surfaces.items():
            stand = self.stands[name]
            # two bodies, so that a shift is along the axes of the prescription and a turn about the surface's own
            bodies.append(Body(name, Pose(np.eye(3), np.array([0.0, stand.y, stand.z]))))
            bodies.append(Body(f"{name}/face", Pose(about_axis(0, stand.tilt))))
            what = Interaction.PASS if name == self.names[-1] else Interaction.REFLECT
            elements[name] = Element(name, f"{name}/face", surface, what)
        stop = self.names.index(self.stop)
        return Assembly(RigidTree(tuple(bodies)), elements, {"imaging": self.names, "to_stop": self.names[: stop + 1]})

    def tangents(self, variables: Sequence[Variable], sequence: str) -> SystemBatch:
        """A batch of V equal systems; the v-th carries the derivative by the v-th variable."""
        assembly = self.assembly
        idle = (self.names[-1], "scale", 0)  # of a plane without size: changes nothing
        steps = [_step(v) if v.quantity in _STEPS else idle for v in variables]
        systems = assemble(assembly, [sequence], [{}] * len(variables), steps)
        assert systems.tangents is not None
        along = assembly.sequences[sequence]
        tables = []
        for i, name in enumerate(along):
            table = map_leaves(_or_zero, systems.values[i], systems.tangents[i])
            for n, variable in enumerate(variables):
                if variable.element == name and variable.quantity in _NUMBERS:
                    number = _NUMBERS[variable.quantity]
                    table = with_leaf(table, number, leaves(table)[number] + np.eye(len(variables))[n])
            tables.append(table)
        return replace(systems, tangents=tuple(tables))


def _or_zero(value: np.ndarray, tangent: np.ndarray | None) -> np.ndarray:
    return np.zeros_like(value) if tangent is None else tangent


def _step(variable: Variable) -> tuple[str, str, int]:
    body, kind, axis = _STEPS[variable.quantity]
    return variable.element + body, kind, axis
