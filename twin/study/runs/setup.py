"""Setup of a study: its specification, the complete data of its base job, and the tables of its factors."""

import csv
import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from optics.numerics.number_tree import FrozenMap
from scenes.specs.job_tables import HEAT_KEYS
from scenes.specs.load import find_named
from scenes.specs.procedures import BASES, PROCEDURES, studied_commands
from scenes.specs.study import FactorSpec, Scalar, StudySpec
from scenes.yaml import yaml_file
from scenes.yaml.csv_table import lines_of, table_text
from scenes.yaml.errors import InputError, Issue, KeyPath, Problem, key_text, names_text, nearest
from scenes.yaml.input_file import is_file, unusable
from scenes.yaml.spec import Source, Spec, validate
from twin.framework.provenance import source_digest, versions
from twin.study.runs.base_job import BaseJob, ProcedureBase, Tree, is_neutral, with_entry, with_values

PROGRAM = "twin.study"
BY_NAME = ("instrument", "disturbances")
"""Keys of a job that name files whose contents are in the resolved base job.

Changing such a name would have no effect.
"""
WORDS = ("name", "description", "limits", "report")
"""Keys of a study that affect no computed number.

These keys, and the names and units of responses, may be changed when a study is resumed.
"""


@dataclass(frozen=True, eq=False)
class StudySetup:
    """Study with the contents of all files it refers to.

    Attributes
    ----------
    study : StudySpec
        Specification in the study's file, with the values of the tables.
    tree : dict
        Plain data of the base job with an entry at the key of every factor. If the base job has no value there and some
        value has the same effect as its absence, that value is used; else one of the factor's values.
    base : dict
        Plain data of the base job without values of factors: an entry exists only if the base job has one, or one with
        the same effect as its absence.
    """

    study: StudySpec
    tree: Tree
    base: Tree

    @cached_property
    def job(self) -> BaseJob:
        """Command that every run of the study repeats, such as ``twin.render``, with its way of computing a run."""
        return _job(self.study.base.command)

    def to_yaml(self) -> str:
        """Return the text of the study's config.yaml, which ``resolve_study`` reads back to the same values."""
        return yaml_file.dump_yaml({"study": self.study.plain(), "base": self.base})

    @cached_property
    def content(self) -> str:
        """Checksum of everything in the study that affects a number.

        The base job's data contain all library files.
        """
        study = {key: value for key, value in self.study.plain().items() if key not in WORDS}
        study["base"] = {"command": self.study.base.command}
        # in order, because random draws and columns are assigned by position
        study["factors"] = list(study["factors"].items())
        study["responses"] = [
            {k: v for k, v in response.items() if k != "unit"} for response in study["responses"].values()
        ]
        content = json.dumps([study, self.base, self.job.block], sort_keys=True)
        return hashlib.sha256(content.encode()).hexdigest()

    @cached_property
    def fingerprint(self) -> str:
        """Checksum of the content, the program's source files and the versions of its dependencies."""
        return hashlib.sha256(json.dumps([self.content, versions(), source_digest()]).encode()).hexdigest()

    def error(self, problem: Problem | str, key: KeyPath, allowed: str | None = None) -> InputError:
        """Return an InputError whose position is ``key`` in the study's file."""
        if isinstance(problem, str):
            return self.study.error(problem, key, allowed=allowed)
        issue = Issue(problem.problem, "", None, (), problem.value, problem.allowed, problem.suggestion)
        return InputError(self._placed(issue, (*key, *problem.within)))

    def _placed(self, issue: Issue, key: KeyPath) -> Issue:
        """Return an issue of the base job with its position at ``key`` in the study's file."""
        source = self.study.source
        return replace(issue, file=source.file, line=source.line(key), key=(*source.prefix, *key))

    def factor_at(self, key: KeyPath) -> tuple[str, KeyPath] | None:
        """Return name and key of the factor that sets the base job's value at ``key``, or above or below it."""
        for name, factor in self.study.factors.items():
            scaled = [(scale.key, ("scales", k)) for k, scale in enumerate(factor.scales)]
            for changed, where in (*((p, factor.key_of(k)) for k, p in enumerate(factor.key_paths)), *scaled):
                n = min(len(changed), len(key))
                if changed[:n] == tuple(key)[:n]:
                    return name, ("factors", name, *where)
        return None

    def blamed(self, error: InputError) -> InputError:
        """Return an error in the base job's data with its position at the factor that caused it, if there is one."""
        issues = []
        for issue in error.issues:
            factor = self.factor_at(issue.key)
            if factor is not None:
                text = f"{issue.problem} (at {key_text(issue.key)} of the base)"
                issue = self._placed(replace(issue, problem=text), factor[1])
            issues.append(issue)
        return InputError(*issues)


def resolve_study(path: str | Path) -> StudySetup:
    """Read a study and all files it refers to; the config.yaml of an earlier study is also accepted.

    Raises
    ------
    InputError
        A file cannot be read or is invalid, or a factor's key does not exist in the base job.
    """
    return _resolved(yaml_file.read_yaml(path))


def base_of(setup: StudySetup) -> Spec:
    """Return the specification of the study's base job as in its own file, without the factors.

    Raises
    ------
    InputError
        The file has changed since it was read.
    """
    source = setup.study.source
    if source.prefix:  # a study's config.yaml holds it
        below = {key[1:]: line for key, line in source.lines.items() if key[:1] == ("base",)}
        return validate(setup.job.model, yaml_file.YamlFile(source.file, setup.base, below))
    return setup.job.resolve(_base_file(setup.study))


def study_from_text(text: str) -> StudySetup:
    """Return the study that the text of a config.yaml describes, for a worker without access to the study's files."""
    return _resolved(yaml_file.parse_yaml(text))


def _resolved(yaml: yaml_file.YamlFile) -> StudySetup:
    if isinstance(yaml.data, dict) and "study" in yaml.data:
        return _again(yaml)
    study = validate(StudySpec, yaml)
    study = _with_tables(study)
    job = _job(study.base.command)
    tree = job.resolve(_base_file(study)).plain()
    setup = _placed(study, tree)
    size = len(setup.to_yaml().encode())
    if size > yaml_file.LARGEST_BYTES:
        rows = max((len(f.table.values or ()) for f in study.factors.values() if f.table is not None), default=0)
        allowed = (
            f"tables of at most {int(rows * yaml_file.LARGEST_BYTES / size)} rows or fewer columns"
            if rows
            else "fewer values"
        )
        raise study.error("the study with its tables is larger than 1 MB", ("factors",), allowed=allowed)
    return setup


def _again(yaml: yaml_file.YamlFile) -> StudySetup:
    """Return the study that a config.yaml of an earlier study describes."""
    known = ("study", "base")
    for key in yaml.data:
        if key not in known:
            line, allowed = yaml.lines.get((key,)), names_text(known)
            raise InputError(Issue("unknown key", yaml.file, line, (key,), None, allowed, nearest(key, known)))
    if not isinstance(yaml.data.get("base"), dict):
        raise InputError(Issue("the resolved base is missing", yaml.file, 1, ("base",), None, "a study's config.yaml"))
    lines = {key[1:]: line for key, line in yaml.lines.items() if key[:1] == ("study",)}
    study = validate(StudySpec, yaml_file.YamlFile(yaml.file, yaml.data["study"], lines))
    for name, factor in study.factors.items():
        if factor.table is not None and factor.table.values is None:
            raise study.error("the table's values are missing", ("factors", name, "table"))
    placed = study.with_source(Source(yaml.file, yaml.lines, ("study",)))
    assert isinstance(placed, StudySpec)
    study = placed
    model = _job(study.base.command).model
    below = {key[1:]: line for key, line in yaml.lines.items() if key[:1] == ("base",)}
    validate(model, yaml_file.YamlFile(yaml.file, yaml.data["base"], below))
    return _placed(study, yaml.data["base"])


def _base_file(study: StudySpec) -> Path:
    """Return the base job's file: a path relative to the study's, or a name in the library."""
    kind = study.base.command.split()[0]
    return find_named("examples" if kind == "render" else kind, study.base.file, study, ("base", "file"))


def _placed(study: StudySpec, tree: Tree) -> StudySetup:
    """Return the study with an entry in its base job for every factor; validate the factors' extreme values."""
    setup, base = StudySetup(study, tree, tree), tree
    model = setup.job.model
    changed: list[tuple[KeyPath, KeyPath, bool]] = []
    for name, factor in study.factors.items():
        changed += [(key, ("factors", name, *factor.key_of(k)), True) for k, key in enumerate(factor.key_paths)]
    for name, factor in study.factors.items():
        changed += [(s.key, ("factors", name, "scales", k, "key"), False) for k, s in enumerate(factor.scales)]
    for key, at, is_set in changed:
        try:
            _refuse_names(study, key)
            tree = with_entry(tree, model, key, neutral=is_set)
            if is_neutral(base, model, key) and not _inherited(base, key):
                base = with_entry(base, model, key, neutral=is_set)
        except Problem as problem:
            raise setup.error(problem, at) from None
    # an entry created for one factor may need the value of another to be valid
    tree = with_values(tree, [(key, f.scalars()[-1]) for f in study.factors.values() for key in _unset(tree, f)])
    return StudySetup(study, tree, base)


def _inherited(base: Tree, key: KeyPath) -> bool:
    """Return True for a key of a body's temperature if the body inherits it from the heated body that carries it."""
    if key[:2] != ("job", "perturb") or key[3:4] != ("temperature",):
        return False
    perturb, node = base["job"].get("perturb", {}), str(key[2])
    warmed = {path for path, perturbation in perturb.items() if "temperature" in perturbation}
    warmed |= set(base["job"].get("course", {}).get("temperature", {}))
    return node not in warmed and any(node.startswith(f"{path}/") for path in warmed)


def _refuse_names(study: StudySpec, key: KeyPath) -> None:
    """Raise Problem for a factor that would change the name of a file that has already been read."""
    if study.base.command == "render" and key[:1] == ("job",) and key[1:2] and key[1] in BY_NAME:
        text = "this file has already been read, vary its contents instead"
        raise Problem(text, key_text(key), f"a key that begins with {key[1]}, without job", within=(0,))
    if "deformation" in key:
        text = "a table of displaced nodes is part of the base, and a study does not vary it"
        raise Problem(text, key_text(key), "another key of perturb: rotate, shift, scale, figure or temperature")
    if "finishes" in key and key[-1] in ("table", "sha256"):
        raise Problem("a table of a finish is part of the base, and a study does not vary it", key_text(key))
    if "temperature" in key[:-1] and key[-1] in HEAT_KEYS:
        text = "a table of temperatures is part of the base, and a study does not vary it"
        raise Problem(text, key_text(key), "change or gradient, which are added to the table")


def _unset(tree: Tree, factor: FactorSpec) -> list[KeyPath]:
    """Return the key paths of a factor that have no value in the base job yet."""
    out = []
    for key in factor.key_paths:
        node: Any = tree
        for part in key:
            node = node[part]
        if node is None:
            out.append(key)
    return out


def _with_tables(study: StudySpec) -> StudySpec:
    """Return the study in which each factor from a table holds the values of its column."""
    factors = dict(study.factors)
    tables: dict[str, dict[str, list[Any]]] = {}
    named: dict[str, dict[str, KeyPath]] = {}
    for name, factor in study.factors.items():
        if factor.table is not None and factor.table.values is None:
            named.setdefault(factor.table.file, {})[factor.table.column] = ("factors", name, "table")
    for name, factor in study.factors.items():
        if factor.table is None or factor.table.values is not None:
            continue
        key: KeyPath = ("factors", name, "table")
        table = factor.table
        if table.file not in tables:
            path = Path(study.source.file).parent / table.file
            tables[table.file] = _read_table(study, path, key, named[table.file])
        columns = tables[table.file]
        new = factor.model_copy(update={"table": table.model_copy(update={"values": tuple(columns[table.column])})})
        try:
            new.numbers()
        except Problem as problem:
            raise StudySetup(study, {}, {}).error(problem, ("factors", name)) from None
        factors[name] = new
    out = study.model_copy(update={"factors": FrozenMap(factors)}).with_source(study.source)
    assert isinstance(out, StudySpec)
    return out


LARGEST_TABLE = 100_000_000
"""Largest size of the file of a table with factor values, bytes."""
MOST_CELLS = 90_000
"""Largest number of cells of all tables with factor values together.

The config.yaml of the study holds them, with at most 100 000 keys and values.
"""


def _read_table(study: StudySpec, path: Path, key: KeyPath, named: Mapping[str, KeyPath]) -> dict[str, list[Any]]:
    """Return the named columns of a CSV file: column -> its values.

    ``named`` gives for each column the key of the study's file that names it, for error messages. The file is read row
    by row, so that only its text and these columns are held in memory.
    """

    def wrong(text: str, allowed: str) -> InputError:
        return study.error(text, (*key, "file"), allowed=allowed)

    def checked(number: int, cells: Sequence[str]) -> None:
        if any(yaml_file.UNWRITABLE.search(cell) for cell in cells):
            raise wrong(f"row {number} of the table {path}: {yaml_file.NO_TEXT}", yaml_file.WRITABLE)

    if not is_file(path):
        raise wrong(unusable(path), "a CSV file, relative to this file")
    rows = (row for row in csv.reader(lines_of(table_text(path, most=LARGEST_TABLE))) if row)
    columns: dict[str, list[Any]] = {}
    try:
        heads = [head.strip() for head in next(rows, [])]
        if heads and (missing := [column for column in named if column not in heads]):
            text, allowed, meant = "no such column", names_text(heads), nearest(missing[0], heads)
            key_path = (*named[missing[0]], "column")
            raise study.error(text, key_path, value=missing[0], allowed=allowed, suggestion=meant)
        checked(1, heads)
        # of columns of one name the last
        column_of = {head: k for k, head in enumerate(heads) if head in named}
        columns = {head: [] for head in column_of}
        most = MOST_CELLS // max(len(column_of), 1)
        for number, row in enumerate(rows, 2):
            if len(row) != len(heads):
                text = f"row {number} of the table {path} has {len(row)} cells, the first {len(heads)}"
                raise wrong(text, "as many cells in every row as names in the first")
            if number > most + 1:
                allowed = f"at most {most} with {len(column_of)} of its columns; draw from a distribution beyond that"
                raise wrong(f"the table {path} has too many rows for a study", allowed)
            checked(number, [row[k] for k in column_of.values()])
            for head, k in column_of.items():
                columns[head].append(_cell(row[k]))
    except csv.Error as error:
        raise wrong(f"the table {path} cannot be read: {error}", "a CSV file") from None
    if not any(columns.values()):
        raise wrong(f"the table {path} has no rows", "names, then a row or more")
    return columns


_SCALAR: TypeAdapter[Any] = TypeAdapter(Scalar)
_PLAIN = re.compile(r"[-+]?\.?[0-9A-Za-z][-+0-9A-Za-z._/^() ]*")
"""Regular expression for most of the table cells that YAML reads as a plain scalar."""


def _cell(text: str) -> Any:
    """Return a text from a table's cell as YAML would read it: number, true, false or text."""
    try:
        if _PLAIN.fullmatch(text):
            return _SCALAR.validate_python(yaml_file.plain_scalar(text.strip()))
        data = yaml_file.parse_yaml(f"- {json.dumps(text) if ':' in text or '#' in text else text}").data[0]
        return _SCALAR.validate_python(data)
    except (InputError, ValidationError):
        return text


def _job(command: str) -> BaseJob:
    """Return the base job for a command's name: one of `BASES`, or a test of `PROCEDURES` that can be varied.

    Raises
    ------
    InputError
        This version of the program does not have it.
    """
    if command in BASES:
        job: BaseJob = BASES[command]()
        return job
    if command not in studied_commands():
        allowed = ", ".join(studied_commands())
        raise InputError(Issue(f"this version of the twin cannot run {command!r} in a study", allowed=allowed))
    return ProcedureBase(PROCEDURES[command])
