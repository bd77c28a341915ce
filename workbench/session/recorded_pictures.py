"""Which pictures of a task an episode keeps. Apart from whoever writes episodes, since workers need no more than this."""

from __future__ import annotations

from collections.abc import Iterable

from workbench.core.pictures import CameraInfo, CameraKind


def recorded_pictures(cameras: Iterable[CameraInfo]) -> tuple[tuple[str, CameraKind, tuple[str, ...]], ...]:
    """What an episode keeps: of a sensor what a policy may see, of a human camera colour."""
    asked = []
    for camera in cameras:
        wanted = ("rgb", "depth", "segmentation") if camera.kind == "sensor" else ("rgb",)
        kept = tuple(modality for modality in wanted if modality in camera.modalities)
        asked.append((camera.name, camera.kind, kept))
    return tuple(asked)
