"""Checks of paper 003's rigorous model, with the figure of what the points cannot tell."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from analysis.arrays import ARCSEC
from analysis.orbit.three_line_model import BIAS, INTERIOR
from optics.numerics.backend import one_blas_thread
from scenes.specs.orbit.angle import LINES
from scenes.specs.orbit.calibration import CalibrationImagesSpec
from scenes.specs.orbit.setup import CalibrationSetup
from twin.orbit.calibration.calibration_run import source_of
from twin.orbit.calibration.campaign import Campaign
from twin.orbit.calibration.campaign_adjustment import calibrated_alone
from twin.run.random_streams import stream
from twin.run.svg import BLUE, GREY, VERMILION, look, new_figure, plain_axes, to_svg
from twin.validation.checks.check import CheckResult
from twin.validation.checks.group import Context, group_of
from twin.validation.paper_003 import exact, rendered
from twin.validation.paper_003 import rendered as marks
from twin.validation.paper_003.exact import exact as exact_setup
from twin.validation.paper_003.rendered import FREE_INTERIOR, ROLL_PITCH, FromImages

_FOCAL = 0.65
"""Metres; angles are drawn as image motion."""
FIELD = "Beijing"
CAMPAIGNS, FAST_CAMPAIGNS = 9, 5
"""Campaigns of seven fields, in the full and in the fast run, for the errors of yaw over their sigma."""
FAST_SIDE = 380
"""Lines and pixels of a rendered patch in the fast run."""
FORM = (
    "The equations are lost in the text. Rebuilt from its words: ground = station + scale · R(measured attitude) "
    "R(bias) (position + R(camera) [−(x − x₀)(1 + d), −(y − y₀)(1 + d), f]ᵀ)."
)
_IMAGES = {
    "003.model.points", "003.model.bias", "003.model.interior", "003.model.plan", "003.model.height",
}  # fmt: skip
UNKNOWNS = len(LINES) * len(INTERIOR) + len(BIAS)
ROUNDS = (1, 3, 10, 30, 100, 300, 1000, 3000)


def open_svg(rank: exact.Rank, walk: exact.Walk) -> str:
    """Bars of the open combination, and sigmas over rounds."""
    with look("paper-003-open"):
        figure = new_figure(3.4)
        left, right = figure.subplots(1, 2)
        one = rank.open[0]
        names = [n if n.split()[-1] in "fxy" else n.split()[-1] for n in one.names]
        angle = [n.split()[-1] not in "fxy" for n in one.names]
        size = [float(c) * (_FOCAL if a else 1.0) * 1e3 for c, a in zip(one.change, angle, strict=True)]
        place = np.arange(len(names))
        left.barh(place, size, color=[VERMILION if a else BLUE for a in angle], height=0.6)
        labels = [f"{c / ARCSEC:+.0f}″" if a else f"{c * 1e3:+.2f} mm" for c, a in zip(one.change, angle, strict=True)]
        for k, label in enumerate(labels):
            left.text(0.5 * size[k], k, label, ha="center", va="center", color="white", fontsize=9.0)
        left.set_yticks(place, names)
        left.set_ylim(len(names) - 0.5, -0.5)
        left.axvline(0.0, color=GREY, lw=0.8)
        left.set_xlabel("image motion of each alone [mm]")
        left.set_title(f"Together: {rank.moved:.4f} px instead of {rank.alone:.0f} px, x of 0.1 mm")
        rounds, away = list(walk.after), list(walk.after.values())
        right.loglog(rounds, away, "o-", color=BLUE, ms=5)
        right.axhline(0.1, color=GREY, lw=0.9, ls="--")
        right.text(rounds[0], 0.105, "a tenth of a sigma", color=GREY, va="bottom")
        right.set_xticks((1, 10, 100, 1000), ("1", "10", "100", "1000"))
        right.set_yticks((0.01, 0.1, 1, 10), ("0.01", "0.1", "1", "10"))
        right.minorticks_off()
        right.set_xlabel("rounds of biases, then interior")
        right.set_ylabel("farthest unknown [sigmas]")
        right.set_title("Stepwise against simultaneous solution")
        for axes in (left, right):
            plain_axes(axes)
        return to_svg(figure)


@one_blas_thread()
def run(context: Context) -> Iterator[CheckResult]:
    """Exact data first, then one drawn field, then rendered ones."""
    seed = np.random.SeedSequence(context.seed, spawn_key=(3, 1))
    if {"003.model", "003.equations", "003.equations.exact"} & context.selected:
        yield from _exact(context, seed)
    if {"003.model.rank", "003.model.stepwise"} & context.selected:
        yield from _simulated(context, stream(seed, 2))
    if "003.model.bias.yaw" in context.selected:
        yield _yaw(context, stream(seed, 4))
    images = [i for i in context.selected if i in _IMAGES]
    if images:
        yield from _rendered(context, stream(seed, 3))


def exact_and_images() -> CalibrationSetup:
    """The field without noise, with the detectors that images need."""
    points = exact.setup_of(exact.FIELDS).test.points
    return exact_setup(exact.without_light(exact.setup_of(exact.IMAGES, (FIELD,), images=None, points=points)))


def _exact(context: Context, seed: np.random.SeedSequence) -> Iterator[CheckResult]:
    setup = exact_and_images()
    campaign = exact.exact_campaign(setup, stream(seed, 0))
    one, pitch = campaign.passes[0], setup.camera.pitch
    if "003.model" in context.selected:
        context.progress(0.02, "render marks")
        misses = exact_misses(setup, campaign, stream(seed, 1))
        worst = max(float(np.abs(v).max()) for v in misses.values())
        mean = max(float(np.abs(v.mean(axis=0)).max()) for v in misses.values())
        rows = ", ".join(f"{k} {np.abs(v).max():.4f} px" for k, v in misses.items())
        how = (
            f"{FORM} {sum(map(len, misses.values()))} marks on rough ground, in three windows over the swath of each "
            f"line, rendered through the true sensor and found by their centroids: {rows}; largest mean of a line "
            f"{mean:.4f} px. Model: true interior and bias, attitude as measured. The light goes straight here; light "
            "time, aberration (2.5 px) and refraction, which the text does not mention, are taken out of image points "
            "before the model is used."
        )
        yield context.check("003.model").evaluate(worst, None, how, 0.0)
    if "003.equations" in context.selected:
        line, name, worst = exact.derivatives(setup, one, one.bias)
        how = (
            f"The equations are lost; rebuilt as derivatives of the model. {len(one.check_ground)} ground points: each "
            "unknown of the rigorous sensor is changed to either side, and what the unchanged model misses at the new "
            f"image points is minus the coefficient. Worst: {name} of the {line} line."
        )
        yield context.check("003.equations").evaluate(worst, None, how, 0.0)
    if "003.equations.exact" in context.selected:
        worst, name = exact.recovered(campaign, pitch)
        how = (
            f"{len(one.control_ground)} control points seen by the rigorous sensor, no noise; biases of 25 to 40″ and "
            f"changes of 50 to 95 µm are found from the laboratory's values. Worst: {name}. The gauge of "
            "003.model.rank holds x and y of the nadir line."
        )
        yield context.check("003.equations.exact").evaluate(worst, None, how, 0.0)


def exact_misses(setup: CalibrationSetup, campaign: Campaign, seed: np.random.SeedSequence) -> dict[str, np.ndarray]:
    """Line -> (n, 2) by how much the model misses rendered marks, pixels."""
    return marks.missed(setup, campaign, marks.rendered_marks(setup, campaign, seed))


def _simulated(context: Context, seed: np.random.SeedSequence) -> Iterator[CheckResult]:
    setup = exact.without_light(exact.setup_of(exact.FIELDS, (FIELD,)))
    campaign = source_of(setup, seed).independent
    if "003.model.rank" in context.selected:
        found = exact.rank_of(setup, campaign)
        text = "; ".join(str(o) for o in found.open)
        how = (
            f"60 control points in three lines, 0.3 px. Open: {text}. Carried out by the rigorous sensor with x of 0.1 "
            f"mm, it moves image points by {found.moved:.4f} px, RMS; x alone moves them by {found.alone:.1f} px. y of "
            f"the nadir line against roll is open to {found.weak_sigma * 1e6:.0f} µm = "
            f"{found.weak_sigma / setup.camera.pitch:.1f} px, and is held, too."
        )
        yield context.check("003.model.rank").evaluate(found.rank, None, how, float(UNKNOWNS), [UNKNOWNS - 1.0])
        context.figure(
            "open",
            "What a calibration of one field leaves open",
            "Left: the combination of unknowns that moves no image point. Right: how many sigmas the stepwise "
            "solution is away from the simultaneous one.",
            open_svg(found, exact.walked(campaign, campaign.passes[0], ROUNDS)),
        )
    if "003.model.stepwise" in context.selected:
        way = exact.walked(campaign, campaign.passes[0])
        after = ", ".join(f"{v:.1f} after {n}" for n, v in way.after.items())
        how = (
            f"{FIELD}, 60 control points; first biases, then interior, until no step is above {exact.TOLERANCE:g} of "
            f"its own sigma: {way.found.rounds} rounds, each leaves {way.found.rate:.4f} of the slowest error, yaw "
            f"against y of the outer lines. Sigmas away: {after} rounds. The simultaneous adjustment takes "
            f"{way.together.iterations} steps. A few rounds are not enough, and small steps are no sign of an end."
        )
        yield context.check("003.model.stepwise").evaluate(way.distance, None, how, 0.0)


def image_setup(fast: bool) -> CalibrationSetup:
    """Fields of rendered images: one with fewer points in the fast run."""
    setup = exact.setup_of(exact.IMAGES, (FIELD,) if fast else (FIELD, "Anhui"))
    if not fast:
        return setup
    spec = setup.test.images
    assert isinstance(spec, CalibrationImagesSpec)
    points = spec.points.model_copy(update={"tie": 0})
    small = spec.model_copy(update={"lines": FAST_SIDE, "pixels": FAST_SIDE, "points": points})
    return setup.model_copy(update={"test": setup.test.model_copy(update={"images": small})})


def _yaw(context: Context, seed: np.random.SeedSequence) -> CheckResult:
    setup, count = exact.without_light(exact.setup_of(exact.FIELDS)), context.count(CAMPAIGNS, FAST_CAMPAIGNS)
    ratios, sigmas = [], []
    for k in range(count):
        context.progress(0.1 + 0.05 * k / count, f"fly campaign {k + 1} of {count}")
        campaign = source_of(setup, stream(seed, k)).independent
        for one in campaign.passes:
            found = calibrated_alone(campaign, one)
            sigmas.append(found.sigma[f"{one.name} yaw"])
            ratios.append((found.bias(one.name) - one.bias)[BIAS.index("yaw")] / sigmas[-1])
    rms = float(np.sqrt(np.mean(np.square(ratios))))
    how = (
        f"{len(ratios)} fields, each calibrated by itself from 60 control points, drawn with 0.3 px: no better than "
        f"003.model.points finds them in images. Largest error {float(np.max(np.abs(ratios))):.1f} sigmas. "
        f"Yaw of one field is known to {float(np.sqrt(np.mean(np.square(sigmas)))) / ARCSEC:.1f}″ only: it goes with y "
        "of the forward and backward lines. In plan that does not show, for the two cancel."
    )
    return context.check("003.model.bias.yaw").evaluate(rms, float(np.sqrt(0.5 / len(ratios))), how, 1.0)


def _rendered(context: Context, seed: np.random.SeedSequence) -> Iterator[CheckResult]:
    setup = image_setup(context.fast)

    def advance(done: float) -> None:
        context.progress(0.15 + 0.8 * done, "render patches and match points")

    campaign = rendered.measured(setup, seed, advance)
    found = rendered.calibrated(campaign)
    spec = setup.test.images
    assert spec is not None
    size = (
        f"{len(found)} field{'s' * (len(found) > 1)} of {len(spec.patches)} patches of {spec.lines} × {spec.pixels} "
        f"px, rendered by three lines: {3 * len(found) * len(spec.patches)} images"
    )
    if "003.model.points" in context.selected:
        rms, matched, wrong = rendered.matching(campaign)
        how = (
            f"{size}. {matched} places pass the matching, {wrong} of them wrong by truth; "
            "control points are identified less well by eye, and the campaigns take 0.3 px."
        )
        yield context.check("003.model.points").evaluate(rms, None, how, exact.setup_of(exact.FIELDS).test.errors.image)
    rounds = ", ".join(str(f.way.rounds) for f in found)
    for identifier, names, unit in (
        ("003.model.bias", tuple(ROLL_PITCH), ARCSEC),
        ("003.model.interior", FREE_INTERIOR, 1e-6),
    ):
        if identifier in context.selected:
            rms, sigma = _worst(found, names)
            said = " ".join(rendered.summary(f, names) for f in found)
            how = f"{size}. Error and sigma: {said} The worst field counts. Rounds of the stepwise solution: {rounds}."
            yield context.check(identifier).evaluate(
                rms / unit, sigma / unit, how, inputs=[exact.all_errors(rms / unit)]
            )
    for what in ("plan", "height"):
        if f"003.model.{what}" in context.selected:
            worst = max(found, key=lambda f: getattr(f.after, f"{what}_rms"))
            rms, before = (float(getattr(e, f"{what}_rms")) for e in (worst.after, worst.before))
            sigma = rms / float(np.sqrt(2.0 * worst.check))
            how = (
                f"{size}. {worst.check} check points of {worst.name}, matched in the same images and intersected with "
                f"the field's own parameters; {before:.0f} m before calibration. Of the same patches as the control "
                "points, whose error in the orthophoto they share."
            )
            limit = getattr(setup.test.limits, what)
            yield context.check(f"003.model.{what}").evaluate(rms, sigma, how, limit, inputs=[exact.all_errors(rms)])
    _table(context, found)


def _worst(found: tuple[FromImages, ...], names: tuple[str, ...]) -> tuple[float, float]:
    """Largest RMS error of some unknowns of any field, and its standard deviation."""
    return max(f.rms(names) for f in found)


def _table(context: Context, found: tuple[FromImages, ...]) -> None:
    rows = []
    for f in found:
        sigma = np.sqrt(np.diag(f.covariance))
        for k, (name, error) in enumerate(f.error.items()):
            unit, scale = ("arcsec", ARCSEC) if name in BIAS else ("µm", 1e-6)
            rows.append((f.name, name, unit, error / scale, float(sigma[k]) / scale))
    context.table(
        "images",
        "Calibrated from rendered images, stepwise",
        "Estimated minus true, and the sigma of the simultaneous adjustment. x and y of the nadir line are held.",
        ("field", "unknown", "unit", "error", "sigma"),
        rows,
        (None, None, None, 2, 2),
    )


GROUP = group_of("003.model", run)
