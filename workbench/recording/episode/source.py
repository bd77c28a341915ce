"""One recording, not read yet: its place, and who made it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

Kind = Literal["ours", "maniskill", "lerobot"]
"""Who made a recording: which of the three ways to read it."""


class UnreadableRecording(ValueError):
    """A file that is no recording, or a broken one; the message says what is wrong with it in a sentence."""


@dataclass(frozen=True)
class Source:
    """One recording, not read yet."""

    path: Path
    """A file of ours, ManiSkill's ``.h5``, or the folder of a LeRobot dataset."""
    part: str | None = None
    """Which of several: ``traj_3``, or the number of the dataset's episode."""
    id: str = ""
    """What the caller knows it by."""
    name: str = ""
    """For people."""

    @property
    def stem(self) -> str:
        """Of the names of what is made from it."""
        stem = self.path.name if self.kind == "lerobot" else self.path.stem
        return stem if self.part is None else f"{stem}_{self.part}"

    @property
    def kind(self) -> Kind:
        if self.part is None:
            return "ours"
        return "maniskill" if self.path.suffix == ".h5" else "lerobot"
