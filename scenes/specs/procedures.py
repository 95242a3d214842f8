"""Tests that commands run: for each its files, its computation, its results and its report.

Commands and their help, the JSON Schemas, studies, the documentation and `twin.perform` use this table. A function of a
test is imported on first use: help and messages about files do not wait for numerical modules, and computations do not
wait for plotting modules.
"""

import csv
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from optics.numerics.extension_table import ExtensionTable
from optics.numerics.number_tree import FrozenMap
from scenes.yaml.named import FileKind, Named


@dataclass(frozen=True)
class Procedure:
    """Test that a command runs, with a report, and whose results a study can use.

    Functions and the set-up may be given as names for `Named`. The modules that ``run`` and ``numbers`` need neither
    plot nor fill templates.

    Attributes
    ----------
    kind : str
        Name of the result file without .json, for example ``focus``.
    setup : type or callable
        Class, derived from `ExperimentSetup`, that holds the simulated test with the content of all its files; or a
        function that reads the file.
    run : callable
        Function from set-up, backend, seed and progress to the complete result. Raises InputError, BenchError.
    numbers : callable
        Function from the result to the plain data of KIND.json, whose keys end in their unit.
    report : callable
        Function from the result to a `twin.framework.report.Report`.
    measured : tuple of types
        Classes of the tests on measurements, chosen by the keys of the file.
    export : callable or None
        Function from the result to paths and contents of files with the measured data, for the option ``--export``;
        None if there is none.
    files : tuple[FileKind, ...]
        Kinds of file that the test reads beside those in file_kinds.csv.
    varied : bool
        True if a study can vary the test.
    judged : bool
        True if the user is warned of cameras that are blurred even as designed.
    seeded : bool
        True if the test draws random numbers; config.yaml then has the seed.
    options : tuple[str, ...]
        Options of the command that are named arguments of ``run``, True or False; `twin.perform` takes them as well.
    about : str
        Text of ``--help`` in Markdown; its first paragraph is shown in the list of subcommands.
    frames : Mapping[str, str]
        Quantity of KIND.json -> its reference frame, where `twin.framework.record` has none.
    """

    kind: str
    setup: Any
    run: Any
    numbers: Any
    report: Any
    measured: tuple[Any, ...] = ()
    export: Any = None
    files: tuple[FileKind, ...] = ()
    varied: bool = False
    judged: bool = True
    seeded: bool = True
    options: tuple[str, ...] = ()
    about: str = ""
    frames: Mapping[str, str] = field(default_factory=FrozenMap)

    def __post_init__(self) -> None:
        """Replace names of functions by references that import them on first use."""
        for name in ("run", "numbers", "report", "export"):
            if isinstance(path := getattr(self, name), str):
                object.__setattr__(self, name, Named(path))

    @property
    def model(self) -> Any:
        """Class that holds the simulated test with the content of all its files."""
        return Named(self.setup).get() if isinstance(self.setup, str) else self.setup

    def resolve(self, path: Path | str, *named: str | None) -> Any:
        """Read a test's file and all files to which it refers.

        Parameters
        ----------
        path : Path | str
            Path of its file or of a run's config.yaml, or name of a test in the library.
        named : str | None
            Further arguments of a function that reads the set-up.

        Raises
        ------
        InputError
            A file cannot be read or is not valid, or the files do not fit together.
        """
        for source in self.measured:
            measured = Named(source).get()
            if measured.measured_by(Named("scenes.specs.resolved:test_keys")(path)):
                return measured.read(path)
        return getattr(self.model, "read", self.model)(path, *named)


BASES: dict[str, Named] = {
    # a study imports only the modules of its base, which halves the start-up time of a worker
    "render": Named("twin.study.runs.render_base:RenderBase"),
    "tolerance": Named("twin.tolerance.samples:ToleranceBase"),
}
"""Command -> class that evaluates many of its runs at once for a study; other tests run one after the other."""


def studied_commands() -> tuple[str, ...]:
    """Return the commands that a study can vary."""
    return (*BASES, *(name for name, procedure in PROCEDURES.items() if procedure.varied))


SENSORS = ("ties", "control", "monitor", "laser", "terrain", "tracker_angles")
"""Sensors that the adjustment of a block can exclude; the command's help lists them."""


def _built_in() -> dict[str, Procedure]:
    """Return the tests of the table beside this module, with the texts of ``--help`` from the file of that name."""
    text = Path(__file__).with_suffix(".md").read_text("utf-8")
    about = dict(section.split("\n", 1) for section in text.split("\n## ")[1:])
    tests = {}
    with Path(__file__).with_suffix(".csv").open(encoding="utf-8", newline="") as rows:
        for row in csv.DictReader(rows):
            name = row.pop("command")
            values: dict[str, Any] = {**row, "export": row["export"] or None, "about": about.get(name, "").strip()}
            values |= {key: tuple(row[key].split()) for key in ("measured", "options")}
            values |= {key: row[key] == "yes" for key in ("varied", "judged", "seeded")}
            tests[name] = Procedure(**values)
    return tests


PROCEDURES = ExtensionTable("procedures", _built_in(), Procedure)
"""Command without the leading ``twin.`` -> test. A new test has its modules, a row of procedures.csv and its help."""
