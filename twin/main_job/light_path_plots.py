"""Side view of the instrument with its light, and the footprints of the beams on every mirror."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon
from scipy.spatial import ConvexHull

from optics.geometry.solid import Solid, solid_mesh
from scenes.models.camera_model import CameraModel
from scenes.models.instrument_model import Instrument
from scenes.specs.instrument import BASE, CENTRAL_PRISM, PRISM_0, PRISM_180, Channel, prism_of
from twin.framework import svg
from twin.pictures.light_paths import RIM, Beam, LightPaths

FIELD_COLOURS = {"left edge": svg.SKY, "centre": svg.BLUE, "right edge": svg.PURPLE}
_CHANNEL_COLOURS = (svg.VERMILION, svg.ORANGE, svg.BROWN, svg.GREY, svg.YELLOW, svg.INK)
"""Colours of a camera's monitor beams, in the order of its channels; they repeat if there are more channels."""
ARROW = 0.3
"""Length of the arrow along a line of sight, in metres."""
# fills: red, green, blue and opacity
_GLASS, _BLOCK, _FRAME = (0.34, 0.71, 0.91, 0.25), (0.0, 0.62, 0.45, 0.22), (0.42, 0.45, 0.50, 0.35)
_FACE = "#4b91c7"
_UP, _DOWN = 1 + RIM // 4, 1 + 3 * RIM // 4  # edge rays at +y and -y of the stop: the ones in the plane of symmetry


def side_view_svg(instrument: Instrument, paths: LightPaths) -> str:
    """Draw the instrument in the base's X-Z plane, metres, with the mirrors cut in their plane of symmetry."""
    with svg.look("side-view"):
        spread = np.concatenate([b.vertices.reshape(-1, 3) for b in paths.beams])
        low, high = spread[:, [0, 2]].min(axis=0) - 0.3, spread[:, [0, 2]].max(axis=0) + 0.3 + 0.5 * ARROW
        width, height = high - low
        figure = svg.new_figure(min(10.6 * height / width + 0.6, 9.0))
        axes = figure.subplots()
        for camera in instrument.cameras:
            _camera_side(axes, instrument, paths, camera)
        _prisms(axes, instrument, paths)
        axes.set(xlabel="base X, flight direction [m]", ylabel="base Z, toward the scene [m]", aspect="equal")
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        svg.gridded(axes)
        colours = _colours(instrument)
        kinds = {_fill(solid) for solid in instrument.solids}
        shown = dict.fromkeys(c.name for c in instrument.channels if c in _seen(instrument, c.camera))
        mirrors = [mirror for model in instrument.cameras.values() for mirror in model.spec.mirrors.values()]
        lenses = any(mirror.light == "refracts" for mirror in mirrors)
        lines = [
            (svg.BLUE, 1.2, "imaging beam: chief and marginal rays, field centre"),
            *((colours[name], 1.2, f"monitor beam, {name} channel (out and back)") for name in shown),
            (svg.INK, 3.0, "mirrors, clear apertures"),
            *([(_FACE, 1.5, "faces of lenses")] if lenses else []),
            (svg.GREEN, 3.0, "focal plane; return faces" if instrument.channels else "focal plane"),
        ]
        handles: list[Artist] = [Line2D([], [], color=colour, lw=lw, label=text) for colour, lw, text in lines]
        fills = {_GLASS: "glass prisms", _FRAME: "mirrors and frames of the monitor"}
        fills |= {_BLOCK: "central prism, common reference"}
        handles += [Patch(fc=fill, ec=svg.INK, lw=0.8, label=text) for fill, text in fills.items() if fill in kinds]
        figure.legend(handles=handles, loc="outside upper center", ncols=3)
        return svg.to_svg(figure)


def _channel(beam: Beam) -> str:
    return beam.name.rpartition("/")[2]


def _colours(instrument: Instrument) -> dict[str, str]:
    """Return channel name -> colour; channels of the same name have the same colour in all cameras."""
    names = dict.fromkeys(channel.name for channel in instrument.channels)
    return {name: _CHANNEL_COLOURS[i % len(_CHANNEL_COLOURS)] for i, name in enumerate(names)}


def _seen(instrument: Instrument, camera: str) -> list[Channel]:
    """Return the channels of a camera that the side view shows.

    They are those at +Y, which cover those at -Y, or all if none is at +Y.
    """
    channels = [c for c in instrument.channels if c.camera == camera]
    return [c for c in channels if c.ccd[1] > 0.0] or channels


def _camera_side(axes: Axes, instrument: Instrument, paths: LightPaths, camera: str) -> None:
    model, placed = instrument.cameras[camera], paths.placed
    imaging = next(b for b in paths.of(camera, monitor=False) if b.name.endswith("centre"))
    _fan(axes, imaging, svg.BLUE, 0.09)
    seen, colours = {c.name for c in _seen(instrument, camera)}, _colours(instrument)
    for beam in paths.of(camera, monitor=True):
        if _channel(beam) in seen:
            _fan(axes, beam, colours[_channel(beam)], 0.30)
    centres = [placed.pose(f"{BASE}/{camera}/{m}").apply(_section(model, m).mean(axis=0)) for m in model.mirrors]
    middle = np.mean(centres, axis=0)
    for mirror in model.mirrors:
        curve = placed.pose(f"{BASE}/{camera}/{mirror}").apply(_section(model, mirror))
        light = model.spec.mirrors[mirror].light
        if light == "passes":  # such a body has no surface, only an edge
            continue
        colour, width = (svg.INK, 3.0) if light is None else (_FACE, 1.5)
        axes.plot(curve[:, 0], curve[:, 2], color=colour, lw=width, solid_capstyle="butt", zorder=4)
        centre = curve[len(curve) // 2]
        away = (centre - middle)[[0, 2]]
        away = 15.0 * away / np.linalg.norm(away)
        _label(axes, mirror, centre[[0, 2]], (float(away[0]), float(away[1])), "center", bold=True)
    _focal_plane(axes, paths, camera)
    for channel in instrument.channels:
        if channel.camera == camera:
            pose = placed.pose(channel.face_body)
            aperture = instrument.assembly.elements[f"{channel.key}/return_face"].aperture
            assert aperture is not None
            radius = aperture.bounds[1]
            ends = pose.apply(radius * np.array([[0.0, -1.0, 0.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]))
            axes.plot(*_widest(ends), color=svg.GREEN, lw=3, solid_capstyle="butt", zorder=5)
    origin = placed.pose(f"{BASE}/{camera}")
    end = imaging.vertices[0, 0]
    tip = end + ARROW * (end - imaging.vertices[0, 1]) / np.linalg.norm(end - imaging.vertices[0, 1])
    axes.annotate("", xy=tip[[0, 2]], xytext=end[[0, 2]], arrowprops={"arrowstyle": "-|>", "color": svg.INK, "lw": 1.3})
    look_deg = float(np.degrees(instrument.spec.cameras[camera].look))
    text = f"{camera}, look {look_deg:+.4g}°".replace("-", "\N{MINUS SIGN}")
    first = placed.pose(f"{BASE}/{camera}/{model.mirrors[0]}").apply(_section(model, model.mirrors[0]))
    _label(axes, text, np.array([origin.translation[0], first[:, 2].min()]), (-4, -22), "top", bold=True)


def _fill(solid: Solid) -> tuple[float, float, float, float]:
    return _GLASS if solid.transparent else _BLOCK if solid.path == CENTRAL_PRISM else _FRAME


def _prisms(axes: Axes, instrument: Instrument, paths: LightPaths) -> None:
    """Draw the outlines of all glass bodies and frames, with one label for each camera."""
    small: list[tuple[np.ndarray, str]] = []
    large: dict[str, list[tuple[np.ndarray, str]]] = {}
    labelled = {c.prism_body(PRISM_180): c.camera for camera in instrument.cameras for c in _seen(instrument, camera)}
    for solid in instrument.solids:
        outline = _outline(solid, paths)
        axes.add_patch(Polygon(outline, closed=True, fc=_fill(solid), ec="none", zorder=1.6))
        axes.add_patch(Polygon(outline, closed=True, fill=False, ec=svg.INK, lw=0.8, zorder=3))
        kind = "prism" if solid.transparent else "mirrors"
        if solid.path == CENTRAL_PRISM:
            middle = 0.5 * (outline[:, 0].min() + outline[:, 0].max())
            _label(axes, "central prism", np.array([middle, outline[:, 1].min()]), (0, -4), "top")
        elif prism_of(solid.path) == PRISM_0:
            small.append((outline, kind))
        elif solid.path in labelled:
            large.setdefault(labelled[solid.path], []).append((outline[np.argmax(outline[:, 1])], kind))
    for tops in large.values():
        kind = "prisms" if {kind for _, kind in tops} == {"prism"} and len(tops) > 1 else tops[0][1]
        _label(axes, f"180° {kind}", max((top for top, _ in tops), key=lambda top: float(top[1])), (0, 5), "bottom")
    if not small:
        return
    corners = np.concatenate([outline for outline, _ in small])
    among = np.array([np.mean([outline[:, 0].mean() for outline, _ in small]), corners[:, 1].max()])
    names = {"prisms" if kind == "prism" else kind for _, kind in small}
    _label(axes, f"0° {' and '.join(sorted(names))}", among, (0, 6), "bottom")


def _outline(solid: Solid, paths: LightPaths) -> np.ndarray:
    """Return the outline of a convex body in the side view: its n corners in order, (n, 2) array of x and z, metres."""
    corners = paths.placed.pose(solid.path).apply(solid_mesh(solid, paths.placed).vertices)[:, [0, 2]]
    return np.asarray(corners[ConvexHull(corners).vertices])


def _focal_plane(axes: Axes, paths: LightPaths, camera: str) -> None:
    """Draw a focal plane, a point when seen along the line CCD, as a bar that is wide enough to be visible."""
    pose = paths.placed.pose(f"{BASE}/{camera}/focal_plane")
    bar = pose.apply(np.array([[-0.06, 0.0, 0.0], [0.06, 0.0, 0.0]]))
    axes.plot(bar[:, 0], bar[:, 2], color=svg.GREEN, lw=4, solid_capstyle="butt", zorder=5)
    # the label is placed away from the monitor beams, which go to the central prism
    beside = CENTRAL_PRISM in paths.placed.index
    prism = paths.placed.pose(CENTRAL_PRISM if beside else BASE).translation
    aside = -17.0 if prism[0] > pose.translation[0] else 10.0
    _label(axes, "focal plane", pose.translation[[0, 2]], (aside, 10.0), "bottom")


def _widest(ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the ends (x, z), metres, of that diameter of a disk which looks longer in the side view.

    ``ends`` holds the ends of two perpendicular diameters.
    """
    pairs = ends.reshape(2, 2, 3)[..., [0, 2]]
    best = int(np.argmax(np.linalg.norm(pairs[:, 1] - pairs[:, 0], axis=-1)))
    return pairs[best, :, 0], pairs[best, :, 1]


def _section(model: CameraModel, mirror: str) -> np.ndarray:
    """Return points on a mirror's surface in its plane of symmetry, (25, 3) array in the mirror's frame, metres."""
    _, _, low, high = model.apertures[mirror].bounds
    y = np.linspace(low, high, 25)
    return np.stack([np.zeros_like(y), y, model.surfaces[mirror].sag(np.zeros_like(y), y)], axis=-1)


def _fan(axes: Axes, beam: Beam, colour: str, alpha: float) -> None:
    """Draw a beam in the side view: shaded segment by segment, with its middle ray and its outermost rays."""
    flat = beam.vertices[:, :, [0, 2]]
    for k in range(flat.shape[1] - 1):
        outline = np.concatenate([flat[[_UP, _DOWN], k], flat[[_DOWN, _UP], k + 1]])
        axes.add_patch(Polygon(outline, closed=True, color=colour, alpha=alpha, lw=0))
    for ray, width in ((0, 0.9), (_UP, 0.7), (_DOWN, 0.7)):
        axes.plot(flat[ray, :, 0], flat[ray, :, 1], color=colour, lw=width)


def _label(
    axes: Axes, text: str, at: np.ndarray, offset: tuple[float, float], vertical: str, bold: bool = False
) -> None:
    axes.annotate(
        text,
        xy=(float(at[0]), float(at[1])),
        xytext=offset,
        textcoords="offset points",
        ha="center",
        va=vertical,
        fontsize=8.5,
        fontweight="bold" if bold else "normal",
        zorder=6,
        bbox={"boxstyle": "square,pad=0.12", "fc": "white", "ec": "none", "alpha": 0.8},
    )


MOST_COLUMNS = 5
"""Largest number of columns in the drawing of footprints; a camera with more surfaces gets more rows."""


def footprints_svg(instrument: Instrument, paths: LightPaths) -> str:
    """Draw the footprints of the beams on each mirror, in millimetres of its frame, one or more rows per camera."""
    with svg.look("footprints"):
        mirrors = [
            (camera, name)
            for camera, model in instrument.cameras.items()
            for name, mirror in model.spec.mirrors.items()
            if mirror.light != "passes"
        ]
        counts = [sum(camera_name == camera for camera_name, _ in mirrors) for camera in instrument.cameras]
        columns = min(max(counts), MOST_COLUMNS)
        lines = [-(-count // columns) for count in counts]
        figure = svg.new_figure(0.7 + 3.0 * sum(lines))
        grid = figure.subplots(sum(lines), columns, squeeze=False)
        for axes in grid.flat:
            axes.set_axis_off()
        for first, camera in zip(np.cumsum([0, *lines[:-1]]), instrument.cameras, strict=True):
            for k, mirror in enumerate(name for camera_name, name in mirrors if camera_name == camera):
                axes = grid[first + k // columns, k % columns]
                axes.set_axis_on()
                _footprints(axes, instrument, paths, camera, mirror)
                stop = " (stop)" if mirror == instrument.cameras[camera].spec.stop else ""
                axes.set_title(f"{camera} {mirror}{stop}")
                axes.set_xlabel("x, along the line [mm]")
                if k % columns == 0:
                    axes.set_ylabel("y, in the plane of symmetry [mm]")
        handles = [Line2D([], [], color=svg.INK, lw=1.3, label="clear aperture")]
        handles += [Line2D([], [], color=c, lw=1.3, label=f"imaging, {f}") for f, c in FIELD_COLOURS.items()]
        ends = {c.name: c.ccd[1] > 0.0 for c in instrument.channels}
        marks = [
            Patch(**_style(colour, ends[name]), label=f"monitor, {name}")
            for name, colour in _colours(instrument).items()
        ]
        figure.legend(handles=[*handles, *marks], loc="outside upper center", ncols=6, columnspacing=1.3)
        return svg.to_svg(figure)


def _style(colour: str, filled: bool) -> dict[str, Any]:
    """Return the line style of a beam footprint: filled for channels at +Y, outlined at -Y, since two may coincide."""
    return {"fc": colour, "ec": colour, "alpha": 0.5} if filled else {"fill": False, "ec": colour, "lw": 1.4}


def _footprints(axes: Axes, instrument: Instrument, paths: LightPaths, camera: str, mirror: str) -> None:
    outline = 1e3 * instrument.cameras[camera].apertures[mirror].outline()
    axes.plot(outline[:, 0], outline[:, 1], color=svg.INK, lw=1.3)
    for beam in paths.of(camera, monitor=False):
        edge = 1e3 * beam.footprints[mirror, 0][1:]
        axes.add_patch(Polygon(edge, closed=True, fill=False, ec=FIELD_COLOURS[beam.name.rpartition("/")[2]], lw=1.2))
    colours, ends = _colours(instrument), {c.name: c.ccd[1] > 0.0 for c in instrument.channels if c.camera == camera}
    for beam in paths.of(camera, monitor=True):
        style = _style(colours[_channel(beam)], ends[_channel(beam)])
        for (where, _), points in beam.footprints.items():
            if where == mirror:
                axes.add_patch(Polygon(1e3 * points[1:], closed=True, **style))
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.06)
    axes.grid(color=svg.LIGHT, lw=0.4)
    axes.set_axisbelow(True)
    axes.tick_params(length=2.5)
