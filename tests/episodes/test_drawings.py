"""What a task draws is recorded where it changes, bounded, and read back by the workbench and by rerun."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.drive.episodes import Made
from tests.episodes.read_rrd import read_rrd
from tests.episodes.verify_rrd import verify_rrd
from workbench.envs.task_drawings import ITEM_SHAPES, Drawing, DrawingKind
from workbench.episodes.document import read_json, with_checksum
from workbench.episodes.drawings import (
    MAX_DRAWING_BYTES,
    MAX_DRAWINGS,
    DrawingTrack,
    DrawingWriter,
    drawing_tracks,
    wrong_drawings,
)
from workbench.episodes.reader.read_episode import read_episode
from workbench.episodes.row import UnreadableRecording

Maker = Callable[..., Made]


def drawing(
    kind: DrawingKind,
    *items: float,
    color: tuple[int, int, int] = (1, 2, 3),
    size: float = 0.5,
    text: str = "word",
) -> Drawing:
    """A drawing of one env: item k is at (items[k], ...)."""
    shape = ITEM_SHAPES[kind]
    data = np.add.outer(items, np.arange(np.prod(shape))).reshape(1, len(items), *shape).astype(np.float32)
    return Drawing(kind, data, color, size, (text,) if kind == "text" else ())


KINDS: st.SearchStrategy[DrawingKind] = st.sampled_from(tuple(ITEM_SHAPES))
DRAWINGS = st.builds(
    lambda kind, items, color, size, text: drawing(kind, *items, color=color, size=size, text=text),
    KINDS,
    st.lists(st.integers(-9, 9), max_size=3),
    st.tuples(*[st.integers(0, 255)] * 3),
    st.sampled_from([0.25, 0.5, 2.0]),
    st.sampled_from(["word", "other", "ü \ud800"]),
)


def assert_same(found: Mapping[str, Drawing], wanted: Mapping[str, Drawing]) -> None:
    wanted = {name: one for name, one in wanted.items() if one.data.size}
    assert found.keys() == wanted.keys()
    for name, one in wanted.items():
        there = found[name]
        np.testing.assert_allclose(there.data, one.data, atol=1e-5)
        assert there.kind == one.kind
        assert there.texts == tuple(text.encode("utf-8", "replace").decode() for text in one.texts)
        if one.kind != "frames":
            assert there.color == one.color
        if one.kind in ("points", "arrows", "frames"):
            assert there.size == pytest.approx(one.size)


@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    states=st.lists(
        st.dictionaries(st.sampled_from(["a", "a/b", "ü ", ""]), DRAWINGS), min_size=4, max_size=4
    )
)
def test_every_state_has_its_own_drawings(make_episode: Maker, states: list[dict[str, Drawing]]) -> None:
    made = make_episode(3)
    made.drawn = states
    with tempfile.TemporaryDirectory() as folder:
        episode = read_episode(made.write(Path(folder)).json)
    for state, wanted in enumerate(states):
        assert_same(episode.drawings_at(state), {name or "unnamed": one for name, one in wanted.items()})


def test_rerun_shows_each_drawing_from_the_state_where_it_changes(
    child_process: None, make_episode: Maker, tmp_path: Path
) -> None:
    made = make_episode(3)
    turned = np.array([[[1, 0, 0, np.sqrt(0.5), 0, 0, np.sqrt(0.5)]]], np.float32)
    fixed = {"spawn": Drawing("frames", turned, size=0.2), "way": drawing("arrows", 1.0, 2.0, size=0.4)}
    made.drawn = [
        *[{**fixed, "dots": drawing("points", 1.0), "name": drawing("text", 0.0)}] * 2,
        {**fixed, "dots": drawing("points", 5.0, 6.0), "edge": drawing("lines", 1.0)},
        {**fixed, "edge": drawing("lines", 1.0)},
    ]
    path = made.write(tmp_path).rrd
    assert verify_rrd(path) is None
    entities = read_rrd(path)
    dots = entities["/drawings/points/dots"]["Points3D:positions"]
    np.testing.assert_array_equal(dots.steps, [0, 2, 3])
    assert [len(row) for row in dots.values] == [1, 2, 0]
    np.testing.assert_array_equal(dots.values[1], [[5, 6, 7], [6, 7, 8]])
    np.testing.assert_array_equal(entities["/drawings/points/dots"]["Points3D:radii"].values[0], [0.25])
    name = entities["/drawings/text/name"]
    assert name["Points3D:labels"].values[0] == ["word"] and len(name["Points3D:positions"].values[1]) == 0
    assert list(name["Points3D:show_labels"].values[0]) == [True]
    arrows = entities["/drawings/arrows/way"]
    np.testing.assert_array_equal(arrows["Arrows3D:origins"].values[0], [[1, 2, 3], [2, 3, 4]])
    np.testing.assert_array_equal(arrows["Arrows3D:vectors"].values[0], [[3, 3, 3], [3, 3, 3]])
    strips = np.array(entities["/drawings/frames/spawn"]["LineStrips3D:strips"].values[0])
    np.testing.assert_allclose(strips[:, 0], [[1, 0, 0]] * 3, atol=1e-6)
    np.testing.assert_allclose(strips[:, 1], [[1, 0.2, 0], [0.8, 0, 0], [1, 0, 0.2]], atol=1e-6)
    np.testing.assert_array_equal(entities["/drawings/lines/edge"]["LineStrips3D:strips"].steps, [2])
    assert len(entities["/drawings/frames/spawn"]["LineStrips3D:colors"].values[0]) == 3
    made.drawn = [
        {"way": drawing("frames", 1.0, size=size), "a": drawing("text", 1.0, text="")}
        for size in (1, 2, 1, 1)
    ]
    entities = read_rrd(made.write(tmp_path).rrd)
    lengths = [
        np.linalg.norm(np.array(strips)[0, 1] - np.array(strips)[0, 0])
        for strips in entities["/drawings/frames/way"]["LineStrips3D:strips"].values
    ]
    assert lengths == pytest.approx([1, 2, 1]), "each row has its own size"
    assert entities["/drawings/text/a"]["Points3D:labels"].values[0] == ["a"]


def test_a_task_that_draws_nothing_pays_nothing(make_episode: Maker, tmp_path: Path) -> None:
    files = make_episode(3).write(tmp_path)
    assert "drawings" not in read_json(files.json)["workbench"]
    assert not [entity for entity in read_rrd(files.rrd) if entity.startswith("/drawings")]


def recorded(states: int, drawn: Callable[[int], dict[str, Drawing]]) -> tuple[dict[str, DrawingTrack], int]:
    """The tracks of an episode, by name, and the size of its lines."""
    writer = DrawingWriter()
    lines = [line for state in range(states) for line in writer.changes(state, drawn(state))]
    tracks = drawing_tracks(lines)
    assert wrong_drawings(tracks, states) is None
    return {f"{track.name} {track.kind}": track for track in tracks}, sum(len(line) for _, line in lines)


def test_a_drawing_that_grows_too_large_ends_with_a_text_at_its_place() -> None:
    def drawn(state: int) -> dict[str, Drawing]:
        return {"cloud": drawing("points", *range(state, state + 2000)), "dot": drawing("points", state)}

    tracks, size = recorded(1500, drawn)
    assert 0.9 * MAX_DRAWING_BYTES < size <= MAX_DRAWING_BYTES
    end = int(tracks["cloud text"].states[0])
    assert 1000 < end < 1499 and tracks["cloud points"].at(end - 1) and not tracks["cloud points"].at(end)
    message = tracks["cloud text"].at(1499)
    assert message is not None and message.data[0, 0, 0] == end and message.color == (255, 0, 0)
    last = tracks["dot points"].at(1499)
    assert last is not None and last.data[0, 0, 0] == 1499, "small drawings are still recorded"


def test_new_names_at_every_step_end_with_a_text() -> None:
    tracks, _ = recorded(
        MAX_DRAWINGS + 50,
        lambda state: {f"{name} {'x' * 300}": drawing("points", 1.0) for name in range(state)},
    )
    assert len(tracks) == MAX_DRAWINGS + 1
    (message,) = [track for track in tracks.values() if track.kind == "text"]
    assert message.states.tolist() == [MAX_DRAWINGS + 1] and message.at(MAX_DRAWINGS + 49)


def test_a_description_with_too_many_or_unknown_drawings_is_refused(
    make_episode: Maker, tmp_path: Path
) -> None:
    made = make_episode(2)
    made.drawn = [{"a": drawing("points", 1.0)}] * 3
    path = made.write(tmp_path).json
    document = read_json(path)
    for drawings in ([["a", "blob"]], [["a", "points"]] * 2, [["b", "text"]] * 5000):
        document["workbench"]["drawings"] = drawings
        path.write_bytes(with_checksum(msgspec.json.encode(document)))
        with pytest.raises(UnreadableRecording, match="broken one"):
            read_episode(path)
