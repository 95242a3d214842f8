"""What the stated motions of an instrument are estimated to be at one time, as files of other commands: the job of that
state for `twin.render`, and what is still uncertain of it as a file of disturbances, a prior for `twin.asbuilt`.

Two causes may move the same body in the same way, and about different points. A job and a file of disturbances say each
component once: amounts add up, and a turn or a growth about another point q than the component's p is one about p with
the shift theta x (p - q), or s (p - q), which is exact to the first order in the motion.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from analysis.arrays import Array
from analysis.monitor.disturbances import Disturbances
from optics.geometry.tree import Body, Motion
from optics.numerics.number_tree import FrozenMap
from optics.thermal.heat import Temperature
from scenes.models.disturbances import HEAT, Component, joint_disturbances, joint_files, state_of, usual_pivot
from scenes.models.instrument_model import Instrument
from scenes.models.thermal_model import ThermalModel
from scenes.specs.disturbances import MOST_JOINT
from scenes.specs.job import JobSpec, PerturbationSpec
from scenes.specs.job_tables import TableTemperatureSpec
from scenes.yaml.yaml_file import dump_yaml

UNSUPPORTED = ("index_gradient",)
"""Kinds of components that `perturb` of a job has no key for."""
PIVOTED = ("rotate", "scale")
"""Kinds whose pivot matters."""


@dataclass(frozen=True, eq=False)
class EstimatedMotions:
    """All stated motions at one time.

    Attributes
    ----------
    components : tuple[Component, ...]
        M of them, as they are stated.
    mean : Array
        (M,) estimated amounts, SI.
    covariance : Array
        (M, M) of their errors, SI.
    """

    components: tuple[Component, ...]
    mean: Array
    covariance: Array

    @classmethod
    def in_units(cls, components: Sequence[Component], mean: Array, covariance: Array) -> EstimatedMotions:
        """From numbers in the units in which people read components.

        Parameters
        ----------
        components : Sequence[Component]
            M of them.
        mean : Array
            (M,) in the components' units.
        covariance : Array
            (M, M) likewise.

        Raises
        ------
        ValueError
            Not as many numbers as components.
        """
        size = np.array([component.unit_size for component in components])
        if mean.shape != size.shape or covariance.shape != (len(size),) * 2:
            raise ValueError(f"{len(size)} components with {mean.shape} amounts and a covariance {covariance.shape}")
        return cls(tuple(components), mean * size, covariance * np.outer(size, size))

    @property
    def sigma(self) -> Array:
        """(M,) standard deviations, SI."""
        return np.sqrt(np.maximum(np.diagonal(self.covariance), 0.0))


@dataclass(frozen=True)
class OmittedComponent:
    """A component that a file does not have.

    Attributes
    ----------
    name : str
        Of it.
    amount : float
        What is not there: of a state the estimated amount, of a prior the standard deviation, SI.
    unit : str
        In which people read it.
    unit_size : float
        That unit in SI.
    share : float | None
        Of the largest share of the variance of a spot or a parameter that goes with it; of a prior only.
    """

    name: str
    amount: float
    unit: str
    unit_size: float
    share: float | None = None


def perturbation(found: EstimatedMotions, thermal: ThermalModel) -> dict[str, PerturbationSpec]:
    """The estimated amounts as `perturb` of a job: what `scenes.models.disturbances.state_of` makes of them, but for
    components of kinds `UNSAID`.

    Parameters
    ----------
    found : EstimatedMotions
        At one time.
    thermal : ThermalModel
        Of the instrument.
    """
    said = [k for k, component in enumerate(found.components) if component.kind not in (*HEAT, *UNSUPPORTED)]
    moves = state_of(found.mean[said], [found.components[k] for k in said], thermal)
    heat: dict[str, Temperature] = {}
    for one, amount in zip(found.components, found.mean.tolist(), strict=True):
        if one.kind in HEAT:
            slope = (amount * (one.axis == 0), amount * (one.axis == 1), amount * (one.axis == 2))
            field = Temperature(amount) if one.kind == "temperature" else Temperature(0.0, slope)
            heat[one.body] = heat.get(one.body, Temperature()) + field
    # of checked parts: to validate them would ask for quantities as text
    return {body: _perturbed(moves.get(body, Motion()), heat.get(body)) for body in dict.fromkeys((*moves, *heat))}


def _perturbed(motion: Motion, heat: Temperature | None) -> PerturbationSpec:
    warm = None
    if heat is not None:
        warm = TableTemperatureSpec.model_construct(change=heat.change, gradient=heat.gradient)
    return PerturbationSpec.model_construct(
        rotate=motion.rotate,
        shift=motion.shift,
        pivot=motion.pivot,
        figure=FrozenMap({f"Z{j}": value for j, value in sorted(motion.figure.items())}),
        scale=motion.scale,
        radius=motion.radius or None,
        conic=motion.conic or None,
        index=motion.index or None,
        temperature=warm,
    )


def state_file(
    found: EstimatedMotions, thermal: ThermalModel, instrument: str, disturbances: str, remark: str
) -> tuple[str, tuple[OmittedComponent, ...]]:
    """Text of the job of the estimated state, and what of it a job cannot say.

    Parameters
    ----------
    found : EstimatedMotions
        At one time.
    thermal : ThermalModel
        Of the instrument.
    instrument : str
        Its name, or absolute path of its file.
    disturbances : str
        Likewise of the file on which sigmas rest.
    remark : str
        At the top of the file, lines of comment.
    """
    job = JobSpec.model_construct(instrument=instrument, perturb=FrozenMap(perturbation(found, thermal)))
    plain = {"instrument": instrument, "perturb": _short(job.plain()["perturb"])}
    head = "".join(f"# {line}\n" for line in remark.splitlines())
    left = tuple(
        OmittedComponent(one.name, amount, one.unit, one.unit_size)
        for one, amount in zip(found.components, found.mean.tolist(), strict=True)
        if one.kind in UNSUPPORTED and amount
    )
    return head + dump_yaml({**plain, "disturbances": disturbances}), left


def _short(perturb: Mapping[str, Mapping[str, object]]) -> dict[str, dict[str, object]]:
    """Perturbations without what a job takes anyway."""
    usual = PerturbationSpec().plain()
    return {
        body: {key: value for key, value in what.items() if key == "temperature" or value != usual.get(key)}
        for body, what in perturb.items()
    }


def merge_components(found: EstimatedMotions, instrument: Instrument) -> tuple[tuple[Component, ...], Array]:
    """Every component of every body once, and what of them each stated motion is, (J, M).

    Parameters
    ----------
    found : EstimatedMotions
        M motions.
    instrument : Instrument
        Of them.
    """
    nodes, bodies = instrument.nodes, {body.path: body for body in instrument.assembly.tree.bodies}
    components: list[Component] = []
    places: dict[tuple[str, str, int], int] = {}
    entries: list[tuple[int, int, float]] = []

    def place(body: str, kind: str, axis: int, pivot: str) -> int:
        own = places.setdefault((body, kind, axis), len(components))
        if own == len(components):
            components.append(Component("estimate", body, kind, axis, pivot, 0.0))
        return own

    for k, component in enumerate(found.components):
        own = place(component.body, component.kind, component.axis, component.pivot)
        entries.append((own, k, 1.0))
        away = (
            _pivot_shift(bodies[component.body], component, components[own].pivot)
            if component.kind in PIVOTED
            else np.zeros(3)
        )
        for axis in np.flatnonzero(np.abs(away) > 0.0).tolist():
            shift = place(component.body, "shift", axis, usual_pivot(nodes[component.body]))
            entries.append((shift, k, float(away[axis])))
    table = np.zeros((len(components), len(found.components)))
    for row, column, value in entries:
        table[row, column] += value
    return tuple(components), table


def _pivot_shift(body: Body, one: Component, pivot: str) -> Array:
    """Shift (3,) that a turn or a growth about its own pivot is beside one about another pivot, per unit."""
    apart = np.array(body.pivots[pivot]) - np.array(body.pivots[one.pivot])
    return np.asarray(np.cross(np.eye(3)[one.axis], apart) if one.kind == "rotate" else apart)


@dataclass(frozen=True, eq=False)
class Prior:
    """What is still uncertain of a state, as a file of disturbances.

    Attributes
    ----------
    files : Mapping[str, str]
        Name -> text; a table of correlations beside the file where there are many components.
    components : tuple[Component, ...]
        J that the file has.
    table : Array
        (J, M) what of them each stated motion is.
    left_out : tuple[LeftOut, ...]
        What it does not have.
    """

    files: Mapping[str, str]
    components: tuple[Component, ...]
    table: Array
    omitted: tuple[OmittedComponent, ...]


def prior_files(
    found: EstimatedMotions, stated: Disturbances, instrument: Instrument, stem: str, reason: str, remark: str
) -> Prior:
    """The covariance of the estimated motions as `joint` of a file of disturbances.

    A file holds `MOST_JOINT` components at most. Of more, those stay that make the largest share of the variance of
    some spot or parameter, were they alone.

    Parameters
    ----------
    found : EstimatedMotions
        M motions at one time.
    stated : Disturbances
        The same motions with what they do to spots and parameters.
    instrument : Instrument
        Of them.
    stem : str
        Name of the file.
    reason : str
        Where its numbers come from.
    remark : str
        At its top, lines of comment.
    """
    components, table = merge_components(found, instrument)
    covariance = table @ found.covariance @ table.T
    share = largest_shares(found, stated)
    weight = np.array([share[table[j] != 0.0].max(initial=0.0) for j in range(len(components))])
    kept = np.sort(np.argsort(-weight, kind="stable")[:MOST_JOINT])
    gone = sorted(set(range(len(components))) - set(kept.tolist()))
    sigma = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    spec = joint_disturbances(
        stem,
        [components[j] for j in kept],
        covariance[np.ix_(kept, kept)],
        instrument.nodes,
        reason,
        f"What is not known of {instrument.spec.name} at one time of its operation, about the state that is estimated.",
    )
    left = [
        OmittedComponent(
            components[j].name, float(sigma[j]), components[j].unit, components[j].unit_size, float(weight[j])
        )
        for j in gone
    ]
    own = tuple(replace(components[j], sigma=float(sigma[j])) for j in kept)
    return Prior(FrozenMap(joint_files(spec, stem, remark)), own, table[kept], tuple(left))


def largest_shares(found: EstimatedMotions, stated: Disturbances) -> Array:
    """(M,) largest share of the variance of a spot or a parameter that each motion would make if it were alone.

    Parameters
    ----------
    found : EstimatedMotions
        M motions at one time.
    stated : Disturbances
        What one standard deviation of each does.
    """
    size = np.array([component.unit_size for component in found.components]) * stated.sigmas
    rows = np.concatenate([stated.spots, stated.parameters]) / np.where(size > 0.0, size, np.inf)
    own = rows**2 * found.sigma**2
    total = own.sum(axis=1, keepdims=True)
    return np.asarray(np.max(own / np.where(total > 0.0, total, np.inf), axis=0, initial=0.0))
