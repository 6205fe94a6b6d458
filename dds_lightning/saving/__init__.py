"""Files that survive: checkpoints, published agents, run directories."""
