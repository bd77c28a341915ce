"""Our own input fields: values go through the command channel, so that a later command sees them applied."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import msgspec
import viser

from workbench.page.command import Command, name_of
from workbench.page.widgets.templates import render

MAX_CHARACTERS = 4096
Plain = str | float | bool | None
Look = Literal["text", "choice", "tick", "slider"]


class Field:
    """One input, or several in a row, in the present container.

    The value goes into a field of a command. It is committed on Enter, Tab or blur, or when an option is
    chosen. A slider and a `live` text send every change at once; while a reply is pending, only the newest
    value is kept. Numbers have the bounds of the command's field, and the browser refuses other values. An
    input is drawn once, because redrawing loses the cursor; the server's value is sent separately (`show`)
    and copied into the input while the input is not in use.
    """

    def __init__(
        self,
        server: viser.ViserServer | viser.ClientHandle,
        label: str,
        kind: type[Command],
        field: str,
        value: Plain | Sequence[Plain] = "",
        *,
        look: Look = "text",
        given: Sequence[Mapping[str, Plain]] = ({},),
        hint: str = "",
        live: bool = False,
        enter: Command | None = None,
        longest: int = MAX_CHARACTERS,
        lines: int = 1,
        step: float = 1.0,
        options: Mapping[str, Plain] | None = None,
        done: type[Command] | None = None,
        note: str = "",
    ) -> None:
        """
        Args:
            kind: the command that the value goes into.
            field: the command's field.
            value: initial value; one for each of `given`, if there are several.
            given: the command's other fields, for each input in the row.
            enter: command for Enter; by default Enter leaves the field.
            lines: more than one for a larger box, in which Enter begins a new line.
            step: for a number: the change per press of an arrow key.
            options: for a choice: values of the field by their label.
            done: for a slider: the command, with the same fields, that is sent when a drag ends or a number
                is entered; by default `kind`.
            note: small text under the label.
        """
        self._names = [".".join([look, name_of(kind), field, *map(str, one.values())]) for one in given]
        self._options = None if options is None else _encoded(options)
        first = value if isinstance(value, (tuple, list)) else (value,)
        number = _number(kind, field, type(first[0])) if look in ("text", "slider") else None
        self._bounds: tuple[float, float] | None = None
        """Bounds of a slider."""
        self._input = server.gui.add_html(
            render(
                "field",
                label=label,
                look=look,
                inputs=[
                    (name, json.dumps([name_of(kind), dict(one), field]), shown)
                    for name, one, shown in zip(self._names, given, first, strict=True)
                ],
                hint=hint,
                number="" if number is None else json.dumps([*number[:2], step, number[2]]),
                live=live,
                enter=enter,
                longest=longest,
                lines=lines,
                done="" if done is None else name_of(done),
                note=note,
            )
        )
        self._shown = server.gui.add_html("")
        self.show(value)

    def show(
        self,
        value: Plain | Sequence[Plain],
        *,
        off: bool = False,
        options: Mapping[str, Plain] | None = None,
        bounds: tuple[float, float] | None = None,
    ) -> None:
        """Show the server's value.

        Args:
            value: one for each input in the row, if there are several.
            off: whether the input is disabled.
            options: new options of a choice.
            bounds: new bounds of a slider.
        """
        if options is not None:
            self._options = _encoded(options)
        self._bounds = bounds or self._bounds
        several = value if isinstance(value, (tuple, list)) else (value,)
        if self._options is not None:
            several = [json.dumps(one) for one in several]
        more = {"options": self._options, "bounds": self._bounds}
        changed = {name: one for name, one in more.items() if one is not None}
        self._shown.content = render(
            "shows",
            shows=json.dumps(
                [[name, one, off, changed] for name, one in zip(self._names, several, strict=True)]
            ),
        )

    @property
    def name(self) -> str:
        """Name of the first input in the page."""
        return self._names[0]

    @property
    def order(self) -> float:
        """viser's order of the last of its elements."""
        return self._shown.order

    @property
    def visible(self) -> bool:
        return self._input.visible

    @visible.setter
    def visible(self, visible: bool) -> None:
        self._input.visible = visible

    def remove(self) -> None:
        self._input.remove()
        self._shown.remove()


def choice(
    server: viser.ViserServer | viser.ClientHandle,
    label: str,
    kind: type[Command],
    field: str,
    options: Mapping[str, Plain] | Sequence[str],
    value: Plain,
    *,
    given: Mapping[str, Plain] | None = None,
    hint: str = "",
) -> Field:
    """A list from which one option is chosen.

    Args:
        options: values of the command's field by their label, or texts that are both value and label.
    """
    return Field(
        server,
        label,
        kind,
        field,
        value,
        look="choice",
        given=(given or {},),
        hint=hint,
        options=by_name(options),
    )


def by_name(options: Mapping[str, Plain] | Sequence[str]) -> Mapping[str, Plain]:
    return options if isinstance(options, Mapping) else {one: one for one in options}


def tick(
    server: viser.ViserServer | viser.ClientHandle,
    label: str,
    kind: type[Command],
    field: str,
    value: bool,
    *,
    given: Mapping[str, Plain] | None = None,
    hint: str = "",
) -> Field:
    """A checkbox."""
    return Field(server, label, kind, field, value, look="tick", given=(given or {},), hint=hint)


def slider(
    server: viser.ViserServer | viser.ClientHandle,
    label: str,
    kind: type[Command],
    field: str,
    bounds: tuple[float, float] | None = None,
    *,
    step: float = 1.0,
    given: Mapping[str, Plain] | None = None,
    hint: str = "",
    done: type[Command] | None = None,
    note: str = "",
) -> Field:
    """A slider with a number next to it. It shows its lower end until `Field.show` sets a value.

    Args:
        bounds: ends of the slider; by default the bounds of the command's field.
        done, note: see `Field`.
    """
    low, high, _ = _number(kind, field, float) or (None, None, False)
    ends = bounds or (low or 0.0, high or 0.0)
    made = Field(
        server,
        label,
        kind,
        field,
        ends[0],
        look="slider",
        given=(given or {},),
        hint=hint,
        step=step,
        done=done,
        note=note,
    )
    made.show(ends[0], bounds=ends)
    return made


def _encoded(options: Mapping[str, Plain]) -> list[tuple[str, str]]:
    return [(name, json.dumps(value)) for name, value in options.items()]


def _number(kind: type[Command], field: str, entered: type) -> tuple[float | None, float | None, bool] | None:
    """(minimum, maximum, whether the number is an integer); None for a text.

    Args:
        entered: type of this input, for a field with several types.
    """
    (types,) = (one.type for one in msgspec.structs.fields(kind) if one.name == field)
    found: Any = msgspec.inspect.type_info(types)
    if isinstance(found, msgspec.inspect.UnionType):
        some = [one for one in found.types if not isinstance(one, msgspec.inspect.NoneType)]
        found = some[0] if len(some) == 1 else msgspec.inspect.type_info(entered)
    if not isinstance(found, (msgspec.inspect.IntType, msgspec.inspect.FloatType)):
        return None
    low = found.ge if found.ge is not None else found.gt
    high = found.le if found.le is not None else found.lt
    return low, high, isinstance(found, msgspec.inspect.IntType)
