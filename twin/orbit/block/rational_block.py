"""Block of images that come with rational polynomials (RPC), and their corrected polynomials after the adjustment.

Line and sample of an image are corrected by a shift, a term that grows with the line (`drift`) and a term that grows
with the sample (`affine`), as unknowns with priors (Fraser and Hanley, Photogramm. Eng. Remote Sens. 69, 53 (2003);
Grodecki and Dial, ibid., 59). The terms have their full value at the border of the image, whose extent is that of its
file, or that of the polynomials' offsets and scales without one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from analysis.arrays import Array
from analysis.block import block as model
from analysis.block.block_adjustment import BlockAdjustment, intersected
from analysis.block.error_processes import BlockError
from analysis.orbit.rational_polynomial import RationalPolynomial, coefficient_rows
from optics.numerics.number_tree import FrozenMap
from scenes.specs.orbit.rational import RationalAdjustSpec, RationalImageSpec
from scenes.specs.orbit.setup import RationalAdjustSetup
from scenes.yaml.csv_table import Column, read_table
from scenes.yaml.errors import InputError, Issue, names_text, unknown
from twin.framework.procedure import Advance, BenchError, silent
from twin.orbit.export.rational_polynomial import PolynomialImage, axis_sigma, level_slopes, read_rpc, refitted
from twin.orbit.measured.ground_files import GroundFile, read_ground_points

_MANY = 1e9
"""Largest accepted absolute value of a line or sample, in pixels."""
IMAGE_POINTS = (
    Column("point", text=True),
    Column("image", text=True),
    Column("line", least=-_MANY, most=_MANY),
    Column("sample", least=-_MANY, most=_MANY),
    Column("line_sigma", least=1e-6, most=1e3),
    Column("sample_sigma", least=1e-6, most=1e3),
    Column("correlation", needed=False, least=-0.999999, most=0.999999),
)
"""Columns of the table of image points; line and sample are in pixels, the centre of the first pixel is 0, 0."""


def read_image(spec: RationalImageSpec) -> PolynomialImage:
    """Read the rational polynomials of an image, with the extent of the image where its file is known.

    Raises
    ------
    InputError
        A file cannot be read; with file, line and key.
    """
    polynomial = read_rpc(spec.rpc or spec.file or "")
    if spec.file is None:
        return PolynomialImage.of(polynomial)
    from twin.orbit.measured.maps import opened

    with opened(spec.file) as source:
        return PolynomialImage.of(polynomial, (source.height, source.width))


def rational_block(setup: RationalAdjustSetup, advance: Advance = silent) -> tuple[model.Block, Array]:
    """Return the block of images with rational polynomials, and the surveyed coordinates (m, 3) of its m points.

    The coordinates are in the ITRS, in metres, and NaN for tie points. Tie points start where the images without
    corrections intersect.

    Raises
    ------
    InputError
        A file cannot be used.
    BenchError
        Points cannot be intersected.
    """
    spec = setup.test
    images = {}
    for name, image in spec.images.items():
        images[name] = read_image(image)
        advance("read", len(images), len(spec.images))
    ground = None if spec.ground is None else read_ground_points(spec.ground, Path())
    ids, places = _image_points(spec, ground)
    if ground is not None and not (known := set(map(str, ground.points.ids))) & ids.keys():
        raise spec.error("no image point of these ground points", ("ground",), value=names_text(sorted(known)[:3]))
    points, surveyed = _points(ids, places, images, ground)
    scenes = tuple(
        model.ModelScene(name, image, FrozenMap((spec.images[name].errors or spec.errors).sigma), places[name])
        for name, image in images.items()
    )
    shared = tuple(
        model.SharedCorrection(tuple(group.images), FrozenMap(group.errors.sigma)) for group in spec.passes.values()
    )
    block = model.Block((), scenes, FrozenMap(), FrozenMap(), (), (), 1.0, points, shared=shared)
    try:
        # control points, whose coordinates may have gross errors, start from their images where two see them
        twice = np.bincount(np.concatenate([rays.point for rays in places.values()])).max(initial=0) > 1
        first = intersected(block.without("control") if twice else block)
    except BlockError as error:
        raise BenchError(str(error), ("image_points",), "points that two images see") from error
    start = np.where((points.role == "control")[:, None], points.start, first)
    return replace(block, points=replace(points, start=start, approximate=first)), surveyed


def _image_points(
    spec: RationalAdjustSpec, ground: GroundFile | None
) -> tuple[dict[str, int], dict[str, model.ImagePlaces]]:
    """Return the number of each point by its name, and the image points of each image.

    They are those of the table and those of a .gcp file, which names images as the block does or by their files.
    """
    ids: dict[str, int] = {}
    rows: dict[str, list[tuple[int, float, float, float, float, float]]] = {name: [] for name in spec.images}
    seen: set[tuple[str, str]] = set()
    if spec.image_points is not None:
        table = read_table(spec.image_points, IMAGE_POINTS)
        correlation = table["correlation"] if "correlation" in table else np.zeros(len(table))
        columns = (table[name] for name in ("line", "sample", "line_sigma", "sample_sigma"))
        for k, (point, image, *numbers) in enumerate(
            zip(table["point"].tolist(), table["image"].tolist(), *columns, correlation, strict=True)
        ):
            if image not in rows:
                raise table.error(k, "image", "no such image in the block", image, names_text(rows))
            if (point, image) in seen:
                raise table.error(k, "point", f"this point occurs twice in {image}", point, "each point once")
            seen.add((point, image))
            rows[image].append((ids.setdefault(point, len(ids)), *map(float, numbers)))  # type: ignore[arg-type]
    files = {Path(image.file).name: name for name, image in spec.images.items() if image.file is not None}
    for image, measured in ({} if ground is None else ground.images).items():
        name = image if image in rows else files.get(Path(image).name)
        if name is None:
            assert spec.ground is not None
            problem = unknown("no such image in the block", image, (*rows, *files))
            raise InputError(Issue(problem.problem, spec.ground.file, None, (), problem.value, problem.allowed))
        for number, line, sample, line_sigma, sample_sigma in measured.tolist():
            point = ids.setdefault(str(ground.points.ids[int(number)]), len(ids))  # type: ignore[union-attr]
            rows[name].append((point, line, sample, line_sigma, sample_sigma, 0.0))
    places = {}
    for name, of_image in rows.items():
        values = np.array(of_image, np.float64).reshape(-1, 6)
        sigma = values[:, 3:5]
        like = np.broadcast_to(np.eye(2), (len(values), 2, 2)).copy()
        like[:, 0, 1] = like[:, 1, 0] = values[:, 5]
        spread = sigma[:, :, None] * like * sigma[:, None, :]
        places[name] = model.ImagePlaces(values[:, 0].astype(np.intp), values[:, 1:3], spread)
    return ids, places


def _points(
    ids: Mapping[str, int],
    places: Mapping[str, model.ImagePlaces],
    images: Mapping[str, PolynomialImage],
    ground: GroundFile | None,
) -> tuple[model.Points, Array]:
    """Return the points with first coordinates, and the surveyed coordinates (m, 3), NaN for tie points.

    A tie point starts where the first image sees the middle height of its polynomials.
    """
    count = len(ids)
    start, surveyed = np.full((count, 3), np.nan), np.full((count, 3), np.nan)
    covariance, role = np.zeros((count, 3, 3)), np.full(count, "tie", object)
    for name, seen in places.items():
        new = ~np.isfinite(start[seen.point]).all(axis=1)
        start[seen.point[new]] = images[name].ground(seen.image[new], float(images[name].polynomial.offset[4]))
    for k, name in enumerate([] if ground is None else ground.points.ids.tolist()):
        if (at := ids.get(str(name))) is not None:
            assert ground is not None
            role[at], surveyed[at], covariance[at] = (
                ground.points.role[k],
                ground.points.itrs[k],
                ground.points.covariance[k],
            )
            start[at] = surveyed[at]
    lost = ~np.isfinite(start).all(axis=1)
    if np.any(lost):
        names = np.array(list(ids), object)[lost][:3].tolist()
        problem = f"{names_text(names)}: the polynomials see no ground at these positions"
        raise BenchError(problem, ("image_points",), "lines and samples of the images to which the polynomials belong")
    exact = (role == "control") & ~np.any(covariance, axis=(1, 2))
    covariance[exact] = 1e-6 * np.eye(3)
    return model.Points(np.array(list(ids), object), start, role, covariance), surveyed


@dataclass(frozen=True, eq=False)
class AdjustedImage:
    """Correction of an image by the adjustment, and its residuals.

    Attributes
    ----------
    terms : tuple of str
        Terms of the correction, K of them.
    value, sigma, before : (2, K) ndarray
        Coefficients for line and sample, their standard deviations, and those of their priors, in pixels.
    points : int
        Number of image points.
    rms_before, rms_after : (2,) ndarray
        Rms residuals of line and sample, in pixels: of points intersected without corrections, and after the
        adjustment, without rejected image points.
    polynomial : RationalPolynomial
        Polynomials that include the correction, with its error on the ground as ERR_BIAS.
    """

    terms: tuple[str, ...]
    value: Array
    sigma: Array
    before: Array
    points: int
    rms_before: Array
    rms_after: Array
    polynomial: RationalPolynomial


def adjusted_images(adjustment: BlockAdjustment) -> FrozenMap[str, AdjustedImage]:
    """Return the correction of every image of a block by rational polynomials; none for other scenes.

    Raises
    ------
    BlockError
        Corrected polynomials cannot be fitted.
    """
    block = adjustment.assembly.block
    if not block.model_scenes:
        return FrozenMap()
    without = intersected(block)
    images = {}
    for scene in block.model_scenes:
        change, covariance = adjustment.change(scene.name)
        value, sigma = (row.reshape(2, -1) for row in (change, np.sqrt(np.diag(covariance))))
        images[scene.name] = AdjustedImage(
            tuple(scene.sigma),
            value,
            sigma,
            block.correction_sigma(scene),
            len(scene.rays.point),
            *_residuals(adjustment, scene, value, without),
            _corrected(scene, value, covariance),
        )
    return FrozenMap(images)


def _residuals(
    adjustment: BlockAdjustment, scene: model.ModelScene, value: Array, without: Array
) -> tuple[Array, Array]:
    """Return rms residuals (2,) of an image's accepted points, without corrections and after the adjustment."""
    where = adjustment.assembly.images.get(scene.name)
    rays = scene.rays if where is None else scene.rays.taken(adjustment.weight[where] > 0.0)
    if not len(rays.point):
        return np.full(2, np.nan), np.full(2, np.nan)
    before = scene.model.seen(without[rays.point])[0] - rays.image
    position = scene.model.seen(adjustment.ground[rays.point])[0]
    after = position + scene.basis(position) @ value.T - rays.image
    return np.sqrt(np.mean(before**2, axis=0)), np.sqrt(np.mean(after**2, axis=0))


def _corrected(scene: model.ModelScene, value: Array, covariance: Array) -> RationalPolynomial:
    """Return the polynomials of an image with its correction; ERR_BIAS is the rms error of the correction per axis.

    ERR_RAND is that of the polynomials before, which the adjustment does not change.
    """
    image = scene.model
    assert isinstance(image, PolynomialImage)
    try:
        fitted = refitted(image, lambda line, sample: scene.basis(np.stack([line, sample], axis=-1)) @ value.T)
    except ValueError as error:
        raise BlockError(f"block: {scene.name}: {error}") from error
    position, to_ground = level_slopes(image)
    rows = coefficient_rows(scene.basis(position))
    spread = to_ground @ rows @ covariance @ np.swapaxes(rows, 1, 2) @ np.swapaxes(to_ground, 1, 2)
    return replace(fitted, bias_m=axis_sigma(spread), random_m=image.polynomial.random_m)
