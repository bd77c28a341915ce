"""An opened recording in the words of a live session, for the panels that show either.

The Cameras tab, the table of numbers and the frustums in the view read a `SessionView`: a task with cameras, a step,
pictures. A recording has all of that, so it is said in these words, and the panels need not know the difference.
"""

from __future__ import annotations

import math

import numpy as np

from workbench.core.camera_settings import CameraKey
from workbench.core.geometry import SceneGeometry
from workbench.core.pictures import CameraInfo, Picture
from workbench.core.step import StepResult
from workbench.recording.episode import Episode
from workbench.session.messages import Settings, TaskDescription
from workbench.session.review_view import ReviewView
from workbench.session.view import SessionView

NO_GEOMETRY = SceneGeometry(0, (), (), (), ())


def as_session_view(
    view: ReviewView,
    cameras: tuple[CameraInfo, ...],
    pictures: dict[CameraKey, Picture],
    pictures_serial: int,
) -> SessionView:
    """The selected recording at the state that is shown.

    Args:
        cameras: What it has pictures of.
        pictures: Those of the state.
        pictures_serial: Grows with every new one.
    """
    chosen = view.opened[view.selected]
    task = described(chosen.episode, len(view.opened), cameras)
    return SessionView(
        state="running" if view.playing else "paused",
        task=task,
        task_serial=view.opened_serial,
        scene_serial=view.opened_serial,
        # Each recording brings its own cameras.
        cameras_serial=view.opened_serial * 1000 + view.selected,
        step=step_of(chosen.episode, view.states[view.selected]),
        step_serial=view.position,
        pictures=pictures,
        pictures_serial=pictures_serial,
        picture_milliseconds=math.nan,
        settings=Settings(view.speed, selected_env=view.selected),
        seed=chosen.episode.info.seed,
        playing=view.playing,
    )


def step_of(episode: Episode, state: int) -> StepResult:
    """One state of a recording as a batch of one env."""
    before = state - 1
    return StepResult(
        elapsed_steps=np.array([state], np.int32),
        reward=np.asarray(episode.reward[before : before + 1] if state else [0.0], np.float32),
        terminated=np.asarray(episode.terminated[before : before + 1] if state else [False], bool),
        truncated=np.asarray(episode.truncated[before : before + 1] if state else [False], bool),
        evaluate={name: values[state : state + 1] for name, values in episode.evaluate.items()},
        poses=np.zeros((1, 0, 7), np.float32) if episode.poses is None else episode.poses[state : state + 1],
        action=episode.action[before : before + 1] if state else None,
        others=episode.others_at(state),
    )


def described(episode: Episode, num_envs: int, cameras: tuple[CameraInfo, ...]) -> TaskDescription:
    info = episode.info
    return TaskDescription(
        env_id=info.task,
        class_name=info.task,
        file=info.source_file,
        source_files=(),
        source_hash=info.source_hash,
        source=info.source,
        backend=info.backend,
        device="",
        num_envs=num_envs,
        max_episode_steps=info.max_episode_steps,
        obs_mode="",
        reward_mode="",
        control_mode=info.control_mode,
        control_dt=info.control_dt,
        actions=(),
        geometry=episode.geometry or NO_GEOMETRY,
        cameras=cameras,
        segmentation=episode.segmentation,
        can_render=True,
    )
