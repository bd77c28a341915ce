"""What is made from recordings to be handed on: films, moving pages, sheets of pictures, datasets.

One list of what can be made, for the page and the command line. Making takes processor and memory, and some of it a
renderer: the page has it done by a process of its own (`workbench.ui.making`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from workbench.machine.atomic_files import new_file
from workbench.recording.episode import Episode
from workbench.recording.episode_pictures import (
    Eye,
    camera_of,
    cameras_by_name,
    contact_sheet,
    enlarged,
    frames,
    scene_frames,
)
from workbench.recording.films import write_mp4
from workbench.recording.lerobot_export import ExportOptions, export_lerobot
from workbench.recording.source import Source
from workbench.recording.sources import read_source
from workbench.ui.fragments import counted
from workbench.ui.scene_html import seconds_a_step, write_scene_html

What = Literal["film", "scene", "page", "sheet", "lerobot"]
MOST_SAID = 5
"""Sentences on recordings that were left out."""
EVERY_CAMERA = ""


@dataclass(frozen=True)
class Wanted:
    what: What
    sources: tuple[Source, ...]
    folder: Path
    """Where the files go; for a dataset the folder that it becomes."""
    camera: str = EVERY_CAMERA
    """Of a film."""
    eye: Eye | None = None
    """From where a scene is seen; None: a usual place."""
    export: ExportOptions = ExportOptions()
    """Of a dataset."""


@dataclass(frozen=True)
class Made:
    paths: tuple[Path, ...]
    words: str
    """What it is, in a sentence or two."""
    not_made: tuple[str, ...] = ()
    """Of which recordings it could not be made, each a sentence that names it and says why."""


OnProgress = Callable[[float, str], None]


def make(wanted: Wanted, on_progress: OnProgress = lambda done, doing: None) -> Made:
    """Make it, of every recording that has what is wanted.

    Args:
        on_progress: called with the part that is done, 0..1, and what is done now.

    Raises:
        ValueError: none of the recordings can be read and has what is wanted; the message says which lacks what.
        OSError: it cannot be written; the message says why. What was finished before stays.
        RuntimeError: this machine has nothing to render with.
    """
    if wanted.what == "lerobot":
        return _dataset(wanted, on_progress)
    paths: list[Path] = []
    not_made: list[str] = []
    for number, source in enumerate(wanted.sources):
        part_done = _part(on_progress, number, len(wanted.sources))
        part_done(0.0, source.stem)
        try:
            paths += _of_readable(wanted, source, part_done)
        except ValueError as error:
            not_made.append(str(error) if source.stem in str(error) else f"{source.stem}: {error}")
    if not paths:
        raise ValueError("\n".join(not_made))
    on_progress(1.0, "done")
    words = counted(len(paths), "file")
    if not_made:
        words += f"; {len(not_made)} could not be made. {' '.join(not_made)}"
    return Made(tuple(paths), words, tuple(not_made))


def file_name(what: What, source: str, camera: str = "") -> str:
    """Of what is made from the recording that is called `source`, and of its `camera` where it is a film of one."""
    suffix = {"film": f".{camera.replace('/', '_')}.mp4", "scene": ".scene.mp4", "page": ".html"}
    return source + suffix.get(what, ".sheet.png")


def _of_readable(wanted: Wanted, source: Source, on_progress: OnProgress) -> list[Path]:
    episode = read_source(source)
    try:
        return _of_one(wanted, source, episode, on_progress)
    except ValueError as error:
        if not episode.unread:
            raise
        raise ValueError(
            " ".join(broken.sentence for broken in episode.unread)
        ) from error  # it does not lack pictures, they cannot be read


def _of_one(wanted: Wanted, source: Source, episode: Episode, on_progress: OnProgress) -> list[Path]:
    name, fps = source.stem, 1.0 / seconds_a_step(episode)
    if wanted.what == "film":
        cameras = [wanted.camera] if wanted.camera != EVERY_CAMERA else list(cameras_by_name(episode))
        if not cameras:
            raise ValueError(f"{name} was recorded without pictures, so there is no film of it.")
        paths = []
        for number, camera in enumerate(cameras):
            path = wanted.folder / file_name("film", name, camera)
            seen = (enlarged(picture) for picture in frames(episode, camera_of(episode, camera)))
            told = _part(on_progress, number, len(cameras))
            write_mp4(path, _counted(seen, episode, f"{name}: {camera}", told), fps)
            paths.append(path)
        return paths
    path = wanted.folder / file_name(wanted.what, name)
    if wanted.what == "scene":
        seen = _counted(scene_frames(episode, wanted.eye), episode, f"{name}: the 3-D view", on_progress)
        write_mp4(path, seen, fps)
    elif wanted.what == "page":
        write_scene_html(
            path, episode, wanted.eye, lambda done: on_progress(done, f"{name}: the moving page")
        )
    else:
        with new_file(path) as temporary:
            contact_sheet(episode).save(temporary, format="PNG")
    return [path]


def _dataset(wanted: Wanted, on_progress: OnProgress) -> Made:
    count = len(wanted.sources)
    made = export_lerobot(
        [(source.stem, partial(read_source, source)) for source in wanted.sources],
        wanted.folder,
        wanted.export,
        lambda done, doing: on_progress(done / max(count, 1), doing),
    )
    words = f"{counted(made.episodes, 'episode')}, {counted(made.frames, 'frame')}"
    if made.left_out:
        words += f"; {made.left_out} without success left out"
    if made.not_fitting:
        words += f"; {len(made.not_fitting)} left out that cannot be read or do not fit"
    return Made((made.folder,), " ".join([words + ".", *made.not_fitting[:MOST_SAID], *made.notes]))


def _part(on_progress: OnProgress, number: int, count: int) -> OnProgress:
    """Of one of several."""
    return lambda done, doing: on_progress((number + done) / count, doing)


def _counted(
    pictures: Iterable[NDArray[np.uint8]], episode: Episode, doing: str, on_progress: OnProgress
) -> Iterator[NDArray[np.uint8]]:
    for state, picture in enumerate(pictures):
        on_progress(state / (episode.length + 1), doing)
        yield picture
