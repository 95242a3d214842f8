"""What the report says of what was set up: instrument, estimators, cameras, stated motions, perturbations."""

from __future__ import annotations

import numpy as np

from analysis.arrays import ARCSEC
from analysis.spots import CENTROIDS
from optics.geometry.tree import Motion
from optics.thermal.heat import Temperature
from scenes.models.job_state import motions_of
from scenes.specs.disturbances import JOINT
from scenes.specs.perturbation import in_words
from twin.framework.artefact import MINUS, Cell, Table, fixed, plain, shown_unit
from twin.framework.report import Section
from twin.main_job.render_results import JobRun, RenderRun
from twin.main_job.result_sections import IN_PAGE

_PAPER = "Wang et al., Acta Photonica Sinica 47(10) 1012001 (2018), doi 10.3788/gxzb20184710.1012001"
_BUILT = "The nominal state is the instrument as built: frames before, and changes, are those about it."
ZERO_CELSIUS = 273.15


def facts(run: JobRun) -> tuple[tuple[str, str], ...]:
    """What was set up, and what the estimators assume."""
    resolved, instrument = run.resolved, run.experiment.instrument
    spec, stated = resolved.instrument, run.experiment.stated is not None
    own = ("Instrument", f"{spec.name}: {spec.description}" if spec.description else spec.name)
    built = () if not spec.as_built else (("As built", f"{in_words(spec.as_built)}. {_BUILT}"),)
    free = (
        "Structures expand freely and carry the bodies on them, mirrors and prisms bend (finite elements), and glass "
    )
    free += "changes its index."
    if not isinstance(run, RenderRun):
        without = "The instrument has no monitor: changes are those of the exact trace, and nothing is measured."
        return ("Assumptions", f"{without} {free}"), own, *built
    monitor, ccd, bits = spec.autocollimator, spec.autocollimator.area_ccd, resolved.area_detector.bit_depth
    fields = [float(np.degrees(one.field)) for name in spec.cameras for one in spec.channels_of(name).values()]
    family = "; ".join(e.title for e in run.estimators.values() if not e.stated)
    judged = run.estimators[run.judged].title
    about = (
        "These estimators assume shifts of the line CCD along X and Y, its turn about Z and a scale of the whole "
        f"optics: {family}. They read any other motion as a mixture of these, an error that more frames do not reduce "
        "(Residuals, Crosstalk). "
        + (
            f"σ covers this error for motions of the prior. The {judged} weighs them against the noise. "
            if stated
            else ""
        )
        + free
    )
    return (
        ("Assumptions", about),
        *((estimator.title, estimator.note) for estimator in run.estimators.values()),
        ("Paper", _PAPER),
        own,
        *built,
        (
            "Monitor",
            f"{plain(1e9 * monitor.wavelength)} nm, pinhole {plain(1e6 * monitor.reticle.pinhole)} µm, return face "
            f"{_all([1e3 * c.aperture for c in instrument.channels])} mm wide, area CCDs at {_fields(fields)}° of "
            "field",
        ),
        (
            "Area CCD",
            f"{ccd.rows} × {ccd.columns} pixels of {plain(1e6 * ccd.pitch)} µm, {bits} bits, "
            f"exposure {plain(1e3 * ccd.exposure)} ms",
        ),
        (
            "Light",
            f"{_all([1e-6 * c.photons for c in instrument.channels])} million photons per spot and frame expected at "
            "the CCD",
        ),
        ("Frames", f"{run.frames} before and {run.frames} after, seed {run.seed}"),
        ("Spot centres", CENTROIDS[resolved.job.analysis.centroid].title),
    )


def _all(values: list[float]) -> str:
    """Different values among those of all channels: ``50``, or ``34, 24``."""
    return ", ".join(dict.fromkeys(plain(value) for value in values))


def _fields(degrees: list[float]) -> str:
    """Different field places: ``±1.22``, or ``±1.22, 1.25`` where one end of the line has more than the other."""
    ends: dict[str, set[bool]] = {}
    for field in degrees:
        ends.setdefault(plain(abs(field)), set()).add(field > 0.0)
    signs = {frozenset((True, False)): "±", frozenset((True,)): "", frozenset((False,)): MINUS}
    return ", ".join(signs[frozenset(own)] + size for size, own in ends.items())


def setup_section(run: JobRun) -> Section:
    """The cameras, and cause by cause what is stated to move."""
    spec, instrument = run.resolved.instrument, run.experiment.instrument
    rows: list[list[Cell]] = []
    for name, model in instrument.cameras.items():
        focal, line = float(run.experiment.nominal_truth.principal_distance[name]), model.spec.line
        row: list[Cell] = [name, model.spec.name, float(np.degrees(spec.cameras[name].look)), focal]
        f_number = model.paraxial.focal_length / model.entrance_pupil
        row += [f_number, line.pixels, 1e6 * line.pitch, 1e3 * line.pixels * line.pitch]
        rows.append([*row, 1e3 * float(instrument.separation[name])] if instrument.channels else row)
    heads = ["camera", "prescription", "look angle [deg]", "principal distance [m]", "F-number", "pixels"]
    heads += ["pitch [µm]", "line [mm]", *(["distance of the area CCDs [mm]"] if instrument.channels else [])]
    decimals = (None, None, 2, 4, 1, None, None, 1, 2)[: len(heads)]
    cameras = Table("cameras", "Cameras", "", heads, rows, decimals, within=IN_PAGE)
    stated = () if run.experiment.stated is None else (_stated(run),)
    title = "Cameras, and the prior on disturbances" if stated else "Cameras"
    return Section(title, (), (*stated, cameras), closed=True)


def _stated(run: JobRun) -> Table:
    motions, spec = run.experiment.stated, run.resolved.disturbances
    assert motions is not None
    assert spec is not None
    rows: list[list[Cell]] = []
    full: list[list[Cell]] = []
    for name, cause in spec.causes.items():
        own = [c for c in motions.components if c.cause == name]
        bodies = list(dict.fromkeys(c.body for c in own))
        sizes: dict[tuple[str, str], list[str]] = {}
        for c in own:
            amount = c.sigma / c.unit_size
            full.append([name, c.body, c.what, amount, shown_unit(c.unit), cause.time.text, cause.reason])
            if c.body == bodies[0]:
                size = f"{plain(amount)} {shown_unit(c.unit)}"
                sizes.setdefault((c.kind, size), []).append(c.what.removeprefix(c.kind).strip())
        what = []
        for (kind, size), axes in sizes.items():
            which = "" if axes in (["x", "y", "z"], [""]) else f" {', '.join(axes)}"
            what.append(f"{kind.replace('_', ' ')}{which} {size}")
        if cause.together is not None:
            what.append(f"bodies together {plain(cause.together)}")
        if cause.correlations:
            what.append(f"{len(cause.correlations)} correlations")
        which = f"{len(bodies)}: `{', '.join(cause.bodies)}`"
        rows.append([name.replace("_", " "), which, "; ".join(what), cause.time.text, cause.reason])
    if (joint := spec.joint) is not None:
        own = [c for c in motions.components if c.cause == JOINT]
        for c in own:
            amount = c.sigma / c.unit_size
            full.append([JOINT, c.body, c.what, amount, shown_unit(c.unit), joint.time.text, joint.reason])
        bodies = list(dict.fromkeys(c.body for c in own))
        which = f"{len(bodies)}: `{', '.join(bodies[:3])}`" + (", ..." if len(bodies) > 3 else "")
        rows.append([JOINT, which, f"{len(own)} components, one by one", joint.time.text, joint.reason])
    heads = ["cause", "body", "motion", "sigma", "unit", "in time", "reason"]
    return Table(
        "disturbances",
        f"Prior on disturbances, {spec.name}: one standard deviation of each component of each body",
        f"{spec.description.strip()} Component by component." if spec.description else "Component by component.",
        ("Cause", "Bodies", "One standard deviation", "In time", "Reason"),
        rows,
        within=IN_PAGE,
        full=Table("disturbances", "Disturbances", "", heads, full),
    )


def done_table(run: JobRun) -> Table:
    """What the job does to each node, at the time that is shown; not what follows from it for other bodies."""
    job = run.resolved.job
    shown = _shown(run)
    motions, fields = motions_of(job, shown), job.fields(shown)
    rows: list[list[Cell]] = []
    for path in dict.fromkeys((*motions, *fields)):
        motion, given = motions.get(path, Motion()), job.perturb.get(path)
        warm = given is not None and given.heat.table is not None
        parts = [_motion_text(motion)]
        if path in fields and not (warm and fields[path] == Temperature()):
            parts.append(_heat_text(fields[path]))
        if given is not None and given.deformation is not None:
            parts.append("deformed by a table of nodes")
        if warm:
            parts.append("warmed by a table of nodes")
        rows.append([path, "; ".join(filter(None, parts)) or "nothing (all zero)", motion.pivot])
    heated, caption = _heated(run), "In each body's own frame: rotation vector about the pivot, then shift."
    if heated:
        caption += (
            f" A temperature is the change from {fixed(run.resolved.instrument.temperature - ZERO_CELSIUS, 2)} °C at "
            "the body's origin plus gradient · r; what the body carries has the same field unless it stands here "
            f"itself. {heated} bodies are at other temperatures than nominal."
        )
    return Table("perturbation", "", caption, ("body", "motion", "pivot"), rows, within=IN_PAGE)


def _shown(run: JobRun) -> int | None:
    """Number of the time of a course that is shown; None without one."""
    return run.series.shown if isinstance(run, RenderRun) and run.series is not None else None


def _heated(run: JobRun) -> int:
    """How many bodies have another temperature than nominal, faces of prisms not counted."""
    job = run.resolved.job
    time = _shown(run)
    fields = run.experiment.thermal.fields(run.experiment.fields(job, time))
    return sum(path in run.experiment.thermal.materials and field != Temperature() for path, field in fields.items())


def _motion_text(motion: Motion) -> str:
    parts = []
    for name, vector, unit, size in (("rotate", motion.rotate, "arcsec", ARCSEC), ("shift", motion.shift, "µm", 1e-6)):
        if any(vector):
            parts.append(f"{name} ({', '.join(plain(v / size) for v in vector)}) {unit}")
    if motion.scale:
        parts.append(f"scale {plain(1e6 * motion.scale)} ppm")
    terms = [f"Z{j} {plain(1e9 * a)} nm" for j, a in motion.figure.items() if a]
    if terms:
        parts.append(f"figure {', '.join(terms)}")
    return "; ".join(parts)


def _heat_text(field: Temperature) -> str:
    text = f"temperature {plain(field.change)} K"
    if any(field.gradient):
        text += f", gradient ({', '.join(plain(1e3 * g) for g in field.gradient)}) mK/m"
    return text
