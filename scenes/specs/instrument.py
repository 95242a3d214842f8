"""Instrument of an input file: cameras on a common base with their monitor channels and prisms.

An instrument as built is another file's instrument with the deviations of its bodies from the design.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import AfterValidator, Field, model_validator

from optics.geometry.tree import Motion, State
from optics.materials.glass import GLASSES, glass
from optics.materials.material import MATERIALS, material
from optics.numerics.number_tree import FrozenMap
from optics.raytrace.reflectors import REFLECTORS, Reflector
from scenes.specs.baffle import BaffleSpec
from scenes.specs.detector import AreaSide, PixelPitch
from scenes.specs.perturbation import AsBuilt, PlainPerturbationSpec
from scenes.yaml.errors import InputError, KeyPath, Problem, unknown
from scenes.yaml.spec import (
    Catalogued,
    Name,
    Named,
    NothingIsEmpty,
    Number,
    OneOf,
    Ref,
    Spec,
    TitledSpec,
    Whole,
    name_in,
    require_one,
)
from scenes.yaml.unit_fields import PositiveLength, Quantity, Vector, Vector2, Vector3, Wavelength
from scenes.yaml.units import ANGLE, DISTANCE, LENGTH, TEMPERATURE, TIME

BASE = "base"
SIDES = ("left", "right")
PRISM_180, PRISM_0 = "prism_180", "prism_0"
PRISMS = (PRISM_180, PRISM_0)
"""Prisms of a channel in the order of the light: keys of ``monitor`` in an instrument's file, and last parts of the
paths of their bodies.
"""
CENTRAL_KEY = "central_prism"
"""Key of the central prism in an instrument's file."""
CENTRAL_PRISM = f"{BASE}/{CENTRAL_KEY}"
"""Body path of the central prism."""


def prism_of(path: str) -> str | None:
    """Return which of ``PRISMS`` a body is or belongs to, from its path; None for other bodies."""
    return next((part for part in path.split("/") if part in PRISMS), None)


def channel_of(path: str) -> tuple[str, str] | None:
    """Return camera and channel to whose prisms or boards a body belongs, from its path; None for other bodies."""
    parts = path.split("/")
    return (parts[1], parts[3]) if len(parts) > 4 and parts[2] in ("monitor", "focal_plane") else None


@dataclass(frozen=True)
class Channel:
    """Monitor channel of a camera.

    Attributes
    ----------
    camera, name : str
        Names of the camera and of the channel, e.g. ``forward``, ``left``; those of a plain pair are ``left`` (the +Y
        end of the line) and ``right``.
    pinhole, ccd : tuple[float, float]
        Positions in the focal plane's X, Y, in metres.
    pupil_offset : tuple[float, float]
        Position of the beam's centre in the entrance pupil, X and Y, in metres.
    aperture : float
        Diameter of the return face, in metres.
    photons : float
        Photons of the spot in a frame.
    """

    camera: str
    name: str
    pinhole: tuple[float, float]
    ccd: tuple[float, float]
    pupil_offset: tuple[float, float]
    aperture: float
    photons: float

    @property
    def key(self) -> str:
        """Prefix ``<camera>/<name>`` of the channel's elements and sequences."""
        return f"{self.camera}/{self.name}"

    @property
    def reticle_body(self) -> str:
        """Body path of the pinhole."""
        return f"{BASE}/{self.camera}/focal_plane/{self.name}/reticle"

    @property
    def ccd_body(self) -> str:
        """Body path of the area CCD."""
        return f"{BASE}/{self.camera}/focal_plane/{self.name}/area_ccd"

    def prism_body(self, prism: str) -> str:
        """Return the body path of one of ``PRISMS``."""
        return f"{BASE}/{self.camera}/monitor/{self.name}/{prism}"

    def prism_elements(self, prism: str) -> str:
        """Return the prefix of the names of the optical elements of one of the channel's ``PRISMS``."""
        return f"{self.key}/{prism}"

    @property
    def face_body(self) -> str:
        """Body path of the return face."""
        return f"{CENTRAL_PRISM}/{self.camera}_{self.name}"


Tilt = Annotated[tuple[float, float], Vector(Quantity(ANGLE, largest="1 deg"), 2)]


GlassName = Annotated[str, Field(strict=True), name_in("glass", GLASSES, glass)]
"""Name of a glass in the catalogue of optics/materials/glass.py."""


MadeOf = Annotated[str, Field(strict=True), Catalogued(lambda name: _spelt(name), MATERIALS)]
"""Name of a glass, or of the material of a frame that carries mirrors, which kinds without glass allow."""


def _spelt(name: str) -> str:
    """Return a material's name as the catalogue spells it; an unknown name is returned unchanged."""
    try:
        return material(name).name
    except KeyError:
        return name


FaceErrors = Annotated[dict[Name, Tilt], NothingIsEmpty, AfterValidator(FrozenMap)]


def reflector_kinds(returns: bool) -> OneOf:
    """Return the names of the reflectors that return the beam, or of those that displace it."""
    return OneOf(lambda: (name for name, kind in REFLECTORS.items() if kind.returns == returns))


def _check_faces(errors: Mapping[str, tuple[float, float]], reflector: Reflector) -> None:
    """Raise `Problem` for angle errors of faces that a reflector does not have."""
    for name in errors:
        if name not in reflector.faces:
            raise unknown("no such face", name, reflector.faces, ("angle_errors", name))


def check_made(from_design: str, reflector: Reflector) -> None:
    """Raise `Problem` if a reflector cannot be made of a material: glass for prisms, any material for frames."""
    names = GLASSES if reflector.transparent else MATERIALS
    if from_design not in names:
        what = "no such glass" if reflector.transparent else "no such material"
        if from_design in MATERIALS:
            what += ": this kind transmits light and must be made of glass"
        raise unknown(what, from_design, names, ("material",))


class Prism180Spec(Spec):
    """Lateral-transfer prism, whose three mutually perpendicular faces return the beam parallel to itself.

    Attributes
    ----------
    material : str
        Glass of the prism; for a kind without glass the material of its frame and mirrors.
    distance : float
        Distance from the camera's origin to the window, along the line of sight, in metres.
    width : float
        Width of the clear apertures across the beam, in metres; somewhat more than the return face's diameter.
    tilt : tuple[float, float]
        Rotation about the prism's x and y, relative to faces perpendicular to the beam, in radians. Its centre is the
        pivot `apex` of the prism, about which rotations do not displace the beam. It leaves the beam's direction
        unchanged and keeps the reflections from the faces off the area CCD.
    angle_errors : dict[str, tuple[float, float]]
        Name of a face -> its manufacturing tilt about the face's x and y, in radians. Faces: window, mirror, roof_a,
        roof_b; of the hollow kind mirror, roof_a, roof_b.
    kind : str | None
        Kind of reflector: a prism (lateral_transfer, the default) or three mirrors on a frame (hollow_transfer).
    """

    material: MadeOf
    distance: PositiveLength
    width: PositiveLength
    tilt: Tilt = (0.0, 0.0)
    angle_errors: FaceErrors = Field(default_factory=FrozenMap)
    kind: Annotated[str, reflector_kinds(returns=True)] | None = None

    @property
    def reflector(self) -> Reflector:
        """Geometry of the faces or mirrors of this kind of reflector."""
        return REFLECTORS[self.kind or "lateral_transfer"]

    @model_validator(mode="after")
    def _can_be_made(self) -> Prism180Spec:
        check_made(self.material, self.reflector)
        _check_faces(self.angle_errors, self.reflector)
        return self


class Prism0Spec(Spec):
    """Rhomboid, whose two parallel reflecting faces displace the beam and keep its direction.

    Attributes
    ----------
    material : str
        Glass of the prism; for a kind without glass the material of its frame and mirrors.
    distance : float
        Distance from the return face to the prism's centre, along the beam, in metres.
    shift : float
        Displacement of the beam, toward the central prism, in metres.
    width : float
        Width of the clear apertures across the beam, in metres.
    tilt : tuple[float, float]
        Rotation of the prism about its centre, about its x and y, relative to faces perpendicular to the beam, in
        radians.
    angle_errors : dict[str, tuple[float, float]]
        Name of a face -> its manufacturing tilt about the face's x and y, in radians. Faces: entry, mirror_a, mirror_b,
        exit; of the periscope mirror_a, mirror_b.
    kind : str | None
        Kind of reflector: a prism (rhomboid, the default) or two mirrors on a frame (periscope).
    """

    material: MadeOf
    distance: PositiveLength
    shift: PositiveLength
    width: PositiveLength
    tilt: Tilt = (0.0, 0.0)
    angle_errors: FaceErrors = Field(default_factory=FrozenMap)
    kind: Annotated[str, reflector_kinds(returns=False)] | None = None

    @property
    def reflector(self) -> Reflector:
        """Geometry of the faces or mirrors of this kind of reflector."""
        return REFLECTORS[self.kind or "rhomboid"]

    @model_validator(mode="after")
    def _can_be_made(self) -> Prism0Spec:
        check_made(self.material, self.reflector)
        _check_faces(self.angle_errors, self.reflector)
        return self


Spread = Annotated[tuple[float, float], Vector(Quantity(LENGTH, above_zero=True, largest="10 m"), 2)]


class CentralPrismSpec(Spec):
    """Central prism, the common reference of all cameras: a block with one mirror facet for each channel.

    The facets meet in its apex.

    Attributes
    ----------
    position : tuple[float, float, float]
        Position of the apex in the base frame, in metres.
    material : str
        Glass of the block.
    spread : tuple[float, float]
        Distance from the apex at which the beams meet their facets, along the base's X and Y, in metres.
    height : float
        Height of the block below the apex, in metres.
    """

    position: Vector3
    material: GlassName
    spread: Spread
    height: PositiveLength


MaterialName = Annotated[str, Field(strict=True), name_in("material", MATERIALS, material)]
Exposure = Annotated[float, Quantity(TIME, above_zero=True, largest="100 s")]
LookAngle = Annotated[float, Quantity(ANGLE, largest="90 deg")]
FieldAngle = Annotated[float, Quantity(ANGLE, largest="45 deg")]
Photons = Annotated[Number, Field(gt=0.0, le=1e12)]
MOST_FRAMES = 10_000
Frames = Annotated[Whole, Field(ge=1, le=MOST_FRAMES)]


class ReticleSpec(Spec):
    """Light source of a monitor channel: an illuminated pinhole in the focal plane.

    Attributes
    ----------
    pinhole : float
        Diameter of the pinhole, in metres.
    photons_per_frame : float
        Expected number of photons of a spot that reach the plane of the area CCD during one exposure.
    """

    pinhole: PositiveLength
    photons_per_frame: Photons


class AreaCcdSpec(Spec):
    """Area CCD of a monitor channel.

    Attributes
    ----------
    detector : str
        Data sheet of the detector, by name or path.
    rows : int
        Number of pixel rows.
    columns : int
        Number of pixel columns.
    pitch : float
        Pixel pitch, in metres.
    offset : tuple[float, float]
        Position (X, Y) of the pixel grid's centre relative to the pinhole, in the focal plane, in metres.
    exposure : float
        Exposure of a frame, in seconds.
    """

    detector: Ref
    rows: AreaSide
    columns: AreaSide
    pitch: PixelPitch
    offset: Vector2
    exposure: Exposure


class AreaCcdChoiceSpec(Spec):
    """Area CCD that the monitor may have, as one choice of the search.

    Pixels of another size need another detector with its own data sheet.

    Attributes
    ----------
    detector : str
        Data sheet of the detector, by name or path.
    pitch : float
        Pixel pitch, in metres.
    rows : int
        Number of pixel rows.
    columns : int
        Number of pixel columns.
    """

    detector: Ref
    pitch: PixelPitch
    rows: AreaSide
    columns: AreaSide


class ReturnFaceSpec(Spec):
    """Mirror-coated facet of the central prism, which returns the monitor's beam and limits it.

    Attributes
    ----------
    aperture : float
        Diameter of the mirror coating, in metres.
    """

    aperture: PositiveLength


class ChannelSpec(Spec):
    """Channel of a camera's monitor, for cameras with other channels than the plain pair.

    Optional keys replace the values that the monitor has for all channels.

    Attributes
    ----------
    field : float
        Field angle of the area CCD from the visual axis, positive at the +Y end of the line, in radians.
    pupil_offset : tuple[float, float]
        Centre (X, Y) of the beam in the entrance pupil, in metres.
    return_face : ReturnFaceSpec | None
        Mirror that returns the beam and limits it; by default the monitor's.
    spread : tuple[float, float] | None
        Distance from the central prism's apex at which the beam meets its facet, along the base's X and Y, in metres;
        by default the central prism's.
    photons_per_frame : float | None
        Photons of the spot per frame; by default those of the monitor's reticle.
    prism_180 : Prism180Spec | None
        Lateral-transfer prism; by default the monitor's.
    prism_0 : Prism0Spec | None
        Rhomboid; by default the monitor's.
    """

    field: FieldAngle
    pupil_offset: Vector2
    return_face: ReturnFaceSpec | None = None
    spread: Spread | None = None
    photons_per_frame: Photons | None = None
    prism_180: Prism180Spec | None = None
    prism_0: Prism0Spec | None = None


@dataclass(frozen=True)
class ChannelParts:
    """Parts of a channel, with the monitor's parts where the channel has none of its own; keys as in `ChannelSpec`."""

    field: float
    pupil_offset: tuple[float, float]
    return_face: ReturnFaceSpec
    spread: tuple[float, float]
    photons_per_frame: float
    prism_180: Prism180Spec
    prism_0: Prism0Spec

    @property
    def prisms(self) -> dict[str, Prism180Spec | Prism0Spec]:
        """Both prisms by their keys, in the order of the light."""
        return {PRISM_180: self.prism_180, PRISM_0: self.prism_0}


class MountedCameraSpec(Spec):
    """Camera mounted on the base, with the channels of its monitor.

    The channels are a plain pair at both ends of the line through one part of the pupil, or any number of channels. An
    instrument without a monitor has no channels.

    Attributes
    ----------
    camera : str
        Prescription of the camera, by name or path.
    look : float
        Look angle: angle of the visual axis from the base's +Z about the base's Y, positive forward (toward +X), in
        radians.
    position : tuple[float, float, float]
        Position of the camera's origin in the base frame, in metres.
    pupil_offset : tuple[float, float] | None
        Centre (X, Y) of the sub-aperture in the entrance pupil of a plain pair of channels, at both ends of the line,
        in metres.
    channels : Mapping[str, ChannelSpec] | None
        Name -> channel, instead of a plain pair. The published formulas need a pair at opposite fields called left and
        right; other cameras are measured by the estimators that use all spots.
    """

    camera: Ref
    look: LookAngle
    position: Vector3
    pupil_offset: Vector2 | None = None
    channels: Annotated[Named[ChannelSpec], Field(min_length=1)] | None = None

    @property
    def mirrored(self) -> MountedCameraSpec:
        """Copy of the camera with all monitor beams through the opposite part of the pupil."""
        if self.pupil_offset is not None:
            x, y = self.pupil_offset
            return self.model_copy(update={"pupil_offset": (-x, -y)})
        if self.channels is None:
            return self
        opposite = {
            name: spec.model_copy(update={"pupil_offset": (-spec.pupil_offset[0], -spec.pupil_offset[1])})
            for name, spec in self.channels.items()
        }
        return self.model_copy(update={"channels": FrozenMap(opposite)})


class MaterialsSpec(Spec):
    """Materials of the parts, by their names in the catalogue of optics/materials/material.py.

    Prisms have their own key for the glass.

    Attributes
    ----------
    base : str
        Material of the common structure.
    camera : str
        Material of each camera's structure and of the monitor's brackets.
    mirror : str
        Material of all mirrors.
    focal_plane : str
        Material of the carrier of the line CCD.
    board : str
        Material of the boards at each end of the line that carry reticle and area CCD.
    """

    base: MaterialName = "CFRP"
    camera: MaterialName = "CFRP"
    mirror: MaterialName = "Zerodur"
    focal_plane: MaterialName = "SiC"
    board: MaterialName = "AlN"


class MonitorSpec(Spec):
    """Autocollimation monitor. Its parts are the same in all cameras and in both channels of each.

    Attributes
    ----------
    wavelength : float
        Wavelength of the source, in metres.
    field : float
        Field angle of the area CCDs from the visual axis, left at +Y and right at -Y, in radians.
    reticle : ReticleSpec
        Light source of each channel.
    area_ccd : AreaCcdSpec
        Detector of each channel.
    prism_180 : Prism180Spec
        Lateral-transfer prism of each channel.
    prism_0 : Prism0Spec
        Rhomboid of each channel.
    return_face : ReturnFaceSpec
        Mirror that returns the beam of each channel.
    frames : int
        Number of frames averaged in a measurement.
    """

    wavelength: Wavelength
    field: Annotated[float, Quantity(ANGLE, above_zero=True, largest="45 deg")]
    reticle: ReticleSpec
    area_ccd: AreaCcdSpec
    prism_180: Prism180Spec
    prism_0: Prism0Spec
    return_face: ReturnFaceSpec
    frames: Frames = 9

    @property
    def prisms(self) -> dict[str, Prism180Spec | Prism0Spec]:
        """Both prisms by their keys, in the order of the light."""
        return {PRISM_180: self.prism_180, PRISM_0: self.prism_0}


class InstrumentSpec(TitledSpec):
    """Instrument: cameras on a common base, either all with a monitor or all without one.

    Attributes
    ----------
    cameras : Mapping[str, MountedCameraSpec]
        Name -> camera; the first one is the reference for the change of the intersection angle.
    central_prism : CentralPrismSpec | None
        Central prism, the common reference of the monitor; absent if there is no monitor.
    monitor : MonitorSpec | None
        Monitor of every camera; by default there is none.
    temperature : float
        Temperature at which all parts have their nominal shape, in kelvin.
    materials : MaterialsSpec
        Materials of structures, mirrors and carriers of detectors.
    baffles : Mapping[str, BaffleSpec]
        Name -> baffle, a black part that blocks light; none by default.
    altitude : float | None
        Altitude of the orbit, in metres. It is needed to express changes of a pair's cameras as errors on the ground.
    disturbances : str | None
        Expected disturbances unless a job has its own: a file of scenes/library/disturbances or the path of your file.
    as_built : Mapping[str, PlainPerturbationSpec] | None
        Node -> deviation of the built body from the rest of this file, as in a job's `perturb`. A job's perturbation is
        added to it, and changes are counted from it.
    """

    cameras: Annotated[Named[MountedCameraSpec], Field(min_length=1)]
    central_prism: CentralPrismSpec | None = None
    monitor: MonitorSpec | None = None
    temperature: Annotated[float, Quantity(TEMPERATURE, above_zero=True, largest="1000 K")] = 293.15
    materials: Annotated[MaterialsSpec, NothingIsEmpty] = MaterialsSpec.model_construct()
    baffles: Annotated[Named[BaffleSpec], NothingIsEmpty] = Field(default_factory=FrozenMap)
    altitude: Annotated[float, Quantity(DISTANCE, smallest="100 km", largest="50000 km")] | None = None
    disturbances: Ref | None = None
    as_built: AsBuilt | None = None

    @model_validator(mode="after")
    def _monitor_is_whole(self) -> InstrumentSpec:
        if (self.monitor is None) != (self.central_prism is None):
            missing = "monitor" if self.monitor is None else CENTRAL_KEY
            text = "a monitor needs both the section `monitor` and a central prism"
            raise Problem(text, f"no {missing}", f"{missing}, or neither of the two", within=())
        for name, mounted in self.cameras.items():
            if self.monitor is not None:
                allowed = "one of pupil_offset and channels"
                problem = "the monitor's channels must be given in exactly one way"
                require_one(mounted, ("pupil_offset", "channels"), problem, allowed, ("cameras", name))
                continue
            keys = [key for key in ("pupil_offset", "channels") if getattr(mounted, key) is not None]
            if keys:
                text = "a camera of an instrument without a monitor has no channels"
                raise Problem(text, keys[0], "neither, or a monitor and a central_prism", within=("cameras", name))
        return self

    @classmethod
    def of_camera(cls, name: str, camera: str) -> InstrumentSpec:
        """Return a single camera as an instrument: on the base, without a look angle and without a monitor.

        Parameters
        ----------
        name : str
            Name of the camera and of the instrument.
        camera : str
            Prescription, by name or path.
        """
        mounted = MountedCameraSpec.model_construct(camera=camera, look=0.0, position=(0.0, 0.0, 0.0))
        return cls.model_construct(name=name, cameras=FrozenMap({name: mounted}))

    @property
    def autocollimator(self) -> MonitorSpec:
        """Monitor of the instrument.

        Raises
        ------
        InputError
            The instrument has no monitor.
        """
        if self.monitor is None:
            raise self._without_monitor()
        return self.monitor

    @property
    def reference_prism(self) -> CentralPrismSpec:
        """Central prism of the instrument. Raises InputError if it has none."""
        if self.central_prism is None:
            raise self._without_monitor()
        return self.central_prism

    def _without_monitor(self) -> InputError:
        text = f"{self.name} has no monitor, so that its changes cannot be measured"
        return self.error(text, ("monitor",), allowed="an instrument with a monitor and a central_prism")

    def key_of(self, camera: str, channel: str, key: KeyPath) -> KeyPath:
        """Return the key at which the file sets a property of a channel: at the channel itself, or for all channels.

        Parameters
        ----------
        camera : str
            Name of the camera; an unknown one leaves the key unchanged.
        channel : str
            Name of the channel; an unknown one leaves the key unchanged.
        key : KeyPath
            Key for all channels, e.g. ``("monitor", "prism_180", "width")``.
        """
        mounted = self.cameras.get(camera)
        if mounted is None or mounted.channels is None or channel not in mounted.channels:
            return key
        common = {
            ("monitor", "field"): "field",
            ("cameras", camera, "pupil_offset"): "pupil_offset",
            ("monitor", "return_face"): "return_face",
            ("central_prism", "spread"): "spread",
            ("monitor", "reticle", "photons_per_frame"): "photons_per_frame",
            ("monitor", PRISM_180): PRISM_180,
            ("monitor", PRISM_0): PRISM_0,
        }
        for start, name in common.items():
            if key[: len(start)] == start and getattr(mounted.channels[channel], name) is not None:
                return ("cameras", camera, "channels", channel, name, *key[len(start) :])
        return key

    def channels_of(self, camera: str) -> dict[str, ChannelParts]:
        """Return all channels of a camera's monitor by name; empty without a monitor.

        Parameters
        ----------
        camera : str
            Name of the camera.
        """
        mounted = self.cameras[camera]
        if self.monitor is None or self.central_prism is None:
            return {}
        monitor, prism = self.monitor, self.central_prism
        specs = mounted.channels
        if specs is None:
            assert mounted.pupil_offset is not None
            pair = zip(SIDES, (monitor.field, -monitor.field), strict=True)
            specs = {name: ChannelSpec.model_construct(field=f, pupil_offset=mounted.pupil_offset) for name, f in pair}
        out = {}
        for name, spec in specs.items():
            face, spread = spec.return_face or monitor.return_face, spec.spread or prism.spread
            photons = spec.photons_per_frame or monitor.reticle.photons_per_frame
            prisms = (spec.prism_180 or monitor.prism_180, spec.prism_0 or monitor.prism_0)
            out[name] = ChannelParts(spec.field, spec.pupil_offset, face, spread, photons, *prisms)
        return out


DESIGN = "design"
"""Key that identifies the file of an instrument as built."""


class AsBuiltInstrumentSpec(TitledSpec):
    """Instrument as built: the instrument of a design, and the deviations of its bodies from that design.

    Attributes
    ----------
    design : str
        Instrument of the design: a name in scenes/library/instruments, or the path of your file. A camera, given as
        `{camera: NAME or FILE}` or by its name, is an instrument without a monitor.
    as_built : Mapping[str, PlainPerturbationSpec]
        Node -> deviation from the design, as in a job's `perturb`; the node is given by its path or the last parts of
        it. Or a list of texts such as `M2 shift z 20 um`. A job's perturbation is added to it, and changes are counted
        from it.
    disturbances : str | None
        Expected disturbances, or the uncertainty of the deviations: a file of scenes/library/disturbances or the path
        of your file; by default the design's.
    """

    design: Ref
    as_built: AsBuilt = Field(default_factory=FrozenMap)
    disturbances: Ref | None = None

    def from_design(self, design: InstrumentSpec, disturbances: str | None = None) -> InstrumentSpec:
        """Return the instrument as built: the designed one with these deviations.

        Parameters
        ----------
        design : InstrumentSpec
            Instrument to which `design` refers.
        disturbances : str | None
            Name or absolute path of the file of disturbances; None for the design's.
        """
        update: dict[str, Any] = {"name": self.name, "as_built": self.as_built}
        update |= {} if not self.description else {"description": self.description}
        update |= {} if disturbances is None else {"disturbances": disturbances}
        return design.model_copy(update=update)


def as_built_of(state: State) -> FrozenMap[str, PlainPerturbationSpec]:
    """Return the motions and shape changes of a state in the form of `as_built` in an instrument's file.

    Parameters
    ----------
    state : State
        Body path -> motion, for example the result of `optics.geometry.tree.compose` for an estimated state and the one
        that the file already has. Bodies without motion are omitted.

    Raises
    ------
    ValueError
        A motion has a scale, a stretch, an index gradient or a grid, which the file cannot express.
    """
    return FrozenMap({path: _built(path, motion) for path, motion in state.items() if motion != Motion()})


def _built(path: str, motion: Motion) -> PlainPerturbationSpec:
    if motion.scale or motion.expansion or any(motion.index_gradient) or motion.grid is not None:
        raise ValueError(f"{path}: only rigid motions, Zernike terms, radius, conic constant and index are as built")
    # the parts are already validated; validating again would require quantities as text
    return PlainPerturbationSpec.model_construct(
        rotate=motion.rotate,
        shift=motion.shift,
        pivot=motion.pivot,
        figure=FrozenMap({f"Z{j}": value for j, value in sorted(motion.figure.items())}),
        radius=motion.radius or None,
        conic=motion.conic or None,
        index=motion.index or None,
    )


def as_built_file(
    name: str,
    design: str | dict[str, Any],
    state: State,
    disturbances: str | None = None,
    description: str = "",
    remark: str = "",
) -> str:
    """Return the text of the file of an instrument as built.

    `scenes.specs.load.load_instrument` reads it back to exactly this state.

    Parameters
    ----------
    name : str
        Name of the instrument.
    design : str | dict[str, Any]
        Name or path of the design's instrument, as the file should have it, or the content of its file.
    state : State
        Body path -> motion relative to the design.
    disturbances : str | None
        Name of a file of disturbances, or its path relative to the new file's folder; None for those of the design.
    description : str
        Description for readers.
    remark : str
        Comment at the top of the file.

    Raises
    ------
    ValueError
        A motion has a scale, a stretch, an index gradient or a grid, which the file cannot express.
    """
    spec = AsBuiltInstrumentSpec.model_construct(
        name=name, description=description, design=name, as_built=as_built_of(state), disturbances=disturbances
    )
    return spec.file_text(remark, design=design)
