"""View of a camera in three dimensions: a still image for the report, a page that turns it, and its scene."""

from __future__ import annotations

from collections.abc import Mapping

from markupsafe import Markup

from optics.numerics.array_math import PhysicalError
from twin.camera.camera_run import CameraRun
from twin.framework.artefact import Artefact, Piece, PngFigure, Undrawn
from twin.pictures.light_paths import trace_light_paths
from twin.pictures.picture_scene import still_png
from twin.pictures.scene_file import TUBE, scene_bytes, viewer_page

TITLE = "In three dimensions"

_IMAGE = '<div class="card"><img src="{0}" alt="{1}"></div>'
_FIGURE = (
    '<h3>{0}</h3>\n<figure><a href="view.html">{1}</a>\n<figcaption>Mirrors and lenses with their clear apertures, and '
    'beams of the middle and both ends of the line. <a href="view.html">view.html</a> turns with the mouse; '
    '<a href="scene.glb">scene.glb</a> is the same scene for other programs.</figcaption></figure>'
)


def solid_view(run: CameraRun) -> tuple[Artefact, Mapping[str, bytes]]:
    """Return the figure of a camera in its state, and the contents of view.html and scene.glb by name.

    A camera through which no light finds its way from the ends of the line has a note in place of the figure, and no
    files.
    """
    state, length = run.optics.state, run.first_order.length
    tube = min(TUBE, 6e-4 * length)
    try:
        instrument = run.instrument
        paths = trace_light_paths(instrument, run.optics.path.backend, state, length)
    except PhysicalError as error:
        return Undrawn("view", TITLE, "", f"{type(error).__name__}: {error}"), {}
    scene = scene_bytes(instrument, state, paths, tube)
    still = PngFigure("view", TITLE, "", still_png(instrument, paths))
    image = Markup(_IMAGE).format(still.address, f"{run.setup.title} {TITLE.lower()}")
    moved = run.perturbed.words if run.perturbed is not None else ""
    page = viewer_page(f"Camera {run.setup.title}", scene, moved, image)
    return (
        Piece("view", "", "", Markup(_FIGURE).format(TITLE, image), within=""),
        {"view.html": page.encode(), "scene.glb": scene},
    )
