"""``python -m twin.asbuilt``: the state of one instrument from everything that was measured on it."""

from __future__ import annotations

if __name__ == "__main__":
    from scenes.yaml.interrupt import end_quietly

    end_quietly()

from typing import Any

import typer
from typer.core import TyperGroup

from twin.framework.command import add_tests


class _Estimate(TyperGroup):
    """A program whose subcommand ``estimate`` need not be named."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments with the subcommand that may have been left out."""
        return list(super().parse_args(ctx, self.whole(args)))

    def whole(self, args: list[str]) -> list[str]:
        """Arguments with the subcommand before them, where they begin with none."""
        named = not args or args[0] in self.commands or args[0] == "--help"
        return args if named else ["estimate", *args]


app = typer.Typer(
    cls=_Estimate,
    add_completion=False,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    no_args_is_help=True,
)


@app.callback()
def main() -> None:
    """Estimate how one instrument stands against its drawing, from wavefronts, foci, distortion, MTF, monitor spots,
    lines of sight, temperatures and positions that were measured on it; what follows for its image, and which move of
    its actuators would improve it.

    `python -m twin.asbuilt FILE` is `python -m twin.asbuilt estimate FILE`.

    Example: `python -m twin.asbuilt scenes/examples/asbuilt_gf7.yaml`

    Exit codes: 0 success, 2 bad input (nothing is written), 1 anything else.
    """


add_tests(app, "asbuilt")


if __name__ == "__main__":
    app()
