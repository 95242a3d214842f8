"""What can happen to an instrument in operation, by the names that tables, records and plans use."""

from __future__ import annotations

from typing import Literal, get_args

Event = Literal["safe_mode", "heater_set_point", "refocus", "eclipse_season_begins", "eclipse_season_ends"]
EVENTS: tuple[str, ...] = get_args(Event)
"""What can happen to an instrument, other than being read."""
