"""Draws in the 3-D view what the task drew with `workbench.draw`, in one env."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import numpy as np
import viser
from numpy.typing import NDArray

from workbench.envs.task_drawings import Drawing
from workbench.page.scene.env_grid import InView, line_set, view_label


class TaskDrawingsView:
    """The task's drawings in the selected env."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._nodes: dict[str, tuple[tuple[object, ...], InView]] = {}
        """What each drawing looks like apart from its data, and its node, by name."""
        self._shown: dict[str, tuple[int, bytes]] = {}

    def draw(self, drawn: Mapping[str, Drawing], env: int, offset: NDArray) -> None:
        """Show these drawings instead of the previous ones.

        Args:
            offset: (3,) position of the env in the view, metres.
        """
        for name in self._nodes.keys() - drawn.keys():
            self._remove(name)
        for name, drawing in drawn.items():
            drawing = drawing.of_env(env)
            data = drawing.data[0].copy()
            data[..., :3] += np.asarray(offset, np.float32)
            text = drawing.texts[0] if drawing.texts else ""
            shown = hash((drawing.kind, text)), data.tobytes()
            looks = (drawing.kind, drawing.color, drawing.size, len(data))
            if self._shown.get(name) == shown and name in self._nodes and self._nodes[name][0] == looks:
                continue
            if name in self._nodes and self._nodes[name][0] != looks:
                self._remove(name)  # viser's arrays are set one after the other, and must have equal lengths
            if not len(data):
                continue
            if name not in self._nodes:
                self._nodes[name] = looks, self._node(name, drawing)
            node = self._nodes[name][1]
            if drawing.kind == "frames":
                node.draw(data[:, 3:], data[:, :3])
            elif drawing.kind == "text":
                node.draw(text or name, tuple(data[0].tolist()))
            else:
                node.draw(data)
            self._shown[name] = shown

    def _remove(self, name: str) -> None:
        self._nodes.pop(name)[1].draw()
        self._shown.pop(name, None)

    def _node(self, name: str, drawing: Drawing) -> InView:
        scene, path = self._server.scene, f"/drawn/{name.replace('/', ' ')}"
        match drawing.kind:
            case "points":
                look = {"colors": drawing.color, "point_size": drawing.size, "point_shape": "circle"}
                return InView(partial(scene.add_point_cloud, path, precision="float32", **look), "points")
            case "lines":
                return line_set(self._server, path, drawing.color, 2.0)
            case "arrows":
                sizes = {"shaft_radius": drawing.size / 4, "head_radius": drawing.size / 2}
                look = {"colors": drawing.color, "head_length": 2 * drawing.size, **sizes}
                return InView(partial(scene.add_arrows, path, **look), "points")
            case "frames":
                look = {"axes_length": drawing.size, "axes_radius": drawing.size / 30}
                return InView(
                    partial(scene.add_batched_axes, path, **look), "batched_wxyzs", "batched_positions"
                )
            case "text":
                return view_label(self._server, path, "bottom-left")
