"""Writes episodes as a LeRobot dataset."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import uuid
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from workbench.episodes.document import differences_from_source
from workbench.episodes.episode import Episode, read_whole
from workbench.episodes.films import Encoding, FilmWriter
from workbench.episodes.lerobot import format as form
from workbench.episodes.lerobot.format import Choice, Frames, feature_name, frames_of
from workbench.episodes.row import UnreadableRecording

ENCODING = Encoding(crf=20, key_every=2, exact_size=True)
"""As in lerobot's films, every second frame is a key frame: training reads frames in random order."""
ROBOT = "robot_uids"


@dataclass(frozen=True)
class ExportOptions:
    choice: Choice = Choice()
    only_successes: bool = False
    """Leave out episodes that never succeed."""
    only_fitting: bool = False
    """If True, leave out and report episodes that cannot be read or do not fit the first one. If False, such
    an episode raises an error."""
    instruction: str | None = None
    """The task's instruction for language-conditioned policies; None for the task's id."""
    fps: int | None = None
    """Frames per second, of which the control rate must be an integer multiple; None for the control rate."""


class DoesNotFit(ValueError):
    """An episode cannot be part of the dataset; the message is a sentence."""


@dataclass
class Exported:
    folder: Path
    episodes: int = 0
    frames: int = 0
    left_out: int = 0
    """Number of episodes that `only_successes` left out."""
    not_fitting: list[str] = field(default_factory=list)
    """A sentence for each episode that `only_fitting` left out."""
    notes: list[str] = field(default_factory=list)


def export_lerobot(
    sources: Sequence[tuple[str, Callable[[], Episode]]],
    folder: Path,
    options: ExportOptions = ExportOptions(),
    on_progress: Callable[[int, str], None] = lambda done, doing: None,
) -> Exported:
    """Write a dataset of these episodes to a new folder.

    Episodes are read and written one by one, so memory use does not grow with their number. A film contains
    several episodes in a row. The dataset is written to a temporary folder, which is renamed when it is
    complete and deleted after an error.

    Args:
        sources: for each episode a name for messages, and a function that reads it.
        folder: must be empty or not exist.
        on_progress: called with the number of finished episodes, and the name of the current one.

    Raises:
        UnreadableRecording: an episode cannot be read completely.
        DoesNotFit: an episode lacks a chosen part, or differs from the first one in features or frame rate.
        ValueError: there is no episode to write.
        OSError: the dataset cannot be written.
    """
    folder = Path(folder).absolute()
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise FileExistsError(f"{folder} exists already; give a folder that does not exist yet.")
    made = Exported(folder)
    temporary = folder.parent / f".{folder.name}.{uuid.uuid4().hex[:8]}.part"
    try:
        temporary.mkdir(parents=True)
        with contextlib.ExitStack() as stack:
            writer = _Writer(temporary, options, made, stack)
            for number, (name, read) in enumerate(sources):
                on_progress(number, name)
                try:
                    fitting = writer.fitting(name, read)
                except (DoesNotFit, UnreadableRecording) as error:
                    if not options.only_fitting:
                        raise
                    made.not_fitting.append(str(error))
                    continue
                if fitting is not None:
                    writer.add(fitting)
            writer.finish()
        os.rename(temporary, folder)
    except OSError as error:
        if isinstance(error, FileExistsError) or error.errno is None:
            raise
        raise OSError(
            error.errno, f"Cannot write the dataset {folder}: {os.strerror(error.errno)}."
        ) from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    on_progress(len(sources), "done")
    return made


class _Films:
    """The films of one camera."""

    def __init__(self, folder: Path, key: str, fps: int) -> None:
        self._folder, self._key, self._fps = folder, key, fps
        self._chunk, self._file = 0, 0
        self._film: FilmWriter | None = None
        self._path = folder

    def add(self, frames: Frames, camera: str) -> tuple[dict[str, Any], form.Stats]:
        """Append an episode; returns its fields in ``meta/episodes`` and its statistics."""
        sampled, samples = set(form.sampled(len(frames.states)).tolist()), []
        # ffmpeg creates the file only after some frames.
        if (
            self._film is not None
            and self._path.exists()
            and self._path.stat().st_size >= form.VIDEO_MB * 2**20
        ):
            self.close()
            self._chunk, self._file = form.next_file(self._chunk, self._file)
        begin = 0 if self._film is None else len(self._film)
        for index, picture in enumerate(frames.pictures(camera)):
            if self._film is None:
                name = form.VIDEO_PATH.format(
                    video_key=self._key, chunk_index=self._chunk, file_index=self._file
                )
                self._path = self._folder / name
                self._path.parent.mkdir(parents=True, exist_ok=True)
                self._film = FilmWriter(self._path, picture.shape, self._fps, ENCODING)
            self._film.add(picture)
            if index in sampled:
                samples.append(picture)
        assert self._film is not None, "an episode has at least one frame"
        entry = {
            f"videos/{self._key}/chunk_index": self._chunk,
            f"videos/{self._key}/file_index": self._file,
            f"videos/{self._key}/from_timestamp": begin / self._fps,
            f"videos/{self._key}/to_timestamp": len(self._film) / self._fps,
        }
        return entry, form.picture_stats(samples)

    def close(self, abandoned: bool = False) -> None:
        film, self._film = self._film, None
        if film is not None:
            film.close(abandoned)


class _Writer:
    def __init__(
        self, folder: Path, options: ExportOptions, made: Exported, stack: contextlib.ExitStack
    ) -> None:
        self._folder, self._options, self._made, self._stack = folder, options, made, stack
        self._features: dict[str, dict] | None = None
        self._first = ""
        self._films: dict[str, _Films] = {}
        self._rows: pq.ParquetWriter | None = None
        self._chunk, self._file, self._path = 0, 0, folder
        self._episodes: list[dict[str, Any]] = []
        self._stats: dict[str, list[form.Stats]] = {}
        self._tasks: dict[str, int] = {}
        self._from: list[dict[str, Any]] = []
        self._fps, self._robot = 0, None

    def fitting(self, name: str, read: Callable[[], Episode]) -> Frames | None:
        """The frames of an episode for `add`; None if it is left out because it never succeeds.

        Raises:
            DoesNotFit: the episode cannot be added.
            UnreadableRecording: the episode cannot be read completely.
        """
        episode = read_whole(name, read)
        if self._options.only_successes and not _succeeds(episode):
            self._made.left_out += 1
            return None
        fps, every = self._rate(name, episode)
        try:
            frames = frames_of(episode, replace(self._options.choice, every=every))
        except ValueError as error:
            raise DoesNotFit(f"{name} {error}.") from error
        features = frames.features()
        if self._features is None:
            self._features, self._first, self._fps = features, name, fps
            self._robot = episode.info.env_kwargs.get(ROBOT)
        elif features != self._features or fps != self._fps:
            raise DoesNotFit(
                f"{name} does not fit into a dataset with {self._first}: "
                f"{_difference(self._features, features)}."
            )
        return frames

    def add(self, frames: Frames) -> None:
        """Append an episode. Raises OSError, or ValueError if a picture cannot be decoded."""
        episode = frames.episode
        entry: dict[str, Any] = {"episode_index": self._made.episodes}
        task = self._options.instruction or episode.info.task
        task_index = self._tasks.setdefault(task, len(self._tasks))
        entry["tasks"], entry["length"] = [task], len(frames.states)
        entry |= self._add_rows(frames, task_index)
        stats: dict[str, form.Stats] = {}
        for camera in frames.cameras:
            key = form.IMAGES + feature_name(camera)
            if key not in self._films:
                self._films[key] = films = _Films(self._folder, key, self._fps)
                # Kills ffmpeg on an error; without an error, `finish` has already closed the films.
                self._stack.callback(films.close, abandoned=True)
            camera_entry, stats[key] = self._films[key].add(frames, camera)
            entry |= camera_entry
        for key, values in self._columns(frames, task_index).items():
            stats[key] = form.stats_of(values)
        for key, of_feature in stats.items():
            self._stats.setdefault(key, []).append(of_feature)
            for statistic, value in of_feature.items():
                entry[f"stats/{key}/{statistic}"] = value.tolist()
        self._episodes.append(entry)
        info = episode.info
        self._from.append(
            {
                "id": info.id,
                "task": info.task,
                "seed": info.seed,
                "source_hash": info.source_hash,
                **differences_from_source(info),
            }
        )
        self._made.episodes += 1
        self._made.frames += len(frames.states)

    def _rate(self, name: str, episode: Episode) -> tuple[int, int]:
        """Frames per second, and steps per frame."""
        rate = 1.0 / episode.info.control_dt if episode.info.control_dt > 0 else 20.0
        if self._options.fps is None:
            fps = max(1, round(rate))
            if abs(rate - fps) > 1e-3 and not self._made.notes:
                self._made.notes.append(
                    f"The format has only integer frame rates: {rate:.3f} per second is written as {fps}."
                )
            return fps, 1
        every = round(rate / self._options.fps)
        if every < 1 or abs(rate / self._options.fps - every) > 1e-3:
            raise DoesNotFit(
                f"{name} has {rate:g} steps per second, which is not an integer multiple of {self._options.fps}; choose "
                "another frame rate."
            )
        return self._options.fps, every

    def _columns(self, frames: Frames, task_index: int) -> dict[str, np.ndarray]:
        """All features that are columns of numbers, (T, D)."""
        count = len(frames.states)
        index = np.arange(count, dtype=np.int64)
        return {
            **frames.columns,
            "timestamp": (index / self._fps).astype(np.float32)[:, None],
            "frame_index": index[:, None],
            "episode_index": np.full((count, 1), self._made.episodes, np.int64),
            "index": (index + self._made.frames)[:, None],
            "task_index": np.full((count, 1), task_index, np.int64),
        }

    def _add_rows(self, frames: Frames, task_index: int) -> dict[str, Any]:
        columns = self._columns(frames, task_index)
        table = pa.table({key: _arrow(values) for key, values in columns.items()})
        if self._rows is not None and self._path.stat().st_size >= form.DATA_MB * 2**20:
            self._rows.close()
            self._rows, (self._chunk, self._file) = None, form.next_file(self._chunk, self._file)
        if self._rows is None:
            self._path = self._folder / form.DATA_PATH.format(chunk_index=self._chunk, file_index=self._file)
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._rows = self._stack.enter_context(
                pq.ParquetWriter(self._path, table.schema, compression="snappy")
            )
        self._rows.write_table(table)
        return {
            "data/chunk_index": self._chunk,
            "data/file_index": self._file,
            "dataset_from_index": self._made.frames,
            "dataset_to_index": self._made.frames + len(frames.states),
        }

    def finish(self) -> None:
        if self._features is None or self._rows is None:
            why = "none of them reaches success" if self._made.left_out else "none was given"
            raise ValueError(" ".join(self._made.not_fitting[:5]) or f"There is no episode to export: {why}.")
        self._rows.close()
        for films in self._films.values():
            films.close()
        for entry in self._episodes:
            entry["meta/episodes/chunk_index"] = entry["meta/episodes/file_index"] = 0
        episodes = self._folder / form.EPISODES
        episodes.parent.mkdir(parents=True)
        pq.write_table(pa.Table.from_pylist(self._episodes), episodes, compression="snappy")
        tasks = pa.table(
            {
                "task_index": pa.array(list(self._tasks.values()), pa.int64()),
                "__index_level_0__": pa.array(list(self._tasks), pa.string()),
            }
        )
        pq.write_table(tasks.replace_schema_metadata(form.tasks_metadata()), self._folder / form.TASKS)
        stats = {key: form.combined_stats(parts) for key, parts in self._stats.items()}
        _write_json(
            self._folder / form.STATS,
            {key: {name: value.tolist() for name, value in of.items()} for key, of in stats.items()},
        )
        _write_json(self._folder / form.WORKBENCH_FILE, {"episodes": self._from})
        _write_json(self._folder / form.INFO, self._info())

    def _info(self) -> dict[str, Any]:
        assert self._features is not None
        features = {**self._features, **form.OF_EVERY_FRAME}
        for key in self._films:
            height, width = features[key]["shape"][:2]
            odd = height % 2 or width % 2
            features[key]["info"] = {
                "video.height": height,
                "video.width": width,
                "video.codec": "h264",
                "video.pix_fmt": "yuv444p" if odd else "yuv420p",
                "video.is_depth_map": False,
                "video.fps": self._fps,
                "video.channels": 3,
                "has_audio": False,
            }
        return {
            "codebase_version": form.VERSION,
            "robot_type": self._robot if isinstance(self._robot, str) else None,
            "total_episodes": self._made.episodes,
            "total_frames": self._made.frames,
            "total_tasks": len(self._tasks),
            "chunks_size": form.CHUNK_SIZE,
            "data_files_size_in_mb": form.DATA_MB,
            "video_files_size_in_mb": form.VIDEO_MB,
            "fps": self._fps,
            "splits": {"train": f"0:{self._made.episodes}"},
            "data_path": form.DATA_PATH,
            "video_path": form.VIDEO_PATH if self._films else None,
            "features": features,
        }


def _arrow(values: np.ndarray) -> pa.Array:
    """A column (T, D) as plain numbers if D is 1, else as fixed-size lists."""
    flat = pa.array(np.ascontiguousarray(values).reshape(-1))
    return flat if values.shape[1] == 1 else pa.FixedSizeListArray.from_arrays(flat, values.shape[1])


def _succeeds(episode: Episode) -> bool:
    flag = episode.flag("success")
    return flag is not None and bool(flag.any())


def _difference(one: dict[str, dict], other: dict[str, dict]) -> str:
    for key in {**one, **other}:
        if key not in other:
            return f"it has no {key}"
        if key not in one:
            return f"the first episode has no {key}"
        if one[key] != other[key]:
            part = next(name for name in one[key] if one[key][name] != other[key].get(name))
            return f"the {part} of {key} is {other[key].get(part)}, but {one[key][part]} in the first episode"
    return "it has another frame rate"


def _write_json(path: Path, content: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=4, ensure_ascii=False), encoding="utf-8")
