"""The text of a camera report: worst objects first, and the worst problem of each env."""

from __future__ import annotations

import numpy as np
import pytest

from workbench.cameras.report_panel import env_words, headline, object_rows
from workbench.pictures.camera_report import DEPTH_EDGES_METRES, CameraReport, DepthReport, ObjectSeen


def seen(
    name: str,
    pixels: list[float],
    unhindered: list[float] | None = None,
    alone: list[float] | None = None,
    cut: tuple[int, ...] = (),
    present: list[bool] | None = None,
    scenery: bool = False,
    never_drawn: bool = False,
) -> ObjectSeen:
    count = len(pixels)
    unhindered = pixels if unhindered is None else unhindered
    return ObjectSeen(
        name=name,
        never_drawn=never_drawn,
        scenery=scenery,
        present=np.array([True] * count if present is None else present),
        pixels=np.array(pixels, np.float32),
        unhindered=np.array(unhindered, np.float32),
        alone=np.array(unhindered if alone is None else alone, np.float32),
        margin=np.zeros(count, np.float32),
        cut=np.isin(np.arange(count), cut),
    )


def depth_of(counts: dict[int, int], envs: int, farthest_object: float = 1.5) -> DepthReport:
    """Return a depth report with pixel `counts` by bin and the distance of the farthest object."""
    rows = np.zeros((envs, len(DEPTH_EDGES_METRES) - 1), np.int64)
    for place, count in counts.items():
        rows[:, place] = count
    share = np.full(envs, 0.25, np.float32)
    metres = np.full(envs, farthest_object, np.float32)
    return DepthReport(rows, share, share, metres, metres)


def report_of(*objects: ObjectSeen) -> CameraReport:
    envs = len(objects[0].pixels)
    return CameraReport(
        camera=("sensor", "base_camera"),
        size=(128, 128),
        measured_size=(64, 64),
        envs=tuple(range(envs)),
        objects=objects,
        depth=depth_of({20: 10, 30: 5}, envs),
        pictures=2 * envs,
        milliseconds=100.0,
    )


def test_rows_list_the_least_seen_object_first_without_scenery() -> None:
    report = report_of(
        seen("bowl", [90, 80, 70, 60]),
        seen("cube", [0, 50, 40, 30], unhindered=[20, 50, 80, 30], cut=(3,)),
        seen("table", [999, 999, 999, 999], scenery=True),
        seen("goal", [0, 0, 0, 0], never_drawn=True),
    )
    rows = object_rows(report)
    assert [row["name"] for row in rows] == ["cube", "bowl", "goal"]
    assert (rows[0]["seen"], rows[0]["pixels"], rows[0]["share"]) == ("75 %", "35", "0.21 %")
    assert rows[0]["cut"] == "25 %"
    assert rows[0]["bad"] == ["seen", "cut", "hidden"] and rows[1]["bad"] == []
    assert rows[2]["seen"] == "" and "hides" in rows[2]["note"]
    (half,) = object_rows(
        report_of(seen("cube", [40, 50, 60], unhindered=[80, 50, 60], present=[True, True, False]))
    )
    assert half["bad"] == ["hidden"] and "2 of 3" in half["note"] and half["hidden"] == "25 %"
    assert half["moods"] == ["good", "good", "none"]
    (little,) = object_rows(report_of(seen("cube", [90, 50], unhindered=[100, 50], alone=[100, 90])))
    assert little["bad"] == [] and "behind other objects" in little["note"]
    (absent,) = object_rows(report_of(seen("cube", [0], present=[False])))
    assert absent["seen"] == ""


@pytest.mark.parametrize(
    ("thing", "words"),
    [
        (seen("cube", [0, 90]), "cube is not visible in 1 of 2 envs."),
        (
            seen("cube", [50, 90], cut=(1,)),
            "Everything is visible; cube is cut by the border in 1 of 2 envs.",
        ),
        (seen("cube", [50, 90]), "Everything is visible, and nothing is cut."),
        (seen("table", [50, 90], scenery=True), "No object is visible in these envs."),
    ],
)
def test_the_headline_names_the_worst_problem(thing: ObjectSeen, words: str) -> None:
    assert headline(report_of(thing)) == words


def test_an_env_is_labelled_with_its_worst_problem() -> None:
    free = [0.0, 30.0, 80.0, 90.0, 90.0, 20.0, 0.0, 45.0]
    cube = seen("cube", [0, 0, 40, 90, 90, 20, 0, 45], free, alone=[*free[:6], 50, 90], cut=(3,))
    report = report_of(cube, seen("bowl", [200] * 8))
    assert [env_words(report, env) for env in range(8)] == [
        "no cube",
        "cube hidden",
        "cube 50 % hidden",
        "cube cut",
        "cube 90 px",
        "cube 20 px, small",
        "cube hidden",
        "cube 50 % behind objects",
    ]
