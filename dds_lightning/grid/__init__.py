"""`dds study`: a grid over tasks, methods, settings and seeds, each piece of work done once, on any engine."""
