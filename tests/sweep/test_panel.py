"""The Sweep tab's HTML and commands, on real files without a browser."""

from __future__ import annotations

import html
import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pyarrow.parquet as pq
import pytest
import viser

from tests.drive.episodes import made
from tests.drive.panels import Panels
from tests.drive.waiting import until
from tests.episodes.sweep_files import sweep_folder
from workbench.episodes.sweep_results import RESULTS, SweepEpisode, SweepResults, write_results
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
from workbench.sweep.panel import SweepPanel, best_first


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
def tab(child_process: None, server: viser.ViserServer, folder: Path) -> Iterator[Tab]:
    tab = Tab(server, folder)
    yield tab
    tab.library.close()


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
    assert "robot_uids = fetch" in tab.panels.html("wb-sweep-point"), (
        "the chosen point must be one of the listed ones"
    )
    tab.ask(FilterSweep(name="robot_uids", value='"panda"'))
    assert len(tab.points()) == 6
    tab.ask(ClearSweepFilter())
    assert len(tab.points()) == 9
    assert "robot_uids = panda" in tab.panels.html("wb-sweep-point"), "the earlier point is shown again"


def test_sorting_and_filtering_return_to_the_first_page(
    child_process: None,
    server: viser.ViserServer,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sweep, "PAGE_ROWS", 2)
    tab = Tab(server, folder)
    for command in (
        SortSweep(column="set reach_weight"),
        FilterSweep(name="robot_uids", value='"fetch"'),
        ClearSweepFilter(),
    ):
        tab.ask(TurnSweep(by=1))
        assert "3 to" in tab.panels.html("wb-sweep-scroll")
        tab.ask(command)
        assert "1 to 2 of" in tab.panels.html("wb-sweep-scroll"), command
    tab.library.close()


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


def test_hostile_results_are_escaped_and_open_nothing(
    child_process: None, server: viser.ViserServer, folder: Path
) -> None:
    write_results(folder / RESULTS, HOSTILE)
    table = pq.read_table(folder / RESULTS)
    about = json.loads(table.schema.metadata[b"workbench.sweep"]) | {"points": HOSTILE_POINTS}
    table = table.replace_schema_metadata({b"workbench.sweep": json.dumps(about).encode()})
    pq.write_table(table, folder / RESULTS)
    tab = Tab(server, folder)
    shown = "".join(handle.content for handle in tab.panels.htmls())
    assert "<img src=x" not in shown and "\u202e" not in shown and html.escape("<img src=x") in shown
    assert max(map(len, re.findall(r"\S+", shown))) < 1000
    assert "inf" not in tab.panels.html("wb-parallel").lower() and "nan" not in tab.panels.html("wb-parallel")
    assert "Its recording is not in this folder" in tab.panels.html("wb-sweep-episodes")
    assert name_of(OpenSweepEpisode) not in tab.panels.html("wb-sweep-episodes")
    tab.library.close()


@pytest.mark.parametrize("content", [b"", b"PAR1 nonsense PAR1"])
def test_an_unreadable_results_file_is_reported(
    child_process: None, server: viser.ViserServer, folder: Path, content: bytes
) -> None:
    (folder / RESULTS).write_bytes(content)
    tab = Tab(server, folder)
    assert (
        "results.parquet cannot be read" in tab.panels.html("wb-note")
        and tab.panels.html("wb-parallel") == ""
    )
    tab.library.close()


def test_a_link_to_results_elsewhere_is_not_followed(
    child_process: None,
    server: viser.ViserServer,
    folder: Path,
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    elsewhere = tmp_path_factory.mktemp("elsewhere") / "secret.parquet"
    (folder / RESULTS).rename(elsewhere)
    (folder / RESULTS).symlink_to(elsewhere)
    tab = Tab(server, folder)
    assert tab.points() == [] and "denied" in tab.panels.html("wb-note").lower()
    tab.library.close()


def test_earlier_success_ranks_first_then_higher_return() -> None:
    rows = [
        SweepEpisode(0, 0, False, False, None, 9, 5.0),
        SweepEpisode(0, 1, True, False, 7, 9, 1.0),
        SweepEpisode(0, 2, True, True, 3, 9, 1.0),
        SweepEpisode(0, 3, True, True, 7, 9, 2.0),
        SweepEpisode(0, 4, failure="no"),
    ]
    assert [row.seed for row in best_first(rows)] == [2, 3, 1, 0]
