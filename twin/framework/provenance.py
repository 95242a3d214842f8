"""Where a run was made: versions, source, processor, linear algebra; and its own checks of itself.

The same program gives the same bytes on the same processor (docs/promises.md). What may differ elsewhere follows from
what stands here.
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
from twin.framework.owned_files import digest

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
"""Those whose numbers results depend on."""


def versions() -> dict[str, str]:
    """Python's and the packages' versions, ``not installed`` where there is none, and those of other distributions
    that extend tables of this program.
    """
    return {
        "python": platform.python_version(),
        **{package: _version(package) or "not installed" for package in PACKAGES},
        **{entry.distribution: entry.version for entry in entries()},
    }


@cache
def other_packages() -> dict[str, str]:
    """Versions of the packages that the program asks for beside PACKAGES: they read, write and draw, and no number
    depends on them.
    """
    try:
        asked = importlib.metadata.requires(PACKAGES[0]) or []
    except importlib.metadata.PackageNotFoundError:
        return {}
    named = (_PACKAGE.match(line) for line in asked if "extra ==" not in line)
    names = sorted({found[0] for found in named if found is not None} - set(PACKAGES))
    return {name: version for name in names if (version := _version(name)) is not None}


_PACKAGE = re.compile(r"[A-Za-z0-9._-]+")


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


ROOT = Path(__file__).resolve().parents[2]
BEFORE = __name__.removesuffix("twin.framework.provenance")
"""What stands before the names of modules: nothing in a source tree, in a wheel the one package that holds all others
(docs/wheel).
"""
SOURCES = ("analysis", "optics", "scenes", "twin")
NOT_IN_RUNS = ("twin/validation/",)
"""No run of a study needs these."""


ENDINGS = (".css", ".csv", ".html", ".j2", ".js", ".json", ".py", ".svg", ".tdm", ".txt", ".yaml", ".zmx")
"""Endings of the packages' own files, as a wheel holds them."""


def _program_files(endings: tuple[str, ...]) -> dict[str, str]:
    """Files of the packages with these endings, and of other distributions' that extend tables, by their paths from
    the folder of the package -> SHA-256.
    """
    found = {}
    for place in (*(ROOT / package for package in SOURCES), *_extensions()):
        for path in sorted(place.rglob("*")) if place.is_dir() else (place,):
            if path.suffix in endings and path.is_file():
                found[path.relative_to(place.parent).as_posix()] = _checksum(path)
    return found


def _extensions() -> Iterator[Path]:
    """Folder or file of each package of other distributions that has an entry in a table; nothing is imported."""
    for name in sorted({entry.value.partition(":")[0].partition(".")[0] for entry in entries()}):
        if (spec := find_spec(name)) is not None:
            yield from map(Path, spec.submodule_search_locations or filter(None, [spec.origin]))


@cache
def sources() -> dict[str, str]:
    """Source files that compute, as this process found them first -> checksum; comments and docstrings count.

    To leave these out every file would have to be parsed, a second or two for every command, and nobody edits the
    program in the middle of a study just to rephrase it.
    """
    every = _program_files((".py",))
    return {name: check[:16] for name, check in every.items() if not name.startswith(NOT_IN_RUNS)}


def _checksum(path: Path) -> str:
    """SHA-256 of a file as the source tree has it."""
    text = path.read_bytes()
    return hashlib.sha256(text.replace(BEFORE.encode(), b"") if BEFORE and path.suffix == ".py" else text).hexdigest()


def source_digest() -> str:
    """One checksum for all of ``sources``."""
    return hashlib.sha256(json.dumps(sources(), sort_keys=True).encode()).hexdigest()


@cache
def program_digest() -> str:
    """One SHA-256 for every file of the program as this process found them first: code, library, templates; the same
    for a source tree and for what was installed from it.
    """
    return hashlib.sha256(json.dumps(_program_files(ENDINGS), sort_keys=True).encode()).hexdigest()


Checksum = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]

SETTINGS = (THREADS_VARIABLE, "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENBLAS_CORETYPE", "NPY_DISABLE_CPU_FEATURES")
"""Variables of the environment that change how numbers are rounded or how fast they come."""


class Blas(BaseModel):
    """A library of linear algebra that the process had loaded.

    Attributes
    ----------
    name : str
        ``openblas``.
    version : str
        Of it.
    kernels : str
        Processor whose kernels it chose, ``Haswell``; it decides how sums are rounded.
    threads : int
        That it used.
    """

    model_config = ConfigDict(strict=True, frozen=True)

    name: str
    version: str
    kernels: str
    threads: int


class Provenance(BaseModel):
    """Where a run was made. What is added has a default: folders of earlier programs stay run folders.

    Attributes
    ----------
    source : Checksum
        SHA-256 of all files of the program, however it was installed.
    system : str
        Operating system.
    libc : str
        C library, whose functions are not rounded alike in all versions.
    processor : str
        Model that the operating system names.
    cores : int
        That the run could use.
    simd : list[str]
        Sets of instructions of the processor that NumPy uses.
    blas : list[Blas]
        Libraries of linear algebra, in the order of their names.
    settings : dict[str, str]
        Variables of the environment that were set and matter.
    packages : dict[str, str]
        Version of every package that the program asks for and whose numbers no result depends on: what reads, writes
        and draws.
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
        """Provenance of what this process computes."""
        loaded = [one for one in threadpool_info() if one["user_api"] == "blas"]
        told = [(one["internal_api"], str(one["version"]), str(one.get("architecture", "")), one) for one in loaded]
        found = [Blas(name=a, version=b, kernels=c, threads=one["num_threads"]) for a, b, c, one in told]
        return cls(
            source=program_digest(),
            system=f"{platform.system()} {platform.release()}",
            libc=" ".join(platform.libc_ver()).strip(),
            processor=_processor(),
            cores=cores(),
            simd=_simd(),
            blas=sorted(found, key=lambda one: (one.name, one.version)),
            settings={name: os.environ[name] for name in SETTINGS if name in os.environ},
            packages=other_packages(),
        )


def _processor() -> str:
    """Model of the processor; Linux says it in a file, Python itself does not."""
    try:
        with Path("/proc/cpuinfo").open(encoding="utf-8") as lines:
            named = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "")
    except OSError:
        named = ""
    return f"{named or platform.processor() or 'unknown'}, {platform.machine()}"


def _simd() -> list[str]:
    found: Any = np.show_config(mode="dicts")
    told = found.get("SIMD Extensions", {})
    return [*told.get("baseline", []), *told.get("found", [])]


@dataclass(frozen=True)
class SelfCheck:
    """Something that a run worked out to see whether its own numbers can be right.

    Attributes
    ----------
    name : str
        What was checked.
    value : float
        What came out.
    limit : float | None
        What it must not exceed; None where nothing is refused for it, or the limit is another for every run.
    unit : str
        Of both, empty for a pure number.
    says : str
        What it means that the limit holds, or not; in one sentence.
    """

    name: str
    value: float
    limit: float | None
    unit: str = ""
    says: str = ""

    @property
    def holds(self) -> bool | None:
        """Whether the limit does, None without one."""
        return None if self.limit is None else bool(self.value <= self.limit)

    def to_dict(self) -> dict[str, Any]:
        """The check as plain data."""
        return {**asdict(self), "holds": self.holds}


CHI_SQUARE, WITHIN = re.compile(r"(^|_)chi_square$|^relative_error$|^worst_relative$"), ("chi_square_limit", "limit")
VERDICT = re.compile(r"(^|_)(agrees?|converged|holds?|settled|stable)$")
"""Ending of the keys of truth values that judge a result: where one is False, its numbers or their sigmas are not to be
relied on.
"""
CANDIDATES = re.compile(r"(^|\.)(intervals|starts)\[").search
"""Finds lists in a path whose entries are judged each: the result beside them states its verdict by itself."""
_OF_TRUTH = "0 for yes, 1 for no"
MOST_CHECKS = 50
"""Checks of one run that are kept at most."""


def checks_in(numbers: Mapping[str, Any]) -> tuple[SelfCheck, ...]:
    """What stands in a run's own numbers of whether they can be right: chi-squares of fits, with their limits where
    these are stated, relative errors, and what converged, agrees or holds.

    Parameters
    ----------
    numbers : Mapping[str, Any]
        Of the run, nested.
    """
    return tuple(islice(_checks(numbers, ""), MOST_CHECKS))


def _checks(tree: Any, path: str) -> Iterator[SelfCheck]:
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
    """Return the paths of all verdicts on a result that are False, such as ``disturbances.agrees``; those of CANDIDATES
    are left out.

    Parameters
    ----------
    numbers : Mapping[str, Any]
        Of the result, nested plain data.
    """
    return [
        one.name for one in _checks(numbers, "") if one.says == _OF_TRUTH and one.value and not CANDIDATES(one.name)
    ]


def inputs_in(tree: Any, given: Iterable[Path] = ()) -> dict[str, str]:
    """Checksums of the files that a resolved set-up names; its paths are absolute.

    What is in the set-up itself, in full, is no input any more: neither the file of the test nor those of the library.

    Parameters
    ----------
    tree : Any
        The set-up as plain data; every text in it that is the absolute path of a file, or of a folder, is one.
    given : Iterable[Path]
        Further files and folders.

    Returns
    -------
    dict[str, str]
        Absolute path -> SHA-256, of a folder those of all its files.
    """
    out: dict[str, str] = {}
    for place in (*map(Path, dict.fromkeys(_paths(tree))), *given):
        for file in _files(place.absolute()):
            if str(file) not in out:
                out[str(file)] = digest(file)
    return dict(sorted(out.items()))


MOST_FILES = 10_000
"""Files of a folder that is named as an input, at most."""


def _files(place: Path) -> Iterable[Path]:
    try:
        if place.is_file():
            return (place,)
        if place.is_dir():
            found = (path for path in sorted(place.rglob("*")) if path.is_file())
            return [path for path, _ in zip(found, range(MOST_FILES), strict=False)]
    except (OSError, ValueError):  # a text that only looks like a path
        pass
    return ()


def _paths(tree: Any) -> Iterable[str]:
    if isinstance(tree, Mapping):
        for below in tree.values():
            yield from _paths(below)
    elif isinstance(tree, str):
        if tree.startswith("/") and len(tree) > 1 and "\n" not in tree:
            yield tree
    elif isinstance(tree, Sequence) and not isinstance(tree, bytes):
        for below in tree:
            yield from _paths(below)
