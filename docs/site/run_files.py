"""What the files of run folders are: read off golden runs of every command, and off the dataclasses that make them."""

from __future__ import annotations

import ast
import dataclasses
import importlib
import re
import types
import typing
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from docs.site.golden_fields import kept_fields
from docs.site.spec_keys import attributes, summary
from scenes.specs.study import UNITS, unit_of
from scenes.yaml.yaml_file import read_yaml
from tests.golden.jobs import ALL
from twin.framework.quantity import Record
from twin.framework.run_folder import Manifest

ROOT = Path(__file__).resolve().parents[2]
Tree = dict[str, Any]
"""Segment of a path -> what is below it; a leaf is the sort of the value, as text."""
SHOWN_NAMES = 4


@dataclass(frozen=True)
class RunFile:
    """One file, or several of one sort.

    Attributes:
        pattern: regular expression of the paths in the run folder.
        shown: how the reference writes them.
        what: what is in it.
    """

    pattern: str
    shown: str
    what: str


def _read(entries: list[dict[str, str]]) -> tuple[RunFile, ...]:
    return tuple(RunFile(one.get("pattern") or re.escape(one["file"]), one["file"], one["what"]) for one in entries)


_TOLD = read_yaml(Path(__file__).with_name("run_files.yaml")).data
EVERYWHERE = _read(_TOLD["everywhere"])
"""Files of every command's folder."""
FILES: Mapping[str, tuple[RunFile, ...]] = {command: _read(told) for command, told in _TOLD["commands"].items()}
"""Command -> its files beside those that every folder has and beside the figures and tables in artefacts/."""
_ARTEFACTS = RunFile(r"artefacts/.*", "artefacts/*", "figures and tables of the report")


def commands() -> dict[str, list[str]]:
    """Command -> golden jobs that ran it and left files."""
    out: dict[str, list[str]] = {}
    for job in ALL:
        if kept_fields(job.name):
            words = [word for word in job.words[1:2] if re.fullmatch(r"[a-z]+", word)]
            words += [word for word in job.words if word == "--gradient"]
            command = " ".join([job.words[0], *words])
            if command in FILES:
                out.setdefault(command, []).append(job.name)
    return out


def known(command: str) -> tuple[RunFile, ...]:
    """All that a command may leave, its own files first."""
    return (*FILES.get(command, ()), *EVERYWHERE, _ARTEFACTS)


def described(command: str, file: str) -> RunFile | None:
    """What is said of a file of a command's run folder; None where nothing is."""
    for one in known(command):
        if re.fullmatch(one.pattern, file):
            return one
    return None


def files(command: str) -> dict[str, list[Any]]:
    """File of a command's run folders -> what stands in it in each golden job that has it."""
    out: dict[str, list[Any]] = {}
    for job in commands()[command]:
        for name, told in kept_fields(job).items():
            out.setdefault(name, []).append(told)
    return out


# --- fields of JSON files --------------------------------------------------------------------------------


def field_tree(several: list[Any]) -> Tree:
    """The fields of a JSON file in all the runs that wrote it, things of one sort together."""
    tree: Tree = {}
    for told in several:
        for path, sort in told["fields"].items():
            _put(tree, segments(path), sort)
    return grouped(tree)


def segments(path: str) -> list[str]:
    """Parts of a field's path; names in braces may have dots."""
    parts, depth, last = [], 0, ""
    for letter in path:
        depth += {"{": 1, "}": -1}.get(letter, 0)
        if letter == "." and depth == 0:
            parts.append(last)
            last = ""
        else:
            last += letter
    return [*parts, last]


def _put(tree: Tree, path: list[str], sort: str) -> None:
    first, *rest = path
    if not rest:
        old = tree.get(first, "")
        if isinstance(old, str):
            tree[first] = " or ".join(sorted({one for one in [*old.split(" or "), *sort.split(" or ")] if one}))
        return
    below = tree.setdefault(first, {})
    if isinstance(below, dict):
        _put(below, rest, sort)
    else:
        tree[first] = {}
        _put(tree[first], rest, sort)


def grouped(tree: Tree, above: str = "") -> Tree:
    """The tree with mappings that have the same below them under one segment, ``{a|b}``; numbers, too, where the key
    ``above`` them has their unit, for then their own keys are names.
    """
    below = {key: grouped(one, key) if isinstance(one, dict) else one for key, one in tree.items()}
    named = bool(unit((above,)))
    alike: dict[str, list[str]] = {}
    for key, one in below.items():
        end = re.search(r"(\[\])*$", key)
        form = f"{one!r}{end[0] if end else ''}"
        if not isinstance(one, dict) and not (named or key.startswith("{")):
            form = f"leaf {key}"
        alike.setdefault(form, []).append(key)
    return {_together(keys): below[keys[0]] for keys in alike.values()}


def _together(keys: list[str]) -> str:
    if len(keys) == 1:
        return keys[0]
    end = re.search(r"(\[\])*$", keys[0])
    names = [name for key in keys for name in re.sub(r"(\[\])*$", "", key).strip("{}").split("|")]
    return "{" + "|".join(dict.fromkeys(names)) + "}" + (end[0] if end else "")


def leaves(tree: Tree, above: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], str]]:
    """(segments, sort) of every field."""
    for key, below in tree.items():
        if isinstance(below, dict):
            yield from leaves(below, (*above, key))
        else:
            yield (*above, key), below


def shown_path(path: tuple[str, ...]) -> str:
    """A path as the reference writes it; of many names the first few."""
    out = []
    for part in path:
        head, brace, rest = part.partition("{")
        if brace:
            names, _, end = rest.partition("}")
            listed = names.split("|")
            more = "|…" if len(listed) > SHOWN_NAMES or "..." in listed else ""
            part = head + "{" + "|".join(one for one in listed[:SHOWN_NAMES] if one != "...") + more + "}" + end
        out.append(part)
    return ".".join(out)


def unit(path: tuple[str, ...]) -> str:
    """The unit that the key of a field says, or the nearest key above it that says one."""
    for part in reversed(path):
        names = re.sub(r"(\[\])+$", "", part).strip("{}").split("|")
        key = names[0].removesuffix("_sigma")
        inverse = re.search(r"_per_(mm|m|px)$", key)
        if inverse and not unit_of((key,)).count("/"):
            return f"1/{inverse[1]}"
        if found := unit_of((key,)):
            return found
        inner = [UNITS[word] for word in key.split("_")[1:] if len(word) > 1 and word in UNITS]
        if inner:
            return inner[-1]
        if not part.startswith("{"):
            break
    return ""


# --- what the fields mean --------------------------------------------------------------------------------

MEANINGS: Mapping[str, str] = _TOLD["meanings"]
"""Last key of a field -> what it holds, of files that no dataclass makes."""


def meaning(kind: str, path: tuple[str, ...]) -> str:
    """What a field holds, as far as the source says; ``kind`` is the file's name without .json."""
    key = re.sub(r"(\[\])+$", "", path[-1])
    if path[0].startswith("reference_frames"):
        return MEANINGS["reference_frames"]
    if kind == "manifest":
        return attributes(Manifest).get(re.sub(r"(\[\])+$", "", path[0]), "")
    model = _model(kind)
    said = _declared(model, path)[0] if model is not None else ""
    if said:
        return said
    if key.endswith("_sigma") or key == "sigma":
        return f"standard deviation of {key.removesuffix('_sigma')}" if key != "sigma" else "standard deviation"
    return MEANINGS.get(key, "")


@cache
def _models() -> dict[str, type[Any] | Record[Any]]:
    """Kind of file -> the record whose meaning, or the dataclass whose docstring, begins with its name."""
    out = {}
    for path in sorted((ROOT / "twin").rglob("*.py")):
        for node in ast.parse(path.read_text("utf-8")).body:
            name, text = "", ""
            if isinstance(node, ast.ClassDef):
                name, text = node.name, ast.get_docstring(node) or ""
            elif isinstance(node, ast.AnnAssign | ast.Assign) and isinstance(node.value, ast.Call) and node.value.args:
                target = node.target if isinstance(node, ast.AnnAssign) else node.targets[0]
                name, text = ast.unparse(target), _text(node.value.args[0], "")
            if said := re.match(r"([a-z_]+)\.json\b", text):
                module = ".".join(path.relative_to(ROOT).with_suffix("").parts)
                out[said[1]] = getattr(importlib.import_module(module), name)
    return out


def _model(kind: str) -> type[Any] | Record[Any] | None:
    return _models().get(kind)


def mapping_meaning(kind: str, path: tuple[str, ...]) -> str:
    """What the dataclass says of itself whose fields stand below a path; empty where none makes the file."""
    model = _model(kind)
    return _declared(model, path)[1] if model is not None and path else ""


def _declared(model: type[Any] | Record[Any], path: tuple[str, ...]) -> tuple[str, str]:
    """What a record or a dataclass says of its field at the end of a path, and what the one there says of itself."""
    if isinstance(model, Record):
        return _of_record(model, path)
    here: Any = model
    said = ""
    for part in path:
        if isinstance(here, type) and dataclasses.is_dataclass(here):
            hints = typing.get_type_hints(here)
            names = re.sub(r"(\[\])+$", "", part).strip("{}").split("|")
            name = next((one for one in names if one in hints), None)
            if name is None:
                return "", ""
            said = attributes(here).get(name, "")
            here = _bare(hints[name])
        else:
            here = _item(here)
        for _ in range(part.count("[]")):
            here = _item(here)
    return said, summary(here) if isinstance(here, type) and dataclasses.is_dataclass(here) else ""


def _of_record(record: Record[Any], path: tuple[str, ...]) -> tuple[str, str]:
    here: Record[Any] | None = record
    said = ""
    for part in path:
        names = re.sub(r"(\[\])+$", "", part).strip("{}").split("|")
        found = None if here is None else next((one for one in here if one.key in names), None)
        if found is not None:
            said, here = found.meaning, found.below
        elif not part.startswith("{") and (here is None or here is record):
            # a name of a mapping leads to the record that the mapping holds; anything else is not declared
            return "", ""
    return said, "" if here is None else here.meaning


def _bare(hint: Any) -> Any:
    if typing.get_origin(hint) in (types.UnionType, typing.Union):
        return _bare(next(one for one in typing.get_args(hint) if one is not type(None)))
    return hint


def _item(hint: Any) -> Any:
    """What a sequence or a mapping holds."""
    items = [one for one in typing.get_args(hint) if one is not Ellipsis]
    return _bare(items[-1]) if items else None


@cache
def artefact_titles() -> tuple[tuple[str, str, str], ...]:
    """(folder of the source, regular expression of an artefact's name, its title), as the reports' modules say."""
    out = []
    for path in sorted((ROOT / "twin").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if not isinstance(node, ast.Call) or getattr(node.func, "id", "") not in ARTEFACTS:
                continue
            given = dict(zip(("name", "title"), node.args, strict=False))
            given |= {one.arg: one.value for one in node.keywords if one.arg in ("name", "title")}
            if len(given) == 2 and (title := _text(given["title"], "…")) and (name := _text(given["name"], r"[\w-]+")):
                out.append((path.parent.relative_to(ROOT).as_posix(), name, title))
    return tuple(out)


ARTEFACTS = ("SvgFigure", "PngFigure", "Table", "Data")


def _text(node: ast.expr, hole: str) -> str:
    """A literal or formatted text with something in place of what is filled in; empty for anything else."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return "".join(str(part.value) if isinstance(part, ast.Constant) else hole for part in node.values)
    return ""


FOLDERS = {
    "twin.lab": "twin/laboratory",
    "twin.orbit simulate": "twin/orbit/images",
    "twin.orbit adjust": "twin/orbit/block",
    "twin.orbit angle": "twin/orbit/angle",
    "twin.orbit calibrate": "twin/orbit/calibration",
    "twin.orbit monitor": "twin/orbit/monitoring",
    "twin.orbit check": "twin/orbit/conventions",
    "twin.orbit match": "twin/orbit/matching",
    "twin.orbit jitter": "twin/orbit/jitter",
    "twin.study --gradient": "twin/study/gradient",
    "twin.study": "twin/study/report",
}
"""Command -> where its reports are made, for names that several commands use."""


def artefact_title(command: str, file: str) -> str:
    """What a figure or table in artefacts/ shows; empty where the source does not say it in so many words."""
    name = Path(file).stem
    place = next((folder for words, folder in FOLDERS.items() if command.startswith(words)), command.replace(".", "/"))
    found = [(folder, title) for folder, pattern, title in artefact_titles() if re.fullmatch(pattern, name)]
    return next((title for folder, title in found if folder.startswith(place)), found[0][1] if len(found) == 1 else "")
