"""What the method is compared with, one algorithm a file."""
