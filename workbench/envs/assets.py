"""Names the assets that a task needs and this machine lacks; never downloads them."""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from traceback import walk_tb
from types import TracebackType
from typing import Any

from mani_skill import ASSET_DIR
from mani_skill.agents import base_agent
from mani_skill.agents.registration import REGISTERED_AGENTS
from mani_skill.utils import assets, download_asset
from mani_skill.utils.assets import data

from workbench.envs.broken_rule import in_brackets
from workbench.envs.error_notes import CoreRefusal, Place
from workbench.envs.robot_notes import place_of_robot_file

_COMMAND = "python -m mani_skill.utils.download_asset"
_A_PATH = re.compile(r"(?:/|[A-Za-z]:\\)[^\s'\"]+")


class MissingAssets(CoreRefusal, RuntimeError):
    """The task needs assets that are not downloaded."""

    def __init__(self, message: str, names: Sequence[str] = (), place: Place | None = None) -> None:
        super().__init__(message, place=place)
        self.names = tuple(names)
        """Arguments of ``python -m mani_skill.utils.download_asset``, one for each missing asset."""


def require_assets(task: str, asset_ids: Sequence[str], robot_uids: Any = None) -> None:
    """Raise MissingAssets unless every asset that the task and its robots declare is on this machine.

    Args:
        asset_ids: the ``asset_download_ids`` that the task was registered with.
        robot_uids: as the task class takes them: a uid, an agent class, or a tuple of them; see `robots_of`.
    """
    names = [name for name in asset_ids if _sources_to_fetch(name)]
    names += [name for uid in _uids(robot_uids) for name in _missing_for_robot(uid)]
    if names:
        raise _missing(task, names)


def robots_of(task: type, kwargs: Mapping[str, Any]) -> Any:
    """``robot_uids`` as the task class will see them: from `kwargs`, else the default of the class's
    constructor.

    None if the constructor has no such parameter, or gives it no default: the constructor may then pass any
    robot to the constructor of its parent class.
    """
    if "robot_uids" in kwargs:
        return kwargs["robot_uids"]
    parameter = inspect.signature(task.__init__).parameters.get("robot_uids")
    return None if parameter is None or parameter.default is inspect.Parameter.empty else parameter.default


def assets_at(path: str | Path) -> list[str]:
    """The names of ManiSkill's downloads that contain `path`, the outermost first.

    A dataset may be inside another one's folder, and downloading the outer one clears that folder.
    """
    wanted = Path(path)
    found = []
    for name, source in assets.DATA_SOURCES.items():
        if source.target_path is not None:
            kept_at = Path(source.output_dir) / source.target_path
            if kept_at == wanted or kept_at in wanted.parents:
                found.append((len(kept_at.parts), name))
    return [name for _, name in sorted(found)]


@contextmanager
def refuse_downloads(task: str) -> Iterator[None]:
    """Context in which an asset that `task` lacks raises MissingAssets.

    Some tasks declare no assets and fail on a missing file while they build. If ManiSkill notices the missing
    file, it asks "download now? (y|n)" on standard input, calls ``exit()`` after a no, and treats
    MS_SKIP_ASSET_DOWNLOAD_PROMPT as a yes. Here nothing is asked or downloaded. An exception becomes the
    cause of a MissingAssets if a download would provide the missing file, or if the file of a robot is
    missing; other exceptions pass.
    """

    @wraps(download_asset.prompt_yes_no)
    def ask(message: str) -> bool:
        asking = sys._getframe(1)
        if asking.f_code.co_filename == base_agent.__file__:
            raise _robot_without_file(task, type(asking.f_locals["self"]))
        raise _missing(task, [], message.split(" Would you")[0])

    @wraps(download_asset.download)
    def download(data_source: data.DataSource, *args: object, **kwargs: object) -> None:
        names = [name for name, known in assets.DATA_SOURCES.items() if known is data_source]
        raise _missing(task, names)

    stock_ask, stock_download = download_asset.prompt_yes_no, download_asset.download
    download_asset.prompt_yes_no, download_asset.download = ask, download  # type: ignore[assignment]
    try:
        yield
    except MissingAssets:
        raise
    except Exception as error:
        names = _named_by(error)
        if names:
            raise _missing(task, names) from error
        loaded = _robot_loaded(error.__traceback__)
        if loaded is not None and not loaded[1].exists():
            raise _no_robot_file(task, *loaded) from error
        raise
    finally:
        download_asset.prompt_yes_no, download_asset.download = stock_ask, stock_download


def _missing(task: str, names: Iterable[str], instead: str = "") -> MissingAssets:
    names = list(dict.fromkeys(names))
    if not names:
        return MissingAssets(f"{task}: {instead} Nothing is downloaded automatically. Type: {_COMMAND} NAME")
    commands = "\n".join(f"  {_COMMAND} {name}" for name in names)
    are = "is" if len(names) == 1 else "are"
    return MissingAssets(
        f"{task} needs {', '.join(names)}, which {are} not downloaded. Type:\n{commands}", names
    )


def _sources_to_fetch(name: str) -> list[str]:
    """The downloads that are missing: of all assets in the group `name`, or of the asset `name`."""
    group = name in assets.DATA_GROUPS
    sources = assets.expand_data_group_into_individual_data_source_ids(name) if group else [name]
    return [source for source in sources if not assets.is_data_source_downloaded(source)]


def _uids(robot_uids: Any) -> list[str]:
    several = robot_uids if isinstance(robot_uids, (tuple, list)) else [robot_uids]
    uids = [robot if isinstance(robot, str) else getattr(robot, "uid", None) for robot in several]
    return [uid for uid in uids if uid in REGISTERED_AGENTS]


def _file_of(agent: Any) -> Path | None:
    path = getattr(agent, "urdf_path", None) or getattr(agent, "mjcf_path", None)
    return None if path is None else Path(str(path))


def _missing_for_robot(uid: str) -> list[str]:
    path = _file_of(REGISTERED_AGENTS[uid].agent_cls)
    if path is None or path.exists():
        return []
    return assets_at(path) or list(REGISTERED_AGENTS[uid].asset_download_ids)


def _robot_without_file(task: str, robot: Any) -> MissingAssets:
    names = _missing_for_robot(robot.uid) if robot.uid in REGISTERED_AGENTS else []
    return _missing(task, names) if names else _no_robot_file(task, robot, _file_of(robot))


def _no_robot_file(task: str, robot: type, path: Path | None) -> MissingAssets:
    place = place_of_robot_file(robot)
    return MissingAssets(
        f"{task}: the file of the robot {robot.__name__}, {path}, does not exist{in_brackets(place)}, and ManiSkill has no "
        f"download for it. {_how_to_name(path)}",
        place=place,
    )


def _how_to_name(path: Path | None) -> str:
    """Advice for a missing robot file."""
    if path is None or path.is_absolute():
        return "Put the file there, or set the path of the file that you have."
    return (
        f"A relative path starts at the working directory: there is no {path.absolute()}. "
        "Set an absolute path."
    )


def _named_by(error: Exception) -> list[str]:
    """The downloads that contain the missing file which caused the exception."""
    text = str(error)
    advised = re.search(r"mani_skill\.utils\.download_asset\s+([\w/\-]+)", text)
    if advised is not None and advised[1] in {*assets.DATA_GROUPS, *assets.DATA_SOURCES}:
        return [advised[1]]
    paths = [Path(found.rstrip(".,:;)")) for found in _A_PATH.findall(text)]
    if isinstance(error, OSError) and error.filename is not None:
        paths.insert(0, Path(str(error.filename)))
    for path in paths:
        if Path(ASSET_DIR) in path.parents and not path.exists():
            names = [name for name in assets_at(path) if not assets.is_data_source_downloaded(name)]
            # If all are downloaded, one was downloaded in part: name the innermost, to download it again.
            return names or assets_at(path)[-1:]
    return []


def _robot_loaded(trace: TracebackType | None) -> tuple[type, Path] | None:
    """The class of the robot that was being loaded, and its file.

    Both are read from the frames: for an agent class that was never registered, the exception is a bare
    KeyError with the robot's uid, from ManiSkill's look-up.
    """
    for frame, _ in walk_tb(trace):
        if frame.f_code.co_filename == base_agent.__file__ and "asset_path" in frame.f_locals:
            return type(frame.f_locals["self"]), Path(str(frame.f_locals["asset_path"]))
    return None
