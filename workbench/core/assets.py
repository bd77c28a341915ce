"""Robots and scenes that must be downloaded first: say which and how, and never ask on stdin.

ManiSkill asks "download now? (y|n)" on standard input and leaves the process with ``exit()`` when the
answer is no. A worker has no standard input, and nobody asked for gigabytes; so the question becomes
an error that names the asset and the command.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from mani_skill.utils import assets, download_asset


class MissingAssets(RuntimeError):
    """The task cannot be built before something is downloaded."""


def require_assets(task: str, asset_ids: Sequence[str]) -> None:
    """Raise MissingAssets unless everything in ``asset_download_ids`` is on this machine."""
    missing = []
    for asset_id in asset_ids:
        group = asset_id in assets.DATA_GROUPS
        sources = assets.expand_data_group_into_individual_data_source_ids(asset_id) if group else [asset_id]
        missing += [source for source in sources if not assets.is_data_source_downloaded(source)]
    if missing:
        commands = "\n".join(f"  python -m mani_skill.utils.download_asset {asset}" for asset in missing)
        raise MissingAssets(f"{task} needs {', '.join(missing)}, which is not downloaded. Type:\n{commands}")


@contextmanager
def refuse_download_prompts() -> Iterator[None]:
    """While this is on, ManiSkill's download question raises MissingAssets instead of reading stdin."""

    def refuse(message: str) -> bool:
        raise MissingAssets(
            f"{message.split(' Would you')[0]} It is not downloaded. "
            "Type: python -m mani_skill.utils.download_asset NAME (a robot's or scene's name)"
        )

    asked = download_asset.prompt_yes_no
    download_asset.prompt_yes_no = refuse
    try:
        yield
    finally:
        download_asset.prompt_yes_no = asked
