"""Line CCDs of a camera's focal plane: one for each spectral band, with time delay and integration (TDI)."""

from typing import Annotated

from pydantic import Field, model_validator

from scenes.specs.detector import PixelPitch
from scenes.yaml.errors import Problem
from scenes.yaml.quantity import Length, Quantity, Vector
from scenes.yaml.spec import Number, Reference, Spec, Whole
from scenes.yaml.units import LENGTH, SCALE, TIME, format_quantity

Spectrum = Annotated[tuple[float, float], Vector(Quantity(LENGTH, smallest="100 nm", largest="100 um"), 2)]
RateError = Annotated[float, Quantity(SCALE, largest="50 percent")]
Exposure = Annotated[float, Quantity(TIME, above_zero=True, largest="100 s")]
Diffusion = Annotated[float, Quantity(LENGTH, smallest="0 um", largest="1 mm")]


class TdiSpec(Spec):
    """How a line CCD collects light while the image moves across it.

    Attributes:
        stages: lines over which the charge is collected.
        phases: steps in which the charge moves on by one pixel; between two steps it stands still and the image does
            not, which blurs it along the track by one step.
        open_share: share of each step in which light is collected.
        line_time: from one line to the next, seconds.
        rate_error: relative difference between the image's speed and the charge's; over all stages it blurs as well.
    """

    stages: Annotated[Whole, Field(ge=1, le=4096)] = 1
    phases: Annotated[Whole, Field(ge=1, le=8)] = 1
    line_time: Exposure = 3.5e-4
    open_share: Annotated[Number, Field(gt=0.0, le=1.0)] = 1.0
    rate_error: RateError = 0.0


class BandSpec(Spec):
    """A line CCD in the focal plane and the light it sees.

    Attributes:
        offset: along X' (flight direction) from the line's centre, metres.
        pixels: number of pixels along the line.
        pitch: of the pixels, which are square, metres.
        spectrum: first and last wavelength, metres; the light is taken as evenly spread between them.
        detector: data sheet, by name or path.
        diffusion: rms spread of charge between pixels (crosstalk), metres.
        tdi: time delay and integration.
    """

    offset: Length = 0.0
    pixels: Annotated[Whole, Field(ge=2, le=1_000_000)]
    pitch: PixelPitch
    spectrum: Spectrum
    detector: Reference
    diffusion: Diffusion = 0.0
    tdi: TdiSpec = TdiSpec()

    @model_validator(mode="after")
    def _spectrum_rises(self) -> "BandSpec":
        first, last = self.spectrum
        if not first <= last:
            found = f"[{format_quantity(first, LENGTH)}, {format_quantity(last, LENGTH)}]"
            raise Problem("the spectrum's wavelengths are in the wrong order", found, "[shortest, longest]")
        return self

    @property
    def exposure(self) -> float:
        """Of all stages, over which dark current is collected, seconds; the data sheet gives it for all stages."""
        return self.tdi.stages * self.tdi.line_time

    @property
    def nyquist(self) -> float:
        """Nyquist frequency of the pixels, cycles/m."""
        return 0.5 / self.pitch
