"""The Studio's report on a camera: what it sees over envs, steps or fresh resets; and a sheet with pictures of all envs."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import viser

from workbench.cameras.commands import (
    ChooseMeasured,
    ChooseMeasuredResets,
    ChooseMeasuredSteps,
    DrawSheet,
    MeasureChosenCamera,
    Measured,
    ShowMeasuredMoment,
    UseSuggestedPlane,
)
from workbench.cameras.events import CameraPlaced, MeasureWanted, SheetWanted
from workbench.cameras.job_result import JobResult
from workbench.cameras.view import StudioCamera, StudioView
from workbench.envs.camera_data import Picture
from workbench.live.env_commands import SelectEnv
from workbench.live.events import MomentShown
from workbench.live.session_protocol import LiveSession
from workbench.live.view import SessionView
from workbench.page.command import Command, Refused
from workbench.page.widgets.fields import Field, choice
from workbench.page.widgets.modality_colours import data_address
from workbench.page.widgets.parts import PagePart
from workbench.page.widgets.templates import counted, render
from workbench.page.widgets.tools import tool, tools_html
from workbench.page.widgets.visitors import Visitor
from workbench.pictures.camera_report import (
    DEPTH_EDGES_METRES,
    CameraReport,
    DepthReport,
    ObjectSeen,
    size_text,
)

OVERS: dict[str, Measured] = {
    "all envs now": "envs",
    "this env's episode so far": "steps",
    "fresh resets": "resets",
}
OVER_HINT = (
    "All envs at the shown moment; the selected env's episode, step by step; or freshly reset envs with other seeds, in "
    "another process."
)
STEPS_HINT = (
    "Maximum number of steps to measure, evenly spaced over the episode. Each step takes a few pictures."
)
MAX_PICTURES = 64
"""Maximum number of pictures on the sheet, worst first."""
THUMBNAIL_PIXELS = 128
"""Longer side of a picture on the sheet."""


class CameraReportPanel(PagePart[SessionView]):
    """The Measure folder, in the present container."""

    does = (
        ChooseMeasured,
        ChooseMeasuredSteps,
        ChooseMeasuredResets,
        MeasureChosenCamera,
        DrawSheet,
        ShowMeasuredMoment,
        UseSuggestedPlane,
    )

    def __init__(self, server: viser.ViserServer, session: LiveSession) -> None:
        self._session = session
        self._over: Measured = "envs"
        self._steps, self._resets = 50, 32
        gui = server.gui
        with gui.add_folder("Measure", expand_by_default=False) as self.folder:
            self._overs = choice(server, "Over", ChooseMeasured, "over", OVERS, self._over, hint=OVER_HINT)
            self._most_steps = Field(
                server, "Steps", ChooseMeasuredSteps, "steps", self._steps, hint=STEPS_HINT
            )
            self._fresh = Field(
                server,
                "Resets",
                ChooseMeasuredResets,
                "resets",
                self._resets,
                hint="Number of resets, each with its own seed.",
            )
            gui.add_html(tools_html([tool("Measure this camera", MeasureChosenCamera())]))
            self._report = JobResult(server)
            gui.add_html(tools_html([tool("Pictures of all envs", DrawSheet())]))
            self._pictures = JobResult(server)

    # --- requests ------------------------------------------------------------------------------------

    def do(self, command: Command, visitor: Visitor) -> None:
        studio = self._session.view().of(StudioView)
        match command:
            case ChooseMeasured(over=over):
                self._over = over
            case ChooseMeasuredSteps(steps=steps):
                self._steps = steps
            case ChooseMeasuredResets(resets=resets):
                self._resets = resets
            case MeasureChosenCamera() | DrawSheet() if studio.chosen is None:
                raise Refused("Choose a camera first.")
            case MeasureChosenCamera():
                self._report.asked(studio.results.report)
                most = self._steps if self._over == "steps" else self._resets
                self._session.dispatch(MeasureWanted(self._over, most))
            case DrawSheet():
                self._pictures.asked(studio.results.sheet)
                self._session.dispatch(SheetWanted())
            case ShowMeasuredMoment(number=number):
                self._show_moment(number)
            case UseSuggestedPlane(plane=plane):
                self._use(plane)

    def _show_moment(self, position: int) -> None:
        moments = self._session.view().of(StudioView).results.report_moments
        if 0 <= position < len(moments):
            self._session.dispatch(MomentShown(moments[position].serial, moments[position].env))

    def _use(self, plane: str) -> None:
        studio = self._session.view().of(StudioView)
        camera, report = studio.placeable, studio.results.report
        if camera is None or camera.now is None or report is None or studio.results.report_of != camera.key:
            return
        near = report.depth.suggested_near if plane == "near" else camera.now.near
        far = report.depth.suggested_far if plane == "far" else camera.now.far
        if near is not None and far is not None and near < far:
            self._session.dispatch(CameraPlaced(camera.key, replace(camera.now, near=near, far=far)))

    # --- drawing -------------------------------------------------------------------------------------

    def draw(self, view: SessionView) -> None:
        studio = view.of(StudioView)
        camera = studio.chosen
        self._overs.show(self._over)
        self._most_steps.show(self._steps)
        self._most_steps.visible = self._over == "steps"
        self._fresh.show(self._resets)
        self._fresh.visible = self._over == "resets"
        self._draw_report(studio, camera)
        self._draw_sheet(view, camera)

    def _draw_report(self, studio: StudioView, camera: StudioCamera | None) -> None:
        results = studio.results
        report = results.report if camera is not None and results.report_of == camera.key else None

        def html(new: bool) -> str:
            assert camera is not None and report is not None, "drawn only then"
            return self._report_html(studio, camera, report, new)

        other = studio.report_stale, results.measuring, None if camera is None else camera.now
        self._report.draw(studio.progress, report, other, html)

    def _report_html(self, studio: StudioView, camera: StudioCamera, report: CameraReport, new: bool) -> str:
        """HTML of the object table, the depth histogram and suggested planes. If `new`, the page scrolls it
        into view."""
        results, depth, lens = studio.results, report.depth, camera.now or camera.info
        moments = [
            {
                "words": f"step {moment.step}",
                "press": ShowMeasuredMoment(number=i),
            }
            for i, moment in enumerate(results.report_moments)
        ]
        planes = []
        suggested: tuple[tuple[Literal["near", "far"], float, float | None], ...] = (
            ("near", lens.near, depth.suggested_near),
            ("far", lens.far, depth.suggested_far),
        )
        for name, now, better in suggested:
            fits = better is None or abs(better / now - 1) < 0.02
            planes.append(
                {
                    "name": name,
                    "now": metres(now),
                    "better": "" if fits or better is None else metres(better),
                    "press": None if studio.placeable is None else UseSuggestedPlane(plane=name),
                }
            )
        count = len(report.envs)
        over = counted(count, "fresh reset") if results.report_seeds else f"{counted(count, 'env')} now"
        unit = "envs"
        if moments:
            span = moments[0]["words"] if count == 1 else f"{moments[0]['words']} to {moments[-1]['words']}"
            over, unit = (
                f"{counted(count, 'moment')} of env {report.envs[-1]}'s episode, {span}; click a step to show that moment",
                "steps",
            )
        width, height = report.measured_size
        return render(
            "camera_report",
            stale=studio.report_stale,
            before=results.measuring,
            new=new,
            over=over,
            how=f"{counted(report.pictures, 'picture')} of {width} × {height} in {report.milliseconds / 1000:.1f} s: the whole scene; "
            "the scene without the robot, if the robot is in view; each object alone",
            unit=unit,
            moments=moments,
            headline=headline(report, unit),
            rows=object_rows(report, unit),
            bars=histogram(depth, lens.near, lens.far),
            metres=metres,
            background=percent(float(depth.background.mean())),
            beyond=percent(float(depth.beyond.mean())),
            planes=planes,
        )

    def _draw_sheet(self, view: SessionView, camera: StudioCamera | None) -> None:
        results, env = view.of(StudioView).results, view.selected_env
        sheet = results.sheet
        mine = camera is not None and bool(sheet) and sheet[0].key == camera.key
        report = None if camera is None else results.report_over_envs(camera.key)
        other = report, env
        self._pictures.draw(
            view.of(StudioView).progress,
            sheet if mine else None,
            other,
            lambda new: self._sheet_html(sheet, report, env, new),
        )

    def _sheet_html(
        self, sheet: tuple[Picture, ...], report: CameraReport | None, selected: int, new: bool
    ) -> str:
        places = {} if report is None else {env: i for i, env in enumerate(report.envs)}
        cells = [
            {
                "env": picture.env,
                "words": ""
                if report is None or picture.env not in places
                else env_words(report, places[picture.env]),
                "picture": data_address(picture.rgb, THUMBNAIL_PIXELS),
                "selected": picture.env == selected,
                "press": SelectEnv(env=picture.env),
            }
            for picture in sheet[:MAX_PICTURES]
            if picture.rgb is not None
        ]
        note = ("worst first, " if report is not None else "") + "click a picture to select its env"
        if len(sheet) > MAX_PICTURES:
            note = f"{MAX_PICTURES} of {len(sheet)}; {note}"
        return render("camera_sheet", cells=cells, note=note, new=new)


# --- a report as text, rows and bars: pure functions -------------------------------------------------

# Worst first: an object that is missing in some env's picture comes before one that is only cut, and an env is described by
# its worst object.

MIN_HIDDEN_SHARE = 0.1
"""An object is reported as hidden if more than this share of it is hidden."""
SMALL_PIXELS = 30.0
"""Number of pixels below which `env_words` calls an object small."""


@dataclass(frozen=True)
class Histogram:
    """Bars of equal width over logarithmic depth, with the depth in metres at both ends."""

    bars: tuple[tuple[float, bool], ...]
    """Height of each bar as a share of the highest, and whether the bar lies behind every object."""
    low: float
    high: float
    near: float | None
    """Position of the near plane, in bars from the left; None if the plane is outside of the bars."""
    far: float | None
    """Position of the far plane, as for `near`."""


def percent(share: float) -> str:
    """A share in whole percent; only exactly 0 is shown as 0 % and only exactly 1 as 100 %."""
    if math.isnan(share):
        return "–"
    whole = round(100 * share)
    if share > 0 and whole == 0:
        return "< 1 %"
    if share < 1 and whole == 100:
        return "> 99 %"
    return f"{whole} %"


def metres(value: float) -> str:
    """Text of a length in metres with three digits."""
    return f"{value:.3g} m"


def object_rows(report: CameraReport, unit: str = "envs") -> list[dict[str, Any]]:
    """Table rows: the objects to see, least visible first; then the objects that the task hides. No scenery.

    In a row, ``bad`` names the columns (``seen``, ``cut``, ``hidden``) that the author should check.
    ``tones`` has the visibility in each picture: ``good``, ``warn`` (cut, or much hidden), ``bad`` (not
    visible) or ``none`` (absent).

    Args:
        unit: what the report counts: ``envs`` or ``steps``.
    """
    rows: list[dict[str, Any]] = []
    wanted = report.wanted_objects()
    for thing in sorted(wanted, key=lambda thing: (thing.summary().seen, thing.name)):
        found = thing.summary()
        if not found.present:
            rows.append({"name": thing.name, "note": f"in none of these {unit}", "seen": ""})
            continue
        bad = []
        if found.seen < 1:
            bad.append("seen")
        if found.cut > 0:
            bad.append("cut")
        if found.wholly_hidden > 0 or found.hidden > MIN_HIDDEN_SHARE:
            bad.append("hidden")
        notes = []
        if found.present < len(report.envs):
            notes.append(f"in {found.present} of {len(report.envs)} {unit}")
        if found.covered > MIN_HIDDEN_SHARE:
            notes.append(f"{percent(found.covered)} behind other objects")
        rows.append(
            {
                "name": thing.name,
                "note": ", ".join(notes),
                "seen": percent(found.seen),
                "pixels": f"{found.median_pixels:.0f}",
                "share": size_text(found.median_pixels, report.size),
                "cut": percent(found.cut),
                "hidden": percent(found.hidden),
                "bad": bad,
                "tones": [_mood(thing, i) for i in range(len(report.envs))],
            }
        )
    hides = "the task hides it from this camera"
    return rows + [{"name": t.name, "note": hides, "seen": ""} for t in report.objects if t.never_drawn]


def headline(report: CameraReport, unit: str = "envs") -> str:
    """The worst finding in one sentence; `unit` as in `object_rows`."""
    wanted = [thing for thing in report.wanted_objects() if thing.present.any()]
    if not wanted:
        return f"No object is visible in these {unit}."
    lacking = {thing.name: int((thing.present & (thing.pixels == 0)).sum()) for thing in wanted}
    worst = max(lacking, key=lambda name: lacking[name])
    if lacking[worst]:
        return f"{worst} is not visible in {lacking[worst]} of {len(report.envs)} {unit}."
    cut = {thing.name: int((thing.present & thing.cut).sum()) for thing in wanted}
    worst = max(cut, key=lambda name: cut[name])
    if cut[worst]:
        return f"Everything is visible; {worst} is cut by the border in {cut[worst]} of {len(report.envs)} {unit}."
    return "Everything is visible, and nothing is cut."


def env_words(report: CameraReport, position: int) -> str:
    """The worst finding in one env, in a few words; empty if there is no object to see.

    Args:
        position: index in `CameraReport.envs`.
    """
    found = [thing for thing in report.wanted_objects() if thing.present[position]]
    if not found:
        return ""
    thing = min(found, key=lambda thing: float(thing.marks()[position]))
    hidden = float(thing.hidden_share[position])
    if thing.pixels[position] == 0:
        return f"{thing.name} hidden" if thing.alone[position] > 0 else f"no {thing.name}"
    if hidden > MIN_HIDDEN_SHARE:
        return f"{thing.name} {percent(hidden)} hidden"
    covered = float(thing.covered_share[position])
    if covered > MIN_HIDDEN_SHARE:
        return f"{thing.name} {percent(covered)} behind objects"
    if thing.cut[position]:
        return f"{thing.name} cut"
    pixels = f"{thing.name} {thing.pixels[position]:.0f} px"
    return f"{pixels}, small" if thing.pixels[position] < SMALL_PIXELS else pixels


def histogram(depth: DepthReport, near: float, far: float) -> Histogram | None:
    """The depths of all envs' pictures; None if everything is background.

    Args:
        near, far: the camera's planes, metres.
    """
    counts = depth.counts.sum(axis=0)
    filled = np.flatnonzero(counts)
    if not len(filled):
        return None
    first, last = max(0, int(filled[0]) - 1), min(len(counts), int(filled[-1]) + 2)
    ends = depth.farthest_object[np.isfinite(depth.farthest_object)]
    end = float(ends.max()) if len(ends) else math.inf
    part, middles = counts[first:last], np.sqrt(DEPTH_EDGES_METRES[:-1] * DEPTH_EDGES_METRES[1:])
    bars = tuple(
        (float(count) / float(part.max()), bool(middles[first + i] >= end)) for i, count in enumerate(part)
    )

    def place(plane: float) -> float | None:
        if not DEPTH_EDGES_METRES[first] <= plane <= DEPTH_EDGES_METRES[last]:
            return None
        at = np.interp(math.log(plane), np.log(DEPTH_EDGES_METRES), np.arange(len(DEPTH_EDGES_METRES)))
        return float(at) - first

    return Histogram(
        bars, float(DEPTH_EDGES_METRES[first]), float(DEPTH_EDGES_METRES[last]), place(near), place(far)
    )


def _mood(thing: ObjectSeen, position: int) -> str:
    if not thing.present[position]:
        return "none"
    if thing.pixels[position] == 0:
        return "bad"
    hindered = max(float(thing.hidden_share[position]), float(thing.covered_share[position]))
    return "warn" if thing.cut[position] or hindered > 0.5 else "good"
