"""Formats verdicts as text, CSV and JSON, for the page, the terminal and files."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Collection, Sequence
from typing import Any

import numpy as np

from workbench.episodes.row import Source
from workbench.machine.text import length, mean_text, number_text
from workbench.rescore.verdict import FLAGS, MAIN, Verdict

PUT_IN = " If the recorded state is restored after every step, nothing drifts."
"""Advice about drift from a recording."""
_MAX_NAMES = 4


def change_text(verdict: Verdict[Any]) -> str:
    """Text of the change of success and fail, or else of the reward; ``unchanged`` if none of them
    differs."""
    if verdict.why_not:
        return f"not rescored: {verdict.why_not}"
    flags = (("success", verdict.success), ("fail", verdict.fail))
    changes = [_flag_text(name, was, now) for name, (was, now) in flags if was != now]
    if changes:
        return ", ".join(changes)
    if verdict.differs:
        at = f", from step {verdict.first_difference}"
        if "reward" in verdict.differing:
            return _reward_change(verdict) + at
        return f"{' and '.join(name for name in FLAGS if name in verdict.differing)} at other steps{at}"
    if verdict.differing:
        return f"unchanged, except {', '.join(verdict.differing[:3])}"
    return "unchanged"


def _flag_text(name: str, was: int | None, now: int | None) -> str:
    """Text of the first steps at which a flag was true, in the record and now (None: never)."""
    before = "never" if was is None else f"at step {was}"
    return f"{name} never now, was {before}" if now is None else f"{name} now at step {now}, was {before}"


def _reward_change(verdict: Verdict[Any]) -> str:
    """Text of the largest change of the reward; if that is not finite, text of the returns."""
    if math.isfinite(verdict.largest):
        return f"reward changed by up to {number_text(verdict.largest)}"
    was, now = verdict.returns
    if math.isfinite(was):
        return f"reward {number_text(now)} now"
    return (
        f"reward no longer {number_text(was)}"
        if math.isfinite(now)
        else f"reward {number_text(now)} at other steps"
    )


def returns_text(verdict: Verdict[Any]) -> str:
    if "reward" not in verdict.has:
        return ""
    if math.isnan(verdict.returns[0]) and np.isnan(verdict.old_reward).all():
        return f"no reward → {number_text(verdict.returns[1])}"
    return _was_now(*map(number_text, verdict.returns))


def drift_text(verdict: Verdict[Any]) -> str:
    """Text of the bodies' drift from the record."""
    if verdict.metres is None:
        return "not known"
    return "none" if verdict.metres == 0 else length(verdict.metres)


def headline(verdicts: Sequence[Verdict[Any]], so_far: bool = False, others: Collection[str] = ()) -> str:
    """One sentence on what differs.

    Args:
        others: names of further entries that differ, such as those that only one version has.
    """
    rescored = [verdict for verdict in verdicts if not verdict.why_not]
    if not rescored:
        return "No episode could be rescored." if verdicts else ""
    differing, yet = sum(verdict.differs for verdict in rescored), " so far" * so_far
    if differing:
        return f"{differing} of {counted(len(rescored), 'episode')} {'differs' if differing == 1 else 'differ'}{yet}."
    has = [name for name in MAIN if any(name in verdict.has for verdict in rescored)]
    unchanged = "there is no reward, success or fail to compare"
    if has:
        listed = f"{', '.join(has[:-1])} and {has[-1]} are" if len(has) > 1 else f"{has[0]} is"
        unchanged = f"{listed} unchanged"
    sentence = f"Nothing differs in {counted(len(rescored), 'episode')}{yet}: {unchanged}."
    named = sorted({*others, *(name for verdict in rescored for name in verdict.differing)})[:_MAX_NAMES]
    return sentence + (f" Other entries differ: {', '.join(named)}." if named else "")


def totals(verdicts: Sequence[Verdict[Any]]) -> list[str]:
    """Texts of successes and mean return, recorded and now, and of the number of episodes without a result."""
    rescored = [verdict for verdict in verdicts if not verdict.why_not]
    texts: list[str] = []
    if any(verdict.has_success for verdict in rescored):
        successes = (sum(verdict.success[k] is not None for verdict in rescored) for k in (0, 1))
        texts.append(f"episodes with success: {_was_now(*map(str, successes))}")
    if rewarded := [verdict for verdict in rescored if "reward" in verdict.has]:
        means = (mean_text([verdict.returns[k] for verdict in rewarded]) for k in (0, 1))
        texts.append(f"mean return: {_was_now(*means)}")
    skipped = len(verdicts) - len(rescored)
    return texts + ([f"{counted(skipped, 'episode')} not rescored"] if rescored and skipped else [])


def summary(verdicts: Sequence[Verdict[Any]]) -> str:
    """Headline and totals in one line."""
    return " ".join((headline(verdicts), *(f"{text[0].upper()}{text[1:]}." for text in totals(verdicts))))


def drift_summary(verdicts: Sequence[Verdict[Any]], advice: str = "") -> str:
    """Text of the bodies' drift from the record, and whether it makes the comparison doubtful; empty if unknown.

    Args:
        advice: a sentence that is added if the comparison is doubtful.
    """
    known = [verdict for verdict in verdicts if verdict.metres is not None]
    if not known:
        return ""
    furthest = max(known, key=lambda verdict: verdict.metres or 0.0)
    metres, radians = furthest.metres or 0.0, max(verdict.radians for verdict in known)
    if metres == 0 and radians == 0:
        return "Every body is exactly where it was recorded, so any difference comes from the code."
    amount = f"{length(metres)} and {math.degrees(radians):.2g}°"
    if not (far := count_drifted(known)):
        return f"States drifted by at most {amount}: the rewards are comparable."
    return (
        f"In {counted(far, 'episode')} bodies drifted by up to {amount}, furthest in {furthest.of.name}: "
        f"differences there may come from the drift and not from the code.{advice}"
    )


def count_drifted(verdicts: Sequence[Verdict[Any]]) -> int:
    """Number of episodes whose differences may come from drift instead of the code."""
    return sum(verdict.drifted for verdict in verdicts)


def not_carried(verdicts: Sequence[Verdict[Any]]) -> tuple[str, ...]:
    """State that could not be restored, with the reasons, each once."""
    return tuple(dict.fromkeys(f"{what}: {why}" for v in verdicts for what, why in v.missed.items()))


def as_rows(verdicts: Sequence[Verdict[Source]]) -> list[dict[str, Any]]:
    """One flat dict per episode, with JSON values."""
    return [
        {
            "episode": verdict.of.name,
            "file": str(verdict.of.path),
            "trajectory": verdict.of.part,
            "task": verdict.task,
            "seed": verdict.seed if verdict.seed >= 0 else None,
            "length": verdict.length,
            "success_before": verdict.success[0],
            "success_now": verdict.success[1],
            "fail_before": verdict.fail[0],
            "fail_now": verdict.fail[1],
            "return_before": verdict.returns[0] if "reward" in verdict.has else None,
            "return_now": verdict.returns[1] if "reward" in verdict.has else None,
            "differs": verdict.differs,
            "first_difference": verdict.first_difference,
            "largest_reward_change": verdict.largest,
            "other_entries": ", ".join(verdict.others),
            "drift_metres": verdict.metres,
            "drift_at": verdict.drift_at,
            "first_state_put_in": verdict.start_differs,
            "not_carried": "; ".join(f"{what}: {why}" for what, why in verdict.missed.items()),
            "not_judged": verdict.why_not,
            "damaged": verdict.damaged,
        }
        for verdict in verdicts
    ]


def as_csv(verdicts: Sequence[Verdict[Source]]) -> str:
    rows = as_rows(verdicts)
    text = io.StringIO()
    writer = csv.DictWriter(text, [*rows[0]] if rows else [], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def as_json(verdicts: Sequence[Verdict[Source]]) -> str:
    """A list of rows; NaN and infinities, which JSON lacks, become null."""
    rows = [{key: _finite(value) for key, value in row.items()} for row in as_rows(verdicts)]
    return json.dumps(rows, indent=1) + "\n"


def counted(number: int, what: str) -> str:
    """``1 episode``, ``3 episodes``."""
    return f"{number} {what}{'' if number == 1 else 's'}"


def _was_now(was: str, now: str) -> str:
    return was if was == now else f"{was} → {now}"


def _finite(value: Any) -> Any:
    return None if isinstance(value, float) and not -float("inf") < value < float("inf") else value
