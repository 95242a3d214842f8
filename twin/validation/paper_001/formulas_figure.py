"""How far every printed formula is from right, in one picture."""

from __future__ import annotations

from collections.abc import Mapping

from twin.report.svg import BLUE, GREY, INK, LIGHT, look, new_figure, plain_axes, to_svg


def ratios_svg(ratios: Mapping[str, tuple[str, float]]) -> str:
    """A row per check: id -> (equation, measured over right)."""
    with look("formulas-001"):
        figure = new_figure(0.8 + 0.27 * len(ratios))
        axes = figure.subplots()
        axes.axvline(1.0, color=INK, lw=1.0)
        for row, (_, value) in enumerate(ratios.values()):
            axes.plot([1.0, value], [row, row], color=LIGHT, lw=4.0, solid_capstyle="butt", zorder=0)
            axes.plot([value], [row], "o", color=BLUE, ms=7.0)
            text = f"{value:.4f}".replace("-", "\N{MINUS SIGN}")
            axes.text(1.06, row, text, transform=axes.get_yaxis_transform(), ha="right", va="center")
        axes.text(1.06, -0.75, "measured", transform=axes.get_yaxis_transform(), ha="right", va="center", color=GREY)
        axes.set_yticks(range(len(ratios)), [f"{name}   {where}" for name, (where, _) in ratios.items()])
        axes.set_ylim(len(ratios) - 0.5, -0.6)
        axes.set_xlabel("measured, where 1 is a correct formula")
        axes.tick_params(axis="y", length=0)
        plain_axes(axes)
        return to_svg(figure)
