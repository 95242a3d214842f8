"""Mirrors and faces that finite-element programs deformed: their nodes in the bodies' frames, and what they come to."""

from __future__ import annotations

from optics.geometry.aperture import Aperture
from optics.geometry.surface import Surface
from optics.raytrace.assembly import Interaction
from optics.thermal.nodal_deformation import NodalDeformation, NodesError, nodal_deformation
from scenes.models.instrument_model import Instrument
from scenes.specs.job import DeformationSpec, JobSpec
from scenes.yaml.errors import names_text, nearest
from scenes.yaml.node_table import read_nodes


def deformed_face(instrument: Instrument, job: JobSpec, path: str, spec: DeformationSpec) -> NodalDeformation:
    """What a job's table does to one body.

    Args:
        instrument: the instrument.
        job: that names the table, for what is wrong.
        path: of the body, which has a reflecting or refracting surface.
        spec: the table, as ``scenes.specs.job.with_deformations`` has left it.

    Raises:
        InputError: no such frame; nodes that are not on the surface or do not cover it.
    """
    key = ("perturb", path, "deformation")
    surface, aperture = _face(instrument, path)
    nodes = read_nodes(spec.table, spec.unit, spec.field, spec.sha256)
    points, moves = nodes.points, nodes.moves
    if spec.frame is not None:
        known = instrument.assembly.tree.paths
        if spec.frame not in known:
            raise job.error(
                "no such node",
                (*key, "frame"),
                found=spec.frame,
                allowed=names_text(sorted(known)),
                suggestion=nearest(spec.frame, known),
            )
        placed = instrument.assembly.place()
        pose = placed.pose(path).inverse() @ placed.pose(spec.frame)
        points, moves = pose.apply(points), moves @ pose.rotation.T
    try:
        return nodal_deformation(points, moves, surface, aperture, spec.terms)
    except NodesError as error:
        text = f"{spec.table} does not describe {path}: {error}"
        raise job.error(text, (*key, "table"), allowed=error.allowed) from error


def _face(instrument: Instrument, path: str) -> tuple[Surface, Aperture]:
    """Shape and clear aperture of a body's optical surface, the widest where several elements use it."""
    own = [
        e
        for e in instrument.assembly.elements.values()
        if e.body == path and e.aperture is not None and e.interaction is not Interaction.PASS
    ]
    widest = max(own, key=lambda e: _area(e.aperture))
    assert widest.aperture is not None
    return widest.surface, widest.aperture


def _area(aperture: Aperture | None) -> float:
    if aperture is None:
        return 0.0
    x0, x1, y0, y1 = aperture.bounds
    return (x1 - x0) * (y1 - y0)
