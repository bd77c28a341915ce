from __future__ import annotations

import pytest

from workbench.machine.apt import PackageVersion, parse_madison
from workbench.machine.software_vulkan import first_good_mesa, mesa_version

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
def test_a_mesa_that_sapien_renders_on_is_chosen(listing: str, wanted: PackageVersion | None) -> None:
    assert first_good_mesa(parse_madison(listing)) == wanted


@pytest.mark.parametrize(
    ("version", "wanted"),
    [("1:24.3.0-1", (24, 3)), ("22.3.6-1+deb12u1", (22, 3)), ("25.0.7", (25, 0)), ("git20250101", (0, 0))],
)
def test_versions_are_read_as_debian_writes_them(version: str, wanted: tuple[int, int]) -> None:
    assert mesa_version(version) == wanted
