"""Time from a hand's action to the first moved pose in the session's view, medians at 16 envs.

    python tests/benchmarks/hands.py [--num-envs 16] [--times 15] [--json]

    move_ms     a paused cube is put elsewhere, until the view has it there
    force_ms    a spring pulls the cube while the envs play in real time, until it has moved by 0.1 mm
    ik_ms       the handles of an end effector are dragged by 5 cm while the envs play (inverse kinematics), until a joint has
                moved by 1e-4 rad
    key_ms      a key drives the end effector (pd_ee_delta_pose), likewise

``--json`` prints one line.
"""

from __future__ import annotations

import json
import statistics
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

sys.path.insert(0, str(Path(__file__).parents[2]))
from tests.benchmarks.session_times import seconds_until
from tests.drive.page import TASK
from workbench.app.session import Session
from workbench.hands.commands import ToggleDriving, ToggleReach
from workbench.hands.reach import ArmDragged
from workbench.hands.state import BodyMoved, BodyPulled, Driven
from workbench.live.commands import PauseRun, PlayRun, ResetAll
from workbench.live.messages import PullBody
from workbench.live.view import SessionView
from workbench.task.description import TaskOptions

ENV = 1


@dataclass(frozen=True)
class Options:
    num_envs: int = 16
    times: int = 15
    json: bool = False


def cube_in(view: SessionView) -> np.ndarray:
    """Pose of the cube in the env."""
    assert view.task is not None and view.step is not None
    return view.step.poses[ENV, view.task.geometry.body_names.index("cube")]


def joints_in(view: SessionView) -> np.ndarray:
    assert view.step is not None and view.step.qpos is not None
    return view.step.qpos[ENV]


def start_over(session: Session) -> None:
    """Pause at the start of new episodes."""
    session.do(PauseRun())
    last = session.view().timeline.last
    session.do(ResetAll())
    seconds_until(session, lambda view: view.timeline.last > last and not view.playing)


def moved(session: Session, k: int) -> float:
    pose = (0.1, 0.1 + 0.01 * k, 0.2, 1.0, 0.0, 0.0, 0.0)
    session.dispatch(BodyMoved("cube", (ENV,), pose))
    return seconds_until(session, lambda view: np.allclose(cube_in(view)[:3], pose[:3], atol=1e-5))


def pulled(session: Session, k: int) -> float:
    start_over(session)
    session.do(PlayRun())
    seconds_until(session, lambda view: view.step is not None and view.step.elapsed_steps[ENV] >= 4)
    before = cube_in(session.view())[:3].copy()
    x, y = (float(value) for value in before[:2])
    session.dispatch(BodyPulled(PullBody("cube", ENV, (0.0, 0.0, 0.0), (x, y, 0.3))))
    took = seconds_until(session, lambda view: np.abs(cube_in(view)[:3] - before).max() > 1e-4)
    session.dispatch(BodyPulled(PullBody()))
    return took


def driven(session: Session, k: int) -> float:
    seconds_until(
        session, lambda view: view.slider_action is not None and not view.slider_action[ENV, :6].any()
    )
    time.sleep(0.4)  # the arm comes to rest
    before = joints_in(session.view()).copy()
    session.dispatch(Driven(("e" if k % 2 else "q",), 0.0))
    took = seconds_until(session, lambda view: np.abs(joints_in(view) - before).max() > 1e-4)
    session.dispatch(Driven((), 0.0))
    return took


def reached(session: Session, k: int) -> float:
    start_over(session)
    session.do(PlayRun())
    seconds_until(
        session, lambda view: view.playing and view.step is not None and view.step.elapsed_steps[ENV] >= 4
    )
    view = session.view()
    assert view.task is not None and view.step is not None
    arm = view.task.arms[0].body
    before = joints_in(view).copy()
    x, y, z, *q = map(float, view.step.poses[ENV, view.task.geometry.body_names.index(arm)])
    session.dispatch(ArmDragged(arm, ENV, (x, y, z + (0.05 if k % 2 else -0.05), *q)))
    took = seconds_until(session, lambda view: np.abs(joints_in(view) - before).max() > 1e-4)
    session.do(ToggleDriving())
    return took


def main(options: Options) -> None:
    with tempfile.TemporaryDirectory() as folder:
        made = TaskOptions(num_envs=options.num_envs, env_kwargs={"control_mode": "pd_ee_delta_pose"})
        session = Session(str(TASK), made, recordings=Path(folder) / "recordings")
        try:
            seconds_until(session, lambda view: view.step is not None)
            session.change(selected_env=ENV, action_source="hold", episode_end="continue")
            start_over(session)
            took = {"move_ms": [moved(session, k) for k in range(options.times)]}
            took["force_ms"] = [pulled(session, k) for k in range(options.times)]
            session.do(ToggleReach())
            took["ik_ms"] = [reached(session, k) for k in range(options.times)]
            start_over(session)
            session.do(ToggleDriving())
            took["key_ms"] = [driven(session, k) for k in range(options.times)]
        finally:
            session.close()
    took = {name: [1000 * seconds for seconds in values] for name, values in took.items()}
    medians = {name: round(statistics.median(values), 1) for name, values in took.items()}
    if options.json:
        print(json.dumps(medians))
        return
    for name, value in medians.items():
        print(f"{name:9} {value:6.1f}   ({min(took[name]):.1f} to {max(took[name]):.1f})")


if __name__ == "__main__":
    main(tyro.cli(Options))
