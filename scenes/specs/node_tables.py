"""What jobs say of a body's temperature and of its displaced nodes, and the tables and meshes that they name."""

from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BeforeValidator, Field, StringConstraints, model_validator

from optics.geometry import zernike
from optics.thermal.heat import Temperature
from optics.thermal.nodal_deformation import TERMS
from scenes.specs.course import NO_MOTION, TemperatureChange, TemperatureGradient
from scenes.yaml.errors import KeyPath, Problem, names_text, nearest
from scenes.yaml.node_table import (
    DECKS_NEED,
    HEAT_DECKS_NEED,
    INPUT_DECKS,
    MESHES,
    TABLES,
    digest_of,
    read_nodes,
    read_temperatures,
)
from scenes.yaml.spec import Reference, Spec, Text, Whole
from scenes.yaml.yaml_file import is_file

Checksum = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{64}$")]
MeshUnit = Literal["m", "mm", "um"]
HEAT_KEYS = ("table", "frame", "values", "unit", "field", "sha256")
"""Of a temperature: those that say which table and how it is read."""


class TemperatureSpec(Spec):
    """A change of a body's temperature, and of all it carries that has none of its own: change + gradient . r.

    Attributes:
        change: at the body's origin, kelvin.
        gradient: in the body's own frame, K/m.
    """

    change: TemperatureChange = 0.0
    gradient: TemperatureGradient = NO_MOTION

    @property
    def linear(self) -> Temperature:
        """The linear field."""
        return Temperature(self.change, self.gradient)

    @property
    def warms(self) -> bool:
        """Whether it changes anything."""
        return self.change != 0.0 or any(self.gradient)


class TableTemperatureSpec(TemperatureSpec):
    """A change of a body's temperature: change + gradient . r, to which a table of nodes is added.

    Attributes:
        change: at the body's origin, kelvin.
        gradient: in the body's own frame, K/m.
        table: CSV file with the columns x, y, z and T (absolute, `T [degC]` or `T [K]`) or dT (`dT [K]`, changes from
            the instrument's temperature), or a mesh (.vtu, .vtk, .msh, .med) with temperatures at its nodes; relative
            to this file.
        frame: path of the body in whose nominal frame the nodes are told; by default the warmed one.
        values: of a mesh: whether its numbers are changes in kelvin (`change`) or absolute temperatures (`K`, `degC`).
        unit: of a mesh's coordinates, whose file has none.
        field: name of the temperatures in a mesh; needed when it has several numbers at its nodes.
        sha256: checksum of the table, which is filled in when it is read: another table is then refused.
    """

    table: Reference | None = None
    frame: Reference | None = None
    values: Literal["change", "K", "degC"] | None = None
    unit: MeshUnit | None = None
    field: Text | None = None
    sha256: Checksum | None = None

    @property
    def warms(self) -> bool:
        """Whether it changes anything."""
        return super().warms or self.table is not None

    @model_validator(mode="after")
    def _says_of_a_table(self) -> "TableTemperatureSpec":
        wrong = next((key for key in HEAT_KEYS[1:] if self.table is None and getattr(self, key) is not None), None)
        if wrong is not None:
            raise Problem(f"{wrong} says how a table is read, and there is none", None, "table: FILE", within=(wrong,))
        return self


def _uniform(value: Any) -> Any:
    """`temperature: 2 K` means a uniform change."""
    return {"change": value} if isinstance(value, str | int | float) else value


def _uniform_or_table(value: Any) -> Any:
    """`temperature: 2 K` means a uniform change, `temperature: m1.csv` a table."""
    if isinstance(value, str) and Path(value).suffix.lower() in (*TABLES, *MESHES, *INPUT_DECKS):
        return {"table": value}
    return _uniform(value)


PlainTemperature = Annotated[TemperatureSpec, BeforeValidator(_uniform)]
"""With its keys, or the uniform change alone."""
TableTemperature = Annotated[TableTemperatureSpec, BeforeValidator(_uniform_or_table)]
"""With its keys, or the uniform change or the table's name alone."""


class DeformationSpec(Spec):
    """Displaced nodes of a finite-element program, on a mirror's optical surface or a face.

    Attributes:
        table: CSV file with the columns x, y, z, dx, dy and dz, units in its heads, or a mesh (.vtu, .vtk, .msh, .med)
            that has displacements at its nodes; relative to this file.
        frame: path of the body in whose nominal frame nodes and displacements are told; by default the deformed one.
        terms: highest Zernike term of the figure, by Noll's numbering; a grid holds the rest.
        unit: of a mesh, whose file has none.
        field: name of the displacements in a mesh; needed when it has several vectors at its nodes.
        sha256: checksum of the table, which is filled in when it is read: another table is then refused.
    """

    table: Reference
    frame: Reference | None = None
    terms: Annotated[Whole, Field(ge=3, le=zernike.MAX_NOLL)] = TERMS
    unit: MeshUnit | None = None
    field: Text | None = None
    sha256: Checksum | None = None


def _named(value: Any) -> Any:
    """`deformation: m1.csv` names the table alone."""
    return {"table": value} if isinstance(value, str) else value


Deformation = Annotated[DeformationSpec, BeforeValidator(_named)]
"""With its keys, or the table's name alone."""

TableSpec = TypeVar("TableSpec", DeformationSpec, TableTemperatureSpec)


def checked(owner: Spec, key: KeyPath, spec: TableSpec) -> TableSpec:
    """The same with the table's full path and checksum, when it can be read.

    Args:
        owner: the specification that names it, which knows its file.
        key: of the deformation or the temperature in there.
        spec: as read, with a table.

    Raises:
        InputError: no such table, one that is not right, or another one than the checksum says.
    """
    heat = isinstance(spec, TableTemperatureSpec)
    assert spec.table is not None
    path = (Path(owner.source.file).parent / spec.table).absolute()
    place = (*key, "table")
    if not is_file(path):
        kinds = names_text((*TABLES, *MESHES))
        raise owner.error(f"no such file: {path}", place, allowed=f"a file ({kinds}), relative to this one")
    ending = path.suffix.lower()
    if ending in INPUT_DECKS:
        text = f"a {ending} file has no {'temperatures' if heat else 'displacements'} that can be read here"
        raise owner.error(text, place, found=spec.table, allowed=HEAT_DECKS_NEED if heat else DECKS_NEED)
    if ending not in (*TABLES, *MESHES):
        meant = nearest(ending, (*TABLES, *MESHES))
        text = "neither a table nor a mesh that is known"
        allowed = names_text((*TABLES, *MESHES))
        raise owner.error(text, place, found=spec.table, allowed=allowed, suggestion=meant)
    of_meshes = ("unit", "field", "values") if heat else ("unit", "field")
    if ending in TABLES:
        wrong = next((name for name in of_meshes if getattr(spec, name) is not None), None)
        if wrong is not None:
            text = f"a table has its units in its heads and no {wrong} beside them"
            raise owner.error(text, (*key, wrong), allowed=f"no {wrong}")
    elif spec.unit is None:
        raise owner.error("a mesh's file does not say its unit", place, found=spec.table, allowed="unit: mm beside it")
    elif isinstance(spec, TableTemperatureSpec) and spec.values is None:
        text = "a mesh's file does not say whether its temperatures are changes or absolute"
        raise owner.error(text, place, found=spec.table, allowed="values: change, K or degC beside it")
    if isinstance(spec, TableTemperatureSpec):
        read_temperatures(path, spec.unit, spec.field, spec.values, spec.sha256)
    else:
        read_nodes(path, spec.unit, spec.field, spec.sha256)
    return spec.model_copy(update={"table": str(path), "sha256": digest_of(path)})
