"""What the studio's state and effects are after each event: previews, measurements, suggestions, and edits of the file."""

# pyright: reportOptionalMemberAccess=false, reportArgumentType=false

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.cameras.studio_runs import (
    CAMERAS,
    FILE,
    HAND,
    MOVED,
    PAST_ENV,
    SETTINGS,
    info,
    loaded,
    runs,
    version,
)
from tests.drive.scenes import problem
from tests.drive.session import BASE, DEATH, PEOPLE
from workbench.cameras import events as of
from workbench.cameras.apply import apply
from workbench.cameras.commands import (
    CopyTask,
    DropCameraChange,
    PickPixel,
    PutMovedCamerasBack,
    ResetCamera,
    RevertCameraChange,
    SaveCameraChange,
    ScalePreview,
    SelectCamera,
    StopMeasuring,
    UndoCamera,
    UsePlacement,
)
from workbench.cameras.edit_state import mismatch
from workbench.cameras.state import Studio, first_studio, kept_placements, view_of
from workbench.cameras.view import EditKind, EditRequest, EditState, PickedPixel, StudioView
from workbench.envs.camera_data import CameraKey, CameraSettings, Picture
from workbench.live.effects import Asked
from workbench.live.events import FileSaved, Now, Send, WorkerDied
from workbench.live.messages import PlaceCamera, TaskFailed
from workbench.live.run import Run
from workbench.page.command import Command, Refused
from workbench.task.write_edits import SourceEdit


@dataclass
class Desk:
    """The studio; events happen to it one after another."""

    run: Run
    studio: Studio = Studio()

    def dispatch(self, event: object) -> list[Any]:
        """The effects of an event or a command."""
        event = Asked(event, "a page") if isinstance(event, Command) else event
        self.studio, effects = apply(self.studio, event, self.run, Now(1.0, 1.0))
        return effects

    def loads(self, run: Run, level: str | None = "cameras") -> list[Any]:
        self.run = run
        return self.dispatch(loaded(level))

    @property
    def view(self) -> StudioView:
        return view_of(self.studio, self.run, None)

    @property
    def edit(self) -> EditState:
        return self.studio.edits.shown


@pytest.fixture
def desk() -> Desk:
    desk = Desk(runs()[0])
    desk.loads(desk.run, None)
    desk.dispatch(SelectCamera(kind="sensor", name="base_camera"))
    return desk


def sent(*pairs: tuple[CameraKey, CameraSettings | None]) -> list[Send]:
    return [Send(PlaceCamera(key, settings)) for key, settings in pairs]


def only(effects: list[Any], kind: type) -> Any:
    (found,) = (one for one in effects if isinstance(one, kind))
    return found


# --- choosing and placing ----------------------------------------------------------------------------


def test_a_sensor_is_chosen_when_the_studio_opens_and_none_after_the_user_chose_none() -> None:
    desk = Desk(runs()[0])
    desk.loads(desk.run, None)
    assert desk.view.selected is None, "no page has opened the studio"
    desk.dispatch(of.StudioOpened())
    assert desk.view.selected == BASE and desk.view.was_chosen
    desk.dispatch(of.CameraChosen(PEOPLE))
    desk.dispatch(of.CameraChosen(("sensor", "gone")))
    assert desk.view.selected == PEOPLE
    with pytest.raises(Refused):
        desk.dispatch(SelectCamera(kind="sensor", name="render_camera"))
    desk.dispatch(of.CameraChosen(None))
    desk.loads(desk.run)
    desk.dispatch(of.StudioOpened())
    assert desk.view.selected is None
    opened_early = Desk(replace(runs()[0], task=None))
    opened_early.dispatch(of.StudioOpened())
    opened_early.loads(runs()[0], None)
    assert opened_early.view.selected == BASE


def test_the_chosen_camera_is_chosen_again_in_the_next_session_if_it_is_there(desk: Desk) -> None:
    desk.dispatch(of.CameraPlaced(BASE, MOVED))
    kept = kept_placements(desk.studio)
    for cameras, selected in ((CAMERAS, BASE), ((info(PEOPLE),), None)):
        later = Desk(replace(runs()[0], task=None), first_studio(kept))
        assert kept_placements(later.studio) == kept
        later.loads(version("old", *cameras), None)
        assert later.view.selected == selected
    assert first_studio().edits.folder == Path.cwd()


def test_reset_puts_the_chosen_camera_back_and_put_back_all(desk: Desk) -> None:
    for key in (BASE, PEOPLE):
        desk.dispatch(of.CameraPlaced(key, MOVED))
    assert desk.dispatch(ResetCamera()) == sent((BASE, None))
    assert {one.key for one in desk.view.cameras if one.moved} == {PEOPLE}
    assert desk.dispatch(ResetCamera()) == [], "it is there"
    assert desk.dispatch(UndoCamera()) == sent((BASE, MOVED))
    assert desk.dispatch(PutMovedCamerasBack()) == sent((PEOPLE, None), (BASE, None))
    assert not any(one.moved for one in desk.view.cameras) and desk.view.undo is not None
    desk.dispatch(of.CameraChosen(None))
    with pytest.raises(Refused):
        desk.dispatch(ResetCamera())


def test_a_new_placement_or_undo_clears_the_last_problem(desk: Desk) -> None:
    for event in (
        of.CameraPlaced(BASE, MOVED),
        UndoCamera(),
        of.MeasureWanted("envs"),
        PickPixel(x=0.5, y=0.5),
    ):
        desk.dispatch(of.CameraPlaced(("sensor", "gone"), SETTINGS))
        assert desk.view.problem
        desk.dispatch(event)
        assert not desk.view.problem, event


def test_a_camera_cannot_be_placed_in_gpu_simulation_or_without_settings(desk: Desk) -> None:
    for run in (version("old", backend="gpu"), version("old", info(BASE, None))):
        desk.run = run
        assert desk.dispatch(of.CameraPlaced(BASE, MOVED)) == []
        assert desk.view.problem and desk.view.chosen.refused and desk.view.placeable is None
    desk.run = runs()[0]
    assert desk.view.placeable is not None


def test_a_mounted_camera_is_shown_at_its_mount_in_the_selected_env_at_the_shown_moment() -> None:
    for run in runs():
        desk = Desk(run)
        desk.loads(run, None)
        step = run.step if run is not runs()[2] else run.past.shown.step
        hand = run.task.geometry.body_names.index("arm/hand")
        env = 0 if run is not runs()[2] else PAST_ENV
        np.testing.assert_array_equal(desk.view.camera(HAND).mount_pose, step.poses[env, hand])
        assert desk.view.camera(BASE).mount_pose is None
    lacking = version("old", info(HAND, mount="arm/tail"))
    assert Desk(lacking).view.camera(HAND).mount_pose is None


# --- previews ------------------------------------------------------------------------------------------


def preview(env: int = 0, key: CameraKey = BASE) -> Picture:
    return Picture(key[1], key[0], env, np.zeros(7, np.float32))


def test_a_preview_is_drawn_again_when_camera_scale_env_or_step_change_and_only_then(desk: Desk) -> None:
    now, later, past = runs()
    (first,) = desk.dispatch(ScalePreview(scale=0.5))
    assert (first.question.key, first.question.settings, first.question.scale) == (BASE, SETTINGS, 0.5)
    assert first.question.env == 0 and first.question.poses is None and len(first.question.modalities) == 3
    assert sent((BASE, MOVED)) == desk.dispatch(of.CameraPlaced(BASE, MOVED)), "one at a time"
    assert only(desk.dispatch(of.PreviewDrawn(preview())), of.DrawPreview).question.settings == MOVED
    assert desk.dispatch(of.PreviewDrawn(preview())) == [] and desk.view.preview is not None
    desk.run = later
    assert only(desk.dispatch(of.StudioOpened()), of.DrawPreview)
    assert desk.dispatch(of.PreviewDrawn(preview())) == []
    desk.run = past
    drawn = only(desk.dispatch(of.StudioOpened()), of.DrawPreview).question
    assert drawn.env == PAST_ENV
    np.testing.assert_array_equal(drawn.poses, past.past.shown.step.poses[PAST_ENV])
    assert desk.view.preview is None, "it is of another env"
    desk.dispatch(of.PreviewDrawn(preview(PAST_ENV)))
    assert desk.view.preview is not None
    assert only(desk.dispatch(of.CameraChosen(PEOPLE)), of.DrawPreview).question.key == PEOPLE
    assert desk.view.preview is None, "it is of another camera"
    desk.dispatch(of.PreviewDrawn(preview(PAST_ENV, PEOPLE)))
    assert desk.dispatch(ScalePreview(scale=1.0)) == [] and desk.view.preview is None
    assert desk.view.preview_scale == 1.0


@pytest.mark.parametrize("change", [{"pages": 0}, {"state": "loading"}, {"state": "stopped"}])
def test_no_preview_is_drawn_without_a_page_or_a_running_version(desk: Desk, change: dict[str, Any]) -> None:
    desk.run = replace(desk.run, **change)
    assert desk.dispatch(ScalePreview(scale=0.5)) == []
    desk.run = runs()[0]
    assert only(desk.dispatch(of.StudioOpened()), of.DrawPreview)


@pytest.mark.parametrize("end", [FileSaved(), WorkerDied(DEATH, "")])
def test_a_save_or_a_dead_worker_ends_the_jobs_and_the_preview_is_drawn_again(
    desk: Desk, end: object
) -> None:
    desk.dispatch(ScalePreview(scale=0.5))
    desk.run = replace(desk.run, state="loading")
    effects = desk.dispatch(end)
    assert effects == [of.StopJobs(("live", "background", "preview", "new camera")), of.StopQuestion()]
    desk.run = runs()[0]
    assert only(desk.loads(desk.run), of.DrawPreview).question.settings == SETTINGS


def test_failures_are_told_where_they_belong_and_the_next_change_draws_again(desk: Desk) -> None:
    desk.dispatch(ScalePreview(scale=0.5))
    assert desk.dispatch(of.WorkFailed("preview", "no device")) == [] and "no device" in desk.view.problem
    assert only(desk.dispatch(of.CameraPlaced(BASE, MOVED)), of.DrawPreview)
    assert not desk.view.problem
    for lane in ("live", "background", "new camera"):
        desk.dispatch(of.WorkFailed(lane, "it broke"))
        assert "t broke" in desk.view.problem, lane
    desk.dispatch(of.SuggestionsFound((), ("cube",)))
    desk.dispatch(of.CameraPlaced(BASE, SETTINGS))
    assert "cube" in desk.view.problem, "that of the last job stays until the next one"
    desk.dispatch(of.Measuring(True))
    assert not desk.view.problem


# --- measurements -------------------------------------------------------------------------------------


def report(*envs: int, worst: tuple[int, ...] = ()) -> Any:
    return SimpleNamespace(envs=envs, worst_first=lambda: worst)


def test_a_camera_is_measured_in_every_env_at_the_shown_moment(desk: Desk) -> None:
    effect = only(desk.dispatch(of.MeasureWanted("envs")), of.MeasureLive)
    assert [(env, poses, moment) for env, poses, moment in effect.cases] == [
        (0, None, None),
        (1, None, None),
        (2, None, None),
    ]
    assert (effect.question.key, effect.question.settings, effect.settings, effect.every) == (
        BASE,
        None,
        SETTINGS,
        3,
    )
    desk.run = runs()[2]
    effect = only(desk.dispatch(of.MeasureWanted("envs")), of.MeasureLive)
    shown = desk.run.past.shown.step.poses
    for number, (env, poses, moment) in enumerate(effect.cases):
        assert (env, moment) == (number, None)
        np.testing.assert_array_equal(poses, shown[number])


def test_a_camera_is_measured_over_the_steps_of_the_selected_env(desk: Desk) -> None:
    desk.run = runs()[2]
    effect = only(desk.dispatch(of.MeasureWanted("steps")), of.MeasureLive)
    history = desk.run.past.history
    assert [moment.step for _, _, moment in effect.cases] == [0, 1, 2, 3, 4] and effect.every > 1
    for env, poses, moment in effect.cases:
        assert (env, moment.env) == (PAST_ENV, PAST_ENV)
        np.testing.assert_array_equal(poses, history.at(moment.serial).step.poses[PAST_ENV])
    assert len(only(desk.dispatch(of.MeasureWanted("steps", 2)), of.MeasureLive).cases) == 2
    desk.dispatch(of.CameraChosen(None))
    assert desk.dispatch(of.MeasureWanted("steps")) == []


def test_fresh_resets_are_measured_with_the_placement_of_a_moved_camera(desk: Desk) -> None:
    for most, count in ((5, 5), (0, 1), (10**6, 1000)):
        effect = only(desk.dispatch(of.MeasureWanted("resets", most)), of.MeasureSeeds)
        assert (effect.seeds, effect.question.settings, effect.settings) == (count, None, SETTINGS)
        assert effect.load is not None
    desk.dispatch(of.CameraPlaced(BASE, MOVED))
    effect = only(desk.dispatch(of.MeasureWanted("resets", 5)), of.MeasureSeeds)
    assert effect.question.settings == MOVED == effect.settings


def test_a_report_is_stale_after_a_move_or_a_rebuild_until_the_next_one(desk: Desk) -> None:
    def made(settings: CameraSettings = SETTINGS, **more: Any) -> of.ReportMade:
        return of.ReportMade(report(0, 1, 2), BASE, settings, more.get("seeds", 0), more.get("moments", ()))

    desk.dispatch(of.Measuring(True))
    desk.dispatch(made())
    results = desk.view.results
    assert (
        not desk.view.report_stale
        and not results.measuring
        and results.report_over_envs(BASE) is results.report
    )
    assert results.report_over_envs(PEOPLE) is None
    desk.dispatch(of.CameraPlaced(PEOPLE, MOVED))
    desk.dispatch(of.CameraChosen(PEOPLE))
    assert not desk.view.report_stale, "another camera was moved"
    desk.dispatch(of.CameraChosen(BASE))
    desk.dispatch(of.CameraPlaced(BASE, replace(SETTINGS, position=(0.4, 0.0, 0.6001))))
    assert not desk.view.report_stale, "it was rounded"
    desk.dispatch(of.CameraPlaced(BASE, MOVED))
    assert desk.view.report_stale
    desk.dispatch(UndoCamera())
    desk.dispatch(of.PixelPicked(PickedPixel(BASE, 0, 0.0, 0.0, (0, 0), None, None, None)))
    desk.dispatch(of.PicturesCompared(preview(), preview()))
    desk.dispatch(of.SheetPictureDrawn(preview()))
    for level in ("same", "cameras"):
        assert not [one for one in desk.loads(desk.run, level) if isinstance(one, of.StopJobs)]
    results = desk.view.results
    assert not desk.view.report_stale and results.picked and results.compared and results.sheet
    for level in ("patched", "rebuilt", None):
        assert only(desk.loads(desk.run, level), of.StopJobs).lanes == ("live", "background")
        results = desk.view.results
        assert desk.view.report_stale and (results.picked, results.compared, results.sheet) == (
            None,
            None,
            (),
        )
        desk.dispatch(made(seeds=3))
        assert not desk.view.report_stale and desk.view.results.report_seeds == 3
        assert desk.view.results.report_over_envs(BASE) is None
    assert desk.dispatch(StopMeasuring()) == [of.StopJobs(("live", "background"))]


def test_suggestions_are_searched_for_the_chosen_camera_and_placed_on_it(desk: Desk) -> None:
    low, high = (0.0, -0.1, 0.2), (0.3, 0.4, 0.5)
    desk.dispatch(of.CameraChosen(HAND))
    desk.dispatch(of.CameraPlaced(HAND, MOVED))
    effect = only(desk.dispatch(of.SuggestionsWanted(("cube", "goal"), low, high, 4)), of.Suggest)
    space = effect.space
    assert (space.objects, space.low, space.high, space.lens) == (("cube", "goal"), low, high, MOVED)
    assert (space.kind, space.mount, effect.seeds) == ("sensor", "arm/hand", 4)
    found = [
        SimpleNamespace(settings=replace(SETTINGS, position=(x, 0.0, 0.3), quaternion=(0, 1, 0, 0), fov=2.0))
        for x in (0.1, 0.2)
    ]
    desk.dispatch(of.SuggestionsFound(tuple(found), ("cube",)))
    assert not desk.view.problem
    desk.dispatch(of.CameraChosen(BASE))
    there = replace(MOVED, position=(0.2, 0.0, 0.3), quaternion=(0, 1, 0, 0))
    assert desk.dispatch(UsePlacement(number=1)) == sent((HAND, there)), (
        "only the pose, and of the searched camera"
    )
    for number in (-1, 2):
        with pytest.raises(Refused):
            desk.dispatch(UsePlacement(number=number))
    desk.dispatch(of.SuggestionsWanted(("cube",), low, high, 4))
    assert (desk.view.results.suggestions, desk.view.results.suggestions_of) == ((), BASE)
    with pytest.raises(Refused):
        desk.dispatch(UsePlacement(number=0))


def test_pictures_are_compared_picked_and_drawn_of_all_envs_at_the_shown_moment(desk: Desk) -> None:
    desk.run = runs()[2]
    moment = desk.run.shown_moment()
    effect = only(desk.dispatch(of.ComparisonWanted(MOVED)), of.Compare)
    assert (effect.key, effect.other, effect.moment.env) == (BASE, MOVED, PAST_ENV)
    assert effect.moment.poses is moment.poses is not None
    assert desk.dispatch(of.ComparisonWanted(replace(MOVED, near=20.0))) == [] and desk.view.problem
    pick = only(desk.dispatch(PickPixel(x=0.25, y=0.75)), of.Pick)
    assert (pick.info.key, pick.u, pick.v, pick.moment.env) == (BASE, 0.25, 0.75, PAST_ENV)
    assert pick.segmentation == desk.run.task.segmentation and not desk.view.problem
    desk.dispatch(of.SheetPictureDrawn(preview()))
    assert (
        only(desk.dispatch(of.SheetWanted()), of.DrawEnvs).env_idx == (0, 1, 2)
        and desk.view.results.sheet == ()
    )
    for found, order in (
        (report(0, 1, 2, worst=(2, 0, 1)), (2, 0, 1)),
        (report(2, 1, 0, worst=(2, 0, 1)), (0, 2, 1)),
        (report(0, 0, 0, worst=(2, 0, 1)), (0, 1, 2)),
    ):
        desk.dispatch(of.ReportMade(found, BASE, SETTINGS, 0, ()))
        assert only(desk.dispatch(of.SheetWanted()), of.DrawEnvs).env_idx == order
    desk.dispatch(of.CameraChosen(PEOPLE))
    drawn = only(desk.dispatch(of.SheetWanted()), of.DrawEnvs)
    assert (drawn.key, drawn.env_idx) == (PEOPLE, (0, 1, 2)), "the report is of another camera"
    desk.dispatch(of.CameraChosen(None))
    for event in (of.SheetWanted(), of.ComparisonWanted(MOVED)):
        assert desk.dispatch(event) == []
    with pytest.raises(Refused):
        desk.dispatch(PickPixel(x=0.5, y=0.5))


# --- edits of the file ---------------------------------------------------------------------------------

NEW: CameraKey = ("sensor", "new")


def edit_to(text: str, old: str = "old", settings: CameraSettings | None = SETTINGS) -> SourceEdit:
    return SourceEdit(FILE, old, text, (), settings)


def plans(desk: Desk, request: EditRequest, edit: SourceEdit) -> EditRequest:
    """Request a plan, which is found; return the request as it was planned."""
    found = only(desk.dispatch(of.EditWanted(request)), of.FindPlan).request
    desk.dispatch(of.PlanFound(found, EditState("planned", found, edit)))
    assert desk.edit.stage == "planned"
    return found


def saves(desk: Desk, run: Run, level: str = "cameras") -> list[Any]:
    """Save the shown change, and load the version with it; return the effects of the load."""
    change = only(desk.dispatch(SaveCameraChange()), of.ChangeFile)
    assert (change.edit, change.revert, desk.edit.stage, desk.edit.loading) == (
        desk.edit.edit,
        False,
        "written",
        True,
    )
    assert desk.dispatch(of.FileChanged()) == []
    return desk.loads(run, level)


def reverts(desk: Desk, run: Run) -> list[Any]:
    change = only(desk.dispatch(RevertCameraChange()), of.ChangeFile)
    assert (change.revert, desk.edit.stage, desk.edit.loading) == (True, "undone", True)
    assert desk.dispatch(of.FileChanged()) == []
    return desk.loads(run)


def test_a_saved_placement_is_checked_and_its_revert_can_be_undone(desk: Desk) -> None:
    desk.dispatch(of.CameraPlaced(BASE, MOVED))
    request = plans(desk, EditRequest("edit", BASE), edit_to("new", settings=MOVED))
    assert request.settings == MOVED
    with_it = version("new", info(PEOPLE), info(BASE, MOVED))
    assert saves(desk, with_it) == sent((BASE, None))
    assert (desk.edit.stage, desk.edit.loading) == ("checked", False) and not desk.view.chosen.moved
    assert reverts(desk, version("old")) == sent((BASE, None))
    assert (desk.edit.stage, desk.edit.loading, desk.studio.edits.done) == ("undone", False, ())
    assert desk.view.chosen.now == SETTINGS
    desk.dispatch(UndoCamera())
    assert desk.view.chosen.now == MOVED


def test_a_camera_that_differs_from_what_was_written_is_a_mismatch_and_can_be_reverted(desk: Desk) -> None:
    plans(desk, EditRequest("edit", BASE), edit_to("new", settings=MOVED))
    saves(desk, version("new", info(BASE, replace(MOVED, far=9.0))))
    assert desk.edit.stage == "mismatch" and "9" in desk.edit.message and "far" in desk.edit.message
    assert desk.studio.edits.done == (desk.edit,)
    reverts(desk, version("old"))
    assert desk.edit.stage == "undone"


def test_only_the_version_with_the_written_text_is_compared(desk: Desk) -> None:
    plans(desk, EditRequest("edit", BASE), edit_to("new\r\n", settings=MOVED))
    only(desk.dispatch(SaveCameraChange()), of.ChangeFile)
    desk.dispatch(of.FileChanged())
    for text, stage in (("old", "written"), ("other", "written"), ("new\n", "checked"), ("other", "checked")):
        desk.loads(version(text, info(BASE, MOVED)))
        assert desk.edit.stage == stage, text


@pytest.mark.parametrize(
    ("what", "name", "after", "placed"),
    [
        ("add", "", (BASE, NEW), {BASE}),
        ("duplicate", "new", (BASE, NEW), {BASE, NEW}),
        ("rename", "new", (NEW,), {NEW}),
        ("remove", "", (), set()),
    ],
)
def test_members_keep_their_placement_through_a_saved_change_and_its_revert(
    desk: Desk, what: EditKind, name: str, after: tuple[CameraKey, ...], placed: set[CameraKey]
) -> None:
    desk.dispatch(of.CameraPlaced(BASE, MOVED))
    key = NEW if what == "add" else BASE
    settings = SETTINGS if what == "add" else None
    plans(
        desk,
        EditRequest(what, key, settings, name),
        edit_to("new", settings=None if what == "remove" else SETTINGS),
    )
    effects = saves(desk, version("new", info(PEOPLE), *(info(one) for one in after)))
    assert desk.edit.stage == "checked", desk.edit.message
    assert {one.key for one in desk.view.cameras if one.moved} == placed
    assert {key for key in placed if Send(PlaceCamera(key, MOVED)) in effects} == placed
    assert all(desk.view.camera(one).now == MOVED for one in placed)
    assert desk.view.selected == (None if what == "remove" else NEW)
    reverts(desk, version("old"))
    assert {one.key for one in desk.view.cameras if one.moved} == {BASE} and desk.view.camera(
        BASE
    ).now == MOVED
    if what != "remove":  # the steps of a removed camera are forgotten
        desk.dispatch(UndoCamera())
        assert not desk.view.camera(BASE).moved


@pytest.mark.parametrize(
    ("request_", "there", "written", "wrong"),
    [
        (EditRequest("edit", BASE), {BASE: SETTINGS}, SETTINGS, False),
        (EditRequest("edit", BASE), {BASE: MOVED}, SETTINGS, True),
        (EditRequest("edit", BASE), {BASE: None}, SETTINGS, True),
        (EditRequest("edit", BASE), {}, SETTINGS, True),
        (EditRequest("remove", BASE), {}, None, False),
        (EditRequest("remove", BASE), {BASE: SETTINGS}, None, True),
        (EditRequest("rename", BASE, name="new"), {NEW: SETTINGS}, SETTINGS, False),
        (EditRequest("rename", BASE, name="new"), {NEW: SETTINGS, BASE: SETTINGS}, SETTINGS, True),
        (EditRequest("rename", BASE, name="new"), {BASE: SETTINGS}, SETTINGS, True),
        (EditRequest("add", NEW), {BASE: SETTINGS}, SETTINGS, True),
        (EditRequest("add", NEW), {NEW: SETTINGS}, None, False),
    ],
)
def test_the_reloaded_cameras_are_compared_with_the_request(
    request_: EditRequest,
    there: dict[CameraKey, CameraSettings | None],
    written: CameraSettings | None,
    wrong: bool,
) -> None:
    assert (
        bool(mismatch(request_, {key: info(key, settings) for key, settings in there.items()}, written))
        is wrong
    )


def test_edits_are_made_in_the_order_of_the_requests(desk: Desk) -> None:
    first, second = EditRequest("duplicate", BASE, SETTINGS, "new"), EditRequest("remove", PEOPLE, SETTINGS)
    assert only(desk.dispatch(of.EditWanted(first)), of.FindPlan).info.key == BASE
    assert desk.dispatch(of.EditWanted(second)) == [of.StopJobs(("new camera",))]
    found = of.PlanFound(first, EditState("planned", first, edit_to("new")))
    effect = only(desk.dispatch(found), of.FindPlan)
    assert (effect.request, effect.info.key, effect.task, effect.load is None) == (
        second,
        PEOPLE,
        desk.run.task,
        False,
    )
    desk.dispatch(of.PlanFound(second, EditState("refused", second, message="Why not.")))
    assert (
        desk.edit.stage == "refused"
        and desk.edit.message.endswith("Why not.")
        and desk.edit.message != "Why not."
    )
    with pytest.raises(Refused):
        desk.dispatch(SaveCameraChange())
    desk.dispatch(of.EditWanted(second))
    desk.dispatch(of.StudioClosed())
    assert desk.dispatch(of.PlanFound(second, EditState("planned", second, edit_to("new")))) == []
    assert desk.dispatch(of.EditWanted(first)) == []


def test_a_file_that_was_not_changed_leaves_the_state_before(desk: Desk) -> None:
    desk.dispatch(of.CameraPlaced(BASE, MOVED))
    plans(desk, EditRequest("edit", BASE, MOVED), edit_to("new", settings=MOVED))
    only(desk.dispatch(SaveCameraChange()), of.ChangeFile)
    desk.dispatch(of.FileNotChanged("it is read-only"))
    assert (desk.edit.stage, desk.edit.loading, desk.studio.edits.done) == ("refused", False, ())
    assert "it is read-only" in desk.edit.message
    plans(desk, EditRequest("edit", BASE, MOVED), edit_to("new", settings=MOVED))
    saves(desk, version("new", info(BASE, MOVED)))
    done = desk.studio.edits.done
    only(desk.dispatch(RevertCameraChange()), of.ChangeFile)
    desk.dispatch(of.FileNotChanged("it was edited since"))
    assert desk.edit.stage == "checked" and desk.studio.edits.done == done and "since" in desk.edit.message
    only(desk.dispatch(RevertCameraChange()), of.ChangeFile)


def test_a_change_that_does_not_load_can_be_reverted(desk: Desk) -> None:
    desk.dispatch(of.CameraPlaced(BASE, MOVED))
    plans(desk, EditRequest("edit", BASE, MOVED), edit_to("new", settings=MOVED))
    only(desk.dispatch(SaveCameraChange()), of.ChangeFile)
    desk.dispatch(of.FileChanged())
    before = desk.edit
    desk.dispatch(TaskFailed(problem(), kept=True, at_run=True))
    assert desk.edit == before, "a failing step is no failing load"
    desk.dispatch(TaskFailed(problem(), kept=True, at_run=False))
    assert desk.edit.stage == "written" and desk.edit.message != before.message
    assert desk.edit.loading, "the author may mend the rest of the file"
    only(desk.dispatch(RevertCameraChange()), of.ChangeFile)
    desk.dispatch(of.FileChanged())
    written = desk.edit.message
    desk.dispatch(TaskFailed(problem(), kept=True, at_run=False))
    assert (desk.edit.stage, desk.edit.loading) == ("undone", False) and desk.edit.message != written
    assert Desk(runs()[0]).dispatch(TaskFailed(problem(), kept=True, at_run=False)) == []


def test_a_dropped_plan_shows_the_newest_change_in_the_file_and_closing_that_forgets_all(desk: Desk) -> None:
    for old, new, settings in (("old", "new", MOVED), ("new", "newer", SETTINGS)):
        desk.dispatch(of.CameraPlaced(BASE, settings))
        plans(desk, EditRequest("edit", BASE, settings), edit_to(new, old, settings))
        saves(desk, version(new, info(BASE, settings)))
    plans(desk, EditRequest("remove", BASE), edit_to("none", "newer", None))
    assert desk.dispatch(DropCameraChange()) == [of.StopJobs(("new camera",))]
    assert desk.edit.stage == "checked" and desk.edit.edit.new_text == "newer"
    reverts(desk, version("new", info(BASE, MOVED)))
    assert desk.edit.stage == "checked" and desk.edit.edit.new_text == "new", "the one before, which is next"
    desk.dispatch(DropCameraChange())
    assert (desk.edit, desk.studio.edits.done) == (EditState(), ())
    assert not [one for one in desk.dispatch(RevertCameraChange()) if isinstance(one, of.ChangeFile)]


def test_a_planned_change_is_saved_only_while_the_camera_is_where_it_was(desk: Desk) -> None:
    plans(desk, EditRequest("duplicate", BASE, name="new"), edit_to("new"))
    desk.dispatch(of.CameraPlaced(PEOPLE, MOVED))
    assert only(desk.dispatch(SaveCameraChange()), of.ChangeFile)
    desk.dispatch(of.FileNotChanged("it is read-only"))
    plans(desk, EditRequest("duplicate", BASE, name="new"), edit_to("new"))
    desk.dispatch(of.CameraPlaced(BASE, MOVED))
    with pytest.raises(Refused):
        desk.dispatch(SaveCameraChange())
    desk.dispatch(of.CameraPlaced(BASE, SETTINGS))
    assert only(desk.dispatch(SaveCameraChange()), of.ChangeFile), "it is back"
    desk.dispatch(of.FileNotChanged("it is read-only"))
    desk.dispatch(of.CameraPlaced(BASE, MOVED))
    plans(desk, EditRequest("add", BASE, SETTINGS), edit_to("new"))
    assert only(desk.dispatch(SaveCameraChange()), of.ChangeFile), "an added camera was not anywhere"


def test_a_new_camera_is_drawn_small_in_the_shown_env_until_another_request(desk: Desk) -> None:
    desk.run = runs()[2]
    large = replace(SETTINGS, width=1024, height=512)
    for settings, scale in ((SETTINGS, 1.0), (large, 0.5)):
        request = EditRequest("add", NEW, settings)
        desk.dispatch(of.EditWanted(request))
        found = of.PlanFound(request, EditState("planned", request, edit_to("new")))
        draw = only(desk.dispatch(found), of.DrawNewCamera)
        assert (draw.request, draw.question.key, draw.question.settings) == (request, NEW, settings)
        assert (draw.question.scale, draw.question.env) == (scale, PAST_ENV) and desk.edit.drawing
        np.testing.assert_array_equal(draw.question.poses, desk.run.past.shown.step.poses[PAST_ENV])
    desk.dispatch(of.NewCameraDrawn(EditRequest("add", NEW, SETTINGS), preview()))
    assert desk.edit.picture is None and desk.edit.drawing, "it is of an earlier request"
    desk.dispatch(of.NewCameraDrawn(request, preview()))
    assert desk.edit.picture is not None and not desk.edit.drawing
    refused = of.PlanFound(request, EditState("refused", request))
    desk.dispatch(of.EditWanted(request))
    assert not desk.edit.drawing and desk.dispatch(refused) == [] and not desk.edit.drawing


def test_a_refused_change_is_planned_again_in_the_copy_of_the_task(desk: Desk) -> None:
    request = EditRequest("edit", BASE, MOVED)
    desk.dispatch(of.EditWanted(request))
    assert [one for one in desk.dispatch(CopyTask()) if isinstance(one, of.CopyToFolder)] == []
    desk.dispatch(of.PlanFound(request, EditState("refused", request)))
    assert [one for one in desk.dispatch(CopyTask()) if isinstance(one, of.CopyToFolder)] == []
    desk.dispatch(of.EditWanted(request))
    desk.dispatch(of.PlanFound(request, EditState("refused", request, can_copy=True)))
    copying = only(desk.dispatch(CopyTask()), of.CopyToFolder)
    assert (copying.task, copying.folder) == (desk.run.task, desk.studio.edits.folder)
    desk.dispatch(of.TaskCopied(Path("/mine/push.py"), EditState("refused")))
    assert not [one for one in desk.loads(desk.run, "rebuilt") if isinstance(one, of.FindPlan)], (
        "it is the original"
    )
    copy = version("old", file="/mine/push.py")
    assert only(desk.loads(copy, "rebuilt"), of.FindPlan).request == request
    assert not [one for one in desk.loads(copy) if isinstance(one, of.FindPlan)], "once"
    desk.dispatch(of.PlanFound(request, EditState("planned", request, edit_to("new"), message="Like this.")))
    assert "/mine/push.py" in desk.edit.message and desk.edit.message.endswith("Like this.")


def test_a_copy_that_does_not_load_is_told(desk: Desk) -> None:
    request = EditRequest("edit", BASE, MOVED)
    desk.dispatch(of.EditWanted(request))
    desk.dispatch(of.PlanFound(request, EditState("refused", request, can_copy=True)))
    desk.dispatch(CopyTask())
    desk.dispatch(of.TaskCopied(Path("/mine/push.py"), EditState("refused")))
    desk.dispatch(TaskFailed(problem(), kept=True, at_run=False))
    assert (
        desk.edit.stage == "refused" and "/mine/push.py" in desk.edit.message and desk.edit.request == request
    )
    desk.dispatch(of.EditFailed("KeyError()"))
    assert "KeyError()" in desk.view.problem
