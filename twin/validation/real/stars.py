"""Defocused images of a real star, beside the Zernike terms that another program fits to them."""

from __future__ import annotations

import pickle
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, files
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from analysis.instrument_state.state_estimate import MeasuredGroup, StateEstimate, StatePrior, estimate_state
from optics.numerics.quadrature import disk
from optics.waves.imaging import orthonormal_rows
from optics.waves.star_image import StarImage, StarPupil
from twin.asbuilt.star_readings import FWHM, StarFit, StarReading
from twin.validation.check import CheckResult
from twin.validation.group import Context, drawing, group_of, load_printed
from twin.validation.row_names import REAL, matches

FILE = "danish/AuxTelTestDonuts.pkl"
"""File in the folder of measured data; the wheel of danish has it as tests/data/AuxTelTestDonuts.pkl."""
RADIUS, HOLE, FOCAL, PITCH = 0.6, 0.2115, 20.8, 10e-6
"""Radii of the pupil, focal length and pitch of the pixels, metres, as in danish's tests of this telescope."""
WAVELENGTH = 1.4e-6
"""Wavelength of the model, metres: twice the real one, since a seeing of ten times the diffraction leaves only rays."""
BINNING, NOISE = 3, 300.0
"""Pixels that are added along each axis, and standard deviation of their sum, electrons: the error of the model."""
TERMS = tuple(range(4, 12))
START, SIGMAS = 3.2e-6, (1e-6, *[3e-7] * 7)
"""Defocus at which the fit starts, and standard deviations of the prior of all terms, metres."""


class _Arrays(pickle.Unpickler):
    """Reader of a pickled list of arrays, which runs nothing else that the file may name."""

    def find_class(self, module: str, name: str) -> Any:
        if module in ("numpy.core.multiarray", "numpy._core.multiarray", "numpy") and name in (
            "_reconstruct", "scalar", "ndarray", "dtype",
        ):  # fmt: skip
            return super().find_class(module.replace("numpy.core", "numpy._core"), name)
        raise pickle.UnpicklingError(f"{module}.{name} is no array")


def star_file(folder: Path) -> Path | None:
    """Return the file of the images in the folder of measured data or in an installed danish; None without either."""
    if (folder / FILE).is_file():
        return folder / FILE
    try:
        inside = [Path(str(entry.locate())) for entry in files("danish") or () if entry.name == Path(FILE).name]
    except PackageNotFoundError:
        return None
    return next((path for path in inside if path.is_file()), None)


def star_images(path: Path) -> list[np.ndarray]:
    """Return the two images, electrons, with pixels added up."""
    with path.open("rb") as stream:
        pages = _Arrays(stream).load()[0]
    size = len(pages[0]) // BINNING
    return [np.asarray(page, float).reshape(size, BINNING, size, BINNING).sum(axis=(1, 3)) for page in pages]


def fitted(counts: np.ndarray) -> tuple[StateEstimate, StarReading, StarFit]:
    """Return annular Zernike terms of a star's wavefront, metres, and the image that they predict."""
    nodes, aperture = disk(60, 240, inner=HOLE / RADIUS), RADIUS / FOCAL
    element = nodes.weight * aperture**2
    pupil = StarPupil(aperture * nodes.x, aperture * nodes.y, element / np.sqrt(np.sum(element)), WAVELENGTH)
    annular = orthonormal_rows(nodes.x, nodes.y, nodes.weight, TERMS[-1])[0][TERMS[0] - 1 :] / nodes.share
    terms = annular @ pupil.terms(pupil.u, pupil.v, nodes.weight, 6).T
    blur = 10.0 * PITCH
    image = StarImage(pupil, 6, counts.shape, BINNING * PITCH, blur=1.5 * blur)
    none = np.zeros((0, 0))
    variance = np.full(counts.shape, NOISE**2)
    star = StarReading(image, None, StarFit(np.zeros(2), blur, 0.0, 0.0, none, none), counts, variance)
    mean = np.zeros(len(TERMS))
    mean[0] = START
    prior = StatePrior.of([f"Z{j}" for j in TERMS], np.diag(SIGMAS) ** 2, mean)
    names = ("star",) * counts.size
    group = MeasuredGroup(
        "star", "images", names, counts.ravel(), variance.ravel(), np.zeros((counts.size, 0)), np.zeros(0), names,
        star.fitted,
    )  # fmt: skip

    def predict(states: np.ndarray) -> np.ndarray:
        return np.stack([star.predict(state @ terms).model.ravel() for state in states])

    estimate = estimate_state(prior, [group], predict, lambda state: star.slope(state @ terms, terms))
    return estimate, star, star.predict(estimate.mean @ terms)


@drawing("real-stars", 3.6)
def stars_svg(figure: Figure, images: list[np.ndarray], fits: list[StarFit]) -> None:
    """Draw the images, the fitted ones and the differences."""
    axes = figure.subplots(len(images), 3)
    for row, counts, fit in zip(axes, images, fits, strict=True):
        peak = float(np.max(counts))
        shown = ((counts, 0.0, peak, "viridis"), (fit.model, 0.0, peak, "viridis"))
        for ax, (values, low, high, colours) in zip(
            row, (*shown, (counts - fit.model, -0.3 * peak, 0.3 * peak, "RdBu_r")), strict=True
        ):
            ax.imshow(values, vmin=low, vmax=high, cmap=colours, origin="lower")
            ax.set(xticks=[], yticks=[])
    for ax, text in zip(axes[0], ("measured", "fitted", "difference"), strict=True):
        ax.set_title(text)


def run(context: Context) -> Iterator[CheckResult]:
    """Yield the results of the rows on images of a star."""
    if not context.wants("real.stars"):
        return
    path = star_file(context.real)
    if path is None:
        why = f"no {FILE} in {context.real}, and danish is not installed; --real or TWIN_REAL names the folder"
        yield from (
            context.check(name).skipped(why) for name in sorted(context.selected) if matches(name, "real.stars")
        )
        return
    other = load_printed(REAL).content.data["danish"]
    images, fits, worst = star_images(path), [], []
    for name, counts in zip(("first", "second"), images, strict=True):
        estimate, _, fit = fitted(counts)
        fits.append(fit)
        values, theirs = 1e9 * estimate.mean, np.array(other[name])
        sigma = 1e9 * estimate.sigma * np.sqrt(estimate.variance_factor)
        apart = np.abs(values - theirs)
        worst.append((float(apart[0]), float(sigma[0])))
        k = 1 + int(np.argmax(apart[1:-1]))
        yield context.row(
            f"real.stars.{name}", float(apart[k]), float(sigma[k]), 0.0, values=values, other=theirs,
            seeing=FWHM * fit.blur / FOCAL * 206264.8,
        )  # fmt: skip
    yield context.row("real.stars.defocus", *max(worst), 0.0)
    context.figure("stars", stars_svg(images, fits))


GROUP = group_of("real.stars", run)
