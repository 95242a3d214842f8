"""Files of measured data of others: where each is published, and rows that need some of them.

The data are no part of the project. ``printed.yaml`` lists their files with the repository that publishes each and its
checksum; a row whose files are absent is skipped, and one whose files are others than the published ones says so.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path

from twin.validation.check import CheckResult
from twin.validation.group import Context, load_printed
from twin.validation.row_names import REAL, matches


def published() -> dict[str, tuple[str, str]]:
    """Return the SHA-256 checksum and the place of publication of each file, by its path in the data's folder."""
    printed = load_printed(REAL)
    data = printed.content.data["files"]
    return {path: (entry["sha256"], entry["published"]) for path, entry in data.items()}


def notes(folder: Path, paths: Iterable[Path]) -> str:
    """Return sentences about files that differ from the published ones; empty if none does.

    Parameters
    ----------
    folder : Path
        Folder of the measured data.
    paths : iterable of Path
        Files that a row uses.
    """
    known, out = published(), []
    for path in paths:
        name = path.relative_to(folder).as_posix()
        checksum = hashlib.sha256(path.read_bytes()).hexdigest()
        if name not in known:
            out.append(f"{name} is none of the published files that the printed values are of.")
        elif checksum != known[name][0]:
            out.append(f"{name} is another file than the published one: its SHA-256 begins with {checksum[:12]}.")
    return " ".join(out)


def on_files(
    context: Context, prefix: str, pattern: str, rows: Callable[[Context, list[Path]], Iterator[CheckResult]]
) -> Iterator[CheckResult]:
    """Yield the results of the rows under a prefix, or skip them where their files are absent.

    Parameters
    ----------
    context : Context
        Context of the group.
    prefix : str
        Common prefix of the rows' ids.
    pattern : str
        Pattern of the files' paths in the data's folder.
    rows : callable
        Function of context and sorted files that yields the results.
    """
    if not context.wants(prefix):
        return
    paths = sorted(context.real.glob(pattern))
    if not paths:
        why = f"no {pattern} in {context.real}; --real or TWIN_REAL names the folder, docs/real_data.md its content"
        yield from (context.check(name).skipped(why) for name in sorted(context.selected) if matches(name, prefix))
        return
    note = notes(context.real, paths)
    for result in rows(context, paths):
        yield replace(result, how=f"{note} {result.how}" if note else result.how)
