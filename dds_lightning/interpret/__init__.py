"""Pictures of what the skills are: drawn from tables and recorded paths, never from a living model."""
