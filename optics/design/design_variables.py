"""Mirror prescriptions for optimisation: rotationally symmetric mirrors in one plane of symmetry, and their variables.

z runs along the parent axis, light enters toward +z, y lies in the plane of symmetry. A surface's vertex is at (0, y,
z), rotated by ``tilt`` about its own x axis.
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
POSE_QUANTITIES = ("z", "y", "tilt")
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
    """Number of a prescription that the optimisation may change, within bounds.

    Attributes
    ----------
    element : str
        Name of a surface; empty for the field bias.
    quantity : str
        The varied quantity: ``curvature``, ``conic``, ``A4``, ``A6`` or ``A8`` of a surface's shape; ``z``, ``y`` or
        ``tilt`` of its pose; or ``field_bias``.
    low, high : float
        Bounds, SI units.
    """

    element: str
    quantity: str
    low: float = -np.inf
    high: float = np.inf

    @property
    def name(self) -> str:
        """Name of the variable for tables and messages, e.g. ``M1 conic``."""
        return f"{self.element} {self.quantity}".strip()


@dataclass(frozen=True)
class VertexPose:
    """Position of a surface's vertex, metres, and its rotation about its x axis, radians."""

    z: float
    y: float = 0.0
    tilt: float = 0.0


@dataclass(frozen=True)
class Prescription:
    """Mirrors in the order of the light, and the image surface.

    Attributes
    ----------
    surfaces : mapping of str to Surface
        Name -> shape, the image last.
    poses : mapping of str to VertexPose
        Name -> position and tilt.
    stop : str
        Name of the mirror whose vertex the chief rays meet.
    field_bias : float
        Angle of the field's centre from the parent axis, radians.
    """

    surfaces: Mapping[str, Surface]
    poses: Mapping[str, VertexPose]
    stop: str
    field_bias: float

    def __post_init__(self) -> None:
        """Make the mappings immutable, and check that shapes, poses and stop have matching names."""
        object.__setattr__(self, "surfaces", FrozenMap(self.surfaces))
        object.__setattr__(self, "poses", FrozenMap(self.poses))
        if set(self.surfaces) != set(self.poses) or self.stop not in self.names[:-1]:
            raise ValueError("every surface needs a pose, and the stop must be one of the mirrors")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all surfaces, in the order of the light."""
        return tuple(self.surfaces)

    def value(self, variable: Variable) -> float:
        """Return the value that a variable has in this prescription, in SI units.

        Raises
        ------
        KeyError
            The prescription has no such number.
        """
        if variable.quantity == BIAS:
            return self.field_bias
        surface, pose = self.surfaces[variable.element], self.poses[variable.element]
        if variable.quantity in POSE_QUANTITIES:
            return float(getattr(pose, variable.quantity))
        if variable.quantity in ("curvature", "conic"):
            return float(getattr(surface, variable.quantity))
        term = SHAPE.index(variable.quantity) - 2 if variable.quantity in SHAPE else None
        if term is None:
            raise KeyError(variable.name)
        return surface.even[term] if term < len(surface.even) else 0.0

    def values(self, variables: Sequence[Variable]) -> np.ndarray:
        """Return the values of V variables in this prescription, (V,), in SI units."""
        return np.array([self.value(v) for v in variables])

    def with_values(self, variables: Sequence[Variable], values: np.ndarray) -> Prescription:
        """Return a copy of the prescription in which the V variables have the given values (V,), in SI units.

        Aspheric terms that a variable names and the prescription lacks are added.
        """
        surfaces, poses, bias = dict(self.surfaces), dict(self.poses), self.field_bias
        for variable, number in zip(variables, (float(v) for v in values), strict=True):
            name, quantity = variable.element, variable.quantity
            if quantity == BIAS:
                bias = number
            elif quantity in POSE_QUANTITIES:
                poses[name] = replace(poses[name], **{quantity: number})
            elif quantity == "curvature":
                surfaces[name] = replace(surfaces[name], curvature=number)
            elif quantity == "conic":
                surfaces[name] = replace(surfaces[name], conic=number)
            else:
                term = SHAPE.index(quantity) - 2
                even = list(surfaces[name].even) + [0.0] * (term + 1 - len(surfaces[name].even))
                even[term] = number
                surfaces[name] = replace(surfaces[name], even=tuple(even))
        return Prescription(surfaces, poses, self.stop, bias)

    @cached_property
    def assembly(self) -> Assembly:
        """Assembly of rigid bodies and optical elements for the ray trace, without apertures.

        Its sequence ``imaging`` leads through all surfaces to the image, ``to_stop`` ends at the stop.
        """
        bodies, elements = [], {}
        for name, surface in self.surfaces.items():
            pose = self.poses[name]
            # two bodies: shifts are along the prescription's axes, rotations about the surface's own axis
            bodies.append(Body(name, Pose(np.eye(3), np.array([0.0, pose.y, pose.z]))))
            bodies.append(Body(f"{name}/face", Pose(about_axis(0, pose.tilt))))
            interaction = Interaction.PASS if name == self.names[-1] else Interaction.REFLECT
            elements[name] = Element(name, f"{name}/face", surface, interaction)
        stop = self.names.index(self.stop)
        return Assembly(RigidTree(tuple(bodies)), elements, {"imaging": self.names, "to_stop": self.names[: stop + 1]})

    def tangents(self, variables: Sequence[Variable], sequence: str) -> SystemBatch:
        """Return V copies of the optical system, of which copy v carries the derivatives with respect to variable v.

        ``sequence`` names the elements that are traced: ``imaging`` (all, to the image) or ``to_stop`` (as far as the
        stop).
        """
        assembly = self.assembly
        no_step = (self.names[-1], "scale", 0)  # scaling the image plane has no effect
        steps = [_step(v) if v.quantity in _STEPS else no_step for v in variables]
        systems = assemble(assembly, [sequence], [{}] * len(variables), steps)
        assert systems.tangents is not None
        names = assembly.sequences[sequence]
        tables = []
        for i, name in enumerate(names):
            table = map_leaves(_or_zero, systems.values[i], systems.tangents[i])
            for n, variable in enumerate(variables):
                if variable.element == name and variable.quantity in _NUMBERS:
                    number = _NUMBERS[variable.quantity]
                    table = with_leaf(table, number, leaves(table)[number] + np.eye(len(variables))[n])
            tables.append(table)
        return replace(systems, tangents=tuple(tables))


def _or_zero(value: np.ndarray, tangent: np.ndarray | None) -> np.ndarray:
    """Return the derivative ``tangent``, or zeros of the shape of ``value`` where it is None."""
    return np.zeros_like(value) if tangent is None else tangent


def _step(variable: Variable) -> tuple[str, str, int]:
    """Return (body, kind of motion, axis) by which a ray trace is differentiated for a variable of position or tilt."""
    body, kind, axis = _STEPS[variable.quantity]
    return variable.element + body, kind, axis
