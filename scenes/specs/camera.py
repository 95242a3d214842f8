"""A camera, as a file in scenes/library/cameras gives it: its optical prescription, the line CCDs of its spectral bands
with time delay and integration, and its optimisation.
"""

from collections.abc import Mapping
from math import isfinite
from typing import Annotated, Any, Literal

from pydantic import Field, GetCoreSchemaHandler, GetJsonSchemaHandler, model_validator
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, core_schema

from optics.geometry.sag_terms import SAG_TERMS, SagTerm
from optics.numerics.frozen_map import FrozenMap
from scenes.specs.detector import PixelPitch
from scenes.yaml.errors import KeyPath, Problem, names_text, nearest, shown
from scenes.yaml.quantity import AsphereTerms, Length, PositiveLength, Quantity, Vector, Wavelength
from scenes.yaml.spec import Name, Named, Number, Reference, Spec, Text, Whole
from scenes.yaml.units import ANGLE, LENGTH, SCALE, TIME, format_quantity, parse_quantity, power_of_length

Spectrum = Annotated[tuple[float, float], Vector(Quantity(LENGTH, smallest="100 nm", largest="100 um"), 2)]
RateError = Annotated[float, Quantity(SCALE, largest="50 percent")]
Exposure = Annotated[float, Quantity(TIME, above_zero=True, largest="100 s")]
Diffusion = Annotated[float, Quantity(LENGTH, smallest="0 um", largest="1 mm")]


class TdiSpec(Spec):
    """How a line CCD collects light while the image moves across it.

    Attributes:
        stages: lines over which the charge is collected.
        phases: steps in which the charge moves on by one pixel; between two steps it stands still and the image does
            not, which blurs it along the track by one step.
        open_share: share of each step in which light is collected.
        line_time: from one line to the next, seconds.
        rate_error: relative difference between the image's speed and the charge's; over all stages it blurs as well.
    """

    stages: Annotated[Whole, Field(ge=1, le=4096)] = 1
    phases: Annotated[Whole, Field(ge=1, le=8)] = 1
    line_time: Exposure = 3.5e-4
    open_share: Annotated[Number, Field(gt=0.0, le=1.0)] = 1.0
    rate_error: RateError = 0.0


class BandSpec(Spec):
    """A line CCD in the focal plane and the light it sees.

    Attributes:
        offset: along X' (flight direction) from the line's centre, metres.
        pixels: number of pixels along the line.
        pitch: of the pixels, which are square, metres.
        spectrum: first and last wavelength, metres; the light is taken as evenly spread between them.
        detector: data sheet, by name or path.
        diffusion: rms spread of charge between pixels (crosstalk), metres.
        tdi: time delay and integration.
    """

    offset: Length = 0.0
    pixels: Annotated[Whole, Field(ge=2, le=1_000_000)]
    pitch: PixelPitch
    spectrum: Spectrum
    detector: Reference
    diffusion: Diffusion = 0.0
    tdi: TdiSpec = TdiSpec()

    @model_validator(mode="after")
    def _spectrum_rises(self) -> "BandSpec":
        first, last = self.spectrum
        if not first <= last:
            found = f"[{format_quantity(first, LENGTH)}, {format_quantity(last, LENGTH)}]"
            raise Problem("the spectrum's wavelengths are in the wrong order", found, "[shortest, longest]")
        return self

    @property
    def exposure(self) -> float:
        """Of all stages, over which dark current is collected, seconds; the data sheet gives it for all stages."""
        return self.tdi.stages * self.tdi.line_time

    @property
    def nyquist(self) -> float:
        """Nyquist frequency of the pixels, cycles/m."""
        return 0.5 / self.pitch


IMAGE = "image"
Vary = Literal["radius", "conic", "A4", "A6", "A8", "z"]


class CameraDesignSpec(Spec):
    """What is to be optimised.

    The focal length along the line, the entrance pupil, the field and its bias stay as they are.

    Attributes:
        camera: prescription to start from, by name or path.
        name: of the new camera.
        description: of the new camera, for people.
        vary: mirror, or ``image`` -> what of it varies.
        envelope: extent along the parent axis over all mirrors and the image, relative to the start's; the largest.
        clearance: least distance of every beam, in the plane of symmetry, from the edge of every mirror and of the
            focal plane that it passes, metres.
        steps: in which the envelope is brought from the start's to the goal's.
        seed: nothing is drawn; there for the command's sake.
    """

    camera: Reference
    name: Name
    description: Text = ""
    vary: Annotated[Named[tuple[Vary, ...]], Field(min_length=1)]
    envelope: Annotated[float, Quantity(SCALE, above_zero=True, largest="200 percent")] | None = None
    clearance: Length = 0.02
    steps: Annotated[Whole, Field(ge=1, le=100)] = 8
    seed: Annotated[Whole, Field(ge=0, le=0)] = 0

    @model_validator(mode="after")
    def _image_moves_only_along_z(self) -> "CameraDesignSpec":
        for name, quantities in self.vary.items():
            wrong = [q for q in quantities if name == IMAGE and q != "z"]
            if wrong:
                raise Problem("the image is a plane", wrong[0], "z", within=("vary", name))
        return self


FieldAngle = Annotated[float, Quantity(ANGLE, largest="45 deg")]


class SagTerms:
    """Annotation of a mapping from names of ``SAG_TERMS`` to their numbers, those that are registered when the file is
    read; in the model the terms themselves.
    """

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Read by ``_read``, written as it was read."""
        as_text = core_schema.plain_serializer_function_ser_schema(self._written, when_used="json-unless-none")
        return core_schema.no_info_plain_validator_function(self._read, serialization=as_text)

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        """The kinds at this moment with their numbers."""

        def value(power: int) -> JsonSchemaValue:
            if not power:
                return {"type": "number"}
            return Quantity(power_of_length(power)).__get_pydantic_json_schema__(schema, handler)

        kinds = {name: {key: value(power) for key, power in kind.POWERS.items()} for name, kind in SAG_TERMS.items()}
        terms = {
            name: {"type": "object", "properties": keys, "additionalProperties": False} for name, keys in kinds.items()
        }
        return {"type": "object", "properties": terms, "additionalProperties": False}

    def _read(self, value: object) -> FrozenMap[str, SagTerm]:
        terms = {}
        for name, given in _mapping(value, SAG_TERMS, "no such term of a sag").items():
            kind = SAG_TERMS[name]
            units = kind.POWERS
            numbers = _mapping(given, units, "unknown key", (name,))
            terms[name] = kind(**{key: _number(numbers[key], units[key], (name, key)) for key in numbers})
        return FrozenMap(terms)

    def _written(self, terms: Mapping[str, SagTerm]) -> dict[str, dict[str, object]]:
        return {
            name: {
                key: format_quantity(number, power_of_length(power)) if power else number
                for key, power in term.POWERS.items()
                if (number := getattr(term, key)) != 0.0
            }
            for name, term in terms.items()
        }


def _mapping(value: object, names: Mapping[str, Any], problem: str, within: KeyPath = ()) -> dict[str, Any]:
    """A mapping with no other keys than these."""
    if not isinstance(value, Mapping):
        raise Problem("not a mapping", shown(value), f"a mapping with keys {names_text(names)}", within=within)
    for name in value:
        if name not in names:
            raise Problem(problem, shown(name), names_text(names), nearest(str(name), names), (*within, name))
    return dict(value)


def _number(value: object, power: int, within: KeyPath) -> float:
    """A quantity in metres to a power, or a plain number."""
    try:
        if power:
            return parse_quantity(value, power_of_length(power))
    except Problem as problem:
        problem.within = within
        raise
    if isinstance(value, bool) or not isinstance(value, int | float) or not isfinite(value):
        raise Problem("not a number", shown(value), "a plain number, without a unit", within=within)
    return float(value)


class MirrorSpec(Spec):
    """A mirror about the parent axis; of revolution, unless ``sag`` has terms that are not.

    Attributes:
        z: vertex on the parent axis, metres; light enters toward +z.
        radius: vertex radius of curvature, metres, positive if the centre of curvature lies toward +z.
        conic: conic constant k.
        aspheric: terms A4, A6, A8 of the sag beyond the conic's, 1/m^3, 1/m^5, 1/m^7; empty for a pure conic.
        sag: further terms of the sag, by kind, each with its numbers.
    """

    z: Length
    radius: Length
    conic: Number = 0.0
    aspheric: AsphereTerms = Field(default_factory=FrozenMap)
    sag: Annotated[FrozenMap[str, SagTerm], SagTerms()] | None = None

    @model_validator(mode="after")
    def _is_curved(self) -> "MirrorSpec":
        if self.radius == 0.0:
            raise Problem("a radius of curvature cannot be zero", "0 m", "a length other than zero", within=("radius",))
        return self


class FieldSpec(Spec):
    """Half angles of the field of view, radians: x along the line CCD, y across it, about the field bias."""

    x: Annotated[float, Quantity(ANGLE, above_zero=True, largest="45 deg")]
    y: Annotated[float, Quantity(ANGLE, above_zero=True, largest="45 deg")]


class ImageSpec(Spec):
    """The focal plane.

    Attributes:
        z: where it crosses the parent axis, metres.
        tilt: about the prescription's x, along the line CCD, radians; left out for a plane square to the axis.
    """

    z: Length
    tilt: Annotated[float, Quantity(ANGLE, largest="45 deg")] | None = None


class LineSpec(Spec):
    """The line CCD, centred on the field bias: number of pixels and their pitch, metres."""

    pixels: Annotated[Whole, Field(ge=2, le=1_000_000)]
    pitch: PixelPitch


class CameraSpec(Spec):
    """An off-axis mirror camera.

    Attributes:
        name: as the file is called.
        description: for people.
        focal_length: nominal, metres; the trace tells the exact one.
        entrance_pupil: diameter of the entrance pupil, metres.
        field_bias: angle of the line CCD's centre from the parent axis, in the plane of symmetry, radians.
        field: half angles about the field bias.
        wavelength: design wavelength, metres.
        stop: name of the mirror that is the aperture stop.
        mirrors: by name, in the order in which the light meets them.
        image: focal plane.
        line: line CCD.
        bands: line CCDs by spectral band, for images of targets; empty when none is described.
        edge_margin: by how much a mirror's clear aperture is wider than the beams that use it, metres.
    """

    name: Name
    description: Text = ""
    focal_length: PositiveLength
    entrance_pupil: PositiveLength
    field_bias: FieldAngle
    field: FieldSpec
    wavelength: Wavelength
    stop: Name
    mirrors: Annotated[Named[MirrorSpec], Field(min_length=1)]
    image: ImageSpec
    line: LineSpec
    bands: Named[BandSpec] = Field(default_factory=FrozenMap)
    edge_margin: Annotated[float, Quantity(LENGTH, smallest="0 mm", largest="1 m")] = 0.005

    @model_validator(mode="after")
    def _stop_is_a_mirror(self) -> "CameraSpec":
        if self.stop not in self.mirrors:
            names = names_text(self.mirrors)
            raise Problem(
                "the stop is not one of the mirrors",
                shown(self.stop),
                names,
                nearest(self.stop, self.mirrors),
                ("stop",),
            )
        return self
