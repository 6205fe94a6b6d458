"""Data made on the spot: planners, controllers, and the recorder that writes what they did."""
