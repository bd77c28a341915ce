"""In the worker: what is asked about a camera (`camera_messages`), answered with the env as it is, and no trace left."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

from workbench.authoring.problem import TaskError
from workbench.core.camera_search import SearchProgress, SearchSpace, suggest_cameras
from workbench.core.camera_suggestion import OfferedPlacement, in_words
from workbench.core.pictures import Picture
from workbench.core.place_camera import PlacedCameras
from workbench.core.take_pictures import take_pictures
from workbench.core.visibility import Placement, judge_camera, picture_of, small_size
from workbench.session.camera_messages import (
    CameraAnswer,
    CameraJudged,
    CameraPictures,
    CameraQuestion,
    CameraQuestionFailed,
    CamerasRun,
    DrawCamera,
    JudgeCamera,
    RunCameras,
    Searching,
    SuggestCameras,
    Suggested,
)
from workbench.session.open_task import OpenedTask
from workbench.session.run_cameras import run_cameras

JUDGED_SIDE = 128
"""Pixels of the shorter side of what is judged, where the camera's own are more: an object that is lost in those is
hardly to be called seen."""
LARGEST_SCALE = 4.0
_TELL_EVERY = 0.2


def answer(
    opened: OpenedTask,
    placed: PlacedCameras,
    question: CameraQuestion,
    tell: Callable[[Searching], None],
    cancelled: Callable[[], bool],
) -> CameraAnswer:
    """No picture may be under way.

    Args:
        tell: of a long search.
        cancelled: whether nobody waits for it any more.
    """
    try:
        if isinstance(question, DrawCamera):
            return CameraPictures(question.number, _drawn(opened, placed, question))
        if isinstance(question, JudgeCamera):
            return _judged(opened, question)
        if isinstance(question, RunCameras):
            return CamerasRun(question.number, run_cameras(opened, question))
        return _suggested(opened, question, tell, cancelled)
    except (ValueError, IndexError, RuntimeError, TaskError) as error:
        return CameraQuestionFailed(question.number, str(error))


def _looked_at(opened: OpenedTask, question: DrawCamera) -> tuple[Picture, ...]:
    """In another size than the env's camera has, which is left alone; or by a camera that the env has not."""
    settings, scale = question.settings, question.scale
    if settings is None or not 0 < scale <= LARGEST_SCALE:
        raise ValueError(f"a camera is looked through in up to {LARGEST_SCALE} times its size, not {scale}")
    size = (max(1, round(settings.width * scale)), max(1, round(settings.height * scale)))
    info = next((info for info in opened.description.cameras if info.key == question.key), None)
    placement = Placement(settings, question.key[0], None if info is None else info.mount)
    made = []
    for e in question.envs:
        moment = None if question.poses is None else question.poses[e]
        picture = picture_of(opened.env.env, e, placement, moment, size)
        wanted = question.modalities
        made.append(
            replace(
                picture,
                camera=question.key[1],
                depth=picture.depth if "depth" in wanted else None,
                segmentation=picture.segmentation if "segmentation" in wanted else None,
            )
        )
    return tuple(made)


def _drawn(opened: OpenedTask, placed: PlacedCameras, question: DrawCamera) -> tuple[Picture, ...]:
    env, key = opened.env.env, question.key
    if question.scale != 1.0 or all(info.key != key for info in opened.description.cameras):
        return _looked_at(opened, question)
    before = placed.settings(key)
    if question.settings is not None:
        placed.place(env, key, question.settings)
    try:
        info = next((info for info in opened.description.cameras if info.key == key), None)
        gives = question.modalities if info is None else info.modalities
        wanted = tuple(m for m in question.modalities if m in gives)
        return tuple(
            take_pictures(
                env,
                e,
                [(key[1], key[0], wanted)],
                None if question.poses is None else question.poses[e],
            )[0]
            for e in question.envs
        )
    finally:
        if question.settings is not None:
            placed.place(env, key, before)


def _judged(opened: OpenedTask, question: JudgeCamera) -> CameraJudged:
    info = next((info for info in opened.description.cameras if info.key == question.key), None)
    width, height = (128, 128) if info is None else (info.width, info.height)
    if question.settings is not None:
        width, height = question.settings.width, question.settings.height
    report = judge_camera(
        opened.env.env,
        question.key,
        question.envs,
        settings=question.settings,
        size=small_size(width, height, JUDGED_SIDE),
        poses=question.poses,
    )
    return CameraJudged(question.number, report)


def _suggested(
    opened: OpenedTask,
    question: SuggestCameras,
    tell: Callable[[Searching], None],
    cancelled: Callable[[], bool],
) -> Suggested:
    told = 0.0
    info = next((info for info in opened.description.cameras if info.key == question.key), None)

    def progress(at: SearchProgress) -> None:
        nonlocal told
        if time.monotonic() - told > _TELL_EVERY:
            told = time.monotonic()
            tell(Searching(question.number, at.done, at.total))

    found = suggest_cameras(
        opened.env.env,
        SearchSpace(
            question.objects,
            question.low,
            question.high,
            question.settings,
            question.key[0],
            mount=None if info is None else info.mount,
        ),
        question.envs,
        progress=progress,
        cancelled=cancelled,
    )
    offered = tuple(
        OfferedPlacement(
            s.settings, s.target, s.score, in_words(s.report, question.objects), s.report, s.picture
        )
        for s in found
    )
    return Suggested(question.number, offered)
