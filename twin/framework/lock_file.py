"""Reading the lock files in docs/supply/lock: what setup.sh installs, and what is installed other than that."""

from __future__ import annotations

import importlib.metadata
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from packaging.markers import Marker

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "supply" / "lock"
"""Beside the source; an installed wheel has none."""
LAYERS = ("install", "runtime", "live", "test", "peers")
"""Files of the lock. A later one has only what it adds; the peers are in a folder of their own."""
_PIN = re.compile(r"([A-Za-z0-9._-]+)==([^\s;\\]+)\s*(?:;\s*(.*?))?\s*\\?$")
_HASH = re.compile(r"--hash=sha256:([0-9a-f]{64})\s*\\?$")


class LockError(Exception):
    """A lock file that is not what pip and this module read; the message names its line."""


@dataclass(frozen=True)
class Locked:
    """One package of a lock file.

    Attributes
    ----------
    name : str
        As the index has it, in lower case with hyphens.
    version : str
        The only one that is installed.
    marker : str
        For which Python and platform, as pip reads it; empty for all.
    hashes : tuple[str, ...]
        SHA-256 of the files that are accepted, hexadecimal.
    asked_by : tuple[str, ...]
        Names of the packages that need it; the project's own stands for what pyproject.toml names; empty for what is
        named in a list of its own.
    layer : str
        The file, one of `LAYERS`.
    """

    name: str
    version: str
    marker: str
    hashes: tuple[str, ...]
    asked_by: tuple[str, ...]
    layer: str

    @property
    def here(self) -> bool:
        """Whether this Python on this platform is meant."""
        return not self.marker or Marker(self.marker).evaluate()


def normal(name: str) -> str:
    """A package's name as the lock has it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def read_layer(layer: str, folder: Path = FOLDER) -> tuple[Locked, ...]:
    """The packages of one file.

    Parameters
    ----------
    layer : str
        One of `LAYERS`.
    folder : Path
        Of the lock files.

    Raises
    ------
    LockError
        a line that is neither a pin, nor a hash, nor a comment; a pin without a hash.
    OSError
        No such file.
    """
    file = folder / f"{layer}.txt"
    return parse(file.read_text("utf-8"), layer, str(file))


def parse(text: str, layer: str, file: str) -> tuple[Locked, ...]:
    """The packages that the text of one file lists; `file` is for messages."""
    found: list[Locked] = []
    pin: re.Match[str] | None = None
    hashes: list[str] = []
    asked: list[str] = []

    def close(number: int) -> None:
        if pin is not None:
            if not hashes:
                raise LockError(f"{file}:{number}: {pin[1]} has no hash")
            found.append(Locked(normal(pin[1]), pin[2], pin[3] or "", tuple(hashes), tuple(asked), layer))

    lines = text.splitlines()
    for number, line in enumerate(lines, 1):
        bare = line.strip()
        if not line[:1].isspace() and bare and not bare.startswith("#"):
            close(number - 1)
            pin, hashes, asked = _PIN.match(bare), [], []
            if pin is None:
                raise LockError(f"{file}:{number}: not a pinned package: {bare}")
        elif bare.startswith("# via "):
            askers = bare.removeprefix("# via ").split(", ")
            asked += [normal(word.split(" (")[0]) for word in askers if not word.startswith("-r ")]
        elif bare and not bare.startswith("#"):
            digest = _HASH.match(bare)
            if digest is None:
                raise LockError(f"{file}:{number}: not a hash: {bare}")
            hashes.append(digest[1])
    close(len(lines))
    return tuple(found)


def read_lock(folder: Path = FOLDER, layers: Iterable[str] = LAYERS) -> tuple[Locked, ...]:
    """All packages of some of the files, in their order. Raises what `read_layer` does."""
    return tuple(package for layer in layers for package in read_layer(layer, folder))


@dataclass(frozen=True)
class Differences:
    """What this environment has other than the lock files.

    Attributes
    ----------
    equal : int
        Number of packages that are those of the lock.
    missing : tuple[str, ...]
        name==version of what the twin needs and is not there.
    other : tuple[str, ...]
        "name version, locked version".
    unknown : tuple[str, ...]
        Names that no file has, and that nobody checked therefore.
    """

    equal: int
    missing: tuple[str, ...]
    other: tuple[str, ...]
    unknown: tuple[str, ...]


def differences(own: str, folder: Path = FOLDER) -> Differences:
    """Compare what is installed here with the lock. What only --live and --test install may be missing.

    Parameters
    ----------
    own : str
        Name of the project, which is in no lock.
    folder : Path
        Of the lock files.

    Raises
    ------
    LockError, OSError
        As `read_layer`.
    """
    installed = {normal(d.name): d.version for d in importlib.metadata.distributions() if d.name}
    names, equal, missing, other = {own}, set(), [], []
    for package in read_lock(folder, LAYERS[:-1]):
        if not package.here:
            continue
        names.add(package.name)
        found = installed.get(package.name)
        if found == package.version:
            equal.add(package.name)
        elif found is not None:
            other.append(f"{package.name} {found}, locked {package.version}")
        elif package.layer == "runtime":
            missing.append(f"{package.name}=={package.version}")
    return Differences(len(equal), tuple(missing), tuple(other), tuple(sorted(set(installed) - names)))
