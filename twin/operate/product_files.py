"""Files and numbers of an operation's products."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from twin.operate.estimated_motions import LeftOut
from twin.operate.products import PRIOR, STATE, Products
from twin.operate.record.entries import utc_text
from twin.operate.validity import SHARE
from twin.orbit.export.export_report import LINE, export_files
from twin.run.data_files import WRITER
from twin.run.quantity import Quantity, Record
from twin.run.reference_frames import described

NUMBERS = "products.json"


def _cameras(one: Products) -> dict[str, dict[str, float]]:
    """Group -> its quantities with their sigmas, in the units that their keys end in."""
    out: dict[str, dict[str, float]] = {}
    for k, quantity in enumerate(one.course.quantities):
        group = out.setdefault(quantity.group, {})
        group[quantity.key] = float(one.course.values[0, k])
        group[f"{quantity.key}_sigma"] = float(one.course.sigmas[0, k])
    return out


LEFT_OUT: Record[LeftOut] = Record(
    "A component that a file does not have.",
    Quantity("component", lambda one: one.name, "body, kind and axis"),
    Quantity("amount", lambda one: one.amount / one.unit_size, "estimated amount, of a prior its standard deviation"),
    Quantity("unit", lambda one: one.unit, "of the amount"),
    Quantity(
        "share", lambda one: one.share, "largest of the variance of a spot or a parameter, of a prior", where_known=True
    ),
)
STATE_FILE: Record[Products] = Record(
    "The job of the estimated state.",
    Quantity("file", lambda one: f"{STATE}.yaml", "for python -m twin.render"),
    Quantity("left_out", lambda one: list(one.state_left_out), "motions that a job cannot say", record=LEFT_OUT),
)
PRIOR_FILE: Record[Products] = Record(
    "What is uncertain of that state.",
    Quantity("file", lambda one: f"{PRIOR}.yaml", "for disturbances of a job or of python -m twin.asbuilt"),
    Quantity("components", lambda one: len(one.prior.components), "that it has"),
    Quantity("left_out", lambda one: list(one.prior.left_out), "that it does not have", record=LEFT_OUT),
)
PRODUCTS: Record[Products] = Record(
    "products.json. What an operation's estimate says for one time.",
    Quantity("record", lambda one: one.history.url, "of the instrument"),
    Quantity("instrument", lambda one: one.history.name, "of the record"),
    Quantity("instrument_sha256", lambda one: one.history.sha256, "by which it is recognised"),
    Quantity("time_utc", lambda one: utc_text(one.time), "of the estimate"),
    Quantity(
        "scene_utc",
        lambda one: None if one.scene_time is None else utc_text(one.scene_time),
        "when the scene was taken, where there is one",
        where_known=True,
    ),
    Quantity("valid_from_utc", lambda one: utc_text(one.validity.since), "from when on it holds"),
    Quantity("valid_until_utc", lambda one: utc_text(one.validity.until), "until when it holds"),
    Quantity("valid_from_reason", lambda one: one.validity.since_reason, "why not before"),
    Quantity("valid_until_reason", lambda one: one.validity.until_reason, "why not after"),
    Quantity("valid_within_percent", lambda one: SHARE, "by which errors may be larger than at the time itself"),
    Quantity("version", lambda one: one.version, "SHA-256 of the record's last entry, the plan and the program"),
    Quantity("program", lambda one: f"{WRITER} {importlib.metadata.version(WRITER)}", "that wrote it"),
    Quantity("readings", lambda one: one.readings, "of the monitor that the estimate rests on"),
    Quantity("newest_utc", lambda one: utc_text(one.newest), "time of the newest of them"),
    Quantity("estimate", _cameras, "every quantity of every camera and of both together, with its sigma"),
    Quantity(
        "changes",
        lambda one: {name: np.asarray(change.values) for name, change in one.changes.items()},
        "camera -> d_alpha, d_beta, d_gamma in rad and d_f in m that its models have been corrected by",
        converted=False,
    ),
    Quantity("cameras", lambda one: list(one.changes), "in the order of the covariance"),
    Quantity(
        "covariance",
        lambda one: one.course.covariance[0],
        "of the changes of one camera after the other, rad and m",
        converted=False,
    ),
    Quantity(
        "models",
        lambda one: None if one.export is None else one.export.lines,
        "camera -> its models of the scene",
        record=LINE,
        where_known=True,
    ),
    Quantity("state", STATE_FILE, "the estimated state as a job"),
    Quantity("prior", PRIOR_FILE, "what is uncertain of it"),
    Quantity("warnings", lambda one: list(one.warnings), "in words"),
)


def product_files(one: Products) -> tuple[dict[str, bytes], dict[str, Any]]:
    """Path in the folder -> contents, and the numbers of `NUMBERS`, which tells the checksums of all others.

    Args:
        one: all products of a time.
    """
    files: dict[str, bytes] = {} if one.export is None else export_files(one.export)
    files[f"{STATE}.yaml"] = one.state.encode()
    files |= {name: text.encode() for name, text in one.prior.files.items()}
    digests: Mapping[str, str] = {name: hashlib.sha256(content).hexdigest() for name, content in files.items()}
    numbers = {**described("products", PRODUCTS(one)), "sha256": dict(digests)}
    files[NUMBERS] = (json.dumps(numbers, indent=1, allow_nan=False) + "\n").encode()
    return files, numbers


def summary(one: Products) -> str:
    """What there is, for the terminal."""
    lines = [
        f"{one.history.name} at {utc_text(one.time)}, from {one.readings} readings up to {utc_text(one.newest)}",
        f"holds from {utc_text(one.validity.since)}: {one.validity.since_reason}",
        f"holds until {utc_text(one.validity.until)}: {one.validity.until_reason}",
    ]
    for name, line in (one.export.lines if one.export is not None else {}).items():
        if line.ground is not None:
            text = f"{name}: wrong on the ground by {line.ground.bias_m:.2f} m (ERR_BIAS)"
            lines.append(
                f"{text} and by {line.ground.random_m:.2f} m otherwise in every image (ERR_RAND), without the orbit"
            )
    return "\n".join([*lines, *(f"warning: {text}" for text in one.warnings)])
