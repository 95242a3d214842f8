"""Photographs and scans that scikit-image, scikit-learn and matplotlib ship, resampled by SciPy's and OpenCV's means,
and a stereo pair with its own disparities.
"""

from pathlib import Path

import cv2
import matplotlib
import numpy as np
import pytest
from scipy import ndimage
from sklearn.datasets import load_sample_images

from analysis.mtf.edge_location import EdgeError
from analysis.mtf.slanted_edge import measure_edge
from tests.analysis.stereo_pairs import HALF, Pair

SHIFT = np.array([0.37, -0.21])
AFFINE = np.array([[1.004, -0.006], [0.005, 0.997]])
NOISE = 2.0
"""DN of 256, white, in both images."""
_GREY = np.array([0.299, 0.587, 0.114])
DRAWN = ("chessboard_GRAY", "chessboard_RGB", "color", "horse", "logo", "no_time_for_that_tiny", "phantom", "multipage")
"""Drawings and graphics, by the beginnings of their names: without the texture of a photograph."""


def photographs() -> dict[str, np.ndarray]:
    """Name -> grey values 0 to 255 (rows, columns), in the order of names; skips the test without scikit-image."""
    data = Path(pytest.importorskip("skimage.data").__file__).parent
    files = [path for path in sorted(data.iterdir()) if path.suffix in (".png", ".jpg")]
    files.append(Path(matplotlib.get_data_path()) / "sample_data" / "grace_hopper.jpg")
    out = {}
    for path in files:
        image = cv2.imread(str(path), cv2.IMREAD_COLOR)
        if image is not None and not path.stem.startswith(DRAWN):
            out[path.stem] = image[..., ::-1].astype(float) @ _GREY
    for name, image in zip(load_sample_images().filenames, load_sample_images().images, strict=True):
        out[Path(name).stem] = image.astype(float) @ _GREY
    return out


def drawings() -> dict[str, np.ndarray]:
    """The same of drawings and graphics."""
    data = Path(pytest.importorskip("skimage.data").__file__).parent
    out = {}
    for path in sorted(data.glob("*.png")):
        if path.stem.startswith(DRAWN):
            image = cv2.imread(str(path), cv2.IMREAD_COLOR)
            if image is not None:
                out[path.stem] = image[..., ::-1].astype(float) @ _GREY
    return out


def shifted(image: np.ndarray, seed: int = 1) -> Pair:
    """The image against itself moved by SHIFT through its Fourier transform, noise in both."""
    smooth = _sampled(image)
    wide = np.pad(smooth, 32, mode="reflect")
    moved = np.fft.ifftn(ndimage.fourier_shift(np.fft.fftn(wide), SHIFT)).real[32:-32, 32:-32]
    places = _lattice(image.shape)
    return _noisy(smooth, moved, places, places + SHIFT, seed)


def turned(image: np.ndarray, seed: int = 2) -> Pair:
    """The same through an affine map about its middle, by OpenCV's Lanczos kernel."""
    smooth = _sampled(image)
    middle = 0.5 * (np.array(image.shape) - 1.0)
    # (row, column) of the second image = middle + AFFINE (place - middle) + SHIFT; OpenCV counts (x, y)
    offset = middle + SHIFT - AFFINE @ middle
    matrix = np.column_stack([AFFINE[::-1, ::-1], offset[::-1]])
    moved = cv2.warpAffine(smooth, matrix, image.shape[::-1], flags=cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REFLECT)
    places = _lattice(image.shape)
    return _noisy(smooth, moved, places, places @ AFFINE.T + offset, seed)


def _sampled(image: np.ndarray) -> np.ndarray:
    """Detail below the sampling limit, which an exact resampling takes."""
    return np.asarray(ndimage.gaussian_filter(image, 0.7))


def _lattice(shape: tuple[int, ...], step: int = 33) -> np.ndarray:
    room = HALF + 10
    rows, columns = (np.arange(room, size - room, step) for size in shape[:2])
    return np.stack(np.meshgrid(rows, columns, indexing="ij"), axis=-1).reshape(-1, 2).astype(float)


def _noisy(first: np.ndarray, second: np.ndarray, places: np.ndarray, true: np.ndarray, seed: int) -> Pair:
    rng = np.random.default_rng(seed)
    noise = NOISE * rng.standard_normal((2, *first.shape))
    return Pair(first + noise[0], second + noise[1], places, true)


def motorcycle() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Left and right image and disparity of the left one, grey values and px."""
    data = Path(pytest.importorskip("skimage.data").__file__).parent
    left, right = (
        cv2.imread(str(data / f"motorcycle_{side}.png")).astype(float)[..., ::-1] @ _GREY for side in ("left", "right")
    )
    return left, right, np.load(data / "motorcycle_disp.npz")["arr_0"]


def edges(image: np.ndarray, side: int = 40, step: int = 20) -> list[tuple[int, int, str]]:
    """(row, column, axis) of windows in which the slanted-edge method finds one edge."""
    out = []
    for row in range(0, image.shape[0] - side + 1, step):
        for column in range(0, image.shape[1] - side + 1, step):
            window = image[row : row + side, column : column + side]
            if np.ptp(window) < 40.0:
                continue
            try:
                out.append((row, column, measure_edge(window).axis))
            except EdgeError:
                continue
    return out
