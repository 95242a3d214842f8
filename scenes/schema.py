"""JSON Schemas of the YAML files, for editors: `python -m scenes.schema [--out DIR]`.

An editor that knows them completes keys, shows what they mean and marks mistakes while typing. With the YAML language
server, the first line of a file names its schema: `# yaml-language-server: $schema=schemas/job.schema.json`.
"""

if __name__ == "__main__":
    from scenes.yaml.interrupt import end_quietly

    end_quietly()

import json
import re
import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core import SchemaSerializer, core_schema
from rich.console import Console

from scenes.specs.file_kinds import FILE_KINDS
from scenes.yaml.spec import Spec
from scenes.yaml.standard_output import to_stdout

MODELS: dict[str, type[Spec]] = {kind.name: kind.model for kind in FILE_KINDS}
_ATTRIBUTE = re.compile(r"^    (\w+(?:, \w+)*): (.*(?:\n {8}.*)*)", re.MULTILINE)
_SI_UNIT = re.compile(r",? (?:metres|radians|seconds)\b")
DIALECT = "https://json-schema.org/draft/2020-12/schema"


def json_schema(name: str) -> dict[str, Any]:
    """The JSON Schema of one sort of file.

    Args:
        name: one of MODELS.

    Raises:
        KeyError: another name.
    """
    schema = MODELS[name].model_json_schema(schema_generator=_Generator)
    for model in (schema, *schema.get("$defs", {}).values()):
        _describe(model)
    return {"$schema": DIALECT, **schema}


class _Generator(GenerateJsonSchema):
    """Writes the defaults of quantities as text with a unit, as they stand in files."""

    def default_schema(self, schema: core_schema.WithDefaultSchema) -> JsonSchemaValue:
        result = super().default_schema(schema)
        if isinstance(schema.get("default"), float | tuple):
            result["default"] = SchemaSerializer(schema["schema"]).to_python(schema["default"], mode="json")
        return result


def _describe(model: dict[str, Any]) -> None:
    """Move what a class's docstring says of its attributes to where an editor shows it."""
    text = model.get("description", "")
    model["description"] = text.split("\n\n")[0]
    each = [(name, description) for names, description in _ATTRIBUTE.findall(text) for name in names.split(", ")]
    for name, description in each:
        item = model.get("properties", {}).get(name)
        if item is not None:
            description = " ".join(description.split())
            # In the file a quantity has the unit that is written beside it.
            unit = item.get("description") or item.get("items", {}).get("description")
            item["description"] = f"{_SI_UNIT.sub('', description).rstrip('.')}: {unit}" if unit else description


def write_schemas(folder: Path) -> list[Path]:
    """Write all schemas as `<name>.schema.json` into a folder, which is made if need be, and return their paths.

    Raises:
        OSError: it cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for name in MODELS:
        path = folder / f"{name}.schema.json"
        path.write_text(json.dumps(json_schema(name), indent=2, ensure_ascii=False) + "\n", "utf-8")
        paths.append(path)
    return paths


def main(
    out: Annotated[Path, typer.Option(help="Folder to write into; it is made if need be.")] = Path("schemas"),
) -> None:
    """Write the JSON Schemas of the twin's YAML files, for editors."""
    try:
        paths = write_schemas(out)
    except OSError as error:
        sys.stderr.write(f"{out}: cannot be written: {error.strerror or error}\n")
        raise typer.Exit(2) from None
    with to_stdout(Console(stderr=True), f"the schemas are complete in {out}"):
        sys.stdout.write("".join(f"{path}\n" for path in paths))


if __name__ == "__main__":
    typer.run(main)
