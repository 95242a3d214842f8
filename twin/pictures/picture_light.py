"""What Mitsuba does for a picture: light and first hits of chosen pixels of a studio.

Pixels are sampled one list at a time, not picture by picture: those on matt surfaces need few samples, glass many.
Every pixel's samples are averaged in a fixed order, so that a seed gives the same picture again.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from optics.numerics.backend import Backend
from twin.pictures.picture_scene import Part, View, load_studio

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

    Raises:
        PictureError: the variant cannot be set (another one is never taken), or Mitsuba fails.
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

    Args:
        mi: mitsuba with its colour variant set.
        parts: what stands in the studio.
        view: the camera.
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

        Args:
            pixels: row times width plus column, (N,).
            samples: per pixel.
            seed: of the samples.
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

        Args:
            x: where in the pixel, pixels from its middle.
            y: likewise.
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
