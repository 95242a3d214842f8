"""Commands of the twin run from a Python script, with their results as Python objects."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from html import escape
from pathlib import Path
from typing import Any

import pandas as pd

from analysis.arrays import shows
from optics.numerics.backend import load_backend
from scenes.specs.procedures import PROCEDURES, Procedure
from scenes.yaml.errors import InputError, Issue, unknown
from scenes.yaml.spec import Source, Spec, validate
from scenes.yaml.yaml_file import YamlFile
from twin.framework.artefact import cell_text
from twin.framework.page import RunFacts, write_test
from twin.framework.procedure import performed, seeded
from twin.framework.report import Report, with_warnings
from twin.framework.run_folder import RunFolder


@shows("name", "report.verdict", "report.warnings")
@dataclass(frozen=True, eq=False)
class TestResult:
    """Result of a finished test or procedure that ``perform`` has run.

    Attributes
    ----------
    name : str
        Name of the test or procedure as given to ``perform``, such as ``lab focus``.
    numbers : Mapping[str, Any]
        Content of the result file of a run folder, such as ``focus.json``; keys end in their unit.
    report : Report
        Verdict, tables and figures.
    setup : Spec
        The test with the content of all files that it refers to.
    run : object
        All computed results; the class depends on the test.
    """

    name: str
    numbers: Mapping[str, Any] = field(repr=False)
    report: Report = field(repr=False)
    setup: Spec = field(repr=False)
    run: Any = field(repr=False)
    _facts: RunFacts = field(repr=False)
    _kind: str = field(repr=False)

    __test__ = False  # for pytest, which looks for tests by this name

    @property
    def summary(self) -> pd.DataFrame:
        """Main table of the test's report, as a data frame."""
        table = self.report.summary
        return pd.DataFrame([[cell_text(cell) for cell in row] for row in table.shown()], columns=list(table.heads))

    def save(self, folder: str | Path, force: bool = False) -> Path:
        """Write the run folder that the command would write.

        Parameters
        ----------
        folder : str or Path
            Folder to create.
        force : bool
            Whether an existing run folder is replaced.

        Raises
        ------
        RunFolderError
            The folder exists or cannot be written.
        """
        with RunFolder(Path(folder), force) as target:
            write_test(self._kind, self.numbers, self.report, self._facts, target)
        return target.target

    def _repr_html_(self) -> str:
        lead = "".join(f"<p>{escape(line)}</p>" for line in (self.report.verdict, *self.report.lead))
        notes = "".join(f"<p>⚠ {escape(text)}</p>" for text in self.report.warnings)
        return f"<h4>{escape(self.report.title)}</h4>{lead}{self.summary.to_html(index=False)}{notes}"


def perform(
    name: str, file: str | Path, *, seed: int | None = None, backend: str = "llvm", **changes: Any
) -> TestResult:
    """Run the procedure of a command, such as ``lab focus``, on its input file.

    Parameters
    ----------
    name : str
        ``camera``, ``recover``, ``tolerance``, ``uncertainty``; or any of ``lab``, ``orbit`` (except export),
        ``design`` and ``asbuilt`` with its subcommand, such as ``lab focus``.
    file : str or Path
        Path of the test's file, or its name in the library.
    seed : int or None
        Seed of all random numbers; by default that of the file.
    backend : str
        Backend that traces the rays, ``llvm`` or ``cuda``.
    changes : keyword arguments
        Keys of the test's file with other values, for ``camera`` and ``uncertainty`` those of the run's config.yaml; a
        mapping replaces single keys of a mapping. A key that refers to another file, such as ``camera``, is read anew.
        For ``camera`` also its options ``refocus=True`` and, with it, ``tilt=True``.

    Raises
    ------
    InputError
        No such test, file or key; or the simulated test failed, with the key to be changed.
    """
    if name not in PROCEDURES:
        raise InputError(unknown("no such test", name, PROCEDURES).at())
    procedure = PROCEDURES[name]
    chosen = {key: changes.pop(key) for key in procedure.options if key in changes}
    procedure = _with_options(procedure, chosen)
    setup = procedure.resolve(file)
    if changes:
        tree, test = setup.plain(), getattr(setup, "test", None)
        tree = _merged(tree, changes if test is None else {"test": changes})
        setup = validate(type(setup), YamlFile("", tree, {}))
        if test is not None:
            changed = setup.test.with_source(Source(test.source.file))
            setup = setup.model_copy(update={"test": changed})
            if any(key in type(setup).model_fields for key in changes):  # another camera, turntable, instrument
                setup = type(setup).model_construct(**{"test": changed, **type(setup).parts(changed)}).checked()
    setup, number, options = seeded(procedure, setup, seed)
    started, clock = time.time(), time.monotonic()
    run, warnings = performed(procedure, setup, load_backend(backend), number)
    seconds = time.monotonic() - clock
    report = with_warnings(procedure.report(run), warnings)
    program, _, command = name.partition(" ")
    run_times = (f"twin.{program}", started, seconds, backend)
    options |= {"options": tuple(f"--{key}" for key, value in chosen.items() if value), "checks": report.checks}
    facts = RunFacts(options.pop("config"), *run_times, command=command, **options)
    numbers = report.with_verdict(procedure.numbers(run))
    return TestResult(name, numbers, report, setup, run, facts, procedure.kind)


def _with_options(procedure: Procedure, chosen: Mapping[str, Any]) -> Procedure:
    """Return the procedure of a command with some of its options set; raise `InputError` where they are not allowed."""
    for key, value in chosen.items():
        if not isinstance(value, bool):
            raise InputError(Issue("an option is set or not", key=(key,), found=repr(value), allowed="True or False"))
    if chosen.get("tilt") and not chosen.get("refocus"):
        raise InputError(Issue("tilt goes with refocus", key=("tilt",), allowed="refocus=True, tilt=True"))
    # a refocused camera is not judged: its verdict states its image quality
    judged = procedure.judged and not chosen.get("refocus")
    return replace(procedure, run=partial(procedure.run, **chosen), judged=judged) if chosen else procedure


def _merged(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return nested mappings with the values of ``changes`` replaced in ``base``; other keys keep their values."""
    out = dict(base)
    for key, value in changes.items():
        inner = out.get(key)
        out[key] = _merged(inner, value) if isinstance(value, Mapping) and isinstance(inner, Mapping) else value
    return out
