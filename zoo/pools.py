"""Where jobs run: processes on this machine, or tasks on a Ray cluster."""

import importlib
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from subprocess import Popen
from typing import Any, Protocol

from sb3_e2c.zoo import jobs
from sb3_e2c.zoo.console import UserError, brief
from sb3_e2c.zoo.jobs import Outcome, outcome_of
from sb3_e2c.zoo.results import Place
from sb3_e2c.zoo.suite import Job

RETRIES = 3  # of a job whose machine or Ray worker is lost


class Pool(Protocol):
    """Runs jobs side by side."""

    def has_room(self) -> bool:
        """Whether another job may be started."""

    def start(self, place: Place) -> None:
        """Start a job."""

    def running(self) -> list[Place]:
        """Jobs that have been started and not been collected."""

    def collect(self) -> list[Outcome]:
        """Jobs that have ended since the last call."""

    def close(self) -> None:
        """Stop the jobs that still run."""


class LocalPool:
    """Processes of this machine.

    :param n_jobs: How many at a time
    :param start: Starts a job's process
    """

    def __init__(self, n_jobs: int, start: Callable[[Place], "Popen[bytes]"] = jobs.start):
        self.n_jobs = n_jobs
        self._start = start
        self._processes: dict[Place, Popen[bytes]] = {}

    def has_room(self) -> bool:
        """See :class:`Pool`."""
        return len(self._processes) < self.n_jobs

    def start(self, place: Place) -> None:
        """See :class:`Pool`."""
        self._processes[place] = self._start(place)

    def running(self) -> list[Place]:
        """See :class:`Pool`."""
        return list(self._processes)

    def collect(self) -> list[Outcome]:
        """See :class:`Pool`."""
        statuses = {place: process.poll() for place, process in self._processes.items()}
        ended = {place: status for place, status in statuses.items() if status is not None}
        for place in ended:
            jobs.let_go(self._processes.pop(place))
        return [outcome_of(place, status) for place, status in ended.items()]

    def close(self) -> None:
        """See :class:`Pool`."""
        jobs.stop(list(self._processes.values()))
        self._processes.clear()


class RayPool:
    """Tasks of a Ray cluster, one core each; all machines must see the results folder.

    Ray decides where and when a task runs, and repeats it elsewhere if its machine is lost.

    :param address: Of the cluster, or "local" to start one on this machine
    :param n_jobs: How many tasks at a time; None: as many as the cluster has cores
    :raises UserError: if Ray is not installed, or there is no cluster
    """

    def __init__(self, address: str, n_jobs: int | None):
        try:
            ray: Any = importlib.import_module("ray")
        except ImportError:
            raise UserError("--ray needs Ray: pip install 'sb3-e2c[distributed]'") from None
        _check_reachable(address)
        local = {"num_cpus": n_jobs, "include_dashboard": False} if address == "local" else {}
        try:
            ray.init(address=address, log_to_driver=False, logging_level="ERROR", **local)
        except (ConnectionError, ValueError, RuntimeError, OSError) as error:
            raise UserError(f"--ray {address}: {brief(error)}") from error
        self.n_jobs = n_jobs
        self._ray = ray
        self._task = ray.remote(num_cpus=1, max_retries=RETRIES)(run_here)
        self._tasks: dict[Any, Place] = {}

    def has_room(self) -> bool:
        """See :class:`Pool`."""
        cores = self._ray.cluster_resources().get("CPU", 1)
        return len(self._tasks) < (self.n_jobs or cores)

    def start(self, place: Place) -> None:
        """See :class:`Pool`."""
        folder = str(place.folder.absolute())
        self._tasks[self._task.remote(folder, place.job.settings())] = place

    def running(self) -> list[Place]:
        """See :class:`Pool`."""
        return list(self._tasks.values())

    def collect(self) -> list[Outcome]:
        """See :class:`Pool`."""
        if not self._tasks:
            return []
        ended, _ = self._ray.wait(list(self._tasks), num_returns=len(self._tasks), timeout=0)
        return [self._outcome(task) for task in ended]

    def _outcome(self, task: Any) -> Outcome:
        place = self._tasks.pop(task)
        try:
            return outcome_of(place, self._ray.get(task))
        except self._ray.exceptions.RayError as error:  # lost more often than it was repeated
            return jobs.record_failure(place, 1, [brief(error)])

    def close(self) -> None:
        """See :class:`Pool`."""
        for task in self._tasks:
            self._ray.cancel(task)
        self._ray.wait(list(self._tasks), num_returns=len(self._tasks), timeout=jobs.GRACE)
        self._ray.shutdown()
        self._tasks.clear()


def _check_reachable(address: str) -> None:
    """Refuse an address at which nobody answers; Ray would wait for many minutes."""
    host, _, port = address.rpartition("//")[2].rpartition(":")
    if not host:  # local, auto
        return
    try:
        socket.create_connection((host, int(port)), timeout=5.0).close()
    except (OSError, ValueError) as error:
        raise UserError(f"--ray {address}: no cluster answers there ({error})") from error


def run_here(folder: str, settings: dict[str, Any]) -> int:
    """Run a job in a process of this machine and wait for it.

    :param folder: The benchmark's folder, as this machine sees it
    :param settings: See :meth:`Job.settings`
    :return: Exit status of the process
    """
    process = jobs.start(Place(Path(folder), Job.from_settings(settings)))
    try:
        while process.poll() is None:
            time.sleep(0.5)  # Ray can interrupt this, but not a wait for the process
    finally:
        with suppress(OSError):
            jobs.stop([process])
    return process.returncode
