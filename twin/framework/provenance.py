"""Provenance of a run (versions, source, processor, linear algebra), and its self-checks.

The same program gives the same bytes on the same processor (docs/promises.md). Differences on other machines can be
explained by the facts recorded here.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import os
import platform
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from threadpoolctl import threadpool_info

from optics.numerics.backend import THREADS_VARIABLE, cores
from optics.numerics.extension_table import entries
from twin.framework.durable import digest

PACKAGES = (
    "space-camera-twin",
    "drjit",
    "mitsuba",
    "numpy",
    "scipy",
    "opencv-python-headless",
    "pyerfa",
    "pyproj",
    "scikit-fem",
    "scikit-learn",
    "trimesh",
    "karellen-llvm-core",
)
"""Packages that affect the numbers of results."""


def versions() -> dict[str, str]:
    """Return the versions of Python, of the packages in `PACKAGES` and of extensions of the program, by name.

    A missing package has the text ``not installed``.
    """
    return {
        "python": platform.python_version(),
        **{package: _version(package) or "not installed" for package in PACKAGES},
        **{entry.distribution: entry.version for entry in entries()},
    }


@cache
def other_packages() -> dict[str, str]:
    """Return the versions of required packages that are not in PACKAGES.

    They read, write and draw, but do not affect the numbers.
    """
    try:
        requirements = importlib.metadata.requires(PACKAGES[0]) or []
    except importlib.metadata.PackageNotFoundError:
        return {}
    named = (_PACKAGE.match(line) for line in requirements if "extra ==" not in line)
    names = sorted({match[0] for match in named if match is not None} - set(PACKAGES))
    return {name: version for name in names if (version := _version(name)) is not None}


_PACKAGE = re.compile(r"[A-Za-z0-9._-]+")


def _version(package: str) -> str | None:
    """Return the version of a package, or None."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


ROOT = Path(__file__).resolve().parents[2]
BEFORE = __name__.removesuffix("twin.framework.provenance")
"""Package prefix of the modules' names: empty in a source tree; in a wheel, the one package that contains the others
(docs/wheel).
"""
SOURCES = ("analysis", "optics", "scenes", "twin")
NOT_IN_RUNS = ("twin/validation/",)
"""Folders of source files on which the results of no run depend, so that they are not part of the checksum of sources.
"""


ENDINGS = (".css", ".csv", ".html", ".j2", ".js", ".json", ".py", ".svg", ".tdm", ".txt", ".yaml", ".zmx")
"""File extensions of the packages' own files, which a wheel contains."""


def _program_files(endings: tuple[str, ...]) -> dict[str, str]:
    """Return the SHA-256 of the packages' files with these file extensions, by path.

    Packages of other distributions that extend tables are included; paths are relative to the parent of each package.
    """
    checksums = {}
    for source in (*(ROOT / package for package in SOURCES), *_extensions()):
        for path in sorted(source.rglob("*")) if source.is_dir() else (source,):
            if path.suffix in endings and path.is_file():
                checksums[path.relative_to(source.parent).as_posix()] = _checksum(path)
    return checksums


def _extensions() -> Iterator[Path]:
    """Yield the folder or file of each package of other distributions that extends a table, without importing it."""
    for name in sorted({entry.value.partition(":")[0].partition(".")[0] for entry in entries()}):
        if (spec := find_spec(name)) is not None:
            yield from map(Path, spec.submodule_search_locations or filter(None, [spec.origin]))


@cache
def sources() -> dict[str, str]:
    """Return the checksum of every source file, by path, as this process first read it; comments count.

    To ignore them every file would have to be parsed, which takes a second or two for every command, and the program is
    rarely edited in the middle of a study.
    """
    checksums = _program_files((".py",))
    return {name: check[:16] for name, check in checksums.items() if not name.startswith(NOT_IN_RUNS)}


def _checksum(path: Path) -> str:
    """Return the SHA-256 of a file as it is in the source tree."""
    text = path.read_bytes()
    return hashlib.sha256(text.replace(BEFORE.encode(), b"") if BEFORE and path.suffix == ".py" else text).hexdigest()


def source_digest() -> str:
    """Return one checksum for all source files of the program."""
    return hashlib.sha256(json.dumps(sources(), sort_keys=True).encode()).hexdigest()


@cache
def program_digest() -> str:
    """Return one SHA-256 for all files of the program as this process first read them: code, library and templates.

    It is the same for a source tree and for an installation made from it.
    """
    return hashlib.sha256(json.dumps(_program_files(ENDINGS), sort_keys=True).encode()).hexdigest()


Checksum = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]

SETTINGS = (
    THREADS_VARIABLE,
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "OPENBLAS_CORETYPE",
    "NPY_DISABLE_CPU_FEATURES",
)
"""Environment variables that change the rounding of numbers or the speed."""


class Blas(BaseModel):
    """Linear-algebra library that the process had loaded.

    Attributes
    ----------
    name : str
        Name of the library, ``openblas``.
    version : str
        Version of the library.
    kernels : str
        Processor whose kernels the library chose, ``Haswell``; they determine the rounding of sums.
    threads : int
        Number of threads.
    """

    model_config = ConfigDict(strict=True, frozen=True)

    name: str
    version: str
    kernels: str
    threads: int


class Provenance(BaseModel):
    """Machine and software of a run. New fields have a default, so that folders of earlier versions stay readable.

    Attributes
    ----------
    source : str
        SHA-256 of all files of the program, however it was installed.
    system : str
        Operating system.
    libc : str
        C library; rounding of its functions depends on its version.
    processor : str
        Model reported by the operating system.
    cores : int
        Cores available to the run.
    simd : list of str
        Instruction sets of the processor that NumPy uses.
    blas : list of Blas
        Linear-algebra libraries, sorted by name.
    settings : dict of str to str
        Relevant environment variables that were set.
    packages : dict of str to str
        Versions of required packages that do not affect the numbers: they read, write and draw.
    """

    model_config = ConfigDict(strict=True, frozen=True)

    source: Checksum
    system: str
    libc: str = ""
    processor: str
    cores: int
    simd: list[str]
    blas: list[Blas]
    settings: dict[str, str]
    packages: dict[str, str] = {}

    @classmethod
    def here(cls) -> Provenance:
        """Return the provenance of computations in this process."""
        loaded = [library for library in threadpool_info() if library["user_api"] == "blas"]
        libraries = [
            (library["internal_api"], str(library["version"]), str(library.get("architecture", "")), library)
            for library in loaded
        ]
        blas = [Blas(name=a, version=b, kernels=c, threads=library["num_threads"]) for a, b, c, library in libraries]
        return cls(
            source=program_digest(),
            system=f"{platform.system()} {platform.release()}",
            libc=" ".join(platform.libc_ver()).strip(),
            processor=_processor(),
            cores=cores(),
            simd=_simd(),
            blas=sorted(blas, key=lambda library: (library.name, library.version)),
            settings={name: os.environ[name] for name in SETTINGS if name in os.environ},
            packages=other_packages(),
        )


def _processor() -> str:
    """Return the model of the processor; Linux reports it in a file, Python itself does not."""
    try:
        with Path("/proc/cpuinfo").open(encoding="utf-8") as lines:
            named = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "")
    except OSError:
        named = ""
    return f"{named or platform.processor() or 'unknown'}, {platform.machine()}"


def _simd() -> list[str]:
    """Return the names of the processor's vector instruction sets that NumPy uses."""
    configuration: Any = np.show_config(mode="dicts")
    extensions = configuration.get("SIMD Extensions", {})
    return [*extensions.get("baseline", []), *extensions.get("found", [])]


@dataclass(frozen=True)
class SelfCheck:
    """Self-check of a run: a value that shows whether its numbers can be right.

    Attributes
    ----------
    name : str
        Quantity that was checked.
    value : float
        Value of the quantity.
    limit : float | None
        Largest allowed value; None if none is defined.
    unit : str
        Unit of both, empty for a pure number.
    says : str
        One sentence on the meaning of the check.
    """

    name: str
    value: float
    limit: float | None
    unit: str = ""
    says: str = ""

    @property
    def holds(self) -> bool | None:
        """True if the value is within the limit, False if not, None without a limit."""
        return None if self.limit is None else bool(self.value <= self.limit)

    def to_dict(self) -> dict[str, Any]:
        """Return the check as plain data."""
        return {**asdict(self), "holds": self.holds}


CHI_SQUARE, WITHIN = re.compile(r"(^|_)chi_square$|^relative_error$|^worst_relative$"), ("chi_square_limit", "limit")
VERDICT = re.compile(r"(^|_)(agrees?|converged|holds?|settled|stable)$")
"""Pattern of the keys of true/false values that judge a result: where one is False, the numbers or their sigmas are not
reliable.
"""
CANDIDATES = re.compile(r"(^|\.)(intervals|starts)\[").search
"""Function that finds, in the path of a verdict, lists of candidates (intervals, starts), whose own verdicts do not
judge the result.
"""
_OF_TRUTH = "0 for yes, 1 for no"
MOST_CHECKS = 50
"""Largest number of checks recorded for one run."""


def checks_in(numbers: Mapping[str, Any]) -> tuple[SelfCheck, ...]:
    """Return the self-checks in the numbers of a run.

    They are the chi-squares of fits (with their limits, where given), relative errors, and true/false values of
    convergence, agreement and validity.

    Parameters
    ----------
    numbers : mapping
        Numbers of the run, nested.
    """
    return tuple(islice(_checks(numbers, ""), MOST_CHECKS))


def _checks(tree: Any, path: str) -> Iterator[SelfCheck]:
    """Yield the self-checks among nested numbers, named by their paths."""
    if isinstance(tree, Mapping):
        limit = next((float(tree[name]) for name in WITHIN if isinstance(tree.get(name), int | float)), None)
        for key, value in tree.items():
            name = f"{path}.{key}" if path else str(key)
            if VERDICT.search(str(key)) and isinstance(value, bool | list):
                good = all(value) if isinstance(value, list) else value
                yield SelfCheck(name, 0.0 if good else 1.0, 0.0, "", _OF_TRUTH)
            elif CHI_SQUARE.search(str(key)) and isinstance(value, int | float) and not isinstance(value, bool):
                yield SelfCheck(name, float(value), limit if "chi_square" in str(key) else None)
            else:
                yield from _checks(value, name)
    elif isinstance(tree, list | tuple):
        for k, value in enumerate(tree):
            yield from _checks(value, f"{path}[{k}]")


def negative_verdicts(numbers: Mapping[str, Any]) -> list[str]:
    """Return the paths of all verdicts on a result that are False, such as ``disturbances.agrees``, except CANDIDATES.

    Parameters
    ----------
    numbers : mapping
        Numbers of the result, nested plain data.
    """
    return [
        check.name
        for check in _checks(numbers, "")
        if check.says == _OF_TRUTH and check.value and not CANDIDATES(check.name)
    ]


def inputs_in(tree: Any, paths: Iterable[Path] = ()) -> dict[str, str]:
    """Return the checksums of the files that a resolved set-up names by absolute paths.

    Content that the set-up already includes in full, such as the file of the test and those of the library, is not an
    input.

    Parameters
    ----------
    tree : Any
        Set-up as plain data; every text in it that is the absolute path of a file or folder counts.
    paths : iterable of Path
        Further files and folders.

    Returns
    -------
    dict of str to str
        SHA-256 by absolute path; for a folder, those of all its files.
    """
    out: dict[str, str] = {}
    for path in (*map(Path, dict.fromkeys(_paths(tree))), *paths):
        for file in _files(path.absolute()):
            if str(file) not in out:
                out[str(file)] = digest(file)
    return dict(sorted(out.items()))


MOST_FILES = 10_000
"""Largest number of files recorded for a folder that is an input."""


def _files(source: Path) -> Iterable[Path]:
    """Return the file at a path, or all files of the folder there."""
    try:
        if source.is_file():
            return (source,)
        if source.is_dir():
            files = (path for path in sorted(source.rglob("*")) if path.is_file())
            return [path for path, _ in zip(files, range(MOST_FILES), strict=False)]
    except (OSError, ValueError):  # the text only looks like a path
        pass
    return ()


def _paths(tree: Any) -> Iterable[str]:
    """Yield all texts in plain data that look like absolute paths."""
    if isinstance(tree, Mapping):
        for below in tree.values():
            yield from _paths(below)
    elif isinstance(tree, str):
        if tree.startswith("/") and len(tree) > 1 and "\n" not in tree:
            yield tree
    elif isinstance(tree, Sequence) and not isinstance(tree, bytes):
        for below in tree:
            yield from _paths(below)
