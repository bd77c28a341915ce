"""Checks of what bodies do while the task runs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from workbench.checks.evidence.collect import Checkup, Found, NotApplicable, Note
from workbench.checks.evidence.over_seeds import together, tried
from workbench.checks.evidence.rolled_episodes import SeenOutlier
from workbench.checks.register_rule import outlier_check
from workbench.checks.results import Seen
from workbench.checks.rules.placement import where_placed
from workbench.envs.scene.scene_index import scene_index
from workbench.machine.text import listed, of


def see_bodies_stay(checkup: Checkup) -> Iterator[Seen]:
    """A row for each body that leaves the scene before the end of a random rollout."""
    rollouts = checkup.random
    of_owner: dict[str, list[SeenOutlier]] = {}
    for seen in sorted(rollouts.outliers, key=lambda seen: (seen.step, seen.seed)):
        if seen.kind.rule == "bodies-stay":
            of_owner.setdefault(seen.body.split("/", 1)[0], []).append(seen)
    moves = any(kind in ("dynamic", "link") for kind in scene_index(checkup.task.env).kinds)
    yield Seen(tried=len(rollouts.seeds), count=int(moves))
    for owner, every in of_owner.items():
        first, seeds = every[0], sorted({seen.seed for seen in every})
        yield Seen(
            (owner,),
            where_placed(checkup, first.body),
            seeds=tuple(seeds),
            size=-float(first.step),
            texts=(f"{first.reason} at step {first.step} of seed {first.seed}",),
        )


@outlier_check("bodies-stay", see=see_bodies_stay)
def bodies_stay(rows: Sequence[Seen]) -> Iterator[Found | Note]:
    if not any(row.count for row in rows if not row.names):
        raise NotApplicable("nothing in the task moves")
    for row in sorted(together(rows, worst=True), key=lambda row: -row.size):
        yield Found(
            f"{row.texts[0]}. The body leaves the scene in {of(len(row.seeds), tried(rows), 'random episode')} "
            f"(seed {listed(row.seeds)}). Avoid overlaps and throwing, or return `fail` from evaluate() when the body is "
            "lost.",
            row.place,
            len(row.seeds),
        )
