"""Drawing of docs/conventions.svg, the picture of docs/conventions.md.

Run it from anywhere: python docs/draw_conventions.py. The look angles and the section of the camera are those of the
library's gf7_pair and its trace; panels d and e are not to scale.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))

from optics.numerics.backend import Backend, load_backend  # noqa: E402
from optics.raytrace.system import assemble  # noqa: E402
from optics.raytrace.trace import make_rays, trace  # noqa: E402
from scenes.models.camera_model import CameraModel, collimated, derive_camera, field_direction  # noqa: E402
from scenes.specs.instrument import InstrumentSpec  # noqa: E402
from scenes.specs.load import load_camera, load_instrument  # noqa: E402

INSTRUMENT = "gf7_pair"
INK, CAMERA, PRESCRIPTION, PLANE, LIGHT, CCD = "#1b1f24", "#0b5cad", "#6b7280", "#b3261e", "#e6a700", "#1a7f4b"
SIZE = 10.0
SHADOW = {"facecolor": "white", "edgecolor": "none", "pad": 1.0, "alpha": 0.85}
Point = tuple[float, float]


def arrow(ax: Any, start: Point, end: Point, colour: str = INK, width: float = 1.8, style: str = "-|>") -> None:
    """Draw a straight arrow in data coordinates."""
    props = {"arrowstyle": style, "color": colour, "lw": width, "shrinkA": 0, "shrinkB": 0, "mutation_scale": 12}
    ax.annotate("", end, start, arrowprops=props, zorder=6)


def text(ax: Any, place: Point, words: str, colour: str = INK, size: float = SIZE, **options: Any) -> None:
    """Write centred text on a white ground that hides lines."""
    options = {"ha": "center", "va": "center", **options}
    ax.text(*place, words, color=colour, fontsize=size, bbox=SHADOW, zorder=7, **options)


def normal(ax: Any, place: Point, into: bool, colour: str, words: str, shift: Point, radius: float) -> None:
    """Draw the symbol of an axis that points into the paper (cross) or out of it (dot)."""
    ax.plot(*place, marker="o", ms=radius, mfc="white", mec=colour, mew=1.4, zorder=6)
    mark, size = ("x", 0.55 * radius) if into else (".", 0.5 * radius)
    ax.plot(*place, marker=mark, ms=size, color=colour, mew=1.4, zorder=7)
    text(ax, (place[0] + shift[0], place[1] + shift[1]), words, colour)


def arc(ax: Any, centre: Point, radius: float, start_deg: float, end_deg: float, colour: str) -> None:
    """Draw a curved arrow from one angle to another, counter-clockwise when end > start."""
    angle = np.radians(np.linspace(start_deg, end_deg, 60))
    x, y = centre[0] + radius * np.cos(angle), centre[1] + radius * np.sin(angle)
    ax.plot(x[:-3], y[:-3], color=colour, lw=1.4, zorder=5)
    arrow(ax, (float(x[-5]), float(y[-5])), (float(x[-1]), float(y[-1])), colour, 1.4)


def plain(ax: Any, title: str) -> None:
    """Set equal axes without ticks and a title on the left."""
    ax.set_aspect("equal")
    ax.axis("off")
    ax.set_title(title, loc="left", fontsize=SIZE + 1.5, fontweight="bold", color=INK)


def draw_base(ax: Any, spec: InstrumentSpec) -> None:
    """Draw the instrument from the side, the scene below: X to the right, Z down, Y out of the paper."""
    ax.set_anchor("N")
    plain(ax, "a   base frame and look angles (seen against +Y, scene below)")
    ax.plot([-2.3, 2.3], [0, 0], color="#c9ced6", lw=5, solid_capstyle="round", zorder=0)
    for name, site in spec.cameras.items():
        x = site.position[0]
        axis = np.array([np.sin(site.look), -np.cos(site.look)])
        across = np.array([axis[1], -axis[0]])
        body = [(x, 0) + 0.34 * (i * across + j * 1.5 * axis) for i, j in ((-1, 0), (1, 0), (1, 1), (-1, 1))]
        ax.fill(*np.transpose(body), facecolor="white", edgecolor=INK, lw=1.5, zorder=2)
        tip = (float(x + 1.9 * axis[0]), float(1.9 * axis[1]))
        ax.plot([x, x], [0, -1.6], color=PRESCRIPTION, lw=1, ls=(0, (4, 3)), zorder=3)
        arrow(ax, (x, 0.0), tip, CAMERA, 2.0)
        sign = 1 if site.look > 0 else -1
        degrees = np.degrees(site.look)
        arc(ax, (x, 0.0), 1.42, -90, -90 + degrees, CAMERA)
        middle = np.radians(-90 + 0.5 * degrees)
        aside = (0.0, -0.18) if sign > 0 else (-0.32, 0.0)
        place = (x + 1.5 * np.cos(middle) + aside[0], 1.5 * np.sin(middle) + aside[1])
        text(ax, place, f"{degrees:+.0f}°".replace("-", "−"), CAMERA)
        text(ax, (tip[0], tip[1] - 0.2), f"Z of {name}", CAMERA)
        text(ax, (x, 0.28), f"base/{name}", INK, SIZE - 1)
    ax.plot(0, 0, marker="s", ms=13, mfc="#d5e8f8", mec=INK, mew=1.3, zorder=3)
    text(ax, (0, 0.28), "base/central_prism", INK, SIZE - 1)
    arrow(ax, (0, 0), (0.7, 0))
    arrow(ax, (0, 0), (0, -0.7))
    normal(ax, (0, 0), False, INK, "Y", (-0.22, -0.2), 8)
    text(ax, (0.52, -0.17), "X, flight")
    text(ax, (0.0, -0.86), "Z, scene")
    ax.set_xlim(-2.45, 2.75)
    ax.set_ylim(-2.25, 0.5)


def draw_turns(ax: Any) -> None:
    """Draw the three rotations of a camera in an oblique view."""
    ax.set_anchor("N")
    plain(ax, "b   changes of a camera")
    ends = {"X": (1.0, 0.0), "Y": (-0.66, -0.5), "Z": (0.0, -1.0)}
    names = {"X": r"$\Delta\beta$ about X", "Y": r"$\Delta\alpha$ about Y", "Z": r"$\Delta\gamma$ about Z"}
    for key, (x, y) in ends.items():
        arrow(ax, (0, 0), (1.25 * x, 1.25 * y), CAMERA, 2.0)
        text(ax, (1.4 * x, 1.4 * y), key, CAMERA, SIZE + 1)
    vectors = {k: np.array(v) for k, v in ends.items()}
    # right-hand rule: about each axis the next one in the cycle X, Y, Z turns toward the one after it
    for key, first, second in (("X", "Y", "Z"), ("Y", "Z", "X"), ("Z", "X", "Y")):
        t = np.radians(np.linspace(-30, 250, 80))
        ring = 0.85 * vectors[key] + 0.23 * (np.cos(t)[:, None] * vectors[first] + np.sin(t)[:, None] * vectors[second])
        ax.plot(*ring[:-3].T, color=PLANE, lw=1.4, zorder=5)
        arrow(ax, tuple(ring[-5]), tuple(ring[-1]), PLANE, 1.4)
    text(ax, (0.85, 0.42), names["X"], PLANE)
    text(ax, (-0.75, 0.02), names["Y"], PLANE)
    text(ax, (0.0, -1.62), names["Z"], PLANE)
    text(ax, (0.95, -0.95), "positive by the\nright-hand rule", INK, SIZE - 1)
    ax.set_xlim(-1.3, 1.6)
    ax.set_ylim(-1.8, 0.75)


def traced_rays(model: CameraModel, backend: Backend) -> np.ndarray:
    """Return points (rays, 6, 2) as (z, y) from before M1 to the image, for three rays in the plane of symmetry."""
    bare = model.bare_assembly(apertures=False)
    names = model.mirrors
    stop = names.index(model.spec.stop)
    radius = model.apertures[model.spec.stop].bounds[1]
    centre = field_direction(model.spec, 0.0, 0.0)
    launch = collimated(
        backend, assemble(bare, [names[: stop + 1]]), centre[None], np.array([[0.0, y] for y in (-radius, 0, radius)])
    )[0]
    out = trace(backend, assemble(bare, ["imaging"]), make_rays(backend, launch, centre), keep=range(len(names)))
    hits = [out.hit(i)[0] + model.vertex(name) for i, name in enumerate(names)]
    end = out.numpy()[0][0] + [0.0, 0.0, model.spec.image.z]
    start = hits[0] - centre * ((hits[0][:, 2:] + 3.05) / centre[2])
    return np.stack([start, *hits, end], axis=1)[..., [2, 1]]


def draw_camera(ax: Any, model: CameraModel, backend: Backend) -> None:
    """Draw a section of the camera in its plane of symmetry, to scale: z to the right, y up, x into the paper."""
    plain(ax, "c   camera gf7 in its plane of symmetry, to scale (seen along +x = camera +Y)")
    rays = traced_rays(model, backend)
    for k, ray in enumerate(rays):
        ax.plot(*ray.T, color=LIGHT, lw=1.6 if k == 1 else 0.9, zorder=1)
    ax.plot([-2.55, 0.75], [0, 0], color=PRESCRIPTION, lw=0.9, ls=(0, (8, 3, 1.5, 3)), zorder=0)
    for name in model.mirrors:
        y = np.linspace(*model.apertures[name].bounds[2:], 60)
        z = model.vertex(name)[2] + model.surfaces[name].sag(0.0, y)
        behind = 0.05 if name != "M2" else -0.05
        ax.fill_betweenx(y, z, z + behind, color="#c9ced6", zorder=2)
        ax.plot(z, y, color=INK, lw=2.4, zorder=3)
        middle = (float(z[30]), float(y[30]))
        ax.plot(*middle, marker="o", ms=4, color=PLANE, zorder=8)
        side = 1 if behind > 0 else -1
        label = {"M1": "M1", "M2": "M2 (stop)", "M3": "M3"}[name]
        place = (middle[0] + side * 0.1, middle[1] + (0.0 if name != "M2" else 0.12))
        text(ax, place, label, ha="left" if side > 0 else "right", size=SIZE + 1, fontweight="bold")
    # prescription frame at the vertex of M1
    arrow(ax, (0, 0), (0.42, 0), PRESCRIPTION)
    arrow(ax, (0, 0), (0, 0.36), PRESCRIPTION)
    normal(ax, (0, 0), True, PRESCRIPTION, "x", (-0.09, -0.09), 9)
    text(ax, (0.48, -0.07), "z", PRESCRIPTION)
    text(ax, (-0.07, 0.33), "y", PRESCRIPTION)
    text(ax, (0.5, 0.2), "prescription frame;\nM1's body: the same axes,\norigin at its vertex", PRESCRIPTION, SIZE - 1)
    z2 = model.vertex("M2")[2]
    arrow(ax, (z2, 0), (z2 + 0.3, 0), PRESCRIPTION)
    normal(ax, (z2, 0), True, PRESCRIPTION, "x", (0.09, -0.09), 8)
    text(ax, (z2 + 0.37, 0.0), "z", PRESCRIPTION)
    text(ax, (z2 - 0.5, -0.14), "M2's body: the same axes,\norigin = centre = vertex", PRESCRIPTION, SIZE - 1)
    # camera frame
    frame = model.camera_frame
    origin = (float(frame.translation[2]), float(frame.translation[1]))
    for column, name, length, move in ((0, "X", 0.3, (-0.08, 0.02)), (2, "Z", 0.7, (0.02, -0.09))):
        axis = frame.rotation[:, column]
        tip = (origin[0] + length * axis[2], origin[1] + length * axis[1])
        arrow(ax, origin, tip, CAMERA, 2.2)
        text(ax, (tip[0] + move[0], tip[1] + move[1]), name, CAMERA, SIZE + 1)
    normal(ax, origin, True, CAMERA, "Y", (0.11, -0.1), 10)
    text(ax, (-0.78, -0.82), "camera frame, origin on M1;\nZ = line of sight, to the scene", CAMERA, SIZE - 1)
    # focal plane
    plane = model.focal_plane
    image = (float(plane.translation[2]), float(plane.translation[1]))
    ax.plot([image[0]] * 2, [image[1] - 0.1, image[1] + 0.1], color=PLANE, lw=3.5, zorder=4)
    arrow(ax, image, (image[0], image[1] + 0.34), PLANE, 2.0)
    arrow(ax, image, (image[0] - 0.34, image[1]), PLANE, 2.0)
    normal(ax, image, True, PLANE, "Y", (0.09, -0.16), 9)
    text(ax, (image[0] + 0.08, image[1] + 0.32), "X", PLANE)
    text(ax, (image[0] - 0.42, image[1]), "Z", PLANE)
    text(ax, (image[0] - 0.12, image[1] + 0.5), "focal plane", PLANE, SIZE + 1, fontweight="bold")
    # toward the rear node, along the chief ray, upstream
    node = (float(model.rear_node[2]), float(model.rear_node[1]))
    high = image[1] + 0.5
    arrow(ax, (0.30, high), (0.72, high), PLANE, 1.4)
    focal = model.line_principal_distance
    words = f"rear_node, {focal:.2f} m upstream of the line\n(z = {node[0]:+.2f} m)"
    text(ax, (0.26, high), words, PLANE, SIZE - 1, ha="right")
    ax.plot(0.3, -1.04, marker="o", ms=4, color=PLANE)
    text(ax, (0.34, -1.04), "pivot centre of a mirror", PLANE, SIZE - 1, ha="left")
    text(ax, (-2.55, -1.02), "light from\nthe scene", "#8a6500", SIZE - 1, ha="center")
    text(ax, (-1.05, 0.76), "here the light runs along +Z", "#8a6500", SIZE - 1)
    ax.set_xlim(-3.1, 0.95)
    ax.set_ylim(-1.17, 1.2)


def draw_plane(ax: Any) -> None:
    """Draw the focal plane seen from the scene, not to scale: X up, Y to the left, Z toward the viewer."""
    ax.set_anchor("N")
    plain(ax, "d   focal plane (+Z toward the viewer, not to scale)")
    ax.add_patch(_box((-4.6, -1.15), 9.2, 2.3, "#f7f7f8", "#9aa1ab", 1.0))
    ax.add_patch(_box((-3.0, -0.07), 6.0, 0.14, "#fbe3e1", PLANE, 1.3))
    text(ax, (1.5, 0.34), "line CCD", PLANE)
    for side, x in (("left", -3.75), ("right", 3.75)):
        ax.add_patch(_box((x - 0.42, -0.42), 0.84, 0.84, "#dff2e7", CCD, 1.4))
        ax.plot(x, -0.83, marker="o", ms=6, mfc=LIGHT, mec=INK, zorder=5)
        text(ax, (x, 0.75), f"{side}", CCD, SIZE + 1, fontweight="bold")
        arrow(ax, (x + 0.3, 0.3), (x + 0.3, -0.3), CCD, 1.3)
        arrow(ax, (x + 0.3, 0.3), (x - 0.3, 0.3), CCD, 1.3)
    text(ax, (-2.55, -0.83), "pinhole", "#8a6500", SIZE - 1)
    arrow(ax, (-2.98, -0.83), (-3.6, -0.83), "#8a6500", 1.0)
    text(ax, (-2.45, 0.72), "area CCD", CCD, SIZE - 1)
    arrow(ax, (0, 0), (0, 0.85), PLANE, 2.0)
    arrow(ax, (0, 0), (-1.15, 0), PLANE, 2.0)
    normal(ax, (0, 0), False, PLANE, "Z", (0.24, -0.3), 10)
    text(ax, (0.25, 0.86), "X", PLANE, SIZE + 1)
    text(ax, (-1.35, 0.3), "Y", PLANE, SIZE + 1)
    arrow(ax, (-3.75, -1.5), (3.75, -1.5), INK, 1.0, "<|-|>")
    text(ax, (0, -1.5), "L, distance of the area CCDs")
    ax.set_xlim(-4.8, 4.8)
    ax.set_ylim(-1.85, 1.3)


def draw_pixels(ax: Any) -> None:
    """Draw an area CCD's pixel grid in the same view as the focal plane."""
    ax.set_anchor("N")
    plain(ax, "e   area CCD, same view")
    n = 5
    for k in range(n + 1):
        ax.plot([-n / 2, n / 2], [k - n / 2] * 2, color=CCD, lw=0.8, zorder=1)
        ax.plot([k - n / 2] * 2, [-n / 2, n / 2], color=CCD, lw=0.8, zorder=1)
    first = (n / 2 - 0.5, n / 2 - 0.5)
    ax.add_patch(_box((first[0] - 0.5, first[1] - 0.5), 1, 1, "#dff2e7", CCD, 1.4))
    ax.plot(*first, marker="o", ms=4, color=INK, zorder=6)
    text(ax, (first[0] + 0.1, n / 2 + 0.42), "(row 0, column 0)", INK, SIZE - 1)
    arrow(ax, (n / 2 + 0.35, n / 2 - 0.4), (n / 2 + 0.35, -n / 2 + 0.4), CCD, 2.0)
    text(ax, (n / 2 + 0.5, 0), "columns: detector x,\nfocal-plane −X,\nthe paper's x", CCD, SIZE - 1, ha="left")
    arrow(ax, (n / 2 - 0.4, -n / 2 - 0.35), (-n / 2 + 0.4, -n / 2 - 0.35), CCD, 2.0)
    text(ax, (0, -n / 2 - 1.15), "rows: detector y,\nfocal-plane +Y, the paper's y", CCD, SIZE - 1)
    ax.plot(0, 0, marker="+", ms=11, color=PLANE, mew=1.6, zorder=6)
    text(ax, (0, -0.95), "centre at\n((rows−1)/2,\n(columns−1)/2)", PLANE, SIZE - 1)
    ax.set_xlim(-3.0, 6.4)
    ax.set_ylim(-4.3, 3.4)


def _box(corner: Point, width: float, height: float, face: str, edge: str, line: float) -> Any:
    """Return a rectangle patch."""
    from matplotlib.patches import Rectangle

    return Rectangle(corner, width, height, facecolor=face, edgecolor=edge, lw=line, zorder=2)


def draw(path: Path) -> None:
    """Draw the picture as SVG or PNG, by the file's suffix."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    plt.rcParams.update({"svg.hashsalt": "conventions", "font.family": "DejaVu Sans"})
    backend = load_backend("llvm")
    spec = load_instrument(INSTRUMENT)
    camera = next(iter(spec.cameras.values())).camera
    model = derive_camera(load_camera(camera), backend)
    figure = plt.figure(figsize=(12.5, 15.2))
    figure.subplots_adjust(left=0.02, right=0.98, top=0.975, bottom=0.01)
    grid = figure.add_gridspec(3, 1, height_ratios=[4.6, 6.9, 4.0], hspace=0.10)
    top = grid[0].subgridspec(1, 2, width_ratios=[5.2, 2.6], wspace=0.02)
    bottom = grid[2].subgridspec(1, 2, width_ratios=[9.6, 6.0], wspace=0.02)
    draw_base(figure.add_subplot(top[0]), spec)
    draw_turns(figure.add_subplot(top[1]))
    draw_camera(figure.add_subplot(grid[1]), model, backend)
    draw_plane(figure.add_subplot(bottom[0]))
    draw_pixels(figure.add_subplot(bottom[1]))
    metadata = {"Date": None} if path.suffix == ".svg" else None
    figure.savefig(path, facecolor="white", metadata=metadata, dpi=80)
    plt.close(figure)


if __name__ == "__main__":
    draw(Path(sys.argv[1]) if len(sys.argv) > 1 else HERE / "conventions.svg")
