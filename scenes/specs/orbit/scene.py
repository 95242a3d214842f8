"""What a line camera in orbit sees, what is known of it, and which points are measured in its images.

Images of a patch of ground by every line of a camera in orbit, as a file in scenes/orbit gives them.
"""

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
        allowed = f"{', '.join(_EVEN_TERMS)}; the others shift the image, which the interior orientation tells"
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
    if (
        len(corners) < 3
        or abs(area(corners)) < _SMALLEST
        or abs(area(hull(corners[None]))[0]) > abs(area(corners)) * (1.0 + 1e-9)
    ):
        allowed = "three corners or more, in order, of a convex polygon; give others as several"
        raise Problem("not a convex polygon", str([list(corner) for corner in outline]), allowed)
    return outline


Outline = Annotated[tuple[Corner, ...], AfterValidator(_is_convex)]
_SMALLEST = 1e-9


def _apart(outlines: tuple[tuple[Corner, ...], ...]) -> tuple[tuple[Corner, ...], ...]:
    """Every polygon by itself, and some of the pupil left."""
    shapes = [np.array(outline, float)[None] for outline in outlines]
    shapes = [shape if area(shape)[0] > 0.0 else shape[:, ::-1] for shape in shapes]
    for k, one in enumerate(shapes):
        for other in shapes[:k]:
            if abs(area(intersect(one, *sides(other)))[0]) > _SMALLEST:
                raise Problem("outlines overlap", "", "polygons that do not overlap")
    turn = 2.0 * np.pi * np.arange(64) / 64
    disk = np.stack([np.cos(turn), np.sin(turn)], axis=-1)[None]
    if sum(float(area(intersect(shape, *sides(disk)))[0]) for shape in shapes) > 0.9 * np.pi:
        raise Problem("the pupil is covered", "", "outlines that leave a tenth of it")
    return outlines


class LineImageSpec(Spec):
    """How a line forms and records its image.

    Attributes
    ----------
    f_number : Number
        Of the lens, whose pupil is round and evenly lit.
    transmission : Number
        Of the lens, mean over the spectrum.
    wavefront : dict[EvenTerm, TermSize]
        Error by even Zernike terms (Noll, unit rms), metres.
    obstruction : tuple[Outline, ...]
        Outlines of what stands before the lens, convex polygons that do not overlap, corners (along the line, along the
        track) in units of the pupil's radius.
    spectrum : WavelengthRange
        First and last wavelength, metres; the light is the Sun's between them.
    detector : Ref
        Data sheet, by name or path.
    diffusion : Diffusion
        Rms spread of charge between pixels, metres.
    tdi : TdiSpec
        How the line collects light; its line time is that of the image.
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
            found = f"[{format_quantity(first, LENGTH)}, {format_quantity(last, LENGTH)}]"
            raise Problem("the spectrum is empty", found, "[shortest, longest]", within=("spectrum",))
        return self


class TerrainSpec(Spec):
    """Heights of the ground above the ellipsoid.

    Attributes
    ----------
    kind : Literal['real', 'fractal']
        `real`: the elevation model that comes with matplotlib (Jacksboro fault, Tennessee, 3 arc seconds), mirrored
        beyond its edges of 30 km x 32 km; `fractal`: drawn.
    height : TerrainHeight
        Mean height, metres.
    relief : float | None
        Rms of the heights about their mean, metres; for `real` none keeps the heights' own, 121 m.
    exponent : Number
        Of a fractal's amplitude spectrum over frequency; larger is smoother.
    post : Spacing
        Of a fractal's posts, metres; between posts the terrain is a cubic spline.
    longest : GroundLength
        Wavelength above which a fractal has no more relief, metres.
    offset : tuple[float, float]
        East and north of the patch's centre from the real model's middle, metres.
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
            raise Problem(
                "a fractal terrain without relief", None, "the rms of its heights, '80 m'", within=("relief",)
            )
        return self


class TextureSpec(Spec):
    """Reflectance of the ground.

    Attributes
    ----------
    spacing : Spacing
        Of the reflectance's cells, metres; the field is a cubic B-spline of them and holds nothing finer.
    mean : Number
        reflectance.
    contrast : Number
        Rms of the reflectance over its mean.
    parcels : Share
        Share of the ground that is fields of crops; the rest varies as a fractal.
    parcel_size : GroundLength
        Side of such a field of mean area, metres.
    roads : GroundLength
        Metres from one road to the next.
    """

    spacing: Spacing = 2.0
    mean: Annotated[Number, Field(ge=0.01, le=0.9)] = 0.18
    contrast: Annotated[Number, Field(ge=0.0, le=0.6)] = 0.3
    parcels: Share = 0.6
    parcel_size: GroundLength = 140.0
    roads: GroundLength = 1500.0


class LightSpec(Spec):
    """The Sun and the air.

    Attributes
    ----------
    elevation : Elevation
        Of the Sun, radians.
    azimuth : float
        Of the Sun, from north over east, radians.
    transmission : Number
        Of the air, down and up together.
    sky : Share
        Share of the light on level ground that comes evenly from the sky.
    path : Number
        Light scattered by the air into the camera, as the reflectance that would give it.
    """

    elevation: Elevation = math.radians(50.0)
    azimuth: Annotated[float, Quantity(ANGLE, smallest="0 deg", largest="360 deg")] = math.radians(145.0)
    transmission: Annotated[Number, Field(gt=0.0, le=1.0)] = 0.7
    sky: Share = 0.15
    path: Annotated[Number, Field(ge=0.0, le=0.5)] = 0.04


class GroundSpec(Spec):
    """The true ground, on the day of the pass.

    Attributes
    ----------
    terrain : TerrainSpec
        heights.
    texture : TextureSpec
        reflectance.
    light : LightSpec
        Sun and air.
    """

    terrain: TerrainSpec = TerrainSpec.model_construct()
    texture: TextureSpec = TextureSpec.model_construct()
    light: LightSpec = LightSpec.model_construct()


class DemSpec(Spec):
    """A reference elevation model.

    Attributes
    ----------
    post : Spacing
        Distance of its posts, metres.
    sigma : GroundSigma
        Standard deviation of a height, metres.
    correlation : GroundLength
        Distance over which the heights' errors are alike, metres.
    """

    post: Spacing = 25.0
    sigma: GroundSigma = 2.0
    correlation: GroundLength = 200.0


class ControlSpec(Spec):
    """The control source: an orthophoto of another date with a reference elevation model; both share one error in plan.

    Attributes
    ----------
    spacing : Spacing
        Ground sample distance of the orthophoto, metres.
    mtf : Number
        Of the orthophoto at its Nyquist frequency.
    noise : Number
        Of the orthophoto, rms, in reflectance.
    changed : Share
        Share of the fields that look different on its date.
    light : LightSpec
        Of its date.
    shift : tuple[float, float]
        Constant error in plan, east and north, metres.
    sigma : GroundSigma
        Standard deviation of a smooth error in plan, each axis, metres.
    correlation : GroundLength
        Distance over which that error changes, metres.
    dem : DemSpec
        Elevation model.
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
"""Pixels: a margin of 3 on either side leaves least squares matching 7."""


def _is_odd(side: int) -> int:
    if side % 2 == 0:
        raise Problem("a template needs a middle pixel", str(side), "an odd number of pixels")
    return side


class ImagePointsSpec(Spec):
    """Points measured in images.

    Attributes
    ----------
    control : Whole
        Points of the orthophoto that are sought in every line.
    check : Whole
        More of them, kept apart to test with.
    tie : Whole
        Points of the nadir line's image that are sought in the others.
    reach : Whole
        How far the predicted place may be off, pixels and lines.
    template : Whole
        Its side, pixels.
    least_correlation : Number
        Of image and template after the fit.
    largest_sigma : Number
        Of a place along its worst direction, pixels.
    height_sigma : GroundSigma
        Of the reference heights, as their producer states it, metres.
    roughness : Number
        Rms by which noise of the attitude bends the displacement over a patch, pixels: neighbours within it do not
        contradict each other.
    false_alarm : Number
        Share of right matches that consensus may take for wrong.
    """

    control: Annotated[Whole, Field(ge=0, le=2000)] = 60
    check: Annotated[Whole, Field(ge=0, le=2000)] = 0
    tie: Annotated[Whole, Field(ge=0, le=2000)] = 0
    reach: Annotated[Whole, Field(ge=2, le=200)] = 40
    template: Annotated[Whole, Field(ge=LEAST_TEMPLATE, le=101), AfterValidator(_is_odd)] = 31
    least_correlation: Annotated[Number, Field(gt=0.0, lt=1.0)] = 0.6
    largest_sigma: Annotated[Number, Field(gt=0.0, le=2.0)] = 0.2
    height_sigma: GroundSigma = 2.0
    roughness: Annotated[Number, Field(ge=0.0, le=10.0)] = 0.15
    false_alarm: Annotated[Number, Field(gt=0.0, lt=0.5)] = 1e-3

    @model_validator(mode="after")
    def _are_some(self) -> "ImagePointsSpec":
        if not self.control + self.check + self.tie:
            raise Problem("no points", "control, check and tie 0", "some points, or no section `points`")
        return self


def _each_once(lines: tuple[str, ...]) -> tuple[str, ...]:
    if not lines or len(set(lines)) != len(lines):
        raise Problem("no lines, or one twice", names_text(lines) or "none", "each line once")
    return lines


Side = Annotated[Whole, Field(ge=16, le=20_000)]
LineTime = Annotated[float, Quantity(TIME, above_zero=True, largest="1 s")]


class InteriorChangeSpec(Spec):
    """How the interior orientation of a line has changed since the laboratory.

    Attributes
    ----------
    principal_distance : float
        Change of the principal distance, metres.
    principal_point : tuple[float, float]
        Change of x (flight) and y (along the line), metres.
    """

    principal_distance: Annotated[float, Quantity(LENGTH, largest="5 mm")] = 0.0
    principal_point: Annotated[tuple[float, float], Vector(Quantity(LENGTH, largest="5 mm"), 2)] = (0.0, 0.0)


class PatchSpec(Spec):
    """The patch of ground that is imaged; its middle lies on what one line sees at a moment.

    Attributes
    ----------
    line : Name
        Of the camera, by name.
    pixel : Number
        Of that line that sees the middle.
    time : Moment
        At which it does, seconds from the orbit's epoch.
    lines, pixels : Side
        Size of every image.
    """

    line: Name = "nadir"
    pixel: Number
    time: Moment = 0.0
    lines: Side = 1000
    pixels: Side = 1000


class OrbitSimulateSpec(PayloadTestSpec):
    """A pass over a patch of ground.

    Attributes
    ----------
    name
        As the file is called.
    description
        For people.
    camera
        Name in scenes/library/payloads or path of a file; it needs a section `image`.
    lines : tuple[Name, ...]
        Those that are rendered, by name.
    perturb : Named[InteriorChangeSpec]
        Line -> how its interior has changed since the laboratory.
    earth : EarthSpec
        Its rotation.
    orbit : OrbitSpec
        True orbit.
    attitude : AttitudeSpec
        True attitude.
    effects : LightEffectsSpec
        What happens to the light between ground and camera.
    line_time : LineTime
        From one image line to the next, seconds.
    patch : PatchSpec
        Where and how large.
    ground : GroundSpec
        What is there.
    control : ControlSpec
        What is known of the ground.
    points : ImagePointsSpec | None
        That are measured in the images; none without this section.
    errors : ErrorsSpec
        Of what the satellite measures of itself.
    oversampling : Whole
        Samples of the ground along each side of a pixel.
    seed : Seed
        Of every random number.
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
