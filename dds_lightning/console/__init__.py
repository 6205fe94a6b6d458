"""What whoever sits at the terminal sees and does: reports, progress, stopping."""
