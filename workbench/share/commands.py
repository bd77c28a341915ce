"""Commands that export recordings and open them in rerun's viewer."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

from workbench.page.command import Command

What = Literal["film", "scene", "page", "sheet", "zip", "lerobot", "maniskill"]
MAX_INSTRUCTION_CHARACTERS = 400


class ChooseShared(Command, frozen=True):
    """Choose whether the open or the selected recordings are shared."""

    opened: bool


class ChooseMade(Command, frozen=True):
    """Choose what to make of recordings."""

    what: What


class ChooseFilmed(Command, frozen=True):
    """Choose the camera of a video."""

    camera: str
    """Empty for all cameras."""


class TakeOnlySuccesses(Command, frozen=True):
    """Omit recordings that never reach success from a dataset, or include them."""

    on: bool


class TakeOnlyCompatible(Command, frozen=True):
    """Leave recordings that cannot be read, or lack data that the first one has, out of a dataset, or stop at them."""

    on: bool


class TypeInstruction(Command, frozen=True):
    """Type the task of a dataset as an instruction in words."""

    words: Annotated[str, msgspec.Meta(max_length=MAX_INSTRUCTION_CHARACTERS)]


class MakeShared(Command, frozen=True):
    """Make the chosen files from the selected or open recordings."""


class StopMaking(Command, frozen=True):
    """Stop the export of recordings."""


class OpenInRerun(Command, frozen=True):
    """Open the selected or open recordings in rerun."""


class CloseRerun(Command, frozen=True):
    """Close rerun."""
