"""Time to the first screen of a library: python tests/benchmarks/library.py

Makes a folder of real recordings (one written by `EpisodeWriter` with a camera; the others are copies with their own ids,
seeds, dates and versions, whose .h5 and .rrd are hard links to those of the first) and opens it as the review does: a watched
`Library` with its panel on a viser server, drawn thirty times per second. Each opening runs in its own process. Printed:
milliseconds from creating the `Library` to the first full page of rows, to a thumbnail in each of them, and until everything
is read, without and with an index; then of a second scan, and of the first screen in Chromium (from the address to the rows,
viser's own page included).
"""

from __future__ import annotations

import json
import os
import random
import statistics
import subprocess
import sys
import tempfile
import time
import uuid
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

sys.path.insert(0, str(Path(__file__).parents[2]))


@dataclass
class Options:
    recordings: int = 2000
    repeats: int = 3
    browser: bool = False
    """Measure the page in Chromium too."""
    folder: Path | None = None
    """Keep the recordings in this folder for the next run."""
    one: bool = False
    """Internal: open `folder` once, print the times as JSON, and exit."""


def write_one(folder: Path) -> Path:
    """Write a recording of 50 steps of a scene with two bodies and one camera; returns its ``.json``."""
    from tests.drive.rows import EpisodeRow, append
    from workbench.envs.camera_data import CameraInfo, Picture
    from workbench.envs.scene.shapes import Material, Mesh, SceneGeometry, Visual
    from workbench.episodes.episode import EpisodeInfo
    from workbench.episodes.writing.episode_writer import EpisodeWriter

    rng = np.random.default_rng(0)
    corner = Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.uint32))
    both = np.array([0, 1], np.int32)
    visual = Visual("box", corner, Material((1.0, 0.5, 0.0, 1.0)), np.zeros(2, np.int32), both)
    geometry = SceneGeometry(1, ("floor", "cube"), ("static", "dynamic"), (False, False), (visual,))
    source = (Path(__file__).parents[2] / "tasks" / "push_cube.py").read_text()
    info = EpisodeInfo(
        task="PushCube-v1",
        env_index=0,
        seed=0,
        source_file=None,
        source_hash="0" * 12,
        source={"push_cube.py": source},
        control_dt=0.05,
        control_mode="pd_joint_delta_pos",
        backend="cpu",
    )
    camera = CameraInfo(
        "base", "sensor", 128, 128, 1.0, 0.01, 10.0, np.eye(3, dtype=np.float32), None, ("rgb",)
    )
    writer = EpisodeWriter(folder, info, geometry, {}, ("x", "y"), (camera,))
    poses = np.tile(np.array([0, 0, 0, 1, 0, 0, 0], np.float32), (2, 1))
    noise = rng.integers(0, 255, (8, 8, 3), dtype=np.uint8).repeat(16, 0).repeat(16, 1)
    for step in range(51):
        picture = Picture("base", "sensor", 0, poses[0], noise)
        action = None if step == 0 else np.zeros(2, np.float32)
        done = np.array(step == 50)
        append(writer, EpisodeRow(poses, {"success": done}, action=action, reward=0.1, pictures=(picture,)))
    return writer.finish().json


def make(folder: Path, count: int) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    first = write_one(folder)
    whole = json.loads(first.read_text())
    rng = random.Random(0)
    for k in range(1, count):
        stem = folder / f"PushCube-v1_seed{k:04d}_env00_copy"
        changed: dict[str, Any] = {
            "id": uuid.UUID(int=rng.getrandbits(128)).hex,
            "seed": k,
            "written_at": f"2026-{1 + k % 12:02}-{1 + k % 28:02}T{k % 24:02}:{k % 60:02}:00+00:00",
            "return": rng.random() * 50,
            "success": rng.random() < 0.5,
            "source_hash": f"{k * 5 // count:012}",
            "tags": ["good"] if k % 7 == 0 else [],
        }
        document = {**whole, "workbench": whole["workbench"] | changed, "workbench_checksum": None}
        stem.with_suffix(".json").write_text(json.dumps(document))
        for suffix in (".h5", ".rrd"):
            os.link(first.with_suffix(suffix), stem.with_suffix(suffix))


def open_once(folder: Path, count: int, browser: bool) -> dict[str, float]:
    from workbench.episodes.reader.reading import start_reading

    # The command also starts the reader before it imports the page's modules.
    start_reading()
    import viser

    from tests.drive.panels import Panels
    from workbench.library.folder import Library
    from workbench.library.listing import ROWS_PER_PAGE
    from workbench.library.panel import LibraryPanel

    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    began = time.perf_counter()
    library = Library(folder)
    library.watch()
    panel, panels = LibraryPanel(server, library, lambda ids: None), Panels(server)
    times: dict[str, float] = {}
    draws: list[float] = []
    wanted = min(ROWS_PER_PAGE, count)
    while not {"all", "pictures"} <= times.keys():
        at = time.perf_counter()
        panel.draw()
        draws.append(time.perf_counter() - at)
        view = library.view()
        if "first" not in times and panels.html("wb-library").count("<tbody") == wanted:
            times["first"] = 1e3 * (time.perf_counter() - began)
        if "pictures" not in times and panels.html("wb-library").count("<img") == wanted:
            times["pictures"] = 1e3 * (time.perf_counter() - began)
        if "all" not in times and view.reading is None and len(view.rows) == count:
            times["all"] = 1e3 * (time.perf_counter() - began)
            panel.draw()
        time.sleep(1 / 30)
    times["page KB"] = len(panels.html("wb-library")) / 1e3
    times["longest draw"] = 1e3 * max(draws)
    at = time.perf_counter()
    library.refresh()
    times["look again"] = 1e3 * (time.perf_counter() - at)
    if browser:
        times["Chromium"] = in_chromium(server.get_port())
    library.close()
    server.stop()
    return times


def in_chromium(port: int) -> float:
    from playwright.sync_api import sync_playwright

    from tests.drive.page import launch, new_page
    from workbench.machine.doctor import find_chromium, how_to_get_chromium

    chromium = find_chromium()
    if chromium is None:
        sys.exit(how_to_get_chromium())
    with sync_playwright() as playwright:
        page, _ = new_page(launch(playwright, chromium))
        began = time.perf_counter()
        page.goto(f"http://127.0.0.1:{port}")
        page.wait_for_selector(".wb-library tbody:nth-of-type(50)")
        return 1e3 * (time.perf_counter() - began)


def measure(folder: Path, options: Options) -> dict[str, float]:
    command = [sys.executable, __file__, "--one", "--folder", str(folder)]
    command += ["--recordings", str(options.recordings), *(["--browser"] if options.browser else [])]
    return json.loads(
        subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()[-1]
    )


def main(options: Options) -> None:
    if options.one:
        assert options.folder is not None
        print(json.dumps(open_once(options.folder, options.recordings, options.browser)))
        return
    from workbench.library.index import index_path

    with tempfile.TemporaryDirectory() as made:
        folder = options.folder or Path(made) / "recordings"
        if not folder.exists():
            began = time.perf_counter()
            make(folder, options.recordings)
            print(f"{options.recordings} recordings made in {time.perf_counter() - began:.1f} s")
        index = index_path(folder)
        for name in ("without an index", "with an index"):
            runs = []
            for _ in range(options.repeats):
                if name == "without an index":
                    index.unlink(missing_ok=True)
                runs.append(measure(folder, options))
            keys = runs[0].keys()
            print(
                f"{name}: " + ", ".join(f"{k} {statistics.median(run[k] for run in runs):.0f}" for k in keys)
            )


if __name__ == "__main__":
    main(tyro.cli(Options))
