"""Differences between runs, and their report: tables of inputs and results, and the images side by side."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scenes.yaml.errors import InputError, Issue
from scenes.yaml.units import split_quantity, unit_ratio
from scenes.yaml.yaml_file import read_yaml
from twin.compare import folder_difference as difference
from twin.compare.folder_difference import NOISE, ArrayDifference, Leaf, NumberDifference, is_sigma
from twin.framework.artefact import Artefact, Cell, PngFigure, Table, plain, significant
from twin.framework.report import Report, Section, answer
from twin.framework.run_folder import Manifest, finished_manifest
from twin.framework.svg import look, new_figure, signed_map, to_png

_MOST_IMAGES = 8
"""Largest number of differing images that the report shows."""

_HEADLINES: Mapping[str, tuple[tuple[str, Callable[[list[float]], float], str], ...]] = {
    "optics.json": (
        (r"wfe_worst_waves", max, "worst wavefront error [waves]"),
        (r"mtf_at_nyquist\[.*\]\.along_\w+", min, "lowest MTF of the optics at Nyquist"),
        (r"first_order\.focal_length_m", max, "focal length [m]"),
    ),
    "quality.json": (
        (r"cameras\.[^.]+\.wfe_worst_waves", max, "worst wavefront error [waves]"),
        (r"cameras\.[^.]+\.mtf_along_\w+\..*", min, "lowest MTF with the pixel at Nyquist"),
    ),
}
"""File -> results with which a verdict begins: pattern of their keys, which of several is meant, and name."""


def compare_report(comparison: Comparison) -> Report:
    """Return the report: tables of the inputs and results that differ, and images of the runs side by side."""
    names = comparison.names
    first_sentences, lead = answer(*verdict(comparison))
    summary = Table(
        "summary",
        "What differs",
        f"Differences from {names[0]}. A number differs if it deviates by more than {comparison.rtol:g} of its value"
        + ("." if comparison.sigmas is None else f" and, if it has a sigma, by more than {comparison.sigmas:g} sigma."),
        ("run", "inputs", "numbers", "images", "compared", "largest [sigma]"),
        [_row(name, diff) for name, diff in zip(names[1:], comparison.diffs, strict=True)],
    )
    sections = []
    for k, (name, run, diff) in enumerate(zip(names[1:], comparison.runs[1:], comparison.diffs, strict=True), start=1):
        artefacts = _artefacts(comparison.runs[0], run, diff, (names[0], name), k)
        if artefacts:
            sections.append(Section(name, (), artefacts))
    return Report(
        title=f"{', '.join(names[1:])} against {names[0]}",
        verdict=first_sentences,
        lead=lead,
        facts=tuple((name, str(run.folder)) for name, run in zip(names, comparison.runs, strict=True)),
        summary=summary,
        sections=tuple(sections),
        warnings=_warnings(comparison),
    )


def _row(name: str, diff: Differences) -> list[Cell]:
    """Return a run's row in the summary table: its name and the numbers of inputs, results and images that differ."""
    far = max((abs(number.in_sigma) for number in diff.numbers if number.in_sigma is not None), default=None)
    return [name, len(diff.inputs), len(diff.numbers), len(diff.arrays), diff.compared, far]


def _warnings(comparison: Comparison) -> tuple[str, ...]:
    """Return warnings that make a comparison doubtful: runs with different program versions or other warnings."""
    first = comparison.runs[0]
    out = []
    for name, run in zip(comparison.names[1:], comparison.runs[1:], strict=True):
        other = {
            package: (first.manifest.versions.get(package, "none"), version)
            for package, version in run.manifest.versions.items()
            if first.manifest.versions.get(package) != version
        }
        if other:
            changes = ", ".join(f"{package} {here} and {there}" for package, (here, there) in other.items())
            out.append(f"{name} was made with other versions: {changes}")
        out += [f"{name}: {text}" for text in run.manifest.warnings if text not in first.manifest.warnings]
        missing = [text for text in first.manifest.warnings if text not in run.manifest.warnings]
        out += [f"{comparison.names[0]} only: {text}" for text in missing]
    return tuple(dict.fromkeys(out))


def _artefacts(reference: Run, run: Run, diff: Differences, names: tuple[str, str], k: int) -> tuple[Artefact, ...]:
    """Return the tables and figures of the differences between one run and the reference.

    ``names`` are those of the two run folders, and ``k`` is the run's number, from which file names follow.
    """
    out: list[Artefact] = []
    if diff.inputs:
        rows: list[list[Cell]] = [
            ["\N{EM DASH}" if value is None else str(value) for value in entry.values()] for entry in diff.inputs
        ]
        out.append(Table(f"inputs-{k}", "Inputs", "Keys of config.yaml.", ("key", *names), rows))
    if diff.numbers:
        rows = [
            [n.file, n.key, *values, n.difference, n.sigma, n.sigma_of, n.in_sigma]
            for n in sorted(diff.numbers, key=lambda entry: (entry.file != "truth.json", -abs(entry.in_sigma or 0.0)))
            if not is_sigma(n.key)
            for values in [[str(v) if isinstance(v, bool) else v for v in (n.reference, n.other)]]
        ]
        columns = ("file", "key", *names, "difference", "sigma", "sigma from", "in sigma")
        about = "The keys end in their units. Sigma is that of the difference of two independent measurements: from "
        about += "image noise if stated, otherwise the total. Runs of one seed share their noise and differ by less."
        left = len(diff.numbers) - len(rows)
        about += f" compare.json lists {left} changed sigmas." if left else ""
        out.append(Table(f"numbers-{k}", "Results", about, columns, rows, (None,) * 7 + (1,)))
    if diff.arrays:
        heads = ("file", "variable", "shape", "largest", "rms", "peak", "differing share")
        rows = [[a.file, a.name, _shape(a), a.largest, a.rms, a.peak, a.share] for a in diff.arrays]
        about = f"Differences and the peak of {names[0]}, in the units of the file."
        out.append(Table(f"images-{k}", "Images", about, heads, rows))
        out += _pictures(reference, run, diff, names, k)
    return tuple(out)


def _shape(array: ArrayDifference) -> str:
    """Return the shapes of the arrays of both runs as text."""
    here, there = ("none" if s is None else " x ".join(map(str, s)) for s in (array.shape, array.other_shape))
    return here if here == there else f"{here}, {there}"


def _pictures(reference: Run, run: Run, diff: Differences, names: tuple[str, str], k: int) -> list[Artefact]:
    """Return images of both runs and their difference, averaged over all but the last two axes."""
    out: list[Artefact] = []
    for array in diff.arrays:
        if array.largest is None or array.shape is None or len(array.shape) < 2 or min(array.shape[-2:]) < 8:
            continue
        if len(out) == _MOST_IMAGES:
            break
        files = [difference.content_of(side.folder / array.file, array.file) for side in (reference, run)]
        for label, first, second in _views(*(file.arrays[array.name].astype(np.float64) for file in files)):
            if len(out) == _MOST_IMAGES:
                break
            delta = np.abs(second - first)
            if not np.isfinite(delta).any():
                continue
            title = " ".join(filter(None, (array.file, array.name, label)))
            png = _picture(first, second, names, title)
            where = f"{len(out) + 1}"
            # NaN has no difference, as outside a pupil
            caption = f"Differences up to {significant(float(np.nanmax(delta)), 3, floor=0.0)}."
            out.append(PngFigure(f"image-{k}-{where}", title, caption, png))
    return out


def _views(first: np.ndarray, second: np.ndarray) -> list[tuple[str, np.ndarray, np.ndarray]]:
    """Return images of both runs to be shown side by side, with a title for each pair.

    Arrays of at most three axes are averaged over the first (frames). For arrays with further axes, such as state and
    channel, there is a pair for each index at which they differ.
    """
    if first.ndim <= 3:
        axes = tuple(range(first.ndim - 2))
        return [("", first.mean(axis=axes), second.mean(axis=axes))]
    indices = [p for p in np.ndindex(*first.shape[:-2]) if not np.array_equal(first[p], second[p])]
    return [(str(list(p)), first[p], second[p]) for p in indices]


def _picture(first: np.ndarray, second: np.ndarray, names: tuple[str, str], title: str) -> bytes:
    """Return a PNG of two images and their difference."""
    with look("image"):
        figure = new_figure(3.6)
        axes = figure.subplots(1, 3)
        low, high = np.nanmin([first, second]), np.nanmax([first, second])
        for axis, image, name in zip(axes[:2], (first, second), names, strict=True):
            shown = axis.imshow(image, cmap="magma", vmin=low, vmax=high, interpolation="nearest")
            axis.set_title(name)
        figure.colorbar(shown, ax=axes[:2], shrink=0.8)
        delta = second - first
        shown = signed_map(axes[2], delta, interpolation="nearest")
        axes[2].set_title("difference")
        figure.colorbar(shown, ax=axes[2], shrink=0.8)
        for axis in axes:
            axis.set_xticks([])
            axis.set_yticks([])
        return to_png(figure, 100)


PROGRAM = "twin.compare"
KIND = "compare"


@dataclass(frozen=True, eq=False)
class Differences:
    """Differences of one run from the reference.

    Attributes
    ----------
    inputs : tuple[Mapping[str, Leaf], ...]
        Keys of config.yaml with different values: ``key``, ``reference``, ``other``; None where a run lacks the key.
    numbers : tuple[NumberDifference, ...]
        Results that differ by more than the tolerance.
    arrays : tuple[ArrayDifference, ...]
        Images and other arrays that differ by more than the tolerance, relative to the array's largest value.
    compared : int
        Number of result values and arrays that both runs have.
    """

    inputs: tuple[Mapping[str, Leaf], ...]
    numbers: tuple[NumberDifference, ...]
    arrays: tuple[ArrayDifference, ...]
    compared: int

    @property
    def same(self) -> bool:
        """True if no result differs from the reference by more than the tolerances."""
        return not self.numbers and not self.arrays


@dataclass(frozen=True, eq=False)
class Run:
    """Run folder with the keys and values of its config.yaml and its manifest.

    The manifest lists the run's files and how they were made.
    """

    folder: Path
    manifest: Manifest
    inputs: Mapping[str, Leaf]

    def file(self, name: str) -> Path | None:
        """Return a file of the run; None if the run has no file of that name."""
        return self.folder / name if name in self.manifest.sha256 else None


def read_run(folder: Path) -> Run:
    """Read the manifest and config.yaml of a run folder.

    Raises
    ------
    InputError
        The folder is not a run folder, or config.yaml cannot be read.
    """
    manifest = finished_manifest(folder)
    config = read_yaml(folder / "config.yaml").data if "config.yaml" in manifest.sha256 else {}
    return Run(folder, manifest, dict(difference.leaves(config, series=False)))


def differences(reference: Run, other: Run, rtol: float, sigmas: float | None) -> Differences:
    """Compare two runs of one kind.

    Parameters
    ----------
    reference : Run
        The first run.
    other : Run
        The second run.
    rtol : float
        Tolerance relative to the larger of two numbers, and for arrays to the largest absolute value.
    sigmas : float | None
        Where a number has a sigma in both runs, differences within this multiple of it do not count; the sigmas and the
        recorded frames, whose random noise differs, are then ignored. None compares all to ``rtol``.

    Raises
    ------
    InputError
        The runs are of different kinds, or a file cannot be read.
    """
    if reference.manifest.kind != other.manifest.kind:
        kinds = f"{reference.manifest.kind} and {other.manifest.kind}"
        raise InputError(
            Issue("the runs are of different kinds", str(other.folder), value=kinds, allowed="runs of one command")
        )
    inputs = [
        {"key": key, "reference": here, "other": there}
        for key in dict.fromkeys((*reference.inputs, *other.inputs))
        if not _same_input(here := reference.inputs.get(key), there := other.inputs.get(key))
    ]
    names = dict.fromkeys((*reference.manifest.sha256, *other.manifest.sha256))
    results = [name for name in names if difference.ending(name) == "json" and "/" not in name]
    images = [name for name in names if difference.ending(name) in (("nc", "tiff") if sigmas is None else ("nc",))]
    count = 0
    numbers: list[NumberDifference] = []
    arrays: list[ArrayDifference] = []
    for name in (*results, *images):
        diff = difference.file_difference(name, reference.file(name), other.file(name))
        count += diff.common_arrays
        arrays += [a for a in diff.arrays if not a.finite or (a.largest or 0.0) > rtol * (a.peak or 0.0)]
        if name in results:
            count += diff.common_numbers
            numbers += [number for number in diff.numbers if not _same_number(number, rtol, sigmas)]
    return Differences(tuple(inputs), tuple(numbers), tuple(arrays), count)


def _same_input(here: Leaf, there: Leaf) -> bool:
    """Return whether two inputs are equal, also if their units differ, as 3 um and 0.003 mm."""
    if here == there and type(here) is type(there):
        return True
    quantity, other_quantity = split_quantity(here), split_quantity(there)
    if quantity is None or other_quantity is None:
        return difference.is_number(here) and difference.is_number(there) and here == there
    try:
        return math.isclose(quantity[0] * unit_ratio(quantity[1], other_quantity[1]), other_quantity[0], rel_tol=1e-15)
    except ValueError:
        return False


def _same_number(number: NumberDifference, rtol: float, sigmas: float | None) -> bool:
    """Return whether two results are equal within a relative tolerance or within ``sigmas`` times their sigma.

    With ``sigmas``, standard deviations themselves always count as equal.
    """
    if sigmas is not None and is_sigma(number.key):
        return True
    if number.difference is None:  # if both are None, one file lacks the key
        return number.reference == number.other and number.reference is not None
    if math.isclose(float(number.reference or 0), float(number.other or 0), rel_tol=rtol):
        return True
    return sigmas is not None and number.sigma is not None and abs(number.difference) <= sigmas * number.sigma


@dataclass(frozen=True, eq=False)
class Comparison:
    """Comparison of runs of one kind.

    Attributes
    ----------
    runs : tuple[Run, ...]
        The runs; the first is the reference.
    diffs : tuple[Differences, ...]
        Differences of each other run from the reference.
    rtol : float
        Relative tolerance of numbers.
    sigmas : float | None
        Multiple of sigma within which differences do not count; None if all count.
    """

    runs: tuple[Run, ...]
    diffs: tuple[Differences, ...]
    rtol: float
    sigmas: float | None

    @property
    def same(self) -> bool:
        """True if no result of any run differs from the reference's."""
        return all(diff.same for diff in self.diffs)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the folders, or their paths if two names are equal."""
        names = [run.folder.resolve().name for run in self.runs]
        return tuple(names if len(set(names)) == len(names) else [str(run.folder) for run in self.runs])


def compare(folders: Sequence[Path], rtol: float, sigmas: float | None) -> Comparison:
    """Read run folders and compare them with the first.

    Raises
    ------
    InputError
        There are fewer than two folders, a folder is not a run folder, or the runs are of different kinds.
    """
    if len(folders) < 2:
        raise InputError(Issue("a comparison needs two runs or more", value=f"{len(folders)}"))
    runs = tuple(read_run(folder) for folder in folders)
    return Comparison(runs, tuple(differences(runs[0], other, rtol, sigmas) for other in runs[1:]), rtol, sigmas)


def numbers(comparison: Comparison) -> Mapping[str, Any]:
    """Return the content of compare.json: inputs, numbers and arrays of each run that differ from the first run's."""
    others = []
    for run, diff in zip(comparison.runs[1:], comparison.diffs, strict=True):
        others.append(
            {
                "run": str(run.folder),
                "same": diff.same,
                "compared": diff.compared,
                "inputs": diff.inputs,
                "numbers": [_plain(entry, "scale", "difference", "in_sigma") for entry in diff.numbers],
                "arrays": [_plain(array, "where reference other depth") for array in diff.arrays],
            }
        )
    return {
        "kind": comparison.runs[0].manifest.kind,
        "reference": str(comparison.runs[0].folder),
        "same": comparison.same,
        "rtol": comparison.rtol,
        "sigmas": comparison.sigmas,
        "others": others,
    }


def _plain(entry: NumberDifference | ArrayDifference, without: str, *derived: str) -> dict[str, Any]:
    """Return the fields of a difference, except ``without``, and its properties ``derived``, as plain data for JSON.

    Numbers that are not finite become None.
    """
    values = {key: value for key, value in vars(entry).items() if key not in without.split()}
    more = {key: getattr(entry, key) for key in derived}
    return values | {key: value if value is not None and abs(value) < math.inf else None for key, value in more.items()}


def _headline(reference: Run, run: Run, diff: Differences) -> str:
    """Return the few results that a reader of cameras looks for first, before and after, where they differ."""
    out = []
    for file, headlines in _HEADLINES.items():
        changed = [number.key for number in diff.numbers if number.file == file]
        sides = [_results(side.file(file)) for side in (reference, run)] if changed else []
        for pattern, worst, name in headlines:
            if not any(re.fullmatch(pattern, key) for key in changed):
                continue
            before, after = ([value for key, value in side.items() if re.fullmatch(pattern, key)] for side in sides)
            if before and after:
                ends = worst(before), worst(after)
                digits = next((k for k in range(3, 10) if plain(ends[0], k) != plain(ends[1], k)), 0)
                out += [f"{name} {plain(ends[0], digits)}, then {plain(ends[1], digits)}"] if digits else []
    return "; ".join(out)


def _results(path: Path | None) -> dict[str, float]:
    """Return key -> number of a result file; empty without the file."""
    values = {} if path is None else difference.content_of(path, path.name).numbers
    return {key: value for key, value in values.items() if isinstance(value, int | float)}


def verdict(comparison: Comparison) -> list[str]:
    """Return the verdict: a sentence for each run compared with the first, and one on its largest change in sigmas."""
    parts = []
    reference = comparison.runs[0]
    for name, run, diff in zip(comparison.names[1:], comparison.runs[1:], comparison.diffs, strict=True):
        if headline := _headline(reference, run, diff):
            parts.append(f"from {comparison.names[0]} to {name}: {headline}")
        inputs = f"{len(diff.inputs)} input{'s' * (len(diff.inputs) != 1)}" if diff.inputs else "no input"
        if diff.same:
            parts.append(
                f"run {name} has the same results as {comparison.names[0]} ({inputs} changed, {diff.compared} compared)"
            )
            continue
        what = [f"{len(diff.numbers)} numbers"] * bool(diff.numbers) + [f"{len(diff.arrays)} images"] * bool(
            diff.arrays
        )
        parts.append(
            f"run {name} differs from {comparison.names[0]} in {' and '.join(what)} of {diff.compared} results "
            f"({inputs} changed)"
        )
        far = max(diff.numbers, key=lambda number: abs(number.in_sigma or 0.0), default=None)
        if far is not None and far.in_sigma is not None:
            kind = "from image noise" if far.sigma_of == NOISE else "as stated"
            parts.append(f"the most significant change is {far.key}, {far.in_sigma:+.3g} sigma {kind}")
    return parts
