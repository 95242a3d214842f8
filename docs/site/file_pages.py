"""Pages of the YAML files and of the nodes of the shipped instruments.

A page lists every key of a kind of file with its meaning, type, default and an example.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import twin
from docs.site.markdown import anchor, code, prose, sentence, slug, table
from docs.site.spec_keys import Key, Spec, Takes, example, flow, keys, sections, shipped, summary
from scenes.schema import MODELS
from scenes.specs.file_kinds import file_kinds
from scenes.specs.load import INSTRUMENTS, SCENES, library_names
from scenes.specs.perturbation import NodeInfo

ACTIONS = ("rotate", "shift", "scale", "figure", "radius", "conic", "index", "abbe", "temperature")
"""Columns of the tables of nodes, as written in a job."""


def file_pages() -> dict[str, str]:
    """Return the pages in Markdown, by their paths in the site's source."""
    pages = {f"reference/files/{kind}.md": _page(kind) for kind in MODELS}
    return {"reference/files/index.md": _index(), **pages, "reference/nodes.md": _node_page()}


def key_page() -> str:
    """Return the page of the repository with every key of every kind of file, in Markdown, without examples."""
    kinds = "\n".join(
        f"- [{title(kind)}](#{slug(title(kind))}): {prose(sentence(summary(model)))}" for kind, model in MODELS.items()
    )
    parts = [
        f"""# Every key of every file

`python -m docs.site --keys docs/keys.md` writes this page from the models that check the files. The site has the same
tables with an example of every key. Every quantity carries its unit, `2 arcsec`; any unit of the same dimension may be
written. A key without a default must be written.

{kinds}
"""
    ]
    described: dict[type[Spec], str] = {}
    for kind, model in MODELS.items():
        parts.append(f"## {title(kind)}\n\nRead {read_by(kind)}.\n")
        for below, paths in sections(model).items():
            if (first := title(described.setdefault(below, kind))) != title(kind):
                parts.append(f"{code(paths[0])} is described under [{first}](#{slug(first)}).\n")
                continue
            head = "" if paths == [""] else f"**{code(paths[0])}**: {prose(sentence(summary(below)))}\n\n"
            rows = (
                [code(key.name), prose(sentence(key.meaning)), _takes(key.takes), _default(key)] for key in keys(below)
            )
            parts.append(head + table(["Key", "Meaning", "Takes", "Default"], rows))
    return "\n".join(parts)


def title(kind: str) -> str:
    """Return the title of a kind of file."""
    return kind.replace("_", " ").capitalize()


def read_by(kind: str) -> str:
    """Return the command that reads a kind of file, and the place of its name in other files."""
    (known,) = (one for one in file_kinds() if one.name == kind)
    command = f"by {code(f'python -m {known.command}')}" if known.command else ""
    return ", or ".join(filter(None, (command, known.place and f"in {known.place}")))


def _index() -> str:
    """Return the index page of the files."""
    rows = (
        [
            f"[{title(kind)}]({kind}.md)",
            prose(sentence(summary(model))),
            read_by(kind),
            ", ".join(code(path.stem) for path in shipped()[kind]),
        ]
        for kind, model in MODELS.items()
    )
    return f"""# Files: every key

Every quantity carries its unit, `2 arcsec`; any unit of the same dimension may be written. Three quantities of one
unit may be written in a row, `0 0 3 um`, where a list of them is required. A file that names another one does so by
its name in the library or by a path relative to itself. An unknown key is an error with its line and the nearest key
that there is.

These pages are made from the models that check the files. The same models give the JSON Schemas with which an editor
completes keys and marks mistakes while typing: `python -m scenes.schema --out schemas`, then as the first line of a
file `# yaml-language-server: $schema=schemas/job.schema.json`.

{table(["File", "Content", "Read", "Shipped"], rows, "files")}
```{{toctree}}
:hidden:

{chr(10).join(MODELS)}
```
"""


def _page(kind: str) -> str:
    """Return the page of a kind of file."""
    files = shipped()[kind]
    parts = [f"# {title(kind)}\n\n{prose(sentence(summary(MODELS[kind])))}\n\nRead {read_by(kind)}.\n"]
    parts += [_section(kind, model, places) for model, places in sections(MODELS[kind]).items()]
    if files:
        smallest = min(files, key=lambda path: path.stat().st_size)
        parts.append("## Shipped files\n\n" + "\n".join(_shipped(path, path == smallest) for path in files))
    return "\n".join(parts)


def _shipped(path: Path, opened: bool) -> str:
    """Return a shipped file in a section that can be folded."""
    name, text = path.relative_to(SCENES.parent).as_posix(), path.read_text("utf-8").rstrip()
    opening = "<details open>" if opened else "<details>"
    return f"{opening}<summary><code>{name}</code></summary>\n\n```yaml\n{text}\n```\n\n</details>\n"


def _section(kind: str, model: type[Spec], places: list[str]) -> str:
    """Return the section of a mapping, with the table of its keys."""
    if places == [""]:
        head, description = "## The file", ""
    else:
        head, description = f"## {code(places[0])}", f"{prose(sentence(summary(model)))}\n"
        if places[1:]:
            description += f"\nThe same at {', '.join(map(code, places[1:]))}.\n"
    rows = (_row(kind, model, places[0], key) for key in keys(model))
    return f"{head}\n\n{description}\n{table(['Key', 'Meaning', 'Takes', 'Default', 'Example'], rows, 'keys')}"


def _row(kind: str, model: type[Spec], place: str, key: Key) -> list[str]:
    """Return the table row of a key."""
    full, value = f"{place}.{key.name}".lstrip("."), example(kind, model, key.name)[key.name]
    shown = code(f"{key.name}: {flow(value)}")
    if key.below:
        below = f"see {code(f'{full}{key.below[0][0]}')} below"
        shown = below if isinstance(value, dict | list) else f"{shown}, or {below}"
    default = _default(key) or "must be written"
    return [f"{anchor(full)}{code(key.name)}", prose(sentence(key.meaning)), _takes(key.takes), default, shown]


def _default(key: Key) -> str:
    """Return the default of a key in Markdown; empty if the key is required."""
    return key.default if key.default in ("none", "empty", "its own defaults") else code(key.default)


def _takes(takes: Takes) -> str:
    """Return type, units and limits of a key in one line."""
    units = f"in {', '.join(map(code, takes.units))}" if takes.units else ""
    before, one_of, names = takes.what.partition("one of ")
    # Names followed by an alternative stay as they are.
    what = f"{before}one of {', '.join(map(code, names.split(', ')))}" if one_of and " or " not in names else takes.what
    return "; ".join(filter(None, (f"{what} {units}".strip(), takes.limits)))


def _node_page() -> str:
    """Return the page of the nodes."""
    parts = [
        """# Nodes of the shipped instruments

A key under `perturb:` in a job, `base/forward/M2`, is the path of a body in the tree of parts; a perturbation of a
body moves all bodies that it carries. `rotate` and `scale` act about a *pivot*, `origin` where none is named. Axes
and signs are those of [conventions](../docs/conventions.md); keys and limits those of [a job](files/job.md).

In a script the same table is `twin.load("gf7_pair").nodes`. An instrument of your own has the nodes of its own
cameras: their names are those of its file, mirrors those of the camera's file.
"""
    ]
    for name in library_names(INSTRUMENTS):
        nodes = twin.load(name).experiment.instrument.nodes
        parts.append(f"## {code(name)}\n\n{len(nodes)} nodes.\n\n{node_table(name, nodes)}")
    return "\n".join(parts)


def node_table(name: str, nodes: Mapping[str, NodeInfo]) -> str:
    """Return the table of one instrument's nodes with what each allows, sorted by path."""
    rows = (
        [
            f"{anchor(f'{name}-{path}')}{code(path)}",
            *("✓" if action in info.allows else "" for action in ACTIONS),
            ", ".join(code(pivot) for pivot in dict.fromkeys(("origin", *info.pivots))),
        ]
        for path, info in sorted(nodes.items())
    )
    return table(["Node", *map(code, ACTIONS), "Pivots"], rows, "nodes")
