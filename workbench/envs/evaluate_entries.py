"""Splits the return value of ``evaluate()`` into rows per env and other entries; checks return values of
hooks."""

from __future__ import annotations

import re
import reprlib
from collections.abc import Iterator, Mapping
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from mani_skill.utils.structs.pose import Pose
from numpy.typing import NDArray

from workbench.envs.step_result import OtherEntry

FLAGS = ("success", "fail")
MAX_TEXT_CHARACTERS = 400
"""Maximum length of a value's text."""
MAX_KEPT_NUMBERS = 1024
"""Maximum count of numbers in a whole-batch value that is kept as numbers. Of a larger value only type, shape
and count are kept."""
MAX_ENTRIES = 1000
"""Maximum number of leaves that are kept; further leaves are only counted."""
_MAX_NAME_CHARACTERS = 200
_MAX_READ_NUMBERS = 1 << 26
"""Maximum count of numbers in a tensor or list that is read: a sparse tensor, made dense, may exceed the
memory."""
_NOT_EVALUATED = ("elapsed_steps", "reconfigure")
"""ManiSkill's own entries of ``info``."""
_REAL_KINDS = "biuf"
_NUMPY_DTYPES = {torch.bool, torch.float32, torch.float64, torch.int32, torch.int64, torch.uint8}
"""torch's dtypes that numpy also has."""
_MAX_DEPTH = 16
_UNPRINTABLE = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\ud800-\udfff]")
"""Control characters and surrogates, which neither files nor browsers accept."""
_ADDRESS = re.compile(r" at 0x[0-9a-f]+")
"""Memory address in a default repr: differs in every run."""

_short = reprlib.Repr()
_short.maxlevel = 4
_short.maxdict = _short.maxlist = _short.maxtuple = _short.maxset = _short.maxfrozenset = 20
_short.maxdeque = _short.maxarray = 20
_short.maxstring = _short.maxlong = _short.maxother = MAX_TEXT_CHARACTERS


def split_entries(info: Mapping[Any, Any], num_envs: int) -> tuple[dict[str, NDArray], dict[str, OtherEntry]]:
    """Split `info` into entries of real numbers with a row for each env, (N, ...), and all other entries.

    All are copies.

    ManiSkill reads only ``success`` and ``fail`` and passes the rest on: None, a string, ``progress.mean()``,
    an object. A tensor, array or list has rows if its first dimension is N. So with one env, a value of shape
    (1,) has a row and one of shape () has none; but ``success`` and ``fail`` may have either shape, as in
    ManiSkill. A nested dict is split into its leaves, named by their keys.
    """
    columns: dict[str, NDArray] = {}
    others: dict[str, OtherEntry] = {}
    left_out = 0
    for path, value in leaves(info):
        if path in _NOT_EVALUATED:
            continue
        if len(columns) + len(others) >= MAX_ENTRIES:
            left_out += 1
            continue
        name = _name(path, columns, others)
        array = _array(value)
        if name in FLAGS and array is not None:
            # ManiSkill accepts one value for all envs, and numbers as bools; the page needs a bool for each env.
            one_each = array.reshape(-1) if array.size == num_envs else array
            columns[name] = np.broadcast_to(one_each.astype(bool), (num_envs, *one_each.shape[1:])).copy()
        elif array is None:
            others[name] = _other(value, num_envs)
        elif array.ndim and len(array) == num_envs:
            columns[name] = array
        else:
            others[name] = _numbers(value, array)
    if left_out:
        others[_name("…", columns, others)] = OtherEntry("entries", (f"{left_out} more",), whole=False)
    return columns, others


def leaves(value: Any, path: str = "", above: tuple[int, ...] = ()) -> Iterator[tuple[str, Any]]:
    """Leaves of nested dicts, each with its keys joined by ``/``. An empty dict, or one that contains itself, is a leaf."""
    if (
        not isinstance(value, Mapping)
        or len(above) > _MAX_DEPTH
        or id(value) in above[1:]
        or (above and not value)
    ):
        yield path, value
        return
    for key, held in value.items():
        yield from leaves(held, f"{path}/{_key(key)}" if path else _key(key), (*above, id(value)))


def flat_entries(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """The `leaves` that are not dicts; a value that is not a dict is one leaf named `path`."""
    return ((name, held) for name, held in leaves(value, path) if not isinstance(held, Mapping))


def _key(key: Any) -> str:
    return (key if type(key) is str else _text(key)[0]) or "''"


def _name(path: str, columns: Mapping[str, Any], others: Mapping[str, Any]) -> str:
    """`path` cleaned, shortened and made unique: the key ``a/b`` and the key ``b`` of a dict ``a`` have the
    same path."""
    name = plain = _clean_name(path)
    number = 2
    while name in columns or name in others:
        name = f"{plain} ({number})"
        number += 1
    return name


@lru_cache(maxsize=4096)
def _clean_name(path: str) -> str:
    name = clean_text(path)
    return name if len(name) <= _MAX_NAME_CHARACTERS else name[: _MAX_NAME_CHARACTERS - 1] + "…"


def _array(value: Any) -> NDArray | None:
    """`value` as booleans or real numbers; None if it holds neither or cannot be read."""
    if isinstance(value, torch.Tensor):
        return _of_tensor(value)
    if isinstance(value, np.ndarray):
        return value.copy() if value.dtype.kind in _REAL_KINDS else None
    if isinstance(value, (bool, int, float, np.bool_, np.integer, np.floating)):
        found = np.asarray(value)
        return found if found.dtype.kind in _REAL_KINDS else None  # an int of more than 64 bits is an object
    if isinstance(value, (list, tuple)) and value:
        return _of_list(value)
    if isinstance(value, Pose):
        return _of_tensor(value.raw_pose)
    return None


def _of_tensor(value: torch.Tensor) -> NDArray | None:
    if value.dtype in _NUMPY_DTYPES and value.layout is torch.strided and value.device.type == "cpu":
        # Fast path for the common case; the general one takes three times as long.
        found = value.detach().numpy() if value.requires_grad else value.numpy()
        return found.copy()
    if value.is_complex() or value.numel() > _MAX_READ_NUMBERS:
        return None
    try:
        if value.layout is not torch.strided:
            value = value.to_dense()
        if value.is_floating_point() and value.dtype not in (torch.float16, torch.float32, torch.float64):
            value = value.float()  # numpy has no bfloat16
        found = value.numpy(force=True)
    except (RuntimeError, TypeError, NotImplementedError):
        return None  # for example, a tensor on the meta device has no data
    return found.copy()


def _of_list(value: list[Any] | tuple[Any, ...]) -> NDArray | None:
    if len(value) > _MAX_READ_NUMBERS or any(isinstance(item, (str, bytes, Mapping)) for item in value):
        return None
    rows: list[Any] = [_of_tensor(item) if isinstance(item, torch.Tensor) else item for item in value]
    if any(row is None for row in rows):
        return None
    try:
        found = np.array(rows)
    except (ValueError, TypeError, OverflowError):  # rows of different lengths
        return None
    return found if found.dtype.kind in _REAL_KINDS else None


def _numbers(value: Any, array: NDArray) -> OtherEntry:
    what = type_text(value)
    if array.size == 0:
        return OtherEntry(what, ("[]",))
    if array.size > MAX_KEPT_NUMBERS:
        return OtherEntry(what, (f"{array.size:,} numbers",), whole=False)
    return OtherEntry(what, numbers=array if array.flags.owndata else array.copy())


def _other(value: Any, num_envs: int) -> OtherEntry:
    rows = _rows_of(value)
    if rows is not None and len(rows) == num_envs:
        texts, whole = zip(*map(_text, rows), strict=True)
        return OtherEntry(type_text(value), texts, per_env=True, whole=all(whole))
    text, whole = _text(value)
    return OtherEntry(type_text(value), (text,), whole=whole)


def _rows_of(value: Any) -> list[Any] | tuple[Any, ...] | NDArray | None:
    """The value as a sequence, which may have one item for each env; None if it is not a sequence."""
    if isinstance(value, (list, tuple)):
        return value
    if isinstance(value, torch.Tensor) and value.is_complex():
        value = value.resolve_conj().numpy(force=True)
    return value if isinstance(value, np.ndarray) and value.ndim else None


def type_text(value: Any) -> str:
    """Type of a value; for an array or tensor also its dtype and shape."""
    if isinstance(value, torch.Tensor):
        return f"{str(value.dtype).removeprefix('torch.')} tensor of shape {tuple(value.shape)}"
    shape, dtype = getattr(value, "shape", None), getattr(value, "dtype", None)
    if isinstance(shape, tuple) and dtype is not None:
        return f"{type(value).__module__.partition('.')[0]} {dtype} array of shape {shape}"
    return "None" if value is None else type(value).__qualname__


def _text(value: Any) -> tuple[str, bool]:
    """`value` as text, and whether the text is complete."""
    if isinstance(value, np.generic):
        value = str(value)  # the repr contains "np.", and a Python number would have more digits
    if isinstance(value, str):
        text = str.__str__(value)
    else:
        text = safe_repr(value)
    if len(text) > MAX_TEXT_CHARACTERS:
        return clean_text(text[: MAX_TEXT_CHARACTERS - 1]) + "…", False
    return clean_text(text), isinstance(value, str) or "..." not in text


def safe_repr(value: object) -> str:
    """The repr without memory addresses, shortened for collections. If the object's repr raises, a text that
    says so."""
    try:
        if isinstance(value, (list, tuple, dict, set, frozenset)):
            text = _short.repr(value)
        else:
            text = repr(value)
    except Exception as error:  # an author's __repr__
        return f"<{type(value).__qualname__}, whose repr raises {type(error).__name__}>"
    return _ADDRESS.sub("", text)


def clean_text(text: str) -> str:
    """`text` with U+FFFD for each character that files or browsers refuse."""
    return _UNPRINTABLE.sub("\ufffd", text)


# --- what is wrong with return values ----------------------------------------------------------------


def wrong_evaluate(evaluate: object, num_envs: int) -> str | None:
    """What is wrong with ``evaluate()``'s return value, or None. It must be a dict whose ``success`` and ``fail`` are (N,).

    Other entries may be anything, as in ManiSkill (`split_entries`).
    """
    if not isinstance(evaluate, Mapping):
        return f"returned {describe(evaluate)}; it must return a dict ({{}} if there is nothing to report)"
    for name in FLAGS:
        value = evaluate.get(name)
        if name in evaluate and not (
            isinstance(value, torch.Tensor) and not value.is_complex() and _a_row_each(value, num_envs)
        ):
            return f"returned {name!r} as {describe(value)}; expected a bool tensor of shape ({num_envs},)"
    return None


def wrong_flags(evaluate: object) -> str | None:
    """What is wrong with ``success`` or ``fail`` if one is a tensor of another dtype than bool, or, with one env, of shape
    (1, 1); else None.

    ManiSkill's step accepts such a tensor, its wrappers do not.
    """
    for name in FLAGS:
        value = evaluate.get(name) if isinstance(evaluate, Mapping) else None
        if isinstance(value, torch.Tensor) and value.numel() == 1 < value.ndim:
            return f"returned {name!r} as {describe(value)}; expected a bool tensor of shape (1,)"
        if isinstance(value, torch.Tensor) and value.dtype != torch.bool:
            return f"returned {name!r} as {describe(value)}; expected a bool tensor: append .bool()"
    return None


def wrong_reward(reward: object, num_envs: int, evaluate: Mapping[str, Any]) -> str | None:
    """What is wrong with a reward, or None. It must be a floating tensor (N,); NaN is allowed, and shown in the env's row.

    With one env shape () is allowed too, but not (1, 1): ManiSkill's step passes it on,
    `ManiSkillVectorEnv` with ``record_metrics`` fails on it.
    """
    problem = no_reward(reward, num_envs)
    if problem is None and isinstance(reward, torch.Tensor) and reward.ndim > 1:
        return f"returned {describe(reward)}; {_floating(num_envs)}"
    if problem is not None or not isinstance(reward, torch.Tensor) or reward.dtype.is_floating_point:
        return problem
    # ManiSkill's own sparse reward is `success` itself where a task has no `fail`.
    success = evaluate.get("success")
    if isinstance(success, torch.Tensor) and reward.dtype == torch.bool and torch.equal(reward, success):
        return None
    return f"returned {describe(reward)}; {_floating(num_envs)}: append .float()"


def no_reward(reward: object, num_envs: int) -> str | None:
    """Why a reward cannot be drawn and recorded; None if it can. It must be a tensor (N,), not complex."""
    if not isinstance(reward, torch.Tensor) or not _a_row_each(reward, num_envs) or reward.dtype.is_complex:
        return f"returned {describe(reward)}; {_floating(num_envs)}"
    return None


def _floating(num_envs: int) -> str:
    return f"expected a floating tensor of shape ({num_envs},)"


def _a_row_each(value: torch.Tensor, num_envs: int) -> bool:
    # Tasks written for one env return one number in other shapes, which ManiSkill's step accepts.
    return value.shape == (num_envs,) or num_envs == value.numel() == 1


def wrong_observation(obs: object, num_envs: int) -> str | None:
    """What is wrong with an observation hook's return value, or None. It must be a dict of arrays (N, ...)."""
    if not isinstance(obs, Mapping):
        return f"returned {describe(obs)}; it must return a dict ({{}} if there is nothing to observe)"
    for name, value in flat_entries(obs):
        shape = getattr(value, "shape", None)
        if shape is None or len(shape) == 0 or shape[0] != num_envs:
            return (
                f"returned {name!r} as {describe(value)}; "
                f"expected shape ({num_envs}, ...), a row for each env"
            )
    return None


def without_rows(value: object, num_envs: int) -> Iterator[tuple[str, str]]:
    """Name and description of each tensor or array, in nested dicts too, that lacks a row for each env."""
    for name, held in flat_entries(value):
        if isinstance(held, torch.Tensor | np.ndarray) and held.shape[:1] != (num_envs,):
            if num_envs > 1 or held.ndim:  # ManiSkill accepts shape () for a single env
                yield name, type_text(held)


def describe(value: object) -> str:
    """Text for a value in a message: the dtype and shape of an array, else the type and the repr."""
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        return f"a {type_text(value)}"
    if value is None:
        return "None"
    text = " ".join(safe_repr(value)[:480].split())
    return f"{type(value).__qualname__} ({text if len(text) <= 60 else text[:59] + '…'})"
