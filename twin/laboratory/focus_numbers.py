"""Numbers of a focal-plane alignment, as focus.json has them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from analysis.focal_plane.through_focus import FocusVertex
from analysis.units import ARCMIN, ARCSEC
from analysis.units import UM_PER_M as UM
from optics.geometry.pose import rotation_vector
from twin.laboratory.focus_alignment import Alignment, Shimming, State
from twin.laboratory.focus_scan import VERTEX_ERROR
from twin.laboratory.measured_focus import MeasuredAlignment
from twin.laboratory.turntable_numbers import FileNumbers
from twin.run.plain_data import plain_data
from twin.targets.target_images import ALONG, TRACK


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
            correction=_correction(done),
            chips_um_rms=UM * done.plane.extra_sigma,
        )


def _correction(done: Shimming) -> CorrectionNumbers:
    wanted = done.plan.wanted
    piston, slope_x, slope_y = np.sqrt(np.diag(done.covariance))
    return CorrectionNumbers(
        rotation_arcmin=[float(v) / ARCMIN for v in wanted.rotation],
        shift_um=[UM * float(v) for v in wanted.shift],
        piston_um_sigma=UM * float(piston),
        slope_x_arcsec_sigma=float(slope_x) / ARCSEC,
        slope_y_arcsec_sigma=float(slope_y) / ARCSEC,
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


@dataclass(frozen=True)
class CurveNumbers:
    """A curve through focus: its vertex as a move of the image, peak, and the fit."""

    vertex_um: float
    vertex_um_sigma: float
    peak_mtf: float
    peak_mtf_sigma: float
    chi_square: float
    degrees_of_freedom: int
    positions: int
    positions_used: int

    @classmethod
    def of(cls, vertex: FocusVertex) -> CurveNumbers:
        """Of a vertex."""
        return cls(
            vertex_um=UM * vertex.position,
            vertex_um_sigma=UM * vertex.sigma,
            peak_mtf=vertex.peak,
            peak_mtf_sigma=vertex.peak_sigma,
            chi_square=vertex.chi_square,
            degrees_of_freedom=vertex.degrees_of_freedom,
            positions=len(vertex.used),
            positions_used=int(np.sum(vertex.used)),
        )


@dataclass(frozen=True)
class MeasuredSiteNumbers:
    """One place; defocus is positive where the CCD stands downstream of best focus; residual: from the plane."""

    band: str
    x_mm: float
    y_mm: float
    defocus_um: float
    defocus_um_sigma: float
    residual_um: float
    curves: Mapping[str, CurveNumbers]


@dataclass(frozen=True)
class PlaneNumbers:
    """The weighted plane of best focus minus CCD. Covariance of piston and slopes: metres and radians. Its sigmas hold
    the error that all vertices share; chi-square is that of the places about the plane with their own sigmas.
    """

    piston_um: float
    piston_um_sigma: float
    slope_x_arcsec: float
    slope_x_arcsec_sigma: float
    slope_y_arcsec: float
    slope_y_arcsec_sigma: float
    covariance: np.ndarray
    chi_square: float
    degrees_of_freedom: int
    probability: float
    chips_um_rms: float


@dataclass(frozen=True)
class ShimNumbers:
    """The shim of one hole: exact change of thickness, what is ground, the new shim, and the slide by hand."""

    change_um: float
    change_um_sigma: float
    ground_um: float
    shim_um: float
    slide_mm: Sequence[float]


@dataclass(frozen=True)
class NoEdgeNumbers:
    """An image without a measurable edge."""

    file: str
    line: int
    reason: str


@dataclass(frozen=True)
class MeasuredFocusNumbers:
    """focus.json of measurements. Expected: largest distance from best focus on the new shims, after rounding, where
    the places are best predicted.
    """

    name: str
    seed: int
    confocal_um_max: float
    confocal_um_sigma: float
    line_level_arcmin: float | None
    line_level_arcmin_sigma: float | None
    plane: PlaneNumbers
    correction: CorrectionNumbers
    shims: Mapping[str, ShimNumbers]
    turn_by_hand_arcmin: float
    line_level_without_turn_arcmin: float
    expected_confocal_um_max: float
    expected_confocal_um_sigma: float
    curves_chi_square: float
    curves_degrees_of_freedom: int
    sites: tuple[MeasuredSiteNumbers, ...]
    images_without_edge: tuple[NoEdgeNumbers, ...]
    files: tuple[FileNumbers, ...]

    @classmethod
    def of(cls, run: MeasuredAlignment) -> MeasuredFocusNumbers:
        """Of an alignment."""
        plane, plan, level = run.shimming.plane, run.shimming.plan, run.level
        assert plan.thickness is not None
        covariance = plane.covariance + np.diag(run.shimming.systematic**2)
        piston, slope_x, slope_y = (float(v) for v in np.sqrt(np.diag(covariance)))
        left, spread = plane.predicted_defocus()
        expected = left + plan.focus_error(plane.place)
        worst = int(np.argmax(np.abs(expected)))
        names = [f"hole_{k + 1}" for k in range(len(plan.thickness))]
        square, freedom = run.chi_square
        changes = np.sqrt(np.diag(plan.change_covariance + run.shimming.systematic_changes))
        return cls(
            name=run.spec.name,
            seed=run.seed,
            confocal_um_max=UM * float(np.max(np.abs(run.defocus))),
            confocal_um_sigma=UM * float(np.hypot(np.max(run.defocus_sigma), run.spec.vertex_error)),
            line_level_arcmin=None if level is None else level.angle / ARCMIN,
            line_level_arcmin_sigma=None if level is None else level.sigma / ARCMIN,
            plane=PlaneNumbers(
                piston_um=UM * plane.piston,
                piston_um_sigma=UM * piston,
                slope_x_arcsec=plane.slope_x / ARCSEC,
                slope_x_arcsec_sigma=slope_x / ARCSEC,
                slope_y_arcsec=plane.slope_y / ARCSEC,
                slope_y_arcsec_sigma=slope_y / ARCSEC,
                covariance=covariance,
                chi_square=plane.chi_square,
                degrees_of_freedom=plane.degrees_of_freedom,
                probability=plane.p_value,
                chips_um_rms=UM * plane.extra_sigma,
            ),
            correction=_correction(run.shimming),
            shims={
                name: ShimNumbers(
                    change_um=UM * float(plan.change[k]),
                    change_um_sigma=UM * float(changes[k]),
                    ground_um=round(UM * float(plan.rounded_change[k]), 6),
                    shim_um=round(UM * float(plan.thickness[k]), 6),
                    slide_mm=[1e3 * float(v) for v in plan.slide[k]],
                )
                for k, name in enumerate(names)
            },
            turn_by_hand_arcmin=plan.turn / ARCMIN,
            line_level_without_turn_arcmin=plan.level_coupling / ARCMIN,
            expected_confocal_um_max=UM * float(np.abs(expected[worst])),
            expected_confocal_um_sigma=UM * float(np.hypot(np.sqrt(spread[worst, worst]), run.spec.vertex_error)),
            curves_chi_square=square,
            curves_degrees_of_freedom=freedom,
            sites=tuple(
                MeasuredSiteNumbers(
                    band=site.band,
                    x_mm=1e3 * float(site.place[0]),
                    y_mm=1e3 * float(site.place[1]),
                    defocus_um=UM * float(run.defocus[k]),
                    defocus_um_sigma=UM * float(run.defocus_sigma[k]),
                    residual_um=UM * float(plane.residual[k]),
                    curves={edge: CurveNumbers.of(vertex) for edge, vertex in run.scans[k].vertex.items()},
                )
                for k, site in enumerate(run.sites)
            ),
            images_without_edge=tuple(NoEdgeNumbers(one.file, one.line, one.reason) for one in run.no_edge),
            files=(FileNumbers(**asdict(run.file)),),
        )


def focus_numbers(alignment: Alignment | MeasuredAlignment) -> dict[str, Any]:
    """Contents of focus.json without its frames."""
    if isinstance(alignment, MeasuredAlignment):
        return dict(plain_data(MeasuredFocusNumbers.of(alignment)))
    return dict(plain_data(FocusNumbers.of(alignment)))
