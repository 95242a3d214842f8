"""``report.html``: one self-contained page that says what a run did, what it found and how far to trust it."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
from markupsafe import Markup

from twin.main_job.crosstalk_sections import crosstalk_section, formula_section, motion_section
from twin.main_job.job_tables import config_text
from twin.main_job.part_sections import quality_section, stray_section, target_section
from twin.main_job.render_drawings import APART, drawings, without_failed
from twin.main_job.render_results import PROGRAM, RenderRun
from twin.main_job.result_sections import (
    IN_PAGE,
    course_sections,
    figure,
    residual_section,
    result_tables,
    shown_time,
    spot_section,
)
from twin.main_job.setup_sections import done_table, facts, setup_section
from twin.main_job.verdict import judge
from twin.pictures.light_paths import trace_light_paths
from twin.pictures.viewer import viewer_markup, viewer_programs, viewer_scripts
from twin.run.artefact import Piece
from twin.run.page import report_page
from twin.run.report import Report, Section

__all__ = ["render_report"]

PICTURES = {
    "picture.png": "The instrument",
    "picture_prisms.png": "The central prism and what is next to it",
    "picture_focal_plane.png": "The detectors of the first camera",
}
"""What the rendered pictures show."""
JPEG_QUALITY = 88
AGAIN = (
    "The run folder's own config.yaml holds everything that was resolved; with the same versions it gives the same "
    "images bit by bit."
)


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
    summary, *shown = result_tables(run)
    done, told = done_table(run), judge(run)
    moved = ", ".join(str(row[0]) for row in done.rows)
    parts = (
        *(course_sections(run, drawn, *shown) if shown else ()),
        Section(f"What was done{shown_time(run)}", (), (done,), name="done") if done.rows else None,
        setup_section(run),
        _instrument(drawn["side"], pictures, viewer_markup(moved) if scene else Markup()),
        spot_section(run, drawn),
        residual_section(run, drawn),
        quality_section(run, drawn),
        target_section(run, drawn),
        stray_section(run),
        motion_section(run, drawn),
        crosstalk_section(run),
        formula_section(run),
        _light(drawn),
        *sections,
    )
    return report_page(
        Report(
            f"{run.resolved.instrument.name}: what its monitor sees, and what it makes of it",
            told.verdict,
            (),
            facts(run),
            summary,
            tuple(section for section in parts if section is not None),
            warnings=told.warnings,
        ),
        again_words(run, backend, bool(pictures)),
        [
            ("Again", AGAIN),
            ("Backend", f"{backend}, float64"),
        ],
        config_text(run.resolved),
        viewer_programs() if scene else (),
        viewer_scripts(scene) if scene else "",
    )


SIDE = (
    "Side view in the base frame. The cameras' planes of symmetry are parallel to it. The line CCDs stand square to "
    "the page; a focal plane is drawn wider than it is. Monitor beams leave a pinhole beside an area CCD, go back "
    "through the mirrors and the 180° and the 0° reflector to a mirror facet of the central prism and return the same "
    "way; channels at both ends of the line lie in front of each other. Arrows: lines of sight."
)


def _instrument(side: str, pictures: Sequence[Path], viewer: Markup) -> Section:
    """The view that can be turned, the drawing that stands in for it, and rendered pictures."""
    drawing = '<figure id="fallback"><div class="card">{}</div><figcaption>{}</figcaption></figure>'
    markup = viewer + Markup(drawing).format(Markup(side), SIDE)
    if pictures:
        markup += Markup('<div class="pictures">{}</div>').format(Markup().join(map(_picture, pictures)))
    return Section("The instrument", (), (Piece("instrument", "", "", markup, within=IN_PAGE),), name="instrument")


def _light(drawn: Mapping[str, str]) -> Section:
    caption = (
        "Clear apertures and footprints on every mirror, in the mirror's own frame (origin at the parent's vertex). "
        "Imaging beams of the line CCD's ends and centre fill the apertures; the monitor's beams, limited by the "
        "return face, use a small part off the middle, out and back. A wavefront or focus error over that part moves "
        "the spot, which is why defocus reads as a rotation."
    )
    footprints = figure(drawn, "footprints", caption)
    return Section("Light path and footprints", (), (footprints,), name="light", closed=True)


def again_words(run: RenderRun, backend: str, pictures: bool) -> tuple[str, ...]:
    """Words of the command that makes a run again from its own folder."""
    options = ("--seed", str(run.seed), "--frames", str(run.frames), "--backend", backend)
    return (PROGRAM, "config.yaml", *options, *(("--picture",) if pictures else ()))


def _picture(place: Path) -> Markup:
    """A rendered picture for the page, a fifth of the file's size."""
    image = cv2.imread(str(place))
    ok, encoded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not ok:
        raise OSError(f"the picture {place.name} cannot be encoded as JPEG")
    address = "data:image/jpeg;base64," + base64.b64encode(encoded.tobytes()).decode("ascii")
    figure = '<figure><img src="{0}" alt="{1}"><figcaption>{2}: <code>{1}</code></figcaption></figure>'
    return Markup(figure).format(address, place.name, PICTURES[place.name])
