"""Groups recorded episodes by the env that rescores them, and rescores them in the background."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from workbench.episodes.document import WrongDocument, read_document
from workbench.episodes.episode import EpisodeInfo
from workbench.episodes.reader.reading import read_recording
from workbench.episodes.recorded_source import (
    CannotEnterRecording,
    NoRecordedSource,
    class_in,
    options_of,
    recorded_source,
    reference_of,
)
from workbench.episodes.row import Source, UnreadableRecording
from workbench.episodes.seal import made_here
from workbench.episodes.side_files import side_files_text
from workbench.live.effects import Asked
from workbench.live.process.ask import Background
from workbench.live.process.background_jobs import Job, JobFailed, Jobs
from workbench.machine.loop import BlockingPool, do, on_loop
from workbench.page.command import Command
from workbench.rescore.state import RescoreView, Rescoring, RescoringUpdate, apply_to_job
from workbench.rescore.verdict import Rescore, Rescored, Verdict
from workbench.task.description import TaskOptions
from workbench.task.library_names import named_like_library_text
from workbench.task.modules import hidden_by_libraries
from workbench.task.reference import TaskName, named_file
from workbench.trust.clearance import Clearances, CodeToRun, NotCleared, recorded_content


@dataclass(frozen=True)
class RescoreGroup:
    """Episodes that are rescored in one env."""

    reference: TaskName
    """The task to open, unless `recorded_source` is True."""
    options: TaskOptions
    info: EpisodeInfo
    """Info of the first episode of the group."""
    files: tuple[Source, ...]
    note: str = ""
    """Note on options that differ from the recorded ones on purpose."""
    recorded_source: bool = False
    """Whether to open the source text in `info` instead of `reference`."""

    @property
    def code(self) -> CodeToRun:
        """The code that needs clearance before it runs."""
        return CodeToRun(self.reference, self.info, self.recorded_source)


def group_episodes(
    files: Sequence[Source],
    num_envs: int,
    base: TaskOptions | None = None,
    *,
    task: str | None = None,
    file: Path | None = None,
    recorded_source: bool = False,
) -> tuple[list[RescoreGroup], list[Verdict[Source]]]:
    """Group episodes by the env that rescores them. Also returns verdicts for the episodes that cannot be
    read, or that lack the text that `recorded_source` needs.

    Args:
        num_envs: maximum number of envs of a group.
        base: options for what a recording does not determine; see `options_of`.
        task: task to open for all episodes, instead of the recorded one.
        file: task file to open for the episodes whose task is in it.
        recorded_source: rescore each episode with the source text in its recording.
    """
    groups: dict[str, RescoreGroup] = {}
    broken_files: list[Verdict[Source]] = []
    for episode in files:
        try:
            info = _info_of(episode)
        except (UnreadableRecording, OSError) as error:
            broken_files.append(Verdict(episode, why_not=str(error), damaged=True))
            continue
        try:
            text = recorded_content(info).hash if recorded_source else ""
        except NoRecordedSource as error:
            broken_files.append(Verdict(episode, task=info.task, why_not=str(error)))
            continue
        options, note = rescore_options(options_of(info, 1, base))
        if recorded_source and (besides := side_files_text(info.source_file, info.side_files)):
            note = f"{note}. {besides}" if note else besides
        reference = task or (file and class_in(file, info.task)) or reference_of(info)
        # Recordings that were made here are trusted: they must not share a group with recordings from
        # elsewhere.
        about = [str(reference), info.task, options.env_kwargs, text, made_here(info).value]
        key = json.dumps(about, sort_keys=True, default=str)
        group = groups.get(key) or RescoreGroup(reference, options, info, (), note, recorded_source)
        groups[key] = replace(group, files=(*group.files, episode))
    return [
        replace(g, options=replace(g.options, num_envs=max(1, min(num_envs, len(g.files)))))
        for g in groups.values()
    ], broken_files


def hidden_modules_text(reference: TaskName) -> list[str]:
    """A sentence for each module next to the task's file that cannot be imported because a library has the same name."""
    file = named_file(reference)
    return (
        []
        if file is None
        else [named_like_library_text(hidden) for hidden in hidden_by_libraries(file.resolve())]
    )


def rescore_options(options: TaskOptions) -> tuple[TaskOptions, str]:
    """Options of the same env without pictures, and a note on the change. Pictures take most of the time, and
    rewards do not read them."""
    kwargs, note = dict(options.env_kwargs), ""
    mode = kwargs.get("obs_mode")
    if mode is not None and mode not in ("state", "state_dict", "none"):
        note = f"observations are the state, not {mode}: no pictures are rendered"
        kwargs["obs_mode"] = "state"
    kwargs["render_backend"] = "none"
    return replace(options, env_kwargs=kwargs), note


def with_renderer(options: TaskOptions) -> TaskOptions:
    """Options of the same env with a renderer, which some tasks need for building: PushT-v1 makes render materials for
    its shapes."""
    return replace(options, env_kwargs={k: v for k, v in options.env_kwargs.items() if k != "render_backend"})


def _info_of(source: Source) -> EpisodeInfo:
    """Info of a recording, from its small .json if there is one, else from `read_recording`, which reads pictures and
    meshes too. Raises as `read_recording` does."""
    try:
        return read_document(source.path.with_suffix(".json")).description().info(source.path.parent)
    except (OSError, WrongDocument):
        return read_recording(source).info


MAX_ENVS = 16
"""Maximum number of envs that rescore at once."""
MAX_VERSIONS = 3
"""Maximum number of versions that a note lists."""


class Rescorer:
    """Rescores recordings in a separate process, one task after the other.

    The process ends with the job, so that code of recordings does not stay loaded; stopping the job kills the
    process.
    """

    def __init__(self, clearances: Clearances | None = None, base: TaskOptions | None = None) -> None:
        """
        Args:
            clearances: decides which code may run; None if there is no person to ask.
            base: base options of every opened task.
        """
        self._rescoring = Rescoring()
        self._jobs = Jobs(lambda: None, self._failed)
        self._process = Background()
        self._aside = BlockingPool("rescore")
        """Thread that reads recordings, and waits for people's answers."""
        self._clearances = clearances or Clearances()
        self._base = base or TaskOptions()

    @property
    def view(self) -> RescoreView:
        """A snapshot. Thread-safe."""
        return self._rescoring.view

    @on_loop
    def do(self, command: Command) -> None:
        """Carry out `StopRescoring`. Raises `Refused`."""
        self._dispatch(Asked(command))

    @on_loop
    def start(
        self,
        files: Sequence[Source],
        *,
        file: Path | None = None,
        recorded_source: bool = False,
        use_env_states: bool = False,
    ) -> None:
        """Rescore these files; `file` and `recorded_source` as in `group_episodes`, `use_env_states` as in
        `replay_recordings.rescore`."""
        if not files:
            return
        self._rescoring = self._rescoring.begun(RescoreView("loading", total=len(files), unit="episodes"))

        def group() -> tuple[list[RescoreGroup], list[Verdict[Source]]]:
            return group_episodes(files, MAX_ENVS, self._base, file=file, recorded_source=recorded_source)

        self._jobs.start("rescoring", lambda job: self._rescore_all(job, group, use_env_states))

    def close(self) -> None:
        """Stop, and wait until the process has ended. Must not be called on the loop's thread."""
        do(self._jobs.close)
        self._aside.end()
        self._process.close()

    # --- on the loop ---------------------------------------------------------------------------------

    def _dispatch(self, event: Asked | RescoringUpdate) -> None:
        self._rescoring, effects = apply_to_job(self._rescoring, event)
        if effects:
            self._jobs.stop()

    def _send_view(self, verdicts: Iterable[Verdict[Source]] = (), **values: Any) -> None:
        """Update these fields of the view, add verdicts, and send the view."""
        known = (*self.view.verdicts, *verdicts)
        view = replace(self.view, verdicts=known, done=len(known), **values)
        self._dispatch(RescoringUpdate(self._rescoring.job, view))

    def _failed(self, failure: JobFailed) -> None:
        self._send_view(state="failed", why=str(failure), problem=failure.problem)

    # --- the job -------------------------------------------------------------------------------------

    async def _rescore_all(
        self,
        job: Job,
        group: Callable[[], tuple[list[RescoreGroup], list[Verdict[Source]]]],
        use_env_states: bool,
    ) -> None:
        try:
            groups, broken_files = await self._aside.run(group)
            notes = [f"with {_code_text(group)}" for group in groups[:MAX_VERSIONS]]
            notes += [f"and {len(groups) - MAX_VERSIONS} more"] if len(groups) > MAX_VERSIONS else []
            notes += dict.fromkeys(g.note for g in groups if g.note)
            self._send_view(broken_files, state="asking", notes=tuple(notes))
            cleared = await self._aside.run(
                lambda: self._clearances.clear_all([group.code for group in groups], lambda: job.stopped)
            )
            await self._rescore_each(job, groups, cleared, use_env_states)
        finally:
            self._process.end()  # so that code of the recordings does not stay loaded
        self._send_view(state="done")

    async def _rescore_each(
        self,
        job: Job,
        groups: Sequence[RescoreGroup],
        cleared: Sequence[TaskName | NotCleared],
        use_env_states: bool,
    ) -> None:
        """Rescore each group with the code cleared for it, or its recorded text. A failed group does not stop the others: a
        folder holds recordings of many tasks, and one of these tasks may be missing.

        Raises:
            JobFailed: the error of the first group, if all fail.
        """
        failures: list[JobFailed] = []
        for group, task in zip(groups, cleared, strict=True):
            try:
                await self._rescore(job, group, task, use_env_states)
            except JobFailed as failure:
                failures.append(failure)
                why = f"{failure}: {failure.problem.message}" if failure.problem is not None else str(failure)
                rescored = {verdict.of.id for verdict in self.view.verdicts}
                missing = [file for file in group.files if file.id not in rescored]
                self._send_view([Verdict(file, task=group.info.task, why_not=why) for file in missing])
        if failures and len(failures) == len(groups):
            raise failures[0]

    async def _rescore(
        self, job: Job, group: RescoreGroup, task: TaskName | NotCleared, use_env_states: bool
    ) -> None:
        if isinstance(task, NotCleared):
            raise JobFailed(str(task))
        began: float | None = None

        def on_part(done: int, total: int, part: Rescored) -> None:
            nonlocal began
            began = began or time.monotonic() - self.view.seconds
            seconds, steps = time.monotonic() - began, self.view.steps + part.steps
            self._send_view(part.verdicts, state="rescoring", steps=steps, seconds=seconds)

        with ExitStack() as stack:
            if group.recorded_source:
                try:
                    task = await self._aside.run(lambda: _write_text(group.info, stack, job))
                except CannotEnterRecording as error:
                    raise JobFailed(str(error)) from error
            hidden = await self._aside.run(lambda: hidden_modules_text(task))
            warnings = tuple(dict.fromkeys((*self.view.warnings, *hidden)))
            self._send_view(state="loading", task=_code_text(group), warnings=warnings)
            or_else = with_renderer(group.options)
            question = Rescore(task, group.options, or_else, group.files, use_env_states)
            last = await self._process.ask(question, on_part)
        if last.problem is not None:
            why = f"the code of {group.info.task} raised"
            if began is None:
                why = f"{_code_text(group)} cannot be opened. Choose 'as recorded', or start the workbench with --task FILE"
            raise JobFailed(why, last.problem)


def _write_text(info: EpisodeInfo, stack: ExitStack, job: Job) -> str:
    """Enter `recorded_source` on `stack`; returns the reference to open. The text is written and removed by
    this process, so it is removed even if the background process is killed. Raises CannotEnterRecording."""
    reference = stack.enter_context(recorded_source(info))
    if job.stopped:
        stack.close()
    return reference


def _code_text(group: RescoreGroup) -> str:
    """Describe the code that rescores a group, for messages."""
    if group.recorded_source:
        return f"{group.info.task} as it was recorded"
    file = named_file(group.reference)
    return f"{group.info.task} as a package registers it" if file is None else f"{group.info.task} of {file}"
