"""The adjustment of a campaign, of one field by itself and of all at once: what is solved for, what is held, what is
known beforehand.
"""

from __future__ import annotations

from collections.abc import Sequence

from analysis.orbit.adjustment import Adjustment, Robust, adjust
from analysis.orbit.calibration_parameters import OFFSET, Prior, Unknowns
from analysis.orbit.null_space import Gauge
from twin.orbit.calibration.campaign import Campaign, FieldPass

GAUGE = Gauge(held=("nadir x", "nadir y"))
"""Of three lines. The nadir line's principal point stays as the laboratory has it: x is not observable against pitch,
y against roll so weakly that a field would not know it to a pixel."""
_LEAST_OFFSET = 1e-3
"""Metres; sigma of an orbit without a drift along one axis."""


def gauge_of(campaign: Campaign) -> Gauge:
    """The principal point of one line is held; see `GAUGE`."""
    return Gauge(held=(f"{campaign.reference} x", f"{campaign.reference} y"))


def calibrated_alone(campaign: Campaign, one: FieldPass, priors: Sequence[Prior] = ()) -> Adjustment:
    """A field by itself, with paper 003's twelve unknowns less the gauge.

    Args:
        campaign: for the laboratory's camera and the noise.
        one: the field.
        priors: what else is known of its unknowns, for example by an on-board monitor.

    Raises:
        CalibrationError: it cannot be solved.
    """
    return adjust([one.control], campaign.laboratory, campaign.noise, priors=priors, gauge=gauge_of(campaign))


def simultaneous(
    campaign: Campaign,
    priors: tuple[Prior, ...] = (),
    robust: Robust | None = None,
    drift: bool = False,
    rate: bool = False,
) -> Adjustment:
    """All fields at once: one interior, a bias and, where the orbit drifts, an offset with its prior for each field.

    Args:
        campaign: the fields.
        priors: what else is known of the unknowns, for example by an on-board monitor in each pass.
        robust: weights of the image points.
        drift: whether the cameras' changes in each pass are unknowns, too; priors must tell them.
        rate: whether a drift of the bias during the passes is; priors must tell it.

    Raises:
        CalibrationError: it cannot be solved.
    """
    errors = campaign.spec.errors
    offsets = errors.switched_on and any(errors.gps.drift)
    drifts = tuple(
        Prior({f"{p.name} offset {axis}": 1.0}, 0.0, max(sigma, _LEAST_OFFSET), "orbit")
        for p in campaign.passes
        for axis, sigma in zip(OFFSET, errors.gps.drift, strict=True)
    )
    return adjust(
        [p.control for p in campaign.passes],
        campaign.laboratory,
        campaign.noise,
        unknowns=Unknowns(
            offset="field" if offsets else "none",
            drift="field" if drift else "none",
            rate="common" if rate else "none",
        ),
        priors=(*(drifts if offsets else ()), *priors),
        gauge=gauge_of(campaign),
        robust=robust,
    )
