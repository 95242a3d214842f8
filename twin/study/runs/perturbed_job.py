"""The job of every run of a monitor study, made quickly: most studies change nothing but numbers under ``perturb``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from pydantic import BaseModel

from optics.numerics.frozen_map import FrozenMap
from scenes.specs.job import JobSpec, PerturbationSpec
from scenes.specs.job_tables import TableTemperatureSpec
from scenes.specs.resolved import ResolvedJob
from scenes.yaml.errors import InputError, Issue, KeyPath, Problem
from scenes.yaml.quantity import Quantity, Vector
from scenes.yaml.spec import Spec, annotation_at, validate
from scenes.yaml.yaml_file import YamlFile
from twin.study.runs.config_tree import Tree, with_values

PERTURB = ("job", "perturb")
Reader = Callable[[object], float]


class JobMaker:
    """Jobs of the runs of one study.

    A number under ``perturb`` is read by its field's own validator and put into a copy of the base's job, which takes
    some 10 us; any other value needs the whole job to be read again, 1 ms.

    Args:
        tree: plain data of a ResolvedJob; whatever is changed is there.
    """

    def __init__(self, tree: Tree) -> None:
        self.tree = tree
        self.base = read_job(tree)
        self._plain = {path: _numbers(what) for path, what in self.base.job.perturb.items()}
        self._readers: dict[KeyPath, Reader | None] = {}

    def job(self, values: tuple[tuple[KeyPath, Any], ...]) -> ResolvedJob:
        """The job with these values.

        Raises:
            InputError: a value that the schema does not allow.
        """
        if not values:
            return self.base
        readers = [self._reader(key) for key, _ in values]
        if any(reader is None for reader in readers):
            return read_job(with_values(self.tree, values))
        changed: dict[str, dict[str, Any]] = {}
        for (key, value), reader in zip(values, readers, strict=True):
            node = str(key[2])
            if node not in changed:
                changed[node] = _copy(self._plain[node])
            assert reader is not None
            try:
                _put(changed[node], key[3:], reader(value))
            except Problem as problem:
                issue = Issue(problem.problem, "", None, key, problem.found, problem.allowed, problem.suggestion)
                raise InputError(issue) from None
        perturb = dict(self.base.job.perturb)
        perturb.update({node: _spec(parts) for node, parts in changed.items()})
        job = self.base.job.model_copy(update={"perturb": FrozenMap(perturb)})
        return self.base.model_copy(update={"job": job})

    def _reader(self, key: KeyPath) -> Reader | None:
        if key not in self._readers:
            inside = key[:2] == PERTURB and len(key) > 3 and key[2] in self._plain
            quantity = quantity_at(PerturbationSpec, key[3:]) if inside else None
            self._readers[key] = quantity.parse if quantity is not None else None
        return self._readers[key]


def read_job(tree: Tree) -> ResolvedJob:
    """The job that plain data describe. Raises InputError."""
    resolved: ResolvedJob = validate(ResolvedJob, YamlFile("", tree, {}))
    return resolved


def quantity_at(model: type[Spec], key: KeyPath) -> Quantity | None:
    """The quantity that a model has at ``key``: a field, a component of a vector, an entry of a mapping; else None."""
    for k, part in enumerate(key):
        owner = annotation_at(model, key[:k])
        if isinstance(owner, type) and issubclass(owner, BaseModel) and part in owner.model_fields:
            metadata, rest = owner.model_fields[str(part)].metadata, key[k + 1 :]
            for item in metadata:
                if isinstance(item, Quantity) and not rest:
                    return item
                if isinstance(item, Vector) and len(rest) == 1:
                    return item.of
        elif k == len(key) - 1:
            return _of_mapping(model, key[:k])
    return None


def _of_mapping(model: type[Spec], key: KeyPath) -> Quantity | None:
    """The quantity that the entries of the mapping at ``key`` are: ``Annotated[float, Quantity(...)]``."""
    arguments = getattr(annotation_at(model, key), "__args__", ())
    metadata = getattr(arguments[-1], "__metadata__", ()) if arguments else ()
    return next((item for item in metadata if isinstance(item, Quantity)), None)


def _numbers(what: PerturbationSpec) -> dict[str, Any]:
    """A perturbation as nested dictionaries and lists of SI numbers, and its deformation as it is."""
    heat = what.temperature
    return {
        "rotate": list(what.rotate),
        "shift": list(what.shift),
        "pivot": what.pivot,
        "figure": dict(what.figure),
        "scale": what.scale,
        "temperature": {**dict(heat), "gradient": list(heat.gradient)},
        "deformation": what.deformation,
    }


def _copy(parts: Mapping[str, Any]) -> dict[str, Any]:
    heat = parts["temperature"]
    return {
        **parts,
        "rotate": list(parts["rotate"]),
        "shift": list(parts["shift"]),
        "figure": dict(parts["figure"]),
        "temperature": {**heat, "gradient": list(heat["gradient"])},
    }


def _put(parts: Any, key: KeyPath, value: float) -> None:
    for part in key[:-1]:
        parts = parts[part]
    parts[key[-1]] = value


def _spec(parts: Mapping[str, Any]) -> PerturbationSpec:
    # every number has been read by its own validator, and no validator of the class looks at several at once
    heat = parts["temperature"]
    return PerturbationSpec.model_construct(
        rotate=tuple(parts["rotate"]),
        shift=tuple(parts["shift"]),
        pivot=parts["pivot"],
        figure=FrozenMap(parts["figure"]),
        scale=parts["scale"],
        temperature=TableTemperatureSpec.model_construct(**{**heat, "gradient": tuple(heat["gradient"])}),
        deformation=parts["deformation"],
    )


def needs_more(job: JobSpec) -> bool:
    """Whether a job asks for what is not done for many states at once: a course, stray light or test targets."""
    return job.course is not None or job.render.stray is not None or bool(job.render.target_images)
