"""Environments: built from a task's row, and many of them side by side in worker processes."""
