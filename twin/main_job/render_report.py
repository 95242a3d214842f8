"""``report.html``: one self-contained page that says what a run did, what it found and how far to trust it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from markupsafe import Markup

from analysis.monitor.recovery import ESTIMATORS
from twin.main_job import crosstalk_content, part_content, report_content, report_labels
from twin.main_job.light_path_plots import footprints_svg, side_view_svg
from twin.main_job.render_results import PROGRAM, RenderRun
from twin.main_job.series_plots import parameters_svg, temperatures_svg
from twin.main_job.spot_plots import residuals_svg, spots_svg
from twin.main_job.target_plots import curves_svg, images_svg, pupils_svg
from twin.pictures.light_paths import trace_light_paths
from twin.run.artefact import FAR
from twin.run.page import environment, reproduce, section_contents
from twin.run.report import Section
from twin.run.versions import versions

__all__ = ["render_report", "write_report"]

TEMPLATE = "report.html.j2"
NUMBERS = {3: "three", 4: "four", 5: "five", 6: "six", 7: "seven", 8: "eight"}


def write_report(run: RenderRun, place: Path, sections: Sequence[Section] = ()) -> None:
    """Write the report of a run.

    Args:
        run: the run.
        place: the HTML file.
        sections: beside the report's own.
    """
    place.write_text(render_report(run, sections), encoding="utf-8")


def render_report(run: RenderRun, sections: Sequence[Section] = ()) -> str:
    """The page as text."""
    experiment, backend = run.experiment, run.experiment.backend.name
    paths = trace_light_paths(experiment.instrument, experiment.backend, run.state)
    tables = report_content.results(run)
    names = list(experiment.instrument.cameras)
    titles = {name: estimator.title for name, estimator in ESTIMATORS.items()}
    figures = {
        "spots": {name: Markup(spots_svg(run, name)) for name in names},
        "residuals": Markup(residuals_svg(report_content.residual_panels(tables), titles)),
        "side": Markup(side_view_svg(experiment.instrument, paths)),
        "footprints": Markup(footprints_svg(experiment.instrument, paths)),
    }
    if run.series is not None:
        figures["temperatures"] = Markup(temperatures_svg(run.series))
        figures["course"] = Markup(parameters_svg(run.series, titles))
    if run.targets is not None:
        cameras = run.targets.cameras
        figures["targets"] = {name: Markup(images_svg(name, camera)) for name, camera in cameras.items()}
        if run.targets.has_edges:
            figures["mtf"] = {name: Markup(curves_svg(name, camera)) for name, camera in cameras.items()}
    if run.quality is not None and run.quality.obstruction:
        figures["pupils"] = Markup(pupils_svg(run.quality))
    template = environment(__package__).get_template(TEMPLATE)
    return template.render(
        setup=report_content.setup(run),
        course=part_content.series_content(run),
        stray=part_content.stray_content(run),
        targets=part_content.target_content(run),
        quality=part_content.quality_content(run),
        tables=tables,
        summary=report_content.summary(tables),
        spots=report_content.spots(run),
        goodness=report_content.goodness(run),
        crosstalk=crosstalk_content.crosstalk_tables(run),
        wrong_percent=round(100 * crosstalk_content.WRONG),
        factors=crosstalk_content.factors(run),
        statements=crosstalk_content.statements(run),
        figures=figures,
        sections=section_contents(sections),
        labels=report_labels,
        estimators=ESTIMATORS,
        number=NUMBERS.get(len(ESTIMATORS), str(len(ESTIMATORS))),
        far=f"{FAR:g}",
        run=run,
        pitch_um=f"{1e6 * experiment.path.pitch:g}",
        config=run.resolved.to_yaml(),
        command=reproduce(PROGRAM, "config.yaml", f"--seed {run.seed} --frames {run.frames}", f"--backend {backend}"),
        versions=versions(),
        backend=backend,
    )
