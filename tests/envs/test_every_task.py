"""Every task in ManiSkill's registry works batched, or its error names the missing asset or the faulty file.

The sweep over all ids takes minutes and is marked slow; `tests/sweeps/task_ids.py` writes its docs page. Quick tests
cover one id with cameras and each known fault of ManiSkill's own tasks.
"""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.drive.envs import batched
from tests.sweeps.exercise_task import exercise
from tests.sweeps.task_ids import PAGE, page, registered_ids, sweep
from tests.sweeps.upstream_faults import FAULTS, Fault, where_it_fails
from workbench.envs.task_env import TaskEnv

ROOT = Path(__file__).parents[2]


def rows_of_the_page() -> dict[str, list[str]]:
    """Return the cells of the page's rows by env id."""
    rows = [
        line[2:-2].split(" | ")
        for line in PAGE.read_text().splitlines()
        if re.match(r"\| [\w-]+-v\d+ ", line)
    ]
    return {cells[0]: cells for cells in rows}


def test_a_task_passes_the_exercise_with_cameras_on(renderer: None) -> None:
    row = exercise("MS-CartpoleBalance-v1")
    assert row.outcome == "passed" and row.cameras, row


def test_a_task_with_an_upstream_fault_does_the_rest(renderer: None) -> None:
    row = exercise("MS-HopperStand-v1")
    assert row.outcome == "upstream" and row.after_restore, row


# --- faults of ManiSkill's own ----------------------------------------------------------------------


# One task for each; the sweep has the others, and DrawSVG-v1 with its hundreds of bodies.
@pytest.mark.parametrize(
    "fault",
    [fault for fault in FAULTS if fault.ids[0] != "DrawSVG-v1"],
    ids=lambda fault: f"{fault.ids[0]} {fault.stage}",
)
def test_an_upstream_fault_is_raised_at_its_listed_line(fault: Fault) -> None:
    made = batched(fault.ids[0], 4, rules="off")
    env = TaskEnv(made)
    env.reset(seed=1)
    act = {"partial reset": lambda: env.reset(seed=5, env_idx=[1, 3]), "get_state": made.get_state}[
        fault.stage
    ]
    with pytest.raises(Exception) as caught:
        act()
    where = where_it_fails(fault, caught.value)
    assert where is not None, f"not at {fault.file}: {fault.line}\n{caught.getrepr()}"
    if fault.stage == "partial reset":
        assert "[1, 3] of 4" in " ".join(caught.value.__notes__)
    env.reset(seed=1)
    made.close()


def test_a_fault_that_upstream_fixed_fails_the_exercise(
    renderer: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    faulty = FAULTS[0]
    fixed = Fault(
        ("MS-CartpoleBalance-v1",), faulty.stage, faulty.file, faulty.line, faulty.why, faulty.upstream
    )
    # Patch the function's globals: pytest may have imported its module twice.
    monkeypatch.setitem(exercise.__globals__, "faults_of", lambda env_id: {fixed.stage: fixed})
    row = exercise("MS-CartpoleBalance-v1")
    assert row.outcome == "failed" and "upstream fixed" in row.notes[0], row


# --- all of them, each in a child process -----------------------------------------------------------


@pytest.mark.slow
def test_a_task_that_crashes_its_process_is_one_row_and_the_sweep_continues(child_process: None) -> None:
    crashed, missing = sweep(["No-Such-Task-v1", "PickSingleYCB-v1"])
    assert crashed["outcome"] == "crashed"
    assert (missing["outcome"], missing["notes"]) == ("download", ["ycb"])


def test_a_task_that_hangs_is_one_row(child_process: None) -> None:
    (row,) = sweep(["PickCube-v1"], limit=0.2)
    assert row["outcome"] == "hung"


@pytest.mark.slow
def test_the_page_has_a_row_for_every_registered_id_and_no_failure(child_process: None) -> None:
    rows = rows_of_the_page()
    # List the ids in a new process: here other tests may have loaded copies of ManiSkill's files that took over their ids.
    ask = "from tests.sweeps.task_ids import registered_ids; print(*registered_ids(), sep='\\n')"
    listed = subprocess.run([sys.executable, "-c", ask], check=True, capture_output=True, text=True, cwd=ROOT)
    assert sorted(rows) == listed.stdout.split()
    assert {cells[2] for cells in rows.values()} == {"passed", "its own fault", "download"}
    assert {env_id for env_id, cells in rows.items() if cells[2] == "its own fault"} == {
        env_id for fault in FAULTS for env_id in fault.ids
    }


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_every_registered_id_works_as_the_page_says_and_downloads_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # ManiSkill reads this as consent to every download.
    monkeypatch.setenv("MS_SKIP_ASSET_DOWNLOAD_PROMPT", "1")
    rows = list(sweep(registered_ids()))
    outcomes = {row["env_id"]: row["outcome"] for row in rows}
    assert not {
        env_id: outcome for env_id, outcome in outcomes.items() if outcome in ("failed", "crashed", "hung")
    }
    ships = [row for row in rows if row["outcome"] != "download"]
    assert all(row["follows"] for row in ships), [row for row in ships if not row["follows"]]
    assert sum(row["like_stock"] == "bit for bit" for row in ships) >= 25
    on_new_page = {
        cells[0]: cells[2:4]
        for cells in (line[2:-2].split(" | ") for line in page(rows).splitlines()[-len(rows) :])
    }
    assert {env_id: cells[2:4] for env_id, cells in rows_of_the_page().items()} == on_new_page
    named = {row["env_id"]: row["notes"] for row in rows}
    assert named["PickSingleYCB-v1"] == ["ycb"]
    assert named["UnitreeH1Stand-v1"] == ["unitree_h1"], "a robot"
    assert named["OpenCabinetDrawer-v1"] == ["partnet_mobility_cabinet"], "an asset group"
    assert named["ArchitecTHOR_SceneManipulation-v1"] == ["AI2THOR"], "found from the missing file's path"
    assert named["ReplicaCADSetTableVal_SceneManipulation-v1"] == ["ReplicaCAD", "ReplicaCADRearrange"]
