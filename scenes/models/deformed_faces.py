"""Mirrors and faces that finite-element programs deformed: their nodes in the bodies' frames, and what they come to."""

from __future__ import annotations

from optics.geometry.aperture import Aperture
from optics.geometry.pose import Pose
from optics.geometry.surface import Surface
from optics.raytrace.assembly import Interaction
from optics.thermal.nodal_deformation import NodalDeformation, NodesError, nodal_deformation
from scenes.models.instrument_model import Instrument
from scenes.specs.job import JobSpec
from scenes.specs.job_tables import DeformationSpec
from scenes.yaml.errors import KeyPath, names_text, nearest
from scenes.yaml.node_table import read_nodes


def deformed_face(instrument: Instrument, job: JobSpec, path: str, spec: DeformationSpec) -> NodalDeformation:
    """What a job's table does to one body.

    Args:
        instrument: the instrument.
        job: that names the table, for what is wrong.
        path: of the body, which has a reflecting or refracting surface.
        spec: the table, as ``scenes.specs.job.with_tables`` has left it.

    Raises:
        InputError: no such frame; nodes that are not on the surface or do not cover it.
    """
    key = ("perturb", path, "deformation")
    surface, aperture = _face(instrument, path)
    nodes = read_nodes(spec.table, spec.unit, spec.field, spec.sha256)
    pose = pose_of_frame(instrument, job, key, path, spec.frame)
    points, moves = pose.apply(nodes.points), nodes.moves @ pose.rotation.T
    try:
        return nodal_deformation(points, moves, surface, aperture, spec.terms)
    except NodesError as error:
        text = f"{spec.table} does not describe {path}: {error}"
        raise job.error(text, (*key, "table"), allowed=error.allowed) from error


def pose_of_frame(instrument: Instrument, job: JobSpec, key: KeyPath, path: str, frame: str | None) -> Pose:
    """Where the nominal frame in which a table is told stands in that of the body.

    Args:
        instrument: the instrument.
        job: that names the table, for what is wrong.
        key: of the table's specification in there.
        path: of the body.
        frame: path of the body in whose frame the nodes are told, None for its own.

    Raises:
        InputError: no such frame.
    """
    if frame is None:
        return Pose()
    known = instrument.assembly.tree.paths
    if frame not in known:
        raise job.error(
            "no such node",
            (*key, "frame"),
            found=frame,
            allowed=names_text(sorted(known)),
            suggestion=nearest(frame, known),
        )
    placed = instrument.assembly.place()
    return placed.pose(path).inverse() @ placed.pose(frame)


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
