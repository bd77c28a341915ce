"""What a judgement says, in sentences: the page shows these, and tests read them."""

from __future__ import annotations

import math

from workbench.session.judge import JudgementView
from workbench.session.judgement import EpisodeDifference, Summary
from workbench.session.lengths import length
from workbench.session.number_text import number_text
from workbench.session.otherwise import counted, reward_change, turned

FAR_METRES = 1e-3
FAR_RADIANS = 1e-2
"""A body that is further than this from where it was makes a comparison of rewards doubtful."""


def headline(view: JudgementView) -> str:
    """One sentence on what differs; empty while nothing is known."""
    summary = view.summary
    if summary is None:
        return ""
    so_far = "" if view.state == "done" else " so far"
    if summary.differing:
        return f"{summary.differing} of {counted(summary.episodes, 'episode')} differ{so_far}."
    sentence = f"Nothing differs in {counted(summary.episodes, 'episode')}{so_far}: reward, success and fail are as they were."
    others = sorted(summary.differing_names)[:4]
    return sentence + (f" Other entries differ: {', '.join(others)}." if others else "")


def in_a_line(view: JudgementView) -> str:
    """For who does not see the rest; empty while there is nothing to say."""
    if view.state == "loading":
        return "The past is judged again: loading the new code"
    if view.state == "judging":
        # In tenths, or a page that is played on would be written to at every look.
        return f"The past is judged again: {10 * int(10 * view.done / max(1, view.total))} %"
    says = {"none": "", "done": headline(view)}.get(view.state, view.why)
    return f"The past, judged again: {says}" if says else ""


def numbers(view: JudgementView) -> list[str]:
    """Success and return over all episodes, before and now, where they differ."""
    summary = view.summary
    if summary is None or summary.differing == 0:
        return []
    lines: list[str] = []
    if summary.successes is not None and summary.successes[0] != summary.successes[1]:
        lines.append(f"episodes with success: {summary.successes[0]} → {summary.successes[1]}")
    was, now = (_mean(*told) for told in zip(summary.mean_return, summary.lost_returns, strict=True))
    if was != now:
        lines.append(f"mean return: {was} → {now}")
    return lines


def is_far(summary: Summary) -> bool:
    """Whether the drift is a reason to doubt the comparison."""
    return not (summary.drift_metres <= FAR_METRES and summary.drift_radians <= FAR_RADIANS)


def drift(summary: Summary) -> str:
    """One sentence on how far the states are from the record."""
    if summary.drift_metres == 0 and summary.drift_radians == 0:
        return "Every body is where it was, to the last bit: what differs comes of the code."
    amount = f"{length(summary.drift_metres)} and {math.degrees(summary.drift_radians):.2g}°"
    if not is_far(summary):
        return f"States drifted by at most {amount}: the rewards are comparable."
    where = "" if summary.drift_at is None else f", most in env {summary.drift_at[0]}"
    return f"States drifted by up to {amount}{where}: where they did, what differs may come of that and not of the code."


def difference(episode: EpisodeDifference) -> list[str]:
    """What is otherwise in one episode: success and fail, or else the reward."""
    flags = (("success", episode.success), ("fail", episode.fail))
    lines = [turned(name, was, now) for name, (was, now) in flags if was != now]
    return lines or [reward_change(episode.largest, episode.returns)]


def change(was: float, now: float) -> str:
    return f"{number_text(was)} → {number_text(now)}"


def _mean(mean: float, lost: str) -> str:
    return ", ".join(part for part in ("" if math.isnan(mean) else number_text(mean), lost) if part)
