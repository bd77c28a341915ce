"""Applies events to the camera studio, and runs the jobs that follow."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import get_args

from workbench.cameras.commands import (
    CopyTask,
    DropCameraChange,
    PickPixel,
    PutMovedCamerasBack,
    RedoCamera,
    ResetCamera,
    RevertCameraChange,
    SaveCameraChange,
    ScalePreview,
    SelectCamera,
    StopMeasuring,
    UndoCamera,
    UsePlacement,
)
from workbench.cameras.edit_jobs import FileEdits
from workbench.cameras.edit_state import (
    apply_to_edits,
    do_edit,
    edit_failed_to_load,
    edit_loaded,
    plan_in_copy,
    with_edits,
)
from workbench.cameras.events import (
    CameraChosen,
    CameraPlaced,
    ChangeFile,
    Compare,
    CopyToFolder,
    DrawEnvs,
    DrawNewCamera,
    DrawPreview,
    FindPlan,
    Lane,
    MeasureLive,
    MeasureSeeds,
    Pick,
    PreviewDrawn,
    StopJobs,
    StopQuestion,
    StudioEffect,
    StudioEvent,
    StudioOpened,
    Suggest,
    WorkFailed,
)
from workbench.cameras.placements import Placements
from workbench.cameras.questions import DrawCamera
from workbench.cameras.report_jobs import CameraReports
from workbench.cameras.report_state import STOP_REPORTS, apply_to_reports, do_report, outdated, with_results
from workbench.cameras.state import Change, Studio, info_of, refusal, settings_in_file, shown_step
from workbench.envs.camera_data import CameraKey, why_no_camera
from workbench.live.effects import Asked
from workbench.live.events import FileOpened, FileSaved, Now, Send, VersionLoaded, WorkerDied
from workbench.live.messages import PlaceCamera, Placed, TaskFailed
from workbench.live.process.ask import Background, QuestionClient
from workbench.live.process.background_jobs import JobProgress, Jobs
from workbench.live.run import Run
from workbench.machine.loop import do
from workbench.page.command import Command, Refused

PREVIEW_MODALITIES = ("rgb", "depth", "segmentation")
_OF_FILE = SaveCameraChange, RevertCameraChange, CopyTask, DropCameraChange
_OF_REPORTS = StopMeasuring, PickPixel
DOES: frozenset[type[Command]] = frozenset(
    {
        SelectCamera,
        UndoCamera,
        RedoCamera,
        ResetCamera,
        PutMovedCamerasBack,
        UsePlacement,
        ScalePreview,
        *_OF_FILE,
        *_OF_REPORTS,
    }
)
"""Commands that `apply` handles."""


def apply(studio: Studio, event: object, run: Run, now: Now) -> Change:
    """The studio after an event, and the effects to perform.

    Args:
        run: the run after the event.

    Raises:
        Refused: the command makes no sense now; nothing has changed.
    """
    studio, effects = _apply(studio, event, run, now)
    if studio.is_open and not studio.was_chosen and studio.selected is None and run.task is not None:
        # Choose a camera once, a sensor if there is one. A later choice of "none" by the user stays.
        cameras = sorted(run.task.cameras, key=lambda camera: camera.kind != "sensor")
        if cameras:
            studio, _ = _select(studio, cameras[0].key, run)
    if not run.pages or run.state not in ("running", "paused"):
        return studio, effects
    studio, preview = _draw_preview(studio, run)
    return studio, [*effects, *preview]


def _apply(studio: Studio, event: object, run: Run, now: Now) -> Change:
    match event:
        case Asked(command=command) if type(command) in DOES:
            return _do_command(studio, command, run, now)
        case StudioOpened():
            return replace(studio, is_open=True), []
        case CameraChosen(key=key):
            return _select(studio, key, run)
        case CameraPlaced():
            return _place(studio, event, run, now)
        case PreviewDrawn(picture=picture):
            return replace(studio, preview=picture, drawing=False), []
        case WorkFailed(lane=lane, why=why):
            return _failed(studio, lane, why), []
        case VersionLoaded():
            report = event.loaded.reload
            return _loaded(
                studio, run, scene_changed=report is None or report.level not in ("same", "cameras")
            )
        case TaskFailed(at_run=False):
            return edit_failed_to_load(studio), []
        case Placed():
            return _placed(studio, event)
        case FileSaved() | WorkerDied():
            studio = replace(studio, previewed=None, drawing=False)
            studio = with_edits(studio, shown=replace(studio.edits.shown, drawing=False))
            return studio, [StopJobs(("live", "background", "preview", "new camera")), StopQuestion()]
        case _:
            studio, effects = apply_to_reports(studio, event, run)
            studio, more = apply_to_edits(studio, event, run)
            return studio, [*effects, *more]


def _do_command(studio: Studio, command: Command, run: Run, now: Now) -> Change:
    placements = studio.placements
    match command:
        case SelectCamera(kind=kind, name=name):
            if info_of(run, (kind, name)) is None:
                raise Refused(f"There is no {kind} camera {name}.")
            return _select(studio, (kind, name), run)
        case UndoCamera():
            if not placements.done:
                raise Refused("There is nothing to undo.")
            return _send(replace(studio, placements=placements.undo(), problem=""), placements.done[-1].key)
        case RedoCamera():
            if not placements.undone:
                raise Refused("There is nothing to redo.")
            return _send(replace(studio, placements=placements.redo(), problem=""), placements.undone[-1].key)
        case ResetCamera():
            if studio.selected is None:
                raise Refused("Choose a camera first.")
            return _put_back(studio, (studio.selected,), now)
        case PutMovedCamerasBack():
            return _put_back(studio, tuple(placements.placed), now)
        case UsePlacement(number=number):
            return _take_suggestion(studio, number, run, now)
        case ScalePreview(scale=scale):
            return replace(studio, preview_scale=scale, preview=None, previewed=None), []
        case _ if isinstance(command, _OF_REPORTS):
            return do_report(studio, command, run)
        case _:
            return do_edit(studio, command, run)


def _select(studio: Studio, key: CameraKey | None, run: Run) -> Change:
    there = key is None or info_of(run, key) is not None
    return replace(studio, was_chosen=True, selected=key if there else studio.selected), []


def _place(studio: Studio, placed: CameraPlaced, run: Run, now: Now) -> Change:
    key = placed.key
    if why_not := refusal(run, key) or why_no_camera(placed.settings):
        return replace(studio, problem=f"{key[1]} was not moved: {why_not}."), []
    after = studio.placements.place(key, placed.settings, now.monotonic, placed.control, placed.pause)
    return _moved(replace(studio, problem=""), after, key)


def _moved(studio: Studio, placements: Placements, key: CameraKey) -> Change:
    """Replace the placements, and send the placement of this camera if it changed."""
    before, studio = studio.placements.placed, replace(studio, placements=placements)
    return (studio, []) if placements.placed.get(key) == before.get(key) else _send(studio, key)


def _send(studio: Studio, *keys: CameraKey) -> Change:
    """Send the present placements of these cameras to the worker."""
    return studio, [Send(PlaceCamera(key, studio.placements.placed.get(key))) for key in keys]


def _put_back(studio: Studio, keys: tuple[CameraKey, ...], now: Now) -> Change:
    """Place cameras as in the file."""
    effects: list[StudioEffect] = []
    for key in keys:
        if (file := studio.placements.in_file.get(key)) is not None:
            label = f"reset {key[1]} to the file"
            after = studio.placements.place(key, file, now.monotonic, label=label)
            studio, sent = _moved(studio, after, key)
            effects += sent
    return studio, effects


def _take_suggestion(studio: Studio, number: int, run: Run, now: Now) -> Change:
    """Place the camera as in a suggestion."""
    key, suggestions = studio.results.suggestions_of, studio.results.suggestions
    settings = None if key is None else studio.placements.now(key)
    if key is None or settings is None or not 0 <= number < len(suggestions):
        raise Refused("There is no such suggestion.")
    found = suggestions[number].settings
    there = replace(settings, position=found.position, quaternion=found.quaternion)
    return _place(studio, CameraPlaced(key, there), run, now)


def _draw_preview(studio: Studio, run: Run) -> Change:
    """Draw a preview if one is wanted, and if the step or the question differs from that of the last
    preview."""
    key, step = studio.selected, shown_step(run)
    settings = None if key is None else studio.placements.now(key)
    if studio.preview_scale == 1.0 or key is None or settings is None or refusal(run, key):
        return studio, []
    question = DrawCamera(key, settings, run.env, PREVIEW_MODALITIES, scale=studio.preview_scale)
    seen = studio.previewed is not None and studio.previewed[0] is step and studio.previewed[1] == question
    if seen or studio.drawing:
        return studio, []
    studio = replace(studio, previewed=(step, question), preview_problem="", drawing=True)
    return studio, [DrawPreview(replace(question, poses=run.shown_moment().of(run.env)))]


def _loaded(studio: Studio, run: Run, scene_changed: bool) -> Change:
    """Handle a loaded version: update cameras and placements, and compare the version with the edit that was
    written or reverted.

    Args:
        scene_changed: whether more than the cameras changed in this version, so that reports are outdated.
    """
    if run.task is None:
        return studio, []
    studio, own = edit_loaded(studio, run.task)
    in_file = settings_in_file(studio.placements, run)
    placements, dropped = studio.placements.loaded(in_file, own)
    problem = ""
    if dropped:
        names = " and ".join(key[1] for key in dropped)
        one = len(dropped) == 1
        problem = (
            f"{names} {'was' if one else 'were'} changed in the file and now {'follows' if one else 'follow'} "
            "it; Undo restores your placement."
        )
    # Keep the selected camera, or select that of the previous session again; none if the camera is gone.
    selected = studio.selected or studio.select_when_loaded
    if selected is not None and info_of(run, selected) is None:
        selected = None
    studio = replace(
        studio, placements=placements, problem=problem, selected=selected, select_when_loaded=None
    )
    stop: list[StudioEffect] = []
    if scene_changed:
        studio, stop = outdated(studio), [STOP_REPORTS]
    # Send dropped placements too: one may have been in transit to the worker during the load. Send edited
    # cameras too: the reload after a revert may keep the worker's cameras, which would stay where they are.
    to_send = dict.fromkeys((*placements.placed, *dropped, *sorted(own & in_file.keys())))
    studio, sent = _send(studio, *to_send)
    studio, planned = plan_in_copy(studio, run)
    return studio, [*stop, *sent, *planned]


def _placed(studio: Studio, event: Placed) -> Change:
    """Handle the worker's answer to a placement."""
    if not event.why_not:
        return studio, []
    problem = f"{event.key[1]} could not be placed: {event.why_not}."
    studio = replace(studio, problem=problem, placements=studio.placements.refused(event.key))
    return (studio, []) if event.settings is None else _send(studio, event.key)


def _failed(studio: Studio, lane: Lane, why: str) -> Studio:
    match lane:
        case "preview":
            # The last preview stays; the next change redraws it.
            return replace(studio, preview_problem=f"The preview failed: {why}.", drawing=False)
        case "new camera":
            return replace(studio, problem=f"There is no picture of the new camera: {why}.")
        case _:
            problem = f"{why[:1].upper()}{why[1:]}" + ("" if why.endswith(".") else ".")
            return with_results(studio, problem=problem)


class StudioJobs:
    """Runs the jobs of the studio. All methods except `close` are called on the loop.

    A temporary camera (`pictures.temporary_camera`) renders the preview: it has the lens of the env's camera,
    but may be smaller (1280 x 720 takes long without a GPU) or larger (64 x 64 shows little). Resizing the
    env's camera instead would change the observation.
    """

    def __init__(
        self,
        asker: QuestionClient,
        background: Background,
        on_change: Callable[[], None],
        dispatch: Callable[[StudioEvent | FileOpened], object],
    ) -> None:
        """
        Args:
            asker, background: the first asks the worker that plays, the second the background process.
            on_change: called when `progress` has changed.
            dispatch: handles the resulting events.
        """
        self._asker, self._dispatch = asker, dispatch
        self._file, self._reports = FileEdits(asker, dispatch), CameraReports(asker, background, dispatch)
        self._lanes: dict[Lane, Jobs] = {
            lane: Jobs(on_change, lambda failure, lane=lane: dispatch(WorkFailed(lane, str(failure))))
            for lane in get_args(Lane)
        }

    @property
    def progress(self) -> JobProgress | None:
        """Progress of a measurement, search or comparison; None while none of these runs."""
        return self._lanes["background"].progress or self._lanes["live"].progress

    def perform(self, effect: StudioEffect) -> None:
        """Start the effect."""
        reports, lanes = self._reports, self._lanes
        match effect:
            case StopJobs(lanes=names):
                for name in names:
                    lanes[name].stop()
            case StopQuestion():
                self._file.stop_question()
            case DrawPreview():
                lanes["preview"].start("a preview", lambda job: self._draw_preview(effect.question))
            case MeasureLive():
                lanes["live"].start(effect.what, lambda job: reports.measure_live(job, effect))
            case MeasureSeeds():
                lanes["background"].start(effect.what, lambda job: reports.measure_seeds(job, effect))
            case Suggest():
                lanes["background"].start(effect.what, lambda job: reports.suggest(job, effect))
            case Compare(key=(_, name)):
                what = f"comparing two placements of {name}"
                lanes["live"].start(what, lambda job: reports.compare(job, effect))
            case DrawEnvs(key=(_, name)):
                what = f"taking pictures of all envs with {name}"
                lanes["live"].start(what, lambda job: reports.draw_envs(job, effect))
            case Pick():
                lanes["live"].start("probing a pixel", lambda job: reports.pick(job, effect))
            case DrawNewCamera():
                lanes["new camera"].start("a new camera", lambda job: self._file.draw(job, effect))
            case FindPlan() | ChangeFile() | CopyToFolder():
                self._file.begin(effect)

    async def _draw_preview(self, question: DrawCamera) -> None:
        self._dispatch(PreviewDrawn(await self._asker.ask(question)))

    def close(self) -> None:
        """Cancel all jobs, and wait for a running edit. Must not be called on the loop's thread."""
        do(lambda: [lane.close() for lane in self._lanes.values()])
        self._file.close()
