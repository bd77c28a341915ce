"""Every change of the view is shown, and nothing of it remains once it is reverted: no redraw key lacks an input, and nothing
keeps an old place."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import viser

from tests.drive.env_rows import rows_of
from tests.drive.live import Live
from tests.drive.panels import difference
from tests.drive.scenes import PLAN, camera, changed, problem, running
from workbench.cameras.view import StudioCamera, StudioView
from workbench.checks.profile import ProfileView
from workbench.checks.results import HookTime, RuleResult, StepProfile
from workbench.checks.state import ChecksView
from workbench.envs.camera_data import CameraSettings, Picture
from workbench.envs.gpu_rules import Finding
from workbench.envs.inspection import BodyReadings, Inspection, Leaf
from workbench.envs.keywords import HowMade, Keyword
from workbench.envs.robots import Joint, JointTarget, RobotDescription, RobotKeyframe, RobotLink
from workbench.hands.joints_panel import TITLE as JOINTS
from workbench.hands.reach import Reach
from workbench.hands.reset_until import ResetSearch
from workbench.hands.resets import ResetCloud
from workbench.hands.spawn import SpawnBox
from workbench.hands.start_edit import BodyPose, RobotQpos, StartEdit
from workbench.hands.state import DraggedJoint, Hands
from workbench.live.commands import SelectBody
from workbench.live.history.curves import Column
from workbench.live.history.moments import RESET, SUCCESS, EpisodeNumbers
from workbench.live.messages import ReloadReport, RulesBroken
from workbench.live.past import Strip, TimelineView
from workbench.live.pause_when import PauseWhen
from workbench.live.process.background_jobs import JobProgress
from workbench.live.process.captured_output import Printed, PrintedLine
from workbench.live.process.heartbeat import Busy
from workbench.live.process.supervisor import ProcessMemory
from workbench.live.run import PastLoad
from workbench.live.view import SessionView
from workbench.page.commands import TellOpenTab, TellUnfolded, ToggleTable
from workbench.planning.seeds_report import SolvedSeed, SolveReport
from workbench.record.saving_state import KeptEpisodes, SaveStatus
from workbench.record.state import RecordingStatus
from workbench.rescore.past_scores import PastRun, RescoredCurve
from workbench.rescore.state import RescoreView
from workbench.rescore.verdict import Verdict
from workbench.solve.seeds import SeedsView
from workbench.solve.state import SolveView
from workbench.task.description import TaskOptions
from workbench.task.write_edits import SourceEdit

pytestmark = pytest.mark.thorough

ENVS = 6
FOUND = Finding("reward-changes", "warn", "a message", "/home/me/push.py", 24, "code", "evaluate", 3, 1)
MODES = (Keyword("control_mode", "choice", '"pd_joint_pos"', choices=('"pd_joint_pos"', '"pd_ee_pose"')),)
LENS = CameraSettings((0.3, 0, 0.6), (1, 0, 0, 0), 1.0, None, 8, 6, 0.01, 10.0, "minimal")
CAMERA = replace(camera(), settings=LENS)
_HERE = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
ARM = RobotDescription(
    "arm",
    (Joint("hinge", False, -1.0, 1.0, 0, JointTarget(0, 1.0, 0.0)),),
    (RobotLink(0, -1, -1, _HERE, _HERE), RobotLink(2, 0, 0, _HERE, _HERE)),
    (RobotKeyframe("rest", (0.0,), None),),
)
KEY = CAMERA.key
EDIT = SourceEdit("/home/me/push.py", "x = 1\n", "x = 2\n", (), None)
HAND = BodyReadings(
    "arm/hand",
    0.125,
    np.ones(3, np.float32),
    np.zeros(3, np.float32),
    None,
    None,
    True,
    ("box",),
    ((0.3, 0.3, 0),),
)
PAST = TimelineView(0, 40, None, 0, 40, 40, 2**20, 2**28, 41)


def episodes(env: int, last: int, columns: Sequence[Column], before: int) -> tuple[EpisodeNumbers, ...]:
    steps = np.arange(1, last + 1)
    return (EpisodeNumbers(steps, {column: env + steps.astype(np.float32) for column in columns}, None),)


def episode(env: int, largest: float = 0.25) -> Verdict[PastRun]:
    run = PastRun(env, 0, 10 * env + np.arange(50))
    details = {"first_difference": 5, "look_at": 5, "differing": ("reward",), "largest": largest}
    return replace(Verdict(run, length=49, returns=(1.0, 2.0), metres=0.0, has=("reward",)), **details)


def studio(now: CameraSettings = LENS, mount: np.ndarray | None = None, **changes: Any) -> StudioView:
    one = StudioCamera(KEY, CAMERA, now, now != LENS, mount)
    return StudioView(**{"cameras": (one,), "selected": KEY, **changes})


def picture(grey: int, env: int = 0) -> dict[Any, Picture]:
    pose = np.array([0, 0, 1, 1, 0, 0, 0], np.float32)
    return {KEY: Picture(CAMERA.name, CAMERA.kind, env, pose, np.full((6, 8, 3), grey, np.uint8))}


def base() -> SessionView:
    """A view in which every part has content; paused, so that each view is drawn."""
    view = running(ENVS, playing=False, state="paused", steps_per_second=0.0)
    assert view.task is not None and view.step is not None
    task = replace(
        view.task,
        cameras=(CAMERA,),
        made=HowMade("panda", MODES),
        joints=("hinge",),
        robots=(ARM,),
        notices=("note one",),
    )
    load = PastLoad(1e9, None, "the first version", 900.0)
    return changed(
        view,
        task=task,
        step=replace(view.step, qpos=np.zeros((ENVS, 1), np.float32)),
        options=TaskOptions(ENVS),
        timeline=PAST,
        details=np.zeros((ENVS, 2), np.float32),
        loads=(load, load),
        reload=ReloadReport("patched", "only evaluate changed"),
        printed=Printed(1, (PrintedLine("stdout", "one"),), 0),
        vitals=ProcessMemory(700 * 2**20, 8 * 2**30),
        checks=ChecksView("done", 1, (RuleResult("reward-changes", "broken", (FOUND,)),), total=1, seconds=1.0),
        rescored=RescoreView("done", 1, tuple(map(episode, range(4))), 50, 50, names=("reward", "success")),
        seeds=SeedsView("done", 1, SolveReport((SolvedSeed(0, 8, 13, 9.25, 3.2, "", Path("/r/0.rrd")),), (), 2.0, False, 1), total=1),
        profile=ProfileView("done", 1, StepProfile(64, 200, 21.0, (HookTime("evaluate", 10.5, 0.5),), ())),
        studio=studio(),
        pictures=picture(50),
        pictures_serial=1,
        inspection=Inspection(0, 7, joints=(), state=(Leaf("s", (1,), "float32", np.ones(1, np.float32), 1.0, 1.0),)),
    )  # fmt: skip


def other_step(view: SessionView, **changes: Any) -> dict[str, Any]:
    assert view.step is not None
    return {"step": replace(view.step, **changes), "step_serial": view.step_serial + 1}


def other_task(view: SessionView, **changes: Any) -> dict[str, Any]:
    assert view.task is not None
    return {"task": replace(view.task, **changes), "task_serial": view.task_serial + 1}


def settings(view: SessionView, **changes: Any) -> dict[str, Any]:
    return {"settings": replace(view.settings, **changes)}


def at(**changes: Any) -> Any:
    return lambda view: {"timeline": replace(view.timeline, **changes)}


def just(**changes: Any) -> Any:
    return lambda view: changes


CHANGES: dict[str, Any] = {
    "another env": lambda view: settings(view, selected_env=1)
    | {"pictures": picture(50, 1), "pictures_serial": 2},
    "the speed": lambda view: settings(view, speed=2.0),
    "the source of actions": lambda view: settings(view, action_source="sliders"),
    "planned actions": lambda view: settings(view, action_source="solve") | {"solve": SolveView("planning", 3, plan=PLAN)},
    "the degree of pictures": lambda view: settings(view, pictures="fast"),
    "it plays": just(playing=True, state="running", steps_per_second=20.0),
    "stale": just(stale=True),
    "it loads": just(state="loading", activity="building"),
    "no worker": just(state="stopped"),
    "a reward": lambda view: other_step(view, reward=np.full(ENVS, 9, np.float32)),
    "an entry": lambda view: other_step(view, evaluate={"success": np.ones(ENVS, bool), "near": np.ones(ENVS, bool)}),
    "the steps": lambda view: other_step(view, elapsed_steps=np.full(ENVS, 31, np.int32)),
    "poses": lambda view: other_step(view, poses=view.step.poses + np.float32(0.5)),
    "another class": lambda view: other_task(view, class_name="Other", env_id="Other-v1"),
    "a control mode": lambda view: other_task(view, control_mode="pd_ee_pose"),
    "a note on the file": lambda view: other_task(view, notices=("note two",)),
    "the device": lambda view: other_task(view, device="llvmpipe"),
    "no reward": lambda view: other_task(view, reward_mode="none"),
    "a rebuild": just(reload=ReloadReport("rebuilt", "_load_scene changed")),
    "how long a load took": just(load_milliseconds=4321.0),
    "another load": lambda view: {"loads": (PastLoad(1e9 + 60, "patched", "why", 43.0), *view.loads)},
    "several classes": just(choices=("TwoEnv", "OneEnv")),
    "what was refused": just(refused=problem("ValueError: refused")),
    "a problem": just(problem=problem(), problem_serial=1),
    "a long call": just(busy=Busy(6.4, "in evaluate", "/home/me/push.py", 88, "while True:", "Traceback ...")),
    "the past": at(shown=30, tick=30, can_continue=True),
    "what can be undone": at(undo="reset of all"),
    "what was not restored": at(not_carried=("actor peg: gone",)),
    "the first kept moment": at(first=10, first_tick=10),
    "options": just(options=TaskOptions(ENVS, env_kwargs={"size": 0.5})),
    "options that were refused": just(options_refused=TaskOptions(400)),
    "the seed": just(seed=5),
    "a broken rule": just(rules=RulesBroken((replace(FOUND, rule="not-applied"),)), rules_serial=1),
    "an outlier": just(odd=(replace(FOUND, rule="bodies-stay"),)),
    "it is recorded": just(recording=RecordingStatus(True, (0, 2), 1e9, 1, folder="r")),
    "an episode that was recorded": just(recording=RecordingStatus(episodes_written=1, last_file="/r/one.rrd", folder="r")),
    "an episode that is saved": just(recording=RecordingStatus(saving=SaveStatus(progress=JobProgress("drawing", 1, 2)))),
    "a printed line": just(printed=Printed(2, (PrintedLine("stdout", "one"), PrintedLine("stderr", "two")), 0)),
    "memory": just(vitals=ProcessMemory(900 * 2**20, 8 * 2**30)),
    "what rescoring came to": lambda view: {"rescored": replace(view.of(RescoreView), serial=2, verdicts=(episode(0, 0.5),))},
    "rescoring goes on": lambda view: {"rescored": replace(view.of(RescoreView), serial=3, state="rescoring", done=20)},
    "a check goes on": lambda view: {"checks": replace(view.of(ChecksView), serial=2, state="checking", total=58)},
    "a check that waits": lambda view: {"checks": replace(view.of(ChecksView), state="loading", waits=True)},
    "a profile": lambda view: {"profile": replace(view.of(ProfileView), serial=2, stale=True)},
    "seeds": lambda view: {"seeds": replace(view.of(SeedsView), serial=2, stale=True)},
    "a moved camera": just(studio=studio(replace(LENS, position=(0.5, 0, 0.6)))),
    "no camera": just(studio=studio(selected=None)),
    "what studio can undo": just(studio=studio(undo="moved base_camera")),
    "a moved mount": just(studio=studio(mount=np.array([0, 1, 0, 1, 0, 0, 0], np.float32))),
    "a person drives": just(hands=Hands(driving=True)),
    "a joint": lambda view: other_step(view, qpos=np.full((ENVS, 1), 0.5, np.float32)),
    "a dragged joint": just(hands=Hands(dragged=DraggedJoint("arm", (0,), 0, 0.7))),
    "moves of all envs": just(hands=Hands(all_envs=True)),
    "another keyframe": lambda view: other_task(view, robots=(replace(ARM, keyframes=(RobotKeyframe("up", (0.1,), None),)),)),
    "handles at the end effectors": just(hands=Hands(reach=Reach(shown=True))),
    "a driven episode is kept": just(
        hands=Hands(driving=True, note="kept"), recording=RecordingStatus(kept=KeptEpisodes(1, 1))
    ),
    "a condition to pause at": just(pause_when=PauseWhen("reward", "rises above", 0.5)),
    "a search for a first state": just(search=ResetSearch("running", PauseWhen("success"), 8, 40, 4)),
    "a pause at a condition": just(pause_when=PauseWhen("success"), paused_at=30),
    "the range of a body": just(spawn=SpawnBox("measured", 1, "arm/hand", ((0, 1), (0, 1)), ((0, 1), None), ((0, 1), None))),
    "where a body shall begin": just(start=StartEdit("planned", 1, BodyPose("cube", _HERE), EDIT, "a message")),
    "where a robot shall begin": just(start=StartEdit("refused", 1, RobotQpos("arm", (0.0,)), None, "a message", "x = 1")),
    "sampled resets": just(cloud=ResetCloud("failed", 1, why="no")),
    "the selected body": lambda view: {"inspection": replace(view.inspection, body=HAND)},
    "a picture": just(pictures=picture(200), pictures_serial=2),
    "a camera that fails": just(failed_cameras={KEY: "It cannot be drawn."}),
}  # fmt: skip


def strip(low: int, high: int, env: int) -> Strip:
    reward = np.linspace(0, 1, high - low + 1, dtype=np.float32) ** (1 + env)
    return Strip(
        low, high, ((low, RESET), ((low + high) // 2, SUCCESS)), reward, (), ((low, high, False, ""),)
    )


def made() -> Live:
    live = Live(viser.ViserServer(host="127.0.0.1", port=0, verbose=False))
    tick, old = np.arange(20), np.ones(20, np.float32)
    live.session.answers |= {
        "strip": lambda low, high, column: strip(low, high, live.session.shown.selected_env),
        "episodes": episodes,
        "rescored_curve": lambda name, env: RescoredCurve(tick, tick, old * env, 2 * old),
    }
    live.do(ToggleTable())
    live.do(SelectBody(body="arm/hand"))  # a link: paused, it has no grip, whose name counts up
    live.do(TellUnfolded(panel=JOINTS))
    return live


def rows(number: int = 0) -> Any:
    return rows_of(steps=np.full(ENVS, number, np.int32))


@pytest.fixture(scope="module")
def live() -> Iterator[Live]:
    live = made()
    live.show(base(), rows())
    yield live
    live.server.stop()


@pytest.mark.parametrize("change", CHANGES)
def test_a_change_is_shown_and_disappears_when_reverted(live: Live, change: str) -> None:
    view = base()
    live.show(view, rows())
    live.show(view, rows())  # pictures in quick succession are sent in full quality with a delay
    before = live.everything()
    after = changed(view, **CHANGES[change](view))
    live.show(after, rows())
    live.again()  # a new version is announced for some seconds
    shown = live.everything()
    assert difference(before, shown), "the change is not shown"
    assert difference(shown, live.all_drawn()) == "", "a part that shows the change was not redrawn"
    live.show(view, rows())
    live.again()
    assert difference(before, live.everything()) == ""


def test_a_step_is_in_the_table_of_envs(live: Live) -> None:
    view = base()
    live.show(view, rows(3))
    before = live.html("wb-env-table")
    live.show(replace(view, step_serial=view.step_serial + 1), rows(4))
    assert live.html("wb-env-table") != before


def test_a_page_after_many_changes_shows_the_same_as_a_new_one(live: Live) -> None:
    view = base()
    for change in CHANGES.values():
        live.show(changed(view, **change(view)), rows())
    for last in ("another env", "the past"):
        new, shown = made(), changed(view, **CHANGES[last](view))
        for page in (live, new):
            page.show(shown, rows())
            page.again()
        assert difference(new.everything(), live.everything()) == "", last
        new.server.stop()


def test_a_tab_that_no_page_shows_is_redrawn_rarely_and_at_once_when_a_page_opens_it(live_page: Live) -> None:
    """Else every browser would receive curves and pictures that it does not show; and the tab must not open empty."""
    reward = live_page.part("Reward")

    def show(count: int, seconds: float = 0.3) -> str:
        live_page.show(replace(running(count), step_serial=count, playing=True), seconds=seconds)
        return reward.html("wb-numbers")

    live_page.do(TellOpenTab(tab="Run"))
    before = show(2)
    assert before, "it is filled before a page opens it"
    assert show(3) == before
    assert (later := show(3, seconds=5)) != before
    assert show(4) == later
    live_page.do(TellOpenTab(tab="Reward"))
    assert show(4) != later
