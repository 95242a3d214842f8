"""Every table of the main report with all its digits, a number to a cell, to be taken away as CSV."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from analysis.monitor.monitoring import PER_SI
from twin.main_job.render_results import RenderRun
from twin.main_job.report_labels import ANGLE, GROUND, PARAMETERS, Parameter
from twin.main_job.systematics import systematics
from twin.main_job.verdict import Reading, readings
from twin.monitor.image_quality import PLACES
from twin.path_tracing.families import family_name
from twin.run.artefact import Cell, Table, shown_unit
from twin.targets.edge_images import DIRECTION_NAMES, DIRECTIONS
from twin.targets.target_result import EdgeReading


def report_tables(run: RenderRun) -> dict[str, Table]:
    """Name -> table, of what the run has."""
    found = [_results(run), _spots(run), _residuals(run), _factors(run), _motions(run), *_parts(run)]
    found += [_disturbances(run)] if run.experiment.stated is not None else []
    return {table.name: table for table in found}


def setup_tables(setup: Mapping[str, Any]) -> dict[str, Table]:
    """What was set up, as ``report_content.setup`` tells it."""
    moved: list[list[Cell]] = [[p["node"], p["motion"], p["pivot"]] for p in setup["perturbations"]]
    keys = ("name", "model", "look", "focal", "f_number", "pixels", "pitch_um", "length_mm", "separation")
    cameras: list[list[Cell]] = [[c[key] for key in keys] for c in setup["cameras"]]
    heads = ["camera", "prescription", "look angle [deg]", "principal distance [m]", "F-number", "pixels"]
    heads += ["pitch [µm]", "line [mm]", "distance of the area CCDs [mm]"]
    tables = (_table("perturbation", ["body", "motion", "pivot"], moved), _table("cameras", heads, cameras))
    return {table.name: table for table in tables}


def _table(name: str, heads: list[str], rows: list[list[Cell]]) -> Table:
    return Table(name, name.replace("_", " "), "", heads, rows)


def _value_and_sigma(run: RenderRun, label: str) -> list[str]:
    """Of each estimator its value, the total sigma and that of the noise."""
    said = (label, " sigma", " sigma noise")
    return [f"{estimator.title}{what}" for estimator in run.estimators.values() for what in said]


def _results(run: RenderRun) -> Table:
    """One row for each change; over a course root mean squares of truth and errors over its times."""
    course = run.series is not None
    heads = ["camera", "parameter", "unit", "true rms" if course else "true"]
    heads += _value_and_sigma(run, " error rms" if course else "")
    rows: list[list[Cell]] = []
    for same in zip(*(readings(run, estimator) for estimator in run.estimators), strict=True):
        first: Reading = same[0]
        where = first.camera or ("ground" if first.parameter in GROUND else "both")
        row: list[Cell] = [where, first.parameter.symbol, first.parameter.unit, first.true]
        for one in same:
            row += [one.error if course else one.value, one.sigma, one.noise]
        rows.append(row)
    return _table("results", heads, rows)


def _shown_state(run: RenderRun) -> Table:
    """As the results, of the one state of a course that is shown in full."""
    recovered, truth = run.recovered_dict(), run.truth_dict()
    rows: list[list[Cell]] = []

    def add(where: str, p: Parameter, true: Mapping[str, float], found: Mapping[str, Mapping[str, float]]) -> None:
        row: list[Cell] = [where, p.symbol, p.unit, true[p.key]]
        for one in found.values():
            row += [one[p.key], one[f"{p.key}_sigma"], one[f"{p.key}_sigma_noise"]]
        rows.append(row)

    for camera, estimators in recovered["cameras"].items():
        for p in PARAMETERS:
            add(camera, p, truth["cameras"][camera], estimators)
    if "intersection_angle" in truth:
        add("both", ANGLE, truth["intersection_angle"], recovered["intersection_angle"])
    for p in GROUND if "ground" in truth else ():
        add("ground", p, truth["ground"], recovered["ground"])
    return _table("shown_time", ["camera", "parameter", "unit", "true", *_value_and_sigma(run, "")], rows)


def _spots(run: RenderRun) -> Table:
    pitch = 1e6 * run.experiment.path.pitch
    rows: list[list[Cell]] = []
    r = run.recovery
    for i, channel in enumerate(run.experiment.path.channels):
        for k, axis in enumerate(("row", "column")):
            before, after = float(r.before[0, i, k]), float(r.after[0, i, k])
            sigma = float(r.shift_covariance[0, 2 * i + k, 2 * i + k]) ** 0.5
            start, end = float(r.sigma_before[0, i, k]), float(r.sigma_after[0, i, k])
            row: list[Cell] = [channel.key, axis, before, start, after, end, after - before, sigma]
            rows.append([*row, (after - before) * pitch, sigma * pitch])
    heads = ["channel", "axis", "before [px]", "sigma [px]", "after [px]", "sigma [px]", "shift [px]", "sigma [px]"]
    return _table("spots", [*heads, "shift [µm]", "sigma [µm]"], rows)


def _residuals(run: RenderRun) -> Table:
    recovered, truth = run.recovered_dict()["cameras"], run.truth_dict()["cameras"]
    rows: list[list[Cell]] = []
    for name in run.crosstalk:
        bias = systematics(run, name).bias[run.judged]
        for k, p in enumerate(PARAMETERS):
            own = recovered[name][run.judged]
            error = own[p.key] - truth[name][p.key]
            expected = float(bias[k])
            sigmas = own[f"{p.key}_sigma"], own[f"{p.key}_sigma_noise"]
            rows.append([name, p.symbol, p.unit, error, *sigmas, expected, error - expected])
    title = run.estimators[run.judged].title
    heads = ["camera", "parameter", "unit", f"{title} - true", "sigma", "sigma noise", "expected from the crosstalk"]
    heads += ["left over"]
    return _table("residuals", heads, rows)


def _factors(run: RenderRun) -> Table:
    rows: list[list[Cell]] = [
        [name, f.formula, f.parameter, f.motion, float(f.by_model), float(f.by_truth)]
        for name, table in run.crosstalk.items()
        for f in table.factors
    ]
    heads = ["camera", "formula", "parameter", "motion", "of the paper's model", "of the real camera"]
    return _table("factors", heads, rows)


def _motions(run: RenderRun) -> Table:
    """Per unit of each motion: where the spots go, the true change, and every estimator's reading."""
    pitch = 1e6 * run.experiment.path.pitch
    places = list(dict.fromkeys(place for table in run.crosstalk.values() for place in table.coordinates))
    heads = ["camera", "motion", "body", "per", *(f"{place} [µm]" for place in places)]
    heads += [f"{p.symbol} [{p.unit}] true" for p in PARAMETERS]
    heads += [f"{p.symbol} [{p.unit}] {estimator.title}" for estimator in run.estimators.values() for p in PARAMETERS]
    rows: list[list[Cell]] = []
    for name, table in run.crosstalk.items():
        for k, motion in enumerate(table.motions):
            row: list[Cell] = [name, motion.label, motion.body, shown_unit(motion.unit)]
            moved = dict(zip(table.coordinates, table.spot_shift[:, k], strict=True))
            row += [float(moved[place]) * pitch if place in moved else None for place in places]
            row += [float(true) for true in table.true[:, k]]
            for estimator in run.estimators:
                row += [float(reading) for reading in table.readings[estimator][:, k]]
            rows.append(row)
    return _table("motions", heads, rows)


def _disturbances(run: RenderRun) -> Table:
    """Every component that is stated to move."""
    assert run.experiment.stated is not None
    assert run.resolved.disturbances is not None
    causes = run.resolved.disturbances.causes
    rows: list[list[Cell]] = [
        [c.cause, c.body, c.what, c.sigma / c.unit_size, shown_unit(c.unit), cause.time.text, cause.reason]
        for c in run.experiment.stated.components
        for cause in [causes[c.cause]]
    ]
    return _table("disturbances", ["cause", "body", "motion", "sigma", "unit", "in time", "reason"], rows)


def _parts(run: RenderRun) -> Iterator[Table]:
    """Of what not every run has."""
    if run.series is not None:
        yield _shown_state(run)
        yield _course(run)
    if run.stray is not None:
        yield from _stray(run)
    if run.quality is not None:
        yield _quality(run)
    if run.targets is not None:
        yield _mtf(run)


def _course(run: RenderRun) -> Table:
    """Every reading of every time."""
    assert run.series is not None
    rows: list[list[Cell]] = []
    for camera, estimators in run.series.parameters.items():
        for k, p in enumerate(PARAMETERS):
            for t, time in enumerate(run.series.times):
                row: list[Cell] = [float(time), camera, p.symbol, p.unit]
                row.append(float(run.series.truth[camera][k, t] * PER_SI[k]))
                for found in estimators.values():
                    columns = (found.vector, found.sigma, found.sigma_noise)
                    row += [float(column[t, k] * PER_SI[k]) for column in columns]
                rows.append(row)
    return _table("course", ["time [s]", "camera", "parameter", "unit", "true", *_value_and_sigma(run, "")], rows)


def _stray(run: RenderRun) -> Iterator[Table]:
    assert run.stray is not None
    after = run.stray.after
    shares = after.share(run.photons_after - after.photons)
    amounts: list[list[Cell]] = []
    rows: list[list[Cell]] = []
    for i, channel in enumerate(run.experiment.path.channels):
        name = f"{channel.key}/area_ccd"
        nominal = after.traced.runs[channel.key].nominal(name).touches
        families = [one for one in after.traced.relative(channel.key) if one[0].detector == name]
        by_kind = [sum(share for f, share, _ in families if f.kind == kind) for kind in ("ghost", "stray")]
        amounts.append([channel.key, float(shares[i]), *by_kind, float(after.photons[i].max())])
        for f, share, sigma in sorted(families, key=lambda one: -one[1]):
            x, y = (1e6 * c for c in f.centroid)
            chain = " ".join(map(str, f.touches))
            rows.append([channel.key, f.kind, family_name(f.touches, nominal), share, sigma, x, y, f.count, chain])
    heads = ["area CCD", "all / spot", "ghosts / spot", "scattered / spot", "brightest pixel [photons]"]
    yield _table("stray", heads, amounts)
    heads = ["area CCD", "kind", "name", "share of the spot", "its σ", "x [µm]", "y [µm]", "paths", "surfaces in order"]
    yield _table("stray_families", heads, rows)
    taken: list[list[Cell]] = [[o.body, o.beam, 100.0 * o.share, 100.0 * o.used] for o in run.stray.obstructions]
    yield _table("stray_prisms", ["prism", "beam", "takes [%]", "of it used by its channel [%]"], taken)


def _quality(run: RenderRun) -> Table:
    """At every field, not only at those that the report shows."""
    assert run.quality is not None
    places = {k: place for place, field in PLACES.items() for k in [run.quality.fields.index(field)]}
    rows: list[list[Cell]] = []
    for name, camera in run.quality.cameras.items():
        for s, when in enumerate(("before", "after")):
            for k, field in enumerate(run.quality.fields):
                numbers = (camera.wfe, camera.wfe_refocused, 1e6 * camera.defocus, camera.mtf_along_line)
                values = [float(n[s, k]) for n in (*numbers, camera.mtf_along_track, 1e2 * camera.light_lost)]
                rows.append([name, when, float(field), places.get(k, ""), *values])
    heads = ["camera", "state", "field", "place", "wavefront error [waves]", "at best focus [waves]"]
    heads += ["best focus - line CCD [µm]", "MTF at Nyquist along the line", "MTF at Nyquist along the track"]
    return _table("quality", [*heads, "light taken [%]"], rows)


def _mtf(run: RenderRun) -> Table:
    assert run.targets is not None
    rows: list[list[Cell]] = []
    for name, camera in run.targets.cameras.items():
        for place, targets in camera.places.items():
            for direction in DIRECTIONS:
                for when, shots in targets.shots.items():
                    for kind, reading in (("edge", shots.edges.get(direction)), ("bars", shots.bars.get(direction))):
                        if reading is None:
                            continue
                        found = reading.nyquist if isinstance(reading, EdgeReading) else reading.reading
                        value, sigma = found if found is not None else (None, None)
                        where: list[Cell] = [name, camera.band, place, DIRECTION_NAMES[direction], when, kind]
                        rows.append(
                            [*where, value, sigma, reading.true_nyquist, *reading.at_nyquist, reading.true_axis]
                        )
    heads = ["camera", "band", "place", "direction", "state", "target", "MTF at Nyquist", "sigma", "true"]
    heads += ["along the line [cycles/px]", "along the track [cycles/px]", "true on the axis"]
    return _table("mtf", heads, rows)
