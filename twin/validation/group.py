"""Groups of checks that share work, their context, and the YAML files with the checks and the printed values.

Keys of numbers end in the unit in which the paper prints them, so that they are read as printed and converted where
they are used. The section ``groups`` of a file holds the checks by group and id, with the keys of `Check`; a check's
``printed`` is a number, or the dotted key of one in the same file.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, wraps
from pathlib import Path
from typing import Annotated, Any

from pydantic import ConfigDict, Field

from optics.numerics.backend import Backend
from optics.numerics.number_tree import FrozenMap
from scenes.specs.job import JobSpec
from scenes.specs.resolved import resolve_job
from scenes.yaml.errors import InputError, Issue, KeyPath, nearest
from scenes.yaml.spec import Number, Spec, Text, validate
from scenes.yaml.yaml_file import YamlFile, read_yaml
from twin.framework.artefact import Artefact, Cell, Data, PngFigure, SvgFigure, Table
from twin.framework.svg import look, new_figure, plain_axes, to_svg
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.validation.check import Check, CheckResult, Chosen, Supposed, sentence
from twin.validation.row_names import FILE, FOLDER, REAL, matches


class ArtefactText(Spec):
    """Title, caption and column heads of a figure or a table of a group of checks.

    Computed values (facts) named in braces are inserted when it is shown; the attributes are those of `Table`.
    """

    title: Text
    caption: Text = ""
    heads: tuple[Text, ...] = ()
    decimals: tuple[int | None, ...] = ()


@dataclass(eq=False)
class Context:
    """Context in which the function of a group computes its checks.

    Attributes
    ----------
    backend : Backend
        Backend of the ray trace.
    seed : int
        Seed of all noise; the same seed gives the same results.
    fast : bool
        True for fewer trials; the verdicts must not depend on it.
    selected : frozenset of str
        Ids that are requested; others need no work, and their results are discarded.
    checks : mapping of str to Check
        All checks of the group by id.
    report_progress : callable
        Function that takes the fraction of the group's work that is done, and the name of the present work.
    folder : Path or None
        Folder for files of the group, which the report lists; None if nothing is written.
    real : Path
        Folder of the measured data of others.
    experiments : dict of str to MonitorExperiment
        Monitoring experiments by instrument, shared by all groups.
    texts : mapping of str to ArtefactText
        Texts of the group's figures and tables by name.
    artefacts : list of Artefact
        Figures, tables and data added so far.
    """

    backend: Backend
    seed: int
    selected: frozenset[str]
    checks: Mapping[str, Check]
    fast: bool = False
    report_progress: Callable[[float, str], None] = lambda fraction, text: None
    folder: Path | None = None
    real: Path = Path()
    experiments: dict[str, MonitorExperiment] = field(default_factory=dict)
    texts: Mapping[str, ArtefactText] = FrozenMap()
    artefacts: list[Artefact] = field(default_factory=list)

    def wants(self, *prefixes: str) -> bool:
        """Return True if the id of a selected check begins with one of the prefixes."""
        return any(matches(identifier, prefix) for identifier in self.selected for prefix in prefixes)

    def count(self, full: int, fast: int) -> int:
        """Return the number of trials: ``full``, or ``fast`` in the fast run."""
        return fast if self.fast else full

    def check(self, identifier: str) -> Check:
        """Return one of the group's checks.

        Raises
        ------
        KeyError
            The group has no check of that id.
        """
        return self.checks[identifier]

    def progress(self, fraction: float, text: str) -> None:
        """Report the fraction of the group's work that is done, from 0 to 1, and the next step."""
        self.report_progress(min(max(fraction, 0.0), 1.0), text)

    def experiment(self, instrument: str) -> MonitorExperiment:
        """Return the monitoring experiment on an instrument of the library, built once for all groups."""
        if instrument not in self.experiments:
            self.experiments[instrument] = MonitorExperiment(resolve_job(JobSpec(instrument=instrument)), self.backend)
        return self.experiments[instrument]

    def add(self, artefact: Artefact) -> None:
        """Add a figure, table or data to the report and the run folder.

        Raises
        ------
        ValueError
            The group already has an artefact of that name.
        """
        if any((artefact.name, artefact.kind) == (other.name, other.kind) for other in self.artefacts):
            raise ValueError(f"two artefacts {artefact.name}.{artefact.kind} in one group")
        self.artefacts.append(artefact)

    def figure(self, name: str, drawing: str | bytes, **facts: object) -> None:
        """Add a drawing (SVG or PNG) to the report, with the title and caption from the group's file."""
        texts = self._worded(name, facts)
        self.add(SvgFigure(name, *texts, drawing) if isinstance(drawing, str) else PngFigure(name, *texts, drawing))

    def table(self, name: str, rows: Sequence[Sequence[Cell]], **facts: object) -> None:
        """Add a table to the report, with the title, caption and column names from the group's file."""
        text = self.texts[name]
        self.add(Table(name, *self._worded(name, facts), text.heads, rows, text.decimals))

    def data(self, name: str, content: dict[str, Any]) -> None:
        """Add data to the report's downloads, with the title and caption from the group's file."""
        self.add(Data(name, *self._worded(name, {}), content))

    def _worded(self, name: str, facts: Mapping[str, Any]) -> tuple[str, str]:
        text = self.texts[name]
        return sentence(text.title, facts), sentence(text.caption, facts)

    def row(
        self,
        identifier: str,
        measured: float,
        sigma: float | None = None,
        implied: float | None = None,
        explained: Sequence[float | None] = (),
        inputs: Sequence[Chosen | Supposed] = (),
        **facts: object,
    ) -> CheckResult:
        """Return the result of one of the group's checks for a simulated value.

        The arguments are those of `Check.evaluate`; values for the texts are passed by name.
        """
        return self.checks[identifier].evaluate(measured, sigma, "", implied, explained, inputs, facts)


Run = Callable[[Context], Iterable[CheckResult]]


@dataclass(frozen=True)
class CheckGroup:
    """Group of checks that share work.

    Attributes
    ----------
    prefix : str
        Name of the group, beginning with the paper's number; the common prefix of its ids, if there is one.
    title : str
        Subject, for the report.
    seconds : float
        Approximate computing time on two cores.
    checks : tuple of Check
        All checks of the group.
    run : Run
        Function that yields one result for every selected check as soon as it is known.
    fast_seconds : float or None
        Approximate time of the fast run; None if it is the same.
    artefacts : mapping of str to ArtefactText
        Texts of figures and tables by name.
    """

    prefix: str
    title: str
    seconds: float
    checks: tuple[Check, ...]
    run: Run
    fast_seconds: float | None = None
    artefacts: Mapping[str, ArtefactText] = FrozenMap()

    def __post_init__(self) -> None:
        """Raise an error for groups with ids that cannot be distinguished, or with texts that cannot be shown."""
        if not self.checks or self.seconds <= 0 or (self.fast_seconds is not None and self.fast_seconds <= 0):
            raise ValueError(f"group {self.prefix!r} needs checks and a rough time > 0")
        if not self.prefix.replace(".", "").replace("_", "").isalnum():
            raise ValueError(f"group prefix {self.prefix!r}: only letters, digits, _ and dots can be used")
        if any(check.paper != self.prefix.partition(".")[0] for check in self.checks):
            raise ValueError(f"group {self.prefix!r} holds checks of another paper")

    def rough_seconds(self, fast: bool) -> float:
        """Return the approximate computing time of the full or the fast run."""
        return self.seconds if self.fast_seconds is None or not fast else self.fast_seconds

    @property
    def ids(self) -> tuple[str, ...]:
        """Main ids of the group's checks."""
        return tuple(check.id for check in self.checks)


_Seconds = Annotated[Number, Field(gt=0.0)]


class GroupRows(Spec):
    """Checks of one group as they are in the paper's file.

    The attributes are those of `CheckGroup`, and ``sentences``: texts by name, which may be named in braces in the
    ``how`` of several checks, or in a later one of these texts.
    """

    title: Text
    seconds: _Seconds
    fast_seconds: _Seconds | None = None
    sentences: Mapping[str, Text] = FrozenMap()
    artefacts: Mapping[str, ArtefactText] = FrozenMap()
    rows: dict[str, Check]


class PaperRows(Spec):
    """Checks in a paper's file, whose other keys are the printed values."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    groups: dict[str, GroupRows]


@dataclass(frozen=True, eq=False)
class Printed:
    """Printed values of a paper, by dotted keys such as ``table1.mtf_nyquist``.

    Every reader raises InputError, with file, line and key, for a name that does not exist or whose value is of another
    kind.
    """

    content: YamlFile

    def number(self, key: str) -> float:
        """Return the printed number at a key, in the unit with which the key ends."""
        return self._number(_path(key), self._at(key))

    def whole(self, key: str) -> int:
        """Return the printed integer at a key."""
        value = self._at(key)
        if not isinstance(value, int) or isinstance(value, bool):
            raise self._error(_path(key), "no whole number", value)
        return value

    def column(self, key: str) -> tuple[float, ...]:
        """Return the printed list of numbers at a key, in the unit with which the key ends."""
        return self._column(_path(key), self._at(key))

    def numbers(self, key: str) -> Mapping[str, float]:
        """Return the printed numbers of all entries below a key, by name, in the order of the file."""
        return FrozenMap({k: self._number((*_path(key), k), v) for k, v in self._mapping(key).items()})

    def columns(self, key: str) -> Mapping[str, tuple[float, ...]]:
        """Return the printed lists of numbers of all entries below a key, by name, in the order of the file."""
        return FrozenMap({k: self._column((*_path(key), k), v) for k, v in self._mapping(key).items()})

    @cached_property
    def groups(self) -> Mapping[str, GroupRows]:
        """Prefix of each group -> its checks, in the order of the file, validated."""
        return FrozenMap(validate(PaperRows, replace(self.content, data=self._named(self.content.data))).groups)

    def group(self, prefix: str, run: Run) -> CheckGroup:
        """Return the group with a prefix, whose checks the function ``run`` computes.

        Raises
        ------
        InputError
            There is no such group.
        """
        if prefix not in self.groups:
            known = nearest(prefix, self.groups)
            raise InputError(Issue(f"no group {prefix!r}", self.content.file, key=("groups",), suggestion=known))
        group_rows = self.groups[prefix]
        rows = tuple(group_rows.rows.values())
        return CheckGroup(
            prefix, group_rows.title, group_rows.seconds, rows, run, group_rows.fast_seconds, group_rows.artefacts
        )

    def _named(self, data: Any) -> Any:
        """Return the data of a group with the id and the shared sentences inserted into each check.

        The key of a printed value is replaced by its number.
        """
        groups = data.get("groups") if isinstance(data, dict) else None
        if not isinstance(groups, dict):
            return data
        named: dict[str, Any] = {}
        for prefix, group in groups.items():
            rows = group.get("rows") if isinstance(group, dict) else None
            if isinstance(rows, dict):
                shared = group.get("sentences", {})
                group = {**group, "rows": {name: self._row(name, row, shared) for name, row in rows.items()}}
            named[prefix] = group
        return {**data, "groups": named}

    def _row(self, name: str, row: Any, shared: Any) -> Any:
        if not isinstance(row, dict):
            return row
        out = {**row, "id": name}
        if isinstance(row.get("printed"), str):
            out["printed"] = self.number(row["printed"])
        if isinstance(row.get("how"), str) and isinstance(shared, dict):
            for key, text in reversed(shared.items()):
                out["how"] = out["how"].replace(f"{{{key}}}", str(text))
        return out

    def _at(self, key: str) -> Any:
        value, path = self.content.data, _path(key)
        for depth, part in enumerate(path):
            if not isinstance(value, dict) or part not in value:
                known = value if isinstance(value, dict) else {}
                parent = path[:depth]
                raise InputError(
                    Issue(
                        f"nothing is printed as {part!r}",
                        self.content.file,
                        self.content.lines.get(parent),
                        parent,
                        suggestion=nearest(str(part), known),
                    )
                )
            value = value[part]
        return value

    def _mapping(self, key: str) -> dict[str, Any]:
        value = self._at(key)
        if not isinstance(value, dict):
            raise self._error(_path(key), "no mapping", value)
        return value

    def _column(self, path: KeyPath, value: Any) -> tuple[float, ...]:
        if not isinstance(value, list):
            raise self._error(path, "no list", value)
        return tuple(self._number((*path, k), item) for k, item in enumerate(value))

    def _number(self, path: KeyPath, value: Any) -> float:
        if not isinstance(value, int | float) or isinstance(value, bool):
            raise self._error(path, "no number", value)
        return float(value)

    def _error(self, path: KeyPath, problem: str, value: Any) -> InputError:
        return InputError(Issue(problem, self.content.file, self.content.lines.get(path), path, value=repr(value)))


@cache
def load_printed(paper: str) -> Printed:
    """Return the printed values of a paper.

    Parameters
    ----------
    paper : str
        Number of the paper, for instance "001", or `REAL`.

    Raises
    ------
    InputError
        There is no file of that paper, or it cannot be read.
    """
    return Printed(read_yaml(FOLDER / (paper if paper == REAL else f"paper_{paper}") / FILE))


def group_of(prefix: str, run: Run = lambda context: ()) -> CheckGroup:
    """Return a group by its prefix, with the checks in its paper's file and the function that computes them.

    Raises
    ------
    InputError
        There is no file of that paper, it cannot be read, or it has no such group.
    """
    return load_printed(prefix.partition(".")[0]).group(prefix, run)


Draw = Callable[..., None]


def drawing(
    name: str | Callable[..., str], height: float | Callable[..., float]
) -> Callable[[Draw], Callable[..., str]]:
    """Return a decorator for a function that draws into a Matplotlib figure: the decorated one returns the SVG.

    Parameters
    ----------
    name : str or callable
        Name that makes the SVG's identifiers unique.
    height : float or callable
        Height of the figure, in inches; both may be functions of the drawn values.
    """

    def decorate(draw: Draw) -> Callable[..., str]:
        @wraps(draw)
        def drawn(*shown: Any) -> str:
            with look(name(*shown) if callable(name) else name):
                figure = new_figure(height(*shown) if callable(height) else height)
                draw(figure, *shown)
                for axes in figure.axes:
                    plain_axes(axes)
                return to_svg(figure)

        return drawn

    return decorate


def _path(key: str) -> KeyPath:
    return tuple(key.split("."))
