"""Write the tables of docs/renamed.md, the note to users on names that are others now: `python -m docs.renamed`.

They are those of `scenes.specs.result_names` and of the specifications' ``old_keys``; a test holds the page to them.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import typer

from scenes.kinds.file_kinds import FILE_KINDS
from scenes.specs.result_names import RENAMED
from scenes.yaml.spec import Spec

PAGE = Path(__file__).parent / "renamed.md"
START = "<!-- python -m docs.renamed -->\n"


def specs_with_old_keys(of: type[Spec] = Spec) -> Iterator[type[Spec]]:
    """Every specification of the program that reads old keys."""
    for one in of.__subclasses__():
        if one.old_keys and one.__module__.startswith("scenes."):
            yield one
        yield from specs_with_old_keys(one)


def tables() -> str:
    """Both tables, keys of files first."""
    for kind in FILE_KINDS:
        assert issubclass(kind.model, Spec)  # which imports it
    keys = sorted({(one.__doc__ or "").partition("\n")[0].rstrip("."): one for one in specs_with_old_keys()}.items())
    lines = ["| in a file, of | old key | key |", "|---|---|---|"]
    lines += [f"| {what} | `{old}` | `{new}` |" for what, one in keys for old, new in one.old_keys.items()]
    lines += ["", "| in results, file | old name | name | since |", "|---|---|---|---|"]
    for one in RENAMED:
        files = ", ".join(f"`{file}`" for file in one.files) or "all"
        lines.append(f"| {files} | `{one.old}` | `{one.new}` | {one.since} |")
    return "\n".join(lines) + "\n"


def page() -> str:
    """The page with its tables as they have to be."""
    head, mark, _ = PAGE.read_text("utf-8").partition(START)
    return head + mark + tables()


def main() -> None:
    """Write the tables of docs/renamed.md, the note to users on names that are others now."""
    PAGE.write_text(page(), "utf-8")


if __name__ == "__main__":
    typer.run(main)
