"""All that a run draws, drawing by drawing: what each needs is imported when it is drawn, and by whom it is drawn."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any
from xml.sax.saxutils import escape

from optics.geometry.tree import State
from scenes.models.instrument_model import Instrument
from twin.main_job.render_results import RenderRun
from twin.pictures.light_paths import LightPaths
from twin.run.artefact import Undrawn

__all__ = ["APART", "FILES", "IRRADIANCE", "SCENE", "SUMMARY", "drawings", "load_drawing", "without_failed"]

SUMMARY, SCENE, IRRADIANCE = "summary", "scene", "irradiance"
"""What is no figure of the report: the bytes of summary.png, scene.glb, irradiance.nc."""
APART = (SUMMARY, SCENE, IRRADIANCE)
FILES = {IRRADIANCE: "irradiance.nc", SCENE: "scene.glb", SUMMARY: "summary.png"}
"""Where these are written."""


def drawings(run: RenderRun, paths: LightPaths) -> Mapping[str, Callable[[], Any]]:
    """Name -> what draws it, the longest first: <svg> elements but for ``APART``, which are written as they are.

    Args:
        run: the run; what it works out on demand is taken as it is now.
        paths: its light, traced.
    """
    experiment = run.experiment
    out: dict[str, Callable[[], Any]] = {"motions": partial(_motions, run)}
    out |= {f"spots {name}": partial(_spots, run, name) for name in experiment.instrument.cameras}
    out[IRRADIANCE] = partial(_irradiance, run)
    out["footprints"] = partial(_footprints, experiment.instrument, paths)
    if run.targets is not None:
        for name in run.targets.cameras:
            out[f"targets {name}"] = partial(_targets, run, name)
            if run.targets.has_edges:
                out[f"mtf {name}"] = partial(_mtf, run, name)
    if run.series is not None:
        out["course"] = partial(_course, run)
        out["temperatures"] = partial(_temperatures, run)
        if run.series.smoothed is not None:
            out["smoothed"] = partial(_smoothed, run)
    out[SUMMARY] = partial(_summary, run)
    out["side"] = partial(_side, experiment.instrument, paths)
    out["residuals"] = partial(_residuals, run)
    if run.quality is not None and run.quality.obstruction:
        out["pupils"] = partial(_pupils, run)
    out[SCENE] = partial(_scene, experiment.instrument, run.state, paths)
    return {name: partial(_tried, name, draw) for name, draw in out.items()}


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
    import xarray

    from twin.main_job import light_path_plots, motion_map, spot_plots, summary_plot
    from twin.pictures import scene_file
    from twin.run.svg import look, new_figure, to_svg
    from twin.uncertainty import uncertainty_plot

    _ = light_path_plots, motion_map, spot_plots, summary_plot, scene_file, uncertainty_plot
    xarray.DataArray([0.0], dims="x", name="first").to_netcdf(engine="h5netcdf")
    with look("first"):
        figure = new_figure(1.0)
        figure.subplots().set_title("0 \N{MINUS SIGN}", fontweight="bold")
        to_svg(figure)


def _motions(run: RenderRun) -> str:
    from twin.main_job.motion_map import motion_map_svg

    return motion_map_svg(run)


def _spots(run: RenderRun, camera: str) -> str:
    from twin.main_job.spot_plots import spots_svg

    return spots_svg(run, camera)


def _residuals(run: RenderRun) -> str:
    from twin.main_job.spot_plots import residuals_svg

    return residuals_svg(run)


def _side(instrument: Instrument, paths: LightPaths) -> str:
    from twin.main_job.light_path_plots import side_view_svg

    return side_view_svg(instrument, paths)


def _footprints(instrument: Instrument, paths: LightPaths) -> str:
    from twin.main_job.light_path_plots import footprints_svg

    return footprints_svg(instrument, paths)


def _summary(run: RenderRun) -> bytes:
    from twin.main_job.summary_plot import summary_png

    return summary_png(run)


def _irradiance(run: RenderRun) -> bytes:
    from twin.main_job.render_files import irradiance_file

    return irradiance_file(run)


def _scene(instrument: Instrument, state: State, paths: LightPaths) -> bytes:
    from twin.pictures.scene_file import scene_bytes

    return scene_bytes(instrument, state, paths)


def _course(run: RenderRun) -> str:
    from twin.main_job.series_plots import parameters_svg

    assert run.series is not None
    return parameters_svg(run.series, {name: estimator.title for name, estimator in run.estimators.items()})


def _temperatures(run: RenderRun) -> str:
    from twin.main_job.series_plots import temperatures_svg

    assert run.series is not None
    return temperatures_svg(run.series)


def _smoothed(run: RenderRun) -> str:
    from twin.main_job.series_plots import smoothed_svg

    assert run.series is not None
    return smoothed_svg(run.series)


def _targets(run: RenderRun, camera: str) -> str:
    from twin.main_job.target_plots import images_svg

    assert run.targets is not None
    return images_svg(camera, run.targets.cameras[camera])


def _mtf(run: RenderRun, camera: str) -> str:
    from twin.main_job.target_plots import curves_svg

    assert run.targets is not None
    return curves_svg(camera, run.targets.cameras[camera])


def _pupils(run: RenderRun) -> str:
    from twin.main_job.target_plots import pupils_svg

    assert run.quality is not None
    return pupils_svg(run.quality)
