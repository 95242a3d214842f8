"""Defocused images of a real star, beside the Zernike terms that another program fits to them."""

from __future__ import annotations

import pickle
import tempfile
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, files
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from matplotlib.figure import Figure

from analysis.arrays import ARCSEC
from optics.numerics.backend import Backend
from scenes.specs.asbuilt import AsBuiltSetup
from scenes.yaml.yaml_file import dump_yaml
from twin.asbuilt.asbuilt_bench import AsBuiltBench
from twin.asbuilt.star_images import StarResidual
from twin.asbuilt.star_readings import StarFit
from twin.validation.check import CheckResult
from twin.validation.group import Context, drawing, group_of, load_printed
from twin.validation.row_names import REAL, matches

FILE = "danish/AuxTelTestDonuts.pkl"
"""File in the folder of measured data; the wheel of danish has it as tests/data/AuxTelTestDonuts.pkl."""
BINNING, PITCH, FOCAL = 3, 30e-6, 20.8
"""Pixels that are added along each axis, their pitch together and the focal length, metres, as in ``auxtel.yaml``."""
NOISE = 3e3
"""Standard deviation of a pixel, electrons: far above shot noise, so that weights are even as danish's, and below the
model's error, so that sigmas grow to it.
"""
TERMS = tuple(range(4, 12))
ESTIMATE: dict[str, Any] = {
    "instrument": str(Path(__file__).parent / "auxtel.yaml"),
    "prior": "./rigid.yaml",
    "wavefront": {"constant": {f"Z{j}": "1 um" if j == TERMS[0] else "300 nm" for j in TERMS}},
    "measurements": {
        "images": {
            "star": {
                "fields": [[0, 0]], "file": "star.fits", "defocus": "30.4 mm", "seeing": "free", "read_noise": NOISE,
            }
        }
    },
    "merits": {"wavefront": {"kind": "wavefront", "at_most": 10}},
}  # fmt: skip
"""Estimate of one image; the defocus is that of the 3.2 um at which danish's fit starts."""
RIGID = {
    "name": "rigid",
    "description": "A telescope whose bodies do not move.",
    "causes": {"none": {"bodies": "base/*/M2", "shift": "0 um", "time": "constant", "reason": "terms alone"}},
}
"""Prior without motions."""


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


def fitted(counts: np.ndarray, backend: Backend) -> tuple[np.ndarray, np.ndarray, StarResidual]:
    """Return annular Zernike terms of a star's wavefront and their sigmas, metres, (T,), and the image they predict."""
    with tempfile.TemporaryDirectory() as folder:
        fits.PrimaryHDU(counts[None]).writeto(Path(folder) / "star.fits")
        for name, content in (("rigid", RIGID), ("estimate", ESTIMATE)):
            (Path(folder) / f"{name}.yaml").write_text(dump_yaml(content))
        bench = AsBuiltBench(AsBuiltSetup.read(Path(folder) / "estimate.yaml"), backend)
        data = bench.data()
        state = bench.estimate(data)
        (star,) = bench.star_images(data, state)
    beams, defocus = bench.kinds[0].beams, bench.kinds[0].spec.defocus  # type: ignore[attr-defined]
    paths = beams.light(bench.view(state.mean[None], None).states).paths[0, 0] + defocus * beams.defocus[0]
    values = beams.zernike_rows(TERMS[-1])[0, TERMS[0] - 1 :] @ paths
    return values, state.sigma * np.sqrt(state.variance_factor), star


@drawing("real-stars", 3.6)
def stars_svg(figure: Figure, images: list[np.ndarray], stars: list[StarFit]) -> None:
    """Draw the images, the fitted ones and the differences."""
    axes = figure.subplots(len(images), 3)
    for row, counts, fit in zip(axes, images, stars, strict=True):
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
    images, stars, worst = star_images(path), [], []
    for name, counts in zip(("first", "second"), images, strict=True):
        *terms, star = fitted(counts, context.backend)
        stars.append(star.fit)
        (values, sigma), theirs = (1e9 * part for part in terms), np.array(other[name])
        apart = np.abs(values - theirs)
        worst.append((float(apart[0]), float(sigma[0])))
        k = 1 + int(np.argmax(apart[1:-1]))
        yield context.row(
            f"real.stars.{name}", float(apart[k]), float(sigma[k]), 0.0, values=values, other=theirs,
            seeing=star.seeing_px * PITCH / FOCAL / ARCSEC,
        )  # fmt: skip
    yield context.row("real.stars.defocus", *max(worst), 0.0)
    context.figure("stars", stars_svg(images, stars))


GROUP = group_of("real.stars", run)
