"""The program of the processes that sense; a farm starts it."""

from __future__ import annotations

from cavmarl.runtime.worker import serve
from cavmarl.stepping.sensing import make_sensor_jobs

if __name__ == "__main__":
    serve(make_sensor_jobs)
