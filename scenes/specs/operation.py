"""A plan of operation: what is expected of an instrument over years, what events do to it, and what it has to keep.

The estimate of `twin.operate` follows a record under such a plan.

What can happen to an instrument in operation, by the names that tables, records and plans use.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal, get_args

from pydantic import AfterValidator, Field, model_validator

from optics.numerics.number_tree import FrozenMap
from scenes.specs.disturbances import NONE, DisturbancesSpec
from scenes.specs.job import JobSpec
from scenes.specs.load import DISTURBANCES, INSTRUMENTS, find_named, is_path
from scenes.specs.resolved import ResolvedJob, resolve_job
from scenes.yaml.errors import Problem, names_text, shown, unknown
from scenes.yaml.quantity import Quantity
from scenes.yaml.spec import Name, Number, Reference, Spec, Text, Whole, short_for, validate
from scenes.yaml.units import ANGLE, LENGTH, MOMENT, SCALE, Kind, parse_quantity
from scenes.yaml.yaml_file import read_yaml

Event = Literal["safe_mode", "heater_set_point", "refocus", "eclipse_season_begins", "eclipse_season_ends"]
EVENTS: tuple[str, ...] = get_args(Event)
"""What can happen to an instrument, other than being read."""


ENDINGS: Mapping[str, tuple[Kind, str]] = FrozenMap(
    {
        "arcsec": (ANGLE, "arcsec"),
        "um": (LENGTH, "um"),
        "mm": (LENGTH, "mm"),
        "m": (LENGTH, "m"),
        "nm": (LENGTH, "nm"),
        "ppm": (SCALE, "ppm"),
        "percent": (SCALE, "percent"),
    }
)
"""Ending of a quantity's key -> what it measures, and the unit in which it is given."""
MOST_REQUIREMENTS, MOST_CAUSES = 100, 100
Span = Annotated[float, Quantity(MOMENT, above_zero=True, largest="1000000 h")]
Causes = Annotated[
    tuple[Name, ...], short_for(None, str, schema=Name | tuple[Name, ...]), Field(min_length=1, max_length=MOST_CAUSES)
]


def _known_events(value: Mapping[str, tuple[Name, ...]]) -> FrozenMap[str, tuple[Name, ...]]:
    for name, causes in value.items():
        if name not in EVENTS:
            raise unknown("no such event", name, EVENTS, within=(name,))
        for k, cause in enumerate(causes):
            if cause in causes[:k]:
                raise Problem("a cause is named twice", shown(cause), "each once", within=(name, k))
    return FrozenMap(value)


class RequirementSpec(Spec):
    """What one quantity has to keep.

    Attributes:
        quantity: `GROUP KEY`: a camera with `d_alpha_arcsec`, `d_beta_arcsec`, `d_gamma_arcsec` or `d_f_um`;
            `intersection_angle change_arcsec`; `ground along_m`, `across_m` or `height_m`.
        limit: that the size of its change must not exceed, with its unit.
        probability: with which it has to keep it at every time.
    """

    quantity: Text
    limit: Text
    probability: Annotated[Number, Field(ge=0.5, lt=1.0)] = 0.95

    @model_validator(mode="after")
    def _is_one(self) -> RequirementSpec:
        if len(self.quantity.split()) != 2:
            raise Problem(
                "not a quantity",
                shown(self.quantity),
                "GROUP KEY: intersection_angle change_arcsec",
                within=("quantity",),
            )
        if self.key.rpartition("_")[2] not in ENDINGS:
            allowed = f"a key that ends in its unit: {names_text(f'_{one}' for one in ENDINGS)}"
            raise Problem("a quantity without a unit", shown(self.key), allowed, within=("quantity",))
        try:
            value = parse_quantity(self.limit, self._kind[0])
        except Problem as problem:
            raise problem.below("limit") from None
        if not value > 0.0:
            raise Problem("not greater than zero", shown(self.limit), self._kind[0].allowed, within=("limit",))
        return self

    @property
    def group(self) -> str:
        """A camera, ``intersection_angle`` or ``ground``."""
        return self.quantity.split()[0]

    @property
    def key(self) -> str:
        """Which of its readings; ends in its unit."""
        return self.quantity.split()[1]

    @property
    def name(self) -> str:
        """Group and key with one blank between them."""
        return f"{self.group} {self.key}"

    @property
    def largest(self) -> float:
        """The limit in the unit in which the key ends."""
        kind, unit = self._kind
        return parse_quantity(self.limit, kind) / parse_quantity(f"1 {unit}", kind)

    @property
    def _kind(self) -> tuple[Kind, str]:
        return ENDINGS[self.key.rpartition("_")[2]]


class OperationSpec(Spec):
    """How the state of an instrument is followed in operation.

    Attributes:
        instrument: name of an instrument in scenes/library/instruments, or path of an own file; that of the record.
        disturbances: what is expected to move over years, with its laws of time: name of a file in
            scenes/library/disturbances, or path of an own one.
        events: event of the record -> causes of the disturbances file whose motions step then by their standard
            deviations. An event without causes steps nothing.
        coefficients: standard deviation of what heat does to light, of each body with a sensor, over the computed
            value.
        mission: life over which the disturbances' `jump_false_alarm` counts.
        window: readings for which a jump is looked for after it has come.
        horizon: how far a forecast reaches.
        requirements: what has to be kept; no quantity twice.
    """

    instrument: Reference
    disturbances: Reference
    events: Annotated[dict[str, Causes], AfterValidator(_known_events)] = Field(default_factory=FrozenMap)
    coefficients: Annotated[float, Quantity(SCALE, smallest="0 percent", largest="1000 percent")] = 0.3
    mission: Span = 87_600.0 * 3600.0
    window: Annotated[Whole, Field(ge=2, le=10_000)] = 60
    horizon: Span = 720.0 * 3600.0
    requirements: Annotated[tuple[RequirementSpec, ...], Field(max_length=MOST_REQUIREMENTS)] = ()

    @model_validator(mode="after")
    def _each_once(self) -> OperationSpec:
        names = [one.name for one in self.requirements]
        for k, name in enumerate(names):
            if name in names[:k]:
                text = "a quantity has two requirements"
                raise Problem(text, shown(name), "one of them", within=("requirements", k, "quantity"))
        return self


class OperationSetup(Spec):
    """A plan with all it refers to, so that one text says under what a record was followed.

    Attributes:
        operation: the plan.
        model: the instrument, with what the plan states to move.
    """

    operation: OperationSpec
    model: ResolvedJob

    @property
    def disturbances(self) -> DisturbancesSpec:
        """What is expected to move."""
        assert self.model.disturbances is not None  # a plan names them
        return self.model.disturbances


def read_operation(path: str | Path) -> OperationSetup:
    """Read a plan of operation and all it refers to.

    Raises:
        InputError: any of the files cannot be read or is not valid, or an event steps a cause that is not there.
    """
    return resolve_operation(validate(OperationSpec, read_yaml(path)))


def resolve_operation(spec: OperationSpec) -> OperationSetup:
    """A plan with all it refers to, its own files by their absolute paths. Raises InputError as `read_operation`."""
    update: dict[str, str] = {}
    for key, place, others in (("instrument", INSTRUMENTS, ("cameras",)), ("disturbances", DISTURBANCES, ())):
        reference = getattr(spec, key)
        if reference == NONE:
            problem, allowed = "a plan needs what is expected to move", "the name of a file of disturbances"
            raise spec.error(problem, (key,), found=reference, allowed=allowed)
        found = find_named(place, reference, spec, (key,), others)
        update |= {key: str(found.absolute())} if is_path(reference) else {}
    spec = spec.model_copy(update=update)
    plain = {"instrument": spec.instrument, "disturbances": {"file": spec.disturbances}}
    model = resolve_job(JobSpec.model_validate(plain).with_source(spec.source))
    setup = OperationSetup.model_construct(operation=spec, model=model)
    known = setup.disturbances.causes
    for event, causes in spec.events.items():
        for k, cause in enumerate(causes):
            if cause not in known:
                wrong = unknown(f"no such cause in {setup.disturbances.name}", cause, known)
                raise spec.error(wrong, ("events", event, k))
    return setup
