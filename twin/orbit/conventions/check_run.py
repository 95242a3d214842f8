"""Search for file conventions of a pass that explain its ground points: ``python -m twin.orbit check``.

A convention is, for example, the order of quaternion elements, a time scale, or the direction in which pixels count. In
names, a reading is one interpretation of the files' numbers under one set of conventions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from scipy.stats import chi2

from optics.numerics.number_tree import FrozenMap
from scenes.yaml.errors import InputError, Issue
from twin.framework.procedure import Advance, silent
from twin.orbit.conventions import pass_readings
from twin.orbit.flight.line_camera import LineTimes, line_cameras
from twin.orbit.flight.sensor import LightEffects
from twin.orbit.measured.earth_orientation import epoch_before
from twin.orbit.measured.measurement_tables import campaign_files
from twin.orbit.measured.pass_measurements import ImagePoints, PassMeasurements
from twin.orbit.measured.platform_files import platform_table

if TYPE_CHECKING:
    from optics.numerics.backend import Backend
    from scenes.specs.orbit.setup import CheckSetup

Verdict = Literal["confirmed", "another", "none"]
DECIDED = 20.0
"""Difference of cost (minus twice the log likelihood) from which one interpretation of the files is rejected.

The rejected one is then exp(-10) = 1/22 000 times as likely as the other. As a few hundred are tried, at most one check
in a hundred is wrong.
"""
_FITS = 9.0
"""Chi-square per degree of freedom up to which an interpretation of the files explains the points: it allows for sigmas
that are three times too small.
"""
_ROUGH_POINTS = 8
"""Number of points of each line in the rough comparison that precedes the fits."""
_CANDIDATES = 40
"""Number of interpretations that are fitted after the rough comparison."""
_ROUNDS = 3
"""Number of search rounds; each adds two conventions that may be wrong."""
_WRONG_SHARE = 1e-6
"""Probability that a correct point is rejected as a gross error."""
_MOST_WRONG = 0.3
"""Largest share of points that may be rejected as gross errors."""


@dataclass(frozen=True, eq=False)
class TriedReading:
    """Interpretation of the files that was tried, with its fit.

    Attributes
    ----------
    changes : Changes
        Changes from the interpretation that the test file specifies.
    fit : Fit or None
        Fit to the points; None if they cannot have been imaged under this interpretation.
    why : str
        Reason why the interpretation is impossible.
    """

    changes: pass_readings.Changes
    fit: pass_readings.Fit | None
    why: str = ""

    @property
    def cost(self) -> float:
        """Minus twice the log likelihood; infinite for an impossible interpretation."""
        return np.inf if self.fit is None else self.fit.cost


@dataclass(frozen=True, eq=False)
class ValueTest:
    """Test of one value of a convention, with the others as in the best interpretation of the files.

    Attributes
    ----------
    value : str, float, bool or tuple
        Value of the convention.
    specified, best : bool
        True if the value is the one that the test file specifies, and if it is that of the best interpretation.
    excess : float
        Cost (minus twice the log likelihood) minus that of the best interpretation, divided by the factor by which the
        variances are too small.
    moved : float or None
        RMS displacement of the points from their positions under the best interpretation, metres; None if they have no
        position on the ground.
    why : str
        Reason why the value is impossible; empty if it is not.
    """

    value: Any
    specified: bool
    best: bool
    excess: float
    moved: float | None
    why: str

    @property
    def possible(self) -> bool:
        """True where the points do not exclude this value of the convention."""
        return self.excess < DECIDED


@dataclass(frozen=True, eq=False)
class Check:
    """Result of a check of conventions.

    Attributes
    ----------
    setup : CheckSetup
        Test file with the camera.
    readings : PassReadings
        Content of the files before interpretation.
    specified : PassConventions
        Conventions that the test file specifies.
    tried : tuple of TriedReading
        Interpretations with a fit, the likeliest first, then those that are impossible.
    best : TriedReading
        Interpretation with the fewest changes among those that explain the points equally well.
    verdict : Verdict
        "confirmed" if the specified interpretation explains the points, "another" if another one does, or "none".
    factor : float
        Factor by which the variances are too small: chi-square per degree of freedom of the best interpretation, at
        least 1.
    answers : dict of str to tuple of ValueTest
        Tested values of each convention.
    count : int
        Number of interpretations that were tried.
    wrong : dict of str to tuple of str
        Names of points that were rejected as gross errors, by line.
    """

    setup: CheckSetup
    readings: pass_readings.PassReadings
    specified: pass_readings.PassConventions
    tried: tuple[TriedReading, ...]
    best: TriedReading
    verdict: Verdict
    factor: float
    answers: dict[str, tuple[ValueTest, ...]]
    count: int
    wrong: dict[str, tuple[str, ...]]

    def excess(self, tried: TriedReading) -> float:
        """Return the cost of an interpretation (minus twice its log likelihood) relative to that of the best one.

        It is the difference divided by `factor`, by which the variances are too small; infinite for an impossible
        interpretation.
        """
        return (tried.cost - self.best.cost) / self.factor

    @property
    def equally_likely(self) -> tuple[pass_readings.Changes, ...]:
        """Interpretations that the points do not distinguish from the best one and that have no more changes."""
        return tuple(
            tried.changes
            for tried in self.tried
            if tried is not self.best and len(tried.changes) <= len(self.best.changes) and self.excess(tried) < DECIDED
        )

    @property
    def specified_fit(self) -> TriedReading:
        """Interpretation that the test file specifies, with its fit."""
        return next(tried for tried in self.tried if not tried.changes)


def run_check(setup: CheckSetup, backend: Backend | None, seed: int, advance: Advance = silent) -> Check:
    """Find the interpretation of a pass's files that explains its ground points best.

    Nothing is ray-traced or drawn at random: backend and seed are not used.

    Raises
    ------
    InputError
        Files cannot be read, or there are fewer than three points.
    """
    advance("readings", 0, 3)
    readings, specified = pass_readings.read_pass(setup.test, setup.camera, Path())
    bench = _bench(setup, readings, specified)
    others = pass_readings.alternatives(specified, readings.platform.attitude.quaternion is not None)
    best, tried, count = _best_reading(bench, others)
    advance("readings", 1, 3)
    wrong: dict[str, tuple[str, ...]] = dict.fromkeys(readings.images, ())
    if best.fit is not None:
        masks = _wrong(bench, best.fit)
        share = float(np.mean(np.concatenate(list(masks.values()))))
        if 0.0 < share <= _MOST_WRONG:
            ids, images = readings.ground.points.ids, bench.readings.images
            wrong = {name: tuple(map(str, ids[images[name].point[mask]])) for name, mask in masks.items()}
            bench = bench.without(masks)
            tried = [_tried(bench, item.changes) for item in tried]
            best = _best(tried)
    advance("readings", 2, 3)
    ratio = np.inf if best.fit is None else best.fit.chi_square / best.fit.freedom
    verdict: Verdict = "none" if ratio > _FITS else "another" if best.changes else "confirmed"
    factor = max(float(ratio), 1.0) if np.isfinite(ratio) else 1.0
    answers = {name: _answers(bench, best, name, values, factor) for name, values in others.items()}
    tried.sort(key=lambda item: (item.cost, len(item.changes)))
    advance("readings", 3, 3)
    return Check(setup, readings, specified, tuple(tried), best, verdict, factor, answers, count, wrong)


def _bench(
    setup: CheckSetup, readings: pass_readings.PassReadings, specified: pass_readings.PassConventions
) -> pass_readings.PassBench:
    """Return the object that fits interpretations of the files to at most the test's number of image points."""
    cameras = line_cameras(setup.camera)
    images = {}
    for name, raw in readings.images.items():
        order = np.lexsort((raw.line, raw.pixel))
        images[name] = raw.taken(order[pass_readings.spread(len(order), setup.test.points)])
    total = sum(len(raw.line) for raw in images.values())
    if total < 3:
        file = setup.test.image_points.file
        raise InputError(Issue("too few image points for a check", file, value=str(total), allowed="three or more"))
    epoch = epoch_before(next(iter(readings.lines.values())).clock.instants("TAI"))
    part, effects = replace(readings, images=images), LightEffects.of(setup.test.effects)
    return pass_readings.PassBench(part, specified, cameras, setup.test.uncertainty, effects, epoch)


def _best_reading(
    bench: pass_readings.PassBench, others: dict[str, tuple[Any, ...]]
) -> tuple[TriedReading, list[TriedReading], int]:
    """Return the best interpretation, those that were fitted, and the number of those that were compared."""
    start: pass_readings.Changes = ()
    fitted: dict[frozenset[str], TriedReading] = {}
    seen: set[frozenset[str]] = set()
    for _ in range(_ROUNDS):
        rough = []
        for changes in pass_readings.singles_and_pairs(others, start):
            key = _key(changes)
            if key in seen:
                continue
            seen.add(key)
            size = _rough(bench, pass_readings.changed(bench.specified, changes))
            if len(changes) <= 1 or np.isfinite(size):
                rough.append((size, len(changes), changes))
        rough.sort(key=lambda item: item[:2])
        chosen = [item[2] for k, item in enumerate(rough) if k < _CANDIDATES or item[1] <= 1]
        fitted |= {_key(changes): _tried(bench, changes) for changes in chosen}
        best = _best(list(fitted.values()))
        if best.fit is None or best.fit.chi_square / best.fit.freedom <= _FITS or best.changes == start:
            break
        start = best.changes
    return best, list(fitted.values()), len(seen)


def _key(changes: pass_readings.Changes) -> frozenset[str]:
    """Return a dictionary key for a set of changed conventions, independent of their order."""
    return frozenset(f"{name}={value}" for name, value in changes)


def _rough(bench: pass_readings.PassBench, reading: pass_readings.PassConventions) -> float:
    """Return the root of the median squared residual of a few points, in metres; infinite if they have no position."""
    try:
        return float(np.sqrt(np.median(np.sum(bench.residuals(reading, _ROUGH_POINTS) ** 2, axis=1))))
    except pass_readings.ImpossibleError:
        return np.inf


def _tried(bench: pass_readings.PassBench, changes: pass_readings.Changes) -> TriedReading:
    """Fit one interpretation of the files, the specified one with `changes`, to the points."""
    try:
        return TriedReading(changes, bench.fit(pass_readings.changed(bench.specified, changes)))
    except pass_readings.ImpossibleError as error:
        return TriedReading(changes, None, str(error))


def _best(tried: Sequence[TriedReading]) -> TriedReading:
    """Return the interpretation with the fewest changes among those that explain the points equally well."""
    least = min(tried, key=lambda reading: reading.cost)
    if least.fit is None:
        return next(reading for reading in tried if not reading.changes)
    factor = max(least.fit.chi_square / least.fit.freedom, 1.0)
    likely = [reading for reading in tried if (reading.cost - least.cost) / factor < DECIDED]
    return min(likely, key=lambda reading: (len(reading.changes), reading.cost))


def _wrong(bench: pass_readings.PassBench, fit: pass_readings.Fit) -> dict[str, np.ndarray]:
    """Return masks of gross errors by line: residuals far beyond the noise and the scatter of the other points."""
    square = np.einsum("ni,nij,nj->n", fit.left, np.linalg.inv(fit.noise), fit.left)
    scale = max(float(np.median(square)) / float(chi2.median(2)), 1.0)
    bad = square > scale * chi2.isf(_WRONG_SHARE, 2)
    images = bench.readings.images
    parts = np.split(bad, np.cumsum([len(raw.line) for raw in images.values()])[:-1])
    return dict(zip(images, parts, strict=True))


def _answers(
    bench: pass_readings.PassBench, best: TriedReading, name: str, values: tuple[Any, ...], factor: float
) -> tuple[ValueTest, ...]:
    """Test every value of a convention, with the others as in the best interpretation."""
    convention = pass_readings.TESTED_CONVENTIONS[name]
    reading = pass_readings.changed(bench.specified, best.changes)
    specified_value, best_value = convention.get(bench.specified), convention.get(reading)
    answers = []
    for value in (specified_value, *values):
        excess, moved, why = np.inf, None, ""
        try:
            fit = bench.fit(convention.put(reading, value))
            excess = (fit.cost - best.cost) / factor
            if best.fit is not None:
                moved = float(np.sqrt(np.mean(np.sum((fit.residual - best.fit.residual) ** 2, 1))))
        except pass_readings.ImpossibleError as error:
            why = str(error)
        answers.append(ValueTest(value, value == specified_value, value == best_value, excess, moved, why))
    return tuple(answers)


def exported(run: Check) -> dict[str, str]:
    """Return the files of a folder of measurements in the project's own conventions, path -> text.

    Raises
    ------
    InputError
        The specified conventions were not confirmed.
    """
    if run.verdict != "confirmed":
        problem = "nothing is exported of a pass whose stated conventions are not confirmed"
        raise InputError(Issue(problem, run.setup.test.source.file, allowed="conventions that `check` confirms"))
    return campaign_files([measurements(run)], run.setup.camera.plain())


def measurements(run: Check) -> PassMeasurements:
    """Return the pass in the project's own conventions, converted by the specified interpretation of its files."""
    readings, reading = run.readings, run.specified
    table = platform_table(readings.platform, reading.platform)
    times, images = {}, {}
    for name, raw in readings.images.items():
        clock = readings.lines[name]
        middle, _ = pass_readings.line_times(clock, reading, table.epoch, clock.line)
        times[name] = LineTimes.of(clock.line - clock.line[0], middle)
        pixels = run.setup.camera.pixels_of(name)
        # A mirrored axis changes the sign of the correlation.
        signs = np.array([-1.0 if reading.backward else 1.0, 1.0 if reading.first_pixel_sees == "right" else -1.0])
        spread = raw.covariance * signs[:, None] * signs
        line = pass_readings.line_of(reading, raw, clock) - clock.line[0]
        images[name] = ImagePoints.of(raw.point, line, pass_readings.pixel_of(reading, raw, pixels), spread)
    return PassMeasurements(run.setup.test.name, table, FrozenMap(times), readings.ground.points, FrozenMap(images))
