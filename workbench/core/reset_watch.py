"""A partial reset, watched for what it does to rows of other envs in what the task keeps on itself, and told of."""

from __future__ import annotations

from collections.abc import Sequence

from mani_skill.envs.sapien_env import BaseEnv

from workbench.core.assignments import find_assignment
from workbench.core.broken_rule import BrokenRules, place_of_hook
from workbench.core.kept_rows import KeptRows, RowsElsewhere
from workbench.core.strict_system import envs_named

_TRIES = 3
"""Partial resets of a class in which a line is looked for."""


class ResetWatch:
    """Of one env. Between `start` and `tell` or `stop` it looks at the rows.

    Args:
        rules: What is told.
    """

    def __init__(self, rules: BrokenRules) -> None:
        self._rules = rules
        self._rows: KeptRows | None = None
        self._chosen: tuple[int, ...] = ()
        self._task: type | None = None
        self._tries = 0
        """Left of `_TRIES`."""
        self._seeks = False
        """Lines are looked for in the next reset."""
        self.whole = False
        """The task has a ``reset`` of its own, which is watched from its beginning to its end."""

    @property
    def looks(self) -> bool:
        return self._rows is not None

    def start(self, env: BaseEnv, task: type, chosen: Sequence[int]) -> None:
        """Envs `chosen` are about to be reset."""
        if self._task is not task:
            self._task, self._tries, self._seeks = task, _TRIES, True
        self._chosen = tuple(chosen)
        self._rows = KeptRows(env, chosen, lines=self._seeks)
        self._rows.start()

    def go_on(self, env: BaseEnv) -> None:
        """The same reset goes on after something that it need not answer for."""
        assert self._task is not None
        self.start(env, self._task, self._chosen)

    def stop(self) -> None:
        """Look no further; tells nothing."""
        if self._rows is not None:
            self._rows.stop()
            self._rows = None

    def tell(self, over: bool = True) -> None:
        """Tell of what the reset did, or did so far where it is not over.

        Raises:
            BrokenRule: of a rule that stops.
        """
        rows = self._rows
        if rows is None:
            return
        self.stop()
        found = rows.changes()
        if over or found:
            # Only where a line is missing need the next reset be slowed down.
            self._tries -= self._seeks
            self._seeks = self._tries > 0 and any(not change.frames for change in found)
        for change in found:
            self._tell(change, rows)

    def _tell(self, change: RowsElsewhere, rows: KeptRows) -> None:
        assert self._task is not None
        shown, total = change.path.removesuffix(".raw_pose"), len(self._chosen) + rows.others
        if change.what == "lost":
            rule = "rows-lost"
            message = (
                f"self.{shown} is left with a row for each of the {len(self._chosen)} envs that are being reset, where "
                f"it had one for each of {total}: write `self.{change.path}[env_idx] = ...` instead of replacing it."
            )
        else:
            rule = "rows-rewritten"
            index = change.path if "[i]" in change.path else f"{change.path}[env_idx]"
            of = " for each i of env_idx" if "[i]" in change.path else ""
            message = (
                f"self.{shown} is changed in {envs_named(change.envs)}, which {_are(change.envs)} not being reset and "
                f"in the middle of an episode. Change the rows of env_idx only: `self.{index} = ...`{of}."
            )
        place = None
        if not change.frames:
            place = find_assignment(self._task, change.path) or place_of_hook(
                self._task, "_initialize_episode"
            )
        self._rules.breaks(rule, message, change.frames or None, place, subject=change.path)


def _are(envs: Sequence[int]) -> str:
    return "is" if len(envs) == 1 else "are"
