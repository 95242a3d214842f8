"""Estimation of an instrument's state as built: its measurements, its actuators and its merits."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, model_validator

from optics.geometry.zernike import MAX_NOLL
from optics.numerics.number_tree import FrozenMap
from scenes.specs import load
from scenes.specs.course import Term, noll
from scenes.specs.disturbances import DisturbancesSpec
from scenes.specs.resolved import ExperimentSetup, ResolvedJob, resolve_on
from scenes.specs.tolerance import Amount, CompensatorSpec, FieldShare, MeritSpec
from scenes.yaml import spec
from scenes.yaml.errors import Problem, names_text, unknown
from scenes.yaml.unit_fields import Quantity, Vector
from scenes.yaml.units import ANGLE, LENGTH, TEMPERATURE_DIFFERENCE

Fields = Annotated[tuple[tuple[FieldShare, FieldShare], ...], Field(min_length=1, max_length=200)]
Sigma = Annotated[float, Quantity(LENGTH, above_zero=True, largest="1 m")]
Common = Annotated[float, Quantity(LENGTH, smallest="0 m", largest="1 m")]
Position = Annotated[float, Quantity(LENGTH, largest="100 m")]
Positions = Annotated[tuple[Position, ...], Field(min_length=1, max_length=200)]
AngleSigma = Annotated[float, Quantity(ANGLE, above_zero=True, largest="10 deg")]
SmallAngle = Annotated[float, Quantity(ANGLE, largest="10 deg")]
Warmth = Annotated[float, Quantity(TEMPERATURE_DIFFERENCE, largest="300 K")]
WarmthSigma = Annotated[float, Quantity(TEMPERATURE_DIFFERENCE, above_zero=True, largest="100 K")]
Place3 = Annotated[tuple[float, float, float], Vector(Quantity(LENGTH, largest="1 m"))]
Modulation = Annotated[spec.Number, Field(ge=0.0, le=1.0)]
FREE = "free"
Focus = Literal["free"] | Annotated[float, Quantity(LENGTH, smallest="0 m", largest="1 m")]
"""`free`, or the standard deviation of the position of an interferometer's focus along the light, in metres."""


class ReadingsSpec(spec.Spec):
    """Base of all kinds of measurement of an instrument as built.

    Attributes
    ----------
    after : str | None
        Name of the last of the `moves` that was made before this measurement; by default none had been made.
    """

    after: spec.Name | None = None

    @property
    def has_data(self) -> bool:
        """True if the file holds the data or refers to a file of data."""
        return any(
            getattr(self, key, None) is not None for key in ("values", "along_line", "file", "pair", "zernikes", "maps")
        )

    @model_validator(mode="after")
    def _one_for_each(self) -> ReadingsSpec:
        positions = getattr(self, "fields", None) or getattr(self, "bodies", None)
        for key in ("values", "along_line", "along_track"):
            values = getattr(self, key, None)
            if positions is not None and values is not None and len(values) != len(positions):
                count, wanted = str(len(values)), str(len(positions))
                raise Problem("not one value for each position", count, wanted, within=(key,))
        return self


class WavefrontReadingsSpec(ReadingsSpec):
    """Wavefronts at several fields, by an interferometer in single or double pass. Piston and tilt are not used.

    Attributes
    ----------
    fields : tuple[tuple[float, float], ...]
        Fields as fractions of the half field, [along the line, along the track].
    terms : tuple[str, str]
        First and last Zernike term (Noll) that are used, `[Z4, Z11]`.
    sigma : float
        Standard deviation of the noise of each coefficient, rms, in metres.
    common : float
        Standard deviation of an error of each term that is the same at all fields, such as that of a reference surface,
        in metres.
    focus : float | 'free'
        Standard deviation of the position of the interferometer's focus along the light at each field, in metres;
        `free`, the default, if it is unknown.
    zernikes : str | None
        CSV file with the coefficients of every field.
    maps : tuple[str, ...] | None
        Files of wavefront maps, one for each field: Zygo .dat or .datx, CODE V INT, Zemax grid sag, FITS.
    double_pass : bool
        True if the light passed the camera twice, so that maps or coefficients show twice the error.
    reference : str | None
        Map or CSV file of the reference surface's error, which is subtracted; none by default.
    orientation : str
        Rotation or reflection that brings maps and coefficients to the stop's axes, in the words of `check`.
    sign : {1, -1}
        Sign convention of the file; -1 if an advanced wavefront is counted as negative.
    """

    fields: Fields
    terms: tuple[spec.Text, spec.Text] = ("Z4", "Z11")
    sigma: Sigma
    common: Common = 0.0
    focus: Focus = "free"
    zernikes: spec.Reference | None = None
    maps: Annotated[tuple[spec.Reference, ...], Field(min_length=1, max_length=200)] | None = None
    double_pass: spec.Flag = False
    reference: spec.Reference | None = None
    orientation: spec.Text = "as it is"
    sign: Literal[1, -1] = 1

    @model_validator(mode="after")
    def _terms_are_a_range(self) -> WavefrontReadingsSpec:
        first, last = (noll(term) for term in self.terms)
        if not 4 <= first <= last <= MAX_NOLL:
            value = f"{self.terms[0]} to {self.terms[1]}"
            raise Problem("not a range of terms", value, f"Z4 to Z11, at most Z{MAX_NOLL}", within=("terms",))
        if self.zernikes is not None and self.maps is not None:
            raise Problem("coefficients and maps", "zernikes and maps", "one of them", within=("maps",))
        if self.maps is not None and len(self.maps) != len(self.fields):
            value, allowed = f"{len(self.maps)} maps", f"{len(self.fields)}, one for each field"
            raise Problem("the number of maps differs from the number of fields", value, allowed, within=("maps",))
        return self

    @property
    def numbers(self) -> range:
        """Noll indices of the Zernike terms that are used, from the first to the last of `terms`."""
        return range(noll(self.terms[0]), noll(self.terms[1]) + 1)


class FocusReadingsSpec(ReadingsSpec):
    """Position of best focus at several fields, along the designed camera's light.

    Positions are counted downstream from the line CCD.

    Attributes
    ----------
    fields : tuple[tuple[float, float], ...] | None
        Fields as fractions of the half field, [along the line, along the track].
    values : tuple[float, ...] | None
        Position of best focus at each field, downstream of the line CCD, in metres.
    sigma : float
        Standard deviation of each position, in metres.
    common : float
        Standard deviation of an error that all positions have in common, in metres.
    file : str | None
        Result `focus.json` of a run of `twin.lab focus`, instead of fields and values.
    """

    fields: Fields | None = None
    values: Positions | None = None
    sigma: Sigma
    common: Common = 0.0
    file: spec.Reference | None = None

    @model_validator(mode="after")
    def _as_many(self) -> FocusReadingsSpec:
        spec.require_one(self, ("fields", "file"), "where was it measured?", "fields with values, or a focus.json")
        return self


class RecordedImagesSpec(ReadingsSpec):
    """Base of measurements that may be images of the camera's detector.

    Attributes
    ----------
    gain : float
        Electrons per grey value.
    saturation : float | None
        Grey value from which a pixel is saturated and is not used; by default the largest that the file can hold.
    orientation : str
        Rotation or reflection that brings the images to columns along the line and rows along the track, in the words
        of `check`.
    """

    gain: Annotated[spec.Number, Field(gt=0.0, le=1e6)] = 1.0
    saturation: Annotated[spec.Number, Field(gt=0.0)] | None = None
    orientation: spec.Text = "as it is"


class MtfReadingsSpec(RecordedImagesSpec):
    """MTF of the optics at several fields and one spatial frequency, or its ratio in two positions of the focal plane.

    Attributes
    ----------
    fields : tuple[tuple[float, float], ...]
        Fields as fractions of the half field, [along the line, along the track].
    frequency : float | None
        Spatial frequency, in cycles per mm; by default the Nyquist frequency of the pixels.
    along_line : tuple[float, ...] | None
        MTF at each field for a pattern of lines perpendicular to the line CCD.
    along_track : tuple[float, ...] | None
        MTF at each field for a pattern of lines parallel to the line CCD.
    sigma : float | None
        Standard deviation of each MTF value; of a `pair`, of an error of each ratio, as a fraction, that is added to
        that of the images, 0 by default.
    defocus : float
        Shift of the focal plane along its normal, downstream, during the measurement, in metres. The MTF in focus does
        not have a sign of defocus; that of a page of edges out of focus by more than the prior's sigma has.
    reference_defocus : float | None
        Shift of the focal plane during the exposure of reference images. Readings are then the logarithms of the ratios
        of the MTF with `defocus` to that with this shift.
    pair : tuple[str, str] | None
        Images of ordinary textured scenes with `reference_defocus` and with `defocus`, FITS or TIFF files with a page
        for each field, in their order; both show the same scene, and values are linear in light.
    read_noise : float | None
        Standard deviation of the noise of a pixel without light in a `pair`, in electrons; by default all that the
        images do not have in common is noise.
    black_level : float
        Grey value without light in a `pair`.
    """

    fields: Fields
    frequency: Annotated[spec.Number, Field(gt=0.0, le=10_000.0)] | None = None
    along_line: Annotated[tuple[Modulation, ...], Field(min_length=1, max_length=200)] | None = None
    along_track: Annotated[tuple[Modulation, ...], Field(min_length=1, max_length=200)] | None = None
    sigma: Annotated[spec.Number, Field(gt=0.0, le=1.0)] | None = None
    defocus: Annotated[float, Quantity(LENGTH, largest="100 mm")] = 0.0
    reference_defocus: Annotated[float, Quantity(LENGTH, largest="100 mm")] | None = None
    pair: tuple[spec.Reference, spec.Reference] | None = None
    read_noise: Annotated[spec.Number, Field(ge=0.0, le=1e6)] | None = None
    black_level: spec.Number = 0.0

    @model_validator(mode="after")
    def _complete(self) -> MtfReadingsSpec:
        if (self.along_line is None) != (self.along_track is None):
            raise Problem("MTF along one direction only", "along_line or along_track", "both", within=("along_line",))
        if self.sigma is None and self.pair is None:
            raise Problem("'sigma' is missing", None, "sigma: 0.005, or a pair of images", within=("sigma",))
        if self.reference_defocus is None:
            if self.pair is not None:
                allowed = "reference_defocus, that of the first image"
                raise Problem("the focus of the first image is missing", None, allowed, within=("reference_defocus",))
            for key in ("gain", "saturation", "orientation", "read_noise", "black_level"):
                if key in self.model_fields_set:
                    raise Problem(f"values of MTF have no {key}", key, f"{key} with a pair of images", within=(key,))
            return self
        if self.along_line is not None:
            allowed = "a pair of images, or `simulate: {}`"
            raise Problem("values of one image with a reference", "along_line", allowed, within=("along_line",))
        if self.frequency is None:
            allowed = "a low one, at which the MTF falls steadily with defocus"
            raise Problem("a ratio of images needs a frequency", None, allowed, within=("frequency",))
        if self.reference_defocus == self.defocus:
            allowed = "two positions of the focal plane; images in the same focus do not show it"
            raise Problem("both images have the same defocus", None, allowed, within=("reference_defocus",))
        return self


class DistortionReadingsSpec(ReadingsSpec):
    """Positions of images along the line CCD at known angles, which determine principal distance and distortion.

    The zero of the angles is unknown and is estimated.

    Attributes
    ----------
    fields : tuple[float, ...] | None
        Fields of the images as fractions of half the line, for simulated data.
    sigma : float | None
        Standard deviation of a position, in metres; by default that of the file.
    file : str | None
        Result `distortion.json` of a run of `twin.lab distortion`.
    """

    fields: Annotated[tuple[FieldShare, ...], Field(min_length=3, max_length=200)] | None = None
    sigma: Sigma | None = None
    file: spec.Reference | None = None

    @model_validator(mode="after")
    def _one_source(self) -> DistortionReadingsSpec:
        spec.require_one(self, ("fields", "file"), "where was it measured?", "a distortion.json, or fields to simulate")
        if self.file is None and self.sigma is None:
            raise Problem("'sigma' is missing", None, "sigma: 0.5 um", within=("sigma",))
        return self


class SpotReadingsSpec(ReadingsSpec):
    """Spot positions of the instrument's monitor, relative to those of the design.

    Attributes
    ----------
    sigma : float
        Standard deviation of each coordinate, in pixels.
    file : str | None
        Result `recovered.json` of a run of `twin.recover`, or a CSV file of the positions with the columns camera,
        channel, row_px, column_px.
    state : {'before', 'after'}
        Set of spots in `recovered.json` that is used: those recorded before or after the change.
    """

    sigma: Annotated[spec.Number, Field(gt=0.0, le=100.0)]
    file: spec.Reference | None = None
    state: Literal["before", "after"] = "before"


class SightReadingsSpec(ReadingsSpec):
    """Line of sight, roll and principal distance relative to the design, from a theodolite or a calibration in orbit.

    Attributes
    ----------
    alpha : float | None
        Rotation of the line of sight about the camera's Y, in radians.
    beta : float | None
        Rotation of the line of sight about the camera's X, in radians.
    gamma : float | None
        Rotation of the line CCD about the line of sight, in radians.
    principal_distance : float | None
        Change of the principal distance, in metres.
    sigma_alpha : float | None
        Standard deviation of `alpha`, in radians; omitted if it is not measured.
    sigma_beta : float | None
        Standard deviation of `beta`, in radians; omitted if it is not measured.
    sigma_gamma : float | None
        Standard deviation of `gamma`, in radians; omitted if it is not measured.
    sigma_principal_distance : float | None
        Standard deviation of the principal distance, in metres; omitted if it is not measured.
    correlation : tuple[tuple[float, ...], ...] | None
        Correlation matrix of the measured quantities in the order alpha, beta, gamma, principal distance; by default
        they are uncorrelated.
    """

    alpha: SmallAngle | None = None
    beta: SmallAngle | None = None
    gamma: SmallAngle | None = None
    principal_distance: Position | None = None
    sigma_alpha: AngleSigma | None = None
    sigma_beta: AngleSigma | None = None
    sigma_gamma: AngleSigma | None = None
    sigma_principal_distance: Sigma | None = None
    correlation: tuple[tuple[Annotated[spec.Number, Field(ge=-1.0, le=1.0)], ...], ...] | None = None

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
        """Names of the quantities that are measured: alpha, beta, gamma or principal_distance."""
        names = ("alpha", "beta", "gamma", "principal_distance")
        return tuple(name for name in names if getattr(self, f"sigma_{name}") is not None)

    @property
    def has_data(self) -> bool:
        """True if the file holds measured angles or a measured principal distance."""
        return getattr(self, self.measured[0]) is not None


class TemperatureReadingsSpec(ReadingsSpec):
    """Temperatures of bodies relative to the temperature at which the instrument has the shape of the design.

    Attributes
    ----------
    bodies : tuple[str, ...]
        Paths or short names of the bodies.
    values : tuple[float, ...] | None
        Temperature difference of each body, in kelvin.
    sigma : float
        Standard deviation of each temperature, in kelvin.
    common : float
        Standard deviation of an error that all temperatures have in common, in kelvin.
    """

    bodies: Annotated[tuple[spec.Text, ...], Field(min_length=1, max_length=100)]
    values: Annotated[tuple[Warmth, ...], Field(min_length=1)] | None = None
    sigma: WarmthSigma
    common: Annotated[float, Quantity(TEMPERATURE_DIFFERENCE, smallest="0 K", largest="100 K")] = 0.0


class PositionReadingsSpec(ReadingsSpec):
    """Positions of bodies' origins relative to the design, by a laser tracker or a coordinate-measuring machine.

    Attributes
    ----------
    bodies : tuple[str, ...]
        Paths or short names of the bodies.
    values : tuple[tuple[float, float, float], ...] | None
        Displacement of each body in the axes of the instrument's base, in metres.
    sigma : float
        Standard deviation of each coordinate, in metres.
    frame : {'free', 'base'}
        Reference frame of the measuring machine: `base` for the instrument's base, or `free` for one with an unknown
        shift and rotation, which needs three bodies or more.
    """

    bodies: Annotated[tuple[spec.Text, ...], Field(min_length=1, max_length=100)]
    values: Annotated[tuple[Place3, ...], Field(min_length=1)] | None = None
    sigma: Sigma
    frame: Literal["free", "base"] = "base"

    @model_validator(mode="after")
    def _as_many(self) -> PositionReadingsSpec:
        if self.frame == FREE and len(self.bodies) < 3:
            value = f"{len(self.bodies)} bodies"
            raise Problem("too few bodies for a free frame", value, "three bodies, or frame: base", within=("frame",))
        return self


class ImageReadingsSpec(RecordedImagesSpec):
    """Images of stars, in focus or defocused, one for each field and all in one position of the focal plane.

    Columns run along the line and rows along the track, toward +Y and +X of the focal plane. Position, flux and
    background of every star are estimated with the state.

    Attributes
    ----------
    fields : tuple[tuple[float, float], ...]
        Fields of the stars as fractions of the half field, [along the line, along the track].
    file : str | None
        FITS or TIFF file with a page of the same size for each field, in their order; values are linear in light.
    defocus : float
        Shift of the focal plane downstream during the exposure, in metres. A shift by an actuator is one of the
        `moves` instead, and its error is estimated.
    seeing : float | 'free'
        Full width at half maximum of the Gaussian blur by air and motion, in radians; `free` to estimate it for every
        star, 0 by default.
    read_noise : float
        Standard deviation of the noise of a pixel without light, in electrons.
    pixels : int
        Rows and columns of simulated images.
    flux : float
        Electrons of a simulated star.
    background : float
        Electrons of background in a pixel of simulated images.
    """

    fields: Annotated[tuple[tuple[FieldShare, FieldShare], ...], Field(min_length=1, max_length=25)]
    file: spec.Reference | None = None
    defocus: Annotated[float, Quantity(LENGTH, largest="100 mm")] = 0.0
    seeing: Literal["free"] | Annotated[float, Quantity(ANGLE, smallest="0 arcsec", largest="1 arcmin")] = 0.0
    read_noise: Annotated[spec.Number, Field(gt=0.0, le=1e6)]
    pixels: Annotated[spec.Whole, Field(ge=8, le=256)] = 32
    flux: Annotated[spec.Number, Field(gt=0.0, le=1e12)] = 1e6
    background: Annotated[spec.Number, Field(ge=0.0, le=1e9)] = 0.0


class MeasurementsSpec(spec.Spec):
    """Measurements by kind; each has a name of your choice.

    Attributes
    ----------
    wavefronts : Mapping[str, WavefrontReadingsSpec]
        Name -> wavefronts by an interferometer.
    focus : Mapping[str, FocusReadingsSpec]
        Name -> positions of best focus by field.
    mtf : Mapping[str, MtfReadingsSpec]
        Name -> MTF at fields.
    distortion : Mapping[str, DistortionReadingsSpec]
        Name -> image positions along the line at known angles.
    spots : Mapping[str, SpotReadingsSpec]
        Name -> spots of the monitor.
    sight : Mapping[str, SightReadingsSpec]
        Name -> line of sight and principal distance.
    temperatures : Mapping[str, TemperatureReadingsSpec]
        Name -> temperatures of bodies.
    positions : Mapping[str, PositionReadingsSpec]
        Name -> positions of bodies.
    images : Mapping[str, ImageReadingsSpec]
        Name -> images of stars in one position of the focal plane.
    """

    wavefronts: Annotated[spec.Named[WavefrontReadingsSpec], spec.NothingIsEmpty] = Field(default_factory=FrozenMap)
    focus: Annotated[spec.Named[FocusReadingsSpec], spec.NothingIsEmpty] = Field(default_factory=FrozenMap)
    mtf: Annotated[spec.Named[MtfReadingsSpec], spec.NothingIsEmpty] = Field(default_factory=FrozenMap)
    distortion: Annotated[spec.Named[DistortionReadingsSpec], spec.NothingIsEmpty] = Field(default_factory=FrozenMap)
    spots: Annotated[spec.Named[SpotReadingsSpec], spec.NothingIsEmpty] = Field(default_factory=FrozenMap)
    sight: Annotated[spec.Named[SightReadingsSpec], spec.NothingIsEmpty] = Field(default_factory=FrozenMap)
    temperatures: Annotated[spec.Named[TemperatureReadingsSpec], spec.NothingIsEmpty] = Field(default_factory=FrozenMap)
    positions: Annotated[spec.Named[PositionReadingsSpec], spec.NothingIsEmpty] = Field(default_factory=FrozenMap)
    images: Annotated[spec.Named[ImageReadingsSpec], spec.NothingIsEmpty] = Field(default_factory=FrozenMap)

    @model_validator(mode="after")
    def _names_once(self) -> MeasurementsSpec:
        kinds: dict[str, str] = {}
        for kind, name, _ in self.named():
            if name in kinds:
                raise Problem("two measurements with this name", name, "a different name for each", within=(kind, name))
            kinds[name] = kind
        return self

    def named(self) -> Iterator[tuple[str, str, ReadingsSpec]]:
        """Iterate over kind (such as ``mtf``), name and content of each measurement."""
        for kind in type(self).model_fields:
            for name, measurement in getattr(self, kind).items():
                yield kind, name, measurement


MOST_TERM = 45
"""Largest Noll index of a wavefront's unknown term: degree 8, which the rays of every beam sample."""


def _require_wavefront(terms: Mapping[str, float]) -> FrozenMap[str, float]:
    for term in terms:
        if not 4 <= noll(term) <= MOST_TERM:
            raise Problem("not a term of a wavefront", term, f"Z4 to Z{MOST_TERM}")
    return FrozenMap(terms)


WavefrontTerms = Annotated[dict[Term, Sigma], AfterValidator(_require_wavefront)]


class WavefrontPriorSpec(spec.Spec):
    """Zernike terms of the wavefront at the exit pupil that are estimated besides the motions of bodies.

    Terms are those of `wavefronts`: Noll, rms, orthonormal over the light of each field, positive where the wavefront
    is ahead.

    Attributes
    ----------
    constant : dict[str, float]
        Term -> standard deviation of its amount, equal at all fields, in metres.
    linear : dict[str, float]
        Term -> standard deviation of its change from the middle to the edge of the field, in metres, along the line
        and, independently, along the track.
    """

    constant: WavefrontTerms = Field(default_factory=FrozenMap)
    linear: WavefrontTerms = Field(default_factory=FrozenMap)


class ActuatorSpec(CompensatorSpec):
    """Actuator: a motion that can be made to align the instrument.

    Attributes
    ----------
    motion
        Motion of the actuator: `M2 shift z`.
    carrying
        Further bodies that move rigidly with it.
    range
        Largest total amount of all moves together, in either direction.
    step
        Step of which the amount is a multiple, as with shims; by default any amount is possible.
    accuracy
        Standard deviation of a move that does not depend on its size.
    move_error : float
        Standard deviation of a move as a fraction of its amount.
    response : float
        Standard deviation of the error of the traced response to this actuator, as a fraction of the response.
    """

    move_error: Annotated[spec.Number, Field(ge=0.0, le=1.0)] = 0.02
    response: Annotated[spec.Number, Field(ge=0.0, le=1.0)] = 0.0


def _require_amounts(value: Mapping[str, Amount]) -> Mapping[str, Amount]:
    if not value:
        raise Problem("nothing is moved", None, "by: {M2_z: 15 um}")
    return FrozenMap(value)


class MoveSpec(spec.Spec):
    """Alignment move that was made.

    Attributes
    ----------
    by : dict[str, str | float]
        Actuator -> amount of its move, with its unit.
    """

    by: Annotated[dict[spec.Name, Amount], AfterValidator(_require_amounts)]


class SimulatedInstrumentSpec(spec.Spec):
    """Simulated instrument, which the program draws at random, measures and moves instead of a real one.

    Attributes
    ----------
    law : {'normal', 'uniform'}
        Probability distribution of the motions of its bodies, with the covariance of the prior.
    prior : str | None
        Disturbances file from which the instrument is drawn; by default that of the estimate.
    seed : int
        Seed of the instrument and of all measurement errors.
    """

    law: Literal["normal", "uniform"] = "normal"
    prior: spec.Ref | None = None
    seed: spec.Seed = 0


class AsBuiltSpec(spec.Spec):
    """Estimate of the state of one built instrument from all of its measurements.

    Attributes
    ----------
    instrument : str
        Camera or instrument, by name or path, as in a job.
    camera : str | None
        Name of the camera to which the estimate applies; may be omitted if the instrument has one camera.
    prior : str
        Disturbances file with the prior: the uncertainty of the state before any measurement.
    wavefront : WavefrontPriorSpec | None
        Zernike terms of the wavefront that are estimated besides the motions of the prior; none by default.
    measurements : MeasurementsSpec
        Measurements by kind and name.
    merits : Mapping[str, MeritSpec]
        Name -> requirement on the camera, as in a tolerance budget.
    actuators : Mapping[str, ActuatorSpec]
        Name -> actuator for the alignment.
    moves : Mapping[str, MoveSpec]
        Name -> alignment move that was made, in the order of time.
    candidates : MeasurementsSpec
        Measurements that could be made next; the report compares their benefit.
    draws : int
        Number of random states of the instrument, drawn from the estimate and its covariance, that are traced for the
        merits.
    seed : int
        Seed of these random states.
    simulate : SimulatedInstrumentSpec | None
        Simulated instrument instead of measured data; by default the data are measured.
    """

    instrument: spec.Ref
    camera: spec.Name | None = None
    prior: spec.Ref = "assembled"
    wavefront: Annotated[WavefrontPriorSpec, spec.NothingIsEmpty] | None = None
    measurements: MeasurementsSpec
    merits: Annotated[spec.Named[MeritSpec], Field(min_length=1, max_length=50)]
    actuators: Annotated[spec.Named[ActuatorSpec], spec.NothingIsEmpty] = Field(default_factory=FrozenMap)
    moves: Annotated[spec.Named[MoveSpec], spec.NothingIsEmpty] = Field(default_factory=FrozenMap)
    candidates: Annotated[MeasurementsSpec, spec.NothingIsEmpty] = MeasurementsSpec.model_construct()
    draws: Annotated[spec.Whole, Field(ge=20, le=100_000)] = 200
    seed: spec.Seed = 0
    simulate: Annotated[SimulatedInstrumentSpec, spec.NothingIsEmpty] | None = None

    @model_validator(mode="after")
    def _belongs_together(self) -> AsBuiltSpec:
        if not any(True for _ in self.measurements.named()):
            kinds = names_text(MeasurementsSpec.model_fields)
            raise Problem("nothing was measured", None, f"at least one measurement: {kinds}", within=("measurements",))
        for kind, name, measurement in self.measurements.named():
            where = ("measurements", kind, name)
            if measurement.after is not None and measurement.after not in self.moves:
                raise unknown("no such move", measurement.after, self.moves, (*where, "after"))
            if self.simulate is None and not measurement.has_data:
                raise Problem("no data", name, "values or files, or `simulate: {}` to draw them", within=where)
            if self.simulate is not None and measurement.has_data:
                raise Problem("both data and `simulate`", name, "one of them", within=where)
        for name, move in self.moves.items():
            for actuator, amount in move.by.items():
                if actuator not in self.actuators:
                    raise unknown("no such actuator", actuator, self.actuators, ("moves", name, "by"))
                self.actuators[actuator].si(amount, "by")
        return self


class AsBuiltSetup(ExperimentSetup[AsBuiltSpec]):
    """Estimate of an instrument as built, with the content of the instrument's and the prior's files.

    Attributes
    ----------
    base : ResolvedJob
        Nominal job of the instrument, with the prior as its disturbances.
    drawn : DisturbancesSpec | None
        Disturbances from which a simulated instrument is drawn; None for the prior.
    """

    base: ResolvedJob
    drawn: DisturbancesSpec | None = None

    @classmethod
    def parts(cls, test: AsBuiltSpec) -> dict[str, Any]:
        """Read the nominal job and the simulated instrument's disturbances; return field of the set-up -> content."""
        base, simulated = resolve_on(test, test.instrument, test.prior), test.simulate
        if simulated is None or simulated.prior is None:
            return {"base": base}
        return {"base": base, "drawn": load.load_disturbances(simulated.prior, test, ("simulate", "prior"))}
