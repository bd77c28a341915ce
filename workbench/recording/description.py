"""What is said of an episode that is being written."""

from __future__ import annotations

import base64
import io
import os
from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from workbench.recording.columns import BATCH, tracks_words
from workbench.recording.document import SHARED, CameraWords, ColumnWords, Description, SceneWords, checksum
from workbench.recording.encoded_pictures import small_jpeg
from workbench.recording.made_here import seal
from workbench.recording.survey import Survey

THUMBNAIL_WIDTH = 160


def describe(survey: Survey) -> Description:
    """What a recording says of itself wherever it goes."""
    info, geometry = survey.info, survey.header.geometry
    folder = os.path.dirname(info.source_file) if info.source_file else ""
    return Description(
        **{name: getattr(info, name) for name in SHARED},
        seed=info.seed if info.seed >= 0 else None,
        source_file=os.path.basename(info.source_file) if info.source_file else None,
        source={_relative(path, folder): text for path, text in info.source.items()},
        length=survey.length,
        total_reward=float(np.sum(survey.reward, dtype=np.float64)),
        success=_last(survey, "success"),
        success_once=_once(survey, "success"),
        fail=_last(survey, "fail"),
        fail_once=_once(survey, "fail"),
        action_names=survey.header.action_names,
        cameras=[CameraWords.of(camera.info) for camera in survey.cameras],
        segmentation=survey.header.segmentation,
        scene=SceneWords(geometry.body_names, geometry.body_kinds, geometry.body_hidden),
        evaluate=_columns(survey.evaluate()),
        batch=_columns(survey.named(BATCH)),
        texts=tracks_words(survey.texts),
        obs=_columns(survey.named("obs/")),
    )


def describe_beside(survey: Survey, folder: Path, files: Sequence[Path]) -> Description:
    """`describe`, with what is only worth saying in `folder`, where the recording lies; of which these are the other `files`."""
    info = survey.info
    source = info.source_file if info.source_file and os.path.isabs(info.source_file) else None
    said = msgspec.structs.replace(describe(survey), files={path.suffix: checksum(path) for path in files})
    return msgspec.structs.replace(
        said,
        source_path=None if source is None else _relative(source, os.fspath(folder.resolve())),
        thumbnail=thumbnail(survey.sample),
        made_here=seal(said, source) if survey.header.made_here else None,
    )


def thumbnail(picture: bytes | None) -> str | None:
    """`picture` (JPEG), small, in base64."""
    if picture is None:
        return None
    with Image.open(io.BytesIO(picture)) as image:
        return base64.b64encode(small_jpeg(image, THUMBNAIL_WIDTH)).decode()


def _columns(columns: dict[str, NDArray]) -> dict[str, ColumnWords]:
    return {name: (column.dtype.str, column.shape[1:]) for name, column in columns.items()}


def _last(survey: Survey, name: str) -> bool | None:
    return bool(survey.flags[name][-1]) if name in survey.flags else None


def _once(survey: Survey, name: str) -> bool | None:
    values: NDArray[np.bool_] | None = survey.flags.get(name)
    return None if values is None else bool(values.any())


def _relative(path: str, folder: str) -> str:
    """Where a source file lies as seen from the task's: the folders above it are nobody's business."""
    if not folder:
        return os.path.basename(path)
    return os.path.relpath(path, folder)
