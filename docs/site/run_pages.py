"""Pages of the run folders: every file that a command writes, and every field, column, variable and tag in it.

They are read from the golden runs of every command; meanings and units are those of the records that make the files.
"""

from __future__ import annotations

import ast
import importlib
import json
import re
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from docs.site.markdown import code, prose, sentence, table
from docs.site.spec_keys import attributes
from scenes.specs.study import UNITS, unit_of
from scenes.yaml.yaml_file import read_yaml
from tests.golden.digest import sorts
from tests.golden.golden import golden_file
from tests.golden.jobs import ALL
from twin.framework.record import FRAMES, Record
from twin.framework.run_folder import Manifest

ROOT = Path(__file__).resolve().parents[2]
FOLDER = "reference/run_folders"
DESCRIBED = read_yaml(Path(__file__).with_name("run_files.yaml")).data
PRINTED = ("exit", "stdout", "stderr", "exact")
"""Keys of a golden run that are not files."""
SHOWN_NAMES = 4
Tree = dict[str, Any]
"""Segment of a path -> subtree; a leaf is the type of the value, as text."""
_LISTS = re.compile(r"(\[\])*$")


# --- content of golden runs -------------------------------------------------------------------------------


def golden_fields(job: str) -> dict[str, Any]:
    """Return file -> structure of its content without values, of a golden run; empty for one without files.

    JSON has ``fields``: path of a value -> its type. CSV has ``columns``. netCDF has ``variables``: name -> dimensions,
    type of number and attributes, and ``attributes`` of its groups. TIFF has ``dtype`` and ``tags``.
    """
    run = json.loads(golden_file(job).read_text("utf-8"))["run"]
    return {name: _fields(name, tree) for name, tree in run.items() if name not in PRINTED}


def _fields(name: str, tree: dict[str, Any]) -> dict[str, Any]:
    """Return the structure of a file's content by its kind."""
    if name.endswith(".json") and "definitions" not in tree:
        return {"fields": sorts(tree)}
    if name.endswith(".csv"):
        return {"columns": tree["head"]}
    if name.endswith(".nc"):
        variables = {
            f"{group.rstrip('/')}/{variable}".lstrip("/"): description
            for group, data in tree.items()
            for variable, description in data["variables"].items()
        }
        return {"variables": variables, "attributes": [key for data in tree.values() for key in sorted(data["attrs"])]}
    if name.endswith(".tiff"):
        return {"dtype": tree["pixels"]["kind"], "tags": sorted(tree["tags"])}
    return {}


@cache
def golden_runs() -> dict[str, dict[str, list[Any]]]:
    """Return command -> file of its run folders -> structure of the file in each golden job that has it."""
    out: dict[str, dict[str, list[Any]]] = {}
    for job in ALL:
        words = [word for word in job.words[1:2] if re.fullmatch(r"[a-z]+", word)]
        words += [word for word in job.words if word == "--gradient"]
        command = " ".join([job.words[0], *words])
        if command in DESCRIBED["commands"]:
            for name, fields in golden_fields(job.name).items():
                out.setdefault(command, {}).setdefault(name, []).append(fields)
    return out


def described(command: str) -> list[dict[str, str]]:
    """Return the entries of a command's run folder files for the reference.

    Raises
    ------
    LookupError
        A golden run has a file that is not described.
    """
    everywhere, there = DESCRIBED["everywhere"], []
    for name in golden_runs()[command]:
        for entry in (*DESCRIBED["commands"][command], *everywhere):
            if re.fullmatch(entry.get("pattern") or re.escape(entry["file"]), name):
                there.append(entry)
                break
        else:
            raise LookupError(f"{command}: run_files.yaml does not describe {name}")
    return [*DESCRIBED["commands"][command], *(entry for entry in everywhere if entry in there)]


# --- fields of JSON files --------------------------------------------------------------------------------


def field_tree(several: list[Any]) -> Tree:
    """Return the fields of a JSON file over all runs that wrote it, with equal structures merged."""
    tree: Tree = {}
    for run in several:
        for path, sort in run["fields"].items():
            # Names in braces may have dots.
            *above, last = re.findall(r"(?:\{[^{}]*\}|[^.{}])+", path)
            here = tree
            for part in above:
                if not isinstance(here.get(part), dict):
                    here[part] = {}
                here = here[part]
            before = here.get(last, "")
            if isinstance(before, str):
                here[last] = " or ".join(sorted({*before.split(" or "), *sort.split(" or ")} - {""}))
    return grouped(tree)


def grouped(tree: Tree, above: str = "") -> Tree:
    """Return the tree with mappings of equal content merged into one segment, ``{a|b}``.

    Numbers are merged as well where the key above them has the unit.
    """
    below = {key: grouped(subtree, key) if isinstance(subtree, dict) else subtree for key, subtree in tree.items()}
    named = bool(unit((above,)))
    alike: dict[str, list[str]] = {}
    for key, subtree in below.items():
        leaf = not isinstance(subtree, dict) and not named and not key.startswith("{")
        alike.setdefault(f"leaf {key}" if leaf else f"{subtree!r}{lists(key)}", []).append(key)
    return {_together(keys): below[keys[0]] for keys in alike.values()}


def names(part: str) -> list[str]:
    """Return the names that a segment of a path stands for."""
    return _LISTS.sub("", part).strip("{}").split("|")


def lists(part: str) -> str:
    """Return the brackets at the end of a segment."""
    return part[len(_LISTS.sub("", part)) :]


def _together(keys: list[str]) -> str:
    """Return one segment for several keys."""
    if len(keys) == 1:
        return keys[0]
    merged = dict.fromkeys(name for key in keys for name in names(key))
    return f"{{{'|'.join(merged)}}}{lists(keys[0])}"


def leaves(tree: Tree, above: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], str]]:
    """Yield (segments, type) of every field."""
    for key, below in tree.items():
        if isinstance(below, dict):
            yield from leaves(below, (*above, key))
        else:
            yield (*above, key), below


def shown_path(path: tuple[str, ...]) -> str:
    """Return a path as the reference writes it, with only the first few of many names."""

    def few(found: re.Match[str]) -> str:
        listed = found[1].split("|")
        more = ["…"] if len(listed) > SHOWN_NAMES or "..." in listed else []
        return f"{{{'|'.join([*(name for name in listed[:SHOWN_NAMES] if name != '...'), *more])}}}"

    return re.sub(r"\{(.*?)\}", few, ".".join(path))


def unit(path: tuple[str, ...]) -> str:
    """Return the unit in the key of a field, or in the nearest key above it that has one."""
    for part in reversed(path):
        key = names(part)[0].removesuffix("_sigma")
        inverse = re.search(r"_per_(mm|m|px)$", key)
        if inverse and "/" not in unit_of((key,)):
            return f"1/{inverse[1]}"
        inner = [UNITS[word] for word in key.split("_")[1:] if len(word) > 1 and word in UNITS]
        if found := unit_of((key,)) or "".join(inner[-1:]):
            return found
        if not part.startswith("{"):
            break
    return ""


# --- meaning of the fields --------------------------------------------------------------------------------


def meaning(kind: str, path: tuple[str, ...]) -> str:
    """Return the meaning of a field, as far as the source declares it; ``kind`` is the file's name without .json."""
    key = names(path[-1])[0]
    if kind == "manifest":
        return attributes(Manifest).get(names(path[0])[0], "")
    if said := declared(kind, path)[0]:
        return said
    if key.endswith("sigma"):
        return f"standard deviation of {key.removesuffix('_sigma')}" if key != "sigma" else "standard deviation"
    return str(DESCRIBED["meanings"].get(key, ""))


def declared(kind: str, path: tuple[str, ...]) -> tuple[str, str]:
    """Return the description of a field in the record of a kind of file, and that in the record below it."""
    record = _records().get(kind)
    fields, description = record, ""
    for part in path:
        match = next((entry for entry in fields or () if entry.key in names(part)), None)
        if match is not None:
            description, fields = match.meaning, match.below
        elif not part.startswith("{") and (fields is None or fields is record):
            # A name of a mapping leads to the record in the mapping; anything else is not declared.
            return "", ""
    return description, "" if fields is None else fields.meaning


def _sources() -> Iterator[tuple[Path, ast.Module]]:
    """Yield the parsed source files of the package twin."""
    for path in sorted((ROOT / "twin").rglob("*.py")):
        yield path.relative_to(ROOT), ast.parse(path.read_text("utf-8"))


@cache
def _records() -> Mapping[str, Record[Any]]:
    """Return kind of file -> the record whose meaning begins with the file's name."""
    out = {}
    for path, module in _sources():
        for node in module.body:
            if isinstance(node, ast.AnnAssign | ast.Assign) and isinstance(node.value, ast.Call) and node.value.args:
                target = node.target if isinstance(node, ast.AnnAssign) else node.targets[0]
                if said := re.match(r"([a-z_]+)\.json\b", _text(node.value.args[0], "")):
                    home = importlib.import_module(".".join(path.with_suffix("").parts))
                    out[said[1]] = getattr(home, ast.unparse(target))
    return {kind: record for kind, record in out.items() if isinstance(record, Record)}


@cache
def artefact_titles() -> tuple[tuple[str, str, str], ...]:
    """Return (folder of the source, pattern of an artefact's name, title) of all calls that name and title one."""
    out = []
    for path, module in _sources():
        for node in ast.walk(module):
            if isinstance(node, ast.Call):
                passed = dict(zip(("name", "title"), node.args, strict=False))
                passed |= {keyword.arg: keyword.value for keyword in node.keywords if keyword.arg in ("name", "title")}
                if len(passed) == 2 and (title := _text(passed["title"], "…"))[:1].isupper():
                    out.append((path.parent.as_posix(), _text(passed["name"], r"[\w-]+"), title))
    # Literal names precede names that are partly filled in.
    return tuple(sorted(out, key=lambda found: "[" in found[1]))


def _text(node: ast.expr, hole: str) -> str:
    """Return a literal or formatted text with a placeholder for inserted values; empty for anything else."""
    if isinstance(node, ast.JoinedStr):
        return "".join(str(part.value) if isinstance(part, ast.Constant) else hole for part in node.values)
    return node.value if isinstance(node, ast.Constant) and isinstance(node.value, str) else ""


def artefact_title(command: str, file: str) -> str:
    """Return the title of a figure or table in artefacts/; empty where the source has no literal title."""
    folders, stem = DESCRIBED["folders"], Path(file).stem
    place = next((folder for words, folder in folders.items() if command.startswith(words)), command.replace(".", "/"))
    found = [(home, said) for home, name, said in artefact_titles() if re.fullmatch(name, stem)]
    here = [said for home, said in found if home.startswith(place)]
    # Fall back to sources outside of the commands' folders.
    shared = [said for home, said in found if not home.startswith(tuple(folders.values()))]
    return (here or [said for said in shared if len(shared) == 1] or [""])[0]


# --- pages -----------------------------------------------------------------------------------------------


def run_pages() -> dict[str, str]:
    """Return the pages in Markdown, by their paths in the site's source."""
    files = {
        command: command.replace("twin.", "").replace(" --", "-").replace(".", "-").replace(" ", "-")
        for command in golden_runs()
    }
    pages = {f"{FOLDER}/{name}.md": _page(command) for command, name in files.items()}
    return {f"{FOLDER}/index.md": _index(files), **pages}


def _list(entries: list[dict[str, str]]) -> str:
    """Return a list of files with their descriptions."""
    return table(
        ["File", "What is in it"], ([code(one["file"]), prose(sentence(one["what"]))] for one in entries), "files"
    )


def _index(files: dict[str, str]) -> str:
    """Return the index page of the run folders."""
    every = DESCRIBED["everywhere"]
    kinds = {command: [code(one["file"]) for one in described(command) if one not in every] for command in files}
    rows = ([f"[{code(command)}]({name}.md)", ", ".join(kinds[command])] for command, name in files.items())
    return f"""# Run folders

Every command writes into a folder of its own, `--out DIR` or else the first free of `runs/NAME-001`, `-002`, ... It
appears complete or not at all. Every folder has:

{_list(every)}
and what the command adds:

{table(["Command", "Files"], rows, "files")}
The names of a number end in its unit: `d_f_um`, `change_arcsec`; `_sigma` after it is its standard deviation in the
same unit. In the paths of fields `{{forward|backward}}` stands for the names that the instrument or the file has,
here those of the examples, and `[]` for the items of a list. Frames are 16-bit TIFF, one page a frame, grey values;
positions, angles and times refer to what `reference_frames` in the same file says.

These pages are made from small runs of every command; a run has fewer files where its job asks for less.

```{{toctree}}
:hidden:

{chr(10).join(files.values())}
```
"""


def _page(command: str) -> str:
    """Return the page of a command's run folder."""
    artefacts, tiffs, parts = [], [], [f"# Files of {code(command)}\n\n{_list(described(command))}"]
    for name, several in golden_runs()[command].items():
        columns = ", ".join(dict.fromkeys(code(column) for told in several for column in told.get("columns", ())))
        if "fields" in several[0]:
            parts.append(f"## {code(name)}\n\n{_json(Path(name).stem, several)}")
        elif "variables" in several[0] and not name.startswith("artefacts/"):
            parts.append(f"## {code(name)}\n\n{_netcdf(several)}")
        elif columns and not name.startswith("artefacts/"):
            parts.append(f"## {code(name)}\n\n{columns.count(',') + 1} columns: {columns}.\n")
        if name.startswith("artefacts/"):
            artefacts.append([code(Path(name).name), prose(artefact_title(command, name)), columns])
        tiffs += [told for told in several if "tags" in told]
    if tiffs:
        kinds = ", ".join(dict.fromkeys(code(told["dtype"]) for told in tiffs))
        tags = ", ".join(dict.fromkeys(code(tag) for told in tiffs for tag in told["tags"]))
        parts.append(f"## Frames (TIFF)\n\nPixels are {kinds}. Tags: {tags}.\n")
    if artefacts and not command.startswith("twin.validate"):
        shown = table(["File", "What it shows", "Columns"], artefacts, "artefacts")
        parts.append(f"## {code('artefacts/')}\n\n{shown}")
    return "\n".join(parts)


def _json(kind: str, several: list[Any]) -> str:
    """Return the table of a JSON file's fields."""
    blocks: dict[tuple[str, ...], list[list[str]]] = {}
    for path, sort in leaves(field_tree(several)):
        if path[0] != "reference_frames":
            row = [code(shown_path(path[-1:])), code(unit(path)), sort or "list", prose(sentence(meaning(kind, path)))]
            blocks.setdefault(path[:-1], []).append(row)
    parts = []
    if frames := FRAMES.get(kind, {}):
        rows = ([code(quantity), prose(sentence(frame))] for quantity, frame in frames.items())
        parts.append(f"`reference_frames`, what these refer to:\n\n{table(['Quantity', 'Frame'], rows, 'files')}\n")
    for above, fields in blocks.items():
        if above:
            parts.append(f"In {code(shown_path(above))}: {prose(sentence(declared(kind, above)[1]))}".rstrip() + "\n")
        parts.append(table(["Field", "Unit", "Holds", "Meaning"], fields, "fields"))
    return "\n".join(parts)


def _netcdf(several: list[Any]) -> str:
    """Return the table of a netCDF file's variables."""
    variables = {place: told for one in several for place, told in one["variables"].items()}
    rows = (
        [
            code(place),
            ", ".join(map(code, told["dims"])),
            code(str(told["attrs"].get("units", ""))),
            told["values"].get("kind", "text"),
            prose(sentence(str(told["attrs"].get("long_name", "")))),
        ]
        for place, told in variables.items()
    )
    attrs = ", ".join(dict.fromkeys(code(key) for one in several for key in one["attributes"]))
    shown = table(["Variable", "Dimensions", "Unit", "Holds", "Meaning"], rows, "fields")
    return f"{shown}\nAttributes: {attrs}.\n" if attrs else shown
