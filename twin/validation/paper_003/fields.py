"""Paper 003's tables and figures over seven fields, as distributions over campaigns with everything drawn anew."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from analysis.units import ARCSEC
from optics.threads import one_blas_thread
from twin.artefact import Cell, SvgFigure, Table
from twin.orbit.ground.random_field import stream
from twin.validation.check import NOT_CHECKABLE, Check, CheckResult
from twin.validation.group import CheckGroup, Context
from twin.validation.paper_003 import flights as flown_fields
from twin.validation.paper_003 import schemes, stability
from twin.validation.paper_003.fields_figure import latitude_svg, schemes_svg
from twin.validation.paper_003.flights import Flights
from twin.validation.paper_003.setups import FIELDS, setup_of, without_light

FULL, FAST = 150, 24
"""Campaigns."""


def _lost(identifier: str, equation: str, statement: str) -> Check:
    return Check(identifier, equation, statement, "1", None, 0.0, "the numbers are lost", expected=NOT_CHECKABLE)


LOST = {
    "003.table1": "The table is not in the text. Names of the fields and the schemes are; latitudes, longitudes, "
    "dates, heights and relief in scenes/orbit/calibrate.yaml are chosen after the names, from 28° to 46° of latitude.",
    "003.fig3": "The map is not in the text; the fields lie where scenes/orbit/calibrate.yaml puts them.",
    "003.table6": "The numbers are not in the text. What section 4.5 says of them is 003.scheme1 to 003.scheme5.",
    "003.table7": "The numbers are not in the text. What section 4.5 says of them is 003.scheme1 to 003.scheme5.",
}
CHECKS = (
    _lost("003.table1", "Table 1", "Extent, terrain and images of the seven fields"),
    _lost("003.fig3", "Fig. 3", "Where the seven fields lie"),
    *stability.CHECKS,
    _lost("003.table6", "Table 6", "Accuracy by scheme and field"),
    _lost("003.table7", "Table 7", "Accuracy by scheme and field, continued"),
    *schemes.CHECKS,
)


@one_blas_thread()
def run(context: Context) -> Iterator[CheckResult]:
    """Fly, calibrate, test; drawn image points, whose noise 003.model.points justifies."""
    for identifier, why in LOST.items():
        if identifier in context.selected:
            yield context.check(identifier).not_checkable(why)
    if not context.selected - set(LOST):
        return
    setup = without_light(setup_of(FIELDS))
    count = context.count(FULL, FAST)
    seed = np.random.SeedSequence(context.seed, spawn_key=(3, 2))

    def step(done: int) -> None:
        context.progress(0.6 * done / count, f"fly campaign {done + 1} of {count}")

    campaigns = flown_fields.flown(setup, [stream(seed, k) for k in range(count)], step)
    context.progress(0.6, "calibrate and test")
    found = flown_fields.flights_of(campaigns)
    yield from stability.results(context, campaigns, found, setup)
    yield from schemes.results(context, found, setup)
    limits = setup.test.limits
    if context.wants(*(c.id for c in schemes.CHECKS)):
        context.add(
            SvgFigure(
                "schemes",
                "Accuracy without ground control by scheme and field",
                "RMS at check points: marks are medians over the campaigns, bars hold the middle 90 % of them. "
                "Scheme 0 is the laboratory's camera.",
                schemes_svg(found, limits.plan, limits.height),
            )
        )
        context.add(_table(found))
    if context.wants("003.table3", "003.fig4", "003.fig5", "003.fig6"):
        context.add(
            SvgFigure(
                "latitude",
                "Attitude biases over latitude",
                "Estimates of the first campaign, each field by itself, with 1 sigma; grey: slopes of other "
                "campaigns, drawn through the middle of the first one's fit.",
                latitude_svg(found),
            )
        )
        context.add(_bias_table(found))


def _table(found: Flights) -> Table:
    rows: list[list[Cell]] = []
    for k, scheme in schemes.NAMES.items():
        for what, values in (("plan", found.plan[:, k - 1]), ("height", found.height[:, k - 1])):
            fields = (float(v) for v in np.median(values, axis=0))
            rows.append([f"{k}, {scheme}", what, *fields, float(np.median(values.mean(axis=1)))])
    return Table(
        "accuracy",
        "In place of Tables 6 and 7: RMS at check points, medians over the campaigns, metres",
        "Without ground control.",
        ("scheme", "", *found.fields, "mean"),
        rows,
        (None, None, *[2] * (len(found.fields) + 1)),
    )


def _bias_table(found: Flights) -> Table:
    rows: list[list[Cell]] = []
    for k, name in enumerate(found.fields):
        values, true = found.bias[0, k] / ARCSEC, found.true_bias[0, k] / ARCSEC
        cells = (float(v) for pair in zip(values, true, strict=True) for v in pair)
        rows.append([name, float(np.degrees(found.latitude[k])), *cells])
    return Table(
        "biases",
        "In place of Table 3: biases of the first campaign, arcsec",
        "Each field calibrated by itself, and the truth.",
        ("field", "latitude [deg]", "roll", "true", "pitch", "true", "yaw", "true"),
        rows,
        (None, 1, *[2] * 6),
    )


GROUP = CheckGroup("003.fields", "Seven fields and five schemes", 170.0, CHECKS, run, 28.0)
