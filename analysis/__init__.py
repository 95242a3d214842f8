"""Measurement analysis for space cameras: from images and readings to parameters with their covariance.

All functions take plain arrays and numbers in SI units (metres, radians, seconds) and need no file. Image positions are
(row, column) in pixels, and the centre of the first pixel is (0, 0). Results have covariances or standard deviations.
Input that cannot be used raises a ValueError that says what is allowed.

    >>> import numpy as np
    >>> import analysis
    >>> row, column = np.mgrid[:33, :33]
    >>> image = 100 + 2000 * np.exp(-0.5 * ((row - 16.3) ** 2 + (column - 15.8) ** 2) / 2.0**2)
    >>> spot = analysis.fit_spot(image, analysis.NoiseModel(gain_dn_per_e=0.5, dark_noise_e=10, offset_dn=100))
    >>> print(round(spot.row, 3), round(spot.column, 3), np.round(spot.sigma, 3))
    16.3 15.8 [0.008 0.008]

Spots and detectors
    fit_spot                  centre of a spot with its covariance
    fit_window_series         positions of a spot in a series of small windows, its shape learnt from them
    photon_transfer           gain, noise and non-uniformity from dark and flat frames
    NoiseModel                noise of a linear detector (EMVA 1288)
    SpotTemplate              calibrated shape of a spot

Modulation transfer function (MTF)
    slanted_edge_mtf          MTF of an edge (ISO 12233), with standard deviations
    bar_mtf                   MTF at the frequency of a group of bars
    mtf_ratio                 ratio of the MTFs of two images of one unknown scene

Image matching
    distinct_points           well-defined points of an image, spread evenly
    match_windows             least-squares matching of windows, with covariances
    MatchOptions              model and thresholds of the matching
    consensus                 rejection of wrong matches by a smooth displacement

Laboratory
    fit_interior_orientation  principal distance, principal point and distortion
    fit_dividing_error        dividing error of a turntable as a curve
    chauvenet                 rejection of gross errors in repeated readings
    focus_vertex              best focus of a through-focus curve
    fit_focal_plane           tilt and defocus of a focal plane

Wavefront maps
    fit_wavefront_map         Zernike coefficients over a pupil of any shape
    find_pupil, Pupil         centre and radius of the pupil in a map
    nm_to_noll, fringe_to_nm, ansi_to_nm
                              indices and orders of Zernike terms

Photogrammetry
    intersection_angle        angle between two lines of a stereo camera, from ground points
    intersect_rays            points from pairs of rays
    height_error              error in height by an error of the intersection angle
    linear_error, circular_error
                              LE90 and CE90 from covariances
    fit_rpc                   rational polynomials of an image (RPC00B)
    find_jitter               oscillations of an attitude
    LineModel, Rays           a line camera and its image points
    make_block, adjust_block  block adjustment of line-camera images

Monitoring of a camera in orbit
    recover_monitor           changes of the cameras from frames of the monitor's spots
    smooth_series             filtered and smoothed changes over a series
    detect_jumps              steps at unknown times in a series
    MonitorGeometry, CameraCalibration, MonitorCalibration
                              calibration of a monitor
    Disturbances, TimeLaw     prior covariance of motions, and its law in time

Statistics
    robust_sigma              standard deviation of residuals with outliers
    proportion_interval       confidence interval of a proportion

Classes of results
    SpotFit, EdgeMtf, InteriorOrientation, ...
                              as each function's help names them

`help(analysis.fit_spot)` and so on show parameters, references and a runnable example. Names are imported when they are
first used. They stay the same within a major version; the modules below this package may change.
"""

from __future__ import annotations

import os
import sys

# "python -m" puts the folder where it is started before all others, so that a numpy.py or an optics.py there would be
# run. It is taken out, also for processes that this one starts, unless this package itself was found there. These
# lines stand in each package that has commands: whatever they would be imported from could be such a file, too.
if (
    sys.argv[:1] == ["-m"]
    and not sys.flags.safe_path
    and sys.orig_argv[-len(sys.argv)].removeprefix("-m").partition(".")[0] == __name__
    and sys.path[0] != os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
):
    del sys.path[0]
    os.environ["PYTHONSAFEPATH"] = "1"

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from analysis.block.block import Block, make_block
    from analysis.block.block_adjustment import BlockAdjustment, adjust_block
    from analysis.focal_plane.plane_fit import FocalPlaneFit, fit_focal_plane
    from analysis.focal_plane.through_focus import FocusVertex, focus_vertex
    from analysis.matching.correlation import MatchOptions, distinct_points
    from analysis.matching.matches import Consensus, Matches, consensus, match_windows
    from analysis.monitor.disturbances import Disturbances, TimeLaw
    from analysis.monitor.jump_detection import Jump
    from analysis.monitor.monitor_formulas import MonitorGeometry
    from analysis.monitor.parameters import CameraCalibration, MonitorCalibration
    from analysis.monitor.recovery import Recovery, recover_monitor
    from analysis.monitor.series_smoother import SmoothedSeries, detect_jumps, smooth_series
    from analysis.mtf.bar_mtf import BarMtf, bar_mtf
    from analysis.mtf.mtf_ratio import MtfRatio, mtf_ratio
    from analysis.mtf.slanted_edge import EdgeMtf, slanted_edge_mtf
    from analysis.orbit.forward_intersection import StereoPoints, circular_error, intersect_rays, linear_error
    from analysis.orbit.jitter import Lines, find_jitter
    from analysis.orbit.planes import height_error, intersection_angle
    from analysis.orbit.rational_polynomial import RationalPolynomial, fit_rpc
    from analysis.orbit.three_line_model import LineModel, Rays
    from analysis.orientation.interior import InteriorOrientation, fit_interior_orientation
    from analysis.spots.likelihood import SpotFit, fit_spot
    from analysis.spots.noise import NoiseModel
    from analysis.spots.photon_transfer import PhotonTransfer, photon_transfer
    from analysis.spots.spot_template import SpotTemplate
    from analysis.spots.window_series import SeriesPrior, WindowSeries, fit_window_series
    from analysis.statistics import proportion_interval, robust_sigma
    from analysis.turntable.dividing_error import AngleFit, chauvenet, fit_dividing_error
    from analysis.wavefront_maps.pupil_fit import MapFit, Pupil, find_pupil, fit_wavefront_map
    from analysis.wavefront_maps.zernike_table import ansi_to_nm, fringe_to_nm, nm_to_noll

_MODULES = {
    "monitor.jump_detection": ("Jump",),
    "block.block": ("Block", "make_block"),
    "block.block_adjustment": ("BlockAdjustment", "adjust_block"),
    "focal_plane.plane_fit": ("FocalPlaneFit", "fit_focal_plane"),
    "focal_plane.through_focus": ("FocusVertex", "focus_vertex"),
    "matching.correlation": ("MatchOptions", "distinct_points"),
    "matching.matches": ("Consensus", "Matches", "consensus", "match_windows"),
    "monitor.disturbances": ("Disturbances", "TimeLaw"),
    "monitor.monitor_formulas": ("MonitorGeometry",),
    "monitor.parameters": ("CameraCalibration", "MonitorCalibration"),
    "monitor.recovery": ("Recovery", "recover_monitor"),
    "monitor.series_smoother": ("SmoothedSeries", "detect_jumps", "smooth_series"),
    "mtf.bar_mtf": ("BarMtf", "bar_mtf"),
    "mtf.mtf_ratio": ("MtfRatio", "mtf_ratio"),
    "mtf.slanted_edge": ("EdgeMtf", "slanted_edge_mtf"),
    "orbit.forward_intersection": ("StereoPoints", "circular_error", "intersect_rays", "linear_error"),
    "orbit.jitter": ("Lines", "find_jitter"),
    "orbit.planes": ("height_error", "intersection_angle"),
    "orbit.rational_polynomial": ("RationalPolynomial", "fit_rpc"),
    "orbit.three_line_model": ("LineModel", "Rays"),
    "orientation.interior": ("InteriorOrientation", "fit_interior_orientation"),
    "spots.noise": ("NoiseModel",),
    "spots.photon_transfer": ("PhotonTransfer", "photon_transfer"),
    "spots.likelihood": ("SpotFit", "fit_spot"),
    "spots.window_series": ("SeriesPrior", "WindowSeries", "fit_window_series"),
    "spots.spot_template": ("SpotTemplate",),
    "statistics": ("robust_sigma", "proportion_interval"),
    "turntable.dividing_error": ("AngleFit", "chauvenet", "fit_dividing_error"),
    "wavefront_maps.pupil_fit": ("MapFit", "Pupil", "find_pupil", "fit_wavefront_map"),
    "wavefront_maps.zernike_table": ("ansi_to_nm", "fringe_to_nm", "nm_to_noll"),
}
"""Public names by the module of this package that defines them; they are imported when first used."""

__all__ = [
    "AngleFit",
    "BarMtf",
    "Block",
    "BlockAdjustment",
    "CameraCalibration",
    "Consensus",
    "Disturbances",
    "EdgeMtf",
    "FocalPlaneFit",
    "FocusVertex",
    "InteriorOrientation",
    "Jump",
    "LineModel",
    "Lines",
    "MapFit",
    "MatchOptions",
    "Matches",
    "MonitorCalibration",
    "MonitorGeometry",
    "MtfRatio",
    "NoiseModel",
    "PhotonTransfer",
    "Pupil",
    "RationalPolynomial",
    "Rays",
    "Recovery",
    "SeriesPrior",
    "SmoothedSeries",
    "SpotFit",
    "SpotTemplate",
    "StereoPoints",
    "TimeLaw",
    "WindowSeries",
    "adjust_block",
    "ansi_to_nm",
    "bar_mtf",
    "chauvenet",
    "circular_error",
    "consensus",
    "detect_jumps",
    "distinct_points",
    "find_jitter",
    "find_pupil",
    "fit_dividing_error",
    "fit_focal_plane",
    "fit_interior_orientation",
    "fit_rpc",
    "fit_spot",
    "fit_wavefront_map",
    "fit_window_series",
    "focus_vertex",
    "fringe_to_nm",
    "height_error",
    "intersect_rays",
    "intersection_angle",
    "linear_error",
    "make_block",
    "match_windows",
    "mtf_ratio",
    "nm_to_noll",
    "photon_transfer",
    "proportion_interval",
    "recover_monitor",
    "robust_sigma",
    "slanted_edge_mtf",
    "smooth_series",
]


def __getattr__(name: str) -> Any:
    for module, names in _MODULES.items():
        if name in names:
            from optics.numerics.arguments import public

            defined = getattr(importlib.import_module(f"{__name__}.{module}"), name)
            value = globals()[name] = public(defined, __name__, name)
            return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
