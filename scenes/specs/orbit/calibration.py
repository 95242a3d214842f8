"""In-orbit calibration of a three-line camera over test fields, with cameras that may drift, as its file gives it."""

from collections.abc import Mapping, Sequence
from typing import Annotated

from pydantic import AfterValidator, Field, model_validator

from scenes.specs.orbit.angle import LINES, DatumShift, EffectsSpec, GroundSigma, Relief, TerrainHeight, check_ends
from scenes.specs.orbit.flight import Altitude, AttitudeSpec, EarthSpec, ErrorsSpec, Latitude, Longitude, UtcTime
from scenes.specs.orbit.scene import ControlSpec, GroundSpec, ImagePointsSpec, InteriorChangeSpec, LineTime, Side
from scenes.yaml.errors import Problem, names_text, unknown
from scenes.yaml.spec import Flag, Name, Named, Number, Ref, Seed, Spec, TitledSpec, Whole, not_empty, one_given
from scenes.yaml.unit_fields import AngleSigmas, LengthSigma, Quantity, Vector
from scenes.yaml.units import ANGLE, DISTANCE, LENGTH, MOMENT

LEAST_TIES = 20
"""Tie points of a strip. Fewer leave most readings of the attitude without a point near them."""


class CameraDriftSpec(Spec):
    """How much a line camera changes from field to field, one standard deviation.

    Attributes
    ----------
    angles : AngleSigmas
        d_alpha (about the camera's Y), d_beta (about X) and d_gamma (about the line of sight), radians.
    principal_distance : LengthSigma
        d_f, metres.
    """

    angles: AngleSigmas = (0.0, 0.0, 0.0)
    principal_distance: LengthSigma = 0.0


class MonitorReadingSpec(Spec):
    """Standard deviation of what the on-board monitor reads of each line camera in each pass.

    Attributes
    ----------
    angles : tuple[float, float, float]
        Of d_alpha, d_beta and d_gamma, radians.
    principal_distance : float
        Of d_f, metres.
    """

    angles: Annotated[tuple[float, float, float], Vector(Quantity(ANGLE, above_zero=True, largest="1 deg"))]
    principal_distance: Annotated[float, Quantity(LENGTH, above_zero=True, largest="5 mm")]


class StripSpec(Spec):
    """Every pass is adjusted on its tie points before check points are intersected.

    Attributes
    ----------
    ties : Whole
        How many tie points are drawn; measured points of images are used as they come.
    length : float
        Of the strip along the track on which they lie, around the field, metres.
    """

    ties: Annotated[Whole, Field(le=5000)] = 500
    length: Annotated[float, Quantity(DISTANCE, smallest="1 km", largest="1000 km")] = 300e3

    @model_validator(mode="after")
    def _are_enough(self) -> "StripSpec":
        if self.ties < LEAST_TIES:
            raise Problem("too few tie points", f"{self.ties}", f"{LEAST_TIES} or more", within=("ties",))
        return self


def _of_lines(drift: Named[CameraDriftSpec]) -> Named[CameraDriftSpec]:
    for name in drift:
        if name not in LINES:
            raise unknown("no such line", name, LINES, (name,))
    return drift


CameraDrifts = Annotated[Named[CameraDriftSpec], AfterValidator(_of_lines)]


LEAST_POINTS = 6
"""Control points of a field. Three points in three lines give 18 conditions for 12 unknowns, but on a field of a few
points one wrong one cannot be told."""

LEAST_PATCHES = 2
"""Patches of a field. One has no width, and the principal distance is open."""

FieldLength = Annotated[float, Quantity(DISTANCE, smallest="1 km", largest="500 km")]
Count = Annotated[Whole, Field(le=5000)]
Repeats = Annotated[Whole, Field(ge=0, le=1000)]


class FieldSpec(Spec):
    """A test field and the pass over it.

    Attributes
    ----------
    latitude, longitude : Latitude
        Of its middle, which the satellite passes at the epoch, radians.
    epoch : UtcTime
        UTC of the pass.
    height : TerrainHeight
        Mean of the ground above the ellipsoid, metres.
    relief : Relief
        Heights lie evenly within this on either side of the mean, metres.
    """

    latitude: Latitude
    longitude: Longitude
    epoch: UtcTime
    height: TerrainHeight = 0.0
    relief: Relief = 0.0


class PointsSpec(Spec):
    """Ground points of every field, at random places of the nadir line's image; all three lines see each of them.

    Attributes
    ----------
    control : Count
        Points that are used for the calibration.
    check : Count
        Points that only test it.
    first, last : Number
        Ends of the part of the nadir line that they lie on, pixels from 0.
    length : FieldLength
        Of the field along the track, metres.
    """

    control: Count = 60
    check: Annotated[Count, Field(ge=2)] = 100
    first: Number
    last: Number
    length: FieldLength = 50e3

    @model_validator(mode="after")
    def _are_enough(self) -> "PointsSpec":
        if self.control < LEAST_POINTS:
            found = f"{self.control} control points"
            raise Problem("too few points to calibrate", found, f"{LEAST_POINTS} or more", within=("control",))
        check_ends(self.first, self.last, "the field has no width")
        return self


class PatchPlaceSpec(Spec):
    """Where a patch of ground lies.

    Attributes
    ----------
    pixel : Number
        Of the nadir line that sees its middle.
    track : float
        Of its middle from the field's middle, metres along the flight.
    """

    pixel: Number
    track: Annotated[float, Quantity(DISTANCE, largest="200 km")] = 0.0


class CalibrationImagesSpec(Spec):
    """Patches of every field whose images are rendered and measured, instead of drawn image points.

    Attributes
    ----------
    patches : tuple[PatchPlaceSpec, ...]
        Of every field.
    lines, pixels : Side
        Size of every image.
    ground : GroundSpec
        What is there. The terrain's height is the field's; a real terrain is another part of the model in each patch.
    control : ControlSpec
        Orthophoto and elevation model. Their errors are drawn for each patch; a shift is common to all.
    points : ImagePointsSpec
        Of every patch. What its `control` and `height_sigma` say is taken for the accuracy of the reference.
    oversampling : Whole
        Samples of the ground along each side of a pixel.
    """

    patches: tuple[PatchPlaceSpec, ...]
    lines: Side = 500
    pixels: Side = 500
    ground: GroundSpec = GroundSpec.model_construct()
    control: ControlSpec = ControlSpec.model_construct()
    points: ImagePointsSpec = ImagePointsSpec.model_construct()
    oversampling: Annotated[Whole, Field(ge=2, le=8)] = 3

    @model_validator(mode="after")
    def _are_enough(self) -> "CalibrationImagesSpec":
        if len(self.patches) < LEAST_PATCHES:
            found = f"{len(self.patches)}"
            problem = "too few patches to tell principal distance from attitude"
            raise Problem(problem, found, f"{LEAST_PATCHES} or more", within=("patches",))
        if self.points.control < 1 or self.points.check < 1:
            found = f"control {self.points.control}, check {self.points.check}"
            raise Problem(
                "a calibration needs control and check points", found, "1 or more of each", within=("points",)
            )
        return self


class CalibrationErrorsSpec(ErrorsSpec):
    """Errors of what is measured. The star trackers' bias is the change of the angle between them and the cameras since
    the laboratory.

    Attributes
    ----------
    gps
        Of the orbit.
    star_tracker
        Of the attitude.
    season : AngleSigmas
        Standard deviation of a further constant bias of each field about body X, Y, Z, radians.
    image : Number
        Standard deviation of an image point in x and in y, pixels.
    control : GroundSigma
        Standard deviation of each coordinate of a control point, metres.
    datum : DatumShift
        Shift that the coordinates of all control points share, east, north and up, unknown to the analysis, metres.
        Check points are given in the right datum.
    switched_on : Flag
        False for exact image points, control points and orbit, and an attitude with its biases only.
    """

    season: AngleSigmas = (0.0, 0.0, 0.0)
    image: Annotated[Number, Field(ge=0, le=10)] = 0.3
    control: GroundSigma = 1.0
    datum: DatumShift = (0.0, 0.0, 0.0)
    switched_on: Flag = True


class LaunchSpec(Spec):
    """How much a launch may change, one standard deviation. The adjustment uses it for what the points tell less well,
    and for nothing else; an estimate far beyond it is a sign of wrong ground coordinates or of a wrong camera file,
    which the fit alone does not show.

    Attributes
    ----------
    bias : AngleSigmas
        Angle between star trackers and cameras about body X, Y, Z, radians; 0 where nothing is known of it.
    interior : float
        Principal distances and principal points, metres.
    """

    bias: AngleSigmas = (2e-4, 2e-4, 2e-4)
    interior: Annotated[float, Quantity(LENGTH, above_zero=True, largest="5 mm")] = 100e-6


class MapLimitsSpec(Spec):
    """Largest RMS errors without ground control that a map at a scale of 1:50 000 allows.

    Attributes
    ----------
    plan : float
        Both axes together, metres; 25 m is 0.5 mm on the map.
    height : float
        metres.
    """

    plan: Annotated[float, Quantity(LENGTH, above_zero=True, largest="1 km")] = 25.0
    height: Annotated[float, Quantity(LENGTH, above_zero=True, largest="1 km")] = 6.0


def checked_schemes(schemes: Sequence[Sequence[str]], fields: Mapping[str, object]) -> None:
    """Raises Problem unless there are schemes, and each names some of the fields once."""
    if not schemes:
        raise Problem("no schemes", "an empty list", "at least one list of fields", within=("schemes",))
    for scheme in schemes:
        for name in scheme:
            if name not in fields:
                raise unknown("no such field", name, fields, ("schemes",))
        if not scheme or len(set(scheme)) != len(scheme):
            found = names_text(scheme) or "none"
            raise Problem("a scheme without fields, or with one twice", found, "each once", within=("schemes",))


class OrbitCalibrationSpec(TitledSpec):
    """A calibration over several fields, tested on all of them without ground control.

    Attributes
    ----------
    name
        As the file is called.
    description
        For people.
    camera : Ref
        Name in scenes/library/payloads or path of a file, with lines forward, nadir and backward.
    perturb : Named[InteriorChangeSpec]
        Line -> how its interior has changed since the laboratory. The nadir line's principal point is the gauge and
        does not change: it cannot be told from a turn of the whole camera, `errors.star_tracker.bias`.
    earth : EarthSpec
        Its rotation.
    altitude : Altitude
        Of the descending sun-synchronous orbit over each field, metres.
    span : float
        How long the orbit is followed before and after the field's middle, seconds.
    line_time : LineTime
        From one image line to the next, seconds.
    attitude : AttitudeSpec
        True attitude.
    fields : Named[FieldSpec]
        By name.
    schemes : tuple[tuple[Name, ...], ...]
        Scheme -> fields whose parameters are averaged for it. One more, by the next number, lets each field use its
        own.
    points : PointsSpec | None
        Of every field, drawn; None where images are measured.
    images : CalibrationImagesSpec | None
        Rendered and measured instead of drawn points.
    effects : EffectsSpec
        On the light.
    errors : CalibrationErrorsSpec
        Of what is measured.
    drift : CameraDrifts
        Line -> how its camera changes from field to field.
    monitor : MonitorReadingSpec | None
        How well an on-board monitor reads these changes in each pass; None for no monitor.
    strip : StripSpec | None
        Tie points for an adjustment of every pass; None for none.
    launch : LaunchSpec
        How much of a change is no surprise.
    limits : MapLimitsSpec
        For the verdict.
    repeats : Repeats
        Campaigns over the same fields with everything drawn anew, for what differs from one to the next.
    seed : Seed
        Of every random number.
    """

    camera: Ref
    perturb: Named[InteriorChangeSpec] = Field(default_factory=dict, validate_default=True)
    earth: EarthSpec = EarthSpec.model_construct()
    altitude: Altitude = 500e3
    span: Annotated[float, Quantity(MOMENT, smallest="1 s", largest="1 h")] = 60.0
    line_time: LineTime = 0.7e-3
    attitude: AttitudeSpec = AttitudeSpec.model_construct(steering="yaw")
    fields: Annotated[Named[FieldSpec], not_empty("no fields", "at least one test field")]
    schemes: tuple[tuple[Name, ...], ...]
    points: PointsSpec | None = None
    images: CalibrationImagesSpec | None = None
    effects: EffectsSpec = EffectsSpec.model_construct()
    errors: CalibrationErrorsSpec = CalibrationErrorsSpec.model_construct()
    drift: CameraDrifts = Field(default_factory=dict, validate_default=True)
    monitor: MonitorReadingSpec | None = None
    strip: StripSpec | None = None
    launch: LaunchSpec = LaunchSpec.model_construct()
    limits: MapLimitsSpec = MapLimitsSpec.model_construct()
    repeats: Repeats = 0
    seed: Seed = 0

    @model_validator(mode="after")
    def _has_points(self) -> "OrbitCalibrationSpec":
        problem = "points are drawn or measured in images"
        one_given(self, ("points", "images"), problem, "`points:` or `images:`", ("points",))
        if self.images is not None and self.repeats:
            problem = "campaigns from images are not repeated, for each is rendered anew"
            raise Problem(problem, str(self.repeats), "0", within=("repeats",))
        return self

    @model_validator(mode="after")
    def _can_be_compared(self) -> "OrbitCalibrationSpec":
        if self.monitor is not None and not self.drift:
            allowed = "a section `drift:`, with sigmas of zero for cameras that keep"
            raise Problem("a monitor, but nothing that it reads", None, allowed, within=("monitor",))
        if self.drift and self.images is not None:
            problem = (
                "cameras that drift are compared on drawn points only, for images would be rendered for every size"
            )
            raise Problem(problem, None, "`points:` instead of `images:`", within=("drift",))
        errors = self.errors
        noise = (*errors.star_tracker.noise, *errors.star_tracker.slow.noise, *errors.gps.noise)
        if self.strip is not None and not (errors.switched_on and any(noise)):
            problem = "a strip adjustment without noise of attitude or orbit has nothing to adjust"
            raise Problem(problem, None, "errors.star_tracker.noise or slow", within=("strip",))
        return self

    @model_validator(mode="after")
    def _schemes_name_fields(self) -> "OrbitCalibrationSpec":
        checked_schemes(self.schemes, self.fields)
        return self
