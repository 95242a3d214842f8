"""Text of a new file: its template, filled with the numbers of a camera and checked by the model of its kind."""

import json
import os
import re
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from optics.numerics.backend import load_backend
from scenes.models.camera_model import derive_camera
from scenes.models.camera_sharpness import sharpness
from scenes.specs.file_kinds import file_kinds
from scenes.specs.load import is_path
from scenes.specs.resolved import resolve_with
from scenes.yaml.errors import InputError, Issue, Problem
from scenes.yaml.spec import validate
from scenes.yaml.units import split_quantity
from scenes.yaml.yaml_file import parse_yaml
from twin.new.camera_numbers import INDEX, RADIUS, CameraNumbers


def numbers_of(reference: str, folder: Path) -> CameraNumbers:
    """Return the numbers that a new file in a folder takes from a camera, or from the first one of an instrument.

    Raises
    ------
    InputError
        There is no such camera or instrument, or its prescription brings no light to the image.
    """
    resolved = resolve_with(reference)
    instrument, backend = resolved.instrument, load_backend("llvm")
    mounted, site = next(iter(instrument.cameras.items()))
    camera = resolved.cameras[site.camera]
    alone = len(instrument.cameras) == 1
    names = (reference_from(reference, folder), instrument.name, mounted, "" if alone else f"{mounted}/")
    upright = bool(derive_camera(camera, backend).first_order.scale[0, 0, 0] < 0.0)
    return CameraNumbers(camera, *names, instrument.monitor is not None, sharpness(camera, backend).worst, upright)


def reference_from(reference: str, folder: Path) -> str:
    """Return a reference to an instrument as a file in a folder has it: a name, or a path relative to the folder."""
    return _quoted(os.path.relpath(reference, folder)) if is_path(reference) else reference


def checked_text(kind: str, numbers: CameraNumbers, values: Mapping[str, str]) -> str:
    """Return the text of a new file.

    Parameters
    ----------
    kind : str
        Name of its template and kind of file.
    numbers : CameraNumbers
        Numbers of its camera.
    values : mapping of str to str
        Answers to the questions of its kind, ``file``, its path, and ``base``, the job of a study.

    Raises
    ------
    InputError
        A value is not allowed.
    """
    environment = Environment(
        loader=FileSystemLoader(str(files(__package__))),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters["times"] = _times
    template = environment.get_template(f"{kind}.yaml.j2")
    try:
        text = template.render(n=numbers, index=INDEX, radius=RADIUS, nested=kind == "operation", **values)
    except Problem as problem:  # an option that is no quantity
        raise InputError(Issue(problem.problem, value=problem.value, allowed=problem.allowed)) from None
    model = next(file_kind for file_kind in file_kinds() if file_kind.name == kind).model
    validate(model, parse_yaml(text))
    return text


def _quoted(path: str) -> str:
    """Return a path as YAML reads it back, in quotes where it needs them."""
    return path if re.fullmatch(r"[\w./][\w./ +-]*", path) else json.dumps(path, ensure_ascii=False)


def _times(quantity: str, factor: float) -> str:
    """Return a quantity times a number, in its own unit."""
    parts = split_quantity(quantity)
    if parts is None:
        raise Problem("not a quantity with its unit", quantity, "10 um, 5 arcsec")
    number, unit = parts
    return f"{factor * number:.6g} {unit}"
