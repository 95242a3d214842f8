"""Report of an optimised camera: numbers before and after, layout, wavefront error over the field, and its new file."""

from collections.abc import Callable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from optics.design.merit_function import Evaluation, Prescription, trace_beams
from optics.design.optimiser import Attempt, Design, rms_error
from scenes.models.camera_design import prescription_of
from twin.design.design_run import DESIGN, DesignRun, difference_text, verdict
from twin.framework.artefact import CameraFile, SvgFigure, Table
from twin.framework.report import Report, Section, answer
from twin.framework.svg import GREY, INK, ORANGE, look, new_figure, plain_axes, to_svg


def design_report(run: DesignRun) -> Report:
    """Return the report: numbers before and after, layout, wavefront error over the field, and the new file."""
    setup, design = run.setup, run.best
    before, after = design.before, design.after
    worst = float(after.errors.max())
    head, more = answer(
        *verdict(run).split(". "),
        difference_text(run),
        f"The worst field of {setup.test.name} has a wavefront error of {worst:.4f} waves rms "
        f"({before.errors.max():.4f} in {setup.camera.name})",
        f"its extent along the axis is {1e3 * after.envelope:.1f} mm ({1e3 * before.envelope:.1f} mm): see "
        "the fields and the clearances between beams and edges",
    )
    numbers = _numbers(before, after)
    summary = Table("merit", "The camera before and after", "", ("", "before", "after"), numbers, (None, 4, 4))
    fields = np.degrees(design.merit.beams.fields)
    by_field = Table(
        "fields",
        "Wavefront error by field",
        "Waves rms, piston and tilt removed; the other half of the field is the mirror image.",
        ("x [deg]", "y [deg]", "before", "after"),
        np.column_stack([fields, before.errors, after.errors]).tolist(),
        (3, 3, 4, 4),
    )
    changed = Table(
        "variables",
        "Variables",
        "SI units.",
        ("variable", "before", "after"),
        [
            [v.name, float(prescription_of(setup.camera).value(v)), float(design.prescription.value(v))]
            for v in design.variables
        ],
    )
    starts = Table(
        "starts",
        "Results of all starts",
        "Rms over the field and worst field, waves. The best of them is the camera above.",
        ("start", "envelope", "waves rms", "worst field", "Jacobians", "ended"),
        [_start_row(n, attempt) for n, attempt in enumerate(run.searched.attempts)],
        (None, None, 4, 4, 0, None),
    )
    names = ("scene", *design.prescription.names)
    passages = Table(
        "clearances",
        "Clearances between beams and edges",
        "Least distance in y of every stretch of the beams from the edge that it passes, in the plane of symmetry, mm.",
        ("from", "to", "passes", "before", "after"),
        [
            [names[p.segment], names[p.segment + 1], names[p.surface], 1e3 * float(b), 1e3 * float(a)]
            for p, b, a in zip(design.merit.passages, before.clearances, after.clearances, strict=True)
        ],
        (None, None, None, 1, 1),
    )
    with look("design"):
        layout = to_svg(_layout_figure(design, prescription_of(setup.camera)))
    sections = (
        Section(
            "Layout",
            ("Chief ray and edges of the beam of the middle of the field, in the plane of symmetry.",),
            (SvgFigure("layout", "Before and after", "To the same scale.", layout), passages),
        ),
        Section("Image quality", (), (by_field,)),
        Section(
            "Prescription",
            (f"{design.evaluations} Jacobians were traced. The camera's file can be used as it is.",),
            (
                starts,
                changed,
                CameraFile(setup.test.name.lower(), "The new camera", "A file for scenes/library/cameras.", run.text),
            ),
        ),
    )
    facts = (
        ("start", setup.camera.name),
        ("variables", str(len(design.variables))),
        ("starts", str(len(run.searched.attempts))),
    )
    warnings = (*run.warnings, *DESIGN.warnings(run))
    return Report(f"Design of {setup.test.name}", head, more, facts, summary, sections, warnings=warnings)


def _start_row(number: int, attempt: Attempt) -> list[str | float]:
    """Return a table row for one start of the optimisation and the design at which it ended."""
    design = attempt.design
    kind = "random" if attempt.drawn else "the camera"
    start_text = "at once" if attempt.steps == 1 else f"in {attempt.steps} steps"
    if design is None:
        return [f"{number + 1}: {kind}", start_text, "", "", "", attempt.problem.partition(";")[0]]
    ended = "converged" if design.converged else "out of iterations"
    worst = float(design.after.errors.max())
    return [f"{number + 1}: {kind}", start_text, rms_error(design.after), worst, float(design.evaluations), ended]


def _numbers(before: Evaluation, after: Evaluation) -> list[list[str | float]]:
    def row(name: str, of: Callable[[Evaluation], float]) -> list[str | float]:
        return [name, float(of(before)), float(of(after))]

    return [
        row("wavefront error, worst field [waves rms]", lambda j: j.errors.max()),
        row("wavefront error, rms over the field [waves]", lambda j: np.sqrt(np.mean(j.errors**2))),
        row("principal distance [m]", lambda j: j.principal_distance),
        row("extent along the axis [m]", lambda j: j.envelope),
        row("f along the line over f across it", lambda j: j.anamorphism),
        row("least clearance [m]", lambda j: j.clearances.min()),
    ]


def _layout_figure(design: Design, start: Prescription) -> Figure:
    """Plot the beams in the plane of symmetry, before and after, to the same scale."""
    figure = new_figure(4.4)
    axes = figure.subplots(1, 2, sharex=True, sharey=True)
    for ax, prescription, title in zip(axes, (start, design.prescription), ("before", "after"), strict=True):
        _layout(ax, design, prescription)
        ax.set_title(title)
    axes[0].set_ylabel("y [m]")
    return figure


def _layout(axes: Axes, design: Design, prescription: Prescription) -> None:
    rays = trace_beams(design.merit.backend, prescription, design.merit.beams)
    points = rays.points[..., 1:].copy()  # y, z of (K + 1, F, N)
    first, then = rays.points[0], rays.points[1]
    z = 1.25 * rays.points[1:, ..., 2].min()
    share = (z - first[..., 2]) / (then - first)[..., 2]
    points[0] = np.stack([first[..., 1] + share * (then - first)[..., 1], np.full(share.shape, z)], axis=-1)
    middle = np.flatnonzero(np.all(design.merit.beams.fields == 0.0, axis=1))[0]
    for colour, ray in ((ORANGE, 0), *((GREY, n) for n in _edges(points[1, middle]))):
        axes.plot(points[:, middle, ray, 1], points[:, middle, ray, 0], color=colour, lw=0.8)
    for k, name in enumerate(prescription.names):
        y = np.linspace(points[k + 1, ..., 0].min(), points[k + 1, ..., 0].max(), 60)
        vertex = prescription.poses[name]
        sag = prescription.surfaces[name].sag(0.0, y - vertex.y)
        axes.plot(vertex.z + sag, y, color=INK, lw=2.2)
        axes.annotate(name, (float(vertex.z + sag[-1]), float(y[-1])), (4, 4), textcoords="offset points")
    axes.set_aspect("equal")
    axes.set_xlabel("z [m]")
    plain_axes(axes)


def _edges(hits: np.ndarray) -> tuple[int, int]:
    """Return the indices of the rays of a beam with the smallest and the largest y, from N hits (x, y), (N, 2)."""
    return int(np.argmin(hits[:, 0])), int(np.argmax(hits[:, 0]))
