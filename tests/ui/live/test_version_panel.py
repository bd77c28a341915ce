"""What the page says of a reload."""

from __future__ import annotations

from typing import Any, cast

from tests.drive.panels import Panels
from tests.ui.scenes import problem, running
from workbench.session.live.view import PastLoad
from workbench.session.protocol.messages import ReloadReport
from workbench.ui.live.version_panel import MOST_SHOWN, VersionPanel, took, version_html
from workbench.ui.widgets.parts import Parts


class StillSession:
    """Does nothing that a page asks for."""

    @property
    def versions(self) -> StillSession:
        return self

    def choose_class(self, name: str) -> None: ...
    def reload(self, level: str) -> None: ...


def test_level_reason_and_time_are_said() -> None:
    html = version_html(ReloadReport("patched", "only evaluate changed"), 43.2, loaded=True)
    assert "patched" in html and "43 ms" in html and "only evaluate changed" in html and "continue" in html


def test_what_a_build_could_not_carry_is_named_up_to_a_number() -> None:
    missing = {f"actor cube_{i}": "this env has none of this name" for i in range(MOST_SHOWN + 3)}
    html = version_html(
        ReloadReport("rebuilt", "_load_scene changed", ("actor goal",), missing), 1500.0, True
    )
    assert "1.5 s" in html and "put back to where it was" in html
    assert "actor cube_0" in html and f"actor cube_{MOST_SHOWN}" not in html and "and 3 more" in html


def test_a_build_without_a_moment_says_that_an_episode_began() -> None:
    assert "New episodes" in version_html(ReloadReport("rebuilt", "another task"), 900.0, loaded=True)


def test_what_comes_of_the_file_is_escaped() -> None:
    report = ReloadReport("rebuilt", "<img src=x>", (), {"<b>name</b>": "<script>why</script>"})
    html = version_html(report, 1.0, loaded=True)
    assert "<img" not in html and "<script" not in html and "<b>name" not in html


def test_before_the_first_reload_it_says_what_saving_does() -> None:
    assert "Save the file" in version_html(None, 0.0, loaded=True)
    assert version_html(None, 0.0, loaded=False).strip() == ""


def test_while_the_file_is_broken_the_broken_save_is_what_it_speaks_of(panels: Panels) -> None:
    """It spoke of the good save before, as if that were what had just been saved."""
    panel = Parts([VersionPanel(panels.server, cast(Any, StillSession()))])
    good = ReloadReport("patched", "only evaluate changed")
    panel.draw(running(4, reload=good))
    assert "not loaded" not in panels.html()
    panel.draw(running(4, reload=good, stale=True, state="error", refused=problem()))
    told = panels.html()
    assert (
        told.index("not loaded")
        < told.index("The previous version is still loaded")
        < told.index("only evaluate")
    )
    assert "push.py:88" in told and "KeyError" in told
    panel.draw(running(4, reload=good, stale=True, state="loading", refused=problem()))
    assert "not loaded" not in panels.html()  # another one is being tried


def test_times_are_short() -> None:
    assert (took(42.6), took(1234.0)) == ("43 ms", "1.2 s")


def test_what_the_author_should_know_stands_there_before_and_after_a_reload() -> None:
    notices = tuple(f"<b>file{i}.py</b> has the name of a library" for i in range(MOST_SHOWN + 2))
    for report in (None, ReloadReport("same", "")):
        html = version_html(report, 1.0, True, notices=notices)
        assert (
            html.count("has the name of a library") == MOST_SHOWN
            and "And 2 more." in html
            and "<b>file" not in html
        )


def test_the_tasks_of_a_file_can_be_chosen_while_the_one_that_was_asked_for_fails(
    panels: Panels,
) -> None:
    panel = Parts([VersionPanel(panels.server, cast(Any, StillSession()))])
    panel.draw(running(4))
    assert not panels.shows("Task")
    failed = running(4, task=None, state="error", refused=problem(), choices=("TwoEnv", "OneEnv"))
    panel.draw(failed)
    assert panels.shows("Task") and panels.control("Task").value == "TwoEnv"
    assert panels.control("Task").options == ("OneEnv", "TwoEnv")


def test_the_last_loads_are_listed_newest_first_with_level_reason_and_time(panels: Panels) -> None:
    panel = Parts([VersionPanel(panels.server, cast(Any, StillSession()))])
    first = PastLoad(1_000_000_000.0, None, "the first version", 900.0)
    panel.draw(running(4, loads=(first,)))
    assert "the first version" not in panels.html(), "one load is no list"
    refused = PastLoad(1_000_000_060.0, None, "KeyError: '<goal>'", problem=problem())
    patched = PastLoad(1_000_000_120.0, "patched", "only evaluate changed", 43.0)
    panel.draw(running(4, loads=(patched, refused, first)))
    told = panels.html("wb-loads")
    places = [
        told.index(words)
        for words in ("patched", "43 ms", "only evaluate", "refused", "push.py:88", "900 ms")
    ]
    assert places == sorted(places) and "&lt;goal&gt;" in told


def test_while_steps_go_on_it_is_not_drawn_again(panels: Panels) -> None:
    panel = VersionPanel(panels.server, cast(Any, StillSession()))
    # Each number that a view is made with is another object.
    assert panel.key(running(4, load_milliseconds=43.0, step_serial=1)) == panel.key(
        running(4, load_milliseconds=float("43.0"), step_serial=2)
    )
