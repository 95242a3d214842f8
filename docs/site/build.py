"""Gathers the pages of the documentation, written ones and those that are made, and lets Sphinx build the site."""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from docs.site.link_check import faults
from docs.site.policy import with_policy

ROOT = Path(__file__).resolve().parents[2]
HERE = Path(__file__).resolve().parent
NOTEBOOKS = ("start", "my_camera", "heat", "targets_mtf", "orbit_calibration", "trade_study")
GUIDES = (
    *("live", "monitor", "monitor_layout", "monitor_design", "disturbances", "finite_elements", "stray_light"),
    *("measured_frames", "coming_from", "camera", "prescriptions", "laboratory", "measured_laboratory"),
    *("orbit", "block", "measured_orbit", "orbit_files", "operation", "studies", "export", "limits"),
)
MEANING = ("conventions", "glossary")
PROGRAM = ("promises", "stability", "architecture", "by_hand", "installed")
"""Pages of docs by the part of the site in which they stand, in order; other notebooks and pages follow these."""
NEEDED = ("sphinx", "myst_nb", "furo", "sphinx_copybutton")
_LINK = re.compile(r"\]\((?!https?://|#|mailto:)([^)#\s]+)")


class BuildError(Exception):
    """The site cannot be built, or is not as it should be; the message says all that is wrong."""


def build(out: Path, notebooks: bool = True) -> int:
    """Build the site.

    Args:
        out: folder for the pages; what a former build left there is replaced.
        notebooks: whether to run the notebooks; otherwise they are shown as they are.

    Returns:
        Number of pages.

    Raises:
        BuildError: a package is missing, Sphinx warns, a link leads nowhere, or a page needs the network.
    """
    missing = [name for name in NEEDED if importlib.util.find_spec(name) is None]
    if missing:
        raise BuildError(f"not installed: {', '.join(missing)}; install the extra `docs`: pip install -e .[docs]")
    if out.exists() and any(out.iterdir()) and not (out / "objects.inv").exists():
        raise BuildError(f"{out} holds something else than a site; choose another folder")
    with tempfile.TemporaryDirectory(prefix="docs-") as place:
        source, made = Path(place) / "source", Path(place) / "site"
        try:
            stage(source)
        except (LookupError, TypeError, ValueError) as error:
            raise BuildError(f"the reference cannot be made: {error}") from error
        _sphinx(source, made, Path(place) / "state", notebooks)
        pages = sorted(made.rglob("*.html"))
        for page in pages:
            page.write_text(with_policy(page.read_text("utf-8")), "utf-8")
        wrong = faults(made)
        if wrong:
            raise BuildError("\n".join(wrong))
        if out.exists():
            shutil.rmtree(out)
        out.parent.mkdir(parents=True, exist_ok=True)
        shutil.move(made, out)
    return len(pages)


def stage(source: Path) -> None:
    """Put everything that the site is made of into one folder: pages at the places that they have in the project, so
    that their links hold, and the pages of the reference.
    """
    source.mkdir(parents=True)
    pages = [ROOT / "README.md", *written_pages(), *sorted((ROOT / "docs/notebooks").glob("*.ipynb"))]
    for page in pages:
        _copy(page, source)
    for page in pages:
        if page.suffix == ".md":
            text = page.read_text("utf-8")
            for linked in _LINK.findall(text):
                target = (page.parent / linked).resolve()
                if target.is_file() and target.is_relative_to(ROOT):
                    _copy(target, source)
                elif target == ROOT / "docs/notebooks":
                    # a forge shows what is in a folder; a site shows pages
                    text = text.replace(f"]({linked})", f"]({linked.rstrip('/')}/{NOTEBOOKS[0]}.ipynb)")
            (source / page.relative_to(ROOT)).write_text(text, "utf-8")
    for notebook_data in (ROOT / "docs/notebooks").glob("*.yaml"):
        _copy(notebook_data, source)
    for name, text in made_pages().items():
        place = source / name
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_text(text, "utf-8")
    shutil.copy(HERE / "conf.py", source)
    shutil.copytree(HERE / "static", source / "_static")


def written_pages() -> list[Path]:
    """The Markdown pages in docs."""
    return [page for page in sorted((ROOT / "docs").rglob("*.md")) if HERE not in page.parents]


def made_pages() -> dict[str, str]:
    """Path of every page that is made -> Markdown."""
    # what the pages are made from takes seconds to import
    from docs.site.api_page import api_page
    from docs.site.command_pages import command_page
    from docs.site.file_pages import file_pages
    from docs.site.node_pages import node_page
    from docs.site.run_pages import run_pages

    return {
        "index.md": index_page(),
        "reference/commands.md": command_page(),
        **file_pages(),
        "reference/nodes.md": node_page(),
        **run_pages(),
        "reference/api.md": api_page(),
    }


def index_page() -> str:
    """The first page, with the contents of the site."""
    there = sorted(path.stem for path in (ROOT / "docs/notebooks").glob("*.ipynb"))
    rank = {name: k for k, name in enumerate(NOTEBOOKS)}
    notebooks = [f"docs/notebooks/{name}" for name in sorted(there, key=lambda name: rank.get(name, len(rank)))]
    placed = {*GUIDES, *MEANING, *PROGRAM}
    others = [page.stem for page in written_pages() if page.parent == ROOT / "docs" and page.stem not in placed]
    parts = {
        "Start": ["Overview <README>"],
        "Notebooks": notebooks,
        "Guides": [f"docs/{name}" for name in (*GUIDES, *others)],
        "Reference": [
            "reference/commands",
            "reference/files/index",
            "reference/nodes",
            "reference/run_folders/index",
            "reference/api",
            *(f"docs/{name}" for name in MEANING),
        ],
        "Papers": ["docs/validation/README"],
        "The program": [f"docs/{name}" for name in PROGRAM],
    }
    trees = [
        "\n".join(["```{toctree}", f":caption: {caption}", ":maxdepth: 1", "", *pages, "```"])
        for caption, pages in parts.items()
        if pages
    ]
    return f"""# Space camera twin

This digital twin simulates space mapping cameras, the autocollimation monitor that watches them in orbit, the
laboratory that calibrates them and the passes over test fields that check them.

- **New here**: the [overview](README.md) has two commands, a first job and the main results.
- **Guides** explain one task each. The notebooks show the same tasks in Python.
- **Reference** lists every command, every key of every file, every node and every file of a run folder.

{chr(10).join(trees)}
"""


def _copy(path: Path, source: Path) -> None:
    place = source / path.resolve().relative_to(ROOT)
    place.parent.mkdir(parents=True, exist_ok=True)
    if not place.exists():
        shutil.copy(path, place)


def _sphinx(source: Path, made: Path, state: Path, notebooks: bool) -> None:
    """Build the pages with warnings as errors, in a process of its own that imports this checkout."""
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]),
        "DOCS_NOTEBOOKS": "force" if notebooks else "off",
        "JUPYTER_PLATFORM_DIRS": "1",
    }
    words = [sys.executable, "-m", "sphinx", "-b", "html", "-q", "-W", "--keep-going", "-d", str(state)]
    done = subprocess.run(
        [*words, str(source), str(made)], env=environment, capture_output=True, text=True, check=False, cwd=ROOT
    )
    if done.returncode:
        raise BuildError(done.stderr.replace(f"{source}/", "").strip() or "Sphinx failed")
    (made / ".buildinfo").unlink(missing_ok=True)
    shutil.rmtree(made / "_sources", ignore_errors=True)
