"""Worker processes that run worlds: SuperSuit's, waited for with patience and never longer.

A worker that dies, hangs or sends something unreadable is named with its worlds.
"""

import pickle
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from supersuit.vector.concat_vec_env import ConcatVecEnv
from supersuit.vector.multiproc_vec import ProcConcatVec
from typing_extensions import override

# How often to look whether a silent worker is alive. Only whole intervals of waiting count, so
# that a program that was stopped for hours has not waited all the time.
_LOOK_SECONDS = 0.5


class _RemoteTraceback(Exception):
    """Where in a worker process an error was raised; the cause of that error in this process."""


class WorkerProcesses(ProcConcatVec):
    """SuperSuit's worker processes.

    :param makers: make the rows of each of W worlds, inside a worker
    :param n_processes: number of workers; their shares of the worlds are nearly equal
    :param like: has the agents and spaces of all worlds
    :param timeout: seconds to wait for an answer; None waits without end
    """

    def __init__(
        self,
        makers: Sequence[Callable[[], Any]],
        n_processes: int,
        like: Any,
        timeout: float | None,
    ):
        self.timeout = timeout
        self._shares = [part.tolist() for part in np.array_split(range(len(makers)), n_processes)]
        super().__init__(
            [partial(ConcatVecEnv, [makers[world] for world in part]) for part in self._shares],
            like.observation_space,
            like.action_space,
            len(makers) * len(like.agents),
            like.metadata,
        )

    @override
    def _receive_info(self) -> list[Any]:
        return [self._answer(worker) for worker in range(len(self.pipes))]

    def _answer(self, worker: int) -> Any:
        """What a worker sends next; the error of a world is raised here."""
        self._await(worker)
        try:
            message = self.pipes[worker].recv_bytes()
        except (EOFError, OSError) as error:
            raise self._death(worker) from error
        try:
            answer = pickle.loads(message)
        except Exception as error:
            raise RuntimeError(
                f"{self._name(worker)} sent something that cannot be read; expected observations, "
                "or an error that survives pickling. Try n_processes=1 to see it"
            ) from error
        if not isinstance(answer, tuple):
            return answer
        raised, text = answer
        if not isinstance(raised, Exception):  # it would end this program without a word
            raised = RuntimeError(f"{self._name(worker)} was ended by {raised!r}")
        raise raised from _RemoteTraceback(f"in {self._name(worker)}:\n{text}")

    def _await(self, worker: int) -> None:
        """Return when there is something to receive."""
        pipe, proc, waited = self.pipes[worker], self.procs[worker], 0.0
        interval = _LOOK_SECONDS if self.timeout is None else min(_LOOK_SECONDS, self.timeout)
        while not pipe.poll(interval):
            # Its pipe stays open where processes that it has started live longer than itself.
            if not proc.is_alive() and not pipe.poll():
                raise self._death(worker)
            waited += interval
            if self.timeout is not None and waited >= self.timeout:
                raise TimeoutError(
                    f"{self._name(worker)} has not answered for {self.timeout:g} seconds; expected "
                    "its worlds' next observations. One of them hangs, or needs more time: "
                    "share_parameters(..., timeout=...)"
                )

    def a_death(self) -> RuntimeError | None:
        """News of the first worker that has died, if any has."""
        for worker, proc in enumerate(self.procs):
            proc.join(timeout=0.1)  # its pipes close a moment before it has an exit code
            if not proc.is_alive():
                return self._death(worker)
        return None

    def _death(self, worker: int) -> RuntimeError:
        proc = self.procs[worker]
        proc.join(timeout=1.0)
        return RuntimeError(
            f"{self._name(worker)} ended with exit code {proc.exitcode}; expected it to answer "
            "with its worlds' next observations. Look above for its traceback and for lack of "
            "memory, try n_processes=1, and make the environment again"
        )

    def _name(self, worker: int) -> str:
        worlds = self._shares[worker]
        return f"worker process {worker} (worlds {worlds[0]} to {worlds[-1]})"


def is_of_a_world(error: BaseException) -> bool:
    """Whether an error was raised by a world, and not by the talk with its worker.

    :param error: raised by :class:`WorkerProcesses`
    """
    return isinstance(error.__cause__, _RemoteTraceback)


def kill(procs: list[Any]) -> None:
    """End worker processes at once, and wait until they are gone.

    :param procs: of this program
    """
    for proc in procs:
        if proc.is_alive():
            proc.kill()
        proc.join()
