"""A recording as an `Episode` again, whoever wrote it."""

from __future__ import annotations

from pathlib import Path

from workbench.recording.episode import Episode


def read_episode(path: Path) -> Episode:
    """The episode of our own files; `path` is its .rrd, .h5 or .json, and the others are found beside it.

    What a missing file would have held is empty: without the .rrd no geometry, poses and pictures, without the .h5 no env
    states and observations. The geometry is that of this env alone, as env 0 of 1.

    Raises:
        UnreadableRecording: what is there is no recording of ours, or broken; the message says which.
    """
    raise NotImplementedError


def read_maniskill(path: Path, trajectory: str) -> Episode:
    """Episode `trajectory` (``traj_0``) of an .h5 that ManiSkill's RecordEpisode wrote; its .json lies beside it.

    It has no geometry and no poses. Raises as `read_episode`.
    """
    raise NotImplementedError


def trajectories(path: Path) -> tuple[str, ...]:
    """Names of the episodes in a ManiSkill .h5, in order. Raises as `read_episode`."""
    raise NotImplementedError


class UnreadableRecording(ValueError):
    """A file that is no recording, or a broken one; the message says what is wrong with it in a sentence."""
