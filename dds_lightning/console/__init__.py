"""What a person at the terminal sees and does: reports, progress, interrupts."""
