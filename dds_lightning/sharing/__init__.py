"""An agent for others: exported to one file, verified."""
