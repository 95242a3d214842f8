"""A prescription as a YAML file of batoid.

There light comes down from +z; here it enters toward +z. Everything is turned about x by half a turn.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from optics.geometry.aperture import Circle, Edge, Ellipse, Polygon, Ray, Rectangle
from optics.geometry.pose import Pose
from optics.geometry.surface import Surface, ZernikeFigure
from optics.raytrace.assembly import Interaction
from scenes.lens import prescription
from scenes.lens.camera_writer import rounded
from scenes.yaml.yaml_file import dump_yaml


def batoid_text(lens: prescription.Prescription) -> tuple[str, tuple[prescription.Note, ...]]:
    """The file's text, and what of the prescription is not in it.

    Raises:
        InputError: a surface that batoid does not know.
    """
    notes: list[prescription.Note] = []
    items: list[dict[str, Any]] = []
    index = 1.0
    for k, surface in enumerate(lens.surfaces):
        try:
            over = prescription.turned_over(surface)
        except TypeError as error:
            problem = f"batoid's file cannot carry this: {error}"
            raise lens.error(problem, surface.line, surface.name, "polynomials and Zernike terms") from None
        pose = rounded(prescription.OVER @ over.pose)
        last = k == len(lens.surfaces) - 1
        kind = {Interaction.REFLECT: "Mirror", Interaction.REFRACT: "RefractiveInterface"}.get(surface.interaction)
        item: dict[str, Any] = {"type": "Detector" if last else kind or "Interface", "name": surface.name}
        item["surface"] = _surface(lens, over)
        place = _place(pose)
        if place:
            item["coordSys"] = place
        item["inMedium"] = index
        if surface.interaction is Interaction.REFRACT:
            index = surface.index
        item["outMedium"] = index
        cuts = over.every_edge
        if item["type"] == "Interface" and cuts and k != lens.stop:
            item["type"] = "Baffle"
        parts = [part for edge in cuts if (part := _obscuration(edge)) is not None]
        if parts and item["type"] != "Interface":
            item["obscuration"] = parts[0] if len(parts) == 1 else {"type": "ObscUnion", "items": parts}
        if len(parts) < len(cuts) or (cuts and item["type"] == "Interface"):
            notes.append(prescription.Note(0, surface.name, "its aperture is not carried"))
        if item["type"] == "Interface":
            item.pop("inMedium"), item.pop("outMedium")
        items.append(item)
    system = {"type": "CompoundOptic", "name": lens.name, "inMedium": 1.0, "items": items}
    remarks = [
        f"# {lens.name} at {lens.wavelength * 1e9:.6g} nm, written by python -m scenes.lens write. Metres, radians.",
        "# Light comes down from +z: batoid's x is the prescription's, y and z are turned about it by half a turn.",
        *(f"# {note}" for note in (*lens.notes, *notes)),
    ]
    return "\n".join(remarks) + "\n" + dump_yaml({"opticalSystem": system}), tuple(notes)


def _place(pose: Pose) -> dict[str, float]:
    """A coordinate system as shifts, then turns about x, y and z, each about the axes that the one before has made."""
    out = {name: float(v) for name, v in zip("xyz", pose.translation, strict=True) if v}
    r = pose.rotation
    if not np.array_equal(r, np.eye(3)):
        turns = {
            "rotX": math.atan2(-r[1, 2], r[2, 2]),
            "rotY": math.atan2(r[0, 2], math.hypot(r[0, 0], r[0, 1])),
            "rotZ": math.atan2(-r[0, 1], r[0, 0]),
        }
        out.update({name: turn for name, turn in turns.items() if turn})
    return out


def _surface(lens: prescription.Prescription, given: prescription.LensSurface) -> dict[str, Any]:
    shape = given.surface
    freeform = prescription.polynomial_of(Surface(terms=shape.terms)) if shape.terms else {}
    radius = 0.0
    figure = shape.figure
    if isinstance(figure, ZernikeFigure) and any(figure.terms.values()):
        radius = figure.radius
        if any(figure.centre) or freeform:
            radius += math.hypot(*figure.centre)
            for pair, value in prescription.about_vertex(figure).items():
                freeform[pair] = freeform.get(pair, 0.0) + value
    base: dict[str, Any] = {"type": "Plane"}
    if shape.curvature:
        base = {"type": "Quadric", "R": 1.0 / shape.curvature, "conic": shape.conic}
        if any(shape.even):
            base = {**base, "type": "Asphere", "coefs": [float(a) for a in shape.even]}
        elif shape.conic == -1.0:
            # where a ray runs along the axis of a Quadric with this conic, batoid divides by zero
            base = {"type": "Paraboloid", "R": 1.0 / shape.curvature}
    elif any(shape.even):
        for pair, value in prescription.polynomial_of(Surface(even=shape.even)).items():
            freeform[pair] = freeform.get(pair, 0.0) + value
    terms: dict[int, float] = {}
    if freeform:
        radius = radius or (0.5 * float(np.ptp(given.aperture.bounds[:2])) if given.aperture else 0.1)
        if max(a + b for a, b in freeform) > prescription.LARGEST_ORDER:
            raise lens.error("batoid's file cannot carry a polynomial of so high an order", given.line, given.name)
        terms = prescription.zernike_of({(a, b): c * radius ** (a + b) for (a, b), c in freeform.items()})
    elif isinstance(figure, ZernikeFigure):
        terms = {j: a for j, a in figure.terms.items() if a}
    if not terms:
        return base
    listed = [float(terms.get(j, 0.0)) for j in range(max(terms) + 1)]
    return {"type": "Sum", "items": [base, {"type": "Zernike", "coef": listed, "R_outer": radius, "R_inner": 0.0}]}


def _obscuration(edge: Edge) -> dict[str, Any] | None:
    """What cuts the light; None for what batoid does not know."""
    way, shape = "Obsc" if edge.blocks else "Clear", edge.shape
    x, y = shape.centre
    turn = {"theta": edge.turn} if edge.turn else {}
    match shape:
        case Circle(radius, _, inner):
            if inner:
                return {"type": f"{way}Annulus", "inner": inner, "outer": radius, "x": x, "y": y}
            return {"type": f"{way}Circle", "radius": radius, "x": x, "y": y}
        case Rectangle(half_x, half_y):
            return {"type": f"{way}Rectangle", "width": 2.0 * half_x, "height": 2.0 * half_y, "x": x, "y": y, **turn}
        case Ray(width):
            return {"type": f"{way}Ray", "width": width, "x": x, "y": y, **turn}
        case Polygon(corners):
            xs, ys = ([float(value) for value in axis] for axis in zip(*corners, strict=True))
            return {"type": f"{way}Polygon", "xs": xs, "ys": ys}
        case Ellipse():
            return None
