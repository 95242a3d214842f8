"""Lock files: uv finds compatible versions for every Python and platform, with checksums."""

from __future__ import annotations

import shutil
import subprocess
import sysconfig
import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path

from docs.supply.lock_file import FOLDER, Locked, normal, parse, read_layer

ROOT = Path(__file__).resolve().parents[2]
EXTRAS: Mapping[str, tuple[str, ...] | None] = {"runtime": (), "live": ("live",), "test": None}
"""Layer -> extras of pyproject.toml that it adds to those before it; None for all."""
OLDEST, PYTHONS = "3.11", ("3.11", "3.12", "3.13")
PLATFORM = "x86_64-manylinux_2_28"
"""Platform of the wheels; Debian 12 has a newer C library."""
HEADS = {
    "install": "What everything else is installed with.",
    "runtime": "What the twin needs.",
    "live": "What serves the live twin, beside runtime.txt.",
    "test": "What `setup.sh --test` installs beside runtime.txt and live.txt.",
    "peers": "What `setup.sh --test` installs into .venv/peers.",
}
HEAD = """# {what} Made by `python -m docs.supply lock` from {source}; not to be edited.
# SHA-256 of every file that the package index has of these versions: pip refuses any other.
"""


class SupplyError(Exception):
    """Error of a command of this package; the message gives the reason."""


def make_lock(folder: Path = FOLDER, upgrade: bool = False) -> dict[str, tuple[Locked, ...]]:
    """Write all files again, keeping locked versions where pyproject.toml allows it.

    Parameters
    ----------
    folder : Path
        Folder with install.in and peers.in.
    upgrade : bool
        Use the newest versions of whatever pyproject.toml does not pin.

    Returns
    -------
    dict[str, tuple[Locked, ...]]
        The packages of every layer.

    Raises
    ------
    SupplyError
        No versions are compatible, a package has no wheel, or the index cannot be reached.
    """
    project = ROOT / "pyproject.toml"
    former = [folder / f"{layer}.txt" for layer in EXTRAS]
    preferred = "" if upgrade else "".join(file.read_text("utf-8") for file in former if file.exists())
    texts = {
        "install": compiled(folder / "install.in", "", "--no-build"),
        "peers": compiled(folder / "peers.in", "", "--no-build", "--no-deps"),
    }
    all_blocks = blocks(compiled(project, preferred, "--all-extras"), "test")
    pinned = "".join(all_blocks.values())
    written = set(blocks(texts["install"], "install"))
    for layer, extras in EXTRAS.items():
        chosen = ["--all-extras"] if extras is None else [word for name in extras for word in ("--extra", name)]
        layer_blocks = all_blocks if extras is None else blocks(compiled(project, pinned, *chosen), layer)
        # what more Pythons need for the tests than for the rest stands in both files, each with its marker
        texts[layer] = "".join(all_blocks.get(key, text) for key, text in layer_blocks.items() if key not in written)
        written |= set(layer_blocks)
    with tempfile.TemporaryDirectory(prefix="lock-") as place:
        made = Path(place)
        for layer, text in texts.items():
            source = "pyproject.toml" if layer in EXTRAS else f"{layer}.in"
            (made / f"{layer}.txt").write_text(HEAD.format(what=HEADS[layer], source=source) + text, "utf-8")
        _check_wheels(made, texts)
        for layer in texts:
            shutil.copyfile(made / f"{layer}.txt", folder / f"{layer}.txt")
    return {layer: read_layer(layer, folder) for layer in texts}


def blocks(text: str, layer: str) -> dict[tuple[str, str, str], str]:
    """Return (name, version, marker) of each package in a lock file -> its lines.

    pip, which some package requires, is always in install.txt.
    """
    packages = parse(text, layer, layer)
    parts, lines = [], text.splitlines(keepends=True)
    for line in lines:
        if not line[:1].isspace() and line.strip() and not line.startswith("#"):
            parts.append("")
        if parts:
            parts[-1] += line
    own = {normal(p) for p in ("pip", "setuptools")} if layer != "install" else set()
    return {(p.name, p.version, p.marker): part for p, part in zip(packages, parts, strict=True) if p.name not in own}


def compiled(source: Path, preferred: str, *options: str) -> str:
    """Return uv's resolution of a list of requirements, as lines for pip.

    Parameters
    ----------
    source : Path
        pyproject.toml or a list.
    preferred : str
        Lines of a previous lock, whose versions are kept where possible.
    options : str
        Further options of uv.
    """
    with tempfile.TemporaryDirectory(prefix="lock-") as place:
        out = Path(place, "lock.txt")
        if preferred:
            out.write_text(preferred, "utf-8")
        words = ["pip", "compile", "--universal", "--generate-hashes", "--python-version", OLDEST, "--no-header"]
        run_uv([*words, "--annotation-style", "line", "--quiet", *options, str(source), "--output-file", str(out)])
        return out.read_text("utf-8")


def _check_wheels(folder: Path, layers: Iterable[str]) -> None:
    """Raise SupplyError unless every package has a wheel with a known hash on the Pythons that setup.sh serves.

    Nothing is installed.
    """
    files = [word for layer in layers if layer != "peers" for word in ("-r", str(folder / f"{layer}.txt"))]
    for chosen in (files, ["-r", str(folder / "peers.txt")]):
        for python in PYTHONS:
            words = ["--dry-run", "--quiet", "--no-deps", "--require-hashes", "--only-binary", ":all:"]
            where = ["--python-version", python, "--python-platform", PLATFORM, "--target", str(folder / "none")]
            run_uv(["pip", "install", *words, *where, *chosen])


def run_uv(words: list[str]) -> str:
    """Run uv in the project's folder. Raises SupplyError with its message."""
    beside = Path(sysconfig.get_path("scripts"), "uv")
    program = str(beside) if beside.exists() else shutil.which("uv")
    if program is None:
        raise SupplyError("uv is not installed: bash setup.sh --test")
    done = subprocess.run([program, *words], cwd=ROOT, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise SupplyError(done.stderr.strip() or f"uv ended with exit code {done.returncode}")
    return done.stdout
