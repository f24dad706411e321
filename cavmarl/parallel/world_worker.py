"""The program of the processes that run worlds; a pool starts it."""

from __future__ import annotations

from cavmarl.parallel.job_factory import make_jobs
from cavmarl.parallel.processes.worker_loop import serve

if __name__ == "__main__":
    serve(make_jobs)
