"""``workbench view`` in a terminal: rerun's own viewer, in a window or, where there is no screen, in a page."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from pathlib import Path

from workbench.cli.terminal import refuse, say, say_addresses, warn
from workbench.recording.rerun.viewer import has_screen, open_window, resolve_recordings, web_viewer_folder


def view_in_terminal(files: Sequence[Path], web: bool, host: str, port: int) -> int:
    """Show them until the window is closed or Ctrl-C comes; returns the exit code."""
    try:
        if web or not has_screen(os.environ):
            return _in_page(resolve_recordings(files), host, port)
        viewer = open_window(files)
    except (OSError, ValueError, RuntimeError) as error:
        return refuse(str(error))
    try:
        viewer.wait()
    except RuntimeError as error:
        return refuse(str(error))
    except KeyboardInterrupt:
        say("closing")
    finally:
        viewer.close()
    return 0


def _in_page(files: Sequence[Path], host: str, port: int) -> int:
    from workbench.ui.server.file_response import Downloads
    from workbench.ui.server.gated_server import ServerOptions, open_server
    from workbench.ui.share.rerun_view import RerunPages

    web_viewer_folder()
    gated_server = open_server(ServerOptions(host=host, port=port))
    try:
        address = RerunPages(gated_server, Downloads(gated_server)).address(files)
        if gated_server.warning:
            warn(gated_server.warning)
        say_addresses(gated_server.addresses(address))
        say(f"  remote  {gated_server.ssh_hint}")
        say("  Ctrl-C ends it.")
        while True:
            # Not for ever in one go: a signal that the kernel hands to another thread does not wake this one.
            time.sleep(0.2)
    except KeyboardInterrupt:
        say("closing")
    finally:
        gated_server.close()
    return 0
