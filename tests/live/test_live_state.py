"""How each event of a worker and each command of a page changes the view."""

# The views are of a session whose task is loaded: what may be None before is not here.
# pyright: reportOptionalMemberAccess=false, reportOptionalSubscript=false

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.drive.scenes import problem
from tests.drive.session import DEATH, FakeWorker, FakeWorkerSession, fake_worker_session
from tests.drive.waiting import until
from workbench.envs.camera_data import Picture
from workbench.envs.gpu_rules import Finding
from workbench.envs.inspection import Inspection
from workbench.live.commands import ChooseClass, PauseRun, PlayRun, ReloadFile, SetSeed
from workbench.live.events import MomentShown, OptionsApplied, PagesCounted, ReadingChosen
from workbench.live.messages import (
    CameraFailed,
    CameraRequest,
    Inspect,
    Load,
    Loading,
    Pictures,
    ReadPolicyAgain,
    Request,
    RulesBroken,
    Settings,
    SliderAction,
    Status,
    TaskFailed,
)
from workbench.live.process.supervisor import End
from workbench.live.run import Run
from workbench.page.command import Refused
from workbench.rescore.state import RescoreView, RescoringUpdate
from workbench.task.description import TaskOptions
from workbench.task.reference import RecordedTask

EYE = CameraRequest("eye", "sensor")
FINDING = Finding("r", "warn", "m", None, None, "", "", 1, 0)


def pictures(env: int, number: int = 0) -> Pictures:
    rgb = np.zeros((2, 2, 3), np.uint8)
    return Pictures((Picture("eye", "sensor", env, np.zeros(7, np.float32), rgb),), 12.0, number)


def asked_load(fake: FakeWorkerSession) -> Load:
    """The load that the next save requests."""
    fake.asked(object)
    fake.session.do(ReloadFile())
    (load,) = fake.asked(Load)
    return load


def test_moments_are_shown_only_once_a_task_is_loaded(fake: FakeWorkerSession) -> None:
    assert fake.view.state == "starting" and fake.session.env_rows() is None
    fake.tell(Loading("importing"))
    assert (fake.view.state, fake.view.activity) == ("loading", "importing")
    fake.play(3)
    view = fake.view
    assert (view.state, view.activity, view.playing, view.steps_per_second) == ("running", "", True, 20.0)
    assert (view.timeline.last, view.step_serial, view.timeline.moments) == (3, 3, 4)
    assert view.step.elapsed_steps.tolist() == [3, 3, 3] and view.timeline.last_tick == 3


def test_the_selected_env_is_limited_to_the_envs_that_exist(fake: FakeWorkerSession) -> None:
    fake.session.change(selected_env=2**40, speed=2.0)
    fake.load()
    assert (fake.view.selected_env, fake.view.settings.speed) == (2, 2.0)
    fake.session.change(selected_env=-5)
    assert fake.view.selected_env == 0


@pytest.mark.parametrize("level", ["same", "patched", "cameras"])
def test_a_version_with_the_same_scene_keeps_the_past_and_the_meshes(
    played: FakeWorkerSession, level: str
) -> None:
    played.session.change(selected_env=2)
    before = played.view
    played.load(level, source_hash="b")
    after = played.view
    assert after.task.source_hash == "b" and after.task.geometry is before.task.geometry
    assert after.task_serial == before.task_serial + 1 and after.scene_serial == before.scene_serial
    assert after.cameras_serial == before.cameras_serial + (level == "cameras")
    assert (after.selected_env, after.timeline.moments, after.step_serial) == (2, 4, 3)
    assert len(played.rescored) == (level == "patched")


def test_a_new_scene_starts_a_new_past_and_shows_nothing_of_the_old_one(played: FakeWorkerSession) -> None:
    session = played.session
    session.change(selected_env=2, cameras=(EYE,))
    played.load("patched", source_hash="b")
    assert played.view.of(RescoreView).state == "loading" and played.view.of(RescoreView).total == 3
    session.dispatch(RescoringUpdate(1, RescoreView("rescoring", done=3)))
    session.dispatch(RescoringUpdate(1, RescoreView("done", done=3)))
    assert (played.view.of(RescoreView).state, played.view.of(RescoreView).done) == ("done", 3)
    session.dispatch(MomentShown(1))
    session.dispatch(MomentShown(None))
    told = np.ones((3, 2), np.float32)
    played.tell(pictures(2), SliderAction(told), Inspection(2, 3), RulesBroken((FINDING,)))
    played.tell(CameraFailed(EYE.key, "no shader"))
    before = played.view
    assert (
        before.pictures
        and before.slider_action is told
        and before.inspection
        and before.rules
        and before.failed_cameras
    )
    played.load("rebuilt", num_envs=2)
    played.reset()
    after = played.view
    assert (after.scene_serial, after.cameras_serial) == (before.scene_serial + 1, before.cameras_serial + 1)
    assert after.pictures_serial > before.pictures_serial and after.rules_serial > before.rules_serial
    assert (after.pictures, after.slider_action, after.inspection, after.rules) == ({}, None, None, None)
    assert after.of(RescoreView).state == "none" and after.of(RescoreView).total == 0
    assert not after.failed_cameras and after.selected_env == 1 and after.timeline_cleared
    assert (after.timeline.first, after.timeline.moments) == (4, 1) and after.timeline.last_tick == 0


def test_findings_while_playing_disappear_with_their_version_unless_the_next_has_them_too(
    played: FakeWorkerSession,
) -> None:
    odd = (1.0, np.nan, 1.0)
    played.step(reward=odd)
    (found,) = played.view.odd
    assert (found.rule, found.count, found.first_step) == ("reward-finite", 1, 3)
    played.tell(RulesBroken((FINDING,)))
    assert played.view.played == (FINDING, found)
    played.load("same")
    assert played.view.odd == (found,)
    played.load("patched", source_hash="b")
    assert played.view.odd == ()
    played.step(reward=odd)
    assert [each.first_step for each in played.view.odd] == [4]
    played.load("rebuilt", source_hash="b")
    assert played.view.odd == ()


# --- failures --------------------------------------------------------------------------------------------


def test_the_last_good_version_is_restored_with_its_past_and_the_cause_of_death(
    played: FakeWorkerSession,
) -> None:
    played.session.do(PlayRun())
    played.die()
    view = played.view
    assert "SIGSEGV" in view.problem.message and view.problem_at_run
    assert (view.state, view.playing, view.steps_per_second) == ("starting", False, 0.0)
    played.greet()
    played.load()
    played.reset()
    after = played.view
    assert after.timeline.moments == 5 and after.stale and after.state == "paused"
    assert after.problem == view.problem, "the first reset of a new scene does not clear the problem"
    played.step()
    assert played.view.problem is None
    played.load(source_hash="b")
    assert played.view.timeline.moments == 0


def test_each_failure_while_running_is_shown_until_the_next_step(played: FakeWorkerSession) -> None:
    for _ in range(2):
        before = played.view
        played.tell(Status(True, 20.0, 1.0), TaskFailed(problem(), kept=True, at_run=True))
        view = played.view
        assert (view.state, view.playing, view.stale, view.refused) == ("paused", False, False, None)
        assert view.problem_at_run and view.problem_serial > before.problem_serial
        assert len(view.loads) == 1, "a failure is not a load"
        played.step()
        assert played.view.problem is None and not played.view.problem_at_run


@pytest.mark.parametrize("paused", [False, True])
def test_a_fixed_policy_plays_on_even_if_the_task_is_reloaded_before_the_policy_is_read(
    played: FakeWorkerSession, tmp_path: Path, paused: bool
) -> None:
    # Both the task's watcher and the policy's notice the save, in either order.
    policy = tmp_path / "policy.py"
    policy.write_text("def act(obs): return None\n")
    played.session.change(action_source="policy", policy=f"{policy}:act")
    played.session.do(PlayRun())
    failed = replace(problem(), stage="policy", file=str(policy))
    played.tell(Status(True, 20.0, 1.0), TaskFailed(failed, kept=True, at_run=True), Status(False, 0.0, 0.0))
    if paused:
        played.session.do(PauseRun())
    played.load("same")
    played.asked(object)
    policy.write_text("def act(obs): return obs\n")
    asked: list[ReadPolicyAgain] = []
    until(lambda: asked.extend(played.asked(ReadPolicyAgain)) or asked, "the policy is read again")
    assert asked == [ReadPolicyAgain(play=not paused)]


def test_a_failed_load_shows_its_problem_while_the_last_version_runs_on(
    played: FakeWorkerSession,
) -> None:
    played.tell(Loading("importing"), TaskFailed(problem(), kept=True))
    played.step()
    view = played.view
    assert view.stale and view.refused is view.problem is not None and view.state == "running"
    played.load("patched")
    assert not played.view.stale and played.view.problem is None and played.view.refused is None


def test_a_worker_with_nothing_to_load_keeps_the_problem_and_too_many_deaths_stop_it(
    fake: FakeWorkerSession,
) -> None:
    fake.session.do(PlayRun())
    fake.greet()
    fake.die()
    (settings,) = fake.greet()
    assert isinstance(settings, Settings) and fake.view.state == "error", (
        "there is nothing to load, and it does not play"
    )
    fake.die(replace(DEATH, end=End.ASKED))
    assert fake.view.problem is not None
    fake.die(replace(DEATH, gives_up=True))
    assert fake.view.state == "stopped" and fake.view.activity == ""


def test_every_load_is_listed_including_refused_ones(played: FakeWorkerSession) -> None:
    for number in range(30):
        played.tell(Loading("importing"), TaskFailed(problem(f"NameError: {number}"), kept=True))
    loads = played.view.loads
    assert len(loads) == 20 and loads[0].reason == "NameError: 29" and loads[0].problem is not None
    played.load("patched")
    assert [load.level for load in played.view.loads[:2]] == ["patched", None]


def test_a_failed_camera_is_not_requested_until_it_is_ticked_again(played: FakeWorkerSession) -> None:
    other = CameraRequest("hand", "sensor")
    played.session.dispatch(PagesCounted(1))
    played.session.change(cameras=(EYE, other))
    played.tell(CameraFailed(EYE.key, "no shader"))
    assert played.view.failed_cameras == {EYE.key: "no shader"}
    played.asked(object)
    played.session.change(speed=2.0)
    (settings,) = played.asked(Settings)
    assert settings.cameras == (other,)
    for cameras, sent in (((other,), (other,)), ((EYE, other), (EYE, other))):
        played.session.change(cameras=cameras)
        (settings,) = played.asked(Settings)
        assert settings.cameras == sent and not played.view.failed_cameras


# --- selections ----------------------------------------------------------------------------------------


def test_pictures_are_of_the_selected_env_and_the_shown_moment(
    played: FakeWorkerSession,
) -> None:
    played.session.change(cameras=(EYE,))
    played.tell(pictures(0, number=3))
    assert set(played.view.pictures) == {EYE.key}
    serial = played.view.pictures_serial
    played.session.dispatch(MomentShown(1))
    assert played.view.pictures == {} and played.view.pictures_serial > serial
    played.session.dispatch(MomentShown(3))
    assert set(played.view.pictures) == {EYE.key}
    played.session.change(selected_env=2)
    assert played.view.pictures == {}
    played.tell(pictures(0, number=3))
    assert played.view.pictures == {}
    played.asked(object)
    played.session.change(selected_env=2)
    assert played.asked(Settings) == [], "nothing changed"
    played.session.dispatch(PagesCounted(1))
    played.session.dispatch(PagesCounted(2))
    played.session.dispatch(PagesCounted(0))
    assert [settings.cameras for settings in played.asked(Settings)] == [(EYE,), ()], (
        "no pictures without a page"
    )


def test_the_version_that_ran_is_restored_even_if_another_class_was_requested(tmp_path: Path) -> None:
    file = str(tmp_path / "push.py")
    found = {
        "file": file,
        "source_files": (file,),
        "source": {file: "text"},
        "chosen": "One",
        "others": ("Two",),
    }
    with fake_worker_session(tmp_path, file) as fake:
        fake.load(**found)
        with pytest.raises(Refused):
            fake.session.do(ChooseClass(name="Nobody"))
        assert fake.asked(Load) == [] and fake.view.choices == ("One", "Two")
        fake.session.do(SetSeed(seed=7))
        fake.session.do(ChooseClass(name="Two"))
        (load,) = fake.asked(Load)
        assert load.task == f"{file}:Two" and load.options.seed == 7 and fake.view.choices == ("Two", "One")
        again = fake.session.look(Run.running_load)
        assert again is not None and (again.task, again.source) == (f"{file}:One", {file: "text"})
        fake.tell(Loading("", load.number))
        fake.die()
        fake.greet()
        fake.load(**found)
        assert fake.view.choices == ("Two", "One"), "saves still load the requested class"
        assert asked_load(fake).task == f"{file}:Two"
        fake.load("rebuilt", **found, in_place_of="Two")
        assert asked_load(fake).task == f"{file}:One"


def test_a_file_named_by_a_recording_is_the_agreed_version_until_it_is_saved(tmp_path: Path) -> None:
    file = tmp_path / "push.py"
    file.write_text("text")
    agreed = RecordedTask("Push-v1", str(file), "Push", {str(file): "text"})
    with fake_worker_session(tmp_path, agreed) as fake:
        assert asked_load(fake).task is agreed
        file.write_text("other")
        (load,) = until(lambda: fake.asked(Load), "the load of what was saved")
        assert load.task == f"{file}:Push" and fake.view.stale


def test_after_two_concurrent_choices_the_last_message_contains_both(tmp_path: Path) -> None:
    sent: list[Settings] = []
    other = threading.Thread(target=lambda: fake.session.change(episode_end="continue"))

    class Overtaken(FakeWorker):
        def send(self, request: Request) -> None:
            if isinstance(request, Settings):
                if request.speed == 2.0 and not other.ident:
                    other.start()
                    other.join(timeout=0.3)  # time for the other to overtake
                sent.append(request)

    with fake_worker_session(tmp_path, worker=Overtaken) as fake:
        fake.session.change(speed=2.0)
        other.join()
        assert (sent[-1].speed, sent[-1].episode_end) == (2.0, "continue")


def test_only_files_of_the_task_are_known(tmp_path: Path) -> None:
    task, beside, outside = (tmp_path / name for name in ("lab/push.py", "lab/helper.py", "secret.py"))
    task.parent.mkdir()
    for file in (task, beside, outside):
        file.write_text("")
    with fake_worker_session(tmp_path, str(task)) as fake:
        knows = fake.session.knows_file
        assert knows(str(task)) and knows(str(beside)) and not knows(str(outside))
        assert not knows(str(task.parent / ".." / "secret.py")) and not knows("/etc/passwd")
        assert not knows(str(task.parent / "gone.py"))
        (task.parent / "notes.txt").write_text("")
        (task.parent / "link.py").symlink_to(outside)
        assert not knows(str(task.parent / "notes.txt")) and not knows(str(task.parent / "link.py"))
        fake.session.change(action_source="policy", policy=f"{outside}:act")
        assert knows(str(outside)), "its policy"


# --- readings of an env ----------------------------------------------------------------------------------


def test_a_reading_is_requested_and_again_after_its_answer(fake: FakeWorkerSession) -> None:
    fake.play(2)
    fake.session.dispatch(PagesCounted(1))
    fake.session.dispatch(ReadingChosen(("joints",)))
    (asked,) = until(lambda: fake.asked(Inspect), "a reading")
    assert (asked.env, asked.sections) == (0, ("joints",))
    fake.step(5)
    fake.tell(Inspection(0, 3))
    assert len(until(lambda: fake.asked(Inspect), "the reading of the newest step")) == 1
    fake.load("rebuilt")
    assert len(until(lambda: fake.asked(Inspect), "another scene, although the last was not answered")) == 1


# --- options of the envs -----------------------------------------------------------------------------------

FIRST, MORE = TaskOptions(3), TaskOptions(4, env_kwargs={"size": 2})


def test_options_take_effect_once_a_load_succeeds_with_them(played: FakeWorkerSession) -> None:
    played.session.dispatch(OptionsApplied(MORE))
    (load,) = played.asked(Load)
    assert load.options == MORE and played.view.options == FIRST
    again = played.session.look(Run.running_load)
    assert again is not None and again.options == FIRST, "the version that ran is restored with its options"
    played.load("same", options=FIRST)
    assert played.view.options == FIRST and asked_load(played).options == MORE, (
        "that load was already in progress"
    )
    played.load("rebuilt", num_envs=4, options=MORE)
    assert played.view.options == MORE and asked_load(played).options == MORE


@pytest.mark.parametrize("kills", [False, True])
def test_options_that_make_the_task_fail_are_dropped_and_not_blamed_on_the_file(
    played: FakeWorkerSession, kills: bool
) -> None:
    played.session.dispatch(OptionsApplied(MORE))
    (load,) = played.asked(Load)
    if kills:
        played.tell(Loading("building", load.number))
        played.die()
        played.greet()
    else:
        played.tell(Loading("building", load.number), TaskFailed(problem(), kept=True, options=MORE))
        assert played.view.state == "running" and not played.view.stale
    assert played.view.problem is not None
    assert (played.view.options, played.view.options_refused) == (FIRST, MORE)
    assert asked_load(played).options == FIRST, "they do not make the next save fail"
    played.session.dispatch(OptionsApplied(FIRST))
    assert played.view.options_refused is None


def test_a_task_that_never_ran_keeps_the_options_that_were_chosen_last(fake: FakeWorkerSession) -> None:
    fake.session.dispatch(OptionsApplied(MORE))
    fake.tell(TaskFailed(problem(), kept=False, options=MORE))
    assert fake.view.options == MORE and asked_load(fake).options == MORE
