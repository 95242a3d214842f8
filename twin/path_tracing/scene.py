"""Mitsuba's part: the triangles of a scenery, one mesh per surface."""

from __future__ import annotations

from typing import Any

import numpy as np

from optics.backend import Backend
from scenes.scenery import Scenery

VARIANTS = {"llvm": "llvm_ad_mono", "cuda": "cuda_ad_mono"}
"""Mitsuba's variant whose arrays are those of the backend; triangles are float32 in all of them."""


class VariantUnavailable(RuntimeError):
    """Mitsuba cannot run the variant that the backend needs."""


def load_mitsuba(backend: Backend) -> Any:
    """The mitsuba module with exactly the backend's variant set.

    Raises:
        VariantUnavailable: it could not be set (Mitsuba itself would take another one silently from a list).
    """
    import mitsuba as mi  # after optics, which has named the LLVM library

    variant = VARIANTS[backend.name]
    if mi.variant() != variant:
        try:
            mi.set_variant(variant)
        except (ImportError, AttributeError) as error:
            raise VariantUnavailable(f"mitsuba {mi.__version__} cannot run its variant {variant}: {error}") from error
    if mi.variant() != variant:
        raise VariantUnavailable(f"mitsuba runs its variant {mi.variant()} where {variant} is needed")
    return mi


def build_scene(mi: Any, scenery: Scenery) -> Any:
    """A ``mi.Scene`` of the triangles; Mitsuba's index of a shape is the number of the surface.

    Args:
        mi: mitsuba with its variant set.
        scenery: the surfaces; their triangles are moved to the world in float64 and rounded once.

    Raises:
        RuntimeError: Mitsuba has put the shapes in another order.
    """
    names = [f"surface{i:05d}" for i in range(len(scenery.surfaces))]
    # robust: rays do not slip through between two triangles
    description: dict[str, Any] = {"type": "scene", "embree_use_robust_intersections": True}
    for name, surface in zip(names, scenery.surfaces, strict=True):
        mesh = mi.Mesh(name, len(surface.vertices), len(surface.triangles))
        parameters = mi.traverse(mesh)
        world = surface.pose.apply(surface.vertices).astype(np.float32)
        parameters["vertex_positions"] = mi.Float(np.ascontiguousarray(world.ravel()))
        parameters["faces"] = mi.UInt32(np.ascontiguousarray(surface.triangles.astype(np.uint32).ravel()))
        parameters.update()
        description[name] = mesh
    # the parser's optimisations would merge meshes of the same material
    scene = mi.load_dict(description, optimize=False)
    if [shape.id() for shape in scene.shapes()] != names:
        raise RuntimeError("mitsuba has put the shapes of a scene in another order")
    return scene
