"""Files, numbers and report of an export."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

from twin.orbit.export.export_run import Export, ExportedLine
from twin.orbit.export.line_scanner import ModelError
from twin.orbit.export.rational_polynomial import RationalPolynomial
from twin.run.artefact import Cell, Table, significant
from twin.run.data_files import FrameFacts, tiff
from twin.run.plain_data import plain_data
from twin.run.report import Report, Section, one_sentence

FOLDER = "models"


@dataclass(frozen=True)
class PolynomialNumbers:
    """Agreement of rational polynomials with the rigorous sensor between the places that were fitted."""

    largest_line_px: float
    largest_sample_px: float
    rms_line_px: float
    rms_sample_px: float

    @classmethod
    def of(cls, model: RationalPolynomial) -> Self:
        """Of one line."""
        return cls(*model.error_px, *model.rms_px)


@dataclass(frozen=True)
class ExportedNumbers:
    """One line's image and its models; files are paths in the run folder, None for those that were not written."""

    lines: int
    pixels: int
    first_pixel: int
    first_line_time_s: float
    line_time_s: float
    image: str | None
    isd: str
    rpc: str | None
    isd_nodes: int
    isd_errors: Sequence[ModelError]
    rpc_errors: PolynomialNumbers | None
    rpc_refused: str | None

    @classmethod
    def of(cls, line: ExportedLine) -> Self:
        """Of one line."""
        window, polynomial = line.window, line.polynomial
        names = _names(line)
        return cls(
            lines=window.sensor.lines,
            pixels=window.pixels,
            first_pixel=window.first_pixel,
            first_line_time_s=window.sensor.first_line_time,
            line_time_s=window.sensor.line_time,
            image=names.get("image"),
            isd=names["isd"],
            rpc=names.get("rpc"),
            isd_nodes=len(line.scanner.camera.seconds),
            isd_errors=line.scanner.errors,
            rpc_errors=None if polynomial is None else PolynomialNumbers.of(polynomial),
            rpc_refused=line.refused or None,
        )


@dataclass(frozen=True)
class ExportNumbers:
    """What export.json holds."""

    epoch_utc: str
    truth: bool
    heights_m: Sequence[float]
    lines: Mapping[str, ExportedNumbers]


def export_numbers(run: Export) -> Mapping[str, Any]:
    """As plain data."""
    lines = {name: ExportedNumbers.of(line) for name, line in run.lines.items()}
    return dict(plain_data(ExportNumbers(run.epoch, run.truth, run.heights, lines)))


def _names(line: ExportedLine) -> dict[str, str]:
    """Files of a line."""
    stem = f"{FOLDER}/{line.window.name}"
    names = {"isd": f"{stem}.json"}
    if line.window.frame is not None:
        names["image"] = f"{stem}.tif"
    if line.polynomial is not None:
        names["rpc"] = f"{stem}_RPC.TXT"
    return names


def export_files(run: Export) -> dict[str, bytes]:
    """Path in the run folder -> contents: ISD and RPC of every line, and its image as a GeoTIFF with the RPC inside."""
    found = {}
    for line in run.lines.values():
        names = _names(line)
        found[names["isd"]] = (json.dumps(line.scanner.isd, allow_nan=False) + "\n").encode()
        if line.polynomial is not None:
            found[names["rpc"]] = line.polynomial.text().encode()
        if line.window.frame is not None:
            facts = FrameFacts(
                line.window.name, line.window.pitch, note=f"second 0 of its orbit is {run.epoch}", place=line.polynomial
            )
            found[names["image"]] = tiff(line.window.frame[None], facts)
    return found


_ROUGH = 0.1
"""Pixels: a model that is further off is worth a warning."""


def export_report(run: Export) -> Report:
    """What was written, and how well it agrees with the rigorous sensor."""
    isd = max((max(e.sample_px, e.line_px), name) for name, line in run.lines.items() for e in line.scanner.errors)
    rpc = [(max(line.polynomial.error_px), name) for name, line in run.lines.items() if line.polynomial is not None]
    low, _, high = run.heights
    images = sum(line.window.frame is not None for line in run.lines.values())
    verdict = one_sentence(
        f"{len(run.lines)} lines as community sensor models and rational polynomials"
        + (f", with {images} images" if images else ""),
        f"on ground {low:.0f} to {high:.0f} m high the sensor models are within {significant(isd[0], 2)} pixels of the "
        f"rigorous sensor ({isd[1]} is the worst)",
        f"the polynomials within {significant(max(rpc)[0], 2)} pixels ({max(rpc)[1]})"
        if rpc
        else "there are no polynomials",
    )
    rows: list[tuple[Cell, ...]] = []
    for name, line in run.lines.items():
        errors = {f"{e.height_m:.0f}": e for e in line.scanner.errors}
        polynomial = line.polynomial
        most = (None, None) if polynomial is None else (max(polynomial.error_px), max(polynomial.rms_px))
        rows.append((name, *(max(e.sample_px, e.line_px) for e in errors.values()), *most))
    heights = [f"ISD at {height:.0f} m [px]" for height in run.heights]
    summary = Table(
        "models",
        "Models against the rigorous sensor",
        "Largest difference over the image, of lines and samples the larger one; of the polynomials between the places "
        "that were fitted, over all heights.",
        ("line", *heights, "RPC largest [px]", "RPC rms [px]"),
        rows,
        digits=2,
    )
    known = "camera and orbit as they truly are" if run.truth else "the laboratory's camera on the measured orbit"
    facts = (
        ("Lines", known),
        ("Second 0 of the orbit", run.epoch),
        ("Ground", f"{low:.0f} to {high:.0f} m above the ellipsoid"),
        ("Read", "the run folder of a simulation" if run.source.folder is not None else "a test without images"),
    )
    return Report(
        "Line cameras for other software", verdict, (), facts, summary, _sections(run), warnings=_warnings(run)
    )


def _sections(run: Export) -> tuple[Section, ...]:
    rows: list[tuple[Cell, ...]] = []
    for name, line in run.lines.items():
        files = _names(line)
        window = line.window
        size = f"{window.sensor.lines} x {window.pixels}"
        rows.append((name, size, str(window.first_pixel), *(files.get(key, "") for key in ("image", "isd", "rpc"))))
    files_table = Table(
        "files",
        "Files",
        "Paths in this folder. Software that reads an image's rational polynomials finds them inside the TIFF, or in "
        "NAME_RPC.TXT beside it.",
        ("line", "lines x pixels", "first pixel", "image", "ISD", "RPC"),
        rows,
    )
    text = (
        "The community's line scanner model (ISD) interpolates station and attitude and knows nothing of what happens "
        "to the light: light time, aberration and refraction stand in the attitude and the distortion as they are at "
        "the middle height, and what they do at others is the difference in the table.",
        "Rational polynomials are smooth: what an attitude jitters from line to line is not in them.",
        "Sensor models count the corner of the image as 0, 0, polynomials the centre of its first pixel.",
    )
    return (Section("What was written", text, (files_table,)),)


def _warnings(run: Export) -> tuple[str, ...]:
    found = []
    for name, line in run.lines.items():
        if line.polynomial is None:
            found.append(f"{name} has no rational polynomials: {line.refused}")
        elif max(line.polynomial.error_px) > _ROUGH:
            found.append(
                f"the rational polynomials of {name} are off by up to {significant(max(line.polynomial.error_px), 2)} "
                "pixels, as attitude and orbit are not smooth; the ISD follows them"
            )
    return tuple(found)
