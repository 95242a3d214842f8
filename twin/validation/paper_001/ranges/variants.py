"""Variants of a monitored instrument: one camera only, a larger area CCD, other sub-apertures, fields and returns."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from optics.assembly import Assembly
from optics.backend import Backend
from optics.element import Element, Interaction
from optics.frozen_map import FrozenMap
from optics.pose import Pose
from optics.rotation import about_axis
from optics.surface import plane
from optics.tree import Body, RigidTree
from scenes.instrument_model import Instrument
from scenes.resolved import ResolvedJob
from twin.experiment import MonitorExperiment
from twin.monitor import MonitorPath

RETURNS = ("plane", "roof", "roof along", "corner")
"""Kinds of return: a mirror facet; a roof whose ridge lies across the line, or along it; a corner cube."""


def variant(
    resolved: ResolvedJob,
    backend: Backend,
    camera: str,
    pixels: int | None = None,
    pupil_offset: tuple[float, float] | None = None,
    field: float | None = None,
    ccd_offset: tuple[float, float] | None = None,
) -> MonitorExperiment:
    """The experiment with one camera of an instrument, changed and built anew.

    Args:
        resolved: the instrument as its file gives it.
        backend: where to trace.
        camera: the camera that is kept.
        pixels: rows and columns of the area CCDs.
        pupil_offset: centre (X, Y) of the monitor's sub-aperture in the entrance pupil, metres.
        field: of the area CCDs, radians.
        ccd_offset: (X, Y) from the pinhole to the area CCD's centre, metres.

    Raises:
        InputError: the prisms cannot stand so.
    """
    spec = resolved.instrument
    site = spec.cameras[camera]
    if pupil_offset is not None:
        site = site.model_copy(update={"pupil_offset": pupil_offset})
    of_ccd: dict[str, Any] = {} if pixels is None else {"rows": pixels, "columns": pixels}
    if ccd_offset is not None:
        of_ccd["offset"] = ccd_offset
    of_monitor: dict[str, Any] = {"area_ccd": spec.monitor.area_ccd.model_copy(update=of_ccd)}
    if field is not None:
        of_monitor["field"] = field
    changed = {
        "cameras": FrozenMap({camera: site}),
        "monitor": spec.monitor.model_copy(update=of_monitor),
        "baffles": FrozenMap({}),
    }
    return MonitorExperiment(resolved.model_copy(update={"instrument": spec.model_copy(update=changed)}), backend)


def with_return(experiment: MonitorExperiment, kind: str) -> MonitorExperiment:
    """The experiment with another kind of return, in place; call it before anything is rendered.

    The facet becomes an opening of the same size, behind which two or three mirrors stand square to each other and
    meet in its middle. Rays meet them in one order; the other orders give the same ray, as turns by half a turn do not
    depend on theirs.

    Args:
        experiment: newly built.
        kind: of RETURNS.

    Raises:
        ValueError: it is no such kind.
    """
    if kind not in RETURNS:
        raise ValueError(f"no return {kind!r}; there are {', '.join(RETURNS)}")
    if kind != "plane":
        instrument = experiment.instrument
        experiment.instrument = replace(instrument, assembly=_returning(instrument, kind))
        experiment.path = MonitorPath(experiment.instrument, experiment.backend)
    return experiment


def _returning(instrument: Instrument, kind: str) -> Assembly:
    """The assembly with mirrors square to each other behind every facet's opening."""
    old = instrument.assembly
    bodies, elements, sequences = list(old.tree.bodies), dict(old.elements), dict(old.sequences)
    for channel in instrument.channels:
        name = f"{channel.key}/return_face"
        elements[name] = replace(old.elements[name], interaction=Interaction.PASS)
        added = []
        for k, pose in enumerate(_mirrors(kind)):
            body, mirror = Body(f"{channel.face_body}/mirror_{k}", pose), f"{name}/mirror_{k}"
            bodies.append(body)
            elements[mirror] = Element(mirror, body.path, plane(), Interaction.REFLECT)
            added.append(mirror)
        way = old.sequences[f"{channel.key}/monitor"]
        at = way.index(name)
        sequences[f"{channel.key}/monitor"] = (*way[: at + 1], *added, *way[at + 1 :])
    return Assembly(RigidTree(tuple(bodies)), elements, sequences, old.media)


def _mirrors(kind: str) -> list[Pose]:
    """Poses of the mirrors in the facet's frame (x along the line, y across it, z to the light)."""
    if kind.startswith("roof"):
        ridge = 1 if kind == "roof" else 0
        return [Pose(about_axis(ridge, side * math.pi / 4)) for side in (1.0, -1.0)]
    lean = math.acos(1.0 / math.sqrt(3.0))  # of a cube's faces to its diagonal
    return [Pose(about_axis(2, 2.0 * math.pi * k / 3.0) @ about_axis(0, lean)) for k in range(3)]
