"""Stores choices that a person made on the page, for the next run, in the user's own folder."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

import msgspec

from workbench.machine.folders import locked, read_private, write_private

FILE = "choices.json"
MAX_FOLDERS, MAX_POLICIES = 100, 10
log = logging.getLogger(__name__)


class Preferences(msgspec.Struct, frozen=True):
    """The user's preferences, stored in `FILE`. Every field has a default, so that files of earlier versions can be read."""

    hints_closed: bool = False
    """Whether the hints of the first page were closed."""
    check_after_save: bool = True
    """Whether rules are checked after each load."""
    policies: dict[str, list[str]] = {}
    """Policies that were used, newest first, keyed by the folder in which the command was started."""


def preferences() -> Preferences:
    """The stored choices; the defaults, with a warning, if the file cannot be read."""
    try:
        content = read_private(FILE)
        return Preferences() if content is None else msgspec.json.decode(content, type=Preferences)
    except (OSError, msgspec.MsgspecError, RecursionError) as error:
        log.warning("Stored choices cannot be read, so defaults are used: %s", error)
        return Preferences()


def close_hints() -> None:
    """Store that the hints are not shown again."""
    _change(lambda kept: msgspec.structs.replace(kept, hints_closed=True))


def keep_check_after_save(wanted: bool) -> None:
    """Store whether rules are checked after each load."""
    _change(lambda kept: msgspec.structs.replace(kept, check_after_save=wanted))


def used_policies(folder: Path) -> tuple[str, ...]:
    """Policies that were used in this folder, the newest first."""
    return tuple(preferences().policies.get(str(folder), ()))


def keep_policy(folder: Path, reference: str) -> None:
    """Store a policy that was used in this folder."""

    def change(kept: Preferences) -> Preferences:
        known = [one for one in kept.policies.get(str(folder), ()) if one != reference]
        others = {place: used for place, used in kept.policies.items() if place != str(folder)}
        newest = dict([*others.items()][-(MAX_FOLDERS - 1) :])
        policies = {**newest, str(folder): [reference, *known][:MAX_POLICIES]}
        return msgspec.structs.replace(kept, policies=policies)

    _change(change)


def _change(change: Callable[[Preferences], Preferences]) -> None:
    try:
        with locked(FILE):
            write_private(FILE, msgspec.json.encode(change(preferences())))
    except OSError as error:
        # The page works without stored choices.
        log.warning("Choices of this page cannot be stored for the next run: %s", error)
