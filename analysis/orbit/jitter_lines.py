"""Oscillations of an attitude that are found in observations of it, and its course over time with a covariance.

Lines are found one after the other, the strongest first: the highest power of the periodogram is a line if its chance
is below the stated rate; then all lines found so far are fitted together, frequencies included, and the search goes on
beside them. Where moments are nearly even, a faster oscillation shows power in the search, too: each frequency up to a
stated one that explains what was found as well is an alias of it, and a line is that of them which is right but for
the false-alarm rate, or it is any of those that are named. Observations that no oscillation explains (wrong matches)
are left out, and taken up again if a line that is found later explains them.

Frequencies far beyond a search that could be what was found in it: the aliases of an uneven sampling.

Points that lie on rows, such as a grid's, are seen at moments that are nearly whole numbers of an interval, and an
oscillation faster than half of its rate looks there like a slow one. The power of all frequencies, up to the rate of
the image lines, follows at once from Fourier transforms of the observations on a fine grid of moments: with the
observations' weights w and values v,

    z(f) = sum v w exp(-2 pi i f t),   N(f) = sum w w' exp(-2 pi i f (t - t')),   power = 2 z* N^-1 z,

which is the power of the periodogram but for the nuisance and for what sine and cosine have in common. Both are little
at frequencies that are high against the inverse of the time observed; what is selected is fitted exactly.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft
from scipy.interpolate import BSpline

from analysis.arrays import Array
from analysis.orbit.jitter_spectrum import BLIND, JitterError, Observations, Periodogram, periodogram
from analysis.statistics import robust_sigma

_FINE, _PADDED = 16, 4
"""Moments in a period of the highest frequency, and transformed frequencies in a resolution element: an oscillation
loses 3% of its power at most by either.
"""
_WIDEST = 2**18
"""Resolution elements that are transformed at most."""
_REGULAR = 1e-4
"""Share of the best known combination of axes that is added to all: what moves alike stays bounded."""


def farthest(given: Observations, highest: float) -> float:
    """Return the frequency up to which aliases can be looked for, hertz, at most ``highest``."""
    return min(highest, _WIDEST / given.span)


def peaks(given: Observations, lowest: float, highest: float) -> tuple[Array, Array]:
    """Return frequencies (K,), hertz, and approximate powers (K,) of all local maxima of the power, the highest first.

    Args:
        given: observations.
        lowest: frequency, hertz.
        highest: likewise; lowered to `farthest`.
    """
    highest = farthest(given, highest)
    step = 1.0 / (_FINE * highest)
    count = int(np.ceil(given.span / step)) + 2
    size = fft.next_fast_len(_PADDED * count, real=True)
    first = np.searchsorted(given.group, np.arange(len(given.time)))
    value = given.rest(given.value)[:, None, None]
    seen = np.add.reduceat(given.weight * value, first, axis=0)
    pairs = np.add.reduceat(given.weight[:, :, None, :, None] * given.weight[:, None, :, None, :], first, axis=0)
    # moments that have no weight may be anything
    begin = given.ends[0]
    at = np.clip(np.rint((given.time - begin) / step).astype(np.intp), 0, count - 1)
    apart = np.rint((given.time[:, :, None] - given.time[:, None, :]) / step).astype(np.intp) % size
    frequency = np.arange(size // 2 + 1) / (size * step)
    inside = (frequency >= lowest) & (frequency <= highest)
    axes = given.axes

    def transformed(place: np.ndarray, weight: Array) -> Array:
        return np.asarray(fft.rfft(np.bincount(place.ravel(), weight.ravel(), size))[inside])

    z = np.stack([transformed(at, seen[..., a]) for a in range(axes)], axis=-1)
    normal = np.empty((len(z), axes, axes), complex)
    for a in range(axes):
        for b in range(axes):
            normal[:, a, b] = transformed(apart, pairs[..., a, b])
    own = np.einsum("faa->fa", normal).real
    best = np.maximum(own.max(axis=0), 1e-300)
    scale = 1.0 / np.sqrt(best)
    normal = normal * scale[:, None] * scale + _REGULAR * np.eye(axes)
    scaled = z * scale
    power = 2.0 * np.einsum("fa,fa->f", scaled.conj(), np.linalg.solve(normal, scaled[..., None])[..., 0]).real
    power = np.where(np.all(own >= BLIND**2 * best, axis=1), power, 0.0)
    rising = np.concatenate([[True], power[1:] >= power[:-1]])
    falling = np.concatenate([power[:-1] > power[1:], [True]])
    top = np.flatnonzero(rising & falling & (power > 0.0))
    top = top[np.argsort(-power[top])]
    return frequency[inside][top], power[top]


MOST_LINES = 20
_FAR = 5.0
"""Robust standard deviations beyond which an observation is wrong: one in two million of good ones is lost."""
_ROUNDS = 40
_ARRIVED = 1e-10
_ASTRAY = 1.0
"""Resolution elements: a fit that goes farther from the highest power has not found what makes it."""
_CELL = 1.0
"""Resolution elements to each side of a line that is fitted in which none else is sought."""
_MOST_ALIASES = 24
"""Frequencies that are fitted in place of a line, those of the highest power."""
_ALIKE = 0.8
"""Share of a line's power that an alias has at least, by the approximation that selects it."""


@dataclass(frozen=True, eq=False)
class Lines:
    """Oscillations that were found, fitted together.

    theta(t) = sum over lines of sine sin(2 pi f (t - origin)) + cosine cos(2 pi f (t - origin)).

    Attributes:
        frequency: (K,) hertz.
        sine, cosine: (K, A) radians.
        covariance: of frequency, sine and cosine of the first line, then of the next, (K (1 + 2 A), ...), with the
            variance of the noise that the observations show.
        chance: (K,) largest probability that noise alone would have shown one like it, anywhere in the search, when it
            was found.
        origin: moment from which phases count, seconds.
        aliases: (K,) other frequencies, hertz, that explain the observations as well, but for the false-alarm rate.
    """

    frequency: Array
    sine: Array
    cosine: Array
    covariance: Array
    chance: Array
    origin: float
    aliases: tuple[tuple[float, ...], ...] = ()

    @property
    def amplitude(self) -> Array:
        """(K, A) radians."""
        return np.hypot(self.sine, self.cosine)

    @property
    def phase(self) -> Array:
        """(K, A) p of amplitude sin(2 pi f t + p) with t from the epoch, radians, 0 to 2 pi."""
        at = np.arctan2(self.cosine, self.sine) - 2.0 * np.pi * self.frequency[:, None] * self.origin
        return np.asarray(np.mod(at, 2.0 * np.pi))

    @property
    def frequency_sigma(self) -> Array:
        """(K,) hertz."""
        width = 1 + 2 * self.sine.shape[1]
        return np.asarray(np.sqrt(np.diag(self.covariance)[::width]))

    @property
    def amplitude_sigma(self) -> Array:
        """(K, A) radians: of the component along the amplitude."""
        axes = self.sine.shape[1]
        out = np.zeros_like(self.sine)
        for k in range(len(self.frequency)):
            first = k * (1 + 2 * axes) + 1
            for a in range(axes):
                at = [first + a, first + axes + a]
                along = np.array([self.sine[k, a], self.cosine[k, a]])
                along = along / max(float(np.linalg.norm(along)), 1e-300)
                out[k, a] = np.sqrt(along @ self.covariance[np.ix_(at, at)] @ along)
        return out

    def design(self, seconds: ArrayLike) -> Array:
        """(T, A, K (1 + 2 A)) derivative of the attitude at times (T,) by what `covariance` is of."""
        t = np.asarray(seconds, np.float64) - self.origin
        axes, width = self.sine.shape[1], 1 + 2 * self.sine.shape[1]
        out = np.zeros((len(t), axes, width * len(self.frequency)))
        for k, f in enumerate(self.frequency):
            angle = 2.0 * np.pi * f * t
            sine, cosine = np.sin(angle), np.cos(angle)
            slope = 2.0 * np.pi * t
            out[:, :, k * width] = (slope * cosine)[:, None] * self.sine[k] - (slope * sine)[:, None] * self.cosine[k]
            for a in range(axes):
                out[:, a, k * width + 1 + a] = sine
                out[:, a, k * width + 1 + axes + a] = cosine
        return out

    def course(self, seconds: ArrayLike) -> tuple[Array, Array]:
        """Attitude (T, A), radians, at times (T,), and its covariance (T, A, A)."""
        t = np.asarray(seconds, np.float64) - self.origin
        angle = 2.0 * np.pi * t[:, None] * self.frequency
        value = np.sin(angle) @ self.sine + np.cos(angle) @ self.cosine
        by = self.design(seconds)
        return np.asarray(value), np.asarray(np.einsum("tap,pq,tbq->tab", by, self.covariance, by, optimize=True))


@dataclass(frozen=True, eq=False)
class Found:
    """A search for jitter.

    Attributes:
        lines: that were found.
        before: periodogram of the observations, with the variances of their kinds as they were found.
        after: the same beside all lines that were found.
        used: (R,) observations that were not left out as wrong.
        factors: (K,) variance of the noise over that of the covariances, of each kind of errors.
        threshold: power of ``after`` that noise alone exceeds with the stated probability.
        beyond: frequency up to which aliases were looked for, hertz.
    """

    lines: Lines
    before: Periodogram
    after: Periodogram
    used: NDArray[np.bool_]
    factors: Array
    threshold: float
    beyond: float

    @property
    def detectable(self) -> Array:
        """(F, A) amplitude about one axis alone that reaches the threshold without noise, radians; inf where blind."""
        least = np.sqrt(self.threshold) * self.before.sigma
        return np.where(self.before.blind[:, None], np.inf, least)


def search(
    given: Observations, lowest: float, highest: float, false_alarm: float, beyond: float | None = None
) -> Found:
    """Find oscillations.

    Args:
        given: what was observed.
        lowest: frequency, hertz.
        highest: likewise.
        false_alarm: probability of finding any where there is none, over all frequencies looked at.
        beyond: frequency up to which aliases of what is found are looked for, hertz; None for ``highest``.

    Raises:
        JitterError: observations that say nothing of jitter.
    """
    used = _good(given, None)
    used = _good(given.evened(given.taken(used).factors()), None)
    frequency: list[float] = []
    chance: list[float] = []
    aliases: list[tuple[float, ...]] = []
    lines: Lines | None = None
    reach = lowest, farthest(given, max(highest, beyond or highest))
    while True:
        kept = given.taken(used)
        factors = _beside(kept, lines).factors()
        kept = kept.evened(factors)
        now = periodogram(_beside(kept, lines), lowest, highest)
        step = _CELL / kept.span
        open_ = ~now.blind & np.all(np.abs(now.frequency[:, None] - np.array(frequency)) > step, axis=1)
        if not np.any(open_) or len(frequency) >= MOST_LINES:
            break
        best = int(np.argmax(np.where(open_, now.power, -1.0)))
        probability = float(now.chance(now.power[best]))
        if probability > false_alarm:
            break
        chances = [*chance, probability]
        try:
            fitted = _fitted(kept, np.array([*frequency, float(now.frequency[best])]), np.array(chances))
            fitted, others = _unaliased(kept, lines, fitted, reach, false_alarm)
            again = _good(given.evened(_beside(given.taken(used), fitted).factors()), fitted)
            kept = given.taken(again).evened(factors)
            fitted = _fitted(kept, fitted.frequency, np.array(chances))
            # a strong line was noise to the factors before
            kept = given.taken(again)
            factors = _beside(kept, fitted).factors()
            kept = kept.evened(factors)
            fitted = _fitted(kept, fitted.frequency, np.array(chances))
        except JitterError:
            # what is left is no oscillation beside the others, such as one whose amplitude changes
            break
        lines, used, frequency, chance = fitted, again, fitted.frequency.tolist(), chances
        aliases.append(others)
    before = now if lines is None else periodogram(kept, lowest, highest)
    if lines is None:
        axes = given.axes
        none = np.zeros((0, axes))
        lines = Lines(np.zeros(0), none, none, np.zeros((0, 0)), np.zeros(0), given.middle)
    lines = replace(lines, aliases=tuple(aliases))
    return Found(lines, before, now, used, factors, now.threshold(false_alarm), reach[1])


def _unaliased(
    kept: Observations, lines: Lines | None, fitted: Lines, reach: tuple[float, float], false_alarm: float
) -> tuple[Lines, tuple[float, ...]]:
    """Return all lines with the last one at the frequency that explains it best, and other frequencies that explain it
    as well.

    Args:
        kept: observations that are used.
        lines: that were found before; None for none.
        fitted: the same and the last.
        reach: lowest and highest frequency of aliases, hertz.
        false_alarm: likelihood, against the best, above which a frequency is an alias.
    """
    beside, at, cell = _beside(kept, lines), fitted.frequency[-1], _CELL / kept.span
    frequency, power = peaks(beside, *reach)
    here = np.abs(frequency - at) <= cell
    noise, margin = _left(kept, fitted) / kept.freedom, 2.0 * np.log(1.0 / false_alarm)
    least = _ALIKE * float(power[here].max(initial=0.0)) - margin * noise
    away = np.all(np.abs(frequency[:, None] - fitted.frequency) > cell, axis=1)
    found = [(_left(kept, fitted), fitted)]
    for candidate in frequency[away & (power >= least)][:_MOST_ALIASES]:
        try:
            other = _fitted(kept, np.append(fitted.frequency[:-1], candidate), fitted.chance)
            rest = periodogram(_beside(kept, other), max(at - 2.0 * cell, reach[0]), at + 2.0 * cell)
        except JitterError:
            continue
        if rest.chance(rest.power[rest.best]) > false_alarm:
            found.append((_left(kept, other), other))
    least_square = min(square for square, _ in found)
    alike = [one for square, one in found if kept.freedom * np.log(square / least_square) <= margin]
    # what lies in the search is taken where nothing tells it apart
    line = fitted if alike[0] is fitted else min(found, key=lambda item: item[0])[1]
    return line, tuple(sorted(float(one.frequency[-1]) for one in alike if one is not line))


def _left(given: Observations, lines: Lines) -> float:
    """Return the square sum that lines and nuisance leave of the observations."""
    left = given.rest(given.value - _predicted(given, lines))
    return float(left @ left)


def _beside(given: Observations, lines: Lines | None) -> Observations:
    """Observations with all that is fitted of lines as unknowns beside the others."""
    return given if lines is None else given.beside(_columns(given, lines))


def _columns(given: Observations, lines: Lines) -> Array:
    """Derivatives of the observations by all that is fitted of lines, (R, P)."""
    by = np.zeros((len(given.value), lines.covariance.shape[0]))
    for j in range(given.time.shape[1]):
        by += np.einsum("ra,rap->rp", given.weight[:, j], lines.design(given.time[:, j])[given.group])
    return by


def _predicted(given: Observations, lines: Lines) -> Array:
    out = np.zeros(len(given.value))
    for j in range(given.time.shape[1]):
        angle = 2.0 * np.pi * (given.time[:, j, None] - lines.origin) * lines.frequency
        turn = np.sin(angle) @ lines.sine + np.cos(angle) @ lines.cosine
        out += np.sum(given.weight[:, j] * turn[given.group], axis=1)
    return out


def _good(given: Observations, lines: Lines | None) -> NDArray[np.bool_]:
    """Which observations are explained by nuisance and lines, as far as noise goes; of a place all or none."""
    value = given.value if lines is None else given.value - _predicted(given, lines)
    keep = np.ones(len(value), bool)
    for _ in range(_ROUNDS):
        known = given.taken(keep).nuisance
        x = np.linalg.lstsq(known, value[keep], rcond=1e-10)[0] if known.shape[1] else np.zeros(0)
        off = np.abs(value - given.nuisance @ x)
        worst = np.zeros(len(given.time))
        np.maximum.at(worst, given.group, off)
        again = worst[given.group] <= _FAR * max(robust_sigma(off), 1e-300)
        if np.array_equal(again, keep):
            break
        keep = again
    return keep


def _fitted(given: Observations, frequency: Array, chance: Array) -> Lines:
    """All lines together, by Gauss and Newton from these frequencies (K,).

    Raises:
        JitterError: two of them cannot be told apart.
    """
    axes, count, value = given.axes, len(frequency), given.rest(given.value)
    f = frequency.copy()
    width = 1 + 2 * axes
    empty = np.zeros((count * width, count * width))
    for _ in range(_ROUNDS):
        waves = given.rest(given.waves(f)).reshape(len(value), -1)
        linear = np.linalg.lstsq(waves, value, rcond=None)[0].reshape(count, 2, axes)
        lines = Lines(
            f, np.asarray(linear[:, 0], np.float64), np.asarray(linear[:, 1], np.float64), empty, chance, given.middle
        )
        by = given.rest(_columns(given, lines))
        size = np.linalg.norm(by, axis=0)
        if not np.all(size > 0.0):
            raise JitterError("an oscillation that was found moves nothing")
        left = value - waves @ linear.ravel()
        u, s, vt = np.linalg.svd(by / size, full_matrices=False)
        if s[-1] < 1e-8 * s[0]:
            raise JitterError("two oscillations that were found cannot be told apart")
        step = (vt.T @ ((u.T @ left) / s)) / size
        # half a resolution element at most
        move = np.clip(step[::width], -0.5 / given.span, 0.5 / given.span)
        f = f + move
        if np.max(np.abs(move)) * given.span < _ARRIVED:
            break
    if np.max(np.abs(f - frequency)) * given.span > _ASTRAY:
        raise JitterError("an oscillation that was found is none of one frequency")
    factor = float(left @ left) / max(given.freedom - count * width, 1)
    spread = (vt.T / s**2) @ vt / size[:, None] / size
    return replace(lines, frequency=f, covariance=np.asarray(factor * spread))


@dataclass(frozen=True, eq=False)
class Course:
    """An attitude over time as a cubic spline, with the covariance of its coefficients.

    Attributes:
        knots: (K + 4,) seconds.
        coefficients: (K, A) radians.
        covariance: (K A, K A), of the coefficients of all axes of the first spline, then of the next.
    """

    knots: Array
    coefficients: Array
    covariance: Array

    def basis(self, seconds: ArrayLike) -> Array:
        """(T, K) values of the splines at times (T,) within the knots."""
        return np.asarray(BSpline.design_matrix(np.asarray(seconds, np.float64), self.knots, 3).toarray())

    def at(self, seconds: ArrayLike) -> tuple[Array, Array]:
        """Attitude (T, A), radians, at times (T,), and its covariance (T, A, A)."""
        by = self.basis(seconds)
        axes = self.coefficients.shape[1]
        spread = self.covariance.reshape(by.shape[1], axes, by.shape[1], axes)
        return by @ self.coefficients, np.asarray(np.einsum("tk,kalb,tl->tab", by, spread, by, optimize=True))


def splined(given: Observations, interval: float, sigma: float) -> Course:
    """The attitude as a cubic spline of which nothing is known but how large it may be: for jitter that is no lines.

    What differences between moments do not tell, such as its mean and blind frequencies, keeps the prior's variance.

    Args:
        given: what was observed.
        interval: of the knots, seconds; oscillations of a period below two of them are not in it.
        sigma: standard deviation of a coefficient before the observations, radians.

    Raises:
        JitterError: no time between the first and the last moment.
    """
    first, last = given.ends
    if not last > first or not interval > 0.0:
        raise JitterError("a course needs moments that lie apart and an interval above zero")
    count = max(int(np.ceil((last - first) / interval)), 1)
    inner = np.linspace(first, last, count + 1)
    step = inner[1] - inner[0]
    knots = np.concatenate([first - step * np.arange(3, 0, -1), inner, last + step * np.arange(1, 4)])
    axes, splines = given.axes, len(knots) - 4
    by = np.zeros((len(given.value), splines, axes))
    for j in range(given.time.shape[1]):
        values = BSpline.design_matrix(np.clip(given.time[:, j], first, last), knots, 3).toarray()
        by += values[given.group][:, :, None] * given.weight[:, j, None]
    design = given.rest(by.reshape(len(given.value), -1))
    left = given.rest(given.value)
    normal = design.T @ design + np.eye(splines * axes) / sigma**2
    covariance = np.linalg.inv(normal)
    solved = np.asarray(covariance @ (design.T @ left), np.float64)
    return Course(knots, solved.reshape(splines, axes), np.asarray(covariance, np.float64))
