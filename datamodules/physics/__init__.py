"""The simulator put into recorded states: whether a recording belongs to an environment."""
