"""Lists the tasks that ManiSkill registers and renders a thumbnail of each, in a process of the lowest priority."""

from __future__ import annotations

import asyncio
import hashlib
import io
import logging
import re
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TypeVar

import msgspec
import numpy as np
from PIL import Image

from workbench.live.process.ask import Background
from workbench.live.process.background_jobs import JobFailed
from workbench.live.questions_without_task import DrawTask, ListTasks
from workbench.machine.files import read_regular_file, replace_file
from workbench.machine.folders import cache_folder
from workbench.machine.loop import BlockingPool, begin, do, on_loop
from workbench.machine.maniskill_installed import installed_maniskills, lines_if_lacking
from workbench.machine.processes.child_environment import LOWEST_NICENESS
from workbench.machine.processes.watched_thread import report_failure
from workbench.machine.processes.wire import Question

log = logging.getLogger(__name__)

LIST_FILE = "tasks.json"
MAX_TASKS = 2000
MAX_TRIES = 2
"""Number of failed attempts to draw a task; each later attempt has to wait `RETRY_SECONDS`."""
RETRY_SECONDS = 7 * 24 * 3600.0
"""Backoff after `MAX_TRIES` failures: missing files may have been downloaded by then."""
ANSWER_SECONDS = 120.0
"""Timeout for the list and for each picture; on two cores with a software renderer most tasks are drawn in 5 s."""
PICTURES_PER_PROCESS = 20
"""Number of pictures after which another process is started, since SAPIEN keeps the meshes of closed scenes."""
MAX_REASON_CHARACTERS = 300
WIDTH_PIXELS, HEIGHT_PIXELS = 160, 120
MAX_PICTURE_BYTES = 64 * 1024
"""Maximum size of a cached picture; 160 x 120 pixels take 6 kB."""
_POLL_SECONDS = 0.5
"""Interval at which the job checks whether drawing may continue."""
_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,119}")
"""Pattern of an id. The cache is untrusted: an id without dots, slashes and colons cannot name a file or a
module."""
Value = TypeVar("Value")


class NotDrawn(msgspec.Struct, frozen=True):
    """Why a task has no picture."""

    text: str
    needs_download: bool = False
    tries: int = 1
    """Number of failed attempts."""
    last: float = 0.0
    """Unix time of the last attempt."""


class _Cached(msgspec.Struct):
    ids: list[str]
    not_drawn: dict[str, NotDrawn] = {}


@dataclass(frozen=True)
class RegisteredView:
    """The list and the pictures at one moment."""

    ids: tuple[str, ...] = ()
    pictures: frozenset[str] = frozenset()
    """Ids that have a picture."""
    why_not: Mapping[str, NotDrawn] = field(default_factory=dict)
    """Why a task has no picture, by id."""
    doing: str = ""
    """The work in progress, such as ``drawing PickCube-v1``; empty if there is none."""
    problem: str = ""
    """Why there is no list, or why no more pictures are made, as sentences."""

    @property
    def waiting(self) -> int:
        """Number of pictures that are still to be made."""
        return len(set(self.ids) - self.pictures - self.why_not.keys())


class RegisteredTasks:
    """ManiSkill's tasks and their thumbnails, cached by ManiSkill's version below the user's cache folder.

    Importing ManiSkill takes seconds, and every picture needs an env. So both happen in a process of the
    lowest priority, which gets only idle CPU time. The process ends when everything is done.

    Args:
        may_work: called on the loop before every picture; if it returns False, drawing waits and the process is ended to
            free its memory.
        folder: folder of the cached list and pictures; None for the user's cache.
    """

    def __init__(self, may_work: Callable[[], bool] = lambda: True, folder: Path | None = None) -> None:
        self._may_work, self._given_folder = may_work, folder
        self.view = RegisteredView()
        """The present list and pictures."""
        self.on_change: Callable[[], None] = lambda: None
        """Called on the loop when `view` has changed."""
        self._folder = Path()
        self._disk = BlockingPool("registered-tasks")
        self._process = Background(niceness=LOWEST_NICENESS)
        self._work: asyncio.Task[None] | None = None

    @on_loop
    def start(self) -> None:
        """Start listing and drawing, unless already started. Returns at once."""
        if self._work is None:
            self._work = begin(self._list_and_draw())

    def picture(self, env_id: str) -> bytes | None:
        """The JPEG of a listed task; None if there is none."""
        return _read_jpeg(self._file(env_id)) if env_id in self.view.pictures else None

    def close(self) -> None:
        """End the process. Must not be called on the loop."""
        do(self._end)
        self._process.close()

    def _end(self) -> None:
        self._disk.end()  # also cancels work that begins later
        if self._work is not None:
            self._work.cancel()

    async def _list_and_draw(self) -> None:
        try:
            lacking = await self._disk.run(lambda: lines_if_lacking("The list of ManiSkill's tasks"))
            if lacking is not None:
                self._change_view(problem=" ".join(lacking))
                return
            self._folder = self._given_folder or await self._disk.run(_version_folder)
            cached = await self._disk.run(lambda: _read_list(self._folder))
            self._change_view(ids=tuple(cached.ids), why_not=cached.not_drawn)
            if not cached.ids:
                await self._list()
            self._change_view(pictures=await self._disk.run(self._find_pictures))
            await self._draw_all()
        except Exception as error:
            report_failure("ManiSkill's tasks could not be listed and drawn", error)
        finally:
            self._process.end()
            self._change_view(doing="")

    async def _list(self) -> None:
        self._change_view(doing="listing ManiSkill's tasks")
        try:
            ids = await self._ask(ListTasks())
        except JobFailed as failure:
            self._change_view(problem=f"ManiSkill's tasks could not be listed: {failure}.")
            return
        self._change_view(ids=tuple(_checked(ids)))
        await self._keep_list()

    async def _draw_all(self) -> None:
        tried, count = self.view.why_not, 0
        # Tasks that already failed come last.
        for env_id in sorted(self.view.ids, key=tried.__contains__):
            if env_id in self.view.pictures or not _may_try(tried.get(env_id)):
                continue
            while not self._may_work():
                self._process.end()
                self._change_view(doing="")
                await asyncio.sleep(_POLL_SECONDS)
            self._change_view(doing=f"drawing {env_id}")
            try:
                drawn = await self._ask(DrawTask(env_id))
                if drawn.pixels is None:
                    await self._note_failure(env_id, drawn.why_not, drawn.needs_download)
                    continue
                await self._disk.run(partial(_write_jpeg, self._file(env_id), drawn.pixels))
            except (JobFailed, ValueError) as failure:
                await self._note_failure(env_id, str(failure))
                continue
            except OSError as error:
                self._change_view(problem=f"Pictures of tasks cannot be cached: {error}.")
                return
            self._change_view(pictures=self.view.pictures | {env_id})
            count += 1
            if count % PICTURES_PER_PROCESS == 0:
                self._process.end()

    async def _ask(self, question: Question[Value]) -> Value:
        """Ask the process a question; returns the answer.

        Raises:
            JobFailed: the process fails, or does not answer in `ANSWER_SECONDS`.
        """
        try:
            async with asyncio.timeout(ANSWER_SECONDS):
                return await self._process.ask(question)
        except TimeoutError:
            self._process.end()  # the process may be in an endless loop
            raise JobFailed(f"it took longer than {ANSWER_SECONDS:.0f} s") from None

    async def _note_failure(self, env_id: str, why: str, needs_download: bool = False) -> None:
        before = self.view.why_not.get(env_id)
        tries = 1 if before is None else before.tries + 1
        failed = NotDrawn(why[:MAX_REASON_CHARACTERS], needs_download, tries, time.time())
        self._change_view(why_not={**self.view.why_not, env_id: failed})
        await self._keep_list()

    async def _keep_list(self) -> None:
        content = msgspec.json.encode(_Cached(list(self.view.ids), dict(self.view.why_not)))
        try:
            await self._disk.run(partial(_write, self._folder / LIST_FILE, content))
        except OSError as error:
            log.warning(
                "The list of ManiSkill's tasks cannot be cached and is made again in the next run: %s", error
            )

    def _find_pictures(self) -> frozenset[str]:
        return frozenset(one for one in self.view.ids if _read_jpeg(self._file(one)))

    def _file(self, env_id: str) -> Path:
        return self._folder / f"{env_id}.jpg"

    def _change_view(self, **changes: object) -> None:
        view = replace(self.view, **changes)  # type: ignore[arg-type]
        if view != self.view:
            self.view = view
            self.on_change()


def _may_try(before: NotDrawn | None) -> bool:
    return before is None or before.tries < MAX_TRIES or abs(time.time() - before.last) > RETRY_SECONDS


def _version_folder() -> Path:
    versions = [f"{name}-{version}" for name, version in sorted(installed_maniskills().items())]
    name = re.sub(r"[^\w.+-]", "_", "+".join(versions) or "unknown")
    if len(name) > 100:
        name = hashlib.sha256(name.encode()).hexdigest()[:20]
    return cache_folder() / "tasks" / name


def _read_list(folder: Path) -> _Cached:
    try:
        cached = msgspec.json.decode(read_regular_file(folder / LIST_FILE, 1 << 20), type=_Cached)
    except (OSError, msgspec.MsgspecError, RecursionError, UnicodeDecodeError):
        return _Cached([])  # the list will be made again
    cached.ids = _checked(cached.ids)
    return cached


def _checked(ids: Iterable[str]) -> list[str]:
    return sorted(filter(_ID.fullmatch, ids))[:MAX_TASKS]


def _read_jpeg(file: Path) -> bytes | None:
    try:
        content = read_regular_file(file, MAX_PICTURE_BYTES)
    except (OSError, ValueError):
        return None
    return content if content.startswith(b"\xff\xd8\xff") else None


def _write(file: Path, content: bytes) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    replace_file(file, content)


def _write_jpeg(file: Path, pixels: np.ndarray) -> None:
    """Scale a picture until it covers the size of cached pictures, crop it to that size around its centre,
    and write it. Raises ValueError if `pixels` is not a picture."""
    if pixels.ndim != 3 or pixels.shape[2] != 3 or pixels.dtype != np.uint8 or not 0 < pixels.size < 1 << 26:
        raise ValueError("the task's picture is not an RGB image")
    height, width = pixels.shape[:2]
    scale = max(WIDTH_PIXELS / width, HEIGHT_PIXELS / height)
    size = max(WIDTH_PIXELS, round(width * scale)), max(HEIGHT_PIXELS, round(height * scale))
    image = Image.fromarray(pixels).resize(size, Image.Resampling.BOX)
    left, top = (size[0] - WIDTH_PIXELS) // 2, (size[1] - HEIGHT_PIXELS) // 2
    written = io.BytesIO()
    image.crop((left, top, left + WIDTH_PIXELS, top + HEIGHT_PIXELS)).save(written, "JPEG", quality=80)
    _write(file, written.getvalue())
