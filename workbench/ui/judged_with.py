"""Which code recorded episodes can be judged with: what the server knows of, by name, and never a path from a page.

Usually it is today's text of the file that each recording names. But that may be an installed package, or the author
edits a copy: then the file that is open live is meant, or one that was named on the command line.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from workbench.authoring.reference import RecordedTask, named_file
from workbench.recording.episode import EpisodeInfo
from workbench.session.recorded_text import version_of
from workbench.session.step_back import class_in, reference_of

TODAYS, RECORDED = "today's", "as recorded"
MOST_NAMED = 3


@dataclass(frozen=True)
class Code:
    """One choice."""

    label: str
    told: str
    """What is opened, in words."""
    file: Path | None = None
    """Asked before the files that the recordings name."""
    recorded: bool = False


def codes_for(infos: Sequence[EpisodeInfo], known: Sequence[Path]) -> tuple[Code, ...]:
    """The choices for these recordings; today's code and the recorded text are always the first two.

    Args:
        infos: Of the recordings that are open; of others nothing is known before they are judged.
        known: Task files besides those that the recordings name.
    """
    named = list({str(reference): reference for reference in map(reference_of, infos)}.values())
    own = {file for file in map(named_file, named) if file is not None}
    codes = [Code(TODAYS, _todays(infos, named)), Code(RECORDED, _recorded(infos), recorded=True)]
    for file in dict.fromkeys(known):
        # Of recordings that are not open it is not known whether it has their task; those of another are left alone.
        if file not in own and (not infos or any(class_in(file, info.task) for info in infos)):
            taken = {code.label for code in codes}
            label = file.name if file.name not in taken else str(Path(file.parent.name, file.name))
            if label not in taken:
                codes.append(Code(label, f"With {file} as it is now.", file))
    return tuple(codes)


def _todays(infos: Sequence[EpisodeInfo], named: Sequence[RecordedTask]) -> str:
    if not infos:
        return "Each recording with the file that it names, as that is now."
    told = [_in_words(reference) for reference in named[:MOST_NAMED]]
    more = f", and {len(named) - MOST_NAMED} more" if len(named) > MOST_NAMED else ""
    return f"With {', '.join(told)}{more}."


def _in_words(reference: RecordedTask) -> str:
    file = named_file(reference)
    return f"{reference} as it is installed" if file is None else f"{file} as it is now"


def _recorded(infos: Sequence[EpisodeInfo]) -> str:
    hashes = list(dict.fromkeys(version for info in infos if (version := version_of(info))))
    version = f" (version {', '.join(hashes[:MOST_NAMED])})" if hashes else ""
    return f"With the text that each recording holds{version}. It runs here; you are asked first where it was not recorded here."
