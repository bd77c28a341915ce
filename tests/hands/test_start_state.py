"""Writing where episodes begin, and their spawn range, as state machines: which results count, and what follows."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from tests.drive.own_controls import Controls
from tests.drive.session import FakeWorkerSession
from workbench.hands.commands import (
    DropStartChange,
    HideSpawn,
    RevertStartChange,
    SaveStartChange,
    SetSpawnSide,
    WriteSpawn,
)
from workbench.hands.spawn import (
    EndSpawn,
    MeasureSpawn,
    SpawnAsked,
    SpawnBox,
    SpawnDragged,
    SpawnFailed,
    SpawnMeasured,
)
from workbench.hands.spawn_source import MIN_WIDTH_METRES
from workbench.hands.start_edit import (
    BodyPose,
    ChangeStartFile,
    CheckStart,
    PlanStart,
    SpawnRange,
    StartChecked,
    StartEdit,
    StartFileFailed,
    StartPlanned,
    StartRefused,
    StartWanted,
)
from workbench.hands.start_panel import start_edit_html
from workbench.live.messages import Status, TaskFailed
from workbench.page.command import Refused
from workbench.task.problem import Problem
from workbench.task.write_edits import SourceEdit

OLD, NEW = "x = 1\n", "x = 2\n"
EDIT = SourceEdit("push.py", OLD, NEW, (), None)
THERE = BodyPose("cube", (0.1, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0))
SEEN = (-0.1, 0.1), (-0.2, 0.2)
RANGES: tuple[tuple[float, float], None] = (-0.15, 0.15), None


@pytest.fixture
def begun(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """What would have been planned, written, checked or measured."""
    effects: list[Any] = []
    for name in ("start_jobs.StartJobs", "spawn.SpawnJobs"):
        monkeypatch.setattr(f"workbench.hands.{name}.perform", lambda _, effect: effects.append(effect))
    return effects


@pytest.fixture
def loaded(fake: FakeWorkerSession, begun: list[Any]) -> FakeWorkerSession:
    fake.load(source={"push.py": OLD})
    fake.reset()
    return fake


def edit_of(fake: FakeWorkerSession) -> StartEdit:
    return fake.view.of(StartEdit)


def box_of(fake: FakeWorkerSession) -> SpawnBox:
    return fake.view.of(SpawnBox)


def planned(fake: FakeWorkerSession) -> int:
    """Plan a change; returns its number."""
    fake.session.dispatch(StartWanted(THERE))
    fake.session.dispatch(StartPlanned(edit_of(fake).number, EDIT))
    assert edit_of(fake).stage == "planned"
    return edit_of(fake).number


def reload(fake: FakeWorkerSession, text: str) -> None:
    fake.load("patched", source={"push.py": text})


def test_a_change_is_planned_saved_checked_and_reverted_with_its_own_number(
    loaded: FakeWorkerSession, begun: list[Any]
) -> None:
    session = loaded.session
    session.change(selected_env=1)
    for command in (SaveStartChange(), RevertStartChange()):
        with pytest.raises(Refused):
            session.do(command)
    for round in range(2):
        number = planned(loaded)
        plan = begun.pop()
        assert isinstance(plan, PlanStart) and (plan.number, plan.wanted) == (number, THERE)
        assert plan.seeds == (0, 3, 6, 9), "twelve episodes of three envs"
        session.do(SaveStartChange())
        assert begun.pop() == ChangeStartFile(number, EDIT, revert=False) and edit_of(loaded).writing
        with pytest.raises(Refused):
            session.dispatch(StartWanted(THERE))
        reload(loaded, NEW)
        check = begun.pop()
        assert isinstance(check, CheckStart) and (check.number, check.wanted) == (number, THERE)
        assert check.seeds == plan.seeds and not edit_of(loaded).writing
        session.dispatch(StartChecked(number - 1, "late"))
        assert edit_of(loaded).stage == "written"
        session.dispatch(StartChecked(number, "it is elsewhere" if round else ""))
        assert edit_of(loaded).stage == ("mismatch" if round else "checked")
        session.do(RevertStartChange())
        assert begun.pop() == ChangeStartFile(number, EDIT, revert=True)
        reload(loaded, OLD)
        assert edit_of(loaded).stage == "undone" and not edit_of(loaded).writing and not begun
    session.do(DropStartChange())
    assert edit_of(loaded) == StartEdit(number=number + 1)


def test_results_of_an_older_request_are_dropped(loaded: FakeWorkerSession) -> None:
    session = loaded.session
    session.dispatch(StartWanted(THERE))
    old = edit_of(loaded).number
    session.dispatch(StartWanted(replace(THERE, of="table")))
    before = edit_of(loaded)
    for late in (StartPlanned(old, EDIT), StartRefused(old, "no", "")):
        session.dispatch(late)
        assert edit_of(loaded) == before
    session.dispatch(StartRefused(before.number, "no such call", "pose = here"))
    assert edit_of(loaded).stage == "refused" and edit_of(loaded).snippet == "pose = here"
    session.dispatch(StartPlanned(before.number, EDIT))
    assert edit_of(loaded).stage == "refused", "it was answered already"


def test_a_file_that_cannot_be_written_leaves_the_stage_that_the_file_has(loaded: FakeWorkerSession) -> None:
    session, number = loaded.session, planned(loaded)
    session.do(SaveStartChange())
    session.dispatch(StartFileFailed(number, "read-only"))
    assert edit_of(loaded).stage == "refused" and not edit_of(loaded).writing
    number = planned(loaded)
    session.do(SaveStartChange())
    reload(loaded, NEW)
    session.do(RevertStartChange())
    session.dispatch(StartFileFailed(number, "read-only"))
    assert edit_of(loaded).stage == "checked" and not edit_of(loaded).writing, (
        "the change is still in the file"
    )


def test_another_version_ends_the_change_and_the_old_one_does_not(loaded: FakeWorkerSession) -> None:
    planned(loaded)
    loaded.session.do(SaveStartChange())
    reload(loaded, OLD)
    assert edit_of(loaded).stage == "written" and edit_of(loaded).writing, (
        "this is the text before the change"
    )
    loaded.tell(TaskFailed(Problem("import", "no", "push.py", 1, "x", ""), kept=True))
    assert edit_of(loaded).stage == "written" and edit_of(loaded).writing
    reload(loaded, "x = 3\n")
    assert edit_of(loaded).stage == "none"


def test_a_running_body_is_not_written_but_its_range_is(loaded: FakeWorkerSession, begun: list[Any]) -> None:
    loaded.tell(Status(True, 20.0, 1.0))
    with pytest.raises(Refused):
        loaded.session.dispatch(StartWanted(THERE))
    assert not begun
    loaded.session.dispatch(StartWanted(SpawnRange("cube", (0.0, 1.0), None)))
    assert [type(one) for one in begun] == [PlanStart]


@pytest.mark.parametrize(
    ("stage", "commands"),
    [
        ("none", ()),
        ("planning", ()),
        ("planned", (SaveStartChange(), DropStartChange())),
        ("refused", (DropStartChange(),)),
        ("written", (RevertStartChange(), DropStartChange())),
        ("checked", (RevertStartChange(), DropStartChange())),
        ("mismatch", (RevertStartChange(), DropStartChange())),
        ("undone", (DropStartChange(),)),
    ],
)
def test_each_stage_offers_what_can_be_done_and_shows_the_lines_that_hold(
    stage: Any, commands: tuple
) -> None:
    html = start_edit_html(StartEdit(stage, 1, THERE, EDIT, "a message"))
    assert tuple(button.command for button in Controls(html).buttons if button.command) == commands
    assert ("x = 2" in html) == (stage not in ("none", "undone")) and ("a message" in html) == (
        stage != "none"
    )


# --- the spawn range --------------------------------------------------------------------------------------


def measured(fake: FakeWorkerSession, ranges: Any = RANGES, body: str = "cube") -> SpawnBox:
    fake.session.dispatch(SpawnAsked(body))
    fake.session.dispatch(SpawnMeasured(box_of(fake).number, SEEN, ranges))
    return box_of(fake)


def test_a_range_is_measured_with_the_seeds_of_twelve_episodes(
    loaded: FakeWorkerSession, begun: list[Any]
) -> None:
    box = measured(loaded)
    (asked,) = begun
    assert isinstance(asked, MeasureSpawn) and (asked.body, asked.seeds) == ("cube", (0, 3, 6, 9))
    assert (box.stage, box.measured, box.wanted, box.sides) == (
        "measured",
        RANGES,
        RANGES,
        (RANGES[0], SEEN[1]),
    )
    loaded.session.dispatch(SpawnMeasured(box.number - 1, SEEN, (None, None)))
    loaded.session.dispatch(SpawnFailed(box.number - 1, "late", None))
    assert box_of(loaded) == box
    loaded.session.do(WriteSpawn())
    assert begun[-1].wanted == SpawnRange("cube", *RANGES)


def test_a_side_moves_alone_and_stays_a_millimetre_from_the_other(loaded: FakeWorkerSession) -> None:
    both = (-0.1, 0.1), (-0.2, 0.2)
    for side, to, wanted in (
        ("x_min", -0.30004, ((-0.3, 0.1), both[1])),
        ("x_max", 0.3, ((-0.1, 0.3), both[1])),
        ("y_min", 0.5, (both[0], (0.2 - MIN_WIDTH_METRES, 0.2))),
        ("y_max", -0.5, (both[0], (-0.2, -0.2 + MIN_WIDTH_METRES))),
    ):
        measured(loaded, both)
        loaded.session.do(SetSpawnSide(side=side, to=to))  # type: ignore[arg-type]
        assert box_of(loaded).wanted == wanted and box_of(loaded).measured == both
    measured(loaded)
    before = box_of(loaded)
    for wrong in (
        SpawnDragged("y_min", 0.0),
        SpawnDragged("x_min", 2e3),
        SpawnDragged("x_max", float("nan")),
        SpawnDragged("x_max", float("inf")),
        SpawnAsked("no such body"),
    ):
        with pytest.raises(Refused):
            loaded.session.dispatch(wrong)
    assert box_of(loaded) == before
    loaded.session.dispatch(SpawnDragged("x_min", 1.0))
    assert box_of(loaded).wanted == ((RANGES[0][1] - MIN_WIDTH_METRES, RANGES[0][1]), None)


def test_a_new_version_is_measured_again_beside_the_old_box(
    loaded: FakeWorkerSession, begun: list[Any]
) -> None:
    box = measured(loaded)
    reload(loaded, NEW)
    again = box_of(loaded)
    assert (again.stage, again.measured, again.number) == ("measuring", RANGES, box.number + 1)
    with pytest.raises(Refused):
        loaded.session.do(WriteSpawn())
    with pytest.raises(Refused):
        loaded.session.do(SetSpawnSide(side="x_min", to=0.0))
    loaded.session.dispatch(SpawnFailed(again.number, "the task failed", None))
    assert (box_of(loaded).stage, box_of(loaded).why) == ("failed", "the task failed")
    loaded.session.dispatch(SpawnAsked("table"))
    assert box_of(loaded).measured == (None, None), "the box of another body is not shown for this one"
    begun.clear()
    loaded.session.do(HideSpawn())
    assert begun == [EndSpawn()] and box_of(loaded) == SpawnBox(number=again.number + 2)
    with pytest.raises(Refused):
        loaded.session.dispatch(SpawnDragged("x_min", 0.0))
    reload(loaded, OLD)
    assert begun == [EndSpawn()], "a hidden range is not measured"
