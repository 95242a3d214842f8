"""Comparison with other libraries: the measured numbers of the page by_hand.md."""

from __future__ import annotations

import resource
import subprocess
import sys

import numpy as np
from scipy import ndimage

from analysis.matching.correlation import MatchOptions
from analysis.matching.least_squares import least_squares
from optics.geometry import zernike

SEED = 1


def measured() -> dict[str, tuple[float, int, str]]:
    """Return value, decimals and unit of each figure, by name. Needs the packages of ``bash setup.sh --test``."""
    ours, theirs = _matching()
    special = _import_cost("scipy.special")
    return {
        "libraries.matching_ours": (ours, 3, "px"),
        "libraries.matching_skimage": (theirs, 2, "px"),
        "libraries.zernike_e14": (1e14 * _zernike_difference(), 0, "1e-14"),
        "libraries.import_stats": (_import_cost("scipy.stats") - special, 1, "s"),
        "libraries.import_photutils": (_import_cost("photutils.centroids"), 1, "s"),
        "libraries.import_poppy": (_import_cost("poppy"), 1, "s"),
        "libraries.import_fits": (_import_cost("astropy.io.fits"), 1, "s"),
    }


def _import_cost(module: str) -> float:
    """Return the processor time of an import after NumPy's, in seconds, the least of three."""

    def spent(code: str) -> float:
        found = []
        for _ in range(3):
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            subprocess.run([sys.executable, "-c", code], check=True)
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            found.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
        return min(found)

    return spent(f"import numpy, {module}") - spent("import numpy")


def _zernike_difference() -> float:
    """Return the largest difference of the first 36 Zernike terms from poppy's on a disk."""
    from poppy.zernike import zernike1

    y, x = np.mgrid[-1:1:201j, -1:1:201j]
    inside = np.hypot(x, y) < 1.0
    x, y = x[inside], y[inside]
    polar = {"rho": np.hypot(x, y), "theta": np.arctan2(y, x)}
    return max(float(np.abs(zernike.zernike(j, x, y) - zernike1(j, **polar)).max()) for j in range(1, 37))


def _matching() -> tuple[float, float]:
    """Return RMS errors of positions along an axis, by our matching and by phase correlation to a hundredth of a pixel.

    Windows of 25 pixels of a random texture, with a tenth of its contrast as noise, are shifted by up to half a pixel.
    """
    from skimage.registration import phase_cross_correlation

    random, size, half = np.random.default_rng(SEED), 512, 12
    texture = ndimage.gaussian_filter(random.normal(size=(size, size)), 1.5, mode="wrap")
    texture = 1000.0 + 200.0 * texture / texture.std()
    spectrum, f = np.fft.fft2(texture), np.fft.fftfreq(size)
    ours, theirs = [], []
    for _ in range(8):
        shift = random.uniform(-0.5, 0.5, 2)
        phase = np.exp(-2j * np.pi * (f[:, None] * shift[0] + f[None] * shift[1]))
        image = np.fft.ifft2(spectrum * phase).real + random.normal(0.0, 20.0, texture.shape)
        places = random.integers(60, size - 60, (40, 2))
        windows = [np.s_[r - half : r + half + 1, c - half : c + half + 1] for r, c in places]
        templates = np.array([texture[window] for window in windows])
        ours.append(least_squares(image, templates, places.astype(float), MatchOptions()).position - places - shift)
        for window, template in zip(windows, templates, strict=True):
            theirs.append(phase_cross_correlation(image[window], template, upsample_factor=100)[0] - shift)
    return float(np.sqrt(np.mean(np.square(ours)))), float(np.sqrt(np.mean(np.square(theirs))))
