"""Plots of a camera analysis: wavefront maps and spots over the field, MTF, colour, through focus, distortion."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from optics.geometry import zernike
from scenes.models.camera_sharpness import BLURRED, FIELDS
from twin.camera.camera_results import Field
from twin.camera.camera_run import GRID, SHARP, CameraRun
from twin.camera.camera_view import LINE, TRACK, draw_mtf, draw_spot, draw_wavefront
from twin.framework import svg
from twin.framework.artefact import plain, rounded_down

MICRO = "\N{MICRO SIGN}m"
_FIELD_COLOURS = (svg.INK, svg.SKY, svg.BLUE, svg.VERMILION, svg.ORANGE)
_STRIP = 4.0
"""Ratio of a field's sides above which its map is not drawn to the same scale in both directions."""
_FIRST_TERMS = range(4, 23)
"""Noll indices of the Zernike terms in the bar chart."""


def degrees_text(run: CameraRun, field: Field) -> str:
    """Format a field in degrees along the line and along the track."""
    halves = (run.camera.field.x, run.camera.field.y)
    return ", ".join(plain(float(np.degrees(s * h)), 4) for s, h in zip(field, halves, strict=True)) + "\N{DEGREE SIGN}"


def _grid(height: float) -> tuple[Figure, np.ndarray]:
    """Return a figure with three by three panels, one for each of nine fields."""
    figure = svg.new_figure(height, {"w_pad": 0.05, "h_pad": 0.06})
    return figure, np.ravel(figure.subplots(3, 3))


def wavefront_figure(run: CameraRun) -> Figure:
    """Draw wavefront maps at nine fields with a common colour scale."""
    figure, axes = _grid(9.6)
    most = max(float(np.nanmax(np.abs(wave.map))) for wave in run.waves)
    for panel, wave in zip(axes, run.waves, strict=True):
        mesh = draw_wavefront(panel, wave, most)
        panel.set_title(
            f"{degrees_text(run, wave.field)}\n{wave.rms:.3g} rms, {wave.peak_to_valley:.3g} PV", fontsize=8.5
        )
        panel.set_axis_off()
    bar = figure.colorbar(mesh, ax=list(axes), shrink=0.55, aspect=30, pad=0.02)
    bar.set_label(f"wavefront error, waves of {1e9 * run.camera.wavelength:.0f} nm")
    return figure


def spot_figure(run: CameraRun) -> Figure:
    """Draw spots at nine fields in boxes of equal size, with the Airy disk."""
    figure, axes = _grid(10.2)
    half = max(1.2 * run.spots[GRID.index((0.0, 0.0))].airy, 1.08 * max(spot.farthest for spot in run.spots))
    for panel, spot in zip(axes, run.spots, strict=True):
        draw_spot(panel, spot, half)
        rms, far = (plain(1e6 * value, 3) for value in (spot.rms, spot.farthest))
        panel.set_title(f"{degrees_text(run, spot.field)}\nrms {rms}, largest {far} {MICRO}", fontsize=8.5)
        panel.tick_params(labelsize=7)
    for panel in axes[6:]:
        panel.set_xlabel(f"along the line, {MICRO}")
    for panel in axes[::3]:
        panel.set_ylabel(f"along the track, {MICRO}")
    return figure


def fans_figure(run: CameraRun) -> Figure:
    """Draw transverse ray fans and path fans of three fields."""
    fans = run.fans
    figure = svg.new_figure(5.0)
    axes = figure.subplots(2, len(fans.fields), sharex=True, sharey="row")
    for f, field in enumerate(fans.fields):
        for k, (colour, name) in enumerate(((LINE, "fan along the line"), (TRACK, "fan along the track"))):
            axes[0, f].plot(fans.pupil, 1e6 * fans.transverse[f, k, k], color=colour, lw=1.4, label=name)
            axes[1, f].plot(fans.pupil, fans.path[f, k], color=colour, lw=1.4)
        axes[0, f].set_title(degrees_text(run, field), fontsize=8.5)
        axes[1, f].set_xlabel("stop coordinate / radius")
        for panel in axes[:, f]:
            panel.axhline(0.0, color=svg.LIGHT, lw=0.8, zorder=0)
            panel.axvline(0.0, color=svg.LIGHT, lw=0.8, zorder=0)
            svg.plain_axes(panel)
    axes[0, 0].set_ylabel(f"ray from the chief ray, {MICRO}")
    axes[1, 0].set_ylabel(f"path, waves of {1e9 * run.camera.wavelength:.0f} nm")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), ncols=2, loc="outside upper right", fontsize=7.5)
    return figure


def images_figure(run: CameraRun) -> Figure:
    """Draw point images on a linear and on a logarithmic scale, with the grid of the line's pixels."""
    images = run.images
    assert images is not None
    figure = svg.new_figure(2.9)
    axes = figure.subplots(1, 2 * len(images.psfs), sharey=True)
    pitch = 1e6 * run.camera.line.pitch
    half = 1e6 * min(float(images.radius[-1]), 1.5 * max(r or np.inf for r in images.radius_of(0.9)))
    edges = pitch * (np.arange(-np.ceil(half / pitch), np.ceil(half / pitch)) + 0.5)
    for psf, pair in zip(images.psfs, axes.reshape(-1, 2), strict=True):
        um, shown = 1e6 * psf.position, psf.values / np.max(psf.values)
        for panel, values, ends, name in (
            (pair[0], shown, (0.0, 1.0), "linear"),
            (pair[1], np.log10(np.maximum(shown, 1e-6)), (-5.0, 0.0), "decades"),
        ):
            mesh = panel.pcolormesh(
                um, um, values, cmap="viridis", vmin=ends[0], vmax=ends[1], shading="gouraud", rasterized=True
            )
            figure.colorbar(mesh, ax=panel, location="bottom", shrink=0.9, ticks=ends)
            for edge in edges[np.abs(edges) < half]:
                panel.axhline(edge, color=svg.LIGHT, lw=0.35, alpha=0.6)
                panel.axvline(edge, color=svg.LIGHT, lw=0.35, alpha=0.6)
            panel.set_xlim(-half, half)
            panel.set_ylim(-half, half)
            panel.set_aspect("equal")
            panel.set_title(f"{degrees_text(run, psf.field)}: {name}", fontsize=8.5)
            panel.set_xlabel(f"along the line, {MICRO}")
            panel.tick_params(labelsize=7)
    axes[0].set_ylabel(f"along the track, {MICRO}")
    return figure


def energy_figure(run: CameraRun) -> Figure:
    """Draw encircled and ensquared energy of the point images, and that of a perfect image."""
    images = run.images
    assert images is not None
    figure = svg.new_figure(3.3)
    left, right = figure.subplots(1, 2, sharey=True)
    um = 1e6 * images.radius
    left.plot(um, images.limit, color=svg.INK, lw=0.8, ls=(0, (4, 3)), label="without wavefront error")
    for k, (psf, colour) in enumerate(zip(images.psfs, (svg.BLUE, svg.VERMILION), strict=True)):
        left.plot(um, images.encircled[k], color=colour, lw=1.4, label=degrees_text(run, psf.field))
        right.plot(um, images.ensquared[k], color=colour, lw=1.4, label=degrees_text(run, psf.field))
    right.axvline(0.5e6 * run.camera.line.pitch, color=svg.GREY, lw=0.8, ls=":", label="half a pixel")
    for panel, name, axis in ((left, "Encircled", "radius"), (right, "Ensquared", "half width")):
        panel.set_title(f"{name} energy")
        panel.set_xlabel(f"{axis}, {MICRO}")
        panel.set_xlim(0.0, float(um[-1]))
        panel.set_ylim(0.0, 1.0)
        panel.legend(fontsize=7.5, loc="lower right")
        svg.plain_axes(panel)
    left.set_ylabel("share of the light")
    return figure


def zernike_figure(run: CameraRun) -> Figure:
    """Draw the Zernike coefficients of the wavefront in the middle of the field and at the worst field."""
    figure = svg.new_figure(3.6)
    axes = figure.subplots()
    middle = run.waves[GRID.index((0.0, 0.0))]
    worst = run.optics.wavefront(run.worst[1], points=3)
    at = np.arange(len(_FIRST_TERMS))
    for shift, wave, colour in ((-0.2, middle, svg.GREY), (0.2, worst, svg.BLUE)):
        values = [wave.coefficients[j - 1] for j in _FIRST_TERMS]
        axes.bar(at + shift, values, 0.38, color=colour, label=degrees_text(run, wave.field))
    axes.axhline(0.0, color=svg.GREY, lw=0.7)
    names = [f"Z{j} {zernike.name(j)}" for j in _FIRST_TERMS]
    axes.set_xticks(at, names, rotation=52, ha="right", rotation_mode="anchor", fontsize=7)
    axes.set_ylabel("waves rms")
    axes.legend(loc="upper right")
    svg.plain_axes(axes)
    return figure


def error_figure(run: CameraRun) -> Figure:
    """Draw the rms wavefront error over the field as a map, and along the line at three positions along the track."""
    figure = svg.new_figure(3.3)
    left, right = figure.subplots(1, 2, gridspec_kw={"width_ratios": [1.35, 1.0]})
    x, y = (np.degrees(run.field[..., k] * h) for k, h in enumerate((run.camera.field.x, run.camera.field.y)))
    filled = left.contourf(x, y, run.errors, levels=12, cmap="YlGnBu")
    _same_scale(left, x, y)
    figure.colorbar(filled, ax=left, label="waves rms", shrink=0.95)
    worst = run.worst[1]
    left.plot(
        np.degrees(worst[0] * run.camera.field.x), np.degrees(worst[1] * run.camera.field.y), "o", color=svg.VERMILION,
        ms=7, mfc="none", mew=1.6, clip_on=False,
    )  # fmt: skip
    left.set_xlabel("field along the line, degrees")
    left.set_ylabel("along the track, degrees")
    count = run.field.shape[1]
    for k, colour in zip((0, count // 2, count - 1), (svg.SKY, svg.INK, svg.VERMILION), strict=True):
        text = plain(float(y[0, k]), 3)
        right.plot(x[:, k], run.errors[:, k], color=colour, lw=1.3, label=f"{text}\N{DEGREE SIGN}")
    most = float(run.errors.max())
    for limit, name in ((SHARP, "diffraction limited"), (BLURRED, "blurred")):
        if limit < 4.0 * most and most < 4.0 * limit:
            right.axhline(limit, color=svg.GREY, lw=0.8, ls=":")
            # beside the frame, clear of the curves
            right.annotate(
                name.replace(" ", "\n"), (1.0, limit), (4, 0), xycoords=("axes fraction", "data"),
                textcoords="offset points", va="center", fontsize=7.5, annotation_clip=False,
            )  # fmt: skip
    right.set_ylim(0.0, None)
    right.set_xlabel("field along the line, degrees")
    right.set_ylabel("waves rms")
    right.legend(
        fontsize=7.5, ncols=3, title="along the track", title_fontsize=7.5, loc="lower right",
        bbox_to_anchor=(1.0, 1.0), borderaxespad=0.1, columnspacing=1.2, handlelength=1.4,
    )  # fmt: skip
    svg.plain_axes(right)
    return figure


def _same_scale(axes: Axes, x: np.ndarray, y: np.ndarray) -> None:
    """Draw both directions to the same scale, unless the field is a narrow strip."""
    sides = sorted((float(np.ptp(x)), float(np.ptp(y))))
    if sides[1] < _STRIP * sides[0]:
        axes.set_aspect("equal", adjustable="box")


def _directions(run: CameraRun) -> tuple[str, str]:
    """Return the names of the directions along line and track; on the axis of a centred camera also T and S."""
    if run.optics.model.axis.on_axis:
        return "along the line (T, tangential)", "along the track (S, sagittal)"
    return "along the line", "along the track"


def mtf_figure(run: CameraRun) -> Figure:
    """Draw MTF curves of five fields, each with its diffraction limit, and the MTF at Nyquist along the line."""
    figure = svg.new_figure(6.4)
    axes = np.ravel(figure.subplots(2, 3, sharey=True))
    for k, (panel, mtf) in enumerate(zip(axes, run.mtfs, strict=False)):
        draw_mtf(panel, mtf, _directions(run) if k == 0 else None)
        panel.set_title(degrees_text(run, mtf.field))
    last = axes[-1]
    x = np.degrees(run.curves.share * run.camera.field.x)
    for k, colour in enumerate((LINE, TRACK)):
        last.plot(x, run.curves.mtf[:, k], color=colour, lw=1.4)
    last.set_title("at Nyquist, along the line")
    last.set_xlabel("field, degrees")
    svg.shared_legend(figure, axes[0])
    svg.plain_axes(last)
    axes[0].set_ylabel("MTF of the optics")
    axes[3].set_ylabel("MTF of the optics")
    return figure


def lateral_figure(run: CameraRun) -> Figure:
    """Draw the chief-ray position of every wavelength relative to the reference, along the line and the track."""
    colours = run.colours
    assert colours is not None
    assert colours.lateral is not None
    figure = svg.new_figure(3.3)
    axes = figure.subplots(1, 2, sharey=True)
    nm = 1e9 * colours.wavelengths
    for direction, (panel, name) in enumerate(zip(axes, ("along the line", "along the track"), strict=True)):
        for f, colour in zip(range(len(colours.fields)), _FIELD_COLOURS, strict=True):
            text = degrees_text(run, colours.fields[f])
            panel.plot(nm, 1e6 * colours.lateral[f, :, direction], color=colour, lw=1.3, label=text, marker=_mark(nm))
        _over_light(panel, run, f"position {name}")
    axes[0].set_ylabel(f"relative to the reference wavelength, {MICRO}")
    axes[0].legend(fontsize=7.0, title="field", title_fontsize=7.5)
    return figure


def axial_figure(run: CameraRun) -> Figure:
    """Draw best focus by wavelength for each field."""
    colours = run.colours
    assert colours is not None
    assert colours.axial is not None
    figure = svg.new_figure(3.3)
    axes = figure.subplots()
    nm = 1e9 * colours.wavelengths
    for f, colour in zip(range(len(colours.fields)), _FIELD_COLOURS, strict=True):
        text = degrees_text(run, colours.fields[f])
        axes.plot(nm, 1e6 * colours.axial[f], color=colour, lw=1.3, label=text, marker=_mark(nm))
    _over_light(axes, run, "best focus")
    axes.set_ylabel(f"from the focal plane, {MICRO}")
    axes.legend(fontsize=7.0, title="field", title_fontsize=7.5)
    return figure


def _mark(wavelengths: np.ndarray) -> str:
    """Return the marker for points on curves over the given wavelengths; empty (no marker) if there are many."""
    return "o" if len(wavelengths) < 12 else ""


def _over_light(axes: Axes, run: CameraRun, title: str) -> None:
    """Complete axes that show a quantity over wavelength: zero line, reference wavelength, title and axis label."""
    assert run.colours is not None
    axes.axhline(0.0, color=svg.LIGHT, lw=0.8, zorder=0)
    axes.axvline(1e9 * run.colours.reference, color=svg.GREY, lw=0.8, ls=":")
    axes.set_title(title)
    axes.set_xlabel("wavelength, nm")
    svg.plain_axes(axes)


def light_mtf_figure(run: CameraRun) -> Figure:
    """Draw polychromatic MTF curves and point images of five fields."""
    assert run.colours is not None
    figure = svg.new_figure(5.2)
    rows = figure.subplots(2, len(run.colours.fields))
    for k, (mtf, psf) in enumerate(zip(run.colours.mtfs, run.colours.psfs, strict=True)):
        upper, lower = rows[:, k]
        draw_mtf(upper, mtf, _directions(run) if k == 0 else None)
        upper.set_title(degrees_text(run, mtf.field), fontsize=8.5)
        um = 1e6 * psf.position
        lower.pcolormesh(
            um, um, np.sqrt(np.maximum(psf.values, 0.0)), cmap="YlGnBu", shading="nearest", rasterized=True
        )
        # up to a thousandth of the peak
        illuminated = np.abs(um)[np.max(psf.values, axis=0) + np.max(psf.values, axis=1) > 1e-3 * np.max(psf.values)]
        lower.set_xlim(-np.max(illuminated), np.max(illuminated))
        lower.set_ylim(-np.max(illuminated), np.max(illuminated))
        lower.set_aspect("equal")
        lower.set_title(f"Strehl {psf.strehl:.2f}", fontsize=8.0)
        lower.set_xlabel(MICRO)
        for panel in (upper, lower):
            panel.tick_params(labelsize=7)
    svg.shared_legend(figure, rows[0, 0])
    rows[0, 0].set_ylabel("MTF of the optics")
    rows[1, 0].set_ylabel(f"along the track, {MICRO}")
    return figure


def focus_figure(run: CameraRun) -> Figure:
    """Draw wavefront error and MTF at Nyquist through focus for each field."""
    focus = run.focus
    count = 3 if np.any(np.isfinite(focus.mtf)) else 1
    figure = svg.new_figure(3.3)
    axes = np.atleast_1d(figure.subplots(1, count))
    dz = 1e6 * focus.defocus
    for k, (field, colour) in enumerate(zip(focus.fields, _FIELD_COLOURS, strict=True)):
        axes[0].plot(dz, focus.error[k], color=colour, lw=1.3, label=degrees_text(run, field))
        for direction in range(count - 1):
            axes[1 + direction].plot(dz, focus.mtf[k, direction], color=colour, lw=1.3)
    axes[0].set_ylabel("waves rms")
    axes[0].set_title("wavefront error")
    axes[0].set_ylim(0.0, None)
    svg.shared_legend(figure, axes[0], title="field")
    for panel, name in zip(axes[1:], _directions(run), strict=False):
        panel.set_title(f"MTF of the optics at Nyquist\n{name}")
        panel.set_ylim(0.0, None)
    for panel in axes:
        panel.axvline(0.0, color=svg.LIGHT, lw=0.8, zorder=0)
        panel.set_xlabel(f"defocus of the detector, downstream, {MICRO}")
        svg.plain_axes(panel)
    return figure


def curves_figure(run: CameraRun) -> Figure:
    """Draw field curvature, astigmatism and illumination along the line."""
    curves = run.curves
    figure = svg.new_figure(3.2)
    left, right = figure.subplots(1, 2)
    along, across = _directions(run)
    x = np.degrees(curves.share * run.camera.field.x)
    left.plot(x, 1e6 * curves.focus_line, color=LINE, lw=1.4, label=f"fans {along}")
    left.plot(x, 1e6 * curves.focus_track, color=TRACK, lw=1.4, label=f"fans {across}")
    left.plot(x, 1e6 * curves.focus, color=svg.INK, lw=1.0, ls=(0, (4, 2)), label="whole beam")
    left.axhline(0.0, color=svg.LIGHT, lw=0.8, zorder=0)
    left.set_title("Field curvature and astigmatism")
    left.set_ylabel(f"best focus downstream, {MICRO}")
    left.legend(fontsize=7.5)
    right.plot(x, 100.0 * curves.illumination, color=svg.GREEN, lw=1.4, label="relative illumination")
    right.plot(x, 100.0 * (1.0 - curves.vignetted), color=svg.PURPLE, lw=1.2, ls=(0, (4, 2)), label="not vignetted")
    low = 100.0 * min(float(curves.illumination.min()), 1.0 - float(curves.vignetted.max()))
    right.set_ylim(min(98.0, low - 1.0), 100.0 + max(0.5, 100.0 * float(curves.illumination.max()) - 100.0 + 0.3))
    right.set_title("Illumination")
    right.set_ylabel("percent of the middle")
    right.legend(fontsize=7.5)
    for panel in (left, right):
        panel.set_xlabel("field along the line, degrees")
        svg.plain_axes(panel)
    return figure


def distortion_figure(run: CameraRun) -> Figure:
    """Draw the departure from the distortion-free camera, magnified over the field and to scale along the line."""
    d = run.distortion
    figure = svg.new_figure(3.6)
    left, right = figure.subplots(1, 2, gridspec_kw={"width_ratios": [1.35, 1.0]})
    away = d.positions - d.ideal
    spacing = 0.5 * float(np.min(np.ptp(d.ideal, axis=(0, 1)) / (np.array(d.fields.shape[:2]) - 1)))
    factor = rounded_down(spacing / max(d.largest, 1e-12))
    for places, colour, width in ((d.ideal, svg.GREY, 0.6), (d.ideal + factor * away, svg.BLUE, 1.0)):
        for line in (*places, *np.swapaxes(places, 0, 1)):
            left.plot(1e3 * line[:, 0], 1e3 * line[:, 1], color=colour, lw=width)
    _same_scale(left, *np.moveaxis(d.ideal, -1, 0)[:2])
    left.set_title(f"Grid of fields, distortion × {factor:g}")
    left.set_xlabel("along the line [mm]")
    left.set_ylabel("along the track [mm]")
    _lines(right, run)
    svg.plain_axes(left)
    return figure


def _lines(axes: Axes, run: CameraRun) -> None:
    """Draw the distortion of points along the line CCD, in the axes given."""
    d = run.distortion
    axes.plot(1e3 * d.position, 1e6 * d.residual, color=svg.INK, lw=1.4, label="L \N{MINUS SIGN} f tan W")
    if np.max(np.abs(d.residual_with_point - d.residual)) > 1e-9:
        axes.plot(
            1e3 * d.position, 1e6 * d.residual_with_point, color=svg.ORANGE, lw=1.2, label="with fitted principal point"
        )
    axes.axhline(0.0, color=svg.LIGHT, lw=0.8, zorder=0)
    axes.set_title("Along the line")
    axes.set_xlabel("L, mm from the line's middle")
    axes.set_ylabel(f"distortion, {MICRO}")
    axes.legend(fontsize=7.5)
    svg.plain_axes(axes)


def refocus_figure(run: CameraRun) -> Figure:
    """Draw the wavefront error of every field before and after refocusing."""
    assert run.refocus is not None
    figure = svg.new_figure(3.0)
    axes = figure.subplots()
    at = np.arange(len(FIELDS))
    before, after = run.refocus.errors_before, run.refocus.errors_after
    axes.vlines(at, np.minimum(before, after), np.maximum(before, after), color=svg.LIGHT, lw=2.0, zorder=1)
    axes.plot(at, before, "o", color=svg.GREY, ms=6, label="before")
    axes.plot(at, after, "o", color=svg.BLUE, ms=6, label="after")
    axes.set_yscale("log")
    axes.set_xlim(-0.5, len(at) + 1.2)
    for limit, name in ((SHARP, "diffraction limited"), (BLURRED, "blurred")):
        axes.axhline(limit, color=svg.GREY, lw=0.8, ls=":")
        axes.annotate(name, (len(at) + 1.2, limit), (0, 1), textcoords="offset points", ha="right", fontsize=7.5)
    axes.set_xticks(at, [degrees_text(run, field) for field in FIELDS], rotation=30, ha="right", fontsize=7.5)
    axes.set_ylabel("waves rms")
    axes.legend(ncols=2, loc="lower right", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.1)
    svg.plain_axes(axes)
    return figure
