"""The 3-D view of the live page: everything in it is that of the selected env, and a click selects what it hits."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import viser
from numpy.typing import NDArray

from tests.drive.live import Live
from tests.drive.scenes import box_mesh, camera, running, table_scene, visual
from workbench.cameras.events import CameraChosen
from workbench.cameras.frustums import LARGE_METRES, SMALL_METRES
from workbench.envs.camera_data import Picture
from workbench.envs.inspection import Inspection, Touching
from workbench.envs.task_drawings import Drawing
from workbench.hands.commands import HideBody, ShowHiddenBodies
from workbench.hands.reach import Reach
from workbench.hands.state import Hands
from workbench.live.commands import HoverBody, SelectBody, ShowForces
from workbench.live.env_commands import ShowEnvs
from workbench.live.events import ReadingChosen
from workbench.live.view import SessionView
from workbench.page.commands import FrameScene, ShowCollisions, ShowFrames, ShowFrustums
from workbench.task.description import ArmDescription

pytestmark = pytest.mark.thorough

ENVS, CUBE = 5, 3
HUMAN = camera("render_camera", "human")
GREY = np.full((6, 8, 3), 128, np.uint8)


def poses() -> NDArray[np.float32]:
    """(ENVS, 4, 7) poses: the hand and the cube are elsewhere in each env."""
    made = table_scene(ENVS)[1]
    made[:, 2, :2] = np.arange(ENVS)[:, None] * [0.05, 0.02]
    made[:, CUBE, :2] = np.arange(ENVS)[:, None] * [-0.03, 0.04] + [0.1, -0.2]
    return made


def picture(env: int) -> Picture:
    pose = np.array([0.3 + env / 10, -env / 5, 0.4, 1, 0, 0, 0], np.float32)
    return Picture("base_camera", "sensor", env, pose, GREY)


def shown(env: int, num_envs: int = ENVS, **changes: Any) -> SessionView:
    """A view in which the pictures and the contacts are those of `env`, and the task drew a dot in each env."""
    held = {"hands": Hands(reach=Reach(shown=True)), **changes}
    view = running(num_envs, selected_env=env, playing=False, state="paused", **held)
    assert view.task is not None and view.step is not None
    dots = (np.arange(num_envs * 3).reshape(num_envs, 1, 3) / 7).astype(np.float32)
    contact = Touching(("cube", "table"), np.ones(3, np.float32), np.ones(3, np.float32), np.full((1, 3), env + 1, np.float32), np.ones((1, 3), np.float32), 0.0)  # fmt: skip
    return replace(
        view,
        task=replace(view.task, cameras=(camera(), HUMAN), arms=(ArmDescription("arm/hand", ()),)),
        step=replace(view.step, poses=poses()[:num_envs], drawn={"dot": Drawing("points", dots)}),
        pictures={("sensor", "base_camera"): picture(env), **dict(changes.get("pictures", {}))},
        inspection=Inspection(env, 7, contacts=(contact,)),
        settings=replace(view.settings, selected_env=env),
    )


@pytest.fixture(scope="module")
def page() -> Iterator[Live]:
    live = Live(viser.ViserServer(host="127.0.0.1", port=0, verbose=False))
    live.show(shown(0))
    live.do(ShowFrames(on=True))
    live.do(ShowForces(where="on all tabs"))
    yield live
    live.server.stop()


@pytest.fixture
def live(page: Live) -> Live:
    """The page as it was: all envs, with all that the view can show except collision shapes; the cube is selected."""
    page.do(ShowEnvs(all_envs=True))
    page.do(ShowFrustums(on=True))
    page.do(SelectBody(body="cube"))
    page.do(HoverBody(body="arm/hand"))
    page.show(shown(0))
    page.show(shown(0))
    return page


def offset_of(live: Live, env: int) -> NDArray[np.float32]:
    """(3,) offset of an env in the view, from where its cube is drawn."""
    return live.bodies("cube")[0].batched_positions[env] - poses()[env, CUBE, :3]


def node(live: Live, name: str) -> Any:
    (found,) = live.nodes(name)
    return found


@pytest.mark.parametrize("alone", [False, True])
def test_all_in_the_view_is_that_of_the_selected_env(live: Live, alone: bool) -> None:
    spacing = [offset_of(live, env) for env in range(ENVS)]
    assert len({tuple(offset.round(3)) for offset in spacing}) == ENVS
    live.do(ShowEnvs(all_envs=not alone))
    sizes: set[float] = set()
    for env in (0, 3, 1):
        live.show(shown(env))
        live.show(shown(env))
        offset = np.zeros(3) if alone else spacing[env]
        (cube,) = live.bodies("cube")
        wanted = poses()[[env] if alone else slice(None), CUBE, :3]
        np.testing.assert_allclose(cube.batched_positions, wanted + (0 if alone else spacing), atol=1e-6)
        at = poses()[env, CUBE, :3] + offset
        edges = node(live, "/selected_body/box").points.reshape(-1, 3)
        np.testing.assert_allclose((edges.min(0) + edges.max(0)) / 2, at, atol=1e-6)
        frames = node(live, "/frames").batched_positions
        np.testing.assert_allclose(frames[[0, -1]], [offset, at], atol=1e-6)
        dot = np.arange(3) / 7 + env * 3 / 7
        np.testing.assert_allclose(node(live, "/drawn/dot").points, [dot + offset], atol=1e-5)
        np.testing.assert_allclose(node(live, "/forces").points[0, 0], env + 1 + offset, atol=1e-5)
        for name in ("/hands/grip", "/hands/gizmo"):
            np.testing.assert_allclose(node(live, name).position, at, atol=1e-6)
        hand = poses()[env, 2, :3] + offset
        (handle,) = (one for one in live.nodes("/hands/reach/0") if one.name == "/hands/reach/0")
        np.testing.assert_allclose(handle.position, hand, atol=1e-6)
        hovered = node(live, "/hovered_body/box").points.reshape(-1, 3)
        np.testing.assert_allclose((hovered.min(0) + hovered.max(0)) / 2, hand, atol=1e-6)
        sizes.add(float(np.mean(node(live, "/cameras/sensor").scale)))
        np.testing.assert_allclose(
            node(live, "/cameras/sensor").position, picture(env).pose[:3] + offset, atol=1e-5
        )
        marks = [label for label in live.labels() if label == f"env {env}"]
        assert len(marks) == (0 if alone else 1) == len(live.nodes("/selected/frame"))
    assert sizes == {SMALL_METRES if alone else LARGE_METRES}


def test_of_two_envs_one_can_be_shown_alone(live: Live) -> None:
    for alone in (True, False):
        live.do(ShowEnvs(all_envs=not alone))
        live.show(shown(1, num_envs=2))
        assert len(live.bodies("cube")[0].batched_positions) == (1 if alone else 2)
    live.do(ShowEnvs(all_envs=False))
    live.show(shown(0, num_envs=1))
    assert len(live.bodies("cube")[0].batched_positions) == 1 and "env 0" not in live.labels()


def test_a_hidden_body_is_not_drawn_until_it_is_shown_again(live: Live) -> None:
    def drawn() -> list[Any]:
        live.again()
        return [
            (one.batched_positions.tolist(), one.batched_scales, one.visible) for one in live.bodies("cube")
        ]

    before = drawn()
    live.do(HideBody())
    assert drawn() != before
    live.do(ShowHiddenBodies())
    assert drawn() == before


def test_a_body_that_is_hovered_and_selected_has_one_mark(live: Live) -> None:
    live.do(HoverBody(body="cube"))
    live.again()
    assert not live.nodes("/hovered_body/box") and live.nodes("/selected_body/box")


@pytest.mark.parametrize("alone", [False, True])
def test_what_is_switched_off_disappears_and_returns(live: Live, alone: bool) -> None:
    live.do(ShowEnvs(all_envs=not alone))
    for on in (False, True):
        live.do(ShowForces(where="on all tabs" if on else "off"))
        live.do(ShowFrames(on=on))
        live.do(ShowFrustums(on=on))
        live.again()
        assert [bool(live.nodes(name)) for name in ("/frames", "/cameras/sensor", "/forces")] == [on] * 3


def test_collision_shapes_replace_the_visuals_while_they_are_switched_on(live: Live) -> None:
    def drawn() -> list[object]:
        live.again()
        return [one for name, one in live.everything().items() if "view: /envs" in name]

    view = shown(2)
    assert view.task is not None
    geometry = view.task.geometry
    shapes = (visual("cube/shape", box_mesh((0.1, 0.2, 0.3)), ENVS, CUBE),)
    live.show(
        replace(view, scene_serial=7, task=replace(view.task, geometry=replace(geometry, collisions=shapes)))
    )
    for alone in (False, True):
        live.do(ShowEnvs(all_envs=not alone))
        before = drawn()
        live.do(ShowCollisions(on=True))
        assert drawn() != before
        live.do(ShowCollisions(on=False))
        assert drawn() == before


DOWN = np.array([0.0, 0.0, -1.0])


def pressed(live: Live, at: NDArray, direction: NDArray = DOWN) -> list[Any]:
    """What a click on the point `at` (3,), from one metre away, asks of the session."""
    live.asked.clear()
    live.click_view(at - direction, direction)
    asked = [one for one in live.asked if not isinstance(one, ReadingChosen)]
    live.again()
    return asked


def test_a_click_selects_the_env_and_the_body_that_it_hits(live: Live) -> None:
    live.do(ShowFrustums(on=False))
    for env in (3, 0):
        for body, name in ((2, "arm/hand"), (CUBE, "cube")):
            at = poses()[env, body, :3] + offset_of(live, env)
            assert pressed(live, at) == [("change", {"selected_env": env})]
            live.show(shown(env))
            edges = node(live, "/selected_body/box").points.reshape(-1, 3)
            np.testing.assert_allclose((edges.min(0) + edges.max(0))[:2] / 2, at[:2], atol=1e-5)
            assert name in live.labels()
    assert pressed(live, poses()[0, 2, :3] + offset_of(live, 0) + [0, 0, 9], -DOWN) == []
    assert "cube" in live.labels(), "nothing is there"


def test_a_click_on_an_env_that_is_alone_selects_its_body_and_no_other_env(live: Live) -> None:
    live.do(ShowEnvs(all_envs=False))
    live.do(ShowFrustums(on=False))
    live.show(shown(3))
    assert pressed(live, poses()[3, 2, :3]) == [] and "arm/hand" in live.labels()
    table = np.array([-0.5, 1.0, 0.0])
    assert pressed(live, table) == [] and "table" in live.labels()


def test_a_click_on_a_frustum_chooses_its_camera(live: Live) -> None:
    live.show(shown(1))
    at = picture(1).pose[:3] + offset_of(live, 1) + [0.03, 0.0, 0.0]
    assert pressed(live, at, np.array([0.0, 1.0, 0.0])) == [CameraChosen(("sensor", "base_camera"))]


# --- the viewpoint ------------------------------------------------------------------------------------


def viewpoint(live: Live) -> NDArray:
    """(2, 3) position and look-at of a page that is opened now."""
    initial = live.server.initial_camera
    return np.array([initial.position, initial.look_at])


def test_a_new_scene_is_framed_whole_or_as_the_human_camera_sees_it(live: Live) -> None:
    all_envs = viewpoint(live)
    live.do(ShowEnvs(all_envs=False))
    live.again()
    one = viewpoint(live)
    assert np.linalg.norm(one[0]) < np.linalg.norm(all_envs[0])
    human = Picture(HUMAN.name, "human", 0, np.array([3, 1, 0.5, 0, 0, 0, 1], np.float32), GREY)
    wide = replace(HUMAN, fovy=2.0)
    seen = shown(0, pictures={HUMAN.key: human})
    live.show(seen)
    position, look_at = viewpoint(live)
    np.testing.assert_allclose((look_at - position)[1:], 0, atol=1e-6)
    assert look_at[0] < position[0], "towards -x, as the camera looks"
    near = np.linalg.norm(look_at - position)
    live.show(shown(1))
    live.do(FrameScene())
    assert viewpoint(live).tolist() == [position.tolist(), look_at.tolist()], "env 1 has no picture yet"
    assert seen.task is not None
    live.show(replace(seen, task=replace(seen.task, cameras=(camera(), wide))))
    live.do(FrameScene())
    assert np.linalg.norm(np.diff(viewpoint(live), axis=0)) > near, (
        "a wider lens sees as much from further away"
    )
    live.do(ShowEnvs(all_envs=True))
    live.again()
    np.testing.assert_allclose(viewpoint(live), all_envs, atol=1e-6)
