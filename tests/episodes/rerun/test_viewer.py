"""A recording opens in rerun's native viewer, which listens on the loopback address only and sends nothing."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from PIL import Image
from rerun.experimental import ViewerClient

from tests.episodes.verify_rrd import verify_rrd
from workbench.episodes.rerun.viewer import (
    await_port,
    end,
    free_port,
    open_window,
    quiet_environment,
    rerun_command,
)

pytestmark = pytest.mark.usefixtures("child_process")


@pytest.fixture(scope="module")
def file(recorded: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    written = recorded.episode.write(tmp_path_factory.mktemp("recordings"))
    return written.rrd.rename(written.rrd.with_name("PickCube ä.rrd"))


@pytest.fixture
def headless(file: Path) -> Iterator[ViewerClient]:
    """Rerun's viewer without a window. `ViewerClient.spawn` would listen on every address."""
    port = free_port()
    options = ["--headless", "--hide-welcome-screen", "--bind", "127.0.0.1", "--port", str(port)]
    process = subprocess.Popen(
        [*rerun_command(), *options], env=quiet_environment(), stderr=subprocess.DEVNULL
    )
    try:
        await_port(process, port)
        assert listening(process.pid) == {"127.0.0.1"}
        yield ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
    finally:
        end(process)


def listening(pid: int) -> set[str]:
    """Addresses on which a process and its children listen."""
    processes = [psutil.Process(pid), *psutil.Process(pid).children(recursive=True)]
    connections = [c for process in processes for c in process.net_connections("inet")]
    return {c.laddr.ip for c in connections if c.status == psutil.CONN_LISTEN}


@pytest.mark.slow
def test_the_native_viewer_shows_the_whole_layout(headless: ViewerClient, file: Path, tmp_path: Path) -> None:
    opened = headless.open(str(file))
    assert len(opened.store_ids) == 1
    headless.set_time("step", sequence=5)
    state = headless.get_state()
    (recording,) = state.recordings
    timelines = {(one.name, one.start, one.end) for one in recording.timelines}
    assert timelines == {("step", 0, 8), ("sim_time", 0, 400_000_000)}
    assert recording.current_timeline == "step"
    views = {view.name: view for view in state.views}
    cameras = {f"{of}_camera {what}" for of in ("base", "hand") for what in ("rgb", "depth", "segmentation")}
    assert views.keys() == {"Scene", *cameras, "Reward", "Evaluate", "Action", "Events"}
    assert not [report for view in state.views for report in view.reports]
    for name, colours in (("Scene", 100), ("hand_camera rgb", 100), ("base_camera segmentation", 5)):
        picture = tmp_path / f"{name}.png"
        headless.save_screenshot(str(picture), view_id=views[name].view_id)
        pixels = np.asarray(Image.open(picture).convert("RGB"))
        assert len(np.unique(pixels.reshape(-1, 3), axis=0)) > colours, f"{name} is blank"
    scene = np.asarray(Image.open(tmp_path / "Scene.png").convert("RGB")).astype(int)
    # Goal (pure green) and cube (red) are small and near the middle of the view.
    green = (scene[..., 1] > 150) & (scene[..., [0, 2]].max(axis=-1) < 60)
    assert 20 < green.sum() < green.size / 20
    rows, columns = np.nonzero(green)
    assert 0.2 < rows.mean() / scene.shape[0] < 0.8 and 0.2 < columns.mean() / scene.shape[1] < 0.8


def test_opening_a_window_without_a_display_is_refused(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(RuntimeError, match="There is no display here"):
        open_window([file])


def test_a_window_that_cannot_open_is_reported_and_leaves_no_process(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setenv("DISPLAY", ":4711")  # no X server has this number
    before = psutil.Process().children()
    with pytest.raises(RuntimeError, match="ended with"):
        # Rerun listens before it opens its display, so either of the two may report the failure.
        open_window([file]).wait()
    assert psutil.Process().children() == before


def test_reruns_telemetry_is_turned_off(file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, folder in (("HOME", ""), ("XDG_CONFIG_HOME", "config"), ("XDG_DATA_HOME", "data")):
        monkeypatch.setenv(name, str(tmp_path / folder))
    monkeypatch.setenv("FORCE_RERUN_ANALYTICS", "1")
    monkeypatch.delenv("CI", raising=False)
    assert verify_rrd(file) is None
    for config in tmp_path.rglob("analytics.json"):
        assert json.loads(config.read_text())["analytics_enabled"] is False
    assert not list(tmp_path.rglob("analytics/*.json"))
