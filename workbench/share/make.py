"""Makes films, animated 3-D pages, sheets of pictures and datasets from recordings, in a separate process."""

from __future__ import annotations

import asyncio
import contextlib
import os
import shutil
import signal
import tempfile
import time
import zipfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import FrameType

import numpy as np
from numpy.typing import NDArray
from PIL.PngImagePlugin import PngInfo

from workbench.envs.camera_data import moved_cameras_text
from workbench.episodes.episode import Episode, file_part
from workbench.episodes.films import (
    FilmEye,
    camera_of,
    cameras_by_name,
    contact_sheet,
    enlarged,
    frames,
    scene_frames,
    write_mp4,
)
from workbench.episodes.lerobot.export import ExportOptions, export_lerobot
from workbench.episodes.maniskill.export import export_maniskill
from workbench.episodes.reader.reading import read_recording
from workbench.episodes.reader.scan import SUFFIXES
from workbench.episodes.row import Source, UnreadableRecording
from workbench.jobs.local_processes import Processes
from workbench.jobs.scheduler import ItemQueue, PoolError, Scheduler, Work
from workbench.machine.files import new_file
from workbench.machine.loop import BlockingPool, begin, on_loop, post, result_of
from workbench.machine.software_vulkan import ensure_render_device
from workbench.machine.text import plain_text
from workbench.page.widgets.templates import counted, sentence
from workbench.share.commands import What
from workbench.share.scene_html import seconds_a_step, write_scene_html

MAX_SENTENCES = 5
"""Maximum number of sentences about recordings that the page shows."""
EVERY_CAMERA = ""


@dataclass(frozen=True)
class MakeRequest:
    """A request: what to make, and from which recordings."""

    what: What
    sources: tuple[Source, ...]
    folder: Path
    """Folder for the files. For a LeRobot dataset, the folder of the dataset; for ManiSkill's demonstrations,
    the path of their ``.h5`` file."""
    camera: str = EVERY_CAMERA
    """Camera of a film."""
    eye: FilmEye | None = None
    """The viewpoint of a scene; None for the default."""
    export: ExportOptions = ExportOptions()
    """Options of a dataset."""

    @property
    def is_dataset(self) -> bool:
        """Whether all recordings become one dataset."""
        return self.what in ("lerobot", "maniskill")


@dataclass(frozen=True)
class Made:
    """The files that were made."""

    paths: tuple[Path, ...]
    words: str
    """Summary of what was made."""
    left_out: tuple[str, ...] = ()
    """A sentence for each recording from which nothing was made, with its name and the reason."""
    damaged: tuple[str, ...] = ()
    """A sentence for each damaged file of a recording whose other files were used."""
    incomplete: tuple[str, ...] = ()
    """For ManiSkill's demonstrations: a sentence for each recording that lacks some of its observations."""
    sizes: tuple[int, ...] = ()
    """Size of each file in bytes, for downloads."""

    @property
    def said(self) -> tuple[str, ...]:
        """The first `MAX_SENTENCES` sentences about recordings, and how many more there are."""
        said = (*self.damaged, *self.left_out, *self.incomplete)
        more = len(said) - MAX_SENTENCES
        return said[:MAX_SENTENCES] + ((f"And {more} more.",) if more > 0 else ())


OnProgress = Callable[[float, str], None]


def make(wanted: MakeRequest, on_progress: OnProgress = lambda done, doing: None) -> Made:
    """Make the requested files from each recording that has the data. Used by the page and the command line.

    Args:
        on_progress: called with the completed share, 0 to 1, and the current work.

    Raises:
        UnreadableRecording: a recording is damaged, and nothing can be made.
        ValueError: no recording has the data; the message says what each recording lacks.
        OSError: a file cannot be written; the message contains the reason. Finished files stay.
        RuntimeError: this machine cannot render.
    """
    if wanted.what == "lerobot":
        return _dataset(wanted, on_progress)
    if wanted.what == "maniskill":
        return _demonstrations(wanted, on_progress)
    if wanted.what == "zip":
        return _zip(wanted, on_progress)
    paths: list[Path] = []
    not_made: list[str] = []
    damaged: list[str] = []
    unreadable = False
    for number, source in enumerate(wanted.sources):
        part_done = _part(on_progress, number, len(wanted.sources))
        part_done(0.0, source.stem)
        broken: list[str] = []
        try:
            with _reading():
                episode = read_recording(source)
            broken = [one.sentence for one in episode.broken_files]
            paths += _of_one(wanted, source, episode, part_done)
            damaged += broken
        except ValueError as error:
            unreadable = unreadable or bool(broken) or isinstance(error, UnreadableRecording)
            # `error` may say that there are no pictures, although only their file is damaged.
            why = " ".join(broken) or str(error)
            not_made.append(why if source.stem in why else f"{source.stem}: {why}")
    if not paths:
        raise (UnreadableRecording if unreadable else ValueError)("\n".join(not_made))
    on_progress(1.0, "done")
    words = counted(len(paths), "file")
    if not_made:
        words += f"; {len(not_made)} could not be made"
    return Made(tuple(paths), words, tuple(not_made), tuple(damaged))


def file_name(what: What, source: str, camera: str = "") -> str:
    """Name of the file made from the recording `source`, and from its `camera` for a film."""
    suffix = {"film": f".{file_part(camera)}.mp4", "scene": ".scene.mp4", "page": ".html"}
    return source + suffix.get(what, ".sheet.png")


@contextlib.contextmanager
def _reading() -> Iterator[None]:
    """Raise an OSError of the block as `UnreadableRecording`: the block only reads a recording."""
    try:
        yield
    except OSError as error:
        raise UnreadableRecording(str(error)) from error


def _of_one(wanted: MakeRequest, source: Source, episode: Episode, on_progress: OnProgress) -> list[Path]:
    name, fps = source.stem, 1.0 / seconds_a_step(episode)
    if wanted.what == "film":
        cameras = [wanted.camera] if wanted.camera != EVERY_CAMERA else list(cameras_by_name(episode))
        if not cameras:
            raise ValueError(f"{name} was recorded without pictures, so there is no video of it.")
        paths = []
        for number, camera in enumerate(cameras):
            path = wanted.folder / file_name("film", name, camera)
            seen = (enlarged(picture) for picture in frames(episode, camera_of(episode, camera)))
            part_done = _part(on_progress, number, len(cameras))
            counting = _counted(seen, episode, f"{name}: {camera}", part_done)
            write_mp4(path, counting, fps, comment=_moved(episode))
            paths.append(path)
        return paths
    path = wanted.folder / file_name(wanted.what, name)
    if wanted.what == "scene":
        seen = _counted(scene_frames(episode, wanted.eye), episode, f"{name}: the 3D view", on_progress)
        write_mp4(path, seen, fps)
    elif wanted.what == "page":
        write_scene_html(
            path, episode, wanted.eye, lambda done: on_progress(done, f"{name}: the animated page")
        )
    else:
        with _reading():
            sheet = contact_sheet(episode)
        with new_file(path) as temporary:
            about = PngInfo()
            about.add_itxt("Comment", _moved(episode))
            sheet.save(temporary, format="PNG", pnginfo=about)
    return [path]


def _moved(episode: Episode) -> str:
    """Text: which cameras were moved by hand during the recording; empty if none."""
    moved = moved_cameras_text(episode.info.moved_cameras)
    return moved and f"Cameras moved by hand: {moved}"


def _dataset(wanted: MakeRequest, on_progress: OnProgress) -> Made:
    count = len(wanted.sources)
    made = export_lerobot(
        [(source.stem, partial(read_recording, source)) for source in wanted.sources],
        wanted.folder,
        wanted.export,
        lambda done, doing: on_progress(done / max(count, 1), doing),
    )
    words = f"{counted(made.episodes, 'episode')}, {counted(made.frames, 'frame')}"
    if made.left_out:
        words += f"; {made.left_out} without success left out"
    if made.not_fitting:
        words += (
            f"; {len(made.not_fitting)} left out (cannot be read, or lack data that the first recording has)"
        )
    return Made((made.folder,), " ".join([f"{words}.", *made.notes]), tuple(made.not_fitting))


def _demonstrations(wanted: MakeRequest, on_progress: OnProgress) -> Made:
    count = len(wanted.sources)
    made = export_maniskill(
        [(source.stem, partial(read_recording, source)) for source in wanted.sources],
        wanted.folder,
        wanted.export.only_successes,
        wanted.export.only_fitting,
        lambda done, doing: on_progress(done / max(count, 1), doing),
    )
    words = f"{counted(made.episodes, 'episode')}, {counted(made.steps, 'step')}"
    if made.left_out:
        words += f"; {made.left_out} without success left out"
    if made.not_fitting:
        words += (
            f"; {len(made.not_fitting)} left out (cannot be read, or lack data that the first recording has)"
        )
    words += ". Colour pictures were recorded as JPEG, so they are not exact." if made.lossy else "."
    return Made((made.file,), words, tuple(made.not_fitting), incomplete=tuple(made.incomplete))


def zip_name(names: Sequence[str]) -> str:
    """Name of the archive of recordings with these names."""
    return f"{names[0]}.zip" if len(names) == 1 else f"{names[0]}_and_{len(names) - 1}_more.zip"


def _zip(wanted: MakeRequest, on_progress: OnProgress) -> Made:
    """Put the recordings' own files into one archive; unpacked, they are recordings again."""
    # A file with several recordings is added once.
    files = list(dict.fromkeys(file for source in wanted.sources for file in _files_of(source)))
    # Paths relative to the common folder, since recordings in two folders may have the same name.
    root = Path(os.path.commonpath([source.path.parent for source in wanted.sources]))
    path = wanted.folder / zip_name([source.stem for source in wanted.sources])
    # strict_timestamps=False: a file may be older than the earliest date of a zip archive.
    with new_file(path) as temporary, zipfile.ZipFile(temporary, "w", strict_timestamps=False) as archive:
        for number, file in enumerate(files):
            on_progress(number / len(files), file.name)
            # Stored without compression: the large parts, meshes and pictures, are already compressed.
            # plain_text, since an archive accepts only UTF-8 names.
            archive.write(file, plain_text(str(file.relative_to(root))), zipfile.ZIP_STORED)
    on_progress(1.0, "done")
    return Made((path,), f"{counted(len(files), 'file')} of {counted(len(wanted.sources), 'recording')}")


def _files_of(source: Source) -> list[Path]:
    """The files of a recording, without links. Raises ValueError if there are none."""
    if source.kind == "lerobot":
        found = sorted(source.path.rglob("*"))
    else:
        found = [source.path.with_suffix(suffix) for suffix in SUFFIXES]
    files = [file for file in found if file.is_file() and not file.is_symlink()]
    if not files:
        raise ValueError(f"{source.stem}: its files are gone")
    return files


def _part(on_progress: OnProgress, number: int, count: int) -> OnProgress:
    """Progress callback for part `number` of `count` equal parts of the work."""
    return lambda done, doing: on_progress((number + done) / count, doing)


def _counted(
    pictures: Iterable[NDArray[np.uint8]], episode: Episode, doing: str, on_progress: OnProgress
) -> Iterator[NDArray[np.uint8]]:
    numbered = enumerate(pictures)
    while True:
        with _reading():
            state, picture = next(numbered, (0, None))
        if picture is None:
            return
        on_progress(state / (episode.length + 1), doing)
        yield picture


# --- In a separate process, while the page continues ---------------------------------------------


END_SECONDS = 5.0
PROGRESS_PERIOD_SECONDS = 0.1
"""Minimum time between two progress messages. For a sheet of pictures, a message per frame would cost more
than the frame."""


@dataclass(frozen=True)
class MakingView:
    """State of the present job, and results so far."""

    running: bool = False
    done: float = 0.0
    """Completed share, 0 to 1."""
    doing: str = ""
    problem: str = ""
    """Why the job failed, as a sentence; empty if it succeeded or was stopped."""
    made: tuple[Made, ...] = ()
    """Results so far, newest first."""


class Making:
    """Carries out one request at a time, in a separate process.

    Encoding a film uses a core for a while. Drawing a scene needs a renderer, which the server's process must
    not import: a crash in the driver would end the page. A stopped job leaves no files.
    """

    def __init__(self) -> None:
        self._view = MakingView()
        self._stopped = False
        self._aside = BlockingPool("making")
        """Waits for the process."""
        self._task: asyncio.Task[None] | None = None
        self._scratch: Path | None = None

    def view(self) -> MakingView:
        return self._view

    @on_loop
    def start(self, wanted: MakeRequest, download: bool = False) -> bool:
        """Start a job; returns False if one is already running.

        Args:
            download: write into a new temporary folder instead of `wanted.folder`; `close` deletes it.
        """
        if self._view.running:
            return False
        self._stopped = False
        self._view = MakingView(running=True, doing="starting", made=self._view.made)
        self._task = begin(self._make(wanted, download))
        return True

    def stop(self) -> None:
        """Stop the present job and delete its files. Returns at once."""
        self._stopped = True

    def close(self) -> None:
        """Stop, wait for the end of the process, and delete the downloads. Must not be called on the loop."""
        self.stop()
        if self._task is not None:
            # A process that hangs is ended together with this process, by `machine.processes.family`.
            result_of(asyncio.wait([self._task], timeout=END_SECONDS))
        self._aside.end()
        if self._scratch is not None:
            shutil.rmtree(self._scratch, ignore_errors=True)

    async def _make(self, wanted: MakeRequest, download: bool) -> None:
        results = await self._aside.run(lambda: self._run(wanted, download))
        made = tuple(one for one in results if isinstance(one, Made))
        problem = "".join(one for one in results if isinstance(one, str) and not self._stopped)
        self._view = MakingView(problem=problem, made=(*made, *self._view.made))

    def _run(self, wanted: MakeRequest, download: bool) -> list[Made | str]:
        """Run the job; returns the results, and a text for each failure. Runs off the loop."""
        results: list[Made | str] = []

        def take(number: int, one: Made | str) -> None:
            if download and isinstance(one, Made):
                one = replace(one, sizes=tuple(path.stat().st_size for path in one.paths))
            results.append(one)

        def on_progress(progress: tuple[float, str]) -> None:
            post(lambda: self._show_progress(*progress))

        try:
            if download:
                self._scratch = self._scratch or Path(tempfile.mkdtemp(prefix="workbench-shared-"))
                # A new folder each time: a file of the same name may already exist.
                wanted = replace(wanted, folder=Path(tempfile.mkdtemp(dir=self._scratch)))
            work = Work(_make, wanted, Made | str, tuple[float, str], "that makes it")
            Processes(1).run(work, Scheduler(range(1), take, on_progress, lambda: self._stopped))
        except OSError as error:
            results.append(f"The export could not be started: {error}.")
        except PoolError as error:
            results.append(sentence(str(error)))
        return results

    def _show_progress(self, done: float, doing: str) -> None:
        self._view = replace(self._view, done=done, doing=doing)


class _Stopped(BaseException):
    """Stops the job: raised so that the open ``with`` blocks delete half-written files."""


def _make(wanted: MakeRequest, queue: ItemQueue) -> None:
    """Entry point of the separate process."""
    sent_at = 0.0

    def on_progress(done: float, doing: str) -> None:
        nonlocal sent_at
        if time.monotonic() - sent_at >= PROGRESS_PERIOD_SECONDS:
            sent_at = time.monotonic()
            queue.send_update((done, doing))

    def look(number: int, frame: FrameType | None) -> None:
        if queue.limit() == 0:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            raise _Stopped

    if queue.next() is None:
        return
    # Check for a stop in a signal handler: encoding a film may run for long without a call of `on_progress`.
    signal.signal(signal.SIGALRM, look)
    signal.setitimer(signal.ITIMER_REAL, PROGRESS_PERIOD_SECONDS, PROGRESS_PERIOD_SECONDS)
    if wanted.what == "scene":
        os.environ.update(ensure_render_device(install=False).env)
    made: Made | str
    with contextlib.suppress(_Stopped):
        try:
            made = make(wanted, on_progress)
        except (ValueError, OSError, RuntimeError) as error:
            made = str(error)
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        queue.send_result(0, made)
