"""An instrument as its file gives it: cameras on a common base with their monitor channels and prisms.

One instrument as it was built: another file's instrument, and how its bodies stand and are shaped against that.
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
    one_given,
)
from scenes.yaml.unit_fields import PositiveLength, Quantity, Vector, Vector2, Vector3, Wavelength
from scenes.yaml.units import ANGLE, DISTANCE, LENGTH, TEMPERATURE, TIME

BASE = "base"
SIDES = ("left", "right")
PRISM_180, PRISM_0 = "prism_180", "prism_0"
PRISMS = (PRISM_180, PRISM_0)
"""Prisms of a channel in the order of the light: keys of ``monitor`` in an instrument's file, and the last part of the
paths of their bodies."""
CENTRAL_KEY = "central_prism"
"""Key of the central prism in an instrument's file."""
CENTRAL_PRISM = f"{BASE}/{CENTRAL_KEY}"
"""Body path of the central prism."""


def prism_of(path: str) -> str | None:
    """Which of ``PRISMS`` a body is or belongs to, by its path; None for none."""
    return next((part for part in path.split("/") if part in PRISMS), None)


def channel_of(path: str) -> tuple[str, str] | None:
    """Camera and name of the channel to whose prisms or boards a body belongs, by its path; None for no channel."""
    parts = path.split("/")
    return (parts[1], parts[3]) if len(parts) > 4 and parts[2] in ("monitor", "focal_plane") else None


@dataclass(frozen=True)
class Channel:
    """One monitor channel of one camera.

    Attributes
    ----------
    camera, name : str
        e.g. ``forward``, ``left``: the camera's and its own; those of a plain pair are ``left`` (the +Y end of the
        line) and ``right``.
    pinhole, ccd : tuple[float, float]
        Positions in the focal plane's X, Y, metres.
    pupil_offset : tuple[float, float]
        Of its beam's middle in the entrance pupil, X and Y, metres.
    aperture : float
        Diameter of its return face, metres.
    photons : float
        That its spot gets in a frame.
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
        """``<camera>/<name>``, the prefix of the channel's elements and sequences."""
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
        """Body path of one of ``PRISMS``."""
        return f"{BASE}/{self.camera}/monitor/{self.name}/{prism}"

    def prism_elements(self, prism: str) -> str:
        """What the names of the elements of one of ``PRISMS`` begin with."""
        return f"{self.key}/{prism}"

    @property
    def face_body(self) -> str:
        """Body path of the return face."""
        return f"{CENTRAL_PRISM}/{self.camera}_{self.name}"


Tilt = Annotated[tuple[float, float], Vector(Quantity(ANGLE, largest="1 deg"), 2)]


GlassName = Annotated[str, Field(strict=True), name_in("glass", GLASSES, glass)]
"""A glass of the catalogue in optics/materials/glass.py."""


MadeOf = Annotated[str, Field(strict=True), Catalogued(lambda name: _spelt(name), MATERIALS)]
"""A glass, or what a frame of mirrors is made of; see ``_check_made``."""


def _spelt(name: str) -> str:
    """A material's name in the catalogue's own spelling; another name as it is."""
    try:
        return material(name).name
    except KeyError:
        return name


FaceErrors = Annotated[dict[Name, Tilt], NothingIsEmpty, AfterValidator(FrozenMap)]


def reflector_kinds(returns: bool) -> OneOf:
    """Names of the reflectors that send the beam back, or of those that send it on."""
    return OneOf(lambda: (name for name, kind in REFLECTORS.items() if kind.returns == returns))


def _check_faces(errors: Mapping[str, tuple[float, float]], reflector: Reflector) -> None:
    """Refuse angle errors of faces that a reflector does not have."""
    for name in errors:
        if name not in reflector.faces:
            raise unknown("no such face", name, reflector.faces, ("angle_errors", name))


def check_made(made_of: str, reflector: Reflector) -> None:
    """Refuse what a reflector cannot be made of."""
    names = GLASSES if reflector.transparent else MATERIALS
    if made_of not in names:
        what = "no such glass" if reflector.transparent else "no such material"
        if made_of in MATERIALS:
            what += ": light goes through this kind; of other materials are the kinds without glass"
        raise unknown(what, made_of, names, ("material",))


class Prism180Spec(Spec):
    """The lateral-transfer prism: three mutually perpendicular faces send the beam back parallel to itself.

    Attributes
    ----------
    material : MadeOf
        Its glass; of a kind without glass the material of its frame and mirrors.
    distance : PositiveLength
        From the camera's origin to its window, along the line of sight, metres.
    width : PositiveLength
        Of the clear apertures across the beam, metres; somewhat more than the return face's.
    tilt : Tilt
        Turn about its own x and y from where its faces stand square to the beam, about its null point, radians. It
        leaves the beam's direction alone and sends the reflections off its faces past the area CCD.
    angle_errors : FaceErrors
        Face -> tilt about the face's own x and y, radians, as made. Faces: window, mirror, roof_a, roof_b; of the
        hollow kind mirror, roof_a, roof_b.
    kind : str | None
        What stands in its place, by its name among ``REFLECTORS``: the prism (lateral_transfer) when nothing is said,
        or three mirrors on a frame (hollow_transfer).
    """

    material: MadeOf
    distance: PositiveLength
    width: PositiveLength
    tilt: Tilt = (0.0, 0.0)
    angle_errors: FaceErrors = Field(default_factory=FrozenMap)
    kind: Annotated[str, reflector_kinds(returns=True)] | None = None

    @property
    def reflector(self) -> Reflector:
        """What stands there."""
        return REFLECTORS[self.kind or "lateral_transfer"]

    @model_validator(mode="after")
    def _can_be_made(self) -> Prism180Spec:
        check_made(self.material, self.reflector)
        _check_faces(self.angle_errors, self.reflector)
        return self


class Prism0Spec(Spec):
    """The rhomboid: two parallel reflecting faces displace the beam and keep its direction.

    Attributes
    ----------
    material : MadeOf
        Its glass; of a kind without glass the material of its frame and mirrors.
    distance : PositiveLength
        From the return face to its centre, along the beam, metres.
    shift : PositiveLength
        By how much it displaces the beam, toward the central prism, metres.
    width : PositiveLength
        Of the clear apertures across the beam, metres.
    tilt : Tilt
        Turn about its own x and y from where its faces stand square to the beam, about its middle, radians.
    angle_errors : FaceErrors
        Face -> tilt, as for the 180-deg prism. Faces: entry, mirror_a, mirror_b, exit; of the periscope mirror_a,
        mirror_b.
    kind : str | None
        What stands in its place, by its name among ``REFLECTORS``: the prism (rhomboid) when nothing is said, or two
        mirrors on a frame (periscope).
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
        """What stands there."""
        return REFLECTORS[self.kind or "rhomboid"]

    @model_validator(mode="after")
    def _can_be_made(self) -> Prism0Spec:
        check_made(self.material, self.reflector)
        _check_faces(self.angle_errors, self.reflector)
        return self


Spread = Annotated[tuple[float, float], Vector(Quantity(LENGTH, above_zero=True, largest="10 m"), 2)]


class CentralPrismSpec(Spec):
    """The central prism, the common reference of all cameras: a block with one mirror facet per channel, which meet in
    its apex.

    Attributes
    ----------
    position : Vector3
        Of the apex in the base frame, metres.
    material : GlassName
        Of the block.
    spread : Spread
        How far from the apex the beams meet their facets, along the base's X and Y, metres.
    height : PositiveLength
        Of the block below the apex, metres.
    """

    position: Vector3
    material: GlassName
    spread: Spread
    height: PositiveLength


MaterialName = Annotated[str, Field(strict=True), name_in("material", MATERIALS, material)]
Exposure = Annotated[float, Quantity(TIME, above_zero=True, largest="100 s")]
LookAngle = Annotated[float, Quantity(ANGLE, largest="90 deg")]
FieldPlace = Annotated[float, Quantity(ANGLE, largest="45 deg")]
Photons = Annotated[Number, Field(gt=0.0, le=1e12)]
MOST_FRAMES = 10_000
Frames = Annotated[Whole, Field(ge=1, le=MOST_FRAMES)]


class ReticleSpec(Spec):
    """The light source of a monitor channel: a lit pinhole in the focal plane.

    Attributes
    ----------
    pinhole : PositiveLength
        Diameter, metres.
    photons_per_frame : Photons
        Expected number of photons of one spot that reach the area CCD's plane during one exposure.
    """

    pinhole: PositiveLength
    photons_per_frame: Photons


class AreaCcdSpec(Spec):
    """The area CCD of a monitor channel.

    Attributes
    ----------
    detector : Ref
        Its data sheet, by name or path.
    rows : AreaSide
        Number of pixel rows.
    columns : AreaSide
        Number of pixel columns.
    pitch : PixelPitch
        Of the pixels, metres.
    offset : Vector2
        (X, Y) from the pinhole to the centre of the pixel grid, in the focal plane, metres.
    exposure : Exposure
        Of a frame, seconds.
    """

    detector: Ref
    rows: AreaSide
    columns: AreaSide
    pitch: PixelPitch
    offset: Vector2
    exposure: Exposure


class AreaCcdChoiceSpec(Spec):
    """An area CCD that the monitor may have: pixels of another size are another detector, with a data sheet of its own.

    Attributes
    ----------
    detector : Ref
        Its data sheet, by name or path.
    pitch : PixelPitch
        Of its pixels, metres.
    rows : AreaSide
        Number of pixel rows.
    columns : AreaSide
        Number of pixel columns.
    """

    detector: Ref
    pitch: PixelPitch
    rows: AreaSide
    columns: AreaSide


class ReturnFaceSpec(Spec):
    """The mirror coating of a central prism's facet, which returns the monitor's beam and limits it: diameter,
    metres.
    """

    aperture: PositiveLength


class ChannelSpec(Spec):
    """One channel of a camera's monitor, where a camera has others than the plain pair; what is left out is the
    monitor's.

    Attributes
    ----------
    field : FieldPlace
        Angle from the visual axis at which its area CCD stands, positive at the +Y end of the line, radians.
    pupil_offset : Vector2
        Centre (X, Y) of its beam in the entrance pupil, metres.
    return_face : ReturnFaceSpec | None
        The mirror that returns its beam, and limits it.
    spread : Spread | None
        How far from the central prism's apex its beam meets its facet, along the base's X and Y, metres.
    photons_per_frame : Photons | None
        Of its spot.
    prism_180 : Prism180Spec | None
        Its lateral-transfer prism.
    prism_0 : Prism0Spec | None
        Its rhomboid.
    """

    field: FieldPlace
    pupil_offset: Vector2
    return_face: ReturnFaceSpec | None = None
    spread: Spread | None = None
    photons_per_frame: Photons | None = None
    prism_180: Prism180Spec | None = None
    prism_0: Prism0Spec | None = None


@dataclass(frozen=True)
class ChannelParts:
    """What a channel has, its own or the monitor's; see `ChannelSpec`."""

    field: float
    pupil_offset: tuple[float, float]
    return_face: ReturnFaceSpec
    spread: tuple[float, float]
    photons_per_frame: float
    prism_180: Prism180Spec
    prism_0: Prism0Spec

    @property
    def prisms(self) -> dict[str, Prism180Spec | Prism0Spec]:
        """Both by their keys, in the order of the light."""
        return {PRISM_180: self.prism_180, PRISM_0: self.prism_0}


class MountedCameraSpec(Spec):
    """A camera in its place on the base, with the channels of its monitor: a plain pair at both ends of the line,
    through the same part of the pupil, or any number of channels; none in an instrument without a monitor.

    Attributes
    ----------
    camera : Ref
        Which camera, by name or path.
    look : LookAngle
        Angle of its visual axis from the base's +Z, about the base's Y, positive forward (toward +X), radians.
    position : Vector3
        Of the camera's origin in the base frame, metres.
    pupil_offset : Vector2 | None
        Centre (X, Y) of a plain pair's sub-aperture in the entrance pupil, metres.
    channels : Named[ChannelSpec] | None
        By name, in place of a plain pair. The printed formulas are about a pair at opposite fields called left and
        right; a camera without such a pair is measured by the estimators that take all spots.
    """

    camera: Ref
    look: LookAngle
    position: Vector3
    pupil_offset: Vector2 | None = None
    channels: Annotated[Named[ChannelSpec], Field(min_length=1)] | None = None

    @property
    def mirrored(self) -> MountedCameraSpec:
        """The camera with every beam through the opposite part of the pupil."""
        if self.pupil_offset is not None:
            x, y = self.pupil_offset
            return self.model_copy(update={"pupil_offset": (-x, -y)})
        if self.channels is None:
            return self
        turned = {
            name: one.model_copy(update={"pupil_offset": (-one.pupil_offset[0], -one.pupil_offset[1])})
            for name, one in self.channels.items()
        }
        return self.model_copy(update={"channels": FrozenMap(turned)})


class MaterialsSpec(Spec):
    """What the parts are made of, by name in the catalogue of optics/materials/material.py; prisms name their own
    glass.

    Attributes
    ----------
    base : MaterialName
        The common structure.
    camera : MaterialName
        Each camera's structure, with the monitor's brackets.
    mirror : MaterialName
        All mirrors.
    focal_plane : MaterialName
        What carries the line CCD.
    board : MaterialName
        What carries reticle and area CCD at each end of it.
    """

    base: MaterialName = "CFRP"
    camera: MaterialName = "CFRP"
    mirror: MaterialName = "Zerodur"
    focal_plane: MaterialName = "SiC"
    board: MaterialName = "AlN"


class MonitorSpec(Spec):
    """The autocollimation monitor, alike in all cameras and in both channels of each.

    Attributes
    ----------
    wavelength : Wavelength
        Of the source, metres.
    field : float
        Angle from the visual axis at which the area CCDs stand, left at +Y and right at -Y, radians.
    reticle : ReticleSpec
        Light source.
    area_ccd : AreaCcdSpec
        detector.
    prism_180 : Prism180Spec
        The lateral-transfer prism of every channel.
    prism_0 : Prism0Spec
        The rhomboid of every channel.
    return_face : ReturnFaceSpec
        What sends the light back.
    frames : Frames
        Number of frames in one measurement.
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
    """Cameras on a common base, each with its monitor, or all without one.

    Attributes
    ----------
    name
        As the file is called.
    description
        For people.
    cameras : Named[MountedCameraSpec]
        By name; the first is the reference for the change of the intersection angle.
    central_prism : CentralPrismSpec | None
        Common reference of the monitor.
    monitor : MonitorSpec | None
        Of every camera; left out, with the central prism, where there is none.
    temperature : float
        At which everything has its nominal shape, kelvin.
    materials : MaterialsSpec
        What the parts are made of.
    baffles : Named[BaffleSpec]
        By name; none by default.
    altitude : float | None
        Of its orbit, metres; for what changes of a pair's cameras do to points on the ground.
    disturbances : Ref | None
        What is expected to move, unless a job says otherwise: a file of scenes/library/disturbances or of one's own.
    as_built : AsBuilt | None
        Node -> how it stands and is shaped against all else that the file says, as in a job's `perturb`. What a job
        perturbs comes on top of it, and changes count from it.
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
            text = "a monitor needs both its description and the central prism that its beams return from"
            raise Problem(text, f"no {missing}", f"{missing}, or neither of the two", within=())
        for name, site in self.cameras.items():
            if self.monitor is not None:
                allowed = "one of pupil_offset and channels"
                asked = "which channels does its monitor have?"
                one_given(site, ("pupil_offset", "channels"), asked, allowed, ("cameras", name))
                continue
            given = [key for key in ("pupil_offset", "channels") if getattr(site, key) is not None]
            if given:
                text = "a camera of an instrument without a monitor has no channels"
                raise Problem(text, given[0], "neither, or a monitor and a central_prism", within=("cameras", name))
        return self

    @classmethod
    def of_camera(cls, name: str, camera: str) -> InstrumentSpec:
        """A camera by itself as an instrument: on the base, without a look angle and without a monitor.

        Parameters
        ----------
        name : str
            Of the camera, and of the instrument.
        camera : str
            Which camera, by name or path.
        """
        site = MountedCameraSpec.model_construct(camera=camera, look=0.0, position=(0.0, 0.0, 0.0))
        return cls.model_construct(name=name, cameras=FrozenMap({name: site}))

    @property
    def autocollimator(self) -> MonitorSpec:
        """The monitor of an instrument that has one.

        Raises
        ------
        InputError
            It has none.
        """
        if self.monitor is None:
            raise self._without_monitor()
        return self.monitor

    @property
    def reference_prism(self) -> CentralPrismSpec:
        """The central prism of an instrument that has one. Raises InputError: it has none."""
        if self.central_prism is None:
            raise self._without_monitor()
        return self.central_prism

    def _without_monitor(self) -> InputError:
        text = f"{self.name} has no monitor, so that no spot tells of its changes"
        return self.error(text, ("monitor",), allowed="an instrument with a monitor and a central_prism")

    def key_of(self, camera: str, channel: str, key: KeyPath) -> KeyPath:
        """Where the file says something of a channel: at the channel itself if it does there, else where it says it of
        all.

        Parameters
        ----------
        camera : str
            Its name; one that is not in the file changes nothing.
        channel : str
            Its name, likewise.
        key : KeyPath
            Where it says it of all, e.g. ``("monitor", "prism_180", "width")``.
        """
        site = self.cameras.get(camera)
        if site is None or site.channels is None or channel not in site.channels:
            return key
        whole = {
            ("monitor", "field"): "field",
            ("cameras", camera, "pupil_offset"): "pupil_offset",
            ("monitor", "return_face"): "return_face",
            ("central_prism", "spread"): "spread",
            ("monitor", "reticle", "photons_per_frame"): "photons_per_frame",
            ("monitor", PRISM_180): PRISM_180,
            ("monitor", PRISM_0): PRISM_0,
        }
        for start, name in whole.items():
            if key[: len(start)] == start and getattr(site.channels[channel], name) is not None:
                return ("cameras", camera, "channels", channel, name, *key[len(start) :])
        return key

    def channels_of(self, camera: str) -> dict[str, ChannelParts]:
        """All channels of a camera's monitor, by name; none where there is no monitor.

        Parameters
        ----------
        camera : str
            Its name.
        """
        site = self.cameras[camera]
        if self.monitor is None or self.central_prism is None:
            return {}
        monitor, prism = self.monitor, self.central_prism
        given = site.channels
        if given is None:
            assert site.pupil_offset is not None
            pair = zip(SIDES, (monitor.field, -monitor.field), strict=True)
            given = {name: ChannelSpec.model_construct(field=f, pupil_offset=site.pupil_offset) for name, f in pair}
        return {
            name: ChannelParts(
                one.field,
                one.pupil_offset,
                one.return_face or monitor.return_face,
                one.spread or prism.spread,
                one.photons_per_frame or monitor.reticle.photons_per_frame,
                one.prism_180 or monitor.prism_180,
                one.prism_0 or monitor.prism_0,
            )
            for name, one in given.items()
        }


DESIGN = "design"
"""Key by which the file of an instrument as built is told."""


class AsBuiltInstrumentSpec(TitledSpec):
    """An instrument as it was built: the instrument of a design, and how its bodies stand and are shaped against that.

    Attributes
    ----------
    name
        As the file is called.
    description
        For people.
    design : Ref
        The instrument of the drawing: name of one in scenes/library/instruments, or path of an own file. A camera, as
        `{camera: NAME or FILE}` or named like an instrument, is one without a monitor.
    as_built : AsBuilt
        Node -> how it stands and is shaped against the drawing, as in a job's `perturb`, by the node's path or the last
        parts of it; or a list of texts such as `M2 shift z 20 um`. What a job perturbs comes on top of it, and changes
        count from it.
    disturbances : Ref | None
        What is expected to move, or how well it is known how the bodies stand: a file of scenes/library/disturbances or
        of one's own; the design's by default.
    """

    design: Ref
    as_built: AsBuilt = Field(default_factory=FrozenMap)
    disturbances: Ref | None = None

    def made_of(self, design: InstrumentSpec, disturbances: str | None = None) -> InstrumentSpec:
        """The instrument that this one is.

        Parameters
        ----------
        design : InstrumentSpec
            What `design` names.
        disturbances : str | None
            Name or absolute path of the file of disturbances; None for the design's.
        """
        update: dict[str, Any] = {"name": self.name, "as_built": self.as_built}
        update |= {} if not self.description else {"description": self.description}
        update |= {} if disturbances is None else {"disturbances": disturbances}
        return design.model_copy(update=update)


def as_built_of(state: State) -> FrozenMap[str, PlainPerturbationSpec]:
    """A state of an instrument as `as_built` has it.

    Parameters
    ----------
    state : State
        Body path -> motion, for example what `optics.geometry.tree.compose` makes of the state that was found and of
        the one that the file has already. Bodies at rest are left out.

    Raises
    ------
    ValueError
        a motion that no file can say: with a scale, a stretch, a gradient of the index or a grid.
    """
    return FrozenMap({path: _built(path, motion) for path, motion in state.items() if motion != Motion()})


def _built(path: str, motion: Motion) -> PlainPerturbationSpec:
    if motion.scale or motion.stretch or any(motion.index_gradient) or motion.grid is not None:
        raise ValueError(f"{path}: only rigid motions, Zernike terms, radius, conic constant and index are as built")
    # of checked parts: to validate them would ask for quantities as text
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
    """Text of the file of an instrument as it was built; `scenes.specs.load.load_instrument` reads it back to exactly
    this state.

    Parameters
    ----------
    name : str
        Of the instrument.
    design : str | dict[str, Any]
        Name or path of the instrument of the drawing, as the file is to say it, or what its file says.
    state : State
        Body path -> motion against the drawing.
    disturbances : str | None
        Name of a file of disturbances, or its path from where the file is going to stand; None for those of the design.
    description : str
        For people.
    remark : str
        At the top of the file, lines of comment.

    Raises
    ------
    ValueError
        As ``as_built_of``.
    """
    spec = AsBuiltInstrumentSpec.model_construct(
        name=name, description=description, design=name, as_built=as_built_of(state), disturbances=disturbances
    )
    return spec.file_text(remark, design=design)
