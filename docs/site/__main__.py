"""Command that builds the documentation: `python -m docs.site --out DIR`.

The pages in docs, the notebooks and the reference, which is generated from the program, are gathered in a folder at the
same relative paths as in the project, so that their links hold; Sphinx builds the site from them.
"""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from twin.framework.page import NOTHING, checksum, policy

ROOT = Path(__file__).resolve().parents[2]
HERE = Path(__file__).resolve().parent
NEEDED = ("sphinx", "myst_nb", "furo", "sphinx_copybutton")
OWN = "'self' file:"
"""Sources of the site's own files, on a server or in a folder; not every browser treats a folder as one origin."""
_INLINE = re.compile(r"<(script|style)\b([^>]*)>(.*?)</\1>", re.S | re.I)
_HEAD = re.compile(r"<head[^>]*>\s*(<meta charset=[^>]*>)?", re.I)
_EVENT = re.compile(r"<[a-z][^<>]*\s(on[a-z]+)\s*=", re.I)
_REMOTE = re.compile(r"<(?!a\s)[a-z][^<>]*\s(?:src|data|href)\s*=\s*[\"']?((?:https?:)?//[^\"'\s>]+)", re.I)
app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)


class BuildError(Exception):
    """Error of a site that cannot be built or has faults; the message lists all of them."""


@app.command()
def main(
    out: Annotated[Path, typer.Option(help="Folder for the site; a former site there is replaced.")] = Path(
        "build/site"
    ),
    notebooks: Annotated[bool, typer.Option(help="Whether to run the notebooks (minutes).")] = True,
    keys: Annotated[
        Path | None, typer.Option(help="Write only the page with every key of every file: docs/keys.md.")
    ] = None,
) -> None:
    """Build the documentation as web pages that need no network: guides, notebooks, and the generated reference.

    Sphinx's warnings are errors, and every link within the site is checked. Needs what bash setup.sh --test installs.
    """
    if keys is not None:
        from docs.site.file_pages import key_page

        keys.write_text(key_page(), "utf-8")
        return
    try:
        count = build(out, notebooks, Progress())
    except BuildError as error:
        sys.stderr.write(f"{error}\n")
        raise typer.Exit(1) from None
    sys.stdout.write(f"{count} pages: {out / 'index.html'}\n")


class Progress:
    """Lines on stderr that say what is being done: each step, and within a step at most one every few seconds."""

    EVERY_S = 5.0

    def __init__(self) -> None:
        self._last = -self.EVERY_S

    def __call__(self, text: str, step: bool = True) -> None:
        """Print a line; one within a step only if the last one is old enough."""
        if step or time.monotonic() - self._last >= self.EVERY_S:
            self._last = time.monotonic()
            sys.stderr.write(f"progress: {text}\n")
            sys.stderr.flush()


def silent(text: str, step: bool = True) -> None:
    """Print nothing."""


def build(out: Path, notebooks: bool = True, tell: Callable[..., None] = silent) -> int:
    """Build the site.

    Parameters
    ----------
    out : Path
        Folder for the pages; the site of a previous build there is replaced.
    notebooks : bool
        Whether the notebooks are run; otherwise they are shown as they are.
    tell : callable
        Called with each step as text, and within a step with ``step=False``.

    Returns
    -------
    int
        Number of pages.

    Raises
    ------
    BuildError
        A package is missing, the reference cannot be made, Sphinx warns, or a page needs the network.
    """
    if missing := [name for name in NEEDED if importlib.util.find_spec(name) is None]:
        raise BuildError(f"not installed: {', '.join(missing)}; they come with bash setup.sh --test")
    if out.exists() and any(out.iterdir()) and not (out / "objects.inv").exists():
        raise BuildError(f"{out} contains other files than a site; choose another folder")
    with tempfile.TemporaryDirectory(prefix="docs-") as place:
        source, made = Path(place, "source"), Path(place, "site")
        tell("making the reference from the program")
        stage(source)
        tell("building the pages" + (" and running the notebooks, minutes" if notebooks else ""))
        pages = run_sphinx(source, made, "force" if notebooks else "off", tell)
        if out.exists():
            shutil.rmtree(out)
        out.parent.mkdir(parents=True, exist_ok=True)
        shutil.move(made, out)
    return pages


def stage(source: Path) -> None:
    """Copy or generate all sources of the site in a new folder.

    Raises
    ------
    BuildError
        A key has no example, or a file of a run folder no description.
    """
    # Imported here, because these modules take seconds to import.
    from docs.site.command_pages import command_page
    from docs.site.file_pages import file_pages
    from docs.site.run_pages import run_pages

    shutil.copytree(HERE / "pages", source)
    # Copied, because notebooks write into their folder.
    shutil.copytree(ROOT / "docs", source / "docs", ignore=shutil.ignore_patterns("site"))
    shutil.copy(ROOT / "README.md", source)
    for linked in ("optics", "scenes", "tests"):
        (source / linked).symlink_to(ROOT / linked)
    try:
        made = {"reference/commands.md": command_page(), **file_pages(), **run_pages()}
    except (LookupError, TypeError, ValueError) as error:
        raise BuildError(f"the reference cannot be made: {error}") from error
    for name, text in made.items():
        (source / name).parent.mkdir(exist_ok=True)
        (source / name).write_text(text, "utf-8")


def run_sphinx(source: Path, made: Path, notebooks: str, tell: Callable[..., None] = silent) -> int:
    """Build the pages in a process that imports this checkout, and return their number.

    Parameters
    ----------
    source : Path
        Folder with the pages' sources, the first of which is index.
    made : Path
        Folder for the site.
    notebooks : str
        ``nb_execution_mode`` of MyST-NB.
    tell : callable
        Called with what Sphinx is doing and ``step=False``.

    Raises
    ------
    BuildError
        Sphinx warns, for instance of a broken link or of a page to which no other leads, or a page needs the network.
    """
    environment = os.environ | {"JUPYTER_PLATFORM_DIRS": "1", "NO_COLOR": "1"}
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    words = ["-b", "html", "-W", "--keep-going", "-c", HERE, "-D", f"nb_execution_mode={notebooks}"]
    command = [sys.executable, "-m", "sphinx", *words, "-d", source.with_name("state"), source, made]
    with tempfile.TemporaryFile("w+") as errors:
        with subprocess.Popen(
            command, env=environment, stdout=subprocess.PIPE, stderr=errors, text=True, cwd=ROOT
        ) as sphinx:
            assert sphinx.stdout is not None
            for line in filter(None, map(str.strip, sphinx.stdout)):
                tell(line, step=False)
        if sphinx.returncode:
            errors.seek(0)
            raise BuildError(errors.read().replace(f"{source}/", "").strip() or "Sphinx failed")
    pages = sorted(made.rglob("*.html"))
    for page in pages:
        try:
            page.write_text(with_policy(page.read_text("utf-8")), "utf-8")
        except ValueError as error:
            raise BuildError(f"{page.relative_to(made)}: {error}") from None
    (made / ".buildinfo").unlink(missing_ok=True)
    return len(pages)


def with_policy(text: str) -> str:
    """Return a page with a Content-Security-Policy at the beginning of its head.

    It allows the site's own files and what Sphinx writes into the page. Scripts and style sheets in the page are
    allowed by their checksums; all text is the project's own. ``style`` attributes are allowed, since figures and
    highlighted programs have them.

    Raises
    ------
    ValueError
        The page has no head, loads something from the network, or has attributes with programs, which no checksum
        covers.
    """
    head = _HEAD.search(text)
    if head is None:
        raise ValueError("the page has no head")
    for attribute in _EVENT.findall(text):
        raise ValueError(f"the page has an attribute {attribute}, which its policy forbids")
    for address in _REMOTE.findall(text):
        raise ValueError(f"the page loads {address} from the network")
    inline: dict[str, dict[str, None]] = {"script": {}, "style": {}}
    for tag, attributes, inside in _INLINE.findall(text):
        if "src=" not in attributes:
            inline[tag.lower()][checksum(inside)] = None
    allowed = policy(
        {
            **NOTHING,
            "script-src": " ".join([OWN, *inline["script"]]),
            "style-src-elem": " ".join([OWN, *inline["style"]]),
            "style-src-attr": "'unsafe-inline'",
            "img-src": f"{OWN} data:",
            "font-src": f"{OWN} data:",
            # The search reads pages for its excerpts, and its field is a form.
            "connect-src": OWN,
            "form-action": OWN,
        }
    )
    meta = f'<meta http-equiv="Content-Security-Policy" content="{allowed}">'
    return text[: head.end()] + meta + text[head.end() :]


if __name__ == "__main__":
    app()
