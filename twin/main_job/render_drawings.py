"""All that a run draws, drawing by drawing: what each needs is imported when it is drawn, and by whom it is drawn."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from importlib import import_module
from typing import Any
from xml.sax.saxutils import escape

from twin.main_job.render_results import JobRun, RenderRun
from twin.pictures.light_paths import LightPaths
from twin.run.artefact import Undrawn

__all__ = ["APART", "FILES", "IRRADIANCE", "LOADED", "SCENE", "SUMMARY", "drawings", "load_drawing", "without_failed"]

SUMMARY, SCENE, IRRADIANCE = "summary", "scene", "irradiance"
"""What is no figure of the report: the bytes of summary.png, scene.glb, irradiance.nc."""
APART = (SUMMARY, SCENE, IRRADIANCE)
LOADED = (SCENE, IRRADIANCE)
"""What needs libraries that nothing else of a run needs, trimesh and h5netcdf: drawn after `load_drawing`."""
FILES = {IRRADIANCE: "irradiance.nc", SCENE: "scene.glb", SUMMARY: "summary.png"}
"""Where these are written."""


def drawings(run: JobRun, paths: LightPaths) -> Mapping[str, Callable[[], Any]]:
    """Name -> what draws it, the longest first: <svg> elements but for ``APART``, which are written as they are.

    Args:
        run: the run; what it works out on demand is taken as it is now.
        paths: its light, traced.
    """
    instrument, targets = run.experiment.instrument, run.targets
    out = _of_monitor(run) if isinstance(run, RenderRun) else {}
    out["footprints"] = _drawing("light_path_plots.footprints_svg", instrument, paths)
    if targets is not None:
        for name, camera in targets.cameras.items():
            out[f"targets {name}"] = _drawing("target_plots.images_svg", name, camera)
            if targets.has_edges:
                out[f"mtf {name}"] = _drawing("target_plots.curves_svg", name, camera)
    out["side"] = _drawing("light_path_plots.side_view_svg", instrument, paths)
    if run.quality is not None and run.quality.obstruction:
        out["pupils"] = _drawing("target_plots.pupils_svg", run.quality)
    out[SCENE] = partial(_scene, instrument, run.state, paths)
    return {name: partial(_tried, name, draw) for name, draw in out.items()}


def _of_monitor(run: RenderRun) -> dict[str, Callable[[], Any]]:
    """Drawings of what the monitor recorded and reads."""
    out: dict[str, Callable[[], Any]] = {"motions": _drawing("spot_plots.motion_map_svg", run)}
    out |= {f"spots {name}": _drawing("spot_plots.spots_svg", run, name) for name in run.experiment.instrument.cameras}
    out[IRRADIANCE] = _drawing("render_files.irradiance_file", run)
    if (series := run.series) is not None:
        titles = {name: estimator.title for name, estimator in run.estimators.items()}
        out["course"] = _drawing("series_plots.parameters_svg", series, titles)
        out["temperatures"] = _drawing("series_plots.temperatures_svg", series)
        if series.smoothed is not None:
            out["smoothed"] = _drawing("series_plots.smoothed_svg", series)
    out[SUMMARY] = _drawing("summary_plot.summary_png", run)
    out["residuals"] = _drawing("spot_plots.residuals_svg", run)
    return out


def _drawing(function: str, *given: Any) -> Callable[[], Any]:
    """A drawing by a function of this folder, ``file.name``."""
    module, _, name = function.partition(".")
    return partial(_call, f"{__package__}.{module}", name, *given)


def _call(module: str, name: str, *given: Any) -> Any:
    """Import a module and call its function: what draws takes a second to import, in the process that draws."""
    return getattr(import_module(module), name)(*given)


def _scene(*given: Any) -> bytes:
    """The contents of scene.glb."""
    from twin.pictures.scene_file import scene_bytes

    return scene_bytes(*given)


def _tried(name: str, draw: Callable[[], Any]) -> Any:
    """A drawing, or Undrawn: what cannot be drawn must not cost what was computed."""
    try:
        return draw()
    except Exception as error:
        return Undrawn("undrawn", name, "", f"{type(error).__name__}: {' '.join(str(error).split())}")


def without_failed(drawn: Mapping[str, Any]) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Drawings with a note in the place of a figure that could not be made; files that could not are left out. And what
    is missing, a sentence each.
    """
    out, missing = dict(drawn), []
    for name, made in drawn.items():
        if isinstance(made, Undrawn):
            apart = f"the file {FILES[name]} could not be drawn: {made.why}" if name in APART else ""
            missing.append(apart or made.note)
            del out[name]
            if name not in APART:
                out[name] = (
                    f'<svg viewBox="0 0 1060 40" role="img"><text x="8" y="25">{escape(missing[-1])}</text></svg>'
                )
    return out, tuple(missing)


def load_drawing() -> None:
    """Import what all runs draw with, and let it find its fonts."""
    import h5netcdf

    from twin.main_job import light_path_plots, spot_plots, summary_plot
    from twin.pictures import scene_file
    from twin.run.svg import look, new_figure, to_svg
    from twin.uncertainty import uncertainty_report

    _ = h5netcdf, light_path_plots, spot_plots, summary_plot, scene_file, uncertainty_report
    with look("first"):
        figure = new_figure(1.0)
        figure.subplots().set_title("0 \N{MINUS SIGN}", fontweight="bold")
        to_svg(figure)
