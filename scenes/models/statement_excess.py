"""What a job moves beyond what is stated to move."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from scenes.models.disturbances import UNITS, StatedMotions
from scenes.specs.job import JobSpec, PerturbationSpec
from scenes.specs.resolved import ResolvedJob

LIKELY = 4.0
"""Standard deviations up to which an amount is what was stated: a normal number is larger once in 16 000."""


@dataclass(frozen=True)
class Excess:
    """A component of a job's perturbation that its statement does not hold.

    Attributes:
        body: path.
        what: ``shift z``, ``figure Z7``, ``temperature``.
        kind: of `scenes.models.disturbances.UNITS`; ``table`` for what files of nodes say.
        amount: SI; 0 for a table.
        sigma: stated of that component, SI; 0 for one that is not stated.
    """

    body: str
    what: str
    kind: str
    amount: float
    sigma: float

    @property
    def text(self) -> str:
        """In words: ``base/forward/M2 shift z (3 um, stated 0.3 um)``."""
        if self.kind == "table":
            return f"{self.body} {self.what} (not stated)"
        unit, size = UNITS[self.kind]
        stated = f"stated {self.sigma / size:.3g} {unit}" if self.sigma else "not stated"
        return f"{self.body} {self.what} ({self.amount / size:.3g} {unit}, {stated})"


def beyond_statement(resolved: ResolvedJob, stated: StatedMotions | None) -> tuple[Excess, ...]:
    """Components of a job's perturbation that are larger than `LIKELY` times what is stated of them, body by body.

    Pivots are left aside: of a turn about another point its angle counts.

    Args:
        resolved: the job.
        stated: of it; None for nothing.
    """
    return tuple(_excesses(resolved.job, _variances(stated)))


def _variances(stated: StatedMotions | None) -> Mapping[tuple[str, str], float]:
    out: dict[tuple[str, str], float] = {}
    for c in stated.components if stated is not None else ():
        out[c.body, c.what] = out.get((c.body, c.what), 0.0) + c.sigma**2
    return out


def _excesses(job: JobSpec, variance: Mapping[tuple[str, str], float]) -> Iterator[Excess]:
    for body, what in job.perturb.items():
        for kind, name, amount in _components(what):
            sigma = variance.get((body, name), 0.0) ** 0.5
            if kind == "table" or abs(amount) > LIKELY * sigma:
                yield Excess(body, name, kind, amount, sigma)


def _components(what: PerturbationSpec) -> Iterator[tuple[str, str, float]]:
    """Kind, name and amount of all that is done to a body."""
    vectors = {"shift": what.shift, "rotate": what.rotate, "gradient": what.temperature.gradient}
    for kind, vector in vectors.items():
        yield from ((kind, f"{kind} {axis}", value) for axis, value in zip("xyz", vector, strict=True) if value)
    yield from (("figure", f"figure {term}", value) for term, value in what.figure.items() if value)
    for kind, value in (("scale", what.scale), ("temperature", what.temperature.change)):
        if value:
            yield kind, kind, value
    if what.temperature.table is not None:
        yield "table", "temperatures at nodes", 0.0
    if what.deformation is not None:
        yield "table", "deformation", 0.0
