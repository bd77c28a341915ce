"""Recorded episodes judged again in this process: what ``workbench rescore`` does."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import torch

from workbench.authoring.problem import TaskError
from workbench.authoring.reference import TaskName
from workbench.core.broken_rule import warn_of
from workbench.core.rules import Finding
from workbench.machine.current_folder import CurrentFolder
from workbench.recording.sources import Source, UnreadableRecording, sources_among
from workbench.session.clearance import Clearances, NotCleared, NotTrusted
from workbench.session.messages import TaskOptions
from workbench.session.open_task import OpenedTask
from workbench.session.reload import open_task
from workbench.session.rescore import (
    Group,
    group_episodes,
    hidden_in_words,
    judge_each,
    with_renderer,
)
from workbench.session.rescore_run import rescore
from workbench.session.verdict import Verdict


@dataclass(frozen=True)
class RescoreOptions:
    places: tuple[Path, ...]
    """Files and folders."""
    task: str | None = None
    """Opened for all of them, in place of what each names."""
    recorded_source: bool = False
    use_env_states: bool = False
    num_envs: int = 16
    base: TaskOptions = field(default_factory=TaskOptions)
    """Which backend, and what else is the same for all."""


@dataclass(frozen=True)
class Progress:
    episodes: int
    total: int
    steps: int


def rescore_all(
    what: RescoreOptions,
    on_activity: Callable[[str], None] = lambda activity: None,
    on_progress: Callable[[Progress], None] = lambda progress: None,
    on_finding: Callable[[Finding], None] = warn_of,
    clearances: Clearances | None = None,
    on_notice: Callable[[str], None] = lambda notice: None,
) -> tuple[list[Verdict[Source]], tuple[str, ...]]:
    """The verdicts, in the order of the files; and what is not as it was recorded on purpose, in words.

    Args:
        clearances: says what of the code that the recordings name may run; None asks nobody.
        on_notice: gets a sentence for each file beside a task that no import finds, before the task is opened.

    Raises:
        NotTrusted: a recording names code that nobody agreed to, and there is nobody to ask; or the answer to all was no.
        FileNotFoundError, UnreadableRecording: there is nothing to judge.
        TaskError: no task can be opened, or each raises; where others can be judged, it is said of its episodes.
        CannotStepIn: as TaskError, where a recorded text cannot be opened.
    """
    torch.set_num_threads(1)  # see workbench.session.worker.work
    here = CurrentFolder()
    files = [s for s in sources_among([place.absolute() for place in what.places]) if s.kind != "lerobot"]
    if not files:
        raise UnreadableRecording(
            f"A LeRobot dataset cannot be judged again: {', '.join(map(str, what.places))}."
        )
    groups, verdicts = group_episodes(
        files, what.num_envs, what.base, task=what.task, recorded_source=what.recorded_source
    )
    cleared = _cleared(groups, clearances or Clearances())
    steps = 0
    told: set[object] = set()

    def tell_once(finding: Finding) -> None:
        if finding.key not in told:  # a task may be opened several times, and break the rule each time
            told.add(finding.key)
            on_finding(finding)

    def judge(group: Group, reference: TaskName) -> None:
        nonlocal steps
        for notice in hidden_in_words(reference):
            if notice not in told:
                told.add(notice)
                on_notice(notice)
        opened = _open(reference, group.options, on_activity, tell_once, here)
        before = steps

        def tell(now: int) -> None:
            nonlocal steps
            steps = before + now
            on_progress(Progress(len(verdicts), len(files), steps))

        try:
            for verdict in rescore(opened, group.files, use_env_states=what.use_env_states, on_steps=tell):
                verdicts.append(verdict)
                on_progress(Progress(len(verdicts), len(files), steps))
        finally:
            opened.env.close()

    judge_each(groups, cleared, judge, lambda: verdicts, verdicts.extend)
    place = {file.id: number for number, file in enumerate(files)}
    verdicts.sort(key=lambda verdict: place[verdict.of.id])
    return verdicts, tuple(dict.fromkeys(group.note for group in groups if group.note))


def _cleared(groups: list[Group], clearances: Clearances) -> list[TaskName | NotCleared]:
    """What may be opened for each of the groups. Before any of them runs: who is not there to be asked gets all or nothing."""
    cleared = clearances.clear_all([group.wanted for group in groups])
    not_cleared = [one for one in cleared if isinstance(one, NotCleared)]
    refused = [one.question for one in not_cleared if one.question is not None]
    reasons = [str(one) for one in not_cleared if one.trust_helps]
    all_of_them = len(refused) + len(reasons) == len(groups) > 0
    if all_of_them or (refused and not clearances.asks):
        raise NotTrusted(list(dict.fromkeys(refused)), list(dict.fromkeys(reasons)))
    return cleared


def _open(
    reference: TaskName,
    options: TaskOptions,
    on_activity: Callable[[str], None],
    on_finding: Callable[[Finding], None],
    here: CurrentFolder,
) -> OpenedTask:
    with here.again(stay=True):  # the task before may have gone to another one
        try:
            return open_task(reference, options, on_activity=on_activity, on_finding=on_finding)
        except TaskError:
            return open_task(
                reference, with_renderer(options), on_activity=on_activity, on_finding=on_finding
            )
