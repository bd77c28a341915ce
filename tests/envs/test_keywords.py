"""A task's keyword arguments are described from its constructor and parsed from typed text."""

from __future__ import annotations

import enum
import json
import math
from types import SimpleNamespace
from typing import Any, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from workbench.envs.keywords import (
    Keyword,
    as_json,
    constructor_arguments,
    describe_keywords,
    read_value,
    shown,
)


class Base:
    """Stand-in for ManiSkill's `BaseEnv`."""

    SUPPORTED_ROBOTS: Any = ["panda", ("panda", "panda")]
    SUPPORTED_OBS_MODES = ("state", "none", "any_textures")
    SUPPORTED_REWARD_MODES = ("dense", "none")
    obs_mode, reward_mode = "state", "dense"
    robot_uids: Any = "panda"
    control_mode = "pd_joint_pos"
    agent: Any = SimpleNamespace(uid="panda", supported_control_modes=["pd_joint_pos", "pd_ee_pose"])

    def __init__(
        self, num_envs: int = 1, obs_mode: str | None = None, sim_config: dict | None = None
    ) -> None: ...


class Colour(enum.Enum):
    RED = "red"
    BLUE = "blue"


class Middle(Base):
    def __init__(self, *args: Any, noise: float = 0.02, count=3, **kwargs: Any) -> None: ...


class Task(Middle):
    def __init__(
        self,
        *args: Any,
        robot_uids: str = "panda",
        flag: bool = True,
        name: str = "a",
        size: float | None = None,
        way: Literal["left", "right"] = "left",
        colour: Colour = Colour.RED,
        where: tuple[float, ...] = (0.0, 1.0),
        needed: int,
        made: object = object(),
        gone: Missing = 1,  # noqa: F821  # pyright: ignore
        **kwargs: Any,
    ) -> None: ...


class Closed(Middle):
    def __init__(self, only: int = 1) -> None: ...


def own(cls: type, env: Any, given: dict[str, Any], registered: dict[str, Any]) -> dict[str, Keyword]:
    return {one.name: one for one in describe_keywords(cls, env, given, registered, Base).own}


def test_types_defaults_and_values_come_from_the_signature() -> None:
    found = own(Task, Base(), {"needed": 2, "noise": 0.5}, {"count": 7})
    kinds = {name: one.kind for name, one in found.items()}
    assert kinds == {
        "flag": "bool",
        "name": "str",
        "size": "float",
        "way": "choice",
        "colour": "choice",
        "where": "json",
        "needed": "int",
        "made": "json",
        "gone": "int",
        "noise": "float",
        "count": "int",
    }
    assert (found["noise"].value, found["noise"].default) == ("0.5", "0.02")
    assert (found["count"].value, found["count"].default) == ("7", "7"), "only the registration names it"
    assert found["needed"].value == "2" and found["size"].optional and not found["flag"].optional
    assert found["way"].choices == ('"left"', '"right"') and found["colour"].choices == ('"red"', '"blue"')
    assert found["colour"].value == '"red"' and found["where"].value == "[0.0, 1.0]"
    assert found["made"].fixed and not found["gone"].fixed


def test_a_constructor_without_kwargs_hides_those_of_its_bases() -> None:
    assert list(own(Closed, Base(), {}, {})) == ["only"]
    assert own(Base, Base(), {}, {}) == {}, "ManiSkill's own arguments are not the task's"


def test_modes_offer_what_the_class_supports_and_the_current_one() -> None:
    env = Base()
    env.robot_uids, env.obs_mode = "fetch", "rgb+normal"
    made = describe_keywords(Task, env, {}, {}, Base)
    modes = {one.name: one for one in made.modes}
    assert made.robot == "panda"
    assert modes["robot_uids"].choices == ('"panda"', '["panda", "panda"]', '"fetch"')
    assert modes["control_mode"].choices == ('"pd_joint_pos"', '"pd_ee_pose"')
    assert '"rgb+depth"' in modes["obs_mode"].choices and modes["obs_mode"].choices[-1] == '"rgb+normal"'
    assert '"any_textures"' not in modes["obs_mode"].choices
    assert modes["reward_mode"].value == '"dense"'


def test_a_robot_given_as_a_class_is_shown_by_its_uid_or_name() -> None:
    class Hopper:
        uid = "hopper"

    class Plain: ...

    for robots, shows in ((Hopper, "hopper"), (Plain, "Plain"), ((Hopper, "panda"), "hopper, panda")):
        env = Base()
        env.robot_uids = robots
        robot = describe_keywords(Task, env, {}, {}, Base).modes[0]
        assert robot.fixed and robot.value == shows


def test_json_values_become_the_types_that_the_class_takes() -> None:
    given = {"robot_uids": ["panda", "panda"], "colour": "blue", "noise": 1}
    taken = constructor_arguments(Task, given, Base)
    assert taken == {"robot_uids": ("panda", "panda"), "colour": Colour.BLUE, "noise": 1}
    assert constructor_arguments(Task, {"colour": "green"}, Base) == {"colour": "green"}


@pytest.mark.parametrize(
    ("keyword", "text", "value"),
    [
        (Keyword("a", "int", "1"), " 7 ", 7),
        (Keyword("a", "float", "1"), "1e-5", 1e-5),
        (Keyword("a", "bool", "true"), "false", False),
        (Keyword("a", "str", '"x"'), "true", "true"),
        (Keyword("a", "str", '"x"', optional=True), "null", None),
        (Keyword("a", "json", "1"), '{"b": [1, null]}', {"b": [1, None]}),
        (Keyword("a", "choice", '"l"', choices=('"l"', "2")), "2", 2),
    ],
)
def test_typed_text_is_parsed(keyword: Keyword, text: str, value: object) -> None:
    found = read_value(keyword, text)
    assert found == value and type(found) is type(value)


@pytest.mark.parametrize(
    ("keyword", "text"),
    [
        (Keyword("size", "int", "1"), "1.5"),
        (Keyword("size", "int", "1"), "true"),
        (Keyword("size", "int", "1"), str(10**30)),
        (Keyword("size", "float", "1"), "NaN"),
        (Keyword("size", "float", "1"), "1e999"),
        (Keyword("size", "bool", "true"), "1"),
        (Keyword("size", "json", "1"), "[" * 3000),
        (Keyword("size", "choice", '"l"', choices=('"l"',)), '"m"'),
        (Keyword("size", "str", '"x"'), "x" * 3000),
    ],
)
def test_an_invalid_text_is_refused_with_the_keywords_name(keyword: Keyword, text: str) -> None:
    with pytest.raises(ValueError, match="^size takes"):
        read_value(keyword, text)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**60), 2**60) | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(max_size=10),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=6,
)  # fmt: skip


@given(JSON)
def test_a_json_value_survives_a_round_trip(value: Any) -> None:
    text = as_json(value)
    assert text is not None and read_value(Keyword("a", "json", text), text) == value
    assert isinstance(shown(text), str)


@given(
    st.text(max_size=50), st.sampled_from(["bool", "int", "float", "str", "choice", "json"]), st.booleans()
)
def test_any_text_is_parsed_or_raises_value_error(text: str, kind: Any, optional: bool) -> None:
    try:
        value = read_value(Keyword("a", kind, "1", choices=("1",), optional=optional), text)
    except ValueError:
        return
    assert as_json(value) is not None and (not isinstance(value, float) or math.isfinite(value))
    assert json.loads(json.dumps(value)) == value
