"""Pictures of the instrument itself, rendered with Mitsuba: ``python -m twin.render job.yaml --picture``.

``picture.png`` shows both cameras, ``picture_prisms.png`` the central prism and what is next to it, and
``picture_focal_plane.png`` the detectors of the first camera. They are for looking at, not for measuring: lines of
light are drawn a few pixels thick, and the room is a photographer's studio.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from optics.backend import Backend
from optics.tree import State
from scenes.channel import BASE, CENTRAL_PRISM
from scenes.instrument_model import Instrument
from twin.light_paths import LightPaths, trace_light_paths
from twin.picture_clean import displayed, still_patches, without_grain
from twin.picture_light import PictureError, Studio, colour_variant
from twin.picture_scene import Part, points_in_world, studio_parts
from twin.picture_view import View, framed
from twin.scene_file import build_scene

PICTURE = "render the pictures"
"""Name of the work in the progress display."""

LOOKS = ((0.0, 0.0), (-0.35, -0.25), (0.35, 0.25))
"""Where in a pixel it is looked at to find out whether it shows one thing only, pixels from its middle."""

Advance = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Shot:
    """One picture.

    Attributes:
        name: of the file.
        width, height: pixels.
        coarse, fine: samples per pixel, of matt surfaces (which are smoothed) and of all else.
        shows: ``instrument``, ``prisms`` or ``focal_plane``.
    """

    name: str
    width: int
    height: int
    coarse: int
    fine: int
    shows: str


SHOTS = (
    Shot("picture.png", 1600, 1000, 8, 48, "instrument"),
    Shot("picture_prisms.png", 1200, 750, 8, 64, "prisms"),
    Shot("picture_focal_plane.png", 1200, 500, 8, 32, "focal_plane"),
)


def write_pictures(
    instrument: Instrument,
    backend: Backend,
    state: State,
    write: Callable[[str, Callable[[Path], None]], None],
    seed: int = 0,
    advance: Advance = lambda part, done, total: None,
    shots: tuple[Shot, ...] = SHOTS,
) -> None:
    """Render the pictures of an instrument in a perturbed state and hand them over as PNG files.

    Args:
        instrument: the instrument.
        backend: where to trace.
        state: what is perturbed; motions are far too small to be seen.
        write: takes the name of a file and what writes it, e.g. ``RunFolder.write_with``.
        seed: of the samples.
        advance: told how many percent of all pictures are done.
        shots: which pictures.

    Raises:
        PictureError: Mitsuba cannot run the variant that the pictures need, or fails.
    """
    paths = trace_light_paths(instrument, backend, state)
    pixels = [shot.width * shot.height for shot in shots]
    for k, shot in enumerate(shots):
        before, own = sum(pixels[:k]) / sum(pixels), pixels[k] / sum(pixels)

        def say(share: float, before: float = before, own: float = own) -> None:
            advance(PICTURE, round(100.0 * (before + own * share)), 100)

        image = render_shot(instrument, paths, backend, shot, seed, say)
        write(shot.name, partial(_save, image))


def _save(image: np.ndarray, place: Path) -> None:
    ok, encoded = cv2.imencode(".png", image[..., ::-1])
    if not ok:
        raise PictureError(f"{place.name} cannot be encoded as PNG")
    place.write_bytes(encoded.tobytes())


def render_shot(
    instrument: Instrument,
    paths: LightPaths,
    backend: Backend,
    shot: Shot,
    seed: int = 0,
    advance: Callable[[float], None] = lambda share: None,
) -> np.ndarray:
    """One picture, (height, width, 3) uint8, red first.

    Raises:
        PictureError: Mitsuba cannot run the variant that the pictures need, or fails.
    """
    view, parts = staged(instrument, paths, shot)
    with colour_variant(backend) as mi:
        studio = Studio(mi, parts, view)
        seen = [studio.first_hits(x, y) for x, y in LOOKS]
        patches = still_patches(seen, [part.matt for part in parts])
        plain = np.flatnonzero(patches >= 0)
        busy = np.flatnonzero(patches < 0)
        work = len(plain) * shot.coarse + len(busy) * shot.fine
        image = np.zeros((shot.height * shot.width, 3))
        done = 0
        for pixels, samples in ((plain, shot.coarse), (busy, shot.fine)):
            for chosen in studio.chunks(pixels, samples):
                image[chosen] = studio.light(chosen, samples, seed)
                done += len(chosen) * samples
                advance(done / work)
    return displayed(without_grain(image.reshape(shot.height, shot.width, 3), patches))


def which_body(instrument: Instrument, paths: LightPaths, backend: Backend, shot: Shot) -> tuple[np.ndarray, list[str]]:
    """What the middle of every pixel shows first: (height, width) number into the list of bodies, -1 for nothing.

    Raises:
        PictureError: as for ``render_shot``.
    """
    view, parts = staged(instrument, paths, shot)
    with colour_variant(backend) as mi:
        index, _ = Studio(mi, parts, view).first_hits(0.0, 0.0)
    return index, [part.body for part in parts]


def staged(instrument: Instrument, paths: LightPaths, shot: Shot) -> tuple[View, list[Part]]:
    """Where the camera of a picture stands, and all that it may see."""
    points = points_in_world(build_scene(instrument, paths))
    if shot.shows == "instrument":
        wanted, (azimuth, elevation, field) = list(points), (-66.0, 24.0, 28.0)
    elif shot.shows == "prisms":
        wanted = [name for name in points if name.startswith(CENTRAL_PRISM) or name.endswith("prism_0")]
        azimuth, elevation, field = -66.0, 24.0, 24.0
    else:
        plane = f"{BASE}/{next(iter(instrument.cameras))}/focal_plane"
        wanted = [name for name in points if name.startswith(plane)]
        # into the housing, against the light, a little from the side
        x, y, z = -paths.placed.pose(plane).rotation[:, 2]
        azimuth = float(np.degrees(np.arctan2(y, x))) + 12.0
        elevation = float(np.degrees(np.arctan2(z, np.hypot(x, y)))) + 5.0
        field = 24.0
    shown = np.concatenate([points[name] for name in wanted])
    view = framed(shown, azimuth, elevation, field, (shot.width, shot.height))
    return view, studio_parts(instrument, paths, view.pixel_at(shown))
