"""The path tracer as a Mitsuba integrator."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

from optics.backend import Backend
from twin.path_tracing.kernel import Features, Launch, Limits, PreparedScene, follow
from twin.path_tracing.scene import load_mitsuba
from twin.path_tracing.sinks import Sinks

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
