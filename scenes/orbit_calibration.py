"""In-orbit geometric calibration of a three-line camera over fields of ground points (paper 003), as a file in
scenes/orbit gives it.
"""

from typing import Annotated

from pydantic import AfterValidator, Field, model_validator

from scenes.errors import Problem, names_text, nearest
from scenes.orbit_angle import Flag, GroundSigma, Relief, TerrainHeight
from scenes.orbit_spec import AngleSigmas, AttitudeSpec, EarthSpec, ErrorsSpec, Latitude, Longitude
from scenes.quantity import Quantity, Vector
from scenes.spec import Name, Named, Number, Reference, Seed, Spec, Text, Whole
from scenes.units import DISTANCE, LENGTH, MOMENT, TIME
from scenes.utc_time import UtcTime

LEAST_POINTS = 6
"""Control points of a field. Three points in three lines give 18 conditions for 12 unknowns, but on a field of a few
points one wrong one cannot be told."""

InteriorChange = Annotated[float, Quantity(LENGTH, largest="5 mm")]
PointChange = Annotated[tuple[float, float], Vector(Quantity(LENGTH, largest="5 mm"), 2)]
FieldAltitude = Annotated[float, Quantity(DISTANCE, smallest="150 km", largest="2000 km")]
FieldLength = Annotated[float, Quantity(DISTANCE, smallest="1 km", largest="500 km")]
FieldSpan = Annotated[float, Quantity(MOMENT, smallest="1 s", largest="1 h")]
LineTime = Annotated[float, Quantity(TIME, above_zero=True, largest="1 s")]
Count = Annotated[Whole, Field(le=5000)]


class InteriorChangeSpec(Spec):
    """How the interior orientation of a line has changed since the laboratory.

    Attributes:
        focal_length: change of the principal distance, metres.
        principal_point: change of x (flight) and y (along the line), metres.
    """

    focal_length: InteriorChange = 0.0
    principal_point: PointChange = (0.0, 0.0)


class FieldSpec(Spec):
    """A test field and the pass over it.

    Attributes:
        latitude, longitude: of its middle, which the satellite passes at the epoch, radians.
        epoch: UTC of the pass.
        height: mean of the ground above the ellipsoid, metres.
        relief: heights lie evenly within this on either side of the mean, metres.
    """

    latitude: Latitude
    longitude: Longitude
    epoch: UtcTime
    height: TerrainHeight = 0.0
    relief: Relief = 0.0


class PointsSpec(Spec):
    """Ground points of every field, at random places of the nadir line's image; all three lines see each of them.

    Attributes:
        control: points that are used for the calibration.
        check: points that only test it.
        first, last: ends of the part of the nadir line that they lie on, pixels from 0.
        length: of the field along the track, metres.
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
        if not self.first < self.last:
            found = f"first {self.first:g}, last {self.last:g}"
            raise Problem("the field has no width", found, "a last pixel after the first", within=("last",))
        return self


class CalibrationErrorsSpec(ErrorsSpec):
    """Errors of what is measured. The star trackers' bias is the change of the angle between them and the cameras since
    the laboratory.

    Attributes:
        gps: of the orbit.
        star_tracker: of the attitude.
        season: standard deviation of a further constant bias of each field about body X, Y, Z, radians.
        image: standard deviation of an image point in x and in y, pixels.
        control: standard deviation of each coordinate of a control point, metres.
        switched_on: false for exact image points, control points and orbit, and an attitude with its biases only.
    """

    season: AngleSigmas = (0.0, 0.0, 0.0)
    image: Annotated[Number, Field(ge=0, le=10)] = 0.3
    control: GroundSigma = 1.0
    switched_on: Flag = True


class MapLimitsSpec(Spec):
    """Largest RMS errors without ground control that a map at a scale of 1:50 000 allows.

    Attributes:
        plan: both axes together, metres; 25 m is 0.5 mm on the map.
        height: metres.
    """

    plan: Annotated[float, Quantity(LENGTH, above_zero=True, largest="1 km")] = 25.0
    height: Annotated[float, Quantity(LENGTH, above_zero=True, largest="1 km")] = 6.0


def _some_fields(fields: Named[FieldSpec]) -> Named[FieldSpec]:
    if not fields:
        raise Problem("no fields", "an empty mapping", "at least one test field")
    return fields


class OrbitCalibrationSpec(Spec):
    """A calibration over several fields, tested on all of them without ground control.

    Attributes:
        name: as the file is called.
        description: for people.
        camera: name in scenes/payloads or path of a file, with lines forward, nadir and aft.
        changes: line -> how its interior has changed since the laboratory. The nadir line's principal point is the
            gauge and does not change: it cannot be told from a turn of the whole camera, `errors.star_tracker.bias`.
        earth: its rotation.
        altitude: of the descending sun-synchronous orbit over each field, metres.
        span: how long the orbit is followed before and after the field's middle, seconds.
        line_time: from one image line to the next, seconds.
        attitude: true attitude.
        fields: by name.
        schemes: scheme -> fields whose parameters are averaged for it. One more, by the next number, lets each field
            use its own.
        points: of every field.
        errors: of what is measured.
        limits: for the verdict.
        seed: of every random number.
    """

    name: Name
    description: Text = ""
    camera: Reference
    changes: Named[InteriorChangeSpec] = Field(default_factory=dict, validate_default=True)
    earth: EarthSpec = EarthSpec()
    altitude: FieldAltitude = 500e3
    span: FieldSpan = 60.0
    line_time: LineTime = 0.7e-3
    attitude: AttitudeSpec = AttitudeSpec(steering="yaw")
    fields: Annotated[Named[FieldSpec], AfterValidator(_some_fields)]
    schemes: tuple[tuple[Name, ...], ...]
    points: PointsSpec
    errors: CalibrationErrorsSpec = CalibrationErrorsSpec()
    limits: MapLimitsSpec = MapLimitsSpec()
    seed: Seed = 0

    @model_validator(mode="after")
    def _schemes_name_fields(self) -> "OrbitCalibrationSpec":
        if not self.schemes:
            raise Problem("no schemes", "an empty list", "at least one list of fields", within=("schemes",))
        for scheme in self.schemes:
            for name in scheme:
                if name not in self.fields:
                    hint = nearest(name, self.fields)
                    raise Problem("no such field", name, names_text(tuple(self.fields)), hint, within=("schemes",))
            if not scheme or len(set(scheme)) != len(scheme):
                found = names_text(scheme) or "none"
                raise Problem("a scheme without fields, or with one twice", found, "each once", within=("schemes",))
        return self
