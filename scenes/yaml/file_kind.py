"""A kind of file that a user writes: its model, how it is told from others, and the command that reads it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from scenes.yaml.named import Named

if TYPE_CHECKING:
    from scenes.yaml.spec import Spec


@dataclass(frozen=True)
class FileKind:
    """A kind of file.

    Attributes:
        name: of its JSON Schema.
        described: model of what it may say, as `Named` takes its name.
        what: it is, with article, for messages.
        command: that reads it, as the user calls it; empty for what only other files name.
        place: where other files name it; empty for what only a command reads.
        one_of: keys of which it has at least one.
        needs: keys that the model requires and few other kinds have: a file without them is known to be of another
            kind before the model is imported.
    """

    name: str
    described: str
    what: str
    command: str = ""
    place: str = ""
    one_of: tuple[str, ...] = ()
    needs: tuple[str, ...] = ()

    @property
    def model(self) -> type[Spec]:
        """What it may say."""
        model: type[Spec] = Named(self.described).get()
        return model

    def may_be(self, keys: set[str]) -> bool:
        """Whether a file with these keys can be one of this kind, by what is known before the model is imported."""
        return keys >= set(self.needs) and (not self.one_of or bool(keys & set(self.one_of)))

    def strangers(self, keys: set[str]) -> int | None:
        """How many of the keys are none of this kind's; None if one that it needs is missing."""
        if not self.may_be(keys):
            return None
        fields = self.model.model_fields
        needed = {name for name, item in fields.items() if item.is_required()}
        return len(keys - set(fields)) if needed <= keys else None
