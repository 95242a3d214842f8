"""The report's section on finishes that somebody measured, with which stray light was traced."""

from __future__ import annotations

import numpy as np

from twin.main_job.render_results import RenderRun
from twin.run.artefact import Cell, Table
from twin.run.report import Section

SHOWN_ANGLES = np.arange(0.0, 90.0, 10.0)
"""Angles of incidence, degrees, at which coatings are shown; those beyond their tables are left out."""


def finish_section(run: RenderRun) -> Section | None:
    """What the tables are at the monitor's wavelength; None where there are none."""
    measured = None if run.stray is None else run.stray.measured
    if measured is None or not (measured.scatter or measured.coatings):
        return None
    tables = []
    if measured.scatter:
        rows: list[tuple[Cell, ...]] = []
        for kind, scatter in measured.scatter.items():
            rms = scatter.table.reciprocity()
            for angle, stated in zip(scatter.table.incidence, scatter.stated, strict=True):
                total = scatter.table.total(float(angle))
                unequal: Cell = "" if np.isnan(rms) else 100.0 * rms
                rows.append((kind, float(np.degrees(angle)), 100.0 * total, 100.0 * stated, unequal))
        heads = ("surfaces", "incidence [deg]", "total scatter [%]", "stated by the file [%]", "not reciprocal [% rms]")
        text = "Of the incident light: the integral of the table, which is what paths scatter."
        tables.append(Table("finish_scatter", "Measured scattering", text, heads, rows, (), 4))
    if measured.coatings:
        coats: list[tuple[Cell, ...]] = []
        for kind, coating in measured.coatings.items():
            through = kind == "coated"
            for degrees in SHOWN_ANGLES:
                if degrees == 0.0 or np.radians(degrees) <= coating.angles[-1]:
                    reflected, passed = coating.at(float(np.radians(degrees)), through)
                    coats.append((kind, float(degrees), 100.0 * reflected, 100.0 * passed if through else ""))
        columns = ("surfaces", "incidence in air [deg]", "reflected [%]", "transmitted [%]")
        text = "At the monitor's wavelength, for unpolarised light."
        tables.append(Table("finish_coatings", "Measured coatings", text, columns, coats, (), 4))
    about = "Finishes by tables that somebody measured; all others are built in."
    return Section("Measured finishes", (about,), tuple(tables), 1)
