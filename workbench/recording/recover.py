"""What a dead process left behind: journals become episodes, half-made files go."""

from __future__ import annotations

from pathlib import Path

from workbench.recording.episode_writer import EpisodeFiles


def recover(folder: Path) -> list[EpisodeFiles]:
    """Make an episode of every journal in `folder` whose writer is dead; episodes of live writers are left alone.

    A journal too short to be an episode (no control step) is removed.

    Raises:
        RecordingError: the files cannot be written; the journals stay.
    """
    raise NotImplementedError
