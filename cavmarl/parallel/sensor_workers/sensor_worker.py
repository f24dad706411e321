"""The program of sensor workers; `SensorFarm` starts it."""

from __future__ import annotations

from cavmarl.parallel.processes.worker_loop import serve
from cavmarl.parallel.sensor_workers.sensor_worker_setup import make_sensor_jobs

if __name__ == "__main__":
    serve(make_sensor_jobs)
