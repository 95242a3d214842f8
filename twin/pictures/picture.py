"""Pictures of an instrument, rendered by Mitsuba and cleaned of noise.

Pixels are sampled one list at a time, not picture by picture: those on matt surfaces need few samples, glass many.
Every pixel's samples are averaged in a fixed order, so that a seed gives the same picture again.

``picture.png`` shows both cameras, ``picture_prisms.png`` the central prism and what is next to it, and
``picture_focal_plane.png`` the detectors of the first camera. They are for looking at, not for measuring: lines of
light are drawn a few pixels thick, and the room is a photographer's studio.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from optics.geometry.tree import State
from optics.numerics.backend import Backend
from scenes.models.instrument_model import Instrument
from scenes.specs.instrument import BASE, CENTRAL_PRISM, PRISM_0, prism_of
from twin.pictures.light_paths import LightPaths, trace_light_paths
from twin.pictures.picture_scene import Part, View, framed, load_studio, points_in_world, studio_parts
from twin.pictures.scene_file import build_scene

VARIANTS = {"llvm": "llvm_ad_rgb", "cuda": "cuda_ad_rgb"}
"""Mitsuba's variant with colour that a backend's machine can run."""
AT_ONCE = 4_000_000
"""Paths between two looks at the keyboard."""
BRIGHTEST = 4.0
"""Samples are cut here: one path that finds a lamp through glass must not leave a white dot."""
DEPTH = 14
"""Longest path, in segments: light crosses two prisms and more."""
SOFT = 0.75
"""Half width of the tent that a pixel averages over, pixels."""


class PictureError(RuntimeError):
    """The pictures cannot be made; the message says why."""


@contextmanager
def colour_variant(backend: Backend) -> Iterator[Any]:
    """Mitsuba with its colour variant; the one that was set before is set again afterwards.

    Raises
    ------
    PictureError
        The variant cannot be set (another one is never taken), or Mitsuba fails.
    """
    import mitsuba as mi  # after optics, which has named the LLVM library

    variant, before = VARIANTS[backend.name], mi.variant()
    try:
        _set_variant(mi, variant)
        yield mi
    except PictureError:
        raise
    except (RuntimeError, MemoryError) as error:
        raise PictureError(f"mitsuba {mi.__version__} ({variant}) failed: {error}") from error
    finally:
        if before is not None:
            mi.set_variant(before)


def _set_variant(mi: Any, variant: str) -> None:
    try:
        mi.set_variant(variant)
    except (ImportError, AttributeError) as error:
        raise PictureError(f"mitsuba {mi.__version__} cannot run its variant {variant}: {error}") from error
    if mi.variant() != variant:
        raise PictureError(f"mitsuba runs its variant {mi.variant()} where {variant} is needed")


class Studio:
    """A scene and a camera in Mitsuba.

    Parameters
    ----------
    mi
        Mitsuba with its colour variant set.
    parts
        What stands in the studio.
    view
        The camera.
    """

    def __init__(self, mi: Any, parts: list[Part], view: View) -> None:
        import drjit as dr

        self._mi, self._view = mi, view
        self._scene, self._sensor = load_studio(mi, parts, view), _sensor(mi, view)
        self._integrator = mi.load_dict({"type": "path", "max_depth": DEPTH, "rr_depth": 6})
        numbers = [int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0]) for shape in self._scene.shapes()]
        self._part_of = np.full(max(numbers) + 1, -1)  # Dr.Jit's number of a shape -> number of the part
        self._part_of[numbers] = np.arange(len(parts))

    def chunks(self, pixels: np.ndarray, samples: int) -> Iterator[np.ndarray]:
        """Pixels in groups that are quickly done."""
        size = max(1, AT_ONCE // samples)
        for start in range(0, len(pixels), size):
            yield pixels[start : start + size]

    def light(self, pixels: np.ndarray, samples: int, seed: int) -> np.ndarray:
        """Mean light in pixels, (N, 3).

        Parameters
        ----------
        pixels : np.ndarray
            Row times width plus column, (N,).
        samples : int
            Per pixel.
        seed : int
            Of the samples.
        """
        mi = self._mi
        every = np.repeat(pixels, samples)
        sampler = mi.load_dict({"type": "independent"})
        mixed = np.random.SeedSequence([seed, samples, int(pixels[0])]).generate_state(1)
        sampler.seed(int(mixed[0]), len(every))
        offset = SOFT * mi.warp.square_to_tent(sampler.next_2d())
        ray = self._rays(every, offset.x, offset.y)
        light, _, _ = self._integrator.sample(self._scene, sampler, ray)
        values = np.minimum(np.asarray(light.numpy()), BRIGHTEST)
        return np.asarray(values.reshape(3, len(pixels), samples).mean(axis=2, dtype=float).T)

    def first_hits(self, x: float, y: float) -> tuple[np.ndarray, np.ndarray]:
        """Number of the part that every pixel shows first, -1 for none (H, W), and the normal there, (H, W, 3).

        Parameters
        ----------
        x : float
            Where in the pixel, pixels from its middle.
        y : float
            likewise.
        """
        import drjit as dr

        mi, size = self._mi, (self._view.height, self._view.width)
        ray = self._rays(np.arange(size[0] * size[1]), mi.Float(x), mi.Float(y))
        hit = self._scene.ray_intersect(ray)
        found = dr.select(hit.is_valid(), dr.reinterpret_array(mi.UInt32, hit.shape), 0)
        return self._part_of[found.numpy()].reshape(size), hit.sh_frame.n.numpy().T.reshape(*size, 3)

    def _rays(self, pixels: np.ndarray, x: Any, y: Any) -> Any:
        """Rays through pixels, from their middle off by x, y."""
        mi, view = self._mi, self._view
        row, column = np.divmod(pixels, view.width)
        place = mi.Point2f(
            (mi.Float(column.astype(np.float32) + 0.5) + x) / view.width,
            (mi.Float(row.astype(np.float32) + 0.5) + y) / view.height,
        )
        ray, _ = self._sensor.sample_ray_differential(mi.Float(0.0), mi.Float(0.5), place, mi.Point2f(0.5, 0.5))
        return ray


def _sensor(mi: Any, view: View) -> Any:
    look = mi.ScalarTransform4f().look_at(
        origin=view.eye.tolist(), target=(view.eye + view.forward).tolist(), up=view.up.tolist()
    )
    return mi.load_dict(
        {
            "type": "perspective",
            "fov": view.horizontal_field,
            "fov_axis": "x",
            "near_clip": 0.01,
            "far_clip": 1e4,
            "to_world": look,
            "film": {"type": "hdrfilm", "width": view.width, "height": view.height},
        }
    )


BLUR, BLUR_SHARE = (6.0, 16.0), 0.025
"""Over how many pixels the light on a flat patch is averaged: limits, and share of the root of its area."""
EXPOSURE = 0.88
SHOULDER = 0.75
"""Exposed light above this is compressed, so that nothing is burnt out."""


def still_patches(seen: Sequence[tuple[np.ndarray, np.ndarray]], matt: Sequence[bool]) -> np.ndarray:
    """Numbers of the flat patches of matt surfaces, (H, W); -1 on their borders and everywhere else.

    Parameters
    ----------
    seen : Sequence[tuple[np.ndarray, np.ndarray]]
        Some looks at the scene: number of the part (H, W), -1 for none, and normal (H, W, 3).
    matt : Sequence[bool]
        Of every part, whether the light on it changes slowly.
    """
    first, square = _patches(*seen[0]), np.ones((3, 3), np.uint8)
    still = np.array([*matt, False])[seen[0][0]]
    for part, normal in seen:  # a border is a pixel that shows two things in any look, and its neighbours
        patches = _patches(part, normal)
        still &= (patches == first) & (cv2.dilate(patches, square) == cv2.erode(patches, square))
    return np.where(still, first, -1.0).astype(np.int64)


def without_grain(image: np.ndarray, patches: np.ndarray) -> np.ndarray:
    """Average the light over each patch; what belongs to none stays as it is.

    Parameters
    ----------
    image : np.ndarray
        (H, W, 3) rendered light.
    patches : np.ndarray
        (H, W) numbers, -1 for none.
    """
    out = image.astype(np.float32)
    for value in np.unique(patches[patches >= 0]):
        mask = patches == value
        blur = float(np.clip(BLUR_SHARE * np.sqrt(mask.sum()), *BLUR))
        margin = int(3.0 * blur)
        rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        window = np.s_[max(rows[0] - margin, 0) : rows[-1] + margin, max(columns[0] - margin, 0) : columns[-1] + margin]
        weight = mask[window].astype(np.float32)
        light = cv2.GaussianBlur(image[window].astype(np.float32) * weight[..., None], (0, 0), blur)
        share = cv2.GaussianBlur(weight, (0, 0), blur)
        out[window][mask[window]] = (light / np.maximum(share, 1e-6)[..., None])[mask[window]]
    return out


def displayed(light: np.ndarray) -> np.ndarray:
    """Light -> sRGB grey values, uint8."""
    x = np.clip(EXPOSURE * light, 0.0, None)
    room = 1.0 - SHOULDER
    x = np.where(x > SHOULDER, SHOULDER + room * -np.expm1(-(x - SHOULDER) / room), x)
    grey = np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1.0 / 2.4) - 0.055)
    return np.asarray(np.rint(255.0 * np.clip(grey, 0.0, 1.0)), dtype=np.uint8)


def _patches(part: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """A number for every part and direction of its surface, float32 (H, W); exact for up to 16000 parts."""
    steps = np.rint(4.0 * normal).astype(int) + 5
    return (part * 1000 + steps @ np.array([1, 10, 100])).astype(np.float32)


PICTURE = "render the pictures"
"""Name of the work in the progress display."""

LOOKS = ((0.0, 0.0), (-0.35, -0.25), (0.35, 0.25))
"""Where in a pixel it is looked at to find out whether it shows one thing only, pixels from its middle."""

Advance = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Shot:
    """One picture.

    Attributes
    ----------
    name : str
        Of the file.
    width, height : int
        pixels.
    coarse, fine : int
        Samples per pixel, of matt surfaces (which are smoothed) and of all else.
    shows : str
        ``instrument``, ``prisms`` or ``focal_plane``.
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

    Parameters
    ----------
    instrument : Instrument
        The instrument.
    backend : Backend
        Where to trace.
    state : State
        What is perturbed; motions are far too small to be seen.
    write : Callable[[str, Callable[[Path], None]], None]
        Takes the name of a file and what writes it, e.g. ``RunFolder.write_with``.
    seed : int
        Of the samples.
    advance : Advance
        Told how many percent of all pictures are done.
    shots : tuple[Shot, ...]
        Which pictures.

    Raises
    ------
    PictureError
        Mitsuba cannot run the variant that the pictures need, or fails.
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
    place.write_bytes(cv2.imencode(".png", image[..., ::-1])[1].tobytes())


def render_shot(
    instrument: Instrument,
    paths: LightPaths,
    backend: Backend,
    shot: Shot,
    seed: int = 0,
    advance: Callable[[float], None] = lambda share: None,
) -> np.ndarray:
    """One picture, (height, width, 3) uint8, red first.

    Raises
    ------
    PictureError
        Mitsuba cannot run the variant that the pictures need, or fails.
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


def staged(instrument: Instrument, paths: LightPaths, shot: Shot) -> tuple[View, list[Part]]:
    """Where the camera of a picture stands, and all that it may see."""
    points = points_in_world(build_scene(instrument, paths))
    if shot.shows == "instrument":
        wanted, (azimuth, elevation, field) = list(points), (-66.0, 24.0, 28.0)
    elif shot.shows == "prisms":
        wanted = [name for name in points if name.startswith(CENTRAL_PRISM) or prism_of(name) == PRISM_0]
        azimuth, elevation, field = -66.0, 24.0, 24.0
    elif shot.shows == "focal_plane":
        plane = f"{BASE}/{next(iter(instrument.cameras))}/focal_plane"
        wanted = [name for name in points if name.startswith(plane)]
        # into the housing, against the light, a little from the side
        x, y, z = -paths.placed.pose(plane).rotation[:, 2]
        azimuth = float(np.degrees(np.arctan2(y, x))) + 12.0
        elevation = float(np.degrees(np.arctan2(z, np.hypot(x, y)))) + 5.0
        field = 24.0
    else:
        raise ValueError(f"a picture shows the instrument, the prisms or the focal plane, not {shot.shows!r}")
    shown = np.concatenate([points[name] for name in wanted])
    view = framed(shown, azimuth, elevation, field, (shot.width, shot.height))
    return view, studio_parts(instrument, paths, view.pixel_at(shown))
