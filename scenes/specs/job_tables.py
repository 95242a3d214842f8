"""Tables of jobs: temperatures and displaced nodes of bodies, and measured finishes for stray light.

A finish is a BSDF or a coating that replaces the built-in one.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BeforeValidator, Field, StringConstraints, model_validator

from optics.geometry import zernike
from optics.numerics.number_tree import FrozenMap
from optics.thermal.heat import Temperature
from optics.thermal.nodal_deformation import TERMS
from scenes.specs.course import NO_MOTION, TemperatureChange, TemperatureGradient
from scenes.yaml import node_table
from scenes.yaml.errors import KeyPath, Problem, names_text, nearest, shown
from scenes.yaml.finish_files import ENDING, read_bsdf, read_coating
from scenes.yaml.input_file import digest_of
from scenes.yaml.spec import ZERO_IS_NONE, Reference, Spec, Text, Whole, short_for
from scenes.yaml.unit_fields import Quantity
from scenes.yaml.units import SCALE

Checksum = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{64}$")]
MeshUnit = Literal["m", "mm", "um"]
HEAT_KEYS = ("table", "frame", "values", "unit", "field", "sha256")
"""Keys of a temperature that refer to a table and say how to read it."""


class TemperatureSpec(Spec):
    """Temperature change of a body, linear in the position, and of the bodies that it carries without an entry.

    At a point it is `change` plus the scalar product of `gradient` and the point's position from the body's origin. It
    replaces the change that the body would inherit, even if it is zero.

    Attributes
    ----------
    change : float
        Temperature change at the body's origin, in kelvin.
    gradient : tuple[float, float, float]
        Temperature gradient in the body's frame, in K/m.
    """

    change: TemperatureChange = 0.0
    gradient: TemperatureGradient = NO_MOTION

    @property
    def linear(self) -> Temperature:
        """Temperature change as a linear function of the position, for the thermal model."""
        return Temperature(self.change, self.gradient)

    @property
    def warms(self) -> bool:
        """True if the temperature changes anywhere."""
        return self.change != 0.0 or any(self.gradient)


class TableTemperatureSpec(TemperatureSpec):
    """Temperature change of a body: a linear field, to which a table of temperatures at nodes is added.

    The linear field is `change` plus the scalar product of `gradient` and the position from the body's origin.

    Attributes
    ----------
    table : str | None
        CSV file with the columns x, y, z and T (absolute, `T [degC]` or `T [K]`) or dT (`dT [K]`, changes from the
        instrument's temperature), or a mesh (.vtu, .vtk, .msh, .med) with temperatures at its nodes; a path relative to
        this file.
    frame : str | None
        Path of the body in whose nominal frame the nodes are given; by default the heated body.
    values : {'change', 'K', 'degC'} | None
        Meaning of a mesh's numbers: changes in kelvin (`change`) or absolute temperatures (`K`, `degC`).
    unit : {'m', 'mm', 'um'} | None
        Unit of a mesh's coordinates, which its file does not contain.
    field : str | None
        Name of the temperatures in a mesh; needed if it has several scalar fields at its nodes.
    sha256 : str | None
        Checksum of the table, filled in by the program when the table is read; a table with another checksum is
        refused.
    """

    table: Reference | None = None
    frame: Reference | None = None
    values: Literal["change", "K", "degC"] | None = None
    unit: MeshUnit | None = None
    field: Text | None = None
    sha256: Checksum | None = None

    @property
    def warms(self) -> bool:
        """True if the temperature changes anywhere."""
        return super().warms or self.table is not None

    @model_validator(mode="after")
    def _check_table(self) -> "TableTemperatureSpec":
        wrong = next((key for key in HEAT_KEYS[1:] if self.table is None and getattr(self, key) is not None), None)
        if wrong is not None:
            raise Problem(f"{wrong} applies to a table, and there is none", None, "table: FILE", within=(wrong,))
        return self


def _table(value: Any) -> Any:
    """Expand `temperature: m1.csv` to a mapping with the table."""
    if isinstance(value, str) and Path(value).suffix.lower() in (
        *node_table.TABLES,
        *node_table.MESHES,
        *node_table.INPUT_DECKS,
    ):
        return {"table": value}
    return value


_uniform = short_for("change", str, int, float)
PlainTemperature = Annotated[TemperatureSpec, ZERO_IS_NONE, _uniform]
"""Temperature change as a mapping with its keys, or as the uniform change alone, `2 K`. A change of zero is the same as
no entry if no body that carries this one is heated.
"""
TableTemperature = Annotated[TableTemperatureSpec, ZERO_IS_NONE, _uniform, BeforeValidator(_table)]
"""Temperature change as a mapping with its keys, or as the uniform change or the name of a table alone."""


class DeformationSpec(Spec):
    """Displaced nodes of a finite-element program on a mirror's optical surface or a prism's face.

    Attributes
    ----------
    table : str
        CSV file with the columns x, y, z, dx, dy and dz with their units, or a mesh (.vtu, .vtk, .msh, .med) with
        displacements at its nodes; a path relative to this file.
    frame : str | None
        Path of the body in whose nominal frame nodes and displacements are given; by default the deformed body.
    terms : int
        Highest Zernike term of the figure, by Noll's numbering; the residual is represented on a grid.
    unit : {'m', 'mm', 'um'} | None
        Unit of a mesh, which its file does not contain.
    field : str | None
        Name of the displacements in a mesh; needed if it has several vector fields at its nodes.
    sha256 : str | None
        Checksum of the table, filled in by the program when the table is read; a table with another checksum is
        refused.
    """

    table: Reference
    frame: Reference | None = None
    terms: Annotated[Whole, Field(ge=3, le=zernike.MAX_NOLL)] = TERMS
    unit: MeshUnit | None = None
    field: Text | None = None
    sha256: Checksum | None = None


Deformation = Annotated[DeformationSpec, short_for("table", str)]
"""Deformation as a mapping with its keys, or the table's name alone."""

TableSpec = TypeVar("TableSpec", DeformationSpec, TableTemperatureSpec)


def checked(owner: Spec, key: KeyPath, spec: TableSpec) -> TableSpec:
    """Return a specification with the absolute path and the checksum of its table, after reading it.

    Parameters
    ----------
    owner : Spec
        Specification that refers to the table, which knows its file.
    key : KeyPath
        Key path of the deformation or the temperature in it.
    spec : TableSpec
        Specification with a table.

    Raises
    ------
    InputError
        The table is missing or invalid, or its checksum differs.
    """
    heat = isinstance(spec, TableTemperatureSpec)
    assert spec.table is not None
    table_key, known = (*key, "table"), (*node_table.TABLES, *node_table.MESHES)
    path = owner.file_at(table_key, spec.table, Path(owner.source.file).parent, f"a file ({names_text(known)})")
    ending = path.suffix.lower()
    if ending in node_table.INPUT_DECKS:
        text = f"a {ending} file has no {'temperatures' if heat else 'displacements'} that this program can read"
        raise owner.error(
            text, table_key, value=spec.table, allowed=node_table.HEAT_DECKS_NEED if heat else node_table.DECKS_NEED
        )
    if ending not in known:
        text = "unknown type of table or mesh"
        raise owner.error(Problem(text, shown(spec.table), names_text(known), nearest(ending, known)), table_key)
    of_meshes = ("unit", "field", "values") if heat else ("unit", "field")
    if ending in node_table.TABLES:
        wrong = next((name for name in of_meshes if getattr(spec, name) is not None), None)
        if wrong is not None:
            text = f"a table has its units in its heads; {wrong} is for meshes only"
            raise owner.error(text, (*key, wrong), allowed=f"no {wrong}")
    elif spec.unit is None:
        raise owner.error(
            "a mesh file does not contain its unit", table_key, value=spec.table, allowed="a key unit: mm"
        )
    elif isinstance(spec, TableTemperatureSpec) and spec.values is None:
        text = "the file of a mesh does not say whether its temperatures are changes or absolute"
        raise owner.error(text, table_key, value=spec.table, allowed="values: change, K or degC as a further key")
    if isinstance(spec, TableTemperatureSpec):
        node_table.read_temperatures(path, spec.unit, spec.field, spec.values, spec.sha256)
    else:
        node_table.read_nodes(path, spec.unit, spec.field, spec.sha256)
    return spec.model_copy(update={"table": str(path), "sha256": digest_of(path)})


Share = Annotated[float, Quantity(SCALE, smallest="0 percent", largest="100 percent")]


class FinishTableSpec(Spec):
    """Table of a finish.

    Attributes
    ----------
    table : str
        Path of the table, relative to this file.
    sha256 : str | None
        Checksum of the table, filled in by the program when the table is read; a table with another checksum is
        refused.
    """

    table: Reference
    sha256: Checksum | None = None


FinishTable = Annotated[FinishTableSpec, short_for("table", str)]


class FinishSpec(Spec):
    """Measured finish of one kind of surface. Properties without a key keep their built-in values.

    Attributes
    ----------
    bsdf : FinishTableSpec | None
        Tabular BSDF of the reflected light in Zemax's format (.bsdf), instead of the built-in scatter lobe. Its values
        are relative to the incident light, and the scattered share is part of the reflected light.
    coating : FinishTableSpec | None
        CSV file with the columns wavelength, angle, R and optionally T (or Rs and Rp, Ts and Tp).
    reflectance : float | None
        Reflectance, specular and scattered together.
    """

    bsdf: FinishTable | None = None
    coating: FinishTable | None = None
    reflectance: Share | None = None

    @model_validator(mode="after")
    def _check_content(self) -> "FinishSpec":
        if self.bsdf is None and self.coating is None and self.reflectance is None:
            raise Problem("a finish without any property", "no keys", "bsdf, coating or reflectance")
        if self.coating is not None and self.reflectance is not None:
            text = "the table of the coating already has the reflectance"
            raise Problem(text, "both coating and reflectance", "one of them", within=("reflectance",))
        return self


def _by_ending(value: Any) -> Any:
    """Expand `mirror: m1.bsdf` to a BSDF and `mirror: silver.csv` to a coating."""
    if not isinstance(value, str):
        return value
    ending = Path(value).suffix.lower()
    if ending not in (ENDING, *node_table.TABLES):
        allowed = (
            f"the name of a BSDF ({ENDING}) or of a coating ({names_text(node_table.TABLES)}), or keys bsdf, coating"
        )
        raise Problem("not a table of a finish", value, allowed)
    return {"bsdf" if ending == ENDING else "coating": value}


Finish = Annotated[FinishSpec, BeforeValidator(_by_ending)]

ALLOWS: Mapping[str, tuple[str, ...]] = FrozenMap(
    {
        "mirror": ("bsdf", "coating", "reflectance"),
        "black": ("bsdf",),
        "coated": ("coating",),
        "detector": ("bsdf", "coating", "reflectance"),
    }
)
"""Kind of surface -> properties that may be measured."""


class FinishesSpec(Spec):
    """Measured finishes by kind of surface.

    Attributes
    ----------
    mirror : Finish | None
        Finish of the cameras' mirrors; metallised faces of prisms keep their built-in one.
    black : Finish | None
        Finish of the backs of mirrors, of boards and of baffles; with a table they reflect nothing else.
    coated : Finish | None
        Finish of glass faces in transmission, from outside and inside.
    detector : Finish | None
        Finish of the CCDs; light that is not reflected is recorded.
    """

    mirror: Finish | None = None
    black: Finish | None = None
    coated: Finish | None = None
    detector: Finish | None = None

    @model_validator(mode="after")
    def _allowed(self) -> "FinishesSpec":
        if not self.by_kind:
            raise Problem("no finish", "no keys", names_text(ALLOWS))
        for kind, spec in self.by_kind.items():
            named = [what for what in FinishSpec.model_fields if getattr(spec, what) is not None]
            wrong = next((what for what in named if what not in ALLOWS[kind]), None)
            if wrong is not None:
                text = f"{kind} surfaces cannot have a measured {wrong}"
                raise Problem(text, None, names_text(ALLOWS[kind]), within=(kind, wrong))
        return self

    @property
    def by_kind(self) -> dict[str, FinishSpec]:
        """Kind of surface -> finish, for kinds with a finish."""
        return {kind: spec for kind in ALLOWS if (spec := getattr(self, kind)) is not None}

    @property
    def tables(self) -> dict[tuple[str, str], FinishTableSpec]:
        """(Kind of surface, property) -> file of the measured table."""
        both = (
            (kind, what, getattr(spec, what)) for kind, spec in self.by_kind.items() for what in ("bsdf", "coating")
        )
        return {(kind, what): table for kind, what, table in both if table is not None}

    def with_tables(self, tables: Mapping[tuple[str, str], FinishTableSpec]) -> "FinishesSpec":
        """Return the finishes with other tables, given as (kind of surface, property) -> table."""
        changed = dict(self.by_kind)
        for (kind, what), table in tables.items():
            changed[kind] = changed[kind].model_copy(update={what: table})
        return self.model_copy(update=dict(changed))


def checked_finishes(owner: Spec, key: KeyPath, spec: FinishesSpec) -> FinishesSpec:
    """Return finishes with the absolute paths and the checksums of their tables, after reading them.

    Parameters
    ----------
    owner : Spec
        Specification that refers to the tables, which knows its file.
    key : KeyPath
        Key path of the finishes in it.
    spec : FinishesSpec
        The finishes.

    Raises
    ------
    InputError
        A table is missing or invalid, or its checksum differs.
    """
    out = {}
    for (kind, what), table in spec.tables.items():
        table_key = (*key, kind, what)
        path = owner.file_at(table_key, table.table, Path(owner.source.file).parent, "a file")
        ending = path.suffix.lower()
        suffixes = (ENDING,) if what == "bsdf" else node_table.TABLES
        if ending not in suffixes:
            text = f"not the file type of a {what} table"
            raise owner.error(text, table_key, value=table.table, allowed=names_text(suffixes))
        digest = digest_of(path)
        if table.sha256 is not None and digest != table.sha256:
            text = "not the table that was used: its checksum differs"
            raise owner.error(text, table_key, value=digest, allowed=f"sha256 {table.sha256}")
        if what == "bsdf":
            read_bsdf(path)
        else:
            read_coating(path)
        out[kind, what] = table.model_copy(update={"table": str(path), "sha256": digest})
    return spec.with_tables(out)
