"""The folder *How the envs are made*: number of envs, robot, modes and the task's own keyword arguments."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import viser

from workbench.core.capture.recorded_run import HOW_IT_IS_RUN
from workbench.core.env.keywords import MODES, HowMade, Keyword, as_json, read_value, shown
from workbench.jobs.task import TaskOptions, changed_options, command_line
from workbench.session.live.session import Session
from workbench.session.live.view import SessionView
from workbench.session.tasks.recents import MOST_ENVS, lasting
from workbench.ui.server.control_values import checked_int, limit_text
from workbench.ui.widgets.click_targets import Presses
from workbench.ui.widgets.inputs import refusals_told
from workbench.ui.widgets.parts import PagePart
from workbench.ui.widgets.templates import render

LONGEST = 2000
"""Characters of a value."""
LABELS = {
    "robot_uids": "Robot",
    "control_mode": "Control",
    "obs_mode": "Observation",
    "reward_mode": "Reward",
}
NONE = "none (null)"
_FEWEST_DIGITS, _MOST_DIGITS = 4, 9
"""Decimals of a number field."""


@dataclass(frozen=True)
class _Field:
    """One input and the keyword that it is for."""

    keyword: Keyword
    handle: Any
    text: Callable[[], str]
    """What stands in it, as `read_value` takes it."""
    show: Callable[[str], None]
    """Writes a value in JSON into it."""


class EnvOptionsPanel(PagePart[SessionView]):
    """A form that is applied as a whole: every change makes the envs anew.

    What is typed stays in the form until it is applied or discarded, also if the task fails with it; then the envs that
    run stay as they are. The form is written anew when the envs were made in another way.
    """

    def __init__(self, server: viser.ViserServer, session: Session) -> None:
        self._server, self._session = server, session
        self._made: tuple[HowMade, TaskOptions] | None = None
        """What the form was last written for."""
        self._fields: list[_Field] = []
        gui = server.gui
        with gui.add_folder("How the envs are made", expand_by_default=False):
            self._num_envs = gui.add_number("Envs", 1, min=1, max=MOST_ENVS, step=1)
            self._form = gui.add_folder(None)
            self._apply = gui.add_button(
                "Apply", icon=viser.Icon.CHECK, disabled=True, hint="Make the envs anew with these"
            )
            self._discard = gui.add_button(
                "Discard", icon=viser.Icon.X, color="gray", visible=False, hint="Show what is in effect again"
            )
            self._html = gui.add_html("")
            self._reset = Presses(server).id_of("as the task does", lambda client: self._as_the_task_does())
        self._apply.on_click(lambda event: self._apply_form(event.client))
        self._discard.on_click(lambda _: self._discard_form())

    def key(self, view: SessionView) -> object:
        # The command names the file by its place on the disk, which is not asked for with every step.
        task = None if view.task is None else (view.task.made, view.task.device)
        form = self._num_envs.value, [field.text() for field in self._fields]
        options = view.options, view.seed, view.options_refused
        return task, options, form, view.state, self._session.present_reference

    def draw(self, view: SessionView) -> None:
        made = (HowMade() if view.task is None else view.task.made), replace(view.options, seed=0)
        before = self._made
        if made != before:
            self._made = made
            self._build(made[0])
            # What was typed while the first version was loading stays.
            if before is None or before[1] != made[1]:
                self._num_envs.value = made[1].num_envs
        changed = self._is_changed(view)
        self._apply.disabled = not changed or view.state == "stopped"
        self._discard.visible = changed or view.options_refused is not None
        self._html.content = options_html(self._session.present_reference, view, self._reset)

    # --- the form --------------------------------------------------------------------------------

    def _build(self, made: HowMade) -> None:
        keywords = (*made.modes, *made.own)
        kinds = [(one.name, one.kind, one.choices, one.optional, one.fixed) for one in keywords]
        before = [field.keyword for field in self._fields]
        if kinds != [(one.name, one.kind, one.choices, one.optional, one.fixed) for one in before]:
            for field in self._fields:
                field.handle.remove()
            with self._form:
                self._fields = [_field_for(self._server.gui, keyword) for keyword in keywords]
        else:
            self._fields = [
                replace(field, keyword=keyword) for field, keyword in zip(self._fields, keywords, strict=True)
            ]
        self._show_keywords()

    def _show_keywords(self) -> None:
        """Write what is in effect into the fields of the keywords."""
        for field in self._fields:
            if not field.keyword.fixed:
                field.show(field.keyword.value)

    def _is_changed(self, view: SessionView) -> bool:
        if self._num_envs.value != view.options.num_envs:
            return True
        return any(
            field.text() != _text_of(field.keyword) for field in self._fields if not field.keyword.fixed
        )

    def _discard_form(self) -> None:
        view = self._session.view()
        self._num_envs.value = view.options.num_envs
        self._show_keywords()
        if view.options_refused is not None:
            # The task works with what is in effect: loading it takes the problem off the page.
            self._session.versions.apply_options(view.options)

    def _apply_form(self, client: viser.ClientHandle | None) -> None:
        with refusals_told(client):
            options = self._session.view().options
            num_envs = checked_int(self._num_envs.value, 1, MOST_ENVS, "number of envs")
            values = {
                field.keyword: read_value(field.keyword, field.text())
                for field in self._fields
                if not field.keyword.fixed
            }
            wanted = replace(options, num_envs=num_envs, env_kwargs=merged(options.env_kwargs, values))
            if changed_options(options, wanted):
                self._session.versions.apply_options(wanted)

    def _as_the_task_does(self) -> None:
        """Drop the keyword arguments that a person gave."""
        options = self._session.view().options
        self._session.versions.apply_options(replace(options, env_kwargs=_of_the_machine(options.env_kwargs)))


def merged(given: Mapping[str, Any], values: Mapping[Keyword, Any]) -> dict[str, Any]:
    """The keyword arguments of a form over those that were given.

    What stands as it was is left as it was, and what is the class's own value is not given. A new robot has other control
    modes, so the old one is dropped unless it was chosen with it.
    """
    result = dict(given)
    changed = {keyword.name for keyword, value in values.items() if not _same(as_json(value), keyword.value)}
    for keyword, value in values.items():
        if keyword.name not in changed:
            continue
        if keyword.name not in MODES and keyword.default and _same(as_json(value), keyword.default):
            result.pop(keyword.name, None)
        else:
            result[keyword.name] = value
    if "robot_uids" in changed and "control_mode" not in changed:
        result.pop("control_mode", None)
    return result


def _same(a: str | None, b: str) -> bool:
    """Whether two texts are the same value: 1 and 1.0 are, 1 and true are not."""
    if a is None or a == b:
        return a == b
    left, right = json.loads(a), json.loads(b)
    return left == right and isinstance(left, bool) == isinstance(right, bool)


def _of_the_machine(kwargs: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in kwargs.items() if name in HOW_IT_IS_RUN}


# --- inputs ------------------------------------------------------------------------------------------


def _field_for(gui: viser.GuiApi, keyword: Keyword) -> _Field:
    label = LABELS.get(keyword.name, keyword.name)
    handle: Any
    if keyword.fixed:
        handle = gui.add_text(label, keyword.value, disabled=True, hint=f"Not changed here: {keyword.fixed}")
        return _Field(keyword, handle, lambda: keyword.value, lambda text: None)
    if keyword.kind == "choice" or (keyword.kind == "bool" and keyword.optional):
        return _dropdown(gui, keyword, label)
    if keyword.kind == "bool":
        handle = gui.add_checkbox(label, keyword.value == "true")
        return _Field(
            keyword, handle, lambda: json.dumps(handle.value), lambda text: _write(handle, text == "true")
        )
    if keyword.kind in ("int", "float") and not keyword.optional and _is_number(keyword.value):
        return _number(gui, keyword, label)
    of_text = keyword.kind == "str"
    hint = "Text" if of_text else 'A value in JSON: 0.5, true, [1, 2], "text"'
    handle = gui.add_text(label, "", hint=hint + ("; null for none" if keyword.optional else ""))
    limit_text(handle, LONGEST)
    in_words: Callable[[str], str] = shown if of_text else lambda text: text
    handle.value = in_words(keyword.value)
    return _Field(keyword, handle, lambda: handle.value, lambda text: _write(handle, in_words(text)))


def _dropdown(gui: viser.GuiApi, keyword: Keyword, label: str) -> _Field:
    texts = keyword.choices or ("true", "false")
    names = [shown(text) for text in texts]
    # 1 and "1" look the same.
    by_name = dict(zip(names if len(set(names)) == len(names) else texts, texts))
    if keyword.optional and "null" not in texts:
        by_name[NONE] = "null"
    names_of = {text: name for name, text in by_name.items()}
    handle: Any = gui.add_dropdown(
        label, tuple(by_name), initial_value=names_of.get(keyword.value, next(iter(by_name)))
    )

    def write(text: str) -> None:
        if text in names_of:
            _write(handle, names_of[text])

    return _Field(keyword, handle, lambda: by_name[handle.value], write)


def _number(gui: viser.GuiApi, keyword: Keyword, label: str) -> _Field:
    value = json.loads(keyword.value)
    handle: Any
    if keyword.kind == "int":
        handle = gui.add_number(label, int(value), step=1)
        return _Field(
            keyword, handle, lambda: json.dumps(handle.value), lambda text: _write(handle, json.loads(text))
        )
    # A field rounds to its step.
    size = math.floor(math.log10(abs(value))) if value else 0
    digits = min(max(_FEWEST_DIGITS, 3 - size), _MOST_DIGITS)
    handle = gui.add_number(label, float(value), step=10.0**-digits)
    return _Field(
        keyword,
        handle,
        lambda: json.dumps(handle.value),
        lambda text: _write(handle, float(json.loads(text))),
    )


def _is_number(text: str) -> bool:
    value = json.loads(text)
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 2**53


def _write(handle: Any, value: Any) -> None:
    handle.value = value


def _text_of(keyword: Keyword) -> str:
    """What the field of a keyword has in it when it shows what is in effect."""
    if keyword.kind == "str":
        return shown(keyword.value)
    if keyword.kind == "float" and not keyword.optional and _is_number(keyword.value):
        return json.dumps(float(json.loads(keyword.value)))
    return keyword.value


def options_html(reference: object, view: SessionView, reset: str) -> str:
    """What the form does not show: options that were refused, further arguments, the driver, and the command."""
    options = replace(view.options, seed=view.seed)
    refused = view.options_refused
    made = HowMade() if view.task is None else view.task.made
    in_form = {keyword.name for keyword in (*made.modes, *made.own)}
    further = {name: value for name, value in options.env_kwargs.items() if name not in in_form}
    return render(
        "env_options",
        refused=[] if refused is None else _in_words(view.options, refused),
        further=_pairs(further),
        given=bool(options.env_kwargs.keys() - HOW_IT_IS_RUN),
        device="" if view.task is None else view.task.device,
        command=command_line(lasting(str(reference)), options),
        reset=reset,
    )


def _in_words(now: TaskOptions, tried: TaskOptions) -> list[str]:
    of_run = {name: getattr(tried, name) for name in ("num_envs", "backend")}
    values = {**of_run, **tried.env_kwargs}
    return [
        f"{name} = {as_json(values[name]) or values[name]}" if name in values else f"no {name}"
        for name in changed_options(now, tried)
    ]


def _pairs(values: Mapping[str, Any]) -> list[str]:
    return [f"{name} = {as_json(value) or value}" for name, value in values.items()]
