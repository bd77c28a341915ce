"""Time from dragging a camera to its new picture, against editing the number and restarting the stock script.

    python tests/benchmarks/camera_drag.py [--num-envs 16] [--placements 30] [--restarts 3] [--write]

A real session on the example task shows its 128 x 128 sensor camera. Three measurements:

    one placement    from a `CameraPlaced` event while paused until the session's view has a picture from there
    a drag           20 placements per second for three seconds: number of pictures, and delay of the last one
    stock            a new Python process on the file: stock ``gym.make`` of one env, reset, first picture

The script fails if the median of one placement is above 200 ms.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro

sys.path.insert(0, str(Path(__file__).parents[2]))
from tests.benchmarks.reload import cold_restart
from tests.benchmarks.session_times import seconds_until
from tests.benchmarks.table import Row, keep
from tests.drive.page import TASK
from workbench.app.session import Session
from workbench.cameras.events import CameraPlaced
from workbench.cameras.view import StudioView
from workbench.envs.camera_data import CameraKey, CameraSettings
from workbench.live.events import PagesCounted
from workbench.live.messages import CameraRequest
from workbench.live.view import SessionView
from workbench.task.description import TaskOptions

BASE: CameraKey = ("sensor", "base_camera")
MAX_PLACEMENT_SECONDS = 0.2
DRAG_HERTZ = 20.0
DRAG_SECONDS = 3.0


@dataclass(frozen=True)
class Options:
    num_envs: int = 16
    placements: int = 30
    restarts: int = 3
    write: bool = False
    """Write a row of the table of benchmarks."""


def wait(session: Session, settings: CameraSettings) -> None:
    """Wait until the view has a picture taken from this placement."""

    def shows(view: SessionView) -> bool:
        picture = view.pictures.get(BASE)
        return picture is not None and np.allclose(picture.pose[:3], settings.position, atol=1e-6)

    seconds_until(session, shows)


def at(start: CameraSettings, k: int) -> CameraSettings:
    return replace(start, position=(0.4 + 0.002 * k, 0.001 * k, 0.6))


def main(options: Options) -> None:
    with tempfile.TemporaryDirectory() as folder:
        session = Session(
            str(TASK), TaskOptions(num_envs=options.num_envs), recordings=Path(folder) / "recordings"
        )
        try:
            seconds_until(session, lambda view: view.of(StudioView).camera(BASE) is not None)
            camera = session.view().of(StudioView).camera(BASE)
            assert camera is not None
            start = camera.info.settings
            assert start is not None
            session.dispatch(PagesCounted(1))
            session.change(cameras=(CameraRequest("base_camera", "sensor"),))
            wait(session, start)
            single = []
            for k in range(options.placements):
                time.sleep(0.1)
                began = time.perf_counter()
                session.dispatch(CameraPlaced(BASE, at(start, k)))
                wait(session, at(start, k))
                single.append(time.perf_counter() - began)
            first = session.view().pictures_serial
            count = int(DRAG_HERTZ * DRAG_SECONDS)
            began = time.perf_counter()
            for k in range(count):
                time.sleep(max(0.0, began + k / DRAG_HERTZ - time.perf_counter()))
                session.dispatch(CameraPlaced(BASE, at(start, 100 + k), control=1))
            last = time.perf_counter()
            wait(session, at(start, 100 + count - 1))
            lag = time.perf_counter() - last
            pictures = (session.view().pictures_serial - first) / (time.perf_counter() - began)
        finally:
            session.close()
    stock = [cold_restart(TASK) for _ in range(options.restarts)]
    median = statistics.median(single)
    print(
        f"one placement   median {1000 * median:.0f} ms, worst {1000 * max(single):.0f} ms of {len(single)}"
    )
    print(
        f"a drag at {DRAG_HERTZ:.0f}/s   {pictures:.1f} pictures per second, the last {1000 * lag:.0f} ms after its end"
    )
    print(f"stock script    median {statistics.median(stock):.1f} s of {len(stock)}")
    print(f"{statistics.median(stock) / median:.0f} times faster")
    if options.write:
        what = f"Camera: from its placement to its picture, {options.num_envs} envs, against the stock script started again"
        keep([Row(what, median, statistics.median(stock), "s", "less", "camera_drag.py")])
    if median > MAX_PLACEMENT_SECONDS:
        raise SystemExit(
            f"one placement took {1000 * median:.0f} ms, more than {1000 * MAX_PLACEMENT_SECONDS:.0f} ms"
        )


if __name__ == "__main__":
    main(tyro.cli(Options))
