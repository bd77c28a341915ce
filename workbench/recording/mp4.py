"""Frames in, one mp4 out: H.264, as every player, browser and messenger shows it.

ffmpeg comes with imageio-ffmpeg, which ManiSkill brings along anyway; PyAV would be one more thing to install. As a
process of its own it encodes on another core, and what it says when it fails can be read. It gets the frames through
a pipe, one at a time, so an hour of film takes no more memory than a second.
"""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import imageio_ffmpeg
import numpy as np
from numpy.typing import NDArray

from workbench.machine.atomic_files import new_file


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
        self._said = tempfile.TemporaryFile()
        self._process = subprocess.Popen(
            [*command, "-f", "mp4", str(path)],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=self._said,
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
        if self._said.closed:
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
            self._said.close()

    def _error(self) -> OSError:
        self._said.seek(0)
        lines = self._said.read().decode(errors="replace").strip().splitlines()
        # Its last line names the temporary file; the reason stands at the end.
        reason = lines[-1].rpartition(": ")[2] if lines else f"ffmpeg ended with {self._process.returncode}"
        return OSError(f"The film could not be written: {reason}.")
