"""What the method is measured against, and how the measurements are reported."""
