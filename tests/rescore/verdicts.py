"""A verdict in which nothing differs, for tests that change some of its fields."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from workbench.episodes.row import Source
from workbench.rescore.verdict import Verdict


def verdict(id: str = "a", **changes: Any) -> Verdict:
    plain = Verdict(Source(Path(f"{id}.json"), None, id, f"push_{id}"), "Push-v1", 3, 5)
    reward = np.arange(5, dtype=np.float32)
    return replace(
        plain,
        **{"returns": (10.0, 10.0), "old_reward": reward, "new_reward": reward, "metres": 0.0, **changes},
    )
