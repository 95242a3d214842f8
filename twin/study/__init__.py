"""Design trade studies: a base job run many times with varied values, and the statistics of its results.

In a script the package itself can be called, ``twin.study(pair, {...}, n=1000)``; see `twin.study.scripted.study`.
"""

import sys
from types import ModuleType
from typing import Any


class _Study(ModuleType):
    """Module type of this package that makes it callable: a script can write ``twin.study(...)``."""

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        """Run a study from a script; the arguments are those of `twin.study.scripted.study`."""
        # imported late, since parts of the package do not need it
        from twin.study.scripted import study

        return study(*arguments, **options)


sys.modules[__name__].__class__ = _Study
