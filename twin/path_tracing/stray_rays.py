"""Stray light of the monitor: what the area CCDs get by other ways than the nominal one, in photons per pixel.

The wave path's image (``twin.monitor.monitor_path``) holds the nominal family exactly. Here every pinhole's light is
path-traced through the whole instrument, the nominal family is told apart by the surfaces it met, and all the rest can
be added to the wave path's image: nothing is counted twice.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from optics.geometry.tree import State
from optics.numerics import quadrature
from optics.numerics.backend import Backend
from optics.numerics.physical_error import PhysicalError
from scenes.models.instrument_model import Instrument
from scenes.models.scenery import Scenery, build_scenery
from scenes.models.scenery_parts import Finishes
from scenes.specs.baffle import Plate
from scenes.specs.instrument import Channel
from twin.monitor.monitor_beams import Aimed
from twin.monitor.monitor_path import MonitorPath
from twin.path_tracing.families import nominal_codes
from twin.path_tracing.path_result import Family, PathResult
from twin.path_tracing.sinks import NOMINAL
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

    Attributes:
        photons: area CCD (``<camera>/<side>/area_ccd``) -> (rows, columns) expected photons per pixel and frame from
            all traced sources, without the nominal families.
        runs: channel -> all that its source's light did.
        photons_per_power: channel -> photons per frame for a detected share 1 of the source's power.
    """

    photons: Mapping[str, np.ndarray]
    runs: Mapping[str, PathResult]
    photons_per_power: Mapping[str, float]

    def relative(self, channel: str) -> tuple[tuple[Family, float, float], ...]:
        """Families of a channel's source at any detector, each with its energy relative to the nominal family's and the
        standard deviation of that by the number of paths.
        """
        run = self.runs[channel]
        nominal = run.nominal(f"{channel}/area_ccd")
        others = [(family, family.energy / nominal.energy) for family in run.families if family.kind != "nominal"]
        # a path of the one is none of the other: the covariance of their energies is -1 / paths of the product
        own = (nominal.error / nominal.energy) ** 2 + 2.0 / run.paths
        return tuple(
            (family, share, share * float(np.sqrt((family.error / family.energy) ** 2 + own)))
            for family, share in others
        )


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

    Args:
        instrument: the instrument.
        backend: where to aim.
        state: what is perturbed.
        channel: which channel.
        cone: sine of the cone's half angle; by default that of the pupil with ``CONE_ROOM``.
        aimed: all channels' nominal rays to the return faces, by default worked out here.
    """
    placed = instrument.assembly.place([state])
    model = instrument.cameras[channel.camera]
    if cone is None:
        cone = CONE_ROOM * 0.5 * model.spec.entrance_pupil / model.line_focal_length
    place = placed.pose(channel.reticle_body).translation
    axis = instrument.toward_optics(placed, channel.camera)[0]
    radius = 0.5 * instrument.spec.monitor.reticle.pinhole * float(placed.size(channel.reticle_body)[0])
    aimed = aimed or nominal_rays(instrument, backend)
    number = instrument.channels.index(channel)
    return DiskSource.along(place, axis, radius, cone).aimed_at(aimed.direction[number], NARROW_ROOM)


def nominal_rays(instrument: Instrument, backend: Backend) -> Aimed:
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

    Args:
        instrument: the instrument.
        backend: where to trace.
        state: what is perturbed.
        paths: of every channel.
        seed: of the random numbers; the channels' are independent of each other.
        channels: which sources shine; by default all.
        finishes: what surfaces do with light.
        baffles: what else stands there.
        sampling: how paths are drawn.
        cone: sine of the half angle into which the pinholes shine, see ``pinhole``.
        chunk: paths of one launch.
        progress: told the paths done, of all channels together.

    Raises:
        NominalPathLost: too few paths, or the perturbation moves a beam off.
    """
    chosen = tuple(instrument.channels if channels is None else channels)
    scenery = build_scenery(instrument, state, finishes, baffles)
    tracer = PathTracer(backend, scenery, monitor_families(scenery, instrument), sampling)
    aimed = nominal_rays(instrument, backend)
    ccd = instrument.spec.monitor.area_ccd
    photons = {f"{c.key}/area_ccd": np.zeros((ccd.rows, ccd.columns)) for c in instrument.channels}
    runs: dict[str, PathResult] = {}
    scale: dict[str, float] = {}
    for number, channel in enumerate(chosen):
        source = pinhole(instrument, backend, state, channel, cone, aimed)
        own = int(np.random.SeedSequence([seed, instrument.channels.index(channel)]).generate_state(1)[0])

        def tell(done: int, _: int, before: int = number) -> None:
            if progress is not None:
                progress(before * paths + done, len(chosen) * paths)

        run = tracer.run(source, paths, own, chunk=chunk, progress=tell)
        found = run.of(f"{channel.key}/area_ccd", "nominal")
        if not found:
            raise NominalPathLost(
                f"none of {paths} paths of {channel.key} came back to its area CCD by the nominal way; trace more, or "
                "the perturbation moves the beam off"
            )
        runs[channel.key] = run
        scale[channel.key] = channel.photons / found[0].energy
        for name, image in photons.items():
            every = run.images[name]
            image += scale[channel.key] * (every.sum(axis=0) - every[NOMINAL])
    return StrayResult(photons, runs, scale)
