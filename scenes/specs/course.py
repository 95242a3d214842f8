"""A course: temperatures that change with time, as a job's file gives them in a table."""

from itertools import pairwise
from typing import Annotated

from pydantic import AfterValidator, model_validator

from optics.thermal.heat import Temperature
from scenes.yaml.errors import Problem
from scenes.yaml.quantity import Quantity, Vector
from scenes.yaml.spec import Paths, Spec
from scenes.yaml.units import MOMENT, TEMPERATURE_DIFFERENCE, TEMPERATURE_GRADIENT, format_quantity

TemperatureChange = Annotated[float, Quantity(TEMPERATURE_DIFFERENCE, largest="1000 K", unsigned="100 K")]
"""Kelvin. Nothing in an instrument at work becomes 100 K warmer; 250 K without a sign is an absolute temperature."""
TemperatureGradient = Annotated[tuple[float, float, float], Vector(Quantity(TEMPERATURE_GRADIENT, largest="1000 K/m"))]
Moment = Annotated[float, Quantity(MOMENT, largest="100000 h")]

FEWEST, MOST = 2, 1000
"""Numbers of times that a course may have."""


def _ascending(times: tuple[float, ...]) -> tuple[float, ...]:
    if not FEWEST <= len(times) <= MOST:
        raise Problem("not the number of times of a course", f"{len(times)} of them", f"{FEWEST} to {MOST} times")
    for k, (before, after) in enumerate(pairwise(times), 1):
        if not after > before:
            raise Problem("the times do not ascend", moment(after), f"a time after {moment(before)}", within=(k,))
    return times


def moment(time: float) -> str:
    """A time of a course as its file would write it: "12 min" for 720 s."""
    return format_quantity(time, MOMENT)


class TemperatureCourse(Spec):
    """How the temperature of a body, and of all it carries that has none of its own, changes: for each of the course's
    times change + gradient . r. What is left out is zero at all times.

    Attributes:
        change: at the body's origin, kelvin.
        gradient: in the body's own frame, K/m.
    """

    change: tuple[TemperatureChange, ...] | None = None
    gradient: tuple[TemperatureGradient, ...] | None = None


class CourseSpec(Spec):
    """A series of states: at each time the job's perturbation with these temperatures added.

    A body that stands in the table has a temperature of its own at all times, also where the table says 0 K.

    Attributes:
        times: ascending, seconds; only their order matters to the instrument, which has no memory.
        temperature: node path -> its temperatures, one for each time.
        detail: the one of the times that is shown in full, like the single state of a job without a course, seconds;
            the last one by default.
    """

    times: Annotated[tuple[Moment, ...], AfterValidator(_ascending)]
    temperature: Paths[TemperatureCourse]
    detail: Moment | None = None

    @model_validator(mode="after")
    def _consistent(self) -> "CourseSpec":
        if not self.temperature:
            raise Problem(
                "nothing changes", "no nodes", "at least one node with its temperatures", None, ("temperature",)
            )
        for path, table in self.temperature.items():
            given = {"change": table.change, "gradient": table.gradient}
            if all(values is None for values in given.values()):
                raise Problem("nothing changes", None, "change, gradient or both", None, ("temperature", path))
            for key, values in given.items():
                if values is not None and len(values) != len(self.times):
                    raise Problem(
                        "not one entry for each time",
                        f"{len(values)} entries",
                        f"{len(self.times)}, as many as there are times",
                        None,
                        ("temperature", path, key),
                    )
        if self.detail is not None and self.detail not in self.times:
            near = min(self.times, key=lambda time: abs(time - (self.detail or 0.0)))
            raise Problem(
                "not one of the course's times", moment(self.detail), "one of times", moment(near), ("detail",)
            )
        return self

    @property
    def shown(self) -> int:
        """Number of the time that is shown in full, from 0."""
        return len(self.times) - 1 if self.detail is None else self.times.index(self.detail)

    def fields(self, k: int) -> dict[str, Temperature]:
        """Node path -> what the table adds to its temperature at time number ``k``."""
        return {
            path: Temperature(
                table.change[k] if table.change is not None else 0.0,
                table.gradient[k] if table.gradient is not None else (0.0, 0.0, 0.0),
            )
            for path, table in self.temperature.items()
        }

    def key(self, path: str, k: int) -> tuple[str | int, ...]:
        """Where in the course the temperature of a node at time number ``k`` stands."""
        name = "change" if self.temperature[path].change is not None else "gradient"
        return ("temperature", path, name, k)
