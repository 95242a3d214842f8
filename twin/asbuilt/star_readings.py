"""Images of stars as measurements of wavefronts: predicted pixels and their derivatives.

The wavefront of a star is what an instrument's state predicts. Its position, flux and background, and the blur of
seeing if it is free, belong to the image alone: they are fitted to the pixels in every state, and the derivatives are
projected on what they cannot explain (variable projection with Kaufman's approximation: BIT 15, 49, 1975). A least
squares estimate on these readings is that of all unknowns together, with a flat prior of those of the images.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from analysis.arrays import Array
from optics.waves.star_image import StarImage

FWHM = float(2.0 * np.sqrt(2.0 * np.log(2.0)))
"""Full width at half maximum of a Gaussian over its standard deviation."""
_FAINT = 3.0
"""Number of standard deviations of the noise above the background from which a pixel counts for the centroid."""
_STEPS = 30


@dataclass(frozen=True, eq=False)
class StarFit:
    """Quantities of one image of a star that do not belong to the instrument.

    Attributes
    ----------
    position : (2,) ndarray
        Row and column of the chief ray, pixels from the middle of the image.
    blur : float
        Standard deviation of the Gaussian blur, metres.
    flux : float
        Light of the whole star, electrons.
    background : float
        Background, electrons per pixel.
    model : (R, C) ndarray
        Predicted image, electrons.
    columns : (R C, N) ndarray
        Derivatives of the pixels with respect to the N fitted quantities.
    """

    position: Array
    blur: float
    flux: float
    background: float
    model: Array
    columns: Array


@dataclass(frozen=True, eq=False)
class StarReading:
    """Image of a star with R x C pixels, recorded or, for a prediction before the measurement, expected.

    Attributes
    ----------
    image : StarImage
        Model of the image.
    blur : float or None
        Standard deviation of the Gaussian blur, metres; None if it is fitted.
    first : StarFit
        Values at which a fit starts; they are the expected ones where nothing was recorded.
    counts : (R, C) ndarray or None
        Recorded electrons; None before the measurement.
    variance : (R, C) ndarray
        Variance of the pixels, squared electrons; infinite where a pixel is not used.
    """

    image: StarImage
    blur: float | None
    first: StarFit
    counts: Array | None
    variance: Array

    @property
    def fitted(self) -> int:
        """Number of quantities of the image alone."""
        return 4 if self.blur is not None else 5

    def with_noise(self, model: Array, read_noise: float) -> StarReading:
        """Return the image with the noise of its expected light in place of that of the recorded one."""
        variance = read_noise**2 + np.maximum(model, 0.0)
        return replace(self, variance=np.where(np.isfinite(self.variance), variance, np.inf))

    def fit(self, irradiance: Array) -> StarFit:
        """Fit position, flux, background and, if it is free, blur to the recorded pixels.

        Parameters
        ----------
        irradiance : (M, M) ndarray
            Irradiance of unit power at the samples of the model, 1/m^2.
        """
        free = self.blur is None
        blur = self.first.blur if self.blur is None else self.blur
        if self.counts is None:
            return self._at(irradiance, np.array([*self.first.position, blur]), self.first.flux, self.first.background)
        weight = 1.0 / np.sqrt(self.variance)
        counts, unit = (weight * self.counts).ravel(), self.image.pitch
        start = self._start(irradiance, blur)

        last: list[tuple[Array, Array, Array]] = []

        def at(x: Array) -> tuple[Array, Array]:
            """Return residuals and their derivatives where flux and background fit best."""
            if not last or not np.array_equal(last[-1][0], x):
                parts = self.image.pixel_slopes(irradiance, x[:2], x[2] * unit if free else blur)
                parts[3] *= unit
                white = (parts * weight).reshape(4, -1)
                table = np.linalg.qr(np.stack([white[0], weight.ravel()], axis=-1))[0]
                flux = np.linalg.lstsq(np.stack([white[0], weight.ravel()], axis=-1), counts, rcond=None)[0][0]
                rows = flux * white[1 : 4 if free else 3].T
                last[:] = [(x.copy(), table @ (table.T @ counts) - counts, rows - table @ (table.T @ rows))]
            return last[-1][1:]

        first = np.array([*start, blur / unit] if free else start)
        solution = least_squares(
            lambda x: at(x)[0],
            first,
            lambda x: at(x)[1],
            method="lm",
            xtol=1e-10,
            ftol=1e-14,
            gtol=1e-12,
            max_nfev=_STEPS,
        ).x
        place = np.array([*solution[:2], solution[2] * unit if free else blur])
        share = self.image.pixels(irradiance, place[:2], place[2]) * weight
        flux, background = np.linalg.lstsq(np.stack([share.ravel(), weight.ravel()], axis=-1), counts, rcond=None)[0]
        return self._at(irradiance, place, flux, background)

    def _start(self, irradiance: Array, blur: float) -> Array:
        """Return the position at which the model's centroid is that of the recorded light, (2,), pixels."""
        assert self.counts is not None
        used = np.isfinite(self.variance)
        border = used.copy()
        border[1:-1, 1:-1] = False
        border = border if np.any(border) else used
        light = self.counts - np.median(self.counts[border])
        light = np.where(used & (light > _FAINT * np.sqrt(np.median(self.variance[border]))), light, 0.0)
        position = np.asarray(self.first.position, np.float64)
        model = self.image.pixels(irradiance, position, blur)
        return position + centroid(light) - centroid(np.maximum(model, 0.0))

    def _at(self, irradiance: Array, at: Array, flux: float, background: float) -> StarFit:
        """Return the image and its derivatives for given row, column and blur, (3,), flux and background."""
        parts = self.image.pixel_slopes(irradiance, at[:2], float(at[2]))
        columns = [flux * parts[1], flux * parts[2], parts[0], np.ones_like(parts[0])]
        columns += [flux * parts[3]] if self.blur is None else []
        table = np.stack([column.ravel() for column in columns], axis=-1)
        return StarFit(at[:2], abs(float(at[2])), float(flux), float(background), flux * parts[0] + background, table)

    def predict(self, terms: Array) -> StarFit:
        """Return the predicted image for T coefficients of the eikonal, with what is fitted to the recorded one."""
        return self.fit(self.image.irradiance(terms))

    def slope(self, terms: Array, directions: Array) -> Array:
        """Return the derivatives of the pixels along K directions of the coefficients, (R C, K).

        The quantities that belong to the image alone are fitted again in every state: the derivatives are those that
        remain.

        Parameters
        ----------
        terms : (T,) ndarray
            Coefficients of the eikonal, metres.
        directions : (K, T) ndarray
            Changes of the coefficients, metres per unit.
        """
        # the derivatives of many directions are combinations of a few
        left, size, right = np.linalg.svd(directions, full_matrices=False)
        kept = size > 1e-6 * max(size[0], 1e-300)
        irradiance, moved = self.image.irradiance_slopes(terms, right[kept])
        fit = self.fit(irradiance)
        pixels = fit.flux * self.image.pixels(moved, fit.position, fit.blur)
        rows = pixels.reshape(len(moved), -1).T @ (left[:, kept] * size[kept]).T
        weight = 1.0 / np.sqrt(self.variance).ravel()[:, None]
        table = np.linalg.qr(fit.columns * weight * 1.0 / np.linalg.norm(fit.columns * weight, axis=0))[0]
        white = rows * weight
        used = np.isfinite(self.variance).ravel()
        projected = white - table @ (table.T @ white)
        rows[used] = projected[used] / weight[used]
        return np.asarray(rows)


def centroid(light: Array) -> Array:
    """Return row and column of the centroid of an image from its middle, (2,), pixels; 0 without light."""
    total = np.sum(light)
    if not total > 0.0:
        return np.zeros(2)
    axes = (np.arange(size) - 0.5 * (size - 1) for size in light.shape)
    return np.array([np.sum(light.sum(axis=1 - k) * axis) / total for k, axis in enumerate(axes)])
