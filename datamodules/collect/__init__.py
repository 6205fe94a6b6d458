"""Collects data: planners, controllers, and the recorder that writes what they did."""
