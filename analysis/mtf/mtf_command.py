"""Implementation of the command ``python -m analysis.mtf``."""

from __future__ import annotations

import csv
import json
import math
import os
import re
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import typer
from rich import box
from rich.console import Console
from rich.table import Table

from analysis.arrays import Array
from analysis.images.image_file import ImageError, ImageFile, Region, tone_curve
from analysis.mtf.bar_mtf import BarError, BarMtf, measure_bar_pages, page_warnings
from analysis.mtf.edge_location import EdgeError
from analysis.mtf.edge_pages import grey_step, measure_pages
from analysis.mtf.slanted_edge import EdgeMtf

BAD_INPUT, NOT_PRINTED = 2, 1
PLOT_KINDS = (".png", ".pdf", ".svg")
_LENGTHS = {"nm": 1e-6, "um": 1e-3, "µm": 1e-3, "μm": 1e-3, "mm": 1.0}
# Highest frequency, cycles/pixel: beyond twice the sampling frequency no camera passes light.
_HIGHEST = 2.0
# Numbers of more digits occur in no image.
_NUMBERS = re.compile(r"\s*" + r"\s*,\s*".join([r"([0-9]{1,10})"] * 4) + r"\s*")
_LIGHT = tuple(f"{level}_change_{direction}" for level in ("bright", "dark") for direction in ("along", "across"))
# Table rows, cycles/pixel.
_ROWS = (0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5)


class _Wrong(Exception):
    """Error raised for an invalid input of the user, which its message describes in one sentence."""


def run_mtf(
    image: Path,
    roi: str,
    pitch: str | None,
    pixel_size: str | None,
    bars: str | None,
    dark: str | None,
    bright: str | None,
    saturation: float | None,
    offset: float,
    frames: int | None,
    page: int | None,
    gamma: str | None,
    plot: Path | None,
    csv_file: Path | None,
    as_json: bool,
) -> None:
    """Run the command ``python -m analysis.mtf``: measure the MTF, write its files and print the result.

    Raises
    ------
    typer.Exit
        The measurement failed; the exit code is set and the error has been printed.
    """
    errors = Console(stderr=True)
    try:
        size = _pitch(_pitch_option(pitch, pixel_size, errors))
        frequency = _frequency(bars, size) if bars is not None else None
        _check_levels(saturation, offset)
        for path, kinds in ((plot, PLOT_KINDS), (csv_file, (".csv",))):
            _check_target(path, kinds, image)
        _check_bar_options(frequency is not None, dark, bright, plot, csv_file)
        source = ImageFile.open(image, frames, page)
        # an unsuitable curve is refused before the pixels are read
        tone_curve(gamma, source.header.full_scale)
        regions = {"--roi": _region(roi, "--roi")}
        fields: dict[str, ImageFile] = {}
        for option, text in (("--dark", dark), ("--bright", bright)):
            if text is not None and _NUMBERS.fullmatch(text) is None and Path(text).is_file():
                fields[option] = ImageFile.open(Path(text), frames, page)
                sizes = [(image.header.rows, image.header.columns) for image in (fields[option], source)]
                if sizes[0] != sizes[1]:
                    raise _Wrong(f"{option} {text} and {image} have different numbers of rows or columns")
            elif text is not None:
                regions[option] = _region(text, option)
        read = source.read(regions, gamma)
        for option, other in fields.items():
            read[option] = other.read({"--roi": regions["--roi"]}, gamma)["--roi"]
        warnings = _warnings([source, *fields.values()], gamma)
        region = read["--roi"]
        if saturation is None and np.any(region >= source.header.full_scale):
            saturation = source.header.full_scale
        result: BarMtf | EdgeMtf
        step = _step(source, region, gamma)
        if frequency is not None:
            result = measure_bar_pages(
                region, read["--dark"], read["--bright"], frequency, saturation=saturation, offset=offset, step=step
            )
        else:
            result = measure_pages(region, saturation=saturation, step=step)
        warnings += page_warnings(result, step)
        if isinstance(result, EdgeMtf):
            edge = result
            _write(plot, lambda path: _draw(edge, size, path))
            _write(csv_file, lambda path: _write_csv(edge, size, path))
    except (EdgeError, BarError, ImageError, _Wrong) as error:
        # the message names the image, as a script may measure many
        named = isinstance(error, _Wrong) or str(image) in str(error)
        text = str(error) if named else f"{image}: {error}"
        errors.print(f"error: {text}", style="bold red", markup=False, highlight=False, soft_wrap=True)
        raise typer.Exit(BAD_INPUT) from None
    except OSError as error:
        # file names that the system refuses, such as too long ones
        name = str(error.filename)[:80]
        errors.print(
            f"error: {name}: {error.strerror}", style="bold red", markup=False, highlight=False, soft_wrap=True
        )
        raise typer.Exit(BAD_INPUT) from None
    for text in warnings:
        errors.print(f"warning: {text}", style="yellow", markup=False, highlight=False, soft_wrap=True)
    try:
        if isinstance(result, BarMtf):
            _print_bars(result, size, offset, warnings, as_json)
        elif as_json:
            _print_json({**_edge_json(result, size, offset), "warnings": warnings})
        else:
            _print_edge(result, size, offset, [path for path in (plot, csv_file) if path is not None])
        sys.stdout.flush()
    except OSError as error:
        errors.print(f"error: the result cannot be printed ({error.strerror})", markup=False, soft_wrap=True)
        # otherwise the buffer would fail once more at the interpreter's end
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise typer.Exit(NOT_PRINTED) from None


def _check_levels(saturation: float | None, offset: float) -> None:
    if not math.isfinite(offset):
        raise _Wrong(f"--offset {offset} must be a finite number")
    if saturation is not None and math.isnan(saturation):
        raise _Wrong("--saturation nan must be a number")


def _check_bar_options(
    bars: bool, dark: str | None, bright: str | None, plot: Path | None, csv_file: Path | None
) -> None:
    if not bars and (dark is not None or bright is not None):
        raise _Wrong("--dark and --bright belong to --bars; the levels of an edge are measured in its region")
    if bars and (dark is None or bright is None):
        raise _Wrong("--bars needs --dark and --bright: the levels of spaces and bars, images or even patches")
    if bars and (plot is not None or csv_file is not None):
        raise _Wrong("--plot and --csv are for an edge's curve; bars give one number (--json prints it)")


def _warnings(images: list[ImageFile], gamma: str | None) -> list[str]:
    if gamma is not None:
        return []
    return [
        f"{image.path}: {image.header.coded}, so that its grey values probably follow a tone curve. Taken as linear"
        " they make the MTF wrong: give --gamma srgb (or the curve's exponent), or --gamma 1 if they are linear"
        for image in images
        if image.header.coded
    ]


def _step(source: ImageFile, region: Array, gamma: str | None) -> float:
    """Return the step between the grey values of a page, linear in light; for a tone curve the largest step."""
    if gamma in (None, "1"):
        return grey_step(region)
    whole = source.header.full_scale
    ends = tone_curve(gamma, whole)(np.array([0.0, 1.0, whole - 1.0, whole]))
    return float(max(ends[1] - ends[0], ends[3] - ends[2]))


def _pitch_option(pitch: str | None, pixel_size: str | None, errors: Console) -> str:
    """Return the text of the option for the pixel pitch, which may be given under its old name."""
    if pixel_size is not None:
        errors.print("note: --pixel-size is now --pitch; the old name is accepted for one version", soft_wrap=True)
    if (pitch is None) == (pixel_size is None):
        raise _Wrong('--pitch is missing: the pixel pitch, as "7 um"' if pitch is None else "--pitch is given twice")
    return str(pitch if pixel_size is None else pixel_size)


def _quantity(text: str, units: str) -> tuple[float, str]:
    """Return a number and its unit, which a pattern describes; NaN where the text is no such quantity."""
    match = re.fullmatch(rf"\s*([-+0-9.eE]+)\s*({units})\s*", text)
    try:
        return (float(match[1]), match[2]) if match else (math.nan, "")
    except ValueError:
        return math.nan, ""


def _pitch(text: str) -> float:
    """Return the pixel pitch in millimetres from the text of its option, such as ``7 um``."""
    value, unit = _quantity(text, r"\S*")
    if unit not in _LENGTHS or not math.isfinite(value):
        raise _Wrong(f'--pitch {text!r} is not a length with its unit: write it as "7 um" or "0.007 mm"')
    if not 1e-6 <= value * _LENGTHS[unit] <= 10:
        raise _Wrong(f"--pitch {text!r} must lie between 1 nm and 10 mm")
    return value * _LENGTHS[unit]


def _frequency(text: str, pitch: float) -> float:
    """Return the frequency in cycles per pixel from the text of its option; the pitch is in millimetres."""
    value, unit = _quantity(text, "cycles/mm|cycles/pixel|lp/mm")
    if not 0 < value < math.inf:
        raise _Wrong(f'--bars {text!r} is not a frequency with its unit: write "71.4 cycles/mm" or "0.5 cycles/pixel"')
    each = value if unit == "cycles/pixel" else value * pitch
    if each > _HIGHEST:
        raise _Wrong(f"--bars {text!r} is {each:.3g} cycles/pixel; above {_HIGHEST:g} nothing can be measured")
    return each


def _check_target(path: Path | None, kinds: tuple[str, ...], image: Path) -> None:
    if path is None:
        return
    if path.suffix.lower() not in kinds:
        raise _Wrong(f"{path} must end in {' or '.join(kinds)}")
    if not path.absolute().parent.is_dir():
        raise _Wrong(f"the folder of {path} does not exist: make it first")
    if path.is_dir() or (path.exists() and image.exists() and path.samefile(image)):
        raise _Wrong(f"{path} cannot be written: it is a folder or the image itself")


def _region(text: str, option: str) -> Region:
    match = _NUMBERS.fullmatch(text)
    if match is None:
        also = "" if option == "--roi" else ", or an image of an even field"
        raise _Wrong(f"{option} {text[:80]!r} must be four whole numbers ROW,COLUMN,HEIGHT,WIDTH{also}")
    return Region(*(int(number) for number in match.groups()))


def _write(target: Path | None, make: Callable[[Path], None]) -> None:
    """Write a file under a temporary name beside the target and rename it, so that no half-written file is left."""
    if target is None:
        return
    try:
        handle, name = tempfile.mkstemp(suffix=target.suffix, prefix=".", dir=target.absolute().parent)
        os.close(handle)
        temporary = Path(name)
        try:
            make(temporary)
            # mkstemp creates files that only their owner can read
            mask = os.umask(0)
            os.umask(mask)
            temporary.chmod(0o666 & ~mask)
            temporary.replace(target)
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as error:
        raise _Wrong(f"{target} cannot be written ({error.strerror})") from error


def _write_csv(edge: EdgeMtf, pitch: float, path: Path) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["frequency_cycles_per_mm", "frequency_cycles_per_pixel", "mtf", "sigma", "noise_bias"])
        for f, m, s, b in zip(edge.frequency, edge.mtf, edge.sigma, edge.noise_bias, strict=True):
            writer.writerow([f"{number:.9g}" for number in (f / pitch, f, m, s, b)])


def _draw(edge: EdgeMtf, pitch: float, path: Path) -> None:
    # a figure made without pyplot needs no window and no global state
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 4), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    spread, line, curve = figure.subplots(1, 3)
    half_range = min(edge.core * 1.5, float(edge.distance[-1]))
    near = np.abs(edge.pixel_distance) <= half_range
    spread.plot(edge.pixel_distance[near], edge.pixel_grey[near], ".", ms=2, color="0.6", label="pixels")
    shown = np.abs(edge.distance) <= half_range
    spread.plot(edge.distance[shown], edge.esf[shown], color="C0", label="least-squares curve")
    spread.set(title="edge-spread function", xlabel="along the normal / px", ylabel="grey value")
    spread.legend(loc="lower right")
    line.plot(edge.distance[shown], edge.lsf[shown], color="C0")
    line.axhline(0.0, color="0.7", lw=0.8, zorder=0)
    line.set(title="line-spread function", xlabel="along the normal / px", ylabel="1/px")
    frequency, (low, high) = edge.frequency / pitch, (edge.mtf - edge.sigma, edge.mtf + edge.sigma)
    curve.fill_between(frequency, low, high, color="C0", alpha=0.3, lw=0, label="±1 sigma")
    curve.plot(frequency, edge.mtf, color="C0", label="MTF")
    curve.plot(frequency, edge.noise_bias, color="C3", lw=1, label="noise bias in it")
    curve.axvline(0.5 / pitch, color="0.5", ls="--", lw=1)
    curve.annotate("Nyquist", (0.5 / pitch, 1.0), xytext=(4, 0), textcoords="offset points", color="0.4")
    curve.set(title="MTF along the normal", xlabel="cycles/mm", xlim=(0, edge.frequency[-1] / pitch), ylim=(0, 1.05))
    curve.legend()
    figure.savefig(path, format=path.suffix[1:].lower())


def _edge_json(edge: EdgeMtf, pitch: float, offset: float) -> dict[str, Any]:
    nyquist, nyquist_sigma = edge.at(0.5)
    half, half_sigma = edge.frequency_at(0.5)
    return {
        "axis": edge.axis,
        "angle_deg": math.degrees(edge.angle),
        "angle_deg_sigma": math.degrees(edge.angle_sigma),
        "position_px": edge.position,
        "position_px_sigma": edge.position_sigma,
        "curvature_per_px": edge.curvature,
        "curvature_per_px_sigma": edge.curvature_sigma,
        "order": edge.order,
        **{f"{name}_dn": value for name, value in zip(_LIGHT, edge.light.tolist(), strict=True)},
        **{f"{name}_dn_sigma": value for name, value in zip(_LIGHT, edge.light_sigma.tolist(), strict=True)},
        "dark_dn": edge.dark - offset,
        "bright_dn": edge.bright - offset,
        "noise_dark_dn": edge.noise_dark,
        "noise_bright_dn": edge.noise_bright,
        "pages": _pages_json(edge),
        "mtf_nyquist": nyquist,
        "mtf_nyquist_sigma": nyquist_sigma,
        "mtf_nyquist_noise_bias": float(np.interp(0.5, edge.frequency, edge.noise_bias)),
        "mtf50_cycles_per_mm": _or_none(half / pitch),
        "mtf50_cycles_per_mm_sigma": _or_none(half_sigma / pitch),
        "frequency_cycles_per_mm": (edge.frequency / pitch).tolist(),
        "frequency_cycles_per_pixel": edge.frequency.tolist(),
        "mtf": edge.mtf.tolist(),
        "sigma": edge.sigma.tolist(),
        "noise_bias": edge.noise_bias.tolist(),
    }


def _pages_json(edge: EdgeMtf) -> dict[str, Any]:
    pages = edge.pages
    assert pages is not None
    return {
        "position_px": pages.position.tolist(),
        "position_px_sigma": pages.position_sigma.tolist(),
        "angle_deg": np.degrees(pages.angle).tolist(),
        "angle_deg_sigma": np.degrees(pages.angle_sigma).tolist(),
        "drift_px_rms": pages.drift,
        "chi_square": pages.chi_square,
        "degrees_of_freedom": pages.degrees_of_freedom,
        "aligned": pages.aligned,
        "repeated": pages.same,
    }


def _or_none(number: float) -> float | None:
    return number if math.isfinite(number) else None


def _print_json(data: dict[str, Any]) -> None:
    json.dump(data, sys.stdout, allow_nan=False)
    sys.stdout.write("\n")


def _print_edge(edge: EdgeMtf, pitch: float, offset: float, written: list[Path]) -> None:
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for name in ("cycles/mm", "cycles/pixel", "MTF", "sigma", "noise bias"):
        table.add_column(name, justify="right", no_wrap=True)
    for f in _ROWS:
        value, sigma = edge.at(f)
        bias = float(np.interp(f, edge.frequency, edge.noise_bias))
        table.add_row(f"{f / pitch:.1f}", f"{f:.2f}", f"{value:.4f}", f"{sigma:.4f}", f"{bias:.4f}")
    console = Console()
    console.print(table)
    value, sigma = edge.at(0.5)
    half, half_sigma = edge.frequency_at(0.5)
    kind = "near-vertical edge, MTF along rows" if edge.axis == "x" else "near-horizontal edge, MTF along columns"
    lines = [
        f"MTF at Nyquist ({0.5 / pitch:.1f} cycles/mm): {value:.4f} ± {sigma:.4f}",
        "MTF50: not reached"
        if math.isnan(half)
        else f"MTF50: {half / pitch:.2f} ± {half_sigma / pitch:.2f} cycles/mm ({half:.4f} cycles/pixel)",
        f"edge: {math.degrees(edge.angle):+.3f} ± {math.degrees(edge.angle_sigma):.3f} deg, {kind}; "
        + ("straight" if edge.order == 1 else f"curved, fitted by a polynomial of order {edge.order}"),
        f"levels: {edge.dark - offset:.1f} and {edge.bright - offset:.1f}, noise {edge.noise_dark:.2f} and "
        f"{edge.noise_bright:.2f} per pixel",
        "light: bright level changes by {} along the edge and {} across it, dark level by {} and {}".format(
            *(f"{value:+.1f} ± {sigma:.1f}" for value, sigma in zip(edge.light, edge.light_sigma, strict=True))
        ),
        *([_pages_text(edge)] if edge.pages is not None and len(edge.pages.position) > 1 else []),
        *(f"written: {path}" for path in written),
    ]
    for text in lines:
        console.print(text, markup=False, highlight=False, soft_wrap=True)


def _pages_text(edge: EdgeMtf) -> str:
    pages = edge.pages
    assert pages is not None
    sigma = float(np.sqrt(np.mean(pages.position_sigma**2)))
    each = ", ".join(f"{position:+.3f}" for position in pages.position[:9] - edge.position)
    more = f", ... ({len(pages.position)} pages)" if len(pages.position) > 9 else ""
    treatment = "aligned" if pages.aligned else "averaged"
    return f"edge in the pages, relative to {edge.position:.3f} px: {each}{more}, each ± {sigma:.3f} px; {treatment}"


def _print_bars(bars: BarMtf, pitch: float, offset: float, warnings: list[str], as_json: bool) -> None:
    if as_json:
        _print_json(
            {
                "frequency_cycles_per_mm": bars.cycles_per_pixel / pitch,
                "frequency_cycles_per_pixel": bars.cycles_per_pixel,
                "frequency_down_column_cycles_per_pixel": float(bars.frequency[0]),
                "frequency_along_row_cycles_per_pixel": float(bars.frequency[1]),
                "mtf": bars.mtf,
                "sigma": bars.sigma,
                "noise_bias": bars.noise_bias,
                "dark_dn": bars.dark - offset,
                "bright_dn": bars.bright - offset,
                "contrast": _or_none(bars.contrast),
                "contrast_transfer": _or_none(bars.contrast_transfer),
                "coltman_mtf": _or_none(bars.coltman),
                "warnings": warnings,
            }
        )
        return
    console = Console()
    for text in (
        f"bars: {bars.cycles_per_pixel / pitch:.2f} cycles/mm ({bars.cycles_per_pixel:.4f} cycles/pixel)",
        f"MTF: {bars.mtf:.4f} ± {bars.sigma:.4f}, noise bias {bars.noise_bias:.4f}",
        f"levels: {bars.dark - offset:.1f} ± {bars.dark_sigma:.1f} and "
        f"{bars.bright - offset:.1f} ± {bars.bright_sigma:.1f}",
        f"contrast (max - min) / (max + min): {bars.contrast:.4f}, over that of the levels "
        f"{bars.contrast_transfer:.4f}, by Coltman's pi/4 {bars.coltman:.4f}",
    ):
        console.print(text, markup=False, highlight=False, soft_wrap=True)
