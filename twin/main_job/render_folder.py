"""Run folder of a main job: its data files, figures and report.

Each drawing imports what it needs when it is drawn, in the process that draws it.
"""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.sax.saxutils import escape

import cv2
from markupsafe import Markup

from optics.geometry.tree import State
from optics.numerics.backend import Backend
from scenes.models.instrument_model import Instrument
from scenes.yaml.named import Named
from twin.framework.artefact import Piece, Undrawn
from twin.framework.page import report_page, write_artefacts
from twin.framework.procedure import WRITE, Session
from twin.framework.report import Report, Section, further_sections
from twin.framework.run_folder import write_manifest
from twin.framework.second_process import SecondProcess
from twin.main_job import part_sections
from twin.main_job.crosstalk_sections import crosstalk_section, formula_section, motion_section
from twin.main_job.render_files import config_text, write_results
from twin.main_job.render_results import PROGRAM, JobRun, RenderRun
from twin.main_job.result_sections import (
    IN_PAGE,
    course_sections,
    done_table,
    facts,
    figure,
    glance_figure,
    glance_table,
    residual_section,
    result_tables,
    setup_section,
    shown_time,
    spot_section,
)
from twin.main_job.verdict import judge
from twin.pictures.light_paths import trace_light_paths
from twin.pictures.scene_file import viewer_markup, viewer_programs, viewer_scripts


def write_run(run: JobRun, session: Session, picture: bool = False, beside: SecondProcess | None = None) -> str:
    """Write all files of a run: its data, then figures and report.

    Parameters
    ----------
    run : JobRun
        Run to write.
    session : Session
        Session with the open run folder.
    picture : bool
        Also render pictures of the instrument.
    beside : SecondProcess or None
        Second process that draws figures; None starts one.

    Returns
    -------
    str
        Which drawings failed and why; empty if none did.
    """
    if beside is None:
        with SecondProcess(load_drawing) as helper:
            return write_run(run, session, picture, helper)
    seconds, folder = session.seconds, session.folder
    session.advance(WRITE, 0, 1)
    begin_drawing(beside, run.experiment.instrument, run.experiment.backend, run.state)
    beside.start(drawings(run), LOADED)
    if isinstance(run, RenderRun):
        beside.start(limits_drawing(run.limits))
    write_results(run, folder)
    of_tables = part_sections.deformation_section(run), part_sections.heat_section(run)
    sections = [section for section in of_tables if section is not None]
    drawn, missing = without_failed(beside.results())
    if isinstance(run, RenderRun):
        from twin.uncertainty.uncertainty_report import limits_section  # slow to import

        finishes = part_sections.finish_section(run)
        sections += [*(() if finishes is None else (finishes,)), limits_section(run.limits, figure=drawn.get(LIMITS))]
    sections += further_sections("render", run)
    for name, file in FILES.items():
        if name in drawn:
            folder.write_bytes(file, drawn[name])
    write_artefacts((a for section in sections for a in section.artefacts), folder)
    problems = [*missing, _pictures(run, session) if picture else ""]
    pictures = [path for name in _PICTURES if (path := folder.path / name).exists()]
    folder.write_text("report.html", render_report(run, sections, drawn.get(SCENE), pictures, drawn))
    warnings = [*judge(run).warnings, *missing]
    entries = {"backend": session.backend.name, "seed": run.seed, "frames": run.frames, "warnings": warnings}
    command = list(_repeat_command(run, session.backend.name, picture))
    checks = [check.to_dict() for check in run.checks]
    write_manifest(folder, PROGRAM, session.started, seconds, **entries, again=command, checks=checks)
    return "; ".join(filter(None, problems))


def _pictures(run: JobRun, session: Session) -> str:
    """Render pictures of the instrument; return why they are incomplete, or an empty string."""
    from twin.pictures.picture import PictureError, write_pictures

    write = session.folder.write_with
    try:
        write_pictures(run.experiment.instrument, session.backend, run.state, write, run.seed, session.advance)
    except PictureError as error:  # a failed picture must not cost the computed results
        return f"the pictures are incomplete: {error}"
    return ""


_PICTURES = {
    "picture.png": "The instrument",
    "picture_prisms.png": "The central prism and its surroundings",
    "picture_focal_plane.png": "The detectors of the first camera",
}
"""File name of each rendered picture -> its caption."""
_JPEG_QUALITY = 88
AGAIN = (
    "The config.yaml of the run folder is complete, with all references resolved; with the same versions of the "
    "software it gives identical images."
)


def render_report(
    run: JobRun,
    sections: Sequence[Section] = (),
    scene: bytes | None = None,
    pictures: Sequence[Path] = (),
    drawn: Mapping[str, Any] | None = None,
) -> str:
    """Return the report of a run as HTML text.

    Parameters
    ----------
    run : JobRun
        Run to report.
    sections : Sequence[Section]
        Further sections.
    scene : bytes or None
        Contents of scene.glb, for the 3-D view; None omits the view.
    pictures : Sequence[Path]
        Rendered pictures, named as in ``_PICTURES``.
    drawn : Mapping[str, Any] or None
        Name -> <svg> element of every figure of ``twin.main_job.render_folder``; None draws them.
    """
    experiment, backend = run.experiment, run.experiment.backend.name
    if drawn is None:
        pieces = instrument_drawings(experiment.instrument, experiment.backend, run.state) | drawings(run)
        drawn, _ = without_failed({name: draw() for name, draw in pieces.items() if name not in APART})
    summary, *course_tables = result_tables(run)
    monitored = run if isinstance(run, RenderRun) else None
    estimators = None
    if monitored is not None:
        estimators = Section("All estimators", (), (summary,), closed=True, name="estimators")
        summary = glance_table(monitored)
    perturbation, judgement = done_table(run), judge(run)
    bodies = ", ".join(str(row[0]) for row in perturbation.rows)
    parts = (
        estimators,
        *(course_sections(monitored, drawn, *course_tables) if course_tables and monitored else ()),
        Section(f"What was done{shown_time(run)}", (), (perturbation,), name="done") if perturbation.rows else None,
        setup_section(run),
        _instrument(drawn["side"], pictures, viewer_markup(bodies) if scene else Markup(), monitored is not None),
        *((spot_section(monitored, drawn), residual_section(monitored, drawn)) if monitored else ()),
        part_sections.quality_section(run, drawn),
        part_sections.target_section(run, drawn),
        *((part_sections.stray_section(monitored), motion_section(monitored, drawn)) if monitored else ()),
        *((crosstalk_section(monitored), formula_section(monitored)) if monitored else ()),
        _light(drawn, monitored is not None),
        *sections,
    )
    about = "readings of its monitor" if monitored else "changes of geometry and images"
    return report_page(
        Report(
            f"{run.resolved.instrument.name}: {about}",
            judgement.verdict,
            judgement.more,
            facts(run),
            summary,
            tuple(section for section in parts if section is not None),
            warnings=judgement.warnings,
            glance=glance_figure(monitored, drawn) if monitored else None,
        ),
        _repeat_command(run, backend, bool(pictures)),
        [("Again", AGAIN), ("Backend", f"{backend}, float64")],
        config_text(run.resolved),
        viewer_programs() if scene else (),
        viewer_scripts(scene) if scene else "",
    )


SIDE = (
    "Side view in the base frame, parallel to the cameras' planes of symmetry. The line CCDs are perpendicular to the "
    "page; a focal plane is drawn wider than it is."
)
BEAMS = (
    " Monitor beams leave a pinhole beside an area CCD, go back "
    "through the mirrors and the 180° and the 0° reflector to a mirror facet of the central prism and return along "
    "the same path; channels at both ends of the line coincide in this view."
)
ARROWS = " Arrows: lines of sight."


def _instrument(side: str, pictures: Sequence[Path], viewer: Markup, monitored: bool) -> Section:
    """Return the section with the 3-D view, the side view for browsers without it, and rendered pictures."""
    drawing = '<figure id="fallback"><div class="card">{}</div><figcaption>{}</figcaption></figure>'
    markup = viewer + Markup(drawing).format(Markup(side), f"{SIDE}{BEAMS if monitored else ''}{ARROWS}")
    if pictures:
        markup += Markup('<div class="pictures">{}</div>').format(Markup().join(map(_picture, pictures)))
    return Section("The instrument", (), (Piece("instrument", "", "", markup, within=IN_PAGE),), name="instrument")


def _light(drawn: Mapping[str, str], monitored: bool) -> Section:
    caption = (
        "Clear apertures and footprints on every mirror, in the mirror's own frame (origin at the parent's vertex). "
        "Imaging beams of the line CCD's ends and centre fill the apertures"
    )
    of_monitor = (
        "the monitor's beams, limited by the return face, use a small part off the middle, out and back. A wavefront "
        "or focus error over that part moves the spot, so that defocus is read as a rotation"
    )
    caption += f"; {of_monitor}." if monitored else "."
    footprints = figure(drawn, "footprints", caption)
    return Section("Light path and footprints", (), (footprints,), name="light", closed=True)


def _repeat_command(run: JobRun, backend: str, pictures: bool) -> tuple[str, ...]:
    """Return the program name and arguments of the command that repeats a run from its folder."""
    options = ("--seed", str(run.seed), "--frames", str(run.frames), "--backend", backend)
    return (PROGRAM, "config.yaml", *options, *(("--picture",) if pictures else ()))


def _picture(path: Path) -> Markup:
    """Return a rendered picture for the page, compressed as JPEG to a fifth of its file's size."""
    image = cv2.imread(str(path))
    _, encoded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    address = "data:image/jpeg;base64," + base64.b64encode(encoded.tobytes()).decode("ascii")
    figure = '<figure><img src="{0}" alt="{1}"><figcaption>{2}: <code>{1}</code></figcaption></figure>'
    return Markup(figure).format(address, path.name, _PICTURES[path.name])


if TYPE_CHECKING:
    from twin.uncertainty.monitor_limits import MonitorLimits

LIMITS = "limits"
"""Name of the figure on what limits the accuracy of the estimated changes."""
SUMMARY, SCENE, IRRADIANCE = "summary", "scene", "irradiance"
"""Names of the drawings that are files of their own, not figures of the report.

The files are summary.png, scene.glb and irradiance.nc.
"""
APART = (SUMMARY, SCENE, IRRADIANCE)
LOADED = (SCENE, IRRADIANCE)
"""Drawings that need the libraries trimesh and h5netcdf, which nothing else in a run uses.

They are drawn after `load_drawing` has imported the libraries of all other drawings.
"""
FILES = {IRRADIANCE: "irradiance.nc", SCENE: "scene.glb", SUMMARY: "summary.png"}
"""Drawing -> file that it is written to."""


def begin_drawing(beside: SecondProcess, instrument: Instrument, backend: Backend, state: State) -> None:
    """Start drawing in the second process what does not depend on the measurement, unless it has started already.

    It draws the instrument and its light in the state that is shown.

    Parameters
    ----------
    beside : SecondProcess
        Second process.
    instrument : Instrument
        Instrument of the run.
    backend : Backend
        Backend that traces its light.
    state : State
        State that is shown.
    """
    if SCENE not in beside:
        beside.start(instrument_drawings(instrument, backend, state), LOADED)


def instrument_drawings(instrument: Instrument, backend: Backend, state: State) -> dict[str, Callable[[], Any]]:
    """Return name -> function that draws an instrument and its light in a state; the slowest come first.

    The functions return <svg> elements, and the bytes of scene.glb.
    """
    paths = trace_light_paths(instrument, backend, state)
    return _attempts(
        {
            "footprints": _drawing("light_path_plots:footprints_svg", instrument, paths),
            "side": _drawing("light_path_plots:side_view_svg", instrument, paths),
            SCENE: _drawing("twin.pictures.scene_file:scene_bytes", instrument, state, paths),
        }
    )


def drawings(run: JobRun) -> dict[str, Callable[[], Any]]:
    """Return name -> function that draws a figure of a run's results; the data for the figures are computed now."""
    targets = run.targets
    out = _of_monitor(run) if isinstance(run, RenderRun) else {}
    if targets is not None:
        for name, camera in targets.cameras.items():
            out[f"targets {name}"] = _drawing("target_plots:images_svg", name, camera)
            if targets.has_edges:
                out[f"mtf {name}"] = _drawing("target_plots:curves_svg", name, camera)
    if run.quality is not None and run.quality.obstruction:
        out["pupils"] = _drawing("target_plots:pupils_svg", run.quality)
    return _attempts(out)


def limits_drawing(limits: MonitorLimits | None) -> dict[str, Callable[[], Any]]:
    """Return name -> function that draws the contributions to the error variance; empty without a prior."""
    if limits is None:
        return {}
    return _attempts({LIMITS: _drawing("twin.uncertainty.uncertainty_report:limits_svg", limits)})


def _attempts(drawing: Mapping[str, Callable[[], Any]]) -> dict[str, Callable[[], Any]]:
    return {name: partial(_attempt, name, draw) for name, draw in drawing.items()}


def _of_monitor(run: RenderRun) -> dict[str, Callable[[], Any]]:
    """Return name -> function that draws a figure of the monitor's images or estimated changes."""
    out: dict[str, Callable[[], Any]] = {"motions": _drawing("spot_plots:motion_map_svg", run)}
    out |= {f"spots {name}": _drawing("spot_plots:spots_svg", run, name) for name in run.experiment.instrument.cameras}
    out[IRRADIANCE] = _drawing("render_files:irradiance_file", run)
    if (series := run.series) is not None:
        titles = {name: estimator.title for name, estimator in run.estimators.items()}
        out["course"] = _drawing("spot_plots:parameters_svg", series, titles)
        out["temperatures"] = _drawing("spot_plots:temperatures_svg", series)
        if series.smoothed is not None:
            out["smoothed"] = _drawing("spot_plots:smoothed_svg", series)
    out["glance"] = _drawing("spot_plots:glance_svg", run)
    out[SUMMARY] = _drawing("spot_plots:summary_png", run)
    out["residuals"] = _drawing("spot_plots:residuals_svg", run)
    return out


def _drawing(function: str, *arguments: Any) -> Callable[[], Any]:
    """Return a function that calls ``module:name`` with the given arguments and imports the module only then.

    The import takes a second, and only the process that draws needs it.
    """
    return partial(Named(function if "." in function else f"{__package__}.{function}"), *arguments)


def _attempt(name: str, draw: Callable[[], Any]) -> Any:
    """Return a drawing, or an `Undrawn` with the reason if it fails, so that the computed results are not lost."""
    try:
        return draw()
    except Exception as error:
        return Undrawn("undrawn", name, "", f"{type(error).__name__}: {' '.join(str(error).split())}")


def without_failed(drawn: Mapping[str, Any]) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Replace figures that could not be drawn by a note, and drop files that could not be drawn.

    Returns
    -------
    tuple of (dict, tuple of str)
        The drawings, and a sentence for each that is missing.
    """
    out, missing = dict(drawn), []
    for name, drawing in drawn.items():
        if isinstance(drawing, Undrawn):
            apart = f"the file {FILES[name]} could not be drawn: {drawing.why}" if name in APART else ""
            missing.append(apart or drawing.note)
            del out[name]
            if name not in APART:
                out[name] = (
                    f'<svg viewBox="0 0 1060 40" role="img"><text x="8" y="25">{escape(missing[-1])}</text></svg>'
                )
    return out, tuple(missing)


def load_drawing() -> None:
    """Import the libraries that all runs draw with, and let Matplotlib find its fonts."""
    import h5netcdf

    from twin.framework.svg import look, new_figure, to_svg
    from twin.main_job import light_path_plots, spot_plots
    from twin.pictures import scene_file
    from twin.uncertainty import uncertainty_report

    _ = h5netcdf, light_path_plots, spot_plots, scene_file, uncertainty_report
    with look("first"):
        figure = new_figure(1.0)
        figure.subplots().set_title("0 \N{MINUS SIGN}", fontweight="bold")
        to_svg(figure)
