"""The frames of a part of a film as pictures, taken out by an ffmpeg that reads that one file and nothing else.

A ``.mp4`` may be a playlist that names other files and addresses, or claim pictures of any size. So ffmpeg is told the
format, may open files alone, and has limits on pixels, frames and time. Frames come as PPM, which says with each how
large it is.
"""

from __future__ import annotations

import io
import os
import resource
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import imageio_ffmpeg
import numpy as np
from numpy.typing import NDArray

from workbench.machine.regular_file import open_regular_file
from workbench.recording.encoded_pictures import MOST_PIXELS, LazyPictures, encode_jpeg
from workbench.recording.sources import UnreadableRecording

MOST_FRAMES = 100_000
MOST_BYTES = 1 << 29
"""Of all frames of one part, encoded."""
MOST_SECONDS = 60.0
"""Of ffmpeg, for one part."""


class FilmPictures(LazyPictures):
    """The frames of a part of a film as JPEG; all of the part is taken out when one is first asked for."""

    def __init__(self, film: Path, begin: float, count: int, fps: float) -> None:
        """Raises ValueError where no film has such a part."""
        if not 0 <= count <= MOST_FRAMES or not 0 <= begin < 1e9 or not 0 < fps < 1e6:
            raise ValueError(f"it claims {count} frames from {begin} s on, {fps} a second, of {film.name}")
        self._film, self._begin, self._count, self._fps = film, begin, count, fps
        self._blobs: list[bytes] | None = None
        self._taking = threading.Lock()

    def __len__(self) -> int:
        return self._count

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
    with os.fdopen(os.memfd_create("ffmpeg"), "w+b") as said:
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=said)
        late = threading.Timer(MOST_SECONDS, process.kill)
        late.start()
        try:
            assert isinstance(process.stdout, io.BufferedReader)
            resource.prlimit(process.pid, resource.RLIMIT_CPU, (int(MOST_SECONDS), int(MOST_SECONDS)))
            while (frame := _read_ppm(process.stdout)) is not None:
                yield frame
            if (status := process.wait()) != 0:
                raise OSError(_why(said, status))
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


def _why(said: BinaryIO, status: int) -> str:
    if status < 0:
        return f"ffmpeg was ended by signal {-status}, after {MOST_SECONDS:.0f} s at most"
    said.seek(0)
    lines = said.read(4096).decode(errors="replace").strip().splitlines()
    return lines[-1][:200] if lines else f"ffmpeg ended with {status}"
