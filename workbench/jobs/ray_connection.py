"""Connects to a Ray cluster, or starts one that only this user can reach.

Works around problems of Ray's own connection; all uses of Ray's private names are in this module.
"""

from __future__ import annotations

import os
import secrets
import select
import socket
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import Any

AUTO, LOCAL = "auto", "local"
BREAKPOINT = "PYTHONBREAKPOINT"
"""Environment variable that Ray sets for its workers and for processes that connect to a cluster."""
_CONNECT_SECONDS = 5.0
_PROBE_SECONDS = 2.0
_HEAD_DOWN_SECONDS = 20.0
"""Time for which the head of the cluster may refuse connections, for example while it restarts. After 60 s of
this, Ray itself would end this process."""
_INSTALL = "pip install 'maniskill-workbench[cluster]'"
_AUTH_MODE = "RAY_AUTH_MODE"


class NoCluster(OSError):
    """No cluster answers, or the cluster cannot run a worker; the message gives advice."""


class ClusterLost(OSError):
    """The cluster ended during use; the message gives the reason, as far as known."""


class ClusterHealth:
    """Detects that the daemons of the connected cluster have ended.

    Ray itself needs seconds to notice, and then ends this process from native code, without an exception.
    """

    def __init__(self) -> None:
        from ray._private.worker import _global_node

        self._raylet: socket.socket | None = None
        self._head = ""
        self._probed_at = self._answered_at = time.monotonic()
        if _global_node is None:  # a ray:// address: Ray's own errors report the cluster's end
            return
        self._head = _global_node.gcs_address
        self._raylet = socket.socket(socket.AF_UNIX)
        self._raylet.connect(_global_node.raylet_socket_name)

    def check(self) -> None:
        """Raise ClusterLost if the daemons have ended. Cheap: connects only every `_PROBE_SECONDS`."""
        # The raylet sends nothing on an idle connection: readable means closed.
        if self._raylet is not None and select.select([self._raylet], (), (), 0)[0]:
            raise ClusterLost("Ray's daemon of this machine (raylet) has ended")
        now = time.monotonic()
        if not self._head or now - self._probed_at < _PROBE_SECONDS:
            return
        self._probed_at = now
        why = _why_unreachable(self._head)
        if why is None:
            self._answered_at = now
        elif now - self._answered_at > _HEAD_DOWN_SECONDS:
            raise ClusterLost(f"the head of the cluster, {self._head}, no longer answers ({why})")

    def close(self) -> None:
        if self._raylet is not None:
            self._raylet.close()


@contextmanager
def connected(address: str = AUTO) -> Iterator[Any]:
    """Yield the module ``ray``, connected to a cluster. A cluster that is started here ends with the context.

    Raises:
        NoCluster: Ray is not installed, or nothing answers at the address.
    """
    try:
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        # Ray would overwrite the library path of each actor without a GPU, and warn of that.
        os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
        import ray
        from ray.exceptions import RayError
    except ImportError as error:
        raise NoCluster(f"--cluster needs Ray, which is not installed: {_INSTALL}") from error
    if ray.is_initialized():
        yield ray
        return
    if address == AUTO:
        address = os.environ.get("RAY_ADDRESS") or _left_here() or LOCAL
    if address != LOCAL and (why := _why_unreachable(address)) is not None:
        raise NoCluster(_no_cluster_text(address, why))
    how: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR", "namespace": "workbench"}
    with ExitStack() as kept:
        kept.enter_context(_standard_output_kept())
        try:
            kept.enter_context(_token_given(ray, address))
            _connect(ray, address, how)
        except (RayError, ConnectionError, ValueError, RuntimeError) as error:
            raise NoCluster(_no_cluster_text(address, str(error))) from error
        try:
            yield ray
        finally:
            ray.shutdown()


@contextmanager
def _token_given(ray: Any, address: str) -> Iterator[None]:
    """Within this block, send this user's token if the cluster requires one and ``RAY_AUTH_MODE`` is not set.

    A cluster that ``ray start`` has started requires a token if this user has one. By default Ray does not
    send the token, and is refused after twenty seconds. If the token is sent to a cluster that requires none,
    no worker starts.
    """
    if not _asks_for_token(ray, address):
        yield
        return
    os.environ[_AUTH_MODE] = "token"
    ray._raylet.Config.initialize("")  # Ray has read the mode when it was imported: read it again
    try:
        yield
    finally:
        os.environ.pop(_AUTH_MODE)
        ray._raylet.Config.initialize("")


def _asks_for_token(ray: Any, address: str) -> bool:
    if address == LOCAL or "://" in address or _AUTH_MODE in os.environ:
        return False
    try:
        ray._raylet.GcsClient(address=address)
    except ray.exceptions.AuthenticationError:
        return True
    return False


def _why_unreachable(address: str) -> str | None:
    """Why nothing accepts connections at the address; None if something does. Ray itself would retry for
    minutes."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    try:
        with socket.create_connection((host, int(port)), timeout=_CONNECT_SECONDS):
            return None
    except ValueError:
        return "not of the form host:port"
    except OSError as error:
        return error.strerror or str(error)


def _no_cluster_text(address: str, why: str) -> str:
    return (
        f"no Ray cluster answers at {address} ({why}). Start one with `ray start --head`, or use --cluster "
        "auto. If the cluster requires a token, set RAY_AUTH_TOKEN"
    )


def _left_here() -> str | None:
    """Address of a cluster that was started on this machine and still answers; None if there is none."""
    from ray._private.services import find_bootstrap_address

    # Ray keeps the address of a cluster that has ended, and would try to connect for minutes.
    address = find_bootstrap_address(None)
    return address if address and _why_unreachable(address) is None else None


def _connect(ray: Any, address: str, how: Mapping[str, Any]) -> None:
    with _breakpoints_kept():
        if address != LOCAL:
            ray.init(address=address, **how)
            return
        with _only_for_this_user():
            ray.init(address=LOCAL, num_cpus=len(os.sched_getaffinity(0)), include_dashboard=False, **how)
    if not ray.get_runtime_context().gcs_address.startswith("127.0.0.1:"):
        ray.shutdown()
        raise NoCluster(
            f"Ray {ray.__version__} would let other machines connect to the cluster that it starts. Start "
            "one yourself with `ray start --head`, and give its address to --cluster"
        )


@contextmanager
def _standard_output_kept() -> Iterator[None]:
    """Keep Ray's messages about dead workers off stdout, which is for results; the pool reports dead workers."""
    from ray._private import worker

    before = worker.print_to_stdstream
    worker.print_to_stdstream = lambda data, ignore_prefix: None
    try:
        yield
    finally:
        worker.print_to_stdstream = before


@contextmanager
def _breakpoints_kept() -> Iterator[None]:
    """Keep the behaviour of ``breakpoint()``: Ray sets its own debugger for this process and its later children."""
    before = os.environ.get(BREAKPOINT)
    try:
        yield
    finally:
        os.environ.pop(BREAKPOINT, None)
        if before is not None:
            os.environ[BREAKPOINT] = before


@contextmanager
def _only_for_this_user() -> Iterator[None]:
    """Within this block, let Ray start on the loopback address, with a token that only this user has.

    Anyone who can connect to a cluster can run code in it, and by default Ray listens on all addresses of the machine.
    """
    from ray._private import ray_constants

    before = ray_constants.ENABLE_RAY_CLUSTER
    ray_constants.ENABLE_RAY_CLUSTER = False
    # The environment variable is for the daemons, which import the constant again.
    os.environ[ray_constants.ENABLE_RAY_CLUSTERS_ENV_VAR] = "0"
    # Workers get the niceness of local processes; Ray's default of 15 is for shared machines.
    os.environ.setdefault("RAY_worker_niceness", "0")
    # Ray requires a token; without this it writes one into the home folder, where other users may read it.
    os.environ.setdefault("RAY_AUTH_TOKEN", secrets.token_hex(32))
    try:
        yield
    finally:
        ray_constants.ENABLE_RAY_CLUSTER = before
        os.environ.pop(ray_constants.ENABLE_RAY_CLUSTERS_ENV_VAR)
