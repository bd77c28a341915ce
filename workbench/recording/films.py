"""Films: frames in, one mp4 out (H.264, as every player, browser and messenger shows it); and frames out of a part of one.

ffmpeg comes with imageio-ffmpeg, which ManiSkill brings along anyway; PyAV would be one more thing to install. As a
process of its own it encodes on another core, and what it says when it fails can be read. It gets the frames through
a pipe, one at a time, so an hour of film takes no more memory than a second.

A ``.mp4`` that somebody was sent may be a playlist that names other files and addresses, or claim pictures of any size. So
the ffmpeg that takes one apart is told the format, may open files alone, and has limits on pixels, frames and time.
Frames come as PPM, which says with each how large it is.

drawn without a browser from the recorded meshes and poses.

SAPIEN draws that (`workbench.core.cameras.render_recorded`), on a graphics card or in software, so it belongs into a process of its
own: the one that serves the page imports no renderer.
"""

from __future__ import annotations

import io
import os
import resource
import subprocess
import tempfile
import threading
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import BinaryIO

import imageio_ffmpeg
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from transforms3d.quaternions import quat2mat

from workbench.core.cameras.conventions import quaternion_from_axes, quaternion_of, triple, upright
from workbench.machine.files import new_file, open_regular_file
from workbench.recording.episode.encoded_pictures import MOST_PIXELS, encode_jpeg
from workbench.recording.episode.episode import CameraTrack, Episode, box_of_moving, camera_names
from workbench.recording.episode.row import UnreadableRecording

MOST_FRAMES = 100_000
MOST_BYTES = 1 << 29
"""Of all frames of one part, encoded."""
MOST_SECONDS = 60.0
"""Of ffmpeg, for one part."""


@dataclass(frozen=True)
class Encoding:
    """How an mp4 is made; the usual one is for people."""

    crf: int = 18
    """H.264's measure of loss; 18 can hardly be told from the frames themselves."""
    key_every: int | None = None
    """Frames between two that are whole; None leaves it to the encoder. Few make seeking slow."""
    exact_size: bool = False
    """Keep an odd width or height, at the price of a pixel format that not every player has; else a row is added."""


def write_mp4(
    path: Path, frames: Iterable[NDArray[np.uint8]], fps: float, encoding: Encoding = Encoding()
) -> int:
    """Write the frames to a new file at `path`; returns how many there were.

    Args:
        path: where; must not exist.
        frames: (H, W, 3) each, all of one size.
        fps: frames a second.
        encoding: how.

    Raises:
        ValueError: there is no frame, or one has another size.
        OSError: it cannot be written there; the message says why.
    """
    coming = iter(frames)
    first = next(coming, None)
    if first is None:
        raise ValueError("There is no picture to make a film of.")
    with new_file(path) as temporary, FilmWriter(temporary, first.shape, fps, encoding) as film:
        film.add(first)
        for frame in coming:
            film.add(frame)
    return len(film)


class FilmWriter:
    """An ffmpeg that writes an mp4 at `path` and takes frames until `close`; see `write_mp4` for what is raised.

    As a context it closes at the end of the block, and ends ffmpeg at once where the block raised.
    """

    def __init__(self, path: Path, shape: tuple[int, ...], fps: float, encoding: Encoding) -> None:
        self._shape, self._count = shape, 0
        height, width = shape[:2]
        odd = bool(height % 2 or width % 2)
        self._pad = odd and not encoding.exact_size
        height, width = (height + height % 2, width + width % 2) if self._pad else (height, width)
        rate = Fraction(fps).limit_denominator(1000)
        command = [
            imageio_ffmpeg.get_ffmpeg_exe(),
            "-y",
            "-loglevel",
            "error",
            "-f",
            "rawvideo",
            "-pix_fmt",
            "rgb24",
        ]
        command += ["-s", f"{width}x{height}", "-r", f"{rate.numerator}/{rate.denominator}", "-i", "-"]
        command += ["-c:v", "libx264", "-crf", str(encoding.crf), "-pix_fmt"]
        # Half resolution of colour is what all players have; it needs an even size.
        command += ["yuv444p" if odd and encoding.exact_size else "yuv420p", "-movflags", "+faststart"]
        command += [] if encoding.key_every is None else ["-g", str(encoding.key_every), "-bf", "0"]
        self._stderr = tempfile.TemporaryFile()
        self._process = subprocess.Popen(
            [*command, "-f", "mp4", str(path)],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=self._stderr,
            # Ctrl-C is for us; ffmpeg would end the file as if all were well.
            start_new_session=True,
        )

    def __enter__(self) -> FilmWriter:
        return self

    def add(self, frame: NDArray[np.uint8]) -> None:
        if frame.shape != self._shape:
            raise ValueError(f"A picture has the shape {frame.shape} where the first had {self._shape}.")
        if self._pad:
            height, width = frame.shape[:2]
            frame = np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(np.ascontiguousarray(frame).data)
        except OSError:
            self._process.wait()
            raise self._error() from None
        self._count += 1

    def __len__(self) -> int:
        """Frames so far."""
        return self._count

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        self.close(abandoned=error is not None)

    def close(self, abandoned: bool = False) -> None:
        """Finish the file; one that is `abandoned` is left as it is. Can be called twice."""
        if self._stderr.closed:
            return
        assert self._process.stdin is not None
        try:
            if abandoned:
                self._process.kill()
            try:
                self._process.stdin.close()
            except OSError:
                pass  # it is gone; its exit status says why
            if self._process.wait() and not abandoned:
                raise self._error()
        finally:
            self._stderr.close()

    def _error(self) -> OSError:
        self._stderr.seek(0)
        lines = self._stderr.read().decode(errors="replace").strip().splitlines()
        # Its last line names the temporary file; the reason stands at the end.
        reason = lines[-1].rpartition(": ")[2] if lines else f"ffmpeg ended with {self._process.returncode}"
        return OSError(f"The film could not be written: {reason}.")


# --- taken apart -----------------------------------------------------------------------------------


class FilmPart:
    """The frames of a part of a film as JPEG; all of the part is taken out when one is first asked for."""

    def __init__(self, film: Path, begin: float, count: int, fps: float) -> None:
        """Raises ValueError where no film has such a part."""
        if not 0 <= count <= MOST_FRAMES or not 0 <= begin < 1e9 or not 0 < fps < 1e6:
            raise ValueError(f"it claims {count} frames from {begin} s on, {fps} a second, of {film.name}")
        self._film, self._begin, self._count, self._fps = film, begin, count, fps
        self._blobs: list[bytes] | None = None
        self._taking = threading.Lock()

    def one(self, number: int) -> bytes:
        """Raises UnreadableRecording where the film cannot be read."""
        with self._taking:
            if self._blobs is None:
                self._blobs = self._take_out()
        return self._blobs[number]

    def _take_out(self) -> list[bytes]:
        blobs: list[bytes] = []
        size = 0
        try:
            # Half a frame early, so that rounding cannot skip the first one.
            for frame in film_frames(self._film, max(0.0, self._begin - 0.5 / self._fps), self._count):
                blobs.append(encode_jpeg(frame))
                size += len(blobs[-1])
                if size > MOST_BYTES:
                    raise OSError(f"its frames have more than {MOST_BYTES >> 20} MB")
        except (OSError, ValueError) as error:
            raise UnreadableRecording(f"The film {self._film.name} cannot be read: {error}") from error
        if len(blobs) < self._count:
            raise UnreadableRecording(
                f"The film {self._film.name} ends after {len(blobs)} of the {self._count} frames of this episode."
            )
        return blobs


def film_frames(film: Path, begin: float, count: int) -> Iterator[NDArray[np.uint8]]:
    """At most `count` frames (H, W, 3) from `begin` seconds on.

    Raises:
        OSError: it is no MP4 that can be read, or took too long.
    """
    open_regular_file(film).close()
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-nostdin", "-v", "error", "-max_alloc", str(1 << 29)]
    # "mov" is the format of MP4: a playlist that is called so is none.
    command += ["-protocol_whitelist", "file", "-f", "mov", "-threads", "1", "-max_pixels", str(MOST_PIXELS)]
    command += ["-ss", f"{begin:.6f}", "-i", f"file:{film}", "-map", "0:v:0", "-frames:v", str(count)]
    command += ["-f", "image2pipe", "-c:v", "ppm", "-pix_fmt", "rgb24", "-"]
    # In memory: who reads recordings of others writes no files.
    with os.fdopen(os.memfd_create("ffmpeg"), "w+b") as stderr:
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=stderr)
        late = threading.Timer(MOST_SECONDS, process.kill)
        late.start()
        try:
            assert isinstance(process.stdout, io.BufferedReader)
            resource.prlimit(process.pid, resource.RLIMIT_CPU, (int(MOST_SECONDS), int(MOST_SECONDS)))
            while (frame := _read_ppm(process.stdout)) is not None:
                yield frame
            if (status := process.wait()) != 0:
                raise OSError(_failure(stderr, status))
        finally:
            late.cancel()
            process.kill()
            process.wait()
            if process.stdout is not None:
                process.stdout.close()


def _read_ppm(stream: io.BufferedReader) -> NDArray[np.uint8] | None:
    """None at the end."""
    if not (magic := stream.readline(16)):
        return None
    size = stream.readline(32).split()
    if magic != b"P6\n" or len(size) != 2 or stream.readline(16) != b"255\n":
        raise OSError("ffmpeg gave something that is no picture")
    width, height = int(size[0]), int(size[1])
    if not 0 < width * height <= MOST_PIXELS:
        raise OSError(f"it has pictures of {width} x {height}")
    content = stream.read(3 * width * height)
    if len(content) < 3 * width * height:
        return None
    return np.frombuffer(content, np.uint8).reshape(height, width, 3)


def _failure(stderr: BinaryIO, status: int) -> str:
    if status < 0:
        return f"ffmpeg was ended by signal {-status}, after {MOST_SECONDS:.0f} s at most"
    stderr.seek(0)
    lines = stderr.read(4096).decode(errors="replace").strip().splitlines()
    return lines[-1][:200] if lines else f"ffmpeg ended with {status}"


# --- An episode as pictures: what its cameras saw, frame by frame or on one sheet, a row a camera; and its 3-D view as frames, ---


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
            label = f"step {state}   {state * episode.info.control_dt:.2f} s"
            colour = PALE
            if state == first_success:
                label, colour = label + "   success", GOOD
            elif state == _first(episode, "fail"):
                label, colour = label + "   fail", BAD
            draw.text((left, top + height + 2), label, fill=colour, font=small)
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


def default_eye(episode: Episode) -> Eye:
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
    from workbench.core.cameras.render_recorded import RecordedScene

    if episode.geometry is None or episode.poses is None:
        raise ValueError(f"The recording of {episode.info.task} holds no 3-D scene to film.")
    eye = eye or default_eye(episode)
    # A recording that was read holds its env alone, as env 0 of 1; one in memory may still hold the batch.
    env = 0 if episode.geometry.num_envs == 1 else episode.info.env_index
    scene = RecordedScene(episode.geometry, env, *SIZE, eye.fovy)
    for poses in episode.poses:
        yield scene.picture(poses, eye.pose)
