"""The form of how the envs are made: what is shown, refused and applied, and the command line."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.drive.panels import Panels
from tests.ui.scenes import running
from workbench.core.env.keywords import HowMade, Keyword
from workbench.jobs.task import TaskOptions
from workbench.session.live.session import Session
from workbench.session.live.view import SessionView
from workbench.ui.tasks.env_options import EnvOptionsPanel, merged
from workbench.ui.widgets.parts import Parts

ROBOT = Keyword("robot_uids", "choice", '"panda"', choices=('"panda"', '"fetch"'))
CONTROL = Keyword("control_mode", "choice", '"pd_joint_pos"', choices=('"pd_joint_pos"', '"pd_ee_pose"'))
SIZE = Keyword("size", "float", "0.02", "0.02")
OWN = (
    SIZE,
    Keyword("count", "int", "3", "3"),
    Keyword("flag", "bool", "true", "true"),
    Keyword("name", "str", '"a"', '"a"'),
    Keyword("way", "choice", '"left"', '"left"', ('"left"', '"right"'), optional=True),
    Keyword("where", "json", "[0, 1]", "[0, 1]"),
    Keyword("made", "json", "<object>", fixed="its value is an object of Python"),
)
MADE = HowMade("panda", (ROBOT, CONTROL), OWN)


class Form:
    """The form of a session that says what is told here."""

    def __init__(self, panels: Panels, session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
        self.panels, self.applied = panels, list[TaskOptions]()
        view = running(4)
        assert view.task is not None
        task = replace(view.task, made=MADE, device="cpu, pictures on llvmpipe")
        self.view: SessionView = replace(view, task=task, options=TaskOptions(4))
        monkeypatch.setattr(session, "view", lambda: self.view)
        monkeypatch.setattr(session.versions, "apply_options", self.applied.append)
        self.panel = EnvOptionsPanel(panels.server, session)
        self.parts = Parts([self.panel])
        self.draw()

    def draw(self) -> None:
        self.parts.draw(self.view)

    def set(self, name: str, value: object) -> None:
        self.panels.set(name, value)
        self.draw()

    def press(self, name: str) -> None:
        self.panels.press(name)
        self.panels.settle()
        self.draw()


@pytest.fixture
def form(panels: Panels, scripted_session: Callable[..., Session], monkeypatch: pytest.MonkeyPatch) -> Form:
    return Form(panels, scripted_session(4), monkeypatch)


def test_each_keyword_has_the_input_of_its_type_and_shows_what_is_in_effect(form: Form) -> None:
    shown = {
        name: form.panels.control(name, "field").value
        for name in ("Envs", "Robot", "Control", "size", "count", "flag", "name", "way", "where", "made")
    }
    assert shown == {
        "Envs": 4,
        "Robot": "panda",
        "Control": "pd_joint_pos",
        "size": 0.02,
        "count": 3,
        "flag": True,
        "name": "a",
        "way": "left",
        "where": "[0, 1]",
        "made": "<object>",
    }
    assert form.panels.control("Robot").options == ("panda", "fetch")
    assert form.panels.control("made").disabled
    assert form.panels.control("Apply", "button").disabled and not form.panels.shows("Discard", "button")


def test_only_what_was_changed_is_given_and_all_at_once(form: Form) -> None:
    form.set("Envs", 8)
    form.set("size", 0.001)
    form.set("flag", False)
    form.set("where", "[2]")
    form.set("way", "none (null)")
    assert form.applied == [] and form.panels.shows("Discard", "button")
    form.press("Apply")
    assert form.applied == [
        TaskOptions(8, env_kwargs={"size": 0.001, "flag": False, "way": None, "where": [2]})
    ]


@pytest.mark.parametrize(("text", "why"), [("{", "where takes a value in JSON"), ("NaN", "where takes")])
def test_a_value_that_is_none_is_refused_in_words(form: Form, text: str, why: str) -> None:
    form.set("where", text)
    form.press("Apply")
    assert form.applied == [] and why in form.panels.client.notices[-1]
    assert form.panels.control("where").value == text, "to be mended"


def test_what_is_typed_survives_a_save_and_goes_with_discard(form: Form) -> None:
    form.set("size", 0.5)
    form.view = replace(form.view, task_serial=9)
    form.draw()
    assert form.panels.control("size").value == 0.5
    form.press("Discard")
    assert form.panels.control("size").value == 0.02 and form.applied == []
    assert not form.panels.shows("Discard", "button")


def test_a_number_that_is_typed_while_the_task_loads_stays(form: Form) -> None:
    loaded = form.view
    form.view = replace(loaded, task=None, options=TaskOptions(5))
    form.draw()
    form.set("Envs", 7)
    form.view = replace(loaded, options=TaskOptions(5))
    form.draw()
    assert form.panels.control("Envs").value == 7 and form.panels.control("size").value == 0.02


def test_refused_options_stay_in_the_form_and_discard_takes_the_problem_away(form: Form) -> None:
    form.set("Envs", 4000)
    form.press("Apply")
    form.view = replace(form.view, options_refused=form.applied[0], state="error")
    form.draw()
    assert "Not taken: num_envs = 4000" in form.panels.html("wb-env-options")
    assert form.panels.control("Envs").value == 4000
    form.press("Discard")
    assert form.panels.control("Envs").value == 4 and form.applied[-1] == TaskOptions(4)


def test_options_that_were_taken_are_what_is_in_effect(form: Form) -> None:
    form.set("size", 0.5)
    form.press("Apply")
    assert form.view.task is not None
    made = replace(MADE, own=(replace(SIZE, value="0.5"), *OWN[1:]))
    form.view = replace(
        form.view, options=form.applied[0], task=replace(form.view.task, made=made), task_serial=2
    )
    form.draw()
    assert form.panels.control("size").value == 0.5 and form.panels.control("Apply", "button").disabled
    assert "--env size=0.5" in form.panels.html("wb-env-options")
    form.press("as the task does")
    assert form.applied[-1] == TaskOptions(4)


VALUES = st.booleans() | st.integers(-5, 5) | st.floats(-5, 5) | st.text(max_size=3) | st.none()


@given(st.dictionaries(st.sampled_from(["size", "count", "x"]), VALUES), VALUES)
def test_merged_gives_what_differs_and_leaves_the_rest(given_before: dict[str, Any], value: Any) -> None:
    now = given_before.get("size", 0.02)
    keyword = replace(SIZE, kind="json", value=json.dumps(now))
    result = merged(given_before, {keyword: value})
    rest = {name: one for name, one in given_before.items() if name != "size"}
    assert {name: one for name, one in result.items() if name != "size"} == rest
    same = value == now and isinstance(value, bool) == isinstance(now, bool)
    if same:
        assert result == given_before
    elif value == 0.02:
        assert "size" not in result
    else:
        assert result["size"] == value
