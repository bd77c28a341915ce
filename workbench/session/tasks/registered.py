"""Lists the tasks that ManiSkill registers and draws a picture of each, in a process that gives way to all others."""

from __future__ import annotations

import hashlib
import io
import logging
import re
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import msgspec
import numpy as np
from PIL import Image

from workbench.machine.files import read_regular_file, replace_file
from workbench.machine.folders import cache_folder
from workbench.machine.maniskill_installed import installed_maniskills, lines_if_lacking
from workbench.machine.processes.child_python import LOWEST
from workbench.machine.processes.watched_thread import watched_thread
from workbench.session.loop import result_of
from workbench.session.process.askers import Background
from workbench.session.process.jobs import JobFailed
from workbench.session.protocol.questions import DrawTask, ListTasks

log = logging.getLogger(__name__)

LIST_FILE = "tasks.json"
MOST_TASKS = 2000
MOST_TRIES = 2
"""Attempts to draw a task before `AGAIN_AFTER` has to pass."""
AGAIN_AFTER = 7 * 24 * 3600.0
"""Seconds after which a task that failed so often is tried again: what it lacks may have been downloaded."""
LONGEST_LIST, LONGEST_DRAWING = 120.0, 120.0
"""Timeouts in seconds; on two cores with a software renderer most tasks are drawn in 5 s."""
PICTURES_A_PROCESS = 20
"""Pictures that one process draws before another is started: SAPIEN keeps the meshes of closed scenes."""
LONGEST_WHY = 300
WIDTH, HEIGHT = 160, 120
LARGEST_PICTURE = 64 * 1024
"""Most bytes of a cached picture; 160 x 120 pixels take 6 kB."""
_LOOK = 0.5
"""Seconds between two checks whether drawing may continue."""
_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,119}")
"""Pattern of an id. Without a dot, a slash and a colon an id cannot be a file or a module, whoever wrote it into the
cache."""


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
    """List and pictures at one moment."""

    ids: tuple[str, ...] = ()
    pictures: frozenset[str] = frozenset()
    """Ids that have a picture."""
    why_not: Mapping[str, NotDrawn] = field(default_factory=dict)
    """Why a task has no picture, by id."""
    doing: str = ""
    """``listing the tasks``, ``drawing PickCube-v1``; empty if nothing is being done."""
    problem: str = ""
    """Why there is no list, as sentences."""
    serial: int = 0

    @property
    def waiting(self) -> int:
        """Pictures that are still to be made."""
        return len(set(self.ids) - self.pictures - self.why_not.keys())


class RegisteredTasks:
    """ManiSkill's tasks and their pictures, cached by its version below the user's cache folder.

    Importing ManiSkill takes seconds, and every picture needs an env, so both happen in a process of the lowest priority
    that the kernel knows: it gets what is left over. It ends when all is done.

    Args:
        may_work: asked before every picture; False makes it wait, and frees the memory of the process.
        folder: for the cached list and pictures; None for the user's cache.
    """

    def __init__(self, may_work: Callable[[], bool] = lambda: True, folder: Path | None = None) -> None:
        self._may_work, self._given_folder = may_work, folder
        self._lock = threading.Lock()
        self._view = RegisteredView()
        self._cached = _Cached([])
        self._folder = Path()
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def view(self) -> RegisteredView:
        return self._view

    def start(self) -> None:
        """Begin to list and to draw, if that has not begun. Returns at once."""
        with self._lock:
            if self._thread is None and not self._closing.is_set():
                self._thread = watched_thread("registered-tasks", self._work)
                self._thread.start()

    def picture(self, env_id: str) -> bytes | None:
        """The JPEG of a listed task; None without one."""
        return _read_jpeg(self._file(env_id)) if env_id in self._view.pictures else None

    def close(self) -> None:
        """End the process."""
        self._closing.set()
        with self._lock:
            thread = self._thread
        if thread is not None:
            thread.join()

    # --- on its thread -------------------------------------------------------------------------------

    def _work(self) -> None:
        if (lacking := lines_if_lacking("A list of its tasks")) is not None:
            self._say(problem=" ".join(lacking))
            return
        self._folder = self._given_folder or _version_folder()
        self._cached = _read_list(self._folder)
        process = Background(niceness=LOWEST)
        try:
            self._list(process)
            self._say(pictures=frozenset(one for one in self._cached.ids if _read_jpeg(self._file(one))))
            self._draw_all(process)
        finally:
            process.close()
            self._say(doing="")

    def _list(self, process: Background) -> None:
        if not self._cached.ids:
            self._say(doing="listing ManiSkill's tasks")
            try:
                ids = result_of(process.ask(ListTasks()), self._within(LONGEST_LIST))
            except (JobFailed, _Ended) as failure:
                if not self._closing.is_set():
                    self._say(problem=f"ManiSkill's tasks could not be listed: {failure}.")
                return
            self._cached.ids = sorted(filter(_ID.fullmatch, ids))[:MOST_TASKS]
            self._keep()
        self._say(ids=tuple(self._cached.ids), why_not=dict(self._cached.not_drawn))

    def _draw_all(self, process: Background) -> None:
        count = 0
        # A task that failed before comes after all others.
        for env_id in sorted(self._cached.ids, key=self._cached.not_drawn.__contains__):
            if env_id in self._view.pictures or not self._may_try(env_id):
                continue
            if not self._wait_until_allowed(process):
                return
            self._say(doing=f"drawing {env_id}")
            try:
                drawn = result_of(process.ask(DrawTask(env_id)), self._within(LONGEST_DRAWING))
                if drawn.pixels is None:
                    self._note_failure(env_id, drawn.why_not, drawn.needs_download)
                    continue
                _write(self._file(env_id), _jpeg(drawn.pixels))
            except (JobFailed, _Ended, ValueError) as failure:
                if self._closing.is_set():
                    return
                if isinstance(failure, _Ended):
                    process.close()  # it may be in an endless loop
                self._note_failure(env_id, str(failure))
                continue
            except OSError as error:
                self._say(problem=f"Pictures of tasks cannot be kept: {error}.")
                return
            self._say(pictures=self._view.pictures | {env_id})
            count += 1
            if count % PICTURES_A_PROCESS == 0:
                process.close()

    def _wait_until_allowed(self, process: Background) -> bool:
        """Wait until drawing may continue; False if the process has to end."""
        while not self._may_work():
            process.close()
            self._say(doing="")
            if self._closing.wait(_LOOK):
                return False
        return not self._closing.is_set()

    def _within(self, seconds: float) -> Callable[[], None]:
        ends_at = time.monotonic() + seconds

        def check() -> None:
            if self._closing.is_set():
                raise _Ended("the workbench ends")
            if time.monotonic() > ends_at:
                raise _Ended(f"it took longer than {seconds:.0f} s")

        return check

    def _may_try(self, env_id: str) -> bool:
        before = self._cached.not_drawn.get(env_id)
        return before is None or before.tries < MOST_TRIES or abs(time.time() - before.last) > AGAIN_AFTER

    def _note_failure(self, env_id: str, why: str, needs_download: bool = False) -> None:
        before = self._cached.not_drawn.get(env_id)
        tries = 1 if before is None else before.tries + 1
        self._cached.not_drawn[env_id] = NotDrawn(why[:LONGEST_WHY], needs_download, tries, time.time())
        self._keep()
        self._say(why_not=dict(self._cached.not_drawn))

    def _keep(self) -> None:
        try:
            _write(self._folder / LIST_FILE, msgspec.json.encode(self._cached))
        except OSError as error:
            log.warning(
                "The list of ManiSkill's tasks cannot be kept, and is made again in the next run: %s", error
            )

    def _file(self, env_id: str) -> Path:
        return self._folder / f"{env_id}.jpg"

    def _say(self, **changes: object) -> None:
        self._view = replace(self._view, serial=self._view.serial + 1, **changes)  # type: ignore[arg-type]


class _Ended(Exception):
    """The work is no longer wanted, or takes too long."""


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
        return _Cached([])  # made again
    cached.ids = sorted(filter(_ID.fullmatch, cached.ids))[:MOST_TASKS]
    return cached


def _read_jpeg(file: Path) -> bytes | None:
    try:
        content = read_regular_file(file, LARGEST_PICTURE)
    except (OSError, ValueError):
        return None
    return content if content.startswith(b"\xff\xd8\xff") else None


def _write(file: Path, content: bytes) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    replace_file(file, content)


def _jpeg(pixels: np.ndarray) -> bytes:
    """The middle of a picture, in the shape of the cached ones. Raises ValueError for what is no picture."""
    if pixels.ndim != 3 or pixels.shape[2] != 3 or pixels.dtype != np.uint8 or not 0 < pixels.size < 1 << 26:
        raise ValueError("it is no picture")
    height, width = pixels.shape[:2]
    scale = max(WIDTH / width, HEIGHT / height)
    size = max(WIDTH, round(width * scale)), max(HEIGHT, round(height * scale))
    image = Image.fromarray(pixels).resize(size, Image.Resampling.BOX)
    left, top = (size[0] - WIDTH) // 2, (size[1] - HEIGHT) // 2
    written = io.BytesIO()
    image.crop((left, top, left + WIDTH, top + HEIGHT)).save(written, "JPEG", quality=80)
    return written.getvalue()
