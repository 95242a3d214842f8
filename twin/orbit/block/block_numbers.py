"""Result keys of a block adjustment, the content of block.json."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from analysis.block.block_adjustment import LawTest
from analysis.block.network import DatumTest, Network, OpenCombination
from analysis.block.reweighting import GroupTest
from analysis.orbit.forward_intersection import Accuracy
from twin.framework.record import Quantity, Record
from twin.orbit.block.block_run import BlockRun, CameraChange, SensorContribution
from twin.orbit.block.rational_block import AdjustedImage

ACCURACY: Record[Accuracy] = Record(
    "90% errors on the ground.",
    Quantity("ce90_m", lambda accuracy: accuracy.ce90, "circular error in plan, 90%", "CE90", 3),
    Quantity("le90_m", lambda accuracy: accuracy.le90, "linear error in height, 90%", "LE90", 3),
    Quantity("points", lambda accuracy: accuracy.count, "number of points"),
)
ALARM = 1e-3
"""p-value below which a test of a run raises a warning; a run has about ten tests."""
CONTRIBUTION: Record[SensorContribution] = Record(
    "90% errors of the check points with some of the block's sensors.",
    Quantity("excluded", lambda case: list(case.excluded), "sensors that were not used"),
    Quantity("predicted", lambda case: case.predicted, "by the points' covariances", "predicted", record=ACCURACY),
    Quantity("observed", lambda case: case.observed, "by the check points' errors", "observed", record=ACCURACY),
    Quantity("plan_ratio", lambda case: case.plan, "predicted CE90 over that with all sensors", "plan ×", 2),
    Quantity("height_ratio", lambda case: case.height, "predicted LE90 over that with all sensors", "height ×", 2),
    Quantity(
        "normalised_squared_error",
        lambda case: case.normalised_squared_error,
        "mean square of errors over sigmas (chi-square per degree of freedom); 1 where the sigmas are right",
        "χ²/dof",
        2,
    ),
)
GROUP: Record[GroupTest] = Record(
    "Test of a group of observations, or of a law of errors, after the adjustment.",
    Quantity("observations", lambda group: group.count, "number of observations", "observations"),
    Quantity("redundancy", lambda group: group.redundancy, "sum of the redundancy numbers", "redundancy", 1),
    Quantity(
        "variance_ratio",
        lambda group: group.ratio if np.isfinite(group.ratio) else None,
        "variance of the residuals over that expected from the sigmas",
        "variance ratio",
    ),
    Quantity("p_value", lambda group: group.p_value, "two-sided p-value of the residuals, approximate", "p"),
    Quantity("factor", lambda group: group.factor, "variance factor, estimated where asked for", "factor", 2),
)
LAW: Record[LawTest] = Record(
    "Test of the independence of errors of readings that the stated law assumes.",
    Quantity("law", lambda test: test.kind, "stated law"),
    Quantity("excess_sigma", lambda test: test.excess, "products of neighbouring errors less their expectation, in σ"),
    Quantity("p_value", lambda test: test.p_value, "probability of an excess at least as large"),
)
OPEN: Record[OpenCombination] = Record(
    "A combination of unknowns that the observations determine less well than the prior.",
    Quantity("unknowns", lambda combination: list(combination.names), "unknowns of the combination"),
    Quantity("change", lambda combination: list(combination.change), "change of each for one prior σ, metres, radians"),
    Quantity(
        "sigma_ratio", lambda combination: combination.sigma_ratio, "prior σ over the σ of the observations alone"
    ),
)
DATUM: Record[DatumTest] = Record(
    "Common shift of the control points against the rest of the block: given minus adjusted.",
    Quantity("east_m", lambda datum: datum.east, "shift east"),
    Quantity("north_m", lambda datum: datum.north, "shift north"),
    Quantity("up_m", lambda datum: datum.up, "shift up"),
    Quantity("sigma_m", lambda datum: list(datum.sigma), "standard deviations of east, north and up"),
    Quantity("chi_square", lambda datum: datum.chi_square, "chi-square of the shift, three degrees of freedom"),
)
NETWORK: Record[Network] = Record(
    "Connections between the scenes of the block.",
    Quantity("parts", lambda network: [list(part) for part in network.parts], "scenes connected by shared points"),
    Quantity("controlled", lambda network: list(network.controlled), "true if the part has control or footprints"),
    Quantity("alone", lambda network: list(network.alone), "scenes that share no point with another"),
    Quantity("empty", lambda network: list(network.empty), "scenes without image points"),
)


def _four(get: Callable[[CameraChange], np.ndarray | None], k: int) -> Callable[[CameraChange], Any]:
    def value(change: CameraChange) -> Any:
        row = get(change)
        return None if row is None else row[k]

    return value


CHANGE: Record[CameraChange] = Record(
    "Change of a camera in one scene since its calibration.",
    *(
        Quantity(f"{name}_{unit}{end}", _four(get, k), f"{name}{words}", f"{name}{words}", decimals)
        for k, (name, unit, decimals) in enumerate(
            (("d_alpha", "arcsec", 3), ("d_beta", "arcsec", 3), ("d_gamma", "arcsec", 3), ("d_f", "um", 2))
        )
        for end, words, get in (
            ("", "", lambda change: change.value),
            ("_sigma", ", sigma", lambda change: change.sigma),
            ("_sigma_before", ", prior sigma", lambda change: change.before),
            ("_true", ", true", lambda change: change.truth),
        )
    ),
)


def _coefficient(k: int, term: str, attribute: str) -> Callable[[AdjustedImage], Any]:
    def value(image: AdjustedImage) -> Any:
        return getattr(image, attribute)[k, image.terms.index(term)] if term in image.terms else None

    return value


def _rms(k: int, when: str) -> Callable[[AdjustedImage], Any]:
    def value(image: AdjustedImage) -> Any:
        return getattr(image, f"rms_{when}")[k]

    return value


IMAGE: Record[AdjustedImage] = Record(
    "Correction of an image with rational polynomials, added to line and sample by the polynomials.",
    Quantity("points", lambda image: image.points, "number of image points", "points"),
    *(
        Quantity(f"{axis}_rms_{when}_px", _rms(k, when), words, f"{axis} rms {when}", 3)
        for when, words in (
            ("before", "rms residual of points intersected without corrections"),
            ("after", "rms residual after the adjustment"),
        )
        for k, axis in enumerate(("line", "sample"))
    ),
    *(
        Quantity(
            f"{term}_{axis}_px{end}", _coefficient(k, term, attribute), f"{meaning}{words}", f"{term} {axis}{words}", 3
        )
        for term, meaning in (
            ("shift", "constant correction"),
            ("drift", "correction at the last line, zero in the middle"),
            ("affine", "correction at the last sample, zero in the middle"),
        )
        for k, axis in enumerate(("line", "sample"))
        for end, words, attribute in (
            ("", "", "value"),
            ("_sigma", ", sigma", "sigma"),
            ("_sigma_before", ", prior sigma", "before"),
        )
    ),
    Quantity(
        "bias_m", lambda image: image.polynomial.bias_m, "ERR_BIAS: rms error of a horizontal axis", "ERR_BIAS", 3
    ),
    Quantity("random_m", lambda image: image.polynomial.random_m, "ERR_RAND of the polynomials before", "ERR_RAND", 3),
    Quantity(
        "fit_error_px",
        lambda image: max(image.polynomial.error_px),
        "largest error of the corrected polynomials against polynomials plus correction",
    ),
)
BLOCK: Record[BlockRun] = Record(
    "Content of block.json: the adjustment of a block of scenes.",
    Quantity(
        "check_points",
        lambda run: run.contributions,
        "case -> check points by the sensors of the case",
        record=CONTRIBUTION,
    ),
    Quantity("sensors", lambda run: list(run.used), "sensors that were used"),
    Quantity("chi_square", lambda run: run.adjustment.chi_square, "chi-square of all observations and priors"),
    Quantity("degrees_of_freedom", lambda run: run.adjustment.degrees_of_freedom, "degrees of freedom of chi-square"),
    Quantity("p_value", lambda run: run.adjustment.p_value, "probability of a chi-square at least as large"),
    Quantity("agrees", lambda run: run.adjustment.p_value >= ALARM, "true if residuals are not larger than stated"),
    Quantity("unknowns", lambda run: len(run.adjustment.x), "number of unknowns beside the points"),
    Quantity("points", lambda run: int(np.isfinite(run.adjustment.ground[:, 0]).sum()), "number of adjusted points"),
    Quantity(
        "relative_height_sigma_m",
        lambda run: float(np.median(run.relative_height_sigma)),
        "sigma of a point's height relative to the mean height of all points, median of the points",
    ),
    Quantity("groups", lambda run: run.adjustment.groups, "group of observations, or law -> its test", record=GROUP),
    Quantity(
        "laws",
        lambda run: {law.group: law for law in run.laws},
        "law with a course in time -> test of the readings' independence",
        record=LAW,
    ),
    Quantity("datum", lambda run: run.datum, "a common shift of the control points", record=DATUM),
    Quantity("network", lambda run: run.network, "connections between the scenes", record=NETWORK),
    Quantity("open", lambda run: list(run.open), "combinations that the priors determine", record=OPEN),
    Quantity("cameras", lambda run: run.cameras, "scene -> change of its camera", record=CHANGE),
    Quantity("images", lambda run: run.images, "image with rational polynomials -> its correction", record=IMAGE),
    Quantity("rejected", lambda run: [list(point) for point in run.rejected], "point and scene of each gross error"),
)
