"""Paper 004, section 2: the focal plane after one round of shims, from rendered edges."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from optics.threads import one_blas_thread
from scenes.lab_setup import resolve_focus
from twin.artefact import Cell, Table
from twin.edge_images import TRACK
from twin.laboratory.focus import Alignment, align
from twin.laboratory.focus_bench import FocusBench
from twin.laboratory.focus_json import ARCMIN, to_dict
from twin.laboratory.printed_004 import CONFOCAL_UM, LINE_LEVEL_ARCMIN, MTF_NYQUIST
from twin.validation import laboratory_004_distortion, laboratory_004_equations, laboratory_004_turntable
from twin.validation.check import Check, CheckResult
from twin.validation.group import CheckGroup, Context

TEST = "focus"
ALIGNMENTS = 3
"""Alignments from random mis-settings."""

_MTF = "10 %: two digits are printed, and neither wavefront error nor detector: "
_REASONS = {
    "P": _MTF + "0.01 waves more or less of 0.06 are 5 % (Maréchal), 0.2 µm of charge diffusion of 1.4 µm as much",
    "B": _MTF + "a tenth of the line period more or less of exposure is 8 %",
}

CHECKS = (
    *(
        Check(f"004.table1.{band}", "Table 1", f"MTF of the camera at the Nyquist frequency of {band}", "1", value,
              0.1 * value, _REASONS[band[0]])
        for band, value in MTF_NYQUIST.items()
    ),
    Check("004.confocal", "section 2.3", "One round of shims brings every CCD to within 0.04 mm of best focus: largest "
          "true distance of any alignment", "mm", 1e-3 * CONFOCAL_UM, 0.0, "the bound itself", "at most"),
    Check("004.level", "section 2.3", "One round of shims leaves the line level to 1 arcmin: largest true turn of any "
          "alignment", "arcmin", LINE_LEVEL_ARCMIN, 0.0, "the bound itself", "at most"),
)  # fmt: skip


def run(context: Context) -> Iterator[CheckResult]:
    """Align mis-set focal planes, one if only the MTF is wanted."""
    context.progress(0.0, "build the bench")
    count = ALIGNMENTS if context.wants("004.confocal", "004.level") else 1
    with one_blas_thread():
        bench = FocusBench(resolve_focus(TEST), context.backend)
        alignments = []
        for k, seed in enumerate(np.random.SeedSequence(context.seed).generate_state(count)):
            share = 0.1 + 0.9 * k / count
            context.progress(share, f"alignment {k + 1} of {count}")
            alignments.append(align(bench, int(seed)))
    if context.wants("004.table1"):
        yield from _mtf(context, alignments[0])
    if context.wants("004.confocal", "004.level"):
        yield from _bounds(context, alignments)


def _mtf(context: Context, alignment: Alignment) -> Iterator[CheckResult]:
    data = to_dict(alignment)
    measured, true = data["rounds"][-1], data["truth"]["rounds"][-1]
    budget = {line["band"]: line["factors"] for line in data["mtf_budget"] if line["direction"] == TRACK}
    rows: list[list[Cell]] = []
    for band, printed in MTF_NYQUIST.items():
        value, sigma = measured["mtf_nyquist"][band], measured["mtf_nyquist_sigma"][band]
        factors = budget[band]
        perfect = factors["diffraction"] * factors["pixel"]
        rest = {name.replace("_", " "): v for name, v in factors.items() if name not in ("diffraction", "pixel")}
        numbers = (value, sigma, true["mtf_nyquist"][band], perfect, *rest.values())
        rows.append([band, f"{printed:.2f}", *(f"{number:.4f}" for number in numbers)])
        if f"004.table1.{band}" in context.selected:
            lost = ", ".join(f"{name} {v:.3f}" for name, v in rest.items())
            how = (
                f"Rendered slanted edge along the track, mean of {len(alignment.bench.setup.test.fields)} fields after "
                f"one alignment; traced truth there {true['mtf_nyquist'][band]:.4f}. A perfect camera with these "
                f"pixels has {perfect:.3f}; what the scene file assumes beyond the paper takes the rest ({lost})."
            )
            yield context.check(f"004.table1.{band}").judge(value, sigma, how)
    context.add(
        Table(
            "table1",
            "Table 1: MTF at the Nyquist frequency",
            "Along the track, mean over the fields. Perfect: diffraction and pixel alone, in the middle of the field; "
            "beside it the factors that make the difference.",
            ("band", "printed", "measured", "sigma", "true", "perfect", *rest),
            rows,
        )
    )


def _bounds(context: Context, alignments: Sequence[Alignment]) -> Iterator[CheckResult]:
    def worst(number: int) -> np.ndarray:
        return np.array([1e3 * np.max(np.abs(a.states[number].true_defocus)) for a in alignments])

    before, after = worst(0), worst(-1)
    turns = [np.array([abs(a.states[k].true_level) / ARCMIN for a in alignments]) for k in (0, -1)]
    sites = f"{len(alignments)} alignments of {len(alignments[0].bench.sites)} fields and bands, by the traced pupils"
    if "004.confocal" in context.selected:
        how = f"{sites}: before {_list(before, 2)} mm, after {_list(after, 4)} mm."
        yield context.check("004.confocal").judge(float(np.max(after)), None, how)
    if "004.level" in context.selected:
        plan = alignments[0].bench.setup.test
        how = (
            f"{len(alignments)} alignments: before {_list(turns[0], 2)}′, after {_list(turns[1], 2)}′; theodolite and "
            f"setting have {plan.level / ARCMIN:.2f}′ each."
        )
        yield context.check("004.level").judge(float(np.max(turns[1])), None, how)


def _list(values: np.ndarray, digits: int) -> str:
    return ", ".join(f"{value:.{digits}f}" for value in values)


GROUP = CheckGroup("004.focus", "Focal-plane alignment (section 2)", 60.0, CHECKS, run)
GROUPS = (GROUP, laboratory_004_equations.GROUP, laboratory_004_turntable.GROUP, laboratory_004_distortion.GROUP)
"""All of paper 004."""
