"""Tolerance budget of an input file: tolerances, compensators and the requirements on the camera."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from optics.geometry.zernike import MAX_NOLL
from optics.numerics.number_tree import FrozenMap
from scenes.specs.course import noll
from scenes.specs.disturbances import JobDisturbances
from scenes.specs.perturbation import PURE, motion_of
from scenes.specs.resolved import ExperimentSetup, ResolvedJob, resolve_on
from scenes.specs.study import MOST_RUNS, LimitsSpec
from scenes.yaml import units
from scenes.yaml.errors import Problem, shown
from scenes.yaml.spec import Flag, Name, Named, NothingIsEmpty, Number, Ref, Seed, Spec, Text, Whole

Amount = Annotated[str, Field(strict=True, max_length=100)] | Number
"""Quantity with its unit, or a pure number if the motion has no unit."""
Share = Annotated[Number, Field(gt=0.0, lt=1.0)]
Cost = Annotated[Number, Field(gt=0.0)]

MEASURES: Mapping[str, units.Kind] = FrozenMap(
    dict.fromkeys(("shift", "figure"), units.LENGTH)
    | dict.fromkeys(("scale", "radius", "abbe"), units.SCALE)
    | {"rotate": units.ANGLE, "temperature": units.TEMPERATURE_DIFFERENCE, "gradient": units.TEMPERATURE_GRADIENT}
)
"""Kind of a motion -> kind of quantity of its amounts; the other amounts are pure numbers."""
MOST_ABBE = 0.1
"""Upper bound of the relative tolerance limit of an Abbe number. The program also traces ten times the limit, which
must stay below 1 for the Abbe number to remain positive.
"""
SPECTRUM = "figure"
"""Kind of motion `figure`: written without a Zernike term, it means a figure error of many terms with a power spectrum.
"""


class Varied(Spec):
    """Base of tolerances, compensators and actuators: a motion of a body without its amount, as text.

    Attributes
    ----------
    motion : str
        Motion of one body without an amount: `M2 shift z`, `M2 rotate x about centre`, `M1 radius`.
    carrying : tuple[str, ...]
        Further bodies that move rigidly with it, about the same point.
    """

    motion: Text
    carrying: tuple[Text, ...] = ()

    @model_validator(mode="after")
    def _is_a_motion(self) -> Varied:
        node, kind, _, amount, _ = self.parts
        if amount:
            raise Problem("the motion has an amount", shown(self.motion), f"{node} {kind} ...", within=("motion",))
        if self.carrying and kind not in ("shift", "rotate"):
            raise Problem("only shift and rotate carry others", kind, "shift or rotate", within=("carrying",))
        return self

    @property
    def parts(self) -> tuple[str, str, str, str, str]:
        """Parts of the motion's text: node, kind, axis or term, amount (empty) and pivot."""
        return motion_of(self.motion)

    def si(self, value: Amount, key: str, positive: bool = False) -> float:
        """Return an amount of this motion in the SI unit.

        Raises
        ------
        Problem
            The unit of the amount is not one of the motion, or the amount must be greater than zero and is not.
        """
        kind = self.parts[1]
        try:
            number = amount_si(value, kind)
        except Problem as problem:
            raise problem.below(key) from None
        if positive and not number > 0.0:
            raise Problem("not greater than zero", shown(value), within=(key,))
        return number


def amount_si(value: Amount, kind: str) -> float:
    """Return an amount of a kind of motion in the SI unit; raise `Problem` for a missing or wrong unit."""
    if kind in PURE:
        if isinstance(value, str):
            raise Problem(f"a change of the {kind} is a pure number", shown(value), "a number such as 1e-4")
        return float(value)
    return units.parse_quantity(value, MEASURES[kind])


def amount_text(value: float, kind: str) -> str | float:
    """Return an amount of a kind of motion as files write it: with its unit, or as a number without one."""
    return value if kind in PURE else units.format_quantity(value, MEASURES[kind])


class ToleranceSpec(Varied):
    """Tolerance of one parameter.

    Attributes
    ----------
    motion
        Parameter: `M2 shift z`, `M2 rotate x about centre`, `M1 radius`, `M1 conic`, `L1 index`, `L1 abbe` (relative),
        `M2 figure Z7`, `base temperature`; `M1 figure` alone is a figure error of many terms.
    carrying
        Further bodies that move rigidly with the first.
    limit : str | float
        Largest deviation in either direction; for a figure error its rms over the clear aperture, about its mean.
    law : {'normal', 'uniform', 'ends'}
        Distribution: `normal` with the limit at `sigmas` standard deviations; `uniform` within the limit; `ends`, one
        of both ends.
    sigmas : float
        Number of standard deviations of a normal distribution at the limit.
    mean : str | float | None
        Mean of the distribution, for a deviation that has been measured and is not corrected; zero by default.
    measured : tuple[str | float, ...] | None
        Measured deviations of such parts, each drawn equally often, instead of a distribution.
    terms : tuple[str, str] | None
        First and last Zernike term (Noll) of a figure error, `[Z5, Z36]`.
    power : float
        Exponent of a figure error's spectrum: the variance of its terms falls with this power of their radial order.
    cost : float
        Cost of the specified limit, in any unit.
    exponent : float
        Exponent of the cost: it is proportional to the inverse limit to this power.
    costs : tuple[tuple[str | float, float], ...] | None
        Known costs of limits, `[[20 um, 1], [10 um, 3]]`, instead of cost and exponent; they are interpolated and
        extrapolated by a smooth curve in logarithms.
    kept : bool
        True if the allocation must not change this limit.
    """

    limit: Amount
    law: Literal["normal", "uniform", "ends"] = "normal"
    sigmas: Annotated[Number, Field(gt=0.0, le=6.0)] = 2.0
    mean: Amount | None = None
    measured: Annotated[tuple[Amount, ...], Field(min_length=2, max_length=10_000)] | None = None
    terms: tuple[Text, Text] | None = None
    power: Annotated[Number, Field(ge=0.0, le=10.0)] = 3.0
    cost: Cost = 1.0
    exponent: Annotated[Number, Field(gt=0.0, le=5.0)] = 1.0
    costs: Annotated[tuple[tuple[Amount, Cost], ...], Field(min_length=2, max_length=50)] | None = None
    kept: Flag = False

    @model_validator(mode="before")
    @classmethod
    def _whole_figure(cls, data: Any) -> Any:
        """Expand `M1 figure` to a motion with its first term, and its range of terms."""
        if isinstance(data, Mapping) and isinstance(data.get("motion"), str):
            text = data["motion"].split()
            if len(text) == 2 and text[1] == SPECTRUM:
                first, last = data.get("terms") or ("Z5", "Z36")
                return {**data, "motion": f"{data['motion']} {first}", "terms": (first, last)}
        return data

    @model_validator(mode="after")
    def _is_a_tolerance(self) -> ToleranceSpec:
        self.si(self.limit, "limit", positive=True)
        if self.parts[1] == "abbe" and self.limit_si >= MOST_ABBE:
            problem = "the limit is too large: the program tries ten times the limit"
            raise Problem(problem, shown(self.limit), "less than 10 percent", within=("limit",))
        if self.mean is not None:
            self.si(self.mean, "mean")
        for value in self.measured or ():
            self.si(value, "measured")
        if self.measured is not None and (self.mean is not None or self.law != "normal"):
            raise Problem("measured values have no law and no mean", None, "measured: [...]", within=("measured",))
        self._costs_fall()
        if self.terms is not None:
            if self.parts[1] != SPECTRUM:
                raise Problem("only a figure error has terms", self.motion, "M1 figure", within=("terms",))
            first, last = (noll(term) for term in self.terms)
            if not 4 <= first < last <= MAX_NOLL:
                actual = f"{self.terms[0]} to {self.terms[1]}"
                raise Problem("not a range of terms", actual, f"Z5 to Z36, at most Z{MAX_NOLL}", within=("terms",))
            if self.law != "normal" or self.mean is not None or self.measured is not None:
                problem = "the terms of a figure error are distributed normally about zero"
                raise Problem(problem, None, "no law, mean or measured", within=("law",))
        return self

    def _costs_fall(self) -> None:
        """Raise `Problem` for costs that contradict each other or `cost` and `exponent`."""
        if self.costs is None:
            return
        if (self.cost, self.exponent) != (1.0, 1.0):
            raise Problem("costs replace cost and exponent", None, "one of both", within=("costs",))
        points = sorted((self.si(limit, "costs", positive=True), cost) for limit, cost in self.costs)
        for (limit, cost), (looser, less) in pairwise(points):
            if not limit < looser or less > cost:
                problem = "costs must decrease with the limit, with one cost for each limit"
                raise Problem(problem, f"{cost:g} and {less:g}", "costs that fall with the limit", within=("costs",))

    @property
    def cost_points(self) -> tuple[tuple[float, float], ...]:
        """Known costs: limits relative to the specified limit, ascending, and the cost of each; at least two."""
        if self.costs is None:
            return (1.0, self.cost), (2.0, self.cost * 2.0**-self.exponent)
        return tuple(sorted((amount_si(limit, self.parts[1]) / self.limit_si, cost) for limit, cost in self.costs))

    @property
    def spectrum(self) -> tuple[int, ...]:
        """Noll indices of the Zernike terms of a figure error of many terms; empty for other parameters."""
        return () if self.terms is None else tuple(range(noll(self.terms[0]), noll(self.terms[1]) + 1))

    @property
    def words(self) -> str:
        """Text of the motion that varies; `M1 figure` for a figure error of many terms."""
        return self.motion if self.terms is None else self.motion.rsplit(maxsplit=1)[0]

    @property
    def limit_si(self) -> float:
        """Largest deviation in either direction, in the SI unit."""
        return amount_si(self.limit, self.parts[1])

    @property
    def mean_share(self) -> float:
        """Mean of the distribution, divided by the limit."""
        return 0.0 if self.mean is None else amount_si(self.mean, self.parts[1]) / self.limit_si

    @property
    def measured_shares(self) -> tuple[float, ...]:
        """Measured deviations, divided by the limit."""
        return tuple(amount_si(value, self.parts[1]) / self.limit_si for value in self.measured or ())


class CompensatorSpec(Varied):
    """Compensator: an adjustment of every camera. Compensators are applied in the order of the file.

    Attributes
    ----------
    motion
        Motion of the compensator: `focal_plane shift z`.
    carrying
        Further bodies that move rigidly with the first.
    range : str | float
        Largest amount in either direction; zero disables the compensator.
    step : str | float | None
        Step of which the amount is a multiple; by default any amount is possible.
    accuracy : str | float | None
        Standard deviation of the error of an adjustment; zero by default.
    """

    range: Amount
    step: Amount | None = None
    accuracy: Amount | None = None

    @model_validator(mode="after")
    def _is_a_compensator(self) -> CompensatorSpec:
        if self.si(self.range, "range") < 0.0:
            raise Problem("a range is not negative", shown(self.range), within=("range",))
        if self.step is not None:
            self.si(self.step, "step", positive=True)
        if self.accuracy is not None and self.si(self.accuracy, "accuracy") < 0.0:
            raise Problem("a standard deviation is not negative", shown(self.accuracy), within=("accuracy",))
        return self

    @property
    def range_si(self) -> float:
        """Largest amount of the adjustment in either direction, in the SI unit."""
        return amount_si(self.range, self.parts[1])

    @property
    def step_si(self) -> float:
        """Step of which the adjustment is a multiple, in the SI unit; 0 if any amount is possible."""
        return 0.0 if self.step is None else amount_si(self.step, self.parts[1])

    @property
    def accuracy_si(self) -> float:
        """Standard deviation of the error of an adjustment, in the SI unit; 0 if it is exact."""
        return 0.0 if self.accuracy is None else amount_si(self.accuracy, self.parts[1])


FieldShare = Annotated[Number, Field(ge=-1.0, le=1.0)]
NINE = tuple((x, y) for x in (-1.0, 0.0, 1.0) for y in (-1.0, 0.0, 1.0))
"""Default fields of a merit: fractions of the half field along the line and along the track."""
MERIT_UNITS: Mapping[str, units.Kind | None] = FrozenMap(
    dict.fromkeys(("wavefront", "mtf", "obstruction"))
    | dict.fromkeys(("boresight", "roll", "chief_ray", "monitor_angle"), units.ANGLE)
    | dict.fromkeys(("principal_distance", "distortion", "monitor_focus"), units.LENGTH)
)
"""Kind of a merit -> kind of quantity of its value; None for a number (waves of the design wavelength, MTF)."""
OfOptics = Literal[
    "wavefront", "mtf", "boresight", "roll", "principal_distance", "distortion", "chief_ray", "obstruction"
]
OfMonitor = Literal["monitor_angle", "monitor_focus"]
MORE_IS_BETTER = ("mtf",)
OF_MONITOR = ("monitor_angle", "monitor_focus")
"""Kinds of merits that are standard deviations of the monitor's readings."""
POSTERIOR = "posterior"
"""Estimator of a monitor's readings with the smallest variance."""


class MeritSpec(Spec):
    """Merit: a requirement on the camera.

    Attributes
    ----------
    kind : str
        Quantity: `wavefront`, rms wavefront error in waves of the design wavelength; `mtf` of the optics; `boresight`,
        rotation of the line of sight; `roll` of the line about the line of sight; `principal_distance`, its change;
        `distortion`, largest change of an image position along the line that rotation, roll and principal distance do
        not explain; `chief_ray`, largest rotation of a chief ray at the line CCD; `obstruction`, largest fraction of a
        field's beam, by area of the stop, that bodies of the instrument block; `monitor_angle` and `monitor_focus`,
        standard deviation of the monitor's readings of a rotation and of `d_f` under the disturbances. The budget's
        `light` selects the light for wavefronts and MTFs.
    fields : tuple[tuple[float, float], ...]
        Fields for wavefront, mtf, chief_ray and obstruction, of which the worst one counts: fractions of the half
        field, [along the line, along the track].
    frequency : float | None
        Spatial frequency of mtf, in cycles per mm; by default the Nyquist frequency of the pixels.
    direction : {'line', 'track', 'worse'}
        Direction of mtf: along the line, along the track, or the worse of both.
    reading : {'angle', 'd_alpha', 'd_beta', 'd_gamma'} | None
        Reading of monitor_angle: `angle` between the lines of sight of a pair, or `d_alpha`, `d_beta`, `d_gamma` of the
        camera; by default the angle of a pair, and the worst of these three for one camera.
    estimator : str
        Estimator of the monitor's readings.
    at_most : str | float | None
        Largest value that passes, for all kinds but mtf; changes are judged by their absolute value.
    at_least : float | None
        Smallest value that passes, for mtf.
    probability : float
        Required fraction of cameras that pass.
    loss : str | float | None
        Loss of the merit that a single tolerance may cause, for the inverse sensitivity analysis; by default the margin
        between design and requirement over the square root of the number of tolerances.
    """

    kind: Literal[OfOptics, OfMonitor]
    fields: Annotated[tuple[tuple[FieldShare, FieldShare], ...], Field(min_length=1, max_length=100)] = NINE
    frequency: Annotated[Number, Field(gt=0.0, le=10_000.0)] | None = None
    direction: Literal["line", "track", "worse"] = "worse"
    reading: Literal["angle", "d_alpha", "d_beta", "d_gamma"] | None = None
    estimator: Name = POSTERIOR
    at_most: Amount | None = None
    at_least: Number | None = None
    probability: Share = 0.9
    loss: Amount | None = None

    @model_validator(mode="after")
    def _asks(self) -> MeritSpec:
        more = self.kind in MORE_IS_BETTER
        wanted, other = ("at_least", "at_most") if more else ("at_most", "at_least")
        if getattr(self, wanted) is None or getattr(self, other) is not None:
            raise Problem(f"a merit of kind {self.kind} needs {wanted}, and only that", other, f"{wanted}: ...")
        for key in ("at_most", "loss"):
            value = getattr(self, key)
            if value is not None and not self._si(value, key) > 0.0:
                raise Problem("not greater than zero", shown(value), within=(key,))
        if self.kind != "mtf" and (self.frequency is not None or self.direction != "worse"):
            raise Problem(f"{self.kind} has no frequency and no direction", self.kind, "kind: mtf", within=("kind",))
        if self.kind != "monitor_angle" and self.reading is not None:
            raise Problem(f"{self.kind} has no reading", self.kind, "kind: monitor_angle", within=("kind",))
        if self.kind not in OF_MONITOR and self.estimator != POSTERIOR:
            raise Problem(f"{self.kind} has no estimator", self.kind, " or ".join(OF_MONITOR), within=("kind",))
        return self

    def _si(self, value: Amount, key: str) -> float:
        unit = MERIT_UNITS[self.kind]
        if unit is None:
            if isinstance(value, str):
                raise Problem(f"{self.kind} is a pure number", shown(value), "a number without a unit", within=(key,))
            return float(value)
        try:
            return units.parse_quantity(value, unit)
        except Problem as problem:
            raise problem.below(key) from None

    @property
    def more_is_better(self) -> bool:
        """True if the merit passes for large values, as an MTF does."""
        return self.kind in MORE_IS_BETTER

    @property
    def requirement(self) -> float:
        """Value of the merit that just passes, in the SI unit."""
        if self.at_least is not None:
            return float(self.at_least)
        assert self.at_most is not None
        return self._si(self.at_most, "at_most")

    @property
    def loss_si(self) -> float | None:
        """Loss of the merit that a single tolerance may cause, in the SI unit; None for the default."""
        return None if self.loss is None else self._si(self.loss, "loss")


class AllocationSpec(Spec):
    """Allocation of limits that achieve the yield at the smallest cost.

    Attributes
    ----------
    target : float
        Yield: fraction of cameras that must pass all requirements.
    grades : tuple[float, ...]
        Preferred numbers: limits are rounded to these times powers of ten.
    loosest : float
        Largest factor by which a limit may increase.
    tightest : float
        Largest factor by which a limit may decrease.
    """

    target: Share = 0.9
    grades: Annotated[tuple[Annotated[Number, Field(ge=1.0, lt=10.0)], ...], Field(min_length=1)] = (1.0, 2.0, 5.0)
    loosest: Annotated[Number, Field(ge=1.0, le=1000.0)] = 10.0
    tightest: Annotated[Number, Field(ge=1.0, le=1000.0)] = 10.0


class ToleranceBudgetSpec(Spec):
    """Tolerance budget of a camera.

    Attributes
    ----------
    instrument : str
        Camera or instrument, by name or path, as in a job.
    camera : str | None
        Name of the camera that is judged; may be omitted if the instrument has one camera.
    disturbances : JobDisturbancesSpec | None
        Disturbances between two measurements of the monitor, as in a job; by default those of the instrument.
    tolerances : Mapping[str, ToleranceSpec]
        Name -> tolerance of one parameter of the camera.
    compensators : Mapping[str, CompensatorSpec]
        Name -> adjustment of every camera, in this order; the adjustments minimise the mean square wavefront error over
        all fields of the merits.
    merits : Mapping[str, MeritSpec]
        Name -> requirement on the camera.
    light : {'spectrum', 'design'} | None
        Light for wavefronts and MTFs: `spectrum` of the camera, or `design` for its design wavelength alone. By default
        the spectrum for a camera with lenses that has one, else the design wavelength.
    samples : int
        Number of cameras in the Monte Carlo run.
    seed : int
        Seed of all random numbers.
    allocation : AllocationSpec | None
        Allocation of new limits; by default the limits are not changed.
    limits : LimitsSpec
        Limits on the resources of the Monte Carlo run.
    """

    instrument: Ref
    camera: Name | None = None
    disturbances: JobDisturbances | None = None
    tolerances: Annotated[Named[ToleranceSpec], Field(min_length=1, max_length=300)]
    compensators: Annotated[Named[CompensatorSpec], NothingIsEmpty] = Field(default_factory=FrozenMap)
    merits: Annotated[Named[MeritSpec], Field(min_length=1, max_length=50)]
    light: Literal["spectrum", "design"] | None = None
    samples: Annotated[Whole, Field(ge=20, le=MOST_RUNS)] = 1000
    seed: Seed = 0
    allocation: AllocationSpec | None = None
    limits: Annotated[LimitsSpec, NothingIsEmpty] = LimitsSpec.model_construct()

    @model_validator(mode="after")
    def _disturbances_have_readings(self) -> ToleranceBudgetSpec:
        if self.disturbances is not None and not any(merit.kind in OF_MONITOR for merit in self.merits.values()):
            allowed = f"a merit of kind {' or '.join(OF_MONITOR)}, or no disturbances"
            raise Problem("no merit depends on disturbances", None, allowed, within=("disturbances",))
        return self


class ToleranceSetup(ExperimentSetup[ToleranceBudgetSpec]):
    """Tolerance budget, with the content of its instrument's files.

    Attributes
    ----------
    base : ResolvedJob
        Nominal job of the instrument.
    draws : dict[str, float]
        Name of a varied parameter -> its deviation in one camera of the Monte Carlo run, in units of its limit; zero
        for missing names.
    """

    base: ResolvedJob
    draws: Annotated[dict[str, Number], NothingIsEmpty] = Field(default_factory=FrozenMap)

    @classmethod
    def parts(cls, test: ToleranceBudgetSpec) -> dict[str, Any]:
        """Read the instrument as the job without perturbation; return field -> content."""
        return {"base": resolve_on(test, test.instrument, test.disturbances)}
