"""The Cameras tab, drawn from views that are made by hand; of the session it only asks for pictures."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import viser

from tests.session.conftest import TASKS
from tests.ui.scenes import camera, description, running, table_scene
from workbench.core.pictures import CameraInfo, Picture
from workbench.session.messages import TaskOptions
from workbench.session.session import Session
from workbench.session.view import SessionView
from workbench.ui.cameras_panel import CamerasPanel

POSE = np.array([0, 0, 1, 1, 0, 0, 0], np.float32)


@pytest.fixture
def session(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Session]:
    options = TaskOptions(num_envs=1, env_kwargs={"render_backend": "none"})
    session = Session(str(TASKS / "minimal.py"), options, recordings=tmp_path_factory.mktemp("kept"))
    yield session
    session.close()


def seen(serial: int, cameras: tuple[CameraInfo, ...], pictured: bool = True) -> SessionView:
    pictures = {
        (c.kind, c.name): Picture(c.name, c.kind, 0, POSE, np.zeros((6, 8, 3), np.uint8)) for c in cameras
    }
    return running(
        1,
        task=description(table_scene(1)[0], cameras),
        cameras_serial=serial,
        pictures=pictures if pictured else {},
        pictures_serial=serial,
    )


def test_a_camera_that_stays_keeps_its_place_its_ticks_and_its_picture(
    server: viser.ViserServer, session: Session
) -> None:
    panel = CamerasPanel(server, session)
    panel.draw(seen(1, (camera("base"), camera("hand"))))
    base = panel._cameras["sensor", "base"]
    base.ticks["depth"].value = True
    panel._drawn_at = 0.0
    panel.draw(seen(2, (camera("top"), replace(camera("base"), width=640))))
    assert list(panel._cameras) == [("sensor", "top"), ("sensor", "base")]
    again = panel._cameras["sensor", "base"]
    assert again.folder is base.folder and again.ticks["depth"].value and again.folder.order == 1
    assert "640 × 6" in again.facts.content and again.images["rgb"] is base.images["rgb"]
    # What it can show is another choice of ticks.
    panel.draw(seen(3, (replace(camera("base"), modalities=("rgb",)),)))
    assert list(panel._cameras["sensor", "base"].ticks) == ["rgb"] and base.folder._impl.removed


def test_pictures_of_another_moment_are_said_to_be_that(server: viser.ViserServer, session: Session) -> None:
    panel = CamerasPanel(server, session)
    cameras = (camera("base"),)
    panel.draw(seen(1, cameras))
    facts = panel._cameras["sensor", "base"].facts
    assert "another moment" not in facts.content
    panel.draw(seen(1, cameras, pictured=False))
    assert "another moment" in facts.content and "wb-other-moment" in facts.content
    panel.draw(seen(1, cameras))
    assert "another moment" not in facts.content
