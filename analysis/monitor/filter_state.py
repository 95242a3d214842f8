"""State of the filter of a series: its readings, their innovations, and the estimate with its covariance."""

from __future__ import annotations

from dataclasses import dataclass, replace

from analysis.arrays import Array
from analysis.monitor.jump_detection import Jump


@dataclass(frozen=True, eq=False)
class Observed:
    """One reading: of all spots, or of d sensors or combinations of parameters.

    Attributes:
        time: seconds.
        value: (D,) shifts of the spots since the reference, px; (d,) of another reading, in its unit.
        noise: its covariance.
        sensors: numbers of the sensors of `HeatInputs` that read it, d of them.
        parameters: (d, P) rows on the parameters that it reads.
    """

    time: float
    value: Array
    noise: Array
    sensors: tuple[int, ...] = ()
    parameters: Array | None = None

    @property
    def spots(self) -> bool:
        """Return whether the reading is one of the spots."""
        return not self.sensors and self.parameters is None


@dataclass(frozen=True)
class BadReading:
    """Evidence that a reading is bad.

    Attributes:
        log_ratio: logarithm of the likelihood if it is bad, chance beforehand included, over that if it is not.
        z: the coordinate that is furthest from what all others and the past make of it, in standard deviations.
        coordinate: number of it.
    """

    log_ratio: float
    z: float
    coordinate: int


@dataclass(frozen=True, eq=False)
class Innovation:
    """A reading against what was expected of it before it came.

    Attributes:
        observed: the reading.
        white: (d,) the difference in independent standard deviations.
        log_score: logarithm of the density that was stated for what came.
        jump: told at this reading; None for none.
        bad: what speaks for the reading being bad, where it was set aside; None where it was taken.
        earlier: the reading that was set aside before it, if that was taken after all.
        settled: whether one was set aside before it, of which it is decided now whether it is taken or left out.
    """

    observed: Observed
    white: Array
    log_score: float
    jump: Jump | None = None
    bad: BadReading | None = None
    earlier: Innovation | None = None
    settled: bool = False

    @property
    def chi_square(self) -> float:
        """Return chi-square, of as many degrees of freedom as numbers were read."""
        return float(self.white @ self.white)


@dataclass(frozen=True, eq=False)
class Track:
    """A filter, and what steps just before each of L readings would do to it.

    Attributes:
        mean: (n,); covariance: (n, n).
        response: (L, n, q) of the mean to steps of unit outputs.
        score: (L, q) b of the module's text; information: (L, q, q) J.
    """

    mean: Array
    covariance: Array
    response: Array
    score: Array
    information: Array

    def alone(self) -> Track:
        """The filter without steps that are looked for."""
        return replace(self, response=self.response[:0], score=self.score[:0], information=self.information[:0])


@dataclass(frozen=True, eq=False)
class Whitened:
    """A reading divided by the root of its covariance.

    Attributes:
        root: Cholesky factor (d, d) of its covariance, noise included.
        white: (d,) root^-1 (value - what was expected).
        rows: (d, n) root^-1 H; gain: (d, n) root^-1 H P; picked: (d, q) root^-1 what unit outputs do to it.
    """

    root: Array
    white: Array
    rows: Array
    gain: Array
    picked: Array


@dataclass(frozen=True, eq=False)
class Aside:
    """A reading that was set aside until the next one, since it may be bad or the first after a jump.

    Attributes:
        taken: what is known if it is good.
        innovation: of it.
        log_odds: logarithm of the odds that it is bad.
    """

    taken: Belief
    innovation: Innovation
    log_odds: float


@dataclass(frozen=True, eq=False)
class Belief:
    """All that is known from the readings so far.

    Attributes:
        time: of the newest reading or of the start, seconds.
        last: time of the newest reading of spots; NaN before the first.
        after, until: (L,) between which times each step that is looked for comes, seconds.
        state: the filter. search: the one that looks for jumps, which knows of no walk; None where they are the same.
        left: (m,) what share of the mean square of jumps cannot be told, of each motion of a stated rate.
        recent: whether each of the last readings of spots was left out as a bad one.
        aside: a reading after which this is what is known if it is bad; None for none.
    """

    time: float
    last: float
    after: Array
    until: Array
    state: Track
    search: Track | None
    left: Array
    recent: tuple[bool, ...] = ()
    aside: Aside | None = None

    @property
    def mean(self) -> Array:
        """(n,) of the states."""
        return self.state.mean

    @property
    def covariance(self) -> Array:
        """(n, n) of the states."""
        return self.state.covariance

    @property
    def looking(self) -> Track:
        """The filter that looks for jumps."""
        return self.state if self.search is None else self.search
