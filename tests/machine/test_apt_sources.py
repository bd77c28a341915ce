from __future__ import annotations

from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st

from workbench.machine.apt import (
    AptSource,
    backports_source,
    parse_deb822_format,
    parse_one_line_format,
    read_apt_sources,
)

KEYRING = "/usr/share/keyrings/debian-archive-keyring.gpg"

words = st.from_regex(r"[a-z][a-z0-9./-]{0,12}", fullmatch=True)
uris = st.builds(
    lambda scheme, rest: f"{scheme}{rest}", st.sampled_from(["http://", "https://", "mirror+file:/"]), words
)
keyrings = st.one_of(st.none(), words.map(lambda word: f"/usr/share/keyrings/{word}.gpg"))


@given(uri=uris, suite=words, components=st.lists(words, max_size=3), keyring=keyrings)
def test_both_formats_of_a_source_parse_equally(
    uri: str, suite: str, components: list[str], keyring: str | None
) -> None:
    options = {} if keyring is None else {"Signed-By": keyring}
    bracket = "" if keyring is None else f"[arch=amd64 signed-by={keyring}] "
    signed = "" if keyring is None else f"Architectures: amd64\nSigned-By: {keyring}\n"
    if keyring is not None:
        options["Architectures"] = "amd64"
    wanted = AptSource((uri,), (suite,), tuple(components), options)
    assert parse_one_line_format(f"deb {bracket}{uri} {suite} {' '.join(components)}") == [wanted]
    paragraph = f"Types: deb\nURIs: {uri}\nSuites: {suite}\nComponents: {' '.join(components)}\n{signed}"
    assert parse_deb822_format(paragraph) == [wanted]


@given(text=st.text(max_size=300))
def test_any_text_parses_without_raising(text: str) -> None:
    for source in [*parse_one_line_format(text), *parse_deb822_format(text)]:
        assert source.uris and source.suites


def test_disabled_and_source_only_sources_are_skipped() -> None:
    assert (
        parse_one_line_format("# deb http://m/debian bookworm main\ndeb-src http://m/debian bookworm main")
        == []
    )
    off = "Enabled: no\nTypes: deb\nURIs: http://m/debian\nSuites: bookworm\nComponents: main\n"
    source_only = "Types: deb-src\nURIs: http://m/debian\nSuites: bookworm\nComponents: main\n"
    assert parse_deb822_format(f"{off}\n{source_only}") == []


def test_backports_use_the_releases_mirror_and_its_keyring() -> None:
    text = (
        "Types: deb\n# a comment inside\nURIs: http://vendor/apt\nSuites: stable\nComponents: main\n\n"
        "Types: deb deb-src\nURIs: https://mirror.lan/debian\nSuites: bookworm bookworm-updates\n"
        f"Components: main contrib\nSigned-By: {KEYRING}\n"
    )
    written = backports_source(parse_deb822_format(text), "bookworm")
    assert written is not None
    assert parse_deb822_format(written) == [
        AptSource(("https://mirror.lan/debian",), ("bookworm-backports",), ("main",), {"Signed-By": KEYRING})
    ]


def test_no_backports_source_without_a_mirror_of_the_release() -> None:
    security = "deb http://m/debian-security bookworm-security main\ndeb http://vendor/apt bookworm vendor"
    assert backports_source(parse_one_line_format(security), "bookworm") is None


def test_sources_are_read_from_all_files(tmp_path: Path) -> None:
    (tmp_path / "sources.list").write_text("deb http://a/debian bookworm main\n")
    (tmp_path / "sources.list.d").mkdir()
    (tmp_path / "sources.list.d" / "b.sources").write_text(
        "Types: deb\nURIs: http://b/x\nSuites: b\nComponents: c\n"
    )
    (tmp_path / "sources.list.d" / "c.list.disabled").write_text("deb http://c/debian bookworm main\n")
    assert [source.uris for source in read_apt_sources(tmp_path)] == [("http://a/debian",), ("http://b/x",)]
