"""Layouts of a monitor: the beams of a design, the instrument's file that has them, and what they take of mass, pupil
and glass.

A beam stands four times in a pair: at both ends of both cameras' lines, mirrored. Its pupil offset counts toward the
central prism, and along the line toward the beam's own end.
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
from scenes.models.obstruction import convex_hull, imaging_segments, rays_taken
from scenes.specs import instrument as instruments
from scenes.specs import load
from scenes.specs.camera import CameraSpec, MonitorDesignSpec, PrismChoiceSpec
from scenes.specs.detector import DetectorSpec
from scenes.specs.disturbances import NONE, DisturbancesSpec
from scenes.specs.resolved import ExperimentSetup
from scenes.yaml.errors import KeyPath
from scenes.yaml.spec import Paths, Spec

RAYS = 2000
"""Rays of an imaging beam by which shares of the pupil are told: to about a thousandth."""
AS_STARTED = "start"
"""Name of the prisms of the instrument that a design starts from."""


class MonitorDesignSetup(ExperimentSetup[MonitorDesignSpec]):
    """A design with all it refers to.

    Attributes
    ----------
    instrument : instruments.InstrumentSpec
        To start from.
    cameras : Paths[CameraSpec]
        By the name that the instrument gives them.
    detector : DetectorSpec
        Data sheet of the area CCDs.
    disturbances : Paths[DisturbancesSpec]
        By the name that the design, or the instrument, gives them.
    detectors : Paths[DetectorSpec]
        Data sheets of the area CCDs that the design may choose from, by its names for them.
    """

    instrument: instruments.InstrumentSpec
    cameras: Paths[CameraSpec]
    detector: DetectorSpec
    disturbances: Paths[DisturbancesSpec]
    detectors: Paths[DetectorSpec] = FrozenMap()

    @classmethod
    def parts(cls, test: MonitorDesignSpec) -> dict[str, Any]:
        """Return the instrument with all that belongs to it, and what the design may choose from."""
        start = load.load_instrument(test.instrument, test, ("instrument",))
        if start.as_built:
            problem = f"{start.name} is an instrument as built, and a layout is drawn"
            allowed = "the drawing that its file names as its design"
            raise test.error(problem, ("instrument",), found=test.instrument, allowed=allowed)
        owner: Spec = test
        references = test.disturbances
        if references is None:
            owner, references = start, () if start.disturbances in (None, NONE) else (start.disturbances,)
        if not references:
            problem = f"there is no prior on disturbances in {start.name}"
            raise test.error(problem, ("disturbances",), allowed="disturbances files, by name or path")
        stated = {}
        for k, reference in enumerate(references):
            key: KeyPath = ("disturbances", k) if owner is test else ("disturbances",)
            stated[str(reference)] = load.load_disturbances(reference, owner, key)
        sheets = {
            name: load.load_detector(one.detector, test, ("area_ccds", name, "detector"))
            for name, one in (test.area_ccds or {}).items()
        }
        return {
            "instrument": start,
            "cameras": load.load_cameras(start),
            "detector": load.load_detector(start.autocollimator.area_ccd.detector, start, load.AREA_CCD),
            "disturbances": FrozenMap(stated),
            "detectors": FrozenMap(sheets),
        }

    def checked(self) -> Self:
        """Check that the instrument is one that can be designed so."""
        test, start = self.test, self.instrument
        if len(start.cameras) != 2:
            raise test.error("a layout is designed for a pair", ("instrument",), found=f"{len(start.cameras)} cameras")
        if test.goal.height is not None and start.altitude is None:
            raise test.error(f"{start.name} does not state its altitude", ("goal", "height"), allowed="angle or d_f")
        start_beams(self)
        return self


@dataclass(frozen=True)
class Beam:
    """One beam of a layout, at both ends of both cameras' lines.

    Attributes
    ----------
    pupil_x, pupil_y : float
        Middle in the entrance pupil, toward the central prism and toward its own end of the line, m.
    width : float
        Diameter of its return face, m.
    field : float
        Angle of its area CCD from the visual axis, rad.
    prism_180_distance : float
        From the camera's origin, m.
    prism_0_distance : float
        From its return face, m.
    shift : float
        Of its rhomboid, m.
    spread_x, spread_y : float
        Of its facet from the apex, m.
    prisms : str
        By their name in the design.
    photons : float | None
        Of its spot, per frame; None for the monitor's.
    area_ccd : str
        Of all channels, by its name in the design.
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
        """Return the beam with other continuous numbers, by their names."""
        values: Mapping[str, Any] = numbers
        return replace(self, **values)


CONTINUOUS = tuple(item.name for item in fields(Beam) if item.name not in {"prisms", "area_ccd"})
"""Names of what varies continuously."""
Layout = tuple[Beam, ...]


def start_beams(setup: MonitorDesignSetup) -> Layout:
    """The beams of the instrument that a design starts from.

    Raises
    ------
    InputError
        They do not stand mirrored at both ends of both lines.
    """
    start, first = setup.instrument, next(iter(setup.instrument.cameras))
    sign, beams = _toward(start, start.cameras[first]), []
    for one in start.channels_of(first).values():
        if one.field > 0.0:
            made, small = one.prism_180, one.prism_0
            x, y = one.pupil_offset
            numbers = (sign * x, y, one.return_face.aperture, one.field, made.distance, small.distance, small.shift)
            light = setup.test.photons_per_frame or one.photons_per_frame
            beams.append(Beam(*numbers, *one.spread, _prisms_of(setup, one), light, _ccd_of(setup)))
    again = layout_spec(setup, tuple(beams))
    for camera in start.cameras:
        own, made_again = start.channels_of(camera), again.channels_of(camera)
        places = [sorted((c.field, c.pupil_offset, c.spread) for c in them.values()) for them in (own, made_again)]
        if len(own) != len(made_again) or not np.allclose(_flat(places[0]), _flat(places[1]), atol=1e-12):
            problem = f"the channels of {camera} are not those of {first}, mirrored"
            raise setup.test.error(problem, ("instrument",), found=start.name, allowed="the same beams, mirrored")
    return tuple(beams)


def _prisms_of(setup: MonitorDesignSetup, one: instruments.ChannelParts) -> str:
    """Name of the prisms that a channel of the start has."""
    monitor = setup.instrument.autocollimator
    has = [(prism.material, prism.kind) for prism in (one.prism_180, one.prism_0)]
    known = {AS_STARTED: [(prism.material, prism.kind) for prism in (monitor.prism_180, monitor.prism_0)]}
    for name, chosen in (setup.test.prisms or {}).items():
        known[name] = [(prism.material, prism.kind) for prism in (chosen.prism_180, chosen.prism_0)]
    for name, parts in known.items():
        if parts == has:
            return name
    problem = f"the channels of {setup.instrument.name} have prisms that the design does not name"
    allowed = "these, under a name of one's own"
    raise setup.test.error(problem, ("prisms",), found=f"{has[0]}, {has[1]}", allowed=allowed)


def _ccd_of(setup: MonitorDesignSetup) -> str:
    """Name of the area CCD that the start has."""
    own = setup.instrument.autocollimator.area_ccd
    for name, one in (setup.test.area_ccds or {}).items():
        if (one.detector, one.pitch, one.rows, one.columns) == (own.detector, own.pitch, own.rows, own.columns):
            return name
    return AS_STARTED


def _flat(places: Sequence[tuple[float, tuple[float, float], tuple[float, float]]]) -> np.ndarray:
    return np.array([[field, *offset, *spread] for field, offset, spread in places])


def _toward(spec: instruments.InstrumentSpec, site: instruments.MountedCameraSpec) -> float:
    """+1 where the central prism lies on the camera's +X side, else -1."""
    return 1.0 if spec.reference_prism.position[0] > site.position[0] else -1.0


def layout_spec(setup: MonitorDesignSetup, beams: Layout) -> instruments.InstrumentSpec:
    """The instrument that has these beams; all else as in the start, but for its name, light, frames, area CCDs and the
    central prism's material.

    Parameters
    ----------
    setup : MonitorDesignSetup
        The design.
    beams : Layout
        Each becomes a channel at both ends of both lines: ``left`` and ``right``, ``left_2`` and ``right_2``.
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
    own = {} if chosen is None else {name: getattr(chosen, name) for name in type(chosen).model_fields}
    ccd = monitor.area_ccd.model_copy(update=own)
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
    """Photons of a spot and frame where a beam has none of its own."""
    return setup.test.photons_per_frame or setup.instrument.autocollimator.reticle.photons_per_frame


def channel_name(side: str, number: int) -> str:
    """Name of a beam's channel at one of ``SIDES``; beams are counted from 0."""
    return side if number == 0 else f"{side}_{number + 1}"


def _channel(
    setup: MonitorDesignSetup, beam: Beam, field: float, offset: tuple[float, float]
) -> instruments.ChannelSpec:
    monitor = setup.instrument.autocollimator
    rim = monitor.prism_180.width - monitor.return_face.aperture, monitor.prism_0.width - monitor.return_face.aperture
    chosen = (setup.test.prisms or {}).get(beam.prisms)
    kinds = [{} if chosen is None else dict(one) for one in _parts(chosen)]
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
    """Material and kind of both prisms, as updates."""
    for one in (None, None) if chosen is None else (chosen.prism_180, chosen.prism_0):
        yield {} if one is None else {"material": one.material, "kind": one.kind}


def kinds_of(setup: MonitorDesignSetup, beam: Beam) -> tuple[str | None, str | None]:
    """Kinds of a beam's two reflectors; None for the prism itself."""
    monitor, chosen = setup.instrument.autocollimator, (setup.test.prisms or {}).get(beam.prisms)
    own = (monitor.prism_180.kind, monitor.prism_0.kind)
    return own if chosen is None else (chosen.prism_180.kind, chosen.prism_0.kind)


def drawn_beam(setup: MonitorDesignSetup, rng: np.random.Generator) -> Beam:
    """A beam at random, evenly in all that may vary."""
    start = start_beams(setup)[0]
    numbers = {name: float(rng.uniform(*ends)) for name, ends in ranges(setup).items()}
    return replace(start.changed(numbers), prisms=_chosen(setup, rng), area_ccd=_chosen_ccd(setup, start, rng))


def changed_beam(setup: MonitorDesignSetup, beam: Beam, step: float, rng: np.random.Generator) -> Beam:
    """A beam near another one.

    Parameters
    ----------
    setup : MonitorDesignSetup
        The design.
    beam : Beam
        That is changed.
    step : float
        Standard deviation of the change of each number, relative to its range; its ends throw back.
    rng : np.random.Generator
        Source of all that is drawn. About half of the numbers stay, so that single ones are tried, too.
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
    """One of a beam's continuous numbers."""
    value = getattr(beam, name)
    return _light(setup) if value is None else float(value)


def ranges(setup: MonitorDesignSetup) -> dict[str, tuple[float, float]]:
    """What of each beam varies continuously, from and to, SI."""
    return {name: ends for name in CONTINUOUS if (ends := getattr(setup.test.vary, name)) is not None}


def _chosen(setup: MonitorDesignSetup, rng: np.random.Generator) -> str:
    names = tuple(setup.test.prisms or (AS_STARTED,))
    return names[int(rng.integers(len(names)))]


def _chosen_ccd(setup: MonitorDesignSetup, start: Beam, rng: np.random.Generator) -> str:
    names = tuple(setup.test.area_ccds or ())
    return names[int(rng.integers(len(names)))] if names else start.area_ccd


def prism_mass(instrument: Instrument) -> float:
    """Mass of all prisms and of what stands in their place, kg, without the central prism."""
    placed, total = instrument.assembly.place(), 0.0
    for solid in instrument.solids:
        if solid.path != instruments.CENTRAL_PRISM:
            total += float(solid_mesh(solid, placed).mesh.volume) * material(solid.material).density
    return total


@dataclass(frozen=True, eq=False)
class ImagingBeams:
    """Imaging beams of an instrument's cameras, of which prisms take their part.

    Attributes
    ----------
    segments : Mapping[str, Sequence[np.ndarray]]
        Camera -> rays to both ends and the middle of the line, three of (RAYS, K, 2, 3), base frame, metres.
    """

    segments: Mapping[str, Sequence[np.ndarray]]

    @classmethod
    def of(cls, instrument: Instrument, backend: Backend) -> ImagingBeams:
        """Those of an instrument; every layout on the same cameras has the same."""
        return cls({name: imaging_segments(instrument, backend, name, RAYS) for name in instrument.cameras})

    def taken(self, instrument: Instrument) -> np.ndarray:
        """Which rays some prism of an instrument takes, (cameras, 3, RAYS)."""
        placed, out = instrument.assembly.place(), np.zeros((len(self.segments), 3, RAYS), dtype=bool)
        for solid in instrument.solids:
            corners = placed.pose(solid.path).apply(solid_mesh(solid, placed).vertices)
            planes = convex_hull(corners).equations
            for c, beams in enumerate(self.segments.values()):
                for k, rays in enumerate(beams):
                    out[c, k] |= rays_taken(rays, planes)
        return out


def pupil_share(taken: np.ndarray) -> float:
    """Largest share of a camera's pupil along its line, by what ``ImagingBeams.taken`` gives."""
    return float(taken.mean(axis=-1).max())
