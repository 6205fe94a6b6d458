"""Sharing an agent: export to one file, verification of a published directory."""
