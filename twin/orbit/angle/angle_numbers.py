"""Numbers of an intersection-angle test, as angle.json has them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from scipy.stats import chi2

from analysis.units import ARCSEC
from twin.orbit.angle.angle_run import AngleRun, PassAngles, Scatter, SimulatedAngleRun, values_of
from twin.run.plain_data import plain_data

ByAngle = Mapping[str, float | None]
"""A number for each angle of the test's file; what could not be computed is None."""


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _arcsec(names: Iterable[str], values: Iterable[float]) -> ByAngle:
    """Radians as arcseconds."""
    return {name: _number(v / ARCSEC) for name, v in zip(names, values, strict=True)}


def _degrees(names: Iterable[str], values: Iterable[float]) -> ByAngle:
    """Radians as degrees; keys say so, since they stand beside those of sigmas."""
    return {f"{name}_deg": _number(np.degrees(v)) for name, v in zip(names, values, strict=True)}


def _with_sigmas(names: Iterable[str], values: Iterable[float], sigmas: Iterable[float]) -> ByAngle:
    """Angles in degrees, then their sigmas in arcseconds."""
    names = tuple(names)
    claimed = {f"{name}_sigma_arcsec": _number(v / ARCSEC) for name, v in zip(names, sigmas, strict=True)}
    return {**_degrees(names, values), **claimed}


@dataclass(frozen=True)
class TruthNumbers:
    """Angles of the true camera, by each definition."""

    look: ByAngle
    dihedral: ByAngle
    along_track: ByAngle

    @classmethod
    def of(cls, run: SimulatedAngleRun) -> Self:
        """Of a run."""
        angles = run.flight.look, run.flight.dihedral, run.flight.along_track
        return cls(*(_degrees(run.names, values.values()) for values in angles))


@dataclass(frozen=True)
class ChangeNumbers:
    """Changes of the look angles since the laboratory, arcseconds: from the ground, true, by the instrument's trace."""

    ground: ByAngle
    truth: ByAngle
    trace: ByAngle

    @classmethod
    def of(cls, run: SimulatedAngleRun) -> Self:
        """Of a run."""
        flight = run.flight
        return cls(
            ground=_arcsec(run.names, run.change),
            truth=_arcsec(run.names, values_of(flight.look) - values_of(flight.laboratory_look)),
            trace=_arcsec(flight.trace, flight.trace.values()),
        )


@dataclass(frozen=True)
class EffectNumbers:
    """What an effect on the light does to the angles, and what its correction leaves."""

    what: str
    bias_arcsec: ByAngle
    corrected_arcsec: ByAngle


@dataclass(frozen=True)
class ScatterNumbers:
    """One estimator over the passes; p_value: chance of a spread as far off if the sigma is right."""

    bias_arcsec: ByAngle
    spread_arcsec: ByAngle
    sigma_arcsec: ByAngle
    p_value: ByAngle

    @classmethod
    def of(cls, names: Sequence[str], scatter: Scatter) -> Self:
        """Of one estimator."""
        rows = scatter.bias / ARCSEC, scatter.spread / ARCSEC, scatter.sigma / ARCSEC, scatter.tail
        return cls(*(dict(zip(names, row.tolist(), strict=True)) for row in rows))


@dataclass(frozen=True)
class PassesNumbers:
    """Passes with errors drawn anew."""

    passes: int
    planes: ScatterNumbers
    along_track: ScatterNumbers
    resection: ScatterNumbers

    @classmethod
    def of(cls, run: SimulatedAngleRun) -> Self:
        """Of a run."""
        estimators = run.planes, run.along, run.resection
        return cls(len(run.planes.values), *(ScatterNumbers.of(run.names, scatter) for scatter in estimators))


@dataclass(frozen=True)
class SimulatedNumbers:
    """What angle.json has of a simulated test beside its pass; frames: of every form of the planes in every frame."""

    seed: int
    time_s: float
    angles: Mapping[str, Sequence[str]]
    planes: Mapping[str, ByAngle]
    folded: Mapping[str, bool]
    look: ByAngle
    along_track: ByAngle
    resection: ByAngle
    truth: TruthNumbers
    change_arcsec: ChangeNumbers
    difference_arcsec: ByAngle
    difference_sigma_arcsec: ByAngle
    sensitivity: Sequence[Mapping[str, Any]]
    effects: Sequence[EffectNumbers]
    frames: Sequence[Mapping[str, Any]]
    scatter: PassesNumbers
    height_m_per_arcsec: ByAngle

    @classmethod
    def of(cls, run: SimulatedAngleRun) -> Self:
        """Of a run."""
        estimate, flight, names = run.estimate, run.flight, run.names
        return cls(
            seed=run.seed,
            time_s=flight.spec.time,
            angles=flight.pairs,
            planes={
                method: _with_sigmas(names, angles.values, angles.sigma) for method, angles in estimate.angles.items()
            },
            folded={name: bool(f) for name, f in zip(names, estimate.angles["tls"].folded, strict=True)},
            look=_degrees(names, estimate.look),
            along_track=_with_sigmas(names, estimate.along.values, estimate.along.sigma),
            resection={
                **_with_sigmas(names, run.resected, run.resected_sigma),
                "p_value": estimate.resection.p_value,
            },
            truth=TruthNumbers.of(run),
            change_arcsec=ChangeNumbers.of(run),
            difference_arcsec=_arcsec(names, run.difference),
            difference_sigma_arcsec=_arcsec(names, run.difference_sigma),
            sensitivity=[row.to_dict() for row in run.table],
            effects=[
                EffectNumbers(row.what, _arcsec(names, row.bias), _arcsec(names, row.left)) for row in run.effects
            ],
            frames=[
                {
                    "frame": row.frame,
                    "method": row.method,
                    **_with_sigmas(names, row.values, row.sigma),
                    "least_normal_z": row.steepest,
                    "near_vertical": row.warned,
                }
                for row in run.frames
            ],
            scatter=PassesNumbers.of(run),
            height_m_per_arcsec=run.height,
        )


@dataclass(frozen=True)
class PassNumbers:
    """Angles of a pass, simulated or measured; those of the laboratory's camera; time from the epoch."""

    time_s: float
    points: Mapping[str, int]
    dihedral: ByAngle
    along_track: ByAngle
    resection: ByAngle
    laboratory_dihedral: ByAngle
    laboratory_along_track: ByAngle
    change_arcsec: ByAngle
    plane_p_value: Mapping[str, float]
    resection_p_value: float

    @classmethod
    def of(cls, one: PassAngles) -> Self:
        """Of one pass."""
        names, pairs, estimate = tuple(one.pairs), tuple(one.pairs.values()), one.estimate
        section, tls, along = estimate.resection, estimate.angles["tls"], estimate.along
        sigma = np.sqrt(np.diag(section.angle_covariance(pairs)))
        return cls(
            time_s=one.time,
            points={name: len(pixel) for name, pixel in one.pixel.items()},
            dihedral=_with_sigmas(names, tls.values, tls.sigma),
            along_track=_with_sigmas(names, along.values, along.sigma),
            resection=_with_sigmas(names, section.angles(pairs), sigma),
            laboratory_dihedral=_degrees(names, one.dihedral),
            laboratory_along_track=_degrees(names, one.along_track),
            change_arcsec=_arcsec(names, along.values - one.along_track),
            plane_p_value={
                line: float(chi2.sf(fit.chi_square, len(fit.residual) - 2))
                for line, fit in zip(one.lines, estimate.planes["tls"], strict=True)
            },
            resection_p_value=section.p_value,
        )


def angle_numbers(run: AngleRun) -> dict[str, Any]:
    """Contents of angle.json without its frames. Keys of angles begin with their names."""
    numbers = plain_data({"measured": {one.name: PassNumbers.of(one) for one in run.passes}})
    return {**(plain_data(SimulatedNumbers.of(run)) if isinstance(run, SimulatedAngleRun) else {}), **numbers}
