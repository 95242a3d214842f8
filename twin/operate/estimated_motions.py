"""Estimated motions of an instrument at one time, as files of other commands.

The files are a job for `twin.render`, which has the estimated state, and a file of disturbances with its uncertainty, a
prior for `twin.asbuilt`.

Two causes may rotate or expand the same body about different points. A job and a file of disturbances give each
component (body, kind and axis of motion) only once. The amounts are therefore added, and a rotation (vector theta, rad)
or a relative expansion s about a point q is converted, to first order, to that about the component's pivot p with an
additional shift theta x (p - q), or s (p - q).
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
from scenes.models.disturbances import HEAT, Component, default_pivot, joint_disturbances, joint_files, state_of
from scenes.models.instrument_model import Instrument
from scenes.models.thermal_model import ThermalModel
from scenes.specs.disturbances import MOST_JOINT
from scenes.specs.job import JobSpec, PerturbationSpec
from scenes.specs.job_tables import TableTemperatureSpec
from scenes.yaml.yaml_file import dump_yaml

UNSUPPORTED = ("index_gradient",)
"""Kinds of disturbance components for which the key `perturb` of a job has no equivalent."""
PIVOTED = ("rotate", "scale")
"""Kinds of disturbance components whose effect depends on a pivot point."""


@dataclass(frozen=True, eq=False)
class EstimatedMotions:
    """Estimate of all motions specified in the disturbances, at one time.

    Attributes
    ----------
    components : tuple[Component, ...]
        The M specified components of motion.
    mean : (M,) ndarray
        Estimated amounts, in SI units.
    covariance : (M, M) ndarray
        Covariance of their errors, in SI units.
    """

    components: tuple[Component, ...]
    mean: Array
    covariance: Array

    @classmethod
    def in_units(cls, components: Sequence[Component], mean: Array, covariance: Array) -> EstimatedMotions:
        """Return the estimate from numbers in the components' display units.

        Parameters
        ----------
        components : Sequence[Component]
            The M components.
        mean : (M,) ndarray
            Amounts in the components' units.
        covariance : (M, M) ndarray
            Covariance in these units.

        Raises
        ------
        ValueError
            The numbers of amounts and components differ.
        """
        size = np.array([component.unit_size for component in components])
        if mean.shape != size.shape or covariance.shape != (len(size),) * 2:
            raise ValueError(f"{len(size)} components with {mean.shape} amounts and a covariance {covariance.shape}")
        return cls(tuple(components), mean * size, covariance * np.outer(size, size))

    @property
    def sigma(self) -> Array:
        """Standard deviations of the estimated amounts, (M,), in SI units.

        Array dimensions: M motions.
        """
        return np.sqrt(np.maximum(np.diagonal(self.covariance), 0.0))


@dataclass(frozen=True)
class OmittedComponent:
    """Disturbance component that a written file has to omit.

    Attributes
    ----------
    name : str
        Body, kind and axis of the component.
    amount : float
        Omitted amount, in SI units: the estimate for a state, the standard deviation for a prior.
    unit : str
        Unit in which the amount is displayed.
    unit_size : float
        Size of this unit in SI units.
    share : float | None
        For a prior, the largest share of the variance of a spot or a parameter that the component contributes; None for
        a state.
    """

    name: str
    amount: float
    unit: str
    unit_size: float
    share: float | None = None


def perturbation(motions: EstimatedMotions, thermal: ThermalModel) -> dict[str, PerturbationSpec]:
    """Convert estimated motions to the section `perturb` of a job, without those of the kinds `UNSUPPORTED`.

    The result describes the same state as `scenes.models.disturbances.state_of` for the same amounts.

    Parameters
    ----------
    motions : EstimatedMotions
        Motions at one time.
    thermal : ThermalModel
        Thermal model of the instrument.
    """
    reported = [k for k, component in enumerate(motions.components) if component.kind not in (*HEAT, *UNSUPPORTED)]
    moves = state_of(motions.mean[reported], [motions.components[k] for k in reported], thermal)
    heat: dict[str, Temperature] = {}
    for moving, amount in zip(motions.components, motions.mean.tolist(), strict=True):
        if moving.kind in HEAT:
            slope = (amount * (moving.axis == 0), amount * (moving.axis == 1), amount * (moving.axis == 2))
            field = Temperature(amount) if moving.kind == "temperature" else Temperature(0.0, slope)
            heat[moving.body] = heat.get(moving.body, Temperature()) + field
    # the parts are checked already; validation would require quantities as text
    return {body: _perturbed(moves.get(body, Motion()), heat.get(body)) for body in dict.fromkeys((*moves, *heat))}


def _perturbed(motion: Motion, heat: Temperature | None) -> PerturbationSpec:
    """Return a body's perturbation from its motion and its temperature."""
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
    motions: EstimatedMotions, thermal: ThermalModel, instrument: str, disturbances: str, remark: str
) -> tuple[str, tuple[OmittedComponent, ...]]:
    """Return the text of the job of the estimated state, and the components that a job cannot express.

    Parameters
    ----------
    motions : EstimatedMotions
        Motions at one time.
    thermal : ThermalModel
        Thermal model of the instrument.
    instrument : str
        Name of the instrument, or absolute path of its file.
    disturbances : str
        Name or absolute path of the file of disturbances, the prior of the estimate.
    remark : str
        Comment at the top of the file, one or several lines.
    """
    job = JobSpec.model_construct(instrument=instrument, perturb=FrozenMap(perturbation(motions, thermal)))
    plain = {"instrument": instrument, "perturb": _short(job.plain()["perturb"])}
    head = "".join(f"# {line}\n" for line in remark.splitlines())
    omitted = tuple(
        OmittedComponent(component.name, amount, component.unit, component.unit_size)
        for component, amount in zip(motions.components, motions.mean.tolist(), strict=True)
        if component.kind in UNSUPPORTED and amount
    )
    return head + dump_yaml({**plain, "disturbances": disturbances}), omitted


def _short(perturb: Mapping[str, Mapping[str, object]]) -> dict[str, dict[str, object]]:
    """Return perturbations without the keys that have the default values of a job."""
    usual = PerturbationSpec().plain()
    return {
        body: {key: value for key, value in what.items() if key == "temperature" or value != usual.get(key)}
        for body, what in perturb.items()
    }


def merge_components(motions: EstimatedMotions, instrument: Instrument) -> tuple[tuple[Component, ...], Array]:
    """Merge components of motion with the same body, kind and axis.

    Parameters
    ----------
    motions : EstimatedMotions
        The M motions.
    instrument : Instrument
        Instrument whose motions they are.

    Returns
    -------
    tuple of Component
        The J merged components.
    (J, M) ndarray
        Matrix that converts amounts of the M motions to amounts of the J components.
    """
    nodes, bodies = instrument.nodes, {body.path: body for body in instrument.assembly.tree.bodies}
    components: list[Component] = []
    indices: dict[tuple[str, str, int], int] = {}
    entries: list[tuple[int, int, float]] = []

    def index_of(body: str, kind: str, axis: int, pivot: str) -> int:
        index = indices.setdefault((body, kind, axis), len(components))
        if index == len(components):
            components.append(Component("estimate", body, kind, axis, pivot, 0.0))
        return index

    for k, component in enumerate(motions.components):
        index = index_of(component.body, component.kind, component.axis, component.pivot)
        entries.append((index, k, 1.0))
        away = (
            _pivot_shift(bodies[component.body], component, components[index].pivot)
            if component.kind in PIVOTED
            else np.zeros(3)
        )
        for axis in np.flatnonzero(np.abs(away) > 0.0).tolist():
            shift = index_of(component.body, "shift", axis, default_pivot(nodes[component.body]))
            entries.append((shift, k, float(away[axis])))
    table = np.zeros((len(components), len(motions.components)))
    for row, column, value in entries:
        table[row, column] += value
    return tuple(components), table


def _pivot_shift(body: Body, component: Component, pivot: str) -> Array:
    """Return the shift of a body that is equivalent to a change of the pivot of a rotation or expansion.

    It is a vector (3,), in metres per radian or per unit of relative expansion.
    """
    apart = np.array(body.pivots[pivot]) - np.array(body.pivots[component.pivot])
    return np.asarray(np.cross(np.eye(3)[component.axis], apart) if component.kind == "rotate" else apart)


@dataclass(frozen=True, eq=False)
class Prior:
    """Uncertainty of an estimated state, written as a file of disturbances.

    Array dimensions: M motions.

    Attributes
    ----------
    files : Mapping[str, str]
        File name -> text; with many components the table of correlations is a separate file.
    components : tuple[Component, ...]
        The J components of the file.
    table : (J, M) ndarray
        Matrix that converts amounts of the M specified motions to amounts of these components.
    omitted : tuple[OmittedComponent, ...]
        Components that the file omits.
    """

    files: Mapping[str, str]
    components: tuple[Component, ...]
    table: Array
    omitted: tuple[OmittedComponent, ...]


def prior_files(
    motions: EstimatedMotions, disturbances: Disturbances, instrument: Instrument, stem: str, reason: str, remark: str
) -> Prior:
    """Write the covariance of the estimated motions as the section `joint` of a file of disturbances.

    A file holds at most `MOST_JOINT` components. If there are more, those are selected that contribute the largest
    share of the variance of any spot or camera parameter.

    Parameters
    ----------
    motions : EstimatedMotions
        The M motions at one time.
    disturbances : Disturbances
        Effect of the same motions on spots and camera parameters.
    instrument : Instrument
        Instrument whose motions they are.
    stem : str
        Name of the file.
    reason : str
        Source of the numbers, to be named in the file.
    remark : str
        Comment at the top of the file, one or several lines.
    """
    components, table = merge_components(motions, instrument)
    covariance = table @ motions.covariance @ table.T
    share = largest_shares(motions, disturbances)
    weight = np.array([share[table[j] != 0.0].max(initial=0.0) for j in range(len(components))])
    kept = np.sort(np.argsort(-weight, kind="stable")[:MOST_JOINT])
    dropped = sorted(set(range(len(components))) - set(kept.tolist()))
    sigma = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    spec = joint_disturbances(
        stem,
        [components[j] for j in kept],
        covariance[np.ix_(kept, kept)],
        instrument.nodes,
        reason,
        f"What is not known of {instrument.spec.name} at one time of its operation, about the state that is estimated.",
    )
    omitted = [
        OmittedComponent(
            components[j].name, float(sigma[j]), components[j].unit, components[j].unit_size, float(weight[j])
        )
        for j in dropped
    ]
    selected = tuple(replace(components[j], sigma=float(sigma[j])) for j in kept)
    return Prior(FrozenMap(joint_files(spec, stem, remark)), selected, table[kept], tuple(omitted))


def largest_shares(motions: EstimatedMotions, disturbances: Disturbances) -> Array:
    """Return the largest share of the variance of any spot or camera parameter due to each of M motions, (M,).

    Parameters
    ----------
    motions : EstimatedMotions
        The M motions at one time.
    disturbances : Disturbances
        Effects on spots and camera parameters of one standard deviation of each motion.
    """
    size = np.array([component.unit_size for component in motions.components]) * disturbances.sigmas
    rows = np.concatenate([disturbances.spots, disturbances.parameters]) / np.where(size > 0.0, size, np.inf)
    variance = rows**2 * motions.sigma**2
    total = variance.sum(axis=1, keepdims=True)
    return np.asarray(np.max(variance / np.where(total > 0.0, total, np.inf), axis=0, initial=0.0))
