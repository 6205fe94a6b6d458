"""How a stage is fitted: the Trainer with this project's parts, its progress line, its stopping and resuming."""
