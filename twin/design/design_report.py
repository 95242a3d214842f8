"""Figures of an optimised camera: its layout before and after, and the wavefront error over the field."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from optics.design.design_rays import trace_beams
from optics.design.design_variables import Prescription
from optics.design.optimiser import Design
from twin.run.svg import BLUE, GREY, INK, ORANGE, new_figure, plain_axes

_BEFORE, _AFTER = GREY, BLUE


def layout_figure(design: Design, start: Prescription) -> Figure:
    """Beams in the plane of symmetry, before and after, to one scale."""
    figure = new_figure(4.4)
    axes = figure.subplots(1, 2, sharex=True, sharey=True)
    for one, prescription, title in zip(axes, (start, design.prescription), ("before", "after"), strict=True):
        _layout(one, design, prescription)
        one.set_title(title)
    axes[0].set_ylabel("y, m")
    return figure


def _layout(axes: Axes, design: Design, prescription: Prescription) -> None:
    rays = trace_beams(design.judge.backend, prescription, design.judge.beams)
    points = rays.points[..., 1:].copy()  # y, z of (K + 1, F, N)
    first, then = rays.points[0], rays.points[1]
    z = 1.25 * rays.points[1:, ..., 2].min()
    share = (z - first[..., 2]) / (then - first)[..., 2]
    points[0] = np.stack([first[..., 1] + share * (then - first)[..., 1], np.full(share.shape, z)], axis=-1)
    middle = np.flatnonzero(np.all(design.judge.beams.fields == 0.0, axis=1))[0]
    for colour, ray in ((ORANGE, 0), *((GREY, n) for n in _edges(points[1, middle]))):
        axes.plot(points[:, middle, ray, 1], points[:, middle, ray, 0], color=colour, lw=0.8)
    for k, name in enumerate(prescription.names):
        y = np.linspace(points[k + 1, ..., 0].min(), points[k + 1, ..., 0].max(), 60)
        stand = prescription.stands[name]
        sag = prescription.surfaces[name].sag(0.0, y - stand.y)
        axes.plot(stand.z + sag, y, color=INK, lw=2.2)
        axes.annotate(name, (float(stand.z + sag[-1]), float(y[-1])), (4, 4), textcoords="offset points")
    axes.set_aspect("equal")
    axes.set_xlabel("z, m")
    plain_axes(axes)


def _edges(hits: np.ndarray) -> tuple[int, int]:
    """The rays (N, 2) of a beam that are farthest out in y."""
    return int(np.argmin(hits[:, 0])), int(np.argmax(hits[:, 0]))


def error_figure(design: Design) -> Figure:
    """Wavefront error of every field, before and after."""
    figure = new_figure(2.9)
    axes = figure.subplots()
    fields = np.degrees(design.judge.beams.fields)
    at = np.arange(len(fields))
    axes.bar(at - 0.2, design.before.errors, 0.38, color=_BEFORE, label="before")
    axes.bar(at + 0.2, design.after.errors, 0.38, color=_AFTER, label="after")
    axes.set_xticks(at, [f"{x:.2f}, {y:+.2f}" for x, y in fields])
    axes.set_xlabel("field x, y, degrees")
    axes.set_ylabel("waves rms")
    axes.legend(frameon=False, ncols=2, loc="upper left")
    axes.set_ylim(0.0, 1.25 * float(max(design.before.errors.max(), design.after.errors.max())))
    plain_axes(axes)
    return figure
