"""The run folder of a main job: its data, then what they look like."""

from __future__ import annotations

from twin.main_job.finish_section import finish_section
from twin.main_job.heat_section import heat_section
from twin.main_job.job_tables import faces_of
from twin.main_job.render_drawings import FILES, SCENE, drawings, load_drawing, without_failed
from twin.main_job.render_files import write_results
from twin.main_job.render_report import PICTURES, again_words, render_report
from twin.main_job.render_results import PROGRAM, RenderRun
from twin.main_job.verdict import judge
from twin.pictures.light_paths import trace_light_paths
from twin.run.page import write_artefacts
from twin.run.procedure import WRITE, Session
from twin.run.report import Section, further_sections
from twin.run.run_folder import write_manifest
from twin.run.second_process import SecondProcess


def write_run(run: RenderRun, session: Session, picture: bool = False, beside: SecondProcess | None = None) -> str:
    """Write all files of a run: its data, then what they look like.

    Args:
        run: what was computed.
        session: with the open run folder.
        picture: also render pictures of the instrument.
        beside: the process that helps with the drawing; None for one that begins now.

    Returns:
        What could not be drawn and why, empty where all was.
    """
    if beside is None:
        with SecondProcess(load_drawing) as helper:
            return write_run(run, session, picture, helper)
    seconds, folder = session.seconds, session.folder
    session.advance(WRITE, 0, 1)
    beside.start(drawings(run, trace_light_paths(run.experiment.instrument, run.experiment.backend, run.state)))
    write_results(run, folder)
    made = (_deformed(run), heat_section(run), finish_section(run))
    tables = tuple(section for section in made if section is not None)
    further = further_sections("render", run)
    limits = _limits(run)
    drawn, missing = without_failed(beside.results())
    for name, file in FILES.items():
        if name in drawn:
            folder.write_bytes(file, drawn[name])
    sections = (*tables, limits, *further)
    write_artefacts((a for section in sections for a in section.artefacts), folder)
    problems = [*missing, _pictures(run, session) if picture else ""]
    pictures = [place for name in PICTURES if (place := folder.path / name).exists()]
    folder.write_text("report.html", render_report(run, sections, drawn.get(SCENE), pictures, drawn))
    warnings = [*judge(run).warnings, *missing]
    entries = {"backend": session.backend.name, "seed": run.seed, "frames": run.frames, "warnings": warnings}
    again = list(again_words(run, session.backend.name, picture))
    checks = [check.to_dict() for check in run.checks]
    write_manifest(folder, PROGRAM, session.started, seconds, **entries, again=again, checks=checks)
    return "; ".join(filter(None, problems))


def _limits(run: RenderRun) -> Section:
    """The section on what limits the readings."""
    from twin.uncertainty.uncertainty_report import limits_section

    return limits_section(run.limits)


def _deformed(run: RenderRun) -> Section | None:
    """The section on bodies that tables of displaced nodes deform, if there are any."""
    if not faces_of(run):
        return None
    from twin.main_job.deformation_section import deformation_section

    return deformation_section(run)


def _pictures(run: RenderRun, session: Session) -> str:
    """Render them; why they are not complete, else nothing."""
    from twin.pictures.picture import PictureError, write_pictures

    write = session.folder.write_with
    try:
        write_pictures(run.experiment.instrument, session.backend, run.state, write, run.seed, session.advance)
    except PictureError as error:  # what took minutes to compute is not thrown away for a picture
        return f"the pictures are not complete: {error}"
    return ""
