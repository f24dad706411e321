"""The program of the processes that run worlds; a pool starts it."""

from __future__ import annotations

from cavmarl.runtime.worker import serve
from cavmarl.stepping.jobs import make_jobs

if __name__ == "__main__":
    serve(make_jobs)
