"""Software bill of materials in CycloneDX: every locked package, its checksums, licence and dependents."""

from __future__ import annotations

import json
import tomllib
import uuid
from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path

from cyclonedx.contrib.license.factories import LicenseFactory
from cyclonedx.model import HashAlgorithm, HashType, Property
from cyclonedx.model.bom import Bom
from cyclonedx.model.component import Component, ComponentType
from cyclonedx.output.json import JsonV1Dot6
from cyclonedx.schema import SchemaVersion
from cyclonedx.validation.json import JsonStrictValidator
from packageurl import PackageURL

from docs.supply.licences import Carried, read_carried, read_table, unique
from docs.supply.lock_file import FOLDER, LAYERS, read_lock
from docs.supply.make_lock import ROOT, SupplyError

EPOCH = datetime(1980, 1, 1, tzinfo=UTC)
"""Time stamp of every bill, so that the same lock gives the same bytes. The history of the lock gives the real date."""


def bill(layers: Iterable[str] = LAYERS, folder: Path = FOLDER) -> str:
    """Return the bill as JSON, valid against the schema of CycloneDX 1.6.

    Parameters
    ----------
    layers : iterable of str
        Files of the lock.
    folder : Path
        Folder of the lock.

    Raises
    ------
    SupplyError
        A package is missing from the licences, or the bill is not valid.
    LockError
        A lock file cannot be read.
    """
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    licences = {(row.package, row.version): row for row in read_table()}
    factory = LicenseFactory()
    root = Component(
        name=project["name"],
        version=project["version"],
        type=ComponentType.APPLICATION,
        bom_ref=project["name"],
        description=project["description"],
        licenses=[factory.make_from_string(project["license"])],
    )
    out = Bom(serial_number=uuid.uuid5(uuid.NAMESPACE_URL, project["name"]), version=1)
    out.metadata.component, out.metadata.timestamp = root, EPOCH
    packages = unique(read_lock(folder, layers))
    made: dict[str, list[Component]] = {root.name: [root]}
    for p in packages:
        row = licences.get((p.name, p.version))
        if row is None:
            raise SupplyError(f"no licence of {p.name} {p.version}: python -m docs.supply licences")
        address = PackageURL("pypi", None, p.name, p.version)
        part = Component(
            name=p.name,
            version=p.version,
            type=ComponentType.LIBRARY,
            bom_ref=str(address),
            purl=address,
            hashes=[HashType(alg=HashAlgorithm.SHA_256, content=digest) for digest in p.hashes],
            licenses=[factory.make_from_string(row.licence)],
            properties=[Property(name="layer", value=p.layer), Property(name="marker", value=p.marker or "all")],
            components=[_carried(inner, address) for inner in read_carried() if inner.package == p.name],
        )
        made.setdefault(p.name, []).append(part)
        out.components.add(part)
    needs: dict[str, set[str]] = {name: set() for name in made}
    for p in packages:
        for asker in p.asked_by or (root.name,):
            needs.setdefault(asker, set()).add(p.name)
    for name, parts in made.items():
        for part in parts:
            out.register_dependency(part, [other for needed in needs[name] for other in made[needed]])
    text = JsonV1Dot6(out).output_as_string(indent=2)
    wrong = JsonStrictValidator(SchemaVersion.V1_6).validate_str(text)
    if wrong is not None:
        raise SupplyError(f"the bill is not valid: {wrong}")
    return json.dumps(json.loads(text), indent=1, sort_keys=True) + "\n"


def _carried(inner: Carried, package: PackageURL) -> Component:
    """Return the component of a library within the files of a package."""
    licence = LicenseFactory().make_from_string(inner.licence)
    return Component(name=inner.library, bom_ref=f"{package}#{inner.library}", licenses=[licence])
