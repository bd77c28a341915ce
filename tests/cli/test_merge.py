"""``--shard`` and ``workbench merge``: separately run parts equal the whole, bit for bit."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.drive.commands import exit_code
from workbench.machine.folders import web_assets_folder

pytestmark = pytest.mark.usefixtures("child_process")
TASK = Path(__file__).parents[2] / "tasks" / "minimal.py"
QUICK = ("--max-steps", "4", "--env", "render_backend=none")


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with a task."""
    shutil.copy(TASK, tmp_path / "my_task.py")
    (tmp_path / "parts").mkdir()
    monkeypatch.chdir(tmp_path)
    return tmp_path


def bits(folder: Path) -> dict[str, bytes]:
    found = {re.sub(r".*_(seed\d+)_.*", r"\1", path.name): path.read_bytes() for path in folder.glob("*.h5")}
    assert len(found) == len(list(folder.glob("*.h5"))) == len(list(folder.glob("*.json")))
    return found


def record(*arguments: str) -> int:
    few = ("--episodes", "6", "--num-envs", "2", "--no-pictures", "--workers", "1")
    return exit_code("record", "my_task.py", *few, *QUICK, *arguments)


def test_merged_parts_completed_by_a_resumed_job_equal_the_whole(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert record("--out", "whole") == 0
    for part in ("1/3", "3/3"):
        assert record("--shard", part, "--out", f"parts/{part[0]}") == 0
    assert {path.name for path in place.glob("*.job")} == {"record-1-of-3.job", "record-3-of-3.job"}
    parts = ("record-1-of-3.job", "record-3-of-3.job")
    assert exit_code("merge", *parts) == 2
    assert "the episodes are in 2 folders" in capsys.readouterr().err
    assert exit_code("merge", *parts, "--out", "demos", "--job", "whole.job") == 1
    assert (
        "2 of the job's episodes are in none of these files: number 2, number 3\n" in capsys.readouterr().out
    )
    capsys.readouterr()
    assert record("--out", "demos", "--job", "whole.job") == 0
    # Existing episodes are not reported as progress.
    assert re.findall(r"^episode (\d):", capsys.readouterr().err, re.M) == ["2", "3"]
    assert bits(place / "demos") == bits(place / "whole") and len(bits(place / "demos")) == 6
    assert exit_code("merge", "whole.job") == 0
    assert str(place / "demos") in capsys.readouterr().out


def test_a_deleted_episode_is_recorded_again(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert record("--out", "demos", "--job", "a.job") == 0
    before = bits(place / "demos")
    (deleted,) = (place / "demos").glob("*seed0003*.json")
    deleted.unlink()
    assert record("--out", "demos", "--job", "a.job") == 0
    made = capsys.readouterr().out
    (again,) = (place / "demos").glob("*seed0003*.json")
    assert str(again.with_suffix(".rrd").relative_to(place)) in made
    assert (place / "demos" / f"{again.stem}.h5").read_bytes() == before["seed0003"]


def test_a_part_of_another_job_is_refused(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert record("--shard", "1/3", "--out", "demos") == 0
    assert record("--shard", "2/3", "--out", "demos", "--seed", "5") == 0
    capsys.readouterr()
    assert exit_code("merge", "record-1-of-3.job", "record-2-of-3.job") == 2
    assert "belongs to another job: seed is 0 here and 5 there" in capsys.readouterr().err


@pytest.mark.slow
def test_the_script_of_the_docs_runs_its_part_as_an_array_task(place: Path) -> None:
    page = (web_assets_folder() / "docs" / "jobs" / "cluster.md").read_text()
    (script,) = re.findall(r"```sh fragment\n(#!/bin/bash\n.*?)```", page, re.DOTALL)
    merge = next(line for line in page.splitlines() if line.startswith("workbench merge"))
    environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    for number in range(1, 5):
        (place / "job.sh").write_text(script.replace("--no-pictures", f"--no-pictures {' '.join(QUICK)}"))
        subprocess.run(
            ["bash", "job.sh"],
            check=True,
            env={**environment, "SLURM_ARRAY_TASK_ID": str(number)},
            timeout=120,
        )
    subprocess.run(merge, shell=True, check=True, env=environment, timeout=120)
    assert (
        exit_code("record", "my_task.py", "--episodes", "16", "--no-pictures", *QUICK, "--out", "whole") == 0
    )
    assert bits(place / "demos") == bits(place / "whole") and len(bits(place / "demos")) == 16
