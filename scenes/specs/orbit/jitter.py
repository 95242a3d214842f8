"""Jitter of a satellite's attitude as files in scenes/orbit state it: lines and bands of its spectrum."""

from typing import Annotated

from pydantic import Field, model_validator

from scenes.yaml.errors import Problem
from scenes.yaml.quantity import Quantity, Vector
from scenes.yaml.spec import Spec
from scenes.yaml.units import ANGLE, ANGLE_SPECTRUM, FREQUENCY, format_quantity

Frequency = Annotated[float, Quantity(FREQUENCY, above_zero=True, largest="10 kHz")]
Amplitudes = Annotated[tuple[float, float, float], Vector(Quantity(ANGLE, smallest="0 arcsec", largest="0.1 deg"))]
Phases = Annotated[tuple[float, float, float], Vector(Quantity(ANGLE, largest="360 deg"), alike=True)]
Levels = Annotated[
    tuple[float, float, float],
    Vector(Quantity(ANGLE_SPECTRUM, smallest="0 arcsec^2/Hz", largest="1e6 arcsec^2/Hz")),
]


class JitterLineSpec(Spec):
    """An oscillation: amplitude x sin(2 pi frequency x time + phase) about each axis of the body.

    Attributes:
        frequency: in hertz.
        amplitude: about body X, Y and Z (roll, pitch, yaw), half of what it swings from end to end, radians.
        phase: about each axis, or one for all, radians, time counting from the orbit's epoch; None for random ones.
    """

    frequency: Frequency
    amplitude: Amplitudes
    phase: Phases | None = None


class JitterBandSpec(Spec):
    """A random motion with an even spectrum between two frequencies, Gaussian at every time.

    Attributes:
        first, last: ends of the band, hertz.
        level: one-sided spectral density about body X, Y and Z, rad^2/Hz; level x (last - first) is the variance.
    """

    first: Frequency
    last: Frequency
    level: Levels

    @model_validator(mode="after")
    def _has_a_width(self) -> "JitterBandSpec":
        if not self.first < self.last:
            found = f"{format_quantity(self.first, FREQUENCY)} to {format_quantity(self.last, FREQUENCY)}"
            raise Problem("the band is empty", found, "`last` above `first`", within=("last",))
        return self


class JitterSpec(Spec):
    """Small fast turns of the body about its own axes, after all else that the attitude says; nothing by default.

    Attributes:
        lines: oscillations.
        bands: of noise.
    """

    lines: tuple[JitterLineSpec, ...] = Field(default=(), max_length=100)
    bands: tuple[JitterBandSpec, ...] = Field(default=(), max_length=20)

    @property
    def stated(self) -> bool:
        """Whether there is any."""
        return any(any(line.amplitude) for line in self.lines) or any(any(band.level) for band in self.bands)
