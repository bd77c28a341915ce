"""Runs of a task with three cameras, for tests of the studio's state."""

# pyright: reportOptionalMemberAccess=false

from __future__ import annotations

import tempfile
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from tests.drive.scenes import camera as scene_camera
from tests.drive.session import BASE, PEOPLE, fake_worker_session
from workbench.envs.camera_data import CameraInfo, CameraKey, CameraSettings
from workbench.live.events import MomentShown, VersionLoaded
from workbench.live.messages import Loaded
from workbench.live.run import Run

FILE = "/home/me/push.py"
SETTINGS = CameraSettings((0.4, 0.0, 0.6), (1, 0, 0, 0), 1.0, None, 8, 6, 0.01, 10.0, "minimal", 0.7)
MOVED = replace(SETTINGS, position=(0.4, 0.0, 0.9))
HAND: CameraKey = ("sensor", "hand")
PAST_ENV = 2


def info(key: CameraKey, settings: CameraSettings | None = SETTINGS, mount: str | None = None) -> CameraInfo:
    return replace(scene_camera(key[1], key[0]), settings=settings, mount=mount)


CAMERAS = info(PEOPLE), info(BASE), info(HAND, mount="arm/hand")


@cache
def runs() -> tuple[Run, Run, Run]:
    """Runs of three envs: live, live one step later, and at a past moment with env 2 selected."""
    with tempfile.TemporaryDirectory() as folder, fake_worker_session(Path(folder)) as fake:
        fake.load(cameras=CAMERAS, file=FILE, source_files=(FILE,), source={FILE: "old"})
        fake.reset()
        fake.step(3)
        first = fake.session.look(lambda run: run)
        fake.step()
        second = fake.session.look(lambda run: run)
        fake.session.dispatch(MomentShown(1, env=PAST_ENV))
        past = fake.session.look(lambda run: run)
    opened = {"pages": 1, "state": "paused"}
    return replace(first, **opened), replace(second, **opened), replace(past, **opened)


def version(text: str, *cameras: CameraInfo, run: Run | None = None, **changes: Any) -> Run:
    """The run after a load of the file with this text and these cameras."""
    run = runs()[0] if run is None else run
    assert run.task is not None
    return replace(run, task=replace(run.task, source={FILE: text}, cameras=cameras or CAMERAS, **changes))


def loaded(level: str | None = "cameras") -> VersionLoaded:
    """Return a load event; the studio reads only its level, since the run holds the loaded task."""
    report: Any = None if level is None else SimpleNamespace(level=level)
    nothing: Any = None
    return VersionLoaded(Loaded(nothing, nothing, {}, report), on_disk=True)
