"""Plans, runs, writes and checks the change of a body's first pose."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from workbench.cameras.edit.plan_request import texts_on_disk
from workbench.checks.state import load_version
from workbench.hands.pose_edit import (
    ChangePoseFile,
    CheckPose,
    PlanPose,
    PoseChecked,
    PoseEffect,
    PoseEvent,
    PoseFileFailed,
    PosePlanned,
    PoseRefused,
)
from workbench.hands.pose_source import lines_to_copy, plan_pose
from workbench.live.messages import Load, Reset
from workbench.live.process.ask import Background
from workbench.live.process.background_jobs import Job, JobFailed, Jobs
from workbench.machine.loop import BlockingPool, begin, do
from workbench.pictures.camera_conventions import angle_between
from workbench.source.parsed import RefusedEdit, plain_line_ends
from workbench.task.write_edits import SourceEdit, apply, revert, why_not_writable

Poses = NDArray[np.float32]
POSITION_TOLERANCE_METRES = 2e-4
ANGLE_TOLERANCE_RADIANS = 4e-4
"""Tolerances that cover the rounding of written numbers."""


class PoseJobs:
    """Performs the effects: one plan or check at a time. Used on the loop, except `close`."""

    def __init__(self, process: Background, happen: Callable[[PoseEvent], object]) -> None:
        """
        Args:
            process: the background process, which resets the task with the old and the new text.
            happen: handles the resulting events.
        """
        self._process, self._happen = process, happen
        self._asked: PlanPose | CheckPose | None = None
        self._jobs = Jobs(lambda: None, self._failed)
        self._aside = BlockingPool("pose-edits")

    def perform(self, effect: PoseEffect) -> None:
        match effect:
            case PlanPose():
                self._asked = effect
                self._jobs.start("the change", lambda job: self._plan(job, effect))
            case CheckPose():
                self._asked = effect
                self._jobs.start("the check", lambda job: self._check(job, effect))
            case ChangePoseFile():
                begin(self._change(effect))

    def close(self) -> None:
        """Wait for a running write, and begin no more work. Must not be called on the loop's thread."""
        do(self._jobs.close)
        self._aside.close()

    async def _plan(self, job: Job, wanted: PlanPose) -> None:
        try:
            edit = await self._verified(job, wanted)
        except RefusedEdit as refused:
            snippet = refused.snippet or lines_to_copy("", wanted.pose)
            self._happen(PoseRefused(wanted.number, refused.reason, snippet))
        else:
            self._happen(PosePlanned(wanted.number, edit))

    async def _verified(self, job: Job, wanted: PlanPose) -> SourceEdit:
        """The planned change, after a run of the new text has confirmed it. Raises RefusedEdit."""
        task, body = wanted.task, wanted.body
        if task.file is None or not task.source_files:
            raise RefusedEdit(f"{task.class_name} is installed, and installed files are not edited")
        texts = await self._aside.run(partial(texts_on_disk, task))
        if any(plain_line_ends(text) != task.source.get(path) for path, text in texts.items()):
            raise RefusedEdit("the file was edited since it was loaded; save it, let it load and try again")
        before = await self._reset(job, wanted.load, wanted.seeds)
        row = task.geometry.body_names.index(body)
        poses = before[:, :, row].reshape(-1, 7)
        poses = poses[np.isfinite(poses).all(axis=1)]
        if not len(poses) or np.ptp(poses, axis=0).max() > POSITION_TOLERANCE_METRES:
            raise RefusedEdit(f"{body} begins at different poses in different episodes or envs")
        here = tuple(map(float, poses[0]))
        plan = partial(plan_pose, texts, task.file, task.class_name, body, here, wanted.pose)
        edit = await self._aside.run(plan)
        for change in edit.changes:
            if why := await self._aside.run(partial(why_not_writable, change.file)):
                raise RefusedEdit(why)
        new = {change.file: plain_line_ends(change.new_text) for change in edit.changes}
        changed = replace(wanted.load, source={**task.source, **new})
        after = await self._reset(job, changed, wanted.seeds)
        if after.shape != before.shape:
            raise RefusedEdit("the change would add or remove bodies")
        if why := difference(after[:, :, row], wanted.pose, body):
            raise RefusedEdit(f"a run of the changed file shows: {why}")
        moved = np.nanmax(np.abs(after - before), axis=(0, 1, 3), initial=0.0) > POSITION_TOLERANCE_METRES
        moved[row] = False
        others = [name for name, is_moved in zip(task.geometry.body_names, moved, strict=True) if is_moved]
        if others:
            note = f"{', '.join(others)} will begin elsewhere too."
            edit = replace(edit, notes=(*edit.notes, note))
        return edit

    async def _check(self, job: Job, wanted: CheckPose) -> None:
        names = wanted.task.geometry.body_names
        why = f"The new version has no body {wanted.body}"
        if wanted.body in names:
            poses = await self._reset(job, wanted.load, wanted.seeds)
            why = difference(poses[:, :, names.index(wanted.body)], wanted.pose, wanted.body)
        self._happen(PoseChecked(wanted.number, why))

    async def _reset(self, job: Job, load: Load, seeds: tuple[int, ...]) -> Poses:
        """(S, N, B, 7) poses after a reset of all envs with each seed.

        The scene is built again, because a reset does not move a body whose pose only its builder sets.
        """
        load = replace(load, level="rebuilt", fresh=True)

        async def ask() -> Poses:
            await load_version(self._process, job, load)
            return np.stack([(await self._process.ask(Reset(None, seed))).poses for seed in seeds])

        return await self._process.in_turns(job, ask)

    async def _change(self, wanted: ChangePoseFile) -> None:
        change = revert if wanted.revert else apply
        try:
            await self._aside.run(partial(change, wanted.edit))
        except RefusedEdit as refused:
            self._happen(PoseFileFailed(wanted.number, refused.reason))

    def _failed(self, failure: JobFailed) -> None:
        asked = self._asked
        assert asked is not None, "a job has failed"
        problem = failure.problem
        why = f"{failure}: {problem.message}" if problem is not None else str(failure)
        if isinstance(asked, PlanPose):
            self._happen(PoseRefused(asked.number, why, lines_to_copy("", asked.pose)))
        else:
            self._happen(PoseChecked(asked.number, f"It could not be checked: {why}"))


def difference(poses: Poses, wanted: tuple[float, ...], body: str) -> str:
    """How the (S, N, 7) poses of a body differ from the pose `wanted`, as text; empty if they do not."""
    for pose in poses.reshape(-1, 7).astype(np.float64):
        if not np.isfinite(pose).all():
            continue  # this env lacks the body
        away = float(np.linalg.norm(pose[:3] - wanted[:3]))
        turned = angle_between(pose[3:], wanted[3:])
        if away > POSITION_TOLERANCE_METRES or turned > ANGLE_TOLERANCE_RADIANS:
            return f"{body} begins {away:.4g} m and {np.degrees(turned):.3g} degrees from the requested pose"
    return ""
