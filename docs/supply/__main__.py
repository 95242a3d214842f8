"""Locked packages and their licences: `python -m docs.supply lock|sbom|licences|audit`."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Literal, NoReturn

import typer

from docs.supply.lock_file import FOLDER, LAYERS, LockError
from docs.supply.make_lock import SupplyError, make_lock

app = typer.Typer(
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    no_args_is_help=True,
    help="""Lock files, bill of materials, licences and known vulnerabilities of all packages that setup.sh installs.

    Needs what bash setup.sh --test installs. Exit code: 0 done, 1 a known vulnerability (audit), 2 not done.
    """,
)
ALL = ",".join(LAYERS)
Layer = Annotated[
    str,
    typer.Option("--for", help=f"Files of the lock, with commas between them: {', '.join(LAYERS)}; all if not given."),
]


@contextmanager
def _exit_on_failure() -> Iterator[None]:
    """Print failures as one line and exit with code 2."""
    try:
        yield
    except ModuleNotFoundError as error:
        _refuse(f"{error.name} is not installed: bash setup.sh --test")
    except (SupplyError, LockError, OSError) as error:
        _refuse(error)


def _layers(names: str) -> list[str]:
    """Return the layers of the lock that an option names."""
    chosen = [name.strip() for name in names.split(",")]
    unknown = [name for name in chosen if name not in LAYERS]
    if unknown:
        _refuse(f"no such file of the lock: {', '.join(unknown)}; there are {', '.join(LAYERS)}")
    return chosen


def _refuse(text: object) -> NoReturn:
    """Print an error and exit."""
    sys.stderr.write(f"error: {text}\n")
    raise typer.Exit(2)


@app.command()
def lock(
    upgrade: Annotated[bool, typer.Option("--upgrade", help="Newest versions of what is not pinned there.")] = False,
) -> None:
    """Write docs/supply/lock/*.txt again from pyproject.toml, install.in and peers.in, keeping versions where possible.

    Run licences afterwards.

    Example: python -m docs.supply lock
    """
    with _exit_on_failure():
        for layer, packages in make_lock(upgrade=upgrade).items():
            sys.stdout.write(f"{layer}.txt: {len(packages)} packages\n")


@app.command()
def sbom(
    out: Annotated[Path, typer.Option(help="File to write.")] = Path("sbom.cdx.json"), layers: Layer = ALL
) -> None:
    """Write a software bill of materials (CycloneDX 1.6, JSON) of all locked packages, checked against its schema.

    Example: python -m docs.supply sbom --out sbom.cdx.json --for install,runtime
    """
    with _exit_on_failure():
        from docs.supply.sbom import bill

        out.write_text(bill(_layers(layers)), "utf-8")
    sys.stdout.write(f"{out}\n")


@app.command()
def licences() -> None:
    """Update docs/supply/licences.csv to the lock, and print counts; only missing packages are fetched and read.

    Example: python -m docs.supply licences
    """
    with _exit_on_failure():
        from docs.supply.licences import read_carried, update

        rows = update()
        for licence, number in Counter(row.licence for row in rows).most_common():
            sys.stdout.write(f"{number:4d}  {licence}\n")
        asking = [(row, f"{row.package} ({row.licence}), for {row.for_}") for row in rows]
        asking += [(inner, f"{inner.library} ({inner.licence}) within {inner.package}") for inner in read_carried()]
        for licensed, text in asking:
            if licensed.copyleft != "no":
                sys.stdout.write(f"{licensed.copyleft} copyleft: {text}\n")
        sys.stdout.write(f"{len(rows)} packages: docs/supply/licences.csv\n")


@app.command()
def audit(
    layers: Layer = ALL, service: Annotated[Literal["pypi", "osv"], typer.Option(help="Who is asked.")] = "pypi"
) -> None:
    """Look up known vulnerabilities of the locked packages for this Python and platform. Needs the network.

    Exit code 0: none is known; 1: some are, and listed; 2: not all packages could be checked.

    Example: python -m docs.supply audit --for install,runtime
    """
    lists = [word for layer in _layers(layers) for word in ("-r", str(FOLDER / f"{layer}.txt"))]
    # everything is pinned: nothing is to be resolved or installed
    options = ["--disable-pip", "--no-deps", "--require-hashes", "--progress-spinner", "off"]
    with _exit_on_failure(), tempfile.TemporaryDirectory(prefix="audit-") as place:
        out = Path(place, "answer.json")
        command = [sys.executable, "-m", "pip_audit", "-s", service, "-f", "json", "-o", str(out), *options, *lists]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if not out.exists():
            last_line = done.stderr.strip().splitlines()[-1:] or [f"exit code {done.returncode}"]
            raise SupplyError(f"pip-audit failed: {last_line[0]}")
        number, vulnerabilities = findings(out.read_text("utf-8"))
    sys.stdout.write("".join(f"{line}\n" for line in vulnerabilities))
    sys.stdout.write(f"{number} packages checked, {len(vulnerabilities)} known vulnerabilities\n")
    raise typer.Exit(1 if vulnerabilities else 0)


def findings(answer: str) -> tuple[int, list[str]]:
    """Return the number of packages in pip-audit's JSON, and a line for each known vulnerability.

    Raises
    ------
    SupplyError
        The JSON lacks some of the packages; pip-audit itself treats a package unknown to its service as free of faults.
    """
    packages = json.loads(answer)["dependencies"]
    skipped = [p["name"] for p in packages if "skip_reason" in p]
    if skipped or not packages:
        which = ", ".join(skipped[:5]) + (", ..." if len(skipped) > 5 else "")
        raise SupplyError(f"the service has no answer for {len(skipped)} of {len(packages)} packages: {which}")
    return len(packages), [
        f"{p['name']} {p['version']}: {v['id']}; mended in {', '.join(v['fix_versions']) or 'no version'}"
        for p in packages
        for v in p.get("vulns", ())
    ]


if __name__ == "__main__":
    app()
