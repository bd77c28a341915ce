"""What a verdict on a recorded episode says, in words and as rows: the page, the terminal and files show these."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from workbench.recording.replace_file import replace_file
from workbench.session.lengths import length
from workbench.session.number_text import mean_text, number_text
from workbench.session.otherwise import counted, reward_change, turned
from workbench.session.rescore_messages import Verdict


def what_changed(verdict: Verdict) -> str:
    """Success and fail, or else the reward; ``as it was`` where nothing is another."""
    if verdict.why_not:
        return f"not judged: {verdict.why_not}"
    flags = (("success", verdict.success), ("fail", verdict.fail))
    told = [turned(name, was, now) for name, (was, now) in flags if was != now]
    if told:
        return ", ".join(told)
    if verdict.differs:
        return f"{reward_change(verdict.largest, verdict.returns)}, from step {verdict.first_difference}"
    if verdict.differing:
        return f"as it was, but for {', '.join(verdict.differing[:3])}"
    return "as it was"


def returns(verdict: Verdict) -> str:
    if math.isnan(verdict.returns[0]) and np.isnan(verdict.old_reward).all():
        return f"none → {number_text(verdict.returns[1])}"
    was, now = (number_text(value) for value in verdict.returns)
    return was if was == now else f"{was} → {now}"


def drift(verdict: Verdict) -> str:
    """How far the bodies were from the record."""
    if verdict.metres is None:
        return "not known"
    return "none" if verdict.metres == 0 else length(verdict.metres)


def summary(verdicts: Sequence[Verdict]) -> str:
    """One sentence over all of them."""
    judged = [verdict for verdict in verdicts if not verdict.why_not]
    if not judged:
        return "No episode could be judged."
    differing = sum(verdict.differs for verdict in judged)
    sentence = (
        f"{differing} of {counted(len(judged), 'episode')} {'differs' if differing == 1 else 'differ'}"
        if differing
        else f"Nothing differs in {counted(len(judged), 'episode')}: reward, success and fail are as they were"
    )
    if any(verdict.has_success for verdict in judged):
        was, now = (sum(verdict.success[k] is not None for verdict in judged) for k in (0, 1))
        sentence += f"; successes: {was}" + ("" if was == now else f" → {now}")
    was, now = (mean_text([v.returns[k] for v in judged]) for k in (0, 1))
    sentence += f"; mean return {was}" + ("" if was == now else f" → {now}")
    skipped = len(verdicts) - len(judged)
    return sentence + (f"; {counted(skipped, 'episode')} not judged" if skipped else "") + "."


def doubts(verdicts: Sequence[Verdict]) -> str:
    """What makes the comparison doubtful; empty for nothing."""
    far = [verdict for verdict in verdicts if verdict.drifted]
    if not far:
        return ""
    worst = max(verdict.metres or 0.0 for verdict in far)
    return (
        f"In {counted(len(far), 'episode')} bodies came up to {length(worst)} from where they were: what differs there "
        "may come of that, and not of the code. With the recorded states put in at every step nothing drifts."
    )


def not_carried(verdicts: Sequence[Verdict]) -> tuple[str, ...]:
    """What could not be put back, each once with its reason."""
    return tuple(dict.fromkeys(f"{what}: {why}" for v in verdicts for what, why in v.missed.items()))


def as_rows(verdicts: Sequence[Verdict]) -> list[dict[str, Any]]:
    """One flat dict an episode, as JSON can say it."""
    return [
        {
            "episode": verdict.file.name,
            "file": str(verdict.file.path),
            "trajectory": verdict.file.trajectory,
            "task": verdict.task,
            "seed": verdict.seed if verdict.seed >= 0 else None,
            "length": verdict.length,
            "success_before": verdict.success[0],
            "success_now": verdict.success[1],
            "fail_before": verdict.fail[0],
            "fail_now": verdict.fail[1],
            "return_before": verdict.returns[0],
            "return_now": verdict.returns[1],
            "differs": verdict.differs,
            "first_difference": verdict.first_difference,
            "largest_reward_change": verdict.largest,
            "other_entries": ", ".join(verdict.differing),
            "drift_metres": verdict.metres,
            "drift_at": verdict.drift_at,
            "first_state_put_in": verdict.begins_otherwise,
            "not_carried": "; ".join(f"{what}: {why}" for what, why in verdict.missed.items()),
            "not_judged": verdict.why_not,
        }
        for verdict in verdicts
    ]


def as_csv(verdicts: Sequence[Verdict]) -> str:
    rows = as_rows(verdicts)
    text = io.StringIO()
    writer = csv.DictWriter(text, [*rows[0]] if rows else [], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def as_json(verdicts: Sequence[Verdict]) -> str:
    """With ``NaN`` and infinities as null, which JSON has not."""
    rows = [{key: _finite(value) for key, value in row.items()} for row in as_rows(verdicts)]
    return json.dumps(rows, indent=1) + "\n"


def write_table(path: Path, text: str) -> None:
    """Whole or not at all, in place of what was there.

    Raises:
        OSError: it cannot be written.
    """
    replace_file(path, text.encode())


def _finite(value: Any) -> Any:
    return None if isinstance(value, float) and not -float("inf") < value < float("inf") else value
