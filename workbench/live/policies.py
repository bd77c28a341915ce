"""Lists policies to choose from, while the source of actions is *policy* and a page is open."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from workbench.actions.policy import NoPolicy, find_policy, list_policies
from workbench.live.process.background_jobs import Job, Jobs
from workbench.live.run import Run
from workbench.machine.loop import BlockingPool, do
from workbench.machine.preferences import keep_policy, used_policies

LIST_SECONDS = 5.0
"""Interval between searches for policies. A search reads many files."""


@dataclass(frozen=True)
class Wanted:
    """Arguments of the search for policies."""

    task_folder: Path | None
    acting: str | None
    """The chosen policy; saved for the next run if its file or module exists."""


@dataclass(frozen=True)
class KnownPolicies:
    wanted: Wanted | None = None
    """None while nothing is listed."""
    found: tuple[str, ...] = ()
    """Policies that were used before in the folder where the command was started, and functions in the files
    of this folder and of the task's folder."""


@dataclass(frozen=True)
class PoliciesListed:
    """Event: a search has ended."""

    found: tuple[str, ...]


@dataclass(frozen=True)
class ListPolicies:
    """Effect: search repeatedly, with these arguments from now on; None stops the search."""

    wanted: Wanted | None


def apply(known: KnownPolicies, event: object, run: Run) -> tuple[KnownPolicies, list[ListPolicies]]:
    """The known policies after an event, and the effects to perform.

    Args:
        run: the run after the event.
    """
    if isinstance(event, PoliciesListed) and event.found != known.found:
        known = replace(known, found=event.found)
    is_listed = run.pages > 0 and run.settings.action_source == "policy"
    wanted = Wanted(run.folder, run.policy) if is_listed else None
    if wanted == known.wanted:
        return known, []
    return replace(known, wanted=wanted), [ListPolicies(wanted)]


class PolicySearch:
    """Performs `ListPolicies`. Used on the loop, except `close`."""

    def __init__(self, dispatch: Callable[[PoliciesListed], object]) -> None:
        self._dispatch = dispatch
        self._here = Path.cwd()
        self._disk = BlockingPool("policies")
        self._jobs = Jobs(lambda: None, lambda failure: None)

    def perform(self, effect: ListPolicies) -> None:
        if effect.wanted is None:
            self._jobs.stop()
        else:
            self._jobs.start("list policies", partial(self._list, effect.wanted))

    def close(self) -> None:
        """Stop. Called on any thread."""
        do(self._jobs.close)
        self._disk.end()

    async def _list(self, wanted: Wanted, job: Job) -> None:
        await self._disk.run(partial(_keep, self._here, wanted))
        while True:
            self._dispatch(PoliciesListed(await self._disk.run(partial(_find, self._here, wanted))))
            await asyncio.sleep(LIST_SECONDS)


def _keep(here: Path, wanted: Wanted) -> None:
    if wanted.acting is not None and _is_there(wanted.acting, wanted.task_folder):
        keep_policy(here, wanted.acting)


def _find(here: Path, wanted: Wanted) -> tuple[str, ...]:
    used = [one for one in used_policies(here) if _is_there(one, wanted.task_folder)]
    return tuple(dict.fromkeys([*used, *list_policies(here, wanted.task_folder)]))


def _is_there(reference: str, task_folder: Path | None) -> bool:
    with contextlib.suppress(NoPolicy):
        find_policy(reference, task_folder)
        return True
    return False
