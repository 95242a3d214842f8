"""Ghosts and stray light on the area CCDs, added to the wave path's images.

The wave path's image (``twin.monitor.monitor_path``) holds the nominal family exactly. Every pinhole's light is
path-traced through the whole instrument, and the surfaces that a path met tell the nominal family from all others, so
that nothing is counted twice. The other light is geometric rays in pixels. It went through apertures of the same size
as the nominal spot's, and is spread by the nominal spot's diffraction image before it is added. Its interference with
the nominal light is left out.
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
from twin.monitor.monitor_beams import Aimed
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.monitor_path import MonitorPath
from twin.path_tracing.path_families import Event, Touch, family_name, nominal_codes
from twin.path_tracing.path_result import NOMINAL, Balance, Family, PathResult
from twin.path_tracing.source import DiskSource
from twin.path_tracing.tracer import CHUNK, FAINT, PathTracer, Progress, Sampling

CONE_ROOM = 1.25
"""Half angle of the source's cone relative to that of the pupil seen from the focal plane."""

AIM_RINGS = 6
NARROW_ROOM = 1.2
"""Room around the rays to the outermost of these rings of the return face: they end 3 % inside its edge."""


class NominalPathLost(PhysicalError, RuntimeError):
    """No path reached an area CCD by its nominal way, so that nothing can be normalised."""


@dataclass(frozen=True, eq=False)
class StrayResult:
    """Stray light of some monitor channels in one state.

    Attributes
    ----------
    photons : Mapping[str, np.ndarray]
        Area CCD (``<camera>/<channel>/area_ccd``) -> (rows, columns) expected photons per pixel and frame from all
        traced sources, without the nominal families.
    runs : Mapping[str, PathResult]
        Channel -> all that its source's light did.
    photons_per_power : Mapping[str, float]
        Channel -> photons per frame for a detected share 1 of the source's power.
    """

    photons: Mapping[str, np.ndarray]
    runs: Mapping[str, PathResult]
    photons_per_power: Mapping[str, float]

    def relative(self, channel: str) -> list[ListedFamily]:
        """Families of a channel's source at any detector, the strongest first."""
        run = self.runs[channel]
        nominal = run.nominal(f"{channel}/area_ccd")
        others = [(family, family.energy / nominal.energy) for family in run.families if family.kind != "nominal"]
        others.sort(key=lambda one: -one[1])
        # a path of the one is none of the other: the covariance of their energies is -1 / paths of the product
        own = (nominal.error / nominal.energy) ** 2 + 2.0 / run.paths
        sigmas = [share * float(np.sqrt((family.error / family.energy) ** 2 + own)) for family, share in others]
        return [ListedFamily(*one, sigma, nominal.touches) for one, sigma in zip(others, sigmas, strict=True)]


@dataclass(frozen=True, eq=False)
class ListedFamily:
    """A family beside the nominal one of its source.

    Attributes
    ----------
    family : Family
        which.
    share : float
        Its light over that of the nominal family at the source's own area CCD.
    sigma : float
        Of this share, by the number of paths.
    nominal : tuple[Touch, ...]
        Events of the nominal family.
    """

    family: Family
    share: float
    sigma: float
    nominal: tuple[Touch, ...]


def pinhole(
    instrument: Instrument,
    backend: Backend,
    state: State,
    channel: Channel,
    cone: float | None = None,
    aimed: Aimed | None = None,
) -> DiskSource:
    """The light source of a channel: its pinhole, evenly lit into a cone that covers the camera's pupil.

    Half of the paths are aimed at the return face.

    Parameters
    ----------
    instrument : Instrument
        The instrument.
    backend : Backend
        Where to aim.
    state : State
        What is perturbed.
    channel : Channel
        Which channel.
    cone : float | None
        Sine of the cone's half angle; by default that of the pupil with ``CONE_ROOM``.
    aimed : Aimed | None
        All channels' nominal rays to the return faces, by default worked out here.
    """
    placed = instrument.assembly.place([state])
    model = instrument.cameras[channel.camera]
    if cone is None:
        cone = CONE_ROOM * 0.5 * model.spec.entrance_pupil / model.line_principal_distance
    place = placed.pose(channel.reticle_body).translation
    axis = instrument.toward_optics(placed, channel.camera)[0]
    radius = 0.5 * instrument.spec.autocollimator.reticle.pinhole * float(placed.size(channel.reticle_body)[0])
    aimed = aimed or _nominal_rays(instrument, backend)
    number = instrument.channels.index(channel)
    return DiskSource.along(place, axis, radius, cone).aimed_at(aimed.direction[number], NARROW_ROOM)


def _nominal_rays(instrument: Instrument, backend: Backend) -> Aimed:
    """Rays from every pinhole to its return face in the unperturbed instrument."""
    return MonitorPath(instrument, backend, quadrature.disk(AIM_RINGS)).nominal


def monitor_families(scenery: Scenery, instrument: Instrument) -> dict[str, tuple[int, ...]]:
    """Area CCD -> events of its nominal family."""
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
        The instrument.
    backend : Backend
        Where to trace.
    state : State
        What is perturbed.
    paths : int
        Of every channel.
    seed : int
        Of the random numbers; the channels' are independent of each other.
    channels : Sequence[Channel] | None
        Which sources shine; by default all.
    finishes : Finishes | None
        What surfaces do with light.
    baffles : Iterable[Plate]
        What else stands there.
    sampling : Sampling
        How paths are drawn.
    cone : float | None
        Sine of the half angle into which the pinholes shine, see ``pinhole``.
    chunk : int
        Paths of one launch.
    progress : Progress | None
        Told the paths done, of all channels together.

    Raises
    ------
    NominalPathLost
        Too few paths, or the perturbation moves a beam off.
    """
    chosen = tuple(instrument.channels if channels is None else channels)
    scenery = build_scenery(instrument, state, finishes, baffles)
    tracer = PathTracer(backend, scenery, monitor_families(scenery, instrument), sampling)
    aimed = _nominal_rays(instrument, backend)
    ccd = instrument.spec.autocollimator.area_ccd
    photons = {f"{c.key}/area_ccd": np.zeros((ccd.rows, ccd.columns)) for c in instrument.channels}
    runs: dict[str, PathResult] = {}
    scale: dict[str, float] = {}
    for number, channel in enumerate(chosen):
        source = pinhole(instrument, backend, state, channel, cone, aimed)
        own = int(np.random.SeedSequence([seed, instrument.channels.index(channel)]).generate_state(1)[0])

        def tell(done: int, _: int, before: int = number) -> None:
            if progress is not None:
                progress(before * paths + done, len(chosen) * paths)

        run = tracer.run(source, paths, own, chunk=chunk, progress=tell, toward=f"{channel.key}/area_ccd")
        found = run.of(f"{channel.key}/area_ccd", "nominal")
        if not found:
            raise NominalPathLost(
                f"none of {paths} paths of {channel.key} came back to its area CCD by the nominal way; trace more, or "
                "the perturbation moves the beam off"
            )
        runs[channel.key] = run
        scale[channel.key] = channel.photons / found[0].energy
        for name, light in photons.items():
            every = run.images[name]
            light += scale[channel.key] * (every.sum(axis=0) - every[NOMINAL])
    return StrayResult(photons, runs, scale)


REACH = 88
"""Pixels from the middle of the diffraction image out to which stray light is spread."""

FAMILIES = 20
"""How many families of each source are listed, the strongest first."""

GHOSTS = 1e-3
"""Share of a spot's light above which ghosts on its area CCD are warned of: a pixel of motion reads wrong by 1e-3 px,
some times the centroid's noise."""


@dataclass(frozen=True, eq=False)
class StrayLight:
    """Stray light of one state.

    Attributes
    ----------
    photons : np.ndarray
        Expected photons per pixel and frame beside the nominal spot, (C, rows, columns).
    traced : StrayResult
        The path tracer's result.
    paths : int
        Traced for every source.
    """

    photons: np.ndarray
    traced: StrayResult
    paths: int

    def share(self, nominal: np.ndarray) -> np.ndarray:
        """Stray over nominal light of every area CCD, (C,)."""
        return np.asarray(self.photons.sum(axis=(1, 2)) / nominal.sum(axis=(1, 2)))

    def to_dict(self) -> dict[str, Any]:
        """Contents of stray.json: by source, the families at any detector and where the light went."""
        sources = {
            name: {"families": [*map(FAMILY, self.traced.relative(name)[:FAMILIES])], "balance": _BALANCE(run.balance)}
            for name, run in self.traced.runs.items()
        }
        return {"paths_per_source": self.paths, "sources": sources}


FAMILY: Record[ListedFamily] = Record(
    "All paths that reach a detector by the same events in the same order.",
    Quantity("detector", lambda one: one.family.detector, "where the paths end"),
    Quantity("kind", lambda one: one.family.kind, "ghost, or stray where something scatters or diffuses on the way"),
    Quantity("name", lambda one: family_name(one.family.touches, one.nominal), "in what it differs from nominal light"),
    Quantity("surfaces", lambda one: list(map(str, one.family.touches)), "in order"),
    Quantity("relative_to_nominal", lambda one: one.share, "its light over that of the source's spot", "share"),
    Quantity("relative_to_nominal_sigma", lambda one: one.sigma, "sigma by the number of paths", "its σ"),
    Quantity("paths", lambda one: one.family.count, "that were traced"),
    Quantity("x_um", lambda one: one.family.centroid[0], "centroid from the detector's middle"),
    Quantity("y_um", lambda one: one.family.centroid[1], "centroid from the detector's middle"),
    Quantity("rms_x_um", lambda one: one.family.rms[0], "size about the centroid"),
    Quantity("rms_y_um", lambda one: one.family.rms[1], "size about the centroid"),
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
        The instrument.
    state : State
        What is perturbed.
    paths : int
        Of every source.
    seed : int
        Of the random numbers.
    progress : Callable[[int, int], None] | None
        Told the paths done and in all.
    finishes : Finishes | None
        What surfaces do with light, None for the built-in ones.

    Raises
    ------
    NominalPathLost
        Too few paths, or the perturbation moves a beam off.
    """
    from scipy.signal import fftconvolve  # takes long, and most jobs trace no stray light

    instrument = experiment.instrument
    traced = trace_stray(instrument, experiment.backend, state, paths, seed, finishes=finishes, progress=progress)
    spots = diffraction_spots(experiment)
    raw = np.stack([traced.photons[f"{c.key}/area_ccd"] for c in experiment.path.channels])
    spread = np.stack([fftconvolve(light, spot, mode="same") for light, spot in zip(raw, spots, strict=True)])
    return StrayLight(np.maximum(spread, 0.0), traced, paths)  # the transform leaves rounding below zero


def diffraction_spots(experiment: MonitorExperiment) -> np.ndarray:
    """Every channel's diffraction image about its middle, of unit sum, (C, 2 REACH + 1, 2 REACH + 1)."""
    path = experiment.path
    grid = Grid(-REACH * path.pitch, path.pitch, 2 * REACH + 1)
    spots = image(path.fields([{}]), grid, grid, single=True).astype(np.float64)
    return np.asarray(spots / spots.sum(axis=(1, 2), keepdims=True))


@dataclass(frozen=True)
class Ghost:
    """Ghosts on one area CCD that have more than GHOSTS of its own spot's light.

    Attributes
    ----------
    channel : Channel
        Whose area CCD it is.
    source : str
        Channel that the strongest comes from, ``<camera>/<channel>``.
    body : str | None
        Path of the prism that throws it, the first whose face reflects what it should let pass; None where it comes
        from nothing but nominal surfaces in another order.
    text : str
        All in words.
    """

    channel: Channel
    source: str
    body: str | None
    text: str


def ghost_warnings(experiment: MonitorExperiment, light: StrayLight) -> tuple[str, ...]:
    """One warning for each area CCD on which ghosts of any source have more than GHOSTS of its own spot's light."""
    return tuple(ghost.text for ghost in ghosts(experiment, light))


def _thrower(family: Family, usual: tuple[Touch, ...]) -> str | None:
    known = {(touch.part, touch.event) for touch in usual}
    for touch in family.touches:
        prism = prism_of(touch.part)
        if prism is not None and touch.event == Event.REFLECT and (touch.part, touch.event) not in known:
            return f"{touch.part.partition(f'/{prism}/')[0]}/{prism}"
    return None


def ghosts(experiment: MonitorExperiment, light: StrayLight) -> tuple[Ghost, ...]:
    """Area CCDs on which ghosts of any source have more than GHOSTS of their own spot's light.

    Parameters
    ----------
    experiment : MonitorExperiment
        The monitor.
    light : StrayLight
        traced.
    """
    out, traced = [], light.traced
    for channel in experiment.path.channels:
        name = f"{channel.key}/area_ccd"
        own = traced.runs[channel.key].nominal(name)
        found = [
            (traced.photons_per_power[source] * family.energy / channel.photons, source, family)
            for source, run in traced.runs.items()
            for family in run.families
            if family.detector == name and family.kind == "ghost"
        ]
        total = sum(share for share, _, _ in found)
        if total > GHOSTS:
            share, source, family = max(found, key=lambda one: one[0])
            off = np.hypot(*np.subtract(family.centroid, own.centroid)) / experiment.path.pitch
            usual = traced.runs[source].nominal(f"{source}/area_ccd").touches
            text = (
                f"ghosts on the area CCD of {channel.key} have {100.0 * total:.2g} % of its spot's light and pull the "
                f"spot by that share of what it moves and they do not; the strongest, {100.0 * share:.2g} %, comes "
                f"from {source} by {family_name(family.touches, usual)}, {off:.3g} px from the spot: another tilt of "
                "that prism, or another field, leads it aside"
            )
            out.append(Ghost(channel, source, _thrower(family, usual), text))
    return tuple(out)
