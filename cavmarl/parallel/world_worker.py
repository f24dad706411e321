"""The program of worker processes that run worlds; `Pool` starts it."""

from __future__ import annotations

from cavmarl.parallel.job_factory import make_jobs
from cavmarl.parallel.processes.worker_loop import serve

if __name__ == "__main__":
    serve(make_jobs)
