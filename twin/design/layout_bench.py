"""What one beam, and one whole layout, of a monitor's design is worth: built, checked and traced.

A beam is first tried alone, four times in a pair as in every layout. What its spots say of the bodies that all beams
share, and what its own prisms do to them, add up over the beams of a layout, so that thousands of combinations cost no
trace. The chosen ones are then built as a whole, where facets in one block and prisms beside each other count, too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache

import numpy as np
from scipy.spatial import ConvexHull

from analysis.monitor.disturbances import Disturbances
from optics.numerics.backend import Backend, load_backend
from optics.numerics.number_tree import FrozenMap
from optics.raytrace.aim import AimError
from optics.raytrace.trace import BeamMissedError
from scenes.models import monitor_layout
from scenes.models.instrument_builder import build_instrument
from scenes.models.instrument_model import Instrument
from scenes.models.obstruction import LEAST_GAP, convex_bodies, monitor_beams, rays_taken, separation
from scenes.specs.instrument import CENTRAL_PRISM, SIDES, prism_of
from scenes.yaml.errors import InputError
from scenes.yaml.spec import validate
from scenes.yaml.yaml_file import parse_yaml
from twin.monitor.information import Information, ground_of, information_of, quantity_rows
from twin.sensors.area_detector import EmvaDetector

_AROUND = 24
EDGE_PX = 10.0
"""Room that the fit of a spot needs between its middle and the edge of its area CCD, pixels."""
FULLEST = 0.9
"""Largest share of what a pixel can hold that its expected light may fill: the rest is for shot noise and for pixels
that respond more than others, five standard deviations of both even with a few thousand electrons.
"""


@dataclass(frozen=True, eq=False)
class Seen:
    """What the spots of one beam say under one statement of disturbances; D = 8 coordinates, K cameras.

    Attributes
    ----------
    shared : np.ndarray
        (D, M) px by independent unit motions of the bodies that all beams share.
    own : np.ndarray
        (D, D) px^2, covariance by the bodies of this beam alone, and by noise.
    parameters : np.ndarray
        (4 K, M) of the cameras by the shared motions; the same for all beams.
    """

    shared: np.ndarray
    own: np.ndarray
    parameters: np.ndarray


@dataclass(frozen=True, eq=False)
class BeamFacts:
    """A beam that was tried alone.

    Attributes
    ----------
    beam : monitor_layout.Beam
        The beam.
    refused : str
        Why it cannot stand, empty for one that can; nothing else is then known.
    seen : Mapping[str, Seen]
        By the names of the disturbances.
    taken : np.ndarray
        Imaging rays that its prisms take, packed bits of (cameras, 3, rays).
    mass : float
        Of its prisms, kg.
    bodies : tuple[np.ndarray, ...]
        Corners (P, 3) of its prisms in the base frame, metres.
    facets : np.ndarray
        Of each channel, how far its facet leans along the base's X and Y (tangents) and stands from the apex, metres,
        (channels, 4).
    light : np.ndarray
        Rays of its beams in front of the cameras, segments (N, K, 2, 3), metres.
    """

    beam: monitor_layout.Beam
    refused: str = ""
    seen: Mapping[str, Seen] = field(default_factory=FrozenMap)
    taken: np.ndarray = field(default_factory=lambda: np.zeros(0, np.uint8))
    mass: float = 0.0
    bodies: tuple[np.ndarray, ...] = ()
    facets: np.ndarray = field(default_factory=lambda: np.zeros((0, 4)))
    light: np.ndarray = field(default_factory=lambda: np.zeros((0, 0, 2, 3)))

    @cached_property
    def planes(self) -> list[np.ndarray]:
        """Planes of the faces of each of its prisms, (F, 4) each."""
        return [ConvexHull(corners).equations for corners in self.bodies]


@dataclass(frozen=True, eq=False)
class LayoutFacts:
    """A layout that was built as a whole.

    Attributes
    ----------
    beams : monitor_layout.Layout
        Of it.
    refused : str
        Why it cannot stand, empty for one that can; nothing else is then known.
    sigmas : Mapping[str, Mapping[str, float]]
        Disturbances -> quantity -> what is left, SI.
    before : Mapping[str, Mapping[str, float]]
        Likewise, without any measurement.
    shares : Mapping[str, Mapping[str, Mapping[str, float]]]
        Disturbances -> goal -> cause -> variance that is left, SI.
    shares_before : Mapping[str, Mapping[str, Mapping[str, float]]]
        Likewise, without any measurement.
    pupil_share : float
        Of the imaging pupil that its prisms take.
    mass : float
        Of its prisms, kg.
    glass_path : float
        Longest way of a beam in glass, one way, metres.
    spot_sigma : float
        Largest standard deviation of a spot's place, pixels.
    brightest : np.ndarray
        How full every spot's brightest pixel is, (C,).
    """

    beams: monitor_layout.Layout
    refused: str = ""
    sigmas: Mapping[str, Mapping[str, float]] = field(default_factory=FrozenMap)
    before: Mapping[str, Mapping[str, float]] = field(default_factory=FrozenMap)
    shares: Mapping[str, Mapping[str, Mapping[str, float]]] = field(default_factory=FrozenMap)
    shares_before: Mapping[str, Mapping[str, Mapping[str, float]]] = field(default_factory=FrozenMap)
    pupil_share: float = 0.0
    mass: float = 0.0
    glass_path: float = 0.0
    spot_sigma: float = 0.0
    brightest: np.ndarray = field(default_factory=lambda: np.zeros(0))


class LayoutBench:
    """Tries beams and layouts of one design.

    Parameters
    ----------
    setup
        The design.
    backend
        Where to trace.
    """

    def __init__(self, setup: monitor_layout.MonitorDesignSetup, backend: Backend) -> None:
        self.setup, self.backend = setup, backend

    @cached_property
    def start(self) -> Instrument:
        """What the design starts from. Raises InputError where it cannot stand."""
        return build_instrument(self.setup.instrument, self.setup.cameras, self.backend)

    @cached_property
    def imaging(self) -> monitor_layout.ImagingBeams:
        """Imaging beams of the cameras, which all layouts have."""
        return monitor_layout.ImagingBeams.of(self.start, self.backend)

    @property
    def imaging_shape(self) -> tuple[int, int, int]:
        """Shape of the bits that ``BeamFacts.taken`` packs."""
        return len(self.setup.instrument.cameras), 3, monitor_layout.RAYS

    @cached_property
    def rows(self) -> dict[str, np.ndarray]:
        """Quantity -> rows on the parameters; the same in all layouts, which leave the cameras as they are."""
        return quantity_rows(self.start, ground_of(self.start))

    def detector(self, name: str = monitor_layout.AS_STARTED) -> EmvaDetector:
        """Detector of the area CCD that a beam names."""
        sheet = self.setup.detectors.get(name, self.setup.detector)
        return EmvaDetector.from_sheet(sheet, self.setup.instrument.autocollimator.area_ccd.exposure)

    def goals_of(self, name: str) -> tuple[str, ...]:
        """Quantities of which a goal's value is the worst: ``d_f`` of every camera."""
        return tuple(key for key in self.rows if key == name or key.endswith(f"/{name}"))

    def boards_apart(self, one: monitor_layout.Beam, other: monitor_layout.Beam) -> bool:
        """Whether the area CCDs of two beams have room beside each other at an end of every line."""
        ccd = monitor_layout.layout_spec(self.setup, (one,)).autocollimator.area_ccd
        return all(
            abs(camera.line_principal_distance * (np.tan(one.field) - np.tan(other.field))) >= ccd.rows * ccd.pitch
            for camera in self.start.cameras.values()
        )

    def try_beam(self, beam: monitor_layout.Beam) -> BeamFacts:
        """A beam alone."""
        try:
            instrument = build_instrument(
                monitor_layout.layout_spec(self.setup, (beam,)), self.setup.cameras, self.backend
            )
            taken, mass = self.imaging.taken(instrument), monitor_layout.prism_mass(instrument)
            self._check_limits(monitor_layout.pupil_share(taken), mass)
            information = self.information(instrument, beam, alike=True)
            self._check_spots(information, instrument)
        except (InputError, AimError, BeamMissedError, _OutsideLimitsError, ValueError) as error:
            return BeamFacts(beam, refused=_reason(error))
        bodies = convex_bodies(instrument)
        return BeamFacts(
            beam,
            seen=FrozenMap({name: _seen(one) for name, one in information.items()}),
            taken=np.packbits(taken),
            mass=mass,
            bodies=tuple(corners for path, corners in bodies.items() if prism_of(path) is not None),
            facets=_facets(instrument),
            light=_light(instrument, self.backend),
        )

    def try_layout(self, beams: monitor_layout.Layout) -> LayoutFacts:
        """A layout as a whole."""
        try:
            instrument = build_instrument(
                monitor_layout.layout_spec(self.setup, beams), self.setup.cameras, self.backend
            )
            return self.judged(beams, instrument)
        except (InputError, AimError, BeamMissedError, _OutsideLimitsError, ValueError) as error:
            return LayoutFacts(beams, refused=_reason(error))

    def judged(self, beams: monitor_layout.Layout, instrument: Instrument, limited: bool = True) -> LayoutFacts:
        """What an instrument is worth as a layout.

        Parameters
        ----------
        beams : monitor_layout.Layout
            That it has.
        instrument : Instrument
            With them.
        limited : bool
            Whether it has to keep the design's limits.

        Raises
        ------
        BeamMissedError, AimError
            Light does not come to its area CCDs.
        _OutsideLimitsError
            It does not keep a limit.
        """
        share, mass = monitor_layout.pupil_share(self.imaging.taken(instrument)), monitor_layout.prism_mass(instrument)
        if limited:
            self._check_limits(share, mass)
        information = self.information(instrument, beams[0])
        if limited:
            self._check_spots(information, instrument)
        goals = [key for name in self.setup.test.goal.wanted for key in self.goals_of(name)]
        return LayoutFacts(
            beams,
            sigmas={name: {key: one.sigma(key) for key in one.quantities} for name, one in information.items()},
            before={name: {key: one.sigma_before(key) for key in one.quantities} for name, one in information.items()},
            shares={name: {key: one.shares(key) for key in goals} for name, one in information.items()},
            shares_before={name: {key: one.shares(key, False) for key in goals} for name, one in information.items()},
            pupil_share=share,
            mass=mass,
            glass_path=max(sum(lengths.values()) for lengths in instrument.glass_path.values()),
            spot_sigma=max(float(one.spot_sigma.max()) for one in information.values()),
            brightest=next(iter(information.values())).brightest,
        )

    def information(
        self, instrument: Instrument, beam: monitor_layout.Beam, alike: bool = False, single: bool = True
    ) -> dict[str, Information]:
        """What an instrument's spots know, by the names of the disturbances.

        Parameters
        ----------
        instrument : Instrument
            a layout of this design.
        beam : monitor_layout.Beam
            One of it, which names the area CCD.
        alike : bool
            As of ``information_of``.
        single : bool
            likewise.
        """
        stated = self.setup.disturbances
        found = information_of(
            instrument,
            list(stated.values()),
            self.detector(beam.area_ccd),
            self.backend,
            ground_of(instrument),
            alike,
            single,
        )
        return dict(zip(stated, found, strict=True))

    def _check_limits(self, share: float, mass: float) -> None:
        limits = self.setup.test.limits
        if limits.pupil_share is not None and share > limits.pupil_share:
            raise _OutsideLimitsError(f"its prisms take {100.0 * share:.3g} percent of the imaging pupil")
        if limits.mass is not None and mass > limits.mass:
            raise _OutsideLimitsError(f"its prisms have a mass of {mass:.4g} kg")

    def _check_spots(self, information: Mapping[str, Information], instrument: Instrument) -> None:
        ccd = instrument.spec.autocollimator.area_ccd
        room = 0.5 * min(ccd.rows, ccd.columns) - EDGE_PX
        reach = self.setup.test.limits.spot_sigmas * max(float(one.spot_sigma.max()) for one in information.values())
        if reach > room:
            raise _OutsideLimitsError(f"its spots leave their area CCDs: {reach:.3g} px of {room:.3g} px")
        fullest = max(float(one.brightest.max()) for one in information.values())
        if fullest > FULLEST:
            raise _OutsideLimitsError(f"its spots are too bright: pixels are filled to {100.0 * fullest:.3g} percent")


class _OutsideLimitsError(Exception):
    """A layout does not keep a limit of its design."""


def _reason(error: Exception) -> str:
    return error.issues[0].problem if isinstance(error, InputError) else str(error)


def is_own(body: str) -> bool:
    """Whether a body belongs to one channel, by its path: prisms, boards, facets."""
    last = body.rpartition("/")[2]
    return any(part.partition("_")[0] in SIDES for part in body.split("/")) or any(
        last.endswith(f"_{side}") for side in SIDES
    )


def _seen(information: Information) -> Seen:
    stated: Disturbances = information.disturbances
    own = np.array([is_own(body) for body in stated.bodies])
    root = stated.root[np.ix_(~own, ~own)]
    mine = stated.spots[:, own] @ stated.root[np.ix_(own, own)]
    return Seen(stated.spots[:, ~own] @ root, mine @ mine.T + information.noise, stated.parameters[:, ~own] @ root)


def _light(instrument: Instrument, backend: Backend) -> np.ndarray:
    """Edge rays of all beams on their way out, in front of the cameras and outside glass, segments (N, K, 2, 3)."""
    angle = 2.0 * np.pi * np.arange(_AROUND) / _AROUND
    edge = 0.999 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    out = []
    for beam in monitor_beams(instrument, backend, np.concatenate([np.zeros((1, 2)), edge])):
        first = len(instrument.cameras[beam.channel.camera].mirrors)
        last = len(instrument.assembly.sequences[f"{beam.channel.key}/outgoing"])
        out.append(beam.segments[:, [k for k in range(first, last) if beam.inside[k] is None]])
    return np.concatenate(out)


def _facets(instrument: Instrument) -> np.ndarray:
    apex = instrument.assembly.nominal_pose(CENTRAL_PRISM).translation
    out = []
    for channel in instrument.channels:
        pose = instrument.assembly.nominal_pose(channel.face_body)
        normal = pose.rotation[:, 2]
        out.append([*(normal[:2] / normal[2]), *(pose.translation - apex)[:2]])
    return np.array(out)


def touching(one: BeamFacts, other: BeamFacts) -> bool:
    """Whether two beams cannot stand together: prisms stand in each other or in the other's light, or one's facet
    reaches over the edge of the other's.

    Parameters
    ----------
    one : BeamFacts
        a beam that was tried alone.
    other : BeamFacts
        Another one.
    """
    # as scenes.models.monitor_chain.facet_places: of two in one corner the one that leans more stands farther out
    away = one.facets - other.facets
    lean = away[:, :2]
    apart = np.sum(lean * away[:, 2:], axis=1) / np.maximum(np.linalg.norm(lean, axis=1), 1e-12)
    if np.any(apart < max(one.beam.width, other.beam.width)):  # the edge of two facets is half way between them
        return True
    for light, planes in ((one.light, other.planes), (other.light, one.planes)):
        if any(rays_taken(light, own).any() for own in planes):
            return True
    for a in one.bodies:
        for b in other.bodies:
            gap = np.maximum(a.min(axis=0), b.min(axis=0)) - np.minimum(a.max(axis=0), b.max(axis=0))
            if np.all(gap <= LEAST_GAP) and separation(a, b) < LEAST_GAP:
                return True
    return False


def combined(facts: Sequence[BeamFacts], name: str) -> np.ndarray:
    """Covariance of the cameras' parameters that several beams together leave, (4 K, 4 K), rad and m.

    Parameters
    ----------
    facts : Sequence[BeamFacts]
        Of the beams.
    name : str
        Of the disturbances.
    """
    seen = [one.seen[name] for one in facts]
    shared = np.concatenate([one.shared for one in seen])
    spread = shared @ shared.T
    size = len(seen[0].own)
    for k, one in enumerate(seen):
        own = slice(size * k, size * (k + 1))
        spread[own, own] += one.own
    parameters = seen[0].parameters
    across = parameters @ shared.T
    return np.asarray(parameters @ parameters.T - across @ np.linalg.solve(spread, across.T))


@lru_cache(maxsize=1)
def bench_of(config: str, backend: str) -> LayoutBench:
    """The bench of a design, of a worker process that keeps it from one piece of work to the next.

    Parameters
    ----------
    config : str
        Text of the design's config.yaml.
    backend : str
        Where to trace.
    """
    return LayoutBench(validate(monitor_layout.MonitorDesignSetup, parse_yaml(config)), load_backend(backend))
