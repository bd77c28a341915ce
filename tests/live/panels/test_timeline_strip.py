from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from tests.drive.scenes import running
from workbench.live.history.moments import FAIL, RESET, REWARD_NONFINITE, SUCCESS, TRUNCATED, WENT_BACK
from workbench.live.panels.timeline_panel import LINE_HEIGHT as HEIGHT
from workbench.live.panels.timeline_panel import MAX_MARKS, STRIP_POINTS, reward_lines, strip_html
from workbench.live.past import Strip, TimelineView


def strip(**changes: object) -> Strip:
    values: dict[str, object] = {
        "low": 100,
        "high": 200,
        "events": ((100, RESET), (150, SUCCESS | TRUNCATED), (160, RESET), (180, WENT_BACK)),
        "values": np.linspace(0, 1, 101, dtype=np.float32),
        "branches": ((180, 120),),
        "segments": ((100, 159, False, "success"), (160, 179, False, ""), (180, 200, True, "")),
    }
    return Strip(**{**values, **changes})  # type: ignore[arg-type]


def past(shown: int | None = None) -> TimelineView:
    at = 200 if shown is None else shown
    return TimelineView(
        130, 230, None if shown is None else shown + 30, 100, at, 200, 3 * 1024**2, 256 * 1024**2, 101, True
    )


def marks(html: str) -> list[tuple[float, str, str]]:
    """Per cent from the left, style and text of each mark."""
    found = re.findall(
        r'class="wb-mark wb-mark-(\w+)" style="left:([\d.]+)%" data-do="[^"]*" title="([^"]*)"', html
    )
    return [(float(place), style, words) for style, place, words in found]


def cursor(html: str) -> float:
    return float(re.findall(r'<line x1="([\d.]+)" x2="\1" [^>]*wb-cursor', html)[0])


def test_marks_are_at_their_steps_and_name_the_most_important_event() -> None:
    html, legend = strip_html(strip(), running(4, timeline=past()))
    assert marks(html) == [
        (0.0, "reset", "reset, 100 steps ago"),
        (50.0, "success", "success, 50 steps ago"),
        (60.0, "reset", "reset, 40 steps ago"),
        (80.0, "back", "went back 60 steps, 20 steps ago"),
    ]
    assert re.findall(r'<path d="([^"]*)"', html) == ["M 20.0 0 Q 50.0 -26 80.0 0"]
    assert ">live<" in html and cursor(html) == 100.0
    found = re.findall(r'wb-key wb-mark-(\w+)"></i>([^<]*)<', legend)
    assert found == [("success", "success"), ("back", "went back"), ("reset", "reset")]


def test_a_band_is_a_stretch_without_a_jump() -> None:
    html, _ = strip_html(strip(), running(4, timeline=past()))
    bands = re.findall(r'<rect x="([\d.]+)" y="-14" width="([\d.]+)" height="46" class="([^"]*)"', html)
    assert bands == [
        ("0.0", "58.8", "wb-band wb-ended-success"),
        ("60.0", "18.8", "wb-band wb-odd"),
        ("80.0", "19.8", "wb-band wb-branch"),
    ]


def test_a_branch_from_a_recording_or_from_before_the_strip_is_shown() -> None:
    html, _ = strip_html(strip(branches=()), running(4, timeline=past()))
    assert marks(html)[-1] == (80.0, "back", "from a recording, 20 steps ago") and "<path" not in html
    html, _ = strip_html(strip(low=150, branches=((180, 120),)), running(4, timeline=past()))
    assert re.findall(r'<path d="([^"]*)"', html) == ["M 0.0 0 Q 30.0 -26 60.0 0"]


@pytest.mark.parametrize("count", [2, STRIP_POINTS, STRIP_POINTS + 1, 15_000])
def test_a_one_step_spike_stays_in_the_line(count: int) -> None:
    reward = np.zeros(count, np.float32)
    reward[count // 3] = 5.0
    (line,) = reward_lines(reward)
    points = [tuple(map(float, point.split(","))) for point in line.split()]
    assert len(points) <= STRIP_POINTS
    assert min(y for _, y in points) == 0.0 and max(y for _, y in points) == HEIGHT == 30.0
    assert all(0 <= x <= 100 for x, _ in points)


def test_a_missing_reward_is_a_gap_and_a_constant_one_a_straight_line() -> None:
    assert reward_lines(np.full(10, np.nan, np.float32)) == []
    for constant in (
        np.ones(10, np.float32),
        np.tile(np.nextafter(np.float32(0.4), np.array([0, 1], np.float32)), 5),
    ):
        (line,) = reward_lines(constant)
        assert {point.split(",")[1] for point in line.split()} == {f"{HEIGHT / 2:.1f}"}
    lines = reward_lines(np.array([np.nan, 1, 2, np.nan, 0], np.float32))
    assert [[point.split(",")[0] for point in line.split()] for line in lines] == [
        ["25.00", "50.00"],
        ["100.00", "100.00"],
    ]
    many = np.tile(np.array([np.nan, 1, 2], np.float32), 1000)
    assert len(reward_lines(many)) == 1, "narrower than a pixel"
    html, _ = strip_html(strip(values=many[:101]), running(4, timeline=past()))
    assert "nan" not in html and html.count("<polyline") > 1
    view = running(4, timeline=past())
    assert view.task is not None
    without = replace(view, task=replace(view.task, reward_mode="none"))
    assert "<polyline" not in strip_html(strip(values=np.zeros(101, np.float32)), without)[0]


def test_of_many_events_each_part_of_the_strip_shows_the_worst() -> None:
    ends = ((tick, (FAIL if tick % 1000 == 0 else TRUNCATED) | RESET) for tick in range(0, 100_000, 50))
    html, _ = strip_html(
        strip(low=0, high=100_000, events=tuple(ends), branches=()), running(4, timeline=past())
    )
    drawn = marks(html)
    assert len(drawn) == MAX_MARKS and min(drawn)[0] == 0.0 and max(drawn)[0] > 99
    assert sum(style == "fail" for _, style, _ in drawn) == 100
    both, _ = strip_html(strip(events=((190, REWARD_NONFINITE | RESET),)), running(4, timeline=past()))
    assert marks(both) == [(90.0, "odd", "reward is NaN or infinite, 10 steps ago")]


def test_an_event_that_lasts_several_steps_has_one_mark() -> None:
    late = (
        (150, TRUNCATED),
        (151, TRUNCATED),
        (152, TRUNCATED),
        (153, TRUNCATED | SUCCESS),
        (160, TRUNCATED),
    )
    html, _ = strip_html(strip(events=late), running(4, timeline=past()))
    assert [(place, style) for place, style, _ in marks(html)] == [
        (50.0, "limit"),
        (53.0, "success"),
        (60.0, "limit"),
    ]
    resets, _ = strip_html(strip(events=((150, RESET), (151, RESET))), running(4, timeline=past()))
    assert [place for place, _, _ in marks(resets)] == [50.0, 51.0]
    constant, _ = strip_html(strip(values=np.full(101, 0.5, np.float32)), running(4, timeline=past()))
    assert constant.count(">0.5<") == 1
