"""The folder *How the envs are made*: number of envs, robot, modes and the task's own keyword arguments."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import viser

from workbench.envs.keywords import MODES, HowMade, Keyword, as_json, read_value, shown
from workbench.envs.recorded_run import RUN_KEYWORDS
from workbench.live.commands import (
    MAX_VALUE_CHARACTERS,
    ApplyEnvOptions,
    DiscardEnvOptions,
    ResetEnvOptions,
    SetKeyword,
    SetNumEnvs,
)
from workbench.live.events import OptionsApplied
from workbench.live.session_protocol import LiveSession
from workbench.live.view import SessionView
from workbench.page.command import Command, Refused
from workbench.page.widgets.fields import Field, Plain, choice, tick
from workbench.page.widgets.parts import PagePart, name_fold
from workbench.page.widgets.templates import counted, render
from workbench.page.widgets.tools import tool, tools_html
from workbench.page.widgets.visitors import Visitor
from workbench.task.description import TaskOptions, changed_options, command_line
from workbench.task.reference import lasting

TITLE = "How the envs are made"
LABELS = {
    "robot_uids": "Robot",
    "control_mode": "Control",
    "obs_mode": "Observation",
    "reward_mode": "Reward",
}
NONE = "none (null)"
_MIN_DECIMALS, _MAX_DECIMALS = 4, 9
"""Minimum and maximum number of decimals of the increment by which an arrow key changes a number."""


class EnvOptionsPanel(PagePart[SessionView]):
    """A form that is applied as a whole, since every change rebuilds the envs.

    Entered values stay in the form until they are applied or discarded. If the task fails with them, they
    stay too, and the running envs do not change. The form is rewritten when the envs were made with other
    options.
    """

    does = (SetNumEnvs, SetKeyword, ApplyEnvOptions, DiscardEnvOptions, ResetEnvOptions)

    def __init__(self, server: viser.ViserServer, session: LiveSession) -> None:
        self._server, self._session = server, session
        self._made: tuple[HowMade, TaskOptions] | None = None
        """Env and options that the form was last written for."""
        self._num_envs = 1
        self._keywords: tuple[Keyword, ...] = ()
        self._values: dict[str, Plain] = {}
        """Values in the form, by the name of the keyword."""
        self._fields: list[Field] = []
        """Input fields of the keywords."""
        gui = server.gui
        self._folder = gui.add_folder(TITLE, expand_by_default=False)
        with self._folder:
            self._envs = Field(server, "Envs", SetNumEnvs, "num_envs", self._num_envs)
            self._form = gui.add_folder(None)
            self._tools = gui.add_html("")
            self._html = gui.add_html("")

    def key(self, view: SessionView) -> object:
        # The shown command contains the file's path on disk, which must not be looked up at every step.
        task = None if view.task is None else (view.task.made, view.task.device)
        form = self._num_envs, tuple(self._values.items())
        options = view.options, view.seed, view.options_refused
        return task, options, form, view.state, self._session.present_reference

    def draw(self, view: SessionView) -> None:
        made = (HowMade() if view.task is None else view.task.made), replace(view.options, seed=0)
        if view.task is not None:
            name_fold(
                self._folder,
                TITLE,
                f"{counted(view.task.num_envs, 'env')}, {view.task.device.partition(',')[0]}",
            )
        before = self._made
        if made != before:
            self._made = made
            self._build(made[0])
            # A number of envs that was entered while the first version was loading stays.
            if before is None or before[1] != made[1]:
                self._num_envs = made[1].num_envs
        self._envs.show(self._num_envs)
        for keyword, field in zip(self._keywords, self._fields, strict=True):
            field.show(self._values[keyword.name], off=bool(keyword.fixed))
        changed = self._num_envs != view.options.num_envs or bool(self._changed())
        apply = tool("Apply", ApplyEnvOptions(), off=not changed or view.state == "stopped", tone="main")
        discard = tool("Discard", DiscardEnvOptions())
        self._tools.content = tools_html(
            [apply, discard] if changed or view.options_refused is not None else [apply]
        )
        self._html.content = options_html(self._session.present_reference, view)

    def do(self, command: Command, visitor: Visitor) -> None:
        match command:
            case SetNumEnvs(num_envs=num_envs):
                self._num_envs = num_envs
            case SetKeyword(name=name, value=value):
                if not any(keyword.name == name and not keyword.fixed for keyword in self._keywords):
                    raise Refused(f"There is no option {name} that can be changed here.")
                if isinstance(value, str) and not value.isprintable():
                    raise Refused(f"The value of {name} has characters that cannot be shown. Remove them.")
                self._values[name] = value
            case ApplyEnvOptions():
                self._apply()
            case DiscardEnvOptions():
                self._discard()
            case ResetEnvOptions():
                self._as_the_task_does()

    # --- the form --------------------------------------------------------------------------------

    def _build(self, made: HowMade) -> None:
        before, self._keywords = self._keywords, (*made.modes, *made.own)
        self._values = {keyword.name: _in_effect(keyword) for keyword in self._keywords}
        if list(map(_input_of, before)) != list(map(_input_of, self._keywords)):
            for field in self._fields:
                field.remove()
            with self._form:
                self._fields = [_field_for(self._server, keyword) for keyword in self._keywords]

    def _changed(self) -> dict[Keyword, Plain]:
        """Values in the form that differ from those in effect, by keyword."""
        now = {keyword: self._values[keyword.name] for keyword in self._keywords}
        return {keyword: value for keyword, value in now.items() if value != _in_effect(keyword)}

    def _discard(self) -> None:
        view = self._session.view()
        self._num_envs = view.options.num_envs
        self._values = {keyword.name: _in_effect(keyword) for keyword in self._keywords}
        if view.options_refused is not None:
            # The task works with the options in effect: loading it with these removes the problem from the
            # page.
            self._session.dispatch(OptionsApplied(view.options))

    def _apply(self) -> None:
        options = self._session.view().options
        try:
            values = {
                keyword: read_value(keyword, value if isinstance(value, str) else json.dumps(value))
                for keyword, value in self._changed().items()
            }
        except ValueError as why:
            raise Refused(str(why)) from None
        wanted = replace(options, num_envs=self._num_envs, env_kwargs=merged(options.env_kwargs, values))
        if changed_options(options, wanted):
            self._session.dispatch(OptionsApplied(wanted))

    def _as_the_task_does(self) -> None:
        """Drop the user's keyword arguments, except `RUN_KEYWORDS`."""
        options = self._session.view().options
        kept = _of_the_machine(options.env_kwargs)
        self._session.dispatch(OptionsApplied(replace(options, env_kwargs=kept)))


def merged(given: Mapping[str, Any], values: Mapping[Keyword, Any]) -> dict[str, Any]:
    """The keyword arguments `given`, updated with the `values` of a form.

    Unchanged arguments are kept. A changed argument that equals the class's default is omitted, unless it is
    a mode. A new robot has other control modes, so the old mode is dropped unless a mode was chosen together
    with the robot.
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
    """Whether two texts are the same JSON value: 1 and 1.0 are, 1 and true are not."""
    if a is None or a == b:
        return a == b
    left, right = json.loads(a), json.loads(b)
    return left == right and isinstance(left, bool) == isinstance(right, bool)


def _of_the_machine(kwargs: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in kwargs.items() if name in RUN_KEYWORDS}


# --- inputs ------------------------------------------------------------------------------------------


def _input_of(keyword: Keyword) -> object:
    """Key of a keyword's input field: everything that the field depends on, except its value."""
    return keyword.name, keyword.kind, keyword.choices, keyword.optional, keyword.fixed


def _in_effect(keyword: Keyword) -> Plain:
    """Content of a keyword's input field for the value in effect."""
    if keyword.fixed:
        return keyword.value
    if keyword.kind == "str":
        return shown(keyword.value)
    if keyword.kind == "bool" and not keyword.optional:
        return keyword.value == "true"
    if keyword.kind in ("int", "float") and not keyword.optional and _is_number(keyword.value):
        number = json.loads(keyword.value)
        return int(number) if keyword.kind == "int" else float(number)
    return keyword.value


def _field_for(server: viser.ViserServer, keyword: Keyword) -> Field:
    label, value = LABELS.get(keyword.name, keyword.name), _in_effect(keyword)
    given = {"name": keyword.name}
    if keyword.fixed:
        hint = f"Cannot be changed here: {keyword.fixed}"
        return Field(server, label, SetKeyword, "value", value, given=[given], hint=hint)
    if keyword.kind == "choice" or (keyword.kind == "bool" and keyword.optional):
        return choice(server, label, SetKeyword, "value", _options(keyword), value, given=given)
    if isinstance(value, bool):
        return tick(server, label, SetKeyword, "value", value, given=given)
    if isinstance(value, (int, float)):
        return Field(server, label, SetKeyword, "value", value, given=[given], step=_step(value))
    hint = "Text" if keyword.kind == "str" else 'A value in JSON: 0.5, true, [1, 2], "text"'
    hint += "; null for none" if keyword.optional else ""
    return Field(
        server, label, SetKeyword, "value", value, given=[given], hint=hint, longest=MAX_VALUE_CHARACTERS
    )


def _options(keyword: Keyword) -> dict[str, Plain]:
    """Values in JSON by label."""
    texts = keyword.choices or ("true", "false")
    names = [shown(text) for text in texts]
    # If two labels are equal, as those of 1 and "1", all options are labelled in JSON.
    options: dict[str, Plain] = dict(zip(names if len(set(names)) == len(names) else texts, texts))
    if keyword.optional and "null" not in texts:
        options[NONE] = "null"
    return options


def _step(value: float) -> float:
    """Increment by which an arrow key changes a number of this size."""
    if isinstance(value, int):
        return 1.0
    size = math.floor(math.log10(abs(value))) if value else 0
    return 10.0 ** -min(max(_MIN_DECIMALS, 3 - size), _MAX_DECIMALS)


def _is_number(text: str) -> bool:
    value = json.loads(text)
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 2**53


def options_html(reference: object, view: SessionView) -> str:
    """HTML of what the form does not show: options that were refused, further arguments, the driver, and the command."""
    options = replace(view.options, seed=view.seed)
    refused = view.options_refused
    made = HowMade() if view.task is None else view.task.made
    in_form = {keyword.name for keyword in (*made.modes, *made.own)}
    further = {name: value for name, value in options.env_kwargs.items() if name not in in_form}
    return render(
        "env_options",
        refused=[] if refused is None else _in_words(view.options, refused),
        further=_pairs(further),
        given=bool(options.env_kwargs.keys() - RUN_KEYWORDS),
        device="" if view.task is None else view.task.device,
        command=command_line(lasting(str(reference)), options),
        reset=ResetEnvOptions(),
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
