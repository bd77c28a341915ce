"""One state of one env, written by hand and passed to a writer as a recorder does."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from workbench.envs.camera_data import Picture
from workbench.envs.step_result import OtherEntry
from workbench.envs.task_drawings import Drawing
from workbench.episodes.columns import BATCH, EVALUATE, OBS, STATE, BatchPacker, Layout
from workbench.episodes.writing.episode_writer import EpisodeWriter


@dataclass(frozen=True)
class EpisodeRow:
    poses: NDArray
    """(B, 7)"""
    evaluate: Mapping[str, NDArray] = field(default_factory=dict)
    env_states: Mapping[str, NDArray] = field(default_factory=dict)
    obs: Mapping[str, NDArray] = field(default_factory=dict)
    action: NDArray | None = None
    """(A,) action that led to this state; None in state 0."""
    reward: float = 0.0
    terminated: bool = False
    truncated: bool = False
    pictures: tuple[Picture, ...] = ()
    others: Mapping[str, OtherEntry] = field(default_factory=dict)
    drawn: Mapping[str, Drawing] = field(default_factory=dict)


_packers: WeakKeyDictionary[EpisodeWriter, BatchPacker] = WeakKeyDictionary()


def packed(row: EpisodeRow, packer: BatchPacker, actions: int) -> tuple[Layout, bytes]:
    """`row` as a batch of one env; `actions` is the length of an action."""
    action = np.zeros(actions) if row.action is None else row.action
    columns: dict[str, object] = {
        "poses": np.asarray(row.poses, np.float32),
        "action": np.asarray(action, np.float32),
        "reward": np.float32(row.reward),
        "terminated": np.bool_(row.terminated),
        "truncated": np.bool_(row.truncated),
    }
    batch = {name: entry.numbers for name, entry in row.others.items() if entry.numbers is not None}
    parts = ((EVALUATE, row.evaluate), (BATCH, batch), (STATE, row.env_states), (OBS, row.obs))
    columns |= {prefix + name: value for prefix, held in parts for name, value in held.items()}
    layout, (content,) = packer.pack([(name, np.asarray(v)[None]) for name, v in columns.items()])
    return layout, content


def append(writer: EpisodeWriter, row: EpisodeRow) -> None:
    packer = _packers.setdefault(writer, BatchPacker())
    writer.append(*packed(row, packer, writer.actions), row.pictures, row.others, row.drawn)
