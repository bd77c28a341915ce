"""Finds the worker processes of a page's server or of a test."""

from __future__ import annotations

import psutil


def workers_of(server: psutil.Process) -> list[psutil.Process]:
    """The keeper process of each worker, oldest first; the worker is its only child."""
    keepers: list[psutil.Process] = []
    for child in server.children():
        try:
            command = " ".join(child.cmdline())
        except psutil.NoSuchProcess:  # it has exited, reaped or not
            continue
        if "workbench.app.worker.start" in command:
            keepers.append(child)
        elif "workbench.app.worker.fork_server" in command:
            keepers += child.children()
    return sorted(keepers, key=lambda process: process.create_time())
