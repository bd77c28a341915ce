"""Any .json of a foreign recording gives values that commands and the page can use, or is reported as damaged."""

from __future__ import annotations

import copy
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.drive.episodes import made, write
from tests.episodes.foreign_h5 import write as write_foreign
from workbench.episodes.episode import Episode
from workbench.episodes.maniskill.write import maniskill_json
from workbench.episodes.reader.reading import find_all_sources, read_recording
from workbench.episodes.recorded_source import (
    CannotEnterRecording,
    changed_on_disk,
    options_of,
    recorded_version,
    reference_of,
    run_of,
    write_source,
)
from workbench.episodes.row import UnreadableRecording
from workbench.episodes.seal import made_here
from workbench.episodes.side_files import side_files_text
from workbench.machine.processes.wire import Unpacker, pack
from workbench.rescore.recording_jobs import group_episodes
from workbench.review.panel import facts_html
from workbench.review.view import Opened, find_events
from workbench.trust.clearance import Clearances, NotCleared

LONG = "LONG"
"""Stands for 5,000 characters."""
NAMES = [
    LONG, f"{'y' * 300}/b.py", "a\0b", "../" * 60 + "a.py", "/", "", ".", "..", "~", "\ud800", "\u202eyp.x", "<b>", "a\nb", "{0}",
    "/dev/zero", "/proc/self/mem", "é" * 200,
]  # fmt: skip
DEEP = "nested"
"""Stands for a list in a list in a list ..."""
VALUES = st.one_of(
    st.sampled_from(NAMES),
    st.sampled_from([None, True, 0, -1, 2**31, 2**63, 10**40, 0.0, -1.0, 1e-300, 1e300, float("nan"), float("inf")]),
    st.text(st.characters(exclude_categories=()), max_size=20),
    st.sampled_from(["9999-12-31T23:59:59+00:00", "0001-01-01T00:00:00", "2026-01-01T00:00:00+23:59", "<f8", "|O", ">f4"]),
    st.sampled_from([[], {}, [1], {"a": 1}, {LONG: LONG}, {"a\0": "\0"}, {"../../x.py": "y"}, {"/etc/passwd": "0" * 12}]),
    st.just(DEEP),
)  # fmt: skip


def places(value: Any, at: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The path of each value in a document."""
    if at:
        yield at
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for name, one in inner:
        yield from places(one, (*at, name))


def put(document: Any, at: tuple[Any, ...], value: Any, as_name: bool) -> None:
    """Replace the value at this path, or its name, if the path still exists."""
    *before, last = at
    try:
        for step in before:
            document = document[step]
        if as_name and isinstance(document, dict) and isinstance(value, str):
            document[value] = document.pop(last)
        else:
            document[last] = value
    except (KeyError, IndexError, TypeError):
        pass


@pytest.fixture(scope="module")
def originals(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The .json of a workbench recording with all fields, and of a ManiSkill recording."""
    folder = tmp_path_factory.mktemp("ours")
    (folder / "push.py").write_text("reward = 1\n")
    episode = made(
        4,
        2,
        source_file=str(folder / "push.py"),
        source={str(folder / "push.py"): "reward = 1\n", str(folder / "lib.py"): "x = 1\n"},
        side_files={"meshes/a.obj": "0" * 12},
        env_kwargs={"obs_mode": "state", "sim_config": {"control_freq": 20}},
        reset_options={"k": [1, {"a": "b"}]},
        versions={"torch": "2"},
        acted_by=((0, "random"), (2, "sliders")),
        max_episode_steps=50,
    )
    ours = write(folder / "recordings", episode)
    theirs = write_foreign(tmp_path_factory.mktemp("theirs")).with_suffix(".json")
    document = json.loads(theirs.read_text())
    document["env_info"] |= {"env_kwargs": {"obs_mode": "state"}, "max_episode_steps": 50}
    document["episodes"][0] |= {
        "episode_seed": 3,
        "control_mode": "pd_joint_delta_pos",
        "reset_kwargs": {"seed": 3, "options": {"a": [1]}},
        "success": False,
    }
    theirs.write_text(json.dumps(document | {"source_type": "human", "source_desc": "x"}))
    return {"ours": ours, "theirs": theirs}


def use(episode: Episode, path: Path) -> None:
    """Do what commands and the page do with a recording before any of its code runs."""
    info = episode.info
    reference_of(info)
    options_of(info, 1)
    changed_on_disk(info)
    recorded_version(info)
    made_here(info)
    side_files_text(info.source_file, info.side_files)
    run_of(episode)
    json.dumps(maniskill_json(episode))
    try:
        folder, _ = write_source(info)
        shutil.rmtree(folder)
    except CannotEnterRecording:
        pass
    html = facts_html(Opened("id", path.stem, episode, find_events(episode)), "")
    assert len(html) < 1 << 20
    html.encode()
    assert Unpacker().unpack(pack(info), type(info)) is not None


@settings(max_examples=80)
@given(
    which=st.sampled_from(["ours", "ours", "theirs"]),
    changes=st.lists(st.tuples(st.integers(0, 10**6), VALUES, st.booleans()), min_size=1, max_size=4),
)
def test_a_document_of_any_values_is_read_or_reported(
    child_process: None, originals: dict[str, Path], which: str, changes: list[tuple[int, Any, bool]]
) -> None:
    path = originals[which]
    before = path.read_bytes()
    document = json.loads(before)
    if which == "ours":
        document["workbench_checksum"] = None
    everywhere = list(places(document))
    for number, value, as_name in changes:
        put(document, everywhere[number % len(everywhere)], copy.deepcopy(value), as_name)
    text = json.dumps(document).replace(f'"{DEEP}"', "[" * 400 + "]" * 400)
    path.write_text(text.replace(LONG, "x" * 5000))
    try:
        try:
            sources = find_all_sources([path])
        except UnreadableRecording:
            return  # the file now belongs to another program
        for source in sources:
            assert len(source.name) < 1000 and len(source.id) < 10_000
            try:
                episode = read_recording(source)
            except UnreadableRecording as error:
                assert path.stem in str(error)
                continue
            use(episode, path)
        groups, unreadable = group_episodes(sources, 4)
        for group in groups:
            try:
                Clearances().clear(group.code)
            except NotCleared:
                pass
        assert len(unreadable) + sum(len(group.files) for group in groups) == len(sources)
    finally:
        path.write_bytes(before)
