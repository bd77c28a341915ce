"""An episode on one picture: what each camera saw, from the first moment to the last, a row a camera."""

from __future__ import annotations

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from workbench.recording.camera_pictures import cameras_by_name, picture_index
from workbench.recording.episode import Episode, flag_of

COLUMNS = 8
CELL = 176
"""Pixels of a picture's longer side."""
GAP, HEAD, CAPTION = 8, 34, 18
PAPER, INK, PALE = (255, 255, 255), (33, 37, 41), (110, 118, 126)
GOOD, BAD = (43, 138, 62), (201, 42, 42)


def contact_sheet(episode: Episode, columns: int = COLUMNS) -> Image.Image:
    """The sheet.

    Raises:
        ValueError: the episode was recorded without pictures.
    """
    cameras = cameras_by_name(episode)
    if not cameras:
        raise ValueError(
            f"The recording of {episode.info.task} has no camera pictures to make a sheet of; record it with pictures."
        )
    states = chosen_states(episode, columns)
    heights = []
    for camera in cameras.values():
        width, height = camera.info.width, camera.info.height
        heights.append(max(1, round(height * CELL / max(width, height))))
    sheet = Image.new(
        "RGB",
        (
            GAP + len(states) * (CELL + GAP),
            HEAD + sum(CAPTION + height + CAPTION + GAP for height in heights),
        ),
        PAPER,
    )
    draw = ImageDraw.Draw(sheet)
    large, small = ImageFont.load_default(15), ImageFont.load_default(12)
    draw.text((GAP, GAP), _title(episode), fill=INK, font=large)
    top, first_success = HEAD, _first(episode, "success")
    for (name, camera), height in zip(cameras.items(), heights):
        draw.text((GAP, top), name, fill=PALE, font=small)
        top += CAPTION
        assert camera.rgb is not None
        for column, state in enumerate(states):
            left = GAP + column * (CELL + GAP)
            picture = Image.fromarray(camera.rgb[picture_index(camera, state)])
            width = max(1, round(picture.width * height / picture.height))
            # Small pictures keep their pixels; large ones are averaged.
            how = Image.Resampling.NEAREST if picture.height < height else Image.Resampling.LANCZOS
            sheet.paste(picture.resize((width, height), how), (left, top))
            said = f"step {state}   {state * episode.info.control_dt:.2f} s"
            colour = PALE
            if state == first_success:
                said, colour = said + "   success", GOOD
            elif state == _first(episode, "fail"):
                said, colour = said + "   fail", BAD
            draw.text((left, top + height + 2), said, fill=colour, font=small)
        top += height + CAPTION + GAP
    return sheet


def chosen_states(episode: Episode, columns: int) -> list[int]:
    """`columns` states or fewer from the first to the last, evenly; the first success or fail in place of its neighbour."""
    states = sorted(set(np.linspace(0, episode.length, columns).round().astype(int).tolist()))
    for name in ("success", "fail"):
        moment = _first(episode, name)
        if moment is not None and moment not in states and len(states) > 2:
            inner = states[1:-1]
            states[states.index(min(inner, key=lambda state: abs(state - moment)))] = moment
            states.sort()
    return states


def _first(episode: Episode, name: str) -> int | None:
    """The first state at which this entry of ``evaluate()`` was true."""
    flag = flag_of(episode.evaluate.get(name))
    return None if flag is None or not flag.any() else int(flag.argmax())


def _title(episode: Episode) -> str:
    info = episode.info
    seed = f"   seed {info.seed}" if info.seed >= 0 else ""
    success = flag_of(episode.evaluate.get("success"))
    ended = "" if success is None else "   success" if success[-1] else "   no success"
    total = float(np.sum(episode.reward, dtype=np.float64))
    return f"{info.task}{seed}   {episode.length} steps   return {total:.2f}{ended}"
