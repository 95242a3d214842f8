"""Series of the principle experiment of paper 001, what was read in them, and the table as the paper prints it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from analysis.autocollimator import AXES, column_component, exact_reading, mean_difference, relation_factor
from analysis.units import ARCSEC
from scenes.turntable_model import UNITS


@dataclass(frozen=True)
class Series:
    """One series: axis X, Y or Z of system 1-XYZ, half angle theta between the mirrors and step, radians, and number of
    steps after the first reading at zero.
    """

    axis: str
    half_angle: float
    step: float
    steps: int

    @property
    def angles(self) -> np.ndarray:
        """Turns of the table as commanded, (steps + 1,), radians."""
        return self.step * np.arange(self.steps + 1)

    @property
    def stream(self) -> tuple[int, int, int]:
        """Number of its random streams: a series draws the same whichever others are run with it."""
        return AXES.index(self.axis), round(self.half_angle / ARCSEC), round(1e3 * self.step / ARCSEC)


@dataclass(frozen=True, eq=False)
class SeriesResult:
    """Readings of one series.

    Attributes:
        series: what was turned.
        readings: (2 mirrors, rows, 2) turns about each autocollimator's own X and Y against its reading at zero,
            radians.
        sigma: (2, rows, 2) their standard deviations by the noise of the images alone, radians.
    """

    series: Series
    readings: np.ndarray
    sigma: np.ndarray

    @property
    def scale(self) -> float:
        """What mirror 2 is multiplied with: 1 (X), 1 / cos b (Y), 1 / sin b (Z)."""
        return 1.0 / relation_factor(self.series.axis, 2, 2.0 * self.series.half_angle)

    @property
    def columns(self) -> tuple[np.ndarray, np.ndarray]:
        """Mirror 1 and scaled mirror 2 as in Table 2, (rows,) each, radians."""
        component = column_component(self.series.axis)
        return self.readings[0, :, component], self.scale * self.readings[1, :, component]

    @property
    def mean_difference(self) -> float:
        """Last line of Table 2, radians: X and Y mirror 1 - scaled mirror 2, Z the turntable - scaled mirror 2."""
        first, second = self.columns
        return mean_difference(self.series.angles if self.series.axis == "Z" else first, second)

    @property
    def from_exact(self) -> np.ndarray:
        """Readings minus those of ideal mirrors, lens and turntable to all orders, (2, rows, 2), radians."""
        args = self.series.axis, self.series.angles
        return self.readings - np.stack([exact_reading(*args, u, 2.0 * self.series.half_angle) for u in UNITS])


@dataclass(frozen=True, eq=False)
class PrincipleTable:
    """All series of one run of the experiment, and the seed that its errors and noise come from."""

    results: tuple[SeriesResult, ...]
    seed: int

    def __getitem__(self, axis: str) -> SeriesResult:
        """The first series about that axis. Raises KeyError if there is none."""
        for result in self.results:
            if result.series.axis == axis:
                return result
        raise KeyError(axis)

    def to_dict(self) -> dict[str, Any]:
        """Plain data: every number in the unit that its key ends in."""
        out = []
        for result in self.results:
            first, second = result.columns
            out.append(
                {
                    "axis": result.series.axis,
                    "theta_deg": float(np.degrees(result.series.half_angle)),
                    "step_arcsec": result.series.step / ARCSEC,
                    "mirror_2_scale": result.scale,
                    "rows": [
                        {"angle_arcsec": a, "mirror_1_arcsec": m1, "scaled_mirror_2_arcsec": m2}
                        for a, m1, m2 in (np.stack([result.series.angles, first, second], -1) / ARCSEC).tolist()
                    ],
                    "image_sigma_arcsec": float(np.max(result.sigma) / ARCSEC),
                    "mean_difference_arcsec": result.mean_difference / ARCSEC,
                }
            )
        return {"seed": self.seed, "series": out}

    def text(self) -> str:
        """The table as the paper prints it, arcsec; all series need the same number of steps."""
        heads = [f"{r.series.axis}: mirror 1 {r.scale:9.6f}*mirror 2" for r in self.results]
        lines = [f"{'angle':>9} " + " ".join(f"{head:>29}" for head in heads)]
        for i in range(len(self.results[0].series.angles)):
            cells = ["{:>12.4f} {:>16.4f}".format(*(c[i] / ARCSEC for c in r.columns)) for r in self.results]
            lines.append(f"{self.results[0].series.angles[i] / ARCSEC:9.1f} " + " ".join(cells))
        cells = [f"{r.mean_difference / ARCSEC:29.6f}" for r in self.results]
        return "\n".join([*lines, f"{'mean |d|':>9} " + " ".join(cells)])
