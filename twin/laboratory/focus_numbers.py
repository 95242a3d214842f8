"""Numbers of a focal-plane alignment, as focus.json has them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from analysis.units import ARCMIN, ARCSEC
from analysis.units import UM_PER_M as UM
from optics.geometry.pose import rotation_vector
from scenes.specs.lab_setup import FocusSetup, resolve_focus
from twin.laboratory.focus_alignment import Alignment, Shimming, State, run_focus
from twin.laboratory.focus_scan import VERTEX_ERROR
from twin.run.plain_data import plain_data
from twin.run.procedure import Procedure
from twin.targets.edge_images import ALONG, TRACK


@dataclass(frozen=True)
class SiteNumbers:
    """One band's CCD in one field; positive where it stands downstream of best focus."""

    band: str
    field: float
    defocus_um: float
    defocus_um_sigma: float

    @classmethod
    def of(cls, alignment: Alignment, state: State) -> tuple[SiteNumbers, ...]:
        """Of all sites."""
        return tuple(
            cls(site.band, site.field, UM * float(defocus), UM * float(sigma))
            for site, defocus, sigma in zip(alignment.bench.sites, state.defocus, state.defocus_sigma, strict=True)
        )


@dataclass(frozen=True)
class StateNumbers:
    """The assembly as it was measured; ``confocal``: the largest distance from best focus."""

    confocal_um_max: float
    confocal_um_sigma: float
    line_level_arcmin: float
    line_level_arcmin_sigma: float
    sites: tuple[SiteNumbers, ...]

    @classmethod
    def of(cls, alignment: Alignment, state: State) -> StateNumbers:
        """Of one state."""
        return cls(**_measured(alignment, state))


@dataclass(frozen=True)
class CorrectionNumbers:
    """Motion that the measurement asks for, with sigmas of the fitted plane."""

    rotation_arcmin: Sequence[float]
    shift_um: Sequence[float]
    piston_um_sigma: float
    slope_x_arcsec_sigma: float
    slope_y_arcsec_sigma: float


@dataclass(frozen=True)
class RoundNumbers(StateNumbers):
    """The assembly on new shims: MTF by band, shims by hole, and how they were decided."""

    mtf_nyquist: Mapping[str, float]
    mtf_nyquist_sigma: Mapping[str, float]
    mtf_nyquist_along_line: Mapping[str, float]
    mtf_nyquist_along_line_sigma: Mapping[str, float]
    shims_um: Mapping[str, float]
    shim_changes_um: Mapping[str, float]
    slides_mm: Mapping[str, Sequence[float]]
    turn_by_hand_arcmin: float
    line_level_without_turn_arcmin: float
    correction: CorrectionNumbers
    chips_um_rms: float

    @classmethod
    def after(cls, alignment: Alignment, state: State, done: Shimming) -> RoundNumbers:
        """The state after the shims ``done``."""
        plan = done.plan
        assert plan.thickness is not None
        names = [f"hole_{k + 1}" for k in range(len(plan.thickness))]
        piston, slope_x, slope_y = np.sqrt(np.diag(done.covariance))
        across, along = (_by_band(alignment, state, edge) for edge in (TRACK, ALONG))
        return cls(
            **_measured(alignment, state),
            mtf_nyquist={band: value for band, (value, _) in across.items()},
            mtf_nyquist_sigma={band: sigma for band, (_, sigma) in across.items()},
            mtf_nyquist_along_line={band: value for band, (value, _) in along.items()},
            mtf_nyquist_along_line_sigma={band: sigma for band, (_, sigma) in along.items()},
            # whole steps of the workshop; beyond picometres there is only rounding
            shims_um={n: round(UM * float(t), 6) for n, t in zip(names, plan.thickness, strict=True)},
            shim_changes_um={n: round(UM * float(t), 6) for n, t in zip(names, plan.rounded_change, strict=True)},
            slides_mm={n: [1e3 * float(x) for x in s] for n, s in zip(names, plan.slide, strict=True)},
            turn_by_hand_arcmin=plan.turn / ARCMIN,
            line_level_without_turn_arcmin=plan.level_coupling / ARCMIN,
            correction=CorrectionNumbers(
                rotation_arcmin=[float(v) / ARCMIN for v in plan.wanted.rotation],
                shift_um=[UM * float(v) for v in plan.wanted.shift],
                piston_um_sigma=UM * float(piston),
                slope_x_arcsec_sigma=float(slope_x) / ARCSEC,
                slope_y_arcsec_sigma=float(slope_y) / ARCSEC,
            ),
            chips_um_rms=UM * done.plane.extra_sigma,
        )


def _measured(alignment: Alignment, state: State) -> dict[str, Any]:
    """Fields of `StateNumbers`."""
    return {
        "confocal_um_max": UM * float(np.max(np.abs(state.defocus))),
        "confocal_um_sigma": UM * float(np.hypot(np.max(state.defocus_sigma), VERTEX_ERROR)),
        "line_level_arcmin": state.level.angle / ARCMIN,
        "line_level_arcmin_sigma": state.level.sigma / ARCMIN,
        "sites": SiteNumbers.of(alignment, state),
    }


def _by_band(alignment: Alignment, state: State, edge: str) -> dict[str, tuple[float, float]]:
    """Mean over the fields of the measured MTF at Nyquist, and its sigma."""
    out = {}
    for band in alignment.bench.ccds:
        pairs = [f.by_edge[edge] for f, s in zip(state.focus, alignment.bench.sites, strict=True) if s.band == band]
        values, sigmas = np.array(pairs).T
        out[band] = float(np.mean(values)), float(np.sqrt(np.sum(sigmas**2)) / len(sigmas))
    return out


@dataclass(frozen=True)
class BudgetNumbers:
    """What makes one band's MTF at Nyquist in one direction."""

    band: str
    direction: str
    factors: Mapping[str, float]
    total: float


@dataclass(frozen=True)
class TrueStateNumbers:
    """The assembly as it stands, by the exact trace."""

    confocal_um_max: float
    line_level_arcmin: float
    mtf_nyquist: Mapping[str, float]
    rotation_arcmin: Sequence[float]
    shift_um: Sequence[float]
    chip_height_um: Mapping[str, float]
    defocus_um: Sequence[float]

    @classmethod
    def of(cls, alignment: Alignment, state: State) -> TrueStateNumbers:
        """Of one state."""
        bench, standing = alignment.bench, state.standing
        mtf = {}
        for band in bench.ccds:
            values = [
                s.imagers[TRACK].mtf(float(s.crossing(standing.pose, standing.heights[band])[2]), s.nyquist)
                for s in bench.sites
                if s.band == band
            ]
            mtf[band] = float(np.mean(values))
        return cls(
            confocal_um_max=UM * float(np.max(np.abs(state.true_defocus))),
            line_level_arcmin=state.true_level / ARCMIN,
            mtf_nyquist=mtf,
            rotation_arcmin=[float(v) / ARCMIN for v in rotation_vector(standing.pose.rotation)],
            shift_um=[UM * float(v) for v in standing.pose.translation],
            chip_height_um={band: UM * height for band, height in standing.heights.items()},
            defocus_um=[UM * float(v) for v in state.true_defocus],
        )


@dataclass(frozen=True)
class FocusTruth:
    """What the analysis does not know."""

    initial: TrueStateNumbers
    rounds: tuple[TrueStateNumbers, ...]


@dataclass(frozen=True)
class FocusNumbers:
    """focus.json."""

    camera: str
    seed: int
    initial: StateNumbers
    rounds: tuple[RoundNumbers, ...]
    mtf_budget: tuple[BudgetNumbers, ...]
    truth: FocusTruth

    @classmethod
    def of(cls, alignment: Alignment) -> FocusNumbers:
        """Of an alignment."""
        first, *after = alignment.states
        return cls(
            camera=alignment.bench.setup.camera.name,
            seed=alignment.seed,
            initial=StateNumbers.of(alignment, first),
            rounds=tuple(
                RoundNumbers.after(alignment, state, done)
                for state, done in zip(after, alignment.shimmings, strict=True)
            ),
            mtf_budget=tuple(
                BudgetNumbers(line.band, line.edge, line.factors, line.total) for line in alignment.budget
            ),
            truth=FocusTruth(
                TrueStateNumbers.of(alignment, first),
                tuple(TrueStateNumbers.of(alignment, state) for state in after),
            ),
        )


def focus_numbers(alignment: Alignment) -> dict[str, Any]:
    """Contents of focus.json without its frames."""
    return dict(plain_data(FocusNumbers.of(alignment)))


FOCUS = Procedure("focus", FocusSetup, resolve_focus, run_focus, focus_numbers)
