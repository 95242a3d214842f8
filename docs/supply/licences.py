"""Licence of every locked package as an SPDX expression, read from the packages and stored in licences.csv."""

from __future__ import annotations

import csv
import importlib.metadata
import re
import tempfile
from collections.abc import Iterable, Mapping
from dataclasses import astuple, dataclass, fields
from functools import cache
from pathlib import Path
from typing import Any

from docs.supply.lock_file import FOLDER, Locked, normal, read_lock
from docs.supply.make_lock import PLATFORM, PYTHONS, SupplyError, run_uv

TABLE = Path(__file__).with_name("licences.csv")
CARRIED = Path(__file__).with_name("carried.csv")
BY_HAND = "its licence file, read by a person"
"""Source of rows that no rule below gives; such rows stay until the version changes."""
OTHER_NAMES = {
    "apache 2": "Apache-2.0",
    "apache 2.0": "Apache-2.0",
    "apache license": "Apache-2.0",
    "apache license, version 2.0": "Apache-2.0",
    "apache software license": "Apache-2.0",
    "bsd 3 clause": "BSD-3-Clause",
    "bsd 3-clause license": "BSD-3-Clause",
    "gnu lesser general public license v3.0": "LGPL-3.0-only",
    "isc license": "ISC",
    "isc license (iscl)": "ISC",
    "mit license": "MIT",
    "the mit license (mit)": "MIT",
    "mozilla public license 2.0 (mpl 2.0)": "MPL-2.0",
    "psfl": "PSF-2.0",
    "python software foundation license": "PSF-2.0",
}
"""Spellings of licences in packages, in lower case; for BSD licences the licence's text determines which."""
COPYLEFT = {
    "strong": re.compile(r"A?GPL-|OSL-|SSPL-|EUPL-|CECILL-2"),
    "weak": re.compile(r"LGPL-|MPL-|EPL-|CDDL-|CPL-"),
}
"""Prefix of a licence's name -> obligations of those who redistribute the package; see docs/installed.md."""
LEAVES = re.compile(r"GCC-exception|Bootloader-exception|Classpath-exception")
"""Exceptions that do not affect programs which only use the package."""


@dataclass(frozen=True)
class Row:
    """Row of the table.

    Attributes
    ----------
    package, version : str
        Name and version as locked.
    for_ : str
        First layer of the lock that has it.
    licence : str
        SPDX expression.
    copyleft : str
        No, weak or strong.
    said_by : str
        File or field in which the licence was read.
    """

    package: str
    version: str
    for_: str
    licence: str
    copyleft: str
    said_by: str


@dataclass(frozen=True)
class Carried:
    """Third-party library within a package's files under another licence: a row of carried.csv, written by hand."""

    package: str
    library: str
    licence: str
    copyleft: str
    note: str


HEADS = [field.name.rstrip("_").replace("_", " ") for field in fields(Row)]


def read_table(file: Path = TABLE) -> tuple[Row, ...]:
    """Return all rows."""
    with file.open(encoding="utf-8", newline="") as lines:
        return tuple(Row(*line) for line in list(csv.reader(lines))[1:])


def read_carried(file: Path = CARRIED) -> tuple[Carried, ...]:
    """Return all rows."""
    with file.open(encoding="utf-8", newline="") as lines:
        return tuple(Carried(*line) for line in list(csv.reader(lines))[1:])


def write_table(rows: Iterable[Row], file: Path = TABLE) -> None:
    """Write all rows, with a head."""
    with file.open("w", encoding="utf-8", newline="") as out:
        writer = csv.writer(out, lineterminator="\n")
        writer.writerows([HEADS, *(astuple(row) for row in rows)])


def update(folder: Path = FOLDER, file: Path = TABLE) -> tuple[Row, ...]:
    """Read the licences of locked packages that the table lacks at this version, and write the table.

    The files of these packages are fetched by their checksums into a temporary folder; nothing is installed.

    Raises
    ------
    SupplyError
        A package states an unknown licence; the index cannot be reached.
    """
    packages = unique(read_lock(folder))
    known = {(row.package, row.version): row for row in read_table(file)} if file.exists() else {}
    fetched = _fetched([p for p in packages if (p.name, p.version) not in known])
    rows, unclear = [], []
    for p in packages:
        row = known.get((p.name, p.version))
        licence, said_by = (row.licence, row.said_by) if row else fetched.get((p.name, p.version), ("", "not found"))
        if not licence:
            unclear.append(f"{p.name} {p.version}: {said_by}")
        else:
            rows.append(Row(p.name, p.version, p.layer, licence, copyleft(licence), said_by))
    if unclear:
        line = f"package,version,layer,SPDX expression,copyleft,{BY_HAND!r}"
        raise SupplyError("\n".join([f"read these by hand and add a line for each to {file}: {line}", *unclear]))
    write_table(rows, file)
    return tuple(rows)


def unique(packages: Iterable[Locked]) -> tuple[Locked, ...]:
    """Return one entry per name and version, of its first layer, with all that require it; sorted by name."""
    found: dict[tuple[str, str], Locked] = {}
    for p in packages:
        first = found.setdefault((p.name, p.version), p)
        asked = tuple(dict.fromkeys([*first.asked_by, *p.asked_by]))
        marker = first.marker if first.marker == p.marker or not p.marker else f"({first.marker}) or ({p.marker})"
        found[p.name, p.version] = Locked(p.name, p.version, marker, first.hashes, asked, first.layer)
    return tuple(found[key] for key in sorted(found))


def _fetched(packages: Iterable[Locked]) -> Mapping[tuple[str, str], tuple[str, str]]:
    """Return (name, version) -> licence and its source, or "" and the unclear text."""
    out: dict[tuple[str, str], tuple[str, str]] = {}
    for python in PYTHONS:
        out |= _read([p for p in packages if (p.name, p.version) not in out], python, markers=True)
    for p in packages:
        if (p.name, p.version) not in out:  # for other platforms only
            out |= _read([p], PYTHONS[0], markers=False)
    return out


def _read(packages: Iterable[Locked], python: str, markers: bool) -> dict[tuple[str, str], tuple[str, str]]:
    """Return the licences of packages fetched for one Python."""
    lines = []
    for p in packages:
        where = f" ; {p.marker}" if markers and p.marker else ""
        lines.append(" ".join([f"{p.name}=={p.version}{where}", *(f"--hash=sha256:{h}" for h in p.hashes)]))
    if not lines:
        return {}
    with tempfile.TemporaryDirectory(prefix="licences-") as place:
        listed = Path(place, "packages.txt")
        listed.write_text("\n".join(lines) + "\n", "utf-8")
        words = ["pip", "install", "--quiet", "--no-deps", "--require-hashes", "--only-binary", ":all:"]
        options = ["--python-version", python, "--python-platform", PLATFORM, "--target", f"{place}/files"]
        run_uv([*words, *options, "-r", str(listed)])
        found = importlib.metadata.distributions(path=[f"{place}/files"])
        return {(normal(d.name), d.version): licence_of(d) for d in found}


def licence_of(package: importlib.metadata.Distribution) -> tuple[str, str]:
    """Return the SPDX expression in a package's files and its source, or "" and the unclear text."""
    metadata = package.metadata
    expression = metadata.get("License-Expression")
    if expression:
        return expression, "License-Expression"
    field = (metadata.get("License") or "").strip()
    classes = [
        line.rpartition(" :: ")[2] for line in metadata.get_all("Classifier") or [] if line.startswith("License ::")
    ]
    classes = [name for name in classes if name != "OSI Approved"]
    for text, place in ((field, "License"), *((name, "Classifier") for name in classes if len(classes) == 1)):
        if len(text) < 60 and (known := OTHER_NAMES.get(text.lower(), text if _is_spdx(text) else "")):
            return known, place
    if field.startswith("Files:"):  # one for each part, as Debian lists them
        parts = sorted(set(re.findall(r"^\s*License: (\S+)$", field, re.M)))
        if parts and all(map(_is_spdx, parts)):
            return " AND ".join(parts), "License"
    if any("bsd" in text.lower() for text in (field, *classes)) and len(classes) < 2:
        for text in (field, *_licence_files(package)):
            clauses = _bsd_of(text)
            if clauses:
                return clauses, "licence file"
    return "", f"License {field[:60]!r}, Classifier {classes}"


@cache
def spdx() -> Any:
    """Return the parser of SPDX expressions, cached because it takes long to make."""
    from license_expression import get_spdx_licensing  # only for the tables' makers: readers do without

    return get_spdx_licensing()


def _is_spdx(text: str) -> bool:
    """Return True if this is an SPDX expression."""
    from license_expression import ExpressionError

    try:
        return spdx().parse(text, validate=True, strict=True) is not None
    except ExpressionError:
        return False


def _licence_files(package: importlib.metadata.Distribution) -> list[str]:
    """Return the texts of a package's licence files."""
    found = [path for path in package.files or [] if re.match(r"(?i)(licen[cs]e|copying)", path.name)]
    # a package's own before those of what it carries
    return [str(path.locate().read_text("utf-8", "replace")) for path in sorted(found, key=lambda p: len(str(p)))]


def _bsd_of(text: str) -> str:
    """Return the BSD licence of a text, "" if it is none."""
    words = " ".join(text.lower().split())
    if "redistribution and use in source and binary forms" not in words:
        return ""
    own = words[: words.index("disclaimed") if "disclaimed" in words else len(words)]
    return "BSD-3-Clause" if "endorse or promote products" in own else "BSD-2-Clause"


def copyleft(expression: str) -> str:
    """Return the obligations of those who redistribute the package: no, weak or strong.

    Weak concerns the package's own source and its changes, strong also the source of what is made with it. Of
    alternative licences the least demanding counts.
    """
    tree = spdx().parse(expression)
    ranks = ("no", "weak", "strong")

    def rank(node: object) -> int:
        arguments = getattr(node, "args", ())
        if arguments:
            return (min if getattr(node, "operator", "AND").strip() == "OR" else max)(map(rank, arguments))
        name = str(node)
        if COPYLEFT["weak"].match(name):
            return 1
        return (1 if LEAVES.search(name) else 2) if COPYLEFT["strong"].match(name) else 0

    return ranks[rank(tree)]
