"""Inputs of our own: what is entered goes on the channel of commands, so that a command that follows it finds it done."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import msgspec
import viser

from workbench.page.command import Command, name_of
from workbench.page.widgets.templates import render

LONGEST = 4096
"""Maximum number of characters."""
Plain = str | float | bool | None
Look = Literal["text", "choice", "tick", "slider"]


class Field:
    """One input, or several in a row, in the present container.

    What is entered goes into a field of a command. It is sent when it has been typed (Enter, Tab, or a press elsewhere) or
    chosen; that of a slider, and of a `live` text, at once, the newest while one is unanswered. Whole and other numbers have
    the bounds of the command's field, and what is no such number is refused in the browser. An input is drawn once, since one
    that is drawn again loses the cursor; what the server has comes beside it (`show`), and is copied into it while nobody uses it.
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
        longest: int = LONGEST,
        lines: int = 1,
        step: float = 1.0,
        options: Mapping[str, Plain] | None = None,
    ) -> None:
        """
        Args:
            kind: the command that what is entered goes into.
            field: its field.
            value: what is shown at first; one for each of `given`, if there are several.
            given: the command's other fields, for each of the inputs in the row.
            enter: what Enter does; by default it leaves the field.
            lines: more than one for a larger box, in which Enter begins a line.
            step: of a number: what an arrow key adds.
            options: of a choice: values of the field by what is shown for them.
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
        """Show what the server has.

        Args:
            value: one for each input of the row, if there are several.
            off: nobody can use it.
            options: the new ones of a choice.
            bounds: of a slider.
        """
        if options is not None:
            self._options = _encoded(options)
        self._bounds = bounds or self._bounds
        several = value if isinstance(value, (tuple, list)) else (value,)
        if self._options is not None:
            several = [json.dumps(one) for one in several]
        more = {"options": self._options, "bounds": self._bounds}
        told = {name: one for name, one in more.items() if one is not None}
        self._shown.content = render(
            "shows",
            shows=json.dumps(
                [[name, one, off, told] for name, one in zip(self._names, several, strict=True)]
            ),
        )

    @property
    def name(self) -> str:
        """Name of its first input, in the page."""
        return self._names[0]

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
    """A list of which one is chosen.

    Args:
        options: values of the command's field by what is shown for them, or texts that are both.
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
    """A box to tick."""
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
) -> Field:
    """A slider with its number next to it, at its lower end until `Field.show` sets a value.

    Args:
        bounds: its ends, by default those of the command's field.
    """
    low, high, _ = _number(kind, field, float) or (None, None, False)
    ends = bounds or (low or 0.0, high or 0.0)
    made = Field(
        server, label, kind, field, ends[0], look="slider", given=(given or {},), hint=hint, step=step
    )
    made.show(ends[0], bounds=ends)
    return made


def _encoded(options: Mapping[str, Plain]) -> list[tuple[str, str]]:
    return [(name, json.dumps(value)) for name, value in options.items()]


def _number(kind: type[Command], field: str, entered: type) -> tuple[float | None, float | None, bool] | None:
    """Least, greatest, and whether it is whole, of a number; None for a text.

    Args:
        entered: of a field with several types, the one of this input.
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
