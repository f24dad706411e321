"""`TrainingJob`: a training program as a job of a cluster, which can be stopped and continued.

A job that is preempted, or whose machine fails, is started again by its cluster. It then resumes
from the last checkpoint of the run, whose folder all machines must be able to read and write.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cavmarl.core.errors import TrainingError, require
from cavmarl.core.processes import dying_with_parent
from cavmarl.evaluate.provenance.training_record import CHECKPOINT_FILE, is_trained

SAVE_S = 60.0  # time for the last checkpoint, before the program is killed
END_S = 300.0  # time in which a batch system ends a job after SIGTERM


@dataclass
class TrainingJob:
    """A run of a training program; calling the job trains until the run is complete.

    Attributes:
        program: path of the program.
        words: options of the program.
        folder: folder of the run.
        directory: working directory of the program.
        processes: number of processes that train together, see `data_parallel`.
    """

    program: str
    words: list[str]
    folder: str
    directory: str
    processes: int = 1

    def command(self) -> list[str]:
        """Return the command that begins the run, or continues a run that this job has begun."""
        launcher = [sys.executable]
        if self.processes > 1:
            launcher += ["-m", "torch.distributed.run", "--standalone"]
            launcher += [f"--nproc-per-node={self.processes}"]
        words = self.words
        if not self._is_resumed and (Path(self.folder) / CHECKPOINT_FILE).exists():
            words = ["--resume", self.folder]
        return [*launcher, self.program, *words]

    @property
    def _is_resumed(self) -> bool:
        """Whether the options continue a run that another job has begun."""
        return any(word.partition("=")[0] == "--resume" for word in self.words)

    def __call__(self) -> str:
        """Train, and return the folder of the run.

        Raises:
            TrainingError: the program has failed, or was ended.
        """
        if not self._is_resumed and is_trained(Path(self.folder)):
            return self.folder
        global _child
        # Block SIGUSR2 in the program, too, because batch systems send it to all processes.
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGUSR2})
        try:
            command = dying_with_parent(self.command())
            child = _child = subprocess.Popen(command, cwd=self.directory)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        told: list[int] = []

        def end(number: int, _: object) -> None:
            told.append(number)
            if child.returncode is None:
                os.kill(child.pid, signal.SIGTERM)

        is_main = threading.current_thread() is threading.main_thread()
        before = signal.signal(signal.SIGTERM, end) if is_main else None
        while (code := child.poll()) is None:
            time.sleep(0.2)
        if is_main:
            signal.signal(signal.SIGTERM, before)
        if told and not is_trained(Path(self.folder)):
            time.sleep(END_S)  # the batch system ends this process, and starts the job again
        if code:
            raise TrainingError(
                f"{self.folder}: the program ended with exit code {code}; its message is in the "
                "log of this job"
            )
        return self.folder

    def checkpoint(self) -> Any:
        """Let the program write its last checkpoint; return the job, to be queued again.

        submitit calls this at SIGUSR2, before the job is preempted or reaches its time limit.
        """
        if _child is not None:
            os.kill(_child.pid, signal.SIGTERM)
            until = time.monotonic() + SAVE_S
            # The methods of `subprocess` need a lock, which the interrupted call may hold.
            while os.waitid(os.P_PID, _child.pid, os.WEXITED | os.WNOWAIT | os.WNOHANG) is None:
                if time.monotonic() > until:
                    os.kill(_child.pid, signal.SIGKILL)
                time.sleep(0.05)
        return require("submitit.helpers", "cluster").DelayedSubmission(self)


_child: subprocess.Popen[bytes] | None = None  # not a field: jobs are pickled
