"""Pictures of an instrument, rendered by Mitsuba and denoised.

Pixels are sampled in groups with the same number of samples: pixels on matt surfaces need few, those on glass many. The
samples of a pixel are averaged in a fixed order, so that a seed reproduces the same picture.

``picture.png`` shows both cameras, ``picture_prisms.png`` the central prism and its neighbours, and
``picture_focal_plane.png`` the detectors of the first camera. They are illustrations and not for measuring: light beams
are drawn a few pixels thick, and the room is a photographer's studio.
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
"""Backend -> the colour variant of Mitsuba that its machine can run."""
AT_ONCE = 4_000_000
"""Number of light paths that are traced at once; between these calls the program can be interrupted."""
BRIGHTEST = 4.0
"""Radiance at which samples are clipped, so that single paths to a lamp through glass leave no white dots."""
DEPTH = 14
"""Largest number of segments of a light path: light may cross two prisms and be reflected several times."""
SOFT = 0.75
"""Half-width of the tent-shaped weight with which samples around a pixel's middle are averaged, in pixels."""


class PictureError(RuntimeError):
    """Error in rendering the pictures; the message names the cause."""


@contextmanager
def colour_variant(backend: Backend) -> Iterator[Any]:
    """Provide Mitsuba with its colour variant; the previous variant is restored afterwards.

    Raises
    ------
    PictureError
        The variant cannot be set (no other one is used instead), or Mitsuba fails.
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
    """Set Mitsuba's variant, or raise PictureError."""
    try:
        mi.set_variant(variant)
    except (ImportError, AttributeError) as error:
        raise PictureError(f"mitsuba {mi.__version__} cannot run its variant {variant}: {error}") from error
    if mi.variant() != variant:
        raise PictureError(f"mitsuba runs its variant {mi.variant()} where {variant} is needed")


class Studio:
    """Scene and camera in Mitsuba, ready to be rendered.

    Parameters
    ----------
    mi : module
        Mitsuba with its colour variant set.
    parts : list of Part
        Parts of the scene.
    view : View
        Camera.
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
        """Yield pixels in groups of at most ``AT_ONCE`` light paths, between which the program can be interrupted."""
        size = max(1, AT_ONCE // samples)
        for start in range(0, len(pixels), size):
            yield pixels[start : start + size]

    def light(self, pixels: np.ndarray, samples: int, seed: int) -> np.ndarray:
        """Return the mean radiance of N pixels, (N, 3): red, green, blue in the units of the lamps.

        Parameters
        ----------
        pixels : (N,) ndarray of int
            Numbers of the pixels: row times width plus column.
        samples : int
            Samples per pixel.
        seed : int
            Seed of the samples.
        """
        mi = self._mi
        samples_of_pixels = np.repeat(pixels, samples)
        sampler = mi.load_dict({"type": "independent"})
        sampler_seed = np.random.SeedSequence([seed, samples, int(pixels[0])]).generate_state(1)
        sampler.seed(int(sampler_seed[0]), len(samples_of_pixels))
        offset = SOFT * mi.warp.square_to_tent(sampler.next_2d())
        ray = self._rays(samples_of_pixels, offset.x, offset.y)
        light, _, _ = self._integrator.sample(self._scene, sampler, ray)
        values = np.minimum(np.asarray(light.numpy()), BRIGHTEST)
        return np.asarray(values.reshape(3, len(pixels), samples).mean(axis=2, dtype=float).T)

    def first_hits(self, x: float, y: float) -> tuple[np.ndarray, np.ndarray]:
        """Find the part that each pixel of the H x W picture shows first, and the direction of its surface.

        Parameters
        ----------
        x, y : float
            Position within the pixel, pixels from its middle.

        Returns
        -------
        tuple of ndarray
            Number of the part that each pixel of H rows and W columns shows, (H, W), -1 where there is none; and unit
            normal of its surface, (H, W, 3).
        """
        import drjit as dr

        mi, size = self._mi, (self._view.height, self._view.width)
        ray = self._rays(np.arange(size[0] * size[1]), mi.Float(x), mi.Float(y))
        hit = self._scene.ray_intersect(ray)
        shape = dr.select(hit.is_valid(), dr.reinterpret_array(mi.UInt32, hit.shape), 0)
        return self._part_of[shape.numpy()].reshape(size), hit.sh_frame.n.numpy().T.reshape(*size, 3)

    def _rays(self, pixels: np.ndarray, x: Any, y: Any) -> Any:
        """Return rays through pixels, displaced from the pixels' middles by x, y, in pixels."""
        mi, view = self._mi, self._view
        row, column = np.divmod(pixels, view.width)
        position = mi.Point2f(
            (mi.Float(column.astype(np.float32) + 0.5) + x) / view.width,
            (mi.Float(row.astype(np.float32) + 0.5) + y) / view.height,
        )
        ray, _ = self._sensor.sample_ray_differential(mi.Float(0.0), mi.Float(0.5), position, mi.Point2f(0.5, 0.5))
        return ray


def _sensor(mi: Any, view: View) -> Any:
    """Return Mitsuba's description of the camera of a view."""
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
"""Width over which the light on a flat patch is averaged: limits in pixels, and ratio to the root of its area."""
EXPOSURE = 0.88
"""Factor by which radiance is multiplied before the tone curve."""
SHOULDER = 0.75
"""Exposed radiance above which the tone curve compresses, so that highlights keep detail."""


def uniform_patches(seen: Sequence[tuple[np.ndarray, np.ndarray]], matt: Sequence[bool]) -> np.ndarray:
    """Return the number of the flat matt patch that each pixel of an H x W picture shows.

    Parameters
    ----------
    seen : sequence of tuple
        First hits at several positions in the pixels: number of the part (H, W), -1 for none, and normal (H, W, 3).
    matt : sequence of bool
        True for each part on which the light varies slowly.

    Returns
    -------
    (H, W) ndarray of int
        Number of the patch of each pixel; -1 on the borders of patches and elsewhere.
    """
    first, square = _patches(*seen[0]), np.ones((3, 3), np.uint8)
    still = np.array([*matt, False])[seen[0][0]]
    for part, normal in seen:  # a border pixel shows two patches in any of these hits, or is adjacent to such a pixel
        patches = _patches(part, normal)
        still &= (patches == first) & (cv2.dilate(patches, square) == cv2.erode(patches, square))
    return np.where(still, first, -1.0).astype(np.int64)


def denoised(image: np.ndarray, patches: np.ndarray) -> np.ndarray:
    """Average the light over each patch; pixels outside all patches remain unchanged.

    Parameters
    ----------
    image : (H, W, 3) ndarray
        Rendered light of H rows and W columns: red, green, blue.
    patches : (H, W) ndarray of int
        Numbers of the patches, -1 for none.
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
    """Convert radiance to sRGB values, uint8, after multiplication by the exposure and compression of highlights."""
    x = np.clip(EXPOSURE * light, 0.0, None)
    room = 1.0 - SHOULDER
    x = np.where(x > SHOULDER, SHOULDER + room * -np.expm1(-(x - SHOULDER) / room), x)
    grey = np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1.0 / 2.4) - 0.055)
    return np.asarray(np.rint(255.0 * np.clip(grey, 0.0, 1.0)), dtype=np.uint8)


def _patches(part: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Return a number for each pixel (H, W) that tells its part of the scene and its surface direction, float32.

    Numbers are exact up to 16 000 parts.
    """
    steps = np.rint(4.0 * normal).astype(int) + 5
    return (part * 1000 + steps @ np.array([1, 10, 100])).astype(np.float32)


PICTURE = "render the pictures"
"""Name of the rendering of pictures in the progress display."""

LOOKS = ((0.0, 0.0), (-0.35, -0.25), (0.35, 0.25))
"""Positions in a pixel, relative to its middle in pixels, where it is tested for showing one part of the scene only."""

Advance = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Shot:
    """Settings of one rendered picture.

    Attributes
    ----------
    name : str
        Name of the file.
    width, height : int
        Size, pixels.
    coarse, fine : int
        Samples per pixel of matt surfaces, which are denoised, and of all other pixels.
    shows : str
        Content of the picture: ``instrument``, ``prisms`` or ``focal_plane``.
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
    """Render the pictures of an instrument in a perturbed state and write them as PNG files.

    Parameters
    ----------
    instrument : Instrument
        Instrument.
    backend : Backend
        Array backend of the trace.
    state : State
        Perturbed state; its motions are far too small to be visible.
    write : callable
        Function of a file name and of the function that writes the file, e.g. ``RunFolder.write_with``.
    seed : int
        Seed of the samples.
    advance : Advance
        Called with the percentage of all pictures done.
    shots : tuple of Shot
        Pictures to render.

    Raises
    ------
    PictureError
        Mitsuba cannot run the variant that the pictures need, or fails.
    """
    paths = trace_light_paths(instrument, backend, state)
    pixels = [shot.width * shot.height for shot in shots]
    for k, shot in enumerate(shots):
        before, weight = sum(pixels[:k]) / sum(pixels), pixels[k] / sum(pixels)

        def report(share: float, before: float = before, weight: float = weight) -> None:
            advance(PICTURE, round(100.0 * (before + weight * share)), 100)

        image = render_shot(instrument, paths, backend, shot, seed, report)
        write(shot.name, partial(_save, image))


def _save(image: np.ndarray, path: Path) -> None:
    """Write an image as a PNG file."""
    path.write_bytes(cv2.imencode(".png", image[..., ::-1])[1].tobytes())


def render_shot(
    instrument: Instrument,
    paths: LightPaths,
    backend: Backend,
    shot: Shot,
    seed: int = 0,
    advance: Callable[[float], None] = lambda share: None,
) -> np.ndarray:
    """Render one picture, (height, width, 3) uint8, red first.

    Raises
    ------
    PictureError
        Mitsuba cannot run the variant that the pictures need, or fails.
    """
    view, parts = picture_setup(instrument, paths, shot)
    with colour_variant(backend) as mi:
        studio = Studio(mi, parts, view)
        hits = [studio.first_hits(x, y) for x, y in LOOKS]
        patches = uniform_patches(hits, [part.matt for part in parts])
        uniform_pixels = np.flatnonzero(patches >= 0)
        detailed_pixels = np.flatnonzero(patches < 0)
        work = len(uniform_pixels) * shot.coarse + len(detailed_pixels) * shot.fine
        image = np.zeros((shot.height * shot.width, 3))
        done = 0
        for pixels, samples in ((uniform_pixels, shot.coarse), (detailed_pixels, shot.fine)):
            for chunk in studio.chunks(pixels, samples):
                image[chunk] = studio.light(chunk, samples, seed)
                done += len(chunk) * samples
                advance(done / work)
    return displayed(denoised(image.reshape(shot.height, shot.width, 3), patches))


def picture_setup(instrument: Instrument, paths: LightPaths, shot: Shot) -> tuple[View, list[Part]]:
    """Return the camera of a picture and all parts that it may show."""
    points = points_in_world(build_scene(instrument, paths))
    if shot.shows == "instrument":
        names, (azimuth, elevation, field) = list(points), (-66.0, 24.0, 28.0)
    elif shot.shows == "prisms":
        names = [name for name in points if name.startswith(CENTRAL_PRISM) or prism_of(name) == PRISM_0]
        azimuth, elevation, field = -66.0, 24.0, 24.0
    elif shot.shows == "focal_plane":
        plane = f"{BASE}/{next(iter(instrument.cameras))}/focal_plane"
        names = [name for name in points if name.startswith(plane)]
        # view into the housing, against the light, slightly from the side
        x, y, z = -paths.placed.pose(plane).rotation[:, 2]
        azimuth = float(np.degrees(np.arctan2(y, x))) + 12.0
        elevation = float(np.degrees(np.arctan2(z, np.hypot(x, y)))) + 5.0
        field = 24.0
    else:
        raise ValueError(f"a picture shows the instrument, the prisms or the focal plane, not {shot.shows!r}")
    shown = np.concatenate([points[name] for name in names])
    view = framed(shown, azimuth, elevation, field, (shot.width, shot.height))
    return view, studio_parts(instrument, paths, view.pixel_at(shown))
