"""Specification of a camera (scenes/library/cameras): optical prescription and line CCDs.

Also the specifications of the optimisation of a camera and of the search for a monitor layout.

Glass of a lens: a name of the catalogue, or a manufacturer's dispersion formula.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import isinf
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, SerializerFunctionWrapHandler, model_serializer, model_validator

from optics.geometry.sag_terms import SagTerm
from optics.materials.glass import (
    FORMULAS,
    GLASSES,
    SCHOTT_RANGE,
    CatalogueGlass,
    Glass,
    ThermalDispersion,
    WarmGlass,
    common_glasses,
    glass,
)
from optics.materials.material import MATERIALS, TemperatureRange
from optics.numerics.array_math import UnphysicalError
from optics.numerics.number_tree import FrozenMap
from optics.raytrace.reflectors import REFLECTORS
from scenes.specs import instrument as instruments
from scenes.specs.baffle import SurfaceEdgeSpec
from scenes.specs.detector import PITCH_RANGE, PixelPitch
from scenes.specs.spectrum import Spectrum, SpectrumSpec, WavelengthRange
from scenes.yaml import unit_fields
from scenes.yaml.errors import Problem, unknown
from scenes.yaml.spec import Name, Named, Number, Ref, Seed, Spec, Text, TitledSpec, Whole, short_for
from scenes.yaml.unit_fields import Quantity
from scenes.yaml.units import ANGLE, EXPANSION, LENGTH, MASS, SCALE, format_quantity

Medium = Literal["vacuum", "air"]
CATALOGUE_RANGE = TemperatureRange.celsius(-30.0, 70.0, "AGF catalogues state the mean expansion of that range")
"""Temperature range in which the expansion of a glass in a camera's file holds."""


def glass_entry(glass: CatalogueGlass) -> dict[str, Any]:
    """Return a catalogue glass in the form of a camera's file."""
    ends = [format_quantity(w, LENGTH) for w in (glass.shortest, glass.longest)]
    out = {"name": glass.name, "formula": glass.formula, "coefficients": list(glass.coefficients), "range": ends}
    if glass.expansion is not None:
        out["expansion"] = format_quantity(glass.expansion, EXPANSION)
    return out if glass.thermal is None else {**out, "thermal": list(glass.thermal)}


class LensGlassSpec(Spec):
    """Glass of a lens with its dispersion at 20 C.

    Attributes
    ----------
    name : str
        Name of a glass in the catalogue (`N-BK7`, `N-SF11`, `S-FPL53`, `FCD1`, `H-K9L`, ...), or any name beside a
        formula.
    formula : int | None
        Number of the dispersion formula in AGF catalogues (1 Schott, 2 Sellmeier 1, ...); by default the catalogue's
        glass.
    coefficients : tuple[float, ...] | None
        Coefficients of the formula for wavelengths in micrometres, in the order of the AGF catalogue; for Sellmeier B1,
        C1, B2, C2, B3, C3.
    range : tuple[float, float] | None
        Shortest and longest wavelength at which the formula holds, in metres.
    expansion : float | None
        Linear thermal expansion, mean of -30 to 70 C, as in the ED line of AGF catalogues, in 1/K. By default that of
        the twin's material of the same name; if there is none, the lens cannot be heated.
    thermal : tuple[float, ...] | None
        Schott's constants D0, D1, D2, E0, E1 and Lambda_TK of dn/dT in the units of data sheets, as in the TD line of
        AGF catalogues. By default those of the catalogue; if there are none, the lens cannot be heated.
    """

    name: Text
    formula: Annotated[Whole, Field(ge=1, le=max(FORMULAS))] | None = None
    coefficients: Annotated[tuple[Number, ...], Field(min_length=1, max_length=12)] | None = None
    range: WavelengthRange | None = None
    expansion: Annotated[float, Quantity(EXPANSION, largest="1000 ppm/K")] | None = None
    thermal: Annotated[tuple[Number, ...], Field(min_length=6, max_length=6)] | None = None

    @model_validator(mode="before")
    @classmethod
    def _with_formula(cls, data: Any) -> Any:
        """Return the file's data, with the formula of a common glass where they have none."""
        known = common_glasses().get(data["name"]) if isinstance(data, dict) and "name" in data else None
        return data if known is None or "formula" in data else {**glass_entry(known), **data}

    @model_validator(mode="after")
    def _is_known(self) -> LensGlassSpec:
        keys = [key for key in ("formula", "coefficients", "range") if getattr(self, key) is not None]
        if keys and len(keys) < 3:
            raise Problem("an incomplete definition of a glass", ", ".join(keys), "formula, coefficients, range")
        if not keys:
            try:
                glass(self.name)
            except KeyError:
                raise unknown("no such glass", self.name, (*GLASSES, *common_glasses()), within=("name",)) from None
        return self

    @model_serializer(mode="wrap")
    def _short(self, handler: SerializerFunctionWrapHandler) -> Any:
        """Return a catalogue glass as its name alone, another glass in full."""
        full = handler(self)
        plain = all(getattr(self, key) is None for key in type(self).model_fields if key != "name")
        return self.name if plain else full

    def index(self, wavelength: float, medium: Medium) -> float:
        """Return the refractive index at 20 C.

        Parameters
        ----------
        wavelength : float
            Wavelength, in metres.
        medium : {'vacuum', 'air'}
            Medium to which the index refers: ``air`` of 20 C and 1013 hPa, as manufacturers state it, or ``vacuum``.

        Raises
        ------
        ValueError
            The formula does not hold at this wavelength.
        """
        known: Glass | CatalogueGlass
        if self.formula is None or self.coefficients is None or self.range is None:
            known = glass(self.name)
        else:
            known = CatalogueGlass(self.name, self.formula, self._filled(self.coefficients), *self.range)
        return known.index(wavelength) if medium == "air" else known.vacuum_index(wavelength)

    def warm(self, wavelength: float, medium: Medium) -> WarmGlass:
        """Return the thermal properties of the glass at a wavelength.

        Parameters
        ----------
        wavelength : float
            Wavelength, in metres.
        medium : {'vacuum', 'air'}
            Medium to which the index refers: ``air`` of 20 C and 1013 hPa, or ``vacuum``. The medium itself is not
            heated.

        Raises
        ------
        ValueError
            Neither the catalogue nor the file has its expansion or the change of its index.
        """
        named = None if self.formula is not None else glass(self.name)
        solid = None if named is None else MATERIALS.get(named.name)
        if self.expansion is None and solid is None:
            raise UnphysicalError(
                f"the thermal expansion of {self.name} is unknown; its glass needs `expansion: 8.2 ppm/K`, the first "
                "number of ED in its AGF catalogue"
            )
        thermal = named.thermal if named is not None else None
        if self.thermal is not None:
            d0, d1, d2, e0, e1, lambda_tk = self.thermal
            thermal = ThermalDispersion(d0, d1, d2, e0, e1, lambda_tk)
        if thermal is None:
            raise UnphysicalError(
                f"dn/dT of {self.name} is unknown; its glass needs `thermal: "
                "[D0, D1, D2, E0, E1, Lambda_TK]`, the first six numbers of TD in its AGF catalogue"
            )
        if self.expansion is not None:
            expansion, valid = self.expansion, CATALOGUE_RANGE
        else:
            assert solid is not None
            expansion, valid = solid.expansion, solid.known
        low, high = (max(valid.coldest, SCHOTT_RANGE.coldest), min(valid.hottest, SCHOTT_RANGE.hottest))
        source = valid.source if (low, high) == (valid.coldest, valid.hottest) else SCHOTT_RANGE.source
        known = TemperatureRange(low, high, source)
        return WarmGlass(self.name, expansion, known, self.index(wavelength, medium), wavelength, thermal)

    @staticmethod
    def _filled(coefficients: tuple[float, ...]) -> tuple[float, ...]:
        return (*coefficients, *[0.0] * (12 - len(coefficients)))


LensGlass = Annotated[LensGlassSpec, short_for("name", str)]
"""Glass as a mapping with its keys, or the name of a catalogue glass alone."""


Diffusion = Annotated[float, unit_fields.Quantity(LENGTH, smallest="0 um", largest="1 mm")]


class TdiSpec(Spec):
    """Time delay and integration (TDI): how a line CCD collects charge while the image moves across it.

    Attributes
    ----------
    stages : int
        Number of TDI stages, i.e. lines over which the charge is collected.
    phases : int
        Number of clock phases per pixel. Between two phases the charge stands still while the image moves, which blurs
        it along the track by one step.
    open_share : float
        Fraction of each step during which light is collected.
    line_time : float
        Time from one line to the next, in seconds.
    rate_error : float
        Relative difference between the speeds of the image and of the charge; it blurs the image over all stages.
    """

    stages: Annotated[Whole, Field(ge=1, le=4096)] = 1
    phases: Annotated[Whole, Field(ge=1, le=8)] = 1
    line_time: instruments.Exposure = 3.5e-4
    open_share: Annotated[Number, Field(gt=0.0, le=1.0)] = 1.0
    rate_error: Annotated[float, unit_fields.Quantity(SCALE, largest="50 percent")] = 0.0


class BandSpec(Spec):
    """Line CCD of a spectral band in the focal plane.

    Attributes
    ----------
    offset : float
        Position along X' (flight direction) relative to the line's centre, in metres.
    pixels : int
        Number of pixels along the line.
    pitch : float
        Pitch of the square pixels, in metres.
    spectrum : SpectrumSpec
        Relative signal by wavelength, or two wavelengths between which the light is evenly distributed.
    detector : str
        Data sheet of the detector, by name or path.
    diffusion : float
        Charge diffusion between pixels (crosstalk), rms, in metres.
    tdi : TdiSpec
        Time delay and integration; a single stage by default.
    """

    offset: unit_fields.Length = 0.0
    pixels: Annotated[Whole, Field(ge=2, le=1_000_000)]
    pitch: PixelPitch
    spectrum: Spectrum
    detector: Ref
    diffusion: Diffusion = 0.0
    tdi: TdiSpec = TdiSpec.model_construct()

    @property
    def exposure(self) -> float:
        """Exposure of all stages together, in seconds, during which dark current is collected.

        The data sheet gives the dark current for all stages.
        """
        return self.tdi.stages * self.tdi.line_time

    @property
    def nyquist(self) -> float:
        """Nyquist frequency of the pixels, in cycles/m."""
        return 0.5 / self.pitch


PANCHROMATIC = "P"
"""Name of a camera's panchromatic band."""

PhotonRange = tuple[instruments.Photons, instruments.Photons]


class BeamRangesSpec(Spec):
    """Ranges, [smallest, largest], in which the search may vary each beam of a monitor.

    A quantity without a range keeps its value in the instrument to start from.

    In a pair each beam exists four times, mirrored: at both ends of the line of both cameras.

    Attributes
    ----------
    pupil_x : tuple[float, float] | None
        Beam centre in the entrance pupil across the line, positive toward the central prism, in metres.
    pupil_y : tuple[float, float] | None
        Beam centre in the entrance pupil along the line, positive toward the beam's end of the line, in metres.
    width : tuple[float, float] | None
        Diameter of the return face, in metres. The prisms are wider than it by the same amount as in the instrument to
        start from.
    field : tuple[float, float] | None
        Field angle of the area CCD from the visual axis, in radians.
    prism_180_distance : tuple[float, float] | None
        Distance from the camera's origin to the 180-degree prism, in metres.
    prism_0_distance : tuple[float, float] | None
        Distance from the return face to the rhomboid, in metres.
    shift : tuple[float, float] | None
        Displacement of the beam by the rhomboid, in metres.
    spread_x : tuple[float, float] | None
        Distance of the facet from the central prism's apex along the base's X, in metres.
    spread_y : tuple[float, float] | None
        Distance of the facet from the central prism's apex along the base's Y, in metres.
    photons : tuple[float, float] | None
        Photons of a spot per frame; layouts whose spots would saturate their pixels are refused.
    """

    pupil_x: unit_fields.Vector2 | None = None
    pupil_y: unit_fields.Vector2 | None = None
    width: unit_fields.Vector2 | None = None
    field: (
        Annotated[
            tuple[float, float], unit_fields.Vector(unit_fields.Quantity(ANGLE, above_zero=True, largest="45 deg"), 2)
        ]
        | None
    ) = None
    prism_180_distance: unit_fields.Vector2 | None = None
    prism_0_distance: unit_fields.Vector2 | None = None
    shift: unit_fields.Vector2 | None = None
    spread_x: unit_fields.Vector2 | None = None
    spread_y: unit_fields.Vector2 | None = None
    photons: PhotonRange | None = None

    @model_validator(mode="after")
    def _from_less_to_more(self) -> BeamRangesSpec:
        for name in type(self).model_fields:
            limits = getattr(self, name)
            if limits is not None and not limits[0] <= limits[1]:
                raise Problem("the range ends before it begins", within=(name,), allowed="[smallest, largest]")
        return self


class TransferChoiceSpec(Spec):
    """Reflector that returns a beam, as one choice of the search.

    Attributes
    ----------
    material : str
        Glass of the prism, or material of the frame that carries the mirrors.
    kind : str | None
        Kind of reflector; by default the lateral-transfer prism.
    """

    material: instruments.MadeOf
    kind: Annotated[str, instruments.reflector_kinds(returns=True)] | None = None

    @model_validator(mode="after")
    def _made_of_what_it_may(self) -> TransferChoiceSpec:
        instruments.check_made(self.material, REFLECTORS[self.kind or "lateral_transfer"])
        return self


class ShiftChoiceSpec(Spec):
    """Reflector that displaces a beam, as one choice of the search.

    Attributes
    ----------
    material : str
        Glass of the prism, or material of the frame that carries the mirrors.
    kind : str | None
        Kind of reflector; by default the rhomboid.
    """

    material: instruments.MadeOf
    kind: Annotated[str, instruments.reflector_kinds(returns=False)] | None = None

    @model_validator(mode="after")
    def _made_of_what_it_may(self) -> ShiftChoiceSpec:
        instruments.check_made(self.material, REFLECTORS[self.kind or "rhomboid"])
        return self


class PrismChoiceSpec(Spec):
    """Pair of prisms that a beam may have, as one choice of the search.

    Attributes
    ----------
    prism_180 : TransferChoiceSpec
        Replacement of the lateral-transfer prism of the instrument to start from.
    prism_0 : ShiftChoiceSpec
        Replacement of the rhomboid of the instrument to start from.
    """

    prism_180: TransferChoiceSpec
    prism_0: ShiftChoiceSpec


class MonitorGoalSpec(Spec):
    """Goals of a layout: standard deviations of the changes that remain after the spots have been measured.

    They hold for the worse of both cameras and for the worst of several disturbances files.

    Attributes
    ----------
    angle : float | None
        Standard deviation of the change of the intersection angle, in radians; by default not a goal.
    d_f : float | None
        Standard deviation of the change of a principal distance, in metres; by default not a goal.
    height : float | None
        Standard deviation of the height of a ground point, in metres, which needs the instrument's altitude; by default
        not a goal.
    """

    angle: Annotated[float, unit_fields.Quantity(ANGLE, above_zero=True)] | None = None
    d_f: unit_fields.PositiveLength | None = None
    height: unit_fields.PositiveLength | None = None

    @model_validator(mode="after")
    def _something(self) -> MonitorGoalSpec:
        if not self.wanted:
            raise Problem("the goal of the layout is empty", "nothing", "one or several of angle, d_f and height")
        return self

    @property
    def wanted(self) -> dict[str, float]:
        """Goals that the file sets: name -> largest standard deviation, in SI units."""
        return {name: value for name in type(self).model_fields if (value := getattr(self, name)) is not None}


class MonitorLimitsSpec(Spec):
    """Limits that a layout must not exceed.

    Attributes
    ----------
    pupil_share : float | None
        Largest fraction of a camera's imaging pupil that the monitor's prisms block, at the worst field of the line; no
        limit by default.
    mass : float | None
        Largest mass of all prisms, or of the mirrors in their place, without the central prism, in kg; no limit by
        default.
    spot_sigmas : float
        Smallest distance of each spot from the edge of its area CCD, as a multiple of the standard deviation of the
        spot's position.
    ghost_paths : int | None
        Number of paths per source for tracing ghosts of the layouts on the Pareto front. A layout whose ghosts have
        more than a thousandth of a spot's light is excluded. By default no ghosts are traced.
    """

    pupil_share: Annotated[float, unit_fields.Quantity(SCALE, above_zero=True, largest="100 percent")] | None = None
    mass: Annotated[float, unit_fields.Quantity(MASS, above_zero=True)] | None = None
    spot_sigmas: Annotated[Number, Field(gt=0.0, le=10.0)] = 3.0
    ghost_paths: Annotated[Whole, Field(ge=10_000, le=1_000_000_000)] | None = None


class MonitorSearchSpec(Spec):
    """Effort of the search.

    Attributes
    ----------
    beams : int
        Number of beams drawn at random at the beginning.
    layouts : int
        Largest number of combinations of beams that are compared.
    rounds : int
        Number of rounds that change the beams of the best layouts and combine them again. The steps are halved after a
        round without an improvement.
    changed : int
        Number of beams that each round tries.
    exact : int
        Number of layouts that are modelled completely at the beginning and after each round.
    refine : int
        Largest number of steps by exact gradients that finally improve the best layout.
    starts : int
        Number of further searches from other random beams, without those of the instrument, as a test of whether they
        reach the same result.
    """

    beams: Annotated[Whole, Field(ge=1, le=100_000)] = 120
    layouts: Annotated[Whole, Field(ge=1, le=10_000_000)] = 2000
    rounds: Annotated[Whole, Field(ge=0, le=1000)] = 6
    changed: Annotated[Whole, Field(ge=1, le=10_000)] = 24
    exact: Annotated[Whole, Field(ge=1, le=1000)] = 8
    refine: Annotated[Whole, Field(ge=0, le=1000)] = 0
    starts: Annotated[Whole, Field(ge=0, le=100)] = 0


class MonitorDesignSpec(Spec):
    """Search for the layout of a monitor: number of beams, their positions and their prisms.

    Attributes
    ----------
    instrument : str
        Instrument to start from, by name or path: a pair with mirrored monitor channels.
    name : str
        Name of the new instrument.
    description : str
        Description of the new instrument for readers; the program does not use it.
    disturbances : tuple[str, ...] | None
        Files of disturbances, by name or path; by default the instrument's.
    beams : int
        Largest number of beams at each end of a line.
    vary : BeamRangesSpec
        Ranges in which each beam may vary.
    prisms : Mapping[str, PrismChoiceSpec] | None
        Name of your choice -> pair of prisms that a beam may have; by default those of the instrument to start from.
    area_ccds : Mapping[str, AreaCcdChoiceSpec] | None
        Name of your choice -> area CCD that all channels may have; by default that of the instrument to start from.
    central_material : str | None
        Glass of the central prism; by default that of the instrument to start from.
    photons_per_frame : float | None
        Photons of every spot per frame; by default those of the instrument to start from.
    frames : int | None
        Number of frames in a measurement; by default that of the instrument to start from.
    goal : MonitorGoalSpec
        Standard deviations of the monitored changes that the layout must reach.
    limits : MonitorLimitsSpec
        Limits of blocked pupil, mass, spot positions and ghosts that a layout must not exceed.
    search : MonitorSearchSpec
        Effort of the search: numbers of beams, layouts, rounds and starts.
    seed : int
        Seed of all random numbers.
    """

    instrument: Ref
    name: Name
    description: Text = ""
    disturbances: Annotated[tuple[Ref, ...], Field(min_length=1)] | None = None
    beams: Annotated[Whole, Field(ge=1, le=6)]
    vary: BeamRangesSpec
    prisms: Annotated[Named[PrismChoiceSpec], Field(min_length=1)] | None = None
    area_ccds: Annotated[Named[instruments.AreaCcdChoiceSpec], Field(min_length=1)] | None = None
    central_material: instruments.GlassName | None = None
    photons_per_frame: instruments.Photons | None = None
    frames: instruments.Frames | None = None
    goal: MonitorGoalSpec
    limits: MonitorLimitsSpec = MonitorLimitsSpec.model_construct()
    search: MonitorSearchSpec = MonitorSearchSpec.model_construct()
    seed: Seed = 0


Rotation = Annotated[tuple[float, float, float], unit_fields.Vector(unit_fields.Quantity(ANGLE, largest="180 deg"), 3)]
Light = Literal["refracts", "passes"]
Reflectance = Annotated[float, unit_fields.Quantity(SCALE, smallest="0 percent", largest="100 percent")]


class MirrorSpec(Spec):
    """Surface of a camera: a mirror, a face of a lens or the stop.

    It is a surface of revolution about the parent axis unless ``sag``, ``decentre`` or ``rotate`` make it another one.

    Attributes
    ----------
    z : float
        Position of the vertex on the parent axis, in metres; light enters toward +z.
    decentre : tuple[float, float] | None
        Displacement of the vertex from the parent axis along x and y, in metres; zero by default.
    rotate : tuple[float, float, float] | None
        Rotation vector of the surface about its vertex, in radians; zero by default.
    radius : float
        Vertex radius of curvature, in metres, positive if the centre of curvature lies toward +z; ``flat`` for a plane.
    conic : float
        Conic constant k: 0 for a sphere, the default, -1 for a paraboloid, less for a hyperboloid.
    aspheric : Mapping[str, float]
        Coefficients A4, A6, ... of the sag beyond the conic's, in 1/m^3, 1/m^5, ...; by default a pure conic.
    sag : Mapping[str, SagTerm] | None
        Kind of a further sag term -> its coefficients; none by default.
    light : {'refracts', 'passes'} | None
        `refracts` for a face of a lens, `passes` for a plane that only serves as the stop; by default a mirror.
    index : float | None
        Refractive index behind a face of a lens at the design wavelength; 1 where the light leaves the lens.
    glass : LensGlassSpec | None
        Glass behind a face where light enters a lens, instead of `index`; its dispersion gives the index at every
        wavelength.
    reflectance : float | None
        Reflectance of a face of a lens with a coating, for ghosts; by default that of bare glass.
    edges : tuple[SurfaceEdgeSpec, ...] | None
        Edges that block light at this surface besides the stop; light must pass all of them. By default there are no
        edges.
    """

    z: unit_fields.Length
    decentre: unit_fields.Vector2 | None = None
    rotate: Rotation | None = None
    radius: unit_fields.Radius
    conic: Number = 0.0
    aspheric: unit_fields.AsphereTerms = Field(default_factory=FrozenMap)
    sag: Annotated[FrozenMap[str, SagTerm], unit_fields.SagTerms()] | None = None
    light: Light | None = None
    index: Annotated[Number, Field(ge=1.0, le=10.0)] | None = None
    glass: LensGlass | None = None
    reflectance: Reflectance | None = None
    edges: Annotated[tuple[SurfaceEdgeSpec, ...], Field(min_length=1, max_length=100)] | None = None

    @model_validator(mode="after")
    def _is_curved(self) -> MirrorSpec:
        if self.radius == 0.0:
            raise Problem("a radius of curvature cannot be zero", "0 m", "a length other than zero", within=("radius",))
        return self

    @model_validator(mode="after")
    def _index_where_light_refracts(self) -> MirrorSpec:
        media = [key for key in ("index", "glass") if getattr(self, key) is not None]
        if (self.light == "refracts") != bool(media):
            problem = "an index or a glass belongs to a face of a lens (light: refracts), and to no other surface"
            value = f"{' and '.join(media)}, light: {self.light or 'reflected'}" if media else "no index"
            raise Problem(problem, value, "light: refracts with an index or a glass", within=("light",))
        if len(media) > 1:
            problem = "the index of a glass follows from its dispersion"
            raise Problem(problem, "index and glass", "only one of them", within=("index",))
        if self.reflectance is not None and self.light != "refracts":
            problem = "a reflectance is that of a face of a lens, where it makes ghosts"
            raise Problem(problem, f"light: {self.light or 'reflected'}", "light: refracts", within=("reflectance",))
        return self

    @property
    def enters_glass(self) -> bool:
        """True if light enters a lens at this face."""
        return self.light == "refracts" and self.index != 1.0


class FieldSpec(Spec):
    """Half angles of the field of view about the field bias.

    Attributes
    ----------
    x : float
        Half angle along the line CCD, in radians.
    y : float
        Half angle across the line CCD, in radians.
    """

    x: Annotated[float, unit_fields.Quantity(ANGLE, above_zero=True, largest="45 deg")]
    y: Annotated[float, unit_fields.Quantity(ANGLE, above_zero=True, largest="45 deg")]


class ImageSpec(Spec):
    """Position and tilt of the focal plane.

    Attributes
    ----------
    z : float
        Position of the focal plane on the parent axis, in metres.
    tilt : float | None
        Rotation about the prescription's x, the direction of the line CCD, in radians; by default the plane is
        perpendicular to the axis.
    reflectance : float | None
        Reflectance of the detector, for ghosts; by default that of bare silicon, 30 percent.
    """

    z: unit_fields.Length
    tilt: Annotated[float, unit_fields.Quantity(ANGLE, largest="45 deg")] | None = None
    reflectance: Reflectance | None = None


_MOST_PIXELS = 1_000_000


class LineSpec(Spec):
    """Line CCD or area detector, centred on the field bias.

    Attributes
    ----------
    pixels : int
        Number of pixels along the line.
    pitch : float
        Pixel pitch, in metres.
    rows : int
        Number of lines: 1 for a line CCD, more for an area detector.
    """

    pixels: Annotated[Whole, Field(ge=2, le=_MOST_PIXELS)]
    pitch: PixelPitch
    rows: Annotated[Whole, Field(ge=1, le=_MOST_PIXELS)] = 1


def line_over_field(camera: Mapping[str, Any]) -> LineSpec:
    """Return a line CCD over the field whose Nyquist frequency is half the cut-off, for a camera whose file has none.

    Parameters
    ----------
    camera : mapping
        ``focal_length``, ``entrance_pupil``, ``wavelength`` (metres) and ``field``.
    """
    focal, pupil, wavelength, field = (camera[key] for key in ("focal_length", "entrance_pupil", "wavelength", "field"))
    pitch = float(np.clip(wavelength * focal / pupil, *PITCH_RANGE))
    pixels = int(np.clip(round(2.0 * focal * np.tan(field.x) / pitch), 2, _MOST_PIXELS))
    return LineSpec.model_construct(pixels=pixels, pitch=pitch, rows=1)


class CameraSpec(TitledSpec):
    """Optical prescription of a camera with its line CCDs.

    Attributes
    ----------
    focal_length : float
        Nominal focal length, in metres; the ray trace computes the exact one.
    entrance_pupil : float
        Diameter of the entrance pupil, in metres: of the axial beam before the first surface. Its rays define the size
        of the stop, unless ``stop_diameter`` states it.
    field_bias : float
        Angle of the line CCD's centre from the parent axis, in the plane of symmetry, in radians; 0, the default, for a
        telescope that is used on its axis.
    field : FieldSpec
        Half angles of the field of view about the field bias.
    wavelength : float
        Design wavelength, in metres.
    stop : str
        Name of the surface that is the aperture stop.
    stop_diameter : float | None
        Diameter of the stop, in metres, if it is known; ``entrance_pupil`` is then nominal.
    mirrors : Mapping[str, MirrorSpec]
        Name -> surface, in the order of the light: mirrors, and also faces of lenses and a separate stop.
    image : ImageSpec
        Position and tilt of the focal plane.
    line : LineSpec
        Pixels of the line CCD, or of an area detector. By default a line over the field with a pitch of the
        wavelength times the F-number: its Nyquist frequency is half the cut-off frequency of diffraction.
    bands : Mapping[str, BandSpec]
        Name of a spectral band -> its line CCD, for images of targets; none by default.
    spectrum : SpectrumSpec | None
        Light for polychromatic image quality; by default that of the panchromatic or first band.
    medium : {'vacuum', 'air'} | None
        Medium around the lenses at 20 C, to which the index of a glass refers: ``air``, as in prescriptions for use on
        the ground, or ``vacuum``, the default.
    edge_margin : float
        Margin by which a mirror's clear aperture exceeds the beams that use it, in metres.
    """

    focal_length: unit_fields.PositiveLength
    entrance_pupil: unit_fields.PositiveLength
    field_bias: instruments.FieldAngle = 0.0
    field: FieldSpec
    wavelength: unit_fields.Wavelength
    stop: Name
    stop_diameter: unit_fields.PositiveLength | None = None
    mirrors: Annotated[Named[MirrorSpec], Field(min_length=1)]
    image: ImageSpec
    line: LineSpec = Field(default_factory=line_over_field)
    bands: Named[BandSpec] = Field(default_factory=FrozenMap)
    spectrum: Spectrum | None = None
    medium: Medium | None = None
    edge_margin: Annotated[float, unit_fields.Quantity(LENGTH, smallest="0 mm", largest="1 m")] = 0.005

    @model_validator(mode="after")
    def _stop_is_a_mirror(self) -> CameraSpec:
        if self.stop not in self.mirrors:
            raise unknown("the stop is not one of the mirrors", self.stop, self.mirrors, ("stop",))
        return self

    @model_validator(mode="after")
    def _check_lenses_in_air(self) -> CameraSpec:
        inside = ""
        for name, mirror in self.mirrors.items():
            if mirror.light != "refracts":
                continue
            if mirror.enters_glass == bool(inside):
                problem = "lens faces must alternate between into and out of glass; cemented lenses are not supported"
                allowed = "index: 1 where light leaves glass" if inside else "an index above 1 where light enters glass"
                key = "index" if mirror.glass is None else "glass"
                value = f"{mirror.index:g}" if mirror.glass is None else mirror.glass.name
                raise Problem(problem, value, allowed, within=("mirrors", name, key))
            inside = "" if inside else name
        if inside:
            problem = "light enters glass and does not leave it"
            raise Problem(problem, inside, "a face with index: 1 behind it", within=("mirrors", inside))
        return self

    @model_validator(mode="after")
    def _colours_through_named_glass(self) -> CameraSpec:
        plain = [name for name, mirror in self.mirrors.items() if mirror.enters_glass and mirror.glass is None]
        for key in ("bands", "spectrum"):
            if plain and getattr(self, key):
                problem = "a bare index is valid at the design wavelength only"
                allowed = f"the glass of {plain[0]} by its name, or no {key}"
                raise Problem(problem, f"index at {plain[0]}", allowed, within=(key,))
        return self

    @model_validator(mode="after")
    def _glasses_are_known(self) -> CameraSpec:
        self._check_glasses()
        return self

    def _check_glasses(self) -> None:
        """Raise `Problem` if a glass has no index at a wavelength of the camera's light."""
        lights: dict[tuple[str, ...], SpectrumSpec] = {
            ("bands", name, "spectrum"): band.spectrum for name, band in self.bands.items()
        }
        if self.spectrum is not None:
            lights["spectrum",] = self.spectrum
        colours: dict[tuple[str, ...], tuple[float, ...]] = {("wavelength",): (self.wavelength,)}
        # the wavelengths of a table are not known before it has been read
        colours |= {key: light.ends for key, light in lights.items() if light.curve is not None or light.table is None}
        for name, mirror in self.mirrors.items():
            for key, wavelengths in colours.items() if mirror.glass is not None else ():
                for wavelength in wavelengths:
                    try:
                        self.index_behind(name, wavelength)
                    except ValueError as error:
                        raise Problem(f"{name}: {error}", within=key) from None

    def index_behind(self, name: str, wavelength: float | None = None) -> float:
        """Return the refractive index behind a face of a lens, relative to the medium around the lens.

        Parameters
        ----------
        name : str
            Name of the face.
        wavelength : float | None
            Wavelength in metres; the design wavelength by default.

        Raises
        ------
        ValueError
            The glass has no index at this wavelength, or the face has a bare index and the wavelength is not the design
            wavelength.
        """
        mirror, colour = self.mirrors[name], self.wavelength if wavelength is None else wavelength
        if mirror.glass is not None:
            return mirror.glass.index(colour, self.medium or "vacuum")
        if mirror.index is None:
            raise ValueError(f"{name} is not a face of a lens")
        if mirror.enters_glass and colour != self.wavelength:
            raise ValueError(f"{name}: its bare index is valid at the design wavelength only; give its glass")
        return mirror.index

    def warm_glass(self, name: str) -> WarmGlass:
        """Return the thermal properties of the glass behind a face where light enters a lens, at the design wavelength.

        Raises
        ------
        ValueError
            The thermal properties are not known.
        """
        mirror = self.mirrors[name]
        if mirror.glass is None:
            raise ValueError(
                f"the index of {name} has no thermal properties; give its glass, with `expansion` and `thermal` where "
                "no catalogue has them"
            )
        return mirror.glass.warm(self.wavelength, self.medium or "vacuum")

    @property
    def light(self) -> SpectrumSpec | None:
        """Light for polychromatic image quality; None if the camera specifies none.

        It is the camera's spectrum, else that of its panchromatic band, else that of its first band.
        """
        if self.spectrum is not None or not self.bands:
            return self.spectrum
        return self.bands[PANCHROMATIC if PANCHROMATIC in self.bands else next(iter(self.bands))].spectrum

    def file_text(self, remark: str, **others: Any) -> str:
        """Return the text of a file with this camera, without empty terms and one row; see `TitledSpec.file_text`."""
        plain = {**self.plain(), **others}
        if plain["line"].get("rows") == 1:
            del plain["line"]["rows"]
        plain["mirrors"] = {
            name: {key: value for key, value in face.items() if value != {}} for name, face in plain["mirrors"].items()
        }
        return super().file_text(remark, **plain)

    def with_curves(self) -> CameraSpec:
        """Return the camera with the tables of its spectra read.

        Raises
        ------
        InputError
            A table is missing or invalid, or has wavelengths at which a glass has no index.
        """
        bands = {
            name: band.model_copy(update={"spectrum": band.spectrum.read(self, ("bands", name, "spectrum"))})
            for name, band in self.bands.items()
        }
        spectrum = None if self.spectrum is None else self.spectrum.read(self, ("spectrum",))
        if spectrum is self.spectrum and all(
            bands[name].spectrum is band.spectrum for name, band in self.bands.items()
        ):
            return self
        camera = self.model_copy(update={"bands": FrozenMap(bands), "spectrum": spectrum})
        try:
            camera._check_glasses()
        except Problem as problem:
            raise self.error(problem) from None
        return camera

    def require_mirrors(self, where: str, on_axis: bool = False) -> None:
        """Raise `InputError` unless the camera consists of mirrors alone.

        Parameters
        ----------
        where : str
            Noun phrase for the thing that needs such a camera, for the message.
        on_axis : bool
            Also refuse mirrors that are flat, rotated or off the parent axis.

        Raises
        ------
        InputError
            The camera has a lens, a separate stop or explicit edges; with the line.
        """
        for name, mirror in self.mirrors.items():
            if mirror.edges:
                problem = f"{where} cannot have explicit edges: its clear apertures follow from its beams"
                raise self.error(problem, ("mirrors", name, "edges"), allowed="no edges")
            if mirror.light is not None:
                problem = f"{where} must consist of mirrors only"
                raise self.error(problem, ("mirrors", name, "light"), value=mirror.light, allowed="mirrors")
            if on_axis and (mirror.decentre or mirror.rotate or isinf(mirror.radius)):
                key = next(k for k in ("decentre", "rotate", "radius") if k == "radius" or getattr(mirror, k))
                problem = f"{where} must have curved mirrors about one axis"
                raise self.error(problem, ("mirrors", name, key), allowed="mirrors without decentre and rotate")


IMAGE = "image"
Vary = Literal["radius", "conic", "A4", "A6", "A8", "z"]


class CameraDesignSpec(Spec):
    """Optimisation of a camera. Its focal length along the line, entrance pupil, field and field bias stay fixed.

    Attributes
    ----------
    camera : str
        Prescription to start from, by name or path.
    name : str
        Name of the new camera.
    description : str
        Description of the new camera for readers; the program does not use it.
    vary : Mapping[str, tuple[{'radius', 'conic', 'A4', 'A6', 'A8', 'z'}, ...]]
        Name of a mirror, or ``image`` -> list of its variables.
    envelope : float | None
        Largest extent along the parent axis over all mirrors and the image, relative to that of the camera to start
        from; free by default.
    clearance : float
        Smallest distance, in the plane of symmetry, of every beam from the edge of every mirror and of the focal plane
        that it passes, in metres.
    anamorphism : float | None
        Largest relative difference of the focal length along the line from that across it; free by default.
    steps : int
        Number of steps in which the envelope is reduced from that of the camera to start from to the goal.
    starts : int
        Number of starting points: the camera itself with the envelope reduced in steps, the same at once, and others
        drawn at random about it. Each one leads to one local optimum.
    seed : int
        Seed of the random starting points.
    """

    camera: Ref
    name: Name
    description: Text = ""
    vary: Annotated[Named[tuple[Vary, ...]], Field(min_length=1)]
    envelope: Annotated[float, unit_fields.Quantity(SCALE, above_zero=True, largest="200 percent")] | None = None
    clearance: unit_fields.Length = 0.02
    anamorphism: Annotated[float, unit_fields.Quantity(SCALE, above_zero=True, largest="100 percent")] | None = None
    steps: Annotated[Whole, Field(ge=1, le=100)] = 8
    starts: Annotated[Whole, Field(ge=1, le=1000)] = 2
    seed: Seed = 0

    @model_validator(mode="after")
    def _image_moves_only_along_z(self) -> CameraDesignSpec:
        for name, quantities in self.vary.items():
            wrong = [q for q in quantities if name == IMAGE and q != "z"]
            if wrong:
                raise Problem("the image is a plane", wrong[0], "z", within=("vary", name))
        return self
