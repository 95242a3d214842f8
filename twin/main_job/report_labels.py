"""Names for readers of what the results call by keys."""

from __future__ import annotations

from dataclasses import dataclass

from twin.run.artefact import SYMBOLS

PAPER = "Wang et al., Acta Photonica Sinica 47(10) 1012001 (2018), doi 10.3788/gxzb20184710.1012001"


@dataclass(frozen=True)
class Parameter:
    """One of the four parameters: key in the results, symbol, unit as shown, meaning."""

    key: str
    symbol: str
    unit: str
    meaning: str


PARAMETERS = (
    Parameter("d_alpha_arcsec", SYMBOLS["d_alpha"], "arcsec", "rotation of the line of sight about Y, the line CCD"),
    Parameter(
        "d_beta_arcsec", SYMBOLS["d_beta"], "arcsec", "rotation of the line of sight about X, the flight direction"
    ),
    Parameter("d_gamma_arcsec", SYMBOLS["d_gamma"], "arcsec", "rotation of the imaged line about the line of sight"),
    Parameter("d_f_um", SYMBOLS["d_f"], "µm", "change of the principal distance"),
)

ANGLE = Parameter("change_arcsec", "Δθ", "arcsec", "change of the angle between the two lines of sight")
"""Of two cameras together."""

GROUND = (
    Parameter("along_m", "along", "m", "along the track, positive in flight direction"),
    Parameter("across_m", "across", "m", "across the track, positive to the right"),
    Parameter("height_m", "height", "m", "positive up"),
)
"""Errors of a pair's points on the ground that are located as if the cameras had not changed."""

CENTROID_NOTES = {
    "ml": "maximum-likelihood fit of the calibrated spot shape",
    "gaussian": "fit of a Gaussian",
    "energy": "windowed energy centroid, as in the paper",
}
