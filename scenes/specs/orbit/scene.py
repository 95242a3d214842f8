"""Imaging of a patch of ground by every line of a camera in orbit: true ground, control, and points in the images."""

import math
from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, Field, WithJsonSchema, model_validator

from optics.geometry.polygon import area, hull, intersect, sides
from optics.numerics.number_tree import FrozenMap
from scenes.specs.camera import Diffusion, TdiSpec
from scenes.specs.orbit.angle import GroundSigma, LightEffectsSpec, Moment, TerrainHeight
from scenes.specs.orbit.flight import AttitudeSpec, EarthSpec, ErrorsSpec, OrbitSpec, PayloadTestSpec
from scenes.specs.spectrum import WavelengthRange
from scenes.yaml.errors import Problem, names_text
from scenes.yaml.spec import Name, Named, Number, Ref, Seed, Spec, Whole
from scenes.yaml.unit_fields import Quantity, Vector
from scenes.yaml.units import ANGLE, LENGTH, TIME, format_quantity

_EVEN_TERMS = ("Z4", "Z5", "Z6", "Z11", "Z12", "Z13", "Z14", "Z15", "Z22")


def _is_even(term: str) -> str:
    if term not in _EVEN_TERMS:
        allowed = f"{', '.join(_EVEN_TERMS)}; other terms shift the image and are part of the interior orientation"
        raise Problem("not a wavefront term of a line", term, allowed)
    return term


EvenTerm = Annotated[str, AfterValidator(_is_even), WithJsonSchema({"type": "string", "enum": list(_EVEN_TERMS)})]
TermSize = Annotated[float, Quantity(LENGTH, largest="1 um")]
Spacing = Annotated[float, Quantity(LENGTH, smallest="0.1 m", largest="1 km")]
GroundLength = Annotated[float, Quantity(LENGTH, smallest="1 m", largest="100 km")]
Share = Annotated[Number, Field(ge=0.0, le=1.0)]
Elevation = Annotated[float, Quantity(ANGLE, smallest="5 deg", largest="90 deg")]


Corner = tuple[Annotated[Number, Field(ge=-10.0, le=10.0)], Annotated[Number, Field(ge=-10.0, le=10.0)]]


def _is_convex(outline: tuple[Corner, ...]) -> tuple[Corner, ...]:
    corners = np.array(outline, float)
    size = abs(area(corners)) if len(corners) >= 3 else 0.0
    if size < _SMALLEST or abs(area(hull(corners[None]))[0]) > size * (1.0 + 1e-9):
        allowed = "three corners or more, in order, of a convex polygon; divide other shapes into several polygons"
        raise Problem("not a convex polygon", str([list(corner) for corner in outline]), allowed)
    return outline


Outline = Annotated[tuple[Corner, ...], AfterValidator(_is_convex)]
_SMALLEST = 1e-9


def _apart(outlines: tuple[tuple[Corner, ...], ...]) -> tuple[tuple[Corner, ...], ...]:
    """Raise `Problem` if obstructions overlap or leave less than a tenth of the pupil free."""
    shapes = [np.array(outline, float)[None] for outline in outlines]
    shapes = [shape if area(shape)[0] > 0.0 else shape[:, ::-1] for shape in shapes]
    for k, polygon in enumerate(shapes):
        for other in shapes[:k]:
            if abs(area(intersect(polygon, *sides(other)))[0]) > _SMALLEST:
                raise Problem("outlines overlap", "", "polygons that do not overlap")
    angle = 2.0 * np.pi * np.arange(64) / 64
    disk = np.stack([np.cos(angle), np.sin(angle)], axis=-1)[None]
    if sum(float(area(intersect(shape, *sides(disk)))[0]) for shape in shapes) > 0.9 * np.pi:
        raise Problem("the pupil is covered", "", "outlines that leave at least a tenth of the pupil open")
    return outlines


class LineImageSpec(Spec):
    """Image formation and recording of a line.

    Attributes
    ----------
    f_number : float
        F-number of the lens, whose pupil is circular and uniformly illuminated.
    transmission : float
        Transmission of the lens, mean over the spectrum.
    wavefront : dict[str, float]
        Even Zernike term (Noll, unit rms) -> wavefront error, in metres.
    obstruction : tuple[tuple[tuple[float, float], ...], ...]
        Outlines of obstructions before the lens: convex polygons that do not overlap, corners (along the line, along
        the track) in units of the pupil's radius.
    spectrum : tuple[float, float]
        Shortest and longest wavelength, in metres; the light between them is the Sun's.
    detector : str
        Data sheet of the detector, by name or path.
    diffusion : float
        Charge diffusion between pixels, rms, in metres.
    tdi : TdiSpec
        Time delay and integration; its line time is replaced by that of the image.
    """

    f_number: Annotated[Number, Field(ge=1.0, le=100.0)]
    transmission: Annotated[Number, Field(gt=0.0, le=1.0)] = 0.8
    wavefront: Annotated[dict[EvenTerm, TermSize], AfterValidator(FrozenMap)] = Field(default_factory=FrozenMap)
    obstruction: Annotated[tuple[Outline, ...], AfterValidator(_apart)] = ()
    spectrum: WavelengthRange
    detector: Ref
    diffusion: Diffusion = 0.0
    tdi: TdiSpec = TdiSpec.model_construct()

    @model_validator(mode="after")
    def _spectrum_rises(self) -> "LineImageSpec":
        first, last = self.spectrum
        if not first < last:
            value = f"[{format_quantity(first, LENGTH)}, {format_quantity(last, LENGTH)}]"
            raise Problem("the spectrum is empty", value, "[shortest, longest]", within=("spectrum",))
        return self


class TerrainSpec(Spec):
    """Heights of the ground above the ellipsoid.

    Attributes
    ----------
    kind : {'real', 'fractal'}
        Source of the heights: `real`, the elevation model that comes with matplotlib (Jacksboro fault, Tennessee, 3 arc
        seconds), mirrored beyond its edges of 30 km x 32 km; `fractal`, random.
    height : float
        Mean height above the ellipsoid, in metres.
    relief : float | None
        Rms of the heights about their mean, in metres; required for `fractal`, for `real` by default that of the model,
        121 m.
    exponent : float
        Exponent of a fractal's amplitude spectrum against spatial frequency; a larger one is smoother.
    post : float
        Spacing of a fractal's grid points (posts), in metres; between them the terrain is a cubic spline.
    longest : float
        Longest wavelength of a fractal's relief, in metres.
    offset : tuple[float, float]
        Position of the patch's centre to the east and north of the real model's centre, in metres.
    """

    kind: Literal["real", "fractal"] = "real"
    height: TerrainHeight = 500.0
    relief: Annotated[float, Quantity(LENGTH, smallest="0 m", largest="3 km")] | None = None
    exponent: Annotated[Number, Field(ge=1.0, le=4.0)] = 2.2
    post: Spacing = 30.0
    longest: GroundLength = 6000.0
    offset: Annotated[tuple[float, float], Vector(Quantity(LENGTH, largest="1000 km"), 2)] = (0.0, 0.0)

    @model_validator(mode="after")
    def _fractal_has_relief(self) -> "TerrainSpec":
        if self.kind == "fractal" and self.relief is None:
            allowed = "the rms of its heights, '80 m'"
            raise Problem("a fractal terrain without relief", None, allowed, within=("relief",))
        return self


class TextureSpec(Spec):
    """Reflectance of the ground.

    Attributes
    ----------
    spacing : float
        Spacing of the cells of reflectance, in metres; the reflectance is a cubic B-spline of them without finer
        detail.
    mean : float
        Mean reflectance.
    contrast : float
        Rms of the reflectance relative to its mean.
    parcels : float
        Fraction of the ground covered by fields of crops; the rest varies as a fractal.
    parcel_size : float
        Side of a field of crops of mean area, in metres.
    roads : float
        Distance between roads, in metres.
    """

    spacing: Spacing = 2.0
    mean: Annotated[Number, Field(ge=0.01, le=0.9)] = 0.18
    contrast: Annotated[Number, Field(ge=0.0, le=0.6)] = 0.3
    parcels: Share = 0.6
    parcel_size: GroundLength = 140.0
    roads: GroundLength = 1500.0


class LightSpec(Spec):
    """Illumination by the Sun and the sky, and the atmosphere.

    Attributes
    ----------
    elevation : float
        Elevation of the Sun, in radians.
    azimuth : float
        Azimuth of the Sun, from north over east, in radians.
    transmission : float
        Transmission of the atmosphere, down and up together.
    sky : float
        Fraction of the illumination of level ground that is diffuse light of the sky.
    path : float
        Path radiance: light scattered by the atmosphere into the camera, as an equivalent reflectance.
    """

    elevation: Elevation = math.radians(50.0)
    azimuth: Annotated[float, Quantity(ANGLE, smallest="0 deg", largest="360 deg")] = math.radians(145.0)
    transmission: Annotated[Number, Field(gt=0.0, le=1.0)] = 0.7
    sky: Share = 0.15
    path: Annotated[Number, Field(ge=0.0, le=0.5)] = 0.04


class GroundSpec(Spec):
    """True ground on the day of the pass.

    Attributes
    ----------
    terrain : TerrainSpec
        Heights of the ground.
    texture : TextureSpec
        Reflectance of the ground.
    light : LightSpec
        Illumination and atmosphere.
    """

    terrain: TerrainSpec = TerrainSpec.model_construct()
    texture: TextureSpec = TextureSpec.model_construct()
    light: LightSpec = LightSpec.model_construct()


class DemSpec(Spec):
    """Reference elevation model.

    Attributes
    ----------
    post : float
        Spacing of the model's grid points (posts), in metres.
    sigma : float
        Standard deviation of a height, in metres.
    correlation : float
        Correlation length of the height errors, in metres.
    """

    post: Spacing = 25.0
    sigma: GroundSigma = 2.0
    correlation: GroundLength = 200.0


class ControlSpec(Spec):
    """Control source: an orthophoto of another date with a reference elevation model; both share one error in plan.

    Attributes
    ----------
    spacing : float
        Ground sample distance of the orthophoto, in metres.
    mtf : float
        MTF of the orthophoto at its Nyquist frequency.
    noise : float
        Noise of the orthophoto, rms, in reflectance.
    changed : float
        Fraction of the fields of crops that look different on the orthophoto's date.
    light : LightSpec
        Illumination on the orthophoto's date.
    shift : tuple[float, float]
        Constant error in plan, east and north, in metres.
    sigma : float
        Standard deviation of a smooth error in plan, each axis, in metres.
    correlation : float
        Correlation length of the smooth error, in metres.
    dem : DemSpec
        Reference elevation model.
    """

    spacing: Spacing = 2.0
    mtf: Annotated[Number, Field(gt=0.0, lt=1.0)] = 0.2
    noise: Annotated[Number, Field(ge=0.0, le=0.2)] = 0.004
    changed: Share = 0.15
    light: LightSpec = LightSpec.model_validate({"elevation": "60 deg", "azimuth": "160 deg"})
    shift: Annotated[tuple[float, float], Vector(Quantity(LENGTH, largest="1 km"), 2)] = (0.0, 0.0)
    sigma: GroundSigma = 0.5
    correlation: GroundLength = 5000.0
    dem: DemSpec = DemSpec.model_construct()


LEAST_TEMPLATE = 13
"""Smallest side of a template, in pixels: a margin of 3 on either side leaves 7 for least squares matching."""


def _is_odd(side: int) -> int:
    if side % 2 == 0:
        raise Problem("a template needs a middle pixel", str(side), "an odd number of pixels")
    return side


class ImagePointsSpec(Spec):
    """Points measured in images by least squares matching.

    Attributes
    ----------
    control : int
        Number of control points: points of the orthophoto that are matched in every line.
    check : int
        Number of further points of the orthophoto, which only test the result.
    tie : int
        Number of tie points: points of the nadir line's image that are matched in the others.
    search_radius : int
        Search radius about the predicted position, in pixels and lines.
    template : int
        Side of a template, in pixels.
    least_correlation : float
        Smallest correlation of image and template after the fit.
    largest_sigma : float
        Largest standard deviation of a matched position along its worst direction, in pixels.
    height_sigma : float
        Standard deviation of the reference heights, as their producer states it, in metres.
    roughness : float
        Standard deviation, in x and in y, of the displacement of points within a patch by attitude noise, in pixels;
        the consensus test, which compares a match with its neighbours, allows for it.
    false_alarm : float
        Fraction of correct matches that the consensus test may reject.
    """

    control: Annotated[Whole, Field(ge=0, le=2000)] = 60
    check: Annotated[Whole, Field(ge=0, le=2000)] = 0
    tie: Annotated[Whole, Field(ge=0, le=2000)] = 0
    search_radius: Annotated[Whole, Field(ge=2, le=200)] = 40
    template: Annotated[Whole, Field(ge=LEAST_TEMPLATE, le=101), AfterValidator(_is_odd)] = 31
    least_correlation: Annotated[Number, Field(gt=0.0, lt=1.0)] = 0.6
    largest_sigma: Annotated[Number, Field(gt=0.0, le=2.0)] = 0.2
    height_sigma: GroundSigma = 2.0
    roughness: Annotated[Number, Field(ge=0.0, le=10.0)] = 0.15
    false_alarm: Annotated[Number, Field(gt=0.0, lt=0.5)] = 1e-3

    @model_validator(mode="after")
    def _are_not_empty(self) -> "ImagePointsSpec":
        if not self.control + self.check + self.tie:
            raise Problem("no points", "control, check and tie 0", "some points, or no section `points`")
        return self


def _each_once(lines: tuple[str, ...]) -> tuple[str, ...]:
    if not lines or len(set(lines)) != len(lines):
        raise Problem("no lines, or a repeated line", names_text(lines) or "none", "each line once")
    return lines


Side = Annotated[Whole, Field(ge=16, le=20_000)]
LineTime = Annotated[float, Quantity(TIME, above_zero=True, largest="1 s")]


class InteriorChangeSpec(Spec):
    """Change of the interior orientation of a line since the laboratory.

    Attributes
    ----------
    principal_distance : float
        Change of the principal distance, in metres.
    principal_point : tuple[float, float]
        Change of the principal point, x (flight) and y (along the line), in metres.
    """

    principal_distance: Annotated[float, Quantity(LENGTH, largest="5 mm")] = 0.0
    principal_point: Annotated[tuple[float, float], Vector(Quantity(LENGTH, largest="5 mm"), 2)] = (0.0, 0.0)


class PatchSpec(Spec):
    """Patch of ground that is imaged, centred on the footprint of a pixel of one line at one time.

    Attributes
    ----------
    line : str
        Name of the line at whose footprint the patch is centred.
    pixel : float
        Pixel of this line that images the patch's centre.
    time : float
        Time at which this pixel images the patch's centre, from the orbit's epoch, in seconds.
    lines : int
        Number of lines of every image.
    pixels : int
        Number of pixels in a line of every image.
    """

    line: Name = "nadir"
    pixel: Number
    time: Moment = 0.0
    lines: Side = 1000
    pixels: Side = 1000


class OrbitSimulateSpec(PayloadTestSpec):
    """Simulation of line images of a patch of ground.

    Attributes
    ----------
    camera
        Payload with a section `image`: a name in scenes/library/payloads, or the path of your file.
    lines : tuple[str, ...]
        Names of the lines that are rendered.
    perturb : Mapping[str, InteriorChangeSpec]
        Line -> true change of its interior orientation since the laboratory.
    earth : EarthSpec
        Earth rotation.
    orbit : OrbitSpec
        True orbit.
    attitude : AttitudeSpec
        True attitude.
    effects : LightEffectsSpec
        Effects on the light path between ground and camera.
    line_time : float
        Time from one image line to the next, in seconds.
    patch : PatchSpec
        Position and size of the patch.
    ground : GroundSpec
        True ground.
    control : ControlSpec
        Orthophoto and elevation model of the ground.
    points : ImagePointsSpec | None
        Points that are measured in the images; by default there are none.
    errors : ErrorsSpec
        Errors of the satellite's orbit and attitude measurements.
    oversampling : int
        Number of ground samples along each side of a pixel.
    seed : int
        Seed of all random numbers.
    """

    lines: Annotated[tuple[Name, ...], AfterValidator(_each_once)] = ("forward", "nadir", "backward")
    perturb: Named[InteriorChangeSpec] = Field(default_factory=dict, validate_default=True)
    earth: EarthSpec = EarthSpec.model_construct()
    orbit: OrbitSpec
    attitude: AttitudeSpec = AttitudeSpec.model_construct(steering="yaw")
    effects: LightEffectsSpec = LightEffectsSpec.model_construct()
    line_time: LineTime = 0.7e-3
    patch: PatchSpec
    ground: GroundSpec = GroundSpec.model_construct()
    control: ControlSpec = ControlSpec.model_construct()
    points: ImagePointsSpec | None = None
    errors: ErrorsSpec = ErrorsSpec.model_construct()
    oversampling: Annotated[Whole, Field(ge=2, le=8)] = 3
    seed: Seed = 0
