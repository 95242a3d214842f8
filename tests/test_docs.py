"""The pages in docs/ keep up with the code: every module is named, every link leads somewhere."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def test_architecture_names_every_module() -> None:
    named = set(re.findall(r"`([a-z_0-9]+)`", (ROOT / "docs/architecture.md").read_text("utf-8")))
    modules = {
        path.stem
        for package in ("optics", "scenes", "twin", "analysis")
        for path in (ROOT / package).iterdir()
        if (path.suffix == ".py" and path.stem != "__init__") or (path / "__init__.py").is_file()
    }
    assert len(modules) > 50
    assert modules - named == set()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    links = re.findall(r"\]\(([^)#]+)", page.read_text("utf-8"))
    assert links
    for link in links:
        assert link.startswith("https://") or (page.parent / link).exists(), link
