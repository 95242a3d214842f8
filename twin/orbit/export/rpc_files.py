"""Rational polynomials of other people's files: RPC00B as text beside an image or inside a GeoTIFF, and the RPC files
of DIMAP 2 and 3.

DIMAP's model from the ground to the image is read. Version 2 counts lines and samples from 1, which becomes 0 here;
version 3 counts them from 0, as a scene of Pléiades Neo shows, whose RPC file has the first pixel at 0.0005, -0.0006.
"""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import numpy as np

from scenes.yaml.errors import InputError, Issue, names_text, nearest, shown
from scenes.yaml.input_file import why_unreadable
from twin.orbit.export.rational_polynomial import TERMS, RationalPolynomial
from twin.orbit.measured.text_file import first_lines, numbers, text_lines
from twin.orbit.measured.xml_file import Element, read_xml

_AXES = ("LINE", "SAMP", "LAT", "LONG", "HEIGHT")
_PARTS = ("LINE_NUM", "LINE_DEN", "SAMP_NUM", "SAMP_DEN")
_WHAT = "rational polynomials: NAME_RPC.TXT, a GeoTIFF with them, or RPC_NAME.XML of DIMAP"
_GROUND_MODELS = {"2": "Inverse_Model", "3": "GroundtoImage_Values"}
_FIRST_PIXEL = {"2": 1.0, "3": 0.0}
_TIFF = (".tif", ".tiff")
_ROW = re.compile(r"\s*([A-Z_0-9]+)\s*[:=]\s*(\S+)\s*(?:[A-Za-z]+\s*)?$")
_LEAST_SCALE = 1e-9


def read_rpc(path: str | Path) -> RationalPolynomial:
    """The polynomials of a file; its contents or ending decide on the format.

    Args:
        path: of it.

    Raises:
        InputError: it cannot be read, or is not whole; with file, line and key.
    """
    if Path(path).suffix.lower() in _TIFF:
        return _from_tiff(Path(path))
    if any(line.lstrip("\ufeff \t").startswith("<") for line in first_lines(path, _WHAT, 1)):
        return _from_dimap(read_xml(path, _WHAT))
    return _from_text(Path(path))


def is_rpc(path: Path) -> bool:
    """Whether a file holds rational polynomials alone: NAME_RPC.TXT, a GeoTIFF, or the RPC file of DIMAP.

    Raises:
        InputError: it is XML that cannot be read.
    """
    match path.suffix.lower():
        case ".tif" | ".tiff" | ".txt":
            return True
        case ".xml":
            return bool(read_xml(path, _WHAT).all("Rational_Function_Model"))
    return False


def _made(
    file: str, offset: list[float], scale: list[float], parts: list[np.ndarray], errors: list[float | None]
) -> RationalPolynomial:
    small = [name for name, value in zip(_AXES, scale, strict=True) if not value > _LEAST_SCALE]
    if small:
        raise InputError(Issue("a scale that is not above zero", file, None, (f"{small[0]}_SCALE",)))
    if not (-90.0 <= offset[2] <= 90.0 and -180.0 <= offset[3] <= 360.0):
        found = f"{offset[2]:g}, {offset[3]:g}"
        raise InputError(Issue("no latitude and longitude, degrees", file, None, ("LAT_OFF", "LONG_OFF"), found))
    for name, part in zip(_PARTS, parts, strict=True):
        if name.endswith("DEN") and not np.any(part):
            raise InputError(Issue("a denominator of zeros", file, None, (f"{name}_COEFF",)))
    stated = [None if one is None or one < 0.0 else one for one in errors]  # -1 where nobody states one
    line, below, sample, under = parts
    return RationalPolynomial(
        np.array(offset), np.array(scale), line, below, sample, under, bias_m=stated[0], random_m=stated[1]
    )


def _from_text(path: Path) -> RationalPolynomial:
    file, found = str(path), {}
    for k, line in enumerate(text_lines(path, _WHAT)):
        if not line.strip():
            continue
        match = _ROW.match(line)
        if match is None:
            raise InputError(Issue("not NAME: value", file, k + 1, (), shown(line), "LINE_OFF: 5120.5 pixels"))
        name, text = match.groups()
        if name in found:
            raise InputError(Issue("a key that stands twice", file, k + 1, (name,)))
        found[name] = float(numbers(file, [[text]], [k + 1], [name])[0, 0])
    names = [f"{axis}_{what}" for what in ("OFF", "SCALE") for axis in _AXES]
    names += [f"{part}_COEFF_{k + 1}" for part in _PARTS for k in range(TERMS)]
    for name in names:
        if name not in found:
            raise InputError(Issue(f"no {name}", file, None, (name,), None, _WHAT, nearest(name, found)))
    values = [found[name] for name in names]
    parts = [np.array(values[10 + TERMS * k : 10 + TERMS * (k + 1)]) for k in range(4)]
    return _made(file, values[:5], values[5:10], parts, [found.get("ERR_BIAS"), found.get("ERR_RAND")])


def _from_dimap(root: Element) -> RationalPolynomial:
    if root.tag != "Dimap_Document":
        root.wrong("not a DIMAP file", f"<{root.tag}>", "<Dimap_Document>")
    form = root.one("Metadata_Identification", "METADATA_FORMAT")
    version = form.attributes.get("version", "").partition(".")[0]
    if version not in _GROUND_MODELS:
        form.wrong("not this format", shown(form.attributes.get("version")), "DIMAP of version 2 or 3")
    model = root.one("Rational_Function_Model", "Global_RFM")
    values, validity = model.one(_GROUND_MODELS[version]), model.one("RFM_Validity")
    offset, scale = ([validity.number(f"{axis}_{what}") for axis in _AXES] for what in ("OFF", "SCALE"))
    offset[0] -= _FIRST_PIXEL[version]
    offset[1] -= _FIRST_PIXEL[version]
    parts = [np.array([values.number(f"{part}_COEFF_{k + 1}") for k in range(TERMS)]) for part in _PARTS]
    return _made(root.file, offset, scale, parts, [None, None])


def _from_tiff(path: Path) -> RationalPolynomial:
    import rasterio
    from rasterio.errors import NotGeoreferencedWarning

    file = str(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            with rasterio.open(path, driver="GTiff") as image:
                rpc = image.rpcs
    # the library's errors are many
    except Exception as error:
        raise InputError(Issue(f"cannot be read: {why_unreadable(error)}", file, allowed=_WHAT)) from None
    if rpc is None:
        raise InputError(Issue("a TIFF without rational polynomials", file, allowed=names_text(["RPCCoefficientTag"])))
    offset = [rpc.line_off, rpc.samp_off, rpc.lat_off, rpc.long_off, rpc.height_off]
    scale = [rpc.line_scale, rpc.samp_scale, rpc.lat_scale, rpc.long_scale, rpc.height_scale]
    parts = [rpc.line_num_coeff, rpc.line_den_coeff, rpc.samp_num_coeff, rpc.samp_den_coeff]
    return _made(file, offset, scale, [np.array(part, np.float64) for part in parts], [rpc.err_bias, rpc.err_rand])
