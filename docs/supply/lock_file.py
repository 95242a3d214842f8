"""Reader of the lock files in docs/supply/lock, which list the packages that setup.sh installs."""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

FOLDER = Path(__file__).resolve().parent / "lock"
"""Folder of the lock files."""
LAYERS = ("install", "runtime", "live", "test", "peers")
"""Names of the lock files, in the order of installation. Each has only the packages that it adds; the peers are
installed in a folder of their own.
"""
_PIN = re.compile(r"([A-Za-z0-9._-]+)==([^\s;\\]+)\s*(?:;\s*(.*?))?\s*\\?$")
_HASH = re.compile(r"--hash=sha256:([0-9a-f]{64})\s*\\?$")


class LockError(Exception):
    """Malformed lock file; the message gives the line."""


@dataclass(frozen=True)
class Locked:
    """Package with its version and checksums as a lock file lists it.

    Attributes
    ----------
    name : str
        Name as in the package index, in lower case with hyphens.
    version : str
        Version that is installed.
    marker : str
        Environment marker (Python version, platform) in pip's syntax; empty for all.
    hashes : tuple of str
        Hexadecimal SHA-256 of the accepted files.
    asked_by : tuple of str
        Names of the packages that need it; the project's own name stands for pyproject.toml; empty if a separate list
        names it.
    layer : str
        Lock file, one of `LAYERS`.
    """

    name: str
    version: str
    marker: str
    hashes: tuple[str, ...]
    asked_by: tuple[str, ...]
    layer: str


def normal(name: str) -> str:
    """Return a package name in the spelling of the lock files."""
    return re.sub(r"[-_.]+", "-", name).lower()


def read_layer(layer: str, folder: Path = FOLDER) -> tuple[Locked, ...]:
    """Read the packages of one lock file.

    Parameters
    ----------
    layer : str
        One of `LAYERS`.
    folder : Path
        Folder of the lock files.

    Raises
    ------
    LockError
        A line is not a pin, a hash or a comment, or a pin has no hash.
    OSError
        The file does not exist.
    """
    file = folder / f"{layer}.txt"
    return parse(file.read_text("utf-8"), layer, str(file))


def parse(text: str, layer: str, file: str) -> tuple[Locked, ...]:
    """Parse the text of a lock file into its packages; ``file`` appears in messages."""
    packages: list[Locked] = []
    pin: re.Match[str] | None = None
    hashes: list[str] = []
    dependants: list[str] = []

    def close(number: int) -> None:
        if pin is not None:
            if not hashes:
                raise LockError(f"{file}:{number}: {pin[1]} has no hash")
            packages.append(Locked(normal(pin[1]), pin[2], pin[3] or "", tuple(hashes), tuple(dependants), layer))

    lines = text.splitlines()
    for number, line in enumerate(lines, 1):
        bare = line.strip()
        if not line[:1].isspace() and bare and not bare.startswith("#"):
            close(number - 1)
            pin, hashes, dependants = _PIN.match(bare), [], []
            if pin is None:
                raise LockError(f"{file}:{number}: not a pinned package: {bare}")
        elif bare.startswith("# via "):
            words = bare.removeprefix("# via ").split(", ")
            dependants += [normal(word.split(" (")[0]) for word in words if not word.startswith("-r ")]
        elif bare and not bare.startswith("#"):
            digest = _HASH.match(bare)
            if digest is None:
                raise LockError(f"{file}:{number}: not a hash: {bare}")
            hashes.append(digest[1])
    close(len(lines))
    return tuple(packages)


def read_lock(folder: Path = FOLDER, layers: Iterable[str] = LAYERS) -> tuple[Locked, ...]:
    """Read the packages of several lock files, in their order. Raises the errors of `read_layer`."""
    return tuple(package for layer in layers for package in read_layer(layer, folder))
