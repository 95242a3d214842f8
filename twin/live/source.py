"""What the live twin is opened with: an instrument, a job, a run folder, or a study whose factors become knobs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from scenes.kinds.file_kinds import kind_of, read_for
from scenes.specs.job import JobSpec
from scenes.specs.load import INSTRUMENTS, library_names
from scenes.specs.resolved import ResolvedJob, resolve, resolve_job
from scenes.specs.study import DesignSpec
from scenes.specs.study_factor import FactorSpec
from scenes.yaml.errors import InputError, Issue, KeyPath, Problem, names_text, nearest
from scenes.yaml.translate import validate
from scenes.yaml.units import split_quantity, unit_ratio, with_unit
from scenes.yaml.yaml_file import YamlFile, read_yaml
from twin.live.knobs import AXES, KINDS, knob_name
from twin.study.runs.config_tree import leaf, with_values
from twin.study.runs.plan import Plan
from twin.study.runs.setup import StudySetup, resolve_study

PROGRAM = "twin.live"


@dataclass(frozen=True)
class FactorKnob:
    """A study's factor that is a number.

    Attributes:
        name: as the study calls it.
        unit: of the numbers; empty for pure numbers.
        low, high: the study's smallest and largest value.
        value: in the study's base; for a ratio 1.
        whole: whether it counts.
        knobs: knob of a body -> how many of its units one of the factor's is; empty for what changes the instrument
            itself, which is then built anew.
    """

    name: str
    unit: str
    low: float
    high: float
    value: float
    whole: bool
    knobs: Mapping[str, float]

    def plain(self) -> dict[str, Any]:
        """As the page gets it."""
        return asdict(self)


@dataclass(frozen=True, eq=False)
class Source:
    """What was opened.

    Attributes:
        resolved: the job.
        study: whose base it is; None for others.
        factors: those of the study that are numbers.
    """

    resolved: ResolvedJob
    study: StudySetup | None = None
    factors: tuple[FactorKnob, ...] = ()

    def with_factors(self, values: Mapping[str, float]) -> ResolvedJob:
        """The job with other values of factors, as a run of the study has it, values that follow them included.

        Args:
            values: factor -> number in its unit; others keep the base's.

        Raises:
            InputError: no such factor, or a value that cannot be.
        """
        if self.study is None or not values:
            return self.resolved
        known = {factor.name: factor for factor in self.factors}
        for name in values:
            if name not in known:
                names = names_text(known)
                raise InputError(
                    Issue("no such factor", found=repr(name), allowed=names, suggestion=nearest(name, known))
                )
        study = self.study.study
        factors = {name: _fixed(study.factors[name], known[name], value) for name, value in values.items()}
        one = study.model_copy(update={"factors": factors, "design": DesignSpec(kind="grid")})
        run = Plan.of(StudySetup(one, self.study.tree)).run(0)
        return validate(ResolvedJob, YamlFile("", with_values(self.study.tree, run.values), {}))


def read_source(what: str) -> Source:
    """Read what the live twin is opened with.

    Args:
        what: name of an instrument in the library, or path of an instrument's file, of a job, of a study, or of the
            config.yaml of a run.

    Raises:
        InputError: it cannot be read, is not valid, or is nothing that can be opened.
    """
    if what in library_names(INSTRUMENTS):
        return Source(resolve_job(validate(JobSpec, YamlFile("", {"instrument": what}, {}))))
    kind = kind_of(read_yaml(Path(what)).data)
    if kind is not None and kind.name == "study":
        return _of_study(what)
    if kind is not None and kind.name == "instrument":
        path = str(Path(what).resolve())
        return Source(resolve_job(validate(JobSpec, YamlFile("", {"instrument": path}, {}))))
    return Source(read_for(PROGRAM, Path(what), resolve))


def _of_study(what: str) -> Source:
    setup = resolve_study(what)
    if setup.study.base.command != "render":
        found, allowed = setup.study.base.command, "a study of base: {command: render}"
        raise setup.error(
            Problem("this study varies no instrument that could be shown", found, allowed), ("base", "command")
        )
    resolved = validate(ResolvedJob, YamlFile("", setup.tree, {}))
    turned = (_factor(name, factor, setup) for name, factor in setup.study.factors.items())
    return Source(resolved, setup, tuple(factor for factor in turned if factor is not None))


def _factor(name: str, factor: FactorSpec, setup: StudySetup) -> FactorKnob | None:
    """The knob of a factor; None where it is no number."""
    numbers = factor.numbers()
    if not numbers.numeric or not len(numbers):
        return None
    unit = numbers.unit or ""
    values = list(numbers.values)
    if factor.kind in ("normal", "truncated"):
        mean, sigma = values[:2]
        values = [mean - 4.0 * sigma, mean + 4.0 * sigma] if factor.kind == "normal" else values[2:]
    base = 1.0
    if factor.places:
        base = _number(leaf(setup.tree, factor.places[0]), unit, values[0])
    knobs = {} if factor.scales else _knobs(factor.places, unit)
    return FactorKnob(name, unit, min(*values, base), max(*values, base), base, numbers.whole, knobs)


def _number(value: Any, unit: str, otherwise: float) -> float:
    """A value of the base in the factor's unit."""
    if isinstance(value, int | float):
        return float(value)
    part = split_quantity(value)
    if part is None:
        return otherwise
    number, own = part
    return float(number) if own == unit else float(number) / unit_ratio(unit, own)


def _knobs(places: tuple[KeyPath, ...], unit: str) -> dict[str, float]:
    """Knobs that stand for the places of a factor; none where any is something else."""
    out = {}
    for place in places:
        found = _knob(place)
        if found is None:
            return {}
        name, own = found
        out[name] = 1.0 if unit == own else unit_ratio(unit, own) if unit else 0.0
    return out


def _knob(place: KeyPath) -> tuple[str, str] | None:
    """Name and unit of the knob that a place in a resolved job is."""
    match place:
        case ("job", "perturb", str(node), ("rotate" | "shift") as kind, int(axis)):
            return knob_name(node, kind, AXES[axis]), KINDS[kind].unit
        case ("job", "perturb", str(node), "figure", str(term)):
            return knob_name(node, "figure", term), KINDS["figure"].unit
        case ("job", "perturb", str(node), "scale"):
            return knob_name(node, "scale", ""), KINDS["scale"].unit
        case ("job", "perturb", str(node), "temperature", "change"):
            return knob_name(node, "temperature", ""), KINDS["temperature"].unit
        case ("job", "perturb", str(node), "temperature", "gradient", int(axis)):
            return knob_name(node, "gradient", AXES[axis]), KINDS["gradient"].unit
    return None


def _fixed(factor: FactorSpec, knob: FactorKnob, value: float) -> FactorSpec:
    """The factor with this value alone."""
    number = int(value) if knob.whole and value == int(value) else value
    scalar = with_unit(number, knob.unit) if knob.unit else number
    kept = {"key": factor.key, "keys": factor.keys, "scales": factor.scales}
    return FactorSpec.model_validate({**{k: v for k, v in kept.items() if v}, "values": (scalar,)})
