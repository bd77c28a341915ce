"""Processes beside the one that plays: what they send is believed as little as what that one sends."""

from __future__ import annotations

from pathlib import Path

import psutil
import pytest

from tests.session.hazards import provoke, write_task
from workbench.session.background import BackgroundProcess
from workbench.session.lane import Job, JobFailed, Lane
from workbench.session.messages import Failed, Load, Loaded, TaskOptions


@pytest.mark.parametrize("what", ["garbage", pytest.param("half", marks=pytest.mark.slow)])
def test_a_process_that_sends_garbage_ends_its_job_and_the_next_can_have_another(
    child_process: None, tmp_path: Path, what: str
) -> None:
    file = write_task(tmp_path)
    provoke(file, "import", what)
    process = BackgroundProcess("that judges", "to judge with")
    lane = Lane("test", lambda: None, lambda why: None)
    job = Job(lane, "judging", lambda job: None)
    process.start()
    pid = process.pid
    process.send(Load(str(file), TaskOptions(num_envs=1)))
    if what == "half":
        # It hangs in the middle of a message: that is no end, and a job that is stopped must get out all the same.
        process._owed = (Loaded, Failed)
        process.settle(1.0)
    else:
        with pytest.raises(JobFailed, match="the process that judges sent what cannot be read"):
            process.answer(job, Loaded, Failed)
    assert process.pid is None and pid is not None and not psutil.pid_exists(pid)
