"""JSON Schemas of the YAML files, for editors: `python -m scenes.schema [--out DIR]`.

An editor with these schemas completes keys, shows what they mean and marks mistakes while typing. With the YAML
language server, the first line of a file names its schema: `# yaml-language-server: $schema=schemas/job.schema.json`.
"""

from __future__ import annotations

if __name__ == "__main__":
    from scenes.yaml.interrupt import end_quietly

    end_quietly()

import json
import re
import sys
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core import SchemaSerializer, core_schema
from rich.console import Console

from scenes.specs.file_kinds import file_kinds
from scenes.yaml.standard_output import to_stdout

if TYPE_CHECKING:
    from scenes.specs.perturbation import NodeInfo
    from scenes.yaml.spec import Spec

    MODELS: dict[str, type[Spec]]

_ATTRIBUTE = re.compile(r"^(\w+(?:, \w+)*)(?: : .*)?\n((?:(?: {4}.*)?\n)*(?: {4}.*))", re.MULTILINE)
_SI_UNIT = re.compile(r",? (?:in )?(?:metres|radians|seconds)\b")
DIALECT = "https://json-schema.org/draft/2020-12/schema"


@cache
def _models() -> dict[str, type[Spec]]:
    """Return the specification class of each kind of file, by name; their modules are imported here."""
    return {kind.name: kind.model for kind in file_kinds()}


def __getattr__(name: str) -> Any:
    """Return ``MODELS`` on first use, so that ``--help`` does not wait for it."""
    if name == "MODELS":
        return _models()
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def json_schema(name: str) -> dict[str, Any]:
    """Return the JSON Schema of one kind of file.

    Parameters
    ----------
    name : str
        Kind of file, one of ``MODELS``.

    Raises
    ------
    KeyError
        There is no such kind.
    """
    schema = _models()[name].model_json_schema(schema_generator=WithUnits)
    for model in (schema, *schema.get("$defs", {}).values()):
        _describe(model)
    return {"$schema": DIALECT, **schema}


class WithUnits(GenerateJsonSchema):
    """Schema generator that writes defaults of quantities as text with a unit, as in files."""

    def default_schema(self, schema: core_schema.WithDefaultSchema) -> JsonSchemaValue:
        """Return the schema of a key, with its default as files write it."""
        result = super().default_schema(schema)
        if isinstance(schema.get("default"), float | tuple) and schema["default"] != ():
            result["default"] = SchemaSerializer(schema["schema"]).to_python(schema["default"], mode="json")
        return result


def _describe(model: dict[str, Any]) -> None:
    """Move the descriptions of attributes in a class's docstring to the keys, where an editor shows them."""
    text = model.get("description", "")
    model["description"] = text.split("\n\n")[0]
    listed = text.partition("\nAttributes\n----------\n")[2]
    pairs = [(name, description) for names, description in _ATTRIBUTE.findall(listed) for name in names.split(", ")]
    for name, description in pairs:
        item = model.get("properties", {}).get(name)
        if item is not None:
            description = " ".join(description.split())
            # A quantity of a file has the unit written beside it, not that of the attribute.
            first = item.get("anyOf", [item])[0]
            unit = item.get("description") or first.get("description") or first.get("items", {}).get("description")
            item["description"] = f"{_SI_UNIT.sub('', description).rstrip('.')}: {unit}" if unit else description


def shipped_nodes() -> dict[str, Mapping[str, NodeInfo]]:
    """Return the nodes of each instrument of the library, by path, with what they allow.

    Raises
    ------
    BackendUnavailable, LibraryMissing
        Instruments cannot be traced on this machine.
    """
    from optics.numerics.backend import load_backend
    from scenes.models.instrument_builder import build_instrument
    from scenes.specs.job import JobSpec
    from scenes.specs.load import INSTRUMENTS, library_names
    from scenes.specs.resolved import resolve_job

    backend, out = load_backend(), {}
    for name in library_names(INSTRUMENTS):
        resolved = resolve_job(JobSpec(instrument=name))
        out[name] = build_instrument(resolved.instrument, resolved.cameras, backend).nodes
    return out


def with_nodes(schema: dict[str, Any], instruments: Mapping[str, Mapping[str, NodeInfo]]) -> dict[str, Any]:
    """Return the schema of a job that lists the nodes of known instruments, their pivots and what they allow.

    Parameters
    ----------
    schema : dict[str, Any]
        Schema of a job.
    instruments : Mapping[str, Mapping[str, NodeInfo]]
        Instrument name -> node path -> what the node allows. A job of another instrument may name any node.
    """
    named = {**schema["properties"]["instrument"], "examples": list(instruments)}
    rules = []
    for name, nodes in instruments.items():
        warm = {path: info for path, info in nodes.items() if "temperature" in info.allows}
        moved = {path: info for path, info in nodes.items() if info.allows - {"temperature"}}
        course = {"temperature": _only(dict.fromkeys(warm, True)), "motion": _only(_of_nodes(moved))}
        then = {"perturb": _only(_of_nodes(nodes)), "course": {"properties": course}}
        condition = {"properties": {"instrument": {"const": name}}, "required": ["instrument"]}
        rules.append({"if": condition, "then": {"properties": then}})
    return {**schema, "properties": {**schema["properties"], "instrument": named}, "allOf": rules}


def _only(properties: Mapping[str, Any]) -> dict[str, Any]:
    """Return the JSON Schema of a mapping that allows these keys and no others."""
    return {"properties": dict(properties), "propertyNames": {"enum": list(properties)}}


def _of_nodes(nodes: Mapping[str, NodeInfo]) -> dict[str, Any]:
    """Return path of each node -> JSON Schema of the perturbation that the node allows."""
    from scenes.specs.perturbation import ACTIONS

    out = {}
    for path, info in nodes.items():
        never = {action: False for action in ACTIONS if action not in info.allows}
        if "figure" not in info.allows:
            never["deformation"] = False
        out[path] = {"properties": {"pivot": {"enum": list(info.known_pivots)}, **never}}
    return out


def write_schemas(folder: Path, instruments: Mapping[str, Mapping[str, NodeInfo]]) -> list[Path]:
    """Write all schemas as `<name>.schema.json` into a folder, which is created if necessary, and return their paths.

    Parameters
    ----------
    folder : Path
        Folder to write into.
    instruments : Mapping[str, Mapping[str, NodeInfo]]
        Instruments whose nodes the schema of jobs lists.

    Raises
    ------
    OSError
        The files cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for name in _models():
        path = folder / f"{name}.schema.json"
        schema = json_schema(name)
        schema = with_nodes(schema, instruments) if name == "job" else schema
        path.write_text(json.dumps(schema, indent=2, ensure_ascii=False) + "\n", "utf-8")
        paths.append(path)
    return paths


def main(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for them.")] = Path("schemas"),
    force: Annotated[bool, typer.Option("--force", help="Write into the folder if it exists.")] = False,
) -> None:
    """Write the JSON Schemas of the twin's YAML files, for editors.

    The schema of a job lists the nodes of the library's instruments, their pivots and what may be done to each;
    quantities are checked for the usual units of their kind.

    Example: python -m scenes.schema --out schemas

    Then the first line of a job's file may be: # yaml-language-server: $schema=schemas/job.schema.json
    """
    from optics.numerics.backend import BackendUnavailable
    from optics.numerics.llvm import LibraryMissing

    if out.exists() and not force:
        sys.stderr.write(f"{out} exists; choose another --out, or write into it with --force\n")
        raise typer.Exit(2)
    instruments: dict[str, Mapping[str, NodeInfo]] = {}
    try:
        instruments = shipped_nodes()
    except (BackendUnavailable, LibraryMissing) as error:
        sys.stderr.write(f"the schema of jobs lists no nodes: {error}\n")
    try:
        paths = write_schemas(out, instruments)
    except OSError as error:
        sys.stderr.write(f"{out}: cannot be written: {error.strerror or error}\n")
        raise typer.Exit(2) from None
    with to_stdout(Console(stderr=True), f"the schemas are complete in {out}"):
        sys.stdout.write("".join(f"{path}\n" for path in paths))


if __name__ == "__main__":
    typer.run(main)
