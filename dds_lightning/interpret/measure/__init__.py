"""Numbers about skills, measured in the data and in the simulator."""
