"""How the behaviour policies were trained; needs the extra `behaviours`."""
