"""Figures of the shipped studies on the page studies.md: readers of a study's folder."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

Read = Callable[[Path], float]
"""Function from a run folder to a number in it."""

_CAMERAS = ("forward", "backward")
_GRADIENT_3_SIGMA = 22.5
"""Three standard deviations of a prism's gradient at an unsteadiness of 1 in study_prism_heat, mK/m."""
_ALLOWED = 0.1
"""Error of a monitor that its prisms' gradients may cause, three standard deviations, arcsec."""


def _runs(folder: Path) -> pd.DataFrame:
    """Return the runs of a study that have numbers, with column names without units."""
    table = pd.read_csv(folder / "study.csv").rename(columns=lambda name: name.partition(" [")[0])
    return table[table["failed"] == 0]


def _failed(words: str = "") -> Read:
    """Return a reader of the number of failed runs whose reason contains some words."""

    def read(folder: Path) -> float:
        table = pd.read_csv(folder / "study.csv")
        reasons = table["message"][table["failed"] != 0]
        return float(reasons.str.contains(words, regex=False).sum())

    return read


def _exponent(factor: str) -> Read:
    """Return a reader of a factor's exponent in the noise of d_alpha: a fit of logarithms over all runs."""
    factors = ("aperture", "pinhole", "frames", "wavelength")

    def read(folder: Path) -> float:
        table = _runs(folder)
        columns = np.column_stack([*(np.log(table[name]) for name in factors), np.ones(len(table))])
        found = np.linalg.lstsq(columns, np.log(table["alpha_noise"]), rcond=None)[0]
        return float(found[factors.index(factor)])

    return read


def _alpha_noise(aperture: float) -> Read:
    """Return a reader of the mean noise of d_alpha, in mas, for a prism aperture in mm.

    Pinholes are 20 um, with 4 frames at 650 nm.
    """

    def read(folder: Path) -> float:
        table = _runs(folder)
        chosen = (table["pinhole"] == 20) & (table["frames"] == 4) & (table["wavelength"] == 650)
        return 1e3 * float(table["alpha_noise"][chosen & (table["aperture"] == aperture)].mean())

    return read


def _heat_error(camera: str) -> Read:
    """Return a reader of 3 sigma of d_alpha and d_beta together at an unsteadiness of 1, in arcsec."""

    def read(folder: Path) -> float:
        table = _runs(folder)
        errors = [table[f"{camera}_{name}"] / table["unsteadiness"] for name in ("alpha", "beta")]
        return 3.0 * float(np.sqrt(np.mean([error.var() for error in errors])))

    return read


def _heat_limit(camera: str) -> Read:
    """Return a reader of the gradient, in mK/m, that causes the allowed error at three standard deviations."""
    return lambda folder: _GRADIENT_3_SIGMA * _ALLOWED / _heat_error(camera)(folder)


def _rms(table: pd.DataFrame, name: str) -> float:
    """Return the RMS of a column over the runs and both cameras."""
    return float(np.sqrt(np.mean([np.mean(np.square(table[f"{camera}_{name}"])) for camera in _CAMERAS])))


def _alignment_error(change: str, over: str = "") -> Read:
    """Return a reader of a change's RMS error.

    It is divided by the RMS of its noise (``sigma_noise``) or total sigma (``sigma``) if ``over`` names one.
    """

    def read(folder: Path) -> float:
        table = _runs(folder)
        return _rms(table, change) / (_rms(table, f"{change}_{over}") if over else 1.0)

    return read


def _statistic(response: str, what: str) -> Read:
    """Return a reader of a statistic of a response: ``mean``, ``std``, ``p95``."""

    def read(folder: Path) -> float:
        return float(json.loads((folder / "statistics.json").read_text("utf-8"))["responses"][response][what]["value"])

    return read


def _height(minutes: float | None) -> Read:
    """Return a reader of the mean height error, in metres, with a measurement at this interval, or with none.

    The mounts are those of the base.
    """

    def read(folder: Path) -> float:
        table = _runs(folder)
        table = table[table["drift"] == 1]
        if minutes is None:
            return float(table["unmonitored"].mean())
        return float(table["height_error"][table["interval"] == minutes].mean())

    return read


def _design(of: Callable[[dict[str, Any]], float]) -> Read:
    """Return a reader of a number of design.json."""
    return lambda folder: float(of(json.loads((folder / "design.json").read_text("utf-8"))))


def _errors(design: dict[str, Any], when: str, line: bool = False) -> np.ndarray:
    """Return wavefront errors of the fields before or after, in waves rms, optionally of those on the line alone."""
    errors, fields = np.array(design["wavefront_error_waves"][when]), np.array(design["fields_deg"])
    return np.asarray(errors[fields[:, 1] == 0.0] if line else errors)


def _starts(design: dict[str, Any], what: str) -> np.ndarray:
    """Return a number of each start."""
    return np.array([start[what] for start in design["starts"]], float)


def _errors_of_best(design: dict[str, Any]) -> float:
    """Return the least wavefront error over the field of all starts, in waves rms."""
    return float(_starts(design, "wavefront_error_waves").min())


def _of_design(when: str, camera: str) -> dict[str, tuple[int, str, Read]]:
    """Return the figures of a camera design, before or after the optimisation."""
    return {
        f"studies.design.rms_{camera}": (4, "waves", _design(lambda d: np.sqrt(np.mean(_errors(d, when) ** 2)))),
        f"studies.design.worst_{camera}": (4, "waves", _design(lambda d: _errors(d, when).max())),
        f"studies.design.line_least_{camera}": (4, "waves", _design(lambda d: _errors(d, when, True).min())),
        f"studies.design.line_most_{camera}": (4, "waves", _design(lambda d: _errors(d, when, True).max())),
        f"studies.design.anamorphism_{camera}": (1, "%", _design(lambda d: 100.0 * (1.0 - d["anamorphism"][when]))),
        f"studies.design.length_{camera}": (2, "m", _design(lambda d: d["envelope_m"][when])),
    }


def _study(name: str) -> tuple[str, ...]:
    """Return the command that runs a shipped study."""
    return ("twin.study", f"scenes/examples/study_{name}.yaml", "--yes")


STUDIES: Mapping[tuple[str, ...], Mapping[str, tuple[int, str, Read]]] = {
    _study("aperture"): {
        **{f"studies.aperture.{name}": (1, "", _exponent(name)) for name in ("aperture", "pinhole", "frames")},
        "studies.aperture.wavelength": (1, "", _exponent("wavelength")),
        "studies.aperture.alpha_50": (2, "mas", _alpha_noise(50.0)),
        "studies.aperture.alpha_20": (1, "mas", _alpha_noise(20.0)),
        "studies.aperture.saturated": (0, "", _failed("saturated")),
    },
    _study("prism_heat"): {
        **{f"studies.prism_heat.{name}": (3, "arcsec", _heat_error(name)) for name in _CAMERAS},
        **{f"studies.prism_heat.{name}_limit": (0, "mK/m", _heat_limit(name)) for name in _CAMERAS},
    },
    _study("alignment"): {
        "studies.alignment.wfe": (3, "waves", _statistic("forward_wfe", "mean")),
        **{f"studies.alignment.wfe_95_{name}": (3, "waves", _statistic(f"{name}_wfe", "p95")) for name in _CAMERAS},
        "studies.alignment.mtf_along": (3, "", _statistic("forward_mtf_along", "mean")),
        "studies.alignment.mtf_along_spread": (3, "", _statistic("forward_mtf_along", "std")),
        **{
            f"studies.alignment.mtf_across_{name}": (3, "", _statistic(f"{name}_mtf_across", "mean"))
            for name in _CAMERAS
        },
        "studies.alignment.mtf_across_spread": (3, "", _statistic("forward_mtf_across", "std")),
        **{
            f"studies.alignment.{change}{suffix}": (decimals, unit, _alignment_error(change, over))
            for change, of, digits in (("alpha", "arcsec", 3), ("gamma", "arcsec", 2), ("focal_length", "um", 1))
            for suffix, over, decimals, unit in (
                ("", "", digits, of),
                ("_over_noise", "sigma_noise", 0, ""),
                ("_over_sigma", "sigma", 2, ""),
            )
        },
        "studies.alignment.failed": (0, "", _failed()),
        "studies.alignment.near_the_edge": (0, "", _failed("too near the edge")),
        "studies.alignment.beyond_template": (0, "", _failed("left the range of the template")),
    },
    _study("interval"): {
        **{f"studies.interval.every_{minutes}": (1, "m", _height(minutes)) for minutes in (5, 10, 20, 50)},
        "studies.interval.without": (1, "m", _height(None)),
    },
    (*_study("alignment")[:2], "--gradient"): {
        "studies.gradient_e7": (
            0,
            "1e-7",
            lambda folder: 1e7 * float(json.loads((folder / "gradient.json").read_text("utf-8"))["worst_relative"]),
        )
    },
    ("twin.design", "scenes/examples/design_gf7_short.yaml"): {
        **_of_design("after", "short"),
        **_of_design("before", "gf7"),
        "studies.design.chief_ray_short": (1, "deg", _design(lambda d: np.mean(d["chief_ray_deg"]["after"]))),
        "studies.design.chief_ray_gf7": (2, "deg", _design(lambda d: np.max(d["chief_ray_deg"]["before"]))),
        "studies.design.starts_e6": (
            0,
            "1e-6",
            _design(lambda d: 1e6 * (np.ptp(_starts(d, "wavefront_error_waves")) / _errors_of_best(d))),
        ),
        "studies.design.jacobians_least": (0, "", _design(lambda d: _starts(d, "jacobians").min())),
        "studies.design.jacobians_most": (0, "", _design(lambda d: _starts(d, "jacobians").max())),
    },
}
"""Command of a shipped study -> its figures: decimals, unit, and function that reads each in the study's folder."""
