"""A task whose ``evaluate`` returns more than numbers per env: played, recorded, read back, rescored and restored."""

# pyright: reportOptionalMemberAccess=false, reportOptionalSubscript=false

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import workbench
from tests.drive.session import live_session, wait_until
from tests.episodes.verify_rrd import verify_rrd
from tests.live.odd_entries import write_task
from tests.live.recorded_runs import opened
from workbench.app.session import Session
from workbench.cli.rescore import RescoreOptions, rescore_all
from workbench.envs.step_result import OtherEntry, StepResult
from workbench.episodes.reader.read_episode import read_episode
from workbench.episodes.recorded_source import run_of
from workbench.episodes.replay import replay_to
from workbench.live.commands import PauseRun, PlayRun
from workbench.record.state import RecordingStatus, RecordingWanted

pytestmark = pytest.mark.usefixtures("child_process")

N, STEPS = 3, 5
SPEC: Any = {"backend": "cpu", "render_backend": "none", "reward_mode": "dense", "obs_mode": "state"}


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_task(tmp_path_factory.mktemp("odd"))


@pytest.fixture(scope="module")
def recordings(file: Path) -> Path:
    """An episode of each env, recorded by `workbench.Recorder`, which records the steps of all envs together."""
    folder = file.parent / "recordings"
    env = workbench.Recorder(workbench.make(file, N, **SPEC), folder)
    env.reset(seed=[3, 4, 5])
    rng = np.random.default_rng(0)
    for _ in range(STEPS):
        env.step(rng.uniform(-0.3, 0.3, (N, 8)).astype(np.float32))
    env.close()
    assert env.problem is None and env.episodes_written == N
    return folder


def text(entry: OtherEntry | None) -> str | None:
    return None if entry is None else "".join(entry.texts)


@pytest.mark.parametrize("env", range(N))
def test_odd_entries_are_recorded_and_read_back(recordings: Path, env: int) -> None:
    path = sorted(recordings.glob("*.json"))[env]
    assert verify_rrd(path.with_suffix(".rrd")) is None
    episode = read_episode(path)
    assert (episode.length, episode.info.env_index, episode.broken_files) == (STEPS, env, ())
    others: Any = [episode.other_entries_at(state) for state in range(STEPS + 1)]
    assert [text(each["phase"]) for each in others] == ["reach"] * 2 + ["push"] * 4
    assert [each["stage"].numbers for each in others] == [2] * 6
    best = [text(each["best"]) or float(each["best"].numbers) for each in others]
    assert best == ["None", "None", "None", 0.75, 1.0, 1.25]
    assert [text(each.get("sometimes")) for each in others] == [None, "now", None, None, "now", None]
    assert text(others[2]["words"]) == f"cube {env}" and others[2]["words"].per_env
    assert text(others[0]["mute"]) == "<Mute, whose repr raises ValueError>"
    assert text(others[0]["map"]) == "90,000 numbers" and not others[0]["map"].whole
    assert text(others[0]["text <b>"]) == "line\nand \ufffd \ufffd"
    assert text(others[0]["stats/each (2)"]) == "another of that name" and text(others[0]["7"]) == "seven"
    assert text(others[3]["complex"]).endswith("+1j)")  # type: ignore[union-attr]
    np.testing.assert_array_equal(episode.batch["progress"], episode.batch["stats/mean/away"])
    assert episode.batch["goal"].shape == (STEPS + 1, 2)
    away = episode.evaluate["away"]
    np.testing.assert_array_equal(episode.evaluate["stats/each"], np.stack([away, away], axis=1))
    np.testing.assert_allclose(episode.evaluate["half"], away, rtol=1e-2)
    np.testing.assert_array_equal(episode.evaluate["learnt"], away)
    np.testing.assert_array_equal(episode.evaluate["array"], [2] * (STEPS + 1))
    # The value is per env in every second state, and one for the whole batch in the others.
    np.testing.assert_array_equal(episode.evaluate["turns"][1::2], away[1::2])
    assert np.isnan(episode.evaluate["turns"][::2]).all()
    np.testing.assert_array_equal(episode.batch["turns"][::2], episode.batch["progress"][::2])
    np.testing.assert_array_equal(episode.evaluate["reward_terms/all"][1:], episode.reward)
    assert np.isfinite(episode.batch["reward_terms/mean"][1:]).all()


@pytest.mark.slow
def test_entries_that_are_not_per_env_are_no_difference_when_rescored(recordings: Path, file: Path) -> None:
    verdicts, _ = rescore_all(RescoreOptions((recordings,), num_envs=2))
    assert len(verdicts) == N
    for verdict in verdicts:
        assert (verdict.why_not, verdict.first_difference, verdict.differing) == ("", None, ())


def test_a_recorded_state_can_be_entered(recordings: Path, file: Path) -> None:
    task = opened(str(file), 2, reward_mode="dense", obs_mode="state")
    run = run_of(read_episode(sorted(recordings.glob("*.json"))[1]), 3)
    step, replay_result = replay_to(task, run, 3, [1])
    assert (replay_result.metres, replay_result.missed) == (0, {})
    assert "progress" in step.others
    task.env.close()


@pytest.fixture(scope="module")
def session(file: Path) -> Any:
    with live_session(file, file.parent / "of_the_page", reward_mode="dense") as session:
        yield session


@pytest.mark.slow
def test_the_page_plays_and_records_odd_entries(session: Session, file: Path) -> None:
    def shown(step: StepResult | None) -> bool:
        return step is not None and "best" in step.others and step.others["best"].numbers is not None

    session.dispatch(RecordingWanted((0, 1)))
    session.do(PlayRun())
    view = wait_until(session, lambda view: shown(view.step), "a later step")
    assert view.problem is None and view.step.others["phase"].texts == ("push",)
    wait_until(session, lambda view: view.of(RecordingStatus).episodes_written >= 2, "recordings")
    session.do(PauseRun())
    assert session.view().problem is None
    read = [read_episode(path) for path in sorted((file.parent / "of_the_page").glob("*.json"))]
    assert all(text(episode.other_entries_at(2)["phase"]) == "push" for episode in read)
    assert "progress" in read[0].batch
