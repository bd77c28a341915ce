"""Writes the 3-D view of an episode as an animated HTML file that needs no server and no network."""

from __future__ import annotations

import html
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import viser

from workbench.episodes.episode import Episode
from workbench.episodes.films import FilmEye, default_eye
from workbench.machine.files import new_file
from workbench.page.door.gated_server import ServerOptions, open_server
from workbench.page.scene.bodies import DrawStyle, SceneView
from workbench.page.scene.env_grid import lay_out
from workbench.page.widgets.templates import counted, render
from workbench.review.view import outcome_text

MAX_TRIANGLES = 80_000
"""Approximate maximum number of triangles. A robot's own meshes have twice as many; with them the file would
be three times the size."""

PAUSE_SECONDS = 1.0
"""Time for which the last state is held before the player repeats."""


def write_scene_html(
    path: Path,
    episode: Episode,
    eye: FilmEye | None = None,
    on_progress: Callable[[float], None] = lambda done: None,
) -> None:
    """Write the animated scene to a new file at `path`.

    viser's page can contain a recording of its server's messages, and play it. For this recording, the scene
    is built and moved state by state on a server without viewers, with pauses in between. The player repeats
    without a pause, so the recording holds the last state for `PAUSE_SECONDS`. The player's clock would
    include that time: the clock is hidden, and our caption shows the episode's time and step.

    Args:
        path: file, which must not exist.
        episode: episode with geometry and poses.
        eye: the initial viewpoint; None for the default.
        on_progress: called with the completed share, 0 to 1.

    Raises:
        ValueError: the recording has no scene.
        OSError: the file cannot be written.
    """
    if episode.geometry is None or episode.poses is None:
        raise ValueError(f"The recording of {episode.info.task} holds no 3D scene to show.")
    eye = eye or default_eye(episode)
    with new_file(path) as temporary:
        # viser needs a running server; its address is never shown.
        gated_server = open_server(ServerOptions(port=0))
        try:
            page = _recorded(gated_server.server, episode, eye, on_progress)
        finally:
            gated_server.close()
        title = f"{episode.info.task}, {counted(episode.length, 'step')}"
        page = page.replace("</body>", _caption(episode) + "</body>", 1)
        page = re.sub(r"<title>.*?</title>", lambda _: f"<title>{html.escape(title)}</title>", page, count=1)
        temporary.write_text(page, encoding="utf-8")
    on_progress(1.0)


def seconds_a_step(episode: Episode) -> float:
    return episode.info.control_dt if episode.info.control_dt > 0 else 0.05


def _caption(episode: Episode) -> str:
    info = episode.info
    about = f"{info.task}, seed {info.seed}" if info.seed >= 0 else info.task
    ended, tone = outcome_text(episode)
    dt = seconds_a_step(episode)
    return render("scene_caption", about=about, ended=ended if tone else "", dt=dt, steps=episode.length)


def _recorded(
    server: viser.ViserServer, episode: Episode, eye: FilmEye, on_progress: Callable[[float], None]
) -> str:
    geometry, poses = episode.geometry, episode.poses
    assert geometry is not None and poses is not None
    env = 0 if geometry.num_envs == 1 else episode.info.env_index
    server.scene.set_up_direction("+z")
    # Use viser's own lights: its player resets to them at every repetition, so other lights would flash.
    camera = server.initial_camera
    camera.position, camera.look_at, camera.up, camera.fov = eye.position, eye.look_at, eye.up, eye.fovy
    camera.near, camera.far = 0.05, 300.0
    # The scene has all envs, but the recording has only one: the others are NaN, and are not drawn.
    batch = np.full((geometry.num_envs, *poses.shape[1:]), np.nan, np.float32)
    batch[env] = poses[0]
    scene = SceneView(server)
    layout = lay_out(geometry, batch)
    scene.build(geometry, layout, batch, env, DrawStyle(MAX_TRIANGLES))
    recording = server.get_scene_serializer()
    for state, now in enumerate(poses):
        batch[env] = now
        scene.move(batch, layout, env)
        recording.insert_sleep(seconds_a_step(episode))
        on_progress(0.9 * state / len(poses))
    # The player repeats; without a pause the end would not be visible.
    recording.insert_sleep(PAUSE_SECONDS)
    return recording.as_html(dark_mode=True)
