from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from workbench.page.scene.visible_motion import (
    AT_REST_SECONDS,
    Eye,
    SentPoses,
    displacements,
    eyes_of,
    pixel_sizes,
)

EYE = Eye(np.array([0.0, 0.0, 5.0]), 0.001)
"""A pixel is 5 mm at the origin."""
REACH = np.full(8, 0.2, np.float32)


def poses_at(x: float, turn: float = 0.0) -> NDArray[np.float32]:
    """(8, 7): eight bodies side by side, moved along x in metres and turned about z in radians."""
    poses = np.zeros((8, 7), np.float32)
    poses[:, 1] = np.linspace(-1, 1, 8)
    poses[:, 0] = x
    poses[:, 3], poses[:, 6] = np.cos(turn / 2), np.sin(turn / 2)
    return poses


def test_motion_below_a_pixel_is_sent_once_it_adds_up() -> None:
    sent = SentPoses(REACH)
    first, changed = sent.update(poses_at(0.0), (EYE,), 0.0)
    assert changed.all() and np.array_equal(first, poses_at(0.0))
    before = first.copy()
    for step in range(1, 5):
        shown, changed = sent.update(poses_at(0.001 * step), (EYE,), 0.03 * step)
        assert not changed.any() and np.array_equal(shown, before)
    shown, changed = sent.update(poses_at(0.006), (EYE,), 0.2)
    assert changed.all()
    assert (displacements(shown, poses_at(0.006), REACH) < 0.005).all()


def test_rotation_is_measured_at_the_far_end_of_a_body() -> None:
    sent = SentPoses(REACH)
    sent.update(poses_at(0.0), (EYE,), 0.0)
    _, changed = sent.update(poses_at(0.0, turn=0.01), (EYE,), 0.03)
    assert not changed.any(), "2 mm at its end"
    _, changed = sent.update(poses_at(0.0, turn=0.04), (EYE,), 0.06)
    assert changed.all(), "8 mm"


def test_no_body_is_shown_more_than_one_and_a_half_pixels_off() -> None:
    rng = np.random.default_rng(0)
    sent = SentPoses(REACH)
    x = turn = 0.0
    for step in range(200):
        shown, _ = sent.update(poses_at(x, turn), (EYE,), 0.03 * step)
        away = displacements(shown, poses_at(x, turn), REACH)
        assert (away <= 1.5 * pixel_sizes((EYE,), poses_at(x)[:, :3], REACH)).all()
        x, turn = x + rng.normal(0, 0.002), turn + rng.normal(0, 0.01)


def test_a_body_at_rest_gets_its_exact_pose() -> None:
    sent = SentPoses(REACH)
    sent.update(poses_at(0.0), (EYE,), 0.0)
    end = poses_at(0.0123456, turn=0.1234)
    shown, _ = sent.update(end, (EYE,), 1.0)
    assert not np.array_equal(shown, end)
    shown, _ = sent.update(end, (EYE,), 1.0 + AT_REST_SECONDS / 2)
    assert not np.array_equal(shown, end)
    shown, changed = sent.update(end, (EYE,), 1.01 + AT_REST_SECONDS)
    assert np.array_equal(shown, end) and changed.all()
    _, changed = sent.update(end, (EYE,), 2.0)
    assert not changed.any(), "once"


def test_a_closer_eye_shows_motion_that_was_too_small() -> None:
    sent = SentPoses(REACH)
    sent.update(poses_at(0.0), (EYE,), 0.0)
    _, changed = sent.update(poses_at(0.003), (EYE,), 0.03)
    assert not changed.any()
    near = Eye(np.array([0.0, 0.0, 1.5]), 0.001)
    _, changed = sent.update(poses_at(0.003), (EYE, near), 0.06)
    assert changed.any(), "for one of the two pages"


def test_an_appearing_or_disappearing_body_is_sent() -> None:
    sent = SentPoses(REACH)
    sent.update(poses_at(0.0), (EYE,), 0.0)
    gone = poses_at(0.0)
    gone[3] = np.nan
    shown, changed = sent.update(gone, (EYE,), 0.03)
    assert changed[3] and not np.delete(changed, 3).any() and np.isnan(shown[3]).all()
    shown, changed = sent.update(poses_at(0.0), (EYE,), 0.06)
    assert changed[3] and np.isfinite(shown).all()


def test_a_page_that_folded_its_view_has_an_eye() -> None:
    camera = SimpleNamespace(position=np.zeros(3), fov=1.0, image_height=0)
    server: Any = SimpleNamespace(get_clients=lambda: {0: SimpleNamespace(camera=camera)})
    (eye,) = eyes_of(server)
    assert np.isfinite(eye.pixel)
