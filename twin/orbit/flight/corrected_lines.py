"""Lines of an instrument after changes that its on-board monitor has estimated.

What a change does to the looks of a line is `analysis.orbit.forward_intersection.CalibratedLine.corrected`, which also
corrects lines that are intersected; here the corrected looks go back into the line that a sensor flies with.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from analysis.orbit.forward_intersection import CalibratedLine
from optics.numerics.backend import Backend
from scenes.models.instrument_model import Instrument
from twin.monitor.truth import LineSight
from twin.orbit.flight.line_camera import LineCamera


def calibrated_line(line: LineCamera, axes: np.ndarray, principal_distance: float) -> CalibratedLine:
    """A traced line in the analysis's form.

    Args:
        line: of one CCD.
        axes: (3, 3) columns X, Y, Z of its camera in the body, about which changes count.
        principal_distance: of it, metres.
    """
    return CalibratedLine(line.pixels, line.directions, line.origins, axes, principal_distance)


def calibrated_lines(
    lines: Mapping[str, LineCamera], instrument: Instrument, backend: Backend
) -> dict[str, CalibratedLine]:
    """Lines of an instrument as its calibration knows them, by camera.

    Args:
        lines: of the unperturbed instrument, as `twin.orbit.flight.line_camera.traced_line_cameras` finds them.
        instrument: that is unperturbed.
        backend: where to trace.
    """
    sight = LineSight(instrument, backend)
    distance = sight.truth([{}]).principal_distance
    return {name: calibrated_line(line, sight.axes[name], distance[name]) for name, line in lines.items()}


def corrected_line(line: LineCamera, calibrated: CalibratedLine, change: ArrayLike) -> LineCamera:
    """A line after a change.

    Args:
        line: as it was calibrated.
        calibrated: the same line, by `calibrated_lines`.
        change: (4,) d_alpha, d_beta, d_gamma (rad) and d_f (m) since then.

    Raises:
        ValueError: another shape, numbers that are not finite, no principal distance left.
    """
    return replace(line, directions=calibrated.corrected(change).directions)
