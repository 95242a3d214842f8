"""Layout of a camera with rays: side view in the plane of symmetry, and top view."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from optics.geometry.aperture import Circle
from optics.numerics.backend import Backend
from scenes.models.camera_model import IMAGE, CameraModel
from twin.camera.camera_optics import INSIDE
from twin.camera.first_order_data import obstacles, ray_paths
from twin.framework.artefact import plain
from twin.framework.svg import BLUE, GREEN, GREY, INK, LIGHT, VERMILION, new_figure, plain_axes

_END_COLOURS = (BLUE, GREEN, VERMILION)
"""Colours of the negative end of the field, its middle and its positive end."""

BEFORE = 0.16
"""Length of the incoming rays in the drawing, as a fraction of the layout's length."""

_CHARACTER, _LEVEL, _LEVELS = 0.07, 0.155, 3
"""Width of a character and height of a line of labels, inches, and the number of lines of labels above each other."""

_VIEWS = ((1, "y", "Side view, in the plane of symmetry"), (0, "x", "Top view, along the line"))


def layout_figure(model: CameraModel, backend: Backend) -> Figure:
    """Draw chief and marginal rays of three fields, mirrors, stop and focal plane in both views, to the same scale."""
    boxes = [_extent(model, backend, axis) for axis, _, _ in _VIEWS]
    low, high = min(b[0] for b in boxes), max(b[1] for b in boxes)
    heights = [b[3] - b[2] for b in boxes]
    scale = 9.6 / (high - low)  # inches of the page per metre
    figure = new_figure(min(scale * sum(heights) + 1.5, 12.0))
    sizes = _sizes(model)
    axes = figure.subplots(2, 1, sharex=True, gridspec_kw={"height_ratios": heights})
    for panel, (axis, name, title), box in zip(axes, _VIEWS, boxes, strict=True):
        _view(panel, model, backend, axis, low, scale)
        panel.set_xlim(low, high)
        panel.set_ylim(box[2], box[3])
        panel.set_aspect("equal")
        panel.set_title(title, loc="left")
        panel.set_ylabel(f"{name} [m]")
        _measure(panel, sizes[axis], sizes[2])
        plain_axes(panel)
    axes[1].set_xlabel("z along the parent axis [m]")
    return figure


def _measure(axes: Axes, across: np.ndarray, along: np.ndarray) -> None:
    """Write the overall length and height of the parts in a view, with arrows from end to end, metres."""
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    below, beside = low + 0.03 * (high - low), right - 0.012 * (right - left)
    for upright, ends in ((0, [(end, below) for end in along]), (90, [(beside, end) for end in across])):
        x, y = np.mean(ends, axis=0)
        text = f"{plain(float(np.linalg.norm(np.diff(ends, axis=0))), 4)} m"
        style = {"arrowstyle": "<->", "color": GREY, "lw": 0.7, "shrinkA": 0, "shrinkB": 0}
        axes.annotate("", ends[0], ends[1], arrowprops=style)
        label = axes.text(
            float(x), float(y), text, rotation=upright, ha="center", va="center", fontsize=7.5, color=GREY
        )
        label.set_bbox({"facecolor": "white", "edgecolor": "none", "pad": 0.6})


def _fields(axis: int) -> list[tuple[float, float]]:
    """Return both ends and the middle of the field along ``axis`` as three fields, in fractions of the half fields.

    Axis 0 is along the line, axis 1 along the track.
    """
    return [(s, 0.0) if axis == 0 else (0.0, s) for s in (-1.0, 0.0, 1.0)]


def section_rays(
    model: CameraModel, backend: Backend, axis: int, fields: Sequence[tuple[float, float]] | None = None
) -> np.ndarray:
    """Trace chief, lower and upper marginal ray of F fields to K surfaces, (1 + K, F, 3, 3), metres.

    The axes are launch point and surfaces, fields, rays and coordinates x, y, z. The plane of the rays is along
    ``axis``: 0 for the line, 1 for the track. By default the fields are both ends and the middle along ``axis``.
    """
    stop = np.zeros((3, 2))
    stop[1:, axis] = -INSIDE, INSIDE
    return ray_paths(model, backend, _fields(axis) if fields is None else fields, stop).points


def _extent(model: CameraModel, backend: Backend, axis: int) -> tuple[float, float, float, float]:
    """Return the limits of a drawing: smallest and largest z and transverse coordinate, with a margin, metres."""
    rays = section_rays(model, backend, axis)
    points = rays[1:]
    z = points[..., 2]
    length = float(np.ptp(z))
    room = 0.05 * length
    first = float(z.min()) - BEFORE * length
    across = np.concatenate(
        [np.ravel(points[..., axis]), np.ravel(begun(rays, first)[0, ..., axis]), _sizes(model)[axis]]
    )
    return (first, float(z.max()) + 2.0 * room, float(across.min()) - 1.5 * room, float(across.max()) + room)


def begun(points: np.ndarray, first: float) -> np.ndarray:
    """Return rays, (1 + K, ..., 3) points on K surfaces, extended to begin at z = ``first`` metres."""
    start, then = points[0], points[1]
    share = (first - start[..., 2:]) / (then - start)[..., 2:]
    return np.concatenate([(start + share * (then - start))[None], points[1:]])


def _view(axes: Axes, model: CameraModel, backend: Backend, axis: int, first: float, scale: float) -> None:
    """Draw the side view or the top view of the layout with its rays, from z = ``first``, inches per metre."""
    points = begun(section_rays(model, backend, axis), first)
    half = np.degrees((model.spec.field.x, model.spec.field.y)[axis])
    for share, colour in zip((-1.0, 0.0, 1.0), _END_COLOURS, strict=True):
        axes.plot([], [], color=colour, label=f"field {plain(share * half)}\N{DEGREE SIGN}")
    axes.plot([], [], color=GREY, ls=(0, (5, 2)), lw=1.0, label="chief ray")
    axes.plot([], [], color=GREY, lw=0.7, label="marginal rays")
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=5, borderaxespad=0.1, fontsize=7.5)
    for k, colour in enumerate(_END_COLOURS):
        for ray, width in ((1, 0.7), (2, 0.7), (0, 1.0)):
            line = points[:, k, ray]
            style = (0, (5, 2)) if ray == 0 else "-"
            axes.plot(line[:, 2], line[:, axis], color=colour, lw=width, ls=style, alpha=0.9)
    edges = obstacles(model)
    lines = section_lines(model, axis)
    _label(axes, model, lines, axis, scale)
    for name, drawn in lines.items():
        if name not in edges and name != IMAGE and model.spec.mirrors[name].light == "passes":  # no body is there
            axes.plot(drawn[:, 2], drawn[:, axis], color=GREY, lw=0.8, ls=(0, (1, 2)), zorder=3)
        else:
            axes.plot(drawn[:, 2], drawn[:, axis], color=INK, lw=2.6, solid_capstyle="butt", zorder=3)
    axes.axhline(0.0, color=LIGHT, lw=0.7, ls=(0, (8, 3, 2, 3)), zorder=0)


def _sizes(model: CameraModel) -> np.ndarray:
    """Return the least and the largest x, y and z of mirrors, lenses and line CCDs, (3, 2), metres."""
    bodies = obstacles(model)
    sections = (section_lines(model, axis) for axis in (0, 1))
    drawn = np.concatenate([points for lines in sections for name, points in lines.items() if name in bodies])
    return np.stack([drawn.min(axis=0), drawn.max(axis=0)], axis=-1)


def dimensions(model: CameraModel) -> list[tuple[str, str, float]]:
    """Return the distances between the vertices of a camera and its overall sizes: from, to, metres.

    Overall sizes are those of the clear apertures and the focal plane, along z, y and x.
    """
    names = [*model.mirrors, IMAGE]
    places = [*(model.vertex(name) for name in model.mirrors), model.image_body.translation]
    gaps = np.linalg.norm(np.diff(places, axis=0), axis=-1)
    out = [(a, _title(b), float(gap)) for a, b, gap in zip(names, names[1:], gaps, strict=False)]
    sizes = np.ptp(_sizes(model), axis=-1)
    ends = (("length", 2), ("height, y", 1), ("width, x", 0))
    return [*out, *(("overall", text, float(sizes[axis])) for text, axis in ends)]


def _title(name: str) -> str:
    """Return the name of a surface for readers."""
    return "focal plane" if name == IMAGE else name


def section_lines(model: CameraModel, axis: int, points: int = 80) -> dict[str, np.ndarray]:
    """Return surface, or ``IMAGE`` -> its section along ``axis`` (0: line, 1: track), (points, 3) points in metres."""
    edges, lines = obstacles(model), {}
    for name in (*model.mirrors, IMAGE):
        edge = edges.get(name, model.apertures.get(name))
        assert edge is not None
        across = np.linspace(edge.bounds[2 * axis], edge.bounds[2 * axis + 1], points)
        other = np.full(points, edge.centre[1 - axis])
        x, y = (across, other) if axis == 0 else (other, across)
        pose = model.image_body if name == IMAGE else model.mirror_pose(name)
        sag = np.zeros(points) if name == IMAGE else model.surfaces[name].sag(x, y)
        lines[name] = pose.apply(np.stack([x, y, sag], axis=-1))
    return lines


def _label(axes: Axes, model: CameraModel, lines: Mapping[str, np.ndarray], axis: int, scale: float) -> None:
    """Write the names of the surfaces beside their drawings, clear of each other.

    ``lines`` are the sections along ``axis``, and ``scale`` is the size of the drawing, inches per metre.
    """
    taken: list[np.ndarray] = []
    for name, section in lines.items():
        drawn = section[:, [2, axis]]
        text = f"{name}, stop" if name == model.spec.stop else _title(name)
        # beyond the end that is farther from the axis; in the top view all ends are alike, and neighbours alternate
        turn = name == IMAGE or model.mirrors.index(name) == 0
        first = int(np.argmax(np.abs(drawn[[0, -1], 1]))) if axis == 1 else int(turn)
        right = isinstance(model.apertures.get(name), Circle) or name == IMAGE
        for level, end in itertools.product(range(_LEVELS), (drawn[-first], drawn[first - 1])):
            up = 1 if end[1] >= np.mean(drawn[:, 1]) else -1
            size = np.array([_CHARACTER * len(text), _LEVEL]) / scale
            middle = end + np.array([-0.5 if right else 0.5, up * (0.5 + level)]) * size
            if not any(np.all(np.abs(middle - other[0]) < 0.5 * (size + other[1])) for other in taken):
                break
        taken.append(np.stack([middle, size]))
        axes.annotate(
            text,
            (float(end[0]), float(end[1])),
            (-4 if right else 4, up * (4 + 72 * _LEVEL * level)),
            textcoords="offset points",
            ha="right" if right else "left",
            va="bottom" if up > 0 else "top",
            color=INK,
            fontsize=8.5,
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.6, "alpha": 0.8},
        )
