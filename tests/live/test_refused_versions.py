"""A refused or removed version leaves nothing behind, whatever its code did to the process."""

# The fixture hands over a session whose task is loaded: what may be None before is not here.
# pyright: reportOptionalMemberAccess=false, reportOptionalSubscript=false

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.drive.session import live_session, save, start_over, step, wait_until
from workbench.app.session import Session
from workbench.live.commands import PlayRun, Step
from workbench.live.events import EnvsReset
from workbench.live.view import SessionView
from workbench.record.commands import StopRecording
from workbench.record.state import RecordingStatus, RecordingWanted

pytestmark = pytest.mark.usefixtures("child_process")

EVALUATE = "    def evaluate(self) -> dict[str, torch.Tensor]:\n"
AT_IMPORT = "\n\n@register_env("


@pytest.fixture(scope="module")
def good(task_file: Path) -> str:
    text = task_file.read_text()
    assert text.count(EVALUATE) == text.count(AT_IMPORT) == 1
    return text


@pytest.fixture(scope="module")
def expected(good: str, session: Session) -> SessionView:
    """The view of seed 0 in a fresh session."""
    return played(session)


@pytest.fixture
def fixed(good: str, expected: SessionView, session: Session, task_file: Path) -> Iterator[Session]:
    yield session
    save(session, task_file, good)
    found = played(session)
    np.testing.assert_array_equal(found.step.poses, expected.step.poses)
    np.testing.assert_array_equal(found.step.reward, expected.step.reward)


def played(session: Session) -> SessionView:
    start_over(session, 0)
    return step(session, 3)


def refused(session: Session, task_file: Path, text: str) -> SessionView:
    before = session.view()
    task_file.write_text(text)

    def reached(view: SessionView) -> bool:
        return view.problem is not None and view.problem_serial > before.problem_serial

    wait_until(session, reached, "the refusal")
    # Its first moment arrives after the version.
    return wait_until(
        session,
        lambda v: v.state == "paused" and v.timeline.last > before.timeline.last,
        "the last good version",
    )


def in_evaluate(good: str, *lines: str) -> str:
    return good.replace(EVALUATE, EVALUATE + "".join(f"        {line}\n" for line in lines))


def at_import(good: str, *lines: str) -> str:
    head, tail = good.split(AT_IMPORT)
    return head + "\n" + "\n".join(lines) + AT_IMPORT + tail


MISCHIEF = {
    "a member of the task": ("self.cube = self.cube.pose.p",),
    "a default type": ("torch.set_default_dtype(torch.float64)",),
    "the clock": ("import time", "time.monotonic = lambda: 0.0"),
    "a method of ManiSkill": (
        "from mani_skill.utils.structs import Actor",
        "Actor.set_pose = lambda *given: None",
    ),
}


@pytest.mark.parametrize("what", MISCHIEF)
def test_effects_of_a_refused_version_are_gone(
    fixed: Session, task_file: Path, good: str, expected: SessionView, what: str
) -> None:
    before = played(fixed)
    bad = in_evaluate(good, *MISCHIEF[what], "raise ValueError('enough')")
    view = refused(fixed, task_file, bad)
    line = bad[: bad.index("raise ValueError('enough')")].count("\n") + 1
    assert view.stale and (view.problem.file, view.problem.line) == (str(task_file), line)
    # The last good version is restored at the same moment (float32 link poses, from the joints) and runs on.
    np.testing.assert_allclose(view.step.poses, before.step.poses, atol=1e-5)
    np.testing.assert_array_equal(view.step.elapsed_steps, before.step.elapsed_steps)
    np.testing.assert_array_equal(step(fixed).step.elapsed_steps, before.step.elapsed_steps + 1)


@pytest.mark.parametrize(
    "lines",
    [
        ("torch.set_num_threads(3)",),
        ("from mani_skill.utils.structs import Actor", "Actor.kept = 1", "print('imported')"),
        ("import threading, time", "threading.Thread(target=lambda: time.sleep(3600), daemon=True).start()"),
    ],
    ids=["a setting", "a class", "a thread"],
)
def test_global_settings_of_a_version_disappear_with_their_line(
    fixed: Session, task_file: Path, good: str, lines: tuple[str, ...]
) -> None:
    before = save(fixed, task_file, at_import(good, *lines))
    worker = fixed.worker_pid
    view = save(fixed, task_file, good)
    assert fixed.worker_pid != worker
    assert view.reload.level == "restarted"
    np.testing.assert_array_equal(view.step.elapsed_steps, before.step.elapsed_steps)


LATE_FAILURES = {
    "a raise": ("pass", False),
    "a default type": ("torch.set_default_dtype(torch.float64)", True),
}


@pytest.mark.parametrize("what", [pytest.param("a raise", marks=pytest.mark.slow), "a default type"])
def test_after_a_failure_at_run_time_a_reset_and_steps_equal_those_of_a_clean_process(
    fixed: Session, task_file: Path, good: str, expected: SessionView, what: str
) -> None:
    did, replaced = LATE_FAILURES[what]
    bad = in_evaluate(
        good, "if self.elapsed_steps.max() > 3:", f"    {did}", "    raise RuntimeError('late')"
    )
    line = bad[: bad.index("raise RuntimeError('late')")].count("\n") + 1
    save(fixed, task_file, bad)
    for go_on in (PlayRun(), Step()):
        before, worker = played(fixed), fixed.worker_pid
        assert before.problem is None
        np.testing.assert_array_equal(before.step.poses, expected.step.poses)
        np.testing.assert_array_equal(before.step.reward, expected.step.reward)
        fixed.do(go_on)
        view = wait_until(
            fixed,
            lambda v, n=before.task_serial: (
                v.problem_at_run and v.state == "paused" and v.task_serial == n + replaced
            ),
            "the failure, and a pause",
        )
        assert (fixed.worker_pid != worker) is replaced is (view.spoiled != ""), view.spoiled
        assert (view.problem.file, view.problem.line) == (str(task_file), line)
        assert not view.stale and not view.playing
        assert view.step.elapsed_steps.tolist() == [3, 3]


@pytest.mark.slow
def test_recording_and_playing_go_on_after_a_refused_version(
    task_file: Path, good: str, tmp_path: Path
) -> None:
    file = tmp_path / "push.py"
    file.write_text(good)
    with live_session(file, tmp_path / "recordings") as session:
        session.change(speed=8.0)
        session.dispatch(RecordingWanted((0,)))
        session.do(PlayRun())
        wait_until(session, lambda v: v.of(RecordingStatus).steps > 3, "some recorded steps")
        file.write_text(in_evaluate(good, "raise ValueError('enough')"))
        wait_until(session, lambda v: v.problem is not None, "the refusal")
        again = wait_until(session, lambda v: v.problem is not None and v.state == "running", "playing again")
        assert again.of(RecordingStatus).active and again.of(RecordingStatus).env_idx == (0,)
        wait_until(
            session, lambda v: v.of(RecordingStatus).episodes_written >= 1, "the episode that was running"
        )
        session.dispatch(EnvsReset((0,)))
        wait_until(session, lambda v: v.of(RecordingStatus).steps > 3, "steps of the next episode")
        session.do(StopRecording())
        wait_until(session, lambda v: v.of(RecordingStatus).episodes_written >= 2, "both episodes")
