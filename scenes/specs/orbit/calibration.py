"""In-orbit calibration of a three-line camera over test fields, with cameras that may drift."""

from collections.abc import Mapping, Sequence
from typing import Annotated

from pydantic import AfterValidator, Field, model_validator

from scenes.specs.orbit.angle import LINES, DatumShift, EffectsSpec, GroundSigma, Relief, TerrainHeight, check_ends
from scenes.specs.orbit.flight import Altitude, AttitudeSpec, EarthSpec, ErrorsSpec, Latitude, Longitude, UtcTime
from scenes.specs.orbit.scene import ControlSpec, GroundSpec, ImagePointsSpec, InteriorChangeSpec, LineTime, Side
from scenes.yaml.errors import Problem, names_text, unknown
from scenes.yaml.spec import Flag, Name, Named, Number, Ref, Seed, Spec, TitledSpec, Whole, not_empty, require_one
from scenes.yaml.unit_fields import AngleSigmas, LengthSigma, Quantity, Vector
from scenes.yaml.units import ANGLE, DISTANCE, LENGTH, MOMENT

LEAST_TIES = 20
"""Smallest number of tie points of a strip; with fewer, most attitude readings would have no point near them."""


class CameraDriftSpec(Spec):
    """Change of a line camera from field to field, as standard deviations.

    Attributes
    ----------
    angles : tuple[float, float, float]
        Standard deviations of the rotations d_alpha (about the camera's Y), d_beta (about X) and d_gamma (about the
        line of sight), in radians.
    principal_distance : float
        Standard deviation of the change d_f of the principal distance, in metres.
    """

    angles: AngleSigmas = (0.0, 0.0, 0.0)
    principal_distance: LengthSigma = 0.0


class MonitorReadingSpec(Spec):
    """Accuracy of an on-board monitor's reading of each line camera in each pass.

    Attributes
    ----------
    angles : tuple[float, float, float]
        Standard deviations of the rotations d_alpha (about the camera's Y), d_beta (about X) and d_gamma (about the
        line of sight), in radians.
    principal_distance : float
        Standard deviation of the change d_f of the principal distance, in metres.
    """

    angles: Annotated[tuple[float, float, float], Vector(Quantity(ANGLE, above_zero=True, largest="1 deg"))]
    principal_distance: Annotated[float, Quantity(LENGTH, above_zero=True, largest="5 mm")]


class StripSpec(Spec):
    """Strip adjustment of every pass on its tie points before check points are intersected.

    Attributes
    ----------
    ties : int
        Number of simulated tie points; for images all measured ones are used.
    length : float
        Length along the track, around the field, of the strip with the tie points, in metres.
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
"""Smallest number of control points of a field. Three points in three lines give 18 conditions for 12 unknowns, but
with so few points a gross error could not be detected.
"""

LEAST_PATCHES = 2
"""Smallest number of patches of a field; a single one has no width, so that the principal distance is undetermined."""

FieldLength = Annotated[float, Quantity(DISTANCE, smallest="1 km", largest="500 km")]
Count = Annotated[Whole, Field(le=5000)]


class FieldSpec(Spec):
    """Test field and the pass over it.

    Attributes
    ----------
    latitude : float
        Geodetic latitude of the field's centre, over which the satellite passes at the epoch, in radians; north is
        positive.
    longitude : float
        Longitude of the field's centre, in radians; east is positive.
    epoch : str
        UTC of the pass.
    height : float
        Mean height of the ground above the ellipsoid, in metres.
    relief : float
        Half range of the heights, which are uniformly distributed about the mean, in metres.
    """

    latitude: Latitude
    longitude: Longitude
    epoch: UtcTime
    height: TerrainHeight = 0.0
    relief: Relief = 0.0


class PointsSpec(Spec):
    """Ground points of every field at random positions in the nadir line's image.

    All three lines observe each of them.

    Attributes
    ----------
    control : int
        Number of control points, which are used for the calibration.
    check : int
        Number of check points, which only test the calibration.
    first : float
        First pixel of the part of the nadir line on which the points lie, counted from 0.
    last : float
        Last pixel of this part of the nadir line, counted from 0.
    length : float
        Length of the field along the track, in metres.
    """

    control: Count = 60
    check: Annotated[Count, Field(ge=2)] = 100
    first: Number
    last: Number
    length: FieldLength = 50e3

    @model_validator(mode="after")
    def _are_enough(self) -> "PointsSpec":
        if self.control < LEAST_POINTS:
            value = f"{self.control} control points"
            raise Problem("too few points to calibrate", value, f"{LEAST_POINTS} or more", within=("control",))
        check_ends(self.first, self.last, "the field has no width")
        return self


class PatchPositionSpec(Spec):
    """Position of a patch of ground.

    Attributes
    ----------
    pixel : float
        Pixel of the nadir line that images the patch's centre.
    track : float
        Distance of the patch's centre from the field's centre along the flight, in metres.
    """

    pixel: Number
    track: Annotated[float, Quantity(DISTANCE, largest="200 km")] = 0.0


class CalibrationImagesSpec(Spec):
    """Patches of every field whose images are rendered and measured, instead of simulated image points.

    Attributes
    ----------
    patches : tuple[PatchPlaceSpec, ...]
        Positions of the patches of every field.
    lines : int
        Number of lines of every image.
    pixels : int
        Number of pixels in a line of every image.
    ground : GroundSpec
        True ground. Its mean height is that of the field; a real terrain is another part of the model in each patch.
    control : ControlSpec
        Orthophoto and elevation model. Their errors are drawn for each patch; a shift is common to all.
    points : ImagePointsSpec
        Points of every patch. Their `control` and `height_sigma` are used as the accuracy of the reference.
    oversampling : int
        Number of ground samples along each side of a pixel.
    """

    patches: tuple[PatchPositionSpec, ...]
    lines: Side = 500
    pixels: Side = 500
    ground: GroundSpec = GroundSpec.model_construct()
    control: ControlSpec = ControlSpec.model_construct()
    points: ImagePointsSpec = ImagePointsSpec.model_construct()
    oversampling: Annotated[Whole, Field(ge=2, le=8)] = 3

    @model_validator(mode="after")
    def _are_enough(self) -> "CalibrationImagesSpec":
        if len(self.patches) < LEAST_PATCHES:
            problem = "too few patches to separate principal distance from attitude"
            raise Problem(problem, str(len(self.patches)), f"{LEAST_PATCHES} or more", within=("patches",))
        if self.points.control < 1 or self.points.check < 1:
            value = f"control {self.points.control}, check {self.points.check}"
            problem = "a calibration needs control and check points"
            raise Problem(problem, value, "1 or more of each", within=("points",))
        return self


class CalibrationErrorsSpec(ErrorsSpec):
    """Measurement errors of a calibration.

    The star trackers' bias is the change, since the laboratory, of the angle between them and the cameras.

    Attributes
    ----------
    season : tuple[float, float, float]
        Standard deviation of a further constant bias of each field about body X, Y, Z, in radians.
    image : float
        Standard deviation of an image point in x and in y, in pixels.
    control : float
        Standard deviation of each coordinate of a control point, in metres.
    datum : tuple[float, float, float]
        Common shift of the coordinates of all control points to the east, north and up, unknown to the analysis, in
        metres. Check points are in the correct datum.
    switched_on : bool
        False for exact image points, control points and orbit, and an attitude with its biases only.
    """

    season: AngleSigmas = (0.0, 0.0, 0.0)
    image: Annotated[Number, Field(ge=0, le=10)] = 0.3
    control: GroundSigma = 1.0
    datum: DatumShift = (0.0, 0.0, 0.0)
    switched_on: Flag = True


class LaunchSpec(Spec):
    """Prior standard deviations of the changes due to the launch.

    The adjustment uses it only for parameters that the points determine less well. An estimate far beyond it indicates
    wrong ground coordinates or a wrong camera file, which the fit alone does not show.

    Attributes
    ----------
    bias : tuple[float, float, float]
        Standard deviations of the angle between star trackers and cameras about body X, Y, Z, in radians; 0 if it is
        unknown.
    interior : float
        Standard deviation of principal distances and principal points, in metres.
    """

    bias: AngleSigmas = (2e-4, 2e-4, 2e-4)
    interior: Annotated[float, Quantity(LENGTH, above_zero=True, largest="5 mm")] = 100e-6


class MapLimitsSpec(Spec):
    """Largest RMS errors without ground control, for the verdict; the defaults are those of a map at 1:50 000.

    Attributes
    ----------
    plan : float
        Largest error in plan, both axes together, in metres; 25 m is 0.5 mm on the map.
    height : float
        Largest error in height, in metres.
    """

    plan: Annotated[float, Quantity(LENGTH, above_zero=True, largest="1 km")] = 25.0
    height: Annotated[float, Quantity(LENGTH, above_zero=True, largest="1 km")] = 6.0


def checked_schemes(schemes: Sequence[Sequence[str]], fields: Mapping[str, object]) -> None:
    """Raise `Problem` unless there is a scheme and each scheme lists fields that exist, each of them once.

    A scheme is a list of fields whose calibration results are averaged.
    """
    if not schemes:
        raise Problem("no schemes", "an empty list", "at least one list of fields", within=("schemes",))
    for scheme in schemes:
        for name in scheme:
            if name not in fields:
                raise unknown("no such field", name, fields, ("schemes",))
        if not scheme or len(set(scheme)) != len(scheme):
            value = names_text(scheme) or "none"
            raise Problem("a scheme without fields, or with a repeated field", value, "each once", within=("schemes",))


class OrbitCalibrationSpec(TitledSpec):
    """In-orbit calibration over several fields, tested on all of them without ground control.

    Attributes
    ----------
    camera : str
        Payload with lines forward, nadir and backward: a name in scenes/library/payloads, or the path of your file.
    perturb : Mapping[str, InteriorChangeSpec]
        Line -> true change of its interior orientation since the laboratory. The nadir line's principal point is the
        gauge and does not change: it cannot be separated from a rotation of the whole camera,
        `errors.star_tracker.bias`.
    earth : EarthSpec
        Earth rotation.
    altitude : float
        Altitude of the descending sun-synchronous orbit over each field, in metres.
    span : float
        Half duration of the orbit data about the field's centre, in seconds.
    line_time : float
        Time from one image line to the next, in seconds.
    attitude : AttitudeSpec
        True attitude.
    fields : Mapping[str, FieldSpec]
        Name -> test field.
    schemes : tuple[tuple[str, ...], ...]
        Schemes: each is a list of fields whose parameters are averaged. The program adds a scheme in which each field
        uses its own parameters.
    points : PointsSpec | None
        Simulated points of every field; omitted if images are measured.
    images : CalibrationImagesSpec | None
        Rendered and measured images instead of simulated points.
    effects : EffectsSpec
        Effects on the light path.
    errors : CalibrationErrorsSpec
        Errors of orbit, attitude, image points and control points.
    drift : Mapping[str, CameraDriftSpec]
        Line -> change of its camera from field to field.
    monitor : MonitorReadingSpec | None
        Accuracy of an on-board monitor that measures these changes in each pass; by default there is no monitor.
    strip : StripSpec | None
        Strip adjustment of every pass on tie points; by default there is none.
    launch : LaunchSpec
        Prior standard deviations of the changes due to the launch.
    limits : MapLimitsSpec
        Largest RMS errors for the verdict.
    seed : int
        Seed of all random numbers.
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
    seed: Seed = 0

    @model_validator(mode="after")
    def _has_points(self) -> "OrbitCalibrationSpec":
        problem = "points must be given in exactly one way"
        require_one(self, ("points", "images"), problem, "`points:` or `images:`", ("points",))
        return self

    @model_validator(mode="after")
    def _can_be_compared(self) -> "OrbitCalibrationSpec":
        if self.monitor is not None and not self.drift:
            allowed = "a section `drift:`, with sigmas of zero for stable cameras"
            raise Problem("a monitor, but no changes that it could measure", None, allowed, within=("monitor",))
        if self.drift and self.images is not None:
            problem = "a drift of the cameras needs simulated points: images cannot be rendered for it"
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
