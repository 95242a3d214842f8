"""Measured finishes that stray light is traced with: BSDF and coating tables in place of the built-in ones."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, model_validator

from optics.numerics.frozen_map import FrozenMap
from scenes.specs.node_tables import Checksum
from scenes.yaml.bsdf_file import ENDING, read_bsdf
from scenes.yaml.coating_file import read_coating
from scenes.yaml.errors import KeyPath, Problem, names_text
from scenes.yaml.node_table import TABLES, digest_of
from scenes.yaml.quantity import Quantity
from scenes.yaml.spec import Reference, Spec
from scenes.yaml.units import SCALE
from scenes.yaml.yaml_file import is_file

Share = Annotated[float, Quantity(SCALE, smallest="0 percent", largest="100 percent")]


class FinishTableSpec(Spec):
    """A table of a finish.

    Attributes:
        table: the file, relative to this one.
        sha256: its checksum, which is filled in when it is read: another table is then refused.
    """

    table: Reference
    sha256: Checksum | None = None


def _named(value: Any) -> Any:
    """`bsdf: m1.bsdf` names the table alone."""
    return {"table": value} if isinstance(value, str) else value


FinishTable = Annotated[FinishTableSpec, BeforeValidator(_named)]


class FinishSpec(Spec):
    """A measured finish of one kind of surface; what it does not say stays as built in.

    Attributes:
        bsdf: Zemax's tabular BSDF of the reflected light (.bsdf), in place of the scatter lobe: shares of the incident
            light, which come out of what is reflected.
        coating: CSV file with the columns wavelength, angle, R and, if need be, T (or Rs and Rp, Ts and Tp).
        reflectance: share that is reflected, specular and scattered together.
    """

    bsdf: FinishTable | None = None
    coating: FinishTable | None = None
    reflectance: Share | None = None

    @model_validator(mode="after")
    def _says_something_once(self) -> "FinishSpec":
        if self.bsdf is None and self.coating is None and self.reflectance is None:
            raise Problem("a finish that says nothing", "no keys", "bsdf, coating or reflectance")
        if self.coating is not None and self.reflectance is not None:
            text = "a coating's table has the reflectance"
            raise Problem(text, "both coating and reflectance", "one of them", within=("reflectance",))
        return self


def _by_ending(value: Any) -> Any:
    """`mirror: m1.bsdf` is a BSDF, `mirror: silver.csv` a coating."""
    if not isinstance(value, str):
        return value
    ending = Path(value).suffix.lower()
    if ending not in (ENDING, *TABLES):
        allowed = f"the name of a BSDF ({ENDING}) or of a coating ({names_text(TABLES)}), or keys bsdf, coating"
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
"""Kind of surface -> what may be measured of it."""


class FinishesSpec(Spec):
    """Measured finishes, by kind of surface.

    Attributes:
        mirror: of the cameras' mirrors; metallised faces of prisms keep theirs.
        black: of the backs of mirrors, boards and baffles: with a table nothing else comes back from them.
        coated: of faces of glass that light goes through, from outside and inside.
        detector: of CCDs; what is not reflected is recorded.
    """

    mirror: Finish | None = None
    black: Finish | None = None
    coated: Finish | None = None
    detector: Finish | None = None

    @model_validator(mode="after")
    def _allowed(self) -> "FinishesSpec":
        if not self.given:
            raise Problem("no finish", "no keys", names_text(ALLOWS))
        for kind, spec in self.given.items():
            named = [what for what in FinishSpec.model_fields if getattr(spec, what) is not None]
            wrong = next((what for what in named if what not in ALLOWS[kind]), None)
            if wrong is not None:
                text = f"{kind} surfaces do not take a {wrong} here"
                raise Problem(text, None, names_text(ALLOWS[kind]), within=(kind, wrong))
        return self

    @property
    def given(self) -> dict[str, FinishSpec]:
        """Kind -> finish, of those that are given."""
        return {kind: spec for kind in ALLOWS if (spec := getattr(self, kind)) is not None}

    @property
    def tables(self) -> dict[tuple[str, str], FinishTableSpec]:
        """Kind and what is measured -> table."""
        both = ((kind, what, getattr(spec, what)) for kind, spec in self.given.items() for what in ("bsdf", "coating"))
        return {(kind, what): table for kind, what, table in both if table is not None}

    def with_tables(self, tables: Mapping[tuple[str, str], FinishTableSpec]) -> "FinishesSpec":
        """The same with other tables, kind and what is measured -> table."""
        changed = dict(self.given)
        for (kind, what), table in tables.items():
            changed[kind] = changed[kind].model_copy(update={what: table})
        return self.model_copy(update=dict(changed))


def checked_finishes(owner: Spec, key: KeyPath, spec: FinishesSpec) -> FinishesSpec:
    """The same with the tables' full paths and checksums, when they can be read.

    Args:
        owner: the specification that names them, which knows its file.
        key: of the finishes in there.
        spec: as read.

    Raises:
        InputError: no such table, one that is not right, or another one than the checksum says.
    """
    out = {}
    for (kind, what), table in spec.tables.items():
        place = (*key, kind, what)
        path = (Path(owner.source.file).parent / table.table).absolute()
        if not is_file(path):
            raise owner.error(f"no such file: {path}", place, allowed="a file, relative to this one")
        ending = path.suffix.lower()
        right = (ENDING,) if what == "bsdf" else TABLES
        if ending not in right:
            text = f"not the ending of a {what}'s table"
            raise owner.error(text, place, found=table.table, allowed=names_text(right))
        digest = digest_of(path)
        if table.sha256 is not None and digest != table.sha256:
            text = "not the table that was used: its checksum is another"
            raise owner.error(text, place, found=digest, allowed=f"sha256 {table.sha256}")
        if what == "bsdf":
            read_bsdf(path)
        else:
            read_coating(path)
        out[kind, what] = table.model_copy(update={"table": str(path), "sha256": digest})
    return spec.with_tables(out)
