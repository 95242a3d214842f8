"""Rational polynomials that come alone, without a rigorous model, corrected by control points."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from optics.numerics.number_tree import FrozenMap
from scenes.yaml.errors import InputError, Issue
from scenes.yaml.yaml_file import dump_yaml
from twin.orbit.export.export_report import FOLDER
from twin.orbit.export.export_run import Controlled, Quality, Wishes, no_bands
from twin.orbit.export.quality_run import controlled_line
from twin.orbit.export.quality_sections import CONTROL, control_section, quality_answers, quality_warnings
from twin.orbit.export.rational_polynomial import RationalPolynomial, is_rpc, read_rpc
from twin.run.artefact import Table
from twin.run.quantity import Quantity, Record
from twin.run.report import Report, answer

_ENDING = re.compile(r"(_RPC|_rpc)$")
_UNSAFE = re.compile(r"[^A-Za-z0-9_-]")


@dataclass(frozen=True, eq=False)
class PolynomialSource:
    """Rational polynomials of a file.

    Attributes:
        name: of the image that they belong to, as far as the file's name tells it.
        file: that they are from.
        polynomial: as they were read.
        config: the file's path, as YAML.
    """

    name: str
    file: str
    polynomial: RationalPolynomial
    config: str


@dataclass(frozen=True, eq=False)
class PolynomialExport:
    """Polynomials after control.

    Attributes:
        source: what was read.
        control: what the points made of it.
    """

    source: PolynomialSource
    control: Controlled


def read_polynomial_source(path: Path, band: str | None = None) -> PolynomialSource | None:
    """Rational polynomials, where a file holds them alone; None for another file.

    Args:
        path: of it.
        band: that was asked for, which polynomials do not have.

    Raises:
        InputError: it holds polynomials that cannot be read, or a band is asked for.
    """
    if not path.is_file() or not is_rpc(path):
        return None
    if band is not None:
        raise no_bands(path, band)
    name = _UNSAFE.sub("_", _ENDING.sub("", path.stem)) or "image"
    return PolynomialSource(name, str(path), read_rpc(path), dump_yaml({"source": str(path)}))


def run_polynomial_export(source: PolynomialSource, wishes: Wishes) -> PolynomialExport:
    """Correct the polynomials.

    Args:
        source: what was read.
        wishes: control points.

    Raises:
        InputError: there are none, they do not determine a correction, or something was asked for that takes a rigorous
            model.
    """
    if wishes.uncertainty is not None:
        allowed = "a source with a rigorous model for --position-sigma, --attitude-sigma and the like"
        raise InputError(Issue("polynomials alone know no camera and no orbit", source.file, allowed=allowed))
    if wishes.control is None:
        raise InputError(Issue("nothing to do with polynomials alone", source.file, allowed="--control points.gcp"))
    found = controlled_line(wishes.control, source.name, source.polynomial, alone=True)
    if found is None:
        problem = "no control point is in the image of these polynomials"
        raise InputError(Issue(problem, wishes.control.file, allowed=f"points in {source.name}.tif"))
    return PolynomialExport(source, found)


POLYNOMIALS: Record[PolynomialExport] = Record(
    "export.json of rational polynomials alone.",
    Quantity("source", lambda run: run.source.file, "that they were read from"),
    Quantity("rpc", lambda run: _file(run), "path in the run folder of the corrected ones"),
    Quantity(
        "control", lambda run: {run.source.name: run.control}, "how control points corrected them", record=CONTROL
    ),
)


def _file(run: PolynomialExport) -> str:
    return f"{FOLDER}/{run.source.name}_RPC.TXT"


def polynomial_files(run: PolynomialExport) -> dict[str, bytes]:
    """Path in the run folder -> contents."""
    return {_file(run): run.control.polynomial.after.text().encode()}


def polynomial_report(run: PolynomialExport) -> Report:
    """What was corrected."""
    quality = Quality(FrozenMap(), FrozenMap({run.source.name: run.control}), FrozenMap())
    sentences = quality_answers(quality)
    verdict, more = answer(*sentences)
    before, after = run.source.polynomial, run.control.polynomial.after
    rows = [
        (name, float(old), float(new))
        for name, old, new in zip(("line", "sample"), before.offset[:2], after.offset[:2], strict=True)
    ]
    table = Table("polynomials", "Offsets", "Middle of the image, pixels.", ("of", "before [px]", "after [px]"), rows)
    size = " x ".join(f"{2.0 * value:.0f}" for value in before.scale[:2])
    low, high = before.offset[4] + np.array([-1.0, 1.0]) * before.scale[4]
    facts = (("Read", run.source.file), ("Image", f"{size} pixels"), ("Ground", f"{low:.0f} to {high:.0f} m high"))
    warnings = tuple(one for one in quality_warnings(quality) if "ISD" not in one)
    sections = (control_section(quality.control),)
    return Report("Corrected rational polynomials", verdict, more, facts, table, sections, warnings=warnings)
