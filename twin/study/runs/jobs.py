"""The jobs that a study can vary, by name."""

from __future__ import annotations

from scenes.specs.procedures import PROCEDURES, studied
from scenes.yaml.errors import InputError, Issue
from twin.study.runs.base_job import BaseJob, ProcedureBase


def base_job(command: str) -> BaseJob:
    """The job of that name: ``render``, or a test of `PROCEDURES` that can be varied.

    Raises:
        InputError: this version of the twin does not have it.
    """
    if command == "render":
        # a study imports only what its own base needs: a worker then starts in half the time
        from twin.study.runs.render_base import RenderBase

        return RenderBase()
    if command not in studied():
        allowed = ", ".join(("render", *studied()))
        raise InputError(Issue(f"this version of the twin cannot run {command!r} in a study", allowed=allowed))
    return ProcedureBase(PROCEDURES[command])
