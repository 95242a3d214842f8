"""A laboratory test that cannot be carried out as its file says."""

from __future__ import annotations

from scenes.errors import KeyPath


class BenchError(Exception):
    """The test failed on the bench: what happened, which key of its file is to be changed, and how.

    Attributes:
        key: key path in the test's file.
        remedy: what may be there instead.
    """

    def __init__(self, problem: str, key: KeyPath, remedy: str) -> None:
        super().__init__(problem)
        self.key = key
        self.remedy = remedy
