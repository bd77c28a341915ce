"""The form of the env options: what it shows, refuses and applies, and the command line."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.drive.panels import Panels
from tests.drive.scenes import running
from workbench.app.session import Session
from workbench.commands import COMMANDS, Refused
from workbench.envs.keywords import HowMade, Keyword
from workbench.live.commands import ResetEnvOptions
from workbench.live.events import OptionsApplied
from workbench.live.panels.env_options import EnvOptionsPanel, merged
from workbench.live.view import SessionView
from workbench.page.widgets.parts import Parts
from workbench.task.description import TaskOptions

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
    Keyword("made", "json", "<object>", fixed="its value is a Python object that JSON cannot hold"),
)
MADE = HowMade("panda", (ROBOT, CONTROL), OWN)


class Form:
    """The form on a session that reports the values set here."""

    def __init__(self, panels: Panels, session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
        self.panels, self.session, self.applied = panels, session, list[TaskOptions]()
        view = running(4)
        assert view.task is not None
        task = replace(view.task, made=MADE, device="cpu, pictures on llvmpipe")
        self.view: SessionView = replace(view, task=task, options=TaskOptions(4))
        monkeypatch.setattr(session, "view", lambda: self.view)
        monkeypatch.setattr(session, "dispatch", self._dispatched)
        self.panel = EnvOptionsPanel(panels.server, session)
        self.parts = Parts([self.panel])
        panels.visitors.do = self.parts.do
        self.draw()

    def _dispatched(self, event: object) -> None:
        assert isinstance(event, OptionsApplied)
        self.applied.append(event.options)

    def draw(self) -> None:
        self.parts.draw(self.view)

    def set(self, name: str, value: object) -> None:
        self.panels.set(name, value)
        self.draw()

    def press(self, name: str) -> None:
        self.panels.press(name)
        self.draw()


@pytest.fixture
def form(panels: Panels, scripted_session: Callable[..., Session], monkeypatch: pytest.MonkeyPatch) -> Form:
    return Form(panels, scripted_session(4), monkeypatch)


def test_each_keyword_has_an_input_of_its_type_with_the_value_in_effect(form: Form) -> None:
    shown = {
        name: form.panels.field(name).value
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
    assert tuple(form.panels.field("Robot").options) == ("panda", "fetch")
    assert form.panels.field("made").off
    assert form.panels.button("Apply").command is None and not form.panels.shows("Discard", "button")


def test_the_fold_names_the_number_of_envs_and_their_device(form: Form) -> None:
    (label,) = (one for one in form.panels.folders() if one is not None and "made" in one)
    assert label.endswith("4 envs, cpu")


def test_options_that_were_applied_elsewhere_replace_those_in_the_form(form: Form) -> None:
    """By another tab, or by Undo: else Apply would bring the old number of envs back."""
    form.set("Envs", 8)
    form.view = replace(form.view, options=TaskOptions(16))
    form.draw()
    assert form.panels.field("Envs").value == 16 and not form.panels.shows("Discard", "button")


def test_only_changed_options_are_applied_all_at_once(form: Form) -> None:
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
def test_an_invalid_value_is_refused_with_a_reason(form: Form, text: str, why: str) -> None:
    form.set("where", text)
    form.press("Apply")
    assert form.applied == [] and why in form.panels.client.notices[-1]
    assert form.panels.field("where").value == text, "the text stays, to be corrected"


@pytest.mark.parametrize(
    ("name", "value"), [("made", "1"), ("nothing_like_it", 1), ("name", "a\0b"), ("where", "x" * 2001)]
)
def test_a_value_that_no_input_accepts_is_refused_and_the_form_stays(
    form: Form, name: str, value: Any
) -> None:
    before = form.panels.everything()
    fields = {"name": name, "value": value}
    with pytest.raises(Refused):
        form.parts.do(COMMANDS.decode("set_keyword", fields), form.panels.visitor)
    form.draw()
    assert form.panels.everything() == before


def test_integers_stay_integers_and_another_type_is_refused_with_a_reason(form: Form) -> None:
    form.set("count", 5)
    form.set("size", 2)
    form.press("Apply")
    (options,) = form.applied
    assert [(one, type(one)) for one in options.env_kwargs.values()] == [(2.0, float), (5, int)]
    form.set("count", 2.5)
    form.press("Apply")
    assert form.panels.client.notices == ["count takes a whole number; got '2.5'."]


def test_typed_values_survive_a_save_and_are_dropped_by_discard(form: Form) -> None:
    form.set("size", 0.5)
    form.view = replace(form.view, task_serial=9)
    form.draw()
    assert form.panels.field("size").value == 0.5
    form.press("Discard")
    assert form.panels.field("size").value == 0.02 and form.applied == []
    assert not form.panels.shows("Discard", "button")


def test_a_number_typed_while_the_task_loads_stays(form: Form) -> None:
    loaded = form.view
    form.view = replace(loaded, task=None, options=TaskOptions(5))
    form.draw()
    form.set("Envs", 7)
    form.view = replace(loaded, options=TaskOptions(5))
    form.draw()
    assert form.panels.field("Envs").value == 7 and form.panels.field("size").value == 0.02


def test_refused_options_stay_in_the_form_and_discard_removes_the_problem(form: Form) -> None:
    form.set("Envs", 4000)
    form.press("Apply")
    form.view = replace(form.view, options_refused=form.applied[0], state="error")
    form.draw()
    assert "Not taken: num_envs = 4000" in form.panels.html("wb-env-options")
    assert form.panels.field("Envs").value == 4000
    form.press("Discard")
    assert form.panels.field("Envs").value == 4 and form.applied[-1] == TaskOptions(4)


def test_accepted_options_are_shown_as_in_effect(form: Form) -> None:
    form.set("size", 0.5)
    form.press("Apply")
    assert form.view.task is not None
    made = replace(MADE, own=(replace(SIZE, value="0.5"), *OWN[1:]))
    form.view = replace(
        form.view, options=form.applied[0], task=replace(form.view.task, made=made), task_serial=2
    )
    form.draw()
    assert form.panels.field("size").value == 0.5 and form.panels.button("Apply").command is None
    assert "--env size=0.5" in form.panels.html("wb-env-options")
    form.panels.ask(ResetEnvOptions())
    assert form.applied[-1] == TaskOptions(4)


def test_a_new_robot_has_its_own_control_mode(form: Form) -> None:
    form.view = replace(
        form.view, options=TaskOptions(4, env_kwargs={"control_mode": "pd_joint_pos", "x": 1})
    )
    form.draw()
    form.set("Robot", "fetch")
    form.press("Apply")
    assert form.applied[-1].env_kwargs == {"robot_uids": "fetch", "x": 1}
    form.set("Control", "pd_ee_pose")
    form.press("Apply")
    assert form.applied[-1].env_kwargs == {"robot_uids": "fetch", "control_mode": "pd_ee_pose", "x": 1}
    form.press("Discard")
    form.set("Control", "pd_ee_pose")
    form.press("Apply")
    assert form.applied[-1].env_kwargs == {"control_mode": "pd_ee_pose", "x": 1}


def test_the_form_is_that_of_the_tasks_own_keywords_and_can_be_discarded(form: Form) -> None:
    form.set("Envs", 8)
    form.press("Discard")
    assert form.panels.field("Envs").value == 4
    assert form.view.task is not None
    again = Keyword("way", "choice", "1", "1", ("1", '"1"'))
    made = replace(MADE, own=(again, Keyword("late", "int", "5", "5")))
    form.view = replace(form.view, task=replace(form.view.task, made=made))
    form.draw()
    labels = [field.label for field in form.panels.fields()]
    assert "size" not in labels and form.panels.field("late").value == 5
    assert list(form.panels.field("way").options) == ["1", '"1"'], (
        "labels in JSON, since they are equal otherwise"
    )
    form.set("late", 6)
    form.press("Apply")
    assert form.applied == [TaskOptions(4, env_kwargs={"late": 6})]
    form.view = replace(form.view, state="stopped")
    form.draw()
    assert form.panels.button("Apply").command is None, "no worker could build them"


def test_the_command_has_what_the_form_lacks(form: Form, monkeypatch: pytest.MonkeyPatch) -> None:
    def told(**changes: Any) -> str:
        form.view = replace(form.view, **changes)
        form.draw()
        return " ".join(re.sub("<[^>]*>", " ", form.panels.html("wb-env-options")).split())

    assert "--seed 5" in told(seed=5) and "cpu, pictures on llvmpipe" in told()
    machine = TaskOptions(4, env_kwargs={"render_backend": "none"})
    assert "render_backend" in told(options=machine) and not form.panels.presses(ResetEnvOptions())
    both = replace(machine, env_kwargs={"render_backend": "none", "size": 0.5, "hidden": 1})
    assert "Also given: render_backend = &#34;none&#34;, hidden = 1" in told(options=both)
    form.panels.ask(ResetEnvOptions())
    assert form.applied[-1] == machine, "it is about this computer, not about the task"
    refused = TaskOptions(400, env_kwargs={"render_backend": "none", "hidden": 1})
    assert "num_envs = 400, no size." in told(options_refused=refused)
    assert form.panels.shows("Discard", "button")
    session = type(form.session)
    monkeypatch.setattr(session, "present_reference", property(lambda self: "other.py:Two"))
    assert "other.py:Two" in told()


VALUES = st.booleans() | st.integers(-5, 5) | st.floats(-5, 5) | st.text(max_size=3) | st.none()


@given(st.dictionaries(st.sampled_from(["size", "count", "x"]), VALUES), VALUES)
def test_merged_sets_what_differs_and_keeps_the_rest(given_before: dict[str, Any], value: Any) -> None:
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
