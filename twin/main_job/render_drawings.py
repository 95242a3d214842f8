"""All that a run draws, drawing by drawing: what each needs is imported when it is drawn, and by whom it is drawn."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING, Any
from xml.sax.saxutils import escape

from optics.geometry.tree import State
from optics.numerics.backend import Backend
from scenes.models.instrument_model import Instrument
from scenes.yaml.named import Named
from twin.framework.artefact import Undrawn
from twin.framework.second_process import SecondProcess
from twin.main_job.render_results import JobRun, RenderRun
from twin.pictures.light_paths import trace_light_paths

if TYPE_CHECKING:
    from twin.uncertainty.monitor_limits import MonitorLimits

__all__ = [
    *("APART", "FILES", "IRRADIANCE", "LIMITS", "LOADED", "SCENE", "SUMMARY"),
    *("begin_drawing", "drawings", "instrument_drawings", "limits_drawing", "load_drawing", "without_failed"),
]

LIMITS = "limits"
"""The figure of what limits the readings."""
SUMMARY, SCENE, IRRADIANCE = "summary", "scene", "irradiance"
"""What is no figure of the report: the bytes of summary.png, scene.glb, irradiance.nc."""
APART = (SUMMARY, SCENE, IRRADIANCE)
LOADED = (SCENE, IRRADIANCE)
"""What needs libraries that nothing else of a run needs, trimesh and h5netcdf: drawn after `load_drawing`."""
FILES = {IRRADIANCE: "irradiance.nc", SCENE: "scene.glb", SUMMARY: "summary.png"}
"""Where these are written."""


def begin_drawing(beside: SecondProcess, instrument: Instrument, backend: Backend, state: State) -> None:
    """Let the second process draw what is known before anything is measured, if it does not so already.

    Args:
        beside: the process.
        instrument: of the run.
        backend: where to trace its light.
        state: that is shown.
    """
    if SCENE not in beside:
        beside.start(instrument_drawings(instrument, backend, state), LOADED)


def instrument_drawings(instrument: Instrument, backend: Backend, state: State) -> dict[str, Callable[[], Any]]:
    """Name -> what draws it, the longest first, of an instrument and its light in a state: <svg> elements, and the
    bytes of scene.glb.
    """
    paths = trace_light_paths(instrument, backend, state)
    return _tried_each(
        {
            "footprints": _drawing("light_path_plots.footprints_svg", instrument, paths),
            "side": _drawing("light_path_plots.side_view_svg", instrument, paths),
            SCENE: partial(_scene, instrument, state, paths),
        }
    )


def drawings(run: JobRun) -> dict[str, Callable[[], Any]]:
    """The same of what a run has found; what it works out on demand is taken as it is now."""
    targets = run.targets
    out = _of_monitor(run) if isinstance(run, RenderRun) else {}
    if targets is not None:
        for name, camera in targets.cameras.items():
            out[f"targets {name}"] = _drawing("target_plots.images_svg", name, camera)
            if targets.has_edges:
                out[f"mtf {name}"] = _drawing("target_plots.curves_svg", name, camera)
    if run.quality is not None and run.quality.obstruction:
        out["pupils"] = _drawing("target_plots.pupils_svg", run.quality)
    return _tried_each(out)


def limits_drawing(limits: MonitorLimits | None) -> dict[str, Callable[[], Any]]:
    """The same of what limits the readings, of which nothing is drawn where no prior is stated."""
    if limits is None:
        return {}
    return _tried_each({LIMITS: partial(Named("twin.uncertainty.uncertainty_report:limits_svg"), limits)})


def _tried_each(drawing: Mapping[str, Callable[[], Any]]) -> dict[str, Callable[[], Any]]:
    return {name: partial(_tried, name, draw) for name, draw in drawing.items()}


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

    from twin.framework.svg import look, new_figure, to_svg
    from twin.main_job import light_path_plots, spot_plots, summary_plot
    from twin.pictures import scene_file
    from twin.uncertainty import uncertainty_report

    _ = h5netcdf, light_path_plots, spot_plots, summary_plot, scene_file, uncertainty_report
    with look("first"):
        figure = new_figure(1.0)
        figure.subplots().set_title("0 \N{MINUS SIGN}", fontweight="bold")
        to_svg(figure)
