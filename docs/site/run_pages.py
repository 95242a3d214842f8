"""The pages of the run folders: every file that a command leaves, and every field, column, variable and tag in it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from docs.site.markdown import code, prose, sentence, table
from docs.site.run_files import (
    EVERYWHERE,
    artefact_title,
    commands,
    described,
    field_tree,
    files,
    known,
    leaves,
    mapping_meaning,
    meaning,
    shown_path,
    unit,
)
from twin.framework.reference_frames import FRAMES

FOLDER = "reference/run_folders"


def run_pages() -> dict[str, str]:
    """Path of a page in the site's source -> Markdown."""
    names = {
        command: command.replace("twin.", "").replace(" --", "-").replace(".", "-").replace(" ", "-")
        for command in commands()
    }
    pages = {f"{FOLDER}/{name}.md": _page(command) for command, name in names.items()}
    return {f"{FOLDER}/index.md": _index(names), **pages}


def _index(names: dict[str, str]) -> str:
    rows = [[code(one.shown), prose(sentence(one.what))] for one in EVERYWHERE]
    listed = [[f"[{code(command)}]({name}.md)", _kinds(command)] for command, name in names.items()]
    return f"""# Run folders

Every command writes into a folder of its own, `--out DIR` or else the first free of `runs/NAME-001`, `-002`, ... It
appears complete or not at all. Every folder has:

{table(["File", "What is in it"], rows, "files")}
and what the command adds:

{table(["Command", "Files"], listed, "files")}
The names of a number end in its unit: `d_f_um`, `change_arcsec`; `_sigma` after it is its standard deviation in the
same unit. In the paths of fields `{{forward|backward}}` stands for the names that the instrument or the file has,
here those of the examples, and `[]` for the items of a list. Frames are 16-bit TIFF, one page a frame, grey values;
positions, angles and times refer to what `reference_frames` in the same file says.

These pages are made from small runs of every command; a run has fewer files where its job asks for less.

```{{toctree}}
:hidden:

{chr(10).join(names.values())}
```
"""


def _kinds(command: str) -> str:
    shown = [one.shown for one in _files_shown(command) if one not in EVERYWHERE]
    return ", ".join(map(code, dict.fromkeys(shown)))


def _files_shown(command: str) -> list[Any]:
    there = {described(command, name) for name in files(command)}
    return [one for one in known(command) if one in there]


def _page(command: str) -> str:
    own = files(command)
    rows = [[code(one.shown), prose(sentence(one.what))] for one in _files_shown(command)]
    parts = [f"# Files of {code(command)}\n\n{table(['File', 'What is in it'], rows, 'files')}"]
    artefacts = {name: told for name, told in own.items() if name.startswith("artefacts/")}
    for name, several in own.items():
        if name not in artefacts or name.endswith(".json"):
            parts.append(_fields(name, several))
    parts.append(_tiffs(own))
    if artefacts and not command.startswith("twin.validate"):
        parts.append(f"## {code('artefacts/')}\n\n{_artefacts(command, artefacts)}")
    return "\n".join(part for part in parts if part)


def _fields(name: str, several: list[Any]) -> str:
    if "fields" in several[0]:
        return _json(name, several)
    if "groups" in several[0]:
        return _netcdf(name, several)
    if "columns" in several[0]:
        rows = [[code(column), ""] for column in dict.fromkeys(c for told in several for c in told["columns"])]
        return f"## {code(name)}\n\n{len(rows)} columns: {', '.join(row[0] for row in rows)}.\n"
    return ""


def _json(name: str, several: list[Any]) -> str:
    kind = Path(name).stem
    blocks: dict[tuple[str, ...], list[list[str]]] = {}
    for path, sort in leaves(field_tree(several)):
        if path[0] == "reference_frames":
            continue
        row = [code(shown_path(path[-1:])), code(unit(path)), sort or "list", prose(sentence(meaning(kind, path)))]
        blocks.setdefault(path[:-1], []).append(row)
    parts = []
    for above, rows in blocks.items():
        if above:
            about = prose(sentence(mapping_meaning(kind, above)))
            parts.append(f"In {code(shown_path(above))}:{f' {about}' if about else ''}\n")
        parts.append(table(["Field", "Unit", "Holds", "Meaning"], rows, "fields"))
    frames = FRAMES.get(kind, {})
    told = [[code(quantity), prose(sentence(frame))] for quantity, frame in frames.items()]
    about = ""
    if told:
        about = f"`reference_frames`, what these refer to:\n\n{table(['Quantity', 'Frame'], told, 'files')}\n"
    return f"## {code(name)}\n\n{about}{chr(10).join(parts)}"


def _netcdf(name: str, several: list[Any]) -> str:
    rows: dict[str, list[str]] = {}
    attributes: dict[str, None] = {}
    for told in several:
        for group, data in told["groups"].items():
            attributes |= dict.fromkeys(data["attributes"])
            for variable, one in data["variables"].items():
                about = one["attributes"]
                place = f"{group.rstrip('/')}/{variable}".lstrip("/")
                rows[place] = [
                    code(place),
                    ", ".join(map(code, one["dims"])),
                    code(about.get("units", "")),
                    one["dtype"],
                    prose(sentence(about.get("long_name", ""))),
                ]
    heads = ["Variable", "Dimensions", "Unit", "Holds", "Meaning"]
    tail = f"\nAttributes: {', '.join(map(code, attributes))}.\n" if attributes else ""
    return f"## {code(name)}\n\n{table(heads, rows.values(), 'fields')}{tail}"


def _tiffs(own: dict[str, list[Any]]) -> str:
    told = [one for name, several in own.items() if name.endswith(".tiff") for one in several]
    if not told:
        return ""
    sorts = ", ".join(map(code, dict.fromkeys(one["dtype"] for one in told)))
    tags = ", ".join(map(code, dict.fromkeys(tag for one in told for tag in one["tags"])))
    return f"## Frames (TIFF)\n\nPixels are {sorts}. Tags: {tags}.\n"


def _artefacts(command: str, artefacts: dict[str, list[Any]]) -> str:
    rows = []
    for name, several in artefacts.items():
        columns = list(dict.fromkeys(c for told in several for c in told.get("columns", ())))
        rows.append([code(Path(name).name), prose(artefact_title(command, name)), ", ".join(map(code, columns))])
    return table(["File", "What it shows", "Columns"], rows, "artefacts")
