"""The Sweep tab's HTML and commands, on real files without a browser."""

from __future__ import annotations

import html
import json
import re
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import pyarrow.parquet as pq
import pytest
import viser

from tests.drive.episodes import made
from tests.drive.panels import Panels
from tests.drive.waiting import until
from tests.episodes.sweep_files import sweep_folder
from workbench.episodes.sweep_results import (
    RESULTS,
    PointSummary,
    SweepEpisode,
    SweepResults,
    write_results,
)
from workbench.library.folder import Library
from workbench.page.command import Command, name_of
from workbench.review.commands import (
    ClearSweepFilter,
    FilterSweep,
    OpenSweepEpisode,
    ShowSweepPoint,
    SortSweep,
    TurnSweep,
)
from workbench.review.view import Opened, ReviewView
from workbench.sweep import panel as sweep
from workbench.sweep.panel import BOTTOM, MAX_AXES, TOP, WIDTH, Shown, SweepPanel, apply, axes_of, best_first


class Tab:
    """The Sweep tab on a page, with helpers to send commands."""

    def __init__(self, server: viser.ViserServer, folder: Path) -> None:
        self.library = Library(folder)
        self.library.refresh()
        self.opened: list[tuple[str, ...]] = []
        self.panel = SweepPanel(server, self.library, self.opened.append)
        self.panels = Panels(server)
        self.panels.visitors.do = self.panel.do
        self.view = ReviewView()
        until(lambda: self.draw() or "Reading" not in self.panels.html("wb-note"), "the results")

    def draw(self) -> None:
        self.panel.key(self.view)
        self.panel.draw(self.view)

    def ask(self, command: Command) -> None:
        self.panels.ask(command)
        self.draw()

    def points(self) -> list[str]:
        """Return the first two cells of each row of the table."""
        rows = re.findall(r"<tr data-do.*?</tr>", self.panels.html("wb-sweep-scroll"), re.DOTALL)
        return [" ".join(re.findall(r"<td[^>]*>(.*?)</td>", row)[:2]) for row in rows]

    def seeds(self) -> list[str]:
        return re.findall(r"seed (\d+)</td>", self.panels.html("wb-sweep-episodes"))


def opened(id: str) -> Opened:
    return Opened(id, f"{id}.rrd", made(), ())


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    sweep_folder(tmp_path)
    return tmp_path


@pytest.fixture
def open_tab(child_process: None, server: viser.ViserServer, folder: Path) -> Iterator[Callable[[], Tab]]:
    """Opens the tab on the folder as it is then."""
    with ExitStack() as closed:

        def open_() -> Tab:
            tab = Tab(server, folder)
            closed.callback(tab.library.close)
            return tab

        yield open_


@pytest.fixture
def tab(open_tab: Callable[[], Tab]) -> Tab:
    return open_tab()


def test_points_are_listed_best_first_and_can_be_sorted_by_any_column(tab: Tab) -> None:
    best = ["2 panda", "2 fetch", "1 panda", "1 fetch", "0.5 panda", "0.5 fetch"]
    assert tab.points()[:6] == best and len(tab.points()) == 9
    assert "36 seeds failed" in tab.panels.html("wb-note")
    tab.ask(SortSweep(column="set reach_weight"))
    assert [one.split()[0] for one in tab.points()] == ["0.5"] * 3 + ["1"] * 3 + ["2"] * 3
    tab.ask(SortSweep(column="set reach_weight"))
    assert tab.points()[0].startswith("2")
    tab.ask(SortSweep(column="mean reward_terms/reach"))
    assert tab.points()[0] == "0.5 panda"


def test_a_points_best_and_worst_episodes_can_be_opened(tab: Tab) -> None:
    assert tab.seeds() == ["0", "1", "2", "3", "4", "11", "10", "9", "8", "7"]
    tab.ask(OpenSweepEpisode(id="p6s11"))
    assert tab.opened == [("p6s11",)]
    tab.ask(ShowSweepPoint(index=8))
    assert tab.seeds() == [] and "12 seeds failed: push.py:12: KeyError" in tab.panels.html(
        "wb-sweep-episodes"
    )


def test_a_value_of_an_axis_filters_the_points(tab: Tab) -> None:
    tab.ask(FilterSweep(name="robot_uids", value='"fetch"'))
    assert tab.points() == ["2 fetch", "1 fetch", "0.5 fetch"]
    assert tab.panels.html("wb-parallel").count("wb-left-out") == 6
    assert tab.panels.html("wb-parallel").count("wb-to-press") == 3, "only the points that are listed"
    assert "robot_uids = fetch" in tab.panels.html("wb-sweep-point"), (
        "the chosen point must be one of the listed ones"
    )
    tab.ask(FilterSweep(name="robot_uids", value='"panda"'))
    assert len(tab.points()) == 6
    tab.ask(ClearSweepFilter())
    assert len(tab.points()) == 9
    assert "robot_uids = panda" in tab.panels.html("wb-sweep-point"), "the earlier point is shown again"


def test_sorting_and_filtering_return_to_the_first_page(
    open_tab: Callable[[], Tab], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sweep, "PAGE_ROWS", 2)
    tab = open_tab()
    for command in (
        SortSweep(column="set reach_weight"),
        FilterSweep(name="robot_uids", value='"fetch"'),
        ClearSweepFilter(),
    ):
        tab.ask(TurnSweep(by=1))
        assert "3 to" in tab.panels.html("wb-sweep-scroll")
        tab.ask(command)
        assert "1 to 2 of" in tab.panels.html("wb-sweep-scroll"), command


def test_the_open_episodes_point_is_shown_until_another_is_chosen(tab: Tab) -> None:
    place = "wb-sweep-point"
    assert "reach_weight = 2, robot_uids = panda" in tab.panels.html(place)
    tab.view = ReviewView(opened=(opened("p0s03"),))
    tab.draw()
    assert "reach_weight = 0.5, robot_uids = panda" in tab.panels.html(place)
    tab.ask(ShowSweepPoint(index=1))
    assert "reach_weight = 0.5, robot_uids = fetch" in tab.panels.html(place)
    tab.view = ReviewView(opened=(opened("p6s11"),))
    tab.draw()
    assert "reach_weight = 0.5, robot_uids = fetch" in tab.panels.html(place)


def test_new_results_are_shown_automatically(tab: Tab, folder: Path) -> None:
    results = sweep_folder(folder)
    write_results(folder / RESULTS, replace(results, actions="zero"))
    tab.library.refresh()
    until(lambda: tab.draw() or "zero" in tab.panels.html("wb-note"), "the new results")


MARKUP = '<img src=x onerror="alert(1)">\u202e</td>'
HOSTILE_POINTS = [{MARKUP: MARKUP, "b": "[" * 150}, {MARKUP: "1e999", "b": '"' + "x" * 5000 + '"'}]
HOSTILE = SweepResults(
    MARKUP,
    MARKUP,
    2,
    ({"a": "1"}, {"a": "2"}),
    (
        SweepEpisode(0, 0, True, True, 2**31 - 1, 2**31 - 1, 1e308, {MARKUP: 1e308}, "../../etc/passwd.rrd"),
        SweepEpisode(0, 1, False, False, -5, -5, -1e308, {MARKUP: -1e308}, "0/p0s00.rrd/../p0s01.rrd"),
        SweepEpisode(1, 2**62, failure=MARKUP * 500),
    ),
)


def test_hostile_results_are_escaped_and_open_nothing(open_tab: Callable[[], Tab], folder: Path) -> None:
    write_results(folder / RESULTS, HOSTILE)
    table = pq.read_table(folder / RESULTS)
    about = json.loads(table.schema.metadata[b"workbench.sweep"]) | {"points": HOSTILE_POINTS}
    table = table.replace_schema_metadata({b"workbench.sweep": json.dumps(about).encode()})
    pq.write_table(table, folder / RESULTS)
    tab = open_tab()
    shown = "".join(handle.content for handle in tab.panels.htmls())
    assert "<img src=x" not in shown and "\u202e" not in shown and html.escape("<img src=x") in shown
    assert max(map(len, re.findall(r"\S+", shown))) < 1000
    assert "inf" not in tab.panels.html("wb-parallel").lower() and "nan" not in tab.panels.html("wb-parallel")
    assert "Its recording is not in this folder" in tab.panels.html("wb-sweep-episodes")
    assert name_of(OpenSweepEpisode) not in tab.panels.html("wb-sweep-episodes")


@pytest.mark.parametrize("content", [b"", b"PAR1 nonsense PAR1"])
def test_an_unreadable_results_file_is_reported(
    open_tab: Callable[[], Tab], folder: Path, content: bytes
) -> None:
    (folder / RESULTS).write_bytes(content)
    tab = open_tab()
    assert (
        "results.parquet cannot be read" in tab.panels.html("wb-note")
        and tab.panels.html("wb-parallel") == ""
    )


def test_a_link_to_results_elsewhere_is_not_followed(
    open_tab: Callable[[], Tab], folder: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    elsewhere = tmp_path_factory.mktemp("elsewhere") / "secret.parquet"
    (folder / RESULTS).rename(elsewhere)
    (folder / RESULTS).symlink_to(elsewhere)
    tab = open_tab()
    assert tab.points() == [] and "denied" in tab.panels.html("wb-note").lower()


def test_earlier_success_ranks_first_then_higher_return() -> None:
    rows = [
        SweepEpisode(0, 0, False, False, None, 9, 5.0),
        SweepEpisode(0, 1, True, False, 7, 9, 1.0),
        SweepEpisode(0, 2, True, True, 3, 9, 1.0),
        SweepEpisode(0, 3, True, True, 7, 9, 2.0),
        SweepEpisode(0, 4, failure="no"),
    ]
    assert [row.seed for row in best_first(rows)] == [2, 3, 1, 0]


# --- axes and choices --------------------------------------------------------------------------------


def summary(index: int, total: float | None, solved: int | None = None, **values: object) -> PointSummary:
    means = {} if total is None else {"reward_terms/reach": 10 * total, "height": 1.0}
    texts = {name: json.dumps(value) for name, value in values.items()}
    return PointSummary(index, texts, 0 if total is None else 4, solved, solved, total, means, 0, "")


def axes(*points: PointSummary) -> dict[str, list[float | None]]:
    """Height of each point on each axis, as a share from the bottom."""
    results = SweepResults("push.py", "zero", 4, tuple(dict(one.values) for one in points), ())
    places = [axis.x for axis in axes_of(results, points)]
    assert places == sorted(set(places)) and 0 < places[0] and places[-1] < WIDTH
    return {
        axis.name: [None if y is None else round((BOTTOM - y) / (BOTTOM - TOP), 3) for y in axis.heights]
        for axis in axes_of(results, points)
    }


def ticks(name: str, *points: PointSummary) -> list[str]:
    results = SweepResults("push.py", "zero", 4, tuple(dict(one.values) for one in points), ())
    (axis,) = (axis for axis in axes_of(results, points) if axis.name == name)
    assert [y for _, y, _ in axis.ticks] == sorted((y for _, y, _ in axis.ticks), reverse=True)
    return [label for label, _, _ in axis.ticks]


def test_each_point_is_drawn_at_its_values_and_results() -> None:
    points = [
        summary(0, 8.0, 1, weight=10, robot="panda"),
        summary(1, 2.0, 4, weight=9, robot="fetch"),
        summary(2, None, weight=100, robot="panda"),
    ]
    assert axes(*points) == {
        "weight": [0.5, 0.0, 1.0],  # by size, not by text
        "robot": [1.0, 0.0, 1.0],
        "success": [0.25, 1.0, None],
        "return": [1.0, 0.0, None],
        "reach": [1.0, 0.0, None],
    }
    assert ticks("weight", *points) == ["9", "10", "100"] and ticks("robot", *points) == ["fetch", "panda"]
    assert ticks("success", *points) == ["0 %", "100 %"] and ticks("return", *points) == ["2", "8"]
    assert ticks("reach", *points) == ["20", "80"]
    mixed = [summary(0, 1.0, a="x"), summary(1, 1.0, a=3)]
    assert axes(*mixed) == {"a": [1.0, 0.0], "return": [0.5, 0.5], "reach": [0.5, 0.5]}
    assert ticks("a", *mixed) == ["3", "x"], "numbers first" and ticks("return", *mixed) == ["1"]


def test_many_values_and_terms_leave_room_for_what_was_set() -> None:
    many = [summary(k, float(k), a=k) for k in range(20)]
    assert ticks("a", *many) == ["0", "3", "5", "8", "11", "14", "16", "19"]
    terms = {f"reward_terms/{k}": 1.0 for k in range(20)}
    assert len(axes(*(replace(one, means=terms) for one in many))) == MAX_AXES
    set_names = {f"s{k}": 1 for k in range(12)}
    assert list(axes(summary(0, 1.0, 1, **set_names))) == [*set_names, "success", "return"]
    named = replace(summary(0, 1.0, a=1), means={"success": 5.0})
    assert ticks("success", named, replace(named, index=1, means={"success": 9.0})) == ["5", "9"], (
        "not a rate"
    )


def test_a_press_changes_the_choice_that_it_is_about() -> None:
    points = [summary(k, float(k), a=k % 3, b=k % 2) for k in range(30)]
    first = Shown()
    by_a = apply(first, SortSweep(column="set a"), points)
    assert (by_a.column, by_a.descending) == ("set a", False)
    assert apply(by_a, SortSweep(column="set a"), points).descending
    assert apply(by_a, SortSweep(column="return"), points).descending, "the best first"
    only = first
    for name, value, kept in (("a", "1", 10), ("a", "2", 20), ("b", "0", 10), ("a", "1", 5)):
        only = apply(only, FilterSweep(name=name, value=value), points)
        assert sum(map(only.keeps, points)) == kept
    turned = apply(only, TurnSweep(by=1), points)
    assert turned.pages.places(5).start == 0, "five points are one page"
    assert apply(first, TurnSweep(by=1), points).pages.places(30).start == 12
    assert all(map(apply(only, ClearSweepFilter(), points).keeps, points))
    assert apply(first, ShowSweepPoint(index=7), points).chosen == 7


def test_a_row_has_the_results_of_its_point_and_each_column_sorts_by_its_own(tab: Tab) -> None:
    def rows() -> list[list[str]]:
        table = re.findall(r"<tr data-do.*?</tr>", tab.panels.html("wb-sweep-scroll"), re.DOTALL)
        return [[re.sub("<[^>]*>", "", cell) for cell in re.findall(r"<td.*?</td>", row)] for row in table]

    assert rows()[0] == ["2", "panda", "83 % (55 - 95)", "83 %", "29", "0.275", "2", "12"]
    assert rows()[-1] == ["2", "nix", "12 failed", "", "", "", "", "0"]
    for column, at in (("success", 2), ("at the end", 3), ("return", 4), ("mean reward_terms/push", 6)):
        tab.ask(SortSweep(column=column))
        if rows()[0][1] == "nix":
            tab.ask(SortSweep(column=column))
        numbers = [float(row[at].split()[0]) for row in rows() if row[1] != "nix"]
        assert len(numbers) == 6 and numbers == sorted(numbers, reverse=True), column
    tab.ask(SortSweep(column="episodes"))
    assert [row[-1] for row in rows()] == ["12"] * 6 + ["0"] * 3
    html = tab.panels.html("wb-parallel")
    assert html.count("wb-failed") == 3 and html.count(' wb-chosen"') == 1
    (chosen,) = re.findall(r'<polyline points="[^"]*" class="wb-point wb-chosen" style="--part:(\d+)%', html)
    assert chosen == "83"


def test_the_open_episode_is_marked(tab: Tab) -> None:
    tab.view = ReviewView(opened=(opened("p6s03"),))
    tab.draw()
    marked = re.findall(r'<tr[^>]*class="wb-chosen">.*?</tr>', tab.panels.html("wb-sweep-episodes"))
    assert len(marked) == 1 and "seed 3<" in marked[0] and "solved at 13" in marked[0] and ">34<" in marked[0]
    key = tab.panel.key(tab.view)
    assert tab.panel.key(ReviewView()) != key
    tab.ask(ShowSweepPoint(index=1))
    assert tab.panel.key(tab.view) != key
