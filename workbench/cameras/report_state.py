"""The part of the studio's state about reports, comparisons and suggestions of cameras."""

from __future__ import annotations

from dataclasses import replace

from workbench.cameras.commands import MAX_MEASURED, PickPixel, StopMeasuring
from workbench.cameras.events import (
    Case,
    Compare,
    ComparisonWanted,
    DrawEnvs,
    MeasureLive,
    MeasureSeeds,
    MeasureWanted,
    Measuring,
    Pick,
    PicturesCompared,
    PixelPicked,
    ReportMade,
    SheetPictureDrawn,
    SheetWanted,
    StopJobs,
    Suggest,
    SuggestionsFound,
    SuggestionsWanted,
)
from workbench.cameras.questions import MeasureCamera
from workbench.cameras.state import Change, Studio, selected_camera
from workbench.cameras.view import MeasuredMoment
from workbench.envs.camera_data import CameraSettings, why_no_camera
from workbench.live.run import Run
from workbench.page.command import Command, Refused
from workbench.pictures.camera_report import SearchSpace

_REPORT_STEPS = 8
"""Number of steps between two partial reports."""
STOP_REPORTS = StopJobs(("live", "background"))


def with_results(studio: Studio, **values: object) -> Studio:
    """Change results, and clear the last failure."""
    return replace(studio, results=replace(studio.results, **{"problem": "", **values}))  # type: ignore[arg-type]


def outdated(studio: Studio) -> Studio:
    """Mark the report as outdated, and drop the compared pictures, the picked pixel and the sheet."""
    results = replace(studio.results, outdated=True, compared=None, picked=None, sheet=())
    return replace(studio, results=results)


def apply_to_reports(studio: Studio, event: object, run: Run) -> Change:
    """The studio after an event about reports. The worker that plays measures the shown moment and earlier
    steps, one env at a time, and continues playing in between. The background process measures fresh
    episodes."""
    match event:
        case MeasureWanted():
            return _measure(replace(studio, problem=""), event, run)
        case SuggestionsWanted():
            return _suggest(replace(studio, problem=""), event, run)
        case ComparisonWanted():
            return _compare(replace(studio, problem=""), event.other, run)
        case SheetWanted():
            return _draw_sheet(replace(studio, problem=""), run)
        case ReportMade():
            return with_results(
                studio,
                report=event.report,
                report_of=event.of,
                report_settings=event.settings,
                report_seeds=event.seeds,
                report_moments=event.moments,
                outdated=False,
                measuring=False,
            ), []
        case Measuring(on=on):
            return with_results(studio, measuring=on), []
        case SuggestionsFound(found=found, objects=objects):
            names = " and ".join(objects)
            problem = (
                "" if found else f"No placement in the search box sees {names} in any env: enlarge the box."
            )
            return with_results(studio, suggestions=found, problem=problem), []
        case PicturesCompared():
            return with_results(studio, compared=(event.now, event.other)), []
        case SheetPictureDrawn(picture=picture):
            return with_results(studio, sheet=(*studio.results.sheet, picture)), []
        case PixelPicked(picked=picked):
            return with_results(studio, picked=picked), []
    return studio, []


def do_report(studio: Studio, command: Command, run: Run) -> Change:
    """Carry out a command about reports."""
    match command:
        case StopMeasuring():
            return studio, [STOP_REPORTS]
        case PickPixel(x=u, y=v):
            camera = selected_camera(studio, run)
            if camera is None or run.task is None:
                raise Refused("Choose a camera first.")
            pick = Pick(camera.info, u, v, run.shown_moment(), run.task.segmentation)
            return replace(studio, problem=""), [pick]
        case _:
            raise AssertionError(f"{command} is not in DOES")


def _measure(studio: Studio, wanted: MeasureWanted, run: Run) -> Change:
    camera, load = selected_camera(studio, run), run.running_load()
    if camera is None or load is None:
        return studio, []
    most = min(max(1, wanted.most), MAX_MEASURED)
    what, question = f"measuring {camera.key[1]}", MeasureCamera(camera.key, None, 0)
    if wanted.over == "resets":
        question = replace(question, settings=camera.now if camera.moved else None)
        what = f"{what} over {most} seeds"
        return studio, [MeasureSeeds(what, question, camera.now, load, most)]
    if wanted.over == "envs":
        moment = run.shown_moment()
        cases: tuple[Case, ...] = tuple((env, moment.of(env), None) for env in range(moment.num_envs))
        what = f"{what} in all envs"
        return studio, [MeasureLive(what, question, camera.now, cases, len(cases))]
    cases = tuple(
        (env, step.poses[env], MeasuredMoment(moment.serial, env, int(step.elapsed_steps[env])))
        for moment, env in run.episode_moments(most)
        for step in [moment.step]
    )
    if not cases:
        return studio, []
    what = f"{what} over {len(cases)} steps"
    return studio, [MeasureLive(what, question, camera.now, cases, _REPORT_STEPS)]


def _suggest(studio: Studio, wanted: SuggestionsWanted, run: Run) -> Change:
    camera, load = selected_camera(studio, run), run.running_load()
    if camera is not None and camera.now is None:
        return replace(studio, problem=f"{camera.key[1]} cannot be placed: {camera.refused}."), []
    if camera is None or camera.now is None or load is None:
        return studio, []
    key = camera.key
    space = SearchSpace(wanted.objects, wanted.low, wanted.high, camera.now, key[0], mount=camera.info.mount)
    studio = with_results(studio, suggestions=(), suggestions_of=key)
    return studio, [Suggest(f"searching for placements of {key[1]}", space, load, wanted.seeds)]


def _compare(studio: Studio, other: CameraSettings, run: Run) -> Change:
    camera = selected_camera(studio, run)
    if camera is None:
        return studio, []
    if why_not := camera.refused or why_no_camera(other):
        return replace(studio, problem=f"{camera.key[1]} cannot be compared: {why_not}."), []
    return studio, [Compare(camera.key, other, run.shown_moment())]


def _draw_sheet(studio: Studio, run: Run) -> Change:
    camera = selected_camera(studio, run)
    if camera is None:
        return studio, []
    moment, report = run.shown_moment(), studio.results.report_over_envs(camera.key)
    order = tuple(range(moment.num_envs))
    if report is not None:
        measured = tuple(report.envs[i] for i in report.worst_first())
        order = measured if sorted(measured) == list(order) else order
    return with_results(studio, sheet=()), [DrawEnvs(camera.key, order, moment)]
