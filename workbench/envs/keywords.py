"""Keyword arguments that make an env: described in the worker, parsed from text in the server. Imports no torch."""

from __future__ import annotations

import enum
import inspect
import json
import math
import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

KeywordKind = Literal["bool", "int", "float", "str", "choice", "json"]
MAX_TEXT_CHARACTERS = 2000
"""Maximum length of a value's text."""
MAX_CHOICES = 200
MAX_KEYWORDS = 40
MODES = ("robot_uids", "control_mode", "obs_mode", "reward_mode")
"""Keywords that every task of ManiSkill has and that a person chooses."""
_BASE_PARAMETERS = frozenset(
    {
        *MODES, "num_envs", "render_mode", "shader_dir", "enable_shadow", "sensor_configs", "sim_config", "sim_backend",
        "human_render_camera_configs", "viewer_camera_configs", "reconfiguration_freq", "render_backend",
        "render_device", "parallel_in_single_scene", "enhanced_determinism", "backend", "device",
    }
)  # fmt: skip
"""Parameters that tasks pass on to `BaseEnv`."""
_ABSENT: Any = object()
_ANY_TEXTURES = "any_textures"
"""Entry of ManiSkill's ``SUPPORTED_OBS_MODES`` that stands for every combination of pictures."""


@dataclass(frozen=True)
class Keyword:
    """One keyword argument of the task class."""

    name: str
    kind: KeywordKind
    value: str
    """Value in effect, in JSON; the ``repr`` of a value that JSON cannot hold."""
    default: str = ""
    """Value without the user's argument, in JSON: from the registration, else the default of the class
    (``null`` if there is none). Empty for `MODES`, and if JSON cannot hold the value."""
    choices: tuple[str, ...] = ()
    """Allowed values of kind ``choice``, in JSON."""
    optional: bool = False
    """Whether the keyword also takes ``null``."""
    fixed: str = ""
    """Why the value cannot be changed here; empty if it can."""


@dataclass(frozen=True)
class HowMade:
    """How the envs of a task are made."""

    robot: str = ""
    """Names of the robots; empty without a robot."""
    modes: tuple[Keyword, ...] = ()
    """Keywords in `MODES` that the task has."""
    own: tuple[Keyword, ...] = ()
    """The task's own keyword arguments."""


def describe_keywords(
    cls: type, env: Any, given: Mapping[str, Any], registered: Mapping[str, Any], stop: type
) -> HowMade:
    """The keywords with which `env` was made, and the values that they can have.

    Args:
        cls: the author's class.
        given: the user's keywords.
        registered: the keywords of the registration.
        stop: `BaseEnv`; its parameters are not counted as the task's own keywords.
    """
    parameters = dict(parameters_of(cls, stop))
    effective = {**registered, **given}
    own = [
        _describe(name, parameter, effective.get(name, _ABSENT), registered.get(name, _ABSENT))
        for name, parameter in list(parameters.items())[:MAX_KEYWORDS]
        if name not in _BASE_PARAMETERS
    ]
    robots = [str(getattr(agent, "uid", type(agent).__name__)) for agent in _agents_of(env)]
    return HowMade(", ".join(robots), tuple(_modes(cls, env)), tuple(own))


def _agents_of(env: Any) -> Sequence[Any]:
    agent = getattr(env, "agent", None)
    if agent is None:
        return ()
    return tuple(getattr(agent, "agents", None) or (agent,))


def control_mode_of(env: Any) -> str | None:
    """The control mode as ``gym.make`` takes it; None without a robot, or if robots have different modes."""
    if getattr(env, "agent", None) is None:
        return None
    # With several robots this is a dict, which ``gym.make`` does not take.
    return one_mode(env.control_mode)


def one_mode(mode: object) -> str | None:
    """The control mode: `mode` if it is a string; if it is a dict by robot, the mode that all robots share.

    None for anything else.
    """
    modes = set(mode.values()) if isinstance(mode, dict) else {mode}
    (first, *others) = modes or {None}
    return first if isinstance(first, str) and not others else None


def _modes(cls: Any, env: Any) -> Iterator[Keyword]:
    supported = getattr(cls, "SUPPORTED_ROBOTS", None) or ()
    robot = getattr(env, "robot_uids", None)
    yield _choice("robot_uids", robot, supported)
    agents = _agents_of(env)
    if len(agents) == 1 and isinstance(mode := getattr(env, "control_mode", None), str):
        yield _choice("control_mode", mode, getattr(agents[0], "supported_control_modes", ()))
    obs_modes = list(cls.SUPPORTED_OBS_MODES)
    if _ANY_TEXTURES in obs_modes:
        obs_modes.remove(_ANY_TEXTURES)
        obs_modes += ["rgb", "depth", "rgb+depth", "rgb+depth+segmentation", "rgb+depth+state"]
    yield _choice("obs_mode", env.obs_mode, obs_modes)
    yield _choice("reward_mode", env.reward_mode, cls.SUPPORTED_REWARD_MODES)


def _choice(name: str, value: Any, choices: Sequence[Any]) -> Keyword:
    """A keyword whose choices include its present value, even if the class does not list that value."""
    now = as_json(value)
    texts = dict.fromkeys(text for one in choices if (text := as_json(one)) is not None)
    if now is None:
        return Keyword(
            name, "json", _in_words(value), fixed="its value is a Python object that JSON cannot hold"
        )
    return Keyword(name, "choice", now, choices=tuple(dict.fromkeys((*texts, now)))[:MAX_CHOICES])


def parameters_of(cls: type, stop: type) -> Iterator[tuple[str, inspect.Parameter]]:
    """Named parameters of the ``__init__`` of the class, then of each base class. Ends after the first
    ``__init__`` without ``**kwargs``.

    Args:
        stop: the base class at which to stop: its parameters and those of its bases are left out.
    """
    seen: set[str] = set()
    for owner in cls.__mro__:
        if owner is stop or owner is object:
            return
        init = vars(owner).get("__init__")
        if init is None:
            continue
        try:
            signature = inspect.signature(init)
        except (TypeError, ValueError):
            return
        parameters = list(signature.parameters.values())[1:]
        for parameter in parameters:
            if parameter.kind in (parameter.POSITIONAL_OR_KEYWORD, parameter.KEYWORD_ONLY):
                if parameter.name not in seen:
                    seen.add(parameter.name)
                    yield parameter.name, parameter.replace(annotation=_annotation(parameter, init))
        if not any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters):
            return


def _annotation(parameter: inspect.Parameter, init: Any) -> Any:
    """The annotated type. A string (``from __future__ import annotations``) is evaluated; `empty` if that
    fails."""
    if not isinstance(parameter.annotation, str):
        return parameter.annotation
    names = getattr(inspect.unwrap(init), "__globals__", {})
    try:
        return eval(parameter.annotation, names)
    except Exception:  # any: evaluating it runs the author's code
        return parameter.empty


def _describe(name: str, parameter: inspect.Parameter, given: Any, registered: Any) -> Keyword:
    own = parameter.default if registered is _ABSENT else registered
    default = None if own is parameter.empty else own
    value = default if given is _ABSENT else given
    kind, choices, optional = _kind_of(parameter.annotation, default)
    optional = optional or default is None
    text, usual = as_json(_plain(value)), as_json(_plain(default))
    if text is None:
        return Keyword(
            name, "json", _in_words(value), fixed="its value is a Python object that JSON cannot hold"
        )
    if choices and text not in choices and text != "null":
        choices = (*choices, text)
    return Keyword(name, kind, text, usual or "", choices[:MAX_CHOICES], optional)


def _plain(value: Any) -> Any:
    """The value of an Enum member, which is what a command line takes; any other value unchanged."""
    return value.value if isinstance(value, enum.Enum) else value


def _kind_of(annotation: Any, default: Any) -> tuple[KeywordKind, tuple[str, ...], bool]:
    """Kind, choices, and whether None is allowed: from the annotation, else from the type of the default."""
    optional = False
    if typing.get_origin(annotation) in (typing.Union, types.UnionType):
        parts = [one for one in typing.get_args(annotation) if one is not type(None)]
        optional = len(parts) < len(typing.get_args(annotation))
        annotation = parts[0] if len(parts) == 1 else None
    if typing.get_origin(annotation) is Literal:
        values = typing.get_args(annotation)
        texts = tuple(text for one in values if (text := as_json(one)) is not None and one is not None)
        return "choice", texts, optional or None in values
    if isinstance(annotation, type) and issubclass(annotation, enum.Enum):
        values = (as_json(member.value) for member in annotation)
        if texts := tuple(text for text in values if text is not None):
            return "choice", texts, optional
    by_type: dict[Any, KeywordKind] = {bool: "bool", int: "int", float: "float", str: "str"}
    known = by_type.get(annotation)
    if known is None and annotation in (inspect.Parameter.empty, Any, None):
        known = by_type.get(type(default))
    return known or "json", (), optional


def as_json(value: Any) -> str | None:
    """The value in JSON (a tuple as a list); None if JSON cannot hold it unchanged, or the text is too
    long."""
    try:
        text = json.dumps(value, allow_nan=False)
        back = json.loads(text)
    except (TypeError, ValueError, RecursionError):
        return None
    same = back == value or (isinstance(value, tuple) and back == list(value))
    return text if same and len(text) <= MAX_TEXT_CHARACTERS else None


def _in_words(value: Any) -> str:
    several = value if isinstance(value, tuple | list) else (value,)
    if several and all(isinstance(one, str | type) for one in several):
        # Agent classes in place of their uids.
        return _short(", ".join(one if isinstance(one, str) else _name_of(one) for one in several))
    try:
        return _short(repr(value))
    except Exception:  # raised by the author's __repr__
        return type(value).__name__


def _name_of(cls: type) -> str:
    uid = getattr(cls, "uid", None)
    return uid if isinstance(uid, str) else cls.__name__


def _short(text: str) -> str:
    return text if len(text) <= 200 else f"{text[:199]}…"


def constructor_arguments(cls: type, given: Mapping[str, Any], stop: type) -> dict[str, Any]:
    """Convert arguments from JSON to what the class takes: a tuple for several robots, a member for an Enum.

    Args:
        stop: as in `describe_keywords`.
    """
    taken = dict(given)
    if isinstance(robots := taken.get("robot_uids"), list):
        taken["robot_uids"] = tuple(robots)  # ManiSkill would treat a list as the name of one robot
    for name, parameter in parameters_of(cls, stop):
        kind = parameter.annotation
        if name in taken and isinstance(kind, type) and issubclass(kind, enum.Enum):
            taken[name] = next((one for one in kind if one.value == taken[name]), taken[name])
    return taken


# --- what a person typed, in the server ----------------------------------------------------------------


def shown(text: str) -> str:
    """A value for a person: ``panda`` for ``"panda"``, ``panda, panda`` for a list of texts, JSON for the rest."""
    try:
        value = json.loads(text)
    except ValueError:
        return text
    if isinstance(value, str):
        return value
    if isinstance(value, list) and value and all(isinstance(one, str) for one in value):
        return ", ".join(value)
    return text


def read_value(keyword: Keyword, text: str) -> Any:
    """Parse the text that a person wrote for a keyword.

    Raises:
        ValueError: the text is not a value of this kind; the message names the keyword and what it takes.
    """
    text = text.strip()
    if len(text) > MAX_TEXT_CHARACTERS:
        raise ValueError(f"{keyword.name} takes at most {MAX_TEXT_CHARACTERS} characters.")
    if keyword.optional and text in ("", "null", "None"):
        return None
    if keyword.kind == "str":
        return text
    try:
        value = json.loads(text, parse_constant=_no_constant)
    except (ValueError, RecursionError):
        raise ValueError(f"{keyword.name} takes {_TAKES[keyword.kind]}; got {_short(text)!r}.") from None
    if not _fits(keyword, value):
        raise ValueError(f"{keyword.name} takes {_TAKES[keyword.kind]}; got {_short(text)!r}.")
    return float(value) if keyword.kind == "float" else value


_TAKES: dict[KeywordKind, str] = {
    "bool": "true or false",
    "int": "a whole number",
    "float": "a number",
    "str": "text",
    "choice": "one of its choices",
    "json": 'a value in JSON, such as 0.5, [1, 2] or "text"',
}
MAX_INT = 2**63


def _fits(keyword: Keyword, value: Any) -> bool:
    if keyword.kind == "bool":
        return isinstance(value, bool)
    if keyword.kind == "int":
        return isinstance(value, int) and not isinstance(value, bool) and abs(value) < MAX_INT
    if keyword.kind == "float":
        return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
    if keyword.kind == "choice":
        return json.dumps(value) in keyword.choices
    return True


def _no_constant(name: str) -> Any:
    raise ValueError(name)
