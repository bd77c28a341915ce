"""Gather one env's episode out of the steps of the whole batch, as columns.

What arrives is a `StepResult` a step, with every env in its leading dimension; what is written is
one file an env, in columns. Between the two something has to pick one env's row out of each step
and hold it until the episode ends, and it has to do so without holding the batches themselves: a
view into row 3 keeps the other rows alive for as long as the episode lasts. `EpisodeBuilder` copies
the row.

It is also the place where a broken stream is noticed. `elapsed_steps` of a real episode counts 0, 1,
2 ...; a step that was lost, or a reset that went by unseen, would otherwise become a file that looks
right and is not. And ``evaluate()`` of a task under way is not tidy: entries come, go and change
their type while the author edits. A step that lacks an entry holds NaN for it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from workbench.core.geometry import SceneGeometry
from workbench.core.pictures import CameraInfo, CameraKind, Picture
from workbench.core.step import StepResult
from workbench.recording.episode import CameraTrack, Episode, EpisodeInfo

MODALITIES = ("rgb", "depth", "segmentation")


class EpisodeBuilder:
    """The episode of one env while it happens: `start`, then `append` a step, then `finish`.

    `len()` is the number of control steps so far. One builder is for one episode, since `info` holds
    its seed.
    """

    def __init__(
        self,
        info: EpisodeInfo,
        geometry: SceneGeometry,
        segmentation: Mapping[int, str],
        action_names: Iterable[str],
        cameras: Iterable[CameraInfo],
    ) -> None:
        self._info = info
        self._geometry = geometry
        self._segmentation = dict(segmentation)
        self._action_names = tuple(action_names)
        self._cameras: dict[tuple[CameraKind, str], CameraInfo] = {(c.kind, c.name): c for c in cameras}
        self._clear()

    def _clear(self) -> None:
        self._poses: list[NDArray[np.float32]] = []
        self._action: list[NDArray[np.float32]] = []
        self._reward: list[float] = []
        self._terminated: list[bool] = []
        self._truncated: list[bool] = []
        self._evaluate: list[dict[str, NDArray]] = []
        self._pictures: dict[tuple[CameraKind, str], list[tuple[int, Picture]]] = {}

    def __len__(self) -> int:
        return len(self._action)

    def start(self, step: StepResult, env: int, pictures: Iterable[Picture] = ()) -> None:
        """Take the state right after the reset of `env`, dropping whatever was gathered before.

        `pictures` may hold those of other envs; they are passed over.

        Raises:
            IndexError: the batch has no such env.
            ValueError: `step` is not the first of an episode of `env`, or does not fit the scene.
        """
        self._check_env(step, env)
        elapsed = int(step.elapsed_steps[env])
        if elapsed != 0:
            raise ValueError(
                f"env {env} is {elapsed} steps into its episode; a recording starts at a reset. "
                "Reset the env, or wait for its next episode."
            )
        self._clear()
        self._append_state(step, env, pictures)

    def append(self, step: StepResult, env: int, pictures: Iterable[Picture] = ()) -> None:
        """Take the control step that led to `step`. `pictures` as in `start`.

        Raises:
            IndexError: the batch has no such env.
            RuntimeError: `start` was not called.
            ValueError: a step is missing between this and the last one, the step carries no action,
                or something in it does not fit what came before.
        """
        if not self._poses:
            raise RuntimeError("append() before start(): an episode begins with the state after its reset.")
        self._check_env(step, env)
        elapsed = int(step.elapsed_steps[env])
        if elapsed != len(self) + 1:
            raise ValueError(
                f"env {env}: step {len(self) + 1} was expected and step {elapsed} came; a step was lost or "
                "the env was reset. Finish this episode and start the next one at its reset."
            )
        if step.action is None:
            raise ValueError(f"env {env}: step {elapsed} has no action, so it cannot be replayed.")
        action = np.array(step.action[env], dtype=np.float32).reshape(-1)
        if len(action) != len(self._action_names):
            raise ValueError(
                f"env {env}: an action of {len(action)} numbers, but {len(self._action_names)} action names."
            )
        self._append_state(step, env, pictures)
        self._action.append(action)
        self._reward.append(float(step.reward[env]))
        self._terminated.append(bool(step.terminated[env]))
        self._truncated.append(bool(step.truncated[env]))

    def finish(self) -> Episode:
        """The episode so far, in columns; the builder is empty afterwards.

        Raises:
            RuntimeError: `start` was not called.
        """
        if not self._poses:
            raise RuntimeError("finish() before start(): there is no episode to finish.")
        episode = Episode(
            info=self._info,
            geometry=self._geometry,
            segmentation=self._segmentation,
            poses=np.stack(self._poses),
            action=_stack(self._action, (len(self._action_names),), np.float32),
            action_names=self._action_names,
            reward=np.array(self._reward, dtype=np.float32),
            terminated=np.array(self._terminated, dtype=np.bool_),
            truncated=np.array(self._truncated, dtype=np.bool_),
            evaluate=_columns_of(self._evaluate),
            cameras=[
                _track(self._cameras[key], self._pictures[key])
                for key in self._cameras
                if key in self._pictures
            ],
        )
        self._clear()
        return episode

    def _check_env(self, step: StepResult, env: int) -> None:
        num_envs, num_bodies = step.poses.shape[:2]
        if not 0 <= env < num_envs:
            raise IndexError(f"env {env} of a batch of {num_envs}: choose 0 to {num_envs - 1}.")
        if num_bodies != len(self._geometry.body_names):
            raise ValueError(
                f"poses of {num_bodies} bodies, but the scene has {len(self._geometry.body_names)}: the task was "
                "rebuilt. Start a new builder with the new scene."
            )

    def _append_state(self, step: StepResult, env: int, pictures: Iterable[Picture]) -> None:
        # Everything is checked before anything is kept, so that a step that is refused leaves no half of
        # itself behind and the episode up to it can still be finished.
        evaluate = {name: _numeric(name, values[env]) for name, values in step.evaluate.items()}
        own = [picture for picture in pictures if picture.env == env]
        for picture in own:
            self._check_picture(picture)
        self._poses.append(np.array(step.poses[env], dtype=np.float32))
        self._evaluate.append(evaluate)
        for picture in own:
            state = len(self._poses) - 1
            self._pictures.setdefault((picture.kind, picture.camera), []).append((state, picture))

    def _check_picture(self, picture: Picture) -> None:
        key = (picture.kind, picture.camera)
        if key not in self._cameras:
            known = ", ".join(f"{name} ({kind})" for kind, name in self._cameras) or "none"
            raise ValueError(
                f"picture of an unknown camera {picture.camera} ({picture.kind}); known: {known}."
            )
        info = self._cameras[key]
        for modality in MODALITIES:
            image = getattr(picture, modality)
            if image is not None and image.shape[:2] != (info.height, info.width):
                raise ValueError(
                    f"camera {info.name}: {modality} of {image.shape[1]} x {image.shape[0]}, "
                    f"but the camera is {info.width} x {info.height}."
                )
        if key in self._pictures:
            before = _given(self._pictures[key][0][1])
            if _given(picture) != before:
                raise ValueError(
                    f"camera {info.name} gave {', '.join(before)} first and now "
                    f"{', '.join(_given(picture)) or 'nothing'}; a recording keeps the same all through."
                )


def _given(picture: Picture) -> tuple[str, ...]:
    return tuple(modality for modality in MODALITIES if getattr(picture, modality) is not None)


def _numeric(name: str, value: NDArray) -> NDArray:
    """A copy of one env's value of one ``evaluate()`` entry."""
    array = np.array(value)
    if array.dtype.kind not in "biuf":
        raise ValueError(
            f"evaluate()['{name}'] has dtype {array.dtype}; a recording keeps booleans and real numbers. "
            "Return it as a tensor of numbers, or leave it out."
        )
    return array


def _stack(rows: list[NDArray], shape: tuple[int, ...], dtype: type) -> NDArray:
    """(len(rows), *shape), also where there are no rows, which `numpy.stack` refuses."""
    return np.stack(rows) if rows else np.zeros((0, *shape), dtype=dtype)


def _columns_of(rows: list[dict[str, NDArray]]) -> dict[str, NDArray]:
    """One column a name over all rows, in the order in which names first appear.

    A column that every row has in one shape keeps its type. Otherwise it becomes floating point and
    holds NaN where a row lacks it; rows of differing shape are flattened and padded with NaN.
    """
    names = dict.fromkeys(name for row in rows for name in row)
    columns: dict[str, NDArray] = {}
    for name in names:
        present = [row[name] for row in rows if name in row]
        if len(present) == len(rows) and len({value.shape for value in present}) == 1:
            columns[name] = np.stack(present)
            continue
        shape = present[0].shape
        if any(value.shape != shape for value in present):
            shape = (max(value.size for value in present),)
        dtype = np.result_type(np.float32, *(value.dtype for value in present))
        column = np.full((len(rows), *shape), np.nan, dtype=dtype)
        for index, row in enumerate(rows):
            if name in row:
                value = row[name]
                if value.shape == shape:
                    column[index] = value
                else:
                    column[index, : value.size] = value.reshape(-1)
        columns[name] = column
    return columns


def _track(info: CameraInfo, pictures: list[tuple[int, Picture]]) -> CameraTrack:
    def column(modality: str, dtype: type) -> NDArray | None:
        images = [getattr(picture, modality) for _, picture in pictures]
        return None if images[0] is None else np.stack(images).astype(dtype, copy=False)

    return CameraTrack(
        info=info,
        frame=np.array([state for state, _ in pictures], dtype=np.int64),
        pose=np.stack([picture.pose for _, picture in pictures]).astype(np.float32, copy=False),
        rgb=column("rgb", np.uint8),
        depth=column("depth", np.float32),
        segmentation=column("segmentation", np.int32),
    )
