"""The integrator that traces paths, and the Mitsuba scene it works in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from optics.numerics.backend import Backend
from scenes.models.scenery import Scenery
from twin.path_tracing.kernel import Features, Launch, Limits, PreparedScene, follow
from twin.path_tracing.sinks import Sinks

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


NAME = "float64_light_tracer"
"""Under which the integrator is registered with Mitsuba."""


@dataclass(frozen=True)
class Sampling:
    """How paths are drawn.

    Attributes:
        steps: at which a path ends, whatever it carries.
        floor: smallest probability of each way that a path can go at a surface. 0: as the power goes, and the balance
            of the power is exact in every run. Above 0 weak ways are drawn more often and carry less each, which finds
            faint ghosts; the balance then holds on average.
        scatter_floor: the same for scattering out of the specular direction.
        roulette: relative to a path's mean weight at the start: below it a path is ended at random, and those that go
            on carry more; 0: never.
    """

    steps: int = 96
    floor: float = 0.0
    scatter_floor: float = 0.0
    roulette: float = 0.0

    def __post_init__(self) -> None:
        """Check the numbers."""
        if self.steps < 1 or not 0.0 <= self.floor < 1.0 or not 0.0 <= self.scatter_floor < 1.0 or self.roulette < 0.0:
            raise ValueError(f"impossible sampling: {self}")


BALANCED = Sampling()
"""Every way is drawn as the power goes."""

FAINT = Sampling(floor=0.1, scatter_floor=0.02, roulette=1e-6)
"""Weak ways are drawn more often: for ghosts and stray light."""


@cache
def _register(variant: str) -> Callable[..., Any]:
    """Register the integrator for the variant that is set, once; returns how to make one."""
    import mitsuba as mi

    base: Any = mi.SamplingIntegrator

    class Float64LightTracer(base):
        """Follows light from its sources in float64 (``launch``); it has no camera's view to render."""

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            self.sampling = Sampling(
                int(props.get("steps", BALANCED.steps)),
                float(props.get("floor", 0.0)),
                float(props.get("scatter_floor", 0.0)),
                float(props.get("roulette", 0.0)),
            )

        def sample(self, *arguments: Any, **options: Any) -> Any:
            raise NotImplementedError(f"{NAME} follows light from its sources; call launch")

        def launch(
            self, scene: PreparedScene, features: Features, start: Launch, mean_weight: float, sinks: Sinks
        ) -> float:
            """Trace paths to their end and write what they meet to the sinks; returns their power at the start."""
            import drjit as dr

            backend = scene.backend
            s = self.sampling
            limits = Limits(
                dr.opaque(backend.UInt, s.steps),
                dr.opaque(backend.UInt, sinks.room),
                backend.opaque(s.floor),
                backend.opaque(s.scatter_floor),
                backend.opaque(s.roulette * mean_weight),
            )
            with dr.suspend_grad():
                dr.scatter_add(sinks.left, start.weight, backend.UInt(2))
                follow(scene, features, limits, start, sinks)
                dr.eval(sinks.arrays)
            return float(sinks.left.numpy()[2])

        def to_string(self) -> str:
            return f"{NAME}[{self.sampling}]"

    mi.register_integrator(NAME, Float64LightTracer)
    return Float64LightTracer


def make_integrator(backend: Backend, sampling: Sampling) -> Any:
    """The integrator as Mitsuba's plugin."""
    mi = load_mitsuba(backend)
    _register(mi.variant())
    numbers = {"floor": sampling.floor, "scatter_floor": sampling.scatter_floor, "roulette": sampling.roulette}
    return mi.load_dict({"type": NAME, "steps": sampling.steps, **numbers})
