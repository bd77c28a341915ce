"""The user's consents persist across programs, and neither a full disk nor an unreadable store loses them."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from workbench.task.content import TaskContent
from workbench.trust import store as trust
from workbench.trust.store import STORE_FILE, TrustStore


def content(text: str = "a", file: str = "/author/push.py") -> TaskContent:
    return TaskContent(file, {file: text})


@pytest.fixture(autouse=True)
def store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    return tmp_path / "workbench" / STORE_FILE


def test_once_lasts_until_the_program_ends(store: Path) -> None:
    kept = TrustStore()
    kept.trust_once(content("one"))
    kept.trust_once(content("two"), followed=True)
    assert kept.trusts(content("one")) and not kept.follows(content("one"))
    assert kept.follows(content("two")) and not kept.follows(content("two", "/other/push.py"))
    assert not TrustStore().trusts(content("one")) and not store.exists()


@pytest.mark.parametrize(
    "text",
    [
        "",
        '{"trusted": [{"hash": 1}]}',
        '{"trusted": [{"hash": "1", "file": "", "when": "", "files": [1]}]}',
        "[" * 100_000,
    ],
)
def test_a_broken_store_trusts_nothing_is_reported_once_and_backed_up(
    store: Path, text: str, caplog: pytest.LogCaptureFixture
) -> None:
    store.parent.mkdir()
    store.write_text(text)
    kept = TrustStore()
    assert not kept.trusts(content()) and not kept.trusts(content())
    (said,) = [record.message for record in caplog.records if "broken" in record.message]
    assert str(store) in said
    kept.trust(content())
    assert TrustStore().trusts(content())
    assert store.with_name(f"{STORE_FILE}.broken").read_text() == text


def test_a_store_writable_by_others_trusts_nothing(store: Path, caplog: pytest.LogCaptureFixture) -> None:
    TrustStore().trust(content())
    store.chmod(0o666)
    assert not TrustStore().trusts(content()) and "chmod go-w" in caplog.text
    store.chmod(0o600)
    store.parent.chmod(0o777)
    assert not TrustStore().trusts(content())


@pytest.mark.parametrize("call", ["fsync", "replace"])
def test_an_answer_that_cannot_be_stored_counts_in_this_run_and_removes_no_other(
    store: Path, call: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    TrustStore().trust(content("one"))
    before = store.read_bytes()
    kept = TrustStore()

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(os, call, full)
        for text in ("two", "three"):
            kept.trust(content(text))
    assert all(kept.trusts(content(text)) for text in ("one", "two", "three"))
    (warning,) = [record.message for record in caplog.records]  # once
    assert "asked again in the next run" in warning and "No space left" in warning
    assert store.read_bytes() == before and not TrustStore().trusts(content("two"))
    assert sorted(path.name for path in store.parent.iterdir()) == [STORE_FILE, f"{STORE_FILE}.lock"]
    kept.trust(content("four"))
    assert TrustStore().trusts(content("four")) and TrustStore().trusts(content("one"))


def test_a_temporarily_unreadable_store_is_not_overwritten(
    store: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    TrustStore().trust(content("one"))
    before = store.read_bytes()
    kept = TrustStore()

    def fail(name: str) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO), name)

    with monkeypatch.context() as patch:
        patch.setattr(trust, "read_private", fail)
        assert not kept.trusts(content("one"))
        kept.trust(content("two"))
        assert kept.trusts(content("two"))
    assert store.read_bytes() == before and TrustStore().trusts(content("one"))
    assert "cannot be read" in caplog.text and "cannot be stored" in caplog.text
