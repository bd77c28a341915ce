"""The Share tab without a browser: what it offers, and what its buttons make."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.drive.panels import Panels
from workbench.episodes.films import FilmEye
from workbench.episodes.lerobot.export import ExportOptions
from workbench.episodes.row import Source
from workbench.page.door.file_response import Downloads
from workbench.page.door.gated_server import GatedServer
from workbench.share.commands import MakeShared
from workbench.share.make import EVERY_CAMERA, Made, MakeRequest, Making, MakingView
from workbench.share.panel import ALL_CAMERAS, MAX_NAMED, MAX_RESULTS, Chosen, SharePanel


class RecordingMaking(Making):
    """Records requests instead of starting a process for them."""

    def __init__(self) -> None:
        super().__init__()
        self.wanted: list[MakeRequest] = []
        self.downloads: list[MakeRequest] = []
        self.shown = MakingView()

    def view(self) -> MakingView:
        return self.shown

    def start(self, wanted: MakeRequest, download: bool = False) -> bool:
        self.wanted.append(wanted)
        self.downloads += [wanted] if download else []
        return True


@pytest.fixture
def making() -> Iterator[RecordingMaking]:
    making = RecordingMaking()
    yield making
    making.close()


@pytest.fixture
def panels(gated_server: GatedServer) -> Panels:
    return Panels(gated_server.server)


@pytest.fixture
def panel(panels: Panels, gated_server: GatedServer, making: RecordingMaking, tmp_path: Path) -> SharePanel:
    panel = SharePanel(gated_server.server, Downloads(gated_server.add_route), making, tmp_path)
    panels.visitors.do = panel.do
    return panel


RECORDING = Source(Path("/recordings/Push_seed1.json"))


def test_without_a_recording_nothing_can_be_made(
    panel: SharePanel, panels: Panels, making: RecordingMaking
) -> None:
    panel.draw(Chosen())
    assert panels.button("Make").command is None and "Select recordings" in panels.html()
    panels.do(MakeShared())
    assert making.wanted == [] and "Select recordings" in panels.client.notices[-1]


def test_recordings_and_files_are_named_before_they_are_made(panel: SharePanel, panels: Panels) -> None:
    panel.draw(Chosen((RECORDING,), ("base_camera", "hand/camera"), selected=True))
    assert "Selected in the library" in panels.html() and "Push_seed1" in panels.html()
    html = panels.html()
    assert "2 files" in html and "Push_seed1.base_camera.mp4" in html and "Push_seed1.hand_camera.mp4" in html
    many = tuple(Source(Path(f"/recordings/r{k}.json")) for k in range(MAX_NAMED + 2))
    panel.draw(Chosen(many))
    assert "Open in the review" in panels.html() and "and 2 more" in panels.html()
    assert "one video for each camera of these 7 recordings" in panels.html()
    panels.set("Make", "Sheet of pictures (png)")
    panel.draw(Chosen(many))
    assert f"{MAX_NAMED + 2} files" in panels.html()
    assert panels.html().count("and 2 more") == 2 and panels.html().count(".sheet.png<") == MAX_NAMED


def test_a_film_shows_the_chosen_camera_or_every_camera(
    panel: SharePanel, panels: Panels, making: RecordingMaking
) -> None:
    panel.draw(Chosen((RECORDING,), ("base_camera", "hand_camera")))
    assert list(panels.field("Camera").options) == [ALL_CAMERAS, "base_camera", "hand_camera"]
    panels.press("Make")
    panels.set("Camera", "hand_camera")
    panels.press("Make")
    assert [wanted.camera for wanted in making.wanted] == [EVERY_CAMERA, "hand_camera"]
    assert making.downloads == making.wanted
    panel.draw(Chosen((RECORDING,), ("base_camera",)))
    assert not panels.shows("Camera"), "there is no choice"


def test_demonstrations_are_saved_with_the_datasets_and_not_offered_as_a_download(
    panel: SharePanel, panels: Panels, making: RecordingMaking, tmp_path: Path
) -> None:
    panels.set("Make", "ManiSkill demonstrations (h5)")
    panel.draw(Chosen((RECORDING,)))
    assert panels.shows("Only successes") and not panels.shows("Task") and not panels.shows("Camera")
    panels.press("Make")
    (wanted,) = making.wanted
    assert wanted.what == "maniskill" and wanted.export.only_successes and not making.downloads
    assert wanted.folder.parent == tmp_path / "datasets" and wanted.folder.suffix == ".h5"
    wanted.folder.parent.mkdir()
    wanted.folder.write_bytes(b"h5")
    making.shown = MakingView(made=(Made((wanted.folder,), "1 episode, 8 steps."),))
    panel.draw(Chosen((RECORDING,)))
    assert "1 episode, 8 steps." in panels.html() and str(wanted.folder) in panels.html()
    assert "download" not in panels.html()


def test_only_successes_cannot_be_ticked_without_a_success(
    panel: SharePanel, panels: Panels, making: RecordingMaking
) -> None:
    several = tuple(Source(Path(f"/recordings/r{k}.json")) for k in range(3))
    panels.set("Make", "LeRobot dataset")
    panel.draw(Chosen(several, successes=0))
    ticked = panels.field("Only successes")
    assert ticked.off and not ticked.value
    panels.press("Make")
    assert not making.wanted[-1].export.only_successes
    panel.draw(Chosen(several, successes=2))
    ticked = panels.field("Only successes")
    assert not ticked.off and ticked.value and "None of them" not in panels.html()
    assert "one dataset of the 2 of these 3 recordings that reach success" in panels.html()
    panels.set("Only successes", False)
    panel.draw(Chosen(several, successes=2))
    assert not panels.field("Only successes").value and "one dataset of these 3 recordings" in panels.html()
    panel.draw(Chosen(several))
    ticked = panels.field("Only successes")
    assert not ticked.off and not ticked.value


def test_made_files_can_be_saved_and_errors_are_shown(
    panel: SharePanel, panels: Panels, making: RecordingMaking, tmp_path: Path
) -> None:
    film = tmp_path / "a<b>.mp4"
    making.shown = MakingView(running=True, done=0.4, doing="a: the 3D view")
    panel.draw(Chosen((RECORDING,)))
    assert "width: 40%" in panels.html() and panels.shows("Stop") and not panels.shows("Make", "button")
    making.shown = MakingView(
        made=(Made((film,), "1 file", sizes=(2_500_000,)),), problem="There is no <room>."
    )
    panel.draw(Chosen((RECORDING,)))
    html = panels.html()
    assert "a&lt;b&gt;.mp4" in html and "2.5 MB" in html and "/offered/" in html and "<room>" not in html


def test_every_choice_of_a_dataset_is_in_its_request(
    panel: SharePanel, panels: Panels, making: RecordingMaking, tmp_path: Path
) -> None:
    two = tuple(Source(Path(f"/recordings/r{k}.json")) for k in range(2))
    panels.set("Make", "LeRobot dataset")
    panel.draw(Chosen(two[:1]))
    assert not panels.shows("Only compatible ones"), "one recording fits itself"
    panel.draw(Chosen(two, in_view=False))
    assert panels.shows("Only compatible ones") and panels.shows("Task")
    panels.type("Task", "  push it ")
    panels.set("Only compatible ones", False)
    panels.press("Make")
    panels.type("Task", " ")
    panels.set("Only successes", False)
    panels.set("Only compatible ones", True)
    panel.draw(Chosen(two))
    panels.press("Make")
    assert [(one.what, one.sources, one.export) for one in making.wanted] == [
        ("lerobot", two, ExportOptions(only_successes=True, only_fitting=False, instruction="push it")),
        ("lerobot", two, ExportOptions(only_successes=False, only_fitting=True, instruction=None)),
    ]
    assert all(one.folder.parent == tmp_path / "datasets" for one in making.wanted) and not making.downloads


def test_the_choice_between_open_and_selected_recordings_counts_only_if_there_is_one(
    panel: SharePanel, panels: Panels
) -> None:
    assert not panel.choose_opened(True) and panels.shows("Share")
    panels.set("Share", "the open recordings")
    assert panel.choose_opened(True)
    assert not panel.choose_opened(False) and not panels.shows("Share")


def test_a_film_of_the_view_is_seen_from_where_the_person_looks(
    panel: SharePanel, panels: Panels, making: RecordingMaking
) -> None:
    looks = {
        "position": (1.0, 2.0, 3.0),
        "look_at": (4.0, 5.0, 6.0),
        "up_direction": (0.0, 0.0, 1.0),
        "fov": 0.5,
    }
    panels.client.camera = SimpleNamespace(**looks, image_width=640)
    panels.set("Make", "Video of the 3D view (mp4)")
    for in_view, width in ((True, 640), (False, 640), (True, 0)):
        panels.client.camera.image_width = width
        panel.draw(Chosen((RECORDING,), in_view=in_view))
        panels.press("Make")
    eye = FilmEye((1.0, 2.0, 3.0), (4.0, 5.0, 6.0), (0.0, 0.0, 1.0), 0.5)
    assert [one.eye for one in making.wanted] == [eye, None, None]
    assert [one.what for one in making.downloads] == ["scene"] * 3


def test_the_panel_follows_the_job_the_choice_and_the_recordings(
    panel: SharePanel, panels: Panels, making: RecordingMaking
) -> None:
    """Each of them alone redraws it."""
    chosen = Chosen((RECORDING,), ("base_camera",))
    panel.draw(chosen)
    seen = [panels.html()]
    making.shown = MakingView(made=(Made((), "1 file"),))
    panel.draw(chosen)
    seen.append(panels.html())
    panels.set("Make", "Sheet of pictures (png)")
    panel.draw(chosen)
    seen.append(panels.html())
    panel.draw(replace(chosen, sources=(Source(Path("/recordings/other.json")),)))
    seen.append(panels.html())
    assert len(set(seen)) == 4 and "other.sheet.png" in seen[-1] and "1 file" in seen[1]
    making.shown = MakingView(
        made=tuple(Made((Path(f"/d/{k}"),), f"number {k}.") for k in range(MAX_RESULTS + 2))
    )
    panel.draw(chosen)
    html = panels.html()
    assert f"number {MAX_RESULTS - 1}." in html and f"number {MAX_RESULTS}." not in html
