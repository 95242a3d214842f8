"""What is told of the worth of exported models: their errors on the ground by what is uncertain of camera and way, how
control points correct the polynomials, and how a product's own polynomials agree with its rigorous model.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from analysis.orbit.image_correction import Kind
from scenes.specs.measured.pass_files import GroundFileSpec
from scenes.yaml.errors import InputError, Issue
from twin.orbit.export.ground_accuracy import AccuracyMap, CameraUncertainty
from twin.orbit.export.polynomial_control import ControlledPolynomial
from twin.orbit.measured.ground_files import GroundFile, read_ground_points
from twin.orbit.measured.text_file import text_lines


@dataclass(frozen=True, eq=False)
class ControlPoints:
    """Control points with their places in images.

    Attributes:
        file: that they are from.
        read: what it holds; places count from the centre of the first pixel.
        kind: of the correction that they determine.
    """

    file: str
    read: GroundFile
    kind: Kind


@dataclass(frozen=True, eq=False)
class Wishes:
    """What is asked for beside the models.

    Attributes:
        uncertainty: of camera and way; None for no map.
        control: points that correct the polynomials; None for none.
    """

    uncertainty: CameraUncertainty | None = None
    control: ControlPoints | None = None


@dataclass(frozen=True, eq=False)
class Controlled:
    """A line's polynomials after control.

    Attributes:
        names: (N,) of the points.
        polynomial: before, after, and what is between.
    """

    names: NDArray[np.object_]
    polynomial: ControlledPolynomial


@dataclass(frozen=True)
class ProductPolynomial:
    """Rational polynomials that came with a product, against its rigorous model, over the image and the heights that
    the polynomials cover; polynomials minus rigorous.

    Attributes:
        file: where they are from.
        mean_line, mean_sample: mean difference, pixels.
        rms_line, rms_sample: root mean square about the mean, pixels.
        most: largest of all differences, pixels.
        heights: lowest and highest ground that the polynomials cover, metres.
    """

    file: str
    mean_line: float
    mean_sample: float
    rms_line: float
    rms_sample: float
    most: float
    heights: tuple[float, float]


@dataclass(frozen=True, eq=False)
class Quality:
    """What the models of an export are worth.

    Attributes:
        maps: line, or `together` for points that all lines intersect -> errors on the ground; empty where nobody asked.
        control: line -> how control points corrected its polynomials.
        products: line -> polynomials that came with it.
    """

    maps: Mapping[str, AccuracyMap]
    control: Mapping[str, Controlled]
    products: Mapping[str, ProductPolynomial]


def read_control(path: Path, kind: Kind) -> ControlPoints:
    """Control points of a .gcp file of the Ames Stereo Pipeline.

    Args:
        path: of it; without a header `# WKT:` its latitudes and longitudes are those of WGS 84, heights above it.
        kind: of the correction.

    Raises:
        InputError: it cannot be read, or has no places in images.
    """
    if path.suffix.lower() != ".gcp":
        raise InputError(Issue("not a .gcp file", str(path), allowed="control points with places in images, .gcp"))
    stated = any("WKT:" in line for line in text_lines(path, "a .gcp file") if line.lstrip().startswith("#"))
    spec = GroundFileSpec(file=str(path), crs=None if stated else "EPSG:4979")
    found = read_ground_points(spec, Path())
    if not found.images:
        allowed = "after the sigmas of each point: image, column, row, two sigmas"
        raise InputError(Issue("control points without places in images", str(path), allowed=allowed))
    return ControlPoints(str(path), found, kind)
