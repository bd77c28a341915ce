"""What each command and event asks of the worker, in a session whose envs and settings differ."""

# The views are of a session whose task is loaded: what may be None before is not here.
# pyright: reportOptionalMemberAccess=false, reportOptionalSubscript=false

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from tests.drive.scenes import camera, problem
from tests.drive.session import DEATH, FakeWorkerSession, fake_worker_session
from tests.drive.waiting import until
from workbench.envs.camera_data import Picture
from workbench.envs.gpu_rules import Finding
from workbench.live.commands import (
    ChooseActions,
    ChooseEpisodeEnd,
    ChoosePictures,
    PauseRun,
    PlayRun,
    RebuildScene,
    ReloadCameras,
    ReloadCode,
    ReloadFile,
    ResetAll,
    ResetSelected,
    RestartWorker,
    SetPolicy,
    SetSeed,
    SetSpeed,
    Step,
    TogglePlay,
    UseControlMode,
)
from workbench.live.env_commands import SelectEnv
from workbench.live.events import (
    EnvsReset,
    EpisodeStepShown,
    FileOpened,
    MomentShown,
    OptionsApplied,
    PagesCounted,
    PolicySaved,
    SettingsChanged,
    SlidersMoved,
)
from workbench.live.messages import (
    CameraFailed,
    CameraRequest,
    EnterRecording,
    Load,
    Loading,
    Pictures,
    Placed,
    Play,
    ReadPolicyAgain,
    Reset,
    Restore,
    RulesBroken,
    SetSliderAction,
    Settings,
    SingleStep,
    Status,
    TaskFailed,
)
from workbench.live.process.supervisor import End
from workbench.live.run import Run, movable_bodies
from workbench.live.timeline_commands import (
    ContinueFromHere,
    GoToLast,
    NextEvent,
    Seek,
    StepBack,
    StepForward,
    UndoReset,
)
from workbench.page.command import Command, Refused
from workbench.task.description import Pulled, TaskOptions

SELECTED = 2
EYE, HAND = CameraRequest("eye", "sensor"), CameraRequest("hand", "sensor")


@pytest.fixture
def ready(fake: FakeWorkerSession) -> FakeWorkerSession:
    """Four steps after a reset of all envs, the third env selected, at the second step of the past."""
    fake.play(4)
    fake.session.change(selected_env=SELECTED)
    fake.session.do(SetSeed(seed=7))
    fake.session.dispatch(MomentShown(2))
    fake.asked(object)
    return fake


def does(fake: FakeWorkerSession, what: Any) -> list[object]:
    """What this command or event asks of the worker."""
    fake.asked(object)
    if isinstance(what, Command):
        fake.session.do(what)
    else:
        fake.session.dispatch(what)
    return fake.asked(object)


@pytest.mark.parametrize(
    ("command", "asked", "playing"),
    [
        (Step(), [SingleStep()], False),
        (PlayRun(), [Play(True, 1)], True),
        (ResetAll(), [Reset(None, 7)], True),
        (ResetSelected(), [Reset((SELECTED,), None)], True),
        (SetSeed(seed=8), [Reset(None, 8)], True),
        (EnvsReset((1,), 5), [Reset((1,), 5)], True),
        (SlidersMoved((1,), (0.5,)), [SetSliderAction((0, 1, 2), (1,), (0.5,))], True),
        (SlidersMoved((0,), (0.5,), (1,)), [SetSliderAction((1,), (0,), (0.5,))], True),
    ],
)
def test_acting_goes_live_and_concerns_only_the_named_envs(
    ready: FakeWorkerSession, command: object, asked: list[object], playing: bool
) -> None:
    pictures = ready.view.pictures_serial
    assert does(ready, command) == asked
    view = ready.view
    assert (view.timeline.shown, view.playing, view.pictures_serial > pictures) == (None, playing, True)


@pytest.mark.parametrize("command", [TogglePlay(), PauseRun()])
def test_a_pause_stays_at_the_shown_moment(ready: FakeWorkerSession, command: Command) -> None:
    assert does(ready, command) == [Play(False, 1)]
    assert (ready.view.timeline.shown, ready.view.playing) == (2, False)
    assert does(ready, TogglePlay()) == [Play(True, 2)] and ready.view.timeline.shown is None


def test_a_chosen_seed_stays_for_resets_and_loads(ready: FakeWorkerSession) -> None:
    does(ready, SetSeed(seed=8))
    assert ready.view.seed == 8 and does(ready, ResetAll()) == [Reset(None, 8)]
    (load,) = does(ready, ReloadFile())
    assert isinstance(load, Load) and load.options.seed == 8


@pytest.mark.parametrize(
    ("command", "setting", "value"),
    [
        (SetSpeed(speed=None), "speed", math.inf),
        (SetSpeed(speed=0.5), "speed", 0.5),
        (ChooseEpisodeEnd(rule="continue"), "episode_end", "continue"),
        (ChoosePictures(pictures="fast"), "pictures", "fast"),
        (ChooseActions(source="zero"), "action_source", "zero"),
        (SetPolicy(policy=" a.py:act "), "policy", "a.py:act"),
        (SettingsChanged({"solve_all": True}), "solve_all", True),
        (SelectEnv(env=1), "selected_env", 1),
    ],
)
def test_a_setting_is_sent_with_all_others_once(
    ready: FakeWorkerSession, command: object, setting: str, value: object
) -> None:
    before = ready.view.settings
    (sent,) = does(ready, command)
    assert isinstance(sent, Settings) and getattr(sent, setting) == value
    kept = {"action_source": "policy"} if setting == "policy" else {}
    assert ready.view.settings == replace(before, **{setting: value}, **kept)
    assert does(ready, command) == [], "nothing changed"


def test_a_policy_is_named_once_and_comes_back_with_its_source(ready: FakeWorkerSession) -> None:
    def policy() -> tuple[str, str | None]:
        return ready.view.settings.action_source, ready.view.settings.policy

    with pytest.raises(Refused):
        does(ready, SetPolicy(policy="act"))
    assert policy() == ("random", None)
    seen = []
    for command in (
        SetPolicy(policy="a.py:act"),
        ChooseActions(source="zero"),
        ChooseActions(source="policy"),
        SetPolicy(policy=" "),
        ChooseActions(source="zero"),
        ChooseActions(source="policy"),
    ):
        does(ready, command)
        seen.append(policy())
    named, none = ("policy", "a.py:act"), ("policy", None)
    assert seen == [named, ("zero", None), named, none, ("zero", None), none]


@pytest.mark.parametrize(
    ("command", "level"),
    [
        (ReloadFile(), "auto"),
        (RebuildScene(), "rebuilt"),
        (ReloadCode(), "patched"),
        (ReloadCameras(), "cameras"),
    ],
)
def test_the_file_is_loaded_at_the_level_that_was_pressed(
    ready: FakeWorkerSession, command: Command, level: str
) -> None:
    (load,) = does(ready, command)
    assert isinstance(load, Load) and (load.level, load.source, load.snapshot) == (level, None, None)


def test_a_control_mode_is_added_to_the_options_that_the_user_gave(ready: FakeWorkerSession) -> None:
    ready.load("rebuilt", options=TaskOptions(3, env_kwargs={"size": 2}))
    ready.reset()
    assert ready.view.task.control_mode == "pd_joint_delta_pos"
    assert does(ready, UseControlMode(mode="pd_joint_delta_pos")) == []
    (load,) = does(ready, UseControlMode(mode="pd_ee_pose"))
    assert isinstance(load, Load)
    assert load.options.env_kwargs == {"size": 2, "control_mode": "pd_ee_pose"}


def test_a_worker_is_restarted_on_request(ready: FakeWorkerSession) -> None:
    does(ready, RestartWorker())
    assert ready.replaced == 1


@pytest.mark.parametrize(
    "command", [StepBack(), StepForward(), NextEvent(), Seek(step=0), GoToLast(), UndoReset()]
)
def test_before_the_first_moment_no_command_of_the_timeline_works(
    fake: FakeWorkerSession, command: Command
) -> None:
    for loads in (lambda: None, fake.load):
        loads()
        with pytest.raises(Refused):
            fake.session.do(command)


def test_an_undo_pauses_first_and_a_continuation_plays_on(ready: FakeWorkerSession) -> None:
    ready.session.do(ContinueFromHere())
    (restore,) = ready.asked(Restore)
    assert restore.env_idx == (SELECTED,) and ready.view.playing and ready.view.timeline.shown is None
    ready.back((SELECTED,), (SELECTED,), 2)
    ready.session.dispatch(MomentShown(1))
    pictures = ready.view.pictures_serial
    pause, undo = does(ready, UndoReset())
    assert pause == Play(False, 1) and isinstance(undo, Restore) and undo.env_idx == (SELECTED,)
    assert not ready.view.playing and ready.view.timeline.shown is None
    assert ready.view.pictures_serial > pictures


@pytest.mark.parametrize("everywhere", [False, True])
def test_a_recorded_run_is_entered_in_the_chosen_envs_now_or_after_the_load(
    tmp_path: Path, everywhere: bool
) -> None:
    run = cast(Any, "a run")
    with fake_worker_session(tmp_path) as fake:
        fake.session.change(selected_env=1)
        number = fake.session.enter_recording(run, everywhere, "push.py", {"push.py": "text"})
        assert fake.asked(EnterRecording) == []
        fake.load()
        fake.reset()
        envs = (0, 1, 2) if everywhere else (1,)
        (request,) = fake.asked(EnterRecording)
        assert request == EnterRecording(run, envs, "push.py", {"push.py": "text"}, number)
        fake.load("rebuilt")
        assert fake.asked(EnterRecording) == [], "once"
        fake.reset()
        fake.session.do(PlayRun())
        fake.session.dispatch(MomentShown(0))
        later = fake.session.enter_recording(run, everywhere)
        assert later != number and not fake.view.playing
        assert fake.asked(EnterRecording) == [EnterRecording(run, envs, None, {}, later)]


def test_a_status_has_each_number_in_its_place(ready: FakeWorkerSession) -> None:
    ready.tell(Status(True, 20.0, 1.5, recorded_share=0.25, watched_share=0.5))
    view = ready.view
    assert (view.steps_per_second, view.real_time_factor) == (20.0, 1.5)
    assert (view.recorded_share, view.watched_share) == (0.25, 0.5)
    ready.tell(Status(True, 20.0, 1.5, "compiling shaders"))
    assert (ready.view.state, ready.view.activity) == ("loading", "compiling shaders")


def test_rules_disappear_when_they_hold_again(ready: FakeWorkerSession) -> None:
    found = Finding("r", "warn", "m", None, None, "", "", 1, 0)
    ready.tell(RulesBroken((found,)))
    assert ready.view.rules is not None
    serial = ready.view.rules_serial
    ready.tell(RulesBroken(()))
    assert ready.view.rules is None and ready.view.rules_serial > serial


def test_another_file_that_is_opened_takes_the_place_of_all_of_the_first(
    ready: FakeWorkerSession, tmp_path: Path
) -> None:
    ready.load(chosen="One", others=("Two",))
    assert ready.view.choices
    folder = tmp_path / "other"
    folder.mkdir()
    file, beside = folder / "pick.py", folder / "helper.py"
    for one in (file, beside):
        one.write_text("")
    (load,) = does(ready, FileOpened(file, "PickEnv"))
    assert isinstance(load, Load) and load.task == f"{file}:PickEnv"
    run = ready.session.look(lambda run: run)
    assert (run.own_file, run.own_folder, run.choices) == (file, folder, ())
    assert ready.session.knows_file(str(beside))
    (sent,) = does(ready, SetSpeed(speed=2.0))
    assert isinstance(sent, Settings) and sent.policy_folder == str(folder)
    file.write_text("x = 1\n")
    (load, *_) = until(lambda: ready.asked(Load), "the load of what was saved")
    assert load.task == f"{file}:PickEnv"


# --- events of the worker ------------------------------------------------------------------------------


def picture(camera: CameraRequest, env: int, grey: int = 0) -> Picture:
    return Picture(camera.name, camera.kind, env, np.zeros(7, np.float32), np.full((2, 2, 3), grey, np.uint8))


def test_pictures_of_sensors_and_of_people_come_apart_and_only_watched_ones_stay(
    ready: FakeWorkerSession,
) -> None:
    ready.session.dispatch(MomentShown(None))
    ready.session.change(cameras=(EYE, HAND))
    ready.tell(Pictures((picture(EYE, SELECTED),), 5.0, 4))
    ready.tell(Pictures((picture(HAND, SELECTED),), 7.0, 4))
    assert set(ready.view.pictures) == {EYE.key, HAND.key} and ready.view.picture_milliseconds == 7.0
    ready.session.change(cameras=(HAND,))
    ready.tell(Pictures((picture(HAND, SELECTED, 9),), 6.0, 4))
    assert {key: one.rgb.max() for key, one in ready.view.pictures.items()} == {HAND.key: 9}
    ready.tell(Pictures((), None, 4))
    assert set(ready.view.pictures) == {HAND.key}


def test_each_camera_that_fails_has_its_own_reason(ready: FakeWorkerSession) -> None:
    ready.session.change(cameras=(EYE, HAND))
    ready.tell(CameraFailed(EYE.key, "one"), CameraFailed(HAND.key, "other"))
    assert ready.view.failed_cameras == {EYE.key: "one", HAND.key: "other"}
    ready.session.change(cameras=(HAND,))
    assert ready.view.failed_cameras == {HAND.key: "other"}


def test_a_placed_camera_changes_alone_and_tells_the_page_of_another_size(
    fake: FakeWorkerSession,
) -> None:
    cameras = camera(), camera("base_camera", "human"), camera("hand")
    fake.load(cameras=cameras)
    serial = fake.view.cameras_serial
    wide = replace(cameras[1], width=99)
    fake.tell(Placed(("human", "base_camera"), None, wide))
    assert [one.width for one in fake.view.task.cameras] == [8, 99, 8]
    assert fake.view.cameras_serial == serial
    fake.tell(Placed(("human", "base_camera"), None, wide, reshaped=True))
    assert fake.view.cameras_serial == serial + 1
    fake.tell(Placed(("sensor", "hand"), None, None, why_not="no"))
    assert [one.name for one in fake.view.task.cameras] == [one.name for one in cameras]


def test_a_pull_is_shown_only_for_its_step(ready: FakeWorkerSession) -> None:
    ready.session.dispatch(MomentShown(None))
    pull = Pulled(1, "cube", 3.0)
    ready.step(pulled=pull)
    assert ready.view.pulled == pull
    at = ready.view.timeline.last
    ready.step()
    assert ready.view.pulled is None
    ready.session.dispatch(MomentShown(at))
    assert ready.view.pulled == pull


def test_a_problem_at_run_time_is_newer_than_that_of_a_load_and_ends_with_the_next_step(
    ready: FakeWorkerSession,
) -> None:
    ready.tell(TaskFailed(problem(), kept=True))
    ready.tell(TaskFailed(problem("other"), kept=True, at_run=True))
    assert ready.view.refused is None, "the file on disk is older than this problem"
    serial = ready.view.problem_serial
    ready.step()
    assert ready.view.problem is None and ready.view.problem_serial > serial


def test_a_saved_policy_resumes_only_a_play_that_it_stopped(played: FakeWorkerSession) -> None:
    def saved() -> bool:
        (request,) = does(played, PolicySaved())
        assert isinstance(request, ReadPolicyAgain)
        return request.play

    failed = TaskFailed(replace(problem(), stage="policy"), kept=True, at_run=True)
    assert not saved()
    played.session.do(PlayRun())
    assert not saved(), "it plays already"
    played.tell(failed, Status(False, 0.0, 0.0, handled=1))
    assert played.view.problem is not None and saved()
    assert played.view.problem is None and played.view.state == "paused"
    played.session.do(PlayRun())
    played.tell(Status(True, 20.0, 1.0, handled=2))
    assert not saved(), "it has played since"
    played.tell(failed, Status(False, 0.0, 0.0, handled=2))
    played.session.do(Step())
    assert not saved(), "the user stepped since"


def test_a_step_of_an_episode_is_shown_in_its_env(ready: FakeWorkerSession) -> None:
    ready.session.dispatch(MomentShown(3, 1))
    assert (ready.view.timeline.shown, ready.view.selected_env) == (3, 1)
    (sent, *_) = ready.asked(Settings)
    assert sent.selected_env == 1
    ready.session.dispatch(EpisodeStepShown(0, 2))
    assert (ready.view.timeline.shown, ready.view.selected_env) == (2, 0)
    assert [one.selected_env for one in ready.asked(Settings)] == [0]


# --- the run as other features read it ---------------------------------------------------------------------


def test_what_another_process_gets_of_the_run(ready: FakeWorkerSession) -> None:
    look: Callable[..., Any] = ready.session.look
    ready.session.dispatch(OptionsApplied(TaskOptions(8)))
    again = look(Run.running_load)
    assert (again.options.num_envs, again.options.seed, again.source) == (3, 7, {"push.py": ""})
    assert not again.any_task, "this class ran"
    assert b"body 4" in look(Run.newest_moment), "also while the past is shown"
    assert movable_bodies(ready.view.task) == ["arm/hand", "cube"] and movable_bodies(None) == []
    shown = look(Run.shown_moment)
    assert (shown.env, shown.num_envs) == (SELECTED, 3)
    for env in range(3):
        np.testing.assert_array_equal(shown.of(env), ready.view.step.poses[env])
    ready.session.dispatch(MomentShown(None))
    assert look(Run.shown_moment).of(0) is None
    assert [one.serial for one, _ in look(lambda run: run.episode_moments(3))] == [0, 2, 4]
    assert look(Run.newest_env_table).steps.tolist() == [4, 4, 4]


def test_the_path_of_an_episode_is_that_of_the_selected_env_and_the_shown_moment(
    fake: FakeWorkerSession,
) -> None:
    fake.play(2)
    fake.reset((1,))  # 3
    fake.step(2)

    def path(env: int, at: int | None) -> list[tuple[int, int]]:
        fake.session.change(selected_env=env)
        fake.session.dispatch(MomentShown(at))
        return [(one.serial, row) for one, row in fake.session.look(lambda run: run.episode_moments(99))]

    assert path(1, None) == [(3, 1), (4, 1), (5, 1)]
    assert path(0, None) == [(0, 0), (1, 0), (2, 0), (4, 0), (5, 0)]
    assert path(1, 1) == [(0, 1), (1, 1), (2, 1)], "the whole episode of then"


def test_the_version_of_each_moment_is_known(played: FakeWorkerSession) -> None:
    for text in ("b", "c"):
        played.load("patched", source_hash=text)
        played.step()
    look = played.session.look
    assert [look(lambda run, at=at: run.version_of(at)).source_hash for at in (0, 3, 4, 5)] == [
        *("0" * 12, "0" * 12, "b", "c")
    ]
    played.load("rebuilt", source_hash="d")
    played.reset()
    assert look(lambda run: run.version_of(5)) is None
    assert look(lambda run: run.version_of(6)).source_hash == "d"


# --- loads and deaths ------------------------------------------------------------------------------------


def test_a_load_is_listed_with_its_whole_time_and_the_options_that_it_used(played: FakeWorkerSession) -> None:
    played.session.dispatch(OptionsApplied(TaskOptions(3, env_kwargs={"size": 2})))
    played.tell(Loading("building", 2))
    played.load("rebuilt", options=TaskOptions(3, env_kwargs={"size": 2}))
    assert played.view.options.env_kwargs == {"size": 2} and played.view.reload.level == "rebuilt"
    assert played.view.load_milliseconds == played.view.loads[0].milliseconds == 1.0
    played.session.dispatch(OptionsApplied(TaskOptions(3, env_kwargs={"size": 2})))
    (load,) = played.asked(Load)[-1:]
    assert load.options.env_kwargs == {"size": 2}


@pytest.mark.parametrize(
    ("changes", "moments", "rescored"),
    [
        ({}, 4, 0),
        ({"same_scene": True, "source_hash": "b"}, 4, 1),
        ({"source_hash": "b"}, 0, 0),
        ({"same_scene": True, "chosen": "Other"}, 0, 0),
        ({"same_scene": True, "num_envs": 2}, 0, 0),
    ],
)
def test_a_new_process_keeps_the_past_of_the_same_scene_and_rescores_it_with_other_code(
    played: FakeWorkerSession, changes: dict[str, Any], moments: int, rescored: int
) -> None:
    played.load("restarted", **changes)
    assert (played.view.timeline.moments, len(played.rescored)) == (moments, rescored)
    assert played.view.timeline_cleared == (moments == 0)


def test_a_worker_that_dies_while_it_draws_takes_the_watched_cameras_along(played: FakeWorkerSession) -> None:
    played.session.dispatch(PagesCounted(1))
    played.session.change(cameras=(EYE,))
    played.session.do(PlayRun())
    played.die(replace(DEATH, doing="drawing", end=End.ASKED))
    assert not played.view.failed_cameras and played.view.problem is None, "a person ended it"
    played.die(replace(DEATH, doing="drawing"))
    assert played.view.failed_cameras.keys() == {EYE.key}
    sent, *_ = played.greet()
    assert isinstance(sent, Settings) and sent.cameras == ()
    played.load()
    played.reset()
    assert played.view.failed_cameras.keys() == {EYE.key}, "it would die again"
    played.load("patched", source_hash="b")
    assert not played.view.failed_cameras, "another version may draw"


def test_presses_are_counted_from_one_for_a_new_worker(played: FakeWorkerSession) -> None:
    played.session.do(PlayRun())
    played.tell(Status(True, 20.0, 1.5, handled=1))
    played.die()
    played.greet()
    played.load()
    played.reset()
    assert does(played, PlayRun()) == [Play(True, 1)]
    played.tell(Status(True, 20.0, 1.0, handled=1))
    assert played.view.playing


def test_problems_before_and_after_the_first_load_are_told_apart(fake: FakeWorkerSession) -> None:
    fake.tell(Loading("importing", 1), TaskFailed(problem(), kept=False, classes=("One", "Two")))
    assert (fake.view.state, fake.view.choices) == ("error", ("One", "Two"))
    fake.tell(Loading("importing", 1), TaskFailed(problem("other"), kept=False))
    assert fake.view.choices == ("One", "Two"), "the file was not read as far"
    fake.play(1)
    fake.tell(TaskFailed(problem(), kept=True, at_run=True))
    assert (fake.view.state, fake.view.problem_at_run) == ("paused", True)
