"""Seals by which this installation recognizes its own recordings."""

from __future__ import annotations

import hmac
import json
import logging
import os
import secrets
from collections.abc import Mapping, Sequence
from enum import Enum
from hashlib import sha256
from typing import Any

from workbench.episodes.document import SHARED, Description, SealJson, as_json
from workbench.episodes.episode import EpisodeInfo
from workbench.machine.folders import create_private, read_private, set_aside

log = logging.getLogger(__name__)

KEY_FILE = "recordings.key"
_KEY_BYTES = 32
_COVERED = {*SHARED, "seed", "source"} - {"acted_by", "pictures", "moved_cameras", "observed_by"}
"""Fields that a seal covers; `_content` adds ``acted_by``. The other three excluded fields stay uncovered, so
that the seals of older versions, which do not cover them, stay valid."""
_logged: set[str] = set()


class InstallationSeal(Enum):
    """Whether this installation made a recording, judged by its seal: a keyed hash (HMAC-SHA256) with a random key that only
    this user can read.

    The seal covers what decides which code runs when the recording is rescored or entered (task, text, keyword arguments),
    and the checksums of its files. Tags and notes may change, and a moved recording keeps its seal. The path of the task's
    file has its own hash: a recording that was sent away and comes back with a different file next to it must
    not run that file.
    """

    NO = "no"
    """The recording is foreign or was changed, or the key is lost."""
    CONTENT = "content"
    """This installation recorded it, but the task's file is at another path, or missing."""
    CONTENT_AND_PLACE = "content and place"
    """This installation recorded it, and the task's file is at the recorded path; the text of the file may
    have changed."""


def seal(description: Description, source_file: str | None) -> SealJson | None:
    """The seal for a new recording with this `description`; None without a usable key, which is logged once.

    Args:
        source_file: the absolute path of the task's file.
    """
    values = {name: getattr(description, name) for name in _COVERED}
    content = _content(values, description.source_file, description.files, description.acted_by)
    key = _any_key()
    if key is None:
        return None
    return SealJson(_mac(key, "content", content), _mac(key, "place", source_file or ""))


def made_here(info: EpisodeInfo) -> InstallationSeal:
    """Check the seal of the recording that `info` was read from."""
    found = info.seal
    if found is None:
        return InstallationSeal.NO
    values = {name: getattr(info, name) for name in _COVERED}
    values["seed"] = info.seed if info.seed >= 0 else None
    try:
        content = _content(values, found.main, found.files, info.acted_by)
    except (TypeError, ValueError, RecursionError):
        return InstallationSeal.NO
    if not is_sealed(content, found.content, "content"):
        return InstallationSeal.NO
    place = info.source_file
    there = place is not None and os.path.isabs(place) and is_sealed(place, found.place, "place")
    return InstallationSeal.CONTENT_AND_PLACE if there else InstallationSeal.CONTENT


def seal_text(text: str, what: str = "text") -> str | None:
    """Seal a text that this installation reads back, such as a journal's header; None without a usable key,
    which is logged once.

    Args:
        what: kind of text; the seal is invalid for another kind.
    """
    key = _any_key()
    return None if key is None else _mac(key, what, text)


def is_sealed(text: str, found: object, what: str = "text") -> bool:
    """Whether `found` is this installation's `seal_text` of the same arguments."""
    try:
        key = _key()
    except OSError as error:
        _log_once(f"Recordings cannot be checked for the seal of this installation: {error}")
        return False
    if key is None or not isinstance(found, str):
        return False
    return hmac.compare_digest(found.encode("utf-8", "surrogatepass"), _mac(key, what, text).encode())


def _content(values: Mapping[str, Any], main: Any, files: Any, acted_by: Sequence[Sequence[Any]]) -> str:
    """Canonical JSON text: equal for values that are equal as JSON."""
    return json.dumps(as_json([values, main, files, acted_by]), sort_keys=True)


def _mac(key: bytes, what: str, text: str) -> str:
    return hmac.new(key, f"{what}\0{text}".encode("utf-8", "surrogatepass"), sha256).hexdigest()


def _any_key() -> bytes | None:
    """The key, created if there is none; None if it cannot be read or written, which is logged once."""
    try:
        return _key() or _new_key()
    except OSError as error:
        _log_once(f"Recordings of this session cannot be sealed as made here: {error}")
        return None


def _key() -> bytes | None:
    """The key; None if there is none or it is broken."""
    written = read_private(KEY_FILE)
    try:
        key = None if written is None else bytes.fromhex(written.decode("ascii"))
    except ValueError:
        return None
    return key if key is not None and len(key) == _KEY_BYTES else None


def _new_key() -> bytes:
    if read_private(KEY_FILE) is not None:
        broken = set_aside(KEY_FILE)
        _log_once(
            f"The key that seals this installation's recordings was broken and was moved to {broken}; "
            "there is a new key."
        )
    create_private(KEY_FILE, secrets.token_hex(_KEY_BYTES).encode())  # unless another process just did
    key = _key()
    if key is None:
        raise OSError("the new key cannot be read back")
    return key


def _log_once(what: str) -> None:
    if what not in _logged:
        _logged.add(what)
        log.warning("%s", what)
