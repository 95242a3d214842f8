"""Figures of paper 004 with which nothing can be compared, and why; the text has their captions only."""

from __future__ import annotations

from collections.abc import Iterator

from twin.validation.checks.check import NOT_CHECKABLE, Check, CheckResult
from twin.validation.checks.group import CheckGroup, Context

_FIGURES = {
    "004.fig1": (
        "Fig. 1", "Optical system of the camera: off-axis, three mirrors",
        "A drawing without radii, distances, field or focal length. The camera file of gf7 is a design of that class.",
    ),
    "004.fig2": (
        "Fig. 2", "Structure of the camera and its coordinate systems",
        "A drawing without dimensions. Signs of rotations and shifts are a convention; 004.alignment.coupling counts "
        "the six parameters.",
    ),
    "004.fig3": (
        "Fig. 3", "Set-up of the system test with a collimator of long focal length and large aperture",
        "Neither focal length nor aperture of the collimator is printed. The simulation takes 20 m and 0.8 m.",
    ),
    "004.fig4": (
        "Fig. 4", "Model of the focal-plane assembly and its mounting surface",
        "A drawing without dimensions: neither the mounting holes nor the inclination of the surface nor the thickness "
        "of any shim is printed. 004.alignment.shims uses an assumed mount.",
    ),
    "004.fig5": (
        "Fig. 5", "Principle of the measurement of interior orientation and distortion in one dimension",
        "A drawing without numbers; what it means is (1), see 004.eq1 to 004.eq4.",
    ),
    "004.fig6": (
        "Fig. 6", "Set-up of the calibration of the dividing error",
        "Neither the reference nor its accuracy is printed. The simulation takes an indexed polygon and an "
        "autocollimator.",
    ),
    "004.fig7": (
        "Fig. 7", "Dividing error of ten repeats at 41 angles",
        "The text has no value of the curve but the largest RMS of the repeats, see 004.turntable.repeat.",
    ),
    "004.fig8": (
        "Fig. 8", "Mean dividing error after Chauvenet's criterion",
        "The text has no value of the curve but the largest RMS, see 004.turntable.chauvenet.",
    ),
    "004.fig9": (
        "Fig. 9", "Fitted and measured dividing error",
        "The text has no value of the curves but the bound of 0.2 arcsec, see 004.turntable.fit; whether the network "
        "was judged at angles that it had been fitted to is not said.",
    ),
}  # fmt: skip

CHECKS = tuple(
    Check(identifier, figure, statement, "1", None, 0.0, "nothing is compared", expected=NOT_CHECKABLE)
    for identifier, (figure, statement, _) in _FIGURES.items()
)


def run(context: Context) -> Iterator[CheckResult]:
    """Say why."""
    for identifier, (_, _, why) in _FIGURES.items():
        if identifier in context.selected:
            yield context.check(identifier).not_checkable(why)


GROUP = CheckGroup("004.figures", "Figures without numbers", 0.1, CHECKS, run)
