"""The skill atlas: everything about the skills of one checkpoint, measured, drawn, and written as one HTML file."""
