"""Where no driver renders, a software driver is provided: which steps are taken, and what the user is told."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from workbench.machine import software_vulkan as module
from workbench.machine.apt import AptFailed, AptSource, PackageVersion, apt_get, apt_install
from workbench.machine.render_probe import RenderProbe, driver_files
from workbench.machine.software_vulkan import (
    MESA,
    ensure_render_device,
    first_good_mesa,
    private_mesa_env,
    unpack_private_mesa,
)

BAD, GOOD = RenderProbe(ok=False, error="no device"), RenderProbe(ok=True, name="llvmpipe", env={"A": "b c"})
LACKS = RenderProbe(ok=False, error="missing", missing_libraries=("libX11.so.6", "libGL.so.1"))
NEW, OLD = PackageVersion("25.0.7-2", "bookworm-backports"), PackageVersion("22.3.6-1", "bookworm")


@dataclass
class Machine:
    """A machine in which only some things work; records what is done to it."""

    probes: list[RenderProbe]
    """Results of the probes, in order."""
    apt: bool = True
    root: bool = False
    private: dict[str, str] | None = None
    offers: list[list[PackageVersion]] = field(default_factory=lambda: [[OLD]])
    """What apt offers at each question; the last one counts for all later ones."""
    release: dict[str, str] = field(default_factory=lambda: {"ID": "debian", "VERSION_CODENAME": "bookworm"})
    unpacks: Any = None
    done: list[Any] = field(default_factory=list)

    def probe(self, env: Any = None) -> RenderProbe:
        self.done.append(("probe", env) if env else "probe")
        return self.probes.pop(0)

    def unpack(self, package: str, source: str | None, choose: Callable[..., Any]) -> Any:
        assert package == MESA and choose([OLD, NEW]) == NEW
        self.done.append(("unpack", bool(source)))
        if isinstance(self.unpacks, Exception):
            raise self.unpacks
        return self.unpacks

    def install(self, patch: pytest.MonkeyPatch, file: Path) -> Machine:
        for name, value in {
            "probe_render_device": self.probe,
            "has_apt": lambda: self.apt,
            "can_install_packages": lambda: self.root,
            "private_mesa_env": lambda: self.private,
            "available_versions": lambda package: (
                self.offers.pop(0) if len(self.offers) > 1 else self.offers[0]
            ),
            "os_release": lambda: self.release,
            "read_apt_sources": lambda: [AptSource(("http://m/debian",), ("bookworm",), ("main",))],
            "unpack_private_mesa": self.unpack,
            "apt_get": lambda arguments, *_: self.done.append(arguments),
            "apt_install": lambda *packages: self.done.append(["apt_install", *packages]),
            "BACKPORTS_FILE": file,
        }.items():
            patch.setattr(module, name, value)
        for name in ("VK_DRIVER_FILES", "VK_ICD_FILENAMES"):
            patch.delenv(name, raising=False)
        return self


INSTALL_NEW = ["install", "--no-install-recommends", "-t", NEW.suite, f"{MESA}={NEW.version}"]


@pytest.mark.parametrize(
    ("machine", "install", "ok", "done", "advice"),
    [
        (Machine([GOOD], root=True), True, True, ["probe"], ""),
        (Machine([BAD], private=None), False, False, ["probe"], "software_vulkan"),
        (Machine([BAD, GOOD], private={"P": "1"}), False, True, ["probe", ("probe", {"P": "1"})], ""),
        (Machine([BAD, BAD], private={"P": "1"}), False, False, ["probe", ("probe", {"P": "1"})], "no device"),
        (Machine([BAD], apt=False), True, False, ["probe"], "24.3"),
        (Machine([BAD, GOOD], unpacks={"U": "1"}), True, True, ["probe", ("unpack", True), ("probe", {"U": "1"})], ""),
        (
            Machine([BAD, GOOD], unpacks={"U": "1"}, release={"ID": "ubuntu"}), True, True,
            ["probe", ("unpack", False), ("probe", {"U": "1"})], "",
        ),
        (Machine([BAD], unpacks=AptFailed("no network")), True, False, ["probe", ("unpack", True)], "bookworm-backports"),
        (
            Machine([BAD], unpacks=AptFailed("no network"), offers=[[NEW]]), True, False,
            ["probe", ("unpack", True)], f"-t {NEW.suite} {MESA}",
        ),
        (
            Machine([BAD], unpacks=AptFailed("no network"), release={"ID": "arch", "PRETTY_NAME": "Arch"}), True, False,
            ["probe", ("unpack", False)], "Arch",
        ),
        (Machine([BAD, GOOD], root=True, offers=[[NEW, OLD]]), True, True, ["probe", ["update"], INSTALL_NEW, "probe"], ""),
        (
            Machine([BAD, GOOD], root=True, offers=[[OLD], [OLD, NEW]]), True, True,
            ["probe", ["update"], ["update"], INSTALL_NEW, "probe"], "",
        ),
        (Machine([BAD], root=True), True, False, ["probe", ["update"], ["update"]], "backports"),
        (Machine([BAD, BAD], root=True, offers=[[NEW]]), True, False, ["probe", ["update"], INSTALL_NEW, "probe"], NEW.version),
        (Machine([BAD], root=True, release={}), True, False, ["probe", ["update"]], "Debian 12"),
        (Machine([LACKS]), True, False, ["probe"], "libx11-6 libgl1"),
        (Machine([LACKS], root=True), False, False, ["probe"], "libx11-6 libgl1"),
        (Machine([LACKS, GOOD], root=True), True, True, ["probe", ["apt_install", "libx11-6", "libgl1"], "probe"], ""),
    ],
)  # fmt: skip
def test_what_is_missing_is_brought_or_named(
    machine: Machine, install: bool, ok: bool, done: list[Any], advice: str, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    file = tmp_path / "backports.sources"
    machine.install(monkeypatch, file)
    probe = ensure_render_device(install)
    assert probe.ok == ok and machine.done == done and not machine.probes
    assert advice in (probe.error or "")
    assert file.exists() == (done.count(["update"]) == 2)
    if file.exists():
        assert "bookworm-backports" in file.read_text() and "http://m/debian" in file.read_text()


def test_a_driver_named_by_the_environment_is_left_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine = Machine([BAD], root=True, private={"P": "1"}).install(monkeypatch, tmp_path / "x")
    monkeypatch.setenv("VK_ICD_FILENAMES", "/mine.json")
    assert ensure_render_device(install=True) == BAD and machine.done == ["probe"]


@pytest.mark.parametrize("export", [True, False])
def test_the_shell_gets_only_the_variables_of_a_device(
    export: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[Any] = []
    for name in ("known_render_device", "ensure_render_device"):
        monkeypatch.setattr(module, name, lambda install, name=name: (asked.append((name, install)), GOOD)[1])
    monkeypatch.setattr("sys.argv", ["x", *(["--export"] if export else [])])
    module.main()
    *first, last = capsys.readouterr().out.splitlines()
    assert last == "export A='b c'" and bool(first) != export
    assert asked == [("known_render_device" if export else "ensure_render_device", True)]
    monkeypatch.setattr(module, "known_render_device", lambda install: BAD)
    monkeypatch.setattr(module, "ensure_render_device", lambda install: BAD)
    module.main()
    printed = capsys.readouterr()
    assert printed.out == "" and "no device" in printed.err


# --- the packages, with apt's programs replaced by scripts ------------------------------------------------


APT_GET = """
echo "$@" >> {log}
test -e {folder}/fails && {{ echo "E: no network" >&2; exit 100; }}
for one in "$@"; do case $one in
  Dir::Cache=*) mkdir -p "${{one#*=}}/archives"; touch "${{one#*=}}/archives/mesa.deb";;
  Dir::Etc::sourceparts=*) ls "${{one#*=}}" >> {log}; cat "${{one#*=}}"/workbench* >> {log};;
esac; done
exit 0
"""
DPKG_DEB = """
root=$3/usr/share/vulkan/icd.d; mkdir -p $root $3/usr/lib/x86 $3/lib/x86
echo '{{"ICD": {{"library_path": "{library}"}}}}' > $root/lvp_icd.x86_64.json
touch $3/usr/lib/x86/libvulkan_lvp.so $3/lib/x86/libz.so.1
"""
APT_CACHE = f"""
echo "{MESA} | {NEW.version} | http://m {NEW.suite}/main amd64 Packages"
echo "{MESA} | {OLD.version} | http://m {OLD.suite}/main amd64 Packages"
"""


@pytest.fixture
def programs(child_process: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Writes apt's programs into a folder that comes first on PATH."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("LD_LIBRARY_PATH", "/mine")
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")

    def write(library: str = "/usr/lib/elsewhere/libvulkan_lvp.so", offers: str = APT_CACHE) -> None:
        scripts = {
            "apt-get": APT_GET.format(log=tmp_path / "log", folder=tmp_path),
            "dpkg-deb": DPKG_DEB.format(library=library),
            "apt-cache": offers,
        }
        for name, script in scripts.items():
            (tmp_path / name).write_text(f"#!/bin/sh\n{script}")
            (tmp_path / name).chmod(0o755)

    return write


def test_an_unpacked_driver_is_found_with_its_libraries(
    programs: Callable[..., None], tmp_path: Path
) -> None:
    programs()
    assert private_mesa_env() is None
    for _ in range(2):
        env = unpack_private_mesa(MESA, "Suites: extra", first_good_mesa)
        root = tmp_path / "cache" / "workbench" / "mesa"
        assert env == private_mesa_env() == {
            "VK_DRIVER_FILES": str(root / "usr/share/vulkan/icd.d/lvp_icd.x86_64.json"),
            "LD_LIBRARY_PATH": f"{root / 'lib/x86'}:{root / 'usr/lib/x86'}:/mine",
        }  # fmt: skip
        manifest = json.loads(Path(env["VK_DRIVER_FILES"]).read_text())
        assert manifest["ICD"]["library_path"] == str(root / "usr/lib/x86/libvulkan_lvp.so")
    log = (tmp_path / "log").read_text()
    assert f"-t {NEW.suite} {MESA}={NEW.version}" in log and "--download-only" in log
    assert "Suites: extra" in log and "Dir::Etc::sourcelist=/dev/null" in log
    assert [path.name for path in root.parent.iterdir()] == ["mesa"], "no scratch folder is left"


@pytest.mark.parametrize("how", ["old", "fails", "library"])
def test_a_driver_that_cannot_be_unpacked_leaves_the_old_one(
    programs: Callable[..., None], tmp_path: Path, how: str
) -> None:
    programs()
    unpack_private_mesa(MESA, None, first_good_mesa)
    before = private_mesa_env()
    if how == "fails":
        (tmp_path / "fails").touch()
    programs(**{"old": {"offers": "echo"}, "library": {"library": "gone.so"}}.get(how, {}))
    with pytest.raises(AptFailed) as failed:
        unpack_private_mesa(MESA, None, first_good_mesa)
    assert {"old": MESA, "fails": "E: no network", "library": "gone.so"}[how] in str(failed.value)
    assert before is not None and (how == "library" or private_mesa_env() == before)


def test_apt_is_asked_without_questions(programs: Callable[..., None], tmp_path: Path) -> None:
    programs()
    apt_install("one", "two")
    first, second = (tmp_path / "log").read_text().splitlines()
    assert first.endswith(" update") and second.endswith(" install --no-install-recommends one two")
    assert "-y" in first.split() and "DPkg::Lock::Timeout=" in first
    (tmp_path / "fails").touch()
    with pytest.raises(AptFailed, match="E: no network"):
        apt_get(["update"])


def test_driver_files_are_those_that_the_loader_reads(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("VK_DRIVER_FILES", "VK_ICD_FILENAMES"):
        monkeypatch.delenv(name, raising=False)
    files = []
    for variable, place in (
        ("XDG_CONFIG_HOME", "a"),
        ("XDG_CONFIG_DIRS", "b"),
        ("XDG_DATA_HOME", "c"),
        ("XDG_DATA_DIRS", "d"),
    ):
        folder = tmp_path / place / "vulkan" / "icd.d"
        folder.mkdir(parents=True)
        (folder / f"{place}.json").touch()
        (folder / "no.txt").touch()
        files.append(folder / f"{place}.json")
        monkeypatch.setenv(
            variable, str(tmp_path / place) + (f":{tmp_path / 'gone'}" if variable.endswith("S") else "")
        )
    assert [file for file in driver_files() if file.is_relative_to(tmp_path)] == files
    monkeypatch.setenv("VK_ICD_FILENAMES", f"{files[2]}:/gone.json")
    assert driver_files() == [files[2]]
    monkeypatch.setenv("VK_DRIVER_FILES", str(files[1]))
    assert driver_files() == [files[1]], "the newer variable has precedence"
