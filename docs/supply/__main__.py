"""What is installed, and under which terms: `python -m docs.supply lock|sbom|licences|audit`."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, NoReturn

import typer

from docs.supply.make_lock import SupplyError, make_lock
from twin.framework.lock_file import LAYERS, LockError

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
def _told() -> Iterator[None]:
    """Failures as one line and exit code 2."""
    try:
        yield
    except ModuleNotFoundError as error:
        _refuse(f"{error.name} is not installed: bash setup.sh --test")
    except (SupplyError, LockError, OSError) as error:
        _refuse(error)


def _layers(names: str) -> list[str]:
    chosen = [name.strip() for name in names.split(",")]
    unknown = [name for name in chosen if name not in LAYERS]
    if unknown:
        _refuse(f"no such file of the lock: {', '.join(unknown)}; there are {', '.join(LAYERS)}")
    return chosen


def _refuse(text: object) -> NoReturn:
    sys.stderr.write(f"error: {text}\n")
    raise typer.Exit(2)


@app.command()
def lock(
    upgrade: Annotated[bool, typer.Option("--upgrade", help="Newest versions of what is not pinned there.")] = False,
) -> None:
    """Write docs/supply/lock/*.txt anew from pyproject.toml, install.in and peers.in. Versions stay where they can.
    Afterwards run licences.

    Example: python -m docs.supply lock
    """
    with _told():
        for layer, packages in make_lock(upgrade=upgrade).items():
            sys.stdout.write(f"{layer}.txt: {len(packages)} packages\n")


@app.command()
def sbom(
    out: Annotated[Path, typer.Option(help="File to write.")] = Path("sbom.cdx.json"), layers: Layer = ALL
) -> None:
    """Write a software bill of materials (CycloneDX 1.6, JSON) of all locked packages, checked against its schema.

    Example: python -m docs.supply sbom --out sbom.cdx.json --for install,runtime
    """
    with _told():
        from docs.supply.sbom import bill

        out.write_text(bill(_layers(layers)), "utf-8")
    sys.stdout.write(f"{out}\n")


@app.command()
def licences() -> None:
    """Bring docs/supply/licences.csv up to the lock, and count. Only packages that it lacks are fetched, and read.

    Example: python -m docs.supply licences
    """
    with _told():
        from docs.supply.licences import read_carried, update

        rows = update()
        for licence, number in Counter(row.licence for row in rows).most_common():
            sys.stdout.write(f"{number:4d}  {licence}\n")
        for row in rows:
            if row.copyleft != "no":
                sys.stdout.write(f"{row.copyleft} copyleft: {row.package} ({row.licence}), for {row.for_}\n")
        for inner in read_carried():
            if inner.copyleft != "no":
                sys.stdout.write(
                    f"{inner.copyleft} copyleft: {inner.library} ({inner.licence}) within {inner.package}\n"
                )
        sys.stdout.write(f"{len(rows)} packages: docs/supply/licences.csv\n")


@app.command()
def audit(
    layers: Layer = ALL, service: Annotated[str, typer.Option(help="Who is asked: pypi or osv.")] = "pypi"
) -> None:
    """Ask for known vulnerabilities of the locked packages, those of this Python and platform. Needs the network. Exit
    code 0: none is known; 1: some are, and listed; 2: not all packages could be checked.

    Example: python -m docs.supply audit --for install,runtime
    """
    from docs.supply.audit import SERVICES
    from docs.supply.audit import audit as ask

    if service not in SERVICES:
        _refuse(f"no such service: {service}; there are {', '.join(SERVICES)}")
    with _told():
        number, found = ask(_layers(layers), service)
    for one in found:
        mended = f"; mended in {', '.join(one.mended_in)}" if one.mended_in else "; not mended"
        sys.stdout.write(f"{one.package} {one.version}: {one.number}{mended}\n")
    sys.stdout.write(f"{number} packages checked, {len(found)} known vulnerabilities\n")
    raise typer.Exit(1 if found else 0)


if __name__ == "__main__":
    app()
