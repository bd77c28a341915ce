"""In the worker: what is asked about a camera (`questions`), answered with the env as it is, and no trace left."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

from workbench.core.camera_report import CameraReport, OfferedPlacement
from workbench.core.camera_search import SearchSpace, suggest_cameras
from workbench.core.pictures import Picture
from workbench.core.place_camera import PlacedCameras
from workbench.core.take_pictures import take_pictures
from workbench.core.visibility import Placement, judge_camera, picture_of, small_size
from workbench.session.open_task import OpenedTask
from workbench.session.questions import (
    CameraQuestion,
    DrawCamera,
    JudgeCamera,
    RunCameras,
    SuggestCameras,
)
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
    tell: Callable[[int, int], None],
    cancelled: Callable[[], bool],
) -> object:
    """No picture may be under way.

    Args:
        tell: how far a long search is, of how much.
        cancelled: whether nobody waits for it any more.

    Raises:
        ValueError, IndexError, RuntimeError, TaskError: it cannot be answered.
    """
    if isinstance(question, DrawCamera):
        return _drawn(opened, placed, question)
    if isinstance(question, JudgeCamera):
        return _judged(opened, question)
    if isinstance(question, RunCameras):
        return run_cameras(opened, question)
    return _suggested(opened, question, tell, cancelled)


def _looked_at(opened: OpenedTask, question: DrawCamera) -> Picture:
    """In another size than the env's camera has, which is left alone; or by a camera that the env has not."""
    settings, scale = question.settings, question.scale
    if settings is None or not 0 < scale <= LARGEST_SCALE:
        raise ValueError(f"a camera is looked through in up to {LARGEST_SCALE} times its size, not {scale}")
    size = (max(1, round(settings.width * scale)), max(1, round(settings.height * scale)))
    info = opened.description.camera(question.key)
    placement = Placement(settings, question.key[0], None if info is None else info.mount)
    picture = picture_of(opened.env.env, question.env, placement, question.poses, size)
    wanted = question.modalities
    return replace(
        picture,
        camera=question.key[1],
        depth=picture.depth if "depth" in wanted else None,
        segmentation=picture.segmentation if "segmentation" in wanted else None,
    )


def _drawn(opened: OpenedTask, placed: PlacedCameras, question: DrawCamera) -> Picture:
    env, key = opened.env.env, question.key
    if question.scale != 1.0 or opened.description.camera(key) is None:
        return _looked_at(opened, question)
    before = placed.settings(key)
    if question.settings is not None:
        placed.place(env, key, question.settings)
    try:
        info = opened.description.camera(key)
        gives = question.modalities if info is None else info.modalities
        wanted = tuple(m for m in question.modalities if m in gives)
        return take_pictures(env, question.env, [(key[1], key[0], wanted)], question.poses)[0]
    finally:
        if question.settings is not None:
            placed.place(env, key, before)


def _judged(opened: OpenedTask, question: JudgeCamera) -> CameraReport:
    info = opened.description.camera(question.key)
    width, height = (128, 128) if info is None else (info.width, info.height)
    if question.settings is not None:
        width, height = question.settings.width, question.settings.height
    size = small_size(width, height, JUDGED_SIDE)
    env = opened.env.env
    return judge_camera(
        env, question.key, question.env, settings=question.settings, size=size, poses=question.poses
    )


def _suggested(
    opened: OpenedTask,
    question: SuggestCameras,
    tell: Callable[[int, int], None],
    cancelled: Callable[[], bool],
) -> tuple[OfferedPlacement, ...]:
    told = 0.0
    info = opened.description.camera(question.key)

    def progress(done: int, total: int) -> None:
        nonlocal told
        if time.monotonic() - told > _TELL_EVERY:
            told = time.monotonic()
            tell(done, total)

    return suggest_cameras(
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
