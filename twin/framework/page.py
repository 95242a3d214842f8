"""Templates of the reports, their Content-Security-Policy, artefacts as they want them, and the run folder of a test.

A report holds texts of a user's files, and is opened from a folder or sent to somebody. All texts are escaped where
they are put in; the policy is there for the day on which one is not. It allows what the page is made of, each piece by
its checksum, and nothing else: no file beside it, no network, no form, no script that somebody's text brought along.

One thing is as loose as it has to be: ``style`` attributes are allowed, since Matplotlib gives every line of a figure
one. They can change how a page looks, and load nothing.
"""

from __future__ import annotations

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

from twin.framework import data_files, provenance, reference_frames, run_folder
from twin.framework.artefact import Artefact
from twin.framework.report import Report, further_sections

FIGURES = "*{stroke-linejoin: round; stroke-linecap: butt}"
"""The style sheet that Matplotlib writes into every figure."""
NOTHING: Mapping[str, str] = {"default-src": "'none'", "base-uri": "'none'", "form-action": "'none'"}


def checksum(text: str) -> str:
    """The source expression of one inline script or style sheet.

    Parameters
    ----------
    text : str
        All that stands between its tags.
    """
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode('ascii')}'"


def page_policy(style: str, programs: Iterable[str] = ()) -> str:
    """The policy of a page that needs no other file.

    Parameters
    ----------
    style : str
        Its style sheet, all that stands between the tags.
    programs : Iterable[str]
        Scripts that it holds, likewise, and scripts that these put in.
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
    """Directives as one text."""
    return "; ".join(f"{name} {sources}" for name, sources in directives.items())


def inline(text: str) -> Markup:
    """A text for a page, escaped; what stands between backticks is code."""
    return text if isinstance(text, Markup) else Markup(_CODE.sub(r"<code>\1</code>", str(escape(text))))


_CODE = re.compile("`([^`]+)`")


@cache
def _template() -> Template:
    loader = FileSystemLoader(str(files(__package__)))
    made = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    made.globals["page_policy"], made.filters["inline"] = page_policy, inline
    return made.get_template("page.html.j2")


def reproduce(words: Sequence[str]) -> str:
    """The command line of a program, its subcommand and options that makes a run again, as one types it."""
    return f"python -m {shlex.join(words)} --out again"


@dataclass(frozen=True)
class RunFacts:
    """How a test was run.

    Attributes
    ----------
    config : str
        The test with all it refers to, as YAML; it can be given in place of the test's file.
    program : str
        That ran it, as the user calls it.
    started : float
        Seconds since the epoch.
    seconds : float
        That it took.
    backend : str
        Where it was traced; empty where nothing was.
    seed : int | None
        Of everything that is drawn; None where nothing is.
    command : str
        Its subcommand.
    options : tuple[str, ...]
        Further options of the command that runs it again.
    again : tuple[str, ...]
        Words of the command that runs it again, program first, where it is not the test with the run's own config.yaml.
    named : Any
        Plain data in which files stand that the run read, by their absolute paths.
    given : tuple[Path, ...]
        Further files and folders that it read, as the user gave them.
    checks : tuple[provenance.SelfCheck, ...]
        What it checked of itself beside what stands in its numbers.
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
    given: tuple[Path, ...] = ()
    checks: tuple[provenance.SelfCheck, ...] = ()

    @property
    def words(self) -> tuple[str, ...]:
        """Words of the command that makes the run again in its folder."""
        if self.again:
            return self.again
        seed = () if self.seed is None else ("--seed", str(self.seed))
        command = (self.command,) if self.command else ()
        return (self.program, *command, "config.yaml", *self.options, *seed, "--backend", self.backend)

    def kept(self, numbers: Mapping[str, Any]) -> dict[str, Any]:
        """What a manifest says of it: how to make it again, what was read, what it checked of itself.

        Parameters
        ----------
        numbers : Mapping[str, Any]
            Of the run.
        """
        place = {"started_in": str(Path.cwd())} if self.given else {}
        checks = [check.to_dict() for check in self.checks or provenance.checks_in(numbers)]
        return {
            "again": list(self.words),
            **place,
            "inputs": provenance.inputs_in(self.named, self.given),
            "checks": checks,
        }


def write_artefacts(artefacts: Iterable[Artefact], folder: run_folder.RunFolder) -> None:
    """Write artefacts that have files of their own into an open run folder.

    Parameters
    ----------
    artefacts : Iterable[Artefact]
        Of a report.
    folder : run_folder.RunFolder
        open.
    """
    for artefact in artefacts:
        if artefact.within is None:
            folder.write_bytes(artefact.file, artefact.content())


def links(names: Iterable[str]) -> Markup:
    """Files of the run folder, for the last table of a page."""
    return Markup(", ").join(Markup('<a href="{0}">{0}</a>').format(name) for name in names)


def report_page(
    report: Report,
    words: Sequence[str],
    rows: Sequence[tuple[str, str]] = (),
    config: str = "",
    programs: Sequence[str] = (),
    scripts: str = "",
) -> str:
    """A report as one page that needs no other file.

    Parameters
    ----------
    report : Report
        What it says.
    words : Sequence[str]
        Of the command that makes the run again, program first.
    rows : Sequence[tuple[str, str]]
        Of its last table, (label, text), before the versions.
    config : str
        All that was resolved, for readers; empty if the page does not show it.
    programs : Sequence[str]
        Scripts of its own that the page may run, as the policy wants them.
    scripts : str
        The elements that hold them, written by this program.
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
    """``report.html`` of a test as text; its numbers are in KIND.json.

    Parameters
    ----------
    kind : str
        Of the test.
    report : Report
        What it says.
    facts : RunFacts
        How it was run.
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
    """Write everything into an open run folder: config, numbers, report, artefacts, images, the manifest.

    Parameters
    ----------
    kind : str
        Of the test.
    numbers : Mapping[str, Any]
        Of its run; KIND.json gets them after their frames.
    report : Report
        Of the test.
    facts : RunFacts
        How it was run.
    folder : run_folder.RunFolder
        open.
    """
    report = replace(report, sections=(*report.sections, *further_sections(kind, numbers)))
    folder.write_text("config.yaml", facts.config)
    folder.write_json(f"{kind}.json", reference_frames.described(kind, numbers))
    write_artefacts(report.artefacts, folder)
    for name, whole in report.files.items():
        folder.write_bytes(name, whole)
    for name, frames in report.images.items():
        for file, content in data_files.frame_files(
            name, frames, report.image_facts.get(name, data_files.FrameFacts()), stretch=None
        ):
            folder.write_bytes(file, content)
    folder.write_text("report.html", render_report(kind, report, facts))
    entries = {"test": kind, "backend": facts.backend, "seed": facts.seed or 0, "warnings": list(report.warnings)}
    run_folder.write_manifest(folder, facts.program, facts.started, facts.seconds, **entries, **facts.kept(numbers))
