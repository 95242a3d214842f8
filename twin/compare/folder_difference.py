"""Differences of two run folders, file by file: numbers with their sigmas, texts, arrays and images.

Files are read by their format, independent of the program that wrote them. Keys of times, durations and versions are
excluded. `file_difference` lists every number, text and array that is not equal to the bit; ``twin.compare`` and
``twin.verify`` decide which of these count.
"""

import csv
import io
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tifffile

from scenes.specs.file_kinds import kind_of
from scenes.yaml.errors import InputError, Issue
from scenes.yaml.input_file import parse_json, why_unreadable
from scenes.yaml.spec import validate
from scenes.yaml.yaml_file import parse_yaml
from twin.framework.data_files import read_netcdf

Leaf = float | int | str | bool | None
EXCLUDED_KEYS = frozenset(
    (
        *("seconds", "worker_seconds", "runs_computed", "states_per_second", "wall_time_s", "started_unix_s"),
        *("fingerprint", "sha256", "versions", "schema", "reference_frames"),
    )
)
"""Keys of results that describe how the run was done, instead of its results."""
STATEMENTS = frozenset(("verdict", "warnings"))
"""Keys of a result whose values are sentences (verdict, warnings) that follow from its numbers."""
ENTRY_NAMES = ("name", "motion", "label", "field", "path", "time_s")
"""Keys whose values identify an entry of a list, such as its name.

The first key is used that all entries have with different values.
"""
NOISE = "noise"
"""Source of a sigma that is due to the images' noise alone, which more frames reduce."""
_ARRAY_LENGTH = 12
"""Number of entries above which a list of numbers is compared as an array and not number by number."""


@dataclass(frozen=True, eq=False)
class Content:
    """Content of a file.

    Attributes
    ----------
    numbers : Mapping[str, Leaf]
        Key -> number or text.
    arrays : Mapping[str, ndarray]
        Name -> array.
    statements : Mapping[str, Any]
        Key -> sentences that follow from the numbers.
    """

    numbers: Mapping[str, Leaf]
    arrays: Mapping[str, np.ndarray]
    statements: Mapping[str, Any]


@dataclass(frozen=True)
class NumberDifference:
    """Number or text with different values in two files.

    Attributes
    ----------
    file : str
        Path in the run folder, such as ``recovered.json``.
    key : str
        Key in the file, which ends in its unit.
    reference, other : Leaf
        Both values; None where a file lacks the key.
    sigma : float | None
        Standard deviation of the difference of two independent measurements, from both files' sigmas; None if the files
        hold none.
    sigma_of : str
        ``noise`` if sigma is due to the images' noise alone, ``stated`` if it is the total sigma that the files give;
        empty without a sigma.
    scale : float
        Largest number of the same kind in both files.
    """

    file: str
    key: str
    reference: Leaf
    other: Leaf
    sigma: float | None = None
    sigma_of: str = ""
    scale: float = 0.0

    @property
    def difference(self) -> float | None:
        """Other minus reference; None unless both are numbers."""
        if is_number(self.reference) and is_number(self.other):
            return float(self.other) - float(self.reference)  # type: ignore[arg-type]
        return None

    @property
    def in_sigma(self) -> float | None:
        """Difference divided by its sigma; None without a sigma."""
        return None if self.difference is None or not self.sigma else self.difference / self.sigma


@dataclass(frozen=True)
class ArrayDifference:
    """Image or other array with different values in two files.

    Attributes
    ----------
    file : str
        Path in the run folder.
    name : str
        Name of the variable; empty for an image.
    shape, other_shape : tuple[int, ...] | None
        Shapes of the reference and of the other array; None where a file lacks it.
    largest : float | None
        Largest absolute difference; None unless both are numeric and of one shape.
    rms : float | None
        Root mean square of the difference.
    peak : float | None
        Largest absolute value of the reference.
    share : float | None
        Share of the elements that differ; None if the shapes differ.
    where : tuple[int, ...]
        Index of the element that differs most.
    reference, other : Leaf
        Values of this element.
    depth : int
        Bytes per element of an array of unsigned integers, such as an image; 0 for other types.
    """

    file: str
    name: str
    shape: tuple[int, ...] | None
    other_shape: tuple[int, ...] | None
    largest: float | None = None
    rms: float | None = None
    peak: float | None = None
    share: float | None = None
    where: tuple[int, ...] = ()
    reference: Leaf = None
    other: Leaf = None
    depth: int = 0

    @property
    def finite(self) -> bool:
        """True if the element that differs most has finite values in both arrays."""
        return self.largest is not None and math.isfinite(float(self.other or 0) - float(self.reference or 0))


@dataclass(frozen=True, eq=False)
class FileDifference:
    """All values of a file in two run folders that are not equal to the bit.

    Attributes
    ----------
    file : str
        Path in the run folders.
    numbers : tuple[NumberDifference, ...]
        Numbers and texts that differ.
    arrays : tuple[ArrayDifference, ...]
        Images and other arrays that differ.
    statements : tuple[NumberDifference, ...]
        Differing sentences that follow from the numbers.
    common_numbers, common_arrays : int
        Number of values and of arrays that both files have; 0 and 1 for files of equal bytes that are not JSON.
    """

    file: str
    numbers: tuple[NumberDifference, ...] = ()
    arrays: tuple[ArrayDifference, ...] = ()
    statements: tuple[NumberDifference, ...] = ()
    common_numbers: int = 0
    common_arrays: int = 1


def file_difference(name: str, reference: Path | None, other: Path | None) -> FileDifference:
    """Compare a file of two run folders.

    Parameters
    ----------
    name : str
        Path in the run folders.
    reference : Path | None
        The file in the first folder; None if it does not exist.
    other : Path | None
        The file in the second folder.

    Raises
    ------
    InputError
        A file cannot be read.
    """
    if reference is not None and other is not None and _same_bytes(reference, other):
        if ending(name) != "json":
            return FileDifference(name)
        content = content_of(reference, name)
        return FileDifference(name, common_numbers=len(content.numbers), common_arrays=len(content.arrays))
    contents = [Content({}, {}, {}) if path is None else content_of(path, name) for path in (reference, other)]
    return content_difference(name, *contents)


def content_difference(name: str, reference: Content, other: Content) -> FileDifference:
    """Compare the contents of two files.

    Parameters
    ----------
    name : str
        Name of the file.
    reference : Content
        Content of the first.
    other : Content
        Content of the second.
    """
    reference_numbers, other_numbers = reference.numbers, other.numbers
    scales = _scales(reference_numbers, other_numbers)
    numbers = []
    for key in dict.fromkeys((*reference_numbers, *other_numbers)):
        here, there = reference_numbers.get(key), other_numbers.get(key)
        if not (key in reference_numbers and key in other_numbers and _same(here, there)):
            sigma, scale = sigma_of(reference_numbers, other_numbers, key), scales.get(_quantity_kind(key), 0.0)
            numbers.append(NumberDifference(name, key, here, there, *sigma, scale))
    pairs = {key: (reference.arrays.get(key), other.arrays.get(key)) for key in (*reference.arrays, *other.arrays)}
    arrays = [off for key, pair in pairs.items() if (off := array_difference(name, key, *pair)) is not None]
    before, after = reference.statements, other.statements
    statements = [
        NumberDifference(name, key, before.get(key), after.get(key))
        for key in dict.fromkeys((*before, *after))
        if before.get(key) != after.get(key)
    ]
    common = (len(reference_numbers.keys() & other_numbers.keys()), len(reference.arrays.keys() & other.arrays.keys()))
    return FileDifference(name, tuple(numbers), tuple(arrays), tuple(statements), *common)


def array_difference(file: str, name: str, here: np.ndarray | None, there: np.ndarray | None) -> ArrayDifference | None:
    """Compare two arrays; return None if they are equal to the bit.

    Parameters
    ----------
    file : str
        File of the arrays.
    name : str
        Name of both arrays.
    here : ndarray | None
        The first array, of any shape; None if it does not exist.
    there : ndarray | None
        The second array.
    """
    if here is None or there is None or here.shape != there.shape:
        first, second = (None if array is None else array.shape for array in (here, there))
        return ArrayDifference(file, name, first, second)
    numeric = all(np.issubdtype(array.dtype, np.number) for array in (here, there))
    values, other_values = (array.astype(np.float64 if numeric else str) for array in (here, there))
    unlike = (
        (values != other_values) & ~(np.isnan(values) & np.isnan(other_values)) if numeric else values != other_values
    )
    if not unlike.any():
        return None
    share = float(unlike.mean())
    if not numeric:
        where = tuple(int(k) for k in np.argwhere(unlike)[0])
        here_text, there_text = str(values[where]), str(other_values[where])
        return ArrayDifference(
            file, name, here.shape, there.shape, share=share, where=where, reference=here_text, other=there_text
        )
    finite = np.isfinite(values) & np.isfinite(other_values)
    delta = np.zeros_like(values)
    with np.errstate(over="ignore"):  # differences of extreme numbers overflow
        np.subtract(other_values, values, out=delta, where=finite)
    largest = float(np.max(np.abs(delta), initial=0.0))
    scale = largest if 1e150 < largest < np.inf else 1.0  # avoids overflow of the squares
    rms = scale * float(np.sqrt(np.mean((delta / scale) ** 2)))
    peak = float(np.max(np.abs(values), where=np.isfinite(values), initial=0.0))
    worst = np.where(unlike & ~finite, np.inf, np.abs(delta))
    where = tuple(int(k) for k in np.unravel_index(int(np.argmax(worst)), worst.shape))
    depth = here.dtype.itemsize if here.dtype.kind == "u" else 0
    far = (values[where].item(), other_values[where].item())
    return ArrayDifference(file, name, here.shape, there.shape, largest, rms, peak, share, where, *far, depth)


def _same_bytes(path: Path, other: Path) -> bool:
    try:
        return path.read_bytes() == other.read_bytes()
    except OSError as error:
        raise InputError(Issue(f"cannot be read: {error.strerror}", str(error.filename))) from None


def ending(name: str) -> str:
    """Return the suffix of a file name in lower case, without the dot."""
    return name.rpartition(".")[2].lower()


def is_number(value: Any) -> bool:
    """Return whether a value is a number and not a boolean."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def _same(here: Any, there: Any) -> bool:
    both_nan = isinstance(here, float) and isinstance(there, float) and math.isnan(here) and math.isnan(there)
    return both_nan or (here == there and type(here) is type(there))


def is_sigma(key: str) -> bool:
    """Return True if a key is that of a standard deviation, or of a residual after correction, of another number."""
    last = key.rpartition(".")[2]
    return last == "sigma" or last.endswith(("_sigma", "_sigma_noise")) or last.startswith(("sigma_", "left_"))


def sigma_of(reference: Mapping[str, Leaf], other: Mapping[str, Leaf], key: str) -> tuple[float | None, str]:
    """Return the sigma of the difference of two numbers, and its source.

    For a number with the key ``x`` the source is ``noise`` if both runs have ``x_sigma_noise`` beside it, otherwise
    ``stated``, the total sigma from ``x_sigma`` or ``sigma``. Noise is preferred because an estimator's systematic
    error, due to the bodies' motions, is equal in two runs with the same motions.

    Parameters
    ----------
    reference : Mapping[str, Leaf]
        Key -> value of the first file.
    other : Mapping[str, Leaf]
        Key -> value of the second file.
    key : str
        Key of the numbers.
    """
    head, dot, last = key.rpartition(".")
    for name in (f"{last}_sigma_noise", f"{last}_sigma", *(("sigma",) if last == "value" else ())):
        both: list[Any] = [numbers.get(f"{head}{dot}{name}") for numbers in (reference, other)]
        if all(map(is_number, both)):
            return math.hypot(*map(float, both)), NOISE if name.endswith(NOISE) else "stated"
    return None, ""


def _quantity_kind(key: str) -> str:
    """Return the name that all numbers of one kind share, by which their common scale is found.

    It is a table's column, or the last part of a key that is an identifier, such as ``zernike_waves`` for the Zernike
    terms of a list.
    """
    if key.startswith("row "):
        return key.partition(", ")[2]
    names = _INDEX.sub("", key).split(".")
    return next((name for name in reversed(names) if name.isidentifier()), key)


_INDEX = re.compile(r"\[(?:\[[^\]]*\]|[^\[\]])*\]")
"""Pattern of an index in a key after a list's name: an entry's number in brackets, or the name that identifies it."""


def _scales(*contents: Mapping[str, Leaf]) -> dict[str, float]:
    """Return kind of number -> largest absolute value in all contents, relative to which rounding is judged."""
    out: dict[str, float] = {}
    for numbers in contents:
        for key, value in numbers.items():
            if isinstance(value, float) and math.isfinite(value):
                name = _quantity_kind(key)
                out[name] = max(out.get(name, 0.0), abs(value))
    return out


# content of a file


def content_of(path: Path, name: str) -> Content:
    """Read a file by its format.

    Parameters
    ----------
    path : Path
        The file.
    name : str
        Path in the run folder, whose suffix determines the format; unknown formats are read as text.

    Raises
    ------
    InputError
        The file cannot be read.
    """
    try:
        content = path.read_bytes()
        if ending(name) == "json":
            return plain(parse_json(content.decode("utf-8"), str(path)))
        return READERS.get(ending(name), _text)(content)
    except InputError:
        raise
    # readers of corrupted files fail in unforeseeable ways
    except Exception as error:
        kind = {"nc": "netCDF"}.get(ending(name), ending(name).upper())
        problem = f"cannot be read as a {kind} file: {why_unreadable(error)}"
        raise InputError(Issue(problem, str(path), allowed="the file as the run wrote it")) from None


def plain(data: Any) -> Content:
    """Return the numbers, texts and arrays of nested mappings and lists."""
    statements = {key: data[key] for key in STATEMENTS if key in data} if isinstance(data, Mapping) else {}
    rest = {key: value for key, value in data.items() if key not in statements} if isinstance(data, Mapping) else data
    values = dict(leaves(rest))
    arrays = {key: value for key, value in values.items() if isinstance(value, np.ndarray)}
    return Content({key: value for key, value in values.items() if key not in arrays}, arrays, statements)


def leaves(data: Any, key: str = "", series: bool = True) -> Iterator[tuple[str, Any]]:
    """Yield keys and values of nested data, without those of `EXCLUDED_KEYS`.

    Parameters
    ----------
    data : dict, list, number, str or None
        Mappings and lists.
    key : str
        Key of the data, which precedes the keys in it.
    series : bool
        Yield long lists of numbers as arrays.
    """
    if isinstance(data, Mapping):
        for name, value in data.items():
            if name not in EXCLUDED_KEYS:
                yield from leaves(value, f"{key}.{name}" if key else str(name), series)
    elif isinstance(data, list):
        if series and len(data) > _ARRAY_LENGTH and (array := _as_array(data)) is not None:
            yield key, array
            return
        names = _entry_names(data)
        for k, value in enumerate(data):
            yield from leaves(value, f"{key}[{names[k]}]", series)
    else:
        yield key, data


def _as_array(data: Sequence[Any]) -> np.ndarray | None:
    try:
        return np.asarray([[math.nan] if value is None else value for value in data], dtype=np.float64)
    except (TypeError, ValueError):
        return None


def _entry_names(data: Sequence[Any]) -> list[str]:
    """Return names that distinguish the entries of a list, so that an inserted entry does not rename the others."""
    for name in ENTRY_NAMES:
        labels = [str(entry[name]) for entry in data if isinstance(entry, Mapping) and name in entry]
        if len(labels) == len(data) and len(set(labels)) == len(labels):
            return labels
    return [str(k) for k in range(len(data))]


def _yaml(content: bytes) -> Content:
    """Return the content of a YAML file; comments, layout and the choice of units do not count."""
    file = parse_yaml(content.decode("utf-8"))
    kind = kind_of(file.data)
    if kind is not None:
        with suppress(InputError):  # a config.yaml contains such a file under a key
            return plain(validate(kind.model, file).plain())
    return plain(file.data)


def _csv(content: bytes) -> Content:
    rows = list(csv.reader(io.StringIO(content.decode("utf-8"))))
    heads = rows[0] if rows else []
    cells = {
        f"row {k}, {heads[c] if c < len(heads) else c + 1}": _cell(cell)
        for k, row in enumerate(rows[1:], 2)
        for c, cell in enumerate(row)
    }
    return Content({**{f"head {c + 1}": head for c, head in enumerate(heads)}, **cells}, {}, {})


def _cell(text: str) -> Leaf:
    """Return a cell of a CSV table as a number if possible, otherwise as text."""
    for kind in (int, float):
        with suppress(ValueError):
            return kind(text)
    return text


def _netcdf(content: bytes) -> Content:
    data = read_netcdf(content)
    arrays = {str(name): np.asarray(data[name].values) for name in (*data.data_vars, *data.coords)}
    attributes = {name: value for name, value in data.attrs.items() if isinstance(value, str | float)}
    numbers = {f"attribute {name}": value for name, value in attributes.items() if name not in EXCLUDED_KEYS}
    return Content(numbers, arrays, {})


def _tiff(content: bytes) -> Content:
    return Content({}, {"": np.asarray(tifffile.imread(io.BytesIO(content)))}, {})


def _fits(content: bytes) -> Content:
    from astropy.io import fits

    arrays: dict[str, np.ndarray] = {}
    with fits.open(io.BytesIO(content)) as units:
        for k, unit in enumerate(units):
            name, columns = unit.name or f"unit {k}", () if unit.data is None else unit.data.dtype.names
            if columns is None:
                arrays[name] = np.asarray(unit.data)
            else:
                arrays |= {f"{name} {column}": np.asarray(unit.data[column]) for column in columns}
    return Content({}, arrays, {})


def _parquet(content: bytes) -> Content:
    import pandas as pd

    table = pd.read_parquet(io.BytesIO(content))
    return Content({}, {str(name): table[name].to_numpy() for name in table.columns}, {})


_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")


def _text(content: bytes) -> Content:
    """Return a text file's content: its numbers as an array, and its words with "#" instead of each number.

    Of a file that is not text, the bytes are the array.
    """
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError:
        return Content({}, {"bytes": np.frombuffer(content, np.uint8)}, {})
    numbers = np.array([float(number) for number in _NUMBER.findall(text)])
    return Content({"text": _NUMBER.sub("#", text)}, {"numbers": numbers}, {})


READERS: dict[str, Callable[[bytes], Content]] = {
    "yaml": _yaml,
    "csv": _csv,
    "nc": _netcdf,
    "tiff": _tiff,
    "tif": _tiff,
    "fits": _fits,
    "parquet": _parquet,
    "journal": lambda content: Content({}, {}, {}),  # journal of a study, whose numbers are in study.nc
}
"""Suffix of a file name -> function that reads the numbers, texts and arrays of such a file."""
