"""HTML pages of reports with their Content-Security-Policy, and the files of a test's run folder.

A report contains texts from a user's files, and is opened from a folder or sent to other people. All texts are escaped
where they are inserted; the policy protects if one is not. It allows the pieces of the page, each by its checksum, and
nothing else: no other file, network, form or script.

``style`` attributes are the one exception: they are allowed because Matplotlib gives every line of a figure one. They
can change the look of a page, but load nothing.
"""

import base64
import hashlib
import re
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template
from markupsafe import Markup, escape

from twin.framework import data_files, provenance, record, run_folder
from twin.framework.artefact import Artefact, typeset
from twin.framework.report import Report, further_sections

FIGURES = "*{stroke-linejoin: round; stroke-linecap: butt}"
"""Style sheet that Matplotlib writes into every figure."""
NOTHING: Mapping[str, str] = {"default-src": "'none'", "base-uri": "'none'", "form-action": "'none'"}
"""Directives of a Content-Security-Policy that forbid a page to load or run anything."""


def checksum(text: str) -> str:
    """Return the source expression of an inline script or style sheet for the policy.

    Parameters
    ----------
    text : str
        Text between its tags.
    """
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode('ascii')}'"


def page_policy(style: str, programs: Iterable[str] = ()) -> str:
    """Return the Content-Security-Policy of a self-contained page.

    Parameters
    ----------
    style : str
        Style sheet of the page, the text between its tags.
    programs : iterable of str
        Scripts of the page, likewise, and scripts that these insert.
    """
    scripts = [checksum(program) for program in programs]
    return policy(
        {
            **NOTHING,
            "img-src": "data:",
            "style-src-elem": f"{checksum(style)} {checksum(FIGURES)}",
            "style-src-attr": "'unsafe-inline'",
            **({"script-src": " ".join(scripts)} if scripts else {}),
        }
    )


def policy(directives: Mapping[str, str]) -> str:
    """Return the directives of a policy as one text."""
    return "; ".join(f"{name} {sources}" for name, sources in directives.items())


def inline(text: str) -> Markup:
    """Return a text as escaped HTML, with typographic minus signs, and words between backticks as code."""
    return text if isinstance(text, Markup) else Markup(_CODE.sub(r"<code>\1</code>", str(escape(typeset(text)))))


_CODE = re.compile("`([^`]+)`")


def style_sheet() -> str:
    """Return the style sheet of reports."""
    return (files(__package__) / "sheet.css").read_text("utf-8")


@cache
def _template() -> Template:
    """Return the Jinja template of a report's HTML page."""
    loader = FileSystemLoader(str(files(__package__)))
    environment = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.globals["page_policy"], environment.filters["inline"] = page_policy, inline
    return environment.get_template("page.html.j2")


def reproduce(words: Sequence[str]) -> str:
    """Return the command line that repeats a run, from its program, subcommand and options."""
    return f"python -m {shlex.join(words)} --out again"


@dataclass(frozen=True)
class RunFacts:
    """Facts about how a test was run, for its report and manifest.

    Attributes
    ----------
    config : str
        Test with everything it refers to, as YAML; it can replace the test's file.
    program : str
        Program that ran the test, as the user calls it.
    started : float
        Start time, in seconds since the epoch.
    seconds : float
        Duration, in seconds.
    backend : str
        Backend of the ray trace; empty without a trace.
    seed : int | None
        Seed of all random numbers; None if none are drawn.
    command : str
        Subcommand of the program.
    options : tuple of str
        Further options of the command that repeats the run.
    again : tuple of str
        Words of the command that repeats the run, program first, if it is not the test with the run's own config.yaml.
    named : Any
        Plain data that contain absolute paths of files that the run read.
    input_paths : tuple of Path
        Further files and folders that the run read, as the user wrote them.
    checks : tuple of provenance.SelfCheck
        Self-checks of the run beside those in its numbers.
    """

    config: str
    program: str
    started: float
    seconds: float
    backend: str = ""
    seed: int | None = None
    command: str = ""
    options: tuple[str, ...] = ()
    again: tuple[str, ...] = ()
    named: Any = None
    input_paths: tuple[Path, ...] = ()
    checks: tuple[provenance.SelfCheck, ...] = ()

    @property
    def words(self) -> tuple[str, ...]:
        """Words of the command line that repeats the run from inside its folder."""
        if self.again:
            return self.again
        seed = () if self.seed is None else ("--seed", str(self.seed))
        command = (self.command,) if self.command else ()
        return (self.program, *command, "config.yaml", *self.options, *seed, "--backend", self.backend)

    def manifest_entries(self, numbers: Mapping[str, Any]) -> dict[str, Any]:
        """Return the entries of the manifest: the command that repeats the run, its inputs and its self-checks.

        Parameters
        ----------
        numbers : mapping
            Numbers of the run.
        """
        folder = {"started_in": str(Path.cwd())} if self.input_paths else {}
        checks = [check.to_dict() for check in self.checks or provenance.checks_in(numbers)]
        return {
            "again": list(self.words),
            **folder,
            "inputs": provenance.inputs_in(self.named, self.input_paths),
            "checks": checks,
        }


def write_artefacts(artefacts: Iterable[Artefact], folder: run_folder.RunFolder) -> None:
    """Write artefacts that have files of their own into an open run folder.

    Parameters
    ----------
    artefacts : iterable of Artefact
        Artefacts of a report.
    folder : run_folder.RunFolder
        Open run folder.
    """
    for artefact in artefacts:
        if artefact.within is None:
            folder.write_bytes(artefact.file, artefact.content())


def links(names: Iterable[str]) -> Markup:
    """Return HTML links to files of the run folder, for the last table of a page."""
    return Markup(", ").join(Markup('<a href="{0}">{0}</a>').format(name) for name in names)


def report_page(
    report: Report,
    words: Sequence[str],
    rows: Sequence[tuple[str, str]] = (),
    config: str = "",
    programs: Sequence[str] = (),
    scripts: str = "",
) -> str:
    """Return a report as a self-contained HTML page.

    Parameters
    ----------
    report : Report
        Content of the page.
    words : sequence of str
        Words of the command that repeats the run, program first.
    rows : sequence of (str, str)
        Rows of the last table, (label, text), before the versions.
    config : str
        Resolved configuration shown to readers; empty to show none.
    programs : sequence of str
        Scripts that the page may run, in the form that the policy needs.
    scripts : str
        HTML elements of these scripts, written by this program.
    """
    return _template().render(
        report=report,
        command=reproduce(words),
        rows=rows,
        versions=", ".join(f"{name} {version}" for name, version in provenance.versions().items()),
        config=config,
        programs=programs,
        scripts=Markup(scripts),
    )


def render_report(kind: str, report: Report, facts: RunFacts) -> str:
    """Return ``report.html`` of a test as text; its numbers are in KIND.json.

    Parameters
    ----------
    kind : str
        Kind of the test.
    report : Report
        Content of the page.
    facts : RunFacts
        Facts about the run.
    """
    rows: list[tuple[str, str]] = [("Numbers", links((f"{kind}.json", "config.yaml")))]
    if report.images:
        images = (Markup('<a href="images/{0}.tiff">{0}.tiff</a>').format(name) for name in report.images)
        rows.append(("Images", Markup(", ").join(images)))
    if facts.backend:
        seed = "" if facts.seed is None else f"{facts.seed}, "
        rows.append(("Seed, backend" if seed else "Backend", f"{seed}{facts.backend}, float64; {facts.seconds:.1f} s"))
    return report_page(report, facts.words, rows)


def write_test(
    kind: str, numbers: Mapping[str, Any], report: Report, facts: RunFacts, folder: run_folder.RunFolder
) -> None:
    """Write all files of a test into an open run folder: config, numbers, report, artefacts, images, manifest.

    Parameters
    ----------
    kind : str
        Kind of the test.
    numbers : mapping
        Numbers of the run, written to KIND.json after their reference frames.
    report : Report
        Report of the test.
    facts : RunFacts
        Facts about the run.
    folder : run_folder.RunFolder
        Open run folder.
    """
    report = replace(report, sections=(*report.sections, *further_sections(kind, numbers)))
    folder.write_text("config.yaml", facts.config)
    folder.write_json(f"{kind}.json", record.described(kind, numbers))
    write_artefacts(report.artefacts, folder)
    for name, whole in report.files.items():
        folder.write_bytes(name, whole)
    for name, frames in report.images.items():
        for file, content in data_files.frame_files(
            name, frames, report.image_facts.get(name, data_files.FrameFacts()), steepness=None
        ):
            folder.write_bytes(file, content)
    folder.write_text("report.html", render_report(kind, report, facts))
    entries = {"test": kind, "backend": facts.backend, "seed": facts.seed or 0, "warnings": list(report.warnings)}
    run_folder.write_manifest(
        folder, facts.program, facts.started, facts.seconds, **entries, **facts.manifest_entries(numbers)
    )
