"""What today's code says of recorded episodes, beside what was said when they were recorded.

This is the comparison and the plain data around it; the envs that live through the episodes again are in
`rescore_run`, and the process that does it for a page is kept by `rescorer`. An episode is judged as far as it was
recorded, also where today's code would have ended it before.

What is judged is the run anew and not the record, so how far it came from the record is measured at every state
and belongs to each verdict. With the recorded states put in after every step nothing drifts, and contacts are those of
one step from the state before.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from workbench.authoring.library_names import named_like_library
from workbench.authoring.modules import hidden_by_libraries
from workbench.authoring.reference import TaskName, named_file
from workbench.core.recorded_run import RecordedRun
from workbench.recording.description import info_from
from workbench.recording.episode import EpisodeInfo
from workbench.recording.json_file import NotJson, read_json
from workbench.recording.made_here import made_here
from workbench.recording.reading import find_trajectories
from workbench.recording.side_files import side_files_in_words
from workbench.recording.unreadable import UnreadableRecording
from workbench.session.clearance import Wanted, recorded_content
from workbench.session.judgement import SAME_REWARD
from workbench.session.messages import TaskOptions
from workbench.session.recorded_text import NoText
from workbench.session.rescore_messages import EpisodeFile, Verdict
from workbench.session.step_back import class_in, options_of, reference_of


@dataclass(frozen=True)
class Group:
    """Episodes that are judged in one env."""

    reference: TaskName
    """What is opened when it is cleared, unless it is `info`'s recorded text."""
    options: TaskOptions
    info: EpisodeInfo
    """Of the first of them."""
    files: tuple[EpisodeFile, ...]
    note: str = ""
    """What is not as it was recorded, on purpose."""
    recorded_source: bool = False

    @property
    def wanted(self) -> Wanted:
        """What has to be cleared before it is judged."""
        return Wanted(self.reference, self.info, self.recorded_source)


@dataclass
class Heard:
    """What the task says of an episode now, while it is lived through."""

    reward: list[float] = field(default_factory=list)
    """(T,)"""
    evaluate: dict[str, list[float]] = field(default_factory=dict)
    """(T + 1,) each, of those that are one number or flag an env."""
    metres: float | None = None
    drift_at: int | None = None

    def drifted(self, metres: float, state: int) -> None:
        if self.metres is None or metres > self.metres:
            self.metres, self.drift_at = metres, state


def verdict_of(file: EpisodeFile, run: RecordedRun, task: str, heard: Heard) -> Verdict:
    """Compare what was recorded with what was heard."""
    old = np.asarray(run.reward, np.float64)
    new = np.asarray(heard.reward, np.float64)
    if len(old) and np.isnan(old).all():
        # A recording of somebody else's that holds no rewards: there is nothing to compare with.
        apart = np.zeros(len(old))
    else:
        apart = _apart(new, old)
    scale = np.max(np.abs(old), initial=0.0, where=np.isfinite(old))
    differs = np.flatnonzero(apart > SAME_REWARD * scale)
    firsts = [int(differs[0]) + 1] if len(differs) else []
    flags: dict[str, tuple[int | None, int | None]] = {}
    for name in ("success", "fail"):
        was, now = _flags(run.evaluate.get(name)), _flags(heard.evaluate.get(name))
        flags[name] = _first_true(was), _first_true(now)
        if was is not None or now is not None:
            a, b = (np.zeros(run.length + 1, bool) if f is None else f for f in (was, now))
            states = np.flatnonzero(a[: run.length + 1] != b[: run.length + 1])
            firsts += [int(states[0])] if len(states) else []
    return Verdict(
        file=file,
        task=task,
        seed=run.seed,
        length=run.length,
        success=flags["success"],
        fail=flags["fail"],
        has_success="success" in run.evaluate or "success" in heard.evaluate,
        returns=(float(old.sum()), float(new.sum())),
        largest=float(apart.max(initial=0.0)),
        first_difference=min(firsts, default=None),
        differing=tuple(_differing(run.evaluate, heard.evaluate)),
        metres=heard.metres,
        drift_at=heard.drift_at if heard.metres else None,
        old_reward=old.astype(np.float32),
        new_reward=new.astype(np.float32),
    )


def find_episodes(places: Sequence[Path]) -> list[EpisodeFile]:
    """The episodes of these files and folders, each once: ours, and those in files of ManiSkill's RecordEpisode.

    Raises:
        UnreadableRecording: a place is not there, or a file that is named holds no episode.
    """
    found: dict[str, EpisodeFile] = {}
    for place in places:
        if place.is_dir():
            names = sorted(p for p in place.rglob("*") if p.suffix in (".json", ".h5", ".rrd"))
            files = [p for p in names if not any(part.startswith(".") for part in p.relative_to(place).parts)]
        elif place.is_file():
            files = [place]
        else:
            raise UnreadableRecording(f"There is no file or folder {place}.")
        for file in files:
            try:
                episodes = list(_episodes_in(file))
            except UnreadableRecording:
                if file is place:
                    raise
                continue  # of a folder what is no recording is passed over
            for episode in episodes:
                found.setdefault(episode.id, episode)
    if not found:
        raise UnreadableRecording(f"There is no recorded episode in {', '.join(map(str, places))}.")
    return [*found.values()]


def group_episodes(
    files: Sequence[EpisodeFile],
    num_envs: int,
    base: TaskOptions | None = None,
    *,
    task: str | None = None,
    file: Path | None = None,
    recorded_source: bool = False,
) -> tuple[list[Group], list[Verdict]]:
    """Which env each episode is judged in; and those that cannot be read, with the reason.

    Args:
        num_envs: at most so many at once.
        task: is opened for all of them, in place of what each names.
        file: is opened for those whose task is in it.
        recorded_source: each is judged by the text that it was recorded with.
    """
    groups: dict[str, Group] = {}
    unread: list[Verdict] = []
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


def not_judged(group: Group, verdicts: Iterable[Verdict], why_not: str) -> list[Verdict]:
    """Of those of the group that have no verdict: a folder holds recordings of many tasks, and one of them may be gone."""
    judged = {verdict.file.id for verdict in verdicts}
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


def _episodes_in(file: Path) -> Iterator[EpisodeFile]:
    said = _said(file.with_suffix(".json"))
    if isinstance(said.get("workbench"), dict):
        id = str(said["workbench"].get("id") or file.with_suffix("").resolve())
        yield EpisodeFile(id, file.stem, file.with_suffix(".json"))
    elif "episodes" in said and file.with_suffix(".h5").is_file():
        data = file.with_suffix(".h5")
        for name in find_trajectories(data):
            yield EpisodeFile(f"{data.resolve()}#{name}", f"{file.stem}#{name}", data, name)
    elif file.suffix == ".rrd":
        yield EpisodeFile(str(file.resolve()), file.stem, file)
    else:
        raise UnreadableRecording(f"{file} is no recording of an episode.")


def _said(file: Path) -> dict[str, Any]:
    try:
        said = read_json(file)
    except (OSError, NotJson):
        return {}
    return said if isinstance(said, dict) else {}


def _info_of(file: EpisodeFile) -> EpisodeInfo:
    """Raises as `EpisodeFile.read`, which it spares where it can: pictures and meshes need not be read for it."""
    said = _said(file.path).get("workbench") if file.path.suffix == ".json" else None
    if isinstance(said, dict):
        try:
            return info_from(said, file.path.parent)
        except (KeyError, TypeError, ValueError) as error:
            raise UnreadableRecording(
                f"{file.path.name} is a recording, but a broken one ({type(error).__name__}: {error})"
            ) from error
    return file.read().info


def _flags(values: Any) -> NDArray[np.bool_] | None:
    """(T + 1,) of an entry that is a flag; None for one that is not there."""
    if values is None:
        return None
    rows = np.asarray(values)
    return (np.nan_to_num(rows.reshape(len(rows), -1)[:, 0].astype(float)) > 0.5) if len(rows) else None


def _first_true(flags: NDArray[np.bool_] | None) -> int | None:
    return None if flags is None or not flags.any() else int(np.argmax(flags))


def _differing(old: Mapping[str, NDArray], new: Mapping[str, list[float]]) -> Iterator[str]:
    for name, values in new.items():
        was = old.get(name)
        if name in ("success", "fail") or was is None:
            continue
        rows = np.asarray(was)
        if rows.shape not in ((len(values),), (len(values), 1)) or rows.dtype.kind not in "fiub":
            continue
        a, b = rows.reshape(-1).astype(float), np.asarray(values, float)
        known = ~np.isnan(a)  # a state that lacks the entry
        scale = np.max(np.abs(a), initial=0.0, where=np.isfinite(a))
        if (_apart(b[known], a[known]) > max(SAME_REWARD * scale, 1e-7)).any():
            yield name


def _apart(new: NDArray, old: NDArray) -> NDArray[np.float64]:
    """How far apart; infinite where one is not a number, zero where both are not or are the same infinity."""
    with np.errstate(invalid="ignore"):
        apart = np.abs(new - old)
    apart[(np.isnan(new) & np.isnan(old)) | (new == old)] = 0.0
    return np.where(np.isnan(apart), np.inf, apart)
