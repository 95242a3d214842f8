"""Detector described by its EMVA 1288 data sheet, with its exposure limits.

The data sheets are files of scenes/library/detectors.
"""

from collections.abc import Mapping
from typing import Annotated

from pydantic import Field, model_validator

from scenes.yaml.errors import KeyPath, Problem, names_text
from scenes.yaml.spec import Named, Number, Spec, TitledSpec, Whole
from scenes.yaml.unit_fields import Quantity
from scenes.yaml.units import LENGTH, TIME, format_quantity

LEAST_SIDE = 24
AreaSide = Annotated[Whole, Field(ge=LEAST_SIDE, le=8192)]
"""Number of rows or columns of an area CCD; the smallest number is that in which a spot can be measured."""
PixelPitch = Annotated[float, Quantity(LENGTH, smallest="0.5 um", largest="1 mm")]
"""Pixel pitch, in metres; a value below the smallest pixels that are made would be a mistaken unit."""
PITCH_RANGE = (0.5e-6, 1e-3)
"""Smallest and largest `PixelPitch`, in metres."""
LEAST_STEPS = 1.0
"""Smallest number of grey values between dark and full well."""


class DetectorSpec(TitledSpec):
    """Data sheet of a detector: plain numbers in the units of EMVA 1288.

    e stands for electrons and DN for digital numbers (grey values).

    Attributes
    ----------
    quantum_efficiency : float
        Electrons per photon at the wavelength of use.
    system_gain_dn_per_e : float
        System gain K of EMVA 1288, in DN per electron.
    dark_noise_e : float
        Temporal noise in the dark without dark current, in electrons rms.
    dark_current_e_per_s : float
        Mean dark current of a pixel, in electrons per second.
    full_well_e : float
        Saturation capacity, in electrons.
    prnu : float
        Photo response non-uniformity, relative rms.
    dsnu_e : float
        Dark signal non-uniformity, in electrons rms.
    bit_depth : int
        Resolution of the analogue-to-digital converter, in bits; frames are stored with 16 bits.
    offset_dn : float
        Grey value of zero signal, in DN.
    noise : Mapping[str, float] | None
        Name of a noise source beyond the model of EMVA 1288 -> its standard deviation, in electrons rms; none by
        default.
    """

    quantum_efficiency: Annotated[Number, Field(gt=0.0, le=1.0)]
    system_gain_dn_per_e: Annotated[Number, Field(gt=0.0, le=1e4)]
    dark_noise_e: Annotated[Number, Field(ge=0.0, le=1e5)]
    dark_current_e_per_s: Annotated[Number, Field(ge=0.0, le=1e9)]
    full_well_e: Annotated[Number, Field(ge=1.0, le=1e9)]
    # above 20 % some responses would be negative; no image sensor is that non-uniform
    prnu: Annotated[Number, Field(ge=0.0, le=0.2)]
    dsnu_e: Annotated[Number, Field(ge=0.0, le=1e5)]
    bit_depth: Annotated[Whole, Field(ge=1, le=16)]
    offset_dn: Annotated[Number, Field(ge=0.0, le=65535.0)]
    noise: Named[Annotated[Number, Field(ge=0.0, le=1e6)]] | None = None

    @model_validator(mode="after")
    def _leaves_grey_values(self) -> "DetectorSpec":
        if self.offset_dn >= self.max_dn:
            value, allowed = f"{self.offset_dn:g} with {self.bit_depth} bits", f"less than {self.max_dn}"
            raise Problem("no grey values are left above the offset", value, allowed, within=("offset_dn",))
        steps = self.system_gain_dn_per_e * self.full_well_e
        if steps < LEAST_STEPS:
            raise Problem(
                "a full well is not even one grey value",
                f"{self.system_gain_dn_per_e:g}, with which a full well makes {steps:.3g} DN",
                f"at least {LEAST_STEPS / self.full_well_e:.3g} DN per electron",
                within=("system_gain_dn_per_e",),
            )
        return self

    @property
    def max_dn(self) -> int:
        """Largest grey value of the converter."""
        return 2**self.bit_depth - 1

    @property
    def saturation_dn(self) -> float:
        """Grey value at which the response ceases to be linear.

        It is the converter's limit or the full well, whichever is lower.
        """
        return float(min(self.max_dn, self.offset_dn + self.system_gain_dn_per_e * self.full_well_e))

    @property
    def saturation_e(self) -> float:
        """Number of electrons in a pixel at which the response ceases to be linear."""
        return min(self.full_well_e, (self.max_dn - self.offset_dn) / self.system_gain_dn_per_e)

    def check_exposure(self, exposure: float) -> None:
        """Raise `InputError` if the dark signal leaves no room for light.

        Parameters
        ----------
        exposure : float
            Exposure of a frame, in seconds.

        Raises
        ------
        InputError
            The dark current alone saturates the pixels.
        """
        limit = self.saturation_e
        if self.dark_current_e_per_s * exposure >= limit:
            raise self.error(
                "the dark current alone saturates the pixels",
                ("dark_current_e_per_s",),
                value=self.dark_current_e_per_s,
                allowed=f"less than {limit / exposure:.3g} electrons per second with the exposure of"
                f" {format_quantity(exposure, TIME)}, or a shorter exposure",
            )


def require_detector(setup: Spec, key: KeyPath, name: str, detectors: Mapping[str, DetectorSpec]) -> None:
    """Raise `InputError` at ``key`` unless the data sheet ``name`` is among a set-up's detectors.

    It may be missing because a user has edited a config.yaml.
    """
    if name not in detectors:
        allowed = names_text(detectors) or "a data sheet of that name in `detectors:`"
        raise setup.error("no such detector in this file", key, value=name, allowed=allowed)
