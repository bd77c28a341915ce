"""Make a set of golden recordings with this version: python tests/golden/make.py v2

Run by hand, once per file format: later versions must read a set as the version of its time wrote it, so an existing set
is overwritten only with --over. Files are made below /tmp/golden, a path that none of them contains, in half a minute.

    cameras      64x48 colour, depth and segmentation, and a success
    several      a task of several modules
    tagged       with tags and a note
    damaged      three episodes: a truncated .rrd, an .h5 with one flipped bit, both
    unfinished   .writing/ of a killed process
    recovered    the same after the next start has recovered the episode
    expected.json    the expected values of each episode
"""

from __future__ import annotations

import argparse
import hashlib
import json
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[2]))
from workbench.episodes.episode import Episode
from workbench.episodes.reader.read_episode import read_episode
from workbench.episodes.reader.reading import recover_confined
from workbench.library.folder import Library

GOLDEN = Path(__file__).parent
PLACE = Path("/tmp/golden")


def expected_of(episode: Episode) -> dict[str, Any]:
    """Return the values that reading must give: a digest of every column, and the mean of colours, which JPEG decoders round."""
    info = episode.info
    return {
        "task": info.task,
        "seed": info.seed,
        "recovered": info.recovered,
        "control_mode": info.control_mode,
        "control_dt": info.control_dt,
        "env_kwargs": info.env_kwargs,
        "acted_by": [list(pair) for pair in info.acted_by],
        "source": sorted(info.source),
        "bodies": [] if episode.geometry is None else list(episode.geometry.body_names),
        "visuals": 0 if episode.geometry is None else len(episode.geometry.visuals),
        "action_names": list(episode.action_names),
        "reward": [float(reward) for reward in episode.reward],
        "columns": {name: _digest(values) for name, values in sorted(_columns(episode))},
        "colour": {
            camera.info.name: [float(camera.rgb[k].mean()) for k in range(len(camera.frame))]
            for camera in episode.cameras
            if camera.rgb is not None
        },
    }


def _columns(episode: Episode) -> Iterator[tuple[str, NDArray]]:
    for name in ("action", "reward", "terminated", "truncated"):
        yield name, getattr(episode, name)
    if episode.poses is not None:
        yield "poses", episode.poses
    for kind in ("evaluate", "env_states", "obs"):
        for name, values in getattr(episode, kind).items():
            yield f"{kind}/{name}", values
    for camera in episode.cameras:
        place = f"cameras/{camera.info.name}"
        yield f"{place}/frame", camera.frame
        yield f"{place}/pose", camera.pose
        yield f"{place}/intrinsic", camera.info.intrinsic
        for modality in ("depth", "segmentation"):
            pictures = getattr(camera, modality)
            if pictures is not None:
                yield f"{place}/{modality}", np.stack([pictures[k] for k in range(len(camera.frame))])


def _digest(values: NDArray) -> str:
    # Normalize NaN payloads and -0, which readers do not distinguish.
    values = np.asarray(values)
    if values.dtype.kind == "f":
        values = np.where(np.isnan(values), values.dtype.type(np.nan), values) + values.dtype.type(0)
    content = np.ascontiguousarray(values.astype(values.dtype.newbyteorder("<"))).tobytes()
    return f"{values.dtype} {values.shape} {hashlib.sha256(content).hexdigest()[:16]}"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("set", help="name of the set, such as v2")
    parser.add_argument("--over", action="store_true", help="overwrite an existing set")
    options = parser.parse_args()
    target = GOLDEN / options.set
    if target.exists() and not options.over:
        sys.exit(f"{target} exists and must stay as its version wrote it. To overwrite it, add --over")
    shutil.rmtree(PLACE, ignore_errors=True)
    shutil.copytree(GOLDEN / "tasks", PLACE / "tasks", ignore=shutil.ignore_patterns("__pycache__"))
    folder = PLACE / options.set
    record(folder / "cameras", "push/push.py", "act", "--seed", "5")
    record(folder / "several", "several/task.py", "act", "--seed", "6", "--no-pictures")
    record(folder / "tagged", "push/push.py", "act", "--seed", "7", "--no-pictures")
    tag(folder / "tagged")
    record(folder / "damaged", "push/push.py", "act", "--seed", "8", "--no-pictures", "--episodes", "3")
    expected = {"damaged": read_folder(folder / "damaged")}
    damage(folder / "damaged")
    kill_while_recording(folder / "unfinished")
    shutil.copytree(folder / "unfinished", folder / "recovered")
    assert len(recover_confined(folder / "recovered")) == 1
    for kind in ("cameras", "several", "tagged", "recovered"):
        expected[kind] = read_folder(folder / kind)
    (folder / "expected.json").write_text(json.dumps(expected, indent=1) + "\n")
    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(folder, target)
    size = sum(path.stat().st_size for path in target.rglob("*") if path.is_file())
    print(f"{target}: {size} bytes")


def read_folder(folder: Path) -> dict[str, Any]:
    """Return the expected values of a folder's episodes, by file name."""
    return {path.stem: expected_of(read_episode(path)) for path in sorted(folder.glob("*.json"))}


def command(folder: Path, task: str, policy: str, *arguments: str) -> list[str]:
    record = [sys.executable, "-m", "workbench.cli.main", "record", f"tasks/{task}", "--num-envs", "1"]
    return [*record, "--actions", f"tasks/push/act.py:{policy}", "--out", str(folder), *arguments]


def record(folder: Path, task: str, policy: str, *arguments: str) -> None:
    episodes = () if "--episodes" in arguments else ("--episodes", "1")
    subprocess.run(command(folder, task, policy, *arguments, *episodes), cwd=PLACE, check=True)


def tag(folder: Path) -> None:
    library = Library(folder)
    library.refresh()
    ids = [row.id for row in library.view().rows]
    library.set_tags(ids, add=["good", "slips"])
    library.set_note(ids, "the box turns a little")
    library.close()


def damage(folder: Path) -> None:
    cut, turned, both = sorted(folder.glob("*.json"))
    for path in (cut.with_suffix(".rrd"), both.with_suffix(".rrd")):
        path.write_bytes(path.read_bytes()[:30_000])
    for path in (turned.with_suffix(".h5"), both.with_suffix(".h5")):
        content = bytearray(path.read_bytes())
        content[len(content) // 2] ^= 1
        path.write_bytes(content)


def kill_while_recording(folder: Path) -> None:
    """Kill a recording whose policy waits forever at the seventh step; all steps before it are in the journal."""
    arguments = ("--seed", "9", "--no-pictures", "--episodes", "1")
    process = subprocess.Popen(command(folder, "push/push.py", "act_and_wait", *arguments), cwd=PLACE)
    while not (PLACE / "waiting").exists():
        time.sleep(0.1)
    time.sleep(3.0)  # many times the delay after which a row is written
    process.kill()
    process.wait()


if __name__ == "__main__":
    main()
