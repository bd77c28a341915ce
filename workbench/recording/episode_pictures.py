"""An episode as pictures: what its cameras saw, frame by frame or on one sheet, a row a camera; and its 3-D view as frames,
drawn without a browser from the recorded meshes and poses.

SAPIEN draws that (`workbench.core.recorded_scene`), on a graphics card or in software, so it belongs into a process of its
own: the one that serves the page imports no renderer.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from transforms3d.quaternions import quat2mat

from workbench.core.camera_frames import quaternion_from_axes, quaternion_of, triple, upright
from workbench.recording.episode import CameraTrack, Episode, box_of_moving, camera_names

SMALLEST_SIDE = 256
"""Pixels. What a policy sees is often 128 wide, which no player shows well; whole pixels are repeated."""
COLUMNS = 8
CELL = 176
"""Pixels of a picture's longer side."""
GAP, HEAD, CAPTION = 8, 34, 18
PAPER, INK, PALE = (255, 255, 255), (33, 37, 41), (110, 118, 126)
GOOD, BAD = (43, 138, 62), (201, 42, 42)


def cameras_by_name(episode: Episode) -> dict[str, CameraTrack]:
    """The cameras that have colour pictures, by their `camera_names`; sensors first."""
    seen = [camera for camera in episode.cameras if camera.rgb is not None and len(camera.rgb)]
    seen.sort(key=lambda camera: camera.info.kind != "sensor")
    return dict(zip(camera_names([camera.info for camera in seen]), seen))


def camera_of(episode: Episode, name: str) -> CameraTrack:
    """The camera of that name.

    Raises:
        ValueError: there is none with pictures; the message says which there are.
    """
    cameras = cameras_by_name(episode)
    if name not in cameras:
        there = f"it has {', '.join(cameras)}" if cameras else "it was recorded without pictures"
        raise ValueError(f"The recording of {episode.info.task} has no camera {name!r}: {there}.")
    return cameras[name]


def picture_index(camera: CameraTrack, state: int) -> int:
    """The newest picture at `state`; the first where there is none yet."""
    return max(int(np.searchsorted(camera.frame, state, side="right")) - 1, 0)


def frames(episode: Episode, camera: CameraTrack) -> Iterator[NDArray[np.uint8]]:
    """One picture (H, W, 3) a state; a state of which there is none shows the one before."""
    assert camera.rgb is not None, "`cameras_by_name` gives only cameras that have colour"
    last, picture = -1, None
    for state in range(episode.length + 1):
        index = picture_index(camera, state)
        if picture is None or index != last:
            last, picture = index, camera.rgb[index]
        yield picture


def enlarged(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """`picture` with every pixel repeated until its smaller side has `SMALLEST_SIDE` pixels or more."""
    times = -(-SMALLEST_SIDE // min(picture.shape[:2]))
    return picture if times <= 1 else picture.repeat(times, axis=0).repeat(times, axis=1)


# --- on one picture --------------------------------------------------------------------------------


def contact_sheet(episode: Episode, columns: int = COLUMNS) -> Image.Image:
    """The sheet.

    Raises:
        ValueError: the episode was recorded without pictures.
    """
    cameras = cameras_by_name(episode)
    if not cameras:
        raise ValueError(
            f"The recording of {episode.info.task} has no camera pictures to make a sheet of; record it with pictures."
        )
    states = chosen_states(episode, columns)
    heights = []
    for camera in cameras.values():
        width, height = camera.info.width, camera.info.height
        heights.append(max(1, round(height * CELL / max(width, height))))
    sheet = Image.new(
        "RGB",
        (
            GAP + len(states) * (CELL + GAP),
            HEAD + sum(CAPTION + height + CAPTION + GAP for height in heights),
        ),
        PAPER,
    )
    draw = ImageDraw.Draw(sheet)
    large, small = ImageFont.load_default(15), ImageFont.load_default(12)
    draw.text((GAP, GAP), _title(episode), fill=INK, font=large)
    top, first_success = HEAD, _first(episode, "success")
    for (name, camera), height in zip(cameras.items(), heights):
        draw.text((GAP, top), name, fill=PALE, font=small)
        top += CAPTION
        assert camera.rgb is not None
        for column, state in enumerate(states):
            left = GAP + column * (CELL + GAP)
            picture = Image.fromarray(camera.rgb[picture_index(camera, state)])
            width = max(1, round(picture.width * height / picture.height))
            # Small pictures keep their pixels; large ones are averaged.
            how = Image.Resampling.NEAREST if picture.height < height else Image.Resampling.LANCZOS
            sheet.paste(picture.resize((width, height), how), (left, top))
            said = f"step {state}   {state * episode.info.control_dt:.2f} s"
            colour = PALE
            if state == first_success:
                said, colour = said + "   success", GOOD
            elif state == _first(episode, "fail"):
                said, colour = said + "   fail", BAD
            draw.text((left, top + height + 2), said, fill=colour, font=small)
        top += height + CAPTION + GAP
    return sheet


def chosen_states(episode: Episode, columns: int) -> list[int]:
    """`columns` states or fewer from the first to the last, evenly; the first success or fail in place of its neighbour."""
    states = sorted(set(np.linspace(0, episode.length, columns).round().astype(int).tolist()))
    for name in ("success", "fail"):
        moment = _first(episode, name)
        if moment is not None and moment not in states and len(states) > 2:
            inner = states[1:-1]
            states[states.index(min(inner, key=lambda state: abs(state - moment)))] = moment
            states.sort()
    return states


def _first(episode: Episode, name: str) -> int | None:
    """The first state at which this entry of ``evaluate()`` was true."""
    flag = episode.flag(name)
    return None if flag is None or not flag.any() else int(flag.argmax())


def _title(episode: Episode) -> str:
    info = episode.info
    seed = f"   seed {info.seed}" if info.seed >= 0 else ""
    success = episode.flag("success")
    ended = "" if success is None else "   success" if success[-1] else "   no success"
    total = float(np.sum(episode.reward, dtype=np.float64))
    return f"{info.task}{seed}   {episode.length} steps   return {total:.2f}{ended}"


# --- its 3-D view ----------------------------------------------------------------------------------

SIZE = (960, 720)
"""Width and height in pixels."""
FOVY = 0.75
"""Radians, vertical; the page's own."""
FROM_THE_FRONT = np.array([1.0, 0.55, 0.75])
"""ManiSkill's robots look along +x, so their front is seen from there."""


@dataclass(frozen=True)
class Eye:
    """A camera that does not move."""

    position: tuple[float, float, float]
    look_at: tuple[float, float, float]
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    fovy: float = FOVY

    @property
    def pose(self) -> NDArray[np.float32]:
        """(7,) position and wxyz in ManiSkill's camera frame: x forward, y left, z up."""
        forward = np.subtract(self.look_at, self.position)
        try:
            quaternion = quaternion_from_axes(forward, self.up)
        except ValueError:  # straight up or down
            quaternion = quaternion_of(upright(forward))
        return np.concatenate([self.position, quaternion]).astype(np.float32)


def usual_eye(episode: Episode) -> Eye:
    """The recorded human-render camera's where there is one, else one that has all that moves in view."""
    for camera in episode.cameras:
        if camera.info.kind == "human" and len(camera.pose):
            position, forward = camera.pose[0, :3], quat2mat(camera.pose[0, 3:])[:, 0]
            look_at = position + forward
            return Eye(triple(position), triple(look_at), fovy=float(camera.info.fovy))
    assert episode.poses is not None and episode.geometry is not None
    low, high = box_of_moving(episode.poses, episode.geometry.body_kinds)
    middle = (low + high) / 2
    # Origins of bodies, not their outlines: half as far again holds a hand or a cube around its origin.
    radius = max(float(np.linalg.norm(high - low)) / 2, 0.25) * 1.1
    direction = FROM_THE_FRONT / np.linalg.norm(FROM_THE_FRONT)
    return Eye(triple(middle + direction * radius / np.sin(FOVY / 2)), triple(middle))


def scene_frames(episode: Episode, eye: Eye | None = None) -> Iterator[NDArray[np.uint8]]:
    """One picture (H, W, 3) a state.

    Raises:
        ValueError: the recording holds no scene.
        RuntimeError: this machine has nothing to render with.
    """
    from workbench.core.recorded_scene import RecordedScene

    if episode.geometry is None or episode.poses is None:
        raise ValueError(f"The recording of {episode.info.task} holds no 3-D scene to film.")
    eye = eye or usual_eye(episode)
    # A recording that was read holds its env alone, as env 0 of 1; one in memory may still hold the batch.
    env = 0 if episode.geometry.num_envs == 1 else episode.info.env_index
    scene = RecordedScene(episode.geometry, env, *SIZE, eye.fovy)
    for poses in episode.poses:
        yield scene.picture(poses, eye.pose)
