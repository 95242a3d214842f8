"""Spoils files at random, by what they are: bytes of any file; words, numbers and lines of a text; the tree of YAML and
JSON and whatever looks like a path in it; cells, rows and columns of a table; what an image or data set holds and says.

changed = mutate("job.yaml", content, random.Random(7))
changed.content     # bytes of the spoilt file
changed.how         # what was done
"""

from __future__ import annotations

import json
import random
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath

from scenes.yaml.yaml_file import dump_yaml, parse_yaml
from tests.robustness.mutate_data import DATA_SETS, IMAGES
from tests.robustness.mutate_table import TABLES
from tests.robustness.mutate_tree import TREES, YAMLS, paths
from tests.robustness.nasty import LINE_ENDS, MARKS, NUMBERS, TEXTS, UNITS, WORDS

Mutator = Callable[[bytes, random.Random], bytes]


@dataclass(frozen=True)
class Mutant:
    """A spoilt file.

    Attributes:
        content: its bytes.
        how: which mutators made it.
    """

    content: bytes
    how: str


_NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d*)?(?:e[-+]?\d+)?(?![\w.])")
_UNIT = re.compile(r"(?<=\d) [A-Za-z%]+(?:/[A-Za-z]+(?:\^\d)?)?")
_WORD = re.compile(r"[A-Za-z_]\w+")


def form_of(name: str) -> str:
    """What a file is to the mutators: "yaml", "json", "table", "image", "data", "binary" or "text"; by its ending."""
    return _FORMS.get(PurePosixPath(name).suffix.lower(), "text")


_FORMS = {
    **dict.fromkeys((".yaml", ".yml"), "yaml"),
    **dict.fromkeys((".json", ".geojson"), "json"),
    ".csv": "table",
    **dict.fromkeys((".tif", ".tiff", ".fits", ".png", ".jpg"), "image"),
    ".nc": "data",
    **dict.fromkeys((".npz", ".gtx", ".parquet"), "binary"),
}


def mutate(name: str, content: bytes, chance: random.Random) -> Mutant:
    """A file spoilt in one way, or in two or three at once.

    Args:
        name: of the file, whose ending says what it is.
        content: of the file as it is.
        chance: what is done; the same state gives the same mutant.
    """
    form = form_of(name)
    kinds = KINDS[form]
    kind = chance.choices(list(kinds), [weight for weight, _ in kinds.values()])[0]
    table, how = kinds[kind][1], []
    for _ in range(chance.choice((1, 1, 1, 2, 3))):
        mutator = chance.choice(table)
        try:
            content = mutator(content, chance)
        except Exception:  # nothing left to change, or no longer what it was, which libraries tell in many ways
            continue
        how.append(mutator.__name__)
    return Mutant(content, f"{kind}: " + ", ".join(how))


# --- bytes


def _span(content: bytes, chance: random.Random, longest: int = 60) -> tuple[int, int]:
    first = chance.randrange(len(content) + 1)
    return first, min(len(content), first + chance.randint(1, longest))


def flip(content: bytes, chance: random.Random) -> bytes:
    out = bytearray(content)
    for _ in range(chance.choice((1, 2, 5, 20))):
        if out:
            out[chance.randrange(len(out))] ^= 1 << chance.randrange(8)
    return bytes(out)


def insert(content: bytes, chance: random.Random) -> bytes:
    at, _ = _span(content, chance)
    sort = chance.randrange(4)
    if sort == 0:
        extra = chance.randbytes(chance.randint(1, 40))
    elif sort == 1:
        extra = chance.choice(MARKS)
    elif sort == 2:
        extra = bytes(chance.choices(b"{}[],:#&*!|>'\"%@`-?\n \\", k=chance.randint(1, 6)))
    else:
        extra = chance.choice(("\ufeff", "\u2028", "\x85", "\u200b", "\u00a0", "\u202e", "😀")).encode()
    return content[:at] + extra + content[at:]


def delete(content: bytes, chance: random.Random) -> bytes:
    first, last = _span(content, chance)
    return content[:first] + content[last:]


def repeat(content: bytes, chance: random.Random) -> bytes:
    first, last = _span(content, chance, 200)
    return content[:last] + content[first:last] * chance.choice((1, 2, 50)) + content[last:]


def truncate(content: bytes, chance: random.Random) -> bytes:
    return content[: chance.randrange(len(content) + 1)]


def swap(content: bytes, chance: random.Random) -> bytes:
    a, b = sorted(_span(content, chance))
    c, d = sorted(_span(content, chance))
    if b > c:
        return content
    return content[:a] + content[c:d] + content[b:c] + content[a:b] + content[d:]


def binary(content: bytes, chance: random.Random) -> bytes:
    return chance.choice(
        (chance.randbytes(500), b"\x7fELF\x02\x01\x01" + bytes(200), b"\x89PNG\r\n\x1a\n" + bytes(50), bytes(1000))
    )


def recode(content: bytes, chance: random.Random) -> bytes:
    text = content.decode("utf-8", "replace")
    return text.encode(chance.choice(("utf-16", "utf-16-le", "utf-32", "utf-7", "cp037", "utf-8-sig")), "replace")


def line_ends(content: bytes, chance: random.Random) -> bytes:
    return content.replace(b"\n", chance.choice(LINE_ENDS))


def huge(content: bytes, chance: random.Random) -> bytes:
    """Around the reader's limit of a megabyte."""
    sort = chance.randrange(4)
    room = max(0, chance.choice((200_000, 999_999, 1_000_001)) - len(content))
    if sort == 0:
        return content + b"\n#" + b"x" * room
    if sort == 1:
        return chance.choice((b"[", b"{", b"{a: ", b"- ", b"? ", b"'", b"\n")) * 50_000
    if sort == 2:
        return content + b"\nlong: '" + b"x" * room + b"'\n"
    return b"x" * min(room, 300_000) + b": 1\n" + content


BYTES: tuple[Mutator, ...] = (
    *(flip, flip, insert, insert, delete, delete, repeat, truncate, swap, binary, recode, line_ends, huge),
)


# --- tokens


def _replaced(text: str, pattern: re.Pattern[str], chance: random.Random, new: Callable[[str], str]) -> str:
    found = list(pattern.finditer(text))
    one = found[chance.randrange(len(found))]
    return text[: one.start()] + new(one[0]) + text[one.end() :]


def number(text: str, chance: random.Random) -> str:
    return _replaced(text, _NUMBER, chance, lambda old: chance.choice(NUMBERS))


def scale(text: str, chance: random.Random) -> str:
    factor = chance.choice((-1.0, 0.0, 1e-300, 1e-12, 1e-6, 1e-3, 0.1, 0.9, 1.1, 3.0, 10.0, 1e3, 1e6, 1e12, 1e300))

    def scaled(old: str) -> str:
        value = float(old) * factor
        return str(int(value)) if re.fullmatch(r"[-+]?\d+", old) and abs(value) < 1e15 else repr(value)

    return _replaced(text, _NUMBER, chance, scaled)


def unit(text: str, chance: random.Random) -> str:
    return _replaced(text, _UNIT, chance, lambda old: " " + chance.choice(UNITS))


def no_unit(text: str, chance: random.Random) -> str:
    return _replaced(text, _UNIT, chance, lambda old: "")


def word(text: str, chance: random.Random) -> str:
    return _replaced(
        text, _WORD, chance, lambda old: chance.choice((*TEXTS, old.upper(), old[::-1], old + "x", old[:-1]))
    )


def words(text: str, chance: random.Random) -> str:
    """Two words change places."""
    found = list(_WORD.finditer(text))
    a, b = sorted(chance.sample(range(len(found)), 2))
    first, second = found[a], found[b]
    middle = text[first.end() : second.start()]
    return text[: first.start()] + second[0] + middle + first[0] + text[second.end() :]


def indent(text: str, chance: random.Random) -> str:
    lines = text.split("\n")
    k = chance.randrange(len(lines))
    lines[k] = chance.choice((" ", "   ", "\t", "- ", "? ", "'", "> ", "| ")) + lines[k].lstrip(
        chance.choice((" ", ""))
    )
    return "\n".join(lines)


TOKENS: tuple[Callable[[str, random.Random], str], ...] = (
    *(number, number, scale, scale, scale, unit, unit, no_unit, word, words, indent),
)


def lines(text: str, chance: random.Random) -> str:
    """Lines are lost, doubled, exchanged for others, or for something else."""
    found = text.split("\n")
    for _ in range(chance.randint(1, 4)):
        at = chance.randrange(len(found))
        found[at : at + 1] = chance.choice(([], [found[at]] * 2, [chance.choice(found)], [chance.choice(WORDS)]))
        found = found or [""]
    return "\n".join(found)


def nasty_words(text: str, chance: random.Random) -> str:
    found = text.split(" ")
    for _ in range(chance.randint(1, 4)):
        found[chance.randrange(len(found))] = chance.choice(WORDS)
    return " ".join(found)


def _of_text(mutators: Sequence[Callable[[str, random.Random], str]]) -> tuple[Mutator, ...]:
    """Mutators of text as mutators of a file, which keeps its encoding."""
    return tuple(_on_bytes(one) for one in mutators)


def _on_bytes(one: Callable[[str, random.Random], str]) -> Mutator:
    def changed(content: bytes, chance: random.Random) -> bytes:
        wide = (
            "utf-16" if content.startswith((b"\xff\xfe", b"\xfe\xff")) else "utf-16-le" if b"\0" in content else "utf-8"
        )
        return one(content.decode(wide), chance).encode(wide, "surrogatepass")

    changed.__name__ = one.__name__
    return changed


def _on_json(one: Callable[[str, random.Random], str]) -> Mutator:
    """A mutator of a YAML tree as one of JSON, which Python reads with NaN and infinities."""

    def changed(content: bytes, chance: random.Random) -> bytes:
        tree = json.loads(content.decode())
        return json.dumps(parse_yaml(one(dump_yaml(tree), chance)).data, indent=2).encode("utf-8", "surrogatepass")

    changed.__name__ = one.__name__
    return changed


_TOKENS = _of_text(TOKENS)
KINDS: Mapping[str, Mapping[str, tuple[int, tuple[Mutator, ...]]]] = {
    "yaml": {
        "byte": (14, BYTES),
        "token": (26, _TOKENS),
        "tree": (40, _of_text(TREES)),
        "path": (10, _of_text((paths,))),
        "yaml": (10, _of_text(YAMLS)),
    },
    "json": {
        "byte": (20, BYTES),
        "token": (20, _TOKENS),
        "tree": (50, tuple(map(_on_json, TREES))),
        "path": (10, (_on_json(paths),)),
    },
    "table": {"byte": (20, BYTES), "token": (15, _TOKENS), "line": (10, _of_text((lines,))), "table": (55, TABLES)},
    "text": {"byte": (25, BYTES), "token": (40, _TOKENS), "line": (35, _of_text((lines, nasty_words)))},
    "image": {"byte": (40, BYTES), "image": (60, IMAGES)},
    "data": {"byte": (40, BYTES), "data": (60, DATA_SETS)},
    "binary": {"byte": (1, BYTES)},
}
"""Form of a file -> kind of change -> its weight and mutators."""
