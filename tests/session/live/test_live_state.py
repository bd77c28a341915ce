"""What each event means for what is seen, without a worker."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from tests.drive.scripted import scripted
from tests.drive.waiting import until
from tests.session.moments import DEATH
from tests.ui.scenes import description, problem, step_of, table_scene
from workbench.authoring.loading.reference import RecordedTask
from workbench.core.camera_data import Picture
from workbench.jobs.task import Stepped, TaskOptions
from workbench.session.live.live_state import LiveState
from workbench.session.live.session import Session
from workbench.session.live.view import SessionView
from workbench.session.process.supervisor import End, Supervisor
from workbench.session.protocol.messages import (
    CameraRequest,
    Loaded,
    LoadFailed,
    Loading,
    Pictures,
    ReloadReport,
    Request,
    Settings,
    Status,
)

N = 3


def view(state: LiveState) -> SessionView:
    return state.view()


def loaded(report: ReloadReport | None = None, num_envs: int = N, source_hash: str = "a") -> Loaded:
    geometry, poses = table_scene(num_envs)
    task = replace(description(geometry), source_hash=source_hash)
    return Loaded(task, replace(step_of(poses), elapsed_steps=np.zeros(num_envs, np.int32)), {}, report)


def stepped(number: int, jumped: bool = False, num_envs: int = N) -> Stepped:
    step = replace(
        step_of(table_scene(num_envs)[1]), elapsed_steps=np.full(num_envs, 0 if jumped else number, np.int32)
    )
    return Stepped(step, np.full(num_envs, jumped), snapshot=b"body", part_keys=(), number=number)


def running(steps: int = 3) -> LiveState:
    """It was loaded, plays, and took some steps."""
    state = LiveState("push.py", TaskOptions(), 10**8)
    state.loaded(loaded(), restored=False, stale=False)
    for number in range(steps + 1):
        state.stepped(stepped(number, jumped=number == 0))
    state.take(Status(True, 20.0, 1.0))
    return state


def report(level: str) -> ReloadReport:
    return ReloadReport(level, "")  # type: ignore[arg-type]


def test_nothing_is_shown_before_a_task_is_loaded_and_its_moments_from_then_on() -> None:
    state = LiveState("push.py", TaskOptions(), 10**8)
    assert view(state).state == "starting" and view(state).curves is None and state.newest_moment() is None
    state.take(Loading("importing"))
    assert (view(state).state, view(state).activity) == ("loading", "importing")
    shown = view(running())
    assert (shown.state, shown.activity, shown.playing) == ("running", "", True)
    assert (shown.timeline.last, shown.step_serial, shown.timeline.moments) == (3, 3, 4)
    assert shown.curves is not None and shown.curves.serial == 3


def test_what_is_changed_before_there_is_a_task_leaves_the_env_that_was_selected_in_an_earlier_session() -> (
    None
):
    state = LiveState("push.py", TaskOptions(), 10**8)
    state.set(settings=Settings(selected_env=1))
    state.change(speed=2.0)
    state.loaded(loaded(), restored=False, stale=False)
    assert (view(state).selected_env, view(state).settings.speed) == (1, 2.0)
    state = LiveState("push.py", TaskOptions(), 10**8)
    state.change(selected_env=2**40)
    state.loaded(loaded(), restored=False, stale=False)
    assert view(state).selected_env == N - 1


def test_curves_stay_as_they_were_taken_and_are_of_the_selected_env() -> None:
    state = running()
    state.stepped(stepped(4, jumped=True))
    first = view(state).curves
    assert view(state).curves is first, "nothing is made for a look"
    state.stepped(stepped(5))
    state.change(selected_env=1)
    now = view(state).curves
    assert first is not None and (first.serial, first.env) == (3, 0)
    assert now is not None and (now.serial, now.env) == (4, 1)


def test_a_version_on_the_same_scene_leaves_the_past_and_the_drawn_shapes() -> None:
    state = running()
    state.change(selected_env=2)
    before = view(state)
    state.loaded(loaded(report("patched"), source_hash="b"), restored=False, stale=False)
    after = view(state)
    assert after.task is not None and before.task is not None
    assert after.task.source_hash == "b" and after.task.geometry is before.task.geometry
    assert (after.task_serial, after.scene_serial, after.cameras_serial) == (2, 1, 1)
    assert (after.selected_env, after.timeline.moments, after.step_serial) == (2, 4, 3)


def test_what_was_odd_while_playing_goes_with_the_version_and_comes_back_if_that_is_odd_too() -> None:
    state = running()
    lost = np.array([0.0, np.nan, 0.0], np.float32)
    odd = [replace(one, step=replace(one.step, reward=lost)) for one in (stepped(4), stepped(5))]
    state.stepped(odd[0])
    (found,) = view(state).odd
    assert (found.rule, found.count, found.first_step) == ("reward-finite", 1, 3) and view(state).played == (
        found,
    )
    state.loaded(loaded(report("same")), restored=False, stale=False)
    assert view(state).odd == (found,)
    state.loaded(loaded(report("patched"), source_hash="b"), restored=False, stale=False)
    assert view(state).odd == ()
    state.stepped(odd[1])
    assert [each.first_step for each in view(state).odd] == [4]
    state.loaded(loaded(report("rebuilt"), source_hash="b"), restored=False, stale=False)
    assert view(state).odd == ()


def test_another_scene_begins_another_past_whose_moments_count_on() -> None:
    state = running()
    state.change(selected_env=2)
    state.loaded(loaded(report("rebuilt"), num_envs=2), restored=False, stale=False)
    state.stepped(stepped(0, jumped=True, num_envs=2))
    after = view(state)
    assert (after.scene_serial, after.cameras_serial) == (2, 2)
    assert after.selected_env == 1
    assert (after.timeline.first, after.timeline.moments) == (4, 1)


def test_the_last_good_version_comes_back_with_its_past_and_with_what_killed_it() -> None:
    state = running()
    told = state.died(DEATH, while_loading=False, printed="pushing")
    assert told is not None and "SIGSEGV" in told.message and "pushing" in told.traceback
    assert (view(state).state, view(state).playing) == ("starting", False)
    state.loaded(loaded(), restored=True, stale=True)
    state.stepped(stepped(0, jumped=True))
    after = view(state)
    assert after.timeline.moments == 5 and after.stale and after.state == "paused"
    assert after.problem == told
    state.loaded(loaded(source_hash="b"), restored=False, stale=False)
    assert view(state).problem is None and view(state).timeline.moments == 0


def test_what_failed_while_running_stands_until_a_step_follows() -> None:
    state = running()
    state.take(LoadFailed(problem(), kept=True, at_run=True))
    assert (view(state).state, view(state).playing, view(state).stale) == ("paused", False, False)
    assert view(state).problem_at_run
    state.stepped(stepped(4))
    assert view(state).problem is None and not view(state).problem_at_run


def test_what_fails_while_envs_are_put_back_failed_while_it_ran() -> None:
    state = running()
    state.take(Status(False, 0.0, 0.0, "going back: step 3 of 40"))
    state.take(LoadFailed(problem(), kept=True, at_run=True))
    assert view(state).problem_at_run and not view(state).stale and len(view(state).loads) == 1


def test_the_reset_that_a_new_scene_begins_with_mends_no_failure_at_run() -> None:
    state = LiveState("push.py", TaskOptions(), 10**8)
    state.loaded(loaded(), restored=False, stale=False)
    state.take(LoadFailed(problem(), kept=True, at_run=True))
    state.stepped(stepped(0, jumped=True))
    assert view(state).problem is not None
    state.stepped(stepped(1))
    assert view(state).problem is None


def test_a_version_that_cannot_be_loaded_leaves_its_problem_while_the_one_before_runs_on() -> None:
    state = running()
    state.take(Loading("importing"))
    state.take(LoadFailed(problem(), kept=True))
    state.stepped(stepped(4))
    assert view(state).stale and view(state).problem is not None and view(state).state == "running"
    state.take(Status(False, 0.0, 0.0))
    assert view(state).state == "paused"


def test_a_worker_that_could_load_nothing_waits_with_the_problem() -> None:
    state = LiveState("push.py", TaskOptions(), 10**8, wants_play=True)
    state.died(DEATH, while_loading=True, printed="")
    state.wait_for_file()
    assert (view(state).state, state.wants_play) == ("error", False)
    assert state.died(replace(DEATH, end=End.ASKED, gives_up=True), while_loading=True, printed="") is None
    state.wait_for_file()
    assert view(state).state == "stopped" and view(state).problem is not None


def test_pictures_are_those_of_the_env_that_is_looked_at() -> None:
    def pictures(env: int) -> Pictures:
        rgb = np.zeros((2, 2, 3), np.uint8)
        return Pictures((Picture("eye", "sensor", env, np.zeros(7, np.float32), rgb),), 12.0, 0)

    state = running()
    state.change(cameras=(CameraRequest("eye", "sensor"),))
    state.take(pictures(0))
    assert set(view(state).pictures) == {("sensor", "eye")}
    assert state.change(selected_env=99) and view(state).selected_env == N - 1 and view(state).pictures == {}
    state.take(pictures(0))
    assert view(state).pictures == {}
    assert not state.change(selected_env=N - 1)
    assert state.settings().cameras == (), "no page is open"


def test_a_moment_of_the_past_is_shown_in_place_of_the_newest() -> None:
    state = running()
    assert state.timeline is not None
    state.timeline.seek(1)
    shown = view(state)
    assert shown.step_serial == 1 and shown.step is not None and shown.step.elapsed_steps[0] == 1


def test_a_load_asks_for_the_class_and_the_seed_that_the_page_chose() -> None:
    state = running()
    assert not state.choose_class("Other")
    task = state.now.task
    assert task is not None
    state.set(task=replace(task, others=("Other",)), choices=("PushEnv", "Other"))
    assert state.choose_class("Other")
    state.set(seed=7)
    load = state.load_request(None, b"moment", level="rebuilt")
    assert str(load.task).endswith("push.py:Other") and load.options == TaskOptions(seed=7)
    assert (load.source, load.level, load.snapshot) == (None, "rebuilt", b"moment")


def test_the_version_that_ran_is_brought_back_although_another_class_is_asked_for() -> None:
    state = running()
    assert state.now.task is not None and state.now.step is not None
    task = replace(
        state.now.task,
        chosen="One",
        others=("Two",),
        file="/home/me/push.py",
        source_files=("/home/me/push.py",),
    )
    state.reference, state.own_file = "/home/me/push.py", Path("/home/me/push.py")
    state.loaded(Loaded(task, state.now.step, {}), restored=False, stale=False)
    assert state.now.choices == ("One", "Two")
    assert state.choose_class("Two") and state.now.choices == ("Two", "One")
    assert state.load_request(None).task == "/home/me/push.py:Two"
    assert state.load_request({"/home/me/push.py": "text"}).task == "/home/me/push.py:One"
    state.loaded(Loaded(task, state.now.step, {}), restored=True, stale=True)
    assert state.now.choices == ("Two", "One"), "it is still what saves bring in"
    assert state.choose_class("One")

    tried = replace(task, in_place_of="Two")
    state.reference = "/home/me/push.py"
    state.loaded(Loaded(tried, state.now.step, {}), restored=False, stale=False)
    assert state.load_request(None).task == "/home/me/push.py:One"


def test_a_file_that_a_recording_named_is_what_was_agreed_to_until_it_is_saved() -> None:
    agreed = RecordedTask("Push-v1", "/home/me/push.py", "Push", {"/home/me/push.py": "text"})
    state = LiveState(agreed, TaskOptions(), 2**20)
    assert state.own_file == Path("/home/me/push.py")
    assert state.load_request(None).task is agreed
    state.use_saved_file()
    assert state.load_request(None).task == "/home/me/push.py:Push"


def test_of_two_who_choose_at_once_the_last_message_has_what_both_chose(tmp_path: Path) -> None:
    sent: list[Settings] = []

    def overtaken(*arguments: Any, **named: Any) -> Supervisor:
        worker = scripted(2)(*arguments, **named)
        send = worker.send

        def send_slowly(request: Request) -> None:
            if isinstance(request, Settings):
                if request.speed == 2.0 and not other.ident:
                    other.start()
                    other.join(timeout=0.3)  # as long as the other may take to come in between
                sent.append(request)
            send(request)

        worker.send = send_slowly
        return worker

    session = Session("push.py", TaskOptions(), recordings=tmp_path, make_worker=overtaken)
    other = threading.Thread(target=lambda: session.change(episode_end="continue"))
    try:
        session.change(speed=2.0)
        until(lambda: other.ident is not None and not other.is_alive(), "the other's choice")
        assert (sent[-1].speed, sent[-1].episode_end) == (2.0, "continue")
    finally:
        session.close()


def test_every_load_is_remembered_also_one_that_was_refused() -> None:
    state = running()
    for number in range(30):
        state.take(Loading("importing"))
        state.take(LoadFailed(problem(f"NameError: {number}"), kept=True))
    loads = view(state).loads
    assert len(loads) == 20 and loads[0].reason == "NameError: 29" and loads[0].problem is not None
    state.take(LoadFailed(problem("ValueError: in a step"), kept=True, at_run=True))
    assert view(state).loads == loads, "it is no load"
    state.loaded(loaded(report("patched")), restored=False, stale=False)
    assert [load.level for load in view(state).loads[:2]] == ["patched", None]


def test_files_of_the_task_are_known_and_no_others(tmp_path: Path) -> None:
    task, beside = tmp_path / "lab" / "push.py", tmp_path / "lab" / "helper.py"
    outside = tmp_path / "secret.py"
    task.parent.mkdir()
    for file in (task, beside, outside):
        file.write_text("")
    state = LiveState(str(task), TaskOptions(), 10**8)
    assert state.knows_file(str(task)) and state.knows_file(str(beside))
    assert not state.knows_file(str(outside))
    assert not state.knows_file(str(task.parent / ".." / "secret.py"))
    assert not state.knows_file(str(task.parent / "gone.py")) and not state.knows_file("/etc/passwd")
    state.change(action_source="policy", policy=f"{outside}:act")
    assert state.knows_file(str(outside)), "its policy"


# --- options of the envs -----------------------------------------------------------------------------


def test_options_are_in_effect_when_a_load_has_taken_them() -> None:
    state = running()
    more = TaskOptions(N + 1, env_kwargs={"size": 2})
    state.apply_options(more)
    assert state.load_request(None).options == more and view(state).options == TaskOptions()
    # The version that ran is brought back as it ran.
    assert state.load_request({"push.py": ""}).options == TaskOptions()
    state.loaded(replace(loaded(num_envs=N + 1), options=more), restored=False, stale=False)
    assert view(state).options == more and state.load_request(None).options == more
    assert state.tried_options is None


def test_a_load_that_was_under_way_before_does_not_count_for_the_new_options() -> None:
    state = running()
    more = TaskOptions(N + 1)
    state.apply_options(more)
    state.loaded(replace(loaded(), options=TaskOptions()), restored=False, stale=False)
    assert view(state).options == TaskOptions() and state.load_request(None).options == more


def test_options_with_which_the_task_fails_are_dropped_and_said_and_the_file_is_not_to_blame() -> None:
    state = running()
    state.take(Loading("building"))
    state.apply_options(bad := TaskOptions(N, env_kwargs={"robot_uids": "no such"}))
    state.take(LoadFailed(problem(), kept=True, options=bad))
    seen = view(state)
    assert seen.state == "running" and seen.problem is not None and not seen.stale
    assert seen.options == TaskOptions() and seen.options_refused == bad
    assert state.load_request(None).options == TaskOptions(), "the next save does not fail for them"
    state.apply_options(TaskOptions())
    assert view(state).options_refused is None


def test_options_that_kill_the_worker_are_dropped() -> None:
    state = running()
    state.apply_options(bad := TaskOptions(4096))
    state.died(DEATH, while_loading=True, printed="")
    assert state.load_request(None).options == TaskOptions() and view(state).options_refused == bad


def test_a_task_that_never_ran_keeps_the_options_that_a_person_chose_last() -> None:
    state = LiveState("push.py", TaskOptions(), 10**8)
    state.apply_options(other := TaskOptions(1))
    state.take(LoadFailed(problem(), kept=False, options=other))
    assert state.load_request(None).options == other and view(state).options == other


def test_a_save_that_fails_leaves_the_options_alone() -> None:
    state = running()
    state.take(Loading("importing"))
    state.take(LoadFailed(problem(), kept=True, options=TaskOptions()))
    assert view(state).stale and view(state).options_refused is None
