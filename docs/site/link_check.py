"""Does every link of the built site lead somewhere, and does no page need the network?"""

from __future__ import annotations

from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

LOADED = {"img": "src", "script": "src", "source": "src", "iframe": "src", "video": "src", "object": "data"}
"""Tags that make a browser fetch something, and the attribute that says what; of `link` only style sheets and icons."""
FETCHED_LINKS = ("stylesheet", "icon", "preload", "shortcut icon")


@dataclass
class _Page(HTMLParser):
    """What a page links to, what it loads, and which places it has."""

    links: list[str] = field(default_factory=list)
    loads: list[str] = field(default_factory=list)
    places: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        super().__init__()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Keep what matters of a tag."""
        given = {name: value or "" for name, value in attrs}
        self.places |= {given[name] for name in ("id", "name") if given.get(name)}
        if tag == "a" and given.get("href"):
            self.links.append(given["href"])
        if tag in LOADED and given.get(LOADED[tag]):
            self.loads.append(given[LOADED[tag]])
        if tag == "link" and given.get("rel", "").lower() in FETCHED_LINKS:
            self.loads.append(given.get("href", ""))


def read_page(text: str) -> _Page:
    """Links, loaded things and places of a page."""
    page = _Page()
    page.feed(text)
    return page


def faults(site: Path) -> list[str]:
    """What is wrong with the links of a built site, a line each; empty for nothing.

    Looked at are all pages: a link or a loaded file must exist in the site, the place that a link names must be in its
    page, nothing may be loaded from elsewhere, style sheets included, and every page can be reached from index.html.
    """
    pages = {path: read_page(path.read_text("utf-8")) for path in sorted(site.rglob("*.html"))}
    out: list[str] = []
    reached: dict[Path, set[Path]] = {}
    for path, page in pages.items():
        name = path.relative_to(site).as_posix()
        reached[path] = set()
        for link in page.links:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            if target.is_dir():
                target /= "index.html"
            if not target.exists():
                out.append(f"{name}: {link} leads nowhere")
            elif parts.fragment and target in pages and unquote(parts.fragment) not in pages[target].places:
                out.append(f"{name}: {link} names no place in {target.relative_to(site).as_posix()}")
            reached[path].add(target)
        for load in page.loads:
            parts = urlsplit(load)
            if parts.scheme == "data":
                continue
            if parts.scheme or parts.netloc:
                out.append(f"{name}: loads {load} from the network")
            elif not (path.parent / unquote(parts.path)).exists():
                out.append(f"{name}: loads {load}, which is not there")
    for sheet in sorted(site.rglob("*.css")):
        text = sheet.read_text("utf-8", errors="replace")
        if "@import url(http" in text or "url(http" in text or 'url("http' in text or "url(//" in text:
            out.append(f"{sheet.relative_to(site).as_posix()}: loads something from the network")
    return out + _unreached(site, pages, reached)


def _unreached(site: Path, pages: dict[Path, _Page], reached: dict[Path, set[Path]]) -> list[str]:
    todo, seen = [site / "index.html"], {site / "index.html"}
    while todo:
        for target in reached.get(todo.pop(), set()) & pages.keys() - seen:
            seen.add(target)
            todo.append(target)
    # the generator's own pages for searching hang on the search field
    own = {site / "search.html", site / "genindex.html", site / "py-modindex.html"}
    return [f"{page.relative_to(site).as_posix()} cannot be reached" for page in pages if page not in seen | own]
