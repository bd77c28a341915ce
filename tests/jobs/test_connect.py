"""A local cluster started by a job, and addresses without a cluster."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from tests.drive.waiting import until
from tests.episodes.verify_rrd import verify_rrd

pytestmark = [pytest.mark.usefixtures("child_process"), pytest.mark.timeout(240)]
STARTS = """
import os
import psutil
from workbench.jobs.ray_connection import connected

with connected("local") as ray:
    family = [psutil.Process(), *psutil.Process().children(recursive=True)]
    ports = [one for process in family for one in process.net_connections("inet") if one.status == "LISTEN"]
    print(len(ports), {one.laddr.ip.removeprefix("::ffff:") for one in ports}, os.environ["RAY_AUTH_MODE"])
_, alive = psutil.wait_procs(family[1:], timeout=20)
print(len(alive))
"""


FINDS_NONE = """
from workbench.jobs.ray_connection import NoCluster, connected

try:
    with connected("127.0.0.1:1"):
        pass
except NoCluster as error:
    print(error)
"""


@pytest.fixture
def ray_folder() -> Iterator[str]:
    folder = tempfile.mkdtemp(prefix="ray", dir="/tmp")  # socket paths must be short
    yield folder
    shutil.rmtree(folder, ignore_errors=True)


def run(script: str, tmp_path: Path, ray_folder: str) -> list[str]:
    (tmp_path / "script.py").write_text(script)
    done = subprocess.run(
        [sys.executable, tmp_path / "script.py"],
        capture_output=True,
        text=True,
        timeout=120,
        env={**os.environ, "RAY_TMPDIR": ray_folder},
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.mark.slow
def test_a_local_cluster_needs_a_token_is_local_only_and_ends_with_the_job(
    tmp_path: Path, ray_folder: str
) -> None:
    while_it_runs, after = run(STARTS, tmp_path, ray_folder)
    count, _, rest = while_it_runs.partition(" ")
    assert int(count) >= 4 and rest == "{'127.0.0.1'} token"
    assert after == "0"


def test_an_address_without_a_cluster_is_reported(tmp_path: Path, ray_folder: str) -> None:
    (message,) = run(FINDS_NONE, tmp_path, ray_folder)
    assert message.startswith("no Ray cluster answers at 127.0.0.1:1 ") and "`ray start --head`" in message


@pytest.mark.slow
def test_ctrl_c_keeps_finished_episodes_and_ends_the_cluster(tmp_path: Path, ray_folder: str) -> None:
    command = [
        *(
            sys.executable,
            "-m",
            "workbench.cli.main",
            "record",
            "PushCube-v1",
            "--no-pictures",
            "--cluster",
            "local",
        ),
        *(
            "--env",
            "render_backend=none",
            "--episodes",
            "100000",
            "--max-steps",
            "3",
            "--out",
            str(tmp_path / "out"),
        ),
    ]
    process = subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env={**os.environ, "RAY_TMPDIR": ray_folder},
    )
    until(
        lambda: len(list((tmp_path / "out").glob("*.json"))) > 40 or process.poll() is not None,
        "some episodes",
        120,
    )
    family = psutil.Process(process.pid).children(recursive=True)
    pressed = time.time()
    os.killpg(process.pid, signal.SIGINT)  # a terminal signals the process group too
    stdout, errors = process.communicate(timeout=90)
    assert process.returncode == 130 and "interrupted" in errors and "Traceback" not in errors
    written = sorted((tmp_path / "out").glob("*.json"))
    listed = {Path(line.split(".rrd")[0] + ".json") for line in stdout.splitlines()[:-1]}
    assert len(listed) > 20 and listed <= set(written)
    # The reports of the last episodes may be lost when the cluster ends.
    assert all(path.stat().st_mtime > pressed - 5.0 for path in set(written) - listed)
    assert all(verify_rrd(path.with_suffix(".rrd")) is None for path in written[-2:])
    _, alive = psutil.wait_procs(family, timeout=20)
    assert not alive


def named(process: psutil.Process) -> str:
    try:
        return process.name()
    except psutil.NoSuchProcess:
        return ""


@pytest.mark.slow
@pytest.mark.parametrize("daemon", ["raylet", "gcs_server"])
def test_a_dead_cluster_ends_the_command_with_a_message_and_keeps_recorded_episodes(
    daemon: str, tmp_path: Path, ray_folder: str
) -> None:
    out = tmp_path / "out"
    command = (
        *("-m", "workbench.cli.main", "record", "PushCube-v1", "--episodes", "5000", "--no-pictures"),
        *("--env", "render_backend=none", "--envs-per-worker", "2", "--workers", "1", "--cluster", "local"),
        *("--out", str(out), "--job", str(tmp_path / "the.job")),
    )
    started = subprocess.Popen(
        [sys.executable, *command],
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
        env={**os.environ, "RAY_TMPDIR": ray_folder},
    )
    until(lambda: started.poll() is not None or any(out.glob("*.json")), "an episode", 120)
    family = psutil.Process(started.pid).children(recursive=True)
    (victim,) = [process for process in family if named(process) == daemon]
    victim.kill()
    _, stderr = started.communicate(timeout=55)  # after 60 s Ray would end it from native code
    assert started.returncode == 1 and "Traceback" not in stderr and "core_worker" not in stderr, stderr
    assert "Ray" in stderr and "--job" in stderr, stderr
    kept = [path.stem for path in out.glob("*.json")]
    assert kept and all((out / f"{stem}{suffix}").exists() for stem in kept for suffix in (".rrd", ".h5"))
    # The cluster's agents search for the dead head node for a while.
    _, alive = psutil.wait_procs(family, timeout=100)
    assert not alive
