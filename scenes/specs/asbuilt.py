"""An instrument as it was built: what was measured on it, what may be moved, and what is asked of it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, model_validator

from optics.geometry.zernike import MAX_NOLL
from optics.numerics.number_tree import FrozenMap
from scenes.specs import load
from scenes.specs.course import noll
from scenes.specs.disturbances import DisturbancesSpec
from scenes.specs.resolved import ExperimentSetup, ResolvedJob, resolve_on
from scenes.specs.tolerance import Amount, CompensatorSpec, FieldShare, MeritSpec
from scenes.yaml.errors import Problem, names_text, unknown
from scenes.yaml.spec import (
    Flag,
    Name,
    Named,
    NothingIsEmpty,
    Number,
    Ref,
    Reference,
    Seed,
    Spec,
    Text,
    Whole,
    one_given,
)
from scenes.yaml.unit_fields import Quantity, Vector
from scenes.yaml.units import ANGLE, LENGTH, TEMPERATURE_DIFFERENCE

Fields = Annotated[tuple[tuple[FieldShare, FieldShare], ...], Field(min_length=1, max_length=200)]
Sigma = Annotated[float, Quantity(LENGTH, above_zero=True, largest="1 m")]
Common = Annotated[float, Quantity(LENGTH, smallest="0 m", largest="1 m")]
Place = Annotated[float, Quantity(LENGTH, largest="100 m")]
Places = Annotated[tuple[Place, ...], Field(min_length=1, max_length=200)]
AngleSigma = Annotated[float, Quantity(ANGLE, above_zero=True, largest="10 deg")]
Turn = Annotated[float, Quantity(ANGLE, largest="10 deg")]
Warmth = Annotated[float, Quantity(TEMPERATURE_DIFFERENCE, largest="300 K")]
WarmthSigma = Annotated[float, Quantity(TEMPERATURE_DIFFERENCE, above_zero=True, largest="100 K")]
Place3 = Annotated[tuple[float, float, float], Vector(Quantity(LENGTH, largest="1 m"))]
Modulation = Annotated[Number, Field(ge=0.0, le=1.0)]
FREE = "free"
Focus = Literal["free"] | Annotated[float, Quantity(LENGTH, smallest="0 m", largest="1 m")]
"""`free`, or the standard deviation of where the focus of an interferometer stands along the light, metres."""


class ReadingsSpec(Spec):
    """Base of what every kind of measurement says.

    Attributes
    ----------
    after : Name | None
        The last of `moves` that had been made when it was taken; none by default.
    """

    after: Name | None = None

    @property
    def given(self) -> bool:
        """Whether its data are in the file or named there."""
        raise NotImplementedError


class WavefrontReadingsSpec(ReadingsSpec):
    """Wavefronts at fields, by an interferometer in single or double pass. Piston and tilt never count.

    Attributes
    ----------
    after
        The last of `moves` that had been made when it was taken; none by default.
    fields : Fields
        Shares of the half field, along the line and along the track.
    terms : tuple[Text, Text]
        First and last Zernike term (Noll) that count, `[Z4, Z11]`.
    sigma : Sigma
        Standard deviation of each coefficient's noise, rms, metres.
    common : Common
        Standard deviation of an error of each term that is the same at all fields, as of a reference surface, metres.
    focus : Focus
        `free`, by default: where the interferometer's focus stood along the light at each field is not known; or its
        standard deviation along the light.
    zernikes : Reference | None
        CSV file with the coefficients of every field.
    maps : tuple[Reference, ...] | None
        Files of wavefront maps, one for each field: Zygo .dat or .datx, CODE V INT, Zemax grid sag, FITS.
    double_pass : Flag
        Whether the light went through the camera twice, so that the maps or coefficients show twice the error.
    reference : Reference | None
        Map or CSV file of the reference surface's error, which is taken off.
    orientation : Text
        How maps and coefficients have to be turned to the stop's axes, as `check` names it.
    sign : Literal[1, -1]
        -1 where the file counts a wavefront that is ahead as negative.
    """

    fields: Fields
    terms: tuple[Text, Text] = ("Z4", "Z11")
    sigma: Sigma
    common: Common = 0.0
    focus: Focus = "free"
    zernikes: Reference | None = None
    maps: Annotated[tuple[Reference, ...], Field(min_length=1, max_length=200)] | None = None
    double_pass: Flag = False
    reference: Reference | None = None
    orientation: Text = "as it is"
    sign: Literal[1, -1] = 1

    @model_validator(mode="after")
    def _terms_are_a_range(self) -> WavefrontReadingsSpec:
        first, last = (noll(term) for term in self.terms)
        if not 4 <= first <= last <= MAX_NOLL:
            found = f"{self.terms[0]} to {self.terms[1]}"
            raise Problem("no range of terms", found, f"Z4 to Z11, at most Z{MAX_NOLL}", within=("terms",))
        if self.zernikes is not None and self.maps is not None:
            raise Problem("coefficients and maps", "zernikes and maps", "one of them", within=("maps",))
        if self.maps is not None and len(self.maps) != len(self.fields):
            found, allowed = f"{len(self.maps)} maps", f"{len(self.fields)}, one for each field"
            raise Problem("another number of maps than of fields", found, allowed, within=("maps",))
        return self

    @property
    def numbers(self) -> range:
        """Noll indices of the terms."""
        return range(noll(self.terms[0]), noll(self.terms[1]) + 1)

    @property
    def given(self) -> bool:
        """Whether files are named."""
        return self.zernikes is not None or self.maps is not None


class FocusReadingsSpec(ReadingsSpec):
    """Best focus at fields, along the light of the designed camera, from the line CCD on downstream.

    Attributes
    ----------
    after
        The last of `moves` that had been made when it was taken; none by default.
    fields : Fields | None
        As of wavefronts.
    values : Places | None
        Of each field, metres.
    sigma : Sigma
        Standard deviation of each, metres.
    common : Common
        Standard deviation of an error that all have in common, metres.
    file : Reference | None
        In place of fields and values, the `focus.json` of a run of `twin.lab focus`.
    """

    fields: Fields | None = None
    values: Places | None = None
    sigma: Sigma
    common: Common = 0.0
    file: Reference | None = None

    @model_validator(mode="after")
    def _as_many(self) -> FocusReadingsSpec:
        one_given(self, ("fields", "file"), "where was it measured?", "fields with values, or a focus.json")
        _one_for_each(self.fields, self.values, "values")
        return self

    @property
    def given(self) -> bool:
        """Whether there are values."""
        return self.values is not None or self.file is not None


class MtfReadingsSpec(ReadingsSpec):
    """MTF of the optics at fields, at one frequency.

    Attributes
    ----------
    after
        The last of `moves` that had been made when it was taken; none by default.
    fields : Fields
        As of wavefronts.
    frequency : Number | None
        Cycles per mm; that of the pixels (Nyquist) if not given.
    along_line : tuple[Modulation, ...] | None
        MTF for lines across the line CCD, of each field.
    along_track : tuple[Modulation, ...] | None
        MTF for lines along the line CCD, of each field.
    sigma : Number
        Standard deviation of each.
    """

    fields: Fields
    frequency: Annotated[Number, Field(gt=0.0, le=10_000.0)] | None = None
    along_line: Annotated[tuple[Modulation, ...], Field(min_length=1, max_length=200)] | None = None
    along_track: Annotated[tuple[Modulation, ...], Field(min_length=1, max_length=200)] | None = None
    sigma: Annotated[Number, Field(gt=0.0, le=1.0)]

    @model_validator(mode="after")
    def _as_many(self) -> MtfReadingsSpec:
        if (self.along_line is None) != (self.along_track is None):
            raise Problem("one direction only", "along_line or along_track", "both", within=("along_line",))
        _one_for_each(self.fields, self.along_line, "along_line")
        _one_for_each(self.fields, self.along_track, "along_track")
        return self

    @property
    def given(self) -> bool:
        """Whether there are values."""
        return self.along_line is not None


class DistortionReadingsSpec(ReadingsSpec):
    """Places of images along the line CCD at known angles, which tell principal distance and distortion. The zero of
    the angles is free.

    Attributes
    ----------
    after
        The last of `moves` that had been made when it was taken; none by default.
    fields : tuple[FieldShare, ...] | None
        Shares of half the line at which images were taken, where the data are simulated.
    sigma : Sigma | None
        Standard deviation of a place, metres; of a file its own if not given.
    file : Reference | None
        The `distortion.json` of a run of `twin.lab distortion`.
    """

    fields: Annotated[tuple[FieldShare, ...], Field(min_length=3, max_length=200)] | None = None
    sigma: Sigma | None = None
    file: Reference | None = None

    @model_validator(mode="after")
    def _one_source(self) -> DistortionReadingsSpec:
        one_given(self, ("fields", "file"), "where was it measured?", "a distortion.json, or fields to simulate")
        if self.file is None and self.sigma is None:
            raise Problem("'sigma' is missing", None, "sigma: 0.5 um", within=("sigma",))
        return self

    @property
    def given(self) -> bool:
        """Whether a file is named."""
        return self.file is not None


class SpotReadingsSpec(ReadingsSpec):
    """Spots of the instrument's monitor, against where the design has them.

    Attributes
    ----------
    after
        The last of `moves` that had been made when it was taken; none by default.
    sigma : Number
        Standard deviation of each coordinate, pixels.
    file : Reference | None
        The `recovered.json` of a run of `twin.recover`, or a CSV file with the places: columns camera, channel, row_px,
        column_px.
    state : Literal['before', 'after']
        Whether the spots of `recovered.json` count that were recorded before or after.
    """

    sigma: Annotated[Number, Field(gt=0.0, le=100.0)]
    file: Reference | None = None
    state: Literal["before", "after"] = "before"

    @property
    def given(self) -> bool:
        """Whether a file is named."""
        return self.file is not None


class SightReadingsSpec(ReadingsSpec):
    """Line of sight, roll and principal distance against the design, as of a theodolite or of a calibration in orbit.

    Attributes
    ----------
    after
        The last of `moves` that had been made when it was taken; none by default.
    alpha, beta : Turn | None
        Turns of the line of sight about the camera's Y and X, radians.
    gamma : Turn | None
        Roll of the line about it, radians.
    principal_distance : Place | None
        Its change, metres.
    sigma_alpha, sigma_beta, sigma_gamma : AngleSigma | None
        Standard deviations, radians; of what is not measured they are left out.
    sigma_principal_distance : Sigma | None
        Likewise, metres.
    correlation : tuple[tuple[Number, ...], ...] | None
        Matrix of those that are measured, in this order; the unit matrix by default.
    """

    alpha: Turn | None = None
    beta: Turn | None = None
    gamma: Turn | None = None
    principal_distance: Place | None = None
    sigma_alpha: AngleSigma | None = None
    sigma_beta: AngleSigma | None = None
    sigma_gamma: AngleSigma | None = None
    sigma_principal_distance: Sigma | None = None
    correlation: tuple[tuple[Annotated[Number, Field(ge=-1.0, le=1.0)], ...], ...] | None = None

    @model_validator(mode="after")
    def _complete(self) -> SightReadingsSpec:
        if not self.measured:
            raise Problem("nothing was measured", None, "sigma_alpha: 0.5 arcsec ...", within=("sigma_alpha",))
        count = len(self.measured)
        rows = self.correlation
        if rows is not None and (len(rows) != count or any(len(row) != count for row in rows)):
            raise Problem("not a matrix of this size", None, f"{count} rows of {count}", within=("correlation",))
        values = [getattr(self, name) is not None for name in self.measured]
        if any(values) and not all(values):
            missing = self.measured[values.index(False)]
            raise Problem(f"{missing!r} is missing", None, f"{missing}: ...", within=(missing,))
        return self

    @property
    def measured(self) -> tuple[str, ...]:
        """Which of the four were measured."""
        names = ("alpha", "beta", "gamma", "principal_distance")
        return tuple(name for name in names if getattr(self, f"sigma_{name}") is not None)

    @property
    def given(self) -> bool:
        """Whether there are values."""
        return getattr(self, self.measured[0]) is not None


class TemperatureReadingsSpec(ReadingsSpec):
    """Temperatures of bodies against that at which the instrument is as drawn.

    Attributes
    ----------
    after
        The last of `moves` that had been made when it was taken; none by default.
    bodies : tuple[Text, ...]
        Paths or short names.
    values : tuple[Warmth, ...] | None
        Of each body, kelvin.
    sigma : WarmthSigma
        Standard deviation of each, kelvin.
    common : float
        Standard deviation of an error that all have in common, kelvin.
    """

    bodies: Annotated[tuple[Text, ...], Field(min_length=1, max_length=100)]
    values: Annotated[tuple[Warmth, ...], Field(min_length=1)] | None = None
    sigma: WarmthSigma
    common: Annotated[float, Quantity(TEMPERATURE_DIFFERENCE, smallest="0 K", largest="100 K")] = 0.0

    @model_validator(mode="after")
    def _as_many(self) -> TemperatureReadingsSpec:
        _one_for_each(self.bodies, self.values, "values")
        return self

    @property
    def given(self) -> bool:
        """Whether there are values."""
        return self.values is not None


class PositionReadingsSpec(ReadingsSpec):
    """Places of bodies' origins against the drawing, by a laser tracker or a coordinate-measuring machine.

    Attributes
    ----------
    after
        The last of `moves` that had been made when it was taken; none by default.
    bodies : tuple[Text, ...]
        Paths or short names.
    values : tuple[Place3, ...] | None
        Displacement of each in the axes of the instrument's base, metres.
    sigma : Sigma
        Standard deviation of each coordinate, metres.
    frame : Literal['free', 'base']
        `free`, by default with three bodies or more: the frame of the measuring machine may be shifted and turned;
        `base` where it is the instrument's.
    """

    bodies: Annotated[tuple[Text, ...], Field(min_length=1, max_length=100)]
    values: Annotated[tuple[Place3, ...], Field(min_length=1)] | None = None
    sigma: Sigma
    frame: Literal["free", "base"] = "base"

    @model_validator(mode="after")
    def _as_many(self) -> PositionReadingsSpec:
        _one_for_each(self.bodies, self.values, "values")
        if self.frame == FREE and len(self.bodies) < 3:
            found = f"{len(self.bodies)} bodies"
            raise Problem("too few bodies for a free frame", found, "three bodies, or frame: base", within=("frame",))
        return self

    @property
    def given(self) -> bool:
        """Whether there are values."""
        return self.values is not None


def _one_for_each(places: Any, values: Any, key: str) -> None:
    if places is not None and values is not None and len(values) != len(places):
        raise Problem("another number of values than of places", str(len(values)), str(len(places)), within=(key,))


class MeasurementsSpec(Spec):
    """What was measured, kind by kind; each measurement has a name of its own.

    Attributes
    ----------
    wavefronts : Named[WavefrontReadingsSpec]
        By interferometers.
    focus : Named[FocusReadingsSpec]
        Best focus by field.
    mtf : Named[MtfReadingsSpec]
        At fields.
    distortion : Named[DistortionReadingsSpec]
        Places along the line at known angles.
    spots : Named[SpotReadingsSpec]
        Of the monitor.
    sight : Named[SightReadingsSpec]
        Lines of sight and principal distances.
    temperatures : Named[TemperatureReadingsSpec]
        Of bodies.
    positions : Named[PositionReadingsSpec]
        Of bodies.
    """

    wavefronts: Annotated[Named[WavefrontReadingsSpec], NothingIsEmpty] = Field(default_factory=FrozenMap)
    focus: Annotated[Named[FocusReadingsSpec], NothingIsEmpty] = Field(default_factory=FrozenMap)
    mtf: Annotated[Named[MtfReadingsSpec], NothingIsEmpty] = Field(default_factory=FrozenMap)
    distortion: Annotated[Named[DistortionReadingsSpec], NothingIsEmpty] = Field(default_factory=FrozenMap)
    spots: Annotated[Named[SpotReadingsSpec], NothingIsEmpty] = Field(default_factory=FrozenMap)
    sight: Annotated[Named[SightReadingsSpec], NothingIsEmpty] = Field(default_factory=FrozenMap)
    temperatures: Annotated[Named[TemperatureReadingsSpec], NothingIsEmpty] = Field(default_factory=FrozenMap)
    positions: Annotated[Named[PositionReadingsSpec], NothingIsEmpty] = Field(default_factory=FrozenMap)

    @model_validator(mode="after")
    def _names_once(self) -> MeasurementsSpec:
        seen: dict[str, str] = {}
        for kind, name, _ in self.every():
            if name in seen:
                raise Problem("two measurements have one name", name, "a name of its own", within=(kind, name))
            seen[name] = kind
        return self

    def every(self) -> Iterator[tuple[str, str, ReadingsSpec]]:
        """Kind, name and content of each measurement."""
        for kind in type(self).model_fields:
            for name, one in getattr(self, kind).items():
                yield kind, name, one


class ActuatorSpec(CompensatorSpec):
    """One thing that can be moved.

    Attributes
    ----------
    motion
        What is moved: `M2 shift z`.
    carrying
        Further bodies that move rigidly with it.
    range
        Largest amount either way, all moves together.
    step
        Of which it is moved by a whole number, as of shims; None for any amount.
    accuracy
        Standard deviation of a move, whatever its size.
    move_error : Number
        Standard deviation of a move as a share of it.
    response : Number
        Standard deviation of what the traced response of the instrument to it may be wrong by, as a share.
    """

    move_error: Annotated[Number, Field(ge=0.0, le=1.0)] = 0.02
    response: Annotated[Number, Field(ge=0.0, le=1.0)] = 0.0


def _some_amounts(value: Mapping[str, Amount]) -> Mapping[str, Amount]:
    if not value:
        raise Problem("nothing is moved", None, "by: {M2_z: 15 um}")
    return FrozenMap(value)


class MoveSpec(Spec):
    """A move that was made.

    Attributes
    ----------
    by : dict[Name, Amount]
        Actuator -> by how much.
    """

    by: Annotated[dict[Name, Amount], AfterValidator(_some_amounts)]


class SimulatedInstrumentSpec(Spec):
    """An instrument that is drawn, measured and moved by the program, in place of a real one.

    Attributes
    ----------
    law : Literal['normal', 'uniform']
        How its motions are distributed, with the prior's covariance.
    prior : Ref | None
        Disturbances file it is drawn from; that of the estimate by default.
    seed : Seed
        Of the instrument and of all errors of measurement.
    """

    law: Literal["normal", "uniform"] = "normal"
    prior: Ref | None = None
    seed: Seed = 0


class AsBuiltSpec(Spec):
    """The state of one instrument from everything that was measured on it.

    Attributes
    ----------
    instrument : Ref
        a camera or an instrument, by name or path, as in a job.
    camera : Name | None
        Which camera of an instrument is meant; may be left out where there is one.
    prior : Ref
        Disturbances file: what is known of the state before anything is measured.
    measurements : MeasurementsSpec
        By kind and name.
    merits : Named[MeritSpec]
        By name, what is asked of the camera, as in a tolerance budget.
    actuators : Named[ActuatorSpec]
        By name, what can be moved.
    moves : Named[MoveSpec]
        By name, in their order, what was moved.
    candidates : MeasurementsSpec
        Measurements that could be made next; their worth is told.
    draws : Whole
        States of the posterior that are traced for the merits.
    seed : Seed
        Of these draws.
    simulate : SimulatedInstrumentSpec | None
        a drawn instrument in place of data.
    """

    instrument: Ref
    camera: Name | None = None
    prior: Ref = "assembled"
    measurements: MeasurementsSpec
    merits: Annotated[Named[MeritSpec], Field(min_length=1, max_length=50)]
    actuators: Annotated[Named[ActuatorSpec], NothingIsEmpty] = Field(default_factory=FrozenMap)
    moves: Annotated[Named[MoveSpec], NothingIsEmpty] = Field(default_factory=FrozenMap)
    candidates: Annotated[MeasurementsSpec, NothingIsEmpty] = MeasurementsSpec.model_construct()
    draws: Annotated[Whole, Field(ge=20, le=100_000)] = 200
    seed: Seed = 0
    simulate: Annotated[SimulatedInstrumentSpec, NothingIsEmpty] | None = None

    @model_validator(mode="after")
    def _belongs_together(self) -> AsBuiltSpec:
        if not any(True for _ in self.measurements.every()):
            kinds = names_text(MeasurementsSpec.model_fields)
            raise Problem("nothing was measured", None, f"at least one measurement: {kinds}", within=("measurements",))
        for kind, name, one in self.measurements.every():
            where = ("measurements", kind, name)
            if one.after is not None and one.after not in self.moves:
                raise unknown_within("no such move", one.after, self.moves, (*where, "after"))
            if self.simulate is None and not one.given:
                raise Problem("no data", name, "values or files, or `simulate: {}` to draw them", within=where)
            if self.simulate is not None and one.given:
                raise Problem("data beside `simulate`", name, "one of them", within=where)
        for name, move in self.moves.items():
            for actuator, amount in move.by.items():
                if actuator not in self.actuators:
                    where = ("moves", name, "by")
                    raise unknown_within("no such actuator", actuator, self.actuators, where)
                self.actuators[actuator].si(amount, "by")
        return self


def unknown_within(text: str, found: object, names: Mapping[str, Any], within: tuple[str, ...]) -> Problem:
    """An unknown name at a key below."""
    problem = unknown(text, found, tuple(names))
    return Problem(problem.problem, problem.found, problem.allowed, problem.suggestion, within=within)


class AsBuiltSetup(ExperimentSetup[AsBuiltSpec]):
    """The measurements of an instrument with the instrument and the prior.

    Attributes
    ----------
    base : ResolvedJob
        The nominal job of the instrument, with the prior as its disturbances.
    drawn : DisturbancesSpec | None
        Disturbances from which a simulated instrument is drawn; None for the prior.
    """

    base: ResolvedJob
    drawn: DisturbancesSpec | None = None

    @classmethod
    def parts(cls, test: AsBuiltSpec) -> dict[str, Any]:
        """Return the nominal job, and what a simulated instrument is drawn from."""
        base, simulated = resolve_on(test, test.instrument, test.prior), test.simulate
        if simulated is None or simulated.prior is None:
            return {"base": base}
        return {"base": base, "drawn": load.load_disturbances(simulated.prior, test, ("simulate", "prior"))}
