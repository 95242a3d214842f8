"""Spectrum in which a budget evaluates wavefronts and MTFs, and matrices that all its random cameras share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optics.numerics.array_math import UnphysicalError
from optics.waves.optical_transfer import VariedTransfer, polychromatic_transfer
from optics.waves.pupil_terms import products
from scenes.models.camera_model import lenses
from scenes.specs.camera import CameraSpec
from scenes.specs.spectrum import SpectrumSpec
from scenes.specs.tolerance import ToleranceBudgetSpec
from twin.camera.camera_optics import CameraOptics
from twin.tolerance.monitor_merit import Merit

TRANSFER = 1e-3
"""Largest allowed error of the nominal pupil's MTF when it is computed at fixed points of the pupil."""


def budget_spectrum(test: ToleranceBudgetSpec, camera: CameraSpec) -> SpectrumSpec | None:
    """Return the spectrum in which a budget evaluates a camera; None for its design wavelength.

    Raises
    ------
    InputError
        The budget requests a spectrum that the camera does not have.
    """
    if test.light == "spectrum" and camera.light is None:
        raise test.error(
            "the camera has no spectrum", ("light",), allowed="light: design, or a `spectrum` of the camera"
        )
    if test.light == "design" or (test.light is None and not lenses(camera)):
        return None
    return camera.light


@dataclass(frozen=True, eq=False)
class WavefrontNorm:
    """Matrices that map wavefront coefficients to residuals whose squares sum to the mean square wavefront.

    The mean square is over the illuminated pupil. Array dimensions: T polynomial coefficients, F fields.

    Attributes
    ----------
    rest : (F, T, T) ndarray
        Matrices for the wavefront without piston and tilt: the squares of their product with the coefficients sum to
        its mean square.
    tilt : (F, 2, T) ndarray
        Matrices that give the two components of the tilt in the same way.
    """

    rest: np.ndarray
    tilt: np.ndarray

    @classmethod
    def of(cls, fields: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]], degree: int) -> WavefrontNorm:
        """Compute the matrices for the illuminated pupils of F fields.

        Parameters
        ----------
        fields : sequence of tuple
            For each field the nodes x, y and the weights of a quadrature over the illuminated pupil.
        degree : int
            Degree of the polynomials over the stop.
        """
        rest, tilt = [], []
        for x, y, share in fields:
            table = products(x, y, degree)
            level = np.stack([np.ones_like(x), x, y], axis=-1)
            weighted = level * share[:, None]
            normal = level.T @ weighted
            # the plane through a wavefront, in functions that are orthonormal over the light; the first is piston
            tilt.append(np.linalg.solve(np.linalg.cholesky(normal), weighted.T @ table)[1:])
            table = table - level @ np.linalg.solve(normal, weighted.T @ table)
            value, vector = np.linalg.eigh(table.T @ (table * share[:, None]))
            rest.append(np.sqrt(np.maximum(value, 0.0))[:, None] * vector.T)
        return cls(np.stack(rest), np.stack(tilt))

    def residuals(self, terms: np.ndarray, shares: np.ndarray) -> np.ndarray:
        """Return residuals whose squares sum to the mean square wavefront over all fields and the spectrum.

        The mean tilt of all wavelengths is removed; a tilt that differs between wavelengths blurs the image and stays.

        Array dimensions: S cameras, F fields, K wavelengths, T polynomial coefficients, R residuals.

        Parameters
        ----------
        terms : (S, F, K, T) ndarray
            Polynomial coefficients of the wavefronts about a common image point.
        shares : (K,) ndarray
            Weights of the wavelengths in the spectrum; they sum to 1.

        Returns
        -------
        (S, R) ndarray
            Residuals in the unit of the coefficients.
        """
        out = terms @ np.swapaxes(self.rest, 1, 2)
        if len(shares) > 1:
            tilt = terms @ np.swapaxes(self.tilt, 1, 2)
            tilt = tilt - np.einsum("k,sfkj->sfj", shares, tilt)[:, :, None]
            out = np.concatenate([out, tilt], axis=-1) * np.sqrt(shares)[:, None]
        return np.asarray(out.reshape(len(terms), -1))


def fixed_transfers(
    optics: CameraOptics,
    test: ToleranceBudgetSpec,
    merits: Sequence[Merit],
    fields: np.ndarray,
    light: tuple[np.ndarray, np.ndarray],
    cosines: np.ndarray,
    degree: int,
) -> dict[int, list[list[VariedTransfer]]]:
    """Return the operators that give the MTF of every merit of kind ``mtf`` from the wavefront.

    Array dimensions: F fields, C wavelengths, N rays.

    Parameters
    ----------
    optics : CameraOptics
        Nominal camera.
    test : ToleranceBudgetSpec
        Budget, for messages.
    merits : sequence of Merit
        Merits of the budget.
    fields : (F, 2) ndarray
        Field points of the budget.
    light : tuple of ndarray
        Wavelengths, metres, and their weights in the spectrum, (C,) each.
    cosines : (C or 1, F, N, 2) ndarray
        Direction cosines of the traced rays.
    degree : int
        Degree of the polynomials over the stop.

    Returns
    -------
    dict
        Index of the merit -> operators by field and direction.

    Raises
    ------
    InputError
        The nominal camera has no MTF, or none at the requested frequency.
    """
    asked = [(k, merit) for k, merit in enumerate(merits) if merit.spec.kind == "mtf"]
    if not asked:
        return {}
    try:
        pupils = optics.colour_pupils(fields, light[0])
    except UnphysicalError as error:
        raise test.error(f"the designed camera has no MTF: {error}", ("merits", asked[0][1].name)) from error
    out = {}
    for k, merit in asked:
        spec = merit.spec
        size = optics.nyquist if spec.frequency is None else 1e3 * spec.frequency
        axes = {"line": (0,), "track": (1,), "worse": (0, 1)}[spec.direction]
        rows = []
        for f in merit.fields:
            row = []
            for axis in axes:
                frequency = size * np.eye(2)[axis]
                fixed = VariedTransfer.of(pupils[f], frequency, *light, cosines[:, f], degree)
                if fixed is None:
                    problem = f"{1e-3 * size:.4g} cycles per mm lie beyond the cut-off at a field"
                    raise test.error(problem, ("merits", merit.name, "frequency"), allowed="a lower frequency")
                pupil = pupils[f] if len(pupils[f]) > 1 else pupils[f][0]
                problem, allowed = (
                    "the MTF of the designed camera has not converged",
                    "a sharper camera, or another merit",
                )
                try:
                    whole = abs(polychromatic_transfer(pupil, frequency[None], *light, np.zeros(1))[0, 0])
                except UnphysicalError as error:
                    raise test.error(f"{problem}: {error}", ("merits", merit.name), allowed=allowed) from error
                if abs(fixed.known - whole) > TRANSFER:
                    raise test.error(problem, ("merits", merit.name), allowed=allowed)
                row.append(fixed)
            rows.append(row)
        out[k] = rows
    return out
