"""Entering a recording's state in the live session with a real worker; and which code is opened for a recording."""

# pyright: reportOptionalMemberAccess=false

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.drive.session import TASKS, live_session, step, wait_until
from tests.live.recorded_runs import opened, reaching, record
from workbench.app.session import Session
from workbench.envs.recorded_run import RecordedRun
from workbench.episodes.episode import EpisodeInfo
from workbench.episodes.recorded_source import CannotEnterRecording, options_of, recorded_source, reference_of
from workbench.live.events import SlidersMoved
from workbench.live.timeline_commands import UndoReset
from workbench.live.view import SessionView
from workbench.task.description import TaskOptions

N, STEPS, ENV = 3, 40, 1


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RecordedRun:
    task = opened(str(TASKS / "push_cube.py"), 2)
    recorded = record(task, STEPS, [11, 12], reaching(STEPS, 2))
    poses.extend(step.poses[ENV] for step in recorded.steps)
    task.env.close()
    return recorded.run(ENV, "an episode")


poses: list[np.ndarray] = []


@pytest.fixture(scope="module")
def live(child_process: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Session]:
    folder = tmp_path_factory.mktemp("author")
    file = folder / "push_cube.py"
    file.write_text((TASKS / "push_cube.py").read_text())
    with live_session(file, folder / "recordings", num_envs=N) as session:
        session.change(selected_env=ENV)
        session.change(action_source="sliders")
        yield session


def into(session: Session, run: RecordedRun, everywhere: bool = False) -> SessionView:
    number = session.enter_recording(run, everywhere)
    return wait_until(session, lambda v: v.timeline.entered == number, "the recorded state")


def step_with(session: Session, action: np.ndarray) -> SessionView:
    session.dispatch(SlidersMoved(tuple(range(len(action))), tuple(float(x) for x in action)))
    return step(session)


@pytest.mark.slow
@pytest.mark.parametrize("state", [0, 23])
def test_the_live_env_enters_the_recorded_state_and_continues_as_recorded(
    live: Session, run: RecordedRun, state: int
) -> None:
    before = live.view().step
    view = into(live, run.until(state))
    assert np.array_equal(view.step.poses[ENV], poses[state], equal_nan=True)
    assert view.step.elapsed_steps[ENV] == state
    others = [i for i in range(N) if i != ENV]
    assert np.array_equal(view.step.poses[others], before.poses[others], equal_nan=True)
    assert "to the last bit" in view.timeline.arrived and view.timeline.not_carried == ()
    for t in range(state, state + 6):
        view = step_with(live, run.action[t])
        assert np.array_equal(view.step.poses[ENV], poses[t + 1], equal_nan=True)
        assert view.step.reward[ENV] == run.reward[t]


def test_entering_a_state_can_be_undone(live: Session, run: RecordedRun) -> None:
    stood = live.view().step.poses[ENV].copy()
    view = into(live, run.until(10))
    assert view.timeline.undo == "going live of env 1"
    last = view.timeline.last
    live.do(UndoReset())
    view = wait_until(live, lambda v: v.timeline.last > last, "the way back")
    assert np.allclose(view.step.poses[ENV], stood, atol=1e-6, equal_nan=True)
    assert view.timeline.arrived == ""
    # Entering the same recorded moment again counts as a new jump.
    before = view.timeline.entered
    assert into(live, run.until(10)).timeline.entered == before + 1


def test_all_envs_can_enter_one_recorded_state(live: Session, run: RecordedRun) -> None:
    view = into(live, run.until(15), everywhere=True)
    for env in range(N):
        assert np.array_equal(view.step.poses[env], poses[15], equal_nan=True)
    rows = live.env_rows()
    assert rows is not None and rows.steps.tolist() == [15] * N and np.isnan(rows.total).all()


def test_code_that_raises_while_entering_leaves_the_envs_unchanged(live: Session, run: RecordedRun) -> None:
    view = into(live, run.until(5))
    file = Path(view.task.file or "")
    text = file.read_text()
    line = "    def compute_dense_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:\n"
    assert line in text
    file.write_text(text.replace(line, f"{line}        assert (self.elapsed_steps != 9).all()\n"))
    view = wait_until(live, lambda v: "!= 9" in v.task.source[str(file)], "the edit")
    stood, last = view.step.poses.copy(), view.timeline.last
    live.enter_recording(run.until(20))
    view = wait_until(live, lambda v: v.problem is not None, "the problem")
    assert view.problem.file == str(file) and "assert" in (view.problem.code or "")
    assert view.timeline.last == last
    file.write_text(text)
    wait_until(live, lambda v: v.task.source[str(file)] == text, "the restored text")
    moved = step_with(live, np.zeros(8)).step.poses
    assert np.nanmax(np.abs(moved - stood)[..., :3]) < 0.02


def test_a_renamed_actor_is_reported_and_the_robot_is_restored(live: Session, run: RecordedRun) -> None:
    view = live.view()
    file = Path(view.task.file or "")
    text = file.read_text()
    assert 'name="cube"' in text
    file.write_text(text.replace('name="cube"', 'name="box"'))
    view = wait_until(live, lambda v: "box" in v.task.geometry.body_names, "the new scene")
    view = into(live, run.until(12))
    not_carried = "; ".join(view.timeline.not_carried)
    assert "actors/cube: " in not_carried and "actors/box: " in not_carried
    names = view.task.geometry.body_names
    hand = names.index("panda/panda_hand")
    assert np.allclose(
        view.step.poses[ENV][hand][:3], poses[12][names.index("panda/panda_hand")][:3], atol=2e-4
    )
    file.write_text(text)
    wait_until(live, lambda v: "cube" in v.task.geometry.body_names, "the old scene")


# --- what is opened ----------------------------------------------------------------------------------


def info(file: Path | None, task: str = "WorkbenchPushCube-v1", **more: object) -> EpisodeInfo:
    source = {} if file is None else {file.name: file.read_text()}
    plain = EpisodeInfo(
        task, 0, 5, None if file is None else str(file), "", source, 0.05, "pd_joint_delta_pos", "cpu"
    )
    return replace(plain, **more)  # pyright: ignore[reportArgumentType]


def test_todays_code_is_the_file_if_it_still_exists_else_the_id(tmp_path: Path) -> None:
    file = TASKS / "push_cube.py"
    assert str(reference_of(info(file))).startswith(f"{file}:")
    deleted = replace(info(file), source_file=str(tmp_path / "deleted.py"))
    assert str(reference_of(deleted)) == "WorkbenchPushCube-v1"
    assert str(reference_of(info(None, "PickCube-v1"))) == "PickCube-v1"
    from importlib.util import find_spec

    spec = find_spec("mani_skill")
    assert spec is not None and spec.submodule_search_locations
    installed = Path(spec.submodule_search_locations[0]) / "envs" / "tasks" / "tabletop" / "pick_cube.py"
    assert str(reference_of(replace(info(None, "PickCube-v1"), source_file=str(installed)))) == "PickCube-v1"


def test_the_recorded_text_is_opened_in_a_temporary_folder(tmp_path: Path) -> None:
    helper = {"helpers/shapes.py": "SIZE = 1\n", "../../outside.py": "x = 1\n"}
    recorded = info(TASKS / "push_cube.py")
    recorded = replace(recorded, source={**recorded.source, **helper}, source_file="push_cube.py")
    with recorded_source(recorded) as reference:
        file, _, name = reference.rpartition(":")
        folder = Path(file).parent
        assert Path(file).read_text() == (TASKS / "push_cube.py").read_text() and name
        assert (folder / "helpers" / "shapes.py").read_text() == "SIZE = 1\n"
        assert (folder / "outside.py").is_file()  # and nowhere else
    assert not folder.exists()
    with pytest.raises(CannotEnterRecording, match="does not hold the text"), recorded_source(info(None)):
        pass


def test_todays_files_beside_the_task_are_available_and_outlive_the_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    file = tmp_path / "author" / "push_cube.py"
    (file.parent / "meshes").mkdir(parents=True)
    file.write_text((TASKS / "push_cube.py").read_text())
    (file.parent / "meshes" / "part.obj").write_text("today's")
    (tmp_path / "secret").write_text("")
    above = ("../secret", "meshes/../../secret", str(tmp_path / "secret"))
    names = ("meshes/part.obj", "meshes/deleted.obj", *above)
    with recorded_source(info(file, side_files=dict.fromkeys(names, "0" * 12))) as reference:
        folder = Path(reference.rpartition(":")[0]).parent
        assert (folder / "meshes" / "part.obj").read_text() == "today's"
        assert {path.name for path in folder.rglob("*")} == {"push_cube.py", "meshes", "part.obj"}
        assert list(temporary.iterdir()) == [folder], "no other folder was made"
    assert not folder.exists()
    assert (file.parent / "meshes" / "part.obj").read_text() == "today's"


def test_the_env_is_made_with_the_recorded_robot_and_modes() -> None:
    kwargs = {"robot_uids": "panda_wristcam", "obs_mode": "rgb", "num_envs": 64, "sim_backend": "gpu"}
    kwargs |= {"render_device": "cuda:1", "render_mode": "human", "render_backend": "gpu"}
    base = TaskOptions(rules="warn")
    options = options_of(replace(info(None, "PickCube-v1"), env_kwargs=kwargs), 2, base)
    assert options.rules == "warn"
    assert options.env_kwargs == {
        "robot_uids": "panda_wristcam",
        "obs_mode": "rgb",
        "control_mode": "pd_joint_delta_pos",
    }
    assert (options.num_envs, options.seed) == (2, 5)
