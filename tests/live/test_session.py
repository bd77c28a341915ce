"""Commands of a page, executed by a real worker on the example task."""

# The fixture hands over a session whose task is loaded: what may be None before is not here.
# pyright: reportOptionalMemberAccess=false, reportOptionalSubscript=false, reportArgumentType=false
# pyright: reportAttributeAccessIssue=false, reportCallIssue=false

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.drive.session import (
    live_session,
    start_over,
    step,
    wait_until,
)
from workbench.app.session import Session
from workbench.live.commands import PauseRun, PlayRun, Step
from workbench.live.events import EnvsReset, PagesCounted, SlidersMoved
from workbench.live.messages import CameraRequest
from workbench.live.view import SessionView

pytestmark = pytest.mark.thorough

DRAWS = True


def settle(session: Session) -> None:
    session.change(action_source="random")
    session.change(episode_end="reset")
    start_over(session, 0)


def test_playing_goes_on_until_paused(session: Session) -> None:
    settle(session)
    session.change(speed=4.0)
    session.do(PlayRun())
    wait_until(session, lambda v: v.step.elapsed_steps.max() >= 10 and v.state == "running", "ten steps")
    session.do(PauseRun())
    wait_until(session, lambda v: v.state == "paused", "the pause")
    session.change(speed=1.0)


def test_resetting_one_env_leaves_the_other(session: Session) -> None:
    settle(session)
    step(session, 3)
    before = session.view().step
    session.dispatch(EnvsReset((1,)))
    after = wait_until(session, lambda v: v.step.elapsed_steps[1] == 0, "the reset of env 1").step
    assert after.elapsed_steps.tolist() == [3, 0]
    assert np.array_equal(after.poses[0], before.poses[0], equal_nan=True)
    assert not np.array_equal(after.poses[1], before.poses[1], equal_nan=True)


def test_a_slider_moves_one_joint_of_one_env_from_its_current_targets(
    child_process: None, tmp_path: Path
) -> None:
    with live_session("PushCube-v1", tmp_path, control_mode="pd_joint_pos") as session:
        session.change(action_source="sliders")
        start = slider_values(session)
        assert np.allclose(start[:, :7], session.view().step.qpos[:, :7], atol=1e-5), (
            "not the middle of the limits"
        )
        assert np.allclose(step(session, 3).step.action, start), "untouched, each joint keeps its target"
        session.dispatch(SlidersMoved((0,), (5.0,), (1,)))
        moved = wait_until(
            session, lambda v: v.slider_action[1, 0] != start[1, 0], "the slider"
        ).slider_action
        others = np.ones(moved.shape, bool)
        others[1, 0] = False
        assert moved[1, 0] == pytest.approx(session.view().task.actions[0].high)
        assert np.array_equal(moved[others], start[others])
        assert np.allclose(step(session).step.action, moved)
        session.change(action_source="random")
        acted = step(session).step.action
        session.change(action_source="sliders")
        assert np.allclose(
            slider_values(session, lambda v: not np.array_equal(v.slider_action, moved)), acted
        )
        session.dispatch(EnvsReset((0,)))
        after = slider_values(
            session, lambda v: v.step.elapsed_steps[0] == 0 and not np.array_equal(v.slider_action, acted)
        )
        assert np.allclose(after[0, :7], session.view().step.qpos[0, :7], atol=1e-5)
        assert np.allclose(after[1], acted[1]), "env 1 was not reset"


def slider_values(session: Session, reached: Callable[[SessionView], bool] = lambda view: True) -> np.ndarray:
    """(N, A) values of the sliders."""
    view = wait_until(
        session, lambda v: v.slider_action is not None and reached(v), "what the robots are told"
    )
    assert view.slider_action is not None
    return view.slider_action


def test_a_policy_from_a_file_is_called_with_the_observation(session: Session, tmp_path) -> None:
    settle(session)
    policy, imports = tmp_path / "policy.py", tmp_path / "imports.txt"
    counted = f"open({str(imports)!r}, 'a').write('x')\n"
    policy.write_text(f"{counted}def act(obs):\n    return obs[:, :8] * 0 + 0.5\n")
    session.change(action_source="policy", policy=f"{policy}:act")
    session.change(speed=2.0)
    session.do(Step())
    view = wait_until(session, lambda v: v.step.elapsed_steps.any(), "a step")
    assert np.allclose(view.step.action, 0.5)
    session.change(speed=1.0)
    assert imports.read_text() == "x", "another setting leaves the policy as it is"


@pytest.mark.parametrize(
    ("text", "reference", "says", "line"),
    [
        ("def act(obs):\n    return 1 / 0\n", "act", "ZeroDivisionError", 2),
        ("\ndef act(obs):\n    return obs[:, :3]\n", "act", "(2, 3)", 2),
        ("def act(obs):\n    return None\n", "missing", "no function missing", None),
    ],
)
def test_a_failing_policy_is_reported_and_the_session_goes_on(
    session: Session, tmp_path, text: str, reference: str, says: str, line: int | None
) -> None:
    settle(session)
    policy = tmp_path / "policy.py"
    policy.write_text(text)
    session.change(action_source="policy", policy=f"{policy}:{reference}")
    if reference == "act":
        session.do(Step())
    view = wait_until(session, lambda v: v.problem is not None, "a problem")
    assert view.problem.stage == "policy" and says in view.problem.message
    assert (view.problem.file, view.problem.line) == (None if line is None else str(policy), line)
    # No other action replaces it: each Play or Step reports the same problem.
    for again in (lambda: session.do(PlayRun()), lambda: session.do(Step())):
        serial = session.view().problem_serial
        again()
        view = wait_until(
            session, lambda v, n=serial: v.problem_serial > n and not v.playing, "the problem again"
        )
        assert says in view.problem.message and not view.step.elapsed_steps.any()
    session.change(action_source="random")
    session.do(Step())
    wait_until(session, lambda v: v.problem is None, "the problem's end")


POLICIES = {
    "half": ('{"panda_wristcam-0": torch.zeros(2, 8)}', ["panda_wristcam-1"]),
    "other": ('{"panda": 0, "panda_wristcam-0": np.zeros(8), "panda_wristcam-1": np.zeros(8)}', ["panda,"]),
    "one_row": ("np.zeros(8)", ["(8,)", "(2, 16)", "panda_wristcam-0 8"]),
    "nan": ("torch.full((2, 16), torch.nan)", ["2 of 2 envs", "panda_wristcam-0/arm/panda_joint1", "env 0"]),
    "pair": ("(torch.zeros(2, 16), {})", ["(2, 16)", "dict"]),
    "no_parameter": ("0", ["TypeError"]),
}


def test_an_invalid_action_for_several_robots_is_reported(tmp_path: Path, child_process: None) -> None:
    policy = tmp_path / "policy.py"
    text = "import numpy as np, torch\n"
    text += "".join(f"def {name}(obs): return {returned}\n" for name, (returned, _) in POLICIES.items())
    text = text.replace("no_parameter(obs)", "no_parameter()")
    text += "def works(obs): return {'panda_wristcam-1': torch.ones(2, 8), 'panda_wristcam-0': np.zeros(8)}\n"
    policy.write_text(text)
    with live_session("TwoRobotPickCube-v1", tmp_path) as session:
        for at, (name, (_, facts)) in enumerate(POLICIES.items()):
            serial = session.view().problem_serial
            session.change(action_source="policy", policy=f"{policy}:{name}")
            session.do(Step())
            view = wait_until(
                session, lambda v, n=serial: v.problem_serial > n and v.problem is not None, name
            )
            problem = view.problem
            assert (problem.stage, problem.file, problem.line) == ("policy", str(policy), at + 2), problem
            assert all(fact in problem.message for fact in facts), problem.message
        session.change(action_source="policy", policy=f"{policy}:works")
        session.do(Step())
        view = wait_until(session, lambda v: v.step.elapsed_steps.all(), "a step")
        assert view.step.action.tolist() == [[0.0] * 8 + [1.0] * 8] * 2


def test_a_saved_policy_is_loaded_and_a_fixed_one_plays_on(session: Session, tmp_path: Path) -> None:
    settle(session)
    policy, text = tmp_path / "policy.py", "def act(obs):\n    return obs[:, :8] * 0 + {}\n"
    policy.write_text(text.format("0.50"))
    session.change(action_source="policy", policy=f"{policy}:act")
    session.do(PlayRun())
    wait_until(session, lambda v: v.step.action is not None and np.allclose(v.step.action, 0.5), "its action")
    # Same length, and saved in the same second as the last version.
    for action in ("0.25", "0.75"):
        policy.write_text(text.format(action))
        wait_until(session, lambda v, a=float(action): np.allclose(v.step.action, a), "the new one's action")
    assert sum("it is read again" in text for text in session.view().printed.texts) >= 2
    policy.write_text(text.format("0.25 +"))
    view = wait_until(session, lambda v: v.problem is not None and not v.playing, "the problem")
    assert (view.problem.stage, view.problem.file, view.problem.line) == ("policy", str(policy), 2)
    policy.write_text(text.format("0.10"))
    view = wait_until(session, lambda v: v.playing and np.allclose(v.step.action, 0.1), "the fixed one")
    assert view.problem is None
    # After a pause by the user it does not play.
    session.do(PauseRun())
    wait_until(session, lambda v: not v.playing, "the pause")
    policy.write_text(text.format("0.30 +"))
    wait_until(session, lambda v: v.problem is not None, "the problem while paused")
    policy.write_text(text.format("0.30"))
    wait_until(session, lambda v: v.problem is None, "its end")
    session.do(Step())
    view = wait_until(session, lambda v: np.allclose(v.step.action, 0.3), "a step")
    assert not view.playing and view.problem is None


def test_a_policy_next_to_the_task_is_found_and_loaded_once_fixed(session: Session, task_file) -> None:
    settle(session)
    session.change(action_source="policy", policy="pol.py:act")
    view = wait_until(session, lambda v: v.problem is not None, "a problem")
    for folder in (Path.cwd(), task_file.parent):
        assert str(folder) in view.problem.message
    (task_file.parent / "pol.py").write_text("def act(obs):\n    return obs[:, :8] * 0 + 0.25\n")
    session.do(Step())
    view = wait_until(session, lambda v: v.step.elapsed_steps.any(), "a step")
    assert np.allclose(view.step.action, 0.25) and view.problem is None


@pytest.mark.slow
def test_pictures_are_of_the_selected_env_and_only_while_they_are_shown(session: Session) -> None:
    settle(session)
    sensor = next(c for c in session.view().task.cameras if c.kind == "sensor")
    wanted = CameraRequest(sensor.name, "sensor", ("rgb", "depth", "segmentation"))
    session.change(cameras=(wanted,))
    session.do(Step())
    wait_until(session, lambda v: v.step.elapsed_steps[0] == 1, "a step")
    assert not session.view().pictures, "no picture is shown yet"
    session.dispatch(PagesCounted(1))
    session.change(selected_env=1)
    view = wait_until(session, lambda v: bool(v.pictures), "a picture")
    picture = view.pictures["sensor", sensor.name]
    assert picture.env == 1
    assert picture.rgb.shape == (sensor.height, sensor.width, 3) and picture.rgb.std() > 5
    assert picture.depth.shape == (sensor.height, sensor.width) and picture.depth.max() > 0.1
    assert set(np.unique(picture.segmentation)) - {0} <= view.task.segmentation.keys()
    session.dispatch(PagesCounted(0))
    session.change(selected_env=0)
    session.do(Step())
    wait_until(session, lambda v: v.step.elapsed_steps[0] == 2, "another step")
    assert not session.view().pictures, "pictures are no longer shown"
    session.change(cameras=())
