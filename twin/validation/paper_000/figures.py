"""Paper 000's Figs. 3 to 5: what the text says of them, sentence by sentence, and the number that decides each.

The paper's words have no numbers: "far more" is taken as at least twice, "very near" as within a quarter, "little" as
at most a quarter of the largest, and a slope that grows as one that grows by 5 %, the least that shows in a figure.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from analysis.arrays import ARCSEC, Array
from analysis.orbit.planes import Method, Sensitivity, Strip, intersection_angles, sensitivity
from optics.numerics.backend import one_blas_thread
from twin.orbit.angle.angle_flight import AnglePass, Measurement
from twin.run.svg import BLUE, GREEN, GREY, INK, LIGHT, VERMILION, look, new_figure, plain_axes, to_svg
from twin.validation.checks.check import Check, CheckResult, Chosen, Supposed, mean_of
from twin.validation.checks.group import Context, group_of, load_printed
from twin.validation.paper_000.passes import TEST, Passes, planes_of, repeated, setup_of

Kind = Literal["signs", "largest", "far", "alike", "little", "grows", "opposite"]
Angle = Literal["alpha", "beta"]
Rises = Mapping[tuple[str, Angle, str], float]
"""(what is moved, angle, axis) -> change of the angle for 10 m, arcsec."""
AXES = ("x", "y", "z")
FAR, ALIKE, LITTLE, GROWS = 2.0, 1.25, 0.25, 0.05
GREEK: Mapping[str, str] = {"alpha": "α", "beta": "β"}
_STYLES = {"x": (BLUE, "o"), "y": (GREEN, "s"), "z": (VERMILION, "^")}
REACH = 10.0
"""Metres."""
ELSEWHERE = (45.0, 120.0)
"""Latitude and longitude, degrees, of a pass on which what the paper says of place-dependent sizes holds."""
PANELS = {
    "fig3": (("station", "alpha"), ("station", "beta")),
    "fig4": (("forward", "alpha"), ("nadir", "alpha")),
    "fig5": (("nadir", "beta"), ("backward", "beta")),
}
TITLES = {
    "fig3": "Fig. 3 again: errors of the station",
    "fig4": "Fig. 4 again: errors of the forward and nadir points in α",
    "fig5": "Fig. 5 again: errors of the nadir and backward points in β",
}


@dataclass(frozen=True)
class Sentence:
    """One statement of the text: how `angle` answers when `what` is moved.

    Attributes:
        name: of the row, without the paper.
        kind: what is said.
        what: "station", or the line whose points move.
        angle: of which it is said.
        axes: of which it is said; for signs those along which the angle rises.
        others: with which they are compared; for signs those along which it falls.
    """

    name: str
    kind: Kind
    what: str
    angle: Angle
    axes: tuple[str, ...]
    others: tuple[str, ...] = ()

    @property
    def row(self) -> Check:
        """What is compared."""
        return load_printed("000").groups["000.figures"].rows[f"000.{self.name}"]

    @property
    def implied(self) -> float:
        """What the sentence asks of `measure`."""
        return {
            "signs": 0.0, "largest": 1.0, "far": FAR, "alike": ALIKE, "little": LITTLE, "grows": GROWS, "opposite": 1.0,
        }[self.kind]  # fmt: skip

    def measure(self, rises: Rises, growth: Rises) -> float:
        """The number that decides; growth: relative growth of the slopes, by the same keys."""

        def rise(axis: str, angle: Angle = self.angle) -> float:
            return rises[self.what, angle, axis]

        size = {axis: abs(rise(axis)) for axis in AXES}
        if self.kind == "signs":
            return min([rise(axis) for axis in self.axes] + [-rise(axis) for axis in self.others])
        if self.kind in ("largest", "far"):
            return min(size[axis] for axis in self.axes) / max(size[axis] for axis in self.others)
        if self.kind == "alike":
            return max(size[axis] for axis in self.axes) / min(size[axis] for axis in self.axes)
        if self.kind == "little":
            return max(size[axis] for axis in self.axes) / max(size[axis] for axis in self.others)
        if self.kind == "grows":
            return min(growth[self.what, self.angle, axis] for axis in AXES)
        return max((-rise(axis, "beta") / rise(axis, "alpha") for axis in AXES), key=lambda ratio: abs(ratio - 1.0))

    def holds(self, rises: Rises, growth: Rises) -> bool:
        """Whether the number says so, as the row compares it."""
        return self.row.outside(self.measure(rises, growth), self.implied) <= self.row.tolerance


YZ, XZ, XY = ("y", "z"), ("x", "z"), ("x", "y")
SENTENCES: tuple[Sentence, ...] = (
    Sentence("fig3.alpha_signs", "signs", "station", "alpha", ("x",), YZ),
    Sentence("fig3.beta_signs", "signs", "station", "beta", ("x",), YZ),
    Sentence("fig3.alpha_largest", "largest", "station", "alpha", ("z",), XY),
    Sentence("fig3.beta_largest", "largest", "station", "beta", ("y",), XZ),
    Sentence("fig3.alpha_growth", "grows", "station", "alpha", AXES),
    Sentence("fig3.beta_growth", "grows", "station", "beta", AXES),
    Sentence("fig4.forward_alike", "alike", "forward", "alpha", XZ),
    Sentence("fig4.forward_signs", "signs", "forward", "alpha", ("y",), XZ),
    Sentence("fig4.forward_y", "far", "forward", "alpha", ("y",), XZ),
    Sentence("fig4.nadir_signs", "signs", "nadir", "alpha", XZ, ("y",)),
    Sentence("fig4.nadir_yz", "largest", "nadir", "alpha", YZ, ("x",)),
    Sentence("fig5.nadir_signs", "signs", "nadir", "beta", ("y",), XZ),
    Sentence("fig5.nadir_yz", "far", "nadir", "beta", YZ, ("x",)),
    Sentence("fig5.aft_signs", "signs", "backward", "beta", ("z",), ("y",)),
    Sentence("fig5.aft_x", "little", "backward", "beta", ("x",), YZ),
    Sentence("fig5.aft_largest", "largest", "backward", "beta", ("z",), XY),
    Sentence("fig5.opposite", "opposite", "nadir", "alpha", AXES),
)


def sensitivity_svg(
    amount: NDArray[np.float64],
    change: Mapping[tuple[str, str, str], NDArray[np.float64]],
    panels: Sequence[tuple[str, str]],
) -> str:
    """A panel for each (what is moved, angle): a curve for each axis, arcsec over metres."""
    with look(f"sensitivity-000-{panels[0][0]}-{panels[1][0]}"):
        figure = new_figure(3.3)
        for axes, (what, angle) in zip(figure.subplots(1, 2, sharey=True), panels, strict=True):
            axes.axhline(0.0, color=GREY, lw=0.8)
            ends = {}
            for axis, (colour, mark) in _STYLES.items():
                curve = change[what, angle, axis]
                ends[axis] = float(curve[-1])
                axes.plot(amount, curve, color=colour, marker=mark, ms=3.5, lw=1.4)
            low, high = min(0.0, *ends.values()), max(0.0, *ends.values())
            for axis, place in _apart(ends, 0.07 * (high - low)).items():
                axes.annotate(
                    axis, (amount[-1], place), (6, 0), textcoords="offset points", va="center", color=_STYLES[axis][0]
                )
            moved = "station" if what == "station" else f"{what} points"
            axes.set(title=f"{GREEK[angle]} over the error of the {moved}", xlabel="error, m")
            axes.margins(x=0.06)
            axes.grid(color=LIGHT, lw=0.5)
            plain_axes(axes)
        figure.axes[0].set_ylabel("change of the angle, arcsec")
        return to_svg(figure)


def _apart(ends: Mapping[str, float], least: float) -> dict[str, float]:
    """Places of labels that do not overlap."""
    out: dict[str, float] = {}
    last = -np.inf
    for axis, value in sorted(ends.items(), key=lambda item: item[1]):
        last = max(value, last + least)
        out[axis] = last
    return out


def places_svg(held: Mapping[tuple[float, float], int], total: int, marked: Mapping[str, tuple[float, float]]) -> str:
    """How many sentences hold by (latitude, longitude), degrees."""
    with look("places-000"):
        figure = new_figure(3.6)
        axes = figure.subplots()
        lat, lon = (np.unique([place[k] for place in held]) for k in (0, 1))
        grid = np.array([[held[a, b] for b in lon] for a in lat])
        mesh = axes.pcolormesh(
            lon, lat, grid, cmap="cividis", vmin=grid.min() - 0.5, vmax=total + 0.5, shading="nearest"
        )
        for a in lat:
            for b in lon:
                shade = (held[a, b] - grid.min()) / (total - grid.min())
                axes.text(
                    b, a, str(held[a, b]), ha="center", va="center", fontsize=8, color="white" if shade < 0.55 else INK
                )
        for place in marked.values():
            axes.plot(place[1], place[0], "o", ms=19, mfc="none", mec=VERMILION, mew=1.8)
        axes.set(xlabel="longitude, ° E", ylabel="latitude, ° N")
        figure.colorbar(mesh, ax=axes, label=f"sentences that hold, of {total}")
        plain_axes(axes)
        return to_svg(figure)


@dataclass(frozen=True, eq=False)
class Answers:
    """Curves of one measurement, by planes fitted anew.

    Attributes:
        amount: (k,) metres.
        change: (what is moved, angle, axis) -> (k,), arcsec.
    """

    amount: Array
    change: Mapping[tuple[str, str, str], Array]

    @classmethod
    def of(cls, table: Sequence[Sensitivity]) -> Answers:
        """From the rows for every thing that is moved along every axis."""
        change = {
            (row.what, angle, row.axis): row.change[k] / ARCSEC for row in table for k, angle in enumerate(row.angles)
        }
        return cls(table[0].amount, change)

    @property
    def rises(self) -> Rises:
        """At the end."""
        return {key: float(change[-1]) for key, change in self.change.items()}  # type: ignore[misc]

    @property
    def growth(self) -> Rises:
        """Growth of the steepness from the first to the last step, relative."""
        out = {}
        for key, change in self.change.items():
            slope = np.abs(np.diff(change))
            out[key] = float(slope[-1] / slope[0] - 1.0) if slope[0] > 0 else 0.0
        return out  # type: ignore[return-value]


def make_passes(
    context: Context, place: tuple[float, float] | None = None, count: int | None = None, direction: str = "descending"
) -> Passes:
    """Measurements at the place of the library's test, or at another (latitude, longitude), degrees."""
    at: dict[str, object] = {"direction": direction}
    if place is not None:
        at |= {"latitude": np.radians(place[0]), "longitude": np.radians(place[1])}
    many = context.count(full=60, fast=10) if count is None else count
    return repeated(setup_of(TEST, **at), np.random.SeedSequence([context.seed, 8]), many)


def answers(measured: Measurement, flight: AnglePass, steps: int = 10, method: Method = "corrected") -> Answers:
    """All planes fitted anew for every move."""
    amount = np.linspace(0.0, REACH, steps + 1)
    return Answers.of(sensitivity(measured.station, measured.strips, flight.pairs, method=method, amounts=amount))


@one_blas_thread()
def run(context: Context) -> Iterator[CheckResult]:
    """All checks of the group."""
    context.progress(0.0, "move station and points")
    passes = make_passes(context)
    found = [answers(m, passes.flight) for m in passes.measured]
    context.progress(0.4, "the same elsewhere")
    there = make_passes(context, ELSEWHERE, 1)
    other = answers(there.measured[0], there.flight)
    places = _places(context)
    for sentence in SENTENCES:
        if sentence.row.id in context.selected:
            yield _row(sentence, passes, found, other, places)
    if "000.fig3.ordinate" in context.selected:
        yield _ordinate(context, found, places)
    if "000.fig4.single" in context.selected:
        yield _single(context, passes)
    context.progress(0.9, "draw")
    _show(context, found[0], places)


def _row(
    sentence: Sentence,
    passes: Passes,
    found: list[Answers],
    other: Answers,
    places: Mapping[tuple[float, float], Answers],
) -> CheckResult:
    values = np.array([sentence.measure(a.rises, a.growth) for a in found])
    mean = {axis: np.mean([a.rises[sentence.what, sentence.angle, axis] for a in found]) for axis in AXES}
    place = _place(sentence, places)
    lat, lon = ELSEWHERE
    how = (
        f"{len(found)} measurements of a descending pass over 40° N 116° E, Earth-fixed axes, planes fitted anew for "
        f"every metre. Change for 10 m: {', '.join(f'{axis} {v:+.3f}″' for axis, v in mean.items())}. The paper does "
        f"not print the place: the sentence {place.said}; at {lat:g}° N {lon:g}° E the number is "
        f"{sentence.measure(other.rises, other.growth):.3g}."
    )
    value, sigma = (float(values[0]), None) if sentence.kind == "grows" else mean_of(values)
    inputs = [place] if sentence.row.basis == "chosen" else []
    return sentence.row.evaluate(
        value, sigma, how, sentence.implied, _explained(sentence, passes, other), inputs,
        facts={"north": lat, "east": lon, "alike": ALIKE},
    )  # fmt: skip


def _place(sentence: Sentence | None, places: Mapping[tuple[float, float], Answers]) -> Supposed:
    """Where a sentence holds, or all of those on signs."""
    sentences = [sentence] if sentence else [s for s in SENTENCES if s.kind == "signs"]
    held = sum(all(s.holds(a.rises, a.growth) for s in sentences) for a in places.values())
    text = f"holds at {held} of {len(places)} places from 25° to 50° N and 80° to 130° E"
    return Supposed("a descending pass over 40° N 116° E", text)


def _explained(sentence: Sentence, passes: Passes, other: Answers) -> list[float]:
    """Value that the reason of the row gives, where there is one."""
    if sentence.kind == "grows":
        return [REACH / float(np.linalg.norm(passes.flight.station - passes.flight.middle_point))]
    if sentence.kind == "alike" and sentence.holds(other.rises, other.growth):
        normal = np.abs(passes.normal("forward"))
        return [float(normal[2] / normal[0])]
    return []


def _ordinate(context: Context, found: list[Answers], places: Mapping[tuple[float, float], Answers]) -> CheckResult:
    signs = [s for s in SENTENCES if s.kind == "signs"]
    flipped = [{key: -v for key, v in a.rises.items()} for a in found]
    share = np.mean([s.holds(a.rises, a.growth) for s in signs for a in found])
    other = np.mean([s.holds(r, a.growth) for s in signs for r, a in zip(flipped, found, strict=True)])
    how = (
        f"{len(signs)} sentences with {sum(len(s.axes + s.others) for s in signs)} signs on {len(found)} "
        "measurements. Read off the ordinate, resection minus planes, "
        f"where the resection stays, the share is {other:.2f}: the figures' curves fall where the text says that the "
        "angle rises."
    )
    return context.check("000.fig3.ordinate").evaluate(float(share), None, how, 1.0, inputs=[_place(None, places)])


def _single(context: Context, passes: Passes) -> CheckResult:
    m = passes.measured[0]
    base = intersection_angles(*planes_of(m, "corrected")).values[0]
    shift = np.array([0.0, REACH, 0.0])

    def moved(strip: Strip) -> float:
        other = {**m.strips, "forward": strip}
        planes = planes_of(replace(m, strips=other), "corrected")
        return float(intersection_angles(*planes).values[0] - base)

    forward = m.strips["forward"]
    whole = moved(forward.shifted(shift))
    each = []
    for k in range(len(forward.points)):
        points = forward.points.copy()
        points[k] += shift
        each.append(moved(Strip(points, forward.covariance)))
    value = float(np.max(np.abs(each)) / abs(whole))
    how = (
        f"One of {len(each)} forward points is moved by 10 m in y, every one in turn: at most "
        f"{np.max(np.abs(each)) / ARCSEC:.3f}″, all together {whole / ARCSEC:.2f}″. With n points the share is about "
        "1/n, and the paper does not print n."
    )
    count = Chosen.power("points on a line", float(len(each)), "1", value, -1.0)
    return context.check("000.fig4.single").evaluate(value, None, how, 0.0, inputs=[count])


def _places(context: Context) -> dict[tuple[float, float], Answers]:
    """(latitude, longitude), degrees -> answers of one measurement there."""
    step = 5.0 if context.fast else 2.5
    out = {}
    grid = [(lat, lon) for lat in np.arange(25.0, 50.1, step) for lon in np.arange(80.0, 130.1, 2.0 * step)]
    for k, place in enumerate(grid):
        if k % 10 == 0:
            context.progress(0.4 + 0.45 * k / len(grid), "the same elsewhere")
        passes = make_passes(context, place, 1)
        out[place] = answers(passes.measured[0], passes.flight, 2)
    return out


def _readings(context: Context) -> list[tuple[str, str, int, int]]:
    """Frame and direction of the pass -> how many sentences hold of the angle, and of the figures' ordinate."""
    rows = []
    for direction in ("descending", "ascending"):
        passes = make_passes(context, count=1, direction=direction)
        flight, (m,) = passes.flight, passes.measured
        frames = {
            "Earth-fixed": m,
            "east, north, up": m.in_frame(flight.local, flight.middle_point),
            "forward, right, down": m.in_frame(flight.orbital, flight.station),
        }
        for frame, seen in frames.items():
            # two of the frames have a nearly vertical plane
            a = answers(seen, flight, 2, "tls")
            minus = {key: -value for key, value in a.rises.items()}
            counts = [sum(s.holds(r, a.growth) for s in SENTENCES) for r in (a.rises, minus)]
            rows.append((frame, direction, counts[0], counts[1]))
    return rows


def _show(context: Context, shown: Answers, places: Mapping[tuple[float, float], Answers]) -> None:
    for name, panels in PANELS.items():
        context.figure(
            name,
            TITLES[name],
            "Change of the angle by planes when one coordinate is wrong by 0 to 10 m, Earth-fixed axes, one "
            "measurement. The paper's ordinate, resection minus planes, is minus this but for a constant.",
            sensitivity_svg(shown.amount, shown.change, panels),
        )
    held = {place: sum(s.holds(a.rises, a.growth) for s in SENTENCES) for place, a in places.items()}
    context.figure(
        "places",
        "Where the paper's pass can have been",
        f"How many of the {len(SENTENCES)} sentences on Figs. 3 to 5 hold on a descending pass, by its place; the "
        "two on growing slopes hold nowhere. Circles: 40° N 116° E, where the checks are made, and 45° N 120° E.",
        places_svg(held, len(SENTENCES), {"test": (40.0, 116.0), "elsewhere": ELSEWHERE}),
    )
    context.table(
        "readings",
        "What x, y and z can mean",
        f"How many of the {len(SENTENCES)} sentences hold over 40° N 116° E; the paper names neither frame "
        "nor direction.",
        ("axes", "pass", "of the angle", "of the figures' ordinate"),
        _readings(context),
        (None, None, 0, 0),
    )
    rows = [
        (what, axis, *(float(shown.rises[what, angle, axis]) for angle in ("alpha", "beta")))
        for what in ("station", "forward", "nadir", "backward")
        for axis in AXES
    ]
    context.table(
        "changes",
        "Change of the angles for 10 m",
        "One measurement at 40° N 116° E, planes fitted anew; Earth-fixed axes.",
        ("moved", "axis", "α, arcsec", "β, arcsec"),
        rows,
        (None, None, 3, 3),
    )


GROUP = group_of("000.figures", run)
