"""Plans, runs, writes and checks the change of how episodes begin."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from workbench.cameras.edit.plan_request import texts_on_disk
from workbench.checks.state import load_version
from workbench.hands.pose_source import lines_to_copy as pose_lines
from workbench.hands.pose_source import plan_pose
from workbench.hands.qpos_source import find_qpos, plan_qpos, without_noise
from workbench.hands.qpos_source import lines_to_copy as qpos_lines
from workbench.hands.questions import EpisodeStart, ReadStart
from workbench.hands.spawn_source import AXES, measure_spawn, plan_spawn, why_no_range
from workbench.hands.spawn_source import lines_to_copy as spawn_lines
from workbench.hands.start_edit import (
    Beginning,
    ChangeStartFile,
    CheckStart,
    PlanStart,
    RobotQpos,
    SpawnRange,
    StartChecked,
    StartEffect,
    StartEvent,
    StartFileFailed,
    StartPlanned,
    StartRefused,
)
from workbench.live.messages import Load
from workbench.live.process.ask import Background
from workbench.live.process.background_jobs import Job, JobFailed, Jobs
from workbench.machine.loop import BlockingPool, begin, do
from workbench.pictures.camera_conventions import angle_between
from workbench.source.parsed import RefusedEdit, plain_line_ends
from workbench.task.description import TaskDescription
from workbench.task.write_edits import SourceEdit, apply, revert, why_not_writable

Poses = NDArray[np.float64]
POSITION_TOLERANCE_METRES = 2e-4
ANGLE_TOLERANCE_RADIANS = 4e-4
QPOS_TOLERANCE = 1e-3
"""Tolerances that cover the rounding of written numbers; of joints, in rad or m, also how well a reset sets them."""


class StartJobs:
    """Performs the effects: one plan or check at a time. Used on the loop, except `close`."""

    def __init__(self, process: Background, dispatch: Callable[[StartEvent], object]) -> None:
        """
        Args:
            process: the background process, which resets the task with the old and the new text.
            dispatch: handles the resulting events.
        """
        self._process, self._dispatch = process, dispatch
        self._asked: PlanStart | CheckStart | None = None
        self._jobs = Jobs(lambda: None, self._failed)
        self._aside = BlockingPool("start-edits")

    def perform(self, effect: StartEffect) -> None:
        match effect:
            case PlanStart():
                self._asked = effect
                self._jobs.start("the change", lambda job: self._plan(job, effect))
            case CheckStart():
                self._asked = effect
                self._jobs.start("the check", lambda job: self._check(job, effect))
            case ChangeStartFile():
                begin(self._change(effect))

    def close(self) -> None:
        """Wait for a running write, and begin no more work. Must not be called on the loop's thread."""
        do(self._jobs.close)
        self._aside.close()

    async def _plan(self, job: Job, effect: PlanStart) -> None:
        try:
            edit = await self._verified(job, effect)
        except RefusedEdit as refused:
            snippet = refused.snippet or _lines_to_copy(effect.wanted)
            self._dispatch(StartRefused(effect.number, refused.reason, snippet))
        else:
            self._dispatch(StartPlanned(effect.number, edit))

    async def _verified(self, job: Job, effect: PlanStart) -> SourceEdit:
        """The planned change, after a run of the new text has confirmed it. Raises RefusedEdit."""
        task, wanted = effect.task, effect.wanted
        if task.file is None or not task.source_files:
            raise RefusedEdit(f"{task.class_name} is installed, and installed files are not edited")
        texts = await self._aside.run(partial(texts_on_disk, task))
        if any(plain_line_ends(text) != task.source.get(path) for path, text in texts.items()):
            raise RefusedEdit("the file was edited since it was loaded; save it, let it load and try again")
        before = await self._read(job, effect.load, effect.seeds, texts)
        edit = await self._aside.run(partial(_planned, texts, task, before, wanted))
        for change in edit.changes:
            if why := await self._aside.run(partial(why_not_writable, change.file)):
                raise RefusedEdit(why)
        old_texts, texts = texts, texts | {change.file: change.new_text for change in edit.changes}
        new = {change.file: plain_line_ends(change.new_text) for change in edit.changes}
        changed = replace(effect.load, source={**task.source, **new})
        after = await self._read(job, changed, effect.seeds, texts)
        if after[0].poses.shape != before[0].poses.shape:
            raise RefusedEdit("the change would add or remove bodies")
        unlike = await self._aside.run(partial(_unlike, before, after, task, wanted, old_texts))
        # The links of a robot move with its joints.
        others = [] if isinstance(wanted, RobotQpos) else _moved(before, after, task, wanted.of)
        unseeded: list[str] = []
        if unlike or others:
            # Numbers that are not drawn from the seed differ without the change too.
            again = await self._read(job, effect.load, effect.seeds, old_texts)
            unseeded = _unseeded(before, again, task, wanted, others)
        if why := difference(after, task, wanted) or ("" if wanted.of in unseeded else unlike):
            raise RefusedEdit(f"a run of the changed file shows: {why}")
        notes = list(edit.notes)
        if caused := [name for name in others if name not in unseeded]:
            notes.append(f"The start of {', '.join(caused)} changes too.")
        if unseeded:
            notes.append(
                f"The start of {', '.join(unseeded)} differs from run to run, with and without this change: the task does not "
                "draw it from the seed."
            )
        return replace(edit, notes=tuple(notes))

    async def _check(self, job: Job, effect: CheckStart) -> None:
        task, wanted = effect.task, effect.wanted
        names = [robot.name for robot in task.robots]
        if not isinstance(wanted, RobotQpos):
            names = list(task.geometry.body_names)
        why = f"The new version has no {wanted.of}"
        if wanted.of in names:
            starts = await self._read(job, effect.load, effect.seeds, task.source)
            why = difference(starts, task, wanted)
        self._dispatch(StartChecked(effect.number, why))

    async def _read(
        self, job: Job, load: Load, seeds: tuple[int, ...], texts: Mapping[str, str]
    ) -> list[EpisodeStart]:
        # The scene is built again, because a reset does not move a body whose pose only its builder sets.
        load = replace(load, level="rebuilt", fresh=True)

        async def ask() -> list[EpisodeStart]:
            await load_version(self._process, job, load)
            return [await self._process.ask(ReadStart(seed, texts)) for seed in seeds]

        return await self._process.in_turns(job, ask)

    async def _change(self, wanted: ChangeStartFile) -> None:
        change = revert if wanted.revert else apply
        try:
            await self._aside.run(partial(change, wanted.edit))
        except RefusedEdit as refused:
            self._dispatch(StartFileFailed(wanted.number, refused.reason))

    def _failed(self, failure: JobFailed) -> None:
        asked = self._asked
        assert asked is not None, "a job has failed"
        problem = failure.problem
        why = f"{failure}: {problem.message}" if problem is not None else str(failure)
        if isinstance(asked, PlanStart):
            self._dispatch(StartRefused(asked.number, why, _lines_to_copy(asked.wanted)))
        else:
            self._dispatch(StartChecked(asked.number, f"It could not be checked: {why}"))


def _planned(
    texts: Mapping[str, str], task: TaskDescription, before: Sequence[EpisodeStart], wanted: Beginning
) -> SourceEdit:
    """The change that does what is wanted; see `plan_pose`, `plan_spawn` and `plan_qpos`. Raises RefusedEdit."""
    if isinstance(wanted, RobotQpos):
        rows = _qpos_of(before, task, wanted)
        written = find_qpos(texts, rows)
        return plan_qpos(written, without_noise(written, rows, wanted.qpos))
    row = task.geometry.body_names.index(wanted.of)
    if isinstance(wanted, SpawnRange):
        spawn = measure_spawn(before, row)
        if spawn is None:
            raise RefusedEdit(f"no env has {wanted.of}")
        return plan_spawn(texts, wanted.of, spawn, (wanted.x, wanted.y))
    poses = _poses_of(before, row)
    if not len(poses) or np.ptp(poses, axis=0).max() > POSITION_TOLERANCE_METRES:
        raise RefusedEdit(f"{wanted.of} begins at different poses in different episodes or envs")
    assert task.file is not None, "its files are edited"
    here = tuple(map(float, poses[0]))
    return plan_pose(texts, task.file, task.class_name, wanted.of, here, wanted.pose)


def _lines_to_copy(wanted: Beginning) -> str:
    if isinstance(wanted, SpawnRange):
        return spawn_lines(wanted.of, (wanted.x, wanted.y))
    if isinstance(wanted, RobotQpos):
        return qpos_lines(wanted.qpos)
    return pose_lines("", wanted.pose)


def _qpos_of(starts: Sequence[EpisodeStart], task: TaskDescription, wanted: RobotQpos) -> Poses:
    """(K, J) joint positions of the robot in all envs. Raises RefusedEdit if there is no such robot."""
    robot = next((one for one in task.robots if one.name == wanted.of), None)
    rows = [start.qpos for start in starts if start.qpos is not None]
    if robot is None or len(rows) < len(starts) or len(robot.joints) != len(wanted.qpos):
        raise RefusedEdit(f"no robot {wanted.of} with {len(wanted.qpos)} joints begins here")
    return np.concatenate(rows)[:, [joint.column for joint in robot.joints]].astype(np.float64)


def _unlike(
    before: Sequence[EpisodeStart],
    after: Sequence[EpisodeStart],
    task: TaskDescription,
    wanted: Beginning,
    texts: Mapping[str, str],
) -> str:
    """How the joints of a robot follow the changed numbers, as text; empty if each moves by the change of its number."""
    if not isinstance(wanted, RobotQpos):
        return ""
    old = _qpos_of(before, task, wanted)
    written = find_qpos(texts, old)
    changes = without_noise(written, old, wanted.qpos) - written.values
    apart = np.abs(_qpos_of(after, task, wanted) - old - changes).max()
    return f"{wanted.of} begins {apart:.3g} from where the numbers put it" if apart > QPOS_TOLERANCE else ""


def _unseeded(
    before: Sequence[EpisodeStart],
    again: Sequence[EpisodeStart],
    task: TaskDescription,
    wanted: Beginning,
    others: Sequence[str],
) -> list[str]:
    """Names whose start differs between two runs of the same source with the same seeds: bodies of `others`, or the robot
    whose joints are wanted."""
    if isinstance(wanted, RobotQpos):
        apart = np.abs(_qpos_of(again, task, wanted) - _qpos_of(before, task, wanted)).max()
        return [wanted.of] if apart > QPOS_TOLERANCE else []
    return [name for name in _moved(before, again, task, wanted.of) if name in others]


def _poses_of(starts: Sequence[EpisodeStart], row: int) -> Poses:
    """(K, 7) poses of a body in the envs that have it."""
    poses = np.concatenate([start.poses[:, row] for start in starts]).astype(np.float64)
    return poses[np.isfinite(poses).all(axis=1)]


def _moved(
    before: Sequence[EpisodeStart], after: Sequence[EpisodeStart], task: TaskDescription, exclude: str
) -> list[str]:
    """Names of the bodies, except `exclude`, whose start differs with the same seeds."""
    apart = np.stack([new.poses - old.poses for old, new in zip(before, after, strict=True)])
    moved = np.nanmax(np.abs(apart), axis=(0, 1, 3), initial=0.0) > POSITION_TOLERANCE_METRES
    names = task.geometry.body_names
    return [name for name, is_moved in zip(names, moved, strict=True) if is_moved and name != exclude]


def difference(starts: Sequence[EpisodeStart], task: TaskDescription, wanted: Beginning) -> str:
    """How the first moments of episodes differ from what is wanted, as text; empty if they do not."""
    if isinstance(wanted, RobotQpos):
        rows = _qpos_of(starts, task, wanted)
        # A task may add noise to what is written.
        apart = np.abs(rows.mean(axis=0) - wanted.qpos) - np.ptp(rows, axis=0)
        return f"{wanted.of} begins with other joint positions" if apart.max() > QPOS_TOLERANCE else ""
    row = task.geometry.body_names.index(wanted.of)
    if isinstance(wanted, SpawnRange):
        return _other_ranges(starts, row, wanted)
    for pose in _poses_of(starts, row):
        away = float(np.linalg.norm(pose[:3] - wanted.pose[:3]))
        turned = angle_between(pose[3:], wanted.pose[3:])
        if away > POSITION_TOLERANCE_METRES or turned > ANGLE_TOLERANCE_RADIANS:
            return f"{wanted.of} begins {away:.4g} m and {np.degrees(turned):.3g} degrees from the requested pose"
    return ""


def _other_ranges(starts: Sequence[EpisodeStart], row: int, wanted: SpawnRange) -> str:
    spawn = measure_spawn(starts, row)
    if spawn is None:
        return f"no env has {wanted.of}"
    for name, found, to in zip(AXES, spawn.ranges, (wanted.x, wanted.y), strict=True):
        if to is None:
            continue
        if found is None:
            return why_no_range(name, wanted.of)
        if not np.allclose(found, to, rtol=0, atol=POSITION_TOLERANCE_METRES):
            return f"{name} of {wanted.of} begins from {found[0]:.4g} to {found[1]:.4g} m"
    return ""
