"""Evaluation of single beams and whole layouts of a monitor: they are built, checked and traced.

A layout consists of monitor beams, each with its prisms at a position in the pupil. A beam is first evaluated alone,
four times in a pair of cameras as in every layout. The Fisher information of its spots on the motions of the bodies
that all beams share adds up over the beams of a layout (the motions of a beam's own prisms act as noise of its spots),
so that thousands of combinations are compared without a trace. The best ones are then built as a whole, which includes
facets in one block and adjacent prisms.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache

import numpy as np
from scipy.spatial import ConvexHull

from analysis.monitor.disturbances import Disturbances
from optics.numerics.backend import Backend, load_backend
from optics.numerics.number_tree import FrozenMap
from optics.numerics.quadrature import circle
from optics.raytrace.aim import AimError
from optics.raytrace.trace import BeamMissedError
from scenes.models import monitor_layout
from scenes.models.instrument_builder import build_instrument
from scenes.models.instrument_model import Instrument
from scenes.models.obstruction import LEAST_GAP, blocked_rays, convex_bodies, monitor_beams, separation
from scenes.specs.instrument import CENTRAL_PRISM, SIDES, prism_of
from scenes.yaml.errors import InputError
from scenes.yaml.spec import validate
from scenes.yaml.yaml_file import parse_yaml
from twin.monitor.monitor_derivative import Information, ground_of, information_of, quantity_rows
from twin.sensors.area_detector import EmvaDetector

_AROUND = 24
"""Number of rays traced along the edge of a monitor beam."""
EDGE_PX = 10.0
"""Smallest distance between the centre of a spot and the edge of its area CCD that the fit needs, pixels."""
FULLEST = 0.9
"""Largest fraction of a pixel's full-well capacity that its expected light may fill.

The rest is for shot noise and for pixels of higher response, five standard deviations of both even with a few thousand
electrons.
"""


@dataclass(frozen=True, eq=False)
class Seen:
    """Linear observation model of the spots of one beam under one prior on disturbances.

    Array dimensions: D = 8 spot coordinates, K cameras, M independent motions.

    Attributes
    ----------
    shared : (D, M) ndarray
        Spot shifts, px, due to independent motions, of unit variance, of the bodies that all beams share.
    individual : (D, D) ndarray
        Covariance of the spot shifts, px^2, due to the motions of this beam's own bodies and to image noise.
    parameters : (4 K, M) ndarray
        Changes of the cameras' parameters, rad and m, due to the shared motions; the same for all beams.
    """

    shared: np.ndarray
    individual: np.ndarray
    parameters: np.ndarray


@dataclass(frozen=True, eq=False)
class BeamFacts:
    """Properties of a monitor beam that was evaluated alone.

    Array dimensions: P corners, N segments, K cameras.

    Attributes
    ----------
    beam : Beam
        The beam.
    refused : str
        Reason why it is not feasible, empty if it is; the other attributes are then empty.
    seen : dict
        Name of a disturbances file -> observation model of the beam's spots.
    taken : ndarray
        Imaging rays that its prisms block: the packed bits of a boolean array (cameras, 3, rays).
    mass : float
        Mass of its prisms, kg.
    bodies : tuple of ndarray
        Corners (P, 3) of its prisms in the base frame, metres.
    facets : (channels, 4) ndarray
        For each channel the tilt of its facet (tangents) along the base's X and Y, and the facet's position (X, Y)
        relative to the apex, metres.
    light : (N, K, 2, 3) ndarray
        Segments of the rays of its beams in front of the cameras, metres.
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
        """Planes of the faces of each of its prisms, (F, 4) for F faces: normal n and offset d of n x + d = 0.

        n is a unit vector that points outwards in the base frame, x a point in that frame and d is in metres.
        """
        return [ConvexHull(corners).equations for corners in self.bodies]


@dataclass(frozen=True, eq=False)
class LayoutFacts:
    """Properties of a layout that was built as a whole.

    Attributes
    ----------
    beams : Layout
        Beams of the layout.
    refused : str
        Reason why it is not feasible, empty if it is; the other attributes are then empty.
    sigmas : dict
        Disturbances -> quantity -> posterior standard deviation, SI units.
    before : dict
        Disturbances -> quantity -> prior standard deviation, without any measurement, SI units.
    shares : dict
        Disturbances -> quantity of a goal -> cause -> contribution of the cause to the posterior variance, SI units
        squared.
    shares_before : dict
        Disturbances -> quantity of a goal -> cause -> contribution of the cause to the prior variance, without any
        measurement, SI units squared.
    pupil_share : float
        Fraction of the imaging pupil that its prisms block.
    mass : float
        Mass of its prisms, kg.
    glass_path : float
        Longest path of a beam in glass, one way, metres.
    spot_sigma : float
        Largest prior standard deviation of a spot position, pixels.
    brightest : (C,) ndarray
        Signal of the brightest pixel of each of C spots, as a fraction of its full-well capacity.
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
    """Evaluator of the beams and layouts of one design: builds, checks and traces them.

    Parameters
    ----------
    setup : MonitorDesignSetup
        Specification of the search for a layout.
    backend : Backend
        Array backend of the ray trace.
    """

    def __init__(self, setup: monitor_layout.MonitorDesignSetup, backend: Backend) -> None:
        self.setup, self.backend = setup, backend

    @cached_property
    def start(self) -> Instrument:
        """Instrument from which the design starts; raises InputError if it cannot be built."""
        return build_instrument(self.setup.instrument, self.setup.cameras, self.backend)

    @cached_property
    def imaging(self) -> monitor_layout.ImagingBeams:
        """Imaging beams of the cameras, which all layouts have in common."""
        return monitor_layout.ImagingBeams.of(self.start, self.backend)

    @property
    def imaging_shape(self) -> tuple[int, int, int]:
        """Shape (cameras, 3, rays) of the boolean array that is stored bitwise in ``BeamFacts.taken``."""
        return len(self.setup.instrument.cameras), 3, monitor_layout.RAYS

    @cached_property
    def rows(self) -> dict[str, np.ndarray]:
        """Quantity -> its coefficients on the parameters of all cameras, the same for all layouts."""
        return quantity_rows(self.start, ground_of(self.start))

    def detector(self, name: str = monitor_layout.AS_STARTED) -> EmvaDetector:
        """Return the detector model of the area CCD named in a beam."""
        sheet = self.setup.detectors.get(name, self.setup.detector)
        return EmvaDetector.from_sheet(sheet, self.setup.instrument.autocollimator.area_ccd.exposure)

    def goals_of(self, name: str) -> tuple[str, ...]:
        """Return the quantities of which a goal takes the worst, such as ``d_f`` of every camera."""
        return tuple(key for key in self.rows if key == name or key.endswith(f"/{name}"))

    def boards_apart(self, beam: monitor_layout.Beam, other: monitor_layout.Beam) -> bool:
        """Return True if the area CCDs of two beams fit beside each other at an end of every line."""
        ccd = monitor_layout.layout_spec(self.setup, (beam,)).autocollimator.area_ccd
        return all(
            abs(camera.line_principal_distance * (np.tan(beam.field) - np.tan(other.field))) >= ccd.rows * ccd.pitch
            for camera in self.start.cameras.values()
        )

    def try_beam(self, beam: monitor_layout.Beam) -> BeamFacts:
        """Build and trace a beam alone and return its properties, or why it is not feasible."""
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
            seen=FrozenMap({name: _seen(info) for name, info in information.items()}),
            taken=np.packbits(taken),
            mass=mass,
            bodies=tuple(corners for path, corners in bodies.items() if prism_of(path) is not None),
            facets=_facets(instrument),
            light=_light(instrument, self.backend),
        )

    def try_layout(self, beams: monitor_layout.Layout) -> LayoutFacts:
        """Build and trace a layout as a whole and return its properties, or why it is not feasible."""
        try:
            instrument = build_instrument(
                monitor_layout.layout_spec(self.setup, beams), self.setup.cameras, self.backend
            )
            return self.judged(beams, instrument)
        except (InputError, AimError, BeamMissedError, _OutsideLimitsError, ValueError) as error:
            return LayoutFacts(beams, refused=_reason(error))

    def judged(self, beams: monitor_layout.Layout, instrument: Instrument, limited: bool = True) -> LayoutFacts:
        """Return the properties (accuracy, obstruction, mass) of a layout that is already built as an instrument.

        Parameters
        ----------
        beams : Layout
            Beams of the layout.
        instrument : Instrument
            Instrument with these beams.
        limited : bool
            True if it must satisfy the design's limits.

        Raises
        ------
        BeamMissedError, AimError
            Light does not reach its area CCDs.
        _OutsideLimitsError
            It violates a limit.
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
            sigmas={name: {key: info.sigma(key) for key in info.quantities} for name, info in information.items()},
            before={
                name: {key: info.sigma_before(key) for key in info.quantities} for name, info in information.items()
            },
            shares={name: {key: info.shares(key) for key in goals} for name, info in information.items()},
            shares_before={name: {key: info.shares(key, False) for key in goals} for name, info in information.items()},
            pupil_share=share,
            mass=mass,
            glass_path=max(sum(lengths.values()) for lengths in instrument.glass_path.values()),
            spot_sigma=max(float(info.spot_sigma.max()) for info in information.values()),
            brightest=next(iter(information.values())).brightest,
        )

    def information(
        self, instrument: Instrument, beam: monitor_layout.Beam, alike: bool = False, single: bool = True
    ) -> dict[str, Information]:
        """Return disturbances -> Fisher information of an instrument's spots on the cameras' parameters.

        Parameters
        ----------
        instrument : Instrument
            A layout of this design.
        beam : Beam
            One of its beams, which names the area CCD.
        alike, single : bool
            True to assume the same noise for spots of one camera with the same beam width; True for images in single
            precision.
        """
        priors = self.setup.disturbances
        detector, ground = self.detector(beam.area_ccd), ground_of(instrument)
        results = information_of(instrument, [*priors.values()], detector, self.backend, ground, alike, single)
        return dict(zip(priors, results, strict=True))

    def _check_limits(self, share: float, mass: float) -> None:
        limits = self.setup.test.limits
        if limits.pupil_share is not None and share > limits.pupil_share:
            raise _OutsideLimitsError(f"its prisms block {100.0 * share:.3g} percent of the imaging pupil")
        if limits.mass is not None and mass > limits.mass:
            raise _OutsideLimitsError(f"its prisms have a mass of {mass:.4g} kg")

    def _check_spots(self, information: Mapping[str, Information], instrument: Instrument) -> None:
        ccd = instrument.spec.autocollimator.area_ccd
        room = 0.5 * min(ccd.rows, ccd.columns) - EDGE_PX
        extent = self.setup.test.limits.spot_sigmas * max(float(info.spot_sigma.max()) for info in information.values())
        if extent > room:
            raise _OutsideLimitsError(f"its spots leave their area CCDs: {extent:.3g} px of {room:.3g} px")
        fullest = max(float(info.brightest.max()) for info in information.values())
        if fullest > FULLEST:
            raise _OutsideLimitsError(f"its spots are too bright: pixels are filled to {100.0 * fullest:.3g} percent")


class _OutsideLimitsError(Exception):
    """Error that a layout violates a limit of its design, such as on mass."""


def _reason(error: Exception) -> str:
    return error.issues[0].problem if isinstance(error, InputError) else str(error)


def is_individual(body: str) -> bool:
    """Return True if the path of a body shows that it belongs to one channel: a prism, board or facet."""
    last = body.rpartition("/")[2]
    return any(part.partition("_")[0] in SIDES for part in body.split("/")) or any(
        last.endswith(f"_{side}") for side in SIDES
    )


def _seen(information: Information) -> Seen:
    disturbances: Disturbances = information.disturbances
    individual = np.array([is_individual(body) for body in disturbances.bodies])
    root = disturbances.root[np.ix_(~individual, ~individual)]
    individual_shifts = disturbances.spots[:, individual] @ disturbances.root[np.ix_(individual, individual)]
    return Seen(
        disturbances.spots[:, ~individual] @ root,
        individual_shifts @ individual_shifts.T + information.noise,
        disturbances.parameters[:, ~individual] @ root,
    )


def _light(instrument: Instrument, backend: Backend) -> np.ndarray:
    """Return segments of the edge rays of all outgoing beams in front of the cameras, (N, K, 2, 3), metres.

    Segments inside glass are omitted. Array dimensions: N segments, K cameras; each segment has two end points.
    """
    out = []
    for beam in monitor_beams(instrument, backend, np.concatenate([np.zeros((1, 2)), 0.999 * circle(_AROUND)])):
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


def touching(beam: BeamFacts, other: BeamFacts) -> bool:
    """Return True if two beams cannot be in the same layout.

    Their prisms overlap or block the other's light, or a facet extends over the edge of the other's.

    Parameters
    ----------
    beam, other : BeamFacts
        Beams that were evaluated alone.
    """
    # as scenes.models.monitor_chain.facet_positions: of two facets in one corner the more tilted one is farther out
    offset = beam.facets - other.facets
    lean = offset[:, :2]
    distance = np.sum(lean * offset[:, 2:], axis=1) / np.maximum(np.linalg.norm(lean, axis=1), 1e-12)
    if np.any(distance < max(beam.beam.width, other.beam.width)):  # the edge of two facets is half way between them
        return True
    for light, planes in ((beam.light, other.planes), (other.light, beam.planes)):
        if any(blocked_rays(light, faces).any() for faces in planes):
            return True
    for a in beam.bodies:
        for b in other.bodies:
            gap = np.maximum(a.min(axis=0), b.min(axis=0)) - np.minimum(a.max(axis=0), b.max(axis=0))
            if np.all(gap <= LEAST_GAP) and separation(a, b) < LEAST_GAP:
                return True
    return False


def combined(facts: Sequence[BeamFacts], name: str) -> np.ndarray:
    """Return the posterior covariance of the parameters of K cameras from several beams together, (4 K, 4 K).

    The parameters are in rad and m.

    Parameters
    ----------
    facts : sequence of BeamFacts
        The beams.
    name : str
        Name of the disturbances.
    """
    models = [entry.seen[name] for entry in facts]
    shared = np.concatenate([entry.shared for entry in models])
    spread = shared @ shared.T
    size = len(models[0].individual)
    for k, entry in enumerate(models):
        rows = slice(size * k, size * (k + 1))
        spread[rows, rows] += entry.individual
    parameters = models[0].parameters
    across = parameters @ shared.T
    return np.asarray(parameters @ parameters.T - across @ np.linalg.solve(spread, across.T))


@lru_cache(maxsize=1)
def bench_of(config: str, backend: str) -> LayoutBench:
    """Return the evaluator of a design's layouts, which a worker process keeps between tasks.

    Parameters
    ----------
    config : str
        Text of the design's config.yaml.
    backend : str
        Array backend of the ray trace.
    """
    return LayoutBench(validate(monitor_layout.MonitorDesignSetup, parse_yaml(config)), load_backend(backend))
