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
    control_mode_of,
    describe_keywords,
    one_mode,
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
    assert (found["needed"].default, found["needed"].optional) == ("null", True)
    given = own(Task, Base(), {"way": "up", "count": 1, "colour": "red"}, {"count": 7, "name": "b"})
    assert given["way"].choices == ('"left"', '"right"', '"up"'), "what is given may be chosen again"
    assert (given["count"].value, given["count"].default) == ("1", "7")
    assert (given["name"].value, given["name"].default) == ('"b"', '"b"')
    assert "robot_uids" not in given and "num_envs" not in given


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


def test_several_robots_are_named_and_have_no_common_control_mode() -> None:
    env = Base()
    env.agent = SimpleNamespace(agents=[SimpleNamespace(uid="left"), SimpleNamespace(uid="right")])
    made = describe_keywords(Task, env, {}, {}, Base)
    assert made.robot == "left, right" and "control_mode" not in {one.name for one in made.modes}
    env.agent = None
    assert describe_keywords(Task, env, {}, {}, Base).robot == "" and control_mode_of(env) is None


@pytest.mark.parametrize(
    ("mode", "shared"),
    [
        ("a", "a"),
        ({"left": "a", "right": "a"}, "a"),
        ({"left": "a", "right": "b"}, None),
        ({}, None),
        (None, None),
        (3, None),
    ],
)
def test_the_control_mode_of_robots_is_one_that_all_have(mode: object, shared: str | None) -> None:
    assert one_mode(mode) == shared


@pytest.mark.parametrize(
    ("text", "shows"),
    [
        ('"panda"', "panda"),
        ('["panda", "fetch"]', "panda, fetch"),
        ("[1, 2]", "[1, 2]"),
        ("[]", "[]"),
        ("0.5", "0.5"),
        ("no JSON", "no JSON"),
    ],
)
def test_a_value_is_shown_as_a_person_writes_it(text: str, shows: str) -> None:
    assert shown(text) == shows


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
        (Keyword("a", "float", "1"), "2", 2.0),
        (Keyword("a", "int", "1", optional=True), "", None),
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
        (Keyword("size", "int", "1"), str(2**63)),
        (Keyword("size", "int", "1"), "null"),
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
