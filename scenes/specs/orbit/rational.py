"""Images that come with rational polynomials (RPC): their adjustment as a block, and tie points between them."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from scenes.specs.orbit.measurements import GroundFileSpec
from scenes.specs.orbit.scene import LEAST_TEMPLATE, _is_odd
from scenes.yaml.errors import Problem, unknown
from scenes.yaml.spec import Flag, Name, Named, Number, Reference, Spec, TitledSpec, Whole, not_empty
from scenes.yaml.unit_fields import Quantity, Vector
from scenes.yaml.units import DISTANCE

Pixels = Annotated[Number, Field(gt=0.0, le=1e4)]
PixelSigmas = tuple[Pixels, Pixels]
HeightRange = Annotated[tuple[float, float], Vector(Quantity(DISTANCE, largest="10 km"), 2)]


class CorrectionSpec(Spec):
    """Correction of line and sample of an image: standard deviations [line, sample] before the adjustment, in pixels.

    Attributes
    ----------
    shift : tuple[float, float]
        Constant of the whole image.
    drift : tuple[float, float] | None
        Term that grows with the line: its value at the image's first and last line. By default there is none.
    affine : tuple[float, float] | None
        Term that grows with the sample: its value at the image's first and last sample; with `shift` and `drift` it
        makes an affine function. By default there is none.
    """

    shift: PixelSigmas
    drift: PixelSigmas | None = None
    affine: PixelSigmas | None = None

    @property
    def sigma(self) -> dict[str, tuple[float, float]]:
        """Terms of the correction -> standard deviations for line and sample, in pixels."""
        terms = {"shift": self.shift, "drift": self.drift, "affine": self.affine}
        return {name: value for name, value in terms.items() if value is not None}


class SharedCorrectionSpec(Spec):
    """Pass whose images have errors in common, such as a stereo triplet.

    Attributes
    ----------
    images : tuple[str, ...]
        Names of the images.
    errors : CorrectionSpec
        Errors that all of these images share, beside the errors of each one.
    """

    images: Annotated[tuple[Name, ...], Field(min_length=1)]
    errors: CorrectionSpec


class RationalImageSpec(Spec):
    """Image with rational polynomials.

    Attributes
    ----------
    file : str | None
        Image, GeoTIFF; matching needs it. By default there is none.
    rpc : str | None
        Rational polynomials: NAME_RPC.TXT, NAME.RPB, RPC_NAME.XML of DIMAP, or a GeoTIFF; by default those of `file`,
        in the image itself or in a file beside it.
    band : int
        Band of the image that is matched, counted from 1.
    errors : CorrectionSpec | None
        Correction of this image; by default that of the block.
    """

    file: Reference | None = None
    rpc: Reference | None = None
    band: Annotated[Whole, Field(ge=1, le=1000)] = 1
    errors: CorrectionSpec | None = None

    @model_validator(mode="after")
    def _has_polynomials(self) -> RationalImageSpec:
        if self.file is None and self.rpc is None:
            raise Problem("an image without a file", None, "`file:` of the image, or `rpc:` of its polynomials")
        return self


RationalImages = Annotated[Named[RationalImageSpec], not_empty("no images", "two images or more")]


class RationalTestSpec(TitledSpec):
    """Base of tests of images with rational polynomials.

    Attributes
    ----------
    images : Mapping[str, RationalImageSpec]
        Name -> image.
    """

    images: RationalImages

    @property
    def seed(self) -> int:
        """Seed of random numbers, without effect because the test uses none."""
        return 0


class RationalAdjustSpec(RationalTestSpec):
    """Block adjustment of images with rational polynomials.

    Attributes
    ----------
    image_points : str | None
        Table of the image points of tie, control and check points; by default those of a .gcp file in `ground`.
    ground : GroundFileSpec | None
        Control and check points, also footprints of a laser altimeter; by default there are none.
    errors : CorrectionSpec
        Correction of every image without one of its own.
    passes : Mapping[str, SharedCorrectionSpec]
        Name -> images of one pass and the errors that these share; by default all errors are independent.
    without : tuple[{'ties', 'control'}, ...]
        Sensors that the files have but the adjustment does not use.
    robust : bool
        True to detect gross errors.
    components : tuple[str, ...]
        Names of groups (image, control, shift, drift, affine) whose variance components are estimated.
    """

    image_points: Reference | None = None
    ground: GroundFileSpec | None = None
    errors: CorrectionSpec
    passes: Named[SharedCorrectionSpec] = Field(default_factory=dict, validate_default=True)
    without: tuple[Literal["ties", "control"], ...] = ()
    robust: Flag = True
    components: tuple[Name, ...] = ()

    @model_validator(mode="after")
    def _fits_together(self) -> RationalAdjustSpec:
        if self.image_points is None and (self.ground is None or not self.ground.file.lower().endswith(".gcp")):
            raise Problem("no image points", None, "`image_points:`, or a .gcp file in `ground`")
        self._passes_fit()
        groups = ("image", "control", *self.errors.sigma)
        for k, name in enumerate(self.components):
            if name not in groups:
                raise unknown("no such group of variances", name, groups, ("components", k))
        return self

    def _passes_fit(self) -> None:
        """Raise Problem for images of a pass that are not there, that another pass has, or that lack a shared term."""
        taken: set[str] = set()
        for name, group in self.passes.items():
            for k, image in enumerate(group.images):
                where = ("passes", name, "images", k)
                if image not in self.images:
                    raise unknown("no such image in the block", image, tuple(self.images), where)
                if image in taken:
                    raise Problem("an image of two passes", image, "each image in one pass, once", within=where)
                lacking = group.errors.sigma.keys() - (self.images[image].errors or self.errors).sigma.keys()
                if lacking:
                    term = sorted(lacking)[0]
                    raise Problem(f"{image} has no {term} of its own", None, f"`{term}` in its errors", within=where)
                taken.add(image)

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the sensors that can be excluded."""
        return ("ties",) if self.ground is None else ("ties", "control")


class RationalPointsSpec(Spec):
    """Tie points matched between images with rational polynomials.

    Attributes
    ----------
    tie : int
        Number of points that are chosen in each image and matched in the others.
    search_radius : int
        Search radius about a predicted position, in pixels: the largest error of the polynomials of two images.
    template : int
        Side of a template, in pixels.
    least_correlation : float
        Smallest correlation of image and template after the fit.
    largest_sigma : float
        Largest standard deviation of a matched position along its worst direction, in pixels.
    roughness : float
        Standard deviation of a position across the epipolar line beyond that of its match, in pixels; the consensus
        test, which compares a match with its neighbours, allows for it.
    false_alarm : float
        Fraction of correct matches that the consensus test may reject.
    """

    tie: Annotated[Whole, Field(ge=1, le=20_000)] = 200
    search_radius: Annotated[Whole, Field(ge=2, le=100)] = 10
    template: Annotated[Whole, Field(ge=LEAST_TEMPLATE, le=101), AfterValidator(_is_odd)] = 25
    least_correlation: Annotated[Number, Field(gt=0.0, lt=1.0)] = 0.6
    largest_sigma: Annotated[Number, Field(gt=0.0, le=2.0)] = 0.2
    roughness: Annotated[Number, Field(ge=0.0, le=10.0)] = 0.15
    false_alarm: Annotated[Number, Field(gt=0.0, lt=0.5)] = 1e-3


class SurfaceSpec(Spec):
    """Grid of heights by dense matching of all pairs of images.

    Attributes
    ----------
    spacing : float
        Side of a cell, in metres.
    crs : str | None
        Projected coordinate reference system of the grid in metres, such as EPSG:32631; by default the zone of UTM
        (WGS84) of the first image. Heights are above the ellipsoid.
    sigma : float
        Standard deviation of a matched displacement, in pixels.
    """

    spacing: Annotated[float, Quantity(DISTANCE, smallest="0.01 m", largest="1 km")]
    crs: Annotated[str, Field(pattern="^[A-Za-z]+:[0-9]+$")] | None = None
    sigma: Pixels = 0.25


class RationalMatchSpec(RationalTestSpec):
    """Measurement of tie points between images with rational polynomials by matching.

    Attributes
    ----------
    heights : tuple[float, float]
        Lowest and highest ground above the ellipsoid, in metres, between which a point is searched.
    points : RationalPointsSpec
        Number of points and settings of the matching.
    surface : SurfaceSpec | None
        Grid of heights, for polynomials that `adjust` has corrected; by default there is none.
    """

    heights: HeightRange
    points: RationalPointsSpec = RationalPointsSpec.model_construct()
    surface: SurfaceSpec | None = None

    @model_validator(mode="after")
    def _fits_together(self) -> RationalMatchSpec:
        if not self.heights[0] < self.heights[1]:
            raise Problem("not a range of heights", None, "the lowest ground before the highest", within=("heights",))
        if len(self.images) < 2:
            raise Problem("a single image", None, "two images or more", within=("images",))
        for name, image in self.images.items():
            if image.file is None:
                raise Problem("no image to match", None, "`file:`", within=("images", name))
        return self
