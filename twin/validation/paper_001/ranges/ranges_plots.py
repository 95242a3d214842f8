"""Figures of the range studies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from analysis.units import ARCSEC
from twin.run.svg import BLUE, GREEN, GREY, INK, LIGHT, ORANGE, PURPLE, VERMILION, look, new_figure, plain_axes, to_svg
from twin.validation.paper_001.ranges.curves import CALIBRATED, CORRECTED, JOINT, PRINTED, Curves
from twin.validation.paper_001.ranges.defocus import FieldPoint, PupilStudy
from twin.validation.paper_001.ranges.turns import CLAIMED, EQUATIONS, FINE, NAMES, Corners, Range, key

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_COLOURS = {PRINTED: VERMILION, JOINT: ORANGE, CORRECTED: BLUE, CALIBRATED: GREEN}
_MARKS = {PRINTED: "o", JOINT: "D", CORRECTED: "s", CALIBRATED: "^"}
SYMBOLS = {"d_alpha": "Δα", "d_beta": "Δβ", "d_gamma": "Δγ", "d_f": "Δf"}
_OF_PARAMETER = {"d_alpha": VERMILION, "d_beta": BLUE, "d_gamma": GREEN, "d_f": PURPLE}
_ORDER = ("d_beta", "d_alpha", "d_gamma", "d_f")


def _scale(name: str) -> tuple[float, str]:
    return (1e-3, "mm") if name == "d_f" else (1.0, "arcsec")


def _thinned(points: np.ndarray) -> np.ndarray:
    """Points (N, 2) without those that nearly coincide with the one before."""
    kept = [0]
    for i in range(1, len(points)):
        if points[i, 0] > 1.25 * points[kept[-1], 0]:
            kept.append(i)
    return points[kept]


def singles_svg(ranges: Mapping[str, Sequence[Range]]) -> str:
    """A panel per parameter: error over the true change, both on logarithmic axes."""
    with look("ranges-001-singles"):
        figure = new_figure(7.4)
        panels = figure.subplots(2, 2).ravel()
        for axes, name in zip(panels, _ORDER, strict=True):
            both = ranges[name]
            per, unit = _scale(name)
            first = both[0]
            low, high = first.raw[PRINTED][0, 0] * per, first.lost * per
            axes.axvspan(0.85 * low, min(r.window for r in both) * per, color=LIGHT, alpha=0.55, lw=0)
            grid = np.array([low, high])
            axes.plot(grid, 0.01 * grid, "--", color=GREY, lw=1.0)
            axes.axhline(FINE[name] * per, color=INK, lw=1.0, ls=":")
            if CLAIMED[name] != FINE[name]:
                axes.axhline(CLAIMED[name] * per, color=INK, lw=1.0, ls="-.")
            shown = [PRINTED, JOINT] if name == "d_f" else [PRINTED, CORRECTED]
            for form in shown:
                marks = _thinned(first.raw[form]) * per
                line = np.concatenate([first.raw[form], first.raw_traced[form]]) * per
                axes.plot(line[:, 0], np.abs(line[:, 1]), "-", color=_COLOURS[form], lw=1.0)
                label = f"printed {EQUATIONS[name]}" if form == PRINTED else form
                if name == "d_f" and form == PRINTED:
                    label += ", the same as corrected"
                axes.plot(marks[:, 0], np.abs(marks[:, 1]), _MARKS[form], color=_COLOURS[form], ms=4.5, label=label)
            _log(axes)
            axes.set_xlim(0.85 * low, 1.02 * high)
            axes.set_ylim(0.3 * np.min(np.abs(first.raw[CORRECTED][:, 1])) * per, None)
            axes.plot([], [], "--", color=GREY, lw=1.0, label="1 %")
            axes.plot([], [], ":", color=INK, lw=1.0, label="0.04 mm" if name == "d_f" else "0.1 arcsec")
            if CLAIMED[name] != FINE[name]:
                axes.plot([], [], "-.", color=INK, lw=1.0, label="2.15 arcsec")
            axes.set_xlabel(f"true {SYMBOLS[name]} [{unit}]")
            axes.set_ylabel(f"|error| [{unit}]")
            axes.legend(loc="upper left", ncols=2)
        return to_svg(figure)


def joint_svg(corners: Corners, forms: Sequence[str]) -> str:
    """A panel per parameter: worst corner as a share of the claim over the share of the box."""
    with look("ranges-001-joint"):
        figure = new_figure(6.2)
        panels = figure.subplots(2, 2, sharex=True).ravel()
        for axes, name in zip(panels, _ORDER, strict=True):
            axes.axhline(1.0, color=INK, lw=1.0, ls=":")
            axes.axvspan(float(corners.images.size[0]), 1.0, color=LIGHT, alpha=0.55, lw=0)
            for form in forms:
                of = key(form, name)
                size = np.concatenate([corners.images.size, corners.traced.size])
                value = np.concatenate([corners.images.value[of], corners.traced.value[of]])
                axes.plot(size, value, "-", color=_COLOURS[form], lw=1.0)
                marks = _thinned(np.column_stack([corners.images.size, corners.images.value[of]]))
                axes.plot(marks[:, 0], marks[:, 1], _MARKS[form], color=_COLOURS[form], ms=4.5, label=form)
            _log(axes)
            axes.set_xlim(float(corners.images.size[0]), corners.lost * 1.02)
            limit = f"{CLAIMED[name] * _scale(name)[0]:g} {_scale(name)[1]}"
            axes.set_ylabel(f"worst error of {SYMBOLS[name]} / {limit}")
        for axes in panels[2:]:
            axes.set_xlabel("size of the box, times ±(4″, 4″, 24″, 0.95 mm)")
        panels[0].legend(loc="lower right")
        return to_svg(figure)


def defocus_svg(pupil: PupilStudy, curves: Curves, focal: tuple[float, float]) -> str:
    """False readings per piston over the pupil, and over the piston."""
    with look("ranges-001-defocus"):
        figure = new_figure(3.9)
        left, right = figure.subplots(1, 2)
        grid = np.array([-0.3, 0.3])
        for axis, name, length, sign in ((0, "d_alpha", focal[0], -1.0), (1, "d_beta", focal[1], 1.0)):
            own = np.equal(pupil.offset[:, 1 - axis], 0.0)
            k = NAMES.index(name)
            slope = 1e-6 * pupil.slope[own, k]
            colour = _OF_PARAMETER[name]
            left.plot(1e3 * grid, sign * 1e-6 * grid / length**2 / ARCSEC, "-", color=colour, lw=1.0)
            letter = "XY"[axis]
            left.plot(1e3 * pupil.offset[own, axis], slope, "o" if axis == 0 else "s", color=colour, ms=5.0,
                      label=f"{SYMBOLS[name]}, sub-aperture along {letter}")  # fmt: skip
        left.plot([], [], "-", color=GREY, lw=1.0, label="theory, ±h/f²")
        left.axhline(0.0, color=LIGHT, lw=0.8, zorder=0)
        left.set_xlabel("sub-aperture off the pupil's middle, h [mm]")
        left.set_ylabel("false reading [arcsec per µm of defocus]")
        left.legend(loc="upper center")
        plain_axes(left)
        right.axhline(1.0, color=INK, lw=1.0, ls=":")
        ends = {}
        for name in _ORDER:
            value = curves.value[f"{name} claimed"]
            right.plot(1e6 * curves.size, value, "o-", color=_OF_PARAMETER[name], ms=3.5, lw=1.0)
            ends[name] = float(value[-1])
        _log(right)
        for name, end in ends.items():
            place = 1e6 * float(curves.size[-1]), end
            right.annotate(SYMBOLS[name], place, xytext=(6, 0), textcoords="offset points",
                           color=_OF_PARAMETER[name], va="center")  # fmt: skip
        right.set_xlabel("motion of the line CCD along Z [µm]")
        right.set_ylabel("false reading / (0.1″, 2.15″, 0.04 mm)")
        return to_svg(figure)


def field_svg(points: Sequence[FieldPoint]) -> str:
    """Deviation of the readings' scale over the field."""
    with look("ranges-001-field"):
        figure = new_figure(3.2)
        axes = figure.subplots()
        field = np.array([p.field for p in points])
        fine = np.linspace(0.0, float(field.max()), 60)

        def gain(form: str, name: str) -> Any:
            return np.array([p.gains[form][NAMES.index(name)] for p in points])

        base = float(gain(CORRECTED, "d_beta")[0])
        axes.plot(np.degrees(fine), 100 * (base * np.cos(fine) ** 2 - 1.0), "-", color=GREY, lw=1.0)
        axes.plot(
            np.degrees(field), 100 * (gain(PRINTED, "d_beta") - 1.0), "o", color=INK, ms=5.0, label="Δβ printed (2)"
        )
        for name, mark in (("d_beta", "s"), ("d_alpha", "^"), ("d_gamma", "D"), ("d_f", "v")):
            axes.plot(np.degrees(field), 100 * (gain(CORRECTED, name) - 1.0), f"{mark}-", color=_OF_PARAMETER[name],
                      ms=4.5, lw=0.8, label=f"{SYMBOLS[name]} corrected")  # fmt: skip
        axes.axhline(0.0, color=LIGHT, lw=0.8, zorder=0)
        axes.set_xlim(0.0, None)
        axes.set_xlabel("field of the area CCDs [deg]")
        axes.set_ylabel("reading / truth less 1 [%]")
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
        plain_axes(axes)
        return to_svg(figure)


def _log(axes: Axes) -> None:
    axes.set_xscale("log")
    axes.set_yscale("log")
    plain_axes(axes)
