"""Films of episodes: mp4 files, frames extracted from them, contact sheets, and frames of the 3-D view."""

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

from workbench.episodes.encoded_pictures import MAX_PIXELS, encode_jpeg
from workbench.episodes.episode import CameraTrack, Episode, camera_names, movable_bounds
from workbench.episodes.row import UnreadableRecording
from workbench.machine.files import new_file, open_regular_file
from workbench.pictures.camera_conventions import quaternion_from_axes, quaternion_of, triple, upright

MAX_FRAMES = 100_000
"""Maximum number of frames of a `FilmPart`."""
MAX_BYTES = 1 << 29
"""Maximum size of all JPEG frames of a `FilmPart` together."""
FFMPEG_TIMEOUT_SECONDS = 60.0
"""Timeout of ffmpeg for extracting the frames of a `FilmPart`."""


@dataclass(frozen=True)
class Encoding:
    """Settings of an mp4; the defaults are for films that people watch."""

    crf: int = 18
    """H.264's constant rate factor: a lower one gives better quality; 18 is visually almost lossless."""
    key_every: int | None = None
    """Interval of key frames, in frames; None for the encoder's default. A long interval makes seeking slow."""
    exact_size: bool = False
    """If True, keep an odd width or height, which needs a pixel format that some players do not support. If
    False, pad it by a pixel."""


def write_mp4(
    path: Path,
    frames: Iterable[NDArray[np.uint8]],
    fps: float,
    encoding: Encoding = Encoding(),
    comment: str = "",
) -> int:
    """Write the frames to a new file at `path`; returns their number.

    Args:
        path: must not exist.
        frames: (H, W, 3) each, all of the same size.
        fps: frames per second.
        comment: comment in the file's metadata.

    Raises:
        ValueError: there is no frame, or the frames differ in size.
        OSError: the file cannot be written.
    """
    coming = iter(frames)
    first = next(coming, None)
    if first is None:
        raise ValueError("There is no picture to make a film of.")
    with new_file(path) as temporary, FilmWriter(temporary, first.shape, fps, encoding, comment) as film:
        film.add(first)
        for frame in coming:
            film.add(frame)
    return len(film)


class FilmWriter:
    """Writes frames to an mp4 (H.264) with an ffmpeg process; raises as `write_mp4` does.

    ffmpeg comes with imageio-ffmpeg, a dependency of ManiSkill. A separate process encodes on another core,
    and its error messages can be read. Frames go through a pipe, so memory use does not grow with the film.

    As a context manager, the writer finishes the file at the end of the block, or kills ffmpeg if the block
    raised.
    """

    def __init__(
        self, path: Path, shape: tuple[int, ...], fps: float, encoding: Encoding, comment: str = ""
    ) -> None:
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
        # Every player supports colour at half resolution, which needs an even size.
        command += ["yuv444p" if odd and encoding.exact_size else "yuv420p", "-movflags", "+faststart"]
        command += [] if encoding.key_every is None else ["-g", str(encoding.key_every), "-bf", "0"]
        command += ["-metadata", f"comment={comment}"] if comment else []
        self._stderr = tempfile.TemporaryFile()
        self._process = subprocess.Popen(
            [*command, "-f", "mp4", str(path)],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=self._stderr,
            # In its own session: if Ctrl-C reached ffmpeg, ffmpeg would finish the file as if it were
            # complete.
            start_new_session=True,
        )

    def __enter__(self) -> FilmWriter:
        return self

    def add(self, frame: NDArray[np.uint8]) -> None:
        if frame.shape != self._shape:
            raise ValueError(f"A picture has the shape {frame.shape}, but the first one has {self._shape}.")
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
        """Number of frames added so far."""
        return self._count

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        self.close(abandoned=error is not None)

    def close(self, abandoned: bool = False) -> None:
        """Finish the file, or kill ffmpeg if `abandoned`. May be called twice."""
        if self._stderr.closed:
            return
        assert self._process.stdin is not None
        try:
            if abandoned:
                self._process.kill()
            try:
                self._process.stdin.close()
            except OSError:
                pass  # ffmpeg has ended; its exit status is checked below
            if self._process.wait() and not abandoned:
                raise self._error()
        finally:
            self._stderr.close()

    def _error(self) -> OSError:
        self._stderr.seek(0)
        lines = self._stderr.read().decode(errors="replace").strip().splitlines()
        # The last line begins with the temporary file's name and ends with the reason.
        reason = lines[-1].rpartition(": ")[2] if lines else f"ffmpeg ended with {self._process.returncode}"
        return OSError(f"The film could not be written: {reason}.")


# --- frames of a film ------------------------------------------------------------------------------


class FilmPart:
    """The frames of a part of a film as JPEG; all are extracted on the first access."""

    def __init__(self, film: Path, begin: float, count: int, fps: float) -> None:
        """`begin` in seconds, `count` in frames. Raises ValueError if they are out of range."""
        if not 0 <= count <= MAX_FRAMES or not 0 <= begin < 1e9 or not 0 < fps < 1e6:
            raise ValueError(
                f"it claims {count} frames of {film.name} from {begin} s on, at {fps} per second"
            )
        self._film, self._begin, self._count, self._fps = film, begin, count, fps
        self._blobs: list[bytes] | None = None
        self._taking = threading.Lock()

    def one(self, number: int) -> bytes:
        """Frame `number`. Raises UnreadableRecording if the film cannot be read."""
        with self._taking:
            if self._blobs is None:
                self._blobs = self._extract()
        return self._blobs[number]

    def _extract(self) -> list[bytes]:
        blobs: list[bytes] = []
        size = 0
        try:
            # Start half a frame early, or rounding may skip the first frame.
            for frame in film_frames(self._film, max(0.0, self._begin - 0.5 / self._fps), self._count):
                blobs.append(encode_jpeg(frame))
                size += len(blobs[-1])
                if size > MAX_BYTES:
                    raise OSError(f"its frames take more than {MAX_BYTES >> 20} MB")
        except (OSError, ValueError) as error:
            raise UnreadableRecording(f"The film {self._film.name} cannot be read: {error}") from error
        if len(blobs) < self._count:
            raise UnreadableRecording(
                f"The film {self._film.name} ends after {len(blobs)} of the {self._count} frames of this episode."
            )
        return blobs


def film_frames(film: Path, begin: float, count: int) -> Iterator[NDArray[np.uint8]]:
    """At most `count` frames (H, W, 3) from `begin` seconds on.

    An untrusted ``.mp4`` may be a playlist that names other files and URLs, or claim pictures of any
    size. So ffmpeg gets a fixed format, may open files but no URLs, and has limits on pixels, frames and
    time. It outputs PPM, which contains the size of each frame.

    Raises:
        OSError: the film cannot be read as MP4, or ffmpeg takes too long.
    """
    open_regular_file(film).close()
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-nostdin", "-v", "error", "-max_alloc", str(1 << 29)]
    # "mov" is MP4's demuxer: it refuses a playlist that has the suffix .mp4.
    command += ["-protocol_whitelist", "file", "-f", "mov", "-threads", "1", "-max_pixels", str(MAX_PIXELS)]
    command += ["-ss", f"{begin:.6f}", "-i", f"file:{film}", "-map", "0:v:0", "-frames:v", str(count)]
    command += ["-f", "image2pipe", "-c:v", "ppm", "-pix_fmt", "rgb24", "-"]
    # In memory: confined readers may not write files.
    with os.fdopen(os.memfd_create("ffmpeg"), "w+b") as stderr:
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=stderr)
        late = threading.Timer(FFMPEG_TIMEOUT_SECONDS, process.kill)
        late.start()
        try:
            assert isinstance(process.stdout, io.BufferedReader)
            resource.prlimit(
                process.pid, resource.RLIMIT_CPU, (int(FFMPEG_TIMEOUT_SECONDS), int(FFMPEG_TIMEOUT_SECONDS))
            )
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
    """The next picture (H, W, 3) of ffmpeg's output; None at the end. Raises OSError."""
    if not (magic := stream.readline(16)):
        return None
    size = stream.readline(32).split()
    if magic != b"P6\n" or len(size) != 2 or stream.readline(16) != b"255\n":
        raise OSError("ffmpeg's output is not a PPM picture")
    width, height = int(size[0]), int(size[1])
    if not 0 < width * height <= MAX_PIXELS:
        raise OSError(f"it has pictures of {width} x {height} pixels")
    content = stream.read(3 * width * height)
    if len(content) < 3 * width * height:
        return None
    return np.frombuffer(content, np.uint8).reshape(height, width, 3)


def _failure(stderr: BinaryIO, status: int) -> str:
    if status < 0:
        return f"ffmpeg was killed by signal {-status} (its timeout is {FFMPEG_TIMEOUT_SECONDS:.0f} s)"
    stderr.seek(0)
    lines = stderr.read(4096).decode(errors="replace").strip().splitlines()
    return lines[-1][:200] if lines else f"ffmpeg ended with {status}"


# --- pictures of an episode's cameras ---------------------------------------------------------------

MIN_SIDE_PIXELS = 256
"""Minimum length of a film's shorter side. Players blur pictures of 128 pixels, a usual size for policies, so
each pixel of a small picture is repeated."""
COLUMNS = 8
CELL_PIXELS = 176
"""Longer side of a picture on the sheet."""
GAP, HEAD, CAPTION = 8, 34, 18
PAPER, INK, PALE = (255, 255, 255), (33, 37, 41), (110, 118, 126)
GOOD, BAD = (43, 138, 62), (201, 42, 42)


def cameras_by_name(episode: Episode) -> dict[str, CameraTrack]:
    """The cameras with colour pictures by their unique names (`camera_names`), sensors first."""
    seen = [camera for camera in episode.cameras if camera.rgb is not None and len(camera.rgb)]
    seen.sort(key=lambda camera: camera.info.kind != "sensor")
    return dict(zip(camera_names([camera.info for camera in seen]), seen))


def camera_of(episode: Episode, name: str) -> CameraTrack:
    """The camera of that name.

    Raises:
        ValueError: no camera with pictures has that name; the message lists the cameras with pictures.
    """
    cameras = cameras_by_name(episode)
    if name not in cameras:
        there = f"it has {', '.join(cameras)}" if cameras else "it was recorded without pictures"
        raise ValueError(f"The recording of {episode.info.task} has no camera {name!r}: {there}.")
    return cameras[name]


def picture_index(camera: CameraTrack, state: int) -> int:
    """Index of the newest picture up to `state`; of the first picture if all pictures are later."""
    return max(int(np.searchsorted(camera.frame, state, side="right")) - 1, 0)


def frames(episode: Episode, camera: CameraTrack) -> Iterator[NDArray[np.uint8]]:
    """One picture (H, W, 3) per state; a state without a picture repeats the previous one."""
    assert camera.rgb is not None, "`cameras_by_name` returns only cameras with colour pictures"
    last, picture = -1, None
    for state in range(episode.length + 1):
        index = picture_index(camera, state)
        if picture is None or index != last:
            last, picture = index, camera.rgb[index]
        yield picture


def enlarged(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """`picture` with every pixel repeated until its smaller side has at least `MIN_SIDE_PIXELS` pixels."""
    times = -(-MIN_SIDE_PIXELS // min(picture.shape[:2]))
    return picture if times <= 1 else picture.repeat(times, axis=0).repeat(times, axis=1)


# --- contact sheet ---------------------------------------------------------------------------------


def contact_sheet(episode: Episode, columns: int = COLUMNS) -> Image.Image:
    """Pictures of every camera at `columns` states on one sheet, a row per camera.

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
        heights.append(max(1, round(height * CELL_PIXELS / max(width, height))))
    sheet = Image.new(
        "RGB",
        (
            GAP + len(states) * (CELL_PIXELS + GAP),
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
            left = GAP + column * (CELL_PIXELS + GAP)
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
    """At most `columns` evenly spaced states. The first state with success, and then the first with fail,
    each replace the nearest state that is neither the first nor the last."""
    states = sorted(set(np.linspace(0, episode.length, columns).round().astype(int).tolist()))
    for name in ("success", "fail"):
        moment = _first(episode, name)
        if moment is not None and moment not in states and len(states) > 2:
            inner = states[1:-1]
            states[states.index(min(inner, key=lambda state: abs(state - moment)))] = moment
            states.sort()
    return states


def _first(episode: Episode, name: str) -> int | None:
    """The first state in which this entry of ``evaluate()`` is true; None if there is none."""
    flag = episode.flag(name)
    return None if flag is None or not flag.any() else int(flag.argmax())


def _title(episode: Episode) -> str:
    info = episode.info
    seed = f"   seed {info.seed}" if info.seed >= 0 else ""
    success = episode.flag("success")
    ended = "" if success is None else "   success" if success[-1] else "   no success"
    total = float(np.sum(episode.reward, dtype=np.float64))
    return f"{info.task}{seed}   {episode.length} steps   return {total:.2f}{ended}"


# --- frames of the 3-D view ------------------------------------------------------------------------

SIZE_PIXELS = (960, 720)
"""Width and height."""
FOVY_RADIANS = 0.75
"""Vertical field of view, as in the page's 3-D view."""
FROM_THE_FRONT = np.array([1.0, 0.55, 0.75])
"""Direction from the scene to the camera: ManiSkill's robots face +x."""


@dataclass(frozen=True)
class FilmEye:
    """A fixed camera; positions are in metres in the env's frame."""

    position: tuple[float, float, float]
    look_at: tuple[float, float, float]
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    fovy: float = FOVY_RADIANS

    @property
    def pose(self) -> NDArray[np.float32]:
        """(7,) position and wxyz in ManiSkill's camera frame: x forward, y left, z up."""
        forward = np.subtract(self.look_at, self.position)
        try:
            quaternion = quaternion_from_axes(forward, self.up)
        except ValueError:  # straight up or down
            quaternion = quaternion_of(upright(forward))
        return np.concatenate([self.position, quaternion]).astype(np.float32)


def default_eye(episode: Episode) -> FilmEye:
    """The recorded human-render camera, or else a camera that sees all movable bodies."""
    for camera in episode.cameras:
        if camera.info.kind == "human" and len(camera.pose):
            position, forward = camera.pose[0, :3], quat2mat(camera.pose[0, 3:])[:, 0]
            look_at = position + forward
            return FilmEye(triple(position), triple(look_at), fovy=float(camera.info.fovy))
    assert episode.poses is not None and episode.geometry is not None
    low, high = movable_bounds(episode.poses, episode.geometry.body_kinds)
    middle = (low + high) / 2
    # The box holds origins of bodies, not their outlines: leave a margin.
    radius = max(float(np.linalg.norm(high - low)) / 2, 0.25) * 1.1
    direction = FROM_THE_FRONT / np.linalg.norm(FROM_THE_FRONT)
    return FilmEye(triple(middle + direction * radius / np.sin(FOVY_RADIANS / 2)), triple(middle))


def scene_frames(episode: Episode, eye: FilmEye | None = None) -> Iterator[NDArray[np.uint8]]:
    """One picture (H, W, 3) per state, rendered by SAPIEN from the recorded meshes and poses.

    Must be called in a job process: the server imports no renderer.

    Raises:
        ValueError: the recording holds no scene.
        RuntimeError: this machine has no render device.
    """
    from workbench.pictures.render_recorded import RecordedScene

    if episode.geometry is None or episode.poses is None:
        raise ValueError(f"The recording of {episode.info.task} holds no 3-D scene to film.")
    eye = eye or default_eye(episode)
    # A scene from a file holds this env alone, as env 0 of 1; a scene in memory may hold the batch.
    env = 0 if episode.geometry.num_envs == 1 else episode.info.env_index
    scene = RecordedScene(episode.geometry, env, *SIZE_PIXELS, eye.fovy)
    for poses in episode.poses:
        yield scene.picture(poses, eye.pose)
