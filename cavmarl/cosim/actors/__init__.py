"""Vehicles, people and roadside units that clients and recorded traces bring into a world."""
