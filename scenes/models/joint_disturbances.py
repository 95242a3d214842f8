"""A covariance of components as a file of disturbances, such as what an estimate of an instrument's state leaves."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence

import numpy as np

from scenes.models.disturbances import INDEFINITE, Component, usual_pivot
from scenes.specs.disturbances import DisturbancesSpec, TimeLawSpec, written_sigma
from scenes.specs.perturbation import NodeInfo
from scenes.yaml.spec import validate
from scenes.yaml.yaml_file import YamlFile

ABOUT = ("shift", "rotate", "scale")
"""Kinds of components that have a pivot."""
DIGITS = 12
"""After the point of a correlation: less says nothing, and eigenvalues stay within ``INDEFINITE``."""
FEW = 12
"""Components up to which a file holds the matrix of their correlations itself."""


def joint_disturbances(
    name: str,
    components: Sequence[Component],
    covariance: np.ndarray,
    nodes: Mapping[str, NodeInfo],
    reason: str,
    description: str = "",
    time: TimeLawSpec | None = None,
) -> DisturbancesSpec:
    """The statement that components have a covariance, as `joint` of a file of disturbances.

    ``scenes.models.disturbances.motions_of_spec`` makes of it the components that move, in this order and with these
    standard deviations, and states drawn from it have this covariance.

    Args:
        name: of the file.
        components: M of them, of different bodies, kinds or axes; their own standard deviations do not count.
        covariance: (M, M), SI. Components without any are left out.
        nodes: of the instrument.
        reason: where the numbers come from.
        description: for people.
        time: how they go on in a series of measurements; constant by default.

    Raises:
        ValueError: it is no covariance of these components.
        InputError: a component is there twice, or moves by more than a file can say.
    """
    covariance = np.asarray(covariance, dtype=np.float64)
    if covariance.shape != (len(components),) * 2 or not np.all(np.isfinite(covariance)):
        raise ValueError(f"a covariance of {len(components)} components has not the shape {covariance.shape}")
    if np.min(np.diagonal(covariance), initial=0.0) < 0.0:
        raise ValueError("a variance is negative")
    sigma = np.sqrt(np.diagonal(covariance))
    own = np.flatnonzero(sigma > 0.0).tolist()
    correlation = covariance[np.ix_(own, own)] / np.outer(sigma[own], sigma[own])
    if np.max(np.abs(correlation - correlation.T), initial=0.0) > -INDEFINITE:
        raise ValueError("a covariance is symmetric")
    correlation = np.clip(0.5 * (correlation + correlation.T), -1.0, 1.0)
    correlation = np.asarray(np.round(correlation, DIGITS), dtype=np.float64)
    np.fill_diagonal(correlation, 1.0)
    if len(own) and np.linalg.eigvalsh(correlation)[0] < INDEFINITE:
        raise ValueError("a covariance has no negative eigenvalue")
    names = [_name(components[k], nodes) for k in own]
    plain = {
        "name": name,
        "description": description,
        "joint": {
            "components": {said: written_sigma(said, float(sigma[k])) for said, k in zip(names, own, strict=True)},
            "correlation": correlation.tolist(),
            "time": (time or TimeLawSpec(kind="constant")).plain(),
            "reason": reason,
        },
    }
    if len(set(names)) < len(names):
        raise ValueError("a component is there twice")
    return validate(DisturbancesSpec, YamlFile(name, plain, {}))


def joint_files(spec: DisturbancesSpec, stem: str, remark: str = "") -> dict[str, str]:
    """Files that say a statement with `joint`: its own, and beside it a table of the correlations where there are many.

    Args:
        spec: the statement.
        stem: of the files' names.
        remark: at the top of the file, lines of comment.

    Returns:
        Name -> text.
    """
    joint = spec.joint
    if joint is None or joint.correlation is None or len(joint.components) <= FEW:
        return {f"{stem}.yaml": spec.file_text(remark)}
    table = io.StringIO()
    rows = csv.writer(table, lineterminator="\n")
    rows.writerow(joint.components)
    rows.writerows([[repr(value) for value in row] for row in joint.correlation])
    short = joint.model_copy(update={"correlation": None, "correlation_file": f"{stem}.csv"})
    return {f"{stem}.yaml": spec.model_copy(update={"joint": short}).file_text(remark), f"{stem}.csv": table.getvalue()}


def _name(component: Component, nodes: Mapping[str, NodeInfo]) -> str:
    """Name of a component, with its pivot where that is not the usual one."""
    if component.kind in ABOUT and component.pivot != usual_pivot(nodes[component.body]):
        return f"{component.name} about {component.pivot}"
    return component.name
