from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from workbench.machine.apt import PackageVersion, parse_madison
from workbench.machine.render_probe import RenderProbe
from workbench.machine.software_vulkan import first_good_mesa, known_render_device, mesa_version

DEBIAN_12_WITH_BACKPORTS = """\
mesa-vulkan-drivers | 25.0.7-2~bpo12+1 | http://mirror/debian bookworm-backports/main amd64 Packages
mesa-vulkan-drivers | 22.3.6-1+deb12u1 | http://mirror/debian bookworm/main amd64 Packages
"""
UBUNTU_24_04 = """\
mesa-vulkan-drivers | 25.2.8-0ubuntu0.24.04.1 | http://mirror/ubuntu noble-updates/main amd64 Packages
mesa-vulkan-drivers | 24.0.5-1ubuntu1 | http://mirror/ubuntu noble/main amd64 Packages
"""
UBUNTU_22_04 = "mesa-vulkan-drivers | 23.2.1-1ubuntu3.1~22.04.3 | http://mirror/ubuntu jammy-updates/main amd64 Packages\n"


@pytest.mark.parametrize(
    ("listing", "wanted"),
    [
        (DEBIAN_12_WITH_BACKPORTS, PackageVersion("25.0.7-2~bpo12+1", "bookworm-backports")),
        (UBUNTU_24_04, PackageVersion("25.2.8-0ubuntu0.24.04.1", "noble-updates")),
        (UBUNTU_22_04, None),
        ("", None),
        ("N: Unable to locate package mesa-vulkan-drivers\n", None),
    ],
)
def test_a_mesa_version_that_works_with_sapien_is_chosen(listing: str, wanted: PackageVersion | None) -> None:
    assert first_good_mesa(parse_madison(listing)) == wanted


@pytest.mark.parametrize(
    ("version", "wanted"),
    [("1:24.3.0-1", (24, 3)), ("22.3.6-1+deb12u1", (22, 3)), ("25.0.7", (25, 0)), ("git20250101", (0, 0))],
)
def test_debian_versions_are_parsed(version: str, wanted: tuple[int, int]) -> None:
    assert mesa_version(version) == wanted


@pytest.mark.usefixtures("child_process")
def test_a_found_device_is_cached_until_its_driver_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    found = known_render_device(install=False)
    if not found.ok:
        pytest.skip("nothing renders here")
    (cached,) = (tmp_path / "workbench").glob("render-device-*.json")
    cached.write_bytes(msgspec.json.encode(RenderProbe(ok=True, name="from the cache")))
    assert known_render_device(install=False).name == "from the cache"
    cached.write_bytes(b"{")
    assert known_render_device(install=False) == found
    broken = tmp_path / "broken.json"
    broken.write_text("{}")
    monkeypatch.setenv("VK_DRIVER_FILES", str(broken))
    assert not known_render_device(install=False).ok
    assert len([*cached.parent.glob("render-device-*.json")]) == 1, "only working devices are cached"
