"""Spectrum of a camera's light: signal by wavelength, and the radiance of a black body."""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field, SerializerFunctionWrapHandler, model_serializer, model_validator

from optics.numerics.quadrature import gauss, gauss_of
from scenes.yaml.csv_table import Column, read_table
from scenes.yaml.errors import KeyPath, Problem
from scenes.yaml.spec import Number, Reference, Spec, require_one, short_for
from scenes.yaml.unit_fields import Quantity, Vector, Wavelength
from scenes.yaml.units import LENGTH, TEMPERATURE, format_quantity


def black_body_photons(wavelength: np.ndarray, temperature: float) -> np.ndarray:
    """Return the spectral photon radiance of a black body by Planck's law.

    Parameters
    ----------
    wavelength : np.ndarray
        Wavelengths in metres, of any shape.
    temperature : float
        Temperature in kelvin.

    Returns
    -------
    np.ndarray
        Photons/(s m^2 sr m), of the wavelength's shape.
    """
    # imported here because scipy's table of constants would delay every message about a file
    from scipy import constants

    x = constants.h * constants.c / (wavelength * constants.k * temperature)
    return np.asarray(2.0 * constants.c / wavelength**4 / np.expm1(x))


WavelengthRange = Annotated[tuple[float, float], Vector(Quantity(LENGTH, smallest="100 nm", largest="100 um"), 2)]
"""Shortest and longest wavelength, in metres."""

MOST_LINES = 100
MOST_SAMPLES = 20_000

_PIECES, _NODES, _LEAST_POINTS = 64, 8, 512
"""Numbers of the fine rule that represents a whole spectrum: intervals of an evenly distributed band with the light of
a black body; smallest number of Gauss nodes on each interval of a curve, over which Planck's law is a polynomial to
rounding; and smallest number of nodes on all intervals together, far more than the rules for results have.
"""


class SpectrumSpec(Spec):
    """Spectrum: relative signal, counted in photons, by wavelength.

    The source has the same spectrum everywhere. ``weights`` and a table's response are signal per photon (transmission
    times quantum efficiency), and a black body emits photons. Only ratios matter.

    Attributes
    ----------
    between : tuple[float, float] | None
        Shortest and longest wavelength of light that is evenly distributed between them, in metres.
    wavelengths : tuple[float, ...] | None
        Wavelengths of spectral lines, ascending, in metres.
    weights : tuple[float, ...] | None
        Relative signal of each line; by default all are equal.
    table : str | None
        CSV file with the columns `wavelength` (with unit) and `response`; a path relative to this file. The response is
        linear between its rows and zero beyond them.
    curve : tuple[tuple[float, float], ...] | None
        Content of the table, filled in by the program when it is read; the table's file is then not needed.
    black_body : float | None
        Temperature of a black body as the source for the band or the table, in kelvin; by default the photon flux is
        the same at all wavelengths.
    """

    between: WavelengthRange | None = None
    wavelengths: Annotated[tuple[Wavelength, ...], Field(min_length=1, max_length=MOST_LINES)] | None = None
    weights: tuple[Annotated[Number, Field(ge=0.0)], ...] | None = None
    table: Reference | None = None
    curve: Annotated[tuple[tuple[Wavelength, Number], ...], Field(min_length=2, max_length=MOST_SAMPLES)] | None = None
    black_body: Annotated[float, Quantity(TEMPERATURE, above_zero=True, largest="100000 K")] | None = None

    @model_validator(mode="after")
    def _one_form(self) -> SpectrumSpec:
        curve_key = "table" if self.table is not None else "curve"
        allowed = "between, wavelengths or table"
        require_one(
            self, ("between", "wavelengths", curve_key), "the spectrum must be given in exactly one way", allowed
        )
        if self.weights is not None and len(self.weights) != len(self.wavelengths or ()):
            problem, value = ("not one weight for each wavelength", f"{len(self.weights)} weights")
            raise Problem(problem, value, f"{len(self.wavelengths or ())} of them", within=("weights",))
        if self.weights is not None and not any(self.weights):
            raise Problem("all weights are zero", None, "one above zero", within=("weights",))
        if self.black_body is not None and self.wavelengths is not None:
            raise Problem(
                "lines have weights in place of a black body", "black_body", "no black_body", within=("black_body",)
            )
        return self

    @model_validator(mode="after")
    def _ascends(self) -> SpectrumSpec:
        if self.between is not None and not self.between[0] <= self.between[1]:
            value = f"[{', '.join(format_quantity(w, LENGTH) for w in self.between)}]"
            raise Problem("the spectrum's wavelengths are in the wrong order", value, "[shortest, longest]")
        for name, values in (("wavelengths", self.wavelengths), ("curve", tuple(w for w, _ in self.curve or ()))):
            descending = next((k for k, (a, b) in enumerate(pairwise(values or ()), 1) if not a < b), None)
            if descending is not None:
                raise Problem("the wavelengths do not ascend", None, "ascending wavelengths", within=(name, descending))
        if self.curve is not None and not (all(r >= 0.0 for _, r in self.curve) and any(r for _, r in self.curve)):
            raise Problem("the response is negative, or zero everywhere", None, "a response", within=("curve",))
        return self

    @model_serializer(mode="wrap")
    def _short(self, handler: SerializerFunctionWrapHandler) -> Any:
        """Return the spectrum in the form of a file; an evenly distributed band as its two wavelengths."""
        full = handler(self)
        return full["between"] if self.between is not None and self.black_body is None else full

    @classmethod
    def evenly(cls, first: float, last: float) -> SpectrumSpec:
        """Return the spectrum of light evenly distributed between two wavelengths, in metres."""
        return cls.model_construct(between=(first, last))

    @property
    def ends(self) -> tuple[float, float]:
        """Shortest and longest wavelength with signal, in metres."""
        if self.between is not None:
            return self.between
        if self.wavelengths is not None:
            points, _ = _parts(self)
        else:
            points, _ = _corners(self)
        return float(points[0]), float(points[-1])

    @property
    def lines(self) -> bool:
        """True if the spectrum consists of discrete lines, for which a mean over the light is an exact sum."""
        return self.wavelengths is not None

    @property
    def mean(self) -> float:
        """Mean wavelength of the signal, in metres."""
        points, weights = self.rule(2)
        return float(points @ weights)

    def rule(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Return wavelengths and weights of a quadrature rule for means over the signal.

        It is the Gauss rule of this spectrum: the mean of a function of the wavelength is exact if it is a polynomial
        of degree below 2 ``count``, for any response. For lines, all of them are returned instead of a rule.

        Parameters
        ----------
        count : int
            Number of wavelengths.

        Returns
        -------
        tuple[np.ndarray, np.ndarray]
            K wavelengths, (K,), in metres, and K weights, (K,), that sum to 1.

        Raises
        ------
        ValueError
            The table has not been read.
        """
        if self.between is not None and self.black_body is None:
            first, last = self.between
            node, weight = gauss(count if last > first else 1)
            return 0.5 * (first + last) + 0.5 * (last - first) * node, 0.5 * weight
        points, weights = _parts(self)
        if not self.lines:
            points, weights = gauss_of(points, weights, count)
        return points, weights / np.sum(weights)

    def even(self, count: int) -> np.ndarray:
        """Return (count,) evenly spaced wavelengths from shortest to longest, in metres; for lines all of them."""
        if self.wavelengths is not None:
            return np.array(self.wavelengths)
        first, last = self.ends
        return np.linspace(first, last, count) if last > first else np.array([first])

    def read(self, owner: Spec, key: KeyPath) -> SpectrumSpec:
        """Return the spectrum with the curve of its table.

        Parameters
        ----------
        owner : Spec
            Specification whose file refers to the table.
        key : KeyPath
            Key of this spectrum in the owner.

        Raises
        ------
        InputError
            The table is missing or invalid.
        """
        if self.table is None or self.curve is not None:
            return self
        folder = Path(owner.source.file).parent
        path = owner.file_at((*key, "table"), self.table, folder, "a CSV file")
        columns = (Column("wavelength", LENGTH, least=100e-9, most=100e-6), Column("response", least=0.0))
        table = read_table(path, columns, least_rows=2)
        if len(table) > MOST_SAMPLES:
            raise owner.error(
                "the table has too many rows", (*key, "table"), value=len(table), allowed=f"at most {MOST_SAMPLES}"
            )
        wavelengths, response = table["wavelength"], table["response"]
        descending = np.flatnonzero(np.diff(wavelengths) <= 0.0)
        if len(descending):
            raise table.error(int(descending[0]) + 1, "wavelength", "the wavelengths do not ascend")
        if not np.any(response > 0.0):
            raise table.error(0, "response", "no response at any wavelength")
        # remove the rounding error of the conversion to metres
        curve = tuple((float(f"{w:.12g}"), float(r)) for w, r in zip(wavelengths, response, strict=True))
        return self.model_copy(update={"curve": curve})


@lru_cache(maxsize=64)
def _parts(spectrum: SpectrumSpec) -> tuple[np.ndarray, np.ndarray]:
    """Return wavelengths with signal, in metres, and their weights, fine enough for the whole spectrum."""
    if spectrum.wavelengths is not None:
        weights = np.ones(len(spectrum.wavelengths)) if spectrum.weights is None else np.array(spectrum.weights)
        return np.array(spectrum.wavelengths)[weights > 0.0], weights[weights > 0.0]
    corners, response = _corners(spectrum)
    if corners[0] == corners[-1]:
        return corners[:1], np.ones(1)
    node, weight = gauss(max(_NODES, -(-_LEAST_POINTS // (len(corners) - 1))))
    step = np.diff(corners)[:, None]
    points = (corners[:-1, None] + 0.5 * step * (node + 1.0)).ravel()
    weights = (0.5 * step * weight).ravel() * np.interp(points, corners, response)
    if spectrum.black_body is not None:
        weights = weights * black_body_photons(points, spectrum.black_body)
    return points[weights > 0.0], weights[weights > 0.0]


def _corners(spectrum: SpectrumSpec) -> tuple[np.ndarray, np.ndarray]:
    """Return the wavelengths, in metres, between which the response is linear, and the response at them."""
    if spectrum.between is not None:
        corners = np.linspace(*spectrum.between, _PIECES + 1)
        return corners, np.ones_like(corners)
    if spectrum.curve is None:
        raise ValueError(f"the table {spectrum.table} has not been read")
    corners, response = np.array(spectrum.curve).T
    signal = np.flatnonzero(response > 0.0)
    used = slice(max(int(signal[0]) - 1, 0), int(signal[-1]) + 2)
    return corners[used], response[used]


Spectrum = Annotated[SpectrumSpec, short_for("between", list, tuple)]
"""Spectrum as a mapping with its keys, or the shortest and the longest wavelength alone."""
