"""What differs between run folders: inputs, numbers with their sigmas, images.

Files are read by what they are, not by who wrote them: config.yaml is what went in, JSON files are what came out,
netCDF and TIFF files hold arrays. What names a time, a duration or a version is left out.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tifffile

from scenes.yaml.errors import InputError, Issue
from scenes.yaml.input_file import why_unreadable
from scenes.yaml.json_file import read_json
from scenes.yaml.units import split_quantity, unit_ratio
from scenes.yaml.yaml_file import read_yaml
from twin.run.data_files import read_netcdf
from twin.run.owned_files import MANIFEST
from twin.run.run_folder import Manifest, read_manifest

Leaf = float | int | str | bool | None
LEFT_OUT = frozenset(
    (
        *("seconds", "worker_seconds", "runs_computed", "states_per_second", "wall_time_s", "started_unix_s"),
        *("fingerprint", "sha256", "versions"),
    )
)
"""Keys of results that say how the run was done, not what it gave."""
NOISE = "noise"
"""Name of a sigma that more frames lower."""
TOLD = frozenset(("verdict", "warnings"))
"""Sentences at the top of a result that follow from its numbers, which are compared themselves."""
NAMES = ("name", "motion", "label", "field", "path", "time_s")
"""Keys by which an entry of a list is told from the others, in this order."""
_SERIES = 12
"""Numbers of a list from which it is compared as an array."""
PLAIN = ("json",)
ARRAYS = ("nc", "tiff")


@dataclass(frozen=True)
class InputDifference:
    """A key of config.yaml with different values.

    Attributes:
        key: ``job.perturb.base/forward/M2.shift[2]``.
        reference, other: what stands there; None where there is nothing.
    """

    key: str
    reference: Leaf
    other: Leaf


@dataclass(frozen=True)
class NumberDifference:
    """A result with different values.

    Attributes:
        file: of the run folder, ``recovered.json``.
        key: in it, which ends in its unit.
        reference, other: what stands there; None where there is nothing.
        sigma: standard deviation of the difference of two independent measurements, from both runs' sigmas; None where
            the file states none.
        sigma_of: what that is of: the ``noise`` of the images alone, or ``stated``, what the file states beside the
            number and calls by no other name; empty without a sigma.
    """

    file: str
    key: str
    reference: Leaf
    other: Leaf
    sigma: float | None = None
    sigma_of: str = ""

    @property
    def difference(self) -> float | None:
        """Other minus reference, None unless both are numbers."""
        if _is_number(self.reference) and _is_number(self.other):
            return float(self.other) - float(self.reference)  # type: ignore[arg-type]
        return None

    @property
    def in_sigma(self) -> float | None:
        """The difference over its sigma."""
        return None if self.difference is None or not self.sigma else self.difference / self.sigma


@dataclass(frozen=True)
class ArrayDifference:
    """An image, or another array of numbers, with different values.

    Attributes:
        file: of the run folder.
        name: of the variable; empty for a TIFF.
        shape: of the reference's; of the other in ``other_shape``, None where it has none.
        largest: absolute difference at most; None where the shapes differ.
        rms: of the difference.
        peak: largest absolute value of the reference.
        share: of the elements that differ.
    """

    file: str
    name: str
    shape: tuple[int, ...] | None
    other_shape: tuple[int, ...] | None
    largest: float | None = None
    rms: float | None = None
    peak: float | None = None
    share: float | None = None


@dataclass(frozen=True, eq=False)
class Differences:
    """One run against the reference.

    Attributes:
        inputs: what went in.
        numbers: what came out and is not the same to the tolerance.
        arrays: images that are not the same to the tolerance of their peak.
        compared: how many numbers and arrays stand in both.
    """

    inputs: tuple[InputDifference, ...]
    numbers: tuple[NumberDifference, ...]
    arrays: tuple[ArrayDifference, ...]
    compared: int

    @property
    def same(self) -> bool:
        """Whether no result differs."""
        return not self.numbers and not self.arrays


@dataclass(frozen=True, eq=False)
class RunResults:
    """A run folder that has been read.

    Attributes:
        folder: where.
        manifest: of the run.
        inputs: key of config.yaml -> value.
        numbers: (file, key) -> value of everything in JSON files that is no long list.
        series: (file, key) -> long lists of numbers.
    """

    folder: Path
    manifest: Manifest
    inputs: Mapping[str, Leaf]
    numbers: Mapping[tuple[str, str], Leaf]
    series: Mapping[tuple[str, str], np.ndarray]

    @property
    def kind(self) -> str:
        """Kind of the run: its program, and the kind of a test."""
        return " ".join(filter(None, (self.manifest.program, self.manifest.test)))

    def array_files(self) -> list[str]:
        """Files that hold arrays."""
        return [name for name in self.manifest.sha256 if name.rpartition(".")[2] in ARRAYS]


def read_run(folder: Path) -> RunResults:
    """Read a run folder.

    Raises:
        InputError: it is none, or a file that its manifest lists cannot be read.
    """
    manifest = read_manifest(folder)
    if manifest is None:
        problem = "no such folder" if not folder.is_dir() else f"not a run folder: it has no {MANIFEST} of a run"
        raise InputError(Issue(problem, str(folder), allowed="a folder that a command of the twin has written"))
    numbers: dict[tuple[str, str], Leaf] = {}
    series: dict[tuple[str, str], np.ndarray] = {}
    for name in manifest.sha256:
        if name.rpartition(".")[2] not in PLAIN or "/" in name:
            continue
        data = read_json(folder / name)
        results = {key: value for key, value in data.items() if key not in TOLD} if isinstance(data, Mapping) else data
        for key, value in leaves(results):
            if isinstance(value, np.ndarray):
                series[name, key] = value
            else:
                numbers[name, key] = value
    config = folder / "config.yaml"
    inputs = dict(leaves(read_yaml(config).data, series=False)) if "config.yaml" in manifest.sha256 else {}
    return RunResults(folder, manifest, inputs, numbers, series)


def leaves(data: Any, key: str = "", series: bool = True) -> Iterator[tuple[str, Any]]:
    """Keys and values of nested data, without those of `LEFT_OUT`.

    Args:
        data: mappings and lists.
        key: of it; keys of what is in it follow.
        series: whether long lists of numbers are given whole, as arrays.
    """
    if isinstance(data, Mapping):
        for name, value in data.items():
            if name not in LEFT_OUT and name not in ("schema", "reference_frames"):
                yield from leaves(value, f"{key}.{name}" if key else str(name), series)
    elif isinstance(data, list):
        if series and len(data) > _SERIES and (array := _as_array(data)) is not None:
            yield key, array
            return
        names = _entry_names(data)
        for k, value in enumerate(data):
            yield from leaves(value, f"{key}[{names[k]}]", series)
    else:
        yield key, data


def _as_array(data: Sequence[Any]) -> np.ndarray | None:
    try:
        array = np.asarray([[math.nan] if value is None else value for value in data], dtype=np.float64)
    except (TypeError, ValueError):
        return None
    return array


def _entry_names(data: Sequence[Any]) -> list[str]:
    """What tells the entries of a list apart: a name of theirs, so that an entry that is put in moves no other."""
    for name in NAMES:
        found = [str(entry[name]) for entry in data if isinstance(entry, Mapping) and name in entry]
        if len(found) == len(data) and len(set(found)) == len(found):
            return found
    return [str(k) for k in range(len(data))]


def differences(reference: RunResults, other: RunResults, rtol: float, sigmas: float | None) -> Differences:
    """What differs between two runs of one kind.

    Args:
        reference: the first.
        other: the second.
        rtol: numbers that agree to this part of the larger one are the same, and elements of arrays to this part of the
            array's peak.
        sigmas: where a number has a sigma in both runs, differences within so many of them do not count; sigmas
            themselves and recorded frames, in which the noise is another draw, are then left out. None holds all to
            ``rtol``.

    Raises:
        InputError: they are of two kinds, or a file cannot be read.
    """
    if reference.kind != other.kind:
        found = f"{reference.kind} and {other.kind}"
        raise InputError(Issue("runs of two kinds", str(other.folder), found=found, allowed="runs of one command"))
    inputs = tuple(
        InputDifference(key, reference.inputs.get(key), other.inputs.get(key))
        for key in dict.fromkeys((*reference.inputs, *other.inputs))
        if not _same_input(reference.inputs.get(key), other.inputs.get(key))
    )
    numbers = []
    for place in dict.fromkeys((*reference.numbers, *other.numbers)):
        if sigmas is not None and is_sigma(place[1]):
            continue
        here, there = (run.numbers.get(place, _MISSING) for run in (reference, other))
        sigma, kind = sigma_of(reference.numbers, other.numbers, place)
        if not _same_number(here, there, rtol, sigma, sigmas):
            numbers.append(NumberDifference(*place, _shown(here), _shown(there), sigma, kind))
    pairs: list[tuple[str, str, np.ndarray | None, np.ndarray | None]] = [
        (*place, reference.series.get(place), other.series.get(place))
        for place in dict.fromkeys((*reference.series, *other.series))
    ]
    count = len(reference.numbers.keys() & other.numbers.keys())
    arrays = [one for one in (_array_difference(*pair, rtol) for pair in pairs) if one is not None]
    count += sum(here is not None and there is not None for _, _, here, there in pairs)
    for file in dict.fromkeys((*reference.array_files(), *other.array_files())):
        if sigmas is not None and file.endswith(".tiff"):
            continue
        if reference.manifest.sha256.get(file) == other.manifest.sha256.get(file):
            count += 1
            continue
        # one file at a time is in memory
        first, second = (_arrays(run, file) for run in (reference, other))
        count += len(first.keys() & second.keys())
        for name in dict.fromkeys((*first, *second)):
            difference = _array_difference(file, name, first.get(name), second.get(name), rtol)
            arrays += [difference] if difference is not None else []
    return Differences(inputs, tuple(numbers), tuple(arrays), count)


_MISSING: Any = object()


def _shown(value: Any) -> Leaf:
    return None if value is _MISSING else value


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _same_input(here: Leaf, there: Leaf) -> bool:
    """Also 3 um and 0.003 mm."""
    if here == there and type(here) is type(there):
        return True
    one, two = split_quantity(here), split_quantity(there)
    if one is None or two is None:
        return _is_number(here) and _is_number(there) and here == there
    try:
        return math.isclose(one[0] * unit_ratio(one[1], two[1]), two[0], rel_tol=1e-15)
    except ValueError:
        return False


def _same_number(here: Any, there: Any, rtol: float, sigma: float | None, sigmas: float | None) -> bool:
    if not (_is_number(here) and _is_number(there)):
        return bool(here == there) and here is not _MISSING
    if math.isnan(here) and math.isnan(there):
        return True
    if math.isclose(here, there, rel_tol=rtol):
        return True
    return sigmas is not None and sigma is not None and abs(there - here) <= sigmas * sigma


def is_sigma(key: str) -> bool:
    """Whether a key holds the standard deviation of another number, or what correcting by it leaves."""
    last = key.rpartition(".")[2]
    return last == "sigma" or last.endswith(("_sigma", "_sigma_noise")) or last.startswith(("sigma_", "left_"))


def sigma_of(
    reference: Mapping[Any, Leaf], other: Mapping[Any, Leaf], place: tuple[str, str]
) -> tuple[float | None, str]:
    """Return the sigma of the difference of two numbers and what it is of: of the noise of both runs, from
    ``x_sigma_noise`` beside them in both runs, else as stated, from ``x_sigma`` or ``sigma``. What an
    estimator makes wrong of the motions is the same in runs of the same motions, and does not scatter between them.

    Args:
        reference: (file, key) -> value of one run.
        other: of the other.
        place: file and key of the numbers.
    """
    file, key = place
    head, dot, last = key.rpartition(".")
    names = (f"{last}_sigma_noise", f"{last}_sigma", *(("sigma",) if last == "value" else ()))
    for name in names:
        both = [run.get((file, f"{head}{dot}{name}")) for run in (reference, other)]
        if all(_is_number(value) for value in both):
            kind = NOISE if name.endswith(NOISE) else "stated"
            return math.hypot(*(float(value) for value in both if value is not None)), kind
    return None, ""


def _array_difference(
    file: str, name: str, here: np.ndarray | None, there: np.ndarray | None, rtol: float
) -> ArrayDifference | None:
    if here is None or there is None or here.shape != there.shape:
        first, second = (None if array is None else tuple(array.shape) for array in (here, there))
        return ArrayDifference(file, name, first, second)
    if not np.issubdtype(here.dtype, np.number) or not np.issubdtype(there.dtype, np.number):
        unequal = here.astype(str) != there.astype(str)
        share = float(unequal.mean()) if unequal.size else 0.0
        return ArrayDifference(file, name, here.shape, there.shape, share=share) if share else None
    one, two = here.astype(np.float64), there.astype(np.float64)
    both = np.isfinite(one) & np.isfinite(two)
    odd = (np.isnan(one) != np.isnan(two)) | (~both & ~np.isnan(one) & (one != two))
    delta = np.zeros_like(one)
    with np.errstate(over="ignore"):  # numbers at the end of the range differ by infinity
        np.subtract(two, one, out=delta, where=both)
    peak = float(np.max(np.abs(one), where=np.isfinite(one), initial=0.0))
    largest = float(np.max(np.abs(delta), initial=0.0))
    if largest <= rtol * peak and not odd.any():
        return None
    share = float(np.mean((delta != 0.0) | odd))
    scale = largest if 1e150 < largest < np.inf else 1.0  # whose squares are beyond the range
    rms = scale * float(np.sqrt(np.mean((delta / scale) ** 2)))
    return ArrayDifference(file, name, here.shape, there.shape, largest, rms, peak, share)


def _arrays(run: RunResults, file: str) -> dict[str, np.ndarray]:
    """Arrays of a file by name; empty where the run has no such file."""
    if file not in run.manifest.sha256:
        return {}
    path = run.folder / file
    try:
        if file.endswith(".tiff"):
            return {"": np.asarray(tifffile.imread(path))}
        data = read_netcdf(path.read_bytes())
        return {str(name): np.asarray(data[name].values) for name in (*data.data_vars, *data.coords)}
    # the libraries fail on spoilt files in ways that cannot be foreseen
    except Exception as error:
        problem = f"cannot be read as a {'TIFF' if file.endswith('.tiff') else 'netCDF'} file: {why_unreadable(error)}"
        raise InputError(Issue(problem, str(path), allowed="the file as the run wrote it")) from None


def images_of(run: RunResults, difference: ArrayDifference) -> np.ndarray | None:
    """The array that differs, of one run; None where it has none."""
    if (difference.file, difference.name) in run.series:
        return run.series[difference.file, difference.name]
    return _arrays(run, difference.file).get(difference.name)
