"""The crosstalk table, the factors of the printed formulas and the statements, ready for the template."""

from __future__ import annotations

import math
import re
from itertools import groupby
from typing import Any

import numpy as np

from twin.main_job.render_results import RenderRun
from twin.main_job.report_content import body_name
from twin.main_job.report_labels import PARAMETERS
from twin.monitor.crosstalk import PRINTED, CameraCrosstalk
from twin.run.artefact import SAME, SYMBOLS, fixed, plain, shown_unit, significant

WRONG = 0.1
"""A reading that departs from the truth by more than this part of it is marked ..."""
UNSEEN = 0.01
"""... if that is also more than this part of the run's noise: what a hundred units would not show is not marked."""


def crosstalk_tables(run: RenderRun) -> list[dict[str, Any]]:
    """Per camera: column groups, and rows grouped by body."""
    out = []
    recovered = run.recovered_dict()["cameras"]
    for name, table in run.crosstalk.items():
        columns = [_columns(run, table, p) for p in range(len(PARAMETERS))]
        own = recovered[name][run.judged]
        floors = [max(SAME, UNSEEN * own[f"{p.key}_sigma_noise"]) for p in PARAMETERS]
        groups = []
        ordered = sorted(range(len(table.motions)), key=lambda k: _first_use(table, k))
        for body, members in groupby(ordered, key=lambda k: table.motions[k].body):
            groups.append({"body": body_name(body), "rows": [_row(table, k, columns, floors) for k in members]})
        heads = [
            {"symbol": p.symbol, "unit": p.unit, "columns": [label for label, _ in columns[i]]}
            for i, p in enumerate(PARAMETERS)
        ]
        out.append({"name": name, "heads": heads, "groups": groups, "width": 2 + sum(1 + len(c) for c in columns)})
    return out


def _first_use(table: CameraCrosstalk, k: int) -> int:
    """Where the body of motion k comes first, so that its motions stand together."""
    return next(j for j, motion in enumerate(table.motions) if motion.body == table.motions[k].body)


def _columns(run: RenderRun, table: CameraCrosstalk, parameter: int) -> list[tuple[str, str]]:
    """(heading, estimator) of one parameter; the two printed sets share a column where they are the same formula."""
    single, joint = (table.readings[e][parameter] for e in ("paper_single", "paper_joint"))
    same = np.allclose(single, joint, rtol=1e-9, atol=0.0)
    columns = []
    for estimator in run.estimators:
        if estimator == "paper_joint" and same:
            continue
        heading = run.estimators[estimator].title
        if (estimator, parameter) in PRINTED:
            heading = "printed" if same else {"paper_single": "printed (7)", "paper_joint": "Table 1"}[estimator]
        columns.append((heading, estimator))
    return columns


def _row(table: CameraCrosstalk, k: int, columns: list[list[tuple[str, str]]], floors: list[float]) -> dict[str, Any]:
    motion = table.motions[k]
    cells = []
    for p in range(len(PARAMETERS)):
        true = float(table.true[p, k])
        cells.append({"text": significant(true), "true": True, "wrong": False})
        for _, estimator in columns[p]:
            reading = float(table.readings[estimator][p, k])
            cells.append({"text": significant(reading), "true": False, "wrong": is_wrong(reading, true, floors[p])})
    return {"label": _short(motion.label), "unit": shown_unit(motion.unit), "cells": cells}


def _short(label: str) -> str:
    """A motion's label without its body, which stands above the rows."""
    for word in ("figure ", "along ", "about "):
        if word in label:
            return (word + label.partition(word)[2]).removeprefix("figure ")
    return label.removeprefix("whole camera ")


def is_wrong(reading: float, true: float, floor: float = SAME) -> bool:
    """Whether a reading departs from the truth by more than ``WRONG`` of it and by more than ``floor``."""
    return abs(reading - true) > max(WRONG * abs(true), floor)


def factors(run: RenderRun) -> dict[str, Any]:
    """Factors of the printed formulas, a column pair per camera, and the numbers that the text quotes."""
    cameras = list(run.crosstalk)
    first = run.crosstalk[cameras[0]].factors
    rows = []
    for i, f in enumerate(first):
        mine = [(name, run.crosstalk[name].factors[i]) for name in cameras]
        rows.append(
            {
                "formula": f.formula,
                "symbol": next(p.symbol for p in PARAMETERS if p.key == f.parameter),
                "motion": f.motion,
                "cells": [
                    {
                        "key": f"{name}.{g.estimator}.{g.parameter}",
                        "by_model": fixed(float(g.by_model), 4),
                        "by_truth": fixed(float(g.by_truth), 4),
                    }
                    for name, g in mine
                ],
            }
        )
    texts: dict[tuple[str, ...], list[str]] = {}
    for name, table in run.crosstalk.items():
        geometry = run.experiment.geometry(name)
        assert geometry.focal_length_x_m is not None
        numbers = (
            fixed(_factor(table, "paper_single", "d_gamma_arcsec"), 3),
            fixed(_factor(table, "paper_joint", "d_f_um"), 3),
            fixed(geometry.focal_length_x_m / geometry.focal_length_m, 4),
            fixed(geometry.focal_length_x_m, 4),
            fixed(geometry.focal_length_m, 4),
            fixed(math.cos(geometry.field_beta_rad) ** 2, 5),
            fixed(math.cos(geometry.field_alpha_rad) ** 2, 5),
            plain(math.degrees(geometry.field_beta_rad)),
            plain(math.degrees(geometry.field_alpha_rad)),
        )
        texts.setdefault(numbers, []).append(name)
    names = ("gamma", "d_f", "anamorphism", "focal_x", "focal", "cos_beta", "cos_alpha", "beta", "alpha")
    notes = [{"cameras": ", ".join(who), **dict(zip(names, numbers, strict=True))} for numbers, who in texts.items()]
    return {"cameras": cameras, "rows": rows, "notes": notes}


def _factor(table: CameraCrosstalk, estimator: str, parameter: str) -> float:
    return float(next(f.by_model for f in table.factors if (f.estimator, f.parameter) == (estimator, parameter)))


def statements(run: RenderRun) -> list[dict[str, Any]]:
    """What kinds of focal-length change the spots see, and how many motions they can tell apart."""
    out = []
    for name, table in run.crosstalk.items():
        labels = [f"{m.label} [{m.unit}]" for m in table.motions] + [m.label for m in table.motions]
        first = _split(table.observability.statements[0], labels)
        focal = [_split(s, labels) for s in table.focal_length_statements()]
        out.append({"name": name, "focal": focal, "first": first["text"]})
    return out


def _split(text: str, labels: list[str]) -> dict[str, str]:
    """A statement's label, where it begins with one, and the rest."""
    label, colon, rest = text.partition(": ")
    known = colon and label in labels
    text = rest if known else text
    return {
        "label": _pretty(label) if known else "",
        "text": _pretty(text),
    }


_TYPESET = (
    *SYMBOLS.items(),
    (" um", " µm"),
    ("[um]", "[µm]"),
    ('"', " arcsec"),
)


def _pretty(text: str) -> str:
    for plain_text, typeset in _TYPESET:
        text = text.replace(plain_text, typeset)
    text = re.sub(r"(?<=\d) x (?=[A-Za-z])", " × ", text)
    text = re.sub(r"(?<=\d)e-0?(\d)", "e\N{MINUS SIGN}\\1", text)
    return re.sub(r"(?<= )-(?=\d| )", "\N{MINUS SIGN}", text)
