"""Known vulnerabilities of the locked packages, by pip-audit."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from docs.supply.make_lock import SupplyError
from twin.framework.lock_file import FOLDER

SERVICES = ("pypi", "osv")


@dataclass(frozen=True)
class Finding:
    """A known vulnerability of a package: its number, and the versions that are without."""

    package: str
    version: str
    number: str
    mended_in: tuple[str, ...]


def audit(layers: Iterable[str], service: str, folder: Path = FOLDER) -> tuple[int, tuple[Finding, ...]]:
    """Ask a service about every package of some lock files that this Python and platform use.

    Args:
        layers: files of the lock.
        service: one of `SERVICES`.
        folder: of the lock.

    Returns:
        How many packages were checked, and what is known of them.

    Raises:
        SupplyError: it cannot be told of all of them. pip-audit itself takes a package that its service does not know
            for a good one.
    """
    lists = [word for layer in layers for word in ("-r", str(folder / f"{layer}.txt"))]
    with tempfile.TemporaryDirectory(prefix="audit-") as place:
        out = Path(place, "answer.json")
        # everything is pinned: nothing is to be resolved or installed
        options = ["--disable-pip", "--no-deps", "--require-hashes", "--progress-spinner", "off"]
        words = ["-s", service, "-f", "json", "-o", str(out), *options, *lists]
        command = [sys.executable, "-m", "pip_audit", *words]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if not out.exists():
            said = done.stderr.strip().splitlines()[-1:] or [f"exit code {done.returncode}"]
            raise SupplyError(f"pip-audit got no answer: {said[0]}")
        return findings(out.read_text("utf-8"))


def findings(answer: str) -> tuple[int, tuple[Finding, ...]]:
    """What pip-audit's JSON says. Raises SupplyError when it does not say it of all packages."""
    packages = json.loads(answer)["dependencies"]
    skipped = [p["name"] for p in packages if "skip_reason" in p]
    if skipped or not packages:
        which = ", ".join(skipped[:5]) + (", ..." if len(skipped) > 5 else "")
        raise SupplyError(f"the service has no answer for {len(skipped)} of {len(packages)} packages: {which}")
    found = (
        Finding(p["name"], p["version"], v["id"], tuple(v["fix_versions"]))
        for p in packages
        for v in p.get("vulns", ())
    )
    return len(packages), tuple(found)
