"""Files of ``python -m twin.orbit adjust --export``: adjusted points, corrected polynomials and their covariance.

corrections.json has the joint covariance of the corrections of all images by rational polynomials: images of a block
without control may all be shifted alike, so that the errors of two images must not be taken as independent.
"""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np

from analysis.block.assembly import correction_names
from analysis.orbit.forward_intersection import level_axes
from scenes.specs.orbit.setup import RationalAdjustSetup
from twin.orbit.block.block_run import BlockRun
from twin.orbit.block.rational_block import AdjustedImage
from twin.orbit.flight.earth import Earth
from twin.orbit.measured.measurement_tables import csv_text

_MOST_JOINT = 1000
"""Largest number of unknowns whose joint covariance is written, 1e6 numbers; beyond, each image has its own only."""
_COPIED = 2e9
"""Largest size of all images together that are copied with corrected tags, in bytes."""


def exported(run: BlockRun) -> dict[str, str | bytes]:
    """Return the files of an adjusted block, path -> content.

    points.csv has the points with their covariances. A block of images with rational polynomials also has
    NAME_RPC.TXT of each image, NAME.tif where the image has RPCCoefficientTag, and corrections.json.
    """
    files: dict[str, str | bytes] = {"points.csv": csv_text(_points(run))}
    if not isinstance(run.setup, RationalAdjustSetup):
        return files
    files |= {f"{name}_RPC.TXT": image.polynomial.text() for name, image in run.images.items()}
    files["corrections.json"] = json.dumps(corrections(run), indent=1) + "\n"
    sources = {name: image.file for name, image in run.setup.test.images.items() if image.file is not None}
    if sum(Path(file).stat().st_size for file in sources.values()) <= _COPIED:
        copies = {f"{name}.tif": _retagged(file, run.images[name]) for name, file in sources.items()}
        files |= {name: content for name, content in copies.items() if content is not None}
    return files


def _points(run: BlockRun) -> dict[str, Any]:
    """Return the columns of the table of adjusted points: geodetic coordinates with sigmas, and the ITRS covariance.

    `sigma_up_relative` is the sigma of a point's height relative to the mean height of all points of the table.
    """
    adjustment = run.adjustment
    points = adjustment.assembly.block.points
    where = np.flatnonzero(np.isfinite(adjustment.ground).all(axis=1))
    ground, covariance = adjustment.ground[where], adjustment.point_covariance(where)
    axes = level_axes(ground)
    sigma = np.sqrt(np.einsum("nij,njk,nik->ni", axes, covariance, axes))
    longitude, latitude, height = Earth().geodetic(ground)
    columns: dict[str, Any] = {
        "point": points.ids[where],
        "role": points.role[where],
        "longitude [deg]": np.degrees(longitude),
        "latitude [deg]": np.degrees(latitude),
        "height [m]": height,
    }
    columns |= {f"sigma_{axis} [m]": sigma[:, k] for k, axis in enumerate(("east", "north", "up"))}
    columns["sigma_up_relative [m]"] = run.relative_height_sigma
    columns |= {f"{axis} [m]": ground[:, k] for k, axis in enumerate("xyz")}
    pairs = ((i, j) for i in range(3) for j in range(i, 3))
    return columns | {f"covariance_{'xyz'[i]}{'xyz'[j]} [m^2]": covariance[:, i, j] for i, j in pairs}


def corrections(run: BlockRun) -> dict[str, Any]:
    """Return the corrections of all images with their joint covariance, as plain data.

    The position of a ground point in an image is p + c(p), with p the position by the polynomials before the
    adjustment; for line and for sample, c = shift + drift (line - middle) / size + affine (sample - middle) / size.
    """
    adjustment, images = run.adjustment, {}
    for scene in adjustment.assembly.block.model_scenes:
        value, covariance = adjustment.change(scene.name)
        images[scene.name] = {
            "middle_px": scene.model.middle.tolist(),
            "size_px": scene.model.size.tolist(),
            "unknowns": list(correction_names(scene)),
            "value_px": value.tolist(),
            "covariance_px2": covariance.tolist(),
        }
    _, joint = adjustment.change(*images)
    return {
        "meaning": "position = p + shift + drift (line - middle) / size + affine (sample - middle) / size, for line and"
        " for sample, with p, line and sample by the polynomials before the adjustment; the centre of the first pixel"
        " is 0, 0",
        "images": images,
        "joint_unknowns": [f"{name} {unknown}" for name, image in images.items() for unknown in image["unknowns"]],
        "joint_covariance_px2": joint.tolist() if len(joint) <= _MOST_JOINT else None,
    }


def _retagged(file: str, image: AdjustedImage) -> bytes | None:
    """Return a copy of an image whose RPCCoefficientTag has the corrected polynomials; None if it has no such tag."""
    import tifffile

    ((code, _, _, values, _),) = image.polynomial.tags()
    copy = io.BytesIO(Path(file).read_bytes())
    with tifffile.TiffFile(copy, mode="r+b") as content:
        tag = content.pages[0].tags.get(code)
        if tag is None or tag.count != len(values):
            return None
        tag.overwrite(values)
    return copy.getvalue()
