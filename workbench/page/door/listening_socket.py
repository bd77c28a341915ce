"""The listening socket of the page: a TCP port, or a Unix socket that only its owner can connect to."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import getpass
import ipaddress
import os
import socket
import stat
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import psutil

DEFAULT_PORT = 8080
PORTS_TO_TRY = 100
MAX_PATH_BYTES = 107
"""Maximum length of the path of a Unix socket (unix(7)); ssh cannot reach a longer one either."""
BACKLOG = 100


class ServerError(RuntimeError):
    """The page cannot be served. The message includes the remedy."""


@dataclass(frozen=True)
class Listening:
    """A listening socket and how to reach it."""

    socket: socket.socket
    host: str
    """Host in the address that a browser opens: a name or an address, IPv6 in brackets."""
    port: int
    """Port in the address that a browser on this machine or behind `ssh_hint` opens."""
    bound_host: str
    """Address that the socket is bound to."""
    loopback: bool
    """Whether only this machine can connect."""
    path: Path | None = None
    """Path of the Unix socket; None for a TCP port."""
    inode: int = 0
    """Inode of the Unix socket's file, by which `remove` recognizes it."""

    @property
    def authority(self) -> str:
        return f"{self.host}:{self.port}"

    @property
    def ssh_hint(self) -> str:
        """The ``ssh -L`` command to type on the user's own machine."""
        to = f"{self.host if self.loopback else '127.0.0.1'}:{self.port}" if self.path is None else self.path
        return f"ssh -L {self.port}:{to} {_user()}@{socket.gethostname()}"

    def external_hosts(self) -> tuple[str, ...]:
        """This machine's name and addresses for browsers on other machines. When listening on every interface, loopback is
        last: for a container's published port, loopback is the address that works on the host."""
        if self.loopback:
            return ()
        address = ipaddress.ip_address(self.bound_host.partition("%")[0])
        hosts = [socket.gethostname()]
        if address.is_unspecified:
            hosts += [*_own_addresses(address.version), "127.0.0.1" if address.version == 4 else "[::1]"]
        else:
            hosts.append(_in_address(address))
        return tuple(dict.fromkeys(host for host in hosts if host and host != "localhost"))

    def connect(self, timeout: float) -> socket.socket:
        """Connect to the socket as a client on this machine."""
        if self.path is None:
            address = ipaddress.ip_address(self.bound_host.partition("%")[0])
            loopback = "::1" if address.version == 6 else "127.0.0.1"
            host = loopback if address.is_unspecified else self.bound_host
            return socket.create_connection((host, self.port), timeout=timeout)
        client = socket.socket(socket.AF_UNIX)
        client.settimeout(timeout)
        client.connect(str(self.path))
        return client

    def remove(self) -> None:
        """Remove the file of a Unix socket, if it is still ours."""
        if self.path is not None:
            with contextlib.suppress(FileNotFoundError):
                if self.path.lstat().st_ino == self.inode:
                    self.path.unlink()


def listen_on_port(host: str, port: int) -> Listening:
    """Listen on a TCP port.

    Args:
        host: An address or a name of this machine.
        port: 0 takes any free port. If `DEFAULT_PORT` is taken, the next free one is used.

    Raises:
        ServerError: The host is not this machine's, or the port is taken or forbidden.
    """
    # "localhost" may be 127.0.0.1, ::1 or both; the printed address must be the bound one.
    asked = "127.0.0.1" if host.lower() == "localhost" else host
    try:
        family, _, _, _, address = socket.getaddrinfo(
            asked, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
    except (OSError, UnicodeError) as error:
        raise ServerError(f"Cannot listen on {host}: {error}. Give an address of this machine.") from None
    last = min(port + PORTS_TO_TRY, 65536) if port == DEFAULT_PORT else port + 1
    for candidate in range(port, last):
        try:
            made = socket.create_server((address[0], candidate), family=family, backlog=BACKLOG)
        except PermissionError:
            raise ServerError(
                f"Port {candidate} needs root privileges; give one from 1024 up with --port."
            ) from None
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise ServerError(
                    f"Cannot listen on {host}: {error.strerror}. Give an address of this machine."
                ) from None
            continue
        bound, bound_port = made.getsockname()[:2]
        loopback = ipaddress.ip_address(bound.partition("%")[0]).is_loopback
        return Listening(made, _reach(bound), bound_port, bound, loopback)
    if port == DEFAULT_PORT:
        raise ServerError(f"Ports {port} to {last - 1} are all taken; --port 0 takes any free one.")
    raise ServerError(f"Port {port} is taken by another program; give another with --port, or 0 for any.")


def listen_on_file(path: Path, port: int) -> Listening:
    """Listen on a Unix socket with mode 0600.

    On a shared machine every user can connect to a loopback port, and a browser sends its cookies to every port of a host.
    For a Unix socket the kernel checks the user who connects, and the browser reaches it through the user's ``ssh -L``.

    Args:
        path: Path of the socket. The socket of a killed workbench is replaced.
        port: Port on the browser's machine, at the other end of ``ssh -L``.

    Raises:
        ServerError: `path` exists and is not the socket of a killed workbench, or other users may write into
            its folder.
    """
    folder = path.expanduser().absolute().parent.resolve()
    place = folder / path.name
    if len(os.fsencode(place)) > MAX_PATH_BYTES:
        raise ServerError(f"The path of a socket has at most {MAX_PATH_BYTES} bytes; {place} is longer.")
    made = socket.socket(socket.AF_UNIX)
    try:
        with _alone_in(folder):
            _make_room(place)
            # Linux creates the file with the mode of the socket, so it never exists with a wider one.
            os.fchmod(made.fileno(), 0o600)
            made.bind(str(place))
            made.listen(BACKLOG)
            return Listening(
                made, "localhost", port or DEFAULT_PORT, "localhost", True, place, place.lstat().st_ino
            )
    except OSError as error:
        made.close()
        raise ServerError(f"Cannot make the socket {place}: {error.strerror}.") from None
    except ServerError:
        made.close()
        raise


@contextlib.contextmanager
def _alone_in(folder: Path) -> Iterator[None]:
    """Lock the folder: no other workbench makes or removes a socket in it meanwhile."""
    try:
        handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except (FileNotFoundError, NotADirectoryError):
        raise ServerError(
            f"There is no folder {folder} for the socket; mkdir -m 700 {folder} makes a folder that only you can use."
        ) from None
    try:
        found = os.fstat(handle)
        others_write = found.st_mode & (stat.S_IWGRP | stat.S_IWOTH) and not found.st_mode & stat.S_ISVTX
        if found.st_uid not in (os.getuid(), 0) or others_write:
            raise ServerError(
                f"Others can write into {folder}, and could replace this socket with their own. Give a "
                "folder that is yours alone, such as one made with mkdir -m 700."
            )
        fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def _make_room(place: Path) -> None:
    """Remove the socket of a killed workbench.

    Raises:
        ServerError: Something else is at this path, or a program listens there.
    """
    try:
        found = place.lstat()
    except FileNotFoundError:
        return
    if not stat.S_ISSOCK(found.st_mode) or found.st_uid != os.getuid():
        raise ServerError(
            f"{place} exists already and is not a socket of yours. It was left alone; give another path."
        )
    with socket.socket(socket.AF_UNIX) as client:
        client.settimeout(2.0)
        try:
            client.connect(str(place))
        except ConnectionRefusedError:
            place.unlink()
            return
        except OSError:  # a program listens but is too busy to answer
            pass
    raise ServerError(f"Another program is listening at {place}, perhaps a workbench; give another path.")


def _reach(host: str) -> str:
    """``host`` as in a URL: an IPv6 address is in brackets. If ``host`` means every interface, returns the
    address of the interface with the default route, found by connecting a datagram socket, which sends
    nothing."""
    address = ipaddress.ip_address(host.partition("%")[0])
    if not address.is_unspecified:
        return _in_address(address)
    # TEST-NET-1 and the documentation prefix, RFC 5737 and 3849. Our IPv6 sockets do not accept IPv4.
    family, far = (socket.AF_INET6, "2001:db8::1") if address.version == 6 else (socket.AF_INET, "192.0.2.1")
    with socket.socket(family, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect((far, 9))
            return _in_address(ipaddress.ip_address(probe.getsockname()[0].partition("%")[0]))
        except OSError:
            return "[::1]" if address.version == 6 else "127.0.0.1"


def _own_addresses(version: int) -> list[str]:
    """Addresses of the interfaces that are up, without loopback and link-local ones."""
    up = {name for name, state in psutil.net_if_stats().items() if state.isup}
    hosts: list[str] = []
    for name, given in psutil.net_if_addrs().items():
        for one in given if name in up else ():
            if one.family not in (socket.AF_INET, socket.AF_INET6):
                continue
            address = ipaddress.ip_address(one.address.partition("%")[0])
            if address.version == version and not address.is_loopback and not address.is_link_local:
                hosts.append(_in_address(address))
    return hosts


def _in_address(address: ipaddress.IPv4Address | ipaddress.IPv6Address) -> str:
    return f"[{address}]" if address.version == 6 else str(address)


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # a container's user without a name
        return "USER"
