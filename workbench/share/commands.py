"""What is made of recordings to be shared, and rerun's viewer."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

from workbench.page.command import Command

What = Literal["film", "scene", "page", "sheet", "zip", "lerobot", "maniskill"]
LONGEST_INSTRUCTION = 400
"""Characters."""


class ChooseShared(Command, frozen=True):
    """Choose whether the open recordings are shared, or the selected ones."""

    opened: bool


class ChooseMade(Command, frozen=True):
    """Choose what is made of recordings."""

    what: What


class ChooseFilmed(Command, frozen=True):
    """Choose the camera that a video is made of."""

    camera: str
    """Empty for every camera."""


class TakeOnlySuccesses(Command, frozen=True):
    """Leave recordings that reach success at no step out of a dataset, or not."""

    on: bool


class TakeOnlyCompatible(Command, frozen=True):
    """Leave recordings that cannot be read, or lack what the first one has, out of a dataset, or not."""

    on: bool


class TypeInstruction(Command, frozen=True):
    """Type the task of a dataset in words."""

    words: Annotated[str, msgspec.Meta(max_length=LONGEST_INSTRUCTION)]


class MakeShared(Command, frozen=True):
    """Make something of the selected or open recordings."""


class StopMaking(Command, frozen=True):
    """Stop making something of recordings."""


class OpenInRerun(Command, frozen=True):
    """Open the selected or open recordings in rerun."""


class CloseRerun(Command, frozen=True):
    """Close rerun."""
