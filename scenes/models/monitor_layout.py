"""Layouts of a monitor: the beams of a design, the instrument that has them, and their mass, pupil share and glass.

A design is a search for the best layout; it starts from an existing instrument, "the start". Each beam exists four
times in a pair of cameras, mirrored: at both ends of both cameras' lines. Its pupil offset counts toward the central
prism, and along the line toward the beam's own end.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np

from optics.geometry.solid import solid_mesh
from optics.materials.material import material
from optics.numerics.backend import Backend
from optics.numerics.number_tree import FrozenMap
from scenes.models.instrument_model import Instrument
from scenes.models.obstruction import blocked_rays, convex_hull, imaging_segments
from scenes.specs import instrument as instruments
from scenes.specs import load
from scenes.specs.camera import CameraSpec, MonitorDesignSpec, PrismChoiceSpec
from scenes.specs.detector import DetectorSpec
from scenes.specs.disturbances import NONE, DisturbancesSpec
from scenes.specs.resolved import ExperimentSetup
from scenes.yaml.errors import KeyPath
from scenes.yaml.spec import Paths, Spec

RAYS = 2000
"""Rays of an imaging beam from which pupil shares are computed: accurate to about a thousandth."""
AS_STARTED = "start"
"""Name of the prisms and area CCD of the instrument that a design starts from."""


class MonitorDesignSetup(ExperimentSetup[MonitorDesignSpec]):
    """Monitor design with all the files that it refers to.

    Attributes
    ----------
    instrument : InstrumentSpec
        Instrument that the design starts from.
    cameras : Mapping[str, CameraSpec]
        Cameras by the instrument's names for them.
    detector : DetectorSpec
        Data sheet of the area CCDs.
    disturbances : Mapping[str, DisturbancesSpec]
        Disturbance priors by the names that the design, or the instrument, gives them.
    detectors : Mapping[str, DetectorSpec]
        Data sheets of the area CCDs that the design may choose from, by its names for them.
    """

    instrument: instruments.InstrumentSpec
    cameras: Paths[CameraSpec]
    detector: DetectorSpec
    disturbances: Paths[DisturbancesSpec]
    detectors: Paths[DetectorSpec] = FrozenMap()

    @classmethod
    def parts(cls, test: MonitorDesignSpec) -> dict[str, Any]:
        """Read the start instrument, its cameras and the parts to choose from; return field -> content."""
        start = load.load_instrument(test.instrument, test, ("instrument",))
        if start.as_built:
            problem = f"{start.name} is an instrument as built; a layout starts from a drawing"
            allowed = "the drawing that its file names as its design"
            raise test.error(problem, ("instrument",), value=test.instrument, allowed=allowed)
        owner: Spec = test
        references = test.disturbances
        if references is None:
            owner, references = start, () if start.disturbances in (None, NONE) else (start.disturbances,)
        if not references:
            problem = f"{start.name} names no disturbance prior"
            raise test.error(problem, ("disturbances",), allowed="disturbances files, by name or path")
        priors = {}
        for k, reference in enumerate(references):
            key: KeyPath = ("disturbances", k) if owner is test else ("disturbances",)
            priors[str(reference)] = load.load_disturbances(reference, owner, key)
        sheets = {
            name: load.load_detector(ccd.detector, test, ("area_ccds", name, "detector"))
            for name, ccd in (test.area_ccds or {}).items()
        }
        return {
            "instrument": start,
            "cameras": load.load_cameras(start),
            "detector": load.load_detector(start.autocollimator.area_ccd.detector, start, load.AREA_CCD),
            "disturbances": FrozenMap(priors),
            "detectors": FrozenMap(sheets),
        }

    def checked(self) -> Self:
        """Check that the design can start from this instrument; return the set-up."""
        test, start = self.test, self.instrument
        if len(start.cameras) != 2:
            raise test.error("a layout is designed for a pair", ("instrument",), value=f"{len(start.cameras)} cameras")
        if test.goal.height is not None and start.altitude is None:
            raise test.error(f"{start.name} does not state its altitude", ("goal", "height"), allowed="angle or d_f")
        start_beams(self)
        return self


@dataclass(frozen=True)
class Beam:
    """Monitor beam of a layout: the numbers of the four mirrored channels at both ends of both cameras' lines.

    Attributes
    ----------
    pupil_x, pupil_y : float
        Centre of the beam in the entrance pupil: distance from the pupil's centre toward the central prism (x) and
        toward the channel's end of the line (y), in metres.
    width : float
        Diameter of its return face, in metres.
    field : float
        Angle of its area CCD from the visual axis, in radians.
    prism_180_distance : float
        Distance of its 180-deg prism from the camera's origin, in metres.
    prism_0_distance : float
        Distance of its rhomboid from the return face, in metres.
    shift : float
        Displacement of the beam by its rhomboid, in metres.
    spread_x, spread_y : float
        Position of its facet relative to the central prism's apex, along the base's X and Y, in metres.
    prisms : str
        Name of its pair of prisms in the design's file.
    photons : float or None
        Photons of its spot per frame; None for the monitor's number.
    area_ccd : str
        Name of the area CCD in the design's file, the same for all channels.
    """

    pupil_x: float
    pupil_y: float
    width: float
    field: float
    prism_180_distance: float
    prism_0_distance: float
    shift: float
    spread_x: float
    spread_y: float
    prisms: str = AS_STARTED
    photons: float | None = None
    area_ccd: str = AS_STARTED

    def changed(self, numbers: Mapping[str, float]) -> Beam:
        """Return the beam with some of its continuous numbers replaced, by name."""
        values: Mapping[str, Any] = numbers
        return replace(self, **values)


CONTINUOUS = tuple(item.name for item in fields(Beam) if item.name not in {"prisms", "area_ccd"})
"""Names of the numbers of a beam that vary continuously, unlike its prisms and its area CCD."""
Layout = tuple[Beam, ...]


def start_beams(setup: MonitorDesignSetup) -> Layout:
    """Return the beams of the instrument that a design starts from.

    Raises
    ------
    InputError
        The beams are not mirrored at both ends of both lines.
    """
    start, first = setup.instrument, next(iter(setup.instrument.cameras))
    sign, beams = _toward(start, start.cameras[first]), []
    for channel in start.channels_of(first).values():
        if channel.field > 0.0:
            made, small = channel.prism_180, channel.prism_0
            x, y = channel.pupil_offset
            numbers = (
                sign * x,
                y,
                channel.return_face.aperture,
                channel.field,
                made.distance,
                small.distance,
                small.shift,
            )
            light = setup.test.photons_per_frame or channel.photons_per_frame
            beams.append(Beam(*numbers, *channel.spread, _prisms_of(setup, channel), light, _ccd_of(setup)))
    again = layout_spec(setup, tuple(beams))
    for camera in start.cameras:
        channels, made_again = start.channels_of(camera), again.channels_of(camera)
        layouts = [
            sorted((c.field, c.pupil_offset, c.spread) for c in them.values()) for them in (channels, made_again)
        ]
        if len(channels) != len(made_again) or not np.allclose(_flat(layouts[0]), _flat(layouts[1]), atol=1e-12):
            problem = f"the channels of {camera} do not mirror those of {first}"
            raise setup.test.error(problem, ("instrument",), value=start.name, allowed="the same beams, mirrored")
    return tuple(beams)


def _prisms_of(setup: MonitorDesignSetup, channel: instruments.ChannelParts) -> str:
    """Return the name in the design for the prisms of a channel of the start instrument.

    Raises InputError if the design names no such prisms.
    """
    monitor = setup.instrument.autocollimator
    has = [(prism.material, prism.kind) for prism in (channel.prism_180, channel.prism_0)]
    known = {AS_STARTED: [(prism.material, prism.kind) for prism in (monitor.prism_180, monitor.prism_0)]}
    for name, chosen in (setup.test.prisms or {}).items():
        known[name] = [(prism.material, prism.kind) for prism in (chosen.prism_180, chosen.prism_0)]
    for name, parts in known.items():
        if parts == has:
            return name
    problem = f"the channels of {setup.instrument.name} have prisms that the design does not name"
    allowed = "an entry of prisms with these"
    raise setup.test.error(problem, ("prisms",), value=f"{has[0]}, {has[1]}", allowed=allowed)


def _ccd_of(setup: MonitorDesignSetup) -> str:
    """Return the name in the design for the area CCD of the start instrument."""
    ccd = setup.instrument.autocollimator.area_ccd
    for name, sheet in (setup.test.area_ccds or {}).items():
        if (sheet.detector, sheet.pitch, sheet.rows, sheet.columns) == (ccd.detector, ccd.pitch, ccd.rows, ccd.columns):
            return name
    return AS_STARTED


def _flat(beams: Sequence[tuple[float, tuple[float, float], tuple[float, float]]]) -> np.ndarray:
    """Return fields, pupil offsets and facet positions of channels as one array, with a row per channel."""
    return np.array([[field, *offset, *spread] for field, offset, spread in beams])


def _toward(spec: instruments.InstrumentSpec, site: instruments.MountedCameraSpec) -> float:
    """Return +1 if the central prism lies on the camera's +X side, else -1."""
    return 1.0 if spec.reference_prism.position[0] > site.position[0] else -1.0


def layout_spec(setup: MonitorDesignSetup, beams: Layout) -> instruments.InstrumentSpec:
    """Return the instrument whose monitor has these beams.

    Everything else is that of the start instrument, except name, light, number of frames, area CCDs and the central
    prism's material.

    Parameters
    ----------
    setup : MonitorDesignSetup
        The design.
    beams : tuple[Beam, ...]
        Beams, each of which becomes a channel at both ends of both lines: ``left`` and ``right``, ``left_2`` and
        ``right_2``.
    """
    start, test = setup.instrument, setup.test
    monitor = start.autocollimator
    sites = {}
    for name, site in start.cameras.items():
        channels = {}
        for n, beam in enumerate(beams):
            ends = dict(zip(instruments.SIDES, (1.0, -1.0), strict=True))
            for side, end in ends.items():
                offset = (_toward(start, site) * beam.pupil_x, end * beam.pupil_y)
                channels[channel_name(side, n)] = _channel(setup, beam, end * beam.field, offset)
        sites[name] = site.model_copy(update={"pupil_offset": None, "channels": FrozenMap(channels)})
    reticle = monitor.reticle.model_copy(update={"photons_per_frame": _light(setup)})
    chosen = (test.area_ccds or {}).get(beams[0].area_ccd)
    changes = {} if chosen is None else {name: getattr(chosen, name) for name in type(chosen).model_fields}
    ccd = monitor.area_ccd.model_copy(update=changes)
    monitor = monitor.model_copy(update={"reticle": reticle, "frames": test.frames or monitor.frames, "area_ccd": ccd})
    block = start.reference_prism
    block = block.model_copy(update={"material": test.central_material or block.material})
    update = {
        "central_prism": block,
        "name": test.name,
        "description": test.description,
        "cameras": FrozenMap(sites),
        "monitor": monitor,
    }
    return start.model_copy(update=update)


def _light(setup: MonitorDesignSetup) -> float:
    """Return the number of photons per spot and frame for beams without a number of their own."""
    return setup.test.photons_per_frame or setup.instrument.autocollimator.reticle.photons_per_frame


def channel_name(side: str, number: int) -> str:
    """Return the name of a beam's channel at one of ``SIDES``; beams are counted from 0."""
    return side if number == 0 else f"{side}_{number + 1}"


def _channel(
    setup: MonitorDesignSetup, beam: Beam, field: float, offset: tuple[float, float]
) -> instruments.ChannelSpec:
    """Return the specification of one monitor channel of a beam.

    Parameters
    ----------
    setup : MonitorDesignSetup
        The design.
    beam : Beam
        The beam.
    field : float
        Field angle of the channel's area CCD from the visual axis, in radians; positive at the +Y end of the line.
    offset : tuple[float, float]
        Centre (X, Y) of the beam in the entrance pupil, in metres.
    """
    monitor = setup.instrument.autocollimator
    rim = monitor.prism_180.width - monitor.return_face.aperture, monitor.prism_0.width - monitor.return_face.aperture
    chosen = (setup.test.prisms or {}).get(beam.prisms)
    kinds = [{} if chosen is None else dict(part) for part in _parts(chosen)]
    large = {"distance": beam.prism_180_distance, "width": beam.width + rim[0], **kinds[0]}
    small = {"distance": beam.prism_0_distance, "shift": beam.shift, "width": beam.width + rim[1], **kinds[1]}
    return instruments.ChannelSpec.model_construct(
        field=field,
        pupil_offset=offset,
        return_face=instruments.ReturnFaceSpec.model_construct(aperture=beam.width),
        spread=(beam.spread_x, beam.spread_y),
        photons_per_frame=None if beam.photons == _light(setup) else beam.photons,
        prism_180=monitor.prism_180.model_copy(update=large),
        prism_0=monitor.prism_0.model_copy(update=small),
    )


def _parts(chosen: PrismChoiceSpec | None) -> Iterator[Mapping[str, object]]:
    """Yield material and kind of both prisms, as changed keys of their specifications."""
    for prism in (None, None) if chosen is None else (chosen.prism_180, chosen.prism_0):
        yield {} if prism is None else {"material": prism.material, "kind": prism.kind}


def kinds_of(setup: MonitorDesignSetup, beam: Beam) -> tuple[str | None, str | None]:
    """Return the kinds of the two reflectors of a beam, such as ``periscope``; None for a glass prism."""
    monitor, chosen = setup.instrument.autocollimator, (setup.test.prisms or {}).get(beam.prisms)
    kinds = (monitor.prism_180.kind, monitor.prism_0.kind)
    return kinds if chosen is None else (chosen.prism_180.kind, chosen.prism_0.kind)


def drawn_beam(setup: MonitorDesignSetup, rng: np.random.Generator) -> Beam:
    """Return a random beam whose varying numbers are uniformly distributed over their ranges."""
    start = start_beams(setup)[0]
    numbers = {name: float(rng.uniform(*ends)) for name, ends in ranges(setup).items()}
    return replace(start.changed(numbers), prisms=_chosen(setup, rng), area_ccd=_chosen_ccd(setup, start, rng))


def changed_beam(setup: MonitorDesignSetup, beam: Beam, step: float, rng: np.random.Generator) -> Beam:
    """Return a beam with random changes of some of its numbers.

    Parameters
    ----------
    setup : MonitorDesignSetup
        The design.
    beam : Beam
        Beam to change.
    step : float
        Standard deviation of the change of each number, relative to its range; numbers are reflected at the ends of it.
    rng : np.random.Generator
        Generator of the random numbers. About half of the numbers stay, so that changes of single ones are tried, too.
    """
    numbers = {}
    for name, (low, high) in ranges(setup).items():
        change = step * float(rng.standard_normal()) * float(rng.integers(2))
        value = number_of(setup, beam, name) + (high - low) * change
        value = 2.0 * low - value if value < low else 2.0 * high - value if value > high else value
        numbers[name] = float(np.clip(value, low, high))
    prisms = _chosen(setup, rng) if rng.random() < step else beam.prisms
    return replace(beam.changed(numbers), prisms=prisms)


def number_of(setup: MonitorDesignSetup, beam: Beam, name: str) -> float:
    """Return one of a beam's continuous numbers, SI, by its name in ``CONTINUOUS``."""
    value = getattr(beam, name)
    return _light(setup) if value is None else float(value)


def ranges(setup: MonitorDesignSetup) -> dict[str, tuple[float, float]]:
    """Return the range of each continuous number of a beam that varies, SI."""
    return {name: ends for name in CONTINUOUS if (ends := getattr(setup.test.vary, name)) is not None}


def _chosen(setup: MonitorDesignSetup, rng: np.random.Generator) -> str:
    """Return the name of prisms chosen at random among those of the design."""
    names = tuple(setup.test.prisms or (AS_STARTED,))
    return names[int(rng.integers(len(names)))]


def _chosen_ccd(setup: MonitorDesignSetup, start: Beam, rng: np.random.Generator) -> str:
    """Return the name of an area CCD chosen at random among those of the design."""
    names = tuple(setup.test.area_ccds or ())
    return names[int(rng.integers(len(names)))] if names else start.area_ccd


def prism_mass(instrument: Instrument) -> float:
    """Return the mass of all prisms, or of the reflectors in their place, in kg, without the central prism."""
    placed, total = instrument.assembly.place(), 0.0
    for solid in instrument.solids:
        if solid.path != instruments.CENTRAL_PRISM:
            total += float(solid_mesh(solid, placed).mesh.volume) * material(solid.material).density
    return total


@dataclass(frozen=True, eq=False)
class ImagingBeams:
    """Imaging beams of an instrument's cameras, for the fraction that prisms block.

    Attributes
    ----------
    segments : Mapping[str, Sequence[ndarray]]
        Camera -> segments of the rays to both ends and the middle of its line: three arrays (RAYS, K, 2, 3) of the
        start and end points of K segments, in the base frame, in metres.
    """

    segments: Mapping[str, Sequence[np.ndarray]]

    @classmethod
    def of(cls, instrument: Instrument, backend: Backend) -> ImagingBeams:
        """Return the imaging beams of an instrument; all layouts on the same cameras share them."""
        return cls({name: imaging_segments(instrument, backend, name, RAYS) for name in instrument.cameras})

    def taken(self, instrument: Instrument) -> np.ndarray:
        """Return a mask of the imaging rays that prisms of an instrument block.

        Returns
        -------
        (cameras, 3, RAYS) ndarray of bool
            For each camera: rays to one end, the middle or the other end of its line.
        """
        placed, blocked = instrument.assembly.place(), np.zeros((len(self.segments), 3, RAYS), dtype=bool)
        for solid in instrument.solids:
            corners = placed.pose(solid.path).apply(solid_mesh(solid, placed).vertices)
            planes = convex_hull(corners).equations
            for c, beams in enumerate(self.segments.values()):
                for k, rays in enumerate(beams):
                    blocked[c, k] |= blocked_rays(rays, planes)
        return blocked


def pupil_share(taken: np.ndarray) -> float:
    """Return the largest fraction of a camera's pupil that prisms block along its line.

    Parameters
    ----------
    taken : (cameras, 3, RAYS) ndarray of bool
        Blocked rays, from ``ImagingBeams.taken``.
    """
    return float(taken.mean(axis=-1).max())
