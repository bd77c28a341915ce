"""Which recorded episodes are judged again, and in which env each is.

The envs that live through them are in `rescore_run`, and the process that does it for a page is kept by `rescorer`.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

from workbench.authoring.library_names import named_like_library
from workbench.authoring.modules import hidden_by_libraries
from workbench.authoring.problem import TaskError
from workbench.authoring.reference import TaskName, named_file
from workbench.recording.document import WrongDocument, read_document
from workbench.recording.episode import EpisodeInfo
from workbench.recording.made_here import made_here
from workbench.recording.side_files import side_files_in_words
from workbench.recording.sources import Source, UnreadableRecording
from workbench.session.clearance import NotCleared, Wanted, recorded_content
from workbench.session.lane import JobFailed
from workbench.session.messages import TaskOptions
from workbench.session.recorded_text import NoText
from workbench.session.step_back import CannotStepIn, class_in, options_of, recorded_source, reference_of
from workbench.session.verdict import Verdict


@dataclass(frozen=True)
class Group:
    """Episodes that are judged in one env."""

    reference: TaskName
    """What is opened when it is cleared, unless it is `info`'s recorded text."""
    options: TaskOptions
    info: EpisodeInfo
    """Of the first of them."""
    files: tuple[Source, ...]
    note: str = ""
    """What is not as it was recorded, on purpose."""
    recorded_source: bool = False

    @property
    def wanted(self) -> Wanted:
        """What has to be cleared before it is judged."""
        return Wanted(self.reference, self.info, self.recorded_source)


def group_episodes(
    files: Sequence[Source],
    num_envs: int,
    base: TaskOptions | None = None,
    *,
    task: str | None = None,
    file: Path | None = None,
    recorded_source: bool = False,
) -> tuple[list[Group], list[Verdict[Source]]]:
    """Which env each episode is judged in; and those that cannot be read, with the reason.

    Args:
        num_envs: at most so many at once.
        task: is opened for all of them, in place of what each names.
        file: is opened for those whose task is in it.
        recorded_source: each is judged by the text that it was recorded with.
    """
    groups: dict[str, Group] = {}
    unread: list[Verdict[Source]] = []
    for episode in files:
        try:
            info = _info_of(episode)
        except (UnreadableRecording, OSError) as error:
            unread.append(Verdict(episode, why_not=str(error)))
            continue
        try:
            text = recorded_content(info).hash if recorded_source else ""
        except NoText as error:
            unread.append(Verdict(episode, task=info.task, why_not=str(error)))
            continue
        options, note = judging_options(options_of(info, 1, base))
        if recorded_source and (besides := side_files_in_words(info.source_file, info.side_files)):
            note = f"{note}. {besides}" if note else besides
        reference = task or (file and class_in(file, info.task)) or reference_of(info)
        # One that was made here must not vouch for one that was not.
        about = [str(reference), info.task, options.env_kwargs, text, made_here(info).value]
        key = json.dumps(about, sort_keys=True, default=str)
        group = groups.get(key) or Group(reference, options, info, (), note, recorded_source)
        groups[key] = replace(group, files=(*group.files, episode))
    return [
        replace(g, options=replace(g.options, num_envs=max(1, min(num_envs, len(g.files)))))
        for g in groups.values()
    ], unread


def hidden_in_words(reference: TaskName) -> list[str]:
    """What lies beside the task's file and cannot be imported because a library has its name, in sentences."""
    file = named_file(reference)
    return [] if file is None else [named_like_library(hidden) for hidden in hidden_by_libraries(file)]


def judge_each(
    groups: Sequence[Group],
    cleared: Sequence[TaskName | NotCleared],
    judge: Callable[[Group, TaskName], None],
    failed: Callable[[Group, JobFailed | TaskError | CannotStepIn], None],
) -> None:
    """Judge each of these with what was cleared for it, or with its recorded text; one that fails leaves the others.

    Raises:
        JobFailed, TaskError, CannotStepIn: of the first, where all fail.
    """
    failures: list[JobFailed | TaskError | CannotStepIn] = []
    for group, reference in zip(groups, cleared, strict=True):
        try:
            if isinstance(reference, NotCleared):
                raise CannotStepIn(str(reference)) from reference
            text = recorded_source(group.info) if group.recorded_source else nullcontext(reference)
            with text as opened:
                judge(group, opened)
        except (JobFailed, TaskError, CannotStepIn) as error:
            failures.append(error)
            failed(group, error)
    if failures and len(failures) == len(groups):
        raise failures[0]


def not_judged(group: Group, verdicts: Iterable[Verdict[Source]], why_not: str) -> list[Verdict[Source]]:
    """Of those of the group that have no verdict: a folder holds recordings of many tasks, and one of them may be gone."""
    judged = {verdict.of.id for verdict in verdicts}
    missing = [file for file in group.files if file.id not in judged]
    return [Verdict(file, task=group.info.task, why_not=why_not) for file in missing]


def judging_options(options: TaskOptions) -> tuple[TaskOptions, str]:
    """The same env without pictures, which cost most of the time and which no reward looks at; and what was changed."""
    kwargs, note = dict(options.env_kwargs), ""
    mode = kwargs.get("obs_mode")
    if mode is not None and mode not in ("state", "state_dict", "none"):
        note = f"observations are the state, and not {mode}: no pictures are drawn"
        kwargs["obs_mode"] = "state"
    kwargs["render_backend"] = "none"
    return replace(options, env_kwargs=kwargs), note


def with_renderer(options: TaskOptions) -> TaskOptions:
    """For a task that cannot be built without one: PushT-v1 makes materials of SAPIEN's renderer for its shapes."""
    return replace(options, env_kwargs={k: v for k, v in options.env_kwargs.items() if k != "render_backend"})


def _info_of(source: Source) -> EpisodeInfo:
    """Raises as `Source.read`, which it spares where it can: pictures and meshes need not be read for it."""
    try:
        return read_document(source.path.with_suffix(".json")).description().info(source.path.parent)
    except (OSError, WrongDocument):
        return source.read().info
