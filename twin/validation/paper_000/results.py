"""Checks of the results of paper 000 (Liu and Huang 2014).

They are Table 1, planes against resection, and the statements about Figs. 3 to 5.

Each statement of the text is decided by a number. The paper describes the figures in words only: "far more" is taken as
at least twice, "very near" as within a quarter, "little" as at most a quarter of the largest, and a slope that grows as
one that grows by 5 %, the smallest change that is visible in a figure.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np
from matplotlib.figure import Figure

from analysis.arrays import ARCSEC, Array
from analysis.orbit.planes import Method, Sensitivity, Station, Strip, intersection_angles, sensitivity
from optics.numerics.backend import one_blas_thread
from scenes.specs.orbit.angle import LINES
from twin.framework.svg import BLUE, GREEN, GREY, INK, LIGHT, ORANGE, VERMILION
from twin.orbit.angle.angle_flight import AnglePass, Measurement
from twin.orbit.angle.angle_run import effect_rows, values_of
from twin.validation.check import SIGMAS, Check, CheckResult, Chosen, Supposed, mean_of
from twin.validation.group import Context, drawing, group_of, load_printed
from twin.validation.paper_000.method import PAIRS, TEST, Passes, planes_of, repeated, setup_of

PRINTED_ARCSEC = load_printed("000").numbers("table1.difference_arcsec")
ALPHA, BETA = PRINTED_ARCSEC["alpha"], PRINTED_ARCSEC["beta"]
POINT_SIGMA = float(np.hypot(2.0, 5.0 / 3.0))
"""Standard deviation of a ground point, metres.

It combines a control point's error of 2 m with a matching error of a third of a pixel of 5 m.
"""

POINTS = float(setup_of(TEST).test.strips.points)
"""Number of ground points on each line."""

LIMIT = 3.44
"""Radius, in sigmas, that contains 99.7 % of a two-dimensional normal distribution.

It corresponds to three standard deviations in one dimension.
"""


@drawing("table1-000", 4.2)
def differences_svg(figure: Figure, same: Array, independent: Array, printed: tuple[float, float]) -> None:
    """Draw the differences of alpha and beta as points, both arrays (passes, 2) in arcsec, and the printed pair."""
    axes = figure.subplots()
    axes.axhline(0.0, color=LIGHT, lw=0.8, zorder=0)
    axes.axvline(0.0, color=LIGHT, lw=0.8, zorder=0)
    axes.plot(
        *independent.T, "o", color=ORANGE, ms=3.5, mew=0, alpha=0.7, label="points of their own, light left in planes"
    )
    axes.plot(*same.T, "s", color=BLUE, ms=3.0, mew=0, label="same points, light corrected in both")
    label = f"printed: {printed[0]}″, {printed[1]}″"
    axes.plot(*printed, "D", color=VERMILION, ms=8, mec=INK, mew=0.8, label=label)
    axes.plot(*(-v for v in printed), "D", color="none", ms=8, mec=VERMILION, mew=1.4, label="printed, other sign")
    axes.set_aspect("equal")
    axes.set(xlabel="α: resection − planes, arcsec", ylabel="β: resection − planes, arcsec")
    axes.set(xlim=(-2.0, 2.0), ylim=(-2.0, 2.3))
    axes.legend(loc="center left", bbox_to_anchor=(1.02, 0.5))


@dataclass(frozen=True, eq=False)
class Differences:
    """Angles alpha and beta by resection minus those by planes, and the sigma that each method reports.

    The angles are those between the cameras' lines. The differences are a (passes, 2) array and the sigmas (2,), in
    arcsec.
    """

    values: Array
    planes_sigma: Array
    resection_sigma: Array

    @property
    def spread(self) -> Array:
        """Standard deviation of the differences of alpha and of beta over the passes, (2,), arcsec."""
        return np.asarray(np.std(self.values, axis=0, ddof=1))


def differences(planes: Passes, resection: Passes) -> Differences:
    """Return the differences of the angles by the two methods, each from its measurements, which may be the same."""
    by_planes = [intersection_angles(*planes_of(m, "tls")) for m in planes.measured]
    resected = np.array([section.angles(PAIRS) for section in resection.sections])
    claimed = [section.angle_covariance(PAIRS) for section in resection.sections]
    return Differences(
        (resected - np.array([a.values for a in by_planes])) / ARCSEC,
        np.sqrt(np.mean([np.diag(a.covariance) for a in by_planes], axis=0)) / ARCSEC,
        np.sqrt(np.mean([np.diag(c) for c in claimed], axis=0)) / ARCSEC,
    )


@dataclass(frozen=True, eq=False)
class Data:
    """Simulated measurements for Table 1, which compares planes and resection.

    Attributes
    ----------
    same : Passes
        Measurements of ground points with 1.5 m error, light effects removed, for both methods.
    passes : Passes
        Measurements of ground points with an error of `POINT_SIGMA`, light effects removed, for the resection.
    light : Passes
        Further measurements with the same projection centres and the light effects left in, for the planes.
    """

    same: Passes
    passes: Passes
    light: Passes


def make_data(context: Context) -> Data:
    """Simulate all measurements for Table 1."""
    count = context.count(full=800, fast=120)
    first, second, third = np.random.SeedSequence([context.seed, 5]).spawn(3)
    setup = setup_of(TEST, points=POINT_SIGMA)
    independent = repeated(setup, second, count)
    repeats = repeated(setup, third, count, corrected=False)
    # one precise orbit for both methods
    moved = tuple(_at(m, o.station.position) for m, o in zip(repeats.measured, independent.measured, strict=True))
    return Data(repeated(setup_of(TEST), first, count), independent, Passes(repeats.flight, moved))


def _at(measured: Measurement, site: Array) -> Measurement:
    return replace(measured, station=replace(measured.station, position=site))


@one_blas_thread()
def run_table_1(context: Context) -> Iterator[CheckResult]:
    """Yield the results of all checks of Table 1 of paper 000 (Liu and Huang 2014)."""
    context.progress(0.1, "measure ground points for both methods")
    data = make_data(context)
    same, independent = differences(data.same, data.same), differences(data.light, data.passes)
    for k, (name, printed) in enumerate(PRINTED_ARCSEC.items()):
        sigma = float(same.spread[k])
        variance = same.planes_sigma[k] ** 2 - same.resection_sigma[k] ** 2
        noise = sigma / np.sqrt(2.0 * (len(same.values) - 1))
        facts: dict[str, Any] = {
            "same": same,
            "both": [same.planes_sigma[k], same.resection_sigma[k]],
            "printed": printed,
        }
        facts["times"] = printed / sigma
        yield context.row(f"000.table1.{name}", sigma, noise, float(np.sqrt(max(variance, 0.0))), **facts)
    for k, name in enumerate(PRINTED_ARCSEC):
        bias, spread, count = (
            float(np.mean(independent.values[:, k])),
            float(independent.spread[k]),
            len(independent.values),
        )
        noise = spread * np.sqrt(1.0 / count + SIGMAS**2 / (2.0 * (count - 1)))
        exceedance = partial(_exceedance, abs(bias), SIGMAS * spread)
        facts = {"independent": independent, "point": POINT_SIGMA, "bias": bias, "spread": spread}
        yield context.row(f"000.table1.{name}_own", exceedance(1.0), noise, inputs=_points(exceedance), **facts)
    yield _pair(context, data, independent)
    yield from _accuracy(context, data)
    context.progress(0.9, "draw")
    context.figure("table1", differences_svg(same.values, independent.values, (ALPHA, BETA)), point=POINT_SIGMA)


def _exceedance(bias: float, spread: float, factor: float) -> float:
    return bias + factor * spread


def _rms(bias: float, spread: float, factor: float) -> float:
    return float(np.hypot(bias, factor * spread))


def _points(response: Callable[[float], float]) -> list[Chosen]:
    """Return the error of the ground points as an input that the paper does not print.

    The scatter of an angle depends on it.
    """
    return [
        Chosen("error of a point", POINT_SIGMA, "m", response),
        Chosen("points on a line", POINTS, "1", lambda factor: response(factor**-0.5)),
    ]


def _pair(context: Context, data: Data, independent: Differences) -> CheckResult:
    """Check the printed pair of differences together, by their Mahalanobis distance.

    Both angles share the plane of the nadir line: what makes one larger makes the other smaller.
    """
    measured, flight = data.light.measured[0], data.light.flight
    # the station is common and drops out, the points of the two methods are not
    exact = replace(measured, station=Station.of(measured.station.position))
    covariance = 2.0 * intersection_angles(*planes_of(exact, "tls")).covariance / ARCSEC**2
    bias = -next(row.bias for row in effect_rows(flight) if row.what == "all") / ARCSEC
    forward, nadir, backward = (_pitch_variance(data.light, line) for line in LINES)
    simple = np.array([[forward + nadir, -nadir], [-nadir, nadir + backward]])
    pair = np.array([ALPHA, BETA])
    facts: dict[str, Any] = {
        "correlation": covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1]),
        "independent": independent,
        "distance": _distance(pair - np.mean(independent.values, axis=0), np.cov(independent.values.T)),
        "pair": (ALPHA, BETA),
        "apart": _distance(pair * [-1.0, 1.0] - bias, covariance),
        "limit": LIMIT,
    }
    expected = _distance(pair - bias, 2.0 * simple)
    return context.row("000.table1.pair", _distance(pair - bias, covariance), None, LIMIT, [expected], **facts)


def _pitch_variance(passes: Passes, line: str) -> float:
    """Return the variance of the pitch of a line's plane due to errors of its ground points, arcsec^2.

    It follows from the number of points, their error and their distance.
    """
    points = passes.points[line]
    distance = float(np.mean(np.linalg.norm(points - passes.flight.station, axis=1)))
    return (passes.flight.spec.errors.points / distance / ARCSEC) ** 2 / len(points)


def _distance(off: Array, covariance: Array) -> float:
    """Return the Mahalanobis distance of a pair of errors with its covariance, in sigmas."""
    return float(np.sqrt(off @ np.linalg.solve(covariance, off)))


def _accuracy(context: Context, data: Data) -> Iterator[CheckResult]:
    for identifier, passes, light in (
        ("000.accuracy", data.passes, "taken out of the points"),
        ("000.accuracy.light", data.light, "left in"),
    ):
        angles = np.array([intersection_angles(*planes_of(m, "tls")).values for m in passes.measured])
        off = (angles - values_of(passes.flight.dihedral)) / ARCSEC
        mean, spread, rms = np.mean(off, axis=0), np.std(off, axis=0), np.sqrt(np.mean(off**2, axis=0))
        worst = int(np.argmax(rms))
        inputs = _points(partial(_rms, float(mean[worst]), float(spread[worst])))
        noise = float(spread[worst] / np.sqrt(len(off)))
        facts: dict[str, Any] = {"off": off, "point": POINT_SIGMA, "light": light, "mean": mean, "spread": spread}
        yield context.row(identifier, rms[worst], noise, inputs=inputs, **facts)


Kind = Literal["signs", "largest", "far", "alike", "little", "grows", "opposite"]
Angle = Literal["alpha", "beta"]
Site = tuple[float, float]
"""Latitude and longitude of a simulated pass, degrees."""
Rises = Mapping[tuple[str, Angle, str], float]
"""(moved object, angle, axis) -> change of the angle for a displacement of 10 m, arcsec."""
AXES = ("x", "y", "z")
FAR, EQUAL, LITTLE, GROWS = 2.0, 1.25, 0.25, 0.05
GREEK: Mapping[str, str] = {"alpha": "α", "beta": "β"}
_STYLES = {"x": (BLUE, "o"), "y": (GREEN, "s"), "z": (VERMILION, "^")}
LARGEST = 10.0
"""Largest displacement of the projection centre (station) or of ground points in the figures, metres."""
ELSEWHERE = (45.0, 120.0)
"""Latitude and longitude, degrees, of another pass, at which the paper's position-dependent statements are true."""
PANELS = {
    "fig3": (("station", "alpha"), ("station", "beta")),
    "fig4": (("forward", "alpha"), ("nadir", "alpha")),
    "fig5": (("nadir", "beta"), ("backward", "beta")),
}


@dataclass(frozen=True)
class Sentence:
    """Statement of the paper about the change of an angle due to a displacement.

    The projection centre or the ground points are displaced.

    Attributes
    ----------
    name : str
        Name of the check, without the paper.
    kind : Kind
        Kind of statement.
    what : str
        "station" for the projection centre, or the line whose points are displaced.
    angle : Angle
        Angle that the statement is about.
    axes : tuple of str
        Axes that it is about; for signs those along which the angle rises.
    others : tuple of str
        Axes that they are compared with; for signs those along which the angle falls.
    """

    name: str
    kind: Kind
    what: str
    angle: Angle
    axes: tuple[str, ...]
    others: tuple[str, ...] = ()

    @property
    def row(self) -> Check:
        """Check of the validation for this statement."""
        return load_printed("000").groups["000.figures"].rows[f"000.{self.name}"]

    @property
    def implied(self) -> float:
        """Value of the number that `measure` returns, as the statement implies it."""
        return {
            "signs": 0.0, "largest": 1.0, "far": FAR, "alike": EQUAL, "little": LITTLE, "grows": GROWS, "opposite": 1.0,
        }[self.kind]  # fmt: skip

    def measure(self, rises: Rises, bend: Rises) -> float:
        """Return the number that decides the statement.

        Parameters
        ----------
        rises : Rises
            Changes of the angles at the largest displacement, arcsec.
        bend : Rises
            Relative increase of the slope of each curve from its first to its last step.
        """

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
            return min(bend[self.what, self.angle, axis] for axis in AXES)
        return max((-rise(axis, "beta") / rise(axis, "alpha") for axis in AXES), key=lambda ratio: abs(ratio - 1.0))

    def agrees(self, rises: Rises, bend: Rises) -> bool:
        """Return True if the number confirms the statement, with the tolerance of its check."""
        return self.row.outside(self.measure(rises, bend), self.implied) <= self.row.tolerance


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


@drawing(lambda amount, change, panels: f"sensitivity-000-{panels[0][0]}-{panels[1][0]}", 3.3)
def sensitivity_svg(
    figure: Figure, amount: Array, change: Mapping[tuple[str, str, str], Array], panels: Sequence[tuple[str, str]]
) -> None:
    """Draw a panel for each pair of moved object and angle: change of the angle, arcsec, over the move, metres.

    Each panel has a curve for each axis.
    """
    for axes, (what, angle) in zip(figure.subplots(1, 2, sharey=True), panels, strict=True):
        axes.axhline(0.0, color=GREY, lw=0.8)
        ends = {}
        for axis, (colour, mark) in _STYLES.items():
            curve = change[what, angle, axis]
            ends[axis] = float(curve[-1])
            axes.plot(amount, curve, color=colour, marker=mark, ms=3.5, lw=1.4)
        least = 0.07 * (max(0.0, *ends.values()) - min(0.0, *ends.values()))
        last = -np.inf
        for axis, value in sorted(ends.items(), key=lambda item: item[1]):
            last = max(value, last + least)  # labels must not overlap
            colour = _STYLES[axis][0]
            axes.annotate(axis, (amount[-1], last), (6, 0), textcoords="offset points", va="center", color=colour)
        moved = "station" if what == "station" else f"{what} points"
        axes.set(title=f"{GREEK[angle]} over the error of the {moved}", xlabel="error, m")
        axes.margins(x=0.06)
        axes.grid(color=LIGHT, lw=0.5)
    figure.axes[0].set_ylabel("change of the angle, arcsec")


@drawing("places-000", 3.6)
def positions_svg(figure: Figure, counts: Mapping[Site, int], total: int, marked: Sequence[Site]) -> None:
    """Draw a map of the number of statements that are confirmed at each position of the pass."""
    axes = figure.subplots()
    lat, lon = (np.unique([site[k] for site in counts]) for k in (0, 1))
    grid = np.array([[counts[a, b] for b in lon] for a in lat])
    span: dict[str, Any] = {"vmin": grid.min() - 0.5, "vmax": total + 0.5}
    mesh = axes.pcolormesh(lon, lat, grid, cmap="cividis", shading="nearest", **span)
    for (a, b), count in counts.items():
        colour = "white" if (count - grid.min()) / (total - grid.min()) < 0.55 else INK
        axes.text(b, a, str(count), ha="center", va="center", fontsize=8, color=colour)
    for site in marked:
        axes.plot(site[1], site[0], "o", ms=19, mfc="none", mec=VERMILION, mew=1.8)
    axes.set(xlabel="longitude, ° E", ylabel="latitude, ° N")
    figure.colorbar(mesh, ax=axes, label=f"sentences that hold, of {total}")


@dataclass(frozen=True, eq=False)
class Answers:
    """Changes of the angles as functions of the displacement of projection centre or ground points.

    The planes are fitted again after each displacement.

    Attributes
    ----------
    amount : (k,) ndarray
        The k displacements, metres.
    change : Mapping[tuple[str, str, str], ndarray]
        (moved object, angle, axis) -> (k,) changes of the angle, arcsec.
    """

    amount: Array
    change: Mapping[tuple[str, str, str], Array]

    @classmethod
    def of(cls, table: Sequence[Sensitivity]) -> Answers:
        """Return the curves of the angles' changes from a table of sensitivities.

        They are given for every moved object along every axis.
        """
        change = {
            (row.what, angle, row.axis): row.change[k] / ARCSEC for row in table for k, angle in enumerate(row.angles)
        }
        return cls(table[0].amount, change)

    @property
    def rises(self) -> Rises:
        """(moved object, angle, axis) -> change of the angle at the largest displacement, arcsec."""
        return {key: float(change[-1]) for key, change in self.change.items()}  # type: ignore[misc]

    @property
    def bend(self) -> Rises:
        """(moved object, angle, axis) -> relative increase of the curve's slope from the first to the last step."""
        out = {}
        for key, change in self.change.items():
            slope = np.abs(np.diff(change))
            out[key] = float(slope[-1] / slope[0] - 1.0) if slope[0] > 0 else 0.0
        return out  # type: ignore[return-value]


def make_passes(
    context: Context, site: Site | None = None, count: int | None = None, direction: str = "descending"
) -> Passes:
    """Simulate measurements at the library test's position, or at ``site``: latitude and longitude, degrees."""
    at: dict[str, Any] = {"direction": direction}
    if site is not None:
        at |= {"latitude": np.radians(site[0]), "longitude": np.radians(site[1])}
    many = context.count(full=60, fast=10) if count is None else count
    return repeated(setup_of(TEST, **at), np.random.SeedSequence([context.seed, 8]), many)


def answers(measured: Measurement, flight: AnglePass, steps: int = 10, method: Method = "corrected") -> Answers:
    """Return the changes of the angles for displacements of projection centre or ground points.

    The planes are fitted again for each displacement; ``steps`` is the number of displacements.
    """
    amount = np.linspace(0.0, LARGEST, steps + 1)
    return Answers.of(sensitivity(measured.station, measured.strips, flight.pairs, method=method, amounts=amount))


@one_blas_thread()
def run_figures(context: Context) -> Iterator[CheckResult]:
    """Yield the results of all checks of the statements about Figs. 3 to 5 of paper 000 (Liu and Huang 2014)."""
    context.progress(0.0, "move station and points")
    passes = make_passes(context)
    all_answers = [answers(m, passes.flight) for m in passes.measured]
    context.progress(0.4, "the same elsewhere")
    there = make_passes(context, ELSEWHERE, 1)
    other = answers(there.measured[0], there.flight)
    sites = _sites(context)
    for sentence in SENTENCES:
        if sentence.row.id in context.selected:
            yield _row(sentence, passes, all_answers, other, sites)
    yield _ordinate(context, all_answers, sites)
    if "000.fig4.single" in context.selected:
        yield _single(context, passes)
    context.progress(0.9, "draw")
    _show(context, all_answers[0], sites)


def _row(
    sentence: Sentence, passes: Passes, all_answers: list[Answers], other: Answers, sites: Mapping[Site, Answers]
) -> CheckResult:
    values = np.array([sentence.measure(a.rises, a.bend) for a in all_answers])
    mean = {axis: np.mean([a.rises[sentence.what, sentence.angle, axis] for a in all_answers]) for axis in AXES}
    site = _site([sentence], sites)
    facts: dict[str, Any] = {
        "simulated": all_answers,
        "mean": {axis: f"{value:+.3f}″" for axis, value in mean.items()},
        "position": site,
        "other": sentence.measure(other.rises, other.bend),
        "north": ELSEWHERE[0],
        "east": ELSEWHERE[1],
        "similar": EQUAL,
    }
    value, sigma = (float(values[0]), None) if sentence.kind == "grows" else mean_of(values)
    inputs = [site] if sentence.row.basis == "chosen" else []
    explained = _explained(sentence, passes, other)
    return sentence.row.evaluate(value, sigma, "", sentence.implied, explained, inputs, facts)


def _site(sentences: Sequence[Sentence], sites: Mapping[Site, Answers]) -> Supposed:
    """Return the position of the pass as an input that the paper does not print.

    It comes with other positions where the statements are confirmed.
    """
    confirmed = sum(all(s.agrees(a.rises, a.bend) for s in sentences) for a in sites.values())
    text = f"holds at {confirmed} of {len(sites)} places from 25° to 50° N and 80° to 130° E"
    return Supposed("a descending pass over 40° N 116° E", text)


def _explained(sentence: Sentence, passes: Passes, other: Answers) -> list[float]:
    """Return the values that the explanations of a statement's check would give; empty if it has none."""
    if sentence.kind == "grows":
        return [LARGEST / float(np.linalg.norm(passes.flight.station - passes.flight.middle_point))]
    if sentence.kind == "alike" and sentence.agrees(other.rises, other.bend):
        normal = np.abs(passes.normal("forward"))
        return [float(normal[2] / normal[0])]
    return []


def _ordinate(context: Context, all_answers: list[Answers], sites: Mapping[Site, Answers]) -> CheckResult:
    signs = [s for s in SENTENCES if s.kind == "signs"]
    share, other = (
        float(
            np.mean([s.agrees({k: sign * v for k, v in a.rises.items()}, a.bend) for s in signs for a in all_answers])
        )
        for sign in (1.0, -1.0)
    )
    count = sum(len(s.axes + s.others) for s in signs)
    facts: dict[str, Any] = {"sentences": signs, "signs": count, "simulated": all_answers, "other": other}
    return context.row("000.fig3.ordinate", share, None, 1.0, inputs=[_site(signs, sites)], **facts)


def _single(context: Context, passes: Passes) -> CheckResult:
    m = passes.measured[0]
    base = intersection_angles(*planes_of(m, "corrected")).values[0]
    shift = np.array([0.0, LARGEST, 0.0])

    def moved(strip: Strip) -> float:
        planes = planes_of(replace(m, strips={**m.strips, "forward": strip}), "corrected")
        return float(intersection_angles(*planes).values[0] - base)

    forward = m.strips["forward"]
    whole = moved(forward.shifted(shift))
    each = []
    for k in range(len(forward.points)):
        points = forward.points.copy()
        points[k] += shift
        each.append(moved(Strip(points, forward.covariance)))
    value = float(np.max(np.abs(each)) / abs(whole))
    inputs = [Chosen.power("points on a line", float(len(each)), "1", value, -1.0)]
    return context.row("000.fig4.single", value, implied=0.0, inputs=inputs, each=each, whole=whole)


def _sites(context: Context) -> dict[Site, Answers]:
    """Return, for each position of the pass, the changes of the angles over the displacements in one measurement."""
    step = 5.0 if context.fast else 2.5
    out = {}
    grid = [(lat, lon) for lat in np.arange(25.0, 50.1, step) for lon in np.arange(80.0, 130.1, 2.0 * step)]
    for k, site in enumerate(grid):
        if k % 10 == 0:
            context.progress(0.4 + 0.45 * k / len(grid), "the same elsewhere")
        passes = make_passes(context, site, 1)
        out[site] = answers(passes.measured[0], passes.flight, 2)
    return out


def _readings(context: Context) -> list[tuple[str, str, int, int]]:
    """Return, for each frame and flight direction, how many statements are confirmed.

    The first count takes the statements to be about the angle, the second about the ordinate of the figures, which has
    the opposite sign.
    """
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
            counts = [sum(s.agrees(r, a.bend) for s in SENTENCES) for r in (a.rises, minus)]
            rows.append((frame, direction, counts[0], counts[1]))
    return rows


def _show(context: Context, shown: Answers, sites: Mapping[Site, Answers]) -> None:
    for name, panels in PANELS.items():
        context.figure(name, sensitivity_svg(shown.amount, shown.change, panels))
    counts = {site: sum(s.agrees(a.rises, a.bend) for s in SENTENCES) for site, a in sites.items()}
    context.figure("places", positions_svg(counts, len(SENTENCES), ((40.0, 116.0), ELSEWHERE)), total=len(SENTENCES))
    context.table("readings", _readings(context), total=len(SENTENCES))
    moved = ((what, axis) for what in ("station", "forward", "nadir", "backward") for axis in AXES)
    rows = [(w, a, float(shown.rises[w, "alpha", a]), float(shown.rises[w, "beta", a])) for w, a in moved]
    context.table("changes", rows)


TABLE_1 = group_of("000.table1", run_table_1)
FIGURES = group_of("000.figures", run_figures)
