"""The error of files that are no recording."""

from __future__ import annotations


class UnreadableRecording(ValueError):
    """A file that is no recording, or a broken one; the message says what is wrong with it in a sentence."""
