"""The glass of a lens: a name of the catalogue, or a maker's dispersion formula."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, SerializerFunctionWrapHandler, model_serializer, model_validator

from optics.materials.dispersion import FORMULAS, CatalogueGlass
from optics.materials.glass import GLASSES, air_index, glass
from scenes.specs.spectrum import WavelengthRange
from scenes.yaml.errors import Problem, unknown
from scenes.yaml.spec import Number, Spec, Text, Whole, short_for

Medium = Literal["vacuum", "air"]


class LensGlassSpec(Spec):
    """A glass whose index is known by wavelength, at 20 C.

    Attributes:
        name: of the catalogue, or any name beside a formula.
        formula: number of the dispersion formula as AGF catalogues have it (1 Schott, 2 Sellmeier 1, ...).
        coefficients: of it, for micrometres, in the catalogue's order; for Sellmeier's B1, C1, B2, C2, B3, C3.
        range: wavelengths between which it holds, metres.
    """

    name: Text
    formula: Annotated[Whole, Field(ge=1, le=max(FORMULAS))] | None = None
    coefficients: Annotated[tuple[Number, ...], Field(min_length=1, max_length=12)] | None = None
    range: WavelengthRange | None = None

    @model_validator(mode="after")
    def _is_known(self) -> LensGlassSpec:
        given = [key for key in ("formula", "coefficients", "range") if getattr(self, key) is not None]
        if given and len(given) < 3:
            raise Problem("a glass of one's own has all of these", ", ".join(given), "formula, coefficients, range")
        if not given:
            try:
                glass(self.name)
            except KeyError:
                raise unknown("no such glass", self.name, GLASSES, within=("name",)) from None
        return self

    @model_serializer(mode="wrap")
    def _short(self, handler: SerializerFunctionWrapHandler) -> Any:
        """A glass of the catalogue is written as its name."""
        full = handler(self)
        return full if self.formula is not None else self.name

    def index(self, wavelength: float, medium: Medium) -> float:
        """Refractive index at 20 C.

        Args:
            wavelength: metres.
            medium: what the index is against: ``air`` of 20 C and 1013 hPa, as makers state it, or ``vacuum``.

        Raises:
            ValueError: the formula does not hold at that wavelength.
        """
        if self.formula is None or self.coefficients is None or self.range is None:
            own = glass(self.name)
            return own.index(wavelength) if medium == "air" else own.vacuum_index(wavelength)
        n = CatalogueGlass(self.name, self.formula, self._filled(self.coefficients), *self.range)(wavelength)
        return n if medium == "air" else n * air_index(wavelength)

    @staticmethod
    def _filled(coefficients: tuple[float, ...]) -> tuple[float, ...]:
        return (*coefficients, *[0.0] * (12 - len(coefficients)))


LensGlass = Annotated[LensGlassSpec, short_for("name", str)]
"""With its keys, or the name of the catalogue alone."""
