"""Episodes that are uploaded when they end: complete ones only, each once, and no local file stays."""

from __future__ import annotations

import json
import uuid
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import fsspec
import pytest
from moto.server import ThreadedMotoServer

from workbench.episodes.reader.read_episode import read_episode
from workbench.episodes.writing.finish_or_recover import EpisodeFiles
from workbench.episodes.writing.publish import RecordingError
from workbench.episodes.writing.upload import remove_uploaded_id, require_place, upload_episode, upload_file
from workbench.jobs.scheduler import Scheduler, ThisProcess, Work
from workbench.record.job import record
from workbench.record.job_worker import RecordOptions, episode_id
from workbench.task.description import TaskOptions


@pytest.fixture(scope="module")
def bucket() -> Iterator[str]:
    """Address of an empty prefix on an S3 server on the loopback address."""
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    patch = pytest.MonkeyPatch()
    for name, value in {
        "AWS_ENDPOINT_URL": f"http://{host}:{port}",
        "AWS_ACCESS_KEY_ID": "test",
        "AWS_SECRET_ACCESS_KEY": "test",
        "AWS_DEFAULT_REGION": "us-east-1",
    }.items():
        patch.setenv(name, value)
    fsspec.filesystem("s3").mkdir("demos")
    yield "s3://demos/pushed"
    fsspec.filesystem("s3").clear_instance_cache()
    patch.undo()
    server.stop()


def asked(out: Path, upload: str, **other: Any) -> RecordOptions:
    options = TaskOptions(num_envs=2, env_kwargs={"render_backend": "none"})
    return RecordOptions(
        "PushCube-v1", out, pictures=False, max_steps=3, upload=upload, options=options, **other
    )


def names(address: str) -> list[str]:
    system, path = fsspec.core.url_to_fs(address)
    system.invalidate_cache()
    return sorted(name.rpartition("/")[2] for name in system.ls(path, detail=False))


@pytest.mark.slow
def test_episodes_are_uploaded_and_not_kept_locally(bucket: str, tmp_path: Path) -> None:
    done = record(asked(tmp_path / "out", bucket, episodes=3))
    assert [one.address.partition("pushed/")[0] for one in done.written] == ["s3://demos/"] * 3
    stems = [one.path.stem for one in done.written]
    assert names(bucket) == sorted(f"{stem}{suffix}" for stem in stems for suffix in (".rrd", ".h5", ".json"))
    assert not (tmp_path / "out").exists()
    system, path = fsspec.core.url_to_fs(bucket)
    system.get(path, str(tmp_path / "back"), recursive=True)
    episode = read_episode(next((tmp_path / "back").glob("*seed0001*.rrd")))
    assert (episode.info.seed, episode.length) == (1, 3)


FIRST_IS_LATE = """
import torch
from mani_skill.envs.tasks import PushCubeEnv
from mani_skill.utils.registration import register_env


@register_env("UploadedLate-v1", max_episode_steps=9, override=True)
class LateEnv(PushCubeEnv):
    def evaluate(self):
        return {"success": self.elapsed_steps >= torch.where(torch.arange(self.num_envs) == 0, 3, 1)}
"""


def test_a_later_success_that_finished_first_is_removed_from_the_upload_too(tmp_path: Path) -> None:
    place, file = (tmp_path / "there").as_uri(), tmp_path / "late.py"
    file.write_text(FIRST_IS_LATE)
    (kept,) = record(replace(asked(tmp_path / "out", place, successes=1), task=str(file))).written
    assert (kept.seed, kept.steps) == (0, 3)
    assert names(place) == sorted(f"{kept.path.stem}{suffix}" for suffix in (".rrd", ".h5", ".json"))


def test_an_upload_left_by_a_dead_worker_is_replaced(tmp_path: Path) -> None:
    place = (tmp_path / "there").as_uri()
    what, run = asked(tmp_path / "out", place, episodes=2), uuid.uuid4().hex
    first = record(what, run=run)

    class Again:
        is_remote = False

        def run(self, work: Work, scheduler: Scheduler) -> None:
            # As if the first worker had died before it reported the first episode.
            scheduler.go_on({1: first.written[1]}, lambda number, written: None)
            ThisProcess().run(work, scheduler)

    again = record(what, executor=Again(), run=run)
    documents = [json.loads(path.read_text()) for path in (tmp_path / "there").glob("*.json")]
    ids = sorted(document["workbench"]["id"] for document in documents)
    assert ids == sorted(episode_id(run, number) for number in range(2))
    assert len(again.written) == 2 and len(names(place)) == 6


def _files(folder: Path) -> EpisodeFiles:
    paths = [folder / f"Task_seed0001_env00_now{suffix}" for suffix in (".rrd", ".h5", ".json")]
    for path in paths:
        path.write_text('{"workbench": {"id": "mine"}}')
    rrd, h5, json_file = paths
    return EpisodeFiles(rrd, h5, json_file, None, {})


def test_the_json_is_uploaded_last_so_a_partial_upload_is_no_episode(tmp_path: Path) -> None:
    files, place = _files(tmp_path), tmp_path / "there"
    place.mkdir()
    (place / files.h5.name).mkdir()  # a folder cannot be overwritten by a file
    with pytest.raises(RecordingError, match=r"Cannot upload Task_seed0001.*to file://"):
        upload_episode(files, place.as_uri())
    assert not (place / files.json.name).exists() and files.json.exists(), "the local file must not be lost"


def test_only_the_episode_with_that_id_is_removed(tmp_path: Path) -> None:
    files, place = _files(tmp_path), (tmp_path / "there").as_uri()
    require_place(place + "/")
    assert names(place) == [], "what was written to try the place is gone"
    upload_episode(files, place)
    assert not any(path.exists() for path in (files.rrd, files.h5, files.json))
    for name in ("Task_seed0001_env01_later.json", "Task_seed0001_env01_later.rrd"):
        (tmp_path / "there" / name).write_text('{"workbench": {"id": "of another"}}')
    (tmp_path / "note.txt").write_text("mine")
    upload_file(tmp_path / "note.txt", place)
    assert (tmp_path / "note.txt").exists()
    others = ["Task_seed0001_env01_later.json", "Task_seed0001_env01_later.rrd", "note.txt"]
    remove_uploaded_id(place, "Task", 1, "another")
    assert len(names(place)) == 6
    remove_uploaded_id(place, "Task", 1, "mine")
    assert names(place) == others
    for address in ((tmp_path / "note.txt").as_uri(), "unknown://there", "s4://bucket/folder"):
        with pytest.raises(RecordingError):
            require_place(address)
