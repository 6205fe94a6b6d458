"""What the method is measured against, and how the measurement is told."""
