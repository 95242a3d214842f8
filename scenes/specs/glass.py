"""Glass of a lens: a name of the catalogue, or a manufacturer's dispersion formula."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, SerializerFunctionWrapHandler, model_serializer, model_validator

from optics.materials.glass import (
    FORMULAS,
    GLASSES,
    SCHOTT_RANGE,
    CatalogueGlass,
    Glass,
    ThermalDispersion,
    WarmGlass,
    common_glasses,
    glass,
)
from optics.materials.material import MATERIALS, TemperatureRange
from optics.numerics.array_math import UnphysicalError
from scenes.specs.spectrum import WavelengthRange
from scenes.yaml.errors import Problem, unknown
from scenes.yaml.spec import Number, Spec, Text, Whole, short_for
from scenes.yaml.unit_fields import Quantity
from scenes.yaml.units import EXPANSION, LENGTH, format_quantity

Medium = Literal["vacuum", "air"]
CATALOGUE_RANGE = TemperatureRange.celsius(-30.0, 70.0, "AGF catalogues state the mean expansion of that range")
"""Temperature range in which the expansion of a glass in a camera's file holds."""


def glass_entry(glass: CatalogueGlass) -> dict[str, Any]:
    """Return a catalogue glass in the form of a camera's file."""
    ends = [format_quantity(w, LENGTH) for w in (glass.shortest, glass.longest)]
    out = {"name": glass.name, "formula": glass.formula, "coefficients": list(glass.coefficients), "range": ends}
    if glass.expansion is not None:
        out["expansion"] = format_quantity(glass.expansion, EXPANSION)
    return out if glass.thermal is None else {**out, "thermal": list(glass.thermal)}


class LensGlassSpec(Spec):
    """Glass of a lens with its dispersion at 20 C.

    Attributes
    ----------
    name : str
        Name of a glass in the catalogue (`N-BK7`, `N-SF11`, `S-FPL53`, `FCD1`, `H-K9L`, ...), or any name beside a
        formula.
    formula : int | None
        Number of the dispersion formula in AGF catalogues (1 Schott, 2 Sellmeier 1, ...); by default the catalogue's
        glass.
    coefficients : tuple[float, ...] | None
        Coefficients of the formula for wavelengths in micrometres, in the order of the AGF catalogue; for Sellmeier B1,
        C1, B2, C2, B3, C3.
    range : tuple[float, float] | None
        Shortest and longest wavelength at which the formula holds, in metres.
    expansion : float | None
        Linear thermal expansion, mean of -30 to 70 C, as in the ED line of AGF catalogues, in 1/K. By default that of
        the twin's material of the same name; if there is none, the lens cannot be heated.
    thermal : tuple[float, ...] | None
        Schott's constants D0, D1, D2, E0, E1 and Lambda_TK of dn/dT in the units of data sheets, as in the TD line of
        AGF catalogues. By default those of the catalogue; if there are none, the lens cannot be heated.
    """

    name: Text
    formula: Annotated[Whole, Field(ge=1, le=max(FORMULAS))] | None = None
    coefficients: Annotated[tuple[Number, ...], Field(min_length=1, max_length=12)] | None = None
    range: WavelengthRange | None = None
    expansion: Annotated[float, Quantity(EXPANSION, largest="1000 ppm/K")] | None = None
    thermal: Annotated[tuple[Number, ...], Field(min_length=6, max_length=6)] | None = None

    @model_validator(mode="before")
    @classmethod
    def _with_formula(cls, data: Any) -> Any:
        """Return the file's data, with the formula of a common glass where they have none."""
        known = common_glasses().get(data["name"]) if isinstance(data, dict) and "name" in data else None
        return data if known is None or "formula" in data else {**glass_entry(known), **data}

    @model_validator(mode="after")
    def _is_known(self) -> LensGlassSpec:
        keys = [key for key in ("formula", "coefficients", "range") if getattr(self, key) is not None]
        if keys and len(keys) < 3:
            raise Problem("an incomplete definition of a glass", ", ".join(keys), "formula, coefficients, range")
        if not keys:
            try:
                glass(self.name)
            except KeyError:
                raise unknown("no such glass", self.name, (*GLASSES, *common_glasses()), within=("name",)) from None
        return self

    @model_serializer(mode="wrap")
    def _short(self, handler: SerializerFunctionWrapHandler) -> Any:
        """Return a catalogue glass as its name alone, another glass in full."""
        full = handler(self)
        plain = all(getattr(self, key) is None for key in type(self).model_fields if key != "name")
        return self.name if plain else full

    def index(self, wavelength: float, medium: Medium) -> float:
        """Return the refractive index at 20 C.

        Parameters
        ----------
        wavelength : float
            Wavelength, in metres.
        medium : {'vacuum', 'air'}
            Medium to which the index refers: ``air`` of 20 C and 1013 hPa, as manufacturers state it, or ``vacuum``.

        Raises
        ------
        ValueError
            The formula does not hold at this wavelength.
        """
        known: Glass | CatalogueGlass
        if self.formula is None or self.coefficients is None or self.range is None:
            known = glass(self.name)
        else:
            known = CatalogueGlass(self.name, self.formula, self._filled(self.coefficients), *self.range)
        return known.index(wavelength) if medium == "air" else known.vacuum_index(wavelength)

    def warm(self, wavelength: float, medium: Medium) -> WarmGlass:
        """Return the thermal properties of the glass at a wavelength.

        Parameters
        ----------
        wavelength : float
            Wavelength, in metres.
        medium : {'vacuum', 'air'}
            Medium to which the index refers: ``air`` of 20 C and 1013 hPa, or ``vacuum``. The medium itself is not
            heated.

        Raises
        ------
        ValueError
            Neither the catalogue nor the file has its expansion or the change of its index.
        """
        named = None if self.formula is not None else glass(self.name)
        solid = None if named is None else MATERIALS.get(named.name)
        if self.expansion is None and solid is None:
            raise UnphysicalError(
                f"the thermal expansion of {self.name} is unknown; its glass needs `expansion: 8.2 ppm/K`, the first "
                "number of ED in its AGF catalogue"
            )
        thermal = named.thermal if named is not None else None
        if self.thermal is not None:
            d0, d1, d2, e0, e1, lambda_tk = self.thermal
            thermal = ThermalDispersion(d0, d1, d2, e0, e1, lambda_tk)
        if thermal is None:
            raise UnphysicalError(
                f"dn/dT of {self.name} is unknown; its glass needs `thermal: "
                "[D0, D1, D2, E0, E1, Lambda_TK]`, the first six numbers of TD in its AGF catalogue"
            )
        if self.expansion is not None:
            expansion, valid = self.expansion, CATALOGUE_RANGE
        else:
            assert solid is not None
            expansion, valid = solid.expansion, solid.known
        low, high = (max(valid.coldest, SCHOTT_RANGE.coldest), min(valid.hottest, SCHOTT_RANGE.hottest))
        source = valid.source if (low, high) == (valid.coldest, valid.hottest) else SCHOTT_RANGE.source
        known = TemperatureRange(low, high, source)
        return WarmGlass(self.name, expansion, known, self.index(wavelength, medium), wavelength, thermal)

    @staticmethod
    def _filled(coefficients: tuple[float, ...]) -> tuple[float, ...]:
        return (*coefficients, *[0.0] * (12 - len(coefficients)))


LensGlass = Annotated[LensGlassSpec, short_for("name", str)]
"""Glass as a mapping with its keys, or the name of a catalogue glass alone."""
