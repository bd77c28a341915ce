from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from tests.drive.panels import Panels
from tests.ui.scenes import EMPTY, problem, running
from workbench.ui.live.banners import DOING, FILL, REBUILD, Banner, banner_html

RESTART = "Restart the worker"
EVIL = "<img src=x onerror=alert(1)><script>alert(2)</script>\"'&"


def test_first_says_what_failed_and_where() -> None:
    html = banner_html(problem(), running(2))
    title, rest = html.split("</div>", 1)
    assert "PushEnv" in title and "failed in evaluate" in title and "push.py:88" in title
    assert "KeyError" in rest and "return goal[&lt;0&gt;]" in rest


def test_says_what_runs_now_while_an_open_traceback_stays(panels: Panels) -> None:
    banner = Banner(panels.server, lambda: None, lambda: None, lambda: None)
    refused = running(2, problem=problem(), problem_serial=1, stale=True)
    failed = replace(refused, state="paused", playing=False, stale=False, problem_at_run=True)
    said = []
    for view in (
        refused,
        replace(refused, state="starting", playing=False),
        replace(refused, state="paused", playing=False),
        failed,
        replace(failed, spoiled="torch.get_default_dtype() changed"),
        replace(failed, problem=replace(problem(), stage="policy")),
    ):
        banner.draw(view)
        said.append(panels.htmls()[1].content)
    assert len({*said}) == len(said)
    assert "running" in said[0] and not any("running" in words for words in said[1:])
    assert "paused at env 0: step" in said[3] and "torch.get_default_dtype()" in said[4]


def test_everything_of_the_author_s_is_escaped() -> None:
    evil = replace(problem(EVIL), file=f"/tmp/{EVIL}.py", code=EVIL, traceback=EVIL, stage=EVIL)
    html = banner_html(evil, EMPTY)
    assert "<script" not in html and "<img" not in html


@pytest.mark.parametrize("stage", list(DOING))
def test_every_stage_has_words(stage: str) -> None:
    assert DOING[stage] in banner_html(replace(problem(), stage=stage), EMPTY)


def test_problem_without_file_line_or_traceback_is_shown_too() -> None:
    html = banner_html(replace(problem(), file=None, line=None, code=None, traceback=""), EMPTY)
    assert "The task" in html and "<details>" not in html and "<pre" not in html


def test_comes_with_the_problem_and_leaves_with_it(panels: Panels) -> None:
    banner = Banner(panels.server, lambda: None, lambda: None, lambda: None)
    part = panels.part("Problem")
    banner.draw(running(2))
    assert not part.seen
    banner.draw(running(2, problem=problem(), problem_serial=1, state="error"))
    assert part.seen
    assert not panels.shows(RESTART)
    banner.draw(running(2))
    assert not part.seen


@pytest.mark.parametrize(
    ("stage", "offered"), [("evaluate", True), ("reset", True), ("syntax", False), ("policy", False)]
)
def test_a_rebuild_is_offered_where_a_patch_may_lack_what_building_makes(
    panels: Panels, stage: str, offered: bool
) -> None:
    asked: list[str] = []
    banner = Banner(panels.server, lambda: None, lambda: asked.append("rebuild"), lambda: None)
    failed = replace(problem(), stage=stage)
    banner.draw(running(2, problem=failed, problem_serial=1, state="error"))
    assert panels.shows(REBUILD) is offered
    if offered:
        panels.press(REBUILD)
        assert asked == ["rebuild"]


def test_traceback_that_someone_opened_is_not_written_again(panels: Panels) -> None:
    banner = Banner(panels.server, lambda: None, lambda: None, lambda: None)
    view = running(2, problem=problem(), problem_serial=1, state="error")
    banner.draw(view)
    panels.htmls()[0].content = "opened"
    banner.draw(replace(view, step_serial=99))
    assert panels.htmls()[0].content == "opened"
    banner.draw(replace(view, problem=problem("ValueError: other"), problem_serial=2))
    assert "ValueError: other" in panels.html()


def test_dead_worker_can_be_started_again(panels: Panels) -> None:
    asked: list[str] = []
    banner = Banner(panels.server, lambda: None, lambda: None, lambda: asked.append("restart"))
    banner.draw(replace(EMPTY, problem=problem(), problem_serial=1, state="stopped"))
    panels.press(RESTART)
    assert asked == ["restart"]


def test_an_empty_file_is_filled_by_a_press_and_only_while_it_is_empty(
    panels: Panels, tmp_path: Path
) -> None:
    file = tmp_path / "stack_two.py"
    file.write_text("# mine\n\n")
    banner = Banner(panels.server, lambda: None, lambda: None, lambda: None, is_own=str(file).__eq__)
    view = replace(EMPTY, problem=replace(problem(), file=str(file)), problem_serial=1, state="error")
    banner.draw(view)
    assert panels.shows(FILL) and file.read_text() == "# mine\n\n"
    file.write_text("x = 1\n")
    panels.press(FILL)
    assert file.read_text() == "x = 1\n" and "not empty any more" in panels.client.notices[0]
    file.write_text("# mine\n\n")
    panels.press(FILL)
    assert file.read_text().startswith('# mine\n\n"""The least') and "class StackTwoEnv" in file.read_text()
    assert [path.name for path in tmp_path.iterdir()] == ["stack_two.py"]
    banner.draw(replace(view, problem_serial=2))
    assert not panels.shows(FILL), "it holds a task"
    other = tmp_path / "other.py"
    other.touch()
    banner.draw(replace(view, problem=replace(problem(), file=str(other)), problem_serial=3))
    assert not panels.shows(FILL), "it is not the task's"
