"""Zernike coefficients of measured wavefronts from files, converted to the program's orientation."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from analysis.arrays import MeasurementError
from analysis.wavefront_maps.map_files import MapError, WavefrontMap, read_map
from analysis.wavefront_maps.pupil_fit import Orientation, fit_wavefront_map
from analysis.wavefront_maps.zernike_table import read_zernikes
from scenes.yaml.errors import InputError
from twin.camera.varied_beams import VariedBeams

TABLES = (".csv", ".tsv")
"""Suffixes of the files that are tables of Zernike coefficients; all other files are wavefront maps."""


class WavefrontMeasurement(Protocol):
    """Interface of a measurement that refers to files of wavefronts.

    Attributes
    ----------
    spec : Spec
        Specification of the measurement in the test.
    beams : VariedBeams
        Beams of its fields.
    """

    spec: Any
    beams: VariedBeams

    def file(self, key: str, value: str, description: str) -> Path:
        """Return the path of a file given under a key; raise InputError if it does not exist."""

    def wrong(self, text: str, key: str, allowed: str | None = None, value: str | None = None) -> InputError:
        """Return an InputError whose position is a key of the measurement in the file."""


def specified_orientation(measurement: WavefrontMeasurement) -> Orientation:
    """Return the specified orientation of maps and coefficients; raise InputError if its name is unknown."""
    try:
        return Orientation.named(measurement.spec.orientation, measurement.spec.sign)
    except ValueError as error:
        raise measurement.wrong(str(error), "orientation", value=measurement.spec.orientation) from error


def read_coefficients(measurement: WavefrontMeasurement, orientation: Orientation | None = None) -> np.ndarray:
    """Return the Zernike terms of every field, (F, T), metres rms of the wavefront in single pass.

    Array dimensions: F fields, T Zernike terms.

    Parameters
    ----------
    measurement : WavefrontMeasurement
        The measurement.
    orientation : Orientation, optional
        Orientation of its files; the specified one by default.

    Raises
    ------
    InputError
        A file holds no wavefront, or has other fields or terms than specified, or too small an illuminated area.
    """
    recorded = specified_orientation(measurement) if orientation is None else orientation
    spec, terms = measurement.spec, tuple(measurement.spec.numbers)

    def rotated(table: np.ndarray) -> np.ndarray:
        try:
            return recorded.coefficients(table, terms)
        except MapError as error:
            raise measurement.wrong(str(error), "terms") from error

    if spec.zernikes is not None:
        table = rotated(_of_table(measurement, "zernikes", spec.zernikes, len(spec.fields)))
    else:
        table = np.stack([_of_map(measurement, k, name, recorded) for k, name in enumerate(spec.maps)])
    if spec.reference is not None and Path(spec.reference).suffix.lower() in TABLES:
        table = table - rotated(_of_table(measurement, "reference", spec.reference, 1))
    return np.asarray(table * (0.5 if spec.double_pass else 1.0))


def _of_table(measurement: WavefrontMeasurement, key: str, name: str, fields: int) -> np.ndarray:
    path = measurement.file(key, name, "a CSV file of coefficients")
    try:
        coefficients = read_zernikes(path, wavelength=measurement.beams.wavelength)
    except MeasurementError as error:
        raise measurement.wrong(str(error), key) from error
    wanted = tuple(measurement.spec.numbers)
    missing = [f"Z{j}" for j in wanted if j not in coefficients.terms]
    if missing:
        allowed = f"Z{coefficients.terms[0]} to Z{coefficients.terms[-1]} which the table has"
        raise measurement.wrong(f"the table has no {', '.join(missing[:4])}", key, allowed, str(path))
    if len(coefficients.coefficients) != fields:
        text = f"{len(coefficients.coefficients)} wavefronts in the table, {fields} fields in the test"
        raise measurement.wrong(text, key, "one row for each field, in their order", str(path))
    return np.asarray(coefficients.coefficients[:, [coefficients.terms.index(j) for j in wanted]])


def _of_map(measurement: WavefrontMeasurement, number: int, name: str, orientation: Orientation) -> np.ndarray:
    spec = measurement.spec
    path = measurement.file("maps", name, "a file of a wavefront")
    try:
        measured = read_map(path, wavelength=measurement.beams.wavelength)
        if spec.reference is not None and Path(spec.reference).suffix.lower() not in TABLES:
            measured = _less(measured, read_map(measurement.file("reference", spec.reference, "a map")), measurement)
        last = spec.numbers[-1]
        fitted = fit_wavefront_map(orientation.apply(measured).values, tuple(range(1, last + 1)))
    except MeasurementError as error:
        raise measurement.wrong(f"map {number + 1}: {error}", "maps") from error
    return np.asarray(fitted.parts[spec.numbers[0] - 1 :])


def _less(measured: WavefrontMap, reference: WavefrontMap, measurement: WavefrontMeasurement) -> WavefrontMap:
    """Return a measured wavefront map minus the error map of the interferometer's reference surface."""
    if measured.values.shape != reference.values.shape:
        shapes = f"{reference.values.shape} points, the maps {measured.values.shape}"
        raise measurement.wrong(
            "the reference has another number of points than the maps", "reference", "the same", shapes
        )
    return replace(measured, values=measured.values - reference.values)
