"""Adding an argument to a call, in the layout that the call has."""

from __future__ import annotations

import libcst as cst

from workbench.authoring.camera_source.source_file import Replacement, SourceFile


def added_arguments(file: SourceFile, call: cst.Call, texts: list[str]) -> list[Replacement]:
    """`texts` (``near=0.01``) after the last argument: on lines of their own where the others have that."""
    if not texts:
        return []
    close = file.inner_span(call)[1] - 1
    if not call.args:
        return [Replacement(close, close, ", ".join(texts))]
    last = call.args[-1]
    end = argument_end(file, last)
    comma = isinstance(last.comma, cst.Comma)
    closing_line = file.line_at(close)
    before_close = file.text[file.line_start(closing_line) : close]
    own_lines = all(
        file.line(a) != file.line(b) for a, b in zip(call.args[1:], call.args[:-1], strict=True)
    ) and file.line(last) != file.line_at(file.inner_span(call.func)[1])
    own_lines = own_lines and (len(call.args) > 1 or comma)
    if own_lines and not before_close.strip() and file.line(last) != closing_line:
        line = file.line_text(file.line(last))
        indent = line[: len(line) - len(line.lstrip())]
        start = file.line_start(closing_line)
        lines = "".join(f"{indent}{text},\n" for text in texts)
        found = [Replacement(start, start, lines)]
        return found if comma else [Replacement(end, end, ","), *found]
    if comma:
        after = file.text.index(",", end) + 1
        return [Replacement(after, after, " " + ", ".join(texts))]
    return [Replacement(end, end, "".join(f", {text}" for text in texts))]


def argument_end(file: SourceFile, arg: cst.Arg) -> int:
    return file.span(arg.value)[1]


def argument_span(file: SourceFile, arg: cst.Arg) -> tuple[int, int]:
    return file.inner_span(arg)[0], argument_end(file, arg)
