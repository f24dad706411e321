"""Compiled loops: observations, rays, pictures, schedules and errors of sensors."""
