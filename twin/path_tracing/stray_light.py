"""Ghosts and stray light on the area CCDs, which are added to the diffraction images of the spots.

The spot's diffraction image (``twin.monitor.monitor_path``) contains exactly the light on the nominal path, the nominal
family. The light of every pinhole is path-traced through the whole instrument, and the surfaces that a path met
distinguish the nominal family from all others, so that nothing is counted twice. The other light consists of geometric
rays in pixels. It passed apertures of the same size as those of the nominal spot, and is convolved with the nominal
spot's diffraction image before it is added. Its interference with the nominal light is neglected.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from optics.geometry.tree import State
from optics.numerics import quadrature
from optics.numerics.array_math import PhysicalError
from optics.numerics.backend import Backend
from optics.waves.diffraction import Grid, image
from scenes.models.instrument_model import Instrument
from scenes.models.scenery import Finishes, Scenery, build_scenery
from scenes.specs.baffle import Plate
from scenes.specs.instrument import Channel, prism_of
from twin.framework.record import Quantity, Record
from twin.monitor.monitor_beams import AimedRays
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.monitor_path import MonitorPath
from twin.path_tracing.path_families import Event, SurfaceEvent, family_name, nominal_codes
from twin.path_tracing.path_result import NOMINAL, Balance, Family, PathResult
from twin.path_tracing.tracer import CHUNK, FAINT, DiskSource, PathTracer, Progress, Sampling

CONE_MARGIN = 1.25
"""Half-angle of the cone into which a pinhole emits, relative to that of the pupil seen from the focal plane."""

AIM_RINGS = 6
"""Number of rings of rays by which the direction from a pinhole to the return face is sampled.

The return face is the mirror surface that sends the monitor's light back.
"""
NARROW_MARGIN = 1.2
"""Radius of the narrow cone of emission, relative to the cone of rays to the outermost of ``AIM_RINGS``.

These rays end on the return face, the mirror surface that sends the monitor's light back, 3 % inside its edge.
"""


class NominalPathLost(PhysicalError, RuntimeError):
    """No path reached a monitor's area CCD along its nominal surfaces, so stray light cannot be normalised."""


@dataclass(frozen=True, eq=False)
class StrayResult:
    """Stray light of some monitor channels in one state.

    Attributes
    ----------
    photons : Mapping[str, (rows, columns) ndarray]
        Area CCD (``<camera>/<channel>/area_ccd``) -> expected photons per pixel and frame from all traced sources,
        without the nominal families.
    runs : Mapping[str, PathResult]
        Channel -> result of the path tracer for its pinhole.
    photons_per_power : Mapping[str, float]
        Channel -> photons per frame that correspond to the whole emitted power of its source.
    """

    photons: Mapping[str, np.ndarray]
    runs: Mapping[str, PathResult]
    photons_per_power: Mapping[str, float]

    def relative(self, channel: str) -> list[ListedFamily]:
        """Return the families of paths of a channel's pinhole, each with its light relative to the nominal spot's.

        They end at any detector; the strongest comes first.
        """
        run = self.runs[channel]
        nominal = run.nominal(f"{channel}/area_ccd")
        others = [(family, family.energy / nominal.energy) for family in run.families if family.kind != "nominal"]
        others.sort(key=lambda entry: -entry[1])
        # a path belongs to one family only: the covariance of two energies is -1 / paths times their product
        relative_variance = (nominal.error / nominal.energy) ** 2 + 2.0 / run.paths
        sigmas = [
            share * float(np.sqrt((family.error / family.energy) ** 2 + relative_variance)) for family, share in others
        ]
        return [
            ListedFamily(*entry, sigma, nominal.surface_events) for entry, sigma in zip(others, sigmas, strict=True)
        ]


@dataclass(frozen=True, eq=False)
class ListedFamily:
    """Family of paths with its light relative to the nominal family of its source.

    Attributes
    ----------
    family : Family
        Family of paths.
    share : float
        Its light divided by that of the nominal family at the source's own area CCD.
    sigma : float
        Standard deviation of this share due to the finite number of paths.
    nominal : tuple of SurfaceEvent
        Events of the nominal family.
    """

    family: Family
    share: float
    sigma: float
    nominal: tuple[SurfaceEvent, ...]


def pinhole(
    instrument: Instrument,
    backend: Backend,
    state: State,
    channel: Channel,
    cone: float | None = None,
    aimed: AimedRays | None = None,
) -> DiskSource:
    """Return the light source of a channel: its pinhole, which emits evenly into a cone that covers the camera's pupil.

    Half of the paths are aimed at the return face, the mirror surface that sends the light back.

    Parameters
    ----------
    instrument : Instrument
        Instrument.
    backend : Backend
        Backend that aims the rays.
    state : State
        Perturbed state.
    channel : Channel
        Channel of the pinhole.
    cone : float or None
        Sine of the cone's half-angle; by default that of the pupil times ``CONE_MARGIN``.
    aimed : AimedRays or None
        All channels' nominal rays to the return faces, computed here by default.
    """
    placed = instrument.assembly.place([state])
    model = instrument.cameras[channel.camera]
    if cone is None:
        cone = CONE_MARGIN * 0.5 * model.spec.entrance_pupil / model.line_principal_distance
    position = placed.pose(channel.reticle_body).translation
    axis = instrument.toward_optics(placed, channel.camera)[0]
    radius = 0.5 * instrument.spec.autocollimator.reticle.pinhole * float(placed.size(channel.reticle_body)[0])
    aimed = aimed or _nominal_rays(instrument, backend)
    number = instrument.channels.index(channel)
    return DiskSource.along(position, axis, radius, cone).aimed_at(aimed.direction[number], NARROW_MARGIN)


def _nominal_rays(instrument: Instrument, backend: Backend) -> AimedRays:
    """Return the rays from every pinhole to its return face (mirror that sends the light back), nominal instrument."""
    return MonitorPath(instrument, backend, quadrature.disk(AIM_RINGS)).nominal


def monitor_families(scenery: Scenery, instrument: Instrument) -> dict[str, tuple[int, ...]]:
    """Return a mapping from each monitor's area CCD to its nominal events, as numbers of ``path_families.code``.

    An event is a surface that nominal light meets and what happens to it there.
    """
    return {
        f"{c.key}/area_ccd": nominal_codes(scenery, instrument.assembly, f"{c.key}/monitor")
        for c in instrument.channels
    }


def trace_stray(
    instrument: Instrument,
    backend: Backend,
    state: State,
    paths: int,
    seed: int,
    channels: Sequence[Channel] | None = None,
    finishes: Finishes | None = None,
    baffles: Iterable[Plate] = (),
    sampling: Sampling = FAINT,
    cone: float | None = None,
    chunk: int = CHUNK,
    progress: Progress | None = None,
) -> StrayResult:
    """Trace the light of monitor channels, one after the other.

    Parameters
    ----------
    instrument : Instrument
        Instrument.
    backend : Backend
        Backend that traces the paths.
    state : State
        Perturbed state.
    paths : int
        Number of paths of every channel.
    seed : int
        Seed of the random numbers, which are independent between channels.
    channels : Sequence[Channel] or None
        Channels whose sources emit; all by default.
    finishes : Finishes or None
        Surface finishes (scatter, coatings); None uses the built-in ones.
    baffles : Iterable[Plate]
        Baffles of the scene.
    sampling : Sampling
        Sampling of the paths.
    cone : float or None
        Sine of the half-angle into which the pinholes emit; by default ``CONE_MARGIN`` times that of the pupil.
    chunk : int
        Number of paths of one launch.
    progress : Progress or None
        Called with the number of paths done, of all channels together.

    Raises
    ------
    NominalPathLost
        Too few paths, or the perturbation moves a beam off.
    """
    sources = tuple(instrument.channels if channels is None else channels)
    scenery = build_scenery(instrument, state, finishes, baffles)
    tracer = PathTracer(backend, scenery, monitor_families(scenery, instrument), sampling)
    aimed = _nominal_rays(instrument, backend)
    ccd = instrument.spec.autocollimator.area_ccd
    photons = {f"{c.key}/area_ccd": np.zeros((ccd.rows, ccd.columns)) for c in instrument.channels}
    runs: dict[str, PathResult] = {}
    scale: dict[str, float] = {}
    for number, channel in enumerate(sources):
        source = pinhole(instrument, backend, state, channel, cone, aimed)
        channel_seed = int(np.random.SeedSequence([seed, instrument.channels.index(channel)]).generate_state(1)[0])

        def report(done: int, _: int, before: int = number) -> None:
            if progress is not None:
                progress(before * paths + done, len(sources) * paths)

        run = tracer.run(source, paths, channel_seed, chunk=chunk, progress=report, toward=f"{channel.key}/area_ccd")
        nominal = run.of(f"{channel.key}/area_ccd", "nominal")
        if not nominal:
            raise NominalPathLost(
                f"none of {paths} paths of {channel.key} returned to its area CCD along the nominal surfaces; trace "
                "more, or the perturbation moves the beam off"
            )
        runs[channel.key] = run
        scale[channel.key] = channel.photons / nominal[0].energy
        for name, light in photons.items():
            detector_images = run.images[name]
            light += scale[channel.key] * (detector_images.sum(axis=0) - detector_images[NOMINAL])
    return StrayResult(photons, runs, scale)


SPREAD_PX = 88
"""Half-width, in pixels, of the spot's diffraction image with which stray light is convolved."""

FAMILIES = 20
"""Number of path families (paths with the same events) that are listed for each source, the strongest first."""

GHOSTS = 1e-3
"""Ratio of ghost to spot light on a monitor's area CCD above which a warning is given.

The spot's centroid then follows a motion by one pixel with an error of up to 1e-3 px, several times its noise.
"""


@dataclass(frozen=True, eq=False)
class StrayLight:
    """Stray light of one state on the area CCDs of C channels.

    Attributes
    ----------
    photons : (C, rows, columns) ndarray
        Expected photons per pixel and frame without the nominal spot.
    traced : StrayResult
        Result of the path tracer.
    paths : int
        Number of paths traced for every source.
    """

    photons: np.ndarray
    traced: StrayResult
    paths: int

    def share(self, nominal: np.ndarray) -> np.ndarray:
        """Return the ratio of stray to nominal light on the area CCD of each of C channels, (C,).

        ``nominal`` holds the expected photons of the nominal spots, as ``photons`` those of stray light.
        """
        return np.asarray(self.photons.sum(axis=(1, 2)) / nominal.sum(axis=(1, 2)))

    def to_dict(self) -> dict[str, Any]:
        """Return the contents of stray.json: path families at any detector and energy balance, by source."""
        sources = {
            name: {"families": [*map(FAMILY, self.traced.relative(name)[:FAMILIES])], "balance": _BALANCE(run.balance)}
            for name, run in self.traced.runs.items()
        }
        return {"paths_per_source": self.paths, "sources": sources}


FAMILY: Record[ListedFamily] = Record(
    "All paths that reach a detector by the same events in the same order.",
    Quantity("detector", lambda path: path.family.detector, "where the paths end"),
    Quantity("kind", lambda path: path.family.kind, "ghost, or stray where something scatters or diffuses on the way"),
    Quantity(
        "name", lambda path: family_name(path.family.surface_events, path.nominal), "how it differs from nominal light"
    ),
    Quantity("surfaces", lambda path: list(map(str, path.family.surface_events)), "in order"),
    Quantity("relative_to_nominal", lambda path: path.share, "its light over that of the source's spot", "share"),
    Quantity("relative_to_nominal_sigma", lambda path: path.sigma, "sigma by the number of paths", "its σ"),
    Quantity("paths", lambda path: path.family.count, "that were traced"),
    Quantity("x_um", lambda path: path.family.centroid[0], "centroid from the detector's middle"),
    Quantity("y_um", lambda path: path.family.centroid[1], "centroid from the detector's middle"),
    Quantity("rms_x_um", lambda path: path.family.rms[0], "size about the centroid"),
    Quantity("rms_y_um", lambda path: path.family.rms[1], "size about the centroid"),
)
_BALANCE: Record[Balance] = Record(
    "Where the light of a source went, in shares of its power.",
    Quantity("emitted", lambda balance: balance.emitted, "all paths at their start"),
    Quantity("absorbed", lambda balance: balance.absorbed, "body -> light absorbed in it"),
    Quantity("detected", lambda balance: balance.detected, "detector -> light detected by it"),
    Quantity("escaped", lambda balance: balance.escaped, "light that left the instrument"),
    Quantity("under_way", lambda balance: balance.under_way, "light of paths that were cut at the step limit"),
    Quantity("relative_error", lambda balance: balance.error, "what is missing in the sum"),
)


def stray_light(
    experiment: MonitorExperiment,
    state: State,
    paths: int,
    seed: int,
    progress: Callable[[int, int], None] | None = None,
    finishes: Finishes | None = None,
) -> StrayLight:
    """Trace the stray light of all channels in one state.

    Parameters
    ----------
    experiment : MonitorExperiment
        Instrument with its monitor.
    state : State
        Perturbed state.
    paths : int
        Number of paths of every source.
    seed : int
        Seed of the random numbers.
    progress : callable or None
        Called with the number of paths done and the number of all.
    finishes : Finishes or None
        Surface finishes (scatter, coatings); None uses the built-in ones.

    Raises
    ------
    NominalPathLost
        Too few paths, or the perturbation moves a beam off.
    """
    from scipy.signal import fftconvolve  # slow to import, and most jobs trace no stray light

    instrument = experiment.instrument
    traced = trace_stray(instrument, experiment.backend, state, paths, seed, finishes=finishes, progress=progress)
    spots = diffraction_spots(experiment)
    raw = np.stack([traced.photons[f"{c.key}/area_ccd"] for c in experiment.path.channels])
    spread = np.stack([fftconvolve(light, spot, mode="same") for light, spot in zip(raw, spots, strict=True)])
    return StrayLight(np.maximum(spread, 0.0), traced, paths)  # rounding of the transform may be negative


def diffraction_spots(experiment: MonitorExperiment) -> np.ndarray:
    """Return every channel's diffraction image about its middle, (C, n, n) for C channels, each of unit sum.

    The side n is 2 SPREAD_PX + 1 pixels.
    """
    path = experiment.path
    grid = Grid(-SPREAD_PX * path.pitch, path.pitch, 2 * SPREAD_PX + 1)
    spots = image(path.fields([{}]), grid, grid, single=True).astype(np.float64)
    return np.asarray(spots / spots.sum(axis=(1, 2), keepdims=True))


@dataclass(frozen=True)
class Ghost:
    """Ghosts on one area CCD that together have more than the fraction ``GHOSTS`` of the light of its spot.

    Attributes
    ----------
    channel : Channel
        Channel of the area CCD.
    source : str
        Channel that the strongest ghost comes from, ``<camera>/<channel>``.
    body : str or None
        Path of the prism that causes the strongest ghost, the first with a reflecting face that should transmit; None
        where the ghost met only nominal surfaces in another order.
    text : str
        Warning.
    """

    channel: Channel
    source: str
    body: str | None
    text: str


def ghost_warnings(experiment: MonitorExperiment, light: StrayLight) -> tuple[str, ...]:
    """Return a warning for each area CCD on which ghosts of any source exceed GHOSTS of its spot's light."""
    return tuple(ghost.text for ghost in ghosts(experiment, light))


def _reflecting_prism(family: Family, nominal_events: tuple[SurfaceEvent, ...]) -> str | None:
    """Return the first prism that reflects light of a family at a face that should transmit it."""
    known = {(hit.part, hit.event) for hit in nominal_events}
    for hit in family.surface_events:
        prism = prism_of(hit.part)
        if prism is not None and hit.event == Event.REFLECT and (hit.part, hit.event) not in known:
            return f"{hit.part.partition(f'/{prism}/')[0]}/{prism}"
    return None


def ghosts(experiment: MonitorExperiment, light: StrayLight) -> tuple[Ghost, ...]:
    """Return the area CCDs on which ghosts of any source exceed GHOSTS of their spots' light.

    Parameters
    ----------
    experiment : MonitorExperiment
        Monitor.
    light : StrayLight
        Traced stray light.
    """
    out, traced = [], light.traced
    for channel in experiment.path.channels:
        name = f"{channel.key}/area_ccd"
        spot = traced.runs[channel.key].nominal(name)
        ghost_paths = [
            (traced.photons_per_power[source] * family.energy / channel.photons, source, family)
            for source, run in traced.runs.items()
            for family in run.families
            if family.detector == name and family.kind == "ghost"
        ]
        total = sum(share for share, _, _ in ghost_paths)
        if total > GHOSTS:
            share, source, family = max(ghost_paths, key=lambda entry: entry[0])
            off = np.hypot(*np.subtract(family.centroid, spot.centroid)) / experiment.path.pitch
            nominal_events = traced.runs[source].nominal(f"{source}/area_ccd").surface_events
            text = (
                f"ghosts on the area CCD of {channel.key} have {100.0 * total:.2g} % of its spot's light and bias the "
                f"spot by that share of its motion relative to them; the strongest, {100.0 * share:.2g} %, comes "
                f"from {source} by {family_name(family.surface_events, nominal_events)}, {off:.3g} px from the spot: "
                "tilt that prism or change the field to move it away"
            )
            out.append(Ghost(channel, source, _reflecting_prism(family, nominal_events), text))
    return tuple(out)
