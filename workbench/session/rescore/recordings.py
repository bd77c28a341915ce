"""Which recorded episodes are judged again, in which env each is, and a page's judging of them in the background.

The envs that live through them are in `rescore_run`. For a page a process loads one task after the other and judges its
episodes. To stop is to end the process: what is known by then stays. It ends with the job: the code of recordings is not
to stay.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from workbench.authoring.loading.library_names import named_like_library_text
from workbench.authoring.loading.modules import hidden_by_libraries
from workbench.authoring.loading.reference import TaskName, named_file
from workbench.authoring.problem import TaskError
from workbench.jobs.from_recording import (
    CannotEnterRecording,
    NoText,
    class_in,
    options_of,
    recorded_source,
    reference_of,
)
from workbench.jobs.task import TaskOptions
from workbench.jobs.verdict import Rescore, Rescored, Verdict
from workbench.recording.episode.document import WrongDocument, read_document
from workbench.recording.episode.episode import EpisodeInfo
from workbench.recording.episode.made_here import made_here
from workbench.recording.episode.row import Source, UnreadableRecording
from workbench.recording.episode.side_files import side_files_text
from workbench.recording.reader.reading import read_source
from workbench.session.clearance import Clearances, CodeToRun, NotCleared, recorded_content
from workbench.session.process.askers import Background
from workbench.session.process.job_lane import Job, JobFailed
from workbench.session.protocol.messages import Load
from workbench.session.rescore.background import RescoreView, Rescoring


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
    def wanted(self) -> CodeToRun:
        """What has to be cleared before it is judged."""
        return CodeToRun(self.reference, self.info, self.recorded_source)


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
    broken_files: list[Verdict[Source]] = []
    for episode in files:
        try:
            info = _info_of(episode)
        except (UnreadableRecording, OSError) as error:
            broken_files.append(Verdict(episode, why_not=str(error)))
            continue
        try:
            text = recorded_content(info).hash if recorded_source else ""
        except NoText as error:
            broken_files.append(Verdict(episode, task=info.task, why_not=str(error)))
            continue
        options, note = rescore_options(options_of(info, 1, base))
        if recorded_source and (besides := side_files_text(info.source_file, info.side_files)):
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
    ], broken_files


def hidden_in_words(reference: TaskName) -> list[str]:
    """What lies beside the task's file and cannot be imported because a library has its name, in sentences."""
    file = named_file(reference)
    return (
        []
        if file is None
        else [named_like_library_text(hidden) for hidden in hidden_by_libraries(file.resolve())]
    )


def rescore_each(
    groups: Sequence[Group],
    cleared: Sequence[TaskName | NotCleared],
    rescore: Callable[[Group, TaskName], None],
    known: Callable[[], Iterable[Verdict[Source]]],
    not_rescored: Callable[[list[Verdict[Source]]], None],
) -> None:
    """Judge each of these with what was cleared for it, or with its recorded text; one that fails leaves the others.

    Args:
        known: all verdicts so far.
        not_judged: gets those of episodes that have none because theirs failed: a folder holds recordings of many
            tasks, and one of them may be gone.

    Raises:
        JobFailed, TaskError, CannotStepIn: of the first, where all fail.
    """
    failures: list[JobFailed | TaskError | CannotEnterRecording] = []
    for group, reference in zip(groups, cleared, strict=True):
        try:
            if isinstance(reference, NotCleared):
                raise CannotEnterRecording(str(reference)) from reference
            text = recorded_source(group.info) if group.recorded_source else nullcontext(reference)
            with text as opened:
                rescore(group, opened)
        except (JobFailed, TaskError, CannotEnterRecording) as error:
            failures.append(error)
            why = str(error)
            if isinstance(error, JobFailed) and error.problem is not None:
                why += f": {error.problem.message}"
            rescored = {verdict.of.id for verdict in known()}
            missing = [file for file in group.files if file.id not in rescored]
            not_rescored([Verdict(file, task=group.info.task, why_not=why) for file in missing])
    if failures and len(failures) == len(groups):
        raise failures[0]


def rescore_options(options: TaskOptions) -> tuple[TaskOptions, str]:
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
    """Raises as `read_source`, which it spares where it can: pictures and meshes need not be read for it."""
    try:
        return read_document(source.path.with_suffix(".json")).description().info(source.path.parent)
    except (OSError, WrongDocument):
        return read_source(source).info


MOST_AT_ONCE = 16
"""Envs."""
MOST_NAMED = 3
"""Of the versions that are judged with, where there are many."""


class Rescorer:
    """Judges recordings."""

    def __init__(self, clearances: Clearances | None = None, base: TaskOptions | None = None) -> None:
        """
        Args:
            clearances: says what of the code that recordings name may run; None asks nobody.
            base: what is the same for all that is opened.
        """
        self.rescoring = Rescoring("rescore")
        self._process = Background()
        self._clearances = clearances or Clearances()
        self._base = base or TaskOptions()

    def start(
        self,
        files: Sequence[Source],
        *,
        file: Path | None = None,
        recorded_source: bool = False,
        use_env_states: bool = False,
    ) -> None:
        """Judge these; see `group_episodes` for the arguments."""
        if not files:
            return

        def work(job: Job) -> None:
            groups, broken_files = group_episodes(
                files, MOST_AT_ONCE, self._base, file=file, recorded_source=recorded_source
            )
            notes = [f"with {_rescored_with(group)}" for group in groups[:MOST_NAMED]]
            notes += [f"and {len(groups) - MOST_NAMED} more"] if len(groups) > MOST_NAMED else []
            notes += dict.fromkeys(g.note for g in groups if g.note)
            self._tell(job, broken_files, state="asking", notes=tuple(notes))
            try:
                self._rescore_all(job, groups, use_env_states)
            except CannotEnterRecording as error:
                raise JobFailed(str(error)) from error
            finally:
                self._process.end()  # with the code that the recordings named

        self.rescoring.begin(RescoreView("loading", total=len(files), unit="episodes"), work)

    # --- on the lane ---------------------------------------------------------------------------------

    def _rescore_all(self, job: Job, groups: list[Group], use_env_states: bool) -> None:
        cleared = self._clearances.clear_all([group.wanted for group in groups], lambda: job.stopped)
        job.check()

        rescore_each(
            groups,
            cleared,
            lambda group, task: self._rescore(job, group, task, use_env_states),
            lambda: self.rescoring.view.verdicts,
            lambda verdicts: self._tell(job, verdicts),
        )

    def _rescore(self, job: Job, group: Group, reference: TaskName, use_env_states: bool) -> None:
        process = self._process
        warnings = tuple(dict.fromkeys((*self.rescoring.view.warnings, *hidden_in_words(reference))))
        self._tell(job, state="loading", task=_rescored_with(group), warnings=warnings)
        # Never patched into what the last episodes were judged in.
        load = Load(reference, group.options, level="rebuilt")
        try:
            process.ensure(job, load, or_else=replace(load, options=with_renderer(group.options)))
        except JobFailed as failure:
            if failure.problem is None:
                raise
            raise JobFailed(
                f"{group.info.task} could not be opened to judge with", failure.problem
            ) from failure
        self._tell(job, state="rescoring")
        began, before, steps = time.monotonic(), self.rescoring.view.seconds, self.rescoring.view.steps

        def told(now: Rescored) -> None:
            seconds = before + time.monotonic() - began
            self._tell(job, now.verdicts, steps=steps + now.steps, seconds=seconds)

        question = Rescore(group.files, use_env_states)
        last = process.ask(job.check, question, lambda done, total, now: told(now))
        told(last)
        if last.problem is not None:
            raise JobFailed(f"the code of {group.info.task} raised", last.problem)

    def _tell(self, job: Job, verdicts: Iterable[Verdict[Source]] = (), **values: Any) -> None:
        """What is new, and these verdicts besides those that are known."""
        known = (*self.rescoring.view.verdicts, *verdicts)
        self.rescoring.tell(job, verdicts=known, done=len(known), **values)


def _rescored_with(group: Group) -> str:
    """What is opened, in words."""
    if group.recorded_source:
        return f"{group.info.task} as it was recorded"
    file = named_file(group.reference)
    return f"{group.info.task} as it is installed" if file is None else f"{group.info.task} of {file}"
