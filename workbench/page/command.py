"""The base of every command, and the list of all of them."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import msgspec
import msgspec.structs

KEY_NAMES = {
    "space": "Space",
    "arrowleft": "Left arrow",
    "arrowright": "Right arrow",
    "arrowup": "Up arrow",
    "arrowdown": "Down arrow",
    "pageup": "Page Up",
    "pagedown": "Page Down",
    "home": "Home",
    "end": "End",
    "enter": "Enter",
    "escape": "Esc",
    "delete": "Delete",
}
SHORT_NAMES = {**KEY_NAMES, "arrowleft": "←", "arrowright": "→", "arrowup": "↑", "arrowdown": "↓"}
"""Names of keys for a narrow list."""
MODIFIERS = "ctrl", "alt", "shift"
"""Modifiers, in the order in which the name of a key lists them. On a Mac ``ctrl`` is also Cmd."""


class Refused(ValueError):
    """A command is not possible now, or not with these values; the message gives the user the reason."""


def name_of(kind: type[Command]) -> str:
    """The name of a command, made from its class name: ``reset_selected`` for `ResetSelected`."""
    return re.sub(r"(?<!^)(?=[A-Z])", "_", kind.__name__).lower()


class Command(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A request that a user, a script or an agent can make.

    The first line of the docstring is the help text. `CommandList.decode` refuses values that do not fit the fields.
    """

    key: ClassVar[str] = ""
    """Key that sends the command with its default values: ``s``, ``shift+arrowleft``, ``ctrl+z``."""
    context: ClassVar[str] = "page"
    """Where the key works: on every page (``page``), on the pages that name this context (see
    `keys_and_palette.register`), or while an element with this ``data-context`` is visible."""
    repeats: ClassVar[bool] = False
    """Whether a key that is held down repeats the command."""

    @classmethod
    def help(cls) -> str:
        """The help text: one sentence without its full stop."""
        return (cls.__doc__ or "").strip().split("\n")[0].removesuffix(".")

    @classmethod
    def is_in_palette(cls) -> bool:
        """Whether the palette lists the command: it needs no values, is not for a dialog, and is not a page's
        report."""
        alone = not any(field.required for field in msgspec.structs.fields(cls))
        return alone and cls.context != "dialog" and not cls.__name__.startswith("Tell")

    def encode(self) -> tuple[str, dict[str, Any]]:
        """Name and fields, as a page sends them."""
        return name_of(type(self)), msgspec.to_builtins(self)


@dataclass(frozen=True)
class Key:
    """A key and the command that it triggers."""

    key: str
    context: str
    command: str
    repeats: bool


class CommandList:
    """All commands, in groups with a heading each. Names are unique, and so are keys within a context."""

    def __init__(self, groups: Mapping[str, Iterable[type[Command]]]) -> None:
        self.groups = {heading: tuple(kinds) for heading, kinds in groups.items()}
        self.kinds = tuple(kind for kinds in self.groups.values() for kind in kinds)
        self._by_name = {name_of(kind): kind for kind in self.kinds}
        assert len(self._by_name) == len(self.kinds), "two commands have one name"
        taken = [(kind.context, kind.key) for kind in self.kinds if kind.key]
        assert len(taken) == len(set(taken)), "two commands have one key"
        assert all(is_key(kind.key) for kind in self.kinds if kind.key), "a key is not in the normal form"

    def __iter__(self) -> Iterator[type[Command]]:
        return iter(self.kinds)

    def __contains__(self, name: object) -> bool:
        return name in self._by_name

    def decode(self, name: str, fields: object) -> Command:
        """Read a command.

        Raises:
            KeyError: no command has this name.
            Refused: the values do not fit the fields.
        """
        kind = self._by_name[name]
        try:
            return msgspec.convert(fields, kind)
        except msgspec.ValidationError as fault:
            raise Refused(f"{kind.help()}: {fault}.") from None

    def keys(self) -> dict[type[Command], Key]:
        """The key of each command that has one."""
        with_key = (kind for kind in self.kinds if kind.key)
        return {kind: Key(kind.key, kind.context, name_of(kind), kind.repeats) for kind in with_key}


def is_key(key: str) -> bool:
    """Whether a key is in the normal form: modifiers in the order of `MODIFIERS`, then a lower-case character
    or a name in `KEY_NAMES`, joined by ``+``."""
    *held, last = key.split("+")
    known = len(last) == 1 and last == last.lower() or last in KEY_NAMES
    return known and held == [name for name in MODIFIERS if name in held]


def key_in_words(key: str, names: Mapping[str, str] = KEY_NAMES) -> str:
    """The key as the page and the docs show it: ``Space``, ``Shift+R``; empty for no key."""
    if not key:
        return ""
    *held, last = key.split("+")
    name = names.get(last, last.upper())
    return "+".join([*(one.capitalize() for one in held), name])
