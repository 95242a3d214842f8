"""``report.html``: one self-contained page that says what a run did, what it found and how far to trust it."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
from markupsafe import Markup

from twin.main_job import assumptions, crosstalk_content, part_content, report_content, report_labels
from twin.main_job.job_tables import config_text
from twin.main_job.render_drawings import APART, drawings, without_failed
from twin.main_job.render_results import PROGRAM, RenderRun
from twin.main_job.report_tables import report_tables, setup_tables
from twin.main_job.verdict import judge
from twin.pictures.light_paths import trace_light_paths
from twin.pictures.viewer import viewer_markup, viewer_programs, viewer_scripts
from twin.run.artefact import FAR
from twin.run.page import artefact_content, environment, reproduce, section_contents
from twin.run.report import Section
from twin.run.versions import versions

__all__ = ["render_report"]

TEMPLATE = "report.html.j2"
PICTURES = {
    "picture.png": "The instrument",
    "picture_prisms.png": "The central prism and what is next to it",
    "picture_focal_plane.png": "The detectors of the first camera",
}
"""What the rendered pictures show."""
JPEG_QUALITY = 88


def render_report(
    run: RenderRun,
    sections: Sequence[Section] = (),
    scene: bytes | None = None,
    pictures: Sequence[Path] = (),
    drawn: Mapping[str, Any] | None = None,
) -> str:
    """The page as text.

    Args:
        run: the run.
        sections: beside the report's own.
        scene: contents of scene.glb, for the view that can be turned; None leaves it out.
        pictures: files in PICTURES that were rendered.
        drawn: name -> <svg> element of every figure of ``twin.main_job.render_drawings``; None draws them.
    """
    experiment, backend = run.experiment, run.experiment.backend.name
    if drawn is None:
        paths = trace_light_paths(experiment.instrument, experiment.backend, run.state)
        drawn, _ = without_failed({name: draw() for name, draw in drawings(run, paths).items() if name not in APART})
    tables = report_content.results(run)
    figures: dict[str, Any] = {}
    for name, svg in drawn.items():
        group, _, camera = name.partition(" ")
        if camera:
            figures.setdefault(group, {})[camera] = Markup(svg)
        elif isinstance(svg, str):
            figures[name] = Markup(svg)
    template = environment(__package__).get_template(TEMPLATE)
    told, setup = judge(run), report_content.setup(run)
    csvs = {name: artefact_content(table, None) for name, table in (report_tables(run) | setup_tables(setup)).items()}
    return template.render(
        title=f"{run.resolved.instrument.name}: what its monitor sees, and what it makes of it",
        verdict=told.verdict,
        warnings=told.warnings,
        setup=setup,
        csvs=csvs,
        viewer=viewer_markup(", ".join(p["node"] for p in setup["perturbations"])) if scene else "",
        scripts=viewer_scripts(scene) if scene else "",
        programs=viewer_programs() if scene else (),
        pictures=[_picture(picture) for picture in pictures],
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
        estimators=run.estimators,
        judged=run.judged,
        assumed=assumptions.assumed(run.reading),
        stated=report_content.stated(run),
        family="; ".join(e.title for e in run.estimators.values() if not e.stated),
        far=f"{FAR:g}",
        run=run,
        pitch_um=f"{1e6 * experiment.path.pitch:g}",
        config=config_text(run.resolved),
        command=reproduce(again_words(run, backend, bool(pictures))),
        versions=versions(),
        backend=backend,
    )


def again_words(run: RenderRun, backend: str, pictures: bool) -> tuple[str, ...]:
    """Words of the command that makes a run again from its own folder."""
    options = ("--seed", str(run.seed), "--frames", str(run.frames), "--backend", backend)
    return (PROGRAM, "config.yaml", *options, *(("--picture",) if pictures else ()))


def _picture(place: Path) -> dict[str, Any]:
    """A rendered picture for the page, a fifth of the file's size."""
    image = cv2.imread(str(place))
    ok, encoded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not ok:
        raise OSError(f"the picture {place.name} cannot be encoded as JPEG")
    address = "data:image/jpeg;base64," + base64.b64encode(encoded.tobytes()).decode("ascii")
    return {"name": place.name, "about": PICTURES[place.name], "address": address}
