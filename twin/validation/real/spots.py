"""Spots in flight: windows of an aspect camera's fiducial lights and stars, and the scatter of their positions."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy import linalg

from analysis.arrays import Array
from analysis.spots.likelihood import fit_spot
from analysis.spots.noise import NoiseModel
from analysis.spots.window_series import CAUSES, WindowSeries, chi_square_about, fit_window_series
from analysis.statistics import rms
from twin.framework.svg import AFTER, BEFORE, INK
from twin.validation.check import CheckResult, mean_of
from twin.validation.group import Context, drawing, group_of, load_printed
from twin.validation.measured_data import on_files
from twin.validation.row_names import REAL

PIXEL_ARCSEC = 5.0
"""Size of a pixel of the camera on the sky, arcseconds."""
FIDUCIAL, STAR = "fiducial lights", "stars"
_ROWS_OF_KIND = {
    "fiducials": ("fiducials", "fiducials_noise_alone", "successive", "distances", "gaussian"),
    "stars": ("stars", "stars_noise_alone"),
}
"""First part of the rows' names for each kind of light -> the rows that need two lights of it."""
_RADIANS_PX = 500.0
"""Scale of the rotation of the field in the design matrix, px, so that its column has the size of the others."""


@dataclass(frozen=True, eq=False)
class Windows:
    """Windows of one light: (N, H, W) grey values, used pixels, first pixels (N, 2), times, and CCD temperature, K."""

    name: str
    images: Array
    used: NDArray[np.bool_]
    corners: NDArray[np.intp]
    time: Array
    temperature: Array

    @property
    def kind(self) -> str:
        """Kind of the light: the camera takes windows of 8 x 8 px of fiducial lights here, others of stars."""
        return FIDUCIAL if self.images.shape[1] == 8 else STAR


@dataclass(frozen=True, eq=False)
class Light:
    """Windows of one light with the fitted positions."""

    windows: Windows
    fit: WindowSeries


def read_windows(path: Path) -> Windows:
    """Return the windows in a level-0 file of the aspect camera; the corners of 6 x 6 px carry no data."""
    with fits.open(path) as file:
        table = file[1].data
        pixels = np.asarray(table["IMGRAW"], np.float64)
        side = round(float(np.sqrt(pixels[0].size)))
        used = np.ones((side, side), bool)
        if side == 6:
            used[np.ix_([0, -1], [0, -1])] = False
        corners = np.stack([table["IMGROW0"], table["IMGCOL0"]], axis=1).astype(np.intp)
        time, temperature = (np.asarray(table[name], np.float64) for name in ("TIME", "TEMPCCD"))
    name = path.name.removesuffix(".gz").removesuffix(".fits")
    return Windows(name, pixels.reshape(-1, side, side), used, corners, time, temperature)


def _polynomial(time: Array, degree: int = 1) -> Array:
    """Return a motion as powers of the time from the highest, (N, degree + 1); degree 1 is a uniform motion."""
    return np.vander((time - time.mean()) / np.ptp(time), degree + 1)


def common_motion(lights: Sequence[Light], cause: str | None = None) -> tuple[float, int, Array]:
    """Return chi-square of several lights' positions, its degrees of freedom, and residuals (L, N, 2) px.

    Every frame may shift and rotate all lights together, which is the spacecraft's motion, and every light may drift
    uniformly.

    Parameters
    ----------
    lights : sequence of Light
        L lights with N frames each, taken together.
    cause : str or None
        Cause whose covariance alone is expected; None for all.
    """
    count, time = len(lights[0].windows.time), lights[0].windows.time
    common = []
    for light in lights:
        row, column = light.fit.position.mean(axis=0) / _RADIANS_PX
        common.append(np.kron(np.eye(count), [[1.0, 0.0, -column], [0.0, 1.0, row]]))
    drifts = linalg.block_diag(*[np.kron(_polynomial(time), np.eye(2))] * len(lights))
    parts = [light.fit.covariance if cause is None else light.fit.parts[cause] for light in lights]
    positions = np.concatenate([light.fit.position.ravel() for light in lights])
    design = np.concatenate([np.concatenate(common), drifts], axis=1)
    chi, degrees, residual = chi_square_about(design, positions, linalg.block_diag(*parts))
    return chi, degrees, residual.reshape(len(lights), count, 2)


def _distances(lights: Sequence[Light]) -> tuple[float, int, float]:
    """Return chi-square of constant distances between lights, its degrees of freedom, and their rms scatter, px."""
    chi, degrees, square = 0.0, 0, []
    for a, b in combinations(lights, 2):
        apart = a.fit.position - b.fit.position
        length = np.linalg.norm(apart, axis=1)
        along = linalg.block_diag(*(apart / length[:, None])[:, None, :])
        covariance = along @ (a.fit.covariance + b.fit.covariance) @ along.T
        of_pair, free, residual = chi_square_about(np.ones((len(length), 1)), length, covariance)
        chi, degrees = chi + of_pair, degrees + free
        square.append(float(residual @ residual) / free)
    return chi, degrees, float(np.sqrt(np.mean(square)))


@drawing("real-spots", 6.0)
def spots_svg(figure: Figure, lights: Sequence[Light], left: dict[str, Array]) -> None:
    """Draw mean windows, residuals in sigmas of the noise, and positions without the common motion."""
    grid = figure.subplots(3, len(lights), squeeze=False)
    for k, light in enumerate(lights):
        image = np.where(light.windows.used, light.windows.images[0], np.nan)
        grid[0, k].imshow(np.sqrt(np.maximum(image, 0.0)), cmap="gray")
        grid[1, k].imshow(light.fit.residual[0], cmap="RdBu", vmin=-4, vmax=4)
        grid[0, k].set_title(light.windows.name.removeprefix("test_level0_"), fontsize=8)
        for axis, colour in ((0, AFTER), (1, BEFORE)):
            time = light.windows.time - light.windows.time[0]
            residual = 1e3 * left[light.windows.name][:, axis]
            grid[2, k].errorbar(time, residual, 1e3 * light.fit.sigma[:, axis], color=colour, lw=0.8, ms=2, fmt="o")
        grid[2, k].axhline(0.0, color=INK, lw=0.5)
        for axes in grid[:2, k]:
            axes.set_xticks([])
            axes.set_yticks([])
        grid[2, k].tick_params(labelsize=6)
    grid[2, 0].set_ylabel("10⁻³ px")
    grid[2, len(lights) // 2].set_xlabel("seconds")


def _gaussian(lights: Sequence[Light], noise: NoiseModel) -> tuple[float, int]:
    """Return chi-square of positions by `fit_spot` about a uniform drift, and its degrees of freedom."""
    chi, degrees = 0.0, 0
    for light in lights:
        fit = fit_spot(light.windows.images, noise, radius=2.5)
        position, design = np.stack([fit.row, fit.column], axis=1), _polynomial(light.windows.time)
        covariance = linalg.block_diag(*fit.covariance)
        of_light, free, _ = chi_square_about(np.kron(design, np.eye(2)), position.ravel(), covariance)
        chi, degrees = chi + of_light, degrees + free
    return chi, degrees


def _groups(lights: Sequence[Light]) -> dict[str, list[Light]]:
    """Return the lights of each kind that were recorded at the same times."""
    out: dict[str, list[Light]] = {}
    for light in lights:
        same = out.setdefault(light.windows.kind, [])
        if not same or np.array_equal(same[0].windows.time, light.windows.time):
            same.append(light)
    return {kind: group for kind, group in out.items() if len(group) > 1}


def _rows(context: Context, paths: list[Path]) -> Iterator[CheckResult]:
    lights = []
    for k, path in enumerate(paths):
        context.progress(k / (len(paths) + 1), path.name)
        windows = read_windows(path)
        lights.append(Light(windows, fit_window_series(windows.images, corners=windows.corners, used=windows.used)))
    gains = np.array([light.fit.prior.gain_dn_per_e for light in lights])
    gain, sigma = mean_of(gains)
    yield context.row("real.spots.gain", gain, sigma, gains=gains, per_dn=1.0 / gain, sets=len(lights))
    yield context.row("real.spots.unit", gain, sigma)
    groups = _groups(lights)
    left: dict[str, Array] = {light.windows.name: np.zeros((len(light.windows.time), 2)) for light in lights}
    chi_all, degrees_all = 0.0, 0
    for kind, name in ((FIDUCIAL, "fiducials"), (STAR, "stars")):
        group = groups.get(kind)
        if not group:
            yield from (
                context.check(f"real.spots.{row}").skipped(f"there are no two {kind} of the same times")
                for row in _ROWS_OF_KIND[name]
            )
            continue
        chi, degrees, residual = common_motion(group)
        chi_all, degrees_all = chi_all + chi, degrees_all + degrees
        left.update({light.windows.name: of_light for light, of_light in zip(group, residual, strict=True)})
        noise_only, _, _ = common_motion(group, CAUSES[0])
        sigmas = {cause: np.mean([_rms_sigma(light.fit, cause) for light in group]) for cause in CAUSES}
        facts: dict[str, Any] = {
            "lights": len(group), "degrees": degrees, "sigmas": sigmas, "rms": [rms(of_light) for of_light in residual],
            "prnu": [light.fit.prior.prnu for light in group],
        }  # fmt: skip
        yield context.row(f"real.spots.{name}", chi / degrees, float(np.sqrt(2.0 / degrees)), 1.0, **facts)
        yield context.row(
            f"real.spots.{name}_noise_alone", noise_only / degrees, float(np.sqrt(2.0 / degrees)), 1.0, **facts
        )
        if kind == FIDUCIAL:
            steps = [rms(np.diff(light.fit.position, axis=0)) for light in group]
            yield context.row("real.spots.successive", *mean_of(np.array(steps)), steps=steps)
            apart, free, scatter = _distances(group)
            yield context.row("real.spots.distances", apart / free, float(np.sqrt(2.0 / free)), 1.0,
                              scatter=scatter, mas=1e3 * PIXEL_ARCSEC * scatter,
                              temperature=np.ptp(group[0].windows.temperature))  # fmt: skip
            mean = group[0].fit.prior
            chi, free = _gaussian(group, NoiseModel(mean.gain_dn_per_e, mean.read_dn / mean.gain_dn_per_e))
            yield context.row("real.spots.gaussian", chi / free, float(np.sqrt(2.0 / free)), 1.0)
    if degrees_all:
        yield context.row(
            "real.spots.all", chi_all / degrees_all, float(np.sqrt(2.0 / degrees_all)), 1.0, degrees=degrees_all
        )
    else:
        yield context.check("real.spots.all").skipped("there are no two lights of the same times")
    pixels = np.array([light.fit.reduced_chi_square for light in lights])
    yield context.row("real.spots.pixels", *mean_of(pixels), 1.0, pixels=pixels)
    context.table("sets", [_set_row(light, left[light.windows.name]) for light in lights])
    context.figure("spots", spots_svg(lights, left))


def _rms_sigma(fit: WindowSeries, cause: str) -> float:
    return float(np.sqrt(np.mean(np.diagonal(fit.parts[cause]))))


def _set_row(light: Light, left: Array) -> list[Any]:
    chi, degrees, _ = light.fit.scatter(_polynomial(light.windows.time, 2))
    prior, fit = light.fit.prior, light.fit
    return [
        light.windows.name, light.windows.kind, len(left), 1e3 * rms(left), 1e3 * rms(fit.sigma),
        *(1e3 * _rms_sigma(fit, cause) for cause in CAUSES), chi / degrees, fit.reduced_chi_square, fit.width,
        prior.shape, prior.length, 100.0 * prior.prnu, prior.dark_dn, prior.gain_dn_per_e, prior.read_dn,
        float(light.windows.temperature.mean()) - 273.15,
    ]  # fmt: skip


def run(context: Context) -> Iterator[CheckResult]:
    """Yield the results of the rows on spots in flight."""
    yield from on_files(context, "real.spots", load_printed(REAL).content.data["chandra"]["files"], _rows)


GROUP = group_of("real.spots", run)
