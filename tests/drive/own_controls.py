"""Finds the fields and buttons in our HTML of a panel by their labels."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from html.parser import HTMLParser
from typing import Any

from workbench.commands import COMMANDS
from workbench.page.command import Command

_VOID = {"input", "br", "wbr", "hr", "img", "meta"}


@dataclass
class SeenField:
    """An input in our HTML, or a row of inputs under one label."""

    label: str = ""
    names: list[str] = field(default_factory=list)
    asks: list[tuple[str, dict[str, Any], str]] = field(default_factory=list)
    """For each input: the command, its other fields, and the field that takes the entered value."""
    values: list[Any] = field(default_factory=list)
    off: bool = False
    options: dict[str, Any] = field(default_factory=dict)
    bounds: tuple[float, float] | None = None
    hint: str = ""
    done: str = ""
    """Name of the command that an entered value, or the end of a drag, sends."""

    @property
    def value(self) -> Any:
        """What the field shows: a choice's option text, a list for a row of inputs."""
        if self.options:
            return next((shown for shown, one in self.options.items() if one == self.values[0]), None)
        return self.values[0] if len(self.values) == 1 else tuple(self.values)

    def command(self, entered: Any, at: int = 0) -> Command:
        """The command that entering this value sends. Raises `Refused`."""
        name, fields, into = self.asks[at]
        return COMMANDS.decode(
            self.done or name, {**fields, into: self.options[entered] if self.options else entered}
        )


@dataclass
class SeenButton:
    """A pressable part; `command` is None while it is disabled."""

    text: str
    command: Command | None
    pressed: bool
    hint: str


class Controls(HTMLParser):
    """The fields and buttons in some HTML."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.fields: list[SeenField] = []
        self.buttons: list[SeenButton] = []
        self._field: SeenField | None = None
        self._open: list[SeenButton | None] = []
        """The button for each open element, or None."""
        self._labelled = False
        self._shown: dict[str, tuple[Any, bool, dict[str, Any]]] = {}
        self.feed(html)
        self.close()
        # While a page is torn down, a field may already have lost its value.
        self.fields = [one for one in self.fields if self._shown.keys() >= set(one.names)]
        for one in self.fields:
            shown = [self._shown[name] for name in one.names]
            one.values, one.off = [value for value, _, _ in shown], any(off for _, off, _ in shown)
            attributes = shown[0][2]
            one.bounds = tuple(attributes["bounds"]) if "bounds" in attributes else None  # type: ignore[assignment]
            if "options" in attributes:
                one.options = {name: json.loads(value) for name, value in attributes["options"]}
                one.values = [json.loads(value) for value in one.values]

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        has = {name: value or "" for name, value in attrs}
        if "data-shows" in has:
            for name, *rest in json.loads(has["data-shows"]):
                self._shown[name] = tuple(rest)
        if tag == "label":
            self._field = SeenField(hint=has.get("title", ""))
        if self._field is not None and "data-field" in has and has["name"] not in self._field.names:
            if not self._field.names:
                self.fields.append(self._field)
            self._field.names.append(has["name"])
            self._field.asks.append(tuple(json.loads(has["data-field"])))
            self._field.done = has.get("data-done", "")
        if tag in _VOID:
            return
        button = None
        if "data-do" in has or has.get("aria-disabled") == "true":
            does = COMMANDS.decode(*json.loads(has["data-do"])) if "data-do" in has else None
            button = SeenButton(
                has.get("aria-label", ""), does, has.get("aria-pressed") == "true", has.get("title", "")
            )
            self.buttons.append(button)
        self._open.append(button)
        self._labelled = tag == "span" and self._field is not None and not self._field.names

    def handle_endtag(self, tag: str) -> None:
        if tag == "label":
            self._field = None
        if tag not in _VOID and self._open:
            self._open.pop()
        self._labelled = False

    def handle_data(self, data: str) -> None:
        if self._field is not None and self._labelled:
            self._field.label += data
        for button in self._open:
            if button is not None:
                button.text += data
