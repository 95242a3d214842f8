"""focus.json: a focal-plane alignment as plain data."""

from __future__ import annotations

from typing import Any

import numpy as np

from analysis.units import ARCSEC
from optics.rotation import rotation_vector
from twin.edge_images import ALONG, TRACK
from twin.laboratory.focus import Alignment, Shimming, State
from twin.laboratory.focus_scan import VERTEX_ERROR

ARCMIN = 60.0 * ARCSEC
UM = 1e6


def to_dict(alignment: Alignment) -> dict[str, Any]:
    """focus.json."""
    states, shimmings = alignment.states, alignment.shimmings
    return {
        "camera": alignment.bench.setup.camera.name,
        "seed": alignment.seed,
        "initial": _state(alignment, states[0]),
        "rounds": [
            {**_state(alignment, after), **_shims(done)} for after, done in zip(states[1:], shimmings, strict=True)
        ],
        "mtf_budget": [
            {"band": line.band, "direction": line.edge, "factors": dict(line.factors), "total": line.total}
            for line in alignment.bench.budget()
        ],
        "truth": {
            "initial": _truth(alignment, states[0]),
            "rounds": [_truth(alignment, state) for state in states[1:]],
        },
    }


def _state(alignment: Alignment, state: State) -> dict[str, Any]:
    out: dict[str, Any] = {
        "confocal_um_max": UM * float(np.max(np.abs(state.defocus))),
        "confocal_um_sigma": UM * float(np.hypot(np.max(state.defocus_sigma), VERTEX_ERROR)),
        "line_level_arcmin": state.level.angle / ARCMIN,
        "line_level_arcmin_sigma": state.level.sigma / ARCMIN,
        "sites": [
            {
                "band": site.band,
                "field": site.field,
                "defocus_um": UM * float(defocus),
                "defocus_um_sigma": UM * float(sigma),
            }
            for site, defocus, sigma in zip(alignment.bench.sites, state.defocus, state.defocus_sigma, strict=True)
        ],
    }
    if state.focus:
        for edge, key in ((TRACK, "mtf_nyquist"), (ALONG, "mtf_nyquist_along_line")):
            values = {band: _mean_mtf(alignment, state, band, edge) for band in alignment.bench.ccds}
            out[key] = {band: value for band, (value, _) in values.items()}
            out[f"{key}_sigma"] = {band: sigma for band, (_, sigma) in values.items()}
    return out


def _mean_mtf(alignment: Alignment, state: State, band: str, edge: str) -> tuple[float, float]:
    """Mean over the fields of the measured MTF at Nyquist, and its sigma."""
    pairs = [f.by_edge[edge] for f, s in zip(state.focus, alignment.bench.sites, strict=True) if s.band == band]
    values, sigmas = np.array(pairs).T
    return float(np.mean(values)), float(np.sqrt(np.sum(sigmas**2)) / len(sigmas))


def _shims(shimming: Shimming) -> dict[str, Any]:
    plane, plan = shimming.plane, shimming.plan
    assert plan.thickness is not None
    names = [f"hole_{k + 1}" for k in range(len(plan.thickness))]
    piston, slope_x, slope_y = np.sqrt(np.diag(shimming.covariance))
    return {
        # whole steps of the workshop; beyond picometres there is only rounding
        "shims_um": {n: round(UM * float(t), 6) for n, t in zip(names, plan.thickness, strict=True)},
        "shim_changes_um": {n: round(UM * float(t), 6) for n, t in zip(names, plan.rounded_change, strict=True)},
        "slides_mm": {n: [1e3 * float(x) for x in s] for n, s in zip(names, plan.slide, strict=True)},
        "turn_by_hand_arcmin": plan.turn / ARCMIN,
        "line_level_without_turn_arcmin": plan.level_coupling / ARCMIN,
        "correction": {
            "rotation_arcmin": [float(v) / ARCMIN for v in plan.wanted.rotation],
            "shift_um": [UM * float(v) for v in plan.wanted.shift],
            "piston_um_sigma": UM * float(piston),
            "slope_x_arcsec_sigma": float(slope_x) / ARCSEC,
            "slope_y_arcsec_sigma": float(slope_y) / ARCSEC,
        },
        "chips_um_rms": UM * plane.extra_sigma,
    }


def _truth(alignment: Alignment, state: State) -> dict[str, Any]:
    bench, standing = alignment.bench, state.standing
    mtf = {}
    for band in bench.ccds:
        values = [
            s.imagers[TRACK].mtf(float(s.crossing(standing.pose, standing.heights[band])[2]), s.nyquist)
            for s in bench.sites
            if s.band == band
        ]
        mtf[band] = float(np.mean(values))
    return {
        "confocal_um_max": UM * float(np.max(np.abs(state.true_defocus))),
        "line_level_arcmin": state.true_level / ARCMIN,
        "mtf_nyquist": mtf,
        "rotation_arcmin": [float(v) / ARCMIN for v in rotation_vector(standing.pose.rotation)],
        "shift_um": [UM * float(v) for v in standing.pose.translation],
        "chip_height_um": {band: UM * height for band, height in standing.heights.items()},
        "defocus_um": [UM * float(v) for v in state.true_defocus],
    }
