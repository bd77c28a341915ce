"""Result folders of ``workbench sweep``, made without running a sweep."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

from tests.episodes.library_files import describe
from workbench.episodes.sweep_results import RESULTS, SweepEpisode, SweepResults, write_results

SEEDS = 12
WEIGHTS = (0.5, 1, 2)
ROBOTS = ("panda", "fetch", "nix")


def sweep_folder(folder: Path) -> SweepResults:
    """Results of three weights and three robots. The last robot fails; a larger weight solves more seeds."""
    points = list(itertools.product(WEIGHTS, ROBOTS))
    rows: list[SweepEpisode] = []
    for k, (weight, robot) in enumerate(points):
        for seed in range(SEEDS):
            if robot == "nix":
                rows.append(SweepEpisode(k, seed, failure="push.py:12: KeyError: 'nix'"))
                continue
            name = f"p{k}s{seed:02}"
            (folder / f"{k}").mkdir(exist_ok=True)
            describe(folder / f"{k}", name, id=name, seed=seed)
            solved = seed < 3 * WEIGHTS.index(weight) + (4 if robot == "panda" else 1)
            means = {"reward_terms/reach": 0.1 * seed / weight, "reward_terms/push": weight, "height": 1.0}
            at = 10 + seed if solved else None
            total = weight * (20 - seed)
            rows.append(SweepEpisode(k, seed, solved, solved, at, 30, total, means, f"{k}/{name}.rrd"))
    named = tuple({"reach_weight": json.dumps(w), "robot_uids": json.dumps(r)} for w, r in points)
    results = SweepResults("push.py", "policies/push.py:act", SEEDS, named, tuple(rows))
    write_results(folder / RESULTS, results)
    return results
