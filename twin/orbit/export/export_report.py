"""Files, quantities and report of an export."""

from __future__ import annotations

import json

from twin.orbit.export.estimated_change import GroundSigma
from twin.orbit.export.export_run import Export, ExportedLine, SceneSource
from twin.orbit.export.line_scanner import ModelError
from twin.orbit.export.quality_sections import (
    ACCURACY,
    CONTROL,
    PRODUCT,
    quality_answers,
    quality_sections,
    quality_warnings,
)
from twin.orbit.export.rational_polynomial import RationalPolynomial
from twin.run.artefact import Cell, Table, significant
from twin.run.data_files import FrameFacts, tiff
from twin.run.quantity import Quantity, Record
from twin.run.report import Report, Section, answer

FOLDER = "models"


def _names(line: ExportedLine) -> dict[str, str]:
    """What is written of a line -> its path in the run folder."""
    stem = f"{FOLDER}/{line.window.name}"
    names = {"isd": f"{stem}.json"}
    if line.window.frame is not None:
        names["image"] = f"{stem}.tif"
    if line.polynomial is not None:
        names["rpc"] = f"{stem}_RPC.TXT"
    return names


ISD_ERROR: Record[ModelError] = Record(
    "How far the community sensor model is from the rigorous sensor at one height, the largest over the image.",
    Quantity("height_m", lambda one: one.height_m, "above the ellipsoid"),
    Quantity("sample_px", lambda one: one.sample_px, "along the line"),
    Quantity("line_px", lambda one: one.line_px, "along the track"),
)
RPC_ERROR: Record[RationalPolynomial] = Record(
    "How far the polynomials are from the rigorous sensor between the places that were fitted.",
    Quantity("largest_line_px", lambda model: model.error_px[0], "largest difference along the track"),
    Quantity("largest_sample_px", lambda model: model.error_px[1], "largest difference along the line"),
    Quantity("rms_line_px", lambda model: model.rms_px[0], "root mean square along the track"),
    Quantity("rms_sample_px", lambda model: model.rms_px[1], "root mean square along the line"),
)
GROUND: Record[GroundSigma] = Record(
    "What the error of the camera's estimated change is on the ground, root mean square over the image.",
    Quantity("height_m", lambda one: one.height_m, "of the ground above the ellipsoid"),
    Quantity("err_bias_m", lambda one: one.bias_m, "ERR_BIAS: of each horizontal axis, in common with other images"),
    Quantity("err_rand_m", lambda one: one.random_m, "ERR_RAND: of each horizontal axis, another in every image"),
    Quantity("bias_east_m", lambda one: one.bias_east_m, "the same to the east"),
    Quantity("bias_north_m", lambda one: one.bias_north_m, "the same to the north"),
    Quantity("random_east_m", lambda one: one.random_east_m, "the random part to the east"),
    Quantity("random_north_m", lambda one: one.random_north_m, "the random part to the north"),
)
LINE: Record[ExportedLine] = Record(
    "One line's image and its models; files are paths in the run folder, None for those that were not written.",
    Quantity("lines", lambda line: line.window.sensor.lines, "how many"),
    Quantity("pixels", lambda line: line.window.pixels, "how many"),
    Quantity("first_pixel", lambda line: line.window.first_pixel, "of the image on the line"),
    Quantity("first_line_time_s", lambda line: line.window.sensor.first_line_time, "from the epoch"),
    Quantity("line_time_s", lambda line: line.window.sensor.line_time, "from one line to the next"),
    Quantity("image", lambda line: _names(line).get("image"), "GeoTIFF with the polynomials inside"),
    Quantity("isd", lambda line: _names(line)["isd"], "image support data of the community sensor model"),
    Quantity("rpc", lambda line: _names(line).get("rpc"), "rational polynomials"),
    Quantity("isd_nodes", lambda line: len(line.scanner.camera.seconds), "times at which station and attitude stand"),
    Quantity("isd_errors", lambda line: line.scanner.errors, "at every height", record=ISD_ERROR),
    Quantity("rpc_errors", lambda line: line.polynomial, "over all heights", record=RPC_ERROR),
    Quantity("rpc_refused", lambda line: line.refused or None, "why there are no polynomials"),
    Quantity(
        "ground",
        lambda line: line.ground,
        "what is uncertain of the camera's estimated change, where one was estimated",
        record=GROUND,
        where_known=True,
    ),
)
EXPORT: Record[Export] = Record(
    "export.json. Line cameras for other software.",
    Quantity("epoch_utc", lambda run: run.epoch, "second 0 of the orbit"),
    Quantity("truth", lambda run: run.truth, "whether camera and orbit are the true ones"),
    Quantity("heights_m", lambda run: run.heights, "of the ground that models were fitted to: lowest, middle, highest"),
    Quantity("lines", lambda run: run.lines, "every line and its models", record=LINE),
    Quantity(
        "accuracy",
        lambda run: (run.quality and run.quality.maps) or None,
        "line, or `together` for points that all lines intersect: errors on the ground, where they were asked for",
        record=ACCURACY,
        where_known=True,
    ),
    Quantity(
        "control",
        lambda run: (run.quality and run.quality.control) or None,
        "line: how control points corrected its polynomials, where there are some",
        record=CONTROL,
        where_known=True,
    ),
    Quantity(
        "product_rpc",
        lambda run: (run.quality and run.quality.products) or None,
        "line: the polynomials that came with a scene, where there are some",
        record=PRODUCT,
        where_known=True,
    ),
)


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
            found[names["image"]] = bytes(tiff(line.window.frame[None], facts))
    return found


_ROUGH = 0.1
"""Pixels: a model that is further off is worth a warning."""


def export_report(run: Export) -> Report:
    """What was written, and how well it agrees with the rigorous sensor."""
    isd = max((max(e.sample_px, e.line_px), name) for name, line in run.lines.items() for e in line.scanner.errors)
    rpc = [(max(line.polynomial.error_px), name) for name, line in run.lines.items() if line.polynomial is not None]
    low, _, high = run.heights
    images = sum(line.window.frame is not None for line in run.lines.values())
    verdict, more = answer(
        f"The folder has {len(run.lines)} lines as community sensor models and rational polynomials"
        + (f", with {images} images" if images else ""),
        f"on ground {low:.0f} to {high:.0f} m high the sensor models are within {significant(isd[0], 2)} pixels of the "
        f"rigorous sensor ({isd[1]} is the worst)",
        f"the polynomials are within {significant(max(rpc)[0], 2)} pixels ({max(rpc)[1]})"
        if rpc
        else "there are no polynomials",
        *quality_answers(run.quality),
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
    if isinstance(run.source, SceneSource):
        refracted = run.source.scene.read.refracted
        known = f"the rigorous model of the file, {'with' if refracted else 'without'} refraction"
    facts = (
        ("Lines", known),
        ("Second 0 of the orbit", run.epoch),
        ("Ground", f"{low:.0f} to {high:.0f} m above the ellipsoid"),
        ("Read", _read(run)),
    )
    return Report(
        "Line cameras for other software",
        verdict,
        more,
        facts,
        summary,
        (*_sections(run), *quality_sections(run)),
        warnings=(*_warnings(run), *quality_warnings(run.quality)),
    )


def _read(run: Export) -> str:
    if isinstance(run.source, SceneSource):
        read = run.source.scene.read
        return f"{read.profile} {read.name}, DIMAP {read.version}"
    return "the run folder of a simulation" if run.source.folder is not None else "a test without images"


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
    if isinstance(run.source, SceneSource) and run.source.scene.read.inertial_velocity:
        found.append(
            "the file's velocities are against the stars, in Earth-fixed axes: omega x P has been taken off them"
        )
    if isinstance(run.source, SceneSource) and run.source.scene.read.light_speed:
        found.append(
            "the file's LIGHT_SPEED_SETTING is true: light time and aberration are not in the model, up to 13 m along "
            "the track; compare it with the product's own polynomials"
        )
    for name, line in run.lines.items():
        if line.polynomial is None:
            found.append(f"{name} has no rational polynomials: {line.refused}")
        elif max(line.polynomial.error_px) > _ROUGH:
            found.append(
                f"the rational polynomials of {name} are off by up to {significant(max(line.polynomial.error_px), 2)} "
                "pixels, as attitude and orbit are not smooth; the ISD follows them"
            )
    return tuple(found)
