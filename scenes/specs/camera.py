"""A camera as a file in scenes/library/cameras gives it: prescription, line CCDs, and what of it is to be optimised."""

from __future__ import annotations

from math import isinf
from typing import Annotated, Literal

from pydantic import Field, model_validator

from optics.geometry.sag_terms import SagTerm
from optics.materials.glass import WarmGlass
from optics.numerics.number_tree import FrozenMap
from optics.raytrace.reflectors import REFLECTORS
from scenes.specs import instrument as instruments
from scenes.specs.baffle import SurfaceEdgeSpec
from scenes.specs.detector import PixelPitch
from scenes.specs.glass import LensGlass, Medium
from scenes.specs.spectrum import Spectrum, SpectrumSpec
from scenes.yaml.errors import Problem, unknown
from scenes.yaml.spec import Name, Named, Number, Ref, Seed, Spec, Text, TitledSpec, Whole
from scenes.yaml.unit_fields import (
    AsphereTerms,
    Length,
    PositiveLength,
    Quantity,
    Radius,
    SagTerms,
    Vector,
    Vector2,
    Wavelength,
)
from scenes.yaml.units import ANGLE, LENGTH, MASS, SCALE

Diffusion = Annotated[float, Quantity(LENGTH, smallest="0 um", largest="1 mm")]


class TdiSpec(Spec):
    """How a line CCD collects light while the image moves across it.

    Attributes
    ----------
    stages : Whole
        Lines over which the charge is collected.
    phases : Whole
        Steps in which the charge moves on by one pixel; between two steps it stands still and the image does not, which
        blurs it along the track by one step.
    open_share : Number
        Share of each step in which light is collected.
    line_time : instruments.Exposure
        From one line to the next, seconds.
    rate_error : float
        Relative difference between the image's speed and the charge's; over all stages it blurs as well.
    """

    stages: Annotated[Whole, Field(ge=1, le=4096)] = 1
    phases: Annotated[Whole, Field(ge=1, le=8)] = 1
    line_time: instruments.Exposure = 3.5e-4
    open_share: Annotated[Number, Field(gt=0.0, le=1.0)] = 1.0
    rate_error: Annotated[float, Quantity(SCALE, largest="50 percent")] = 0.0


class BandSpec(Spec):
    """A line CCD in the focal plane and the light it sees.

    Attributes
    ----------
    offset : Length
        Along X' (flight direction) from the line's centre, metres.
    pixels : Whole
        Number of pixels along the line.
    pitch : PixelPitch
        Of the pixels, which are square, metres.
    spectrum : Spectrum
        The signal by wavelength; as two wavelengths, light that is evenly spread between them.
    detector : Ref
        Data sheet, by name or path.
    diffusion : Diffusion
        Rms spread of charge between pixels (crosstalk), metres.
    tdi : TdiSpec
        Time delay and integration.
    """

    offset: Length = 0.0
    pixels: Annotated[Whole, Field(ge=2, le=1_000_000)]
    pitch: PixelPitch
    spectrum: Spectrum
    detector: Ref
    diffusion: Diffusion = 0.0
    tdi: TdiSpec = TdiSpec.model_construct()

    @property
    def exposure(self) -> float:
        """Exposure of all stages, over which dark current is collected, seconds; the data sheet gives it for all
        stages.
        """
        return self.tdi.stages * self.tdi.line_time

    @property
    def nyquist(self) -> float:
        """Nyquist frequency of the pixels, cycles/m."""
        return 0.5 / self.pitch


PANCHROMATIC = "P"
"""Name of a camera's panchromatic band."""

PhotonRange = tuple[instruments.Photons, instruments.Photons]


class BeamRangesSpec(Spec):
    """What may vary of each of a monitor's beams, from and to; what is left out is as the start has it.

    A beam stands four times in a pair: at both ends of both cameras' lines, mirrored.

    Attributes
    ----------
    pupil_x : Vector2 | None
        Of its middle in the entrance pupil, toward the central prism positive, metres.
    pupil_y : Vector2 | None
        Likewise along the line, positive toward the beam's own end of it, metres.
    width : Vector2 | None
        Diameter of its return face, metres; prisms are wider by as much as those of the start.
    field : tuple[float, float] | None
        Angle from the visual axis at which its area CCD stands, radians.
    prism_180_distance : Vector2 | None
        From the camera's origin to its 180-deg prism, metres.
    prism_0_distance : Vector2 | None
        From its return face to its rhomboid, metres.
    shift : Vector2 | None
        Of its rhomboid, metres.
    spread_x : Vector2 | None
        From the central prism's apex to its facet along the base's X, metres.
    spread_y : Vector2 | None
        Likewise along Y, metres.
    photons : PhotonRange | None
        Of its spot, per frame; spots that would fill their pixels to the brim are refused.
    """

    pupil_x: Vector2 | None = None
    pupil_y: Vector2 | None = None
    width: Vector2 | None = None
    field: Annotated[tuple[float, float], Vector(Quantity(ANGLE, above_zero=True, largest="45 deg"), 2)] | None = None
    prism_180_distance: Vector2 | None = None
    prism_0_distance: Vector2 | None = None
    shift: Vector2 | None = None
    spread_x: Vector2 | None = None
    spread_y: Vector2 | None = None
    photons: PhotonRange | None = None

    @model_validator(mode="after")
    def _from_less_to_more(self) -> BeamRangesSpec:
        for name in type(self).model_fields:
            given = getattr(self, name)
            if given is not None and not given[0] <= given[1]:
                raise Problem("the range ends before it begins", within=(name,), allowed="[smallest, largest]")
        return self


class TransferChoiceSpec(Spec):
    """What sends a beam back.

    Attributes
    ----------
    material : instruments.MadeOf
        Its glass, or what its mirrors stand on.
    kind : str | None
        By its name among the reflectors; the prism when nothing is said.
    """

    material: instruments.MadeOf
    kind: Annotated[str, instruments.reflector_kinds(returns=True)] | None = None

    @model_validator(mode="after")
    def _made_of_what_it_may(self) -> TransferChoiceSpec:
        instruments.check_made(self.material, REFLECTORS[self.kind or "lateral_transfer"])
        return self


class ShiftChoiceSpec(Spec):
    """What displaces a beam.

    Attributes
    ----------
    material : instruments.MadeOf
        Its glass, or what its mirrors stand on.
    kind : str | None
        By its name among the reflectors; the rhomboid when nothing is said.
    """

    material: instruments.MadeOf
    kind: Annotated[str, instruments.reflector_kinds(returns=False)] | None = None

    @model_validator(mode="after")
    def _made_of_what_it_may(self) -> ShiftChoiceSpec:
        instruments.check_made(self.material, REFLECTORS[self.kind or "rhomboid"])
        return self


class PrismChoiceSpec(Spec):
    """What a beam may have for its two prisms.

    Attributes
    ----------
    prism_180 : TransferChoiceSpec
        In place of the start's lateral-transfer prism.
    prism_0 : ShiftChoiceSpec
        In place of its rhomboid.
    """

    prism_180: TransferChoiceSpec
    prism_0: ShiftChoiceSpec


class MonitorGoalSpec(Spec):
    """What a layout is to reach: standard deviations that are left when the spots have been read; of both cameras the
    worse, of several disturbances files the worst.

    Attributes
    ----------
    angle : float | None
        Of the change of the intersection angle, radians.
    d_f : PositiveLength | None
        Of the change of a principal distance, metres.
    height : PositiveLength | None
        Of a point on the ground, metres; needs the instrument's altitude.
    """

    angle: Annotated[float, Quantity(ANGLE, above_zero=True)] | None = None
    d_f: PositiveLength | None = None
    height: PositiveLength | None = None

    @model_validator(mode="after")
    def _something(self) -> MonitorGoalSpec:
        if not self.wanted:
            raise Problem("what is the layout to reach?", "nothing", "one or several of angle, d_f and height")
        return self

    @property
    def wanted(self) -> dict[str, float]:
        """Those that are given, SI."""
        return {name: value for name in type(self).model_fields if (value := getattr(self, name)) is not None}


class MonitorLimitsSpec(Spec):
    """What a layout must not exceed.

    Attributes
    ----------
    pupil_share : float | None
        Of a camera's imaging pupil that its monitor's prisms take, at the worst place of the line.
    mass : float | None
        Of all prisms together, with what stands in their place and without the central prism, kg.
    spot_sigmas : Number
        So many standard deviations of its place each spot stays on its area CCD.
    ghost_paths : Whole | None
        Of every source, by which the layouts on the front are path-traced; one is left out whose ghosts have more than
        a thousandth of a spot's light. None are traced when left out.
    """

    pupil_share: Annotated[float, Quantity(SCALE, above_zero=True, largest="100 percent")] | None = None
    mass: Annotated[float, Quantity(MASS, above_zero=True)] | None = None
    spot_sigmas: Annotated[Number, Field(gt=0.0, le=10.0)] = 3.0
    ghost_paths: Annotated[Whole, Field(ge=10_000, le=1_000_000_000)] | None = None


class MonitorSearchSpec(Spec):
    """How long is searched.

    Attributes
    ----------
    beams : Whole
        That are drawn at random before anything is known.
    layouts : Whole
        Combinations of them that are compared, at most.
    rounds : Whole
        In which the beams of the best layouts are changed and combined anew, by steps that halve each time the round
        before found nothing better.
    changed : Whole
        Beams that each round tries.
    exact : Whole
        Layouts that are built as a whole after the first draw, and after each round.
    refine : Whole
        Steps by exact gradients with which the best layout is improved at last, at most.
    starts : Whole
        Further searches, each from beams of its own that are drawn at random, and without those of the instrument: do
        they come to the same end?
    """

    beams: Annotated[Whole, Field(ge=1, le=100_000)] = 120
    layouts: Annotated[Whole, Field(ge=1, le=10_000_000)] = 2000
    rounds: Annotated[Whole, Field(ge=0, le=1000)] = 6
    changed: Annotated[Whole, Field(ge=1, le=10_000)] = 24
    exact: Annotated[Whole, Field(ge=1, le=1000)] = 8
    refine: Annotated[Whole, Field(ge=0, le=1000)] = 0
    starts: Annotated[Whole, Field(ge=0, le=100)] = 0


class MonitorDesignSpec(Spec):
    """A monitor's layout to be found: how many beams, where and through which prisms.

    Attributes
    ----------
    instrument : Ref
        To start from, by name or path; a pair whose monitor's channels are mirrored.
    name : Name
        Of the new instrument.
    description : Text
        Of the new instrument, for people.
    disturbances : tuple[Ref, ...] | None
        Files of what is expected to move, by name or path; what the instrument names, when left out.
    beams : Whole
        At each end of a line, at most.
    vary : BeamRangesSpec
        What may vary of each beam.
    prisms : Named[PrismChoiceSpec] | None
        By a name of one's own, what each beam may have for prisms; the start's, when left out.
    area_ccds : Named[instruments.AreaCcdChoiceSpec] | None
        By a name of one's own, which area CCD all channels may have; the start's, when left out.
    central_material : instruments.GlassName | None
        Of the central prism, in place of the start's.
    photons_per_frame : instruments.Photons | None
        Of every spot, in place of the start's.
    frames : instruments.Frames | None
        Of a measurement, in place of the start's.
    goal : MonitorGoalSpec
        What is to be reached.
    limits : MonitorLimitsSpec
        What must not be exceeded.
    search : MonitorSearchSpec
        How long is searched.
    seed : Seed
        Of everything drawn.
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


Turn = Annotated[tuple[float, float, float], Vector(Quantity(ANGLE, largest="180 deg"), 3)]
Light = Literal["refracts", "passes"]


class MirrorSpec(Spec):
    """A mirror about the parent axis; of revolution, unless ``sag`` has terms that are not. A camera may have faces of
    lenses and a stop of its own among its mirrors: ``light`` says what happens there.

    Attributes
    ----------
    z : Length
        Vertex on the parent axis, metres; light enters toward +z.
    decentre : Vector2 | None
        Of the vertex from the parent axis, along x and y, metres.
    rotate : Turn | None
        Rotation vector by which the surface is turned about its vertex, radians.
    radius : Radius
        Vertex radius of curvature, metres, positive if the centre of curvature lies toward +z; ``flat`` for a plane.
    conic : Number
        Conic constant k.
    aspheric : AsphereTerms
        Terms A4, A6, ... of the sag beyond the conic's, 1/m^3, 1/m^5, ...; empty for a pure conic.
    sag : FrozenMap[str, SagTerm] | None
        Further terms of the sag, by kind, each with its numbers.
    light : Light | None
        What it does there, left out for a mirror; a plane that it passes is there to be the stop.
    index : Number | None
        Refractive index behind a face of a lens, where light goes to, at the design wavelength; 1 where it leaves the
        lens.
    glass : LensGlass | None
        What lies behind a face where light enters a lens, in place of its index there, which then follows from the
        dispersion at every wavelength.
    edges : tuple[SurfaceEdgeSpec, ...] | None
        What cuts light there beside the stop; several stop what any of them stops.
    """

    z: Length
    decentre: Vector2 | None = None
    rotate: Turn | None = None
    radius: Radius
    conic: Number = 0.0
    aspheric: AsphereTerms = Field(default_factory=FrozenMap)
    sag: Annotated[FrozenMap[str, SagTerm], SagTerms()] | None = None
    light: Light | None = None
    index: Annotated[Number, Field(ge=1.0, le=10.0)] | None = None
    glass: LensGlass | None = None
    edges: Annotated[tuple[SurfaceEdgeSpec, ...], Field(min_length=1, max_length=100)] | None = None

    @model_validator(mode="after")
    def _is_curved(self) -> MirrorSpec:
        if self.radius == 0.0:
            raise Problem("a radius of curvature cannot be zero", "0 m", "a length other than zero", within=("radius",))
        return self

    @model_validator(mode="after")
    def _index_where_light_refracts(self) -> MirrorSpec:
        given = [key for key in ("index", "glass") if getattr(self, key) is not None]
        if (self.light == "refracts") != bool(given):
            problem = "a face of a lens has an index behind it, and nothing else has"
            found = f"{' and '.join(given)}, light: {self.light or 'reflected'}" if given else "no index"
            raise Problem(problem, found, "light: refracts with an index or a glass", within=("light",))
        if len(given) > 1:
            problem = "the index of a glass follows from its dispersion"
            raise Problem(problem, "index and glass", "one of both", within=("index",))
        return self

    @property
    def enters_glass(self) -> bool:
        """Whether light goes into a lens here."""
        return self.light == "refracts" and self.index != 1.0


class FieldSpec(Spec):
    """Half angles of the field of view, radians: x along the line CCD, y across it, about the field bias."""

    x: Annotated[float, Quantity(ANGLE, above_zero=True, largest="45 deg")]
    y: Annotated[float, Quantity(ANGLE, above_zero=True, largest="45 deg")]


class ImageSpec(Spec):
    """The focal plane.

    Attributes
    ----------
    z : Length
        Where it crosses the parent axis, metres.
    tilt : float | None
        About the prescription's x, along the line CCD, radians; left out for a plane square to the axis.
    """

    z: Length
    tilt: Annotated[float, Quantity(ANGLE, largest="45 deg")] | None = None


class LineSpec(Spec):
    """The line CCD, centred on the field bias: number of pixels and their pitch, metres."""

    pixels: Annotated[Whole, Field(ge=2, le=1_000_000)]
    pitch: PixelPitch


class CameraSpec(TitledSpec):
    """An off-axis mirror camera.

    Attributes
    ----------
    name
        As the file is called.
    description
        For people.
    focal_length : PositiveLength
        Nominal, metres; the trace tells the exact one.
    entrance_pupil : PositiveLength
        Diameter of the entrance pupil, metres: of the beam along the axis before the first surface. Its rays make the
        stop as large as they spread there, unless ``stop_diameter`` states that.
    field_bias : instruments.FieldPlace
        Angle of the line CCD's centre from the parent axis, in the plane of symmetry, radians.
    field : FieldSpec
        Half angles about the field bias.
    wavelength : Wavelength
        Design wavelength, metres.
    stop : Name
        Name of the mirror, or other surface, that is the aperture stop.
    stop_diameter : PositiveLength | None
        Diameter of the stop, metres, where it is known; ``entrance_pupil`` is then nominal.
    mirrors : Named[MirrorSpec]
        By name, in the order in which the light meets them; faces of lenses and a stop among them.
    image : ImageSpec
        Focal plane.
    line : LineSpec
        Line CCD.
    bands : Named[BandSpec]
        Line CCDs by spectral band, for images of targets; empty when none is described.
    spectrum : Spectrum | None
        Light of which the camera is judged over all wavelengths; that of its band when left out.
    medium : Medium | None
        What its lenses stand in at 20 C, which the index of a glass is against: ``air``, as prescriptions on the ground
        take it, or ``vacuum``, also when left out.
    edge_margin : float
        By how much a mirror's clear aperture is wider than the beams that use it, metres.
    """

    focal_length: PositiveLength
    entrance_pupil: PositiveLength
    field_bias: instruments.FieldPlace
    field: FieldSpec
    wavelength: Wavelength
    stop: Name
    stop_diameter: PositiveLength | None = None
    mirrors: Annotated[Named[MirrorSpec], Field(min_length=1)]
    image: ImageSpec
    line: LineSpec
    bands: Named[BandSpec] = Field(default_factory=FrozenMap)
    spectrum: Spectrum | None = None
    medium: Medium | None = None
    edge_margin: Annotated[float, Quantity(LENGTH, smallest="0 mm", largest="1 m")] = 0.005

    @model_validator(mode="after")
    def _stop_is_a_mirror(self) -> CameraSpec:
        if self.stop not in self.mirrors:
            raise unknown("the stop is not one of the mirrors", self.stop, self.mirrors, ("stop",))
        return self

    @model_validator(mode="after")
    def _lenses_stand_in_air(self) -> CameraSpec:
        inside = ""
        for name, mirror in self.mirrors.items():
            if mirror.light != "refracts":
                continue
            if mirror.enters_glass == bool(inside):
                problem = "a lens has a face into glass and a face out of it, with nothing cemented to it"
                allowed = "index: 1 where light leaves glass" if inside else "an index above 1 where light enters glass"
                key = "index" if mirror.glass is None else "glass"
                found = f"{mirror.index:g}" if mirror.glass is None else mirror.glass.name
                raise Problem(problem, found, allowed, within=("mirrors", name, key))
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
                problem = "an index alone says nothing of other wavelengths than the design's"
                allowed = f"the glass of {plain[0]} by its name, or no {key}"
                raise Problem(problem, f"index at {plain[0]}", allowed, within=(key,))
        return self

    @model_validator(mode="after")
    def _glasses_are_known(self) -> CameraSpec:
        self._check_glasses()
        return self

    def _check_glasses(self) -> None:
        """Refuse light at which a glass is not known. Raises Problem."""
        lights: dict[tuple[str, ...], SpectrumSpec] = {
            ("bands", name, "spectrum"): band.spectrum for name, band in self.bands.items()
        }
        if self.spectrum is not None:
            lights["spectrum",] = self.spectrum
        colours: dict[tuple[str, ...], tuple[float, ...]] = {("wavelength",): (self.wavelength,)}
        # of a table that has not been read the wavelengths are not known yet
        colours |= {key: light.ends for key, light in lights.items() if light.curve is not None or light.table is None}
        for name, mirror in self.mirrors.items():
            for key, wavelengths in colours.items() if mirror.glass is not None else ():
                for wavelength in wavelengths:
                    try:
                        self.index_behind(name, wavelength)
                    except ValueError as error:
                        raise Problem(f"{name}: {error}", within=key) from None

    def index_behind(self, name: str, wavelength: float | None = None) -> float:
        """Refractive index behind a face of a lens, against what the lens stands in.

        Parameters
        ----------
        name : str
            Of the face.
        wavelength : float | None
            Metres; the design wavelength by default.

        Raises
        ------
        ValueError
            Its glass is not known there, or the face has an index alone and another wavelength is asked for than that
            of the design.
        """
        mirror, colour = self.mirrors[name], self.wavelength if wavelength is None else wavelength
        if mirror.glass is not None:
            return mirror.glass.index(colour, self.medium or "vacuum")
        if mirror.index is None:
            raise ValueError(f"{name} is no face of a lens")
        if mirror.enters_glass and colour != self.wavelength:
            raise ValueError(f"{name}: its index is known at the design wavelength alone; name its glass")
        return mirror.index

    def warm_glass(self, name: str) -> WarmGlass:
        """What heat does to the glass behind a face where light enters a lens, at the design wavelength.

        Raises
        ------
        ValueError
            Nothing says it.
        """
        mirror = self.mirrors[name]
        if mirror.glass is None:
            raise ValueError(
                f"the index of {name} alone says nothing of heat; name its glass, with `expansion` and `thermal` where "
                "no catalogue has them"
            )
        return mirror.glass.warm(self.wavelength, self.medium or "vacuum")

    @property
    def light(self) -> SpectrumSpec | None:
        """Of which it is judged over all wavelengths: its own, or its panchromatic or first band's; None for none."""
        if self.spectrum is not None or not self.bands:
            return self.spectrum
        return self.bands[PANCHROMATIC if PANCHROMATIC in self.bands else next(iter(self.bands))].spectrum

    def with_curves(self) -> CameraSpec:
        """Return the camera with the tables of its spectra read.

        Raises
        ------
        InputError
            a table is not there or not right, or has wavelengths at which a glass is not known.
        """
        bands = {
            name: band.model_copy(update={"spectrum": band.spectrum.read(self, ("bands", name, "spectrum"))})
            for name, band in self.bands.items()
        }
        own = None if self.spectrum is None else self.spectrum.read(self, ("spectrum",))
        if own is self.spectrum and all(bands[name].spectrum is band.spectrum for name, band in self.bands.items()):
            return self
        read = self.model_copy(update={"bands": FrozenMap(bands), "spectrum": own})
        try:
            read._check_glasses()
        except Problem as problem:
            raise self.error(problem) from None
        return read

    def require_mirrors(self, where: str, on_axis: bool = False) -> None:
        """Refuse a camera that is not made of mirrors alone.

        Parameters
        ----------
        where : str
            Such a camera cannot stand, for the message.
        on_axis : bool
            Refuse mirrors that are flat, turned or off the parent axis, too.

        Raises
        ------
        InputError
            It has a lens, a stop or edges of its own; with the line.
        """
        for name, mirror in self.mirrors.items():
            if mirror.edges:
                problem = f"{where} has no edges of its own: its clear apertures follow from its beams"
                raise self.error(problem, ("mirrors", name, "edges"), allowed="no edges")
            if mirror.light is not None:
                problem = f"{where} is made of mirrors alone"
                raise self.error(problem, ("mirrors", name, "light"), found=mirror.light, allowed="mirrors")
            if on_axis and (mirror.decentre or mirror.rotate or isinf(mirror.radius)):
                key = next(k for k in ("decentre", "rotate", "radius") if k == "radius" or getattr(mirror, k))
                problem = f"{where} has curved mirrors about one axis"
                raise self.error(problem, ("mirrors", name, key), allowed="mirrors without decentre and rotate")


IMAGE = "image"
Vary = Literal["radius", "conic", "A4", "A6", "A8", "z"]


class CameraDesignSpec(Spec):
    """What is to be optimised.

    The focal length along the line, the entrance pupil, the field and its bias stay as they are.

    Attributes
    ----------
    camera : Ref
        Prescription to start from, by name or path.
    name : Name
        Of the new camera.
    description : Text
        Of the new camera, for people.
    vary : Named[tuple[Vary, ...]]
        Mirror, or ``image`` -> what of it varies.
    envelope : float | None
        Extent along the parent axis over all mirrors and the image, relative to the start's; the largest.
    clearance : Length
        Least distance of every beam, in the plane of symmetry, from the edge of every mirror and of the focal plane
        that it passes, metres.
    anamorphism : float | None
        By how much the focal length along the line may differ from that across it, a share of the latter; free where it
        is left out.
    steps : Whole
        In which the envelope is brought from the start's to the goal's.
    starts : Whole
        How many: the camera itself with the envelope shortened in steps, the same at once, and others drawn about it.
        One start finds one local optimum.
    seed : Seed
        Of the starts that are drawn.
    """

    camera: Ref
    name: Name
    description: Text = ""
    vary: Annotated[Named[tuple[Vary, ...]], Field(min_length=1)]
    envelope: Annotated[float, Quantity(SCALE, above_zero=True, largest="200 percent")] | None = None
    clearance: Length = 0.02
    anamorphism: Annotated[float, Quantity(SCALE, above_zero=True, largest="100 percent")] | None = None
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
