"""A detector by the numbers of its EMVA 1288 data sheet, as a file in scenes/library/detectors gives it, and what
limits its pixels.
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
"""Rows or columns of an area CCD, from what a spot can be measured in on."""
PixelPitch = Annotated[float, Quantity(LENGTH, smallest="0.5 um", largest="1 mm")]
"""Metres; pixels smaller than the smallest that are made would be a mistaken unit."""
LEAST_STEPS = 1.0
"""Grey values between the dark and a full well at least."""


class DetectorSpec(TitledSpec):
    """Plain numbers in the units of EMVA 1288; e stands for electrons and DN for digital numbers (grey values).

    Attributes
    ----------
    name
        As the file is called.
    description
        For people.
    quantum_efficiency : Number
        Electrons per photon at the wavelength it is used at.
    system_gain_dn_per_e : Number
        DN per electron (K of EMVA 1288).
    dark_noise_e : Number
        Temporal noise in the dark without dark current, rms.
    dark_current_e_per_s : Number
        Mean dark current of a pixel.
    full_well_e : Number
        Saturation capacity.
    prnu : Number
        Photo response non-uniformity, relative rms.
    dsnu_e : Number
        Dark signal non-uniformity, rms.
    bit_depth : Whole
        Of the analogue-to-digital converter; frames are stored as 16 bits.
    offset_dn : Number
        Grey value of no signal.
    noise : Named[Number] | None
        Beyond the model of EMVA 1288, name -> its number, electrons rms; None for nothing.
    """

    quantum_efficiency: Annotated[Number, Field(gt=0.0, le=1.0)]
    system_gain_dn_per_e: Annotated[Number, Field(gt=0.0, le=1e4)]
    dark_noise_e: Annotated[Number, Field(ge=0.0, le=1e5)]
    dark_current_e_per_s: Annotated[Number, Field(ge=0.0, le=1e9)]
    full_well_e: Annotated[Number, Field(ge=1.0, le=1e9)]
    # above 20% some responses would be negative; no image sensor is that uneven
    prnu: Annotated[Number, Field(ge=0.0, le=0.2)]
    dsnu_e: Annotated[Number, Field(ge=0.0, le=1e5)]
    bit_depth: Annotated[Whole, Field(ge=1, le=16)]
    offset_dn: Annotated[Number, Field(ge=0.0, le=65535.0)]
    noise: Named[Annotated[Number, Field(ge=0.0, le=1e6)]] | None = None

    @model_validator(mode="after")
    def _leaves_grey_values(self) -> "DetectorSpec":
        if self.offset_dn >= self.max_dn:
            found, allowed = f"{self.offset_dn:g} with {self.bit_depth} bits", f"less than {self.max_dn}"
            raise Problem("no grey values are left above the offset", found, allowed, within=("offset_dn",))
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
        """Grey value where the response stops being linear: the converter's end or the full well, whichever comes
        first.
        """
        return float(min(self.max_dn, self.offset_dn + self.system_gain_dn_per_e * self.full_well_e))

    @property
    def saturation_e(self) -> float:
        """Electrons of a pixel there."""
        return min(self.full_well_e, (self.max_dn - self.offset_dn) / self.system_gain_dn_per_e)

    def check_exposure(self, exposure: float) -> None:
        """See whether the dark signal leaves room for light.

        Parameters
        ----------
        exposure : float
            Of a frame, seconds.

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
                found=self.dark_current_e_per_s,
                allowed=f"less than {limit / exposure:.3g} electrons per second with the exposure of"
                f" {format_quantity(exposure, TIME)}, or a shorter exposure",
            )


def require_detector(setup: Spec, key: KeyPath, name: str, detectors: Mapping[str, DetectorSpec]) -> None:
    """InputError at ``key`` unless a setup's data sheets hold that name: a config.yaml may have been changed."""
    if name not in detectors:
        allowed = names_text(detectors) or "a data sheet of that name in `detectors:`"
        raise setup.error("no such detector in this file", key, found=name, allowed=allowed)
