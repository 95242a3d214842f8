"""Glasses of AGF catalogues, as makers publish them, and those of the twin, by the names that prescriptions use.

Indices are against air of 20 C and 1013 hPa, as prescriptions on the ground take them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from optics.materials.glass import FORMULAS, GLASSES, CatalogueGlass, common_glasses
from optics.numerics.number_tree import FrozenMap
from scenes.lens.statements import Glasses, Source, glass_key, is_number, read_lines, statement_of

_CONSTANTS = 6
"""Numbers of Schott's formula of dn/dT on a TD line; the seventh is the temperature of reference, 20 C."""


def own_glasses() -> Glasses:
    """Return the twin's glasses and the common ones; fused silica also by the names that catalogues have for it."""
    own: dict[str, Callable[[float], float]] = {glass_key(name): glass for name, glass in common_glasses().items()}
    own |= {glass_key(name): glass.index for name, glass in GLASSES.items()}
    own |= dict.fromkeys(("SILICA", "FSILICA"), own[glass_key("fused silica")])
    own["BK7"] = own[glass_key("N-BK7")]  # before arsenic was left out of it; the catalogue has one formula for both
    return FrozenMap(own)


def read_catalogues(paths: Sequence[str | Path]) -> Glasses:
    """The twin's glasses and those of AGF files; of one name the first file's counts, before the twin's own.

    Args:
        paths: of the files.

    Raises:
        InputError: a file cannot be read or is damaged.
    """
    out = dict(own_glasses())
    for path in reversed(paths):
        out.update({glass_key(glass.name): glass for glass in read_catalogue(path)})
    return FrozenMap(out)


def read_catalogue(path: str | Path) -> tuple[CatalogueGlass, ...]:
    """The glasses of an AGF file.

    Raises:
        InputError: it cannot be read, or says of a glass what cannot be; with the line.
    """
    source = Source(str(path))
    glasses: list[CatalogueGlass] = []
    name, formula, begun = "", 0, 0
    coefficients: tuple[float, ...] = ()
    expansion: float | None = None
    thermal: tuple[float, ...] | None = None
    for number, text in enumerate(read_lines(source, "a glass catalogue"), start=1):
        if (s := statement_of(number, text)) is None:
            continue
        match s.command:
            case "NM":
                if name:
                    raise source.error(f"{name} has no wavelengths (LD)", begun)
                name, begun, coefficients = (s.words[0] if s.words else ""), number, ()
                expansion = thermal = None
                formula = source.whole(s, 1, "the dispersion formula", 0, 1000)
                if formula not in FORMULAS:
                    known = ", ".join(f"{k} {title}" for k, (title, _) in FORMULAS.items())
                    raise source.error("an unknown dispersion formula", number, formula, known)
            case "CD" if name:
                given = source.numbers(s, "a coefficient")
                coefficients = tuple([*given, *[0.0] * 12][: max(12, len(given))])
            case "ED" if name and s.words and is_number(s.words[0]):
                # a zero stands for what the maker does not say
                expansion = 1e-6 * source.finite(s, 0, "the expansion") or None
            case "TD" if name and len(s.words) >= _CONSTANTS and all(is_number(word) for word in s.words):
                constants = source.numbers(s, "a constant of dn/dT")[:_CONSTANTS]
                thermal = constants if any(constants) else None
            case "LD" if name:
                if not coefficients:
                    raise source.error(f"{name} has no coefficients (CD)", begun)
                first, last = (source.finite(s, k, "the range") * 1e-6 for k in (0, 1))
                if first > last:
                    raise source.error("a range of wavelengths that is reversed", number, s.text, "the shortest first")
                glasses.append(CatalogueGlass(name, formula, coefficients, first, last, expansion, thermal))
                name = ""
            case _:
                pass
    if name:
        raise source.error(f"{name} has no wavelengths (LD): the file is cut off", begun)
    if not glasses:
        raise source.error("no glass in this file", 1, allowed="an AGF catalogue: NM, CD and LD lines")
    return tuple(glasses)
