"""What the author's code draws into the 3-D view with `workbench.draw`, until a step result takes it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

DrawingKind = Literal["points", "lines", "arrows", "frames", "text"]
ITEM_SHAPES: Mapping[DrawingKind, tuple[int, ...]] = {
    "points": (3,),
    "lines": (2, 3),
    "arrows": (2, 3),
    "frames": (7,),
    "text": (3,),
}
"""Shape of one item: a position; start and end; position and quaternion wxyz."""
MAX_ITEMS = 2000
"""Maximum number of points, lines, arrows or frames of one drawing, per env."""


@dataclass(frozen=True)
class Drawing:
    """One named drawing in all envs."""

    kind: DrawingKind
    data: NDArray[np.float32]
    """(N, K, ...) with K items of the shape in `ITEM_SHAPES`, in the frame of each env, metres; rows are NaN for envs in
    which it is not drawn."""
    color: tuple[int, int, int] = (255, 146, 43)
    size: float = 0.01
    """Diameter of points, width of arrows, length of the axes of frames, in metres; not used for lines and text."""
    texts: tuple[str, ...] = ()
    """(N,) texts of a drawing of kind ``text``."""

    @property
    def nbytes(self) -> int:
        """Approximate memory in bytes."""
        return 200 + self.data.nbytes + sum(map(len, self.texts))

    def of_env(self, env: int) -> Drawing:
        """The drawing in one env, as a batch of 1, without its NaN items."""
        data = self.data[env]
        data = data[np.isfinite(data).all(axis=tuple(range(1, data.ndim)))]
        return replace(self, data=data[None], texts=self.texts[env : env + 1])


class TaskDrawings:
    """The drawings of the running task by name. A drawing stays until one of the same name replaces it."""

    def __init__(self) -> None:
        self.on = False
        """Whether a workbench shows them; if not, nothing is kept."""
        self._drawn: dict[str, Drawing] = {}
        self._begun: set[str] = set()
        """Names drawn since `begin_version`."""

    def put(self, name: str, drawing: Drawing, env_idx: Sequence[int] | None = None) -> None:
        """Draw in all envs, or replace the rows of these envs.

        Args:
            drawing: has a row for each env, or for each env of `env_idx`.
        """
        self._begun.add(name)
        before = self._drawn.get(name)
        if env_idx is None:
            self._drawn[name] = drawing
            return
        kept = before if before is not None and before.kind == drawing.kind else None
        old = drawing.data[:0] if kept is None else kept.data
        count = max(max(env_idx, default=-1) + 1, len(old))
        items = max(old.shape[1], drawing.data.shape[1])
        data = np.full((count, items, *drawing.data.shape[2:]), np.nan, np.float32)
        data[: len(old), : old.shape[1]] = old
        texts = [*(() if kept is None else kept.texts), *[""] * count][:count]
        for row, env in enumerate(env_idx):
            data[env] = np.nan
            data[env, : drawing.data.shape[1]] = drawing.data[row]
            if drawing.texts:
                texts[env] = drawing.texts[row]
        self._drawn[name] = replace(drawing, data=data, texts=tuple(texts) if drawing.texts else ())

    def remove(self, name: str) -> None:
        """Remove a drawing; nothing happens if there is none of this name."""
        self._drawn.pop(name, None)

    @contextmanager
    def taken_into(self, drawn: dict[str, Drawing]) -> Iterator[None]:
        """Within this context, keep drawings in `drawn`. Drawings of other envs of the process stay out of it."""
        before = self.on, self._drawn
        self.on, self._drawn = True, drawn
        try:
            yield
        finally:
            self.on, self._drawn = before

    def begin_version(self) -> None:
        """Begin to load a version."""
        self._begun.clear()

    def scene_replaced(self) -> None:
        """Drop what the version that is loaded has not drawn: the scene was built again."""
        self._drawn = {name: drawing for name, drawing in self._drawn.items() if name in self._begun}

    def of_batch(self, num_envs: int) -> dict[str, Drawing]:
        """The drawings, by name, with a row for each of `num_envs` envs. A drawing with fewer rows gets NaN rows, which
        draw nothing; a drawing with more rows is left out."""
        found = {}
        for name, drawing in self._drawn.items():
            if len(drawing.data) < num_envs:
                more = num_envs - len(drawing.data)
                pad = np.full((more, *drawing.data.shape[1:]), np.nan, np.float32)
                texts = (*drawing.texts, *[""] * more) if drawing.texts else ()
                drawing = replace(drawing, data=np.concatenate([drawing.data, pad]), texts=texts)
            if len(drawing.data) == num_envs:
                found[name] = drawing
        return found


drawings = TaskDrawings()
"""The drawings of this process's task."""
