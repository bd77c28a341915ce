"""Any events in any order: the state depends only on its events, can be shown, and a refusal changes nothing."""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.drive.scenes import camera, description, step_of, table_scene
from tests.drive.session import DEATH, moment
from workbench.app.state import State, apply
from workbench.cameras.state import first_studio
from workbench.envs.inspection import Inspection
from workbench.live.commands import (
    ChooseActions,
    PauseRun,
    PlayRun,
    ReloadFile,
    ResetAll,
    ResetSelected,
    RestartWorker,
    SetPolicy,
    SetSeed,
    Step,
    TogglePlay,
    UseControlMode,
)
from workbench.live.effects import Asked, Later
from workbench.live.env_commands import NextEnv, PreviousEnv, SelectEnv
from workbench.live.events import (
    FileSaved,
    MomentShown,
    Now,
    OptionsApplied,
    PagesCounted,
    PastPicturesWanted,
    PolicySaved,
    ReadingChosen,
    ReadingDue,
    Send,
    SettingsChanged,
    VersionLoaded,
    WorkerDied,
)
from workbench.live.inspect_polling import READ_PERIOD_SECONDS
from workbench.live.messages import (
    CameraRequest,
    Inspect,
    Load,
    Loaded,
    Loading,
    Placed,
    ReloadReport,
    Settings,
    Status,
    TaskFailed,
)
from workbench.live.process.supervisor import End
from workbench.live.run import first_run
from workbench.live.timeline_commands import ContinueFromHere, GoToLast, NextEvent, Seek, StepBack, UndoReset
from workbench.live.view import view_of
from workbench.page.command import Refused
from workbench.record.state import LiveRecording
from workbench.task.description import Stepped, TaskOptions
from workbench.task.problem import Problem

ENVS = 3
PROBLEM = Problem("step", "KeyError: 'goal'", "push.py", 7, None, "Traceback")


def loaded(level: str | None, text: str, envs: int = ENVS) -> VersionLoaded:
    geometry, poses = table_scene(envs)
    task = replace(
        description(geometry, (camera(),)), file="push.py", source={"push.py": text}, source_hash=text
    )
    report: Any = None if level is None else ReloadReport(level, "", same_scene=True)  # type: ignore[arg-type]
    return VersionLoaded(Loaded(task, step_of(poses), {"import": 1.0}, report), on_disk=True)


def stepped(number: int, jumped: tuple[int, ...]) -> Stepped:
    elapsed = np.full(ENVS, number)
    elapsed[list(jumped)] = 0
    return moment(elapsed, jumped, number=number)


LEVELS = st.sampled_from([None, "same", "patched", "cameras", "rebuilt", "restarted"])
COMMANDS = st.one_of(
    st.sampled_from(
        [
            TogglePlay(), PlayRun(), PauseRun(), Step(), ResetAll(), ResetSelected(), ReloadFile(), RestartWorker(),
            NextEnv(), UndoReset(), ContinueFromHere(scope="all"), GoToLast(), NextEvent(), StepBack(),
            ChooseActions(source="policy"), SetPolicy(policy="act.py:act"), SetPolicy(policy="act"),
            UseControlMode(mode="pd_joint_pos"),
        ]
    ),
    st.builds(SelectEnv, env=st.integers(-2, 5)),
    st.builds(SetSeed, seed=st.integers(0, 9)),
    st.builds(Seek, step=st.integers(-3, 20), episode_only=st.booleans()),
).map(Asked)  # fmt: skip
DRAW = object()
"""Stands for a request for pictures of the shown moment."""
EVENTS = st.one_of(
    COMMANDS,
    st.builds(loaded, LEVELS, st.sampled_from(["one", "two"])),
    st.builds(stepped, st.integers(0, 20), st.lists(st.integers(0, ENVS - 1), unique=True).map(tuple)),
    st.builds(Status, st.booleans(), st.just(20.0), st.just(1.0)),
    st.builds(Loading, st.just("importing"), number=st.integers(0, 30)),
    st.builds(TaskFailed, st.just(PROBLEM), st.booleans(), at_run=st.booleans()),
    st.builds(
        lambda end, gives_up: WorkerDied(replace(DEATH, end=end, gives_up=gives_up), "printed"),
        st.sampled_from(list(End)),
        st.booleans(),
    ),
    st.builds(MomentShown, st.none() | st.integers(-2, 30), st.none() | st.integers(0, ENVS - 1)),
    st.just(DRAW),
    st.builds(PagesCounted, st.integers(0, 2)),
    st.builds(OptionsApplied, st.builds(TaskOptions, st.integers(1, 4))),
    st.sampled_from([FileSaved(), PolicySaved()]),
)


def plain(value: object) -> Any:
    """The comparable part of a value: everything but stores such as the history."""
    if isinstance(value, np.ndarray):
        return repr(value.tolist())
    if is_dataclass(value) and not isinstance(value, type):
        compared = [one.name for one in fields(value) if one.compare and one.name != "history"]
        return {name: plain(getattr(value, name)) for name in compared}
    if isinstance(value, dict):
        return {str(key): plain(one) for key, one in value.items()}
    if isinstance(value, (tuple, list)):
        return [plain(one) for one in value]
    return repr(value)


def after(events: list[Any]) -> tuple[State, list[object]]:
    run = first_run("push.py", TaskOptions(ENVS), 10**6, Settings())
    state, done = (
        State(
            replace(run, own_file=Path("push.py"), own_folder=Path()),
            LiveRecording("recordings"),
            first_studio(None),
        ),
        list[object](),
    )
    for at, event in enumerate(events):
        if event is DRAW:
            event = PastPicturesWanted(state.run.stands_at)
        try:
            new, effects = apply(state, event, Now(float(at), float(at)))
        except Refused as reason:
            assert str(reason) and isinstance(event, Asked)
            continue
        state = new
        done += effects
        run = state.run
        assert run.task is None or 0 <= run.env < run.task.num_envs
        assert run.past is None or run.past.pinned is None or run.past.shown is not None
        view = view_of(run)
        assert view.step_serial == (
            run.step_serial if run.past is None or run.past.shown is None else run.past.pinned
        )
    return state, done


@settings(max_examples=200)
@given(st.lists(EVENTS, max_size=30))
def test_the_same_events_give_the_same_state_and_effects(events: list[Any]) -> None:
    (state, effects), (again, effects_again) = after(events), after(events)
    assert plain(state) == plain(again)
    assert plain(effects) == plain(effects_again)


@settings(max_examples=100)
@given(st.lists(EVENTS, max_size=30))
def test_loads_of_the_file_are_numbered_in_request_order(events: list[Any]) -> None:
    loads = [
        one.request for one in after(events)[1] if isinstance(one, Send) and isinstance(one.request, Load)
    ]
    numbers = [load.number for load in loads if load.source is None]
    assert numbers == sorted(numbers)


def state_after(*events: Any) -> State:
    return after(list(events))[0]


def test_after_long_work_the_session_is_paused_or_plays_on() -> None:
    busy = Status(False, 0.0, 0.0, activity="building the scene")
    for playing, state in ((False, "paused"), (True, "running")):
        assert state_after(loaded(None, "one"), busy).run.state == "loading"
        assert state_after(loaded(None, "one"), busy, Status(playing, 1.0, 1.0)).run.state == state
    stopped = WorkerDied(replace(DEATH, gives_up=True), "")
    assert state_after(loaded(None, "one"), stopped, Status(True, 1.0, 1.0)).run.state == "stopped"


def test_an_outdated_status_does_not_undo_a_press() -> None:
    playing = loaded(None, "one"), Asked(PlayRun()), Status(True, 1.0, 1.0, handled=1)
    pressed = *playing, Asked(PauseRun()), Status(True, 1.0, 1.0, handled=1)
    assert state_after(*playing).run.playing and not state_after(*pressed).run.playing
    # Later the worker may start playing itself, for example when a policy's file was fixed.
    assert state_after(*pressed, Status(True, 1.0, 1.0, handled=2)).run.playing


def test_previous_and_next_env_wrap_around() -> None:
    there = loaded(None, "one")
    assert state_after(there, Asked(PreviousEnv())).run.env == ENVS - 1
    assert state_after(there, Asked(PreviousEnv()), Asked(NextEnv())).run.env == 0


def test_a_saved_file_stays_stale_when_the_running_version_fails_meanwhile() -> None:
    fails = TaskFailed(PROBLEM, kept=True, at_run=True)
    assert not state_after(loaded(None, "one"), fails).run.stale
    assert state_after(loaded(None, "one"), FileSaved(), fails).run.stale


def test_the_first_reading_is_immediate_and_the_next_is_delayed() -> None:
    state = state_after(loaded(None, "one"), PagesCounted(1), stepped(0, (0, 1, 2)))
    state, (soon,) = apply(state, ReadingChosen(("joints",)), Now(100.0, 0.0))
    assert soon == Later(0.0, ReadingDue())
    state, _ = apply(state, ReadingDue(), Now(100.0, 0.0))
    state, _ = apply(state, stepped(1, ()), Now(100.05, 0.0))
    state, (soon,) = apply(state, Inspection(0, 0), Now(100.1, 0.0))
    assert isinstance(soon, Later) and soon.seconds == pytest.approx(READ_PERIOD_SECONDS - 0.1)


def test_pictures_of_the_past_are_wanted_again_whenever_others_are_needed() -> None:
    past = [loaded(None, "one"), stepped(0, (0, 1, 2)), stepped(1, ()), stepped(2, ()), MomentShown(1)]
    events: list[Any] = [
        SettingsChanged({"selected_env": 1}),
        SettingsChanged({"cameras": (CameraRequest("base_camera", "sensor"),)}),
        SettingsChanged({"pictures": "fast"}),
        MomentShown(0),
        Placed(("sensor", "base_camera"), None, camera()),
    ]

    def wanted(pages: int, event: Any) -> list[Any]:
        state, effects = apply(state_after(*past, PagesCounted(pages)), event, Now(9.0, 9.0))
        found = [one for one in effects if isinstance(one, Later)]
        assert all(one.event == PastPicturesWanted(state.run.stands_at) for one in found)
        return found

    assert [len(wanted(1, event)) for event in events] == [1] * len(events)
    assert [len(wanted(0, event)) for event in events] == [0] * len(events), "no page is open"
    assert not wanted(1, Status(True, 20.0, 1.0)) and not wanted(1, MomentShown(1))
    assert not wanted(1, MomentShown(None)), "live pictures come by themselves"


def test_a_reading_is_repeated_after_a_failure_and_for_all_that_it_depends_on() -> None:
    there = [loaded(None, "one"), PagesCounted(1), stepped(0, (0, 1, 2))]
    asked = [*there, ReadingChosen(("joints",), "cube"), ReadingDue()]
    state, effects = after(asked)
    read = [one.request for one in effects if isinstance(one, Send) and isinstance(one.request, Inspect)]
    assert read == [Inspect(0, ("joints",), "cube")] and state.run.reading == "asked"

    def again(*events: Any) -> int:
        new = after([*asked, *events])[1][len(effects) :]
        return sum(isinstance(one, Later) and isinstance(one.event, ReadingDue) for one in new)

    answer = Inspection(0, 0)
    assert again(answer) == 0, "nothing has changed since"
    for change in (
        stepped(1, ()),
        Asked(SelectEnv(env=1)),
        ReadingChosen(("joints",), "table"),
        ReadingChosen(("joints",)),
        ReadingChosen((), "cube"),
        ReadingChosen(("state",), "cube"),
        loaded("patched", "two"),
    ):
        assert again(answer, change) == 1, change
    assert again(TaskFailed(PROBLEM, kept=True, at_run=True), stepped(1, ())) == 1, "there is no answer"
    assert again(stepped(1, ())) == 0, "the last answer is awaited"
    assert again(loaded("rebuilt", "two")) == 1, "another scene, although it is"
    assert again(answer, ReadingChosen(()), stepped(1, ())) == 0
    assert again(answer, PagesCounted(0), stepped(1, ())) == 0
